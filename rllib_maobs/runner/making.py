"""From a config to the environment copies that a runner steps."""

from __future__ import annotations

import logging
from typing import Any

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.env.env_context import EnvContext
from ray.tune.registry import ENV_CREATOR, _global_registry

from rllib_maobs.envs.joint import StackedEnv, make_copy, make_joint_env, register_envs
from rllib_maobs.envs.team import JointEnv, Team
from rllib_maobs.envs.time_limit import check_time_limits
from rllib_maobs.envs.wrappers import InOrder, WithAgentIds
from rllib_maobs.options import closest

logger = logging.getLogger(__name__)


def env_creator(config: AlgorithmConfig) -> Any:
    """The function that makes the environment of a config from its `env_config`.

    Raises:
        ValueError: If `config.env` is neither a registered name nor an environment class.
    """
    register_envs()  # names are lost when Ray restarts
    if isinstance(config.env, type) and hasattr(config.env, "reset") and hasattr(config.env, "step"):
        return config.env
    # Ray's registry holds names of ASCII alone.
    if isinstance(config.env, str) and config.env.isascii() and _global_registry.contains(ENV_CREATOR, config.env):
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
    env = make_joint_env(env_creator(config), _context(config, worker_index), num_envs)
    limit_faults(env, config)
    if team is not None and env.agents != [*team.agents] and set(env.agents) == set(team.agents):
        env = InOrder(env, team.agents)
    env = WithAgentIds(env) if config.agent_id_input else env
    if team is not None:
        role = "evaluation runner" if config.in_evaluation else "runner"
        team.check(env, f"environment {config.env!r} ({role} {worker_index})")
    return env


def _context(config: AlgorithmConfig, worker_index: int) -> EnvContext:
    return EnvContext(config.env_config or {}, worker_index=worker_index, num_workers=config.num_env_runners)


def replace_copy(env: JointEnv, config: AlgorithmConfig, copy: int, worker_index: int = 0) -> None:
    """Makes one copy of a user's environment anew; it is to be reset.

    Args:
        env: The copies.
        config: The config.
        copy: Which one.
        worker_index: Number of the runner that steps them.

    Raises:
        Exception: Whatever the environment's creator raises; or a ValueError if what it makes is not like the others.
    """
    stacked = getattr(env, "unwrapped", env)
    assert isinstance(stacked, StackedEnv)  # no other has copies that fail alone
    try:
        stacked.envs[copy].close()
    except Exception as error:  # it may be closed because it is broken
        logger.warning("Copy %d of the environment of runner %d could not be closed: %r", copy, worker_index, error)
    stacked.replace(copy, make_copy(env_creator(config), _context(config, worker_index), copy))


def limit_faults(env: JointEnv, config: AlgorithmConfig) -> None:
    """Gives a user's environment the config's `env_timeout_s` and `restart_failed_sub_environments`.

    Raises:
        ValueError: If there can be no time limit, here or for this environment.
    """
    timeout_s = getattr(config, "env_timeout_s", None)  # configs in older checkpoints have none
    stacked = getattr(env, "unwrapped", env)
    if isinstance(stacked, StackedEnv):
        stacked.timeout_s, stacked.isolates = timeout_s, config.restart_failed_sub_environments
    elif timeout_s is not None:
        raise ValueError(
            f"env_timeout_s={timeout_s:g} has no effect on {config.env!r}, whose copies are stepped in one array "
            f"operation: leave it out. It is for environments of your own."
        )
    if timeout_s is not None:
        check_time_limits()
