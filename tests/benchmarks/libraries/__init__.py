"""The libraries that `peers.py` compares, a file each, and what all of them train.

The function of a file is the target of a worker, in the virtual environment of that library.
"""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

from tests.benchmarks.measure import Work, count
from tests.benchmarks.workers import Job, bind, free_cores

HIDDEN = [64, 64, 64]
ROWS = 10_000  # joint transitions in every library's replay
COPIES = 8  # of the environment in train(), which makes one update for each env step


class Shape(NamedTuple):
    """What is trained: the scenario and its sizes."""

    scenario: str
    batch: int  # B
    agents: int  # N
    observation: int  # O
    action: int  # A


def size(*modules: Any) -> int:
    """Return how many parameters modules have."""
    return sum(p.numel() for module in modules for p in module.parameters())


def job(ways: dict[str, Work], parameters: Sequence[int]) -> Job:
    """Bind the process to a core, warm up, and return how it measures.

    Args:
        ways: What is measured, by column of the table.
        parameters: How many one agent's actor and critic have.
    """
    import torch

    bind(free_cores()[-1:])  # Only now: Ray's own processes may have another core, if there is one.
    torch.set_num_threads(1)
    for work in ways.values():
        work()

    def measure(column: str, seconds: float) -> float:
        return count(ways[column], seconds, time.process_time).rate

    return Job(measure, {"columns": list(ways), "parameters": parameters})
