"""Learning has a known answer: one agent finds one target; three agents spread as other libraries' do."""

import numpy as np
import pytest
import torch

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
