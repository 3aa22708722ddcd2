"""The processes that measure: what they answer, where they run, and what they say when they fail."""

import os

import pytest

from tests.benchmarks.workers import Job, Worker, free_cores

HERE = "tests.benchmarks.test_workers"


def prepare(factor: int) -> Job:
    """Be the target: multiply."""
    print("this is not an answer")

    def measure(number: int) -> dict[str, object]:
        assert number >= 0, "it measures what is not negative"
        return {"product": factor * number, "cores": free_cores(), "threads": os.environ["OMP_NUM_THREADS"]}

    return Job(measure, about=["a factor of", factor])


def test_a_worker_answers_what_it_is_asked() -> None:
    core = free_cores()[-1]
    worker = Worker(f"{HERE}:prepare", 3, cores={core})
    assert worker.ready() == ["a factor of", 3]
    answers = [worker.measured(number) for number in (1, 2)]
    assert [answer["product"] for answer in answers] == [3, 6]
    assert answers[0]["cores"] == [core] or not hasattr(os, "sched_setaffinity")
    assert answers[0]["threads"] == "1"
    assert worker.share > 0.0
    worker.close()


def test_a_worker_that_fails_says_why() -> None:
    worker = Worker(f"{HERE}:prepare", 3)
    worker.ready()
    with pytest.raises(RuntimeError, match=r"test_workers:prepare 3 failed:(?s:.*)it measures what is not negative"):
        worker.measured(-1)
    worker.close()
    missing = Worker(f"{HERE}:missing")
    with pytest.raises(RuntimeError, match="has no attribute 'missing'"):
        missing.ready()
    missing.close()
