"""Sweeps and searches: settings by name, what they make of the rows, and Optuna's proposals."""

import pickle
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from rllib_maobs.experiment import Experiment, decayed, fading
from rllib_maobs.experiment.arguments import make_parser, parse
from rllib_maobs.experiment.plan import _costs, print_plan
from rllib_maobs.experiment.report import STEPS
from rllib_maobs.experiment.resume import StateError
from rllib_maobs.experiment.search import Search, Space, stopping
from rllib_maobs.experiment.sweep import Interval, name_of, parse_sweep, points
from rllib_maobs.experiment.trial import Trial

SMALL = {"num_random_steps": 40, "num_steps_sampled_before_learning_starts": 40, "train_batch_size_per_learner": 8}
EXPERIMENT = Experiment(
    name="demo",
    env="maobs/spread-3a",
    algorithms=("iddpg", "maddpg-lstm", "falling"),
    variants={
        "falling": {
            "algorithm": "maddpg",
            "critic_lr": decayed(1e-3),
            "exploration": fading(epsilon=0.1, noise=0.2, final=0.02),
            "train_env_config": {"agent_collision_penalty": 3.0},
            "quick": {"stop_timesteps": 100, "steps_per_iteration": 100, "evaluation_duration": 1},
        }
    },
    training={**SMALL, "actor_lr": 1e-3},
    stop_timesteps=1000,
)


def arguments(*given: str) -> Any:
    parser = make_parser("demo", EXPERIMENT.algorithms, 1000)
    return parse(parser, "demo", ["--results-dir", "new", *given])


def specs(*given: str) -> list[Any]:
    return EXPERIMENT.specs(arguments("--seeds", "7", *given))


def test_values_are_what_they_look_like() -> None:
    text = ["a=1,2.5,1e-3,1/8,.5", "b=true,False,none", "c=mlp,NaN,1/0", "d=1..10", "e=1e-4..1e-2"]
    assert parse_sweep(text, intervals=True) == {
        "a": [1, 2.5, 1e-3, 0.125, 0.5],
        "b": [True, False, None],
        "c": ["mlp", "NaN", "1/0"],
        "d": Interval(1, 10),
        "e": Interval(1e-4, 1e-2),
    }
    assert [type(value) for value in parse_sweep(["a=1,1.0e0"[:3], "b=2.0"], intervals=False)["a"]] == [int]
    assert Interval(1, 10).logarithmic and not Interval(1, 9).logarithmic and not Interval(0, 9).logarithmic


def test_all_combinations_are_tried() -> None:
    both = points({"a": [1, 2], "b": [3, 4]})
    assert both == [{"a": 1, "b": 3}, {"a": 1, "b": 4}, {"a": 2, "b": 3}, {"a": 2, "b": 4}]
    assert points({}) == [{}]
    assert name_of("row", {"lr": 0.0003, "x": "a/b"}) == "row,lr=0.0003,x=a_b"


def test_rows_get_what_means_something_to_them() -> None:
    rows = specs("--sweep", "seq_length=3,5", "tau=0.01,0.02")
    assert [spec.name for spec in rows] == [
        "iddpg,tau=0.01-seed7",
        "iddpg,tau=0.02-seed7",
        *(f"maddpg-lstm,seq_length={length},tau={tau}-seed7" for length in (3, 5) for tau in ("0.01", "0.02")),
        "falling,tau=0.01-seed7",
        "falling,tau=0.02-seed7",
    ]
    lstm = rows[3]
    assert lstm.varied == {"seq_length": 3, "tau": 0.02}
    assert lstm.build_config().tau == 0.02 and lstm.build_config().seq_length == 3
    # One setting of a sweep may be what gives another one a meaning.
    pairs = specs("--algos", "falling", "--sweep", "actor=mlp,lstm", "seq_length=2,3")
    assert [spec.varied for spec in pairs] == [
        {"actor": "mlp"},
        {"actor": "lstm", "seq_length": 2},
        {"actor": "lstm", "seq_length": 3},
    ]


def test_without_settings_it_is_the_paper_s_tables() -> None:
    rows = specs("--sweep")
    assert len(rows) == 6 + 12 + 6
    assert {spec.build_config().train_batch_size_per_learner for spec in rows} == {32, 128, 256}
    assert {spec.training["seq_length"] for spec in rows if "lstm" in spec.name} == {3, 5}
    assert {spec.training["critic_lr"] for spec in rows if "iddpg" in spec.name} == {1e-2, 1e-3}
    assert len({spec.name for spec in rows}) == len(rows)


def test_what_falls_keeps_its_shape() -> None:
    given = ["critic_lr=0.002", "exploration.noise=0.3", "env_config.num_obstacles=5"]
    given += ["train_env_config.obstacle_collision_penalty=4"]
    (spec,) = specs("--algos", "falling", "--sweep", *given)
    assert spec.training["critic_lr"] == [[0, 2e-3], [500, 2e-3], [1000, pytest.approx(1e-4)]]
    (before,) = specs("--algos", "falling")
    assert spec.training["exploration"] == {**before.training["exploration"], "noise": 0.3}
    assert spec.training["actor_lr"] == 1e-3
    assert spec.env_config["num_obstacles"] == spec.evaluation_options["num_obstacles"] == 5
    trained, played = spec.env_config, spec.evaluation_options
    assert [trained[f"{what}_collision_penalty"] for what in ("agent", "obstacle")] == [3.0, 4]
    assert [played[f"{what}_collision_penalty"] for what in ("agent", "obstacle")] == [1.0, 1.0]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("--sweep actr_lr=1,2", "--sweep: no row has a setting 'actr_lr' (did you mean 'actor_lr'?); legal are env_c"),
        ("--sweep tau", "--sweep: 'tau' is not of the form SETTING=VALUE,VALUE, such as actor_lr=1e-3,3e-4"),
        ("--sweep tau=1,,2", "--sweep: 'tau=1,,2' is not of the form"),
        ("--sweep tau=0.1 tau=0.2", "--sweep: tau is there twice"),
        ("--sweep tau=0.1,1e-1", "--sweep: tau=0.1,1e-1 has the same value twice"),
        ("--sweep tau=0.1..0.2", "--sweep: tau=0.1..0.2 is a range, which only --search takes"),
        ("--search optuna --sweep tau=0.2..0.1", "--sweep: tau=0.2..0.1 is no range; legal: two numbers, the lower"),
        ("--search optuna --sweep tau=0.5..2", "tau=2 is illegal; legal: a number > 0 and <= 1"),
        ("--search optuna --seeds 1 2", "--seeds: a search has one seed"),
        ("--sweep tau=0.5,2", "tau=2 is illegal; legal: a number > 0 and <= 1"),
        ("--sweep tau.x=2", "--sweep: tau has no options, so there is no tau.x"),
        ("--sweep env_config=2", "--sweep: env_config is a mapping; name one of its options, as in env_config.OPTION"),
        ("--sweep env_config.num_obstacle=2", "no option 'num_obstacle' (did you mean 'num_obstacles'?)"),
        ("--sweep seq_length=2,3 --algos iddpg", "--sweep: the length of windows needs a recurrent actor"),
        ("--sweep steps_per_iteration=0", "steps_per_iteration=0 is illegal; legal: an integer >= 1"),
    ],
)
def test_wrong_sweeps_say_what_is_legal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], given: str, message: str
) -> None:
    with pytest.raises(SystemExit) as end:
        EXPERIMENT.main([*given.split(), "--no-compile", "--results-dir", str(tmp_path / "new")])
    assert end.value.code == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_missing_optuna_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rllib_maobs.experiment.search.find_spec", lambda name: None)
    with pytest.raises(SystemExit):
        EXPERIMENT.main(["--search", "optuna", "--results-dir", str(tmp_path / "new")])
    assert '--search optuna needs Optuna: pip install -c constraints.txt -e ".[search]"' in capsys.readouterr().err


def test_rates_cost_no_time_and_batches_do() -> None:
    slow, fast = specs("--algos", "iddpg", "--sweep", "actor_lr=1,2"), specs("--algos", "iddpg", "--sweep")
    assert len({_costs(spec) for spec in slow}) == 1 and len({_costs(spec) for spec in fast}) == 3


def test_the_plan_counts_the_trials(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("rllib_maobs.experiment.plan._measured", lambda args, specs, count: ({}, f"{count} measured"))
    args = arguments("--algos", "iddpg", "--quick", "--seeds", "1", "2", "--sweep", "tau=0.1,0.2,0.3")
    print_plan("demo", args, EXPERIMENT.specs(args))
    plan = capsys.readouterr().out
    assert "demo: 6 trials, iddpg with seed 1, 2\nEach with what it takes of the sweep: 3 rows" in plan
    assert "6 measured" in plan and "iddpg,tau=0.2 " in plan and "start from" not in plan
    args.start_from = "three/checkpoint_000001"
    print_plan("demo", args, EXPERIMENT.specs(args))
    assert "\nNetworks start from three/checkpoint_000001\n" in capsys.readouterr().out
    args = arguments("--algos", "iddpg", "--quick", "--search", "optuna", "--num-samples", "9")
    print_plan("demo", args, EXPERIMENT.specs(args))
    assert "demo: 9 trials, iddpg with seed 0\nOptuna chooses" in capsys.readouterr().out


# --- Search -------------------------------------------------------------------------------------------------------


def make_search(resumed: bool = False) -> Search:
    rows = {"a": {"lr": Interval(1e-4, 1e-2), "size": Interval(2, 4)}, "b": {"kind": ["x", None]}}
    return Search(Space(rows), lambda *config: {"config": config}, seed=3, resumed=resumed)


def proposals(search: Search, count: int, begin: int = 0) -> list[Any]:
    found = []
    for trial in map(str, range(begin, begin + count)):
        found.append(search.suggest(trial)["config"])
        search.on_trial_complete(trial, {"score": float(found[-1][1] == "a")})
    return found


def test_proposals_are_of_one_row_and_within_its_values() -> None:
    found = proposals(make_search(), 30)
    assert [number for number, _, _ in found] == list(range(1, 31))
    for _, row, point in found:
        if row == "a":
            assert 1e-4 <= point["lr"] <= 1e-2 and point["size"] in (2, 3, 4) and len(point) == 2
        else:
            assert point.keys() == {"kind"} and point["kind"] in ("x", None)
    assert {row for _, row, _ in found} == {"a", "b"}
    assert sum(row == "a" for _, row, _ in found[15:]) > 10  # it has learned which row is better


def test_a_search_goes_on_where_it_was(tmp_path: Path) -> None:
    whole, first, second = make_search(), make_search(), make_search(resumed=True)
    expected = proposals(whole, 14)
    assert proposals(first, 12) == expected[:12]
    first.save(str(tmp_path / "state"))
    with pytest.raises(StateError, match="Ray Tune could not restore the state"):
        second.suggest("12")
    second.restore(str(tmp_path / "state"))
    assert proposals(second, 2, begin=12) == expected[12:]
    assert proposals(first, 2, begin=12) == expected[12:]  # saving has not harmed it
    assert pickle.loads((tmp_path / "state").read_bytes()).keys().isdisjoint({"_make_config"})


def test_a_trial_s_score_is_where_a_search_finds_it(ray_session: None) -> None:
    (spec,) = specs("--algos", "falling", "--quick", "--no-compile")
    trial = Trial(config=asdict(spec))
    try:
        result = trial.train()
    finally:
        trial.stop()
    returns = result["evaluation"]["env_runners"]["agent_episode_returns_mean"]
    assert result["score"] == returns["agent_0"] < 0
    scheduler = stopping(spec.stop_timesteps)
    assert (scheduler._time_attr, scheduler._metric, scheduler._max_t) == (STEPS, "score", 100)
    assert [rung for rung, _ in scheduler._brackets[0]._rungs] == [36, 12]


def test_a_search_is_an_experiment(
    ray_session: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("rllib_maobs.experiment.plan._measured", lambda args, specs, count: ({}, ""))
    monkeypatch.setattr("rllib_maobs.experiment.run.film_best", lambda *args: "")
    given = ["--algos", "falling", "--quick", "--search", "optuna", "--num-samples", "2", "--sweep", "tau=0.01..0.1"]
    EXPERIMENT.main([*given, "--no-compile", "--results-dir", str(tmp_path / "new")])
    table = pd.read_csv(tmp_path / "new" / "comparison.csv")["algorithm"]
    assert len(table) == 2
    for sample in (1, 2):
        (name,) = [name for name in table if name.endswith(f",sample={sample}")]
        assert name.startswith("falling,tau=0.0") and (tmp_path / "new" / f"{name}-seed0" / "result.json").is_file()
    with pytest.raises(SystemExit):
        EXPERIMENT.main(["--resume", "--add-seeds", "4", "--results-dir", str(tmp_path / "new")])
    assert "the run is a search, which compares trials of one length" in capsys.readouterr().err
