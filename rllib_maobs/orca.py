"""ORCA: what a robotics engineer would use where nothing has been learned."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rllib_maobs.envs import VectorEnv
from rllib_maobs.envs.steering import assign, thrust
from rllib_maobs.envs.world import Bodies, FloatArray, Physics

_MARGIN = 0.01  # that discs keep from each other, for a wanted velocity is not always reached
_CORNERS = 32  # of the polygon around a round obstacle: the library knows no other obstacles
# Seconds in which no other disc and no obstacle may be touched; longer ones cost returns and saved no contacts.
_LOOK_AHEAD, _LOOK_AHEAD_OBSTACLES = 0.5, 0.3
_SIGHT, _MAX_NEIGHBORS = 3.0, 10
_NUDGE = 1e-2  # random part of the preferred speed: discs that meet exactly head-on would stop for good


def import_pyrvo() -> Any:
    """Return the library.

    Raises:
        ImportError: If it is not installed; says how to.
    """
    try:
        import pyrvo
    except ImportError as error:
        raise ImportError('the policy "orca" needs pyrvo: pip install -c constraints.txt -e ".[orca]"') from error
    return pyrvo


class OrcaPolicy:
    """Optimal reciprocal collision avoidance, with an optimal assignment of agents to targets.

    Every agent would like to go straight to its target, at full speed until the last step. It takes the velocity
    nearest to that with which it and the others, each doing its half, touch nothing in the next half second. Like
    the heuristic it sees the whole world and remembers nothing. It plans no way: where obstacles close the straight one
    it may stop, as in the tunnels. The velocities are those of the RVO2 library (`pyrvo`).

    Reference: van den Berg, Guy, Lin and Manocha, *Reciprocal n-body collision avoidance*, 2011.

    Args:
        env: An environment in which each agent has a target, its own one or any.
        seed: Of the random part of the preferred velocities.

    Raises:
        NotImplementedError: If there is not a target for each agent.
        ImportError: If pyrvo is not installed; says how to.
    """

    def __init__(self, env: VectorEnv, seed: int = 0) -> None:
        self._targets = env.world.index.get("target", slice(0, 0))
        if self._targets.stop - self._targets.start != len(env.agents):
            raise NotImplementedError(f"ORCA needs a target for each agent, and {env.scenario} has none")
        self._env, self._library, self._rng = env, import_pyrvo(), np.random.default_rng(seed)
        world = env.world
        solid = [g.name for g in world.groups if g.collides and not g.movable]
        self._solid = np.array([k for name in solid for k in range(world.num_bodies)[world.index[name]]], np.intp)
        movable = [group for group in world.groups if group.movable for _ in range(group.count)]
        self._speed = np.array([_top_speed(group, world.physics) for group in movable])
        # Obstacles stay where they are for an episode, and cost more than all else: one simulator for as long.
        self._simulators: list[Any] = []
        self._obstacles: FloatArray = world.position[:, self._solid]

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Return actions `(E, N, A)`, or numbers `(E, N)` if they are discrete, in the environment's situation."""
        world, n = self._env.world, len(self._env.agents)
        world.refresh()
        goal = assign(world.distance[:, :n, self._targets])
        if self._env.scenario.own_targets:
            goal[:] = np.arange(n)
        aim = np.take_along_axis(world.offset[:, :n, self._targets], goal[..., None, None], axis=2)[:, :, 0]
        wanted = world.velocity[:, : world.num_movers].copy()  # of bodies that are no agents: to go on as they do
        away = np.sqrt((aim**2).sum(axis=-1, keepdims=True))
        speed = np.minimum(self._speed[:n, None], away / world.physics.dt)
        wanted[:, :n] = aim / np.maximum(away, 1e-9) * speed + _NUDGE * speed * self._rng.uniform(-1, 1, aim.shape)
        return self._env.scenario.actions(thrust(world, self._safe(wanted)[:, :n]))

    def _safe(self, wanted: FloatArray) -> FloatArray:
        """Return (E, M, 2), the velocities nearest to the wanted ones that touch nothing."""
        world, movers = self._env.world, wanted.shape[1]
        self._renew()
        now = np.stack([world.position[:, :movers], world.velocity[:, :movers], wanted], axis=2)  # (E, M, 3, 2)
        safe: list[float] = []
        for simulator, bodies in zip(self._simulators, now, strict=True):
            # The library takes numbers one by one: Python's own are several times as quick as NumPy's.
            for k, (position, velocity, preferred) in enumerate(bodies.tolist()):
                simulator.set_agent_position(k, position)
                simulator.set_agent_velocity(k, velocity)
                simulator.set_agent_pref_velocity(k, preferred)
            simulator.do_step()
            for k in range(movers):
                safe += simulator.get_agent_velocity(k).to_tuple()
        return np.array(safe).reshape(wanted.shape)

    def _renew(self) -> None:
        """Make the simulators anew of copies where obstacles do not lie as they did."""
        here = self._env.world.position[:, self._solid]
        if not self._simulators:
            self._simulators = [self._simulator(obstacles) for obstacles in here]
        else:
            for copy in np.flatnonzero((here != self._obstacles).any(axis=(1, 2))):
                self._simulators[copy] = self._simulator(here[copy])
        self._obstacles = here

    def _simulator(self, obstacles: FloatArray) -> Any:
        """Return the library's copy of a world with obstacles (K, 2) at these places."""
        world = self._env.world
        simulator = self._library.RVOSimulator()
        simulator.set_time_step(world.physics.dt)
        for center, radius in zip(obstacles, world.radius[self._solid], strict=True):
            simulator.add_obstacle(_polygon(center, radius))
        for wall in world.walls:
            simulator.add_obstacle(_segment(np.array(wall.normal), wall.offset))
        simulator.process_obstacles()
        look_ahead = _LOOK_AHEAD, _LOOK_AHEAD_OBSTACLES
        for speed, radius in zip(self._speed, world.radius, strict=False):
            simulator.set_agent_defaults(_SIGHT, _MAX_NEIGHBORS, *look_ahead, radius + _MARGIN, speed)
            simulator.add_agent((0.0, 0.0))
        return simulator


def _top_speed(group: Bodies, physics: Physics) -> float:
    """Return the speed limit of a group's bodies, or else the speed where thrust and damping are in balance."""
    limit = group.max_speed
    return float(group.accel * physics.dt / physics.damping / physics.mass if limit is None else limit)


def _polygon(center: FloatArray, radius: float) -> list[tuple[float, float]]:
    """Return the corners of a polygon around a disc, counter-clockwise."""
    angles = 2.0 * np.pi * np.arange(_CORNERS) / _CORNERS
    corners = center + radius / np.cos(np.pi / _CORNERS) * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return [(x, y) for x, y in corners.tolist()]


def _segment(normal: FloatArray, offset: float, half: float = 100.0) -> list[tuple[float, float]]:
    """Return the ends of a long piece of a wall."""
    along = half * np.array([-normal[1], normal[0]])
    return [(x, y) for x, y in (offset * normal + along, offset * normal - along)]
