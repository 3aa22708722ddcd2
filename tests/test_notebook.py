"""The notebooks run, on fewer steps and without compiling."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import pytest

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"


@pytest.fixture
def run(ray_session: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """Runs a notebook with some texts in it replaced; returns its names."""

    def run(name: str, smaller: dict[str, str]) -> dict[str, Any]:
        matplotlib.use("agg")
        monkeypatch.setattr("matplotlib.pyplot.show", lambda: None)
        for function in ("ray.init", "ray.shutdown"):  # the session's Ray does
            monkeypatch.setattr(function, lambda **kwargs: None)
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        cells = json.loads((NOTEBOOKS / name).read_text())["cells"]
        source = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
        for text, replacement in smaller.items():
            assert source.count(text) == 1
            source = source.replace(text, replacement)
        names: dict[str, Any] = {}
        exec(compile(source, name, "exec"), names)
        return names

    return run


def test_the_notebook_runs(run: Callable[..., dict[str, Any]]) -> None:
    smaller = {
        "ITERATIONS = 30 ": "ITERATIONS = 2 ",
        "torch_compile_learner=True": "torch_compile_learner=False",
        "min_sample_timesteps_per_iteration=1000": "min_sample_timesteps_per_iteration=100",
    }
    names = run("quickstart.ipynb", smaller)
    assert len(names["curves"]) == 2
    assert sorted(names["modules"]) == ["agent_0", "agent_1", "agent_2"]


def test_modules_go_elsewhere(run: Callable[..., dict[str, Any]], capsys: pytest.CaptureFixture[str]) -> None:
    smaller = {
        "MADDPG_ITERATIONS = 24 ": "MADDPG_ITERATIONS = 1 ",
        "PPO_ITERATIONS = 4 ": "PPO_ITERATIONS = 1 ",
        "min_sample_timesteps_per_iteration=500": "min_sample_timesteps_per_iteration=40",
        "train_batch_size_per_learner=2000, minibatch_size=500, num_epochs=5": (
            "train_batch_size_per_learner=400, minibatch_size=200, num_epochs=1"
        ),
        "num_envs=20": "num_envs=2",
    }
    names = run("elsewhere.ipynb", smaller)
    assert len(names["returns"]) == 1
    printed = capsys.readouterr().out
    assert "episode 2: distance to the target" in printed
    assert [line.split()[0] for line in printed.splitlines()[-3:]] == ["PPO", "MADDPG", "random"]
