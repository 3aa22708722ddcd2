"""Experiments: the command line, the report, and a whole run that is interrupted, damaged and resumed."""

import importlib.util
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib.image
import numpy as np
import pandas as pd
import pytest
import ray
from PIL import Image
from ray.rllib.algorithms import Algorithm

import rllib_maobs as maobs
from rllib_maobs.envs import make_vec
from rllib_maobs.experiment import Experiment, decayed, fading, load_curves, plot_curves, summarise
from rllib_maobs.experiment import claim as claim_module
from rllib_maobs.experiment.arguments import make_parser, parse
from rllib_maobs.experiment.baselines import play_baselines
from rllib_maobs.experiment.claim import LOCK, claim
from rllib_maobs.experiment.film import film_best
from rllib_maobs.experiment.progress import ProgressTable, makespan
from rllib_maobs.experiment.report import STEPS, best_trial, to_markdown
from rllib_maobs.experiment.resume import TESTED_RAY, forget_decisions
from rllib_maobs.experiment.run import _start_ray as start_ray
from rllib_maobs.experiment.trial import Trial

SCRIPTS = Path(__file__).parent.parent / "tuned_examples"
EXPERIMENT = Experiment(
    name="demo", env="maobs/spread-3a", algorithms=("iddpg", "maddpg"), training={}, stop_timesteps=1000
)


def parsed(experiment: Experiment, *arguments: str) -> Any:
    """The command line's arguments, in a results folder that is not there."""
    parser = make_parser(experiment.name, experiment.algorithms, experiment.stop_timesteps)
    return parse(parser, experiment.name, ["--results-dir", "new", *arguments], experiment.quick_algorithms)


def result(algorithm: str, seed: int, steps: int, score: float, coverage: float = 0.5, **more: Any) -> dict[str, Any]:
    """One line of a result.json, with what the report reads."""
    metrics = {"coverage": coverage, "collisions_agents": 2.0, "collisions_obstacles": 1.0}
    return {
        "config": {"algorithm": algorithm, "seed": seed},
        STEPS: float(steps),
        "time_this_iter_s": 2.0,
        "time_total_s": steps / 50,
        "learners": {"__all_modules__": {}, "agent_0": {}},
        "evaluation": {
            "env_runners": {
                "agent_episode_returns_mean": {"agent_1": -1.0, "agent_0": score},
                "episode_metrics": metrics,
            }
        },
        **more,
    }


def write_results(folder: Path, lines: list[dict[str, Any]], end: str = "\n") -> None:
    config = lines[0]["config"]
    trial = folder / f"{config['algorithm']}-seed{config['seed']}"
    trial.mkdir()
    (trial / "result.json").write_text("\n".join(json.dumps(line) for line in lines) + end)


# --- The report ---------------------------------------------------------------------------------------------------


def test_load_curves_reads_what_was_evaluated(tmp_path: Path) -> None:
    no_episode_yet = result("maddpg", 3, 100, 0.0) | {"evaluation": {"env_runners": {}}}
    write_results(tmp_path, [no_episode_yet, result("maddpg", 3, 200, -7.0, coverage=0.25)])
    curves = load_curves(tmp_path)
    assert curves["env_steps"].tolist() == [100, 200]
    last = curves.iloc[1]
    assert (last["trial"], last["algorithm"], last["seed"]) == ("maddpg-seed3", "maddpg", 3)
    assert (last["score"], last["coverage"], last["collisions"]) == (-7.0, 0.25, 3.0)
    assert last["env_steps_per_s"] == 50.0
    assert np.isnan(curves["score"].iloc[0])


def test_load_curves_replaces_what_a_resumed_trial_computed_again(tmp_path: Path) -> None:
    lines = [result("maddpg", 0, steps, score) for steps, score in ((100, 1), (200, 2), (300, 3), (200, 20), (300, 30))]
    write_results(tmp_path, lines, end='\n{"config": {"algo')  # ... and was killed while it wrote a line
    curves = load_curves(tmp_path)
    assert curves["env_steps"].tolist() == [100, 200, 300]
    assert curves["score"].tolist() == [1, 20, 30]


def test_load_curves_names_a_folder_without_results(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=f"No trial has reported a result in {tmp_path}"):
        load_curves(tmp_path)


def made_up_curves() -> pd.DataFrame:
    rows = []
    for algorithm, seed, final in (("iddpg", 0, 10.0), ("iddpg", 1, 20.0), ("maddpg", 0, 30.0)):
        for steps in (100, 200, 300):
            rows.append(
                {
                    "trial": f"{algorithm}-seed{seed}",
                    "algorithm": algorithm,
                    "seed": seed,
                    "env_steps": steps,
                    "score": final * steps / 300,
                    "coverage": steps / 300,
                    "time_total_s": steps * 36.0,
                }
            )
    return pd.DataFrame(rows)


def test_summarise() -> None:
    table = summarise(made_up_curves(), last=2)
    assert table.index.tolist() == ["maddpg", "iddpg"]  # best first
    # The mean of the last two of 10 * (1/3, 2/3, 1) and of 20 * (1/3, 2/3, 1): 8 1/3 and 16 2/3.
    iddpg = table.loc["iddpg"]
    assert iddpg["seeds"] == 2
    assert iddpg["score"] == pytest.approx(12.5)
    assert iddpg["score_std"] == pytest.approx(8.3333333 / 2**0.5)
    assert iddpg["coverage"] == pytest.approx(5 / 6)
    assert iddpg["env_steps"] == 300
    assert iddpg["env_steps_per_s"] == pytest.approx(1 / 36)
    assert iddpg["hours"] == pytest.approx(3.0)
    assert np.isnan(table.loc["maddpg", "score_std"])


def test_the_best_trial_is_the_best_seed_of_the_best_algorithm() -> None:
    curves = made_up_curves()
    assert best_trial(curves) == "maddpg-seed0"
    curves.loc[curves["trial"] == "iddpg-seed1", "score"] = 100.0
    assert best_trial(curves) == "iddpg-seed1"
    curves.loc[curves["trial"] == "iddpg-seed0", "score"] = -100.0  # one bad seed: the other algorithm is better
    assert best_trial(curves) == "maddpg-seed0"
    assert best_trial(curves.drop(columns="score")) is None
    assert best_trial(curves.head(0)) is None


@pytest.mark.parametrize("options", [{}, {"action_mode": "discrete"}, {"terminate_on_success": True}])
def test_baselines_are_means_over_whole_episodes(options: dict[str, Any]) -> None:
    baselines = play_baselines("maobs/spread-3a", {"horizon": 100, **options}, episodes=20)
    assert list(baselines) == ["random", "heuristic"]
    assert -900 < baselines["random"]["return_agent_0"] < -650 < -90 < baselines["heuristic"]["return_agent_0"] < 0
    assert baselines["random"]["success"] == 0.0 < 0.9 < baselines["heuristic"]["success"] <= 1.0
    length = baselines["heuristic"]["episode_length"]
    assert length == 100.0 if "terminate_on_success" not in options else 5.0 < length < 60.0
    single = make_vec("spread-3a", **{**options, "action_mode": "mpe"})  # the task's own
    single.reset(seed=0)
    returned, done = 0.0, False
    while not done:
        _, rewards, terminated, truncated, _ = single.step(single.heuristic())
        returned, done = returned + float(rewards[0, 0]), bool(terminated[0] | truncated[0])
    alone = play_baselines("maobs/spread-3a", options, episodes=1)["heuristic"]
    assert alone["return_agent_0"] == pytest.approx(returned, rel=1e-5)


def test_baselines_end_the_table() -> None:
    baselines = play_baselines("maobs/spread-3a", {}, episodes=2)
    *_, trained, random, heuristic = to_markdown(summarise(made_up_curves()), baselines).splitlines()
    assert trained.startswith("| iddpg ") and random.startswith("| random ") and heuristic.startswith("| heuristic ")
    cells = [cell.strip() for cell in random.strip("|").split("|")]
    means = baselines["random"]
    assert cells == [
        "random",
        "-",
        "-",
        f"{means['return_agent_0']:.1f}",
        f"{means['coverage']:.2f}",
        "-",
        "-",
    ]
    assert play_baselines("my_env", {}) == {}


def test_plot_curves_draws_mean_and_spread(tmp_path: Path) -> None:
    plot_curves(made_up_curves(), tmp_path / "curves.png", "title")
    both = matplotlib.image.imread(tmp_path / "curves.png")
    assert both.shape[0] > 400
    assert both.shape[1] > both.shape[0]
    assert colours(tmp_path / "curves.png") > 10
    # A change of one seed of two, even at the same mean, shows: the band is there.
    curves = made_up_curves()
    curves.loc[curves["trial"] == "iddpg-seed0", "score"] -= 5
    curves.loc[curves["trial"] == "iddpg-seed1", "score"] += 5
    plot_curves(curves, tmp_path / "wider.png", "title")
    assert not np.array_equal(both, matplotlib.image.imread(tmp_path / "wider.png"))


def test_plot_curves_draws_what_is_not_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A line each, in both panels; random play is a hundredth as good, and leaves half of the picture to the rest."""
    figures: list[Any] = []
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda self, *args, **kwargs: figures.append(self))
    curves = made_up_curves()
    baselines = {
        "random": {"return_agent_0": -4000.0, "coverage": 0.05},
        "heuristic": {"return_agent_0": -10.0, "coverage": 0.9},
        "lazy": {"return_agent_0": -700.0},
    }
    for scores in (curves["score"] - 500.0, curves["score"]):
        plot_curves(curves.assign(score=scores), tmp_path / "curves.png", baselines=baselines)
    negative, positive = figures
    levels = [[set(line.get_ydata()) for line in axes.lines[2:]] for axes in negative.axes]
    assert levels == [[{-4000.0}, {-10.0}, {-700.0}], [{0.05}, {0.9}]]
    names = [text.get_text() for text in negative.legends[0].texts]
    assert names == ["iddpg", "maddpg", "random", "heuristic", "lazy"]
    score, coverage = negative.axes
    low, middle, high = (score.transData.transform((0, y))[1] for y in (-4000, -500, -10))
    assert 0.3 < (middle - low) / (high - low) < 0.7
    ticks = score.get_yticks()
    assert min(ticks) < -1000 < -100 < max(ticks) < 0
    assert coverage.get_yscale() == positive.axes[0].get_yscale() == "linear"


def colours(picture: Path) -> int:
    return len(np.unique(matplotlib.image.imread(picture).reshape(-1, 4), axis=0))


@pytest.mark.parametrize(
    ("reached", "own", "error", "code", "says"),
    [
        ((1000, 1000), None, (None, None), None, "maddpg "),
        ((1000, 1000), None, (None, None), None, "No film: iddpg-seed0, the best one, has no checkpoint."),
        ((1000, 400), 400, (None, None), None, "maddpg "),
        ((1000, 400), None, (None, "boom"), 1, "FAILED: maddpg-seed0, see {}/maddpg-seed0/error.txt"),
        ((1000, 400), None, (None, None), 130, "Interrupted. Go on with: python "),
        ((1000, 400), None, (None, None), 130, "--resume --results-dir {}"),
    ],
)
def test_the_end_of_a_run(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    reached: tuple[int, int],
    own: int | None,
    error: tuple[str | None, str | None],
    code: int | None,
    says: str,
) -> None:
    trials = []
    for algorithm, steps, wrong in zip(EXPERIMENT.algorithms, reached, error, strict=True):
        write_results(tmp_path, [result(algorithm, 0, steps, -5.0)])
        path = str(tmp_path / f"{algorithm}-seed0")
        trials.append(SimpleNamespace(path=path, error=wrong, metrics={STEPS: float(steps)}))
    variants = {"maddpg": {"algorithm": "maddpg", "stop_timesteps": own}} if own else {}
    experiment = replace(EXPERIMENT, variants=variants)
    args = parsed(experiment, "--seeds", "0")
    args.results_dir = tmp_path
    assert (experiment._report(args, trials, experiment.specs(args)) or None) == code  # type: ignore[arg-type]
    output = capsys.readouterr().out
    assert says.format(tmp_path) in output and "| heuristic " in output
    # A trial that failed is drawn, but not compared.
    assert load_curves(tmp_path)["trial"].nunique() == 2
    compared = pd.read_csv(tmp_path / "comparison.csv")["algorithm"].tolist()
    assert compared == [name for name, wrong in zip(EXPERIMENT.algorithms, error, strict=True) if not wrong]


# --- Progress -----------------------------------------------------------------------------------------------------


def test_makespan_fills_free_workers_in_order() -> None:
    assert makespan([3.0, 1.0, 1.0, 2.0], 2) == 4.0
    assert makespan([3.0, 1.0], 1) == 4.0
    assert makespan([], 2) == 0.0


class FakeTrial(SimpleNamespace):
    def __str__(self) -> str:
        return self.trial_id


def fake(algorithm: str, seed: int, stop: int, **more: Any) -> FakeTrial:
    config = {"algorithm": algorithm, "stop_timesteps": stop}
    return FakeTrial(trial_id=f"{algorithm}-seed{seed}", config=config, **more)


def test_progress_table() -> None:
    table = ProgressTable(every_s=30.0)
    running = fake("maddpg", 0, 1000, status="RUNNING", last_result=result("maddpg", 0, 100, -5.0))
    waiting = fake("iddpg", 0, 500, status="PENDING", last_result={})
    trials = [running, waiting]
    assert not table.should_report([waiting])
    assert table.should_report(trials)  # the first table comes at once
    assert not table.should_report(trials)
    running.last_result = result("maddpg", 0, 200, -4.0)
    # 100 env steps since the first result took 2 s; 800 are left here, and then all 500 of the one that waits.
    head, header, first, second = table.table(trials).splitlines()
    assert head.endswith("about 0:00:26 left")
    assert header.split("  ")[0] == "trial"
    assert first.split() == ["maddpg-seed0", "running", "200", "/", "1,000", "-4.0", "0.50", "3.0", "50", "0:00:16"]
    assert second.split() == ["iddpg-seed0", "waiting", "0", "/", "500", "-", "-", "-", "-", "-"]


def test_the_first_update_is_announced() -> None:
    """It is compiled, for longer than a user would think that all is well; trials that act only do not say so."""
    table = ProgressTable(every_s=30.0)
    trial = fake("maddpg", 0, 1000, status="RUNNING", last_result={})
    for compiled in (True, False):
        trial.config["torch_compile"] = compiled
        lines = table.table([trial]).splitlines()
        assert lines[2].split()[1] == "starting"
        said = "starting: the first update is compiled, which takes half a minute to a minute"
        assert (lines[-1] == said) is compiled
    trial.config["torch_compile"] = True
    trial.last_result = result("maddpg", 0, 100, -5.0) | {"learners": {"__all_modules__": {"x": 1}}}
    assert "starting" in table.table([trial])
    trial.last_result = result("maddpg", 0, 100, -5.0)
    assert "starting" not in table.table([trial]) and "running" in table.table([trial])


def test_a_trial_that_waits_is_as_fast_as_another_seed_of_its_algorithm() -> None:
    table = ProgressTable(every_s=30.0)
    slow = fake("maddpg", 0, 1000, status="RUNNING", last_result=result("maddpg", 0, 100, -5.0))
    fast = fake("iddpg", 0, 1000, status="RUNNING", last_result=result("iddpg", 0, 100, -5.0))
    waiting = fake("iddpg", 1, 2000, status="PENDING", last_result={})
    trials = [slow, fast, waiting]
    table.should_report(trials)
    slow.last_result = result("maddpg", 0, 200, -4.0)  # 50 env steps/s
    fast.last_result = result("iddpg", 0, 200, -4.0) | {"time_total_s": 2.5}  # 200 env steps/s
    # 16 s are left of the slow one, 4 s of the fast one, and then 10 s.
    assert table.table(trials).splitlines()[0].endswith("about 0:00:16 left")
    waiting.config["stop_timesteps"] = 4000
    assert table.table(trials).splitlines()[0].endswith("about 0:00:24 left")


def test_compiling_does_not_count_as_slow_training() -> None:
    table = ProgressTable(every_s=30.0)
    trial = fake("maddpg", 0, 1000, status="RUNNING", last_result={})
    fills = {"learners": {"__all_modules__": {}}}
    for seconds, steps, more in ((1.0, 50, fills), (61.0, 100, {}), (63.0, 200, {})):
        trial.last_result = result("maddpg", 0, steps, -5.0) | {"time_total_s": seconds} | more
        table.should_report([trial])
    assert table.table([trial]).splitlines()[0].endswith("about 0:00:16 left")  # 800 env steps at 50/s


# --- The command line ---------------------------------------------------------------------------------------------


@pytest.fixture
def used(tmp_path: Path) -> Path:
    """A results folder with a run in it."""
    settings = vars(make_parser("demo", EXPERIMENT.algorithms, 1000).parse_args([]))
    del settings["results_dir"], settings["resume"], settings["workers"], settings["address"], settings["dashboard"]
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "experiment.json").write_text(json.dumps({"experiment": "demo", **settings}))
    (tmp_path / "used" / "experiment_state.json").touch()
    return tmp_path / "used"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--algos ppo", "argument --algos: invalid choice: 'ppo' (choose from 'iddpg', 'maddpg')"),
        ("--algos iddpg iddpg", "--algos: iddpg iddpg names one of them twice"),
        ("--seeds 0 1 0", "--seeds: 0 1 0 names one of them twice"),
        ("--seeds 4294967296", "argument --seeds: '4294967296' is not a whole number >= 0 and <= 4294967295"),
        ("--stop-timesteps 0", "argument --stop-timesteps: '0' is not a whole number >= 1"),
        ("--stop-timesteps inf", "argument --stop-timesteps: 'inf' is not a whole number >= 1"),
        ("--workers -1", "argument --workers: '-1' is not a whole number >= 1"),
        ("--max-failures -1", "argument --max-failures: '-1' is not a whole number >= 0"),
        ("--train-horizon 2.5", "argument --train-horizon: '2.5' is not a whole number >= 1"),
        ("--num-env-runners nan", "argument --num-env-runners: 'nan' is not a whole number >= 0"),
        ("--address auto --workers 3", "--workers is for this machine; with --address the free cores of the cluster"),
        ("--resume --results-dir none", "none: leave --resume out, or correct --results-dir"),
        ("--results-dir used", "used is not empty: continue the run there with --resume, or choose another"),
        ("--results-dir used/experiment.json", "experiment.json is not a folder"),
        (
            "--results-dir used --resume --train-horizon 5",
            "--train-horizon: the original run has what each row has for itself, and --resume continues it",
        ),
        ("--results-dir used --resume --seeds 5", "--seeds: the original run has [0, 1, 2], and --resume continues it"),
    ],
)
def test_wrong_arguments_say_what_is_legal(
    used: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: str,
    message: str,
) -> None:
    monkeypatch.chdir(used.parent)
    with pytest.raises(SystemExit) as end:
        EXPERIMENT.main(arguments.split())
    assert end.value.code == 2
    assert message in capsys.readouterr().err


def test_settings_that_an_algorithm_refuses_end_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = Experiment(name="demo", env="maobs/spread-3a", algorithms=("maddpg",), training={"tau": 2.0})
    with pytest.raises(SystemExit) as end:
        wrong.main(["--results-dir", str(tmp_path / "new")])
    assert end.value.code == 2
    assert "tau=2.0 is illegal; legal: a number > 0 and <= 1" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_what_all_rows_share_is_given_to_those_it_means_something_to() -> None:
    rows = Experiment(
        name="demo",
        env="maobs/spread-3a",
        algorithms=("iddpg", "maddpg-lstm", "long"),
        training={"seq_length": 3, "tau": 0.02},
        variants={"long": {"algorithm": "maddpg", "seq_length": 4}},
    )
    iddpg, lstm, long = rows.specs(parsed(rows, "--critic-state", "world", "--seeds", "0"))
    assert iddpg.training == {"tau": 0.02}
    assert lstm.training == {"seq_length": 3, "tau": 0.02, "critic_state": "world"}
    # But what a row itself says is not taken away from it.
    with pytest.raises(ValueError, match="seq_length must be 5, not 4"):
        long.build_config().validate()


def test_a_missing_compiler_is_named_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(SystemExit) as end:
        EXPERIMENT.main(["--results-dir", str(tmp_path / "new")])
    assert end.value.code == 2
    assert "no 'no-such-compiler' on the PATH: install one (apt install g++" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_ray_that_runs_is_joined_and_left_running(ray_session: None) -> None:
    node = ray.get_runtime_context().get_node_id()
    assert not start_ray(parsed(EXPERIMENT))
    assert ray.is_initialized() and ray.get_runtime_context().get_node_id() == node


def test_resume_takes_the_settings_of_the_original_run(used: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stored = json.loads((used / "experiment.json").read_text()) | {
        "seeds": [7, 8],
        "quick": True,
        "stop_timesteps": 900,
    }
    (used / "experiment.json").write_text(json.dumps(stored))

    def resume(name: str, *more: str) -> Any:
        parser = make_parser(name, EXPERIMENT.algorithms, 1000)
        return parse(parser, name, ["--resume", "--results-dir", str(used), *more])

    args = resume("demo", "--workers", "4", "--seeds", "7", "8")
    assert (args.seeds, args.quick, args.stop_timesteps, args.workers) == ([7, 8], True, 900, 4)
    with pytest.raises(SystemExit):
        resume("another")
    assert "holds a run of demo, not of another" in capsys.readouterr().err


# Holds a folder for as long as it lives; without the package, which takes seconds to import.
HOLDER = f"""
import runpy, sys, time
from pathlib import Path
file = runpy.run_path({claim_module.__file__!r})["claim"](Path(sys.argv[1]))
print("claimed", flush=True)
time.sleep(600)
"""


def test_a_folder_is_claimed_by_one_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Until it ends, however it does."""
    folder = tmp_path / "new"
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, text=True) as holder:
        try:
            assert holder.stdout is not None and holder.stdout.readline() == "claimed\n"
            with pytest.raises(SystemExit) as end:
                EXPERIMENT.main(["--results-dir", str(folder)])
        finally:
            holder.kill()
    assert end.value.code == 2 and [path.name for path in folder.iterdir()] == [LOCK]
    said = capsys.readouterr().err
    assert f"new is in use by another run (process {holder.pid} on " in said and "or choose another --resu" in said
    with claim(folder):
        assert parsed(EXPERIMENT, "--results-dir", str(folder)).results_dir == folder  # as if it were not there
        with pytest.raises(ValueError, match=f"process {os.getpid()} on "):
            claim(folder)
    claim(folder).close()


def test_a_folder_that_cannot_be_written_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as end:
        EXPERIMENT.main(["--results-dir", str(tmp_path / "file" / "new")])
    assert end.value.code == 2
    assert "new cannot be written (Not a directory): choose a folder that can" in capsys.readouterr().err

    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)  # these tests may run as root, who may write everywhere
    with pytest.raises(ValueError, match=r"cannot be written \(Permission denied\)"):
        claim(tmp_path)


def test_results_go_where_the_path_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    for given, folder in (("~/a b/", "home/a b"), ("./[ü]/../x/", "x"), (str(tmp_path / "y") + "/", "y")):
        assert parsed(EXPERIMENT, "--results-dir", given).results_dir == tmp_path / folder


ROWS = Experiment(
    name="demo",
    env="maobs/spread-3a",
    algorithms=("tuned", "maddpg", "iddpg"),
    quick_algorithms=("tuned", "maddpg"),
    variants={
        "tuned": {
            "algorithm": "maddpg",
            "actor_lr": decayed(1e-3),
            "critic_state": "world",
            "env_config": {"action_mode": "force"},
            "train_horizon": 25,
            "num_envs_per_env_runner": 32,
            "one_policy": True,
            "stop_timesteps": 200_000,
            "steps_per_iteration": 2000,
            "evaluation_duration": 20,
            "quick": {"stop_timesteps": 60_000, "steps_per_iteration": 4000, "torch_compile": True},
        }
    },
    training={"actor_lr": 1e-2, "tau": 0.02},
    env_config={"num_obstacles": 3},
    stop_timesteps=10**6,
)


def trial_settings(spec: Any) -> tuple[Any, ...]:
    return spec.stop_timesteps, spec.steps_per_iteration, spec.evaluation_duration, spec.torch_compile


def test_rows_have_settings_of_their_own() -> None:
    tuned, maddpg, iddpg = ROWS.specs(parsed(ROWS, "--seeds", "7"))
    assert trial_settings(tuned) == (200_000, 2000, 20, True)
    assert trial_settings(maddpg) == trial_settings(iddpg) == (10**6, 1000, 10, True)
    assert (maddpg.num_envs_per_env_runner, maddpg.one_policy, maddpg.training["actor_lr"]) == (8, False, 1e-2)
    assert json.loads(json.dumps(asdict(tuned))) == asdict(tuned)  # plain values, as Tune writes them
    config = tuned.build_config()
    config.validate()
    evaluation = config.get_evaluation_config_object()
    assert config.actor_lr == [[0, 1e-3], [100_000, 1e-3], [200_000, 5e-5]]
    assert (config.tau, config.critic_state, config.num_envs_per_env_runner) == (0.02, "world", 32)
    assert config.env_config == {"num_obstacles": 3, "action_mode": "force", "horizon": 25}
    assert evaluation.env_config == {**config.env_config, "horizon": 100}
    assert evaluation.num_envs_per_env_runner == 20
    assert config.module_ids == ("all", "all", "all")


def test_what_is_given_holds_for_all_rows() -> None:
    specs = ROWS.specs(parsed(ROWS, "--stop-timesteps", "2e3", "--train-horizon", "50", "--no-compile", "--seeds", "0"))
    assert [spec.stop_timesteps for spec in specs] == [2000] * 3
    assert [spec.env_config["horizon"] for spec in specs] == [50] * 3
    assert not any(spec.torch_compile for spec in specs)
    assert specs[0].training["actor_lr"][1:] == [[1000, 1e-3], [2000, 5e-5]]


def test_quick_changes_what_is_not_given() -> None:
    args = parsed(ROWS, "--quick")
    tuned, maddpg = ROWS.specs(args)
    assert (args.algos, args.seeds) == (["tuned", "maddpg"], [0])
    assert trial_settings(tuned) == (60_000, 4000, 5, True)
    assert trial_settings(maddpg) == (4000, 400, 5, False)
    args = parsed(ROWS, "--quick", "--stop-timesteps", "2e3", "--algos", "iddpg", "tuned")
    assert [trial_settings(spec) for spec in ROWS.specs(args)] == [(2000, 400, 5, False), (2000, 4000, 5, True)]
    assert parsed(replace(ROWS, quick_algorithms=()), "--quick").algos == list(ROWS.algorithms)
    named = parse(make_parser("demo", ["iddpg"], 10**6), "demo", ["--quick"])
    assert named.results_dir == Path("results/demo-quick").resolve()


def test_the_plan_of_a_quick_run_measures_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    def plan(*arguments: str) -> str:
        args = parsed(ROWS, "--quick", *arguments)
        ROWS._print_plan(args, ROWS.specs(args))
        return capsys.readouterr().out

    assert "--quick trains tuned and maddpg only: iddpg need hours" in plan()
    out = plan("--algos", "maddpg", "iddpg")
    assert "only" not in out and "at most about five minutes" in out
    assert [line.split() for line in out.splitlines() if line.startswith(("maddpg", "iddpg"))] == [
        ["maddpg", "4,000", "1"],
        ["iddpg", "4,000", "1"],
    ]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"algorithm": "madpg"}, "Row 'a': unknown algorithm 'madpg'; legal are iddpg, maddpg"),
        ({}, "Row 'a': unknown algorithm ''; legal are iddpg"),
        (
            {"algorithm": "maddpg", "actr_lr": 1.0},
            r"Row 'a' has no setting 'actr_lr' \(did you mean 'actor_lr'\?\); legal are env_config, train_env_config, "
            r".*, quick, and arguments of training\(\): other_agents_actions, actor_lr, .*gamma",
        ),
        ({"algorithm": "iddpg", "other_agents_actions": "joint"}, "has no setting 'other_agents_actions'"),
        ({"algorithm": "maddpg", "stop_timesteps": 0}, "stop_timesteps=0 is illegal; legal: an integer >= 1"),
        (
            {"algorithm": "maddpg", "quick": {"stop_steps": 5}},
            "Row 'a', quick has no setting 'stop_steps' .did you mean",
        ),
        ({"algorithm": "maddpg", "lr": 1e-3}, "Row 'a' has no setting 'lr'"),
        ({"algorithm": "maddpg", "quick": {"quick": {}}}, "Row 'a', quick has no setting 'quick'"),
        ({"algorithm": "maddpg", "quick": True}, "quick=True is illegal; legal: a mapping of settings"),
        (
            {"algorithm": "maddpg", "train_env_config": 3},
            "Row 'a': train_env_config=3 is illegal; legal: a mapping of the environment's options",
        ),
    ],
)
def test_rows_with_unknown_settings_are_refused(row: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(EXPERIMENT, algorithms=("a",), variants={"a": row})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": 3}, "Experiment: name=3 is illegal; legal: a string"),
        ({"name": "a/b"}, "name='a/b' is illegal; legal is a name of a folder"),
        ({"algorithms": "iddpg"}, "algorithms='iddpg' is illegal; legal: a list or a tuple"),
        ({"algorithms": ("iddpg", "iddpg")}, "legal are one or more, once each"),
        ({"algorithms": ()}, "legal are one or more, once each"),
        ({"training": 3}, "training=3 is illegal; legal: a dict"),
        ({"env_config": [1]}, r"env_config=\[1\] is illegal; legal: a dict"),
        ({"stop_timesteps": 0}, "stop_timesteps=0 is illegal; legal: an integer >= 1"),
        ({"variants": {"z": {"algorithm": "iddpg"}}}, "variants 'z' are not among the algorithms .* not be trained"),
        ({"variants": {"iddpg": 3}}, "Row 'iddpg': 3 is illegal; legal: a mapping of settings"),
    ],
)
def test_what_an_experiment_cannot_be(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(EXPERIMENT, **change)


@pytest.mark.parametrize(("script", "agents", "batch"), [("spread3a_networks", 3, 128), ("spread9a_networks", 9, 64)])
def test_networks_are_compared_on_equal_terms(script: str, agents: int, batch: int) -> None:
    experiment = load_script(script).experiment
    specs = experiment.specs(parsed(experiment, "--seeds", "0"))
    assert len(specs) == 18
    networks = Counter[tuple[str, str]]()
    for spec in specs:
        config = spec.build_config()
        config.validate()
        assert (len(config.team.agents), config.train_batch_size_per_learner) == (agents, batch)
        assert (config.updates_per_env_step, config.num_envs_per_env_runner) == (1 / 8, 32)
        assert len(set(config.module_ids)) == 1
        assert spec.stop_timesteps == experiment.stop_timesteps
        networks[config.actor, config.critic] += 1
    assert networks == {("mlp", "mlp"): 6, ("lstm", "mlp"): 6, ("entity", "entity"): 6}


def test_quick_algorithms_are_some_of_all() -> None:
    with pytest.raises(ValueError, match="Unknown quick_algorithms 'facmac'; legal are those of algorithms: iddpg, ma"):
        replace(EXPERIMENT, quick_algorithms=("iddpg", "facmac"))


# --- The scripts --------------------------------------------------------------------------------------------------


def load_script(script: str | Path) -> Any:
    """A script of `tuned_examples` by its name, or one that lies elsewhere."""
    path = script if isinstance(script, Path) else SCRIPTS / f"{script}.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(path.parent)  # where Python finds what a script imports from its neighbours
        spec.loader.exec_module(module)
    return module


FIVE = ("iddpg", "maddpg", "maddpg-lstm", "maddpg-l", "facmac")
FOUR = FIVE[:4]
TUNED = "maddpg-entity"


@pytest.mark.parametrize(
    ("script", "algorithms", "agents", "critic_lr", "batch", "seq_length"),
    [
        ("obstacle_predator_prey", FIVE, 3, 0.01, 256, 3),  # table III
        ("spread3a", FIVE, 3, 0.01, 128, 5),  # table IV
        ("spread6a", FIVE, 6, 0.01, 32, 3),  # table V
        ("spread9a", FIVE, 9, 0.01, 32, 3),
        ("tunnel", FIVE, 3, 0.01, 128, 5),  # table VI
        ("simple_tunnel", FOUR, 3, 0.01, 128, 5),
        ("simple_tunnel6a", FOUR, 6, 0.001, 32, 3),  # table VII
        ("facmac_critic_source", ("own", "others", "shared"), 3, 0.01, 256, 3),  # figure 6
        ("facmac_two_stage", ("two-stage", "facmac"), 3, 0.01, 256, 3),  # figure 7
    ],
)
def test_scripts_have_the_settings_of_the_paper(
    script: str, algorithms: tuple[str, ...], agents: int, critic_lr: float, batch: int, seq_length: int
) -> None:
    experiment = load_script(script).experiment
    assert tuple(name for name in experiment.algorithms if name != TUNED) == algorithms
    assert experiment.stop_timesteps == 2_000_000
    arguments = ["--train-horizon", "25", "--critic-state", "world", "--seeds", "5", "6"]
    specs = experiment.specs(parsed(experiment, *arguments, "--algos", *algorithms))
    count = len(algorithms)
    assert [(spec.algorithm, spec.seed) for spec in specs] == [(a, s) for s in (5, 6) for a in algorithms]
    for spec in specs[:count]:
        config = spec.build_config()
        config.validate()
        assert config.name == (spec.algorithm if spec.algorithm in maobs.ALGORITHMS else "facmac")
        assert len(config.team.agents) == agents
        assert (config.actor_lr, config.critic_lr, config.gamma) == (0.001, critic_lr, 0.95)
        assert config.train_batch_size_per_learner == batch
        assert config.window_length == (seq_length if config.recurrent else 0)
        assert config.critic_state == ("world" if config.uses_state else "observations")
        assert (config.seed, config.torch_compile_learner) == (5, True)
        assert (spec.stop_timesteps, spec.num_envs_per_env_runner, spec.one_policy) == (2_000_000, 8, False)
        # Training episodes are short, evaluation is the paper's: 10 noise-free episodes of 100 steps.
        evaluation = config.get_evaluation_config_object()
        assert (config.env_config["horizon"], evaluation.env_config["horizon"]) == (25, 100)
        assert (config.explore, evaluation.explore) == (True, False)
        assert (config.evaluation_interval, config.evaluation_duration) == (1, 10)


@pytest.mark.parametrize(
    ("script", "agents"),
    [
        ("obstacle_predator_prey", 3),
        ("spread3a", 3),
        ("spread6a", 6),
        ("spread9a", 9),
        ("tunnel", 3),
        ("simple_tunnel", 3),
        ("simple_tunnel6a", 6),
    ],
)
def test_scripts_have_a_row_that_learns_in_minutes(script: str, agents: int) -> None:
    experiment = load_script(script).experiment
    row = experiment.variants[TUNED]
    steps = row["stop_timesteps"]
    tuned = next(spec for spec in experiment.specs(parsed(experiment)) if spec.algorithm == TUNED)
    config = tuned.build_config()
    config.validate()
    assert (tuned.stop_timesteps, config.num_envs_per_env_runner) == (steps, 32)
    assert (config.name, config.actor, config.critic, config.critic_state) == ("maddpg", "entity", "entity", "world")
    shared = row.get("one_policy", False)  # targets are not in the walled tunnels, and with them policies
    assert config.module_ids == (("all",) * agents if shared else tuple(f"agent_{i}" for i in range(agents)))
    assert config.critic_lr == [[0, 1e-3], [steps // 2, 1e-3], [steps, 5e-5]]
    stricter = row.get("train_env_config", {})
    assert config.env_config == {"action_mode": "force", "horizon": row["train_horizon"], **stricter}
    scenario = maobs.make_vec(tuned.env.removeprefix("maobs/")).scenario
    usual = {name: getattr(scenario.options, name) for name in stricter}
    assert tuned.evaluation_options == {"action_mode": "force", "horizon": 100, **usual}
    quick = experiment.specs(parsed(experiment, "--quick"))
    assert [spec.name for spec in quick] == ["maddpg-entity-seed0", "maddpg-seed0"]
    small = row["quick"]["stop_timesteps"]
    assert small <= 0.6 * steps
    assert [trial_settings(spec) for spec in quick] == [(small, 4000, 20, True), (4000, 400, 5, False)]


def test_settings_of_the_experiment_may_depend_on_the_env_steps_and_be_classes() -> None:
    training = {"actor_lr": decayed(1e-3), "exploration": fading(epsilon=0.1, noise=0.2, final=0.02)}
    experiment = replace(EXPERIMENT, training={**training, "actor": maobs.MLPActor})
    spec = experiment.specs(parsed(experiment, "--stop-timesteps", "1000"))[0]
    assert spec.training["actor_lr"] == [[0, 1e-3], [500, 1e-3], [1000, 5e-5]]
    assert spec.training["exploration"] == {"epsilon": 0.1, "noise": 0.2, "decay": pytest.approx(3e-4), "final": 0.02}
    assert spec.training["actor"] is maobs.MLPActor


def test_what_training_changes_of_the_environment_evaluation_does_not_see(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    row: dict[str, Any] = {"algorithm": "maddpg", "env_config": {"agent_collision_penalty": 2.0}}
    row["train_env_config"] = {"agent_collision_penalty": 5.0, "obstacle_collision_penalty": 4.0}
    experiment = replace(EXPERIMENT, algorithms=("a",), variants={"a": row})
    (spec,) = experiment.specs(parsed(experiment, "--seeds", "0"))
    prices = ["agent_collision_penalty", "obstacle_collision_penalty"]
    assert [spec.env_config[price] for price in prices] == [5.0, 4.0]
    evaluation = spec.build_config().get_evaluation_config_object()
    assert [evaluation.env_config[price] for price in prices] == [2.0, 1.0]  # the row's, and the scenario's default

    def refused(experiment: Experiment) -> str:
        with pytest.raises(SystemExit):
            experiment.main(["--results-dir", str(tmp_path / "a")])
        return capsys.readouterr().err

    foreign = replace(experiment, env="theirs")
    assert "train_env_config changes obstacle_collision_penalty of theirs: give what evaluation" in refused(foreign)
    wrong = {**row, "train_env_config": {"agent_colision_penalty": 5.0}}
    assert "did you mean 'agent_collision_penalty'" in refused(replace(experiment, variants={"a": wrong}))


def test_variants_have_settings_that_depend_on_the_env_steps() -> None:
    experiment = load_script("facmac_two_stage").experiment
    for steps in (2_000_000, 3000):
        two_stage, whole = experiment.specs(parsed(experiment, "--stop-timesteps", str(steps)))[:2]
        assert two_stage.build_config().mixer_start == steps // 2
        assert whole.build_config().mixer_start == 0
    sources = load_script("facmac_critic_source").experiment
    for spec in sources.specs(parsed(sources)):
        assert spec.build_config().critic_source == spec.algorithm


# --- Tune's saved state -------------------------------------------------------------------------------------------


def saved_state(folder: Path, text: str) -> Path:
    (folder / "experiment_state-2026-01-01_00-00-00.json").write_text("an older one, which nobody reads")
    path = folder / "experiment_state-2026-02-01_00-00-00.json"
    path.write_text(text)
    return path


def test_what_tune_meant_to_do_is_forgotten(tmp_path: Path) -> None:
    state = {"trial_data": [["{}", "{}"]], "runner_data": {"_cached_trial_decisions": {"a": "STOP"}, "_iteration": 7}}
    path = saved_state(tmp_path, json.dumps(state))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        forget_decisions(tmp_path)
    state["runner_data"]["_cached_trial_decisions"] = {}  # type: ignore[index]
    assert json.loads(path.read_text()) == state
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(
    ("version", "text", "message"),
    [
        ("2.61.0", None, r"Resuming was tried with Ray 2\.60, and this is Ray 2\.61\.0\. So .* may be stopped"),
        ("2.6.0", None, r"this is Ray 2\.6\.0"),
        ("2.60.1", "half of a fi", r"state-2026-02-01_00-00-00\.json does not look as Ray 2\.60 writes it\. So "),
        ("2.60.1", "[]", "does not look"),
        ("2.60.1", '{"runner_data": []}', "does not look"),
        ("2.60.1", '{"runner_data": {"_cached_decisions": {}}}', "does not look"),
        ("2.60.1", '{"runner_data": {"_cached_trial_decisions": ["a"]}}', "does not look"),
    ],
)
def test_a_saved_state_that_is_not_known_is_left_alone_with_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str, text: str | None, message: str
) -> None:
    monkeypatch.setattr(ray, "__version__", version)
    text = '{"runner_data": {"_cached_trial_decisions": {"a": "STOP"}}}' if text is None else text
    path = saved_state(tmp_path, text)
    with pytest.warns(UserWarning, match=message) as seen:
        forget_decisions(tmp_path)
    assert len(seen) == 1
    assert path.read_text() == text


def test_the_release_of_ray_that_is_known_is_the_one_that_is_required() -> None:
    project = tomllib.loads((SCRIPTS.parent / "pyproject.toml").read_text())["project"]
    major, minor = TESTED_RAY
    assert f"ray[rllib,tune]>={major}.{minor},<{major}.{minor + 1}" in project["dependencies"]


# --- A whole run --------------------------------------------------------------------------------------------------

# Trials with env steps of their own; the second one's agents share a policy with entity networks.
STOPS = {"iddpg-seed0": 2000, "entity-seed0": 1600, "maddpg-l-seed0": 2000}
TRIALS = tuple(STOPS)
SCRIPT = """
from rllib_maobs.experiment import Experiment

experiment = Experiment(
    name="small",
    env="maobs/spread-3a",
    algorithms=("iddpg", "entity", "maddpg-l", "facmac"),
    quick_algorithms=("iddpg", "entity", "maddpg-l"),
    variants={
        "iddpg": {"algorithm": "iddpg", "quick": {"stop_timesteps": 2000}},
        "entity": {
            "algorithm": "maddpg",
            "actor": "entity",
            "critic": "entity",
            "critic_state": "world",
            "updates_per_env_step": 1 / 8,
            "one_policy": True,
            "env_config": {"action_mode": "force"},
            "train_horizon": 25,
            "quick": {"stop_timesteps": 1600, "steps_per_iteration": 800, "evaluation_duration": 2},
        },
        "maddpg-l": {"algorithm": "maddpg-l", "quick": {"stop_timesteps": 2000}},
    },
    training={"train_batch_size_per_learner": 64},
)

if __name__ == "__main__":
    experiment.main()
"""


def read_results(trial: Path) -> list[dict[str, Any]]:
    path = trial / "result.json"
    return [json.loads(line) for line in path.read_text().split("\n")[:-1]] if path.exists() else []


def wait_for(condition: Callable[[], Any], process: subprocess.Popen[str]) -> Any:
    deadline = time.monotonic() + 600
    while not (value := condition()):
        assert process.poll() is None, "the run ended too early"
        assert time.monotonic() < deadline, "the run takes too long"
        time.sleep(0.1)
    return value


def died_while_saving(results: Path, algorithm: str) -> None:
    """Make Tune's saved state what it is, with the right timing, after a trial died while it wrote a checkpoint."""
    (path,) = results.glob("experiment_state-*.json")
    state = json.loads(path.read_text())
    for entry in state["trial_data"]:
        trial = json.loads(entry[0])
        if trial["config"]["algorithm"] == algorithm:
            entry[0] = json.dumps(trial | {"status": "ERROR"})
            state["runner_data"]["_cached_trial_decisions"] = {trial["trial_id"]: "STOP"}
    path.write_text(json.dumps(state))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimpleNamespace]:
    """A quick run, in which a trial's process is killed and which is then interrupted; and then resumed."""
    folder = tmp_path_factory.mktemp("run")
    results = folder / "the [first] results, größer #1 100%"
    script = folder / "small.py"
    script.write_text(SCRIPT)
    command = [sys.executable, str(script), "--results-dir", f"./{results.name}/"]
    # Tune copies results to the folder with each checkpoint; with one an iteration the first trial is killed early, and
    # has checkpoints to write after it is resumed: there a decision that is not forgotten would stop it.
    first = [*command, "--quick", "--checkpoint-freq", "1", "--max-failures", "0"]
    with subprocess.Popen(first, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            killed = wait_for(lambda: read_results(results / TRIALS[0])[1:], process)
            with pytest.raises(ValueError, match=f"is in use by another run .process {process.pid} on "):
                claim(results)
            os.kill(killed[0]["pid"], signal.SIGKILL)
            wait_for((results / TRIALS[0] / "error.txt").exists, process)
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate(timeout=600)
        finally:
            process.kill()
    assert len(read_results(results / TRIALS[0])) < STOPS[TRIALS[0]] // 400 - 1, (
        "killed so late that it has no checkpoint left to write"
    )
    died_while_saving(results, "iddpg")
    resumed = subprocess.run([*command, "--resume"], cwd=folder, capture_output=True, text=True, timeout=600)
    yield SimpleNamespace(results=results, script=script, code=process.returncode, output=output, resumed=resumed)


def test_the_plan_is_printed_first(run: SimpleNamespace) -> None:
    plan, table, _ = run.output.partition(" since the start")
    assert table
    assert "small: 3 trials, iddpg, entity, maddpg-l with seed 0\n--quick trains iddpg and entity and maddpg-l" in plan
    assert ["entity", "1,600", "0.125"] in [line.split() for line in plan.splitlines()]
    assert f"TensorBoard: tensorboard --logdir {shlex.quote(str(run.results))}\n" in plan


def test_a_failed_trial_and_an_interruption_are_reported(run: SimpleNamespace) -> None:
    assert run.code == 130, run.output
    assert f"FAILED: iddpg-seed0, see {run.results / 'iddpg-seed0' / 'error.txt'}" in run.output
    assert f"--resume --results-dir {shlex.quote(str(run.results))}\n" in run.output


def test_a_resumed_run_goes_on_where_it_was(run: SimpleNamespace) -> None:
    assert run.resumed.returncode == 0, run.resumed.stdout + run.resumed.stderr
    curves = load_curves(run.results)
    for trial, steps in (("iddpg", 400), ("entity", 800), ("maddpg-l", 400)):
        done = curves.loc[curves["trial"] == f"{trial}-seed0", "env_steps"].tolist()
        assert done == list(range(steps, STOPS[f"{trial}-seed0"] + 1, steps))
    # It was killed after its first checkpoint: another process made the iterations that follow, and only those.
    first, *_, last = read_results(run.results / TRIALS[0])
    assert first["pid"] != last["pid"]
    assert last["iterations_since_restore"] < last["training_iteration"] == 5


def test_everything_promised_is_written(run: SimpleNamespace) -> None:
    text = (run.results / "comparison.md").read_text()
    assert "| maddpg-l " in text and "last 3 evaluations" in text
    assert "![learning curves](curves.png)\n\n![an episode of " in text and "(episode.gif)" in text
    comparison = pd.read_csv(run.results / "comparison.csv")
    assert sorted(comparison["algorithm"]) == ["entity", "iddpg", "maddpg-l"]
    assert np.isfinite(comparison[["score", "coverage", "collisions", "collision_free", "hours"]]).all(axis=None)
    assert len(pd.read_csv(run.results / "curves.csv")) == 2 * 5 + 2
    assert colours(run.results / "curves.png") > 10
    for trial in TRIALS:
        folder = run.results / trial
        assert any(path.stat().st_size > 1000 for path in folder.glob("events.out.tfevents.*"))
        progress = pd.read_csv(folder / "progress.csv")
        assert progress[STEPS].iloc[-1] == STOPS[trial]
        assert progress["env_runners/episode_return_mean"].notna().any()
    # No training episode ends in the first iteration, so this is a column that was not there at first.
    assert np.isnan(pd.read_csv(run.results / TRIALS[0] / "progress.csv")["env_runners/episode_return_mean"].iloc[0])


def test_the_best_is_filmed(run: SimpleNamespace) -> None:
    best = pd.read_csv(run.results / "comparison.csv")["algorithm"].iloc[0]
    film = run.results / "episode.gif"
    assert f"An episode of {best}-seed0, the best one: {film}\n" in run.resumed.stdout
    assert Image.open(film).n_frames == 101


def test_a_film_that_fails_says_why(run: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one of agents that were trained with other options of the environment is filmed with these."""
    results = tmp_path / "results"
    shutil.copytree(run.results, results)
    experiment = load_script(run.script).experiment
    specs = experiment.specs(parsed(experiment, "--quick"))
    others = ["iddpg-seed0", "maddpg-l-seed0"]
    assert film_best(results, specs, others) == f"An episode of entity-seed0, the best one: {results / 'episode.gif'}"
    assert (results / "comparison.md").read_text().endswith("\n![an episode of entity-seed0](episode.gif)\n")
    assert film_best(results, specs, TRIALS) == "No film: nothing has been evaluated."
    foreign = [replace(spec, env="mine") for spec in specs]
    assert film_best(results, foreign) == "No film: mine is not an environment of this package."
    monkeypatch.setitem(sys.modules, "pygame", None)  # as if it were not installed
    said = film_best(results, specs, others)
    assert said == 'No film: pictures need pygame: pip install -c constraints.txt -e ".[render]"'
    assert not (results / "episode.gif").exists()


def test_checkpoints_can_be_trained_on(run: SimpleNamespace, ray_session: None) -> None:
    *_, checkpoint = sorted((run.results / "maddpg-l-seed0").glob("checkpoint_*"))
    algorithm = Algorithm.from_checkpoint(str(checkpoint))
    try:
        assert algorithm.train()[STEPS] == STOPS["maddpg-l-seed0"] + 400
    finally:
        algorithm.stop()


# --- One trial ----------------------------------------------------------------------------------------------------


@pytest.fixture
def predators() -> Any:
    """The tuned row of predator-prey, small: learning starts after 80 env steps, and it is done after 300."""
    experiment = load_script("obstacle_predator_prey").experiment
    small = {"num_random_steps": 40, "num_steps_sampled_before_learning_starts": 80, "num_envs_per_env_runner": 4}
    small |= {"train_batch_size_per_learner": 16, "steps_per_iteration": 160, "evaluation_duration": 1}
    return replace(experiment, variants={TUNED: {**experiment.variants[TUNED], **small, "stop_timesteps": 300}})


def test_a_trial_is_done_at_its_own_env_steps(ray_session: None, predators: Experiment) -> None:
    spec = predators.specs(parsed(predators, "--algos", TUNED, "--no-compile"))[0]
    trial = Trial(config=asdict(spec))
    try:
        first, second = trial.train(), trial.train()
    finally:
        trial.stop()
    assert (first[STEPS], first["done"]) == (160, False)
    assert (second[STEPS], second["done"]) == (320, True)
    assert "all" in second["learners"] and "predator_0" not in second["learners"]


def test_a_full_run_measures_how_long_it_takes(
    ray_session: None, predators: Experiment, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = parsed(predators, "--algos", TUNED, "--quick", "--stop-timesteps", "300", "--no-compile")
    args.results_dir = tmp_path
    predators._print_plan(args, predators.specs(args))
    out = capsys.readouterr().out
    assert "Measured with 1 at once in" in out and "Replay will take up to 0 MB" in out
    (row,) = [line.split() for line in out.splitlines() if line.startswith("maddpg-entity")]
    assert row[1:3] == ["300", "0.25"] and float(row[3]) > 1.0
