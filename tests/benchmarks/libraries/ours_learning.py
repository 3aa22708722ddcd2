"""Ours: the row "maddpg-entity" of `tuned_examples/spread3a.py`."""

import tempfile
import time
from typing import Any

import ray
import torch

from rllib_maobs.envs import make_vec
from rllib_maobs.experiment.trial import TrialSpec
from rllib_maobs.policies import CheckpointPolicy
from tests.benchmarks.libraries.learning import Options, learned
from tests.benchmarks.workers import Job


def prepare(spec: dict[str, Any], scenario: str, evaluation: Options) -> Job:
    """Return how to train to the row's end, or for so many seconds of the process's own time, and to play then."""
    torch.set_num_threads(1)
    trial = TrialSpec(**spec)

    def train_and_play(seconds: float, episodes: int) -> dict[str, float]:
        ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
        start = time.process_time()
        algo = trial.build_config().build_algo()
        steps = 0
        while steps < trial.stop_timesteps and time.process_time() - start < seconds:
            steps = int(algo.train()["num_env_steps_sampled_lifetime"])
        spent = time.process_time() - start
        with tempfile.TemporaryDirectory() as folder:
            algo.save_to_path(folder)
            policy = CheckpointPolicy(make_vec(scenario, **evaluation), folder)
        algo.stop()
        ray.shutdown()
        return learned(policy, scenario, evaluation, episodes, steps, spent)

    return Job(train_and_play)
