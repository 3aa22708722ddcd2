"""The tunnels in hand-placed situations."""

import numpy as np
import pytest

from rllib_maobs.envs import make_vec
from tests.episodes import episode_metrics, place, roll, sample_actions


def test_tunnel_starts_as_drawn():
    env = make_vec("tunnel", num_envs=2)
    env.reset(seed=0)
    rows = [0.3, 0.0, -0.3]
    expected = [*([-1.0, y] for y in rows), [0.0, 1.125], [0.0, -1.125], *([1.0, y] for y in rows)]
    np.testing.assert_allclose(env.world.position, [expected] * 2, atol=1e-12)
    assert env.world.gap[0, 0, 3:5].min() > 0.0 and not env.world.walls
    # A body in the middle of the gap has (0.25 - 0.15) / 2 of room on both sides.
    env.world.position[0, 0] = 0.0
    env.world.refresh()
    np.testing.assert_allclose(env.world.gap[0, 0, 3:5], 0.05)


def test_tunnel_shares_targets():
    env = make_vec("tunnel", reward_mode="individual")
    place(env, [[1.0, 0.0], [5.0, 5.0], [1.0, 0.3], *env.scenario.place([None])[0, 3:]])
    _, rewards, *_ = env.step(np.zeros((1, 3, 5)))
    np.testing.assert_allclose(rewards[0], [-0.3, -0.3, -0.3], rtol=1e-6)
    obs = env.observe()[0, 1]
    np.testing.assert_allclose(obs[4:10], [-4.0, -4.7, -4.0, -5.0, -4.0, -5.3], rtol=1e-5)
    np.testing.assert_allclose(obs[10:], [-5.0, -3.875, -5.0, -6.125, -4.0, -5.0, -4.0, -4.7], rtol=1e-5)


def test_simple_tunnel_6a_front_row_goes_to_the_far_column():
    env = make_vec("simple-tunnel-6a")
    env.reset(seed=0)
    p, rows = env.world.position[0], [0.3, 0.0, -0.3]
    np.testing.assert_allclose(p[:6], [*([-0.95, y] for y in rows), *([-1.2, y] for y in rows)], atol=1e-12)
    np.testing.assert_allclose(p[8:], [*([1.2, y] for y in rows), *([0.95, y] for y in rows)], atol=1e-12)


def test_simple_tunnel_observes_and_pays_the_own_target():
    """Agent 0 is at its target; agent 1 at that of agent 2, in a corner both walls touch; agent 2 is on a circle."""
    env = make_vec("simple-tunnel", wall_collision_penalty=3.0, obstacle_collision_penalty=2.0)
    place(env, [[1.0, 0.3], [1.36, 0.96], [0.5, -0.2], *env.scenario.place([None])[0, 3:]])
    obs = env.observe()[0]
    np.testing.assert_allclose(obs[1, 4:6], [-0.36, -0.96], rtol=1e-5)
    np.testing.assert_allclose(obs[1, 6:10], [-1.36, 0.165, -1.36, -2.085], rtol=1e-5)
    np.testing.assert_allclose(obs[1, 10:], [-0.36, -0.66, -0.86, -1.16], rtol=1e-5)
    outcome = env.scenario.outcome(env.world)
    lengths = [0.0, np.hypot(0.36, 0.96), np.hypot(0.5, 0.1)]
    np.testing.assert_allclose(outcome.rewards[0], [-lengths[0], -lengths[1] - 6.0, -lengths[2] - 2.0], rtol=1e-9)
    assert outcome.metrics["target_distance"][0] == pytest.approx(sum(lengths))
    shared = make_vec("simple-tunnel", reward_mode="mean", wall_collision_penalty=3.0, obstacle_collision_penalty=2.0)
    place(shared, env.world.position[0])
    shared.world.refresh()
    np.testing.assert_allclose(shared.scenario.outcome(shared.world).rewards[0], 3 * [outcome.rewards[0].mean()])


def test_simple_tunnel_success_is_per_agent():
    """Agents 1 and 2 stand on each other's targets: covered for Tunnel, not here; then agent 1 comes home."""
    env = make_vec("simple-tunnel", horizon=2)
    rest = env.scenario.place([None])[0, 3:]
    place(env, [[1.0, 0.25], [1.0, -0.3], [1.0, 0.0], *rest])
    env.step(np.zeros((1, 3, 5)))
    env.world.position[0, 1:3], env.world.velocity[0] = [[0.95, 0.0], [1.0, 0.6]], 0.0
    *_, info = env.step(np.zeros((1, 3, 5)))
    metrics = episode_metrics(info)
    assert [metrics[f"success_agent_{i}"] for i in range(3)] == [1.0, 1.0, 0.0]
    assert metrics["coverage"] == pytest.approx(2 / 3) and metrics["coverage_mean"] == pytest.approx(0.5)
    assert metrics["all_covered"] == metrics["success"] == metrics["all_covered_mean"] == 0.0


def test_simple_tunnel_walls_hold():
    env = make_vec("simple-tunnel-6a", num_envs=8, max_speed=None, accel=500.0)
    _, _, metrics = roll(env, sample_actions(env, 100), seed=0)
    assert (np.abs(env.world.position[:, :6]) <= [1.4 + 1e-12, 1.0 + 1e-12]).all()
    assert (metrics["collisions_walls"] > 100).all()


def test_walls_are_collisions():
    """Agent 1 pushes into a corner, at both walls, in two steps of three; nobody touches anything else."""
    env = make_vec("simple-tunnel", horizon=3)
    env.reset(seed=0)
    start = env.world.position[0, 1].copy()
    for x, y in ([-1.36, 0.96], [-1.36, 0.96], start):
        env.world.position[0, 1], env.world.velocity[0] = [x, y], 0.0
        *_, info = env.step(np.array([[[0, 0, 0, 0, 0], [0, 0, 1, 1, 0], [0, 0, 0, 0, 0]]]))
    metrics = episode_metrics(info)
    assert metrics["collisions_walls"] == 4.0 and metrics["collision_free"] == 0.0
    assert metrics["collisions_agents"] == metrics["collisions_obstacles"] == 0.0


def test_much_start_noise_leaves_nobody_in_another():
    env = make_vec("tunnel", num_envs=64, start_noise=2.0)
    env.reset(seed=0)
    x = env.world.position[:, :3, 0]
    assert (x.min(), x.max()) == pytest.approx((-3.0, 1.0), abs=0.1)
    assert env.world.contacts("agent").sum() == env.world.contacts("obstacle").sum() == 0
    plain = make_vec("tunnel")
    plain.reset(seed=0)
    np.testing.assert_array_equal(env.world.position[:, 3:], np.tile(plain.world.position[:, 3:], (64, 1, 1)))


def test_start_noise_moves_agents_alone_and_differs_between_copies():
    env = make_vec("tunnel", num_envs=128, start_noise=0.05)
    still = make_vec("tunnel")
    env.reset(seed=0), still.reset(seed=0)
    shift = env.world.position - still.world.position
    assert not shift[:, 3:].any()
    assert 0.049 < np.abs(shift[:, :3]).max() <= 0.05 and shift.min() < -0.045
    assert not np.array_equal(shift[0], shift[1])
