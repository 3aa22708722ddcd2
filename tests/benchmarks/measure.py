"""What the benchmarks measure with: clocks, turns, and what is printed at the end.

It runs in the virtual environments of other libraries, too, so it imports the standard library only.
"""

import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

T = TypeVar("T")
Work = Callable[[], int]
"""Something to measure, as one call of a few milliseconds or more: it returns how many updates or steps it made."""


class Count(NamedTuple):
    """How much was made, and in how many seconds."""

    made: int
    seconds: float

    @property
    def rate(self) -> float:
        """How much was made per second."""
        return self.made / self.seconds


def count(work: Work, seconds: float, clock: Callable[[], float] = time.perf_counter) -> Count:
    """Call some work again and again until so many seconds are over.

    Args:
        work: What is measured.
        seconds: How long; the last call may take it beyond.
        clock: What tells the time: `time.perf_counter`, or `time.process_time` for the process's own.
    """
    made, start = 0, clock()
    while clock() - start < seconds:
        made += work()
    return Count(made, clock() - start)


def best(work: Callable[[], Any], seconds: float) -> float:
    """Seconds of one call at its fastest: what the machine can do when it is not disturbed."""
    work()
    fastest, end = float("inf"), time.perf_counter() + seconds
    while True:
        start = time.perf_counter()
        for _ in range(5):
            work()
        now = time.perf_counter()
        fastest = min(fastest, (now - start) / 5)
        if now > end:
            return fastest


def in_turns(ways: Mapping[str, Callable[[], T]], rounds: int) -> dict[str, list[T]]:
    """Measure every way once a round, so that a drift of the machine's speed hits all alike; all rounds' results."""
    results: dict[str, list[T]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, way in ways.items():
            results[name].append(way())
    return results


def median_ratio(a: Sequence[float], b: Sequence[float]) -> float:
    """Median over the rounds of the ratio that two ways had in a round."""
    return statistics.median(x / y for x, y in zip(a, b, strict=True))


class Stopwatch:
    """Adds up the time that is spent in methods."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self._running = False

    def watch(self, part: str, owner: Any, *names: str) -> None:
        """Counts an object's methods as a part; what one watched method does inside of another counts once."""
        for name in names:
            setattr(owner, name, self._timed(part, getattr(owner, name)))

    def watched(self, part: str, function: Any) -> "Watched":
        """Counts the calls of an object that can be called; returns what is to be put in its place."""
        return Watched(function, self._timed(part, function))

    def _timed(self, part: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            if self._running:
                return method(*args, **kwargs)
            self._running, start = True, time.perf_counter()
            try:
                return method(*args, **kwargs)
            finally:
                self.seconds[part] += time.perf_counter() - start
                self._running = False

        return timed


class Watched:
    """An object whose calls are counted, and which is otherwise as it was."""

    def __init__(self, inner: Any, call: Callable[..., Any]) -> None:
        self._inner, self._call = inner, call

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._call(*args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


def row(cells: Iterable[str]) -> str:
    """A row of a table in Markdown."""
    return f"| {' | '.join(cells)} |"


def end(missed: Sequence[str]) -> None:
    """Name the bars that were missed and end the program: with exit code 1 if there are any."""
    for bar in missed:
        print(f"below the bar: {bar}")
    sys.exit(bool(missed))
