"""What listens, what is said about pickles, and names from outside that are no names of folders."""

import re
from argparse import Namespace
from pathlib import Path
from typing import Any

import pytest
import ray

from rllib_maobs.experiment import run
from tests.conftest import small_config
from tests.faults.test_fuzz_envs import Foreign

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("dashboard", [False, True])
def test_the_dashboard_listens_on_this_machine_alone(dashboard: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    started: dict[str, Any] = {}
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", lambda **given: started.update(given))
    monkeypatch.setattr(run, "find_spec", lambda name: True)
    run._start_ray(Namespace(address=None, dashboard=dashboard, workers=1, num_env_runners=0))
    assert (started["include_dashboard"], started["dashboard_host"]) == (dashboard, "127.0.0.1")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_that_load_checkpoints_say_that_these_are_pickles(page: Path) -> None:
    text = page.read_text()
    if re.search(r"from_checkpoint\(|load_networks\(|--policy CHECKPOINT", text):
        assert "pickle" in text or "trust.md" in text
    for command in re.findall(r"(?:tensorboard|mlflow ui).*", text):
        assert not re.search(r"--bind_all [^`]*$|--host[= ]\S+\.", command)


@pytest.mark.parametrize("name", ["../x", "/etc/x", "a/b", "..", "a\\b", "a:b"])
def test_agents_that_are_called_like_paths_are_refused(name: str) -> None:
    """Policies are called after them, and folders of checkpoints after policies."""

    class Odd(Foreign):
        def __init__(self, config: Any) -> None:
            super().__init__(config)
            for spaces in (self.observation_spaces, self.action_spaces):
                spaces[name] = spaces.pop("a")
            self.agents = self.possible_agents = [name, "b"]

    with pytest.raises(ValueError, match=rf"{re.escape(name)}|{re.escape(repr(name))}"):
        small_config("iddpg").environment(Odd).validate()
