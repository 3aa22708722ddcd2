"""What a killed run goes on from: beside each checkpoint its logs up to there, and whole copies of Tune's state.

Tune writes logs and its state to a staging folder and copies them to the results folder in the background, over what is
there. After a kill these copies are late, or torn. So each checkpoint gets a copy of its own, and so does the state.
"""

import contextlib
import json
import pickle
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ray
from ray.tune.logger import LoggerCallback

from rllib_maobs.experiment.report import STEPS
from rllib_maobs.paths import write_aside
from rllib_maobs.whole import CHECKSUMS, find_fault, numbered, write_checksums

LOGS = "logs"
"""The folder in a checkpoint with the trial's logs up to it."""
SAVING = ".saving"
"""The folder of a trial where its next checkpoint is written, from where Tune copies it."""
STATE = ".state"
"""The folder of an experiment with copies of Tune's state."""
_LOG_FILES = ("result.json", "progress.csv", "events.out.*")
# TensorBoard takes all files with tfevents in their names for runs, at any depth: copies are called otherwise.
_EVENTS, _KEPT_EVENTS = "tfevents", "tf-events"
_STATE_FILES = ("*.json", "*.pkl")


class Keeper(LoggerCallback):
    """Keeps what a killed run goes on from, and says which checkpoints could not be written.

    It comes before the callbacks that log: a trial that starts finds its logs as its checkpoint has them.

    Attributes:
        failures: A sentence for each checkpoint that could not be written.
    """

    def __init__(self) -> None:
        self.failures: list[str] = []
        self._last: dict[str, str] = {}  # by trial, the checkpoint that it has
        self._saved: list[Any] = []
        self._kept: dict[str, tuple[int, int]] = {}

    def log_trial_start(self, trial: Any) -> None:
        """Take away what the logs hold beyond the checkpoint that the trial goes on from."""
        folder, checkpoint = Path(trial.storage.trial_fs_path), _path(trial)
        self._last[trial.trial_id] = str(checkpoint)
        if checkpoint is None:
            for path in numbered(folder):
                put_aside(path)
        put_back_logs(checkpoint, folder, Path(trial.local_path))

    def log_trial_save(self, trial: Any) -> None:
        """Note which checkpoint there is now, or that it could not be written."""
        checkpoint = _path(trial)
        if str(checkpoint) == self._last.get(trial.trial_id):
            with contextlib.suppress(Exception):
                reason = ray.get(trial.temporary_state.ray_actor.why_not_saved.remote(), timeout=10.0)
                self._tell(trial, reason)
                return
            self._tell(trial, "the log of its process says why")
            return
        self._last[trial.trial_id] = str(checkpoint)
        self._saved.append(trial)  # other callbacks still log what they make of it

    def on_step_end(self, iteration: int, trials: list[Any], **info: Any) -> None:
        """Keep the logs of what was saved in this step, and Tune's state if it has changed."""
        while self._saved:
            trial = self._saved.pop()
            if (checkpoint := _path(trial)) is not None:
                try:
                    keep_logs(checkpoint, Path(trial.storage.trial_fs_path), Path(trial.local_path))
                except OSError as error:
                    self._tell(trial, f"its logs: {error.strerror or error}")
        if trials:
            self._keep_state(Path(trials[0].local_path).parent, Path(trials[0].storage.experiment_fs_path) / STATE)

    def _keep_state(self, staging: Path, kept: Path) -> None:
        for path in (path for pattern in _STATE_FILES for path in staging.glob(pattern)):
            at = path.stat().st_mtime_ns, path.stat().st_size
            if self._kept.get(path.name) != at:
                with contextlib.suppress(OSError, ValueError):  # a full disk: the copy before it stays
                    kept.mkdir(exist_ok=True)
                    write_aside(kept / path.name, path.read_bytes())
                    self._kept[path.name] = at

    def _tell(self, trial: Any, reason: str) -> None:
        stays = "the one before it stays" if _path(trial) is not None else "there is none before it"
        self.failures.append(
            f"The checkpoint of {trial} at {int(trial.last_result.get(STEPS, 0)):,} env steps could not be written "
            f"({reason}); training goes on, and {stays}."
        )
        print(self.failures[-1], flush=True)


def _path(trial: Any) -> Path | None:
    return None if trial.checkpoint is None else Path(trial.checkpoint.path)


def _logs(folder: Path) -> Iterator[Path]:
    for pattern in _LOG_FILES:
        yield from folder.glob(pattern)


def keep_logs(checkpoint: Path, *folders: Path) -> None:
    """Copy a trial's logs into its checkpoint.

    Args:
        checkpoint: Its folder.
        folders: Where logs are; of two of one name the later folder's counts.

    Raises:
        OSError: If they cannot be written; nothing half-written stays.
    """
    aside = checkpoint / f".{LOGS}.part"
    shutil.rmtree(aside, ignore_errors=True)
    try:
        aside.mkdir()
        for path in {path.name: path for folder in folders for path in _logs(folder)}.values():
            shutil.copyfile(path, aside / path.name.replace(_EVENTS, _KEPT_EVENTS))
        write_checksums(aside)
        aside.rename(checkpoint / LOGS)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def put_back_logs(checkpoint: Path | None, *folders: Path, finished: bool = False) -> None:
    """Make a trial's logs what they were when it was saved.

    Args:
        checkpoint: From which it goes on; None if it starts anew, and its logs with it.
        folders: Where the logs are.
        finished: Whether the trial does not go on: then logs that begin as they did stay, with all that follows.
    """
    if checkpoint is not None and not (checkpoint / LOGS).is_dir():
        return  # of a revision that kept none
    copies = [] if checkpoint is None else _logs(checkpoint / LOGS)
    kept = {path.name.replace(_KEPT_EVENTS, _EVENTS): path for path in copies}
    for folder in folders:
        if not finished:
            for path in [path for path in _logs(folder) if path.name not in kept]:
                path.unlink()
        for name, path in kept.items():
            content = path.read_bytes()
            if not (finished and _begins(folder / name, content)):
                write_aside(folder / name, content)


def _begins(path: Path, content: bytes) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(content)) == content
    except OSError:
        return False


def last_result(checkpoint: Path) -> dict[str, Any]:
    """Return the result after which a checkpoint was saved, from the logs in it."""
    *_, last = (checkpoint / LOGS / "result.json").read_text().splitlines()
    result: dict[str, Any] = json.loads(last)
    return result


def find_unfit(checkpoint: Path) -> str | None:
    """Say why a run cannot go on from a checkpoint of a trial; None if it can."""
    if fault := find_fault(checkpoint):
        return fault
    if not (checkpoint / CHECKSUMS).exists():
        return None  # of a revision that wrote none, and kept no logs
    if not (checkpoint / LOGS).is_dir():
        return "its logs are missing"
    if not (checkpoint / LOGS / CHECKSUMS).exists():
        return f"{LOGS}/{CHECKSUMS} is missing"
    fault = find_fault(checkpoint / LOGS)
    return fault and f"{LOGS}/{fault}"


def put_aside(checkpoint: Path) -> str:
    """Take a checkpoint that its trial does not go on from out of the way: one that was whole once is kept.

    Args:
        checkpoint: Its folder.

    Returns:
        The name that it has now; "" if it was never finished, and is removed.
    """
    if not (checkpoint / LOGS).is_dir():
        shutil.rmtree(checkpoint)
        return ""
    aside = checkpoint.with_name(f"damaged_{checkpoint.name}")
    shutil.rmtree(aside, ignore_errors=True)
    return checkpoint.rename(aside).name


def mend_state(results_dir: Path) -> None:
    """Put copies in the place of those files of Tune's state that were torn when the run was killed."""
    for path in (path for pattern in _STATE_FILES for path in (results_dir / STATE).glob(pattern)):
        if not _is_whole(results_dir / path.name):
            write_aside(results_dir / path.name, path.read_bytes())


def _is_whole(path: Path) -> bool:
    try:
        (json if path.suffix == ".json" else pickle).loads(path.read_bytes())
    except Exception:  # pickle raises what it likes
        return False
    return True


def sweep(results_dir: Path) -> None:
    """Remove what a killed run has left half-written."""
    for trial in (path for path in results_dir.iterdir() if path.is_dir()):
        shutil.rmtree(trial / SAVING, ignore_errors=True)
        for path in [*trial.glob(".*.part"), *trial.glob(f"checkpoint_*/.{LOGS}.part")]:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    for path in results_dir.glob(".*.part"):
        path.unlink()
