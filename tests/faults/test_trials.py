"""Trials that fail under Tune: which go on, from where, and what becomes of the others."""

import json
import os
import signal
from collections import Counter
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from ray import cloudpickle, tune
from ray.exceptions import RayTaskError

from rllib_maobs.envs import MAObsEnv
from rllib_maobs.experiment import Experiment, load_curves
from rllib_maobs.experiment.report import STEPS
from rllib_maobs.experiment.retries import Retries
from rllib_maobs.experiment.trial import Trial
from tests.test_experiment import parsed
from tests.test_extending import SMALL, timeless


class Fragile:
    """spread-3a, copy by copy; in training something happens at step 15 of copy 0, the first time or each time."""

    def __init__(self, config: dict) -> None:
        self.what, self.diary = config.pop("what", ""), Path(config.pop("diary", ""))
        trained = config["horizon"] == 50 and getattr(config, "vector_index", 0) == 0
        self.what, self.steps = self.what if trained else "", 0
        self.env = MAObsEnv({"scenario": "spread-3a", **config})
        self.possible_agents, self.agents = self.env.possible_agents, self.env.agents
        self.observation_spaces, self.action_spaces = self.env.observation_spaces, self.env.action_spaces
        self.observation_space, self.action_space = self.observation_spaces.get, self.action_spaces.get
        self.reset = self.env.reset

    def step(self, actions: dict) -> Any:
        self.steps += 1
        if self.what and self.steps == 15:
            with self.diary.open("a") as file:
                print(os.getpid(), file=file)
            first = len(self.diary.read_text().split()) == 1
            if self.what == "dies" and first:
                os.kill(os.getpid(), signal.SIGKILL)
            if self.what == "raises" and first:
                raise KeyError("lidar")
            if self.what == "illegal":
                raise ValueError("no such lidar")
        return self.env.step(actions)

    def close(self) -> None:
        self.env.close()


def experiment(folder: Path, *rows: str) -> Experiment:
    """Rows that do the same, but for what happens to them."""
    quick = {"stop_timesteps": 96, "steps_per_iteration": 24, "evaluation_duration": 1}
    return Experiment(
        name="fragile",
        env="fragile",
        algorithms=rows,
        variants={
            row: {
                "algorithm": "iddpg",
                **SMALL,
                "train_horizon": 50,
                "env_config": {"what": row, "diary": str(folder / row)},
                "quick": quick,
            }
            for row in rows
        },
        training={"tau": 0.05},
    )


def results_of(folder: Path, trial: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / f"{trial}-seed0" / "result.json").read_text().splitlines()]


def test_trials_that_die_or_raise_go_on_and_the_others_do_not_notice(
    ray_session: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], long: bool, tally: Counter[str]
) -> None:
    tune.register_env("fragile", Fragile)
    fail = ["dies", "raises"] if long else ["dies"]
    fragile = experiment(tmp_path, *fail, "steady", *(["illegal"] if long else []))
    args = ["--results-dir", str(tmp_path / "results"), "--quick", "--no-compile", "--checkpoint-freq", "1"]
    with pytest.raises(SystemExit, match="1") if long else nullcontext():
        fragile.main(args)
    out = capsys.readouterr().out
    assert "goes on from its last checkpoint, 2 times at most (--max-failures)" in out
    curves = load_curves(tmp_path / "results").groupby("trial")["env_steps"]
    steady = results_of(tmp_path / "results", "steady")
    assert len({line["pid"] for line in steady}) == 1 and [line[STEPS] for line in steady] == [24, 48, 72, 96]
    for trial in fail:
        results = results_of(tmp_path / "results", trial)
        assert curves.get_group(f"{trial}-seed0").tolist() == [24, 48, 72, 96]
        # Its second process went on from a checkpoint, and to the bit as if nothing had happened.
        assert len({line["pid"] for line in results}) == 2
        assert results[-1]["iterations_since_restore"] < results[-1]["training_iteration"] == 4
        assert timeless(results[-1]) == timeless(steady[-1])
        tally["trials that died or raised, and went on"] += 1
    assert "dies-seed0 failed (ActorDiedError: " in out
    assert "goes on from its last checkpoint; it may fail 1 more times (--max-failures)" in out
    if long:  # What would come again was tried once, in one process, and is the error that is reported.
        assert "illegal-seed0 failed (ValueError: no such lidar), as it would again" in out
        assert "FAILED: illegal-seed0" in out and len((tmp_path / "illegal").read_text().split()) == 1
        assert "ValueError: no such lidar" in (tmp_path / "results" / "illegal-seed0" / "error.txt").read_text()


def test_an_error_that_would_come_again_comes_again_at_once(
    ray_session: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the process that Tune starts next, before it builds anything; a resumed run tries in earnest."""
    tune.register_env("fragile", Fragile)
    (spec,) = experiment(tmp_path, "illegal").specs(parsed(experiment(tmp_path, "illegal"), "--quick", "--no-compile"))
    monkeypatch.setattr(Trial, "logdir", str(tmp_path))  # that of Tune stays the same, too
    trial = Trial(asdict(spec))
    with pytest.raises(ValueError, match="no such lidar"):
        for _ in range(4):
            trial.train()
    trial.stop()
    with pytest.raises(ValueError, match="no such lidar"):
        Trial({})
    again = Trial(asdict(spec))
    assert again.train()[STEPS] == 24
    again.stop()


def failed(error: Exception, folder: Path, failures: int = 1) -> Any:
    """A trial as Tune shows it to callbacks after a failure."""
    (folder / "error.pkl").write_bytes(cloudpickle.dumps(RayTaskError("train", "In its process ...", error)))
    return SimpleNamespace(
        trial_id="a",
        num_failures=failures,
        max_failures=0,
        pickled_error_file=str(folder / "error.pkl"),
        has_checkpoint=lambda: False,
        __str__=lambda: "a",
    )


def test_failures_are_counted_anew_in_each_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trial, retries = failed(KeyError("lidar"), tmp_path, failures=7), Retries(2)
    retries.on_step_begin(1, [trial])
    assert trial.max_failures == 9
    trial.num_failures = 8
    retries.on_step_begin(2, [trial])
    retries.on_trial_recover(2, [trial], trial)
    assert trial.max_failures == 9
    assert (
        "failed (KeyError: 'lidar') and starts anew: it has no checkpoint; it may fail 1 more"
        in capsys.readouterr().out
    )
    failed(FloatingPointError("critic_loss is inf"), tmp_path)
    retries.on_trial_recover(3, [trial], trial)
    assert trial.max_failures == 8 and "inf), as it would again" in capsys.readouterr().out
    trial.pickled_error_file = None
    retries.on_trial_recover(3, [trial], trial)
    assert "failed (RuntimeError: see its error.txt)" in capsys.readouterr().out
