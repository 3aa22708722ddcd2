"""What needs no training: random play, the heuristic and ORCA, the rows to hold algorithms against."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import pandas as pd

from rllib_maobs.envs import SCENARIOS, make_scenario, make_vec
from rllib_maobs.policies import make_policy, play_episodes

# How agents are moved and what critics see is a choice of who trains: the task is the same, and so are its scores.
_NOT_THE_TASK = ("action_mode", "state")
_AT_ONCE = 100  # copies; more would be slower, for want of cache
# Of bodies, in all copies at once: some hundred megabytes of an entity actor, where each agent looks at each pair of
# a target and another agent.
_TRIPLES = 20_000_000


def task_options(env: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a task, without those that make no other task: `action_mode` and `state`.

    With these baselines play, in every table: with the task's own action_mode, not with that of what they stand
    beside. So random play has one number on a task, whatever was trained there.

    Args:
        env: A scenario's id, whose options all count, also those that are not given; or another environment.
        options: Its options; an illegal one of a scenario is a ValueError.
    """
    every = asdict(make_scenario(env, **options).options) if env in SCENARIOS else options
    return {name: value for name, value in every.items() if name not in _NOT_THE_TASK}


def play_many(env: str, options: Mapping[str, Any], policy: str, episodes: int, seed: int = 0) -> pd.DataFrame:
    """Play episodes of a task, so many copies at once as are quick.

    Args:
        env: A scenario's id.
        options: Of the environment.
        policy: See `make_policy`.
        episodes: How many.
        seed: Of the first one; the next one adds 1.

    Returns:
        See `play_episodes`.
    """
    rows, done = [], 0
    bodies = sum(group.count for group in make_scenario(env, **options).bodies())
    at_once = max(1, min(_AT_ONCE, _TRIPLES // bodies**3))
    while done < episodes:
        vec = make_vec(env, num_envs=min(at_once, episodes - done), **options)
        rows.append(play_episodes(vec, make_policy(vec, policy, seed + done), seed + done))
        done += vec.num_envs
    return pd.concat(rows, ignore_index=True)


def play_baselines(env: str, env_config: Mapping[str, Any], episodes: int = 100) -> dict[str, dict[str, float]]:
    """Play an environment with uniformly random actions, and with its scenario's heuristic.

    Args:
        env: Registered name; one that is not of this package has no baselines here.
        env_config: Options of the environment, see `task_options`.
        episodes: How many, with the seeds 0, 1, ...

    Returns:
        By policy, "random" and "heuristic" (if the scenario has one), the mean of every metric over the episodes.
    """
    scenario_id = env.removeprefix("maobs/")
    if scenario_id not in SCENARIOS:
        return {}
    options = task_options(scenario_id, env_config)
    baselines = {}
    for policy in ("random", "heuristic"):
        try:
            rows = play_many(scenario_id, options, policy, episodes)
        except NotImplementedError:
            continue
        baselines[policy] = rows.drop(columns=["seed", "return"]).mean().to_dict()
    return baselines
