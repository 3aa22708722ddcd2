"""What dashboards show of a trial: few curves with plain names over env steps, its settings, and films."""

import math
import os
from argparse import Namespace
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ray import tune
from ray.tune.logger import TBXLoggerCallback
from tensorboardX.proto.summary_pb2 import Summary
from tensorboardX.summary import hparams

from rllib_maobs.envs import SCENARIOS
from rllib_maobs.experiment.film import film
from rllib_maobs.experiment.report import SCORE, STEPS, evaluation_metrics
from rllib_maobs.experiment.trial import TrialSpec

# What is needed for a flag: a package, and how to install it.
_NEEDS = {
    "wandb": ("wandb", "pip install wandb"),
    "mlflow": ("mlflow", "pip install mlflow-skinny sqlalchemy alembic"),
    "video": ("pygame", 'pip install -c constraints.txt -e ".[render]"'),
}


def check_dashboards(args: Namespace, env: str) -> None:
    """Check that what the command line asks for can be shown.

    Args:
        args: Of the command line.
        env: Registered name of the environment.

    Raises:
        ValueError: If a package is missing, or the environment cannot be filmed; says what to do.
    """
    for flag, (package, install) in _NEEDS.items():
        if getattr(args, flag) and find_spec(package) is None:
            raise ValueError(f"--{flag} needs {package}: {install}")
    if args.storage and args.mlflow and "MLFLOW_TRACKING_URI" not in os.environ:
        raise ValueError("--mlflow with results at a URL needs a server of MLflow: set MLFLOW_TRACKING_URI")
    if args.storage and args.wandb and os.environ.get("WANDB_MODE") == "offline":
        raise ValueError("--wandb with WANDB_MODE=offline needs a folder as --results-dir")
    if args.video and env.removeprefix("maobs/") not in SCENARIOS:
        raise ValueError(f"--video: {env} is not an environment of this package, so there are no pictures of it")


def make_callbacks(name: str, args: Namespace) -> list[tune.Callback]:
    """Return the callbacks that write for TensorBoard and, if asked for, for Weights & Biases and MLflow.

    Args:
        name: Of the experiment.
        args: Of the command line.
    """
    callbacks: list[tune.Callback] = [TensorBoard(video=args.video)]
    if args.wandb:
        from ray.air.integrations.wandb import WandbLoggerCallback

        class Wandb(_Grouped, WandbLoggerCallback):
            def log_film(self, trial: Any, path: Path, steps: int) -> None:
                import wandb

                film = {"episode": wandb.Video(str(path)), "training_iteration": steps}
                WandbLoggerCallback.log_trial_result(self, 0, trial, film)

        # It logs in processes of a Ray that may have been started before WANDB_MODE was set.
        mode = os.environ.get("WANDB_MODE")
        callbacks.append(Wandb(project=name, group=args.results_dir.name, dir=str(args.results_dir), mode=mode))
    if args.mlflow:
        from ray.air.integrations.mlflow import MLflowLoggerCallback

        # The program's own place comes first, as a server's.
        uri = os.environ.get("MLFLOW_TRACKING_URI", f"sqlite:///{args.results_dir / 'mlflow.db'}")

        class MLflow(_Grouped, MLflowLoggerCallback):
            def setup(self, *args_: Any, **info: Any) -> None:
                import mlflow

                self._client = mlflow.MlflowClient(uri)
                # Without a server MLflow would put films into the present folder.
                if "MLFLOW_TRACKING_URI" not in os.environ and self._client.get_experiment_by_name(name) is None:
                    self._client.create_experiment(name, (args.results_dir / "mlflow").absolute().as_uri())
                super().setup(*args_, **info)

            def log_film(self, trial: Any, path: Path, steps: int) -> None:
                self._client.log_artifact(self._trial_runs[trial], str(path), "episodes")

        callbacks.append(MLflow(tracking_uri=uri, experiment_name=name))
    return callbacks


def curves_of(result: Mapping[str, Any]) -> dict[str, float]:
    """Return what is worth a curve of one result, by group and name.

    Groups are `evaluation` (episodes without exploration noise), `train` (those with it), `loss` and `q` (means over
    the agents, and each agent's; `q/max`, the largest |Q| of a minibatch, and `q/limit`, the largest return that there
    can be by the rewards seen so far), `gradient` (norms), `rate` (learning rates) and `speed`.

    Args:
        result: What a trial reported.
    """
    curves = {f"evaluation/{name}": value for name, value in evaluation_metrics(result).items()}
    runners = result.get("env_runners", {})
    curves |= {f"train/{name}": value for name, value in runners.get("episode_metrics", {}).items()}
    if "episode_return_mean" in runners:
        curves["train/team_return"] = runners["episode_return_mean"]
    largest = []
    for agent, learned in result.get("learners", {}).items():
        for name, value in learned.items():
            if agent == "__all_modules__":
                if name.endswith("_learning_rate"):
                    curves[f"rate/{name.removesuffix('_learning_rate')}"] = value
                elif name.endswith("_gradient_norm"):
                    curves[f"gradient/{name.removesuffix('_gradient_norm')}"] = value
                elif name == "num_updates_skipped_lifetime":
                    curves["loss/updates_skipped"] = value
            elif name.endswith("_loss"):
                curves[f"loss/{name.removesuffix('_loss')}/{agent}"] = value
            elif name == "q_mean":
                curves[f"q/{agent}"] = value
            elif name == "q_max":
                largest.append(value)
    for group in ("loss/actor", "loss/critic", "q"):
        each = [value for name, value in curves.items() if name.startswith(f"{group}/")]
        curves |= {f"{group}/mean": sum(each) / len(each)} if each else {}
    if largest:
        curves["q/max"] = max(largest)
    if "q_limit" in (team := result.get("learners", {}).get("__all_modules__", {})):
        curves["q/limit"] = team["q_limit"]
    curves["speed/seconds_per_iteration"] = result["time_this_iter_s"]
    curves["speed/env_steps_per_s"] = result["env_runners"]["num_env_steps_sampled"] / result["time_this_iter_s"]
    curves["speed/hours"] = result["time_total_s"] / 3600
    # What has no value yet (no episode has ended, no update was made) is left out: loggers complain of NaN.
    return {name: float(value) for name, value in curves.items() if math.isfinite(value)}


def settings_of(config: Mapping[str, Any]) -> dict[str, bool | int | float | str]:
    """Return a trial's settings as one flat mapping: those of `training()` and the environment's among the others.

    Args:
        config: A `TrialSpec` as plain values.
    """
    nested = ("training", "env_config", "varied", "evaluation_env_config")

    def flat() -> Iterator[tuple[str, Any]]:
        yield from ((key, value) for key, value in config.items() if key not in nested)
        yield from config["training"].items()
        yield from ((f"env.{key}", value) for key, value in config["env_config"].items())

    return {key: value if isinstance(value, bool | int | float | str) else str(value) for key, value in flat()}


class _Grouped:
    """Hands a logger `curves_of` a result instead of the result, and the films that `TensorBoard` has made."""

    def log_trial_result(self, iteration: int, trial: Any, result: dict[str, Any]) -> None:
        """Log one result; its step is in env steps, by the names that MLflow and W&B look for."""
        steps = int(result[STEPS])
        shown = {**curves_of(result), "env_steps": steps, "timesteps_total": steps, "training_iteration": steps}
        super().log_trial_result(iteration, trial, shown)  # type: ignore[misc]

    def log_trial_save(self, trial: Any) -> None:
        """Show the film of the checkpoint that was written, if there is one."""
        super().log_trial_save(trial)  # type: ignore[misc]
        if (path := _film_path(trial)).exists():
            self.log_film(trial, path, int(trial.last_result[STEPS]))

    def log_film(self, trial: Any, path: Path, steps: int) -> None:
        """Log the film of a checkpoint after so many env steps."""
        raise NotImplementedError


def _film_path(trial: Any) -> Path:
    """Return where the film of a trial's last checkpoint is; `TensorBoard`, the first of the loggers, makes it."""
    return Path(trial.local_path) / f"episode-{int(trial.last_result[STEPS])}.gif"


class TensorBoard(TBXLoggerCallback):
    """Writes a trial's curves over env steps, its settings for HParams and, if asked for, a film per checkpoint.

    Args:
        video: Whether to film an episode of each checkpoint.
    """

    def __init__(self, *, video: bool = False) -> None:
        super().__init__()
        self._video = video

    def log_trial_result(self, iteration: int, trial: Any, result: dict[str, Any]) -> None:
        """Write the curves of one result."""
        if trial not in self._trial_writer:
            self.log_trial_start(trial)
        curves = curves_of(result)
        for name, value in curves.items():
            self._trial_writer[trial].add_scalar(name, value, global_step=int(result[STEPS]))
        self._trial_result[trial] = curves
        self._trial_writer[trial].flush()

    def log_trial_save(self, trial: Any) -> None:
        """Film the checkpoint that was written; a film that fails is no reason to fail."""
        if not self._video or trial not in self._trial_writer:
            return
        steps = int(trial.last_result[STEPS])
        path = _film_path(trial)
        try:
            with trial.checkpoint.as_directory() as folder:  # it may be at a URL
                film(TrialSpec(**trial.config), folder, path)
        except Exception as error:
            print(f"No film of {trial} at {steps:,} env steps: {str(error).partition(chr(10))[0]}", flush=True)
            return
        data = path.read_bytes()
        width, height = (int.from_bytes(data[at : at + 2], "little") for at in (6, 8))
        image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=data)
        summary = Summary(value=[Summary.Value(tag="episode", image=image)])
        self._trial_writer[trial].file_writer.add_summary(summary, steps)
        self._trial_writer[trial].flush()

    def log_trial_end(self, trial: Any, failed: bool = False) -> None:
        """Write the settings, and what came of them."""
        if trial not in self._trial_writer:
            return
        writer, last = self._trial_writer.pop(trial), self._trial_result.pop(trial, None)
        if last:
            shown = {name: last[name] for name in (f"evaluation/{SCORE}", "evaluation/coverage") if name in last}
            for summary in hparams(settings_of(trial.config), shown):
                writer.file_writer.add_summary(summary)
        writer.close()
