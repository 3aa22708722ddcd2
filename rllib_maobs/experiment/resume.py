"""What a resumed run needs done to Tune's saved state, which Tune itself does not do."""

import glob
import json
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import ray
from ray import tune
from ray.rllib.utils.annotations import override
from ray.train._internal.checkpoint_manager import _CheckpointManager
from ray.train._internal.session import _TrainingResult
from ray.tune.experiment.trial import Trial as TuneTrial
from ray.tune.search.basic_variant import BasicVariantGenerator

from rllib_maobs.experiment.claim import wait_until_free
from rllib_maobs.experiment.keeping import LOGS, find_unfit, last_result, mend_state, put_aside, put_back_logs, sweep
from rllib_maobs.whole import numbered

OUTLIVES = 30.0
"""Seconds that a killed run's processes may live on; Ray ends them after two or three."""
TESTED_RAY = (2, 60)
"""The release of Ray, any patch of it, whose saved state this was tried with: the range in `pyproject.toml`."""
STATES = "experiment_state-*.json"
"""Tune's saved states, one for each time that a run was started or resumed; it goes on from the newest."""
_DECISIONS = "_cached_trial_decisions"


NOT_RESTORED = (
    "Ray Tune could not restore the state of this run (see the log above); nothing was started or written over: go on "
    "with the version of this package that began it, try again, or restore the folder from a copy"
)


class StateError(RuntimeError):
    """Tune's saved state is not what it must be to go on with a run."""


class Grid(BasicVariantGenerator):
    """Tune's own way through a grid of trials, but a resumed run may have more trials than it had at first.

    Args:
        resumed: Whether a run is resumed. Should Tune fail to, it would start all trials once more; not with this.
        rest: For a resumed run, the trials that Tune's saved state does not hold yet, if there are any.
    """

    def __init__(self, *, resumed: bool = False, rest: tune.Experiment | None = None) -> None:
        super().__init__()
        self._rest = rest
        # None: there is nothing to restore.
        self.restored = False if resumed else None

    @override(BasicVariantGenerator)
    def add_configurations(self, experiments: Any) -> None:
        """Take trials to start."""
        if self.restored is False:
            raise StateError(NOT_RESTORED)
        super().add_configurations(experiments)

    @override(BasicVariantGenerator)
    def restore_from_dir(self, dirpath: str) -> None:
        """Go on from the newest state in a folder, with the trials that are left."""
        rest = self._rest
        super().restore_from_dir(glob.escape(dirpath))  # Tune takes the folder's name for a pattern.
        # What the state had left is among the rest.
        self.__dict__ |= {"_iterators": [], "_trial_generator": [], "_finished": rest is None}
        self.restored, self._rest = True, None
        if rest is not None:
            self.add_configurations([rest])


def take_up(results_dir: Path, kept: int) -> bool:
    """Make Tune's saved state, the trials' checkpoints and their logs fit together, whenever the run was killed.

    Tune goes on from the state that it saved last, which may know less than there is on disk, or be torn. What is on
    disk decides: each trial goes on from its newest checkpoint that is whole and has its logs. Newer ones that are not
    are removed; one that was whole once is put aside as "damaged_...".

    Args:
        results_dir: The folder of the run.
        kept: Checkpoints that a trial keeps.

    Returns:
        Whether there is a state to go on from. If not, the run was killed before it had begun.

    Raises:
        StateError: If a process of the killed run goes on writing.
    """
    for folder in filter(Path.is_dir, results_dir.iterdir()):
        if not wait_until_free(folder, OUTLIVES):
            raise StateError(f"A process of the run that was killed still writes to {folder}: end it, and try again.")
    sweep(results_dir)
    mend_state(results_dir)
    while (path := _newest(results_dir)) is not None and _read(path) is None:
        path.unlink()  # torn, and there is no copy
    if path is None:
        return False
    if not ray.__version__.startswith(f"{'.'.join(map(str, TESTED_RAY))}."):
        return True  # forget_decisions says so
    state = _read(path)
    if _decisions(state) is None:
        return True
    for entry in state["trial_data"]:
        trial = TuneTrial.from_json_state(entry[0], stub=True)
        trial.stub = False
        trial.restore_run_metadata(entry[1])
        if _take_up_trial(trial, results_dir / trial.storage.trial_dir_name, kept):
            trial.invalidate_json_state()
            entry[:] = trial.get_json_state()
    _replace(path, state)
    return True


def _take_up_trial(trial: Any, folder: Path, kept: int) -> bool:
    """Let a trial of Tune's state go on from what is on disk; return whether its state has changed."""
    found, unfit = numbered(folder), list[tuple[Path, str]]()
    while found and (fault := find_unfit(found[0])):
        unfit.append((found.pop(0), fault))
    found = [*found[:1], *(path for path in found[1:] if find_unfit(path) is None)]
    finished = trial.status == TuneTrial.TERMINATED
    if found:
        then = f"the one before it is used: {found[0].name}"
    else:
        then = "there is none before it, so it " + ("stays as it is: finished" if finished else "starts anew")
    for path, fault in unfit:
        aside = put_aside(path)
        where = f" (it is kept as {aside})" if aside else ""
        print(f"{trial}: {path} is no whole checkpoint: {fault}{where}; {then}.", flush=True)
    if not found and finished:
        return False
    if not found and not unfit and trial.checkpoint is not None:
        print(f"{trial}: its checkpoints are no longer in {folder}, so it starts anew.", flush=True)
    if found and not (found[0] / LOGS).is_dir():
        return False  # saved by a revision that kept no logs: only Tune knows what it belongs to
    config, known = trial.run_metadata.checkpoint_manager.checkpoint_config, trial.run_metadata.last_result
    config.num_to_keep = kept
    manager = _CheckpointManager(config)
    for path in reversed(found):
        result = last_result(path) if (path / LOGS).is_dir() else {}
        manager.register_checkpoint(_TrainingResult(tune.Checkpoint(str(path)), result))
    last = manager.latest_checkpoint_result.metrics if found else {}
    trial.run_metadata.checkpoint_manager, trial.run_metadata.last_result = manager, last
    trial.storage.current_checkpoint_index = int(re.sub(r"\D", "", found[0].name)) if found else -1
    if trial.status != TuneTrial.ERROR or last.get("done"):
        trial.status = TuneTrial.TERMINATED if last.get("done") else TuneTrial.PENDING
    if trial.status == TuneTrial.TERMINATED:
        put_back_logs(found[0], folder, finished=True)
    return bool(found or known)


def forget_decisions(results_dir: Path) -> None:
    """Take out of Tune's saved state what it still meant to do with trials when it ended.

    When a trial ends or dies while it writes a checkpoint, Tune notes that it is to be stopped once the checkpoint is
    written. If that does not happen any more, the note is saved with the run. What breaks if it stays: the resumed
    trial goes on from its last checkpoint, writes its next one, and is stopped there, short of its env steps. From then
    on Tune takes it for finished, so no further `--resume` goes on with it.

    The note is in a private part of a private file, for which Tune has no setting. So the file is changed only under
    the release of Ray that this was tried with, and only if it looks as it does there; otherwise it is left alone, and
    a warning says what may happen.

    Args:
        results_dir: The folder of the run; of its state files Tune reads the newest, and so does this.
    """
    path = _newest(results_dir)
    if path is None:  # Tune says so itself.
        return
    tested = ".".join(map(str, TESTED_RAY))
    if not ray.__version__.startswith(f"{tested}."):
        _warn(f"Resuming was tried with Ray {tested}, and this is Ray {ray.__version__}.")
        return
    state = _read(path)
    decisions = _decisions(state)
    if decisions is None:
        _warn(f"{path.name} does not look as Ray {tested} writes it.")
        return
    decisions.clear()
    _replace(path, state)


def known_trials(results_dir: Path) -> set[str]:
    """Return the names of the trials that Tune's saved state holds, whether they have ended or not.

    Raises:
        StateError: If the state is not as the release of Ray that this was tried with writes it.
    """
    _, _, trials = _trials(results_dir)
    return {_name(trial) for trial in trials}


def lengthen(results_dir: Path, stops: Mapping[str, int]) -> list[str]:
    """Let trials of Tune's saved state run longer than they were meant to, also those that have ended.

    Tune resumes no trial that has ended, and keeps the config that a trial had; it has no setting for either. What
    else the config says stays: rates that fall with the length of a trial were made for its first length.

    Args:
        results_dir: The folder of the run.
        stops: Env steps after which each trial is done, by its name.

    Returns:
        The names of the trials that are longer now.

    Raises:
        StateError: If the state is not as the release of Ray that this was tried with writes it.
    """
    path, state, trials = _trials(results_dir)
    longer = []
    for entry, trial in zip(state["trial_data"], trials, strict=True):
        name = _name(trial)
        if stops.get(name, 0) > trial["config"]["stop_timesteps"]:
            trial["config"]["stop_timesteps"] = stops[name]
            if trial["status"] == "TERMINATED":
                trial["status"] = "PENDING"
            entry[0] = json.dumps(trial, indent=2)
            longer.append(name)
    if longer:
        _replace(path, state)
    return longer


def _trials(results_dir: Path) -> tuple[Path, dict[str, Any], list[dict[str, Any]]]:
    """Return the newest state file, what is in it, and the trials in that."""
    path, tested = _newest(results_dir), ".".join(map(str, TESTED_RAY))
    if path is None:
        raise StateError(f"{results_dir} holds no state of Ray Tune (experiment_state-*.json): it cannot be resumed.")
    state = _read(path)
    try:
        trials = [json.loads(trial) for trial, _ in state["trial_data"]]
        if all({"status", "config"} <= {*trial} and "stop_timesteps" in trial["config"] for trial in trials):
            return path, state, trials
    except (TypeError, ValueError, KeyError):
        pass
    raise StateError(
        f"{path} does not look as Ray {tested} writes it (this is Ray {ray.__version__}): install the release that "
        f"the run was started with."
    )


def _name(trial: Mapping[str, Any]) -> str:
    return f"{trial['config']['algorithm']}-seed{trial['config']['seed']}"


def _newest(results_dir: Path) -> Path | None:
    return max(results_dir.glob(STATES), default=None)


def _replace(path: Path, state: dict[str, Any]) -> None:
    """Write a state file anew; whatever happens, there is a whole one."""
    changed = path.with_suffix(".new")
    changed.write_text(json.dumps(state, indent=2))
    changed.replace(path)


def _read(path: Path) -> Any:
    """Return what is in a file of JSON, or None if it is something else."""
    try:
        return json.loads(path.read_text())
    except ValueError:
        return None


def _decisions(state: Any) -> dict[str, Any] | None:
    """Return the decisions of a saved state, by trial, or None if they are not where they are expected."""
    runner = state.get("runner_data") if isinstance(state, dict) else None
    decisions = runner.get(_DECISIONS) if isinstance(runner, dict) else None
    return decisions if isinstance(decisions, dict) else None


def _warn(reason: str) -> None:
    warnings.warn(
        f"{reason} So Tune's saved state is left as it is: a trial that ended or died while it wrote a checkpoint may "
        f"be stopped after its next one, short of its env steps, and no further --resume goes on with it.",
        stacklevel=3,
    )
