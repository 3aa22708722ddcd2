"""Physics: against MPE2, against steps computed by hand, and at the edges."""

from dataclasses import replace

import numpy as np
import pytest
from mpe2._mpe_utils.core import Agent, Landmark
from mpe2._mpe_utils.core import World as MPE2World

from rllib_maobs.envs import SCENARIOS, Bodies, Wall, World, make_scenario

DT, DAMPING, MARGIN, STIFFNESS = 0.1, 0.25, 1e-3, 100.0


def bodies(agents=2, obstacles=0, targets=0, radius=0.1, max_speed=None):
    groups = [Bodies("agent", agents, radius, movable=True, max_speed=max_speed)]
    groups += [Bodies("obstacle", obstacles, 0.1)] if obstacles else []
    groups += [Bodies("target", targets, 0.05, collides=False)] if targets else []
    return groups


def contact_force(gap):
    return STIFFNESS * MARGIN * np.log1p(np.exp(-gap / MARGIN))


def mpe2_world(num_agents, num_obstacles, num_targets, max_speed):
    world = MPE2World()
    world.agents = [Agent() for _ in range(num_agents)]
    world.landmarks = [Landmark() for _ in range(num_obstacles + num_targets)]
    for agent in world.agents:
        agent.silent, agent.size, agent.max_speed = True, 0.15, max_speed
    for i, landmark in enumerate(world.landmarks):
        landmark.size, landmark.collide = 0.1, i < num_obstacles
    return world


@pytest.mark.parametrize("max_speed", [None, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_explicit_order_follows_mpe2_over_whole_episodes(seed, max_speed):
    """From one injected random state, 100 steps in which both integrate on their own."""
    rng = np.random.default_rng(seed)
    n, m, t = 6, 4, 6
    theirs = mpe2_world(n, m, t, max_speed)
    ours = World(
        1,
        [
            Bodies("agent", n, 0.15, movable=True, max_speed=max_speed),
            Bodies("obstacle", m, 0.1),
            Bodies("target", t, 0.1, collides=False),
        ],
        integrator="explicit",
    )
    ours.position[0] = rng.uniform(-1, 1, (n + m + t, 2))
    ours.velocity[0, :n] = rng.uniform(-1, 1, (n, 2))
    for i, entity in enumerate(theirs.entities):
        entity.state.p_pos = ours.position[0, i].copy()
        entity.state.p_vel = ours.velocity[0, i].copy()
    touched = 0
    for _ in range(100):
        force = rng.uniform(-5, 5, (1, n, 2)) - ours.position[:, :n]
        for agent, own in zip(theirs.agents, force[0], strict=True):
            agent.action.u = own.copy()
            agent.action.c = np.zeros(0)
        ours.step(force)
        theirs.step()
        np.testing.assert_allclose(ours.position[0], [b.state.p_pos for b in theirs.entities], atol=1e-7)
        np.testing.assert_allclose(ours.velocity[0], [b.state.p_vel for b in theirs.entities], atol=1e-6)
        touched += ours.contacts("agent").sum() + ours.contacts("obstacle").sum()
    assert touched > 10  # else the episode says nothing about contacts


def test_free_motion_by_hand():
    world = World(1, bodies(1))
    world.velocity[0, 0] = [1.0, 0.0]
    world.step(np.array([[[5.0, -2.0]]]))
    # v = 0.75 * (1, 0) + 0.1 * (5, -2), then p = 0.1 * v
    np.testing.assert_allclose(world.velocity[0, 0], [1.25, -0.2], rtol=1e-14)
    np.testing.assert_allclose(world.position[0, 0], [0.125, -0.02], rtol=1e-14)


def test_solid_damps_once_and_pushes_in_five_parts():
    world = World(1, bodies(1), physics="solid")
    world.velocity[0, 0] = [1.0, 0.0]
    world.step(np.array([[[5.0, 0.0]]]))
    # v = 0.75, then + 0.02 * 5 five times; p sums 0.02 * v over the five parts.
    np.testing.assert_allclose(world.velocity[0, 0], [1.25, 0.0], rtol=1e-14)
    np.testing.assert_allclose(world.position[0, 0], [0.02 * (0.85 + 0.95 + 1.05 + 1.15 + 1.25), 0.0], rtol=1e-14)


def test_explicit_order_moves_before_it_accelerates():
    world = World(1, bodies(1), integrator="explicit")
    world.velocity[0, 0] = [1.0, 0.0]
    world.step(np.array([[[5.0, 0.0]]]))
    np.testing.assert_allclose(world.position[0, 0], [0.1, 0.0], rtol=1e-14)
    np.testing.assert_allclose(world.velocity[0, 0], [1.25, 0.0], rtol=1e-14)


def test_speed_limit_scales_velocity_down_before_the_move():
    world = World(1, bodies(1, max_speed=1.0))
    world.velocity[0, 0] = [1.2, 1.6]
    world.step(np.zeros((1, 1, 2)))  # damped to speed 1.5
    np.testing.assert_allclose(world.velocity[0, 0], [0.6, 0.8], rtol=1e-14)
    np.testing.assert_allclose(world.position[0, 0], [0.06, 0.08], rtol=1e-14)


@pytest.mark.parametrize("gap", [-0.05, -0.001, 0.0, 0.002])
def test_contact_by_hand_is_equal_and_opposite(gap):
    world = World(1, bodies(2))
    world.position[0] = [[0.0, 0.0], [0.0, 0.2 + gap]]
    world.step(np.zeros((1, 2, 2)))
    speed = DT * contact_force(gap)
    np.testing.assert_allclose(world.velocity[0], [[0.0, -speed], [0.0, speed]], rtol=1e-10)
    np.testing.assert_allclose(world.position[0, 0], [0.0, -DT * speed], rtol=1e-10)


def test_obstacle_pushes_and_stays():
    world = World(1, bodies(1, obstacles=1, targets=1))
    world.position[0] = [[0.15, 0.0], [0.0, 0.0], [0.14, 0.0]]
    world.step(np.zeros((1, 1, 2)))
    assert world.velocity[0, 0, 0] == pytest.approx(DT * contact_force(-0.05))
    np.testing.assert_array_equal(world.position[0, 1:], [[0.0, 0.0], [0.14, 0.0]])


def test_momentum_is_kept_in_a_crowd():
    rng = np.random.default_rng(0)
    world = World(5, bodies(8))
    world.position = rng.uniform(-0.3, 0.3, (5, 8, 2))
    world.step(np.zeros((5, 8, 2)))
    assert np.abs(world.velocity).max() > 0.1
    np.testing.assert_allclose(world.velocity.sum(axis=1), 0.0, atol=1e-12)


@pytest.mark.parametrize("physics", ["mpe", "solid"])
def test_coincident_bodies_part(physics):
    world = World(1, bodies(2, obstacles=1), physics=physics)
    world.position[0] = [[0.5, 0.5], [0.5, 0.5], [-0.5, 0.0]]
    world.step(np.zeros((1, 2, 2)))
    assert np.isfinite(world.position).all()
    assert world.distance[0, 0, 1] > 0.1
    np.testing.assert_allclose(world.velocity[0, 0], -world.velocity[0, 1])


def test_bodies_far_inside_each_other_do_not_overflow():
    world = World(1, bodies(2, radius=5.0))
    world.position[0, 1] = [1e-6, 0.0]
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        world.step(np.zeros((1, 2, 2)))
    assert np.isfinite(world.velocity).all()


@pytest.mark.parametrize(("physics", "passes"), [("mpe", True), ("solid", False)])
def test_head_on_at_full_speed(physics, passes):
    """Two agents drive into each other at speed 1 and go on pushing, from 40 distances."""
    world = World(40, bodies(2, radius=0.075, max_speed=1.0), physics=physics)
    world.position[:, 1, 0] = np.linspace(1.0, 1.2, 40)
    push = np.tile([[3.0, 0.0], [-3.0, 0.0]], (40, 1, 1))
    touched = np.zeros(40, bool)
    for _ in range(25):
        world.step(push)
        touched |= world.contacts("agent").any(axis=1)
    assert touched.all()
    assert (world.position[:, 0, 0] > world.position[:, 1, 0]).any() == passes


@pytest.mark.parametrize("scenario_id", sorted(SCENARIOS))
@pytest.mark.parametrize("along", [[1.0, 0.0], [1.0, 1.0]])
@pytest.mark.parametrize("limited", [True, False])
def test_solid_bodies_of_every_scenario_never_pass_at_full_thrust(scenario_id, along, limited):
    """Every kind of pair, head-on from 100 distances, as fast as the scenario lets them and still pushing."""
    scenario = make_scenario(scenario_id, physics="solid")
    kinds = [group for group in scenario.bodies() if group.collides]
    if not limited:
        kinds = [replace(group, max_speed=None) for group in kinds]
    for one in (kind for kind in kinds if kind.movable):
        for other in (kind for kind in kinds if kind is not one or one.count > 1):
            pair = [replace(one, name="one", count=1), replace(other, name="other", count=1)]
            world = World(100, pair, physics="solid")
            contact = one.radius + other.radius
            direction = np.array(along) / np.linalg.norm(along)
            world.position[:, 1] = (contact + np.linspace(0.01, 1.5, 100))[:, None] * direction
            push = np.array(along) * [[one.accel], [-other.accel]]
            # Already as fast as that thrust makes them.
            world.velocity[:] = (push * 0.1 / 0.25)[: world.velocity.shape[1]]
            touched = np.zeros(100, bool)
            for _ in range(60):
                world.step(np.tile(push[: world.num_movers], (100, 1, 1)))
                touched |= world.gap[:, 0, 1] < 0.0  # at the end of some step, if not of the first
                assert ((world.position[:, 1] - world.position[:, 0]) @ direction > 0.0).all()
            assert touched.all()


def test_contacts_count_neither_self_nor_targets():
    world = World(2, bodies(3, obstacles=2, targets=1))
    world.position[0] = [[0.0, 0.0], [0.19, 0.0], [5.0, 0.0], [0.1, 0.1], [0.0, 0.21], [0.0, 0.0]]
    world.position[1] = [[0.0, 0.0], [3.0, 0.0], [5.0, 0.0], [0.0, 7.0], [9.0, 0.0], [0.0, 0.0]]
    world.refresh()
    np.testing.assert_array_equal(world.contacts("agent"), [[1, 1, 0], [0, 0, 0]])
    np.testing.assert_array_equal(world.contacts("obstacle"), [[1, 1, 0], [0, 0, 0]])
    np.testing.assert_array_equal(world.contacts("target"), 0)


def test_contact_is_flagged_after_the_move():
    world = World(1, bodies(1, obstacles=1))
    world.position[0] = [[0.0, 0.0], [0.29, 0.0]]
    world.velocity[0, 0] = [1.3333, 0.0]
    world.refresh()
    assert world.contacts("obstacle").sum() == 0
    world.step(np.zeros((1, 1, 2)))
    assert world.distance[0, 0, 1] == pytest.approx(0.19, abs=1e-4)
    assert world.contacts("obstacle").sum() == 1


WALLS = [Wall((1.0, 0.0), 1.0), Wall((-1.0, 0.0), 1.0), Wall((0.0, 1.0), 0.5), Wall((0.0, -1.0), 0.5)]


def test_walls_keep_centres_inside_and_stop_the_normal_velocity():
    world = World(1, bodies(1), walls=WALLS)
    world.position[0, 0] = [0.95, 0.0]
    world.velocity[0, 0] = [4.0, 0.4]
    world.step(np.zeros((1, 1, 2)))
    assert world.position[0, 0, 0] == 1.0
    assert world.velocity[0, 0, 0] == 0.0
    assert world.velocity[0, 0, 1] == pytest.approx(0.3)  # along the wall it slides
    np.testing.assert_array_equal(world.wall_contacts(), [[1]])


def test_wall_pushes_back_by_its_penetration():
    world = World(1, bodies(1), walls=WALLS)
    world.position[0, 0] = [0.0, -0.42]  # 0.02 deep in the lower wall
    world.step(np.zeros((1, 1, 2)))
    np.testing.assert_allclose(world.velocity[0, 0], [0.0, DT * contact_force(-0.02)], rtol=1e-10)


def test_walls_hold_against_a_crowd():
    rng = np.random.default_rng(1)
    world = World(16, bodies(5), walls=WALLS)
    world.position = rng.uniform(-0.5, 0.5, (16, 5, 2))
    corner = np.array([1.0, 0.5])
    for _ in range(100):
        world.step(5.0 * (corner - world.position))
        assert (np.abs(world.position) <= corner + 1e-12).all()
    assert np.isfinite(world.velocity).all()


@pytest.mark.parametrize("physics", ["mpe", "solid"])
def test_limit_holds_its_own_group_alone(physics):
    held = Bodies("held", 1, 0.1, movable=True, limit=0.5)
    world = World(2, [Bodies("agent", 1, 0.1, movable=True), held], physics=physics)
    world.position[:, 0], world.position[:, 1] = [0.0, 0.45], [0.45, -0.45]
    world.velocity[:] = [2.0, 0.5]
    world.velocity[1, 1] = [-2.0, -0.5]
    for _ in range(3):
        world.step(np.zeros((2, 2, 2)))
    assert (world.position[:, 0] > 0.5).any(axis=1).all()
    assert world.position[0, 1, 0] == 0.5 and world.velocity[0, 1, 0] == 0.0
    assert -0.45 < world.position[0, 1, 1] < -0.3 and world.velocity[0, 1, 1] > 0.0  # along the edge it slides
    assert world.position[1, 1, 1] == -0.5 and world.velocity[1, 1, 1] == 0.0
    assert world.velocity[1, 1, 0] < 0.0


@pytest.mark.parametrize("physics", ["mpe", "solid"])
@pytest.mark.parametrize("integrator", ["semi_implicit", "explicit"])
def test_one_copy_equals_many(physics, integrator):
    rng = np.random.default_rng(2)
    position = rng.uniform(-0.6, 0.6, (16, 9, 2))
    force = rng.uniform(-5, 5, (30, 16, 5, 2))
    groups = bodies(5, obstacles=2, targets=2, max_speed=1.0)
    many = World(16, groups, WALLS, physics, integrator)
    single = [World(1, groups, WALLS, physics, integrator) for _ in range(16)]
    many.position = position
    for e, world in enumerate(single):
        world.position[0] = position[e]
    for step in force:
        many.step(step)
        for e, world in enumerate(single):
            world.step(step[e : e + 1])
            np.testing.assert_array_equal(many.position[e], world.position[0])
            np.testing.assert_array_equal(many.contacts("agent")[e], world.contacts("agent")[0])


def test_written_positions_count_from_the_next_step():
    world, fresh = (World(1, bodies(2)) for _ in range(2))
    world.position[0] = [[3.0, 3.0], [-3.0, -3.0]]
    world.step(np.zeros((1, 2, 2)))
    for w in (world, fresh):
        w.position[0] = [[0.0, 0.0], [0.15, 0.0]]
        w.step(np.zeros((1, 2, 2)))
    np.testing.assert_array_equal(world.position, fresh.position)
    assert world.velocity[0, 0, 0] < -0.1


def test_assignment_fills_the_arrays():
    world = World(2, bodies(2))
    before = world.position
    world.position = np.ones((2, 2, 2), np.float32)
    assert world.position is before
    assert world.position.dtype == np.float64


def test_movable_bodies_come_first():
    with pytest.raises(ValueError, match=r"movable groups come first; got \['rock', 'agent'\]"):
        World(1, [Bodies("rock", 1, 0.1), Bodies("agent", 1, 0.1, movable=True)])
