"""What a resumed run needs done to Tune's saved state, which Tune itself does not do."""

import glob
import json
import warnings
from pathlib import Path
from typing import Any

import ray
from ray.rllib.utils.annotations import override
from ray.tune.search.basic_variant import BasicVariantGenerator

TESTED_RAY = (2, 60)
"""The release of Ray, any patch of it, whose saved state this was tried with: the range in `pyproject.toml`."""
_DECISIONS = "_cached_trial_decisions"


class Grid(BasicVariantGenerator):
    """Tune's own way through a grid of trials, which finds its state again in a folder with brackets in its name."""

    @override(BasicVariantGenerator)
    def restore_from_dir(self, dirpath: str) -> None:
        """Go on from the newest state in a folder; Tune takes the folder's name for a pattern."""
        super().restore_from_dir(glob.escape(dirpath))


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
    path = max(results_dir.glob("experiment_state-*.json"), default=None)
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
