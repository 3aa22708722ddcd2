"""Agents go by name: whatever order an environment lists them in, what is an agent's stays that agent's."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from ray.rllib.env.multi_agent_env import MultiAgentEnv

import rllib_maobs as maobs
from rllib_maobs.runner import JointEnvRunner, make_env
from tests.conftest import small_config

NAMES = ["scout", "guard", "medic", "pilot"]
NUMBERED = [f"agent_{i}" for i in range(2, 11)]


class Listed(MultiAgentEnv):
    """Agent k of `names` observes k and the step; its reward is the sum of its actions and 100 k.

    `listed` says in which order agents are listed: a callable of the names.
    """

    def __init__(self, config: dict[str, Any]) -> None:
        super().__init__()
        self.names = list(config.get("names", NAMES))
        self.possible_agents = self.agents = list(config["listed"](self.names))
        self.observation_spaces = dict.fromkeys(self.agents, gym.spaces.Box(-np.inf, np.inf, (2,), np.float32))
        self.action_spaces = {a: gym.spaces.Box(-1.0, 1.0, (1 + i % 2,), np.float32) for i, a in enumerate(self.names)}
        self.t = 0
        if config.get("described"):
            self.state_layout = [("body", len(self.names), 2)]

    def state(self) -> np.ndarray:
        return np.concatenate([[self.names.index(a), self.t] for a in self.possible_agents])

    def _obs(self) -> dict[str, np.ndarray]:
        return {a: np.array([self.names.index(a), self.t], np.float32) for a in self.possible_agents}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        self.t = 0
        return self._obs(), {}

    def step(self, actions: dict[str, Any]) -> tuple[Any, ...]:
        self.t += 1
        over = {**dict.fromkeys(self.agents, self.t >= 5), "__all__": self.t >= 5}
        rewards = {a: 100.0 * self.names.index(a) + float(actions[a].sum()) for a in self.possible_agents}
        return self._obs(), rewards, dict.fromkeys(over, False), over, {}


class Other(Listed):
    """The same, with one agent more."""

    def __init__(self, config: dict[str, Any]) -> None:
        super().__init__({**config, "names": [*NAMES, "spy"]})


class Shuffled:
    """Lists agents in another order each time, as sets do from process to process."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)

    def __call__(self, names: list[str]) -> list[str]:
        return [names[i] for i in self.rng.permutation(len(names))]


def reverse(names: list[str]) -> list[str]:
    return names[::-1]


def listed_config(listed: Any, algorithm: str = "maddpg", **options: Any) -> maobs.JointConfig:
    return small_config(algorithm).environment(Listed, env_config={"listed": listed, **options})


@pytest.mark.parametrize(("names", "ids"), [(NAMES, True), (NUMBERED, False)])
@pytest.mark.parametrize("listed", [reverse, Shuffled()])
def test_columns_follow_the_team_in_every_runner(ray_session: None, listed: Any, names: list[str], ids: bool) -> None:
    config = listed_config(listed, names=names).training(agent_id_input=ids)
    config.validate()
    team = config.team
    assert team.agents == tuple(sorted(NAMES) if names is NAMES else NUMBERED)
    which = np.array([names.index(agent) for agent in team.agents])
    shift = len(names) if ids else 0
    for worker in range(3):
        runner = JointEnvRunner(config=config, worker_index=worker, num_workers=worker and 2)
        (s,) = runner.sample(num_timesteps=24)
        assert (s.obs[..., shift] == which).all() and (s.final_obs[..., shift] == which).all()
        if ids:
            assert (s.obs[..., :shift] == np.eye(shift)).all()
        # An action is felt by the agent whose column it is in, and by nobody else.
        np.testing.assert_allclose(s.rewards, 100 * which + s.actions.sum(-1), atol=1e-4)
        padded = np.array([size == 1 for size in team.action_sizes])
        assert not s.actions[..., padded, 1].any() and s.actions[..., ~padded, 1].all()


def test_a_described_state_keeps_its_environments_order() -> None:
    """Its layout names agents by their places."""
    for listed in (list, reverse):
        config = listed_config(listed, described=True).training(critic_state="world")
        config.validate()
        assert config.team.agents == tuple(listed(NAMES))


def test_the_states_rows_follow_the_teams_order() -> None:
    env = make_env(listed_config(list, described=True), 2)
    config = listed_config(list, described=True)
    config.validate()
    config.environment(env_config={"listed": reverse, "described": True})
    other = make_env(config, 2, team=config.team)
    for each in (env, other):
        each.reset(seed=0)
        assert each.state()[:, 0::2].tolist() == [[0.0, 1.0, 2.0, 3.0]] * 2


def test_an_order_once_decided_stays() -> None:
    config = listed_config(list, described=True)
    config.validate()
    config.environment(env_config={"listed": reverse, "described": True}).validate()
    assert config.team.agents == tuple(NAMES)
    assert config.team.spaces("guard")[1].shape == (2,) and config.team.spaces("medic")[1].shape == (1,)


def test_another_set_of_agents_is_refused(ray_session: None) -> None:
    config = listed_config(list)
    config.validate()
    config.env = Other
    with pytest.raises(
        ValueError, match=r"environment .*Other.* \(runner 0\) are .*'spy'\], but the team is .*'scout'"
    ):
        JointEnvRunner(config=config, worker_index=0, num_workers=0)
    config = listed_config(list).evaluation(evaluation_interval=1, evaluation_config={"env": Other})
    with pytest.raises(ValueError, match=r"agents of the evaluation environment .*'spy'\], but the team is .*'scout'"):
        config.build_algo()
    wider = {"listed": list, "names": [NAMES[i] for i in (1, 0, 2, 3)]}
    config = listed_config(list).evaluation(evaluation_interval=1, evaluation_config={"env_config": wider})
    with pytest.raises(ValueError, match=r"spaces of agent 'guard' in the evaluation .*\(1,\).* in the team .*\(2,\)"):
        config.build_algo()


def test_evaluation_lists_them_as_it_likes(ray_session: None) -> None:
    config = listed_config(list, described=True).evaluation(
        evaluation_interval=1, evaluation_duration=2, evaluation_config={"env_config": {"listed": reverse}}
    )
    algo = config.build_algo()
    returns = algo.train()["evaluation"]["env_runners"]["agent_episode_returns_mean"]
    assert {agent: round(value / 500) for agent, value in returns.items()} == {a: i for i, a in enumerate(NAMES)}
    algo.stop()


@pytest.mark.parametrize("how", ["path", "state"])
def test_a_run_restored_under_another_order_goes_on_as_the_first(ray_session: None, tmp_path: Any, how: str) -> None:
    """Replay, critics, optimisers and episodes are each agent's own; the checkpoint's order is taken over."""
    # Options that are the same by name: with others the episodes would start anew.
    first, second = (
        listed_config(partial(listed), described=True).training(critic_state="world").build_algo()
        for listed in (list, reverse)
    )
    first.train()
    assert second.config.team.agents == tuple(reverse(NAMES))
    if how == "path":
        second.restore_from_path(first.save_to_path(tmp_path / "checkpoint"))
    else:
        second.set_state(first.get_state())
    assert second.config.team.agents == second.env_runner.team.agents == tuple(NAMES)
    for algo in (first, second):
        algo.train()
    for agent in NAMES:
        one, other = (algo.get_module(agent).state_dict() for algo in (first, second))
        assert all(torch.equal(one[name], other[name]) for name in one)
    columns = [algo.replay_buffer._columns["obs"][: len(algo.replay_buffer)] for algo in (first, second)]
    assert torch.equal(*columns)
    first.stop(), second.stop()


def test_a_run_of_other_agents_is_not_taken_over(ray_session: None, tmp_path: Any) -> None:
    first = listed_config(list).build_algo()
    second = listed_config(list).environment(Other).build_algo()
    with pytest.raises(ValueError, match=r"saved team is \['guard', .*\], but the agents of .*Other.*'spy'\]"):
        second.restore_from_path(first.save_to_path(tmp_path / "checkpoint"))
    first.stop(), second.stop()
