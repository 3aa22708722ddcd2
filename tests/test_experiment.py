"""Experiments: the command line, the report, and a whole run that is interrupted, damaged and resumed."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib.image
import numpy as np
import pandas as pd
import pytest
import ray
from ray.rllib.algorithms import Algorithm

import rllib_maobs as maobs
from rllib_maobs.envs import make_vec
from rllib_maobs.experiment import Experiment, load_curves, plot_curves, summarise
from rllib_maobs.experiment.arguments import make_parser, parse
from rllib_maobs.experiment.baselines import play_baselines
from rllib_maobs.experiment.progress import ProgressTable, makespan
from rllib_maobs.experiment.report import STEPS, to_markdown
from rllib_maobs.experiment.resume import TESTED_RAY, forget_decisions

SCRIPTS = Path(__file__).parent.parent / "tuned_examples"
EXPERIMENT = Experiment(
    name="demo", env="maobs/spread-3a", algorithms=("iddpg", "maddpg"), training={}, stop_timesteps=1000
)


def result(algorithm: str, seed: int, steps: int, score: float, coverage: float = 0.5, **more: Any) -> dict[str, Any]:
    """One line of a result.json, with what the report reads."""
    metrics = {"coverage": coverage, "collisions_agents": 2.0, "collisions_obstacles": 1.0}
    return {
        "config": {"algorithm": algorithm, "seed": seed},
        STEPS: float(steps),
        "time_this_iter_s": 2.0,
        "time_total_s": steps / 50,
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


@pytest.mark.parametrize("options", [{}, {"action_mode": "discrete"}, {"terminate_on_success": True}])
def test_baselines_are_means_over_whole_episodes(options: dict[str, Any]) -> None:
    baselines = play_baselines("maobs/spread-3a", {"horizon": 100, **options}, episodes=20)
    assert list(baselines) == ["random", "heuristic"]
    assert -900 < baselines["random"]["return_agent_0"] < -650 < -90 < baselines["heuristic"]["return_agent_0"] < 0
    assert baselines["random"]["success"] == 0.0 < 0.9 < baselines["heuristic"]["success"] <= 1.0
    length = baselines["heuristic"]["episode_length"]
    assert length == 100.0 if "terminate_on_success" not in options else 5.0 < length < 60.0
    single = make_vec("spread-3a", **options)
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


def colours(picture: Path) -> int:
    return len(np.unique(matplotlib.image.imread(picture).reshape(-1, 4), axis=0))


@pytest.mark.parametrize(
    ("reached", "error", "code", "says"),
    [
        ((1000, 1000), (None, None), None, "maddpg "),
        ((1000, 400), (None, "boom"), 1, "FAILED: maddpg-seed0, see {}/maddpg-seed0/error.txt"),
        ((1000, 400), (None, None), 130, "Interrupted. Go on with: python "),
        ((1000, 400), (None, None), 130, "--resume --results-dir {}"),
    ],
)
def test_the_end_of_a_run(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    reached: tuple[int, int],
    error: tuple[str | None, str | None],
    code: int | None,
    says: str,
) -> None:
    trials = []
    for algorithm, steps, wrong in zip(EXPERIMENT.algorithms, reached, error, strict=True):
        write_results(tmp_path, [result(algorithm, 0, steps, -5.0)])
        path = str(tmp_path / f"{algorithm}-seed0")
        trials.append(SimpleNamespace(path=path, error=wrong, metrics={STEPS: float(steps)}))
    args = parse(make_parser("demo", EXPERIMENT.algorithms, 1000), "demo", ["--results-dir", str(tmp_path / "new")])
    args.results_dir = tmp_path
    assert (EXPERIMENT._report(args, trials, planned=2) or None) == code  # type: ignore[arg-type]
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


def test_progress_table() -> None:
    table = ProgressTable(stop_timesteps=1000, every_s=30.0)
    running = FakeTrial(trial_id="maddpg-seed0", status="RUNNING", last_result=result("maddpg", 0, 100, -5.0))
    waiting = FakeTrial(trial_id="iddpg-seed0", status="PENDING", last_result={})
    trials = [running, waiting]
    assert not table.should_report(trials)
    running.last_result = result("maddpg", 0, 200, -4.0)
    # 100 env steps since the first result took 2 s; 800 are left here, and then 1000 of the one that waits.
    head, header, first, second = table.table(trials).splitlines()
    assert head.endswith("about 0:00:36 left")
    assert header.split("  ")[0] == "trial"
    assert first.split() == ["maddpg-seed0", "running", "200", "/", "1,000", "-4.0", "0.50", "3.0", "50", "0:00:16"]
    assert second.split() == ["iddpg-seed0", "waiting", "0", "/", "1,000", "-", "-", "-", "-", "-"]


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
        ("--train-horizon 2.5", "argument --train-horizon: '2.5' is not a whole number >= 1"),
        ("--num-env-runners nan", "argument --num-env-runners: 'nan' is not a whole number >= 0"),
        ("--address auto --workers 3", "--workers is for this machine; with --address the free cores of the cluster"),
        ("--resume --results-dir none", "none: leave --resume out, or correct --results-dir"),
        ("--results-dir used", "used is not empty: continue the run there with --resume, or choose another"),
        ("--results-dir used/experiment.json", "experiment.json is not a folder"),
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
    assert "tau must be a finite number" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_resume_takes_the_settings_of_the_original_run(used: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stored = json.loads((used / "experiment.json").read_text()) | {"seeds": [7, 8], "quick": True}
    (used / "experiment.json").write_text(json.dumps(stored))

    def resume(name: str, *more: str) -> Any:
        parser = make_parser(name, EXPERIMENT.algorithms, 1000)
        return parse(parser, name, ["--resume", "--results-dir", str(used), *more])

    args = resume("demo", "--workers", "4", "--seeds", "7", "8")
    assert (args.seeds, args.quick, args.stop_timesteps, args.workers) == ([7, 8], True, 1000, 4)
    with pytest.raises(SystemExit):
        resume("another")
    assert "holds a run of demo, not of another" in capsys.readouterr().err


def test_quick_changes_defaults_only() -> None:
    args = parse(make_parser("demo", ["iddpg"], 10**6), "demo", ["--quick", "--stop-timesteps", "2e3"])
    assert (args.stop_timesteps, args.seeds, args.no_compile) == (2000, [0], True)
    assert args.results_dir == Path("results/demo-quick").resolve()


# --- The scripts --------------------------------------------------------------------------------------------------


def load_script(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


FIVE = ("iddpg", "maddpg", "maddpg-lstm", "maddpg-l", "facmac")
FOUR = FIVE[:4]


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
    assert experiment.algorithms == algorithms
    assert experiment.stop_timesteps == 2_000_000
    parser = make_parser(experiment.name, experiment.algorithms, experiment.stop_timesteps)
    arguments = ["--train-horizon", "25", "--critic-state", "world", "--seeds", "5", "6", "--results-dir", "new"]
    specs = experiment.specs(parse(parser, experiment.name, arguments))
    count = len(algorithms)
    assert [(spec.algorithm, spec.seed) for spec in specs] == [(a, s) for s in (5, 6) for a in algorithms]
    for spec in specs[:count]:
        config = spec.build_config()
        config.validate()
        assert config.name == (spec.algorithm if spec.algorithm in maobs.ALGORITHMS else "facmac")
        assert len(config.team.agents) == agents
        assert (config.actor_lr, config.critic_lr, config.gamma) == (0.001, critic_lr, 0.95)
        assert (config.train_batch_size_per_learner, config.seq_length) == (batch, seq_length)
        assert (config.seed, config.critic_state, config.torch_compile_learner) == (5, "world", True)
        # Training episodes are short, evaluation is the paper's: 10 noise-free episodes of 100 steps.
        evaluation = config.get_evaluation_config_object()
        assert (config.env_config["horizon"], evaluation.env_config["horizon"]) == (25, 100)
        assert (config.explore, evaluation.explore) == (True, False)
        assert (config.evaluation_interval, config.evaluation_duration) == (1, 10)


def test_variants_have_settings_of_their_own() -> None:
    experiment = load_script("facmac_two_stage").experiment
    parser = make_parser(experiment.name, experiment.algorithms, experiment.stop_timesteps)
    for steps in (2_000_000, 3000):
        arguments = ["--stop-timesteps", str(steps), "--results-dir", "new"]
        two_stage, whole = experiment.specs(parse(parser, experiment.name, arguments))[:2]
        assert two_stage.build_config().mixer_start == steps // 2
        assert whole.build_config().mixer_start == 0
    sources = load_script("facmac_critic_source").experiment
    parser = make_parser(sources.name, sources.algorithms, sources.stop_timesteps)
    for spec in sources.specs(parse(parser, sources.name, ["--results-dir", "new"])):
        assert spec.build_config().critic_source == spec.algorithm
    with pytest.raises(ValueError, match="Unknown algorithms 'madpg'; legal are iddpg, maddpg"):
        Experiment(name="x", env="maobs/tunnel", algorithms=("a",), variants={"a": {"algorithm": "madpg"}}, training={})


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

STOP = 2000
TRIALS = ("iddpg-seed0", "maddpg-seed0", "maddpg-l-seed0")


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
    results = folder / "results"
    command = [sys.executable, str(SCRIPTS / "spread3a.py"), "--results-dir", str(results)]
    # Tune copies results to the folder with each checkpoint; with one an iteration the first trial is killed early, and
    # has checkpoints to write after it is resumed: there a decision that is not forgotten would stop it.
    first = [*command, "--quick", "--stop-timesteps", str(STOP), "--checkpoint-freq", "1"]
    first += ["--algos", "iddpg", "maddpg", "maddpg-l"]
    with subprocess.Popen(first, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            killed = wait_for(lambda: read_results(results / TRIALS[0])[1:], process)
            os.kill(killed[0]["pid"], signal.SIGKILL)
            wait_for((results / TRIALS[0] / "error.txt").exists, process)
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate(timeout=600)
        finally:
            process.kill()
    assert len(read_results(results / TRIALS[0])) < STOP // 400 - 1, (
        "killed so late that it has no checkpoint left to write"
    )
    died_while_saving(results, "iddpg")
    resumed = subprocess.run([*command, "--resume"], cwd=folder, capture_output=True, text=True, timeout=600)
    yield SimpleNamespace(results=results, code=process.returncode, output=output, resumed=resumed)


def test_the_plan_is_printed_first(run: SimpleNamespace) -> None:
    plan, table, _ = run.output.partition(" since the start")
    assert table
    assert "spread-3a: 3 trials, iddpg, maddpg, maddpg-l with seed 0\n2,000 env steps each, 1 update(s)" in plan
    assert "Measured with 2 at once in" in plan
    assert f"TensorBoard: tensorboard --logdir {run.results}" in plan


def test_a_failed_trial_and_an_interruption_are_reported(run: SimpleNamespace) -> None:
    assert run.code == 130, run.output
    assert f"FAILED: iddpg-seed0, see {run.results / 'iddpg-seed0' / 'error.txt'}" in run.output
    assert f"--resume --results-dir {run.results}" in run.output


def test_a_resumed_run_goes_on_where_it_was(run: SimpleNamespace) -> None:
    assert run.resumed.returncode == 0, run.resumed.stdout + run.resumed.stderr
    curves = load_curves(run.results)
    for trial in TRIALS:
        assert curves.loc[curves["trial"] == trial, "env_steps"].tolist() == [400, 800, 1200, 1600, 2000]
    # It was killed after its first checkpoint: another process made the iterations that follow, and only those.
    first, *_, last = read_results(run.results / TRIALS[0])
    assert first["pid"] != last["pid"]
    assert last["iterations_since_restore"] < last["training_iteration"] == 5


def test_everything_promised_is_written(run: SimpleNamespace) -> None:
    assert "| maddpg-l " in (run.results / "comparison.md").read_text()
    comparison = pd.read_csv(run.results / "comparison.csv")
    assert sorted(comparison["algorithm"]) == ["iddpg", "maddpg", "maddpg-l"]
    assert np.isfinite(comparison[["score", "coverage", "collisions", "collision_free", "hours"]]).all(axis=None)
    assert len(pd.read_csv(run.results / "curves.csv")) == 3 * STOP // 400
    assert colours(run.results / "curves.png") > 10
    for trial in TRIALS:
        folder = run.results / trial
        assert any(path.stat().st_size > 1000 for path in folder.glob("events.out.tfevents.*"))
        progress = pd.read_csv(folder / "progress.csv")
        assert progress[STEPS].tolist() == list(range(400, STOP + 1, 400))
        # No training episode ends in the first iteration, so this is a column that was not there at first.
        assert progress["env_runners/episode_return_mean"].notna().any()


def test_checkpoints_can_be_trained_on(run: SimpleNamespace, ray_session: None) -> None:
    (checkpoint,) = (run.results / "maddpg-l-seed0").glob("checkpoint_*")
    algorithm = Algorithm.from_checkpoint(str(checkpoint))
    try:
        assert algorithm.train()[STEPS] == STOP + 400
    finally:
        algorithm.stop()
