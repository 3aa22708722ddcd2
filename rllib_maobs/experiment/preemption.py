"""A node that is about to be taken away sends SIGTERM: save every trial, then end."""

import os
import signal
from types import FrameType
from typing import Any, Self

from ray import tune
from ray.tune.result import SHOULD_CHECKPOINT

EXIT_CODE = 128 + signal.SIGTERM


class Preemption(tune.Callback):
    """Lets SIGTERM save all trials that run, and then end the run as Ctrl-C does; a second one ends it at once.

        with Preemption() as preemption:
            tune.run(..., callbacks=[preemption])

    Each trial is saved after the iteration that it is in. One that has not made any since it started has nothing new to
    save.

    Attributes:
        came: Whether there was a SIGTERM.
    """

    def __init__(self) -> None:
        self.came = False
        self._before: Any = None
        self._saved = set[str]()
        self._reported = set[str]()

    def __getstate__(self) -> dict[str, Any]:
        """What Tune saves of it: not what a program has done at SIGTERM before."""
        return {**vars(self), "_before": None}

    def __enter__(self) -> Self:
        try:
            self._before = signal.signal(signal.SIGTERM, self._on_sigterm)
        except ValueError:  # not in the main thread, where signals cannot be taken: they do what they did
            self._before = None
        return self

    def __exit__(self, *exception: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGTERM, self._before)

    def _on_sigterm(self, number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # the second one ends the program
        self.came = True
        print("\nSIGTERM: every trial is saved after its iteration. A second SIGTERM ends at once.", flush=True)

    def on_trial_result(
        self, iteration: int, trials: list[Any], trial: Any, result: dict[str, Any], **info: Any
    ) -> None:
        """Ask for a checkpoint after this result."""
        self._reported.add(trial.trial_id)
        if self.came:
            result[SHOULD_CHECKPOINT] = True

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Note that it has made no iteration yet."""
        self._reported.discard(trial.trial_id)

    def on_trial_save(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Note that it is saved, or could not be."""
        if self.came:
            self._saved.add(trial.trial_id)

    def on_step_end(self, iteration: int, trials: list[Any], **info: Any) -> None:
        """End the run once all are saved."""
        running = {trial.trial_id for trial in trials if trial.status == "RUNNING"}
        if self.came and (running & self._reported) <= self._saved:
            os.kill(os.getpid(), signal.SIGUSR1)  # Tune's own way to end, whatever Ctrl-C does
