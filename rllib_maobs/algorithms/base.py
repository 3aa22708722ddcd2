"""What all algorithms share: the loop of sampling, replay and updates."""

from __future__ import annotations

import logging
import math
import pickle
import tempfile
import uuid
from collections.abc import Collection
from numbers import Integral
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pyarrow.fs import FileSystem, FileType
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core import (
    ALL_MODULES,
    COMPONENT_LEARNER,
    COMPONENT_LEARNER_GROUP,
    COMPONENT_METRICS_LOGGER,
    COMPONENT_RL_MODULE,
)
from ray.rllib.utils.annotations import override
from ray.rllib.utils.checkpoints import Checkpointable
from ray.rllib.utils.metrics import (
    ENV_RUNNER_RESULTS,
    ENV_RUNNER_SAMPLING_TIMER,
    LEARNER_RESULTS,
    LEARNER_UPDATE_TIMER,
    NUM_ENV_STEPS_SAMPLED_LIFETIME,
    REPLAY_BUFFER_ADD_DATA_TIMER,
    REPLAY_BUFFER_SAMPLE_TIMER,
    SYNCH_WORKER_WEIGHTS_TIMER,
    TIMERS,
)
from ray.rllib.utils.metrics.metrics_logger import MetricsLogger

from rllib_maobs.algorithms.checks import check_machine
from rllib_maobs.algorithms.config import JointConfig
from rllib_maobs.envs.team import REWARD_TOLERANCE, Team
from rllib_maobs.learner import Diverged, JointLearner
from rllib_maobs.paths import AnyPath, absolute
from rllib_maobs.replay import JointReplayBuffer
from rllib_maobs.runner import JointSample, raise_kept, raised_as_themselves
from rllib_maobs.whole import CHECKSUMS, first_whole, with_those_before, written_aside

logger = logging.getLogger(__name__)
COMPONENT_REPLAY_BUFFER = "replay_buffer"
LARGE_REPLAY = 2e9
"""Bytes of replay from which on a checkpoint is worth a warning: some seconds, each time it is saved."""
# Minibatches are drawn several at a time, up to this many rows: one gather instead of many. Those of long windows are
# larger, so there are fewer.
_ROWS_PER_DRAW = 16_384
_LONG_WINDOW = 32
_FAR_BEYOND = 2.0  # networks overshoot a little while they learn


class JointAlgorithm(AnyPath, Algorithm):
    """Off-policy training of a fixed team from joint replay.

    Each round samples a fragment of every copy, adds it to replay, and makes the updates that
    `updates_per_env_step` owes for it. An iteration is as many rounds as
    `min_sample_timesteps_per_iteration` takes.
    """

    config_class: ClassVar[type[JointConfig]] = JointConfig
    config: Any
    replay_buffer: JointReplayBuffer

    @classmethod
    @override(Algorithm)
    def get_default_config(cls) -> JointConfig:
        """The algorithm's settings."""
        return cls.config_class()

    @override(Algorithm)
    def setup(self, config: AlgorithmConfig) -> None:
        """Builds the replay buffer and lets local runners act with the learner's own tensors.

        Raises:
            ValueError: If this machine lacks what the configuration needs: a GPU, or a compiler.
        """
        check_machine(config)
        super().setup(config)
        team: Team = self.config.team
        self._learner: JointLearner = self.learner_group._learner
        self.replay_buffer = JointReplayBuffer(
            self.config.replay_buffer_capacity,
            len(team.agents),
            team.observation_size,
            team.action_size,
            team.state_size,
            self._learner.acting.networks[0].initial_state().shape if self.config.stored_state else None,
            seed=self.config.seed,
            device=self._learner.device,
        )
        for group in (self.env_runner_group, self.eval_env_runner_group):
            if group is not None:
                raise_kept(group)  # of environments that could not be made
            if group is not None and group.local_env_runner is not None:
                group.local_env_runner.share(self._learner.acting, self._learner.normalizers)
        self._rounds_without_samples = 0
        self._warned_of_values = self._warned_of_size = False
        self._custom_metrics: dict[str, Any] = {}
        self._progress: dict[str, Any] = {
            "env_steps": 0,
            "updates": 0,
            "learning_starts": self._steps_before_learning(),
            "largest_reward": 0.0,
        }
        self._progress["updates_per_env_step"] = self.config.updates_per_env_step

    def _owe_from_now_on(self) -> None:
        """Counts updates from here if `updates_per_env_step` has changed since they were counted last."""
        ratio = self.config.updates_per_env_step
        if self._progress.setdefault("updates_per_env_step", ratio) != ratio:
            starts = max(self._progress["env_steps"], self._progress["learning_starts"])
            self._progress |= {"updates_per_env_step": ratio, "learning_starts": starts, "updates": 0}

    def _steps_before_learning(self) -> int:
        return max(self.config.num_steps_sampled_before_learning_starts, self.config.train_batch_size_per_learner)

    @override(Algorithm)
    def training_step(self) -> None:
        """One iteration's rounds of sampling and updates."""
        goal = self._progress["env_steps"] + max(1, self.config.min_sample_timesteps_per_iteration or 0)
        while self._progress["env_steps"] < goal:
            with self.metrics.log_time((TIMERS, ENV_RUNNER_SAMPLING_TIMER)):
                samples = self._sample()
            self._rounds_without_samples = 0 if samples else self._rounds_without_samples + 1
            if not samples:
                self._check_runners()
                break  # all runners are down: RLlib restores them before it calls again
            with self.metrics.log_time((TIMERS, REPLAY_BUFFER_ADD_DATA_TIMER)):
                for sample in samples:
                    self._check_reward(sample)
                    largest = float(np.abs(sample.rewards).max(initial=self._progress["largest_reward"]))
                    self._progress["largest_reward"] = largest
                    self.replay_buffer.add(**vars(sample))
                    self._learner.update_normalizers(sample.obs)
                    self._progress["env_steps"] += sample.env_steps()
            if self._update():
                self._sync_remote_runners()
        self._log_results()

    def _sample(self) -> list[JointSample]:
        """One fragment of every runner."""
        random_actions = self._progress["env_steps"] < self.config.num_random_steps
        if self.env_runner_group.num_remote_workers() == 0:
            samples: list[JointSample] = self.env_runner.sample(random_actions=random_actions)
            return samples

        with raised_as_themselves(self.env_runner_group):
            results = self.env_runner_group.foreach_env_runner(
                lambda runner: runner.sample(random_actions=random_actions),
                local_env_runner=False,
                timeout_seconds=self.config.sample_timeout_s,
            )
        return [sample for result in results for sample in result]

    @override(Algorithm)
    def evaluate(self, parallel_train_future: Any = None) -> Any:
        """RLlib's evaluation; an error of a remote environment is raised as itself.

        What `custom_evaluation_function` returns is part of the results. RLlib would report only what it logs.
        """
        self._custom_metrics = {}
        with raised_as_themselves(self.eval_env_runner_group):
            results = super().evaluate(parallel_train_future)
        return {**results, **self._custom_metrics}

    @override(Algorithm)
    def _evaluate_with_custom_eval_function(self) -> tuple[dict[str, Any], int, int]:
        returned = self.config.custom_evaluation_function(self, self.eval_env_runner_group)
        try:
            metrics, env_steps, agent_steps = returned
            legal = isinstance(metrics, dict) and isinstance(env_steps, Integral) and isinstance(agent_steps, Integral)
        except (TypeError, ValueError):
            legal = False
        if not legal:
            raise ValueError(
                f"custom_evaluation_function returns {returned!r}; legal are metrics (a dict), env steps and agent "
                f"steps (integers)."
            )
        self._custom_metrics = MetricsLogger.peek_results(metrics)  # numbers, also of what runners give
        return metrics, int(env_steps), int(agent_steps)

    def _check_reward(self, sample: JointSample) -> None:
        """Raises a ValueError where agents' rewards differ but the algorithm's value is that of a team reward."""
        if not self.config.supports.team_reward:
            return
        spread = np.ptp(sample.rewards, axis=-1)
        if spread.max() > REWARD_TOLERANCE * max(1.0, float(np.abs(sample.rewards).max())):
            step, copy = np.unravel_index(spread.argmax(), spread.shape)
            rewards = dict(zip(self.config.team.agents, sample.rewards[step, copy].tolist(), strict=True))
            raise ValueError(
                f"{self.config.name} learns the value of one team reward, but agents' rewards differ at step "
                f"{sample.start + step} of environment copy {copy}: {rewards}."
            )

    def _check_runners(self) -> None:
        """Raises a RuntimeError when RLlib has tried often enough to bring runners back: it would try for ever."""
        tolerance = self.config.num_consecutive_env_runner_failures_tolerance
        if self._rounds_without_samples > tolerance:
            raise RuntimeError(
                f"No env runner sampled anything in {self._rounds_without_samples} rounds "
                f"(num_consecutive_env_runner_failures_tolerance={tolerance}): their processes crash, or take longer "
                f"than sample_timeout_s={self.config.sample_timeout_s:g} s. Ray's logs of them say more."
            )

    def _update(self) -> int:
        """Makes the updates that are owed for the steps sampled so far; returns how many."""
        steps = self._progress["env_steps"] - self._progress["learning_starts"]
        owed = math.floor(self.config.updates_per_env_step * steps) - self._progress["updates"] if steps > 0 else 0
        batch_size = self.config.train_batch_size_per_learner
        rows = batch_size * max(1, self.config.window_length // _LONG_WINDOW)
        left = owed
        while left > 0:
            count = min(left, max(1, _ROWS_PER_DRAW // rows))
            with self.metrics.log_time((TIMERS, REPLAY_BUFFER_SAMPLE_TIMER)):
                batch = self.replay_buffer.sample(
                    (count, batch_size),
                    gamma=self.config.gamma,
                    n_step=self.config.n_step,
                    seq_length=self.config.window_length,
                )
            with self.metrics.log_time((TIMERS, LEARNER_UPDATE_TIMER)):
                timesteps = {NUM_ENV_STEPS_SAMPLED_LIFETIME: self._progress["env_steps"]}
                try:
                    self.learner_group.update(batch=batch, timesteps=timesteps, _no_metrics_reduce=True)
                except Diverged as error:
                    error.keep(self.logdir)
                    raise
            left -= count
        self._progress["updates"] += max(0, owed)
        return owed

    def _sync_remote_runners(self) -> None:
        # A local runner shares the learner's tensors; only remote ones need the weights sent.
        if self.env_runner_group.num_remote_workers() > 0:
            with self.metrics.log_time((TIMERS, SYNCH_WORKER_WEIGHTS_TIMER)):
                self.env_runner_group.sync_weights(from_worker_or_learner_group=self.learner_group, inference_only=True)

    def _log_results(self) -> None:
        """Gathers the runners' and the learner's metrics, once per iteration."""
        results = self.env_runner_group.foreach_env_runner(
            lambda runner: runner.get_metrics(),
            local_env_runner=self.env_runner_group.num_remote_workers() == 0,
            timeout_seconds=self.config.sample_timeout_s,  # one that hangs says nothing, either
        )
        self.metrics.aggregate(results, key=ENV_RUNNER_RESULTS)
        self._count_as_stored()
        timesteps = {NUM_ENV_STEPS_SAMPLED_LIFETIME: self._progress["env_steps"]}
        report = self._learner.report(timesteps=timesteps)
        if report is not None:
            self.metrics.aggregate([report], key=LEARNER_RESULTS)
            self._check_values()

    def _check_values(self) -> None:
        """Reports the largest return there can be, by the rewards seen so far; warns once of values far beyond it."""
        config, largest = self.config, self._progress["largest_reward"]
        if config.gamma == 1.0 or not largest:
            return
        limit = largest * config.reward_scale / (1.0 - config.gamma)
        self.metrics.log_value((LEARNER_RESULTS, ALL_MODULES, "q_limit"), limit, window=1)
        if self._learner.q_max > _FAR_BEYOND * limit and not self._warned_of_values:
            self._warned_of_values = True
            logger.warning(
                f"Values diverge: |Q| comes to {self._learner.q_max:.3g} after {self._progress['env_steps']:,} env "
                f"steps, and no return can be larger than {limit:.3g} (the largest reward so far, {largest:.3g}, at "
                f"every step). A lower critic_lr or tau, grad_clip or a smaller reward_scale may help."
            )

    def _count_as_stored(self) -> None:
        """Reports the env steps that came to be trained on.

        A runner that dies takes its counts with it, of steps that it gave before; and one that was too late has counted
        what was not waited for.
        """
        key = (ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED_LIFETIME)
        if lost := self._progress["env_steps"] - int(self.metrics.peek(key, default=0)):
            self.metrics.log_value(key, lost, reduce="lifetime_sum")

    @override(Algorithm)
    def restore_env_runners(self, env_runner_group: Any) -> list[int]:
        """RLlib's; runners that come back do not repeat the episodes and the noise that they began with."""
        restored: list[int] = super().restore_env_runners(env_runner_group)
        if restored:
            steps = self._progress["env_steps"]
            env_runner_group.foreach_env_runner(
                lambda runner: runner.take_over(steps),
                remote_worker_ids=restored,
                local_env_runner=False,
                timeout_seconds=self.config.env_runner_restore_timeout_s,
            )
        return restored

    def _follow(self, saved: Team | None) -> None:
        """Builds everything anew if a saved team, whose state is to be taken over, stands in another order.

        Networks of a centralised critic have weights for every agent's place, so the order is taken over with them.

        Raises:
            ValueError: If its agents are others, observe something of another size, or act in other spaces: the same
                output of an actor would be another action.
        """
        team: Team = self.config.team
        if saved is None:
            return
        agents = saved.agents
        if set(agents) != set(team.agents):
            raise ValueError(
                f"The saved team is {sorted(agents)}, but the agents of {self.config.env!r} are "
                f"{sorted(team.agents)}: a run goes on with the same set of agents only."
            )
        for agent in agents:
            (observed, acted), (observes, acts) = saved.spaces(agent), team.spaces(agent)
            if observed.shape != observes.shape or acted != acts:
                raise ValueError(
                    f"The spaces of agent {agent!r} in {self.config.env!r} are {observes} and {acts}, but in the saved "
                    f"run {observed} and {acted}: a run goes on with observations of the same size and the same "
                    f"actions only. maobs.load_networks starts a new run from its networks, where they fit."
                )
        if agents == team.agents:
            return
        config: JointConfig = self.config.copy(copy_frozen=False)
        config.team = team.ordered(agents)
        config.validate()
        config.freeze()
        self.cleanup()
        self.config = config
        self.setup(config)

    @override(Algorithm)
    def get_metadata(self) -> dict[str, Any]:
        """RLlib's, and that a checkpoint has checksums: one whose list of them is missing is recognised."""
        return {**super().get_metadata(), "checksums": CHECKSUMS}

    @override(AnyPath)
    def save_to_path(self, path: Any = None, *, filesystem: Any = None, **kwargs: Any) -> str:
        """RLlib's. In a local folder the checkpoint is written aside, with checksums, and renamed into place.

        Whatever happens meanwhile, the checkpoint that was there before stays until the new one is whole.

        Returns:
            The path.
        """
        if path is None:
            path = Path(tempfile.gettempdir()) / str(uuid.uuid4())
        self._warn_of_size()
        if (folder := _local_folder(path, filesystem)) is None:
            return super().save_to_path(path, filesystem=filesystem, **kwargs)
        with written_aside(folder) as aside:
            super().save_to_path(aside, **kwargs)
        return str(folder)

    def _warn_of_size(self) -> None:
        """Says once what a large replay buffer makes of checkpoints, and what leaving it out costs."""
        held = self.replay_buffer.nbytes * len(self.replay_buffer) / self.replay_buffer.capacity
        if self.config.store_buffer_in_checkpoints and held > LARGE_REPLAY and not self._warned_of_size:
            self._warned_of_size = True
            logger.warning(
                f"Every checkpoint of this run holds {held / 1e9:.1f} GB of replay, and training waits while it is "
                f"written. training(store_buffer_in_checkpoints=False) leaves it out; then a restored run first "
                f"collects {self._steps_before_learning():,} env steps anew, and learns from few of them for a while: "
                f"it does not go on as the first would have."
            )

    @classmethod
    @override(AnyPath)
    def from_checkpoint(cls, path: Any, filesystem: Any = None, **kwargs: Any) -> Any:
        """RLlib's; in the place of a torn checkpoint the one before it is used, with a warning.

        Raises:
            ValueError: If there is none.
        """
        return super().from_checkpoint(_whole(path, filesystem), filesystem=filesystem, **kwargs)

    @override(Algorithm)
    def restore_from_path(
        self, path: str | Path, *args: Any, component: str | None = None, filesystem: Any = None, **kwargs: Any
    ) -> None:
        """Goes on from a checkpoint, in the order of agents that it was made in.

        In the place of a torn or damaged one the one before it is used, with a warning.

        Raises:
            ValueError: If there is none, or it does not fit this configuration.
        """
        if component is None:
            path = _whole(path, filesystem)
            files, folder = (filesystem, path) if filesystem else FileSystem.from_uri(absolute(path))
            saved = f"{folder}/{self.CLASS_AND_CTOR_ARGS_FILE_NAME}"
            if files.get_file_info(saved).type == FileType.File:
                with files.open_input_stream(saved) as file:
                    team = pickle.load(file)["ctor_args_and_kwargs"][0][0].get("team")
                self._follow(team)
        try:
            super().restore_from_path(path, *args, component=component, filesystem=filesystem, **kwargs)
        except (KeyError, IndexError, RuntimeError) as error:  # what RLlib and torch say of what does not fit
            raise ValueError(
                f"{str(path)!r} was saved with other policies, networks, actions or exploration than those of this "
                f"configuration ({type(error).__name__}: {str(error).splitlines()[0]}): restore it into the one that "
                f"it was saved with, or start from its networks by maobs.load_networks."
            ) from error
        self._send_weights()

    @override(Algorithm)
    def get_state(
        self,
        components: str | Collection[str] | None = None,
        *,
        not_components: str | Collection[str] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """RLlib's state, the progress of updates against steps and, if wanted, the replay buffer."""
        state: dict[str, Any] = super().get_state(components, not_components=not_components, **kwargs)
        state["progress"] = dict(self._progress)
        state["team"] = self.config.team
        stored = self.config.store_buffer_in_checkpoints
        if stored and self._check_component(COMPONENT_REPLAY_BUFFER, components, not_components):
            state[COMPONENT_REPLAY_BUFFER] = self.replay_buffer.get_state()
        return state

    @override(Algorithm)
    def set_state(self, state: dict[str, Any]) -> None:
        """Goes on from a saved state; without a saved replay buffer learning starts when it is refilled."""
        self._follow(state.get("team"))
        if COMPONENT_METRICS_LOGGER in state:  # RLlib reads the runners' step count in it before it restores it
            self.metrics.set_state(state[COMPONENT_METRICS_LOGGER])
        super().set_state(state)
        if COMPONENT_LEARNER_GROUP in state:
            self._send_weights()
        if "progress" in state:
            self._progress = dict(state["progress"])
            self._progress.setdefault("largest_reward", 0.0)
            self._owe_from_now_on()
            for group in (self.env_runner_group, self.eval_env_runner_group):
                if group is not None and group.num_remote_workers() > 0:  # their episodes are in no checkpoint
                    steps = self._progress["env_steps"]
                    group.foreach_env_runner(
                        lambda runner, steps=steps: runner.begin_anew(steps), local_env_runner=False
                    )
        if COMPONENT_REPLAY_BUFFER in state:
            self.replay_buffer.set_state(state[COMPONENT_REPLAY_BUFFER])
        if len(self.replay_buffer) < min(self.config.train_batch_size_per_learner, self._progress["env_steps"]):
            starts = self._progress["env_steps"] + self._steps_before_learning()
            self._progress |= {"learning_starts": starts, "updates": 0}

    def _send_weights(self) -> None:
        """Sends all remote runners the weights; RLlib would not to those to which others are still on their way."""
        for group in (self.env_runner_group, self.eval_env_runner_group):
            if group is not None and group.num_remote_workers() > 0:
                group.sync_weights(
                    from_worker_or_learner_group=self.learner_group,
                    timeout_seconds=self.config.sample_timeout_s,
                    inference_only=True,
                )

    @override(Algorithm)
    def set_weights(self, weights: dict[str, dict[str, Any]]) -> None:
        """Sets the weights of modules, as `get_weights()` gives them, here and in all runners.

        Raises:
            ValueError: If there is a module or a parameter of another name.
        """
        own = self.get_weights()
        for module, parameters in weights.items():
            unknown = [module] if module not in own else [f"{module}.{p}" for p in parameters if p not in own[module]]
            if unknown:
                raise ValueError(f"There are no weights {unknown[0]!r}; modules are {sorted(own)}, see get_weights().")
        self.set_state({COMPONENT_LEARNER_GROUP: {COMPONENT_LEARNER: {COMPONENT_RL_MODULE: weights}}})

    @override(Algorithm)
    def _before_evaluate(self) -> None:
        if self.eval_env_runner_group is None:
            raise ValueError(
                "evaluate() needs runners of its own: config.evaluation(evaluation_interval=...) or "
                "(evaluation_num_env_runners=...) makes them. It would reset the training environments, and explore."
            )

    def _use_modules(self, *args: Any, **kwargs: Any) -> Any:
        """Takes the place of what RLlib has for policies, of which there are none on its new API stack."""
        raise NotImplementedError(
            "There are no policies on RLlib's new API stack: take an agent's module, module = "
            f"algo.get_module({self.config.module_ids[0]!r}), and act with "
            'module.forward_inference({"obs": obs})["actions"], observations (B, O) to actions (B, A) in [-1, 1], '
            "which ray.rllib.utils.spaces.space_utils.unsquash_action scales to the bounds of a space."
        )

    get_policy = compute_single_action = compute_actions = add_policy = remove_policy = _use_modules
    export_policy_model = export_policy_checkpoint = _use_modules

    def _fixed_team(self, *args: Any, **kwargs: Any) -> Any:
        """Takes the place of what changes the modules in mid-training."""
        raise NotImplementedError(
            "The team's modules are fixed, since they are learned in one stacked update: build an algorithm with "
            "config.multi_agent(policies=..., policy_mapping_fn=...) for others."
        )

    add_module = remove_module = _fixed_team

    @override(Algorithm)
    def get_checkpointable_components(self) -> list[tuple[str, Checkpointable]]:
        """RLlib's components and the replay buffer."""
        components: list[tuple[str, Checkpointable]] = super().get_checkpointable_components()
        if self.config.store_buffer_in_checkpoints:
            components.append((COMPONENT_REPLAY_BUFFER, self.replay_buffer))
        return components


def _local_folder(path: Any, filesystem: Any) -> Path | None:
    """The folder of a path on this machine; None for one elsewhere."""
    local = absolute(path) if filesystem is None else None
    return Path(local) if isinstance(local, str) and "://" not in local else None


def _whole(path: Any, filesystem: Any) -> Any:
    """The path of a checkpoint or, if it is torn and on this machine, that of the one before it."""
    folder = _local_folder(path, filesystem)
    candidates = [] if folder is None else with_those_before(folder)
    # RLlib says itself what is not there at all.
    return first_whole(*candidates) if len(candidates) > 1 or any(map(Path.is_dir, candidates)) else path
