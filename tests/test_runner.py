"""The joint runner and the stock one: what they sample, how they explore, what they count."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from mpe2 import simple_spread_v3
from ray import tune
from ray.rllib.core.columns import Columns
from ray.rllib.env.multi_agent_env import MultiAgentEnv
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner

from rllib_maobs.modules import EpsilonGaussian, Seen
from rllib_maobs.modules.exploration import make_exploration
from rllib_maobs.runner import JointEnvRunner, JointSample
from tests.conftest import small_config


class TwoAgents(MultiAgentEnv):
    """A scripted two-agent task: observations tell the step, actions come back in the infos' place."""

    def __init__(self, config: dict) -> None:
        super().__init__()
        self.config = dict(config)
        self.possible_agents = self.agents = ["left", "right"]
        sizes = self.config.get("sizes", (3, 3))
        self.observation_spaces = {
            a: gym.spaces.Box(-np.inf, np.inf, (n,), np.float32) for a, n in zip(self.agents, sizes, strict=True)
        }
        lengths = self.config.get("lengths", (2, 2))
        self.action_spaces = {
            a: gym.spaces.Box(2.0, 6.0, (n,), np.float32) for a, n in zip(self.agents, lengths, strict=True)
        }
        self.t = 0

    def _obs(self) -> dict:
        obs = {a: np.full(self.observation_spaces[a].shape, self.t, np.float32) for a in self.agents}
        if self.t == self.config.get("nan_at"):
            obs["right"][1] = np.nan
        if self.t == self.config.get("leave_at"):
            del obs["left"]
        return obs

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        self.t = 0
        return self._obs(), {}

    def step(self, actions: dict) -> tuple:
        self.t += 1
        over = self.t >= 5
        flags = {"__all__": over, **dict.fromkeys(self.agents, over)}
        truncated = dict.fromkeys([*self.agents, "__all__"], False)
        rewards = {a: float(actions[a].sum()) for a in self.agents}
        if self.t == self.config.get("inf_at"):
            rewards["left"] = np.inf
        return self._obs(), rewards, flags, truncated, {a: {} for a in self.agents}


def runner_of(config: object) -> JointEnvRunner:
    config.validate()
    return JointEnvRunner(config=config, worker_index=0, num_workers=0)


def sample(runner: JointEnvRunner, **kwargs: object) -> JointSample:
    (result,) = runner.sample(**kwargs)
    return result


def test_columns_are_aligned_and_final_observations_true(ray_session: None) -> None:
    runner = runner_of(small_config("maddpg", horizon=5))
    s = sample(runner, num_timesteps=24)
    assert s.obs.shape == (12, 2, 3, 18) and s.actions.shape == (12, 2, 3, 5) and s.rewards.shape == (12, 2, 3)
    assert s.env_steps() == 24 and s.agent_steps() == 72
    assert s.truncated.sum(0).tolist() == [2, 2] and not s.terminated.any()
    assert np.flatnonzero(s.truncated[:, 0]).tolist() == [4, 9]
    # The final observation continues the episode; the row after it belongs to the next one.
    position = slice(2, 4)
    assert np.abs(s.final_obs[0, :, position] - s.obs[4, 0, :, position]).max() < 0.2
    assert np.abs(s.obs[5, 0, :, position] - s.obs[4, 0, :, position]).max() > 0.3
    # One sample goes on where the last one stopped.
    again = sample(runner, num_timesteps=2)
    assert again.start == s.start + 12 and again.source == s.source


def test_world_states_are_the_environments_own(ray_session: None) -> None:
    runner = runner_of(small_config("maddpg", horizon=4).training(critic_state="world"))
    s = sample(runner, num_timesteps=16)
    assert s.state is not None and s.final_state is not None
    assert s.state.shape == (8, 2, runner.team.state_size)
    # Agents come first in the world state, with their positions, which are in their own observations.
    for state, obs in ((s.state, s.obs), (s.final_state, s.final_obs)):
        agents = state[..., :12].reshape(*state.shape[:-1], 3, 4)
        np.testing.assert_allclose(agents[..., :2], obs[..., 2:4], atol=1e-6)


def test_a_copys_episodes_do_not_depend_on_how_many_there_are(ray_session: None) -> None:
    few = runner_of(small_config("maddpg").env_runners(num_envs_per_env_runner=2))
    many = runner_of(small_config("maddpg").env_runners(num_envs_per_env_runner=5))
    a, b = sample(few, num_timesteps=2, explore=False), sample(many, num_timesteps=5, explore=False)
    np.testing.assert_array_equal(a.obs, b.obs[:, :2])


def test_runners_do_not_repeat_each_other(ray_session: None) -> None:
    config = small_config("maddpg")
    config.validate()
    first, second = (JointEnvRunner(config=config, worker_index=i, num_workers=2) for i in (1, 2))
    a, b = sample(first, num_timesteps=2), sample(second, num_timesteps=2)
    assert len({obs.tobytes() for s in (a, b) for obs in s.obs[0]}) == 4


def test_episodes_are_dealt_out_evenly(ray_session: None) -> None:
    runner = runner_of(small_config("maddpg", horizon=5).env_runners(num_envs_per_env_runner=4))
    # Ten episodes on four copies are 3, 3, 2, 2: three rounds, and two episodes of the last one not counted.
    assert len(sample(runner, num_episodes=10, explore=False).obs) == 15
    assert int(runner.get_metrics()["num_episodes"].peek()) == 10
    # Evaluation is noise-free: the same weights and the same start give the same actions.
    s = sample(runner, num_episodes=4, explore=False)
    greedy = torch.tanh(runner.acting.actors.respond(Seen(torch.from_numpy(s.obs[0])))[0])
    np.testing.assert_allclose(s.actions[0], greedy.numpy(), atol=1e-6)


def test_returns_are_those_of_the_agents(ray_session: None) -> None:
    runner = runner_of(small_config("maddpg", horizon=5, reward_mode="individual"))
    s = sample(runner, num_timesteps=20)  # two episodes of each copy
    results = runner.get_metrics()
    assert results["episode_len_mean"].peek() == 5
    for index, agent in enumerate(runner.team.agents):
        got = np.mean(results["agent_episode_returns_mean"][agent].values)
        assert got == pytest.approx(s.rewards[:, :, index].sum(0).mean() / 2, rel=1e-5)
    assert "coverage" in results["episode_metrics"]


def test_exploration_decays_as_in_the_paper() -> None:
    explore = EpsilonGaussian()
    assert explore.at(0) == (0.1, 0.1)
    assert explore.at(50_000) == pytest.approx((0.075, 0.075))
    assert explore.at(10**7) == (0.05, 0.05)
    assert EpsilonGaussian(epsilon=0.0, noise=0.02).at(0) == (0.0, 0.02)
    generator = torch.Generator().manual_seed(0)
    greedy = torch.full((20_000, 3, 5), 0.5)
    noisy = explore(greedy, 0, generator)
    assert noisy.abs().max() <= 1.0
    uniform = ((noisy - 0.5).abs() > 0.5).any(-1).float().mean().item()
    assert uniform == pytest.approx(0.1 * (1 - 0.5**5), abs=0.005)
    quiet = EpsilonGaussian(epsilon=0.0, noise=0.1)(greedy, 0, generator)
    assert (quiet - 0.5).std().item() == pytest.approx(0.1, abs=0.002)
    with pytest.raises(ValueError, match=r"has no setting 'sigma'; legal are epsilon, noise, decay, final"):
        make_exploration({"sigma": 0.1})
    with pytest.raises(ValueError, match=r"EpsilonGaussian: epsilon=1\.5 is illegal; legal: a number >= 0 and <= 1"):
        make_exploration({"epsilon": 1.5})


def test_actions_are_unsquashed_to_the_environments_bounds(ray_session: None) -> None:
    runner = runner_of(small_config("iddpg").environment(TwoAgents))
    s = sample(runner, num_timesteps=20)
    np.testing.assert_allclose(s.rewards, ((s.actions + 1) / 2 * 4 + 2).sum(-1), rtol=1e-5)
    assert s.terminated[4].all() and not s.truncated.any()
    assert s.final_obs[0, 0, 0] == 5.0


@pytest.mark.parametrize("random_actions", [False, True])
def test_any_fixed_team_parallel_env_can_be_sampled(ray_session: None, random_actions: bool) -> None:
    tune.register_env("mpe2_spread", lambda _: simple_spread_v3.parallel_env(continuous_actions=True, max_cycles=6))
    config = small_config("maddpg").environment("mpe2_spread").training(critic_state="world")
    runner = runner_of(config)
    assert runner.team.agents == ("agent_0", "agent_1", "agent_2")
    s = sample(runner, num_timesteps=14, random_actions=random_actions)
    assert s.obs.shape == (7, 2, 3, 18)
    assert np.flatnonzero(s.truncated[:, 0]).tolist() == [5]
    assert s.state is not None and s.state.shape == (7, 2, 54)
    assert len(np.unique(s.actions)) > 100


def test_the_module_works_in_rllibs_own_runner(ray_session: None) -> None:
    config = small_config("maddpg", horizon=7)
    config.validate()
    config.env_runner_cls = MultiAgentEnvRunner
    runner = MultiAgentEnvRunner(config=config, worker_index=0)
    episodes = runner.sample(num_episodes=2, explore=False)
    agent = episodes[0].agent_episodes["agent_1"]
    assert len(agent) == 7
    module = runner.module["agent_1"]
    want = module.forward_inference({"obs": np.asarray(agent.get_observations(slice(0, 7)))})[Columns.ACTIONS]
    np.testing.assert_allclose(np.asarray(agent.get_actions()), want.numpy(), atol=1e-5)
    assert runner.sample(num_timesteps=4, explore=True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"nan_at": 3}, r"observation of agent 'right' is not finite at step 3 .* copy 0"),
        ({"nan_at": 0}, r"observation of agent 'right' is not finite at step 0"),
        ({"inf_at": 2}, r"reward of agent 'left' is not finite at step 2"),
        ({"leave_at": 4}, r"team changed in environment copy 0 at step 4: missing agents \['left'\]"),
    ],
)
def test_what_goes_wrong_in_an_environment_is_named(ray_session: None, options: dict, message: str) -> None:
    runner = runner_of(small_config("iddpg").environment(TwoAgents, env_config=options))
    with pytest.raises(ValueError, match=message):
        runner.sample(num_timesteps=20)


def test_networks_act_without_denormal_numbers_and_environments_compute_with_them(ray_session: None) -> None:
    runner = runner_of(small_config("maddpg"))
    respond, step = runner.acting.actors.respond, runner.env.step
    seen: dict[str, list[float]] = {"respond": [], "step": []}

    def half() -> float:
        return float(torch.tensor(torch.finfo(torch.float32).tiny) * 0.5)

    runner.acting.actors.respond = lambda given: (seen["respond"].append(half()), respond(given))[1]
    runner.env.step = lambda actions: (seen["step"].append(half()), step(actions))[1]
    runner.sample(num_timesteps=8)
    assert seen["respond"] and not any(seen["respond"])
    assert seen["step"] and all(seen["step"])
    runner.stop()
