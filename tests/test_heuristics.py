"""Every task can be solved, and what a hand-written policy reaches."""

from itertools import permutations

import numpy as np
import pytest

from rllib_maobs.envs import SCENARIOS, Bodies, MAObsEnv, Scenario, make_scenario, make_vec, parallel_env
from rllib_maobs.envs.steering import assign
from tests.episodes import place, sample_actions

PREY = "obstacle-predator-prey"


def play(env, seed=0, actions=None):
    """Mean return of the agents and metrics of one episode in each copy, by the heuristic or given actions."""
    env.reset(seed)
    total = 0.0
    for t in range(env.horizon):
        _, rewards, _, _, info = env.step(env.heuristic() if actions is None else actions[t])
        total += rewards.mean()
    return total, {name: value.mean() for name, value in info["episode_metrics"].items()}


@pytest.mark.parametrize(
    ("scenario_id", "options", "worst", "best", "success"),
    [
        # Returns of the tables in the docstrings, with the spread of means over 100 episodes.
        ("spread-3a", {}, -45, -28, 0.97),
        ("spread-6a", {}, -110, -65, 0.9),
        ("spread-9a", {}, -190, -110, 0.85),
        ("tunnel", {}, -220, -200, 1.0),
        ("tunnel", {"start_noise": 0.05}, -225, -195, 1.0),
        ("simple-tunnel", {}, -34, -31, 1.0),
        ("simple-tunnel-6a", {}, -55, -50, 1.0),
        (PREY, {}, 720, 850, 1.0),
        (PREY, {"prey": "flee"}, 150, 240, 0.98),
        # Stiff contacts and whole thrusts make it harder, not impossible.
        ("spread-3a", {"physics": "solid"}, -55, -30, 0.95),
        ("spread-3a", {"action_mode": "discrete"}, -85, -55, 0.95),
        ("tunnel", {"action_mode": "discrete"}, -290, -240, 1.0),
        ("simple-tunnel-6a", {"physics": "solid"}, -70, -60, 1.0),
    ],
)
def test_heuristic_solves_the_task(scenario_id, options, worst, best, success):
    env = make_vec(
        scenario_id, num_envs=1 if "tunnel" in scenario_id and "start_noise" not in options else 100, **options
    )
    total, metrics = play(env)
    assert worst < total < best
    assert metrics["success"] >= success
    if "tunnel" in scenario_id and options.get("action_mode") != "discrete":
        assert metrics["collision_free"] == 1.0


@pytest.mark.parametrize(
    ("scenario_id", "options", "expected"),
    [
        ("spread-3a", {}, -802),
        ("spread-6a", {}, -2197),
        ("spread-9a", {}, -4052),
        ("tunnel", {}, -1718),
        ("simple-tunnel", {}, -227),
        ("simple-tunnel-6a", {}, -241),
        (PREY, {}, 1),
        (PREY, {"prey": "flee"}, -5),
    ],
)
def test_random_returns_of_the_tables(scenario_id, options, expected):
    """The same 200 episodes as in the docstrings, other actions."""
    env = make_vec(scenario_id, num_envs=200, **options)
    total, metrics = play(env, actions=sample_actions(env, 100, seed=1))
    assert total == pytest.approx(expected, rel=0.05, abs=4)
    assert metrics["success"] < (0.5 if scenario_id == PREY else 0.01)
    assert f"{expected}" in type(env.scenario).__doc__


@pytest.mark.parametrize(
    ("scenario_id", "options", "expected", "success", "collision_free"),
    [
        ("spread-3a", {}, -35, 0.99, 0.98),
        ("spread-6a", {}, -79, 0.97, 0.79),
        ("spread-9a", {}, -138, 0.96, 0.51),
        ("tunnel", {}, -208, 1.0, 1.0),
        ("simple-tunnel", {}, -32, 1.0, 1.0),
        ("simple-tunnel-6a", {}, -53, 1.0, 1.0),
        (PREY, {}, 782, 1.0, 0.54),
        (PREY, {"prey": "flee"}, 192, 1.0, 0.11),
    ],
)
def test_heuristic_returns_of_the_tables(scenario_id, options, expected, success, collision_free):
    """The same 200 episodes as in the docstrings; contacts amplify what a processor rounds otherwise."""
    env = make_vec(scenario_id, num_envs=1 if "tunnel" in scenario_id else 200, **options)
    total, metrics = play(env)
    assert total == pytest.approx(expected, rel=0.03)
    assert metrics["success"] == pytest.approx(success, abs=0.015)
    assert metrics["collision_free"] == pytest.approx(collision_free, abs=0.04)
    assert f"{expected}" in type(env.scenario).__doc__


def test_heuristic_of_a_copy_does_not_depend_on_the_others():
    for scenario_id in SCENARIOS:
        many, single = make_vec(scenario_id, num_envs=5), make_vec(scenario_id)
        many.reset(seed=0), single.reset(seed=3)
        for _ in range(30):
            actions, own = many.heuristic(), single.heuristic()
            np.testing.assert_allclose(actions[3], own[0], atol=1e-12)
            many.step(actions), single.step(own)


@pytest.mark.parametrize("mode", ["mpe", "force", "discrete"])
def test_heuristic_actions_are_legal_on_every_face(mode):
    for scenario_id in SCENARIOS:
        env = make_vec(scenario_id, num_envs=2, action_mode=mode)
        env.reset(seed=0)
        joint = env.heuristic()
        for face in (
            parallel_env(scenario_id, action_mode=mode),
            MAObsEnv({"scenario": scenario_id, "action_mode": mode}),
        ):
            face.reset(seed=0)
            by_agent = face.heuristic()
            assert list(by_agent) == env.agents
            for i, agent in enumerate(env.agents):
                assert env.action_spaces[agent].contains(by_agent[agent])
                np.testing.assert_array_equal(by_agent[agent], joint[0, i])
            face.step(by_agent)


def test_learned_prey_flees_by_heuristic():
    env = make_vec(PREY, prey="learned")
    place(env, [[0.3, 0.0], [0.35, 0.3], [0.35, -0.3], [0.0, 0.0], [9.0, 9.0], [-9.0, 9.0]])
    actions = env.heuristic()
    assert actions.shape == (1, 4, 5)
    assert env.scenario.control(actions)[0, 3, 0] < -0.9


def test_heuristic_sees_what_was_written():
    """Head-on towards a prey that a test has just moved."""
    env = make_vec(PREY, num_predators=1, num_obstacles=0)
    place(env, [[0.0, 0.0], [0.5, 0.0]])
    assert env.scenario.control(env.heuristic())[0, 0, 0] == 1.0
    env.world.position[0, 1] = [-0.5, 0.0]
    assert env.scenario.control(env.heuristic())[0, 0, 0] == -1.0


@pytest.mark.parametrize("mode", ["mpe", "force"])
def test_actions_invert_control(mode):
    scenario = make_scenario("spread-3a", action_mode=mode)
    control = np.random.default_rng(0).uniform(-1, 1, (4, 3, 2))
    np.testing.assert_allclose(scenario.control(scenario.actions(control)), control, atol=1e-6)


def test_discrete_actions_follow_the_larger_component():
    scenario = make_scenario("spread-3a", action_mode="discrete")
    control = np.array([[[0.4, -0.3], [0.9, -0.3], [-0.6, 0.5], [0.2, 0.8], [0.5, -0.7]]])
    assert scenario.actions(control).tolist() == [[0, 1, 2, 3, 4]]


def test_assignment_is_one_to_one_and_the_shortest():
    """Against the best of all permutations."""
    rng = np.random.default_rng(0)
    agents, targets = rng.uniform(-1, 1, (2, 50, 5, 2))
    distance = np.linalg.norm(agents[:, :, None] - targets[:, None], axis=-1)
    goal = assign(distance)
    assert (np.sort(goal, axis=1) == np.arange(5)).all()
    orders = np.array(list(permutations(range(5))))
    best = (distance[:, np.arange(5), orders] ** 2).sum(axis=-1).min(axis=1)
    found = (np.take_along_axis(distance, goal[..., None], axis=2) ** 2).sum(axis=(1, 2))
    np.testing.assert_allclose(found, best, rtol=1e-12)


def test_scenario_without_heuristic_says_so():
    class Still(Scenario):
        observation_size = 2

        def bodies(self):
            return [Bodies("agent", 1, 0.1, movable=True)]

        def place(self, rngs):
            return np.zeros((len(rngs), 1, 2))

        def observe(self, world, out):
            out[...] = world.position

        def outcome(self, world):
            raise AssertionError

    env = make_vec(Still)
    env.reset(seed=0)
    with pytest.raises(NotImplementedError, match=r"Still has no heuristic policy: override Scenario\.heuristic"):
        env.heuristic()
