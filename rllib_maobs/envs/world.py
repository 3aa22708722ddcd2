"""Batched 2-D physics of discs: E copies of a world of K bodies, in NumPy.

The dynamics are those of OpenAI's multi-agent particle environments (MPE). Every array is float64, because
contacts amplify rounding errors; only observations are float32.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rllib_maobs.options import Range, check_value

FloatArray = NDArray[np.float64]

# Beyond this gap the contact force of MPE is below 1e-20: not worth computing.
_REACH = 0.05
MOST_BODIES = 5000
_STIFFEST = 10_000.0  # a hundred times as many steps


@dataclass(frozen=True)
class Bodies:
    """A group of alike discs.

    Args:
        name: Name of the group in the singular, such as "agent" or "obstacle"; body i is called `<name>_<i>`.
        count: How many.
        radius: Radius of each disc.
        movable: Whether forces move it.
        collides: Whether it touches other colliding bodies; targets do not.
        accel: Force at full action, for bodies that act.
        max_speed: Speed limit, None for no limit.
        limit: Half width of the square around the origin in which its centre is held, None for no limit.
    """

    name: str
    count: int
    radius: float
    movable: bool = False
    collides: bool = True
    accel: float = 1.0
    max_speed: float | None = None
    limit: float | None = None

    def __post_init__(self) -> None:
        for name, legal in _LEGAL.items():
            object.__setattr__(self, name, check_value(getattr(self, name), legal, name, "Bodies"))


_Positive = Annotated[float, Range(0.0, 1e6, exclusive=True)]
_NonNegative = Annotated[float, Range(0.0, 1e6)]
_LEGAL: dict[str, Any] = {
    "name": str,
    "count": Annotated[int, Range(0)],
    "radius": _Positive,
    "movable": bool,
    "collides": bool,
    "accel": _NonNegative,
    "max_speed": _NonNegative | None,
    "limit": _Positive | None,
}


def checked_bodies(bodies: Any, owner: str) -> Sequence[Bodies]:
    """Return what a scenario has as its bodies, or raise a ValueError unless they are a list of groups with names."""
    if not isinstance(bodies, Sequence) or not bodies or not all(isinstance(group, Bodies) for group in bodies):
        raise ValueError(f"{owner}.bodies() returns {bodies!r}; legal: a list of Bodies, those that act first")
    names, count = [group.name for group in bodies], sum(group.count for group in bodies)
    if len(set(names)) < len(names):
        raise ValueError(f"{owner}.bodies() returns groups {names}; legal are different names")
    if count > MOST_BODIES:  # there are arrays of all pairs
        raise ValueError(f"{owner}.bodies() returns {count} bodies; legal: up to {MOST_BODIES}")
    return bodies


@dataclass(frozen=True)
class Wall:
    """A half-plane: bodies stay where `normal . p <= offset`.

    Args:
        normal: Unit vector that points out of the arena.
        offset: Distance of the wall from the origin along the normal.
    """

    normal: tuple[float, float]
    offset: float


@dataclass(frozen=True)
class Physics:
    """Constants of the contact and motion model.

    Args:
        dt: Seconds per step.
        damping: Share of the velocity lost per step.
        contact_force: Contact stiffness.
        contact_margin: Width of the soft edge of a body.
        mass: Mass of every movable body.
        substeps: Integration steps per step.
    """

    dt: float = 0.1
    damping: float = 0.25
    contact_force: float = 100.0
    contact_margin: float = 1e-3
    mass: float = 1.0
    substeps: int = 1


PHYSICS: dict[str, Physics] = {
    "mpe": Physics(),
    # Stiffer, in shorter steps: bodies that in "mpe" pass through each other bounce; see `_solid` for fast ones.
    "solid": Physics(contact_force=500.0, substeps=5),
}


def _solid(groups: Sequence[Bodies]) -> Physics:
    """The solid physics, made stiffer where bodies are so fast and small that it would not stop them.

    Two bodies that meet head-on must stop before their centres do: while these close in from r to 0, each moves r / 2,
    and the contact force takes k r^2 / 4 from it. That must be more than the m v^2 / 2 it brings along at top speed;
    half as much again is for the thrust that goes on. More steps keep a stiffer contact stable.
    """
    physics = PHYSICS["solid"]
    moving = [group for group in groups if group.movable and group.collides]
    # Where full diagonal thrust and damping are in balance, or at the speed limit.
    speeds = [math.sqrt(2.0) * g.accel * physics.dt / physics.damping / physics.mass for g in moving]
    speeds = [min(s, math.inf if g.max_speed is None else g.max_speed) for s, g in zip(speeds, moving, strict=True)]
    if not moving or max(speeds) == 0.0:
        return physics
    contact = min(g.radius for g in moving) + min(g.radius for g in groups if g.collides)
    needed = 1.5 * physics.mass * min(2.0 * max(speeds) / contact, 1e100) ** 2 / 2.0
    stiffer = max(1.0, needed / physics.contact_force)
    if not stiffer <= _STIFFEST:
        raise ValueError(
            f"physics='solid' can't stop bodies that are so fast ({max(speeds):g}) and so small (a contact at "
            f"{contact:g}): make them slower (max_speed) or larger, or use physics='mpe'"
        )
    return replace(
        physics,
        contact_force=physics.contact_force * stiffer,
        substeps=math.ceil(physics.substeps * math.sqrt(stiffer)),
    )


class World:
    """E independent copies of a world of K discs.

    Bodies are numbered in the order of the groups; movable groups come first. M is the number of movable
    bodies, C the number of bodies up to the last one that collides, W the number of walls.

    Attributes:
        position: (E, K, 2), writable at any time.
        velocity: (E, K, 2), writable at any time; that of bodies that do not move is ignored.
        index: Slice of the bodies of each group, by name.
        offset: (E, M, K, 2), position of each body relative to each movable one.
        distance: (E, M, K), between centres.
        gap: (E, M, C), between surfaces: negative in contact, +inf to itself and to what it cannot touch.
        wall_gap: (E, M, W), between the surface of a body and the wall.

    `offset`, `distance`, `gap` and `wall_gap` are overwritten by the next step. They follow a write to
    `position` at the next `refresh()`, which stepping and observing call.

    Args:
        num_envs: E.
        groups: The bodies.
        walls: Half-planes that keep movable bodies in.
        physics: "mpe", or "solid" (stiffer contacts, five substeps).
        integrator: "semi_implicit" (velocity first, as in the original MPE; stable in contact) or "explicit"
            (position first, as in MPE2; only to compare with it).
    """

    def __init__(
        self,
        num_envs: int,
        groups: Sequence[Bodies],
        walls: Sequence[Wall] = (),
        physics: Literal["mpe", "solid"] = "mpe",
        integrator: Literal["semi_implicit", "explicit"] = "semi_implicit",
    ) -> None:
        movable = [group.movable for group in groups]
        if movable != sorted(movable, reverse=True):
            raise ValueError(f"movable groups come first; got {[g.name for g in groups]} with movable={movable}")
        self.num_envs = num_envs
        self.groups = tuple(groups)
        self.walls = tuple(walls)
        self.physics = _solid(self.groups) if physics == "solid" else PHYSICS[physics]
        self.integrator = integrator

        ends = np.cumsum([group.count for group in groups]).tolist()
        self.index = {g.name: slice(end - g.count, end) for g, end in zip(groups, ends, strict=True)}
        self.num_bodies: int = ends[-1]
        self.num_movers = sum(g.count for g in groups if g.movable)
        self.body_names = [f"{g.name}_{i}" for g in groups for i in range(g.count)]

        counts = [g.count for g in groups]
        self.radius = np.repeat([g.radius for g in groups], counts)
        caps = [np.inf if g.max_speed is None else g.max_speed for g in groups if g.movable]
        self._max_speed = np.repeat(caps, [g.count for g in groups if g.movable])
        self._capped = bool(np.isfinite(self._max_speed).any())
        limits = [np.inf if g.limit is None else g.limit for g in groups if g.movable]
        self._limit = np.repeat(limits, [g.count for g in groups if g.movable])[:, None]
        self._limited = bool(np.isfinite(self._limit).any())
        self._group_of = np.repeat(np.arange(len(groups)), counts)
        collides = np.repeat([g.collides for g in groups], counts)
        num_colliders = int(np.flatnonzero(collides).max(initial=-1)) + 1
        touch = self.radius[: self.num_movers, None] + self.radius[:num_colliders]
        touch[~(collides[: self.num_movers, None] & collides[:num_colliders])] = -np.inf
        np.fill_diagonal(touch, -np.inf)
        self._touch = touch  # (M, C), distance of the centres in contact
        self._normals = np.array([w.normal for w in walls]).reshape(-1, 2)
        self._wall_offsets = np.array([w.offset for w in walls])

        self._position: FloatArray = np.zeros((num_envs, self.num_bodies, 2))
        self._velocity: FloatArray = np.zeros((num_envs, self.num_bodies, 2))
        self._seen = np.full_like(self._position, np.nan)
        self._offset = np.empty((num_envs, self.num_movers, self.num_bodies), np.complex128)
        self._scratch = np.empty((num_envs, self.num_movers, self.num_bodies))
        self.distance = np.empty_like(self._scratch)
        self.gap = np.empty((num_envs, self.num_movers, num_colliders))
        self.wall_gap = np.empty((num_envs, self.num_movers, len(walls)))
        self._near: NDArray[np.intp] = np.empty(0, np.intp)
        self._contacts: NDArray[np.intp] | None = None
        self.refresh()

    @property
    def position(self) -> FloatArray:
        """(E, K, 2), writable in place and by assignment, which copies."""
        return self._position

    @position.setter
    def position(self, value: ArrayLike) -> None:
        self._position[...] = value

    @property
    def velocity(self) -> FloatArray:
        """(E, K, 2), writable in place and by assignment, which copies."""
        return self._velocity

    @velocity.setter
    def velocity(self, value: ArrayLike) -> None:
        self._velocity[...] = value

    @property
    def offset(self) -> FloatArray:
        """(E, M, K, 2), position of each body relative to each movable one."""
        return self._offset.view(np.float64).reshape(*self._offset.shape, 2)

    def refresh(self) -> None:
        """Bring distances up to date, if a position has changed since they were computed."""
        if not np.array_equal(self._seen, self.position):
            self._measure()

    def contacts(self, group: str) -> NDArray[np.intp]:
        """Count the bodies of a group that touch each movable body now.

        Args:
            group: Name of the group.

        Returns:
            (E, M) counts, without self-contact.
        """
        if self._contacts is None:
            num_groups = len(self.groups)
            mover, other = np.divmod(self._near, self.gap.shape[-1])
            touching = self.gap.reshape(-1)[self._near] < 0.0
            bins = (mover * num_groups + self._group_of[other])[touching]
            counts = np.bincount(bins, minlength=self.num_envs * self.num_movers * num_groups)
            self._contacts = counts.reshape(self.num_envs, self.num_movers, num_groups)
        return self._contacts[..., [g.name for g in self.groups].index(group)]

    def wall_contacts(self) -> NDArray[np.intp]:
        """Count the walls that each movable body touches now: (E, M)."""
        return np.count_nonzero(self.wall_gap < 0.0, axis=-1)

    def step(self, control: FloatArray) -> None:
        """Move all copies by one step.

        Args:
            control: (E, M, 2) forces of the bodies on themselves.
        """
        self.refresh()
        physics, m = self.physics, self.num_movers
        dt = physics.dt / physics.substeps
        position, velocity = self.position[:, :m], self.velocity[:, :m]
        for substep in range(physics.substeps):
            force = self._add_contact_forces(control)
            if self.integrator == "explicit":
                position += velocity * dt
            if substep == 0:
                velocity *= 1.0 - physics.damping
            velocity += force * (dt / physics.mass)
            if self._capped:
                speed = np.sqrt(velocity[..., 0] ** 2 + velocity[..., 1] ** 2)
                velocity *= np.minimum(1.0, self._max_speed / np.maximum(speed, 1e-12))[..., None]
            if self.integrator == "semi_implicit":
                position += velocity * dt
            if self.walls:
                self._stop_at_walls(position, velocity)
            if self._limited:
                self._stop_at_limits(position, velocity)
            self._measure()

    def _measure(self) -> None:
        """Compute offsets, distances and gaps from the positions."""
        # One complex number per point: NumPy subtracts (x, y) pairs an order of magnitude faster this way.
        points = self.position.view(np.complex128)[..., 0]
        np.subtract(points[:, None, :], points[:, : self.num_movers, None], out=self._offset)
        # sqrt(x*x + y*y) rounds alike on every machine, hypot does not.
        np.multiply(self._offset.real, self._offset.real, out=self.distance)
        np.multiply(self._offset.imag, self._offset.imag, out=self._scratch)
        np.add(self.distance, self._scratch, out=self.distance)
        np.sqrt(self.distance, out=self.distance)
        np.subtract(self.distance[..., : self.gap.shape[-1]], self._touch, out=self.gap)
        self._near = np.flatnonzero(self.gap < _REACH)
        self._contacts = None
        if self.walls:
            m = self.num_movers
            along = self.position[:, :m, None, :] * self._normals
            inside = self._wall_offsets - (along[..., 0] + along[..., 1])
            np.subtract(inside, self.radius[:m, None], out=self.wall_gap)
        np.copyto(self._seen, self.position)

    def _penetration(self, gap: FloatArray) -> FloatArray:
        """Soft depth of a contact: margin * log(1 + exp(-gap / margin)), which cannot overflow."""
        margin = self.physics.contact_margin
        return np.logaddexp(0.0, -gap / margin) * margin

    def _add_contact_forces(self, control: FloatArray) -> FloatArray:
        """Return (E, M, 2) control plus the forces of bodies and walls."""
        force = control
        if self._near.size:
            # Each pair of movable bodies is listed from both sides, so forces come out equal and opposite.
            mover, other = np.divmod(self._near, self.gap.shape[-1])
            push = -self._offset.reshape(-1, self.num_bodies)[mover, other]
            distance = self.distance.reshape(-1, self.num_bodies)[mover, other]
            # Coincident bodies have no direction of contact: part them along x.
            coincident = np.where(mover % self.num_movers < other, 1.0, -1.0)
            direction = np.where(distance > 0.0, push / np.maximum(distance, 1e-300), coincident)
            depth = self._penetration(self.gap.reshape(-1)[self._near])
            push = direction * (self.physics.contact_force * depth)
            size = self.num_envs * self.num_movers
            total = np.stack([np.bincount(mover, part, size) for part in (push.real, push.imag)], axis=-1)
            force = force + total.reshape(control.shape)
        if self.walls and (self.wall_gap < _REACH).any():
            depth = np.where(self.wall_gap < _REACH, self._penetration(self.wall_gap), 0.0)
            for w, normal in enumerate(self._normals):
                force = force - self.physics.contact_force * depth[..., w, None] * normal
        return force

    def _stop_at_walls(self, position: FloatArray, velocity: FloatArray) -> None:
        """Keep centres inside the walls and take the outward velocity of those that hit one."""
        for normal, offset in zip(self._normals, self._wall_offsets, strict=True):
            beyond = position[..., 0] * normal[0] + position[..., 1] * normal[1] - offset
            if (beyond > 0.0).any():
                position -= np.maximum(beyond, 0.0)[..., None] * normal
                outward = velocity[..., 0] * normal[0] + velocity[..., 1] * normal[1]
                velocity -= np.where(beyond > 0.0, np.maximum(outward, 0.0), 0.0)[..., None] * normal

    def _stop_at_limits(self, position: FloatArray, velocity: FloatArray) -> None:
        """Keep the centres of bodies with a limit in their square, and take the outward velocity at its edge."""
        beyond = np.abs(position) > self._limit
        if beyond.any():
            np.clip(position, -self._limit, self._limit, out=position)
            velocity[beyond & (velocity * position > 0.0)] = 0.0
