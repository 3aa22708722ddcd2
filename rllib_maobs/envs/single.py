"""One copy of a scenario with dictionaries by agent id, for the faces to other libraries."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rllib_maobs.envs.scenario import Scenario
from rllib_maobs.envs.vector import VectorEnv

ByAgent = dict[str, Any]


class SingleCopy:
    """A `VectorEnv` of one copy that speaks dictionaries.

    Args:
        scenario: The task.
    """

    def __init__(self, scenario: Scenario[Any]) -> None:
        self.env = VectorEnv(scenario, num_envs=1)

    def reset(self, seed: int | None) -> tuple[ByAgent, ByAgent]:
        """Begin an episode; returns observations and infos by agent."""
        observations, _ = self.env.reset(seed)
        return self._by_agent(observations[0]), {agent: {} for agent in self.env.agents}

    def step(self, actions: Mapping[str, Any]) -> tuple[ByAgent, ByAgent, bool, bool, ByAgent]:
        """Step; returns observations and rewards by agent, terminated, truncated, infos by agent.

        Raises:
            ValueError: If an agent has no action, or an action comes from an unknown agent.
        """
        agents = self.env.agents
        if set(actions) != set(agents):
            missing = [agent for agent in agents if agent not in actions]
            unknown = [agent for agent in actions if agent not in agents]
            raise ValueError(f"actions must come from {agents}; missing: {missing}, unknown: {unknown}")
        joint = np.stack([np.asarray(actions[agent]) for agent in agents])[None]
        observations, rewards, terminated, truncated, info = self.env.step(joint)
        metrics = {name: float(value[0]) for name, value in info.get("episode_metrics", {}).items()}
        infos: ByAgent = {agent: {"episode_metrics": dict(metrics)} if metrics else {} for agent in agents}
        rewards_by_agent = {agent: float(reward) for agent, reward in zip(agents, rewards[0], strict=True)}
        return (
            self._by_agent(observations[0]),
            rewards_by_agent,
            bool(terminated[0]),
            bool(truncated[0]),
            infos,
        )

    def state(self, kind: str | None = None) -> NDArray[np.float32]:
        """Return the (S,) global state."""
        return self.env.state(kind)[0]

    def _by_agent(self, rows: NDArray[np.float32]) -> ByAgent:
        return dict(zip(self.env.agents, rows, strict=True))
