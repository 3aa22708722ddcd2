"""Fixtures that several test files share."""

from collections.abc import Iterator

import pytest
import ray


@pytest.fixture(scope="session")
def ray_session() -> Iterator[None]:
    """One local Ray for the whole test session."""
    ray.init(num_cpus=2, include_dashboard=False)
    yield
    ray.shutdown()
