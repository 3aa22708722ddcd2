"""Processes that are killed while they sample: training goes on, and nothing half-sampled or mixed up is stored."""

import os
import random
import signal
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from ray.rllib.env.multi_agent_env import MultiAgentEnv

from rllib_maobs.replay import JointReplayBuffer
from tests.conftest import small_config


class Witness(MultiAgentEnv):
    """What each agent observes says which episode, copy and step it is of, and what the agent did before.

    Its process leaves its number in a folder.
    """

    def __init__(self, config: dict) -> None:
        super().__init__()
        self.possible_agents = self.agents = ["left", "right"]
        self.observation_spaces = dict.fromkeys(self.agents, gym.spaces.Box(-1e9, 1e9, (4,), np.float32))
        self.action_spaces = dict.fromkeys(self.agents, gym.spaces.Box(-1.0, 1.0, (1,), np.float32))
        self.copy, self.episode, self.t = config.vector_index, 0, 0
        (Path(config["folder"]) / str(os.getpid())).touch()

    def _seen(self, actions: dict[str, Any]) -> dict[str, Any]:
        return {a: np.array([self.episode, self.copy, self.t, actions.get(a, 9.0)], np.float32) for a in self.agents}

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        self.episode, self.t = int.from_bytes(os.urandom(3)), 0
        return self._seen({}), {}

    def step(self, actions: dict) -> tuple:
        time.sleep(0.002)  # so that most kills hit a process that samples
        self.t += 1
        over = dict.fromkeys([*self.agents, "__all__"], self.t == 7)
        rewards = {a: 100.0 * self.t + i for i, a in enumerate(self.agents)}
        return self._seen({a: float(action[0]) for a, action in actions.items()}), rewards, over, {}, {}


class Killer(threading.Thread):
    """Kills one of the processes of a folder every few seconds."""

    def __init__(self, folder: Path, every_s: float, kills: int) -> None:
        super().__init__(daemon=True)
        self.folder, self.every_s, self.kills, self.killed = folder, every_s, kills, 0

    def run(self) -> None:
        while self.killed < self.kills:
            time.sleep(self.every_s * random.uniform(0.5, 1.5))
            for path in random.sample(files := sorted(self.folder.iterdir()), len(files)):
                path.unlink()
                if int(path.name) != os.getpid():
                    os.kill(int(path.name), signal.SIGKILL)
                    self.killed += 1
                    break


def check_rows(replay: JointReplayBuffer) -> int:
    """Every row is of one episode, copy and step, and is linked to what followed in just that one; returns how many."""
    count = len(replay)
    assert replay._head == count < replay.capacity  # none is written over
    obs, actions, rewards = (replay._columns[name][:count].numpy() for name in ("obs", "actions", "rewards"))
    assert (obs[:, 0, :3] == obs[:, 1, :3]).all()  # both agents saw the same moment
    moments = {tuple(row) for row in obs[:, 0, :3].tolist()}
    assert len(moments) == count  # none twice
    now = np.flatnonzero(replay._next[:count] >= 0)
    after = replay._next[now]
    assert (replay._previous[after] == now).all() and np.unique(after).size == after.size
    assert (obs[after, :, :2] == obs[now, :, :2]).all() and (obs[after, :, 2] == obs[now, :, 2] + 1).all()
    np.testing.assert_allclose(obs[after, :, 3], actions[now, :, 0], atol=1e-6)
    assert (rewards[now] == 100.0 * obs[after, :, 2] + [0.0, 1.0]).all()
    assert replay._columns["terminated"][now].numpy().all(-1).tolist() == (obs[after, 0, 2] == 7).tolist()
    return count


def test_runners_that_are_killed_leave_nothing_half_sampled(
    ray_session: None, tmp_path: Path, long: bool, tally: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = small_config("iddpg").environment(Witness, env_config={"folder": str(tmp_path)})
    config.env_runners(
        num_env_runners=2, num_envs_per_env_runner=3, rollout_fragment_length=20, num_cpus_per_env_runner=0.5
    )
    config.training(replay_buffer_capacity=200_000, updates_per_env_step=0.01)
    config.fault_tolerance(delay_between_env_runner_restarts_s=0.0)
    algo = config.build_algo()
    sampled: list[Any] = []
    add = JointReplayBuffer.add
    monkeypatch.setattr(JointReplayBuffer, "add", lambda self, **given: (sampled.append(given), add(self, **given)))
    seeds = algo.env_runner_group.foreach_env_runner(lambda runner: runner._env_seeds, local_env_runner=False)
    killer = Killer(tmp_path, every_s=3.0 if long else 1.0, kills=12 if long else 1)
    try:
        algo.train()
        killer.start()
        while killer.is_alive() or algo.env_runner_group.num_healthy_remote_workers() < 2:
            before = algo._progress["env_steps"]
            result = algo.train()
        rows = check_rows(algo.replay_buffer)
        again = algo.env_runner_group.foreach_env_runner(
            lambda runner: (runner._env_seeds, runner.num_env_steps_sampled_lifetime), local_env_runner=False
        )
    finally:
        algo.stop()
    steps = sum(given["truncated"].size for given in sampled)
    assert rows == steps + sum(len(given["final_obs"]) for given in sampled)
    assert algo._progress["env_steps"] == steps == result["num_env_steps_sampled_lifetime"]
    # New processes sample, too; not all live long enough.
    assert 2 < len({given["source"] for given in sampled}) <= 2 + killer.kills
    # They do not begin with the same episodes, nor with as much noise, as in the beginning.
    assert not {tuple(own) for own in seeds} >= {tuple(own) for own, _ in again}
    assert min(count for _, count in again) > before / 2
    tally["env runners killed"] += killer.killed
    tally["env steps seen to be stored once, whole and in their places"] += steps
