"""From a config to the environment copies that a runner steps."""

from __future__ import annotations

from typing import Any

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.env.env_context import EnvContext
from ray.tune.registry import ENV_CREATOR, _global_registry

from rllib_maobs.envs.joint import make_joint_env, register_envs
from rllib_maobs.envs.team import JointEnv, Team
from rllib_maobs.envs.wrappers import InOrder, WithAgentIds
from rllib_maobs.options import closest


def env_creator(config: AlgorithmConfig) -> Any:
    """The function that makes the environment of a config from its `env_config`.

    Raises:
        ValueError: If `config.env` is neither a registered name nor an environment class.
    """
    register_envs()  # names are lost when Ray restarts
    if isinstance(config.env, type) and hasattr(config.env, "reset") and hasattr(config.env, "step"):
        return config.env
    if isinstance(config.env, str) and _global_registry.contains(ENV_CREATOR, config.env):
        return _global_registry.get(ENV_CREATOR, config.env)
    hint = closest(config.env, register_envs()) if isinstance(config.env, str) else ""
    raise ValueError(
        f"Unknown environment {config.env!r}{hint}; legal are {', '.join(sorted(register_envs()))}, a name registered "
        f"with ray.tune.register_env, or an environment class."
    )


def make_env(config: AlgorithmConfig, num_envs: int, worker_index: int = 0, team: Team | None = None) -> JointEnv:
    """E copies of a config's environment, see `make_joint_env`.

    Args:
        config: The config.
        num_envs: E.
        worker_index: Number of the runner that steps them.
        team: The team whose order all arrays are to have; None for the environment's own.

    Raises:
        ValueError: If the environment's agents, or their spaces, are not the team's.
    """
    context = EnvContext(config.env_config or {}, worker_index=worker_index, num_workers=config.num_env_runners)
    env = make_joint_env(env_creator(config), context, num_envs)
    if team is not None and env.agents != [*team.agents] and set(env.agents) == set(team.agents):
        env = InOrder(env, team.agents)
    env = WithAgentIds(env) if config.agent_id_input else env
    if team is not None:
        role = "evaluation runner" if config.in_evaluation else "runner"
        team.check(env, f"environment {config.env!r} ({role} {worker_index})")
    return env
