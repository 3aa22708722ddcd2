"""Learning has a known answer: one agent finds one target, QMIX solves what VDN cannot, memory helps where it must."""

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from ray.rllib.env.multi_agent_env import MultiAgentEnv

import rllib_maobs as maobs
from tests.benchmarks.mpe_spread import mpe_spread_config


def distance_of(algo: maobs.JointAlgorithm) -> float:
    return float(algo.evaluate()["env_runners"]["episode_metrics"]["target_distance"])


def test_one_agent_finds_its_target(ray_session: None) -> None:
    """The best any policy can do is the straight way at full speed; most of it is learned in 3000 updates."""
    horizon = 25
    config = maobs.MADDPGLConfig()
    config.environment("maobs/spread-3a", env_config={"num_agents": 1, "num_obstacles": 0, "horizon": horizon})
    config.env_runners(num_envs_per_env_runner=20)
    config.training(
        critic_lr=1e-3,
        train_batch_size_per_learner=128,
        num_random_steps=2_000,
        num_steps_sampled_before_learning_starts=2_000,
        updates_per_env_step=0.2,
    )
    config.reporting(min_sample_timesteps_per_iteration=4_000)
    config.evaluation(
        evaluation_interval=100,
        evaluation_duration=100,
        evaluation_config=maobs.JointConfig.overrides(num_envs_per_env_runner=100),
    )
    algo = config.debugging(seed=0).build_algo()
    untrained = distance_of(algo)
    for _ in range(4):
        algo.train()
    trained = distance_of(algo)
    # No policy gets there faster than at full speed on the straight way: at most 0.0707, then 0.1 a step.
    env = maobs.make_vec("spread-3a", num_envs=1000, num_agents=1, num_obstacles=0, horizon=horizon)
    obs, _ = env.reset(seed=1)
    start = np.linalg.norm(obs[:, 0, 4:6], axis=1, keepdims=True)
    bound = np.maximum(0.0, start - (0.0707 + 0.1 * np.arange(horizon))).mean()
    assert bound < trained < bound + 0.15 * (untrained - bound), (bound, trained, untrained)
    # The module knows the way on its own: a target to the right is a push to the right.
    module = algo.get_module("agent_0")
    push = module.forward_inference({"obs": torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.8, 0.0]])})["actions"][0]
    assert push[1] - push[2] > 0.5
    algo.stop()


@pytest.mark.slow
def test_three_agents_spread_as_in_other_libraries(ray_session: None) -> None:
    """A third of the run in the README; random actions give 2.1, the full run 0.7 to 0.85."""
    algo = mpe_spread_config("maddpg", seed=0).build_algo()
    for _ in range(5):
        result = algo.train()
    assert result["evaluation"]["env_runners"]["episode_metrics"]["target_distance"] < 1.25
    algo.stop()


class Game(MultiAgentEnv):
    """A two-agent game of a few steps with one reward for both; what it is, a derived class says."""

    steps, observation_size, action_space = 1, 1, Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, config: dict[str, Any]) -> None:
        super().__init__()
        self.possible_agents = self.agents = ["left", "right"]
        self.observation_spaces = dict.fromkeys(self.agents, Box(-5.0, 5.0, (self.observation_size,), np.float32))
        self.action_spaces = dict.fromkeys(self.agents, type(self).action_space)
        self.rng = np.random.default_rng(0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.t = 0
        self.begin()
        return self.observe(), {}

    def step(self, actions: dict[str, Any]) -> tuple[Any, ...]:
        reward = self.pay(*(actions[agent] for agent in self.agents))
        self.t += 1
        over = dict.fromkeys([*self.agents, "__all__"], self.t == self.steps)
        rewards = dict.fromkeys(self.agents, float(reward))
        return self.observe(), rewards, over, dict.fromkeys(over, False), {}


class TwoStepGame(Game):
    """Rashid et al. 2018, section 5: left's first action chooses the second step's payoffs, 7 for all or 0, 1, 1, 8."""

    steps, observation_size, action_space = 2, 3, Discrete(2)

    def begin(self) -> None:
        self.place = 0

    def observe(self) -> dict[str, Any]:
        return dict.fromkeys(self.agents, np.eye(3, dtype=np.float32)[self.place])

    def pay(self, left: int, right: int) -> float:
        if self.t == 0:
            self.place = 1 + left
            return 0.0
        return 7.0 if self.place == 1 else [[0.0, 1.0], [1.0, 8.0]][left][right]


@pytest.mark.parametrize(("algorithm", "value"), [("qmix", 8.0), ("vdn", 7.0)])
def test_qmix_represents_what_vdn_cannot(ray_session: None, algorithm: str, value: float) -> None:
    """From uniformly random play VDN's sum takes 8 for 6.5 and prefers the sure 7; QMIX plays for 8."""
    config = maobs.ALGORITHMS[algorithm]().environment(TwoStepGame)
    config.env_runners(num_envs_per_env_runner=10)
    config.training(
        gamma=0.99,
        train_batch_size_per_learner=64,
        exploration={"epsilon": 1.0, "decay": 0.0},
        updates_per_env_step=0.5,
        tau=0.05,
        replay_buffer_capacity=10_000,
    )
    config.rl_module(model_config={"hidden_sizes": (32,)})
    config.reporting(min_sample_timesteps_per_iteration=6_000)
    config.evaluation(evaluation_interval=1, evaluation_duration=4)
    algo = config.debugging(seed=0).build_algo()
    result = algo.train()
    assert result["evaluation"]["env_runners"]["agent_episode_returns_mean"]["left"] == value
    algo.stop()


class CueGame(Game):
    """A cue is shown at the first step only; the last action shall repeat it. The state has it all the time."""

    steps, observation_size = 3, 2

    def begin(self) -> None:
        self.cue = self.rng.choice([-1.0, 1.0])

    def observe(self) -> dict[str, Any]:
        seen = np.array([self.cue if self.t == 0 else 0.0, self.t], np.float32)
        return dict.fromkeys(self.agents, seen)

    def state(self) -> Any:
        return np.array([self.cue, self.t], np.float32)

    def pay(self, left: Any, right: Any) -> float:
        return -((left[0] - self.cue) ** 2 + (right[0] - self.cue) ** 2) if self.t == self.steps - 1 else 0.0


@pytest.mark.parametrize(
    ("algorithm", "memory"),
    [("maddpg-lstm", {"seq_length": 3}), ("maddpg", {}), ("maddpg-lstm", {"seq_length": 1, "stored_state": True})],
)
def test_a_cue_from_the_past_needs_memory(ray_session: None, algorithm: str, memory: dict[str, Any]) -> None:
    """Without memory the last actions agree with the cue half of the time.

    With a window over the episode they always do, and if h and c are carried, with a window of one observation.
    """
    config = maobs.ALGORITHMS[algorithm]().environment(CueGame)
    config.env_runners(num_envs_per_env_runner=20)
    config.training(
        actor_lr=2e-3,
        critic_lr=2e-3,
        critic_state="world",
        train_batch_size_per_learner=64,
        exploration={"epsilon": 0.3, "noise": 0.2, "decay": 0.0},
        updates_per_env_step=0.15,
        tau=0.05,
        replay_buffer_capacity=20_000,
    )
    config.training(**memory)
    config.rl_module(model_config={"hidden_sizes": (32, 32)})
    config.reporting(min_sample_timesteps_per_iteration=9_000)
    algo = config.debugging(seed=0).build_algo()
    algo.train()
    (sample,) = algo.env_runner.sample(num_timesteps=20 * 300, explore=False)
    start, last = sample.obs[::3, :, :, 0], sample.actions[2::3, :, :, 0]
    success = float((np.sign(last) == start[: len(last)]).mean())
    assert success > 0.98 if algorithm == "maddpg-lstm" else abs(success - 0.5) < 0.06, success
    algo.stop()


class BlindGame(Game):
    """Both are paid u_1 u_2 + x_1 x_2 of two numbers of which each sees its own: at random, 1/9 + 1/9 of variance."""

    def begin(self) -> None:
        self.x = self.rng.uniform(-1.0, 1.0, 2)

    def observe(self) -> dict[str, Any]:
        return {agent: np.array([x], np.float32) for agent, x in zip(self.agents, self.x, strict=True)}

    def pay(self, left: Any, right: Any) -> float:
        return left[0] * right[0] + self.x[0] * self.x[1]


@pytest.mark.parametrize(("algorithm", "unseen"), [("iddpg", 2 / 9), ("maddpg-l", 1 / 9), ("maddpg", 0.0)])
def test_each_critic_explains_what_it_sees(ray_session: None, algorithm: str, unseen: float) -> None:
    """What is left of the critic's loss is the variance of what it does not see: x_2 and u_2, u_2, nothing."""
    config = maobs.ALGORITHMS[algorithm]().environment(BlindGame)
    config.env_runners(num_envs_per_env_runner=50)
    config.training(
        critic_lr=3e-3,
        train_batch_size_per_learner=256,
        exploration={"epsilon": 1.0, "decay": 0.0},
        updates_per_env_step=0.05,
        replay_buffer_capacity=60_000,
    )
    config.rl_module(model_config={"hidden_sizes": (32, 32)})
    config.reporting(min_sample_timesteps_per_iteration=20_000)
    algo = config.debugging(seed=0).build_algo()
    algo.train()
    learned = algo.train()["learners"]
    for agent in ("left", "right"):
        assert learned[agent]["critic_loss"] == pytest.approx(unseen, abs=0.02)
    algo.stop()
