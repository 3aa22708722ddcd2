"""Finished runs that become longer, or get more seeds and algorithms; nothing that was computed is lost."""

import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
import torch
from ray.rllib.core.rl_module import RLModule
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from rllib_maobs.checkpoints import find_checkpoint
from rllib_maobs.experiment import Experiment, decayed, load_curves
from rllib_maobs.experiment.arguments import make_parser, parse
from rllib_maobs.experiment.report import STEPS
from rllib_maobs.experiment.resume import Grid, StateError, known_trials, lengthen
from rllib_maobs.experiment.trial import Trial

SMALL = {
    "num_random_steps": 16,
    "num_steps_sampled_before_learning_starts": 16,
    "train_batch_size_per_learner": 8,
    "num_envs_per_env_runner": 4,
    "quick": {"stop_timesteps": 48, "steps_per_iteration": 24, "evaluation_duration": 1},
}
EXPERIMENT = Experiment(
    name="demo",
    env="maobs/spread-3a",
    algorithms=("iddpg", "maddpg"),
    variants={name: {"algorithm": name, **SMALL} for name in ("iddpg", "maddpg")},
    training={"tau": 0.05},
    stop_timesteps=1000,
)


def arguments(folder: Path, *given: str, experiment: Experiment = EXPERIMENT) -> Any:
    parser = make_parser("demo", experiment.algorithms, 1000)
    return parse(parser, "demo", ["--results-dir", str(folder), *given])


def timeless(result: dict[str, Any]) -> str:
    """What a result says of training and evaluation, as text (NaN is NaN), but for how fast the machine was."""
    evaluated, trained = result["evaluation"]["env_runners"], result["learners"]
    learned = {agent: values for agent, values in trained.items() if agent.startswith("agent_")}
    return json.dumps([evaluated["episode_metrics"], result["score"], learned], sort_keys=True, default=float)


@pytest.fixture(scope="module")
def run(ray_session: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimpleNamespace]:
    """A quick run of two iterations, made twice as long, and then given a seed and an algorithm."""
    folder = tmp_path_factory.mktemp("run") / "a [small] run"
    where = ["--results-dir", str(folder)]
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("rllib_maobs.experiment.run.film_best", lambda *args: "")
        EXPERIMENT.main([*where, "--quick", "--no-compile", "--algos", "iddpg"])
        first = (folder / "iddpg-seed0" / "result.json").read_text()
        EXPERIMENT.main([*where, "--resume", "--stop-timesteps", "96"])
        longer = (folder / "iddpg-seed0" / "result.json").read_text()
        yield SimpleNamespace(folder=folder, where=where, first=first, longer=longer)


def test_a_longer_run_is_as_one_of_that_length(run: SimpleNamespace) -> None:
    """To the bit: the results of every iteration, and the networks."""
    assert run.longer.startswith(run.first)  # nothing is written over
    args = arguments(run.folder.parent / "new", "--quick", "--no-compile", "--algos", "iddpg", "--stop-timesteps", "96")
    (spec,) = EXPERIMENT.specs(args)
    trial = Trial(config=asdict(spec))
    try:
        whole = [trial.train() for _ in range(4)]
        weights = trial._algorithm.learner_group._learner.module["agent_1"].unwrapped().state_dict()
    finally:
        trial.stop()
    lines = [json.loads(line) for line in run.longer.splitlines()]
    assert [line[STEPS] for line in lines] == [24, 48, 72, 96]
    assert [line["done"] for line in lines] == [False, True, False, True]
    assert "critic_loss" in lines[-1]["learners"]["agent_1"]
    for line, result in zip(lines, whole, strict=True):
        assert timeless(line) == timeless(result)
    module = find_checkpoint(run.folder / "iddpg-seed0") / "learner_group" / "learner" / "rl_module" / "agent_1"
    there = RLModule.from_checkpoint(module).state_dict()
    assert all(torch.equal(there[name], value) for name, value in weights.items()) and there.keys() == weights.keys()


def test_tensorboard_goes_on_too(run: SimpleNamespace) -> None:
    events = EventAccumulator(str(run.folder / "iddpg-seed0"))
    events.Reload()
    assert [event.step for event in events.Scalars("evaluation/score")] == [24, 48, 72, 96]


def test_seeds_and_algorithms_are_added(run: SimpleNamespace, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("rllib_maobs.experiment.run.film_best", lambda *args: "")
        EXPERIMENT.main([*run.where, "--add-algos", "maddpg"])
    said = capsys.readouterr().out
    assert "2 trials; 1 have no result yet, 0 go on for longer.\nEstimated: 0.00 hours" in said
    curves = load_curves(run.folder)
    assert sorted(curves["trial"].unique()) == ["iddpg-seed0", "maddpg-seed0"]
    assert (curves.groupby("trial")["env_steps"].max() == 96).all()  # as long as the others are by now
    assert (run.folder / "iddpg-seed0" / "result.json").read_text() == run.longer
    assert sorted(pd.read_csv(run.folder / "comparison.csv")["algorithm"]) == ["iddpg", "maddpg"]
    args = arguments(run.folder, "--resume", "--stop-timesteps", "96")  # as after an interruption
    assert (args.seeds, args.algos, args.stop_timesteps, args.lengthened_to) == ([0], ["iddpg", "maddpg"], None, 96)
    args = arguments(run.folder, "--add-seeds", "5")
    names = [spec.name for spec in EXPERIMENT.specs(args)]
    assert names == ["iddpg-seed0", "maddpg-seed0", "iddpg-seed5", "maddpg-seed5"] and args.resume


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("--resume --stop-timesteps 95", "--stop-timesteps: 95 is less than the 96 that the trials have"),
        ("--add-seeds 0", "--add-seeds: 0 is there already; --resume goes on with it"),
        ("--add-algos iddpg", "--add-algos: iddpg is there already"),
        ("--add-seeds 7 7", "--add-seeds: 7 7 names one of them twice"),
        ("--resume --checkpoint-freq 3", "--checkpoint-freq: the original run has 2, and --resume continues it"),
    ],
)
def test_what_cannot_be_added(
    run: SimpleNamespace, capsys: pytest.CaptureFixture[str], given: str, message: str
) -> None:
    before = (run.folder / "experiment.json").read_text()
    with pytest.raises(SystemExit) as end:
        EXPERIMENT.main([*run.where, *given.split()])
    assert end.value.code == 2 and message in capsys.readouterr().err
    assert (run.folder / "experiment.json").read_text() == before


def test_a_state_that_tune_cannot_read_starts_nothing(
    run: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tune itself would start all trials once more, beside the old ones."""

    def fail(self: Grid, dirpath: str) -> None:
        raise OSError("no space")

    monkeypatch.setattr(Grid, "restore_from_dir", fail)
    before = sorted(path.name for path in run.folder.iterdir() if "basic-variant" not in path.name)
    with pytest.raises(SystemExit) as end:
        EXPERIMENT.main([*run.where, "--resume", "--stop-timesteps", "200"])
    assert "error: Ray Tune could not restore the state of this run" in str(end.value.code)
    assert sorted(path.name for path in run.folder.iterdir() if "basic-variant" not in path.name) == before


# --- Without a run ------------------------------------------------------------------------------------------------


def stored(folder: Path, **settings: Any) -> Path:
    args = arguments(folder, "--seeds", "0")
    kept = {name: value for name, value in vars(args).items() if not name.startswith(("results_dir", "resume", "add_"))}
    folder.mkdir()
    (folder / "experiment.json").write_text(json.dumps({"experiment": "demo", **kept, **settings}))
    (folder / "iddpg-seed0").mkdir()
    return folder


def test_rates_that_fall_stay_where_the_first_length_ended(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    falling = replace(EXPERIMENT, training={"actor_lr": decayed(1e-3)}, variants={})
    folder = stored(tmp_path / "a")
    args = arguments(folder, "--resume", "--stop-timesteps", "4000", "--add-seeds", "1")
    first, _, added, _ = falling.specs(args)
    assert (first.stop_timesteps, added.stop_timesteps) == (4000, 4000)
    assert first.training["actor_lr"] == added.training["actor_lr"] == [[0, 1e-3], [500, 1e-3], [1000, 5e-5]]
    falling._print_kept(args)
    assert "iddpg: actor_lr fall as in the first run, and stay where they ended there.\n" in capsys.readouterr().out


def test_only_shorter_trials_become_longer(tmp_path: Path) -> None:
    rows = replace(EXPERIMENT, variants={"maddpg": {"algorithm": "maddpg", "stop_timesteps": 9000}})
    args = arguments(stored(tmp_path / "a"), "--resume", "--stop-timesteps", "4000", experiment=rows)
    assert [spec.stop_timesteps for spec in rows.specs(args)] == [4000, 9000]
    args = arguments(tmp_path / "a", "--resume", "--stop-timesteps", "400", experiment=rows)
    with pytest.raises(ValueError, match="--stop-timesteps: 400 is less than the 1,000 that trials have"):
        rows.specs(args)


def state(folder: Path, **changes: Any) -> Path:
    """What Tune saves, as far as it is read: two trials that have ended, of which some fields are others."""
    trials = [
        {"status": "TERMINATED", "config": {"algorithm": "a", "seed": seed, "stop_timesteps": 10}} | changes
        for seed in (0, 1)
    ]
    path = folder / "experiment_state-1.json"
    path.write_text(json.dumps({"trial_data": [[json.dumps(each), "{}"] for each in trials], "runner_data": {}}))
    return path


def test_what_lengthen_changes(tmp_path: Path) -> None:
    path = state(tmp_path)
    assert known_trials(tmp_path) == {"a-seed0", "a-seed1"}
    before = path.read_text()
    assert lengthen(tmp_path, {"a-seed0": 10, "a-seed1": 5}) == []
    assert path.read_text() == before
    assert lengthen(tmp_path, {"a-seed0": 10, "a-seed1": 20, "b-seed0": 30}) == ["a-seed1"]
    first, second = [json.loads(trial) for trial, _ in json.loads(path.read_text())["trial_data"]]
    assert (first["status"], first["config"]["stop_timesteps"]) == ("TERMINATED", 10)
    assert (second["status"], second["config"]["stop_timesteps"]) == ("PENDING", 20)
    state(tmp_path, status="ERROR")
    assert len(lengthen(tmp_path, {"a-seed1": 20})) == 1
    assert [json.loads(trial)["status"] for trial, _ in json.loads(path.read_text())["trial_data"]] == ["ERROR"] * 2


def test_a_state_of_another_release_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StateError, match="holds no state of Ray Tune"):
        known_trials(tmp_path)
    for wrong in ({"config": {}}, {"config": None}, {"config": {"stop": 1}}):
        path = state(tmp_path, **wrong)
        with pytest.raises(StateError, match=r"experiment_state-1.json does not look as Ray 2\.60 writes it"):
            lengthen(tmp_path, {"a-seed0": 20})
    path.write_text("half a fi")
    with pytest.raises(StateError, match="does not look as"):
        known_trials(tmp_path)
