"""Long and large runs: memory, files, threads and actors stay as they are."""

import gc
import os
import weakref
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch

import rllib_maobs as maobs
from tests.conftest import small_config

PAGE = os.sysconf("SC_PAGE_SIZE")
linux = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="/proc says what a process holds")


def held(pid: int | str = "self") -> dict[str, int]:
    """What a process holds: bytes of memory, open files, threads."""
    gc.collect()
    process = Path(f"/proc/{pid}")
    return {
        "memory": int((process / "statm").read_text().split()[1]) * PAGE,
        "files": len(list((process / "fd").iterdir())),
        "threads": len(list((process / "task").iterdir())),
    }


def fast_config(**env_runners: Any) -> maobs.JointConfig:
    """Sampling is most of it; the ring is small, so its memory is soon all in use."""
    config = small_config("maddpg").env_runners(num_envs_per_env_runner=64, **env_runners)
    config.training(replay_buffer_capacity=10_000, updates_per_env_step=1 / 64)
    return config.reporting(min_sample_timesteps_per_iteration=2_000)


@linux
@pytest.mark.parametrize("runners", [0, 1])
def test_what_a_training_holds_stays_as_it_is(ray_session: None, runners: int, long: bool, tally: Counter[str]) -> None:
    algo = fast_config(num_env_runners=runners, num_cpus_per_env_runner=0.5).build_algo()
    try:
        pids: list[int | str] = ["self"]
        if runners:
            pids += algo.env_runner_group.foreach_env_runner(lambda runner: os.getpid(), local_env_runner=False)

        def train(steps: int) -> None:
            while algo._progress["env_steps"] < steps:
                algo.train()

        start, end = (60_000, 260_000) if long else (24_000, 48_000)
        train(start)
        before = [held(pid) for pid in pids]
        train(end)
        after = [held(pid) for pid in pids]
        if runners:  # the same processes, and no others beside them
            assert pids[1:] == algo.env_runner_group.foreach_env_runner(
                lambda runner: os.getpid(), local_env_runner=False
            )
        tally["env steps of long runs"] += end - start
    finally:
        algo.stop()
    for was, now in zip(before, after, strict=True):
        assert now["memory"] < 1.02 * was["memory"], (was, now)
        assert abs(now["files"] - was["files"]) <= 2 and abs(now["threads"] - was["threads"]) <= 2, (was, now)


def test_27_agents_in_1024_copies_wrap_the_ring_round(ray_session: None, long: bool, tally: Counter[str]) -> None:
    """What is sampled is what was stepped: positions follow velocities, in every copy, after many rounds."""
    copies, rounds = 1024, 20 if long else 3
    config = maobs.IDDPGConfig().environment(
        "maobs/spread-9a", env_config={"num_agents": 27, "horizon": 25, "placement": "mpe"}
    )
    config.env_runners(num_envs_per_env_runner=copies)
    config.training(
        replay_buffer_capacity=4 * copies, train_batch_size_per_learner=64, updates_per_env_step=1 / copies / 2
    )
    algo = config.reporting(min_sample_timesteps_per_iteration=4 * copies).debugging(seed=0).build_algo()
    try:
        while algo.replay_buffer._head < rounds * algo.replay_buffer.capacity:
            algo.train()
        assert len(algo.replay_buffer) == algo.replay_buffer.capacity
        batch = algo.replay_buffer.sample((512,), gamma=0.95)
        tally["rows written to a ring that is wrapped round"] += algo.replay_buffer._head
        tally["transitions checked"] += 512
    finally:
        algo.stop()
    now, following = batch.now.obs, batch.next.obs
    assert torch.isfinite(now).all() and torch.isfinite(following).all()
    # An observation begins with the agent's own velocity and position.
    torch.testing.assert_close(following[..., 2:4], now[..., 2:4] + 0.1 * following[..., 0:2], rtol=0.0, atol=1e-5)


@linux
def test_building_and_stopping_leaks_nothing(ray_session: None, long: bool, tally: Counter[str]) -> None:
    config = small_config("maddpg-l").reporting(min_sample_timesteps_per_iteration=24)
    alive: list[weakref.ref[Any]] = []

    def once() -> None:
        algo = config.copy(copy_frozen=False).build_algo()
        alive.extend(map(weakref.ref, (algo, algo._learner, algo.replay_buffer, algo.env_runner)))
        algo.train()
        algo.stop()

    for _ in range(3):
        once()
    before, count = held(), 100 if long else 6
    for _ in range(count):
        once()
    after = held()
    tally["algorithms built, trained and stopped"] += count + 3
    left = [type(ref()).__name__ for ref in alive if ref() is not None]
    assert not left, Counter(left)
    assert after["files"] <= before["files"] + 2 and after["threads"] <= before["threads"] + 2, (before, after)
    assert after["memory"] < before["memory"] + 2e6 + 0.2e6 * count, (before, after)
