"""Random start positions in which bodies do not overlap."""

from collections.abc import Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from rllib_maobs.envs.world import FloatArray

# A stuck layout starts anew after this many rounds; easy layouts need about ten.
_ROUNDS_PER_LAYOUT = 100
_LAYOUTS = 30


class Placement:
    """Uniform positions, redrawn until the bodies of each exclusive set keep apart.

    Each copy draws only from its own generator, so its layout does not depend on how many copies there are.

    Args:
        names: Name of each of the K bodies, for messages.
        half_width: (K,) bodies are drawn in the square [-half_width, half_width]^2; with 0 they have a fixed place.
        room: (K,) radius that each body keeps free around it.
        clearance: Extra distance between two bodies.
        exclusive: Sets of body numbers; bodies of one set do not overlap. None at all: no check.
        centre: (K, 2) of the squares; None for the origin.

    Raises:
        ValueError: If a set needs more area than there is.
    """

    def __init__(
        self,
        names: Sequence[str],
        half_width: ArrayLike,
        room: ArrayLike,
        clearance: float = 0.0,
        exclusive: Sequence[Sequence[int]] = (),
        centre: ArrayLike | None = None,
    ) -> None:
        self.names = list(names)
        self._centre = None if centre is None else np.asarray(centre, np.float64)
        self.half_width: FloatArray = np.asarray(half_width, np.float64)
        self.room: FloatArray = np.asarray(room, np.float64)
        separation = np.zeros((len(self.names), len(self.names)))
        for members in exclusive:
            each = np.asarray(members, np.intp)
            separation[np.ix_(each, each)] = self.room[each, None] + self.room[each] + clearance
            if centre is None:
                self._check_area(each, clearance)
        np.fill_diagonal(separation, 0.0)
        self._separation = separation
        # Of two bodies that overlap the later one is drawn again, but never one with a fixed place.
        self._rank = np.where(self.half_width > 0.0, np.arange(len(self.names)), -1)

    def sample(self, rngs: Sequence[Generator]) -> FloatArray:
        """Draw one layout per generator.

        Args:
            rngs: One generator per copy.

        Returns:
            (len(rngs), K, 2) positions.

        Raises:
            ValueError: If no layout is found; names the bodies and the overlap that is left.
        """
        num_bodies = len(self.names)
        position = np.empty((len(rngs), num_bodies, 2))
        redraw = np.ones((len(rngs), num_bodies), bool)
        active = np.arange(len(rngs))
        for attempt in range(1, _ROUNDS_PER_LAYOUT * _LAYOUTS + 1):
            draw = np.empty((len(active), num_bodies, 2))
            for row, copy in enumerate(active.tolist()):
                rngs[copy].random(out=draw[row])
            draw = (2.0 * draw - 1.0) * self.half_width[:, None]
            if self._centre is not None:
                draw += self._centre
            current = np.where(redraw[active, :, None], draw, position[active])
            position[active] = current
            overlaps = self._losers(current, redraw[active])
            redraw[active] = overlaps
            active = active[overlaps.any(axis=-1)]
            if not active.size:
                return position
            if attempt % _ROUNDS_PER_LAYOUT == 0:
                redraw[active] = True
        raise ValueError(self._describe_failure(position[active[0]]))

    def _losers(self, position: FloatArray, moved: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which bodies must move on: of two that overlap the later one, so that every round settles one.

        Args:
            position: (n, K, 2).
            moved: (n, K), the bodies that moved since the others were found to be apart.

        Returns:
            (n, K).
        """
        copy, body = np.nonzero(moved)
        points = position.view(np.complex128)[..., 0]
        offset = points[copy]
        offset -= points[copy, body, None]
        squared = offset.real**2
        squared += offset.imag**2
        pair, other = np.nonzero(squared < self._separation[body] ** 2)
        losers = np.zeros(moved.shape, bool)
        first = body[pair]
        losers[copy[pair], np.where(self._rank[first] > self._rank[other], first, other)] = True
        return losers

    @staticmethod
    def _distances(position: FloatArray) -> FloatArray:
        """(n, K, 2) positions to (n, K, K) distances."""
        x, y = position[..., 0], position[..., 1]
        dx, dy = x[:, :, None] - x[:, None], y[:, :, None] - y[:, None]
        return np.sqrt(dx * dx + dy * dy)

    def _check_area(self, members: NDArray[np.intp], clearance: float) -> None:
        room = self.room[members] + clearance / 2.0
        needed = float(np.sum(np.pi * room**2))
        # Discs stick out of the square in which their centres lie.
        offered = float((2.0 * np.max(self.half_width[members] + room)) ** 2)
        if needed > offered:
            raise ValueError(
                f"{self.names[members[0]]} .. {self.names[members[-1]]} ({len(members)} bodies) do not fit: "
                f"they need an area of {needed:.2f}, there is {offered:.2f} "
                f"({needed - offered:.2f} missing); use fewer or smaller bodies, or a larger range"
            )

    def _describe_failure(self, position: FloatArray) -> str:
        missing = self._separation - self._distances(position[None])[0]
        body, other = np.unravel_index(int(np.argmax(missing)), missing.shape)
        return (
            f"no layout found in {_ROUNDS_PER_LAYOUT * _LAYOUTS} draws: in the last one "
            f"{self.names[body]} is {missing[body, other]:.3f} too close to {self.names[other]}; "
            f"use fewer or smaller bodies, a larger range, or placement='mpe'"
        )


class FixedLayout:
    """The same positions in every episode, but for optional noise of the first bodies.

    Args:
        names: Name of each of the K bodies, for messages.
        position: (K, 2).
        room: (K,) radius that each body keeps free around it.
        exclusive: Sets of body numbers; bodies of one set do not overlap.
        noise: Bodies start uniformly within this distance of their place, along x and along y; those that would
            overlap are drawn again.
        num_noisy: How many bodies, from the first, the noise moves.

    Raises:
        ValueError: If bodies of a set overlap; names them and the missing room.
    """

    def __init__(
        self,
        names: Sequence[str],
        position: ArrayLike,
        room: ArrayLike,
        exclusive: Sequence[Sequence[int]] = (),
        noise: float = 0.0,
        num_noisy: int = 0,
    ) -> None:
        self.position: FloatArray = np.asarray(position, np.float64)
        distance, radius = Placement._distances(self.position[None])[0], np.asarray(room, np.float64)
        for members in exclusive:
            for k, first in enumerate(members):
                for second in members[k + 1 :]:
                    missing = radius[first] + radius[second] - distance[first, second]
                    if missing > 1e-9:
                        raise ValueError(
                            f"{names[first]} and {names[second]} do not fit: {missing:.3f} of room is missing between "
                            f"them; use smaller bodies, or wider spacing"
                        )
        half_width = np.where(np.arange(len(names)) < num_noisy, noise, 0.0)
        self._noisy = Placement(names, half_width, room, 0.0, exclusive, self.position) if noise > 0.0 else None

    def sample(self, rngs: Sequence[Generator]) -> FloatArray:
        """Return one layout per generator.

        Args:
            rngs: One generator per copy; used only if there is noise.

        Returns:
            (len(rngs), K, 2) positions.
        """
        if self._noisy is not None:
            return self._noisy.sample(rngs)
        return np.tile(self.position, (len(rngs), 1, 1))
