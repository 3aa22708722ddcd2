"""JointEnvRunner: steps E environment copies at once and returns joint columns instead of episode objects."""

from __future__ import annotations

import logging
import math
import pickle
import uuid
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core import COMPONENT_RL_MODULE
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule
from ray.rllib.env import INPUT_ENV_SPACES
from ray.rllib.env.env_errors import StepFailedRecreateEnvError
from ray.rllib.env.env_runner import EnvRunner
from ray.rllib.utils.annotations import override
from ray.rllib.utils.checkpoints import Checkpointable
from ray.rllib.utils.metrics import (
    NUM_ENV_STEPS_SAMPLED_LIFETIME,
    RLMODULE_INFERENCE_TIMER,
    SAMPLE_TIMER,
    WEIGHTS_SEQ_NO,
)
from ray.util import log_once

from rllib_maobs.envs.snapshot import snapshot
from rllib_maobs.envs.team import JointEnv, Team, finished
from rllib_maobs.modules.normalizer import Normalizers
from rllib_maobs.modules.team import Actors
from rllib_maobs.runner.acting import Acting
from rllib_maobs.runner.callbacks import Callbacks
from rllib_maobs.runner.episodes import EPISODE_METRICS, Episodes
from rllib_maobs.runner.errors import EnvError, portable
from rllib_maobs.runner.making import limit_faults, make_env, replace_copy

logger = logging.getLogger(__name__)
COMPONENT_SAMPLING = "sampling"
# Its number, the row of every column, and what there was at the end of the episodes that ended.
_Step = tuple[int, dict[str, Any], dict[str, Any]]


@dataclass(frozen=True)
class JointSample:
    """L steps of E copies as joint columns: the arguments of `JointReplayBuffer.add`, which explains them."""

    obs: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    final_obs: NDArray[np.float32]
    state: NDArray[np.float32] | None = None
    final_state: NDArray[np.float32] | None = None
    recurrent_state: NDArray[np.float32] | None = None
    final_recurrent_state: NDArray[np.float32] | None = None
    source: str = ""
    start: int = 0
    failed: NDArray[np.bool_] | None = None

    def env_steps(self) -> int:
        """L * E."""
        return self.truncated.size

    def agent_steps(self) -> int:
        """L * E * N."""
        return self.rewards.size


class JointEnvRunner(EnvRunner, Checkpointable):
    """Samples a fixed team's joint steps from E copies that step together.

    All agents of all copies act in one stacked forward pass, and what comes back are arrays `(L, E, N, ...)`.
    Set by the algorithms of this package as `env_runner_cls`; `sample()` and `get_metrics()` keep RLlib's
    signatures and result keys, so RLlib's evaluation, fault tolerance and Tune work with it unchanged.
    RLlib's callbacks are called as RLlib calls them; `on_sample_end` gets the joint samples, and episode objects exist
    only where a callback looks at them.

    Attributes:
        error: The error of the environment that ended the last `sample()`, if one did.
    """

    @override(EnvRunner)
    def __init__(self, config: AlgorithmConfig, **kwargs: Any) -> None:
        super().__init__(config=config, **kwargs)
        self.team: Team = self.config.team
        self.error: Exception | None = None
        self._failures = self._restarts = 0  # of the environment: since an episode could be sampled, and ever
        self._failures_of_copies: dict[int, int] = {}  # each since it has ended an episode
        self.module_ids: tuple[str, ...] = self.config.module_ids
        self.env: JointEnv | None = None
        self.num_envs: int = self.config.num_envs_per_env_runner
        self._generator = torch.Generator()
        self._seed_anew()
        self._callbacks = Callbacks(self)
        self._obs: NDArray[np.float32] | None = None
        self._needs_reset = True
        local = self.worker_index == 0
        if not local or self.num_workers == 0 or self.config.create_env_on_local_worker:
            try:
                self.make_env()
            except Exception as error:
                if not self.worker_index:
                    raise
                # The algorithm asks for it: RLlib would build an algorithm without this runner, or fail elsewhere.
                self.error = portable(error, f"env runner {self.worker_index}")
        self.module: MultiRLModule | None = None
        self._weights_seq_no = 0
        self.make_module()

        self._watcher = self._callbacks.watcher()
        self._episodes = Episodes(self.team.agents, self.module_ids, self.num_envs)
        self._steps_sampled = 0
        self._source = f"{self.worker_index}-{uuid.uuid4().hex}"

    def _seed_anew(self, *after: int) -> None:
        """Seeds the copies' next first reset, and exploration; after some steps otherwise than at the start."""
        # One stream of randomness per runner and purpose, far from each other even for neighbouring seeds.
        entropy = None if self.config.seed is None else [self.config.seed, self.worker_index or 0]
        seeds = np.random.SeedSequence(entropy, spawn_key=(int(self.config.in_evaluation), *after))
        self._env_seeds = [int(s) for s in seeds.spawn(1)[0].generate_state(self.num_envs)]
        self._generator.manual_seed(int(seeds.generate_state(1)[0]))

    @override(EnvRunner)
    def make_env(self) -> None:
        """Makes the E copies anew; they are reset at the next `sample()`."""
        self._close_env()
        self.env = make_env(self.config, self.num_envs, self.worker_index or 0, self.team)
        self._obs, self._needs_reset = None, True
        self._callbacks.on_environment_created()

    def _close_env(self) -> None:
        if self.env is not None:
            try:
                self.env.close()
            except Exception as error:  # it may be closed because it is broken
                logger.warning("The environment of runner %s could not be closed: %r", self.worker_index, error)
        self.env = None

    @override(EnvRunner)
    def make_module(self) -> None:
        """Builds the agents' modules and stacks their actors, so that all act in one call."""
        self.module = self.config.get_multi_rl_module_spec(spaces=self.get_spaces(), inference_only=True).build()
        modules = [self.module[mid] for mid in self.module_ids]
        self.acting = Acting(modules, self.team, self.num_envs, self._generator)

    def share(self, actors: Actors, normalizers: Normalizers | None) -> None:
        """Acts with the tensors of a learner in this process from now on, so weights need no syncing."""
        self.acting.share(actors, normalizers)

    @override(EnvRunner)
    def sample(
        self,
        *,
        num_timesteps: int | None = None,
        num_episodes: int | None = None,
        explore: bool | None = None,
        random_actions: bool = False,
        force_reset: bool = False,
        **kwargs: Any,
    ) -> list[JointSample]:
        """Steps the copies.

        Args:
            num_timesteps: Env steps to sample at least, over all copies. None: `rollout_fragment_length` steps
                of every copy.
            num_episodes: Episodes to sample instead. They are dealt out to the copies in equal shares, so short
                episodes are not favoured, and all copies start afresh.
            explore: Whether to explore; None takes the config's.
            random_actions: Whether to act uniformly at random.
            force_reset: Whether all copies start afresh.
            **kwargs: Ignored.

        Returns:
            One `JointSample` in a list; none if none is asked for.

        Raises:
            ValueError: If an observation or reward is not finite; names the agent, copy and step.
            Exception: Whatever the environment raises, if RLlib's settings of fault tolerance do not let it be made
                anew (any more).
        """
        if self.env is None and self.error is None:
            raise ValueError(f"{self} has no environment, so it cannot sample.")
        if num_timesteps is not None and num_episodes is not None:
            raise ValueError("Give either num_timesteps or num_episodes, not both.")
        if num_timesteps == 0 or num_episodes == 0:
            return []  # an evaluation has less to play than it has runners
        self.error = None
        explore = self.config.explore if explore is None else explore
        with self.metrics.log_time(SAMPLE_TIMER):
            if force_reset or num_episodes is not None:
                self._needs_reset = True
            try:
                if num_episodes is not None:
                    parts = self._play(num_episodes, explore, random_actions)
                else:
                    length = self.config.get_rollout_fragment_length(self.worker_index)
                    if num_timesteps is not None:
                        length = math.ceil(num_timesteps / self.num_envs)
                    parts = self._fragment(length, explore, random_actions)
                samples = [self._joined(part) for part in parts]
                self._callbacks.call("on_sample_end", samples=samples)
            except Exception as error:
                self.error, self._needs_reset = error, True
                raise
        return samples

    def _joined(self, steps: list[_Step]) -> JointSample:
        """Steps that follow one another as columns."""
        starts, rows, finals = zip(*steps, strict=True)
        failed = [row.pop("failed", None) for row in rows]
        columns = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        if any(copies is not None for copies in failed):
            none = np.zeros(self.num_envs, dtype=np.bool_)
            columns["failed"] = np.stack([none if copies is None else copies for copies in failed])
        final_columns = {f"final_{name}": np.concatenate([final[name] for final in finals]) for name in finals[0]}
        return JointSample(**columns, **final_columns, source=self._source, start=starts[0])

    def _reset_all(self) -> None:
        everyone = np.ones(self.num_envs, dtype=np.bool_)
        # Copies are seeded once; after that each goes on in its own stream. Those made anew get other streams.
        seeds = [(seed + self._restarts) % 2**32 for seed in self._env_seeds] if self._obs is None else None
        self._obs = self._reset(everyone, seed=seeds)
        self._episodes.begin(everyone)
        self.acting.forget(everyone)
        self._needs_reset = False
        self._steps_sampled += 1  # a gap: what follows is not linked to what was sampled before

    def _fragment(self, length: int, explore: bool, random_actions: bool) -> list[list[_Step]]:
        """Steps all copies so often; what came before an error of the environment is dropped, as RLlib does."""
        parts: list[list[_Step]] = [[]]
        while len(parts[-1]) < length:
            self._advance(parts, explore, random_actions)
        if self._failures and any(len(final["obs"]) for _, _, final in parts[-1]):
            self._failures = 0
        return parts[-1:] if length else []

    def _play(self, num_episodes: int, explore: bool, random_actions: bool) -> list[list[_Step]]:
        """Plays episodes: copy e plays its share of them; further ones of it are not counted.

        Returns:
            The steps in parts, between which the environment was made anew.
        """
        left = np.full(self.num_envs, num_episodes // self.num_envs)
        left[: num_episodes % self.num_envs] += 1
        parts: list[list[_Step]] = [[]]
        while (left > 0).any():
            if self._advance(parts, explore, random_actions, counted=left > 0):
                _, row, _ = parts[-1][-1]
                ended = finished(row["terminated"], row["truncated"])
                if (ended & (left > 0)).any():
                    self._failures = 0
                left -= ended
        self._needs_reset = True
        return [part for part in parts if part]

    def _advance(
        self, parts: list[list[_Step]], explore: bool, random_actions: bool, counted: NDArray[np.bool_] | None = None
    ) -> bool:
        """Adds one step to the last part; after an error of the environment it begins a part instead.

        Returns:
            Whether it was a step.
        """
        try:
            if self.env is None:
                self._make_env_or_fail()
            if self._needs_reset:
                self._reset_all()
            start = self._steps_sampled
            parts[-1].append((start, *self._step(explore, random_actions, counted)))
            return True
        except EnvError as error:
            assert isinstance(error.__cause__, Exception)
            self._give_up_env(error.__cause__)
            parts.append([])
            return False

    def _make_env_or_fail(self) -> None:
        try:
            self.make_env()
        except Exception as error:
            raise EnvError from error

    def _give_up_env(self, error: Exception) -> None:
        """After an error of the environment it is to be made anew; raises the error if RLlib's settings are spent."""
        self._failures += 1
        self._tolerate(error, self._failures, "The environment")
        self._close_env()

    def _tolerate(self, error: Exception, failures: int, what: str) -> None:
        config = self.config
        self._restarts += 1
        # A remote runner is not restarted for it: its process is sound. An illegal value would come again.
        runners = config.restart_failed_env_runners and bool(self.worker_index) and not isinstance(error, ValueError)
        limit = min(config.num_consecutive_env_runner_failures_tolerance, config.max_num_env_runner_restarts)
        if not (config.restart_failed_sub_environments or runners) or failures > limit:
            raise error from error.__cause__
        if not isinstance(error, StepFailedRecreateEnvError):
            logger.warning(
                "%s of runner %s raised %r and is made anew (failure %d since an episode could be sampled, %d are "
                "tolerated).",
                what,
                self.worker_index,
                error,
                failures,
                limit,
            )

    def _replace(self, errors: Mapping[int, Exception]) -> NDArray[np.bool_]:
        """Makes copies anew whose steps have failed, and begins episodes in them; returns which they are, `(E,)`."""
        assert self.env is not None
        for copy, error in errors.items():
            failures = self._failures_of_copies[copy] = self._failures_of_copies.get(copy, 0) + 1
            self._tolerate(error, failures, f"Copy {copy} of the environment")
        copies = np.zeros(self.num_envs, dtype=np.bool_)
        copies[list(errors)] = True
        try:
            for copy in errors:
                replace_copy(self.env, self.config, copy, self.worker_index or 0)
        except Exception as error:
            raise EnvError from error
        self._callbacks.on_environment_created()
        if self._watcher is not None:
            self._watcher.create(copies)
        self._obs = self._reset(copies, seed=[(seed + self._restarts) % 2**32 for seed in self._env_seeds], mask=copies)
        self._episodes.begin(copies)
        self.acting.forget(copies)
        return copies

    def _step(
        self, explore: bool, random_actions: bool, counted: NDArray[np.bool_] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """One step of all copies.

        Returns:
            The row of every column `(E, ...)`, and what there was at the end of the episodes that ended `(D, ...)`.
        """
        assert self.env is not None and self._obs is not None
        if self._watcher is not None:
            self._watcher.start(counted)
        row = self._sight()
        with self.metrics.log_time(RLMODULE_INFERENCE_TIMER):
            t = self.num_env_steps_sampled_lifetime
            row["actions"] = self.acting(self._obs, t, explore=explore, random=random_actions)
        played = self.acting.to_env(row["actions"])
        try:
            self._obs, row["rewards"], terminated, row["truncated"], info = self.env.step(played)
        except Exception as error:
            raise EnvError from error
        done = finished(terminated, row["truncated"])
        row["terminated"] = (
            terminated if terminated.ndim == 2 else terminated[:, None].repeat(row["rewards"].shape[1], 1)
        )
        self._episodes.add(row["rewards"])
        self._check_finite("observation", self._obs)
        self._check_finite("reward", row["rewards"])
        self._steps_sampled += 1
        self.num_env_steps_sampled_lifetime += self.num_envs * max(1, self.num_workers)
        failed = info.get("failed")
        if self._watcher is not None:
            looked_at = counted
            if failed is not None:
                looked_at = np.ones(self.num_envs, dtype=np.bool_) if counted is None else counted.copy()
                looked_at[list(failed)] = False
            self._watcher.step(row, self._obs, done, info, looked_at)
        if failed is not None:
            row["failed"] = self._replace(failed)
        if not done.any():
            return row, {name: row[name][:0] for name in ("obs", "state", "recurrent_state") if name in row}
        final = {name: values[done] for name, values in self._sight().items()}
        if self._failures_of_copies:
            self._failures_of_copies = {copy: n for copy, n in self._failures_of_copies.items() if not done[copy]}
        self._episodes.finish(done if counted is None else done & counted, info.get(EPISODE_METRICS, {}))
        self._episodes.begin(done)
        self.acting.forget(done)
        self._obs = self._reset(done, mask=done)
        return row, final

    def _reset(self, copies: NDArray[np.bool_], **how: Any) -> NDArray[np.float32]:
        """Resets the copies `(E,)`; returns all observations `(E, N, O)`."""
        assert self.env is not None
        if self._watcher is not None and "mask" not in how:  # at the end of an episode it has created the next one
            self._watcher.create(copies)
        try:
            obs, info = self.env.reset(**how)
        except Exception as error:
            raise EnvError from error
        self._check_finite("observation", obs)
        if self._watcher is not None:
            self._watcher.reset(copies, obs, info)
        return obs

    def _sight(self) -> dict[str, Any]:
        """What there is to see and to remember now: observations, and where they are stored states."""
        assert self.env is not None
        seen: dict[str, Any] = {"obs": self._obs}
        if self.team.state_size:
            seen["state"] = self.env.state("world")
        if (recurrent_state := self.acting.recurrent_state) is not None:
            seen["recurrent_state"] = recurrent_state
        return seen

    @property
    def _lengths(self) -> NDArray[np.int64]:
        """Steps that each copy's episode has taken so far, `(E,)`."""
        return self._episodes.lengths

    def _check_finite(self, what: str, values: NDArray[np.float32]) -> None:
        if np.isfinite(values).all():
            return
        copy, agent = np.argwhere(~np.isfinite(values))[0][:2]
        raise ValueError(
            f"The {what} of agent {self.team.agents[agent]!r} is not finite at step {self._lengths[copy]} "
            f"of its episode in environment copy {copy} of {self.config.env} (runner {self.worker_index}): "
            f"{values[copy, agent]}; legal: finite numbers."
        )

    @override(EnvRunner)
    def apply(self, func: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Calls a function with this runner, in its own process.

        An error that ended `sample()` is raised for the caller to see, and the process stays. Of any other one RLlib
        takes the process to be broken, and ends it.
        """
        try:
            return func(self, *args, **kwargs)
        except Exception as error:
            ignored = self.config.ignore_env_runner_failures and not self.config.restart_failed_env_runners
            if error is self.error and not ignored:
                self.error = portable(error, f"env runner {self.worker_index}")
                raise self.error from error.__cause__
            raised = error

        def again(_: Any) -> None:
            raise raised

        return super().apply(again)

    @override(EnvRunner)
    def get_metrics(self) -> Any:
        """RLlib's result keys for what was sampled since the last call, and each episode's own metrics."""
        # The results merge all runners' windows into one.
        window = max(1, math.ceil(self.config.metrics_num_episodes_for_smoothing / max(1, self.num_workers)))
        self._episodes.report(self.metrics, window)
        self.metrics.log_value(WEIGHTS_SEQ_NO, self._weights_seq_no, window=1)
        return self.metrics.reduce()

    @override(EnvRunner)
    def get_spaces(self) -> dict[str, tuple[gym.Space[Any], gym.Space[Any]]]:
        """The spaces of every module, and under RLlib's own key those of every agent."""
        team = self.team
        return {
            INPUT_ENV_SPACES: (
                gym.spaces.Dict(list(zip(team.agents, team.observation_spaces, strict=True))),
                gym.spaces.Dict(list(zip(team.agents, team.action_spaces, strict=True))),
            ),
            **{mid: team.spaces(agent) for mid, agent in zip(self.module_ids, team.agents, strict=True)},
        }

    @override(EnvRunner)
    def assert_healthy(self) -> None:
        """Checks that there is something to sample from, or an error that says why not, and something to act with."""
        assert (self.env is not None or self.error is not None) and self.module is not None

    @override(EnvRunner)
    def stop(self) -> None:
        """Closes the environment."""
        if self.env is not None:
            self.env.close()

    @override(Checkpointable)
    def get_state(
        self,
        components: str | Collection[str] | None = None,
        *,
        not_components: str | Collection[str] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """Weights, step count, and where the copies are in their episodes (see `snapshot`)."""
        state: dict[str, Any] = {NUM_ENV_STEPS_SAMPLED_LIFETIME: self.num_env_steps_sampled_lifetime}
        if self.module is not None and self._check_component(COMPONENT_RL_MODULE, components, not_components):
            state[COMPONENT_RL_MODULE] = self.module.get_state(
                components=self._get_subcomponents(COMPONENT_RL_MODULE, components),
                not_components=self._get_subcomponents(COMPONENT_RL_MODULE, not_components),
                **kwargs,
            )
            state[WEIGHTS_SEQ_NO] = self._weights_seq_no
        if self.env is not None and self._check_component(COMPONENT_SAMPLING, components, not_components):
            state[COMPONENT_SAMPLING] = {
                "in_evaluation": self.config.in_evaluation,
                "num_envs": self.num_envs,
                "options": self._options(),
                "env": snapshot(self.env),
                "acting": self.acting.get_state(),
                "watched": None if self._watcher is None else self._watcher.get_state(),
                **{name: getattr(self, name) for name in _SAMPLING_STATE},
            }
        return state

    @override(Checkpointable)
    def set_state(self, state: dict[str, Any]) -> None:
        """Goes on from a saved state; an environment that would not go on exactly starts new episodes."""
        if COMPONENT_RL_MODULE in state and self.module is not None:
            seq_no = state.get(WEIGHTS_SEQ_NO, 0)
            if seq_no == 0 or self._weights_seq_no < seq_no:
                weights = state[COMPONENT_RL_MODULE]
                # RLlib puts the weights for several remote runners into the object store once.
                self.module.set_state(ray.get(weights) if isinstance(weights, ray.ObjectRef) else weights)
            self._weights_seq_no = max(self._weights_seq_no, seq_no)
        if NUM_ENV_STEPS_SAMPLED_LIFETIME in state:
            self.num_env_steps_sampled_lifetime = state[NUM_ENV_STEPS_SAMPLED_LIFETIME]
        sampling = state.get(COMPONENT_SAMPLING)
        # RLlib hands the training runner's state to the evaluation runner, too; its episodes are not for it.
        if sampling is None or self.env is None or sampling["in_evaluation"] != self.config.in_evaluation:
            return
        same = sampling["num_envs"] == self.num_envs and sampling.get("options", self._options()) == self._options()
        if sampling["env"] is None or not same:
            self.begin_anew(sampling["_steps_sampled"])
            return
        self.env = pickle.loads(sampling["env"])
        limit_faults(self.env, self.config)
        self.acting.set_state(sampling["acting"])
        for name in _SAMPLING_STATE:
            setattr(self, name, pickle.loads(pickle.dumps(sampling[name])))
        if self._watcher is not None:
            self._watcher.set_state(sampling.get("watched"))

    def _options(self) -> Any:
        """What environment the configuration asks for, to compare it with a saved one's."""
        return _named([str(self.config.env), self.config.env_config or {}])

    def begin_anew(self, after: int) -> None:
        """Starts new episodes after a restore that cannot go on with the saved ones, and says so once.

        Args:
            after: Steps that had been sampled: environments and noise do not repeat what the run began with.
        """
        if log_once(f"new episodes of {self.config.env}"):
            logger.warning(
                f"Environment {self.config.env} starts new episodes after the restore: the saved ones cannot be "
                f"continued exactly (they do not come back from pickle as they were, are others in number or options, "
                f"or were those of a remote runner)."
            )
        self._seed_anew(after)
        self._obs, self._needs_reset = None, True

    def take_over(self, env_steps: int) -> None:
        """Starts in the place of a process that has died: schedules go on, episodes and noise are not its first ones.

        Args:
            env_steps: That the run has sampled so far.
        """
        self.num_env_steps_sampled_lifetime = env_steps
        self._seed_anew(env_steps)
        self._obs, self._needs_reset = None, True

    @override(Checkpointable)
    def get_ctor_args_and_kwargs(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """What builds this runner again."""
        return (), {"config": self.config}

    @override(Checkpointable)
    def get_checkpointable_components(self) -> list[tuple[str, Checkpointable]]:
        """The agents' modules."""
        return [(COMPONENT_RL_MODULE, self.module)]


_SAMPLING_STATE = ("_obs", "_needs_reset", "_episodes", "_steps_sampled", "_source")


def _named(options: Any) -> Any:
    """Options as plain values that are the same in every process: classes, functions and objects by their names."""
    if isinstance(options, Mapping):
        return {key: _named(value) for key, value in options.items()}
    if isinstance(options, list | tuple):
        return [_named(value) for value in options]
    plain = options is None or isinstance(options, bool | int | float | str)
    return options if plain else getattr(options, "__qualname__", type(options).__qualname__)
