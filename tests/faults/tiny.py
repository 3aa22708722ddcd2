"""A training that takes seconds, as a program that tests kill, and what is compared of its results."""

import json
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from ray.rllib.core.rl_module import RLModule
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from rllib_maobs.checkpoints import find_checkpoint, module_folders
from rllib_maobs.experiment import Experiment
from rllib_maobs.experiment.report import STEPS

TRIAL = "tiny-seed0"
ITERATION = 24  # env steps
EXPERIMENT = Experiment(
    name="tiny",
    env="maobs/spread-3a",
    algorithms=("tiny",),
    variants={
        "tiny": {
            "algorithm": "maddpg",
            "num_random_steps": 16,
            "num_steps_sampled_before_learning_starts": 16,
            "train_batch_size_per_learner": 8,
            "replay_buffer_capacity": 5_000,
            "num_envs_per_env_runner": 4,
            "train_horizon": 10,
            "quick": {"steps_per_iteration": ITERATION, "evaluation_duration": 1},
        }
    },
    training={"tau": 0.05},
    stop_timesteps=1000,
)


def rows(folder: Path) -> list[str]:
    """What each result says of training and evaluation, as text (NaN is NaN), but for how fast the machine was."""
    found = []
    for line in (folder / TRIAL / "result.json").read_text().splitlines():
        result = json.loads(line)
        learned = {agent: values for agent, values in result["learners"].items() if agent.startswith("agent_")}
        timeless = [result["training_iteration"], result[STEPS], result["evaluation"]["env_runners"], learned]
        found.append(json.dumps(without_times(timeless), sort_keys=True))
    return found


def without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_times(v) for key, v in value.items() if "time" not in key and "_sec" not in key}
    return [without_times(v) for v in value] if isinstance(value, list) else value


def iterations(folder: Path) -> dict[str, list[int]]:
    """The iterations that each kind of file has rows of, in their order."""
    events = EventAccumulator(str(folder / TRIAL), size_guidance={"scalars": 0}, purge_orphaned_data=False)
    events.Reload()
    steps = {
        "result.json": [json.loads(line)[STEPS] for line in (folder / TRIAL / "result.json").read_text().splitlines()],
        "progress.csv": pd.read_csv(folder / TRIAL / "progress.csv")[STEPS].tolist(),
        "curves.csv": pd.read_csv(folder / "curves.csv")["env_steps"].tolist(),
        "TensorBoard": [event.step for event in events.Scalars("evaluation/score")],
    }
    return {name: [step // ITERATION for step in found] for name, found in steps.items()}


def weights(folder: Path) -> dict[str, torch.Tensor]:
    """All networks of the last checkpoint, online and target."""
    return {
        f"{mid}.{name}": value
        for mid, path in module_folders(find_checkpoint(folder / TRIAL)).items()
        for name, value in RLModule.from_checkpoint(path).state_dict().items()
    }


if __name__ == "__main__":
    EXPERIMENT.main()
