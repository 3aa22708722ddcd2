"""What is put around joint environments: another order of the agents, and their numbers in what they observe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import flatdim

from rllib_maobs.envs.team import Bool, Float, Groups, JointEnv, StepResult, layouts_of
from rllib_maobs.layout import Entities, Layout, flat


class InOrder:
    """An environment whose agents stand in another order in all arrays.

    Args:
        env: The environment.
        agents: Its agents, in the new order.
    """

    def __init__(self, env: JointEnv, agents: Sequence[str]) -> None:
        self._env = env
        self.num_envs, self.agents = env.num_envs, list(agents)
        self.observation_spaces, self.action_spaces = env.observation_spaces, env.action_spaces
        for name in ("observation_layouts", "state_layout", "shared_reward"):
            setattr(self, name, getattr(env, name, None))
        self._ours = [env.agents.index(agent) for agent in agents]
        self._theirs = [self.agents.index(agent) for agent in env.agents]
        self._row = _row_of_agents(getattr(env, "state_layout", None), len(self.agents))

    def reset(self, seed: int | Sequence[int] | None = None, mask: Bool | None = None) -> tuple[Float, dict[str, Any]]:
        """Resets all copies, or those of `mask`."""
        obs, info = self._env.reset(seed=seed, mask=mask)
        return obs[:, self._ours], info

    def step(self, actions: Float) -> StepResult:
        """Steps every copy."""
        obs, rewards, terminated, truncated, info = self._env.step(actions[:, self._theirs])
        terminated = terminated if terminated.ndim == 1 else terminated[:, self._ours]
        return obs[:, self._ours], rewards[:, self._ours], terminated, truncated, info

    def state(self, kind: str | None = None) -> Float:
        """The environment's own state `(E, S)`; where its layout begins with the agents, their rows in this order."""
        state = self._env.state(kind)
        if self._row == 0:
            return state
        end = len(self.agents) * self._row
        rows = state[:, :end].reshape(len(state), -1, self._row)[:, self._ours]
        return np.concatenate([rows.reshape(len(state), -1), state[:, end:]], axis=1)

    def close(self) -> None:
        """Closes every copy."""
        self._env.close()

    @property
    def unwrapped(self) -> JointEnv:
        """The environment in its own order."""
        return self._env


def _row_of_agents(layout: Groups | None, num_agents: int) -> int:
    """How many numbers each agent has at the start of a state; 0 if its layout does not begin with the agents."""
    found, sizes = 0, set()
    for _, count, size, *_ in layout or ():
        if found < num_agents:
            found += count
            sizes.add(size)
    return sizes.pop() if found == num_agents and len(sizes) == 1 else 0


class WithAgentIds:
    """An environment whose observations begin with the agent's number as a one-hot vector.

    Attributes:
        id_layout: What stands in front of each observation: the group "agent_id".
        observation_layouts: What each agent's observation is made of, `id_layout` included.
        state_layout: What the environment's own state is made of, None if it does not say.

    Args:
        env: The environment.
    """

    def __init__(self, env: JointEnv) -> None:
        self._env = env
        self.num_envs, self.agents, self.action_spaces = env.num_envs, env.agents, env.action_spaces
        self.shared_reward: bool | None = getattr(env, "shared_reward", None)
        zeros, ones = np.zeros(len(env.agents), np.float32), np.ones(len(env.agents), np.float32)
        self.observation_spaces: dict[str, gym.Space[Any]] = {
            agent: gym.spaces.Box(np.append(zeros, space.low), np.append(ones, space.high), dtype=np.float32)
            if isinstance(space, gym.spaces.Box) and len(space.shape) == 1
            else space  # not legal: `Team.of` says so
            for agent, space in env.observation_spaces.items()
        }
        self.id_layout: Layout = (Entities("agent_id", 1, len(env.agents)),)
        layouts: dict[str, Groups] = {
            agent: flat(flatdim(env.observation_spaces[agent]), "observation") for agent in self.observation_spaces
        }
        known = layouts_of(env)
        layouts.update({agent: layout for agent, layout in known.items() if layout is not None})
        self.observation_layouts = {agent: (*self.id_layout, *layout) for agent, layout in layouts.items()}
        self.state_layout: Groups | None = getattr(env, "state_layout", None)
        self._ids = np.broadcast_to(np.eye(len(env.agents), dtype=np.float32), (env.num_envs, *[len(env.agents)] * 2))

    def _with_ids(self, obs: Float) -> Float:
        return np.concatenate([self._ids, obs], axis=-1)

    def reset(self, seed: int | Sequence[int] | None = None, mask: Bool | None = None) -> tuple[Float, dict[str, Any]]:
        """Resets all copies, or those of `mask`."""
        obs, info = self._env.reset(seed=seed, mask=mask)
        return self._with_ids(obs), info

    def step(self, actions: Float) -> StepResult:
        """Steps every copy."""
        obs, *rest = self._env.step(actions)
        return self._with_ids(obs), *rest  # type: ignore[return-value]

    def state(self, kind: str | None = None) -> Float:
        """The environment's own state `(E, S)`."""
        return self._env.state(kind)

    def close(self) -> None:
        """Closes every copy."""
        self._env.close()

    @property
    def unwrapped(self) -> JointEnv:
        """The environment without what is put around it."""
        inner: JointEnv = getattr(self._env, "unwrapped", self._env)
        return inner
