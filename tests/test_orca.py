"""ORCA: straight where nothing is in the way, past each other where something is, and never in contact."""

import sys
from itertools import permutations

import numpy as np
import pytest

import rllib_maobs as maobs
from rllib_maobs.evaluate import Task, baselines_of
from rllib_maobs.evaluate import main as evaluate
from rllib_maobs.policies import make_policy, play_episodes

pytest.importorskip("pyrvo", reason="ORCA's library is not installed")


def placed(position: list[list[float]], **options: object) -> maobs.VectorEnv:
    """Two agents, then their two targets, in one copy without obstacles."""
    env = maobs.make_vec("spread-3a", num_agents=2, num_obstacles=0, **options)
    env.reset(seed=0)
    env.world.position[0] = position
    return env


def test_alone_it_goes_straight_at_full_speed() -> None:
    env = placed([[-0.9, 0.0], [5.0, 5.0], [0.9, 0.3], [5.0, 5.0]])
    policy = make_policy(env, "orca")
    for _ in range(10):
        env.step(policy(env.observe()))
    velocity = env.world.velocity[0, 0]
    assert np.linalg.norm(velocity) == pytest.approx(1.0, abs=0.02)
    assert velocity / np.linalg.norm(velocity) == pytest.approx(np.array([1.8, 0.3]) / np.hypot(1.8, 0.3), abs=0.03)


def test_the_safe_velocity_is_half_of_what_is_needed_from_each() -> None:
    """Head-on, by the definition: both give way alike, and just so far that they pass without a contact."""
    env = placed([[-0.3, 0.0], [0.3, 0.0], [0.9, 0.0], [-0.9, 0.0]])
    env.world.velocity[0, :2] = wanted = np.array([[1.0, 0.0], [-1.0, 0.0]])
    (safe,) = make_policy(env, "orca")._safe(wanted[None])
    assert safe[0] == pytest.approx(-safe[1], abs=1e-6)
    time = np.linspace(0.0, 0.5, 101)[:, None]
    apart = np.linalg.norm(env.world.position[0, 0] - env.world.position[0, 1] + time * (safe[0] - safe[1]), axis=1)
    assert apart.min() == pytest.approx(2 * (0.15 + 0.01), abs=2e-3)


def test_targets_are_assigned_at_the_lowest_cost() -> None:
    env = maobs.make_vec("spread-3a", num_envs=5, num_obstacles=0, action_mode="force", max_speed=0.3)
    env.reset(seed=0)
    env.world.position[:, :3] *= 0.1  # everybody in the middle, so that nobody is at a target
    env.world.position[:, 1] += 20.0  # and so far apart that nobody gives way
    env.world.position[:, 2] -= 20.0
    actions = make_policy(env, "orca")(env.observe())
    world = env.world
    for copy in range(5):
        agents, targets = world.position[copy, :3], world.position[copy, 3:]
        best = min(permutations(range(3)), key=lambda order: ((targets[list(order)] - agents) ** 2).sum())
        way = targets[list(best)] - agents
        cosine = (actions[copy] * way).sum(-1) / np.linalg.norm(actions[copy], axis=-1) / np.linalg.norm(way, axis=-1)
        assert cosine == pytest.approx(1.0, abs=0.01)


def test_crowds_do_not_touch() -> None:
    env = maobs.make_vec("spread-9a", num_envs=10)
    rows = play_episodes(env, make_policy(env, "orca"))
    assert (rows["collisions_agents"] + rows["collisions_obstacles"]).sum() == 0
    assert rows["coverage"].mean() > 0.9


def test_own_targets_and_walls() -> None:
    env = maobs.make_vec("simple-tunnel", action_mode="force")
    rows = play_episodes(env, make_policy(env, "orca"))
    assert rows[["collisions_agents", "collisions_obstacles", "collisions_walls"]].to_numpy().sum() == 0
    assert rows["success_agent_1"][0] == 1.0  # the one in the middle, with a free way
    env.reset(seed=0)
    position = env.world.position[0]
    position[0], position[2] = position[7].copy(), position[5].copy()  # each at the other's target
    actions = make_policy(env, "orca")(env.observe())[0]
    assert actions[0, 1] > 0.1 and actions[2, 1] < -0.1


def test_copies_are_many_single_ones() -> None:
    """Also after a reset of some, when obstacles lie elsewhere."""
    env = maobs.make_vec("spread-9a", num_envs=3)
    policy = make_policy(env, "orca")
    for seed, mask in ((0, None), (7, np.array([False, True, False]))):
        env.reset(seed=seed, mask=mask)
        for _ in range(5):
            env.step(policy(env.observe()))
        wanted = -env.world.position[:, :9]
        together = policy._safe(wanted)
        for copy in range(3):
            alone = maobs.make_vec("spread-9a")
            alone.reset(seed=0)
            alone.world.position, alone.world.velocity = env.world.position[[copy]], env.world.velocity[[copy]]
            assert np.array_equal(make_policy(alone, "orca")._safe(wanted[[copy]])[0], together[copy])
    assert (together != wanted).any()


def test_where_there_is_none(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert baselines_of(Task("obstacle-predator-prey", {})) == ["random", "heuristic"]
    monkeypatch.setitem(sys.modules, "pyrvo", None)
    assert baselines_of(Task("spread-3a", {})) == ["random", "heuristic"]
    said = capsys.readouterr().err
    needs = 'the policy "orca" needs pyrvo: pip install -c constraints.txt -e ".[orca]"'
    assert f"left out: {needs}" in said
    with pytest.raises(SystemExit):  # who asks for it does not want it left out
        evaluate(["results/none", "--baselines", "random,orca"])
    assert needs in capsys.readouterr().err
