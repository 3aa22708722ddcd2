"""What the learning side must know of an environment: its arrays, its agents and their spaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.spaces import flatdim
from numpy.typing import NDArray

Float = NDArray[np.float32]
Bool = NDArray[np.bool_]
StepResult = tuple[Float, Float, Bool, Bool, dict[str, Any]]
# Of rewards that are called equal, relative to their size: sums taken in another order differ.
REWARD_TOLERANCE = 1e-5


class JointEnv(Protocol):
    """E copies of one environment with a fixed team of N agents, stepped together; `VectorEnv` is one."""

    num_envs: int
    agents: list[str]
    observation_spaces: dict[str, gym.Space[Any]]
    action_spaces: dict[str, gym.Space[Any]]

    def reset(self, seed: int | Sequence[int] | None = None, mask: Bool | None = None) -> tuple[Float, dict[str, Any]]:
        """Resets all copies (or those of `mask`) and returns all observations `(E, N, O)`."""

    def step(self, actions: Float) -> StepResult:
        """Steps all copies by `(E, N, A)`, or by the numbers `(E, N)` of discrete actions.

        Returns observations, rewards `(E, N)`, terminated, truncated `(E,)`, info.
        """

    def state(self, kind: str | None = None) -> Float:
        """The state `(E, S)`."""

    def close(self) -> None:
        """Frees what the environment holds."""


@dataclass(frozen=True)
class Team:
    """What the learning side must know of an environment.

    Agents may differ: shorter observations and actions are padded with zeros at their ends, so that all agents'
    fit into arrays `(..., N, O)` and `(..., N, A)`. A discrete action is a one-hot vector in those arrays.

    Attributes:
        agents: Agent ids in the environment's order: the order of every N axis.
        observation_spaces: Every agent's observation space.
        action_spaces: Every agent's action space: all bounded vectors, or all Discrete.
        state_size: S of `state("world")`, 0 if it was not asked for.
    """

    agents: tuple[str, ...]
    observation_spaces: tuple[gym.spaces.Box, ...]
    action_spaces: tuple[gym.spaces.Box, ...] | tuple[gym.spaces.Discrete, ...]
    state_size: int

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        """Length of every agent's own observation."""
        return tuple(int(space.shape[0]) for space in self.observation_spaces)

    @property
    def observation_size(self) -> int:
        """O, that of the longest."""
        return max(self.observation_sizes)

    @property
    def action_sizes(self) -> tuple[int, ...]:
        """Length of every agent's own action, or the number of its discrete actions."""
        return tuple(
            int(space.n) if isinstance(space, gym.spaces.Discrete) else int(space.shape[0])
            for space in self.action_spaces
        )

    @property
    def action_size(self) -> int:
        """A, that of the longest."""
        return max(self.action_sizes)

    @property
    def discrete(self) -> bool:
        """Whether actions are discrete."""
        return isinstance(self.action_spaces[0], gym.spaces.Discrete)

    @property
    def action_mask(self) -> Bool:
        """What of the padded actions is not padding, `(N, A)`."""
        return np.arange(self.action_size) < np.array(self.action_sizes)[:, None]

    def spaces(self, agent: str) -> tuple[gym.spaces.Box, gym.spaces.Space[Any]]:
        """One agent's spaces."""
        index = self.agents.index(agent)
        return self.observation_spaces[index], self.action_spaces[index]

    @classmethod
    def of(cls, env: JointEnv, *, with_state: bool) -> Team:
        """Inspects an environment.

        Args:
            env: The environment.
            with_state: Whether its own state is needed (`critic_state="world"`); then it is reset once.

        Raises:
            ValueError: If spaces are not vectors, or actions unbounded or of both kinds; says which and what is legal.
        """
        agents = tuple(env.agents)
        for agent in agents:
            space = env.observation_spaces[agent]
            if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
                raise ValueError(
                    f"The observation space of agent {agent!r} is {space}; legal are one-dimensional Box spaces: "
                    f"flatten it in the environment."
                )
        actions = tuple(env.action_spaces[agent] for agent in agents)
        for agent, space in zip(agents, actions, strict=True):
            box = isinstance(space, gym.spaces.Box) and len(space.shape) == 1
            if not box and not isinstance(space, gym.spaces.Discrete):
                raise ValueError(
                    f"The action space of agent {agent!r} is {space}; legal are Box of one dimension and Discrete."
                )
            if type(space) is not type(actions[0]):
                raise ValueError(
                    f"The actions of agents {agents[0]!r} and {agent!r} must both be Box or both Discrete, but are "
                    f"{actions[0]} and {space}."
                )
            if isinstance(space, gym.spaces.Box) and not space.is_bounded("both"):
                raise ValueError(
                    f"The action space of agent {agent!r} is unbounded: {space}; the actor's tanh needs "
                    f"finite bounds to scale to."
                )
        state_size = 0
        if with_state:
            env.reset()
            state_size = int(env.state("world").shape[-1])
        return cls(agents, tuple(env.observation_spaces[agent] for agent in agents), actions, state_size)


def shares_reward(env: JointEnv, steps: int = 25) -> bool:
    """Whether all agents always get the same reward: what the environment says, or else what random steps show.

    Args:
        env: The environment; one that has an attribute `shared_reward` other than None is asked and not stepped.
        steps: How many steps to look at.
    """
    declared = getattr(env, "shared_reward", None)
    if declared is not None:
        return bool(declared)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    spaces = [env.action_spaces[agent] for agent in env.agents]
    size = max(flatdim(space) for space in spaces)
    for _ in range(steps):
        actions = np.zeros((env.num_envs, len(spaces), size), dtype=np.float32)
        for agent, space in enumerate(spaces):
            if isinstance(space, gym.spaces.Discrete):
                actions[:, agent, 0] = rng.integers(space.n, size=env.num_envs)
            else:
                shape = (env.num_envs, *space.shape)
                actions[:, agent, : space.shape[0]] = rng.uniform(space.low, space.high, shape)
        discrete = isinstance(spaces[0], gym.spaces.Discrete)
        _, rewards, terminated, truncated, _ = env.step(actions[..., 0].astype(np.int64) if discrete else actions)
        if np.ptp(rewards, axis=1).max() > REWARD_TOLERANCE * max(1.0, float(np.abs(rewards).max())):
            return False
        if (terminated | truncated).any():
            env.reset(mask=terminated | truncated)
    return True
