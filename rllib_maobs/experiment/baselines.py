"""What needs no training: the random and the hand-written policy, the rows to hold algorithms against."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rllib_maobs.envs import SCENARIOS, VectorEnv, make_vec


def play_baselines(env: str, env_config: Mapping[str, Any], episodes: int = 100) -> dict[str, dict[str, float]]:
    """Play an environment with uniformly random actions, and with its scenario's heuristic.

    Args:
        env: Registered name; one that is not of this package has no baselines here.
        env_config: Options of the environment.
        episodes: How many, with the seeds 0, 1, ...

    Returns:
        By policy, "random" and "heuristic" (if the scenario has one), the mean of every metric over the episodes.
    """
    scenario_id = env.removeprefix("maobs/")
    if scenario_id not in SCENARIOS:
        return {}
    vec = make_vec(scenario_id, num_envs=episodes, **env_config)
    baselines = {}
    for policy in ("random", "heuristic"):
        try:
            baselines[policy] = _play(vec, policy)
        except NotImplementedError:
            continue
    return baselines


def _play(env: VectorEnv, policy: str) -> dict[str, float]:
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    totals: dict[str, float] = {}
    running = np.ones(env.num_envs, bool)
    while running.any():
        _, _, terminated, truncated, info = env.step(_random(env, rng) if policy == "random" else env.heuristic())
        finished = terminated | truncated
        for name, values in info.get("episode_metrics", {}).items():
            totals[name] = totals.get(name, 0.0) + float(values[finished & running].sum())
        running &= ~finished
        if finished.any() and running.any():  # Where episodes may terminate, the others go on.
            env.reset(mask=finished)
    return {name: total / env.num_envs for name, total in totals.items()}


def _random(env: VectorEnv, rng: np.random.Generator) -> NDArray[Any]:
    shape = (env.num_envs, len(env.agents))
    space = env.action_spaces[env.agents[0]]
    return rng.integers(0, 5, shape) if not space.shape else rng.uniform(-1.0, 1.0, (*shape, *space.shape))
