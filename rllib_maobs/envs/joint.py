"""Any fixed-team environment as arrays: what the joint runner steps, whoever made the environment.

An environment of this package steps all its copies in one array operation. Any other RLlib `MultiAgentEnv` or
PettingZoo `ParallelEnv` is stepped copy by copy, and its dicts are stacked in the order in which the
environment lists its agents.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from copy import deepcopy
from functools import partial
from inspect import signature
from typing import Any
from weakref import WeakValueDictionary

import gymnasium as gym
import numpy as np
from gymnasium.spaces import flatdim
from ray.rllib.env.env_context import EnvContext
from ray.tune.registry import register_env

from rllib_maobs.envs.registry import SCENARIOS
from rllib_maobs.envs.rllib_env import MAObsEnv
from rllib_maobs.envs.team import Bool, Float, Groups, JointEnv, StepResult
from rllib_maobs.envs.time_limit import time_limit
from rllib_maobs.options import as_list


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


def make_joint_env(creator: Callable[[Any], Any], context: Mapping[str, Any], num_envs: int) -> JointEnv:
    """E copies of what an RLlib environment creator makes.

    Every copy is made from a deep copy of the context of its own, with its `vector_index`.

    Args:
        creator: Function of an `EnvContext` that returns a `MultiAgentEnv` or a `ParallelEnv`.
        context: The `EnvContext` (or dict) to call it with.
        num_envs: E.

    Returns:
        The copies, behind one array interface.

    Raises:
        ValueError: If what the creator returns is not a multi-agent environment with a list of agents, or the same
            object twice.
    """
    try:
        signature(creator).bind(context)
    except TypeError as error:
        name = getattr(creator, "__name__", creator)
        raise ValueError(
            f"{name} can't be called with env_config ({error}): legal is a class whose constructor takes it, or what "
            f'tune.register_env("my_env", lambda config: {name}()) has registered.'
        ) from None
    except ValueError:  # it has no signature
        pass
    env = creator(_own_context(context, 0))
    if hasattr(env, "make_vec"):
        joint: JointEnv = env.make_vec(num_envs)
        return joint
    envs = [env, *(creator(_own_context(context, copy)) for copy in range(1, num_envs))]
    for copy, one in enumerate(envs):
        same = [_innermost(other) is _innermost(one) for other in envs[:copy]]
        if any(same):
            shared = f"copies {same.index(True)} and {copy} of {_name_of(env)} are"
        elif id(_innermost(one)) in _stepped:
            shared = f"copy {copy} of {_name_of(env)} and one of another runner (of evaluation, or not stopped) are"
        else:
            continue
        raise ValueError(f"Environment {shared} one object: the environment's creator must return a new one each time.")
    stacked = StackedEnv(envs)
    _stepped.update({id(_innermost(one)): stacked for one in envs})
    return stacked


# Which environment objects of this process are being stepped, by id, and by whom.
_stepped: WeakValueDictionary[int, StackedEnv] = WeakValueDictionary()


def make_copy(creator: Callable[[Any], Any], context: Mapping[str, Any], copy: int) -> Any:
    """One copy of what an environment creator makes, as `make_joint_env` makes them."""
    return creator(_own_context(context, copy))


def _own_context(context: Mapping[str, Any], copy: int) -> Any:
    """What one copy is made from: whatever its constructor does to it, the others do not see."""
    own: Any = deepcopy(context)
    if isinstance(own, EnvContext):
        own.vector_index = copy
    return own


def _innermost(env: Any) -> Any:
    """The environment inside of wrappers, of PettingZoo's, RLlib's and Gymnasium's kind."""
    for name in ("env", "par_env", "aec_env"):
        inner = getattr(env, name, None)
        if hasattr(inner, "reset") and hasattr(inner, "step"):
            return _innermost(inner)
    return env


def _name_of(env: Any) -> str:
    """What messages call a dict-speaking environment: its class, inside of wrappers."""
    return type(_innermost(env)).__name__


class StackedEnv:
    """Copies of a dict-speaking multi-agent environment, stacked to arrays.

    What they return is checked at every step. Whether an agent was terminated or truncated its own flag says; those
    without one follow `__all__`. An environment that empties its list `agents` has ended its episode, too: agents
    without any flag were truncated then.

    Attributes:
        observation_layouts: What each agent's observation is made of, None if the environment does not say.
        state_layout: What its `state()` is made of, None if it does not say.
        timeout_s: Seconds that one step or reset of one copy may take; None for no limit.
        isolates: Whether an error in one copy's step is no error of the others': they step, and it is in the info.

    Args:
        envs: The copies: RLlib `MultiAgentEnv`s or PettingZoo `ParallelEnv`s.

    Raises:
        ValueError: If the environment does not list its `possible_agents`, is not parallel, or has no seeded reset.
    """

    timeout_s: float | None = None
    isolates: bool = False

    def __init__(self, envs: Sequence[Any]) -> None:
        env = envs[0]
        self.num_envs = len(envs)
        self._name = _name_of(env)
        if hasattr(env, "agent_iter"):
            raise ValueError(
                f"{self._name} is an AEC environment, whose agents act in turns; legal are RLlib MultiAgentEnvs and "
                f"PettingZoo ParallelEnvs: use its parallel_env(), or pettingzoo.utils.aec_to_parallel(env)."
            )
        self.agents: list[str] = as_list(getattr(env, "possible_agents", None)) or []
        if not self.agents or not all(isinstance(agent, Hashable) for agent in self.agents):
            raise ValueError(
                f"{env} lists no `possible_agents`; legal are RLlib MultiAgentEnvs and PettingZoo ParallelEnvs "
                f"with a fixed team."
            )
        if len(set(self.agents)) < len(self.agents) or "__all__" in self.agents:
            raise ValueError(
                f"The agents of {self._name} are {self.agents}; legal are different names, none of them '__all__'."
            )
        try:
            signature(env.reset).bind(seed=0)
        except TypeError as error:
            raise ValueError(f"{self._name}.reset() takes no seed ({error}); legal: reset(seed=None).") from None
        self._envs = list(envs)
        self._infos: list[Mapping[str, Any]] = [{}] * self.num_envs
        self._flagged = {*self.agents, "__all__"}
        self._state_size = 0
        self._steps = np.zeros(self.num_envs, dtype=np.int64)
        self._listed = np.zeros(self.num_envs, dtype=np.bool_)  # which ones say in `agents` who is there
        self._obs: Float | None = None
        # RLlib calls them get_observation_space(agent), PettingZoo observation_space(agent).
        self.observation_spaces, self.action_spaces = self._spaces(env)
        for copy, other in enumerate(envs):
            self._check_alike(copy, other)
        self._sizes = {a: int(np.prod(space.shape or ())) for a, space in self.observation_spaces.items()}
        self._size = max(self._sizes.values())
        self.observation_layouts: Mapping[str, Groups | None] | None = getattr(env, "observation_layouts", None)
        self.state_layout: Groups | None = getattr(env, "state_layout", None)

    def _check_alike(self, copy: int, env: Any) -> None:
        """Raises a ValueError if a copy has other agents or spaces than the first one."""
        if set(theirs := list(env.possible_agents)) != set(self.agents):
            raise ValueError(
                f"The agents of {self._name} are {self.agents} in copy 0, but {theirs} in copy {copy}: legal is "
                f"the same set of agents in all copies."
            )
        if (spaces := self._spaces(env)) != (self.observation_spaces, self.action_spaces):
            raise ValueError(
                f"The spaces of {self._name} are {self.observation_spaces}, {self.action_spaces} in copy 0, but "
                f"{spaces[0]}, {spaces[1]} in copy {copy}: legal are the same ones in all copies."
            )

    def replace(self, copy: int, env: Any) -> None:
        """Takes another environment in the place of a copy; it is to be reset before it is stepped.

        Raises:
            ValueError: If it is stepped already, or differs from the other copies.
        """
        if id(_innermost(env)) in _stepped:
            raise ValueError(
                f"The new copy {copy} of {self._name} and one that is stepped are one object: the environment's "
                f"creator must return a new one each time."
            )
        self._check_alike(copy, env)
        _stepped.pop(id(_innermost(self._envs[copy])), None)
        _stepped[id(_innermost(env))] = self
        self._envs[copy] = env

    def _spaces(self, env: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Each agent's spaces of observations and of actions."""
        spaces: list[dict[str, Any]] = []
        for which in ("observation_space", "action_space"):
            try:
                space_of = getattr(env, f"get_{which}", None) or getattr(env, which)
                spaces.append({agent: space_of(agent) for agent in self.agents})
            except (AttributeError, LookupError, TypeError) as error:
                raise ValueError(
                    f"{self._name} has no {which} for each of {self.agents} ({type(error).__name__}: {error}); legal "
                    f"are a method {which}(agent), or RLlib's dict {which}s."
                ) from error
            if unknown := [agent for agent, space in spaces[-1].items() if not isinstance(space, gym.Space)]:
                raise ValueError(
                    f"{self._name}: {which} of agent {unknown[0]!r} is {spaces[-1][unknown[0]]!r}; legal is a space of "
                    f"gymnasium."
                )
        return spaces[0], spaces[1]

    def reset(self, seed: int | Sequence[int] | None = None, mask: Bool | None = None) -> tuple[Float, dict[str, Any]]:
        """Resets all copies, or those where `mask` is true; returns all observations `(E, N, O)`.

        Raises:
            ValueError: If `reset` does not take a seed, or what it returns is not legal; names copy and agent.
        """
        if isinstance(seed, int):
            seed = [seed + copy for copy in range(self.num_envs)]
        for copy in range(self.num_envs):
            if mask is not None and not mask[copy]:
                continue
            self._steps[copy] = 0
            result = self._call(copy, "reset", seed=None if seed is None else seed[copy])
            if not _are(result, (Mapping, Mapping | None)):
                raise self._error(copy, f"reset() returns {_kinds(result)}", "two dicts by agent: observations, infos")
            self._infos[copy] = self._infos_of(result[1], copy)
            rows = self._stack(result[0], copy)
            if self._obs is None:
                self._obs = np.zeros((self.num_envs, *rows.shape), dtype=np.float32)
            self._obs[copy] = rows
            self._listed[copy] = bool(getattr(self._envs[copy], "agents", None))
        assert self._obs is not None
        return self._obs.copy(), {"infos": list(self._infos)}

    @property
    def envs(self) -> list[Any]:
        """The copies, as callbacks know them: `env.envs[env_index]`."""
        return self._envs

    def step(self, actions: Float) -> StepResult:
        """Steps every copy by its agents' actions `(E, N, A)`, or by their numbers `(E, N)`.

        Returns:
            As `JointEnv.step`, terminated `(E, N)`. If `isolates`, the info has under "failed" the errors of copies:
            their rewards are 0, and they are to be replaced and reset.

        Raises:
            ValueError: If what it returns is not legal, or some agents end before the others; names copy, step and
                agent.
        """
        assert self._obs is not None
        rewards = np.zeros(actions.shape[:2], dtype=np.float32)
        terminated = np.zeros(actions.shape[:2], dtype=np.bool_)
        truncated = np.zeros(self.num_envs, dtype=np.bool_)
        metrics: dict[str, Float] = {}
        failed: dict[int, Exception] = {}
        for copy in range(self.num_envs):
            try:
                rewards[copy], over = self._step_copy(copy, actions[copy])
                if over is not None:
                    terminated[copy] = over
                    truncated[copy] = not over.all()
                    for name, value in self._metrics_of(self._infos[copy], copy).items():
                        metrics.setdefault(name, np.full(self.num_envs, np.nan, dtype=np.float32))[copy] = value
            except Exception as error:
                if not self.isolates:
                    raise
                failed[copy] = error
                rewards[copy], terminated[copy], truncated[copy] = 0.0, False, False
        return (
            self._obs.copy(),
            rewards,
            terminated,
            truncated,
            {
                "infos": list(self._infos),
                **({"episode_metrics": metrics} if metrics else {}),
                **({"failed": failed} if failed else {}),
            },
        )

    def _step_copy(self, copy: int, actions: Float) -> tuple[list[float], Bool | None]:
        """Steps one copy by its agents' actions; returns their rewards, and who terminated if its episode is over."""
        assert self._obs is not None
        env = self._envs[copy]
        joint = {
            agent: self._action(self.action_spaces[agent], action)
            for agent, action in zip(self.agents, actions, strict=True)
        }
        result = env.step(joint) if self.timeout_s is None else self._call(copy, "step", joint)
        self._steps[copy] += 1
        if not _are(result, (*[Mapping] * 4, Mapping | None)):
            legal = "five dicts by agent: observations, rewards, terminated, truncated, infos"
            raise self._error(copy, f"step() returns {_kinds(result)}", legal)
        obs, reward, terminations, truncations, infos = result
        self._infos[copy] = self._infos_of(infos, copy)
        self._obs[copy] = self._stack(obs, copy)
        return self._rewards(reward, copy), self._flags(terminations, truncations, copy)

    def _call(self, copy: int, method: str, *args: Any, **how: Any) -> Any:
        """What a copy's method returns, if it does in time."""
        call = getattr(self._envs[copy], method)
        if self.timeout_s is None:
            return call(*args, **how)
        where = f"environment copy {copy} at step {self._steps[copy]} of its episode"
        with time_limit(
            self.timeout_s,
            lambda: f"{self._name}: {method}() takes longer than env_timeout_s={self.timeout_s:g} s in {where}.",
        ):
            return call(*args, **how)

    def _error(self, copy: int, what: str, legal: str) -> ValueError:
        where = f"environment copy {copy} at step {self._steps[copy]} of its episode"
        return ValueError(f"{self._name}: {what} in {where}; legal: {legal}.")

    def _flags(self, terminations: Mapping[str, Any], truncations: Mapping[str, Any], copy: int) -> Bool | None:
        """Which agents terminated `(N,)` if the episode is over (the others were truncated), or None if it goes on."""
        for flags in (terminations, truncations):
            for name, flag in flags.items():
                if name not in self._flagged or not (
                    flag is None or (isinstance(flag, bool | np.bool_ | int | np.integer) and flag in (0, 1))
                ):
                    legal = "True or False for each agent, and for '__all__'"
                    raise self._error(copy, f"the termination or truncation of {name!r} is {flag!r}", legal)
        terminated, truncated = (
            np.array([bool(flags.get(agent)) for agent in self.agents]) for flags in (terminations, truncations)
        )
        ended, everybody = terminated | truncated, bool(terminations.get("__all__"))
        emptied = self._listed[copy] and not self._envs[copy].agents
        if ended.all() or everybody or truncations.get("__all__") or emptied:
            return terminated | (everybody & ~truncated)
        if ended.any():
            gone = [agent for agent, over in zip(self.agents, ended, strict=True) if over]
            raise self._error(copy, f"the team changed: {gone} ended, others go on", "agents that end in the same step")
        return None

    def _infos_of(self, infos: Mapping[str, Any] | None, copy: int) -> Mapping[str, Any]:
        """Infos by agent; None is taken as empty: it says nothing."""
        for agent, info in (infos or {}).items():
            if not isinstance(info, Mapping | None):
                raise self._error(copy, f"the info of {agent!r} is {info!r}", "a dict, or None")
        return infos or {}

    def _metrics_of(self, infos: Mapping[str, Any], copy: int) -> dict[str, float]:
        """What an episode's last infos say of it under "episode_metrics", whichever agent's have it."""
        metrics: dict[str, float] = {}
        for agent, info in infos.items():
            given = (info or {}).get("episode_metrics")
            given = {} if given is None else given
            try:
                metrics |= {name: float(_numbers(value).item()) for name, value in given.items()}
            except (AttributeError, TypeError, ValueError):
                what = f"episode_metrics in the info of {agent!r} are {given!r}"
                raise self._error(copy, what, "a dict of single numbers by name") from None
        return metrics

    def _rewards(self, reward: Mapping[str, Any], copy: int) -> list[float]:
        """Every agent's reward."""
        if unknown := reward.keys() - self._flagged:
            raise self._error(copy, f"there are rewards of {sorted(map(str, unknown))}", f"those of {self.agents}")
        row = []
        for agent in self.agents:
            value: Any = reward.get(agent, "missing")
            if type(value) is not float:  # the rest need a closer look
                try:
                    array = np.asarray(value)
                except (ValueError, RuntimeError):  # lists of unequal lengths, tensors with gradients
                    array = np.array(None)
                # True is none either: flags in the place of rewards would be believed.
                if array.ndim or array.dtype.kind not in "iuf":
                    what = f"the reward of agent {agent!r} is {value!r}"
                    raise self._error(copy, what, "one number for each agent")
                value = float(array)
            row.append(value)
        return row

    def _stack(self, obs: Mapping[str, Any], copy: int) -> Float:
        if set(obs) != set(self.agents):
            missing, extra = (sorted(gone, key=str) for gone in ({*self.agents} - {*obs}, {*obs} - {*self.agents}))
            raise ValueError(
                f"{self._name}: the team changed in environment copy {copy} at step {self._steps[copy]}: missing "
                f"agents {missing}, unexpected agents {extra}. Joint learning needs all of {self.agents} in every "
                f"observation from reset to the end of the episode."
            )
        rows = np.zeros((len(self.agents), self._size), dtype=np.float32)
        for row, agent in zip(rows, self.agents, strict=True):
            try:
                own = _numbers(obs[agent])
            except (TypeError, ValueError, RuntimeError) as error:  # the last one is of tensors with gradients
                what = f"the observation of agent {agent!r} is no array of numbers ({error})"
                raise self._error(copy, what, f"what is in its space {self.observation_spaces[agent]}") from None
            if own.size != self._sizes[agent]:
                what = f"the observation of agent {agent!r} has {own.size} numbers"
                raise self._error(copy, what, f"what is in its space {self.observation_spaces[agent]}")
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
            ValueError: If they have none, or it changes its size or is not finite; names copy and step.
        """
        rows: list[Float] = []
        for copy, env in enumerate(self._envs):
            try:
                found = env.state()
            except (AttributeError, NotImplementedError) as error:
                raise ValueError(
                    f"{self._name} has no state() of its own ({type(error).__name__}: {error}): use "
                    f'critic_state="observations", or define it in the environment.'
                ) from error
            except TypeError as error:
                raise self._error(copy, f"state() cannot be called: {error}", "a method without arguments") from error
            try:
                row = _numbers(found)
            except (TypeError, ValueError) as error:
                raise self._error(copy, f"the state is a {type(found).__name__}", "an array of numbers") from error
            self._state_size = self._state_size or row.size
            if row.size != self._state_size:
                raise self._error(copy, f"the state has {row.size} numbers", f"{self._state_size}, as it had first")
            if not np.isfinite(row).all():
                index = int(np.flatnonzero(~np.isfinite(row))[0])
                raise self._error(copy, f"number {index} of the state is {row[index]}", "finite numbers")
            rows.append(row)
        return np.stack(rows)

    def close(self) -> None:
        """Closes every copy."""
        for env in self._envs:
            _stepped.pop(id(_innermost(env)), None)
            env.close()


def _numbers(values: Any) -> Float:
    """Values as a vector; raises a TypeError if they are no numbers, such as strings that look like some."""
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"values of dtype {array.dtype}")
    with np.errstate(over="ignore"):  # what is too large for single precision is not finite, and an error as such
        return array.astype(np.float32).reshape(-1)


def _are(result: Any, kinds: Sequence[Any]) -> bool:
    """Whether a method returned a tuple of these kinds."""
    return isinstance(result, tuple) and len(result) == len(kinds) and all(map(isinstance, result, kinds))


def _kinds(result: Any) -> str:
    """What a method returned, in a few words."""
    if not isinstance(result, tuple):
        return f"a {type(result).__name__}"
    return f"{len(result)} values ({', '.join(type(part).__name__ for part in result)})"
