"""How an experiment tells how far it is: one small table every half minute."""

import heapq
import time
from collections.abc import Iterable
from datetime import datetime
from typing import Any

from ray.tune import ProgressReporter

from rllib_maobs.experiment.report import LABELS, SCORE, STEPS, evaluation_metrics, format_metric
from rllib_maobs.experiment.tables import format_table, format_time

# Until a trial updates its networks: it acts at random, and the first update is compiled, which takes half a minute.
_STARTING = "starting"
_STATUS = {"RUNNING": "running", "TERMINATED": "done", "ERROR": "failed"}


def makespan(seconds: Iterable[float], workers: int) -> float:
    """Say how long some jobs take when each starts as soon as a worker is free, in the given order."""
    free_at = [0.0] * max(workers, 1)
    for duration in seconds:
        heapq.heapreplace(free_at, free_at[0] + duration)
    return max(free_at)


class ProgressTable(ProgressReporter):
    """Prints a line per trial: status, env steps, score, coverage, collisions, speed, time left.

    Args:
        every_s: Seconds between tables.
    """

    def __init__(self, every_s: float) -> None:
        self._every_s = every_s
        self._started = self._reported = time.monotonic()
        # Trial id -> env steps and seconds of its first result with an update since it started: where its speed is
        # counted from, for compiling and filling the replay buffer come before.
        self._from: dict[str, tuple[int, float]] = {}
        self._begun = False

    def setup(self, *args: Any, **kwargs: Any) -> None:
        """Start the clock; Tune calls this once before the trials start."""
        self._started = self._reported = time.monotonic()
        self._from = {}
        self._begun = False

    def should_report(self, trials: list[Any], done: bool = False) -> bool:
        """Return whether it is time for a table."""
        for trial in trials:
            if trial.status == "RUNNING" and trial.last_result.get(STEPS) and _learns(trial.last_result):
                self._from.setdefault(trial.trial_id, (trial.last_result[STEPS], trial.last_result["time_total_s"]))
        if all(trial.status == "PENDING" for trial in trials):
            return False
        if not self._begun and any(trial.status == "RUNNING" for trial in trials):
            self._begun = True  # The first table comes at once: it says what is going on.
            return True
        return done or time.monotonic() - self._reported >= self._every_s

    def report(self, trials: list[Any], done: bool, *sys_info: str) -> None:
        """Print the table."""
        self._reported = time.monotonic()
        print(f"\n{self.table(trials)}", flush=True)

    def table(self, trials: list[Any]) -> str:
        """Return the table.

        Args:
            trials: Tune's trials.

        Returns:
            A line with the time elapsed and left, and one line per trial.
        """
        metrics = [evaluation_metrics(trial.last_result) for trial in trials]
        known_metrics = set[str]().union(*metrics)
        headline = "success" if "success" in known_metrics and "coverage" not in known_metrics else "coverage"
        shown = [SCORE, headline, "collisions"]
        speeds = [self._speed(trial) for trial in trials]
        known = [speed for speed in speeds if speed]
        of_its_kind = {trial.config["algorithm"]: speed for trial, speed in zip(trials, speeds, strict=True) if speed}
        rows, remaining = [], []
        for trial, values, speed in zip(trials, metrics, speeds, strict=True):
            status = _STATUS.get(trial.status, "waiting")
            if status == "running" and not _learns(trial.last_result):
                status = _STARTING
            steps, stop = int(trial.last_result.get(STEPS, 0)), trial.config["stop_timesteps"]
            left = None
            if status in ("running", _STARTING, "waiting") and known:
                # Of one that has no speed yet: that of another seed, or else of the others.
                guess = of_its_kind.get(trial.config["algorithm"], sum(known) / len(known))
                left = max(stop - steps, 0) / (speed or guess)
                remaining.append(left)
            rows.append(
                [
                    str(trial),
                    status,
                    f"{steps:,} / {stop:,}",
                    *(format_metric(name, values[name]) if name in values else "-" for name in shown),
                    f"{speed:.0f}" if speed else "-",
                    format_time(left if status in ("running", _STARTING) else None),
                ]
            )
        now, elapsed = datetime.now(), time.monotonic() - self._started
        head = f"{now:%H:%M:%S}  {format_time(elapsed)} since the start"
        running = sum(trial.status == "RUNNING" for trial in trials)
        if remaining and running:
            head += f", about {format_time(makespan(remaining, running))} left"
        header = ["trial", "status", "env steps", *(LABELS[name] for name in shown), "env steps/s", "left"]
        compiles = [row[1] == _STARTING and t.config.get("torch_compile") for row, t in zip(rows, trials, strict=True)]
        note = (
            "\nstarting: the first update is compiled, which takes half a minute to a minute" if any(compiles) else ""
        )
        return f"{head}\n{format_table(header, rows)}{note}"

    def _speed(self, trial: Any) -> float | None:
        """Return env steps per second since the trial's first result with an update, once there is a second one."""
        result = trial.last_result
        if trial.trial_id not in self._from:
            return None
        steps, seconds = self._from[trial.trial_id]
        seconds = result["time_total_s"] - seconds
        return (result[STEPS] - steps) / seconds if seconds > 0 else None


def _learns(result: dict[str, Any]) -> bool:
    """Return whether there was an update; RLlib has a section for all modules together before."""
    return any(module != "__all_modules__" for module in result.get("learners", {}))
