"""RLlib's callbacks of a runner: what they are given, and episodes for those who look at them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from ray import cloudpickle
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.callbacks.utils import make_callback
from ray.rllib.env.env_context import EnvContext
from ray.rllib.env.multi_agent_episode import MultiAgentEpisode
from ray.rllib.utils import force_list

from rllib_maobs.envs.team import Team

if TYPE_CHECKING:
    from rllib_maobs.runner.joint import JointEnvRunner

Mask = NDArray[np.bool_]
Infos = Sequence[Mapping[str, Any]]
_ON_EPISODE = ("on_episode_created", "on_episode_start", "on_episode_step", "on_episode_end")
_OF_A_RUNNER = ("on_environment_created", *_ON_EPISODE, "on_sample_end")


class Callbacks:
    """Calls what a config's callbacks override, with what RLlib's own runner gives them.

    Args:
        runner: The runner they are called for.
    """

    def __init__(self, runner: JointEnvRunner) -> None:
        self._runner = runner
        self._objects = [cls() for cls in force_list(runner.config.callbacks_class)]
        for made in self._objects:
            if not isinstance(made, RLlibCallback):
                raise ValueError(
                    f"callbacks_class makes a {type(made).__name__}; legal is a subclass of RLlibCallback."
                )
        self._wanted = {name for name in _OF_A_RUNNER if self._overridden(name)}

    def _overridden(self, name: str) -> bool:
        nothing = getattr(RLlibCallback, name)
        methods = (getattr(callback, name) for callback in self._objects)
        return bool(self._functions(name)) or any(getattr(m, "__func__", m) is not nothing for m in methods)

    def watcher(self) -> EpisodeWatcher | None:
        """What keeps episodes for them, or None if nobody looks at episodes."""
        return EpisodeWatcher(self, self._runner) if self._wanted.intersection(_ON_EPISODE) else None

    def call(self, name: str, **given: Any) -> None:
        """Calls the classes' methods, then the functions, each in the order of the config; if there are any."""
        if name not in self._wanted:
            return
        given = {"env_runner": self._runner, "metrics_logger": self._runner.metrics, **given}
        make_callback(name, self._objects, self._functions(name), kwargs=given)

    def on_environment_created(self) -> None:
        """The copies have been made."""
        runner = self._runner
        context = EnvContext(
            runner.config.env_config or {},
            worker_index=runner.worker_index or 0,
            num_workers=runner.config.num_env_runners,
            remote=runner.config.remote_worker_envs,
        )
        self.call("on_environment_created", env=unwrapped(runner.env), env_context=context)

    def _functions(self, name: str) -> list[Any]:
        functions: list[Any] = force_list(getattr(self._runner.config, f"callbacks_{name}"))
        return functions


class EpisodeWatcher:
    """Keeps each copy's present episode as RLlib's own object, and calls the callbacks that look at it.

    For each copy the calls come in the order of RLlib's runner: created (before the reset), start, step ..., step, end,
    created. An episode is whole however short the fragments are in which it is sampled, so there are never earlier
    chunks of it. Actions are the module's, in [-1, 1] or numbers, as in RLlib.

    Args:
        callbacks: Who is called.
        runner: The runner whose copies are watched.
    """

    def __init__(self, callbacks: Callbacks, runner: JointEnvRunner) -> None:
        self._callbacks, self._runner = callbacks, runner
        # None: the copy is in the middle of an episode whose beginning was not seen.
        self._episodes: list[MultiAgentEpisode | None] = [None] * runner.num_envs
        self._waiting = np.zeros(runner.num_envs, dtype=np.bool_)  # reset, but not started

    def create(self, copies: Mask) -> None:
        """The copies `(E,)` are about to be reset."""
        team = self._runner.team
        for copy in np.flatnonzero(copies).tolist():
            self._episodes[copy] = MultiAgentEpisode(
                observation_space=dict(zip(team.agents, team.observation_spaces, strict=True)),
                action_space=dict(zip(team.agents, team.action_spaces, strict=True)),
                agent_module_ids=dict(zip(team.agents, self._runner.module_ids, strict=True)),
            )
            self._call("on_episode_created", copy)

    def reset(self, copies: Mask, obs: NDArray[np.float32], info: Mapping[str, Any]) -> None:
        """The copies `(E,)` have been reset, to observations `(E, N, O)`."""
        team, infos = self._runner.team, self._infos(info, ~copies)
        for copy in np.flatnonzero(copies).tolist():
            episode = self._episodes[copy]
            if episode is not None and not episode.is_reset:  # one that does not count is played, but not looked at
                episode.add_env_reset(observations=_observations(team, obs[copy]), infos=dict(infos[copy]))
        self._waiting |= copies

    def start(self, counted: Mask | None) -> None:
        """A step follows; copies outside of `counted` `(E,)` are not looked at."""
        starting = self._waiting if counted is None else self._waiting & counted
        for copy in np.flatnonzero(starting).tolist():
            self._call("on_episode_start", copy)
        self._waiting = self._waiting & ~starting

    def step(
        self,
        row: Mapping[str, Any],
        obs: NDArray[np.float32],
        done: Mask,
        info: Mapping[str, Any],
        counted: Mask | None,
    ) -> None:
        """All copies took a step.

        Args:
            row: Its actions, rewards and flags `(E, ...)`.
            obs: What was seen after it, `(E, N, O)`.
            done: Which episodes it ended, `(E,)`.
            info: The environment's info.
            counted: Which copies are looked at, `(E,)`; None for all.
        """
        team = self._runner.team
        # One flag for the team, or one for each agent.
        terminated = np.broadcast_to(row["terminated"].reshape(len(done), -1), (len(done), len(team.agents)))
        infos = self._infos(info, done)
        for copy in range(len(done)) if counted is None else np.flatnonzero(counted).tolist():
            over, ended = bool(done[copy]), [bool(done[copy] and flag) for flag in terminated[copy]]
            if (episode := self._episodes[copy]) is not None:
                episode.add_env_step(
                    observations=_observations(team, obs[copy]),
                    actions=_actions(team, row["actions"][copy]),
                    rewards=dict(zip(team.agents, map(float, row["rewards"][copy]), strict=True)),
                    infos=dict(infos[copy]),
                    terminateds=_flags(team, ended, all(ended)),
                    truncateds=_flags(team, [over and not flag for flag in ended], over and not all(ended)),
                )
                self._call("on_episode_step", copy)
            if over:
                self._call("on_episode_end", copy, prev_episode_chunks=[])
                self.create(np.arange(len(done)) == copy)

    def _infos(self, info: Mapping[str, Any], done: Mask) -> Infos:
        """Every copy's infos by agent: the environment's, or what an environment of arrays says at the end."""
        if "infos" in info:
            infos: Infos = info["infos"]
            return infos
        agents, metrics = self._runner.team.agents, info.get("episode_metrics", {})
        return [
            {a: {"episode_metrics": {name: float(v[copy]) for name, v in metrics.items()}} for a in agents}
            if over and metrics
            else {a: {} for a in agents}
            for copy, over in enumerate(done)
        ]

    def _call(self, name: str, copy: int, **more: Any) -> None:
        if (episode := self._episodes[copy]) is None:
            return
        runner = self._runner
        self._callbacks.call(
            name, episode=episode, env=unwrapped(runner.env), rl_module=runner.module, env_index=copy, **more
        )

    def get_state(self) -> bytes | None:
        """The episodes as bytes; None if what users put into them can't be pickled."""
        try:
            episodes: bytes = cloudpickle.dumps((self._episodes, self._waiting))
            return episodes
        except Exception:
            return None

    def set_state(self, state: bytes | None) -> None:
        """Goes on with saved episodes; without them each copy is looked at again from its next episode on."""
        if state is not None:
            self._episodes, self._waiting = cloudpickle.loads(state)
        else:
            self._episodes, self._waiting = [None] * self._runner.num_envs, np.zeros_like(self._waiting)


def unwrapped(env: Any) -> Any:
    """The environment without what this package puts around it."""
    return getattr(env, "unwrapped", env)


def _flags(team: Team, flags: Sequence[bool], everybody: bool) -> dict[str, bool]:
    return {**dict(zip(team.agents, flags, strict=True)), "__all__": everybody}


def _observations(team: Team, obs: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """Observations by agent, without padding."""
    return {
        a: obs[i, :size].copy() for i, (a, size) in enumerate(zip(team.agents, team.observation_sizes, strict=True))
    }


def _actions(team: Team, actions: NDArray[np.float32]) -> dict[str, Any]:
    """Actions by agent, without padding, or as numbers."""
    return {
        agent: int(own.argmax()) + int(space.start) if isinstance(space, gym.spaces.Discrete) else own[:size].copy()
        for agent, own, space, size in zip(team.agents, actions, team.action_spaces, team.action_sizes, strict=True)
    }
