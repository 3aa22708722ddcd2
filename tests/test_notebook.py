"""The notebook runs, on fewer steps and without compiling."""

import json
from pathlib import Path

import matplotlib
import pytest

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "quickstart.ipynb"
SMALLER = {
    "ITERATIONS = 30 ": "ITERATIONS = 2 ",
    "torch_compile_learner=True": "torch_compile_learner=False",
    "min_sample_timesteps_per_iteration=1000": "min_sample_timesteps_per_iteration=100",
}


def test_the_notebook_runs(ray_session: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    matplotlib.use("agg")
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: None)
    for name in ("ray.init", "ray.shutdown"):  # the session's Ray does
        monkeypatch.setattr(name, lambda **kwargs: None)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    source = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    for text, smaller in SMALLER.items():
        assert source.count(text) == 1
        source = source.replace(text, smaller)
    names: dict[str, object] = {}
    exec(compile(source, str(NOTEBOOK), "exec"), names)
    assert len(names["curves"]) == 2
    assert sorted(names["modules"]) == ["agent_0", "agent_1", "agent_2"]
