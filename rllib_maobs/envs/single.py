"""One copy of a scenario with dictionaries by agent id, for the faces to other libraries."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rllib_maobs.envs.rendering import FRAMES_PER_SECOND, Frame, Renderer, check_render_mode
from rllib_maobs.envs.scenario import Scenario
from rllib_maobs.envs.vector import VectorEnv, as_array

ByAgent = dict[str, Any]


class SingleCopy:
    """A `VectorEnv` of one copy that speaks dictionaries.

    Args:
        scenario: The task.
        render_mode: None, "rgb_array" or "human".

    Raises:
        ValueError: If the mode is unknown.
        ImportError: If pictures cannot be drawn.
    """

    def __init__(self, scenario: Scenario[Any], render_mode: str | None = None) -> None:
        check_render_mode(render_mode)
        self.env = VectorEnv(scenario, num_envs=1)
        self.render_mode = render_mode
        self._renderer = None if render_mode is None else Renderer(scenario, self.env.world)
        self._sizes = list(scenario.observation_sizes)

    def reset(self, seed: int | None) -> tuple[ByAgent, ByAgent]:
        """Begin an episode; returns observations and infos by agent."""
        observations, _ = self.env.reset(seed)
        if self._renderer is not None:
            self._renderer.begin()
            self._show()
        return self._by_agent(observations[0]), {agent: {} for agent in self.env.agents}

    def step(self, actions: Mapping[str, Any]) -> tuple[ByAgent, ByAgent, bool, bool, ByAgent]:
        """Step; returns observations and rewards by agent, terminated, truncated, infos by agent.

        Raises:
            RuntimeError: If there was no reset, or the episode has ended.
            ValueError: If an agent has no action, an action comes from an unknown agent, or one has a wrong shape or
                type, is not finite or out of range; names the agent.
        """
        self.env.check_running()
        agents = self.env.agents
        if not isinstance(actions, Mapping):
            raise ValueError(f"actions are a {type(actions).__name__}; expected a dict with the action of each agent")
        if set(actions) != set(agents):
            missing = [agent for agent in agents if agent not in actions]
            unknown = [agent for agent in actions if agent not in agents]
            raise ValueError(f"actions must come from {agents}; missing: {missing}, unknown: {unknown}")
        joint = np.stack([self._check_action(agent, actions[agent]) for agent in agents])[None]
        observations, rewards, terminated, truncated, info = self.env.step(joint)
        if self._renderer is not None:
            self._renderer.note_step()
            self._show()
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

    def render(self) -> Frame | None:
        """Return the picture of the present situation, (H, W, 3), in mode "rgb_array"; None in mode "human".

        Raises:
            RuntimeError: If the environment was made without a render mode, or was never reset.
        """
        if self._renderer is None:
            raise RuntimeError('render() needs an environment made with render_mode="rgb_array" or "human"')
        self.env.check_begun("render")
        if self.render_mode == "rgb_array":
            return self._renderer.frame()
        self._show()
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()

    def _show(self) -> None:
        """In mode "human", bring the window up to date."""
        if self._renderer is not None and self.render_mode == "human":
            self._renderer.show(FRAMES_PER_SECOND)

    def heuristic(self) -> ByAgent:
        """Return the actions of the scenario's hand-written policy by agent."""
        return dict(zip(self.env.agents, self.env.heuristic()[0], strict=True))

    def state(self, kind: str | None = None) -> NDArray[np.float32]:
        """Return the (S,) global state."""
        return self.env.state(kind)[0]

    def _by_agent(self, rows: NDArray[np.float32]) -> ByAgent:
        rows_and_sizes = zip(self.env.agents, rows, self._sizes, strict=True)
        return {agent: row[:size] for agent, row, size in rows_and_sizes}

    def _check_action(self, agent: str, given: Any) -> NDArray[Any]:
        """Check what cannot be told any more, or not by agent, when all actions are one array."""
        action = as_array(given, f"the action of {agent}")
        expected = self.env.action_spaces[agent].shape
        if action.shape != expected:
            raise ValueError(f"action of {agent} has shape {action.shape}; expected {expected}")
        if action.dtype.kind not in ("fiub" if expected else "iu"):
            raise ValueError(f"action of {agent} is {action.dtype}; expected {'numbers' if expected else 'an integer'}")
        return action
