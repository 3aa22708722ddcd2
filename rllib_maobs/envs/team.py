"""What the learning side must know of an environment: its arrays, its agents and their spaces."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.spaces import flatdim
from numpy.typing import NDArray

from rllib_maobs.layout import Layout, as_layout, flat, layout_size

Float = NDArray[np.float32]
Bool = NDArray[np.bool_]
StepResult = tuple[Float, Float, Bool, Bool, dict[str, Any]]
Groups = Iterable[Iterable[Any]]  # what `as_layout` makes a layout of
# Of rewards that are called equal, relative to their size: sums taken in another order differ.
REWARD_TOLERANCE = 1e-5


class JointEnv(Protocol):
    """E copies of one environment with a fixed team of N agents, stepped together; `VectorEnv` is one.

    It may say more: `observation_layouts` (by agent) and `state_layout`, what observations and the state are made of,
    and `shared_reward`, whether all agents always get the same reward.
    """

    num_envs: int
    agents: list[str]
    observation_spaces: dict[str, gym.Space[Any]]
    action_spaces: dict[str, gym.Space[Any]]

    def reset(self, seed: int | Sequence[int] | None = None, mask: Bool | None = None) -> tuple[Float, dict[str, Any]]:
        """Resets all copies (or those of `mask`) and returns all observations `(E, N, O)`."""

    def step(self, actions: Float) -> StepResult:
        """Steps all copies by `(E, N, A)`, or by the numbers `(E, N)` of discrete actions.

        Returns observations, rewards `(E, N)`, terminated, truncated `(E,)`, info. Where agents end differently,
        terminated says it of each, `(E, N)`, and truncated whether a time limit ended the episode for the others.
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
        agents: Agent ids in the order of every N axis, whatever order an environment lists them in: that of their
            names ("agent_2" before "agent_10"), which is the same in every process. An environment that says what
            its state is made of keeps its own order: that layout names agents by their places.
        observation_spaces: Every agent's observation space.
        action_spaces: Every agent's action space: all bounded vectors, or all Discrete.
        observation_layouts: What every agent's observation is made of; one group "observation" where that is unknown.
        state_layout: What `state("world")` is made of; one group "state" if that is unknown, None if it was not asked
            for.
    """

    agents: tuple[str, ...]
    observation_spaces: tuple[gym.spaces.Box, ...]
    action_spaces: tuple[gym.spaces.Box, ...] | tuple[gym.spaces.Discrete, ...]
    observation_layouts: tuple[Layout, ...]
    state_layout: Layout | None

    @property
    def state_size(self) -> int:
        """S of `state("world")`, 0 if it was not asked for."""
        return 0 if self.state_layout is None else layout_size(self.state_layout)

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

    def ordered(self, agents: Sequence[str]) -> Team:
        """The same team in the order of `agents`, which are the same ids."""
        order = [self.agents.index(agent) for agent in agents]
        permuted: dict[str, Any] = {
            name: tuple(getattr(self, name)[i] for i in order)
            for name in ("agents", "observation_spaces", "action_spaces", "observation_layouts")
        }
        return replace(self, **permuted)

    def check(self, env: JointEnv, name: str) -> None:
        """Checks that an environment is one of this team's, though it may list its agents in another order.

        Args:
            env: The environment.
            name: What to call it.

        Raises:
            ValueError: If its agents are others, or have other spaces.
        """
        if set(env.agents) != set(self.agents):
            raise ValueError(
                f"The agents of {name} are {sorted(env.agents)}, but the team is {sorted(self.agents)}: legal is the "
                f"same set of agents, in any order, in every runner, in evaluation and after a restore."
            )
        for agent in self.agents:
            observation, action = self.spaces(agent)
            seen, acted = env.observation_spaces[agent], env.action_spaces[agent]
            if seen.shape != observation.shape or acted != action:
                raise ValueError(
                    f"The spaces of agent {agent!r} in {name} are {seen} and {acted}, but in the team {observation} "
                    f"and {action}: legal are observations of the same size and the same actions."
                )

    @classmethod
    def of(
        cls,
        env: JointEnv,
        *,
        with_state: bool,
        observation_layouts: Mapping[str, Groups] | None = None,
        state_layout: Groups | None = None,
    ) -> Team:
        """Inspects an environment.

        Args:
            env: The environment.
            with_state: Whether its own state is needed (`critic_state="world"`); then it is reset once.
            observation_layouts: What observations of some or all agents are made of, by id, instead of what the
                environment says; without agent ids, which are not the environment's own.
            state_layout: What the state is made of, instead of what the environment says.

        Raises:
            ValueError: If spaces are not vectors, or actions unbounded or of both kinds, or a layout is not legal, does
                not add up or belongs to no agent; says which and what is legal.
        """
        agents = tuple(env.agents)
        if state_layout is None and getattr(env, "state_layout", None) is None:
            agents = tuple(sorted(agents, key=_by_name))
        for agent in agents:
            space = env.observation_spaces[agent]
            if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
                raise ValueError(
                    f"The observation space of agent {agent!r} is {space}; legal are one-dimensional Box spaces: "
                    f"flatten it in the environment."
                )
        actions = tuple(env.action_spaces[agent] for agent in agents)
        for agent, space in zip(agents, actions, strict=True):
            box = isinstance(space, gym.spaces.Box) and len(space.shape) == 1 and space.shape[0] > 0
            if not (box and space.dtype.kind in "iuf") and not isinstance(space, gym.spaces.Discrete):
                raise ValueError(
                    f"The action space of agent {agent!r} is {space}; legal are Box of one dimension, of integers or "
                    f"floats, and Discrete."
                )
            if type(space) is not type(actions[0]):
                raise ValueError(
                    f"The actions of agents {agents[0]!r} and {agent!r} must both be Box or both Discrete, but are "
                    f"{actions[0]} and {space}."
                )
            if isinstance(space, gym.spaces.Box) and not _can_be_scaled_to(space):
                raise ValueError(
                    f"The action space of agent {agent!r} is unbounded: {space}; the actor's tanh needs finite bounds "
                    f"to scale to, whose distance is finite in their type (of integers, bounds within 2**53)."
                )
        observations = tuple(env.observation_spaces[agent] for agent in agents)
        layouts: dict[str, Groups | None] = dict(layouts_of(env))
        ids: Layout = getattr(env, "id_layout", ())
        for agent, own in (observation_layouts or {}).items():
            layouts[agent] = (*ids, *own) if isinstance(own, Iterable) else own
        if unknown := [agent for agent in layouts if agent not in agents]:
            raise ValueError(f"There are observation layouts of {unknown}; legal are those of the agents {[*agents]}.")
        return cls(
            agents,
            observations,
            actions,
            tuple(
                _layout(layouts.get(agent), "observation", int(space.shape[0]), f" of agent {agent!r}")
                for agent, space in zip(agents, observations, strict=True)
            ),
            _state_layout(env, state_layout) if with_state else None,
        )


def layouts_of(env: Any) -> Mapping[str, Groups | None]:
    """What an environment says its observations are made of, by agent; empty if it does not say."""
    layouts = getattr(env, "observation_layouts", None)
    layouts = {} if layouts is None else layouts
    if not isinstance(layouts, Mapping):
        raise ValueError(f"An environment's observation_layouts must be a dict by agent, not {layouts!r}.")
    return layouts


def _by_name(agent: str) -> tuple[list[str | int], str]:
    """What names are sorted by: numbers in them count as numbers."""
    parts = re.split(r"(\d+)", str(agent))
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], str(agent)


def _can_be_scaled_to(space: gym.spaces.Box) -> bool:
    """Whether there are bounds, between which arithmetic does not overflow."""
    if not space.is_bounded("both"):
        return False
    if np.issubdtype(space.dtype, np.integer):
        return bool((space.low >= -(2.0**53)).all() and (space.high <= 2.0**53).all())
    with np.errstate(over="ignore"):
        return bool(np.isfinite(space.high - space.low).all())


def _state_layout(env: JointEnv, given: Groups | None) -> Layout:
    """Resets the environment, and returns what its own state is made of: as given, or else as it says."""
    env.reset()
    size = int(env.state("world").shape[-1])
    return _layout(getattr(env, "state_layout", None) if given is None else given, "state", size)


def _layout(groups: Groups | None, what: str, size: int, owner: str = "") -> Layout:
    return flat(size, what) if groups is None else as_layout(groups, size, f"{what}{owner}")


def finished(terminated: Bool, truncated: Bool) -> Bool:
    """Which episodes are over, `(...)`: terminated for all agents `(..., N)`, or truncated `(...)` for some."""
    return truncated | (terminated if terminated.ndim == truncated.ndim else terminated.all(-1))


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
        actions = np.zeros((env.num_envs, len(spaces), size))
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
        if (over := finished(terminated, truncated)).any():
            env.reset(mask=over)
    return True
