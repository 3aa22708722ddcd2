"""The table of docs/resume.md: a run that is restored in a new process goes on as if nothing had been, to the bit."""

import hashlib
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import ray
import torch
from ray.rllib.algorithms.algorithm import Algorithm

import rllib_maobs as maobs
from tests.conftest import ALGORITHMS, is_long, small_config

ENTITIES = {"actor": "entity", "critic": "entity", "critic_state": "world", "other_agents_actions": "joint"}
FALLING = [[0, 1e-3], [400, 1e-5]]
# A case is an algorithm, settings of its training(), and what else differs from `small_config`.
CASES: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    **{name: (name, {}, {}) for name in ALGORITHMS},
    **{
        f"{name}, LSTM": (name, {"actor": "lstm", "seq_length": 3}, {})
        for name in ALGORITHMS
        if maobs.ALGORITHMS[name].supports.recurrent and not maobs.ALGORITHMS[name]().recurrent
    },
    "entity": ("maddpg", ENTITIES, {}),
    "entity-lstm": ("maddpg", {**ENTITIES, "actor": "entity-lstm", "seq_length": 3}, {}),
    "entity, n-step, twin critics, delayed, smoothed, schedules": (
        "maddpg",
        {
            **ENTITIES,
            "n_step": 3,
            "twin_critics": True,
            "policy_delay": 2,
            "target_noise": 0.2,
            "actor_lr": FALLING,
            "critic_lr": FALLING,
        },
        {},
    ),
    "carried states of a learned prey, normalised": (
        "iddpg",
        {
            "actor": "lstm",
            "seq_length": 3,
            "stored_state": True,
            "normalize_observations": True,
            "exploration": {"type": "ornstein-uhlenbeck"},
        },
        {"env": "maobs/obstacle-predator-prey", "env_config": {"prey": "learned", "horizon": 15}},
    ),
    "discrete": ("maddpg", {}, {"env_config": {"action_mode": "discrete", "horizon": 15}}),
    "one policy": ("maddpg", {"agent_id_input": True}, {"shared": True}),
    "replay that wraps round": ("maddpg", {"replay_buffer_capacity": 100}, {}),
    "compiled carried states, n-step": (
        "maddpg",
        {"actor": "lstm", "seq_length": 3, "stored_state": True, "n_step": 2},
        {"compiled": True},
    ),
}
SHORT = (
    "entity, n-step, twin critics, delayed, smoothed, schedules",
    "carried states of a learned prey, normalised",
)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """The long form has all cases."""
    if "case" in metafunc.fixturenames:
        metafunc.parametrize("case", CASES if is_long(metafunc.config) else SHORT)


def build(case: str) -> Any:
    algorithm, settings, other = CASES[case]
    config = small_config(algorithm, horizon=15).training(**settings)
    if "env" in other:
        config.environment(other["env"], env_config=other["env_config"])
    elif "env_config" in other:
        config.environment(env_config=other["env_config"])
    if "shared" in other:
        config.multi_agent(policies={"all"}, policy_mapping_fn=lambda agent, *args, **kwargs: "all")
    if "compiled" in other:
        config.framework(torch_compile_learner=True)
    config.evaluation(evaluation_interval=1, evaluation_duration=1)
    return config.build_algo()


def train_on(algorithm: Any, iterations: int = 2) -> dict[str, str]:
    """What training makes of an algorithm: its results, weights, optimisers, normalisation and replay, as checksums."""
    made = {f"results {i}": json.dumps(numbers(algorithm.train()), sort_keys=True) for i in range(iterations)}
    states = algorithm._learner.get_state() | {"replay": algorithm.replay_buffer.get_state()}
    return made | {name: checksum(part) for name, part in states.items()} | {"progress": str(algorithm._progress)}


def numbers(result: Any) -> Any:
    """A result without what says how fast the machine was."""
    if not isinstance(result, dict):
        return repr(result)
    left_out = {"config", "date", "pid", "perf", "hostname", "node_ip", "sample", "trial_id", "timestamp"}
    parts = ("time_", "timer", "_sec", "restore", "seq_no")
    return {
        str(key): numbers(value)
        for key, value in result.items()
        if str(key) not in left_out and not any(part in str(key) for part in parts)
    }


def checksum(part: Any) -> str:
    digest = hashlib.sha256()

    def feed(value: Any) -> None:
        if isinstance(value, dict):
            for key in sorted(value, key=str):
                digest.update(str(key).encode())
                feed(value[key])
        elif isinstance(value, list | tuple):
            for entry in value:
                feed(entry)
        elif hasattr(value, "tobytes") or isinstance(value, torch.Tensor):
            digest.update(torch.as_tensor(value).detach().cpu().contiguous().numpy().tobytes())
        else:
            digest.update(repr(value).encode())

    feed(part)
    return digest.hexdigest()


class Another:
    """Trains on in a process of its own."""

    def __init__(self) -> None:
        torch.set_num_threads(1)
        maobs.register()

    def train_on(self, path: str) -> dict[str, str]:
        algorithm = Algorithm.from_checkpoint(path)
        try:
            return train_on(algorithm)
        finally:
            algorithm.stop()


@pytest.fixture(scope="module")
def another(ray_session: None) -> Iterator[Any]:
    process = ray.remote(num_cpus=0)(Another).remote()
    yield process
    ray.kill(process)


def test_a_new_process_goes_on_to_the_bit(another: Any, tmp_path: Path, case: str, tally: Counter[str]) -> None:
    algorithm = build(case)
    try:
        for _ in range(3):  # more than a hundred updates: those that are not compiled are recorded by then
            algorithm.train()
        there = another.train_on.remote(algorithm.save_to_path(tmp_path / "checkpoint"))
        here = train_on(algorithm)
    finally:
        algorithm.stop()
    restored = ray.get(there, timeout=300)
    assert {name for name in here if here[name] != restored[name]} == set()
    tally["kinds of runs restored to the bit"] += 1


def test_with_remote_runners_counters_replay_and_updates_go_on(ray_session: None, tmp_path: Path, long: bool) -> None:
    """Their episodes are in no checkpoint, so new ones begin."""
    if not long:
        pytest.skip("in the long form only; tests/test_settings.py has the episodes that begin")
    config = small_config("maddpg", horizon=15).training(updates_per_env_step=0.3)
    config.env_runners(num_env_runners=1, num_cpus_per_env_runner=0.5)
    algorithm = config.build_algo()
    for _ in range(2):
        algorithm.train()
    path = algorithm.save_to_path(tmp_path / "checkpoint")
    restored = Algorithm.from_checkpoint(path)
    try:
        assert restored._progress == algorithm._progress
        assert checksum(restored.replay_buffer.get_state()) == checksum(algorithm.replay_buffer.get_state())
        assert checksum(restored._learner.get_state()) == checksum(algorithm._learner.get_state())
        held = len(restored.replay_buffer)
        assert len({one.train()["num_env_steps_sampled_lifetime"] for one in (algorithm, restored)}) == 1
        del restored._progress["largest_reward"], algorithm._progress["largest_reward"]  # of other episodes
        assert restored._progress == algorithm._progress
        first = restored.replay_buffer._previous[held]
        assert first == -1, "the first step after the restore begins an episode"
    finally:
        algorithm.stop()
        restored.stop()
