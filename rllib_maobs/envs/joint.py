"""Any fixed-team environment as arrays: what the joint runner steps, whoever made the environment.

An environment of this package steps all its copies in one array operation. Any other RLlib `MultiAgentEnv` or
PettingZoo `ParallelEnv` is stepped copy by copy, and its dicts are stacked in the order in which the
environment lists its agents.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from ray.tune.registry import register_env

from rllib_maobs.envs.registry import SCENARIOS
from rllib_maobs.envs.rllib_env import MAObsEnv

Float = NDArray[np.float32]
Bool = NDArray[np.bool_]
StepResult = tuple[Float, Float, Bool, Bool, dict[str, Any]]


class JointEnv(Protocol):
    """E copies of one environment with a fixed team of N agents, stepped together; `VectorEnv` is one."""

    num_envs: int
    agents: list[str]
    observation_spaces: dict[str, gym.Space[Any]]
    action_spaces: dict[str, gym.Space[Any]]

    def reset(self, seed: int | Sequence[int] | None = None, mask: Bool | None = None) -> tuple[Float, dict[str, Any]]:
        """Resets all copies (or those of `mask`) and returns all observations `(E, N, O)`."""

    def step(self, actions: Float) -> StepResult:
        """Steps all copies by `(E, N, A)`: observations, rewards `(E, N)`, terminated, truncated `(E,)`, info."""

    def state(self, kind: str | None = None) -> Float:
        """The state `(E, S)`."""

    def close(self) -> None:
        """Frees what the environment holds."""


@dataclass(frozen=True)
class Team:
    """What the learning side must know of an environment.

    Attributes:
        agents: Agent ids in the environment's order: the order of every N axis.
        observation_space: Every agent's observation space.
        action_space: Every agent's action space.
        state_size: S of `state("world")`, 0 if the environment has none.
    """

    agents: tuple[str, ...]
    observation_space: gym.spaces.Box
    action_space: gym.spaces.Box
    state_size: int

    @property
    def observation_size(self) -> int:
        """O."""
        return int(self.observation_space.shape[0])

    @property
    def action_size(self) -> int:
        """A."""
        return int(self.action_space.shape[0])

    @classmethod
    def of(cls, env: JointEnv, *, with_state: bool) -> Team:
        """Inspects an environment.

        Args:
            env: The environment.
            with_state: Whether its own state is needed (`critic_state="world"`); then it is reset once.

        Raises:
            ValueError: If its team cannot be trained with one network shape: agents whose spaces differ, or
                spaces that are not bounded vectors; says which and what is legal.
        """
        agents = tuple(env.agents)
        for what, spaces in (("observation", env.observation_spaces), ("action", env.action_spaces)):
            first = spaces[agents[0]]
            for agent in agents:
                space = spaces[agent]
                if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
                    raise ValueError(
                        f"The {what} space of agent {agent!r} is {space}; legal are one-dimensional Box spaces "
                        f"(flatten it, or choose continuous actions in the environment's options)."
                    )
                if space.shape != first.shape:
                    raise ValueError(
                        f"Agents must have {what}s of equal size, but {agents[0]!r} has {first.shape[0]} and "
                        f"{agent!r} has {space.shape[0]}: pad the smaller ones in the environment."
                    )
                if what == "action" and not space.is_bounded("both"):
                    raise ValueError(
                        f"The action space of agent {agent!r} is unbounded: {space}; the actor's tanh needs "
                        f"finite bounds to scale to."
                    )
        state_size = 0
        if with_state:
            env.reset()
            state_size = int(env.state("world").shape[-1])
        return cls(agents, env.observation_spaces[agents[0]], env.action_spaces[agents[0]], state_size)


def register_envs() -> list[str]:
    """Tells Ray the name "maobs/<id>" of every scenario; may be called again, e.g. after `ray.shutdown()`.

    Returns:
        The names.
    """
    names = {f"maobs/{scenario_id}": entry for scenario_id, entry in SCENARIOS.items()}
    for name, (cls, preset) in names.items():
        register_env(name, partial(_make_scenario_env, cls, preset))
    return list(names)


def _make_scenario_env(cls: type[Any], preset: Mapping[str, Any], context: Mapping[str, Any]) -> MAObsEnv:
    return MAObsEnv({"scenario": cls, **preset, **context})


def make_joint_env(creator: Callable[[Any], Any], context: Any, num_envs: int) -> JointEnv:
    """E copies of what an RLlib environment creator makes.

    Args:
        creator: Function of an `EnvContext` that returns a `MultiAgentEnv` or a `ParallelEnv`.
        context: The `EnvContext` (or dict) to call it with.
        num_envs: E.

    Returns:
        The copies, behind one array interface.

    Raises:
        ValueError: If what the creator returns is not a multi-agent environment with a list of agents.
    """
    env = creator(context)
    if hasattr(env, "make_vec"):
        joint: JointEnv = env.make_vec(num_envs)
        return joint
    return StackedEnv([env, *(creator(context) for _ in range(num_envs - 1))])


class StackedEnv:
    """Copies of a dict-speaking multi-agent environment, stacked to arrays.

    Args:
        envs: The copies: RLlib `MultiAgentEnv`s or PettingZoo `ParallelEnv`s.

    Raises:
        ValueError: If the environment does not list its `possible_agents`.
    """

    def __init__(self, envs: Sequence[Any]) -> None:
        env = envs[0]
        self.num_envs = len(envs)
        self.agents: list[str] = list(getattr(env, "possible_agents", None) or [])
        if not self.agents:
            raise ValueError(
                f"{env} lists no `possible_agents`; legal are RLlib MultiAgentEnvs and PettingZoo ParallelEnvs "
                f"with a fixed team."
            )
        self._envs = list(envs)
        self._steps = np.zeros(self.num_envs, dtype=np.int64)
        self._obs: Float | None = None
        # RLlib calls them get_observation_space(agent), PettingZoo observation_space(agent).
        self.observation_spaces, self.action_spaces = (
            {a: getattr(env, f"get_{which}", None) or getattr(env, which) for a in self.agents}
            for which in ("observation_space", "action_space")
        )
        self.observation_spaces = {a: space(a) for a, space in self.observation_spaces.items()}
        self.action_spaces = {a: space(a) for a, space in self.action_spaces.items()}

    def reset(self, seed: int | Sequence[int] | None = None, mask: Bool | None = None) -> tuple[Float, dict[str, Any]]:
        """Resets all copies, or those where `mask` is true; returns all observations `(E, N, O)`."""
        if isinstance(seed, int):
            seed = [seed + copy for copy in range(self.num_envs)]
        for copy in range(self.num_envs):
            if mask is not None and not mask[copy]:
                continue
            obs, _ = self._envs[copy].reset(seed=None if seed is None else seed[copy])
            rows = self._stack(obs, copy)
            if self._obs is None:
                self._obs = np.zeros((self.num_envs, *rows.shape), dtype=np.float32)
            self._obs[copy] = rows
            self._steps[copy] = 0
        assert self._obs is not None
        return self._obs.copy(), {}

    def step(self, actions: Float) -> StepResult:
        """Steps every copy by its agents' actions `(E, N, A)`."""
        assert self._obs is not None
        rewards = np.zeros(actions.shape[:2], dtype=np.float32)
        terminated, truncated = np.zeros((2, self.num_envs), dtype=np.bool_)
        metrics: dict[str, Float] = {}
        for copy, env in enumerate(self._envs):
            joint = {
                agent: np.asarray(action, dtype=self.action_spaces[agent].dtype)
                for agent, action in zip(self.agents, actions[copy], strict=True)
            }
            obs, reward, terminations, truncations, infos = env.step(joint)
            self._steps[copy] += 1
            self._obs[copy] = self._stack(obs, copy)
            rewards[copy] = [reward[agent] for agent in self.agents]
            terminated[copy] = self._all(terminations)
            truncated[copy] = not terminated[copy] and self._all(
                {a: terminations.get(a) or truncations.get(a) for a in [*self.agents, "__all__"]}
            )
            if terminated[copy] or truncated[copy]:
                for name, value in infos.get(self.agents[0], {}).get("episode_metrics", {}).items():
                    metrics.setdefault(name, np.full(self.num_envs, np.nan, dtype=np.float32))[copy] = value
        return (
            self._obs.copy(),
            rewards,
            terminated,
            truncated,
            {"episode_metrics": metrics} if metrics else {},
        )

    def _all(self, flags: Mapping[str, Any]) -> bool:
        return bool(flags.get("__all__")) or all(flags.get(agent) for agent in self.agents)

    def _stack(self, obs: Mapping[str, Any], copy: int) -> Float:
        if set(obs) != set(self.agents):
            missing, extra = sorted(set(self.agents) - set(obs)), sorted(set(obs) - set(self.agents))
            raise ValueError(
                f"The team changed in environment copy {copy} at step {self._steps[copy]}: missing agents "
                f"{missing}, unexpected agents {extra}. Joint learning needs all of {self.agents} in every "
                f"observation from reset to the end of the episode."
            )
        return np.stack([np.asarray(obs[agent], dtype=np.float32).reshape(-1) for agent in self.agents])

    def state(self, kind: str | None = None) -> Float:
        """The environments' own `state()`, `(E, S)`.

        Raises:
            ValueError: If they have none.
        """
        if not hasattr(self._envs[0], "state"):
            raise ValueError(f'{self._envs[0]} has no state(): use critic_state="observations".')
        return np.stack([np.asarray(env.state(), dtype=np.float32).reshape(-1) for env in self._envs])

    def close(self) -> None:
        """Closes every copy."""
        for env in self._envs:
            env.close()


def snapshot(env: JointEnv) -> bytes | None:
    """An environment in the middle of its episodes as bytes, or None if it cannot be pickled."""
    try:
        return pickle.dumps(env)
    except Exception:
        return None
