"""How what has been learned is measured, the same for all libraries of `peers_learning.py`."""

from typing import Any

from rllib_maobs.envs import make_vec
from rllib_maobs.policies import Policy, play_episodes

Options = dict[str, Any]
"""Of a scenario."""


def learned(
    policy: Policy, scenario: str, options: Options, episodes: int, env_steps: int, seconds: float
) -> dict[str, float]:
    """Return what a library did in its time, and the mean measures of episodes without noise."""
    table = play_episodes(make_vec(scenario, num_envs=episodes, **options), policy)
    means = table.mean().to_dict()
    contacts = means["collisions_agents"] + means["collisions_obstacles"]
    return {"env_steps": env_steps, "minutes": seconds / 60.0, "contacts": contacts, **means}
