"""Few runs, honestly: interquartile means, performance profiles, probabilities of improvement, and their intervals.

The estimates are those of Agarwal et al., *Deep reinforcement learning at the edge of the statistical precipice*, 2021.
Their own library, rliable, does not run with this package's NumPy and pandas; SciPy has the same trimmed mean, and a
bootstrap that draws runs anew within each task (stratified), which is all it takes.

Scores come as strata, one array for each task, with the runs (seeds) along the first axis.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap, trim_mean

FloatArray = NDArray[np.float64]
_RESAMPLES = 2000


class Estimate(NamedTuple):
    """A value and its 95 % interval, whose ends are NaN where a task has only one run."""

    value: FloatArray
    low: FloatArray
    high: FloatArray


def iqm(runs: FloatArray, axis: int = 0) -> FloatArray:
    """Return the interquartile mean: that of the middle half, a quarter left out at either end."""
    return np.asarray(trim_mean(runs, 0.25, axis=axis))


def interquartile_mean(strata: Sequence[FloatArray]) -> Estimate:
    """Return the interquartile mean of all runs of all tasks, each number along further axes by itself.

    Args:
        strata: A (runs, ...) array for each task.

    Returns:
        Arrays (...).
    """
    return _estimate(strata, lambda *tasks, axis: iqm(np.concatenate(tasks, axis=axis), axis))


def performance_profile(strata: Sequence[FloatArray], thresholds: FloatArray) -> Estimate:
    """Return the share of runs with more than each threshold.

    Args:
        strata: A (runs,) array for each task.
        thresholds: (T,).

    Returns:
        Arrays (T,).
    """
    above = [(runs[:, None] > thresholds).astype(np.float64) for runs in strata]
    return _estimate(above, lambda *tasks, axis: np.concatenate(tasks, axis=axis).mean(axis=axis))


def probability_of_improvement(better: Sequence[FloatArray], worse: Sequence[FloatArray]) -> Estimate:
    """Return how probably a run of one algorithm beats a run of another one, on a task drawn at random.

    Args:
        better: A (runs,) array of the one for each task.
        worse: The same for the other.

    Returns:
        Scalars; a tie counts half.
    """

    def statistic(*tasks: FloatArray, axis: int) -> FloatArray:
        ours, theirs = tasks[: len(better)], tasks[len(better) :]
        wins = []
        for x, y in zip(ours, theirs, strict=True):
            x, y = np.moveaxis(x, axis, -1)[..., :, None], np.moveaxis(y, axis, -1)[..., None, :]
            wins.append(((x > y) + 0.5 * (x == y)).mean(axis=(-2, -1)))
        return np.asarray(np.mean(wins, axis=0))

    return _estimate([*better, *worse], statistic)


def _estimate(strata: Sequence[FloatArray], statistic: Callable[..., FloatArray]) -> Estimate:
    """Return a statistic of the runs, and its interval from drawing as many of each stratum anew."""
    value = statistic(*strata, axis=0)
    if min(map(len, strata)) < 2:
        unknown = np.full_like(value, np.nan)
        return Estimate(value, unknown, unknown)
    drawn: Any = bootstrap(
        tuple(strata),
        statistic,
        n_resamples=_RESAMPLES,
        vectorized=True,
        axis=0,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return Estimate(value, *(np.asarray(end) for end in drawn.confidence_interval))


def learning_curve(runs: Sequence[tuple[FloatArray, FloatArray]], points: int = 50) -> tuple[FloatArray, Estimate]:
    """Return the interquartile mean of curves over their common axis.

    Args:
        runs: For each run where it was evaluated, ascending, and what came out.
        points: At most so many; evaluations between two of them are averaged.

    Returns:
        (P,) places and the estimate there, of the runs that have come so far.
    """
    width = max(x[-1] for x, _ in runs) / min(points, max(len(x) for x, _ in runs))
    columns = round(max(x[-1] for x, _ in runs) / width)
    table, places = np.full((len(runs), columns), np.nan), np.full((len(runs), columns), np.nan)
    for row, (x, y) in enumerate(runs):
        column = np.clip(np.ceil(x / width - 1e-9).astype(int) - 1, 0, columns - 1)
        for index in np.unique(column):
            here = (column == index) & np.isfinite(y)
            if here.any():
                table[row, index], places[row, index] = y[here].mean(), x[here].mean()
    there = np.isfinite(table)
    value, low, high = (np.full(columns, np.nan) for _ in range(3))
    for present in np.unique(there, axis=1).T:  # runs that ended early, or were evaluated less often
        same = (there == present[:, None]).all(axis=0)
        if present.any():
            value[same], low[same], high[same] = interquartile_mean([table[present][:, same]])
    filled = there.any(axis=0)
    estimate = Estimate(value[filled], low[filled], high[filled])
    return np.nanmean(places[:, filled], axis=0), estimate
