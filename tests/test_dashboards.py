"""What TensorBoard, Weights & Biases and MLflow are given."""

from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.io_wrapper import GetLogdirSubdirectories

from rllib_maobs.experiment import Experiment, decayed
from rllib_maobs.experiment import dashboards as dashboards_module
from rllib_maobs.experiment.arguments import make_parser, parse
from rllib_maobs.experiment.dashboards import TensorBoard, _Grouped, curves_of, settings_of
from rllib_maobs.experiment.keeping import keep_logs, put_back_logs
from rllib_maobs.experiment.report import STEPS
from rllib_maobs.experiment.trial import TrialSpec

EXPERIMENT = Experiment(
    name="demo", env="maobs/spread-3a", algorithms=("maddpg",), training={"actor_lr": decayed(1e-3)}, stop_timesteps=100
)


def spec() -> TrialSpec:
    given = ["--results-dir", "new", "--seeds", "7", "--sweep", "tau=0.25"]
    return EXPERIMENT.specs(parse(make_parser("demo", ["maddpg"], 100), "demo", given))[0]


def result(steps: int) -> dict[str, Any]:
    learned = {
        agent: {"critic_loss": 2.0 * number, "actor_loss": -1.0, "q_mean": -10.0 - number, "other": 5.0}
        for number, agent in enumerate(("agent_0", "agent_1"))
    }
    return {
        STEPS: float(steps),
        "training_iteration": 3,
        "time_this_iter_s": 2.0,
        "time_total_s": 1800.0,
        "env_runners": {
            "episode_metrics": {"coverage": 0.25},
            "episode_return_mean": -9.0,
            "num_env_steps_sampled": 100.0,
        },
        "learners": {"__all_modules__": {"actor_learning_rate": 1e-3, "num_updates_lifetime": 4}, **learned},
        "evaluation": {
            "env_runners": {
                "agent_episode_returns_mean": {"agent_0": -3.0, "agent_1": -4.0},
                "episode_metrics": {"coverage": 0.5, "collisions_agents": 2.0},
            }
        },
    }


def test_what_has_no_value_yet_is_no_point_of_a_curve() -> None:
    early = result(100)
    early["env_runners"]["episode_metrics"]["coverage"] = float("nan")
    assert {*curves_of(result(100))} - {*curves_of(early)} == {"train/coverage"}


def test_curves_are_grouped_and_named() -> None:
    assert curves_of(result(100)) == {
        "evaluation/score": -3.0,
        "evaluation/coverage": 0.5,
        "evaluation/collisions_agents": 2.0,
        "evaluation/collisions": 2.0,
        "train/coverage": 0.25,
        "train/team_return": -9.0,
        "loss/critic/agent_0": 0.0,
        "loss/critic/agent_1": 2.0,
        "loss/critic/mean": 1.0,
        "loss/actor/agent_0": -1.0,
        "loss/actor/agent_1": -1.0,
        "loss/actor/mean": -1.0,
        "q/agent_0": -10.0,
        "q/agent_1": -11.0,
        "q/mean": -10.5,
        "rate/actor": 1e-3,
        "speed/seconds_per_iteration": 2.0,
        "speed/env_steps_per_s": 50.0,
        "speed/hours": 0.5,
    }


def test_settings_are_flat_and_plain() -> None:
    settings = settings_of(asdict(spec()))
    assert (settings["algorithm"], settings["seed"], settings["tau"]) == ("maddpg,tau=0.25", 7, 0.25)
    assert settings["env.horizon"] == 100 and settings["actor_lr"] == "[[0, 0.001], [50, 0.001], [100, 5e-05]]"
    assert all(isinstance(value, bool | int | float | str) for value in settings.values())


def written(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder))
    events.Reload()
    return events


@pytest.fixture
def trial(tmp_path: Path) -> SimpleNamespace:
    class FakeTrial(SimpleNamespace):
        __hash__ = object.__hash__

        def init_local_path(self) -> None:
            pass

    path = str(tmp_path)
    config, checkpoint = asdict(spec()), SimpleNamespace(as_directory=lambda: nullcontext("a checkpoint"))
    return FakeTrial(local_path=path, config=config, checkpoint=checkpoint, last_result=result(200))


def test_tensorboard_counts_env_steps(trial: SimpleNamespace, tmp_path: Path) -> None:
    board = TensorBoard()
    for iteration, steps in ((1, 100), (2, 200)):
        board.log_trial_result(iteration, trial, result(steps))
    board.log_trial_save(trial)  # films were not asked for
    board.log_trial_end(trial)
    board.log_trial_end(trial)  # as after an error, when nothing was begun
    events = written(tmp_path)
    tags = events.Tags()
    assert {*tags["scalars"]} >= {*curves_of(result(1))} and not tags["images"]
    assert [(event.step, event.value) for event in events.Scalars("evaluation/score")] == [(100, -3.0), (200, -3.0)]
    data = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    assert b"tau" in data and b"maddpg,tau=0.25" in data


def test_tensorboard_shows_a_trial_once(trial: SimpleNamespace, tmp_path: Path) -> None:
    """Checkpoints hold copies of its logs, for runs that are killed: they are no runs."""
    board, checkpoint = TensorBoard(), tmp_path / "checkpoint_000000"
    checkpoint.mkdir()
    board.log_trial_result(1, trial, result(100))
    keep_logs(checkpoint, tmp_path)
    (log,) = tmp_path.glob("*tfevents*")
    saved = log.read_bytes()
    board.log_trial_result(2, trial, result(200))
    board.log_trial_end(trial)
    assert [*GetLogdirSubdirectories(str(tmp_path))] == [str(tmp_path)]
    assert log.read_bytes() != saved
    put_back_logs(checkpoint, tmp_path)
    assert [*tmp_path.glob("events*")] == [log] and log.read_bytes() == saved


def test_checkpoints_are_filmed_on_request(
    trial: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def film(which: TrialSpec, checkpoint: str, path: Path) -> None:
        assert which == spec() and checkpoint == "a checkpoint"
        Image.new("RGB", (30, 20)).save(path)

    monkeypatch.setattr(dashboards_module, "film", film)
    board = TensorBoard(video=True)
    board.log_trial_result(1, trial, result(200))
    board.log_trial_save(trial)
    board.log_trial_end(trial)
    (image,) = written(tmp_path).Images("episode")
    assert (image.step, image.width, image.height) == (200, 30, 20)
    assert image.encoded_image_string == (tmp_path / "episode-200.gif").read_bytes()

    def fail(*args: Any) -> None:
        raise OSError("no space")

    monkeypatch.setattr(dashboards_module, "film", fail)
    board.log_trial_result(1, trial, result(200))
    board.log_trial_save(trial)
    assert "at 200 env steps: no space" in capsys.readouterr().out


def test_other_loggers_get_the_same_curves_and_films(trial: SimpleNamespace, tmp_path: Path) -> None:
    logged: list[Any] = []

    class Logger:
        def log_trial_result(self, iteration: int, trial: Any, result: dict[str, Any]) -> None:
            logged.append((iteration, trial, result))

        def log_trial_save(self, trial: Any) -> None:
            logged.append(trial)

    class Grouped(_Grouped, Logger):
        def log_film(self, *film: Any) -> None:
            logged.append(film)

    board = Grouped()
    board.log_trial_result(3, trial, result(200))
    board.log_trial_save(trial)  # there is no film
    (tmp_path / "episode-200.gif").touch()
    board.log_trial_save(trial)
    steps = {"env_steps": 200, "timesteps_total": 200, "training_iteration": 200}
    film = (trial, tmp_path / "episode-200.gif", 200)
    assert logged == [(3, trial, {**curves_of(result(200)), **steps}), trial, trial, film]


@pytest.mark.parametrize(
    ("flag", "missing", "message"),
    [
        ("--wandb", "wandb", "error: --wandb needs wandb: pip install wandb"),
        ("--mlflow", "mlflow", "error: --mlflow needs mlflow: pip install mlflow-skinny sqlalchemy alembic"),
        ("--video", "pygame", '--video needs pygame: pip install -c constraints.txt -e ".[render]"'),
        ("--video", "nothing", "--video: my_env is not an environment of this package"),
    ],
)
def test_what_is_missing_is_named(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    flag: str,
    missing: str,
    message: str,
) -> None:
    monkeypatch.setattr(dashboards_module, "find_spec", lambda name: None if name == missing else True)
    experiment = Experiment(name="demo", env="my_env", algorithms=("maddpg",), training={})
    with pytest.raises(SystemExit) as end:
        experiment.main([flag, "--results-dir", str(tmp_path / "new")])
    assert end.value.code == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_weights_and_biases_works_offline(
    ray_session: None, trial: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And MLflow; both where they are installed, with what Tune calls them with."""
    pytest.importorskip("wandb")
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.setenv("WANDB_MODE", "offline")
    given = ["--results-dir", str(tmp_path / "new"), "--wandb", "--mlflow", "--video", "--algos", "maddpg", "--quick"]
    small = {"num_random_steps": 16, "num_steps_sampled_before_learning_starts": 16, "num_envs_per_env_runner": 4}
    quick = {"stop_timesteps": 24, "steps_per_iteration": 24, "evaluation_duration": 1}
    row = {"algorithm": "maddpg", **small, "train_batch_size_per_learner": 8, "quick": quick}
    Experiment(name="demo", env="maobs/spread-3a", algorithms=("maddpg",), variants={"maddpg": row}, training={}).main(
        [*given, "--no-compile"]
    )
    assert list((tmp_path / "new" / "wandb").glob("offline-run-*/*.wandb"))
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'new' / 'mlflow.db'}")
    (experiment,) = [each for each in client.search_experiments() if each.name == "demo"]
    (run,) = client.search_runs([experiment.experiment_id])
    (point,) = client.get_metric_history(run.info.run_id, "evaluation/score")
    assert point.step == 24 and run.data.params["algorithm"] == "maddpg"
    (film,) = (tmp_path / "new" / "wandb").glob("offline-run-*/files/media/videos/episode_24_*.gif")
    (artifact,) = client.list_artifacts(run.info.run_id, "episodes")
    assert artifact.path == "episodes/episode-24.gif" and artifact.file_size == film.stat().st_size > 0
    assert not Path("mlruns").exists()
