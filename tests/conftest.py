"""What several test files share."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import ray
import torch

import rllib_maobs as maobs
from rllib_maobs.learner import Batch, JointLearner

torch.set_num_threads(1)

ALGORITHMS = sorted(maobs.ALGORITHMS)


@pytest.fixture(scope="session")
def ray_session() -> Iterator[None]:
    """One small local Ray for the whole test session."""
    ray.init(num_cpus=2, include_dashboard=False)
    yield
    ray.shutdown()


def small_config(algorithm: str, **options: Any) -> maobs.JointConfig:
    """An algorithm on spread-3a, small enough to build in a second; options are the environment's."""
    config = maobs.ALGORITHMS[algorithm]()
    config.environment("maobs/spread-3a", env_config=options)
    config.env_runners(num_envs_per_env_runner=2)
    config.training(train_batch_size_per_learner=16, replay_buffer_capacity=5_000)
    config.reporting(min_sample_timesteps_per_iteration=40)
    return config.debugging(seed=0)


def random_batch(config: maobs.JointConfig, size: int = 32, seed: int = 0) -> Batch:
    """Random joint transitions for a validated config, some of them terminal."""
    generator = torch.Generator().manual_seed(seed)
    team = config.team
    n, o, a, s = len(team.agents), team.observation_size, team.action_size, config.state_size

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator)

    return Batch(
        obs=normal(size, n, o),
        state=normal(size, s),
        actions=torch.tanh(normal(size, n, a)),
        rewards=normal(size, n),
        terminated=(normal(size, 1) > 0.5).to(torch.get_default_dtype()),
        next_obs=normal(size, n, o),
        next_state=normal(size, s),
    )


@pytest.fixture
def make_learner(ray_session: None) -> Callable[[maobs.JointConfig], JointLearner]:
    """Builds the learner of a config, with targets that differ from the online networks."""

    def make(config: maobs.JointConfig) -> JointLearner:
        config.validate()
        spaces = {mid: (config.team.observation_space, config.team.action_space) for mid in config.module_ids}
        learner: JointLearner = config.learner_class(
            config=config, module_spec=config.get_multi_rl_module_spec(spaces=spaces)
        )
        learner.build()
        generator = torch.Generator().manual_seed(1)
        for stack in (learner.target_actors, learner.target_critics):
            noise = torch.randn(stack.flat.shape, generator=generator)
            stack.flat.data.add_(0.01 * noise)
        return learner

    return make
