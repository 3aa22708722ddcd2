"""Any fixed-team environment as arrays: what the joint runner steps, whoever made the environment.

An environment of this package steps all its copies in one array operation. Any other RLlib `MultiAgentEnv` or
PettingZoo `ParallelEnv` is stepped copy by copy, and its dicts are stacked in the order in which the
environment lists its agents.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import flatdim
from ray.tune.registry import register_env

from rllib_maobs.envs.registry import SCENARIOS
from rllib_maobs.envs.rllib_env import MAObsEnv
from rllib_maobs.envs.team import Bool, Float, Groups, JointEnv, StepResult
from rllib_maobs.layout import Entities, Layout, flat


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
            for agent, space in env.observation_spaces.items()
            if isinstance(space, gym.spaces.Box)
        }
        self.id_layout: Layout = (Entities("agent_id", 1, len(env.agents)),)
        layouts: dict[str, Groups] = {
            agent: flat(flatdim(env.observation_spaces[agent]), "observation") for agent in self.observation_spaces
        }
        known: Mapping[str, Groups | None] = getattr(env, "observation_layouts", None) or {}
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

    Attributes:
        envs: The copies.
        observation_layouts: What each agent's observation is made of, None if the environment does not say.
        state_layout: What its `state()` is made of, None if it does not say.

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
        self.envs = list(envs)
        self._infos: list[Mapping[str, Any]] = [{}] * self.num_envs
        self._steps = np.zeros(self.num_envs, dtype=np.int64)
        self._obs: Float | None = None
        # RLlib calls them get_observation_space(agent), PettingZoo observation_space(agent).
        self.observation_spaces, self.action_spaces = (
            {a: getattr(env, f"get_{which}", None) or getattr(env, which) for a in self.agents}
            for which in ("observation_space", "action_space")
        )
        self.observation_spaces = {a: space(a) for a, space in self.observation_spaces.items()}
        self.action_spaces = {a: space(a) for a, space in self.action_spaces.items()}
        self._size = max(flatdim(space) for space in self.observation_spaces.values())
        self.observation_layouts: Mapping[str, Groups | None] | None = getattr(env, "observation_layouts", None)
        self.state_layout: Groups | None = getattr(env, "state_layout", None)

    def reset(self, seed: int | Sequence[int] | None = None, mask: Bool | None = None) -> tuple[Float, dict[str, Any]]:
        """Resets all copies, or those where `mask` is true; returns all observations `(E, N, O)`."""
        if isinstance(seed, int):
            seed = [seed + copy for copy in range(self.num_envs)]
        for copy in range(self.num_envs):
            if mask is not None and not mask[copy]:
                continue
            obs, infos = self.envs[copy].reset(seed=None if seed is None else seed[copy])
            self._infos[copy] = infos or {}
            rows = self._stack(obs, copy)
            if self._obs is None:
                self._obs = np.zeros((self.num_envs, *rows.shape), dtype=np.float32)
            self._obs[copy] = rows
            self._steps[copy] = 0
        assert self._obs is not None
        return self._obs.copy(), {"infos": list(self._infos)}

    def step(self, actions: Float) -> StepResult:
        """Steps every copy by its agents' actions `(E, N, A)`, or by their numbers `(E, N)`."""
        assert self._obs is not None
        rewards = np.zeros(actions.shape[:2], dtype=np.float32)
        terminated, truncated = np.zeros((2, self.num_envs), dtype=np.bool_)
        metrics: dict[str, Float] = {}
        for copy, env in enumerate(self.envs):
            joint = {
                agent: self._action(self.action_spaces[agent], action)
                for agent, action in zip(self.agents, actions[copy], strict=True)
            }
            obs, reward, terminations, truncations, infos = env.step(joint)
            self._steps[copy] += 1
            self._infos[copy] = infos = infos or {}
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
            {"infos": list(self._infos), **({"episode_metrics": metrics} if metrics else {})},
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
        rows = np.zeros((len(self.agents), self._size), dtype=np.float32)
        for row, agent in zip(rows, self.agents, strict=True):
            own = np.asarray(obs[agent], dtype=np.float32).reshape(-1)
            if own.size != flatdim(self.observation_spaces[agent]):
                raise ValueError(
                    f"The observation of agent {agent!r} has {own.size} numbers in environment copy {copy} at step "
                    f"{self._steps[copy]}; its space is {self.observation_spaces[agent]}."
                )
            row[: own.size] = own
        return rows

    @staticmethod
    def _action(space: gym.Space[Any], action: Any) -> Any:
        """One agent's action as its space has it: without padding, or with the number its numbers start from."""
        if isinstance(space, gym.spaces.Discrete):
            return int(action + space.start)
        return np.asarray(action[: flatdim(space)], dtype=space.dtype)

    def state(self, kind: str | None = None) -> Float:
        """The environments' own `state()`, `(E, S)`.

        Raises:
            ValueError: If they have none.
        """
        if not hasattr(self.envs[0], "state"):
            raise ValueError(f'{self.envs[0]} has no state(): use critic_state="observations".')
        return np.stack([np.asarray(env.state(), dtype=np.float32).reshape(-1) for env in self.envs])

    def close(self) -> None:
        """Closes every copy."""
        for env in self.envs:
            env.close()


def snapshot(env: JointEnv) -> bytes | None:
    """An environment in the middle of its episodes as bytes, or None if it cannot be pickled."""
    try:
        return pickle.dumps(env)
    except Exception:
        return None
