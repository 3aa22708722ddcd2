"""The notebooks run, on fewer steps and without compiling."""

import json
from pathlib import Path

import matplotlib
import pytest

import rllib_maobs as maobs

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
# What is smaller here than in the notebooks, and names that must be there at their ends.
SMALLER = {
    "quickstart": {
        "ITERATIONS = 30 ": "ITERATIONS = 2 ",
        "torch_compile_learner=True": "torch_compile_learner=False",
        "min_sample_timesteps_per_iteration=1000": "min_sample_timesteps_per_iteration=100",
    },
    "environments": {
        "EPISODES = 100": "EPISODES = 4",
        "seconds=1.0": "seconds=0.01",
        "min_sample_timesteps_per_iteration=1600": "min_sample_timesteps_per_iteration=800",
    },
    "networks": {
        "ITERATIONS = 12 ": "ITERATIONS = 2 ",
        "steps = 5000 *": "steps = 100 *",
        "torch_compile_learner=True": "torch_compile_learner=False",
        "min_sample_timesteps_per_iteration=5000": "min_sample_timesteps_per_iteration=100",
        "EPISODES = 100": "EPISODES = 4",
    },
    "experiment": {
        "STEPS = 12_000": "STEPS = 1_000",
        'SEEDS = ("0", "1", "2")': 'SEEDS = ("0",)',
        '("iddpg", "maddpg", "maddpg-often")': '("maddpg-often",)',
        "num_envs=100": "num_envs=4",
    },
    "elsewhere": {
        "MADDPG_ITERATIONS = 24 ": "MADDPG_ITERATIONS = 1 ",
        "PPO_ITERATIONS = 4 ": "PPO_ITERATIONS = 1 ",
        "min_sample_timesteps_per_iteration=500": "min_sample_timesteps_per_iteration=40",
        "train_batch_size_per_learner=2000, minibatch_size=500, num_epochs=5": (
            "train_batch_size_per_learner=400, minibatch_size=200, num_epochs=1"
        ),
        "num_envs=20": "num_envs=2",
    },
}
LEFT = {
    "quickstart": ["curves", "modules"],
    "environments": ["result"],
    "networks": ["both"],
    "experiment": ["best"],
    "elsewhere": ["returns"],
}


def test_every_notebook_is_here() -> None:
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == {*SMALLER}


@pytest.mark.parametrize("name", SMALLER)
def test_a_notebook_runs(name: str, ray_session: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    matplotlib.use("agg")
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: None)
    for function in ("ray.init", "ray.shutdown"):  # the session's Ray does
        monkeypatch.setattr(function, lambda **kwargs: None)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("rllib_maobs.envs.registry.SCENARIOS", dict(maobs.SCENARIOS))
    cells = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text())["cells"]
    assert not any(output["output_type"] == "error" for cell in cells for output in cell.get("outputs", []))
    source = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    for text, smaller in SMALLER[name].items():
        assert source.count(text) == 1
        source = source.replace(text, smaller)
    # A module of its own: classes of a notebook are pickled by value, as they are there.
    names: dict[str, object] = {"__name__": "__main__"}
    exec(compile(source, name, "exec"), names)
    assert all(left in names for left in LEFT[name])
