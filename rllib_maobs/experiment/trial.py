"""One trial of an experiment: an algorithm, a seed and plain settings, run under Ray Tune."""

import contextlib
import math
import os
import shutil
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
from pyarrow.fs import LocalFileSystem
from ray import tune
from ray.rllib.algorithms import AlgorithmConfig
from ray.train._internal.session import _TrainingResult
from ray.tune.result import SHOULD_CHECKPOINT

import rllib_maobs as maobs
from rllib_maobs.experiment.claim import hold
from rllib_maobs.experiment.keeping import SAVING
from rllib_maobs.experiment.report import SCORE, STEPS, evaluation_metrics
from rllib_maobs.experiment.retries import COMES_AGAIN, note, raise_noted
from rllib_maobs.learner import Diverged

SHARED_POLICY = "all"
# What Tune fills in by itself for the trial; the algorithm inside fills in its own, with a config of a thousand lines.
_FILLED_BY_TUNE = {
    "config",
    "trial_id",
    "done",
    "date",
    "timestamp",
    "pid",
    "hostname",
    "node_ip",
    "training_iteration",
    "iterations_since_restore",
    "time_since_restore",
    "time_this_iter_s",
    "time_total_s",
}


@dataclass(frozen=True, kw_only=True)
class TrialSpec:
    """The settings of one trial, as plain values: Tune writes them to the trial's `params.json`.

    Attributes:
        algorithm: Name of the algorithm, or of a variant of one: the trial's name in tables.
        seed: Of the environments, the exploration noise and the initial weights.
        env: Registered name of the environment.
        stop_timesteps: Env steps after which the trial is done.
        training: Arguments of the config's `training()`.
        env_config: Options of the training environments.
        evaluation_env_config: Options of the evaluation environments where they differ.
        num_env_runners: Actors that sample beside the trial's own process; with 0 it samples itself.
        num_envs_per_env_runner: Copies of the environment in each process that samples.
        one_policy: Whether all agents share one policy, instead of one each.
        torch_compile: Whether the update runs under `torch.compile`.
        steps_per_iteration: Env steps between evaluations.
        evaluation_duration: Episodes per evaluation.
        variant_of: The algorithm, if `algorithm` names a variant of it.
        start_from: Checkpoint whose networks it starts from; "" for new ones.
        checkpoint_freq: Iterations between checkpoints.
        varied: What a sweep or a search has changed for this one, by name of the setting.
    """

    algorithm: str
    seed: int
    env: str
    stop_timesteps: int
    training: dict[str, Any]
    env_config: dict[str, Any] = field(default_factory=dict)
    evaluation_env_config: dict[str, Any] = field(default_factory=dict)
    num_env_runners: int = 0
    num_envs_per_env_runner: int = 8
    one_policy: bool = False
    torch_compile: bool = True
    steps_per_iteration: int = 1000
    evaluation_duration: int = 10
    variant_of: str = ""
    start_from: str = ""
    checkpoint_freq: int = 50
    varied: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The trial's name, which is that of its folder, too."""
        return f"{self.algorithm}-seed{self.seed}"

    @property
    def evaluation_options(self) -> dict[str, Any]:
        """All options of the evaluation environments."""
        return {**self.env_config, **self.evaluation_env_config}

    def build_config(self) -> AlgorithmConfig:
        """Return the algorithm's config.

        Returns:
            The config; one iteration is `steps_per_iteration` env steps and an evaluation without exploration noise
            on environments of its own.
        """
        config = (
            maobs.ALGORITHMS[self.variant_of or self.algorithm]()
            .environment(self.env, env_config=self.env_config)
            .env_runners(num_env_runners=self.num_env_runners, num_envs_per_env_runner=self.num_envs_per_env_runner)
            .training(**self.training)
            .framework(torch_compile_learner=self.torch_compile)
            .evaluation(
                evaluation_interval=1,
                evaluation_duration=self.evaluation_duration,
                evaluation_config=AlgorithmConfig.overrides(
                    env_config=self.evaluation_options,
                    explore=False,
                    num_envs_per_env_runner=self.evaluation_duration,
                ),
            )
            .reporting(min_sample_timesteps_per_iteration=self.steps_per_iteration)
            .debugging(seed=self.seed)
        )
        if self.one_policy:
            config.multi_agent(policies={SHARED_POLICY}, policy_mapping_fn=one_policy)
        return config


def one_policy(agent_id: str, episode: Any = None, **kwargs: Any) -> str:
    """RLlib's policy mapping where all agents share one policy."""
    return SHARED_POLICY


class Trial(tune.Trainable):
    """An RLlib algorithm built from a `TrialSpec`.

    Tune runs one class of trainables per experiment, RLlib has one per algorithm: this one holds any of them, so
    that all algorithms share the workers, the progress table and the results folder. Its checkpoints are the
    algorithm's own: `Algorithm.from_checkpoint` reads them.
    """

    @classmethod
    def default_resource_request(cls, config: dict[str, Any]) -> Any:
        """Ask for what RLlib would ask for: one CPU, and one per EnvRunner actor."""
        algorithm = TrialSpec(**config).build_config()
        return algorithm.algo_class.default_resource_request(algorithm)

    def setup(self, config: dict[str, Any]) -> None:
        """Build the algorithm."""
        raise_noted(self.logdir)
        spec = TrialSpec(**config)
        self._stop_timesteps, self._start_from = spec.stop_timesteps, spec.start_from
        self._checkpoint_freq = spec.checkpoint_freq
        self._why_not_saved = ""
        # Should the run be killed, this process lives on for a moment: a resumed run waits for it.
        folder = self._folder()
        self._held = None if folder is None else hold(folder)
        self._algorithm = _build(spec.build_config())

    def train(self) -> dict[str, Any]:
        """Tune's; what would come again is noted for the process in which Tune tries it once more."""
        try:
            result: dict[str, Any] = super().train()
            return result
        except COMES_AGAIN as error:
            note(self.logdir, error)
            raise

    def step(self) -> dict[str, Any]:
        """Train for one iteration; the result says whether that was the last one."""
        if self._start_from:
            maobs.load_networks(self._algorithm, self._start_from)
            self._start_from = ""
        try:
            result = {key: value for key, value in self._algorithm.train().items() if key not in _FILLED_BY_TUNE}
        except Diverged as error:
            self._keep(error)
            raise
        # By this name a search finds it; NaN, which no trial is kept for, if no episode has ended.
        score = evaluation_metrics(result).get(SCORE, math.nan)
        # Tune's own frequency is one for all trials, whose iterations differ in length.
        save = (self.iteration + 1) % self._checkpoint_freq == 0
        return {**result, SCORE: score, SHOULD_CHECKPOINT: save, "done": result[STEPS] >= self._stop_timesteps}

    def _folder(self) -> Path | None:
        """Return the trial's folder; None where there is none, or where it is at a URL."""
        storage = self._storage
        local = storage is not None and isinstance(storage.storage_filesystem, LocalFileSystem)
        return Path(storage.trial_fs_path) if local else None

    def _keep(self, error: Diverged) -> None:
        """Put what a post-mortem needs into the trial's folder, wherever that is."""
        if self._storage is not None and error.evidence:
            path = f"{self._storage.trial_fs_path}/{error.file_name}"
            with self._storage.storage_filesystem.open_output_stream(path) as file:
                file.write(error.evidence)
            error.kept_as(path)

    def save(self, checkpoint_dir: str | None = None) -> Any:
        """Save a checkpoint where Tune keeps it; if the disk is full, or broken, training goes on without.

        It is written in the trial's folder, not in that of the machine's temporary files: there is one disk to be full,
        and the next run removes what a kill leaves there.

        Returns:
            Tune's result of it, without a checkpoint if it could not be written.
        """
        storage, folder = self._storage, self._folder()
        if checkpoint_dir or folder is None:
            return super().save(checkpoint_dir)
        aside, index = folder / SAVING, storage.current_checkpoint_index
        shutil.rmtree(aside, ignore_errors=True)
        try:
            return super().save(str(aside))
        except OSError as error:
            self._why_not_saved = os.strerror(error.errno) if error.errno else str(error)
            if storage.current_checkpoint_index != index:  # Tune was copying it
                shutil.rmtree(storage.checkpoint_fs_path, ignore_errors=True)
                storage.current_checkpoint_index = index
            return _TrainingResult(checkpoint=None, metrics={})
        finally:
            shutil.rmtree(aside, ignore_errors=True)

    def why_not_saved(self) -> str:
        """Return why the last checkpoint could not be written."""
        return self._why_not_saved

    def save_checkpoint(self, checkpoint_dir: str) -> None:
        """Save the algorithm."""
        self._algorithm.save_checkpoint(checkpoint_dir)

    def load_checkpoint(self, checkpoint: Any) -> None:
        """Restore the algorithm; a checkpoint of its own comes before one to start from."""
        self._start_from = ""
        self._algorithm.load_checkpoint(checkpoint)

    def cleanup(self) -> None:
        """Stop the algorithm."""
        self._algorithm.stop()
        if self._held:
            self._held.close()


class Pace(NamedTuple):
    """What a trial takes: env steps per second, evaluation included, and bytes of replay per env step."""

    env_steps_per_s: float
    bytes_per_env_step: float


def measure_pace(spec: TrialSpec, seconds: float) -> Pace:
    """Train for a moment to see what a trial will take on this machine.

    Args:
        spec: The trial. Compiling it fills the on-disk cache from which the trial itself will be compiled.
        seconds: How long to measure, once learning has started and everything is compiled.

    Returns:
        What was measured.
    """
    # Short iterations without evaluation, which is timed alone: a few seconds are enough for both.
    config = spec.build_config().evaluation(evaluation_interval=10**9)
    algorithm = _build(config.reporting(min_sample_timesteps_per_iteration=100))
    while not any(key != "__all_modules__" for key in algorithm.train().get("learners", {})):
        pass
    result = algorithm.train()
    steps, start = result["num_env_steps_sampled_lifetime"], time.perf_counter()
    elapsed = 0.0
    while elapsed < seconds:
        result = algorithm.train()
        elapsed = time.perf_counter() - start
    per_step = elapsed / (result["num_env_steps_sampled_lifetime"] - steps)
    algorithm.evaluate()
    start = time.perf_counter()
    algorithm.evaluate()
    per_step += (time.perf_counter() - start) / spec.steps_per_iteration
    algorithm.stop()
    return Pace(1.0 / per_step, algorithm.replay_buffer.nbytes / algorithm.replay_buffer.capacity)


def _build(config: AlgorithmConfig) -> Any:
    """Build the algorithm for a process with one core to itself."""
    torch.set_num_threads(1)
    maobs.register()
    algorithm = config.build_algo()
    # RLlib makes a log folder in the home directory for an algorithm that Tune does not know; nothing goes there.
    with contextlib.suppress(OSError):
        os.rmdir(algorithm.logdir)
    return algorithm
