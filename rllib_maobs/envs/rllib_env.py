"""The scenarios as a MultiAgentEnv of RLlib, and their metrics in RLlib's results."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.env.multi_agent_env import MultiAgentEnv
from ray.rllib.utils.annotations import override

from rllib_maobs.envs.registry import make_scenario
from rllib_maobs.envs.rendering import Frame
from rllib_maobs.envs.single import ByAgent, SingleCopy
from rllib_maobs.envs.vector import VectorEnv


class MAObsEnv(MultiAgentEnv):
    """A scenario for any stock RLlib algorithm.

    All agents act in every step and end together. In the last step the info of every agent holds
    "episode_metrics", a dictionary of floats.

    Example:
    ```python
    config = (
        PPOConfig()
        .environment(MAObsEnv, env_config={"scenario": "spread-3a", "reward_mode": "individual"})
        .multi_agent(policies={"shared"}, policy_mapping_fn=lambda agent, episode, **kwargs: "shared")
        .callbacks(EpisodeMetricsCallback)
    )
    ```

    Attributes:
        observation_layouts: What each agent's observation is made of, by id.
        state_layout: What `state("world")` is made of.

    Args:
        config: "scenario" (a registered id or a `Scenario` class), the scenario's options, and "render_mode":
            None, "rgb_array" (`render()` returns a picture (H, W, 3)) or "human" (a window shows every step).

    Raises:
        ValueError: If the scenario or an option is unknown, or a value is illegal; names what is legal.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        if not isinstance(config, Mapping | None):
            raise ValueError(f'the env config must be a dict, such as {{"scenario": "spread-9a"}}, not {config!r}')
        options = dict(config or {})
        if unnamed := [name for name in options if not isinstance(name, str)]:
            raise ValueError(f"the env config has options by name; {unnamed[0]!r} is no name")
        if "scenario" not in options:
            raise ValueError('the env config needs a "scenario", such as {"scenario": "spread-9a"}')
        self.render_mode = options.pop("render_mode", None)
        self.scenario = make_scenario(options.pop("scenario"), **options)
        self._copy = SingleCopy(self.scenario, self.render_mode)
        self.possible_agents = list(self.scenario.agents)
        self.agents = list(self.scenario.agents)
        super().__init__()
        self.observation_spaces = self._copy.env.observation_spaces
        self.action_spaces = self._copy.env.action_spaces
        self.observation_layouts = self._copy.env.observation_layouts
        self.state_layout = self._copy.env.state_layout

    @override(MultiAgentEnv)
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ByAgent, ByAgent]:
        """Begin an episode.

        Args:
            seed: Starts a new stream of random numbers; None goes on with the present one.
            options: Not used.

        Returns:
            Observations (O,) and infos by agent.
        """
        return self._copy.reset(seed)

    @override(MultiAgentEnv)
    def step(self, action_dict: Mapping[str, Any]) -> tuple[ByAgent, ByAgent, ByAgent, ByAgent, ByAgent]:
        """Step with one action per agent.

        Args:
            action_dict: Actions by agent.

        Returns:
            Observations, rewards, terminated, truncated (both with "__all__") and infos by agent.
        """
        observations, rewards, terminated, truncated, infos = self._copy.step(action_dict)
        everybody = [*self.possible_agents, "__all__"]
        return (
            observations,
            rewards,
            dict.fromkeys(everybody, terminated),
            dict.fromkeys(everybody, truncated),
            infos,
        )

    @override(MultiAgentEnv)
    def render(self) -> Frame | None:
        """Return a picture, or None in mode "human"; see `SingleCopy.render`."""
        return self._copy.render()

    @override(MultiAgentEnv)
    def close(self) -> None:
        """Close the window, if there is one."""
        self._copy.close()

    def heuristic(self) -> ByAgent:
        """Return the actions of the scenario's hand-written policy by agent; see `Scenario.heuristic`."""
        return self._copy.heuristic()

    def state(self, kind: str | None = None) -> NDArray[np.float32]:
        """Return the (S,) global state; see `VectorEnv.state`."""
        return self._copy.state(kind)

    def make_vec(self, num_envs: int) -> VectorEnv:
        """Return a `VectorEnv` of the same scenario and options."""
        return VectorEnv(self.scenario, num_envs)


class EpisodeMetricsCallback(RLlibCallback):
    """Reports the metrics of `MAObsEnv` in the results of any algorithm.

    They appear under `env_runners/episode_metrics/<name>`.
    """

    @override(RLlibCallback)
    def on_episode_end(self, *, episode: Any, env_runner: Any, metrics_logger: Any, **kwargs: Any) -> None:
        """Log the metrics of one episode, smoothed over as many episodes as RLlib's own returns.

        Args:
            episode: The MultiAgentEpisode that has ended.
            env_runner: The EnvRunner that played it.
            metrics_logger: Its logger.
            **kwargs: Not used.
        """
        infos = episode.get_infos(-1)
        metrics: dict[str, float] = next(
            (info["episode_metrics"] for info in infos.values() if "episode_metrics" in info), {}
        )
        window = env_runner.config.metrics_num_episodes_for_smoothing
        for name, value in metrics.items():
            metrics_logger.log_value(("episode_metrics", name), value, window=window)
