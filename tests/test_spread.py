"""Spread in hand-placed situations."""

from itertools import permutations

import numpy as np
import pytest
from mpe2 import simple_spread_v3

from rllib_maobs.envs import make_vec
from rllib_maobs.envs.coverage import matched
from tests.episodes import episode_metrics, glide, place, roll, sample_actions


def test_spread_sizes():
    for name, n, m, o in (("spread-3a", 3, 2, 18), ("spread-6a", 6, 4, 34), ("spread-9a", 9, 6, 50)):
        env = make_vec(name)
        assert (len(env.agents), env.scenario.options.num_obstacles, env.scenario.observation_size) == (
            n,
            m,
            o,
        )
        assert env.world.body_names[0] == "agent_0" and env.world.num_bodies == 2 * n + m
        assert env.state_size("world") == 6 * n + 2 * m


def test_spread_separated_layouts_are_solvable():
    env = make_vec("spread-9a", num_envs=64)
    for seed in (0, 1000):
        env.reset(seed=seed)
        p = env.world.position
        assert (np.abs(p[:, :9]) <= 1.0).all() and (np.abs(p[:, 9:15]) <= 0.9).all()
        assert np.abs(p[:, :9]).max() > 0.97 and np.abs(p[:, 9:15]).max() > 0.87
        distance = np.linalg.norm(p[:, :, None] - p[:, None], axis=-1) + 9.0 * np.eye(24)
        agents, obstacles, targets = slice(0, 9), slice(9, 15), slice(15, 24)
        assert distance[:, agents, agents].min() >= 0.32
        assert distance[:, targets, targets].min() >= 0.32
        assert distance[:, agents, obstacles].min() >= 0.27
        assert distance[:, targets, obstacles].min() >= 0.27
        assert distance[:, agents, targets].min() < 0.1  # an agent may start on a target


def test_spread_mpe_layouts_are_unchecked():
    env = make_vec("spread-9a", num_envs=64, placement="mpe")
    env.reset(seed=0)
    gaps = env.world.gap
    assert (gaps < 0.0).any(axis=(1, 2)).mean() > 0.9


def spread_2(**options):
    return make_vec("spread-3a", num_agents=2, num_obstacles=1, **options)


def test_spread_observation_by_hand():
    env = spread_2()
    place(env, [[0.0, 0.0], [0.5, 0.1], [-0.5, 0.2], [1.0, 1.0], [-1.0, 0.5]])
    env.world.velocity[0, 1] = [0.3, -0.4]
    expected = [
        [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, -1.0, 0.5, -0.5, 0.2, 0.5, 0.1],
        [0.3, -0.4, 0.5, 0.1, 0.5, 0.9, -1.5, 0.4, -1.0, 0.1, -0.5, -0.1],
    ]
    np.testing.assert_allclose(env.observe()[0], expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("mode", "expected"), [("individual", [-3.0, -1.0]), ("sum", [-4.0, -4.0]), ("mean", [-2.0, -2.0])]
)
def test_spread_reward_modes(mode, expected):
    """Targets 0.4 and 0.6 from the nearest agent; agent 0 runs into the obstacle, at twice the price."""
    env = spread_2(reward_mode=mode, obstacle_collision_penalty=2.0)
    place(env, [[0.05, 0.0], [0.0, 1.0], [-0.24, 0.0], [0.4, 0.0], [0.6, 1.0]])
    _, rewards, _, _, _ = glide(env, [[-0.05, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(rewards[0], expected, rtol=1e-6)


@pytest.mark.parametrize(("matching", "expected"), [("nearest", -1.3), ("one_to_one", -2.1)])
def test_spread_matching(matching, expected):
    """Agent 0 is the nearest to both targets, 0.5 and 0.8 away; agent 1 is 1.6 from the second."""
    env = spread_2(reward_mode="individual", matching=matching)
    place(env, [[0.0, 0.0], [2.4, 0.0], [5.0, 5.0], [-0.5, 0.0], [0.8, 0.0]])
    _, rewards, *_ = glide(env, [[0.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(rewards[0], [expected, expected], rtol=1e-6)


def test_matching_is_the_best_of_all_assignments():
    distance = np.random.default_rng(0).uniform(size=(20, 4, 4))
    best = [min(sum(d[i, j] for i, j in enumerate(order)) for order in permutations(range(4))) for d in distance]
    np.testing.assert_allclose(matched(distance).sum(axis=1), best)


def test_spread_agents_in_contact_both_pay():
    env = spread_2(reward_mode="individual", agent_collision_penalty=0.5)
    place(env, [[-0.17, 0.0], [0.17, 0.0], [5.0, 5.0], [-0.12, 0.0], [0.12, 0.0]])
    _, rewards, _, _, _ = glide(env, [[0.05, 0.0], [-0.05, 0.0]])
    np.testing.assert_allclose(rewards[0], [-0.5, -0.5], rtol=1e-6)


def test_spread_coverage_metrics_by_hand():
    """Agent 0 is 0.05 from its target; agent 1 arrives at its own in step 3 of 4, or passes it by."""
    env = spread_2(horizon=4, max_speed=None)
    start = [[0.0, 0.0], [1.0, 0.0], [5.0, 5.0], [0.0, 0.05], [2.0, 0.0]]
    place(env, start)
    for move in (0.1, 0.1, 0.75, 0.0):  # to 1.1, 1.2, 1.95, 1.95
        *_, info = glide(env, [[0.0, 0.0], [move, 0.0]])
    arrived = episode_metrics(info)
    assert arrived["coverage"] == arrived["all_covered"] == arrived["success"] == 1.0
    assert arrived["coverage_mean"] == 0.75 and arrived["all_covered_mean"] == 0.5
    assert arrived["time_to_goal"] == 3.0 and arrived["episode_length"] == 4.0
    assert arrived["target_distance"] == pytest.approx(0.05 + (0.9 + 0.8 + 0.05 + 0.05) / 4)
    assert arrived["collision_free"] == 1.0 and arrived["path_efficiency"] == pytest.approx(1.0)
    assert arrived["min_clearance"] == pytest.approx(1.1 - 0.3)
    place(env, start)
    for move in (0.1, 0.1, 0.7, 0.4):  # to 1.1, 1.2, 1.9 - just not near enough -, 2.3
        *_, info = glide(env, [[0.0, 0.0], [move - 1e-6, 0.0]])
    passed = episode_metrics(info)
    assert passed["coverage"] == passed["coverage_mean"] == 0.5
    assert passed["success"] == passed["all_covered"] == passed["all_covered_mean"] == 0.0
    assert passed["time_to_goal"] == 4.0


def test_spread_collision_metrics_by_hand():
    """One contact of the agents, one of agent 0 with the obstacle, then both agents with it."""
    env = spread_2(horizon=3)
    place(env, [[-0.17, 0.0], [0.17, 0.0], [9.0, 0.0], [3.0, 0.0], [3.0, 0.0]])
    _, first, *_ = glide(env, [[0.05, 0.0], [-0.05, 0.0]])
    env.world.position[0, :3] = [[0.0, 0.0], [5.0, 0.0], [0.29, 0.0]]
    _, second, *_ = glide(env, [[0.05, 0.0], [0.0, 0.0]])
    env.world.position[0, :3] = [[-0.29, 0.0], [0.29, 0.0], [0.0, 0.0]]
    _, third, _, _, info = glide(env, [[0.05, 0.0], [-0.05, 0.0]])
    m = episode_metrics(info)
    assert (m["collisions_agents"], m["collisions_obstacles"], m["collisions_walls"]) == (1.0, 3.0, 0.0)
    assert m["collision_free"] == 0.0
    assert m["min_clearance"] == pytest.approx(0.24 - 0.3, abs=1e-6)
    assert m["return_agent_0"] == pytest.approx(float(first[0, 0] + second[0, 0] + third[0, 0]), rel=1e-6)


def test_path_efficiency_of_a_detour():
    """Moves by hand between the steps are no part of the path."""
    env = make_vec("spread-3a", num_agents=1, num_obstacles=0, horizon=2)
    env.reset(seed=0)
    env.world.position[0, 0] = [0.0, 0.0]
    glide(env, [[0.06, 0.0]])
    *_, info = glide(env, [[0.0, 0.08]])
    assert episode_metrics(info)["path_efficiency"] == pytest.approx(0.1 / 0.14)


def test_metrics_start_anew_each_episode():
    env = make_vec("spread-3a", num_envs=1, horizon=20)
    actions = sample_actions(env, 20)
    first = roll(env, actions, seed=0)[2]
    env.reset(seed=99)
    roll(env, actions)
    again = roll(env, actions, seed=0)[2]
    assert first == again


@pytest.mark.parametrize("seed", range(3))
def test_spread_is_mpe2_simple_spread(seed):
    """Observations and rewards of a whole episode, in MPE2's order of integration, without our additions."""
    n = 9
    theirs = simple_spread_v3.parallel_env(N=n, max_cycles=100, local_ratio=0.5, continuous_actions=True)
    ours = make_vec(
        "spread-9a",
        num_obstacles=0,
        integrator="explicit",
        max_speed=None,
        placement="mpe",
        reward_mode="individual",
    )
    theirs.reset(seed=seed)
    ours.reset(seed=seed)
    world = theirs.unwrapped.world
    ours.world.position[0] = [body.state.p_pos for body in world.entities]
    rng = np.random.default_rng(seed)
    for _ in range(100):
        actions = (rng.integers(0, 257, (n, 5)) / 256).astype(np.float32)  # exact also in MPE2's float32 sums
        swapped = actions[:, [0, 2, 1, 4, 3]]  # MPE2 has the opposite signs
        obs, rewards, _, _, _ = theirs.step({f"agent_{i}": a for i, a in enumerate(swapped)})
        own_obs, own_rewards, _, _, _ = ours.step(actions[None])
        o = ours.scenario.observation_size  # theirs ends in empty communication
        np.testing.assert_allclose(own_obs[0], [obs[f"agent_{i}"][:o] for i in range(n)], atol=1e-5)
        np.testing.assert_allclose(own_rewards[0] / 2, list(rewards.values()), atol=1e-5)
