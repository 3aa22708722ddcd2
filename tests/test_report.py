"""The page of an experiment: its statistics, what it says of results folders, and how it behaves in a browser."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import asdict, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rllib_maobs.envs import make_vec
from rllib_maobs.evaluate import Task
from rllib_maobs.experiment.trial import Trial, TrialSpec
from rllib_maobs.policies import make_policy, play_episodes
from rllib_maobs.report.__main__ import main, play_baselines, play_teams, write_whole
from rllib_maobs.report.episodes import record_episode
from rllib_maobs.report.results import read_results
from rllib_maobs.report.statistics import (
    interquartile_mean,
    learning_curve,
    performance_profile,
    probability_of_improvement,
)

# Statistics.


def test_the_interquartile_mean_leaves_out_a_quarter_at_either_end() -> None:
    runs = np.array([100.0, 1.0, 2.0, 3.0, 4.0, -50.0, 5.0, 6.0])
    assert interquartile_mean([runs]).value == np.mean([2.0, 3.0, 4.0, 5.0])
    assert interquartile_mean([runs[:4], runs[4:]]).value == np.mean([2.0, 3.0, 4.0, 5.0])


def test_runs_are_drawn_anew_within_each_task() -> None:
    """Tasks differ, runs of one task do not: whatever is drawn, nothing changes."""
    assert interquartile_mean([np.full(4, 1.0), np.full(4, 9.0)]) == (5.0, 5.0, 5.0)
    wide = interquartile_mean([np.array([1.0, 1.0, 1.0, 1.0, 9.0, 9.0, 9.0, 9.0])])
    assert wide.low < 3.0 and wide.high > 7.0


def test_intervals_are_as_wide_as_theory_says() -> None:
    runs = np.random.default_rng(0).uniform(0.0, 1.0, (200, 2))
    estimate = interquartile_mean([runs])
    # The asymptotic variance of a trimmed mean: that of the values, the outer quarters moved to the quartiles, times 4.
    standard_error = np.sqrt((1 / 96 + 2 * 0.25 * 0.25**2) * 4 / 200)
    assert estimate.value.shape == (2,)
    assert (estimate.high - estimate.low) / 2 == pytest.approx(1.96 * standard_error, rel=0.15)
    assert np.isnan(interquartile_mean([runs[:1, 0]]).low)


def test_probability_of_improvement_counts_pairs() -> None:
    value, low, high = probability_of_improvement([np.array([1.0, 2.0, 3.0])], [np.array([2.0, 0.0])])
    assert value == pytest.approx((1 + 1.5 + 2) / 6)
    assert low < value < high
    two_tasks = probability_of_improvement([np.array([1.0]), np.array([0.0])], [np.array([0.0]), np.array([1.0])])
    assert two_tasks.value == 0.5 and np.isnan(two_tasks.low)


def test_profiles_are_shares_of_runs_above() -> None:
    share = performance_profile([np.array([0.1, 0.5]), np.array([0.9, 0.9])], np.array([0.0, 0.5, 0.6, 0.9]))
    assert share.value.tolist() == [1.0, 0.5, 0.5, 0.0]
    assert (share.low <= share.value).all() and (share.value <= share.high).all()


def test_curves_of_runs_that_ended_early() -> None:
    x = np.arange(1, 11) * 100.0
    place, curve = learning_curve([(x, np.full(10, 1.0)), (x, np.full(10, 3.0)), (x[:4], np.full(4, 5.0))], points=5)
    assert place.tolist() == [150.0, 350.0, 550.0, 750.0, 950.0]
    assert curve.value.tolist() == [3.0, 3.0, 2.0, 2.0, 2.0]
    assert np.isfinite(curve.low).all()
    alone = learning_curve([(x, x), (x[:4], x[:4])])[1]
    assert np.isnan(alone.low[4:]).all() and np.isfinite(alone.low[:4]).all()


# Results folders.


def spec(algorithm: str, seed: int, env: str = "spread-3a", **settings: Any) -> TrialSpec:
    evaluation = {"horizon": 12, **settings.pop("evaluation", {})}
    return TrialSpec(
        algorithm=algorithm,
        seed=seed,
        env=f"maobs/{env}",
        stop_timesteps=settings.pop("stop_timesteps", 3000),
        training=settings,
        env_config={"action_mode": "force", "horizon": 25},
        evaluation_env_config=evaluation,
        torch_compile=False,
    )


def write_trial(folder: Path, trial: TrialSpec, scores: list[float]) -> Path:
    """What Tune leaves of a trial whose evaluations, every 1000 env steps, brought these scores."""
    path = folder / trial.name
    path.mkdir(parents=True)
    lines = []
    for number, score in enumerate(scores, start=1):
        metrics = {"coverage": 0.5 + number / 100, "success": 0.25, "all_covered": 0.25, "collision_free": 0.75}
        metrics |= {"collisions_agents": 1.0, "collisions_obstacles": 2.0, "collisions_walls": 0.0}
        metrics |= {"time_to_goal": 40.0 + trial.seed, "path_efficiency": 0.5 + trial.seed / 10}
        runners = {"episode_metrics": metrics, "agent_episode_returns_mean": {"agent_0": score}}
        result = {
            "num_env_steps_sampled_lifetime": 1000 * number,
            "time_total_s": 30.0 * number,
            "time_this_iter_s": 30.0,
            "hostname": "a-host",
            "date": "2026-11-27_01-02-03",
            "done": 1000 * number >= trial.stop_timesteps,
            "evaluation": {"env_runners": runners},
            "config": asdict(trial),
        }
        lines.append(json.dumps(result))
    path.joinpath("result.json").write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def results(ray_session: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two folders: two algorithms with three seeds on one task, and one of them on another task, not finished."""
    folder = tmp_path_factory.mktemp("results")
    for seed in range(3):
        write_trial(folder / "small", spec("ours", seed, actor_lr=1e-3), [-900.0, -200.0 - seed, -100.0 - 10 * seed])
        write_trial(folder / "small", spec("theirs", seed, actor_lr=1e-4), [-900.0, -400.0, -300.0 - seed])
        write_trial(folder / "large", spec("ours", seed, "spread-6a", stop_timesteps=9000), [-2000.0, -900.0, -700.0])
    plan = {"experiment": "small", "algos": ["ours", "theirs"], "seeds": [0, 1, 2, 3], "quick": True}
    (folder / "small" / "experiment.json").write_text(json.dumps(plan))
    trained = Trial(asdict(spec("iddpg", 0)))
    checkpoint = folder / "small" / "ours-seed0" / "checkpoint_000000"
    checkpoint.mkdir()
    trained.save_checkpoint(str(checkpoint))
    trained.stop()
    return folder


def test_trials_are_sorted_by_task(results: Path) -> None:
    (small, large), notes = read_results([results / "small", results / "large"])
    assert small.name == "spread-3a, horizon=12"
    assert {label: [t.settings["seed"] for t in trials] for label, trials in small.rows.items()} == {
        "ours": [0, 1, 2],
        "theirs": [0, 1, 2],
    }
    assert [*large.rows] == ["ours"]
    assert small.trials[0].last == 3 and large.trials[0].last == 10
    assert small.trials[0].result["score"] == pytest.approx(-400.0)
    assert small.trials[0].result["collisions"] == 3.0 and "collisions_walls" not in small.measures
    assert "small/ours-seed3: nothing evaluated yet" in notes
    assert "large/ours-seed2: unfinished, 3,000 of 9,000 env steps" in notes and len(notes) == 5


def test_one_name_from_two_folders(tmp_path: Path) -> None:
    """Seeds of one training come together, others are told apart by their folder."""
    for folder, seed, rate in (("a", 0, 1e-3), ("b", 1, 1e-3), ("c", 0, 1e-3), ("d", 1, 1e-4)):
        write_trial(tmp_path / folder, spec("ours", seed, actor_lr=rate), [-1.0])
    (section,), _ = read_results([tmp_path / "a", tmp_path / "b"])
    assert [*section.rows] == ["ours"]
    (saved,) = (tmp_path / "b").glob("*/result.json")  # an earlier revision's, which saved at other times
    result = json.loads(saved.read_text())
    assert result["config"].pop("varied") == {}
    result["config"]["checkpoint_freq"] = 7
    saved.write_text(json.dumps(result) + "\n")
    (section,), _ = read_results([tmp_path / "a", tmp_path / "b"])
    assert [*section.rows] == ["ours"]
    for other in ("c", "d"):
        (section,), _ = read_results([tmp_path / "a", tmp_path / other])
        assert [*section.rows] == ["ours (a)", f"ours ({other})"]


def test_a_run_that_is_going_on(tmp_path: Path) -> None:
    path = write_trial(tmp_path / "now", spec("ours", 0), [-3.0, -2.0])
    with (path / "result.json").open("a") as file:
        file.write('{"config": ')  # killed while it wrote
    (path / "error.txt").write_text("...")
    _, notes = read_results([tmp_path / "now"])
    assert notes == ["now/ours-seed0: failed after 2,000 env steps"]


def test_environments_of_others_have_neither_baselines_nor_episodes(tmp_path: Path) -> None:
    write_trial(tmp_path / "foreign", replace(spec("ours", 0), env="my_env"), [-3.0, -2.0, -1.0])
    ((section,), notes) = read_results([tmp_path / "foreign"])
    assert section.name == "my_env, horizon=12" and notes == []
    assert play_baselines(section) == {}
    assert play_teams(section, 0) == (
        {},
        ["my_env, horizon=12: no episodes to watch, for it is not an environment of this package"],
    )


def test_episodes_show_what_was_played() -> None:
    episode = record_episode(Task("simple-tunnel", {"horizon": 40}), "random", seed=3)
    env = make_vec("simple-tunnel", horizon=40)
    rows = play_episodes(env, make_policy(env, "random", 3), seed=3)
    assert len(episode["positions"]) == len(episode["contact"]) == 41
    assert episode["positions"][-1] == pytest.approx(env.world.position[0, :3].ravel().tolist(), abs=1e-4)
    assert f"score {rows['return_agent_0'][0]:,.1f}" in episode["summary"]
    agents = [step for step in episode["contact"] if {0, 1, 2} & {*step}]
    collisions = rows[["collisions_agents", "collisions_obstacles", "collisions_walls"]].to_numpy().sum()
    assert 0 < len(agents) <= collisions
    assert [body.get("owner") for body in episode["bodies"]][-3:] == [0, 1, 2]
    assert len(episode["walls"]) == 4 and len(episode["fixed"]) == 2 * 5


# The page.


@pytest.fixture(scope="module")
def page(results: Path) -> Path:
    pytest.importorskip("bokeh")
    main([str(results / "small"), str(results / "large"), "--output", str(results / "page.html")])
    return results / "page.html"


class Outline(HTMLParser):
    """Tags with their attributes, and the cells of every table by its label."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.tables: dict[str, list[list[str]]] = {}
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attributes)))
        if dict(attributes).get("class") == "scroll":
            self._table = self.tables.setdefault(str(dict(attributes)["aria-label"]), [])
        if tag == "tr":
            self._table.append([])
        if tag in ("td", "th"):
            self._table[-1].append("")

    def handle_data(self, data: str) -> None:
        if self.tags and self.tags[-1][0] in ("td", "th") and self.lasttag == self.tags[-1][0] and data.strip():
            self._table[-1][-1] += data


def test_the_page_holds_the_numbers_and_fetches_nothing(page: Path) -> None:
    text = page.read_text()
    outline = Outline(text)
    (header, ours, theirs, *baselines) = outline.tables["Results on spread-3a, horizon=12"]
    score = header.index("score")
    assert (ours[0], ours[1], ours[2]) == ("ours", "3", "3,000")
    assert ours[score].startswith("-403.7\n(")  # the mean over seeds of that over three evaluations
    assert theirs[0] == "theirs" and [row[0] for row in baselines][:2] == ["random", "heuristic"]
    varied = outline.tables["Settings that differ, spread-3a, horizon=12"]
    assert ["training.actor_lr", "0.001", "0.0001"] in varied and len(varied) == 3
    assert ["ours > theirs", "100%"] in outline.tables["Probability of improvement, numbers"]
    for tag, attributes in outline.tags:
        assert tag not in ("img", "iframe", "base") and "src" not in attributes, tag
        assert not (attributes.get("href") or "").partition("#")[0].startswith(("http", "/", "."))
    assert "connect-src" not in text.partition("</head>")[0] and "default-src 'none'" in text
    assert str(page.parent) not in text
    assert "large/ours-seed0: unfinished" in text and "no episode of ours" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["RESULTS/nowhere"], "there is no folder"),
        (["RESULTS"], "is no results folder; legal: what a program in tuned_examples/ wrote to"),
        (["RESULTS/begun"], "has no evaluation yet: try again later"),
        (["RESULTS/small", "--output", "RESULTS/page.html"], "exists: add --force to replace it"),
        (["RESULTS/small", "--output", "RESULTS"], "is a folder: give a file in it"),
        (["RESULTS/small", "--output", "RESULTS/no/page.html"], "there is no folder"),
        (["RESULTS/small/ours-seed1"], "is a trial: give its experiment's, 'RESULTS/small'"),
        (["RESULTS/small", "--force", "--seed", "-1"], "--seed -1 is illegal; legal: an integer >= 0"),
    ],
)
def test_mistakes_end_in_a_sentence(
    page: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (page.parent / "begun").mkdir(exist_ok=True)
    (page.parent / "begun" / "experiment.json").write_text("{}")
    before = page.read_bytes()
    with pytest.raises(SystemExit) as stop:
        main([argument.replace("RESULTS", str(page.parent)) for argument in arguments])
    assert stop.value.code == 2 and message.replace("RESULTS", str(page.parent)) in capsys.readouterr().err
    assert page.read_bytes() == before


def test_without_bokeh(page: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("rllib_maobs.report.__main__.find_spec", lambda name: None)
    with pytest.raises(SystemExit):
        main([str(page.parent / "small"), "--force"])
    assert 'the report needs bokeh: pip install -c constraints.txt -e ".[report]"' in capsys.readouterr().err


def test_nothing_is_half_written(tmp_path: Path) -> None:
    output = tmp_path / "page.html"
    write_whole(output, "old")
    with pytest.raises(UnicodeEncodeError):
        write_whole(output, "new \ud800")  # fails in the middle
    assert output.read_text() == "old" and [*tmp_path.iterdir()] == [output]


# In a browser.

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)} is installed")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


def opened(browser: Any, page: Path, **context: Any) -> tuple[Any, list[str]]:
    """The page in a tab of its own, all charts drawn, and a list that fills with what goes wrong."""
    tab = browser.new_context(**context).new_page()
    wrong: list[str] = []
    tab.on("console", lambda message: wrong.append(message.text) if message.type in ("error", "warning") else None)
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.on("request", lambda it: None if it.url.startswith(("file:", "data:")) else wrong.append(it.url))
    tab.goto(page.as_uri())
    tab.evaluate("Promise.all([...document.querySelectorAll('.plot')].map((it) => figures.has(it) || draw(it)))")
    tab.wait_for_function("[...figures.values()].every((figure) => figure)")
    return tab, wrong


def test_in_a_browser(browser: Any, page: Path) -> None:
    tab, wrong = opened(browser, page)
    player = tab.locator(".player").first
    slider, canvas, button = player.locator("input"), player.locator("canvas").first, player.locator(".play")
    start = canvas.evaluate("it => it.toDataURL()")
    assert int(slider.get_attribute("max")) == 12
    button.focus()
    tab.keyboard.press("Space")
    tab.wait_for_function("it => Number(it.value) >= 2", arg=slider.element_handle())
    assert button.inner_text() == "Pause"
    tab.keyboard.press("Space")
    now = slider.input_value()
    assert button.inner_text() == "Play" and canvas.evaluate("it => it.toDataURL()") != start
    tab.wait_for_timeout(250)
    assert slider.input_value() == now
    slider.fill("7")
    slider.press("ArrowRight")
    assert player.locator("output").inner_text().startswith("step 8 of 12")
    player.locator(".speed").select_option("4")
    button.click()
    tab.wait_for_function("it => it.textContent === 'Play'", arg=button.element_handle())
    assert slider.input_value() == "12"
    player.locator("select").first.select_option(label="heuristic (not trained)")
    assert slider.input_value() == "0" and "heuristic" in canvas.get_attribute("aria-label")

    shown = """() => Object.fromEntries([...figures].filter(([it]) => it.id === "task-0-curve-0").flatMap(
        ([, figure]) => figure.renderers.map((line) => [`${line.name} ${line.glyph.tags}`, line.visible])))"""
    assert tab.evaluate(shown) | {"ours steps": True, "ours time": False, "random steps": True} == tab.evaluate(shown)
    legend = tab.locator("#task-0 .legend button", has_text="ours")
    legend.focus()
    tab.keyboard.press("Enter")
    assert legend.get_attribute("aria-pressed") == "false"
    assert tab.evaluate(shown)["ours steps"] is False and tab.evaluate(shown)["theirs steps"] is True
    legend.click()
    tab.get_by_label("wall time").first.check()
    assert tab.evaluate(shown)["ours time"] is True and tab.evaluate(shown)["ours steps"] is False
    assert wrong == []


def test_the_page_is_accessible(browser: Any, page: Path) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-core is not installed").Axe()
    tab, wrong = opened(browser, page)
    tab.evaluate("document.querySelectorAll('details').forEach((it) => { it.open = true; })")
    # In the dark only the colours differ, and they are the same in every section.
    for scheme, part, options in (("light", "body", {}), ("dark", "#task-1", {"runOnly": ["color-contrast"]})):
        tab.emulate_media(color_scheme=scheme)
        results = axe.run(tab, context=part, options=options).response
        found = [(it["id"], [node["html"][:200] for node in it["nodes"][:3]]) for it in results["violations"]]
        assert found == [], scheme
        assert "color-contrast" in [it["id"] for it in results["passes"]]
    labels = tab.evaluate("[...figures.values()].map((figure) => figure.left[0].major_label_text_color)")
    assert {*labels} == {"#a4acb8"}  # charts are dark now, too
    assert wrong == []


def test_on_a_laptop_and_on_paper(browser: Any, page: Path) -> None:
    """Nothing has been scrolled to, and nothing is missing or cut off."""
    tab = browser.new_context(viewport={"width": 1280, "height": 800}, color_scheme="dark").new_page()
    tab.goto(page.as_uri())
    tab.wait_for_function("() => plots.length > 5 && plots.every((plot) => figures.get(plot))")
    own = "plots.every((plot) => figures.get(plot).id === data.charts[plot.id].root_id)"
    assert tab.evaluate(own) and tab.evaluate("scrollY") == 0
    wide = "-12,345.6\\n(-23,456.7 to -10,234.5)"
    tab.evaluate(f"document.querySelectorAll('.results td').forEach((it) => {{ it.textContent = '{wide}'; }})")
    cut = "[...document.querySelectorAll('.results .scroll')].filter((it) => it.scrollWidth > it.clientWidth).length"
    assert tab.evaluate(cut) == 0
    widths = tab.evaluate("plots.map((plot) => plot.clientWidth)")
    tab.evaluate("dispatchEvent(new Event('beforeprint'))")
    tab.emulate_media(media="print", color_scheme="dark")
    tab.set_viewport_size({"width": 1000, "height": 700})
    assert tab.evaluate(cut) == 0
    assert tab.evaluate("plots.map((plot) => plot.clientWidth)") == widths
    assert tab.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert "invert" in tab.evaluate("getComputedStyle(plots[0]).filter")
    tab.emulate_media(media="screen")
    tab.evaluate("dispatchEvent(new Event('afterprint'))")
    assert tab.evaluate("plots.every((plot) => !plot.style.width && getComputedStyle(plot).filter === 'none')")


def test_the_page_on_a_phone(browser: Any, page: Path) -> None:
    tab, wrong = opened(browser, page, viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True)
    assert tab.evaluate("document.documentElement.scrollWidth") == 390
    small = (
        """[...document.querySelectorAll("button, select")].filter((it) => it.getBoundingClientRect().height < 24)"""
    )
    assert tab.evaluate(f"{small}.length") == 0
    assert wrong == []
