"""Command lines: any arguments work, or end in one line and code 2, before anything starts or is written."""

import contextlib
import io
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import rllib_maobs.evaluate
import rllib_maobs.play
import rllib_maobs.report.__main__
from rllib_maobs import export
from rllib_maobs.experiment import Experiment
from rllib_maobs.experiment.arguments import make_parser, parse
from rllib_maobs.paths import file_name
from tests.faults.fuzz import LONG_NAME, PATHS, attempt, little_memory, nasty, refused, watched
from tests.test_export import made, written

WORDS = st.one_of(
    st.sampled_from("0 1 2 -1 1e3 1e400 nan inf 0x10 1_000 ٣ ² 1.5 True None {} [] spread-3a tunnel random".split()),
    st.sampled_from("heuristic a=b horizon=2 num_agents=[1] gap=1e999 horizon=2**99 =1 scenario=x self=1".split()),
    st.sampled_from(["", " ", "-", "--", "=", "num_agents=" + "(" * 300, "a=" + "-" * 5000 + "1", "render_mode=human"]),
    st.sampled_from("actor_lr=1e-3,3e-4 actor_lr=1..2 tau=.. gamma=1/0 env_config.x=1 actor=os:system,mlp".split()),
    st.sampled_from([path for path in (LONG_NAME, *PATHS) if "\0" not in path]),
    st.text(max_size=6).filter(lambda text: "\0" not in text),
)


@pytest.fixture(scope="module")
def agent(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """An exported actor, in a folder of its own that is the present one."""
    folder = tmp_path_factory.mktemp("commands")
    before = Path.cwd()
    os.chdir(folder)
    env = rllib_maobs.envs.make_vec("spread-3a")
    layout = [list(group) for group in env.observation_layouts["agent_0"]]
    modules = {agent: made(env.action_spaces[agent], observation_layout=layout) for agent in env.agents}
    yield str(written(folder / "agent.safetensors", modules))
    os.chdir(before)


class Started(Exception):
    """All was legal, and the work would begin."""


def command(main: Callable[[Sequence[str]], None], arguments: list[str], tally: Counter[str]) -> None:
    """Run a command line: it starts, or exits with 2 and a last line that says what was wrong, and writes nothing."""
    said = io.StringIO()

    def call() -> None:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            main(arguments)

    with watched() as seen, little_memory():
        try:
            attempt(call, tally, errors=())
        except SystemExit as end:
            assert end.code in (0, 2), end.code
            line = said.getvalue().rstrip("\n")
            assert end.code == 0 or ": error: " in line, line[-300:]
            assert "Traceback" not in line
        except Started:
            pass
    assert not [event for event in seen if event[0] != "pickle.find_class"]  # which Ray's registry of names does


def arguments(flags: Sequence[str], first: st.SearchStrategy[list[str]]) -> st.SearchStrategy[list[str]]:
    """Flags of a program with any values."""
    flag = st.tuples(st.sampled_from(flags), st.lists(WORDS, max_size=2)).map(lambda pair: [pair[0], *pair[1]])
    words = st.tuples(first, st.lists(flag, max_size=3))
    return words.map(lambda pair: [*pair[0], *(word for one in pair[1] for word in one)])


@given(
    given=arguments(
        ["--policy", "--record", "--episodes", "--seed", "horizon=2", "--no-window"], st.lists(WORDS, max_size=2)
    )
)
def test_play(given: list[str], agent: str, tally: Counter[str]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rllib_maobs.play, "play", _start)
        command(rllib_maobs.play.main, ["spread-3a", "--no-window", *given], tally)


@given(
    given=arguments(
        ["--env", "--num-agents", "--episodes", "--seed", "--json", "--csv", "--per-episode", "--record", "horizon=2"],
        st.lists(st.one_of(WORDS, st.just("agent.safetensors")), max_size=2),
    )
)
def test_evaluate(given: list[str], agent: str, tally: Counter[str]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rllib_maobs.evaluate, "baselines_of", _start)
        command(rllib_maobs.evaluate.main, given, tally)


@given(given=arguments(["--agent", "--all", "--format", "--output", "--force"], st.lists(WORDS, max_size=2)))
def test_export(given: list[str], agent: str, tally: Counter[str]) -> None:
    command(export.main, given, tally)


@given(given=arguments(["--output", "--force", "--seed"], st.lists(WORDS, max_size=2)))
def test_report(given: list[str], agent: str, tally: Counter[str]) -> None:
    command(rllib_maobs.report.__main__.main, given, tally)


EXPERIMENT = Experiment(
    name="fuzz", env="maobs/spread-3a", algorithms=("maddpg", "maddpg-lstm"), training={"actor_lr": 1e-3}
)
FLAGS = [
    option
    for action in make_parser("fuzz", EXPERIMENT.algorithms, 1000)._actions
    for option in action.option_strings
    if option.startswith("--")
]


@given(given=arguments([*FLAGS, "--sweep", "--sweep"], st.just([])))
def test_experiments(given: list[str], agent: str, tally: Counter[str]) -> None:
    """All that there is before Ray starts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rllib_maobs.experiment.run.claim", _start)
        command(EXPERIMENT.main, given, tally)


CONTENTS = st.one_of(
    st.binary(max_size=50),
    st.text(max_size=20).map(str.encode),
    st.recursive(
        st.one_of(st.none(), st.integers(), st.text(max_size=3)),
        lambda inner: st.one_of(
            st.lists(inner, max_size=2),
            st.dictionaries(st.sampled_from(["experiment", "algos", "seeds", "config", "env"]), inner),
        ),
    ).map(lambda value: json.dumps(value).encode()),
)


@given(content=CONTENTS)
def test_results_of_strangers(content: bytes, agent: str, tally: Counter[str]) -> None:
    """A results folder whose files are anything can be no report, nor be resumed."""
    folder = Path("results") / "odd"
    (folder / "maddpg-seed0").mkdir(parents=True, exist_ok=True)
    for name in ("experiment.json", "maddpg-seed0/result.json", "maddpg-seed0/progress.csv"):
        (folder / name).write_bytes(content)
    command(rllib_maobs.report.__main__.main, [str(folder)], tally)
    command(
        lambda given: parse(make_parser("fuzz", ["maddpg"], 10), "fuzz", given),
        ["--resume", "--results-dir", str(folder)],
        tally,
    )


def _start(*_: Any, **__: Any) -> Any:
    raise Started


# Names from outside never become paths unchecked.


@given(name=st.one_of(nasty(), st.sampled_from(PATHS)))
def test_names_of_experiments_and_rows_are_names_of_folders(name: Any, tally: Counter[str]) -> None:
    def make(**given: Any) -> Experiment:
        return Experiment(**{"name": "x", "env": "maobs/spread-3a", "algorithms": ["maddpg"], "training": {}, **given})

    variants = {name: {"algorithm": "maddpg"}} if isinstance(name, str) else {}
    for call in (lambda: make(name=name), lambda: make(algorithms=[name], variants=variants)):
        if refused(call, tally, errors=(ValueError,)) is None:
            path = os.path.normpath(Path("/results") / name / "x")
            assert path == f"/results/{name}/x" and "\0" not in path and name not in (".", "..")


@given(name=st.text())
def test_file_names_stay_in_their_folder(name: str) -> None:
    made = file_name(name)
    assert (
        Path(made).name == made and made not in ("", ".", "..") and not set(made) & set("/\\\0:\n") and len(made) <= 100
    )
