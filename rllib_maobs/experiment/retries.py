"""What becomes of a trial that fails: whether it is tried again, and what is said of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ray import cloudpickle, tune
from ray.rllib.utils.annotations import override

from rllib_maobs.runner.errors import portable

COMES_AGAIN = (ValueError, FloatingPointError)
"""Wrong input, and training that diverges: the same steps would lead there again."""
_NOTE = "comes_again.pkl"


class Retries(tune.Callback):
    """Says when a trial failed and is tried again, and that it is not if the error would come again.

    In place of Tune's `FailureConfig`: that is saved with each trial, as is how often it has failed, and a resumed run
    goes on counting. Here every run counts anew.

    Args:
        max_failures: How often each trial may fail and still go on.
    """

    def __init__(self, max_failures: int) -> None:
        self._max_failures = max_failures
        self._known: set[str] = set()

    @override(tune.Callback)
    def on_step_begin(self, iteration: int, trials: Sequence[Any], **info: Any) -> None:
        """Count from here for trials that this run has not seen yet."""
        for trial in trials:
            if trial.trial_id not in self._known:
                self._known.add(trial.trial_id)
                trial.max_failures = trial.num_failures + self._max_failures

    @override(tune.Callback)
    def on_trial_recover(self, iteration: int, trials: Sequence[Any], trial: Any, **info: Any) -> None:
        """Say what happened; the next failure is the last one if this error would come again."""
        error = _error_of(trial)
        what = f"{trial} failed ({type(error).__name__}: {str(error).partition(chr(10))[0]})"
        if isinstance(error, COMES_AGAIN):
            trial.max_failures = trial.num_failures  # its new process says so, too: see `raise_noted`
            print(f"{what}, as it would again", flush=True)
            return
        left = trial.max_failures - trial.num_failures
        goes_on = "goes on from its last checkpoint" if trial.has_checkpoint() else "starts anew: it has no checkpoint"
        print(f"{what} and {goes_on}; it may fail {left} more times (--max-failures)", flush=True)


def note(folder: str, error: Exception) -> None:
    """Leave an error that would come again to the process in which Tune tries the trial again.

    Args:
        folder: The trial's working directory, which is the same for all its processes on a machine.
        error: The error.
    """
    (Path(folder) / _NOTE).write_bytes(cloudpickle.dumps(portable(error, "the trial's first process")))


def raise_noted(folder: str) -> None:
    """Raise what the trial's last process has noted: so no time is spent on the way there once more.

    Tune has no setting for errors that are not to be tried again. A run that is resumed does try: the note is used up.

    Args:
        folder: The trial's working directory.
    """
    path = Path(folder) / _NOTE
    if path.exists():
        error = cloudpickle.loads(path.read_bytes())
        path.unlink()
        raise error


def _error_of(trial: Any) -> Exception:
    """Return what a trial failed with, without Ray's wrapping."""
    try:
        error = cloudpickle.loads(Path(trial.pickled_error_file).read_bytes())
    except Exception:  # there is no file, or it can't be read without what only the trial's process has
        return RuntimeError("see its error.txt")
    cause: Exception = getattr(error, "cause", None) or error
    return cause
