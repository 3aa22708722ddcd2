"""The scenarios as a ParallelEnv of PettingZoo."""

from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from rllib_maobs.envs.registry import make_scenario
from rllib_maobs.envs.rendering import FRAMES_PER_SECOND, RENDER_MODES, Frame
from rllib_maobs.envs.scenario import Scenario
from rllib_maobs.envs.single import ByAgent, SingleCopy
from rllib_maobs.envs.vector import VectorEnv
from rllib_maobs.layout import Entities, Layout, layout_size


class MAObsParallelEnv(ParallelEnv):
    """A scenario as a PettingZoo ParallelEnv; made by `parallel_env`.

    All agents act in every step and end together; `agents` is then empty until the next reset. In the last
    step the info of every agent holds "episode_metrics", a dictionary of floats.

    Attributes:
        observation_layouts: What each agent's observation is made of, by id.
        state_layout: What `state()` is made of: with the scenario's option `state="world"` `Scenario.state_layout`,
            otherwise a group for each agent, its observation.

    Args:
        scenario: The task.
        render_mode: None, "rgb_array" (`render()` returns a picture (H, W, 3)) or "human" (a window shows every
            step, in real time).
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "rllib_maobs",
        "is_parallelizable": True,
        "render_modes": list(RENDER_MODES),
        "render_fps": FRAMES_PER_SECOND,
    }

    def __init__(self, scenario: Scenario[Any], render_mode: str | None = None) -> None:
        self.scenario = scenario
        self.render_mode = render_mode
        self._copy = SingleCopy(scenario, render_mode)
        self.possible_agents = list(scenario.agents)
        self.agents: list[str] = []
        env = self._copy.env
        self.observation_layouts = env.observation_layouts
        rows = tuple(Entities(agent, 1, layout_size(layout)) for agent, layout in env.observation_layouts.items())
        self.state_layout: Layout = env.state_layout if scenario.options.state == "world" else rows
        low_high = np.full(env.state_size(), np.inf, np.float32)
        self.state_space = gym.spaces.Box(-low_high, low_high, dtype=np.float32)

    @property
    def vector(self) -> VectorEnv:
        """The one copy behind this face, as arrays."""
        return self._copy.env

    def observation_space(self, agent: str) -> gym.Space[Any]:
        """Return the observation space of an agent."""
        return self._copy.env.observation_spaces[agent]

    def action_space(self, agent: str) -> gym.Space[Any]:
        """Return the action space of an agent."""
        return self._copy.env.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ByAgent, ByAgent]:
        """Begin an episode.

        Args:
            seed: Starts a new stream of random numbers; None goes on with the present one.
            options: Not used.

        Returns:
            Observations (O,) and infos by agent.
        """
        self.agents = list(self.possible_agents)
        return self._copy.reset(seed)

    def step(self, actions: Mapping[str, Any]) -> tuple[ByAgent, ByAgent, ByAgent, ByAgent, ByAgent]:
        """Step with one action per agent.

        Args:
            actions: Actions by agent.

        Returns:
            Observations, rewards, terminated, truncated and infos by agent.
        """
        observations, rewards, terminated, truncated, infos = self._copy.step(actions)
        if terminated or truncated:
            self.agents = []
        agents = self.possible_agents
        return (
            observations,
            rewards,
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            infos,
        )

    def render(self) -> Frame | None:
        """Return a picture, or None in mode "human"; see `SingleCopy.render`."""
        return self._copy.render()

    def close(self) -> None:
        """Close the window, if there is one."""
        self._copy.close()

    def heuristic(self) -> ByAgent:
        """Return the actions of the scenario's hand-written policy by agent; see `Scenario.heuristic`."""
        return self._copy.heuristic()

    def state(self, kind: str | None = None) -> NDArray[np.float32]:
        """Return the (S,) global state; see `VectorEnv.state`."""
        return self._copy.state(kind)


def parallel_env(
    scenario: str | type[Scenario[Any]], render_mode: str | None = None, **options: Any
) -> MAObsParallelEnv:
    """Make a PettingZoo ParallelEnv.

    Args:
        scenario: A registered id, or a subclass of `Scenario`.
        render_mode: None, "rgb_array" or "human", see `MAObsParallelEnv`.
        **options: Options of the scenario, documented in its class.
    """
    return MAObsParallelEnv(make_scenario(scenario, **options), render_mode)
