"""Hand-written navigation for the heuristic policies: who goes where, and how to get past the others.

A potential field pulls every agent to its goal. Bodies in the way do not push: they take away the part of the
wanted velocity that would bring the agent too near too fast, and turn it into a step aside. Everything is a
function of the present situation of E copies; nothing is remembered.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from rllib_maobs.envs.world import FloatArray, World

_MARGIN = 0.02  # distance that a detour keeps from a body
_APPROACH = 5.0  # speed at which a free distance of one may be closed: half of it per step of 0.1
_PASSES = 8  # a step aside from one body may lead towards the next


def assign(distance: FloatArray) -> NDArray[np.intp]:
    """Match agents and targets one to one, with the smallest sum of squared distances.

    Args:
        distance: (E, N, N), of each agent to each target.

    Returns:
        (E, N) number of each agent's target.
    """
    return np.array([linear_sum_assignment(cost)[1] for cost in distance**2], np.intp)


def steer(world: World, aim: FloatArray, speed: float = 1.0, ignore: str | None = None) -> FloatArray:
    """Return the velocity that leads to a goal and past the bodies on the way.

    Args:
        world: The copies; the first N bodies steer.
        aim: (E, N, 2), goal relative to each of them.
        speed: Speed far from the goal; it falls over the last steps, so that the agent stays there.
        ignore: Group of bodies to run into.

    Returns:
        (E, N, 2).
    """
    n, num_colliders = aim.shape[1], world.gap.shape[-1]
    away = _length(aim)
    wanted = aim * np.minimum(5.0, speed / np.maximum(away, 1e-9))[..., None]
    direction = world.offset[:, :n, :num_colliders] / np.maximum(world.distance[:, :n, :num_colliders, None], 1e-9)
    free = world.gap[:, :n] - _MARGIN
    # Two agents that meet share the free distance between them.
    share = np.where(np.arange(num_colliders) < world.num_movers, 0.5, 1.0)
    allowed = _APPROACH * free * share  # +inf to itself
    if ignore is not None:
        allowed[..., world.index[ignore]] = np.inf
    for _ in range(_PASSES):
        approach = (wanted[:, :, None] * direction).sum(axis=-1)  # (E, N, C)
        excess = np.maximum(approach - allowed, 0.0)
        worst = excess.argmax(axis=-1)[..., None]
        too_fast = np.take_along_axis(excess, worst, axis=-1)
        if not too_fast.any():
            break
        towards = np.take_along_axis(direction, worst[..., None], axis=2)[:, :, 0]
        aside = np.stack([-towards[..., 1], towards[..., 0]], axis=-1)
        # Past the body on the side of the goal; head-on, everybody keeps to the right.
        side = np.where((aside * aim).sum(axis=-1, keepdims=True) > 0.02 * away[..., None], 1.0, -1.0)
        moving = away[..., None] > 0.1
        wanted = wanted - too_fast * (towards - np.where(moving, side, 0.0) * aside)
        fast = _length(wanted)[..., None]
        wanted = wanted * np.minimum(1.0, speed / np.maximum(fast, 1e-9))
    return wanted


def take_turns(world: World, aim: FloatArray) -> FloatArray:
    """Return the velocity that leads through a gap at the origin along x, one agent after the other.

    Agents before the gap (x < 0) first go to its entrance, then along its middle; those behind it go for their
    goals. The agent nearest to the gap goes first, and everybody keeps a distance to the one before.

    Args:
        world: The copies; the first N bodies steer, the group "obstacle" makes the gap.
        aim: (E, N, 2), goal relative to each of them.

    Returns:
        (E, N, 2) velocities.
    """
    n = aim.shape[1]
    position, diameter = world.position[:, :n], 2.0 * world.radius[0]
    # Where an agent can be half a diameter off the middle and still half a diameter from the circle.
    circles = world.index["obstacle"]
    radius, height = world.radius[circles].max(), np.abs(world.position[:, circles, 1]).max()
    entrance = np.sqrt(max((radius + diameter) ** 2 - (height - diameter / 2.0) ** 2, diameter**2))

    x, y = position[..., 0], position[..., 1]
    lined_up = np.abs(y) < 0.2 * diameter + 0.5 * np.maximum(-x - entrance, 0.0)
    inside = (x > -entrance) & (x < entrance)
    before = x <= -entrance
    to_entrance = np.stack([-entrance - x, -y], axis=-1)
    to_exit = np.stack([entrance + diameter - x, -y], axis=-1)
    goal = np.where(before[..., None], np.where(lined_up[..., None], to_exit, to_entrance), aim)
    goal = np.where(inside[..., None], to_exit, goal)
    wanted = steer(world, goal)

    # Length of the way to the exit, negative behind it; the queue is in its order.
    ahead = np.where(before, _length(to_entrance) + 2.0 * entrance, entrance - x)
    order = np.argsort(ahead, axis=1, kind="stable")
    queue = np.take_along_axis(ahead, order, axis=1)
    room = np.full_like(queue, np.inf)
    room[:, 1:] = queue[:, 1:] - queue[:, :-1] - 1.3 * diameter
    speed = np.empty_like(room)
    np.put_along_axis(speed, order, np.clip(8.0 * room, 0.0, 1.0), axis=1)
    speed = np.where(ahead > 0.0, speed, 1.0)
    return wanted * speed[..., None]


def thrust(world: World, wanted: FloatArray) -> FloatArray:
    """Return the directed force that gives the first N bodies a wanted velocity in the next step.

    Args:
        world: The copies.
        wanted: (E, N, 2) velocities.

    Returns:
        (E, N, 2), clipped to [-1, 1].
    """
    physics, n = world.physics, wanted.shape[1]
    accel = np.array([g.accel for g in world.groups if g.movable for _ in range(g.count)])[:n, None]
    missing = wanted - (1.0 - physics.damping) * world.velocity[:, :n]
    return np.clip(missing * physics.mass / (physics.dt * accel), -1.0, 1.0)


def _length(vector: FloatArray) -> FloatArray:
    return np.sqrt(vector[..., 0] ** 2 + vector[..., 1] ** 2)
