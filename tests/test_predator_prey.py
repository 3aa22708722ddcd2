"""Predator-prey in hand-placed situations."""

import numpy as np
import pytest
from mpe2 import simple_tag_v3

from rllib_maobs.envs import make_vec
from rllib_maobs.envs.world import Physics
from tests.episodes import episode_metrics, glide, place

PREY = "obstacle-predator-prey"
FAR = [[9.0, 9.0], [-9.0, 9.0]]  # obstacles out of the way


def chase(**options):
    return make_vec(PREY, **options)


def test_predator_prey_bodies():
    env = chase()
    assert env.agents == ["predator_0", "predator_1", "predator_2"]
    assert env.world.body_names[3:] == ["prey_0", "obstacle_0", "obstacle_1"]
    assert [(g.radius, g.accel, g.max_speed) for g in env.world.groups[:2]] == [(0.075, 3.0, 1.0), (0.05, 4.0, 1.3)]
    assert env.world.radius[4] == 0.2


def test_predator_prey_layouts():
    env = chase(num_envs=256)
    env.reset(seed=0)
    p = env.world.position
    assert 0.99 < np.abs(p[:, :4]).max() <= 1.0 and 0.88 < np.abs(p[:, 4:]).max() <= 0.9
    assert env.world.gap.min() >= 0.02
    unchecked = chase(num_envs=256, placement="mpe")
    unchecked.reset(seed=0)
    assert (unchecked.world.gap < 0.0).any()


def test_predator_prey_observation_by_hand():
    env = chase(num_predators=2, num_obstacles=1, prey="learned")
    place(env, [[0.0, 0.0], [0.5, 0.1], [-0.3, 0.4], [0.9, 0.8]])
    env.world.velocity[0, :3] = [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]
    expected = [
        [0.1, 0.2, 0.0, 0.0, 0.9, 0.8, 0.5, 0.1, -0.3, 0.4, 0.5, 0.6],
        [0.3, 0.4, 0.5, 0.1, 0.4, 0.7, -0.5, -0.1, -0.8, 0.3, 0.5, 0.6],
        [0.5, 0.6, -0.3, 0.4, 1.2, 0.4, 0.3, -0.4, 0.8, -0.3, 0.0, 0.0],
    ]
    np.testing.assert_allclose(env.observe()[0], expected, rtol=1e-6)
    np.testing.assert_allclose(env.state()[0], [*expected[0], *expected[1], *expected[2][:-2]], rtol=1e-6)
    scripted = chase(num_predators=2, num_obstacles=1)
    place(scripted, env.world.position[0])
    scripted.world.velocity[0] = env.world.velocity[0]
    np.testing.assert_allclose(scripted.observe()[0], expected[:2], rtol=1e-6)


def test_predators_share_what_they_catch_and_touch():
    """Two predators on the prey, two pairs of predators in contact, one predator on an obstacle."""
    env = chase(capture_reward=5.0, agent_collision_penalty=0.5, obstacle_collision_penalty=2.0)
    place(env, [[-0.1, 0.0], [0.0, 0.1], [0.1, 0.15], [0.0, 0.0], [0.36, 0.15], [9.0, 9.0]])
    env.world.refresh()
    outcome = env.scenario.outcome(env.world)
    assert outcome.metrics["captures"][0] == 2 and outcome.success[0]
    np.testing.assert_allclose(outcome.rewards[0], 3 * [2 * 5.0 - 2 * 0.5 - 2.0])
    env.world.position[0, 0:6] = [[-0.1, 0.0], [0.5, 0.5], [-0.5, 0.5], [0.0, 0.0], [0.2, 0.0], [9.0, 9.0]]
    env.world.refresh()  # the prey is on the obstacle: no business of the predators
    np.testing.assert_allclose(env.scenario.outcome(env.world).rewards[0], 3 * [5.0])
    shaped = chase(shaping=0.1)
    place(shaped, [[0.3, 0.4], [0.0, 1.0], [-2.0, 0.0], [0.0, 0.0], *FAR])
    shaped.world.refresh()
    np.testing.assert_allclose(shaped.scenario.outcome(shaped.world).rewards[0], 3 * [-0.1 * 3.5])


@pytest.mark.parametrize(
    ("x", "price"), [(0.89, 0.0), (0.95, 0.5), (1.0, 1.0), (-1.2, np.exp(0.4)), (3.0, 10.0), (1e4, 10.0)]
)
def test_learned_prey_pays_for_leaving(x, price):
    env = chase(prey="learned", shaping=0.1)
    place(env, [[x + 0.3, 0.4], [x, 1.0], [x - 2.0, 0.0], [x, 0.0], [2 * x, 50.0], [0.0, 50.0]])
    env.world.refresh()
    np.testing.assert_allclose(env.scenario.outcome(env.world).rewards[0, 3], 0.35 - price, rtol=1e-9)


def test_captures_by_hand():
    """No contact, then one predator, then two, then none: caught, though not at the end."""
    env = chase(horizon=4)
    env.reset(seed=0)
    env.world.physics = Physics(dt=1e-6)  # contacts have no time to part
    for caught in (0, 1, 2, 0):
        hunters = [[0.06 + 0.04 * k, 0.11 * k - 0.05] if k < caught else [2.0 + k, 0.0] for k in range(3)]
        env.world.position[0], env.world.velocity[0] = [*hunters, [0.0, 0.0], *FAR], 0.0
        *_, info = env.step(np.zeros((1, 3, 5)))
    metrics = episode_metrics(info)
    assert (metrics["captures"], metrics["first_capture_step"], metrics["success"]) == (3.0, 2.0, 1.0)
    assert metrics["time_to_goal"] == 2.0
    assert metrics["collisions_agents"] == 1.0  # the two predators of step 3 touch; the prey is no collision
    assert metrics["min_clearance"] < 0.0


def test_nothing_caught():
    env = chase(horizon=2)
    place(env, [[3.0, 0.0], [5.0, 0.0], [7.0, 0.0], [0.0, 0.0], *FAR])
    glide(env, [[0.0, 0.0]] * 3)
    *_, info = glide(env, [[0.0, 0.0]] * 3)
    metrics = episode_metrics(info)
    assert (metrics["captures"], metrics["first_capture_step"], metrics["success"]) == (0.0, 2.0, 0.0)
    assert metrics["prey_distance"] == pytest.approx(5.0, abs=0.05)
    assert metrics["min_clearance"] == pytest.approx(2.0 - 0.15)  # to each other: the prey does not count


def test_the_prey_is_no_obstacle_for_the_clearance():
    env = chase(horizon=1)
    place(env, [[3.0, 0.0], [5.0, 0.0], [7.0, 0.0], [3.0, 0.01], *FAR])
    env.world.physics = Physics(dt=1e-6)  # contacts have no time to part
    metrics = episode_metrics(glide(env, [[0.0, 0.0]] * 3)[-1])
    assert metrics["captures"] == 1.0 and metrics["min_clearance"] > 1.5 and metrics["collision_free"] == 1.0


def test_random_prey_moves_by_its_own_stream():
    env = chase(num_envs=2, num_predators=1)
    env.reset(seed=0)
    env.world.position[:, 0] = [9.0, 0.0]
    forces = []
    for _ in range(100):
        before = env.world.velocity[:, 1].copy()
        env.world.position[:, 1] = 0.0
        env.world.position[:, 2:] = 5.0
        env.step(np.zeros((2, 1, 5)))
        forces.append((env.world.velocity[:, 1] - 0.75 * before) / 0.1 / 4.0)
        if np.hypot(*env.world.velocity[:, 1].T).max() > 1.2:
            env.world.velocity[:, 1] = 0.0  # keep away from the speed limit
    forces = np.array(forces)
    assert np.abs(forces).max() <= 1.0 + 1e-9 and forces.min() < -0.95 and forces.max() > 0.95
    assert abs(forces.mean()) < 0.1 and not np.allclose(forces[:, 0], forces[:, 1])


def test_fleeing_prey_runs_away_but_not_out():
    env = chase(num_envs=64, prey="flee")
    env.reset(seed=0)
    env.world.position[:, 4:] = FAR
    env.world.position[:, :3] = [[0.0, 0.0], [0.1, 0.3], [0.1, -0.3]]
    env.world.position[:, 3] = [0.4, 0.0]
    furthest = np.zeros(64)
    for t in range(100):
        env.step(np.zeros((64, 3, 5)))
        if t == 3:
            assert (env.world.position[:, 3, 0] > 0.5).all()
        furthest = np.maximum(furthest, np.abs(env.world.position[:, 3]).max(axis=1))
    assert (furthest <= 1.0).all() and (furthest > 0.7).all()


def test_fleeing_prey_is_stopped_at_its_limit():
    env = chase(prey="flee", prey_range=0.8)
    place(env, [[0.5, 0.0], [0.4, 0.2], [0.4, -0.2], [0.78, 0.0], *FAR])
    env.world.velocity[0, 3] = [1.2, 0.3]
    env.step(np.zeros((1, 3, 5)))
    assert env.world.position[0, 3, 0] == 0.8 and env.world.velocity[0, 3, 0] == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_predator_prey_is_mpe2_simple_tag(seed):
    """Observations and rewards of a whole episode, in MPE2's order of integration, without our penalties."""
    theirs = simple_tag_v3.parallel_env(
        num_good=1, num_adversaries=3, num_obstacles=2, max_cycles=100, continuous_actions=True
    )
    ours = chase(
        prey="learned",
        integrator="explicit",
        placement="mpe",
        agent_collision_penalty=0.0,
        obstacle_collision_penalty=0.0,
    )
    theirs.reset(seed=seed)
    ours.reset(seed=seed)
    world = theirs.unwrapped.world
    rng = np.random.default_rng(seed)
    for body in world.agents:
        body.state.p_pos = rng.uniform(-0.4, 0.4, 2)
    ours.world.position[0] = [body.state.p_pos for body in world.entities]
    names, captures = ["adversary_0", "adversary_1", "adversary_2", "agent_0"], 0
    for _ in range(100):
        actions = (rng.integers(0, 257, (4, 5)) / 256).astype(np.float32)  # exact also in MPE2's float32 sums
        swapped = actions[:, [0, 2, 1, 4, 3]]  # MPE2 has the opposite signs
        obs, rewards, *_ = theirs.step(dict(zip(names, swapped, strict=True)))
        own_obs, own_rewards, *_ = ours.step(actions[None])
        for i, name in enumerate(names):
            size = ours.scenario.observation_sizes[i]
            np.testing.assert_allclose(own_obs[0, i, :size], obs[name][:size], atol=1e-5)
            assert own_rewards[0, i] == pytest.approx(rewards[name], abs=1e-4)
        captures += own_rewards[0, 0] > 0.0
    assert captures > 0  # else the episode says nothing about captures
