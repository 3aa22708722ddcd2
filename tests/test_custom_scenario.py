"""Scenarios of one's own, among them the one of the documentation, as printed."""

import importlib.util
import sys
import textwrap
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from rllib_maobs.envs import (
    SCENARIOS,
    Bodies,
    Entities,
    Outcome,
    Range,
    Scenario,
    ScenarioOptions,
    make_vec,
    parallel_env,
    register_scenario,
)
from tests.episodes import episode_metrics, roll, sample_actions


def test_scenario_of_the_documentation_runs_as_printed(ray_session, tmp_path, monkeypatch, capsys):
    code = Scenario.__doc__.split("```python\n")[1].split("```")[0]
    path = tmp_path / "home.py"
    path.write_text(textwrap.dedent(code))
    spec = importlib.util.spec_from_file_location("home", path)
    home = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "home", home)
    spec.loader.exec_module(home)
    assert home.rewards.shape == (8, 4)
    assert home.algo.get_module("agent_2").actor is not None
    distance = home.results["env_runners"]["episode_metrics"]["distance"]
    assert 0.0 < distance < 10.0 and f"{distance}" in capsys.readouterr().out
    # Its heuristic solves it.
    env = make_vec(home.Home, num_envs=16)
    env.reset(seed=0)
    for _ in range(100):
        *_, info = env.step(env.heuristic())
    assert info["episode_metrics"]["success"].mean() > 0.9
    with pytest.raises(ValueError, match=r"Home has no option 'penalti' \(did you mean 'penalty'\?\)"):
        make_vec(home.Home, penalti=1.0)
    parallel_api_test(parallel_env(home.Home), num_cycles=20)


@dataclass(frozen=True)
class HomeOptions(ScenarioOptions):
    num_agents: Annotated[int, Range(1)] = 2


class Home(Scenario[HomeOptions]):
    options_class = HomeOptions
    metrics = {"distance": "mean", "farthest": "max"}  # noqa: RUF012

    def bodies(self):
        return [Bodies("agent", self.options.num_agents, radius=0.1, movable=True, accel=5.0)]

    def place(self, rngs):
        return np.stack([rng.uniform(-1, 1, (self.options.num_agents, 2)) for rng in rngs])

    @property
    def observation_layout(self):
        return (Entities("self", 1, 4),)

    def observe(self, world, out):
        out[..., 0:2] = world.velocity
        out[..., 2:4] = world.position

    def outcome(self, world):
        distance = np.linalg.norm(world.position, axis=-1)
        mean = distance.mean(-1)
        return Outcome(-distance, (distance < 0.1).all(-1), {"distance": mean, "farthest": mean})


def test_custom_scenario_by_id_and_by_class(monkeypatch):
    monkeypatch.setattr("rllib_maobs.envs.registry.SCENARIOS", dict(SCENARIOS))
    register_scenario("home", Home, num_agents=3)
    by_id, by_class = make_vec("home", num_envs=2), make_vec(Home, num_envs=2, num_agents=3)
    actions = sample_actions(by_id, 100)
    mine, theirs = roll(by_id, actions, seed=0), roll(by_class, actions, seed=0)
    np.testing.assert_equal(mine, theirs)
    assert (mine[2]["farthest"] > mine[2]["distance"]).all()
    parallel_api_test(parallel_env(Home), num_cycles=120)
    with pytest.raises(ValueError, match="Home has no option 'agents'"):
        register_scenario("home", Home, agents=3)


def test_nothing_to_touch():
    class Ghosts(Home):
        def bodies(self):
            return [Bodies("agent", 2, radius=0.1, movable=True, collides=False)]

    env = make_vec(Ghosts, horizon=1)
    env.reset(seed=0)
    env.world.position[0] = 0.0
    metrics = episode_metrics(env.step(np.zeros((1, 2, 5)))[-1])
    assert metrics["collision_free"] == 1.0 and metrics["min_clearance"] == np.inf


def test_unknown_reduction():
    class Odd(Home):
        metrics = {"distance": "median"}  # noqa: RUF012

    with pytest.raises(ValueError, match="metric 'distance' has reduction 'median'; legal: last, mean"):
        make_vec(Odd)
