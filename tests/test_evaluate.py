"""The command that measures what was trained, beside random play and the heuristic, in teams of any size."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from rllib_maobs.envs import make_scenario, make_vec
from rllib_maobs.evaluate import jobs_of, main, summarise_episodes, to_text
from rllib_maobs.experiment import baselines
from rllib_maobs.experiment.baselines import play_baselines, play_many, task_options
from rllib_maobs.experiment.trial import Trial, TrialSpec
from rllib_maobs.policies import make_policy, play_episodes
from rllib_maobs.report import __main__ as report
from rllib_maobs.report.results import Section


@pytest.fixture(scope="module")
def trial_folder(ray_session: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained team of entity networks, evaluated with another horizon and price than it was trained with."""
    folder = tmp_path_factory.mktemp("trials") / "maddpg-seed0"
    spec = TrialSpec(
        algorithm="maddpg",
        seed=0,
        env="maobs/spread-3a",
        stop_timesteps=1,
        training={"actor": "entity", "critic": "entity", "critic_state": "world"},
        env_config={"action_mode": "force", "horizon": 3, "agent_collision_penalty": 7.0},
        evaluation_env_config={"horizon": 8, "agent_collision_penalty": 1.0},
        one_policy=True,
        torch_compile=False,
    )
    trial = Trial(asdict(spec))
    checkpoint = folder / "checkpoint_000000"
    checkpoint.mkdir(parents=True)
    trial.save_checkpoint(str(checkpoint))
    trial.stop()
    return folder


def run(*arguments: object) -> None:
    main([str(argument) for argument in arguments])


def test_episodes_are_those_of_the_single_copies() -> None:
    env = make_vec("tunnel", num_envs=3, horizon=40, terminate_on_success=True, start_noise=0.05)
    rows = play_episodes(env, make_policy(env, "heuristic"), seed=4)
    assert list(rows["seed"]) == [4, 5, 6]
    assert len(set(rows["episode_length"])) > 1  # some go on while others have ended
    for index, seed in enumerate(rows["seed"]):
        single = make_vec("tunnel", horizon=40, terminate_on_success=True, start_noise=0.05)
        ((_, alone),) = play_episodes(single, make_policy(single, "heuristic"), seed=int(seed)).iterrows()
        pd.testing.assert_series_equal(alone, rows.iloc[index], check_names=False)


def test_large_teams_are_played_in_fewer_copies_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made = list[int]()

    def recorded(env: str, num_envs: int, **options: Any) -> Any:
        made.append(num_envs)
        return make_vec(env, num_envs=num_envs, **options)

    monkeypatch.setattr(baselines, "make_vec", recorded)
    for num_agents, copies in ((3, [5]), (60, [4, 1]), (200, [1] * 5)):
        made.clear()
        options = make_scenario("spread-3a").resized(num_agents)
        seeds = play_many("spread-3a", {**options, "horizon": 2}, "random", 5)["seed"]
        assert (made, list(seeds)) == (copies, [0, 1, 2, 3, 4])


def test_who_never_succeeds_has_no_time_to_success() -> None:
    rows = pd.DataFrame({"env": "e", "agents": 3, "options": "", "policy": ["a", "b"], "success": [0.0, 1.0]})
    lines = to_text(summarise_episodes(rows.assign(time_to_goal=[100.0, 14.0]))).splitlines()
    assert [line.split()[-1] for line in lines if " agents" in line] == ["-", "14.0"]


def test_means_have_intervals_that_hold_them() -> None:
    rng = np.random.default_rng(0)
    returns = rng.normal(-10.0, 2.0, 400)
    frame = pd.DataFrame({"env": "e", "agents": 3, "options": "{}", "policy": "p", "return": returns, "success": 1.0})
    (row,) = summarise_episodes(frame).to_dict("records")
    assert row["return"] == pytest.approx(returns.mean())
    half = 1.96 * returns.std() / np.sqrt(400)
    assert row["return_high"] - row["return"] == pytest.approx(half, rel=0.15)
    assert row["return"] - row["return_low"] == pytest.approx(half, rel=0.15)
    assert row["success_low"] == row["success_high"] == 1.0


def test_a_trial_is_evaluated_as_its_training_was(trial_folder: Path, tmp_path: Path) -> None:
    ((_, task),) = jobs_of(str(trial_folder), None, [], {})
    assert (task.env, task.options["horizon"], task.options["agent_collision_penalty"]) == ("spread-3a", 8, 1.0)
    files = [tmp_path / name for name in ("table.csv", "table.json", "episodes.csv", "best.gif")]
    flags = [
        part for pair in zip(("--csv", "--json", "--per-episode", "--record"), files, strict=True) for part in pair
    ]
    run(trial_folder, "--episodes", 5, *flags)
    table = pd.read_csv(files[0])
    assert list(table["policy"]) == ["random", "heuristic", "orca", "maddpg-seed0"]
    assert json.loads(files[1].read_text())[3]["return"] == pytest.approx(table["return"][3])
    episodes = pd.read_csv(files[2])
    assert len(episodes) == 20
    assert episodes.groupby("policy")["return"].mean()["maddpg-seed0"] == pytest.approx(table["return"][3])
    assert files[3].stat().st_size > 1000


def test_what_is_not_trained_has_one_number_on_a_task(
    trial_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In evaluate, in the report and in comparison.md, whatever the team beside it acts with."""
    run(trial_folder, "--episodes", 6, "--csv", tmp_path / "table.csv")
    assert "acts with each task's own action_mode" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "table.csv").set_index("policy")
    assert json.loads(table["options"]["maddpg-seed0"])["action_mode"] == "force"
    assert "action_mode" not in json.loads(table["options"]["random"])
    monkeypatch.setattr(report, "_EPISODES", 6)
    options = {"horizon": 8, "agent_collision_penalty": 1.0}
    section = Section("maobs/spread-3a", task_options("spread-3a", {**options, "action_mode": "discrete"}))
    on_page = report.play_baselines(section)
    compared = play_baselines("maobs/spread-3a", {**options, "action_mode": "force"}, episodes=6)
    assert [*on_page] == ["random", "heuristic", "orca"] and [*compared] == ["random", "heuristic"]
    for name in ("return", "coverage", "collisions_agents", "collisions_obstacles", "path_efficiency"):
        for policy, means in on_page.items():
            assert table[name][policy] == pytest.approx(means[name], rel=1e-12, nan_ok=True)
            if policy in compared and name != "return":
                assert compared[policy][name] == means[name]
    assert compared["random"]["return_agent_0"] == on_page["random"]["score"]


def test_the_same_twice_is_evaluated_once(trial_folder: Path, tmp_path: Path) -> None:
    again = f"{trial_folder}/"
    run(trial_folder, again, "--episodes", 2, "--num-agents", 2, 2, "--csv", tmp_path / "t.csv", "--baselines", "none")
    assert [*pd.read_csv(tmp_path / "t.csv")["episodes"]] == [2]


def test_teams_of_other_sizes(trial_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(
        trial_folder,
        "--episodes",
        2,
        "--num-agents",
        2,
        9,
        "--csv",
        tmp_path / "sizes.csv",
        "--baselines",
        "heuristic",
        "horizon=2",
    )
    table = pd.read_csv(tmp_path / "sizes.csv")
    assert list(table["agents"]) == [2] * 2 + [9] * 2 and list(table["policy"][:2]) == ["heuristic", "maddpg-seed0"]
    nine = json.loads(table["options"][3])
    assert nine == asdict(make_scenario("spread-9a", action_mode="force", horizon=2).options)
    out = capsys.readouterr().out
    assert "spread-3a, 9 agents" in out
    assert "2 episodes each from seed 0" in out


def test_resized_tasks() -> None:
    for env, size in (("spread-3a", 9), ("spread-9a", 6)):
        scenario = make_scenario(env)
        other = make_scenario(env, **scenario.resized(size))
        assert asdict(other.options) == asdict(make_scenario(f"spread-{size}a").options)
    room = make_scenario("spread-9a").resized(36)
    assert (room["agent_range"], room["obstacle_range"], room["num_obstacles"]) == pytest.approx((2.0, 1.8, 24))
    prey = make_scenario("obstacle-predator-prey", prey="learned")
    assert len(make_scenario("obstacle-predator-prey", prey="learned", **prey.resized(5)).agents) == 5
    assert make_scenario("tunnel").resized(2) == {"num_agents": 2}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--episodes", 1], "--episodes 1 is illegal; legal: an integer >= 2"),
        (["--baselines", "orka"], "'orka' is illegal; legal: none, or some of random,heuristic,orca"),
        (["--num-agents", 0], "--num-agents 0 is illegal; legal: integers >= 1"),
        (["agent_range=0.2", "--num-agents", 12], "use fewer or smaller bodies"),
        (["--num-agents", 1000], "a team of 1000 needs some 612.0 GB of memory"),
        (["num_agents=4", "--num-agents", 3], "--num-agents and num_agents=... say the same"),
        (["--csv", "FOLDER.x", "--json", "FOLDER.x"], "name the same file"),
        (["scenario=tunnel"], "scenario=... is no option of a task; legal are those of its class"),
        (["horzon=3"], "did you mean 'horizon'"),
        (["--env", "spread-4a"], "unknown scenario 'spread-4a'"),
        (
            ["--env", "obstacle-predator-prey"],
            "was trained on (18,): EntityActor of this agent has parameters of other",
        ),
        (["--csv", "FOLDER"], "exists: remove it, or choose another file"),
        (["--json", "FOLDER/no/x.json"], "there is no folder"),
    ],
)
def test_mistakes_end_in_a_sentence(
    trial_folder: Path, arguments: list[Any], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        run(trial_folder, *(str(argument).replace("FOLDER", str(trial_folder)) for argument in arguments))
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_what_is_no_checkpoint_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "results" / "maddpg-seed0" / "checkpoint_000001").mkdir(parents=True)
    for arguments, message in (
        ([tmp_path], "is no checkpoint; legal:"),
        ([tmp_path / "results"], "or of a trial with checkpoints. Trials in it are maddpg-seed0."),
        (["heuristic"], "heuristic comes by itself beside every checkpoint"),
        (["horizon=3"], "nothing to evaluate"),
    ):
        with pytest.raises(SystemExit):
            run(*arguments)
        assert message in capsys.readouterr().err
