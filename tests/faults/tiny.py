"""A training that takes seconds, as a program that tests kill, and what is compared of its results."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from ray.rllib.core.rl_module import RLModule
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from rllib_maobs.checkpoints import find_checkpoint, module_folders
from rllib_maobs.experiment import Experiment
from rllib_maobs.experiment.arguments import make_parser, parse
from rllib_maobs.experiment.report import STEPS
from rllib_maobs.experiment.trial import Trial

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


def timeless(result: dict[str, Any]) -> str:
    """What a result says of training and evaluation, as text (NaN is NaN), but for how fast the machine was."""
    evaluated = result["evaluation"]["env_runners"]["episode_metrics"]
    learned = {agent: values for agent, values in result["learners"].items() if agent.startswith("agent_")}
    numbers = [result["training_iteration"], result[STEPS], result["score"], evaluated, learned]
    return json.dumps(numbers, sort_keys=True, default=float)


def rows(folder: Path) -> list[str]:
    """The results that a run has logged."""
    return [timeless(json.loads(line)) for line in (folder / TRIAL / "result.json").read_text().splitlines()]


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


def uninterrupted(steps: int) -> tuple[list[str], dict[str, torch.Tensor]]:
    """The results and the networks of a training in this process."""
    arguments = ["--quick", "--no-compile", "--stop-timesteps", str(steps)]
    parser = make_parser("tiny", EXPERIMENT.algorithms, 1000)
    (spec,) = EXPERIMENT.specs(parse(parser, "tiny", [*arguments, "--results-dir", "/nowhere"]))
    trial = Trial(config=asdict(spec))
    try:
        results = [timeless(trial.train()) for _ in range(steps // ITERATION)]
        modules = trial._algorithm.learner_group._learner.module
        return results, {
            f"{mid}.{name}": value
            for mid in modules.keys()
            for name, value in modules[mid].unwrapped().state_dict().items()
        }
    finally:
        trial.stop()


def flip(path: Path, bit: int) -> None:
    """Change one bit of a file."""
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


if __name__ == "__main__":
    EXPERIMENT.main()
