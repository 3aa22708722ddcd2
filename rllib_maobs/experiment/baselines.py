"""What needs no training: the random and the hand-written policy, the rows to hold algorithms against."""

from collections.abc import Mapping
from typing import Any

from rllib_maobs.envs import SCENARIOS, make_vec
from rllib_maobs.policies import make_policy, play_episodes


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
            rows = play_episodes(vec, make_policy(vec, policy))
        except NotImplementedError:
            continue
        baselines[policy] = rows.drop(columns=["seed", "return"]).mean().to_dict()
    return baselines
