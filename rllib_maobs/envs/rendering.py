"""Pictures of a running environment: a fixed camera, everything to scale, nothing but pygame needed.

Pictures are drawn off screen at twice the size and scaled down, so they look the same with and without a display.
"""

import os
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rllib_maobs.envs.scenario import Scenario
from rllib_maobs.envs.world import FloatArray, World

RENDER_MODES = ("human", "rgb_array")
FRAMES_PER_SECOND = 10  # the speed of the simulated time
Frame = NDArray[np.uint8]
Color = tuple[int, int, int]

_BACKGROUND, _SOLID, _TARGET, _INK = (250, 249, 246), (92, 98, 107), (150, 156, 166), (40, 42, 46)
_FLASH, _PREY = (230, 30, 30), (56, 160, 74)
_TEAM: list[Color] = [
    (66, 114, 196),
    (222, 135, 46),
    (139, 95, 184),
    (35, 160, 165),
    (196, 86, 140),
    (140, 104, 72),
    (104, 132, 40),
    (84, 96, 150),
    (190, 160, 30),
]
_SAMPLES = 2  # pixels drawn per pixel shown, along x and along y
_TRAIL = 25  # steps
_FLASH_STEPS = 3
_SECONDS_OF_VELOCITY = 0.2  # the mark ends where the body would be then


def import_pygame() -> Any:
    """Return pygame, quietly.

    Raises:
        ImportError: If it is not installed; says how to.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ImportError as error:
        raise ImportError('pictures need pygame: pip install -c constraints.txt -e ".[render]"') from error
    return pygame


def has_display() -> bool:
    """Whether a window would be seen: without a display, pygame draws it where nobody looks.

    A driver that `SDL_VIDEODRIVER` names is taken as meant.
    """
    pygame = import_pygame()
    if os.environ.get("SDL_VIDEODRIVER"):
        return True
    try:
        pygame.display.init()
        return str(pygame.display.get_driver()) not in ("offscreen", "dummy")
    except pygame.error:
        return False
    finally:
        pygame.display.quit()


def check_render_mode(mode: str | None) -> None:
    """Raise a ValueError for an unknown mode, and an ImportError if pictures cannot be drawn."""
    if mode is None:
        return
    if not isinstance(mode, str) or mode not in RENDER_MODES:
        raise ValueError(f"render_mode={mode!r} is illegal; legal: {', '.join(map(repr, RENDER_MODES))} or None")
    import_pygame()


class Renderer:
    """Draws one copy of a scenario.

    Discs are bodies and rings are targets, to scale; a line shows the velocity of a body, as far as it gets in two
    steps; a trail shows where it was in the last 25; what touches flashes red for three. Walls and obstacles are
    grey. The camera shows the rectangle of `Scenario.view` and never moves: an agent outside is a small disc at the
    border.

    Args:
        scenario: The task.
        world: Its physics, of which copy 0 is drawn.
        size: Pixels of the longer side of the picture.
    """

    def __init__(self, scenario: Scenario[Any], world: World, size: int = 480) -> None:
        self.half_width, self.half_height = scenario.view()
        self._scale = size / (2.0 * max(self.half_width, self.half_height))
        # Even, as video codecs want it.
        self.width = 2 * round(self.half_width * self._scale)
        self.height = 2 * round(self.half_height * self._scale)
        self._paired = scenario.own_targets
        self._goal_radius = float(getattr(scenario.options, "goal_radius", 0.0))
        self._world = world
        self._trail: deque[FloatArray] = deque(maxlen=_TRAIL)
        self._flash = np.zeros(world.num_bodies, np.int64)
        self._steps = 0
        self._window: Any = None
        self._clock: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_window": None, "_clock": None}

    def begin(self) -> None:
        """Start an episode: forget trails and flashes."""
        self._trail.clear()
        self._trail.append(self._world.position[0, : self._world.num_movers].copy())
        self._flash[:] = 0
        self._steps = 0

    def note_step(self) -> None:
        """Take in the step that was just made."""
        world = self._world
        self._trail.append(world.position[0, : world.num_movers].copy())
        self._steps += 1
        self._flash = np.maximum(self._flash - 1, 0)
        touching = world.gap[0] < 0.0  # (M, C)
        self._flash[: world.num_movers][touching.any(axis=1) | (world.wall_gap[0] < 0.0).any(axis=1)] = _FLASH_STEPS
        self._flash[: touching.shape[1]][touching.any(axis=0)] = _FLASH_STEPS

    def frame(self) -> Frame:
        """Return the picture of the present situation: (height, width, 3)."""
        pygame = import_pygame()
        canvas = pygame.Surface((self.width * _SAMPLES, self.height * _SAMPLES), depth=32)
        canvas.fill(_BACKGROUND)
        self._draw(pygame, canvas)
        small = pygame.transform.smoothscale(canvas, (self.width, self.height))
        pixels: Frame = pygame.surfarray.array3d(small).transpose(1, 0, 2).copy()
        return pixels

    def show(self, frames_per_second: int) -> None:
        """Show the present situation in a window, no faster than the given rate."""
        pygame = import_pygame()
        if self._window is None:
            pygame.display.init()
            pygame.display.set_caption("rllib-maobs")
            self._window, self._clock = pygame.display.set_mode((self.width, self.height)), pygame.time.Clock()
        pygame.event.pump()
        pygame.surfarray.blit_array(self._window, self.frame().transpose(1, 0, 2))
        pygame.display.flip()
        self._clock.tick(frames_per_second)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            import_pygame().display.quit()
            self._window = None

    def _pixel(self, point: FloatArray) -> tuple[float, float]:
        """Return where a point of the world is on the canvas; y points up in the world and down there."""
        scale = self._scale * _SAMPLES
        return (point[0] + self.half_width) * scale, (self.half_height - point[1]) * scale

    def _draw(self, pygame: Any, canvas: Any) -> None:
        world, scale = self._world, self._scale * _SAMPLES
        goal_radius = max(self._goal_radius * scale, 4.0 * _SAMPLES)
        for wall in world.walls:
            pygame.draw.polygon(canvas, _SOLID, self._wall_polygon(np.array(wall.normal), wall.offset))
        colors = self._colors()
        targets = range(world.num_bodies)[world.index.get("target", slice(0, 0))]
        for k in targets:
            pygame.draw.circle(canvas, colors[k], self._pixel(world.position[0, k]), goal_radius, 2 * _SAMPLES)
        for k in set(range(world.num_movers, world.num_bodies)).difference(targets):
            center, radius = self._pixel(world.position[0, k]), world.radius[k] * scale
            pygame.draw.circle(canvas, colors[k], center, radius)
            self._draw_flash(pygame, canvas, k, center, radius)
        self._draw_trails(pygame, canvas, colors)
        edge = np.array([self.half_width, self.half_height])
        for k in range(world.num_movers):
            position = world.position[0, k]
            inside = bool((np.abs(position) < edge).all())
            center = self._pixel(np.clip(position, -edge, edge))
            radius = world.radius[k] * scale * (1.0 if inside else 0.5)
            pygame.draw.circle(canvas, colors[k], center, radius)
            tip = self._pixel(position + _SECONDS_OF_VELOCITY * world.velocity[0, k])
            if inside:
                pygame.draw.line(canvas, _INK, center, tip, 2 * _SAMPLES)
            self._draw_flash(pygame, canvas, k, center, radius)
        for k in targets:  # above the agents that cover them
            center = self._pixel(world.position[0, k])
            pygame.draw.circle(canvas, _BACKGROUND, center, 5 * _SAMPLES)
            pygame.draw.circle(canvas, colors[k], center, 3 * _SAMPLES)
        pygame.font.init()
        font = pygame.font.Font(None, 20 * _SAMPLES)
        canvas.blit(font.render(f"step {self._steps}", True, _INK, _BACKGROUND), (8 * _SAMPLES, 8 * _SAMPLES))

    def _draw_flash(self, pygame: Any, canvas: Any, body: int, center: tuple[float, float], radius: float) -> None:
        if self._flash[body]:
            width = (1 + int(self._flash[body])) * _SAMPLES
            pygame.draw.circle(canvas, _FLASH, center, radius + width / 2.0, width)

    def _draw_trails(self, pygame: Any, canvas: Any, colors: list[Color]) -> None:
        for age in range(len(self._trail) - 1, 0, -1):
            before, after = self._trail[-1 - age], self._trail[-age]
            strength = 0.7 * (1.0 - age / _TRAIL)
            for k in range(self._world.num_movers):
                mixed = [round(b + strength * (c - b)) for b, c in zip(_BACKGROUND, colors[k], strict=True)]
                pygame.draw.line(canvas, mixed, self._pixel(before[k]), self._pixel(after[k]), 2 * _SAMPLES)

    def _colors(self) -> list[Color]:
        """Return the colour of every body; agents differ, and so do targets that belong to one."""
        colors: list[Color] = []
        for g, group in enumerate(self._world.groups):
            team = g == 0 or (group.name == "target" and self._paired)
            other = _PREY if group.movable else _TARGET if group.name == "target" else _SOLID
            colors += [_TEAM[i % len(_TEAM)] if team else other for i in range(group.count)]
        return colors

    def _wall_polygon(self, normal: FloatArray, offset: float) -> list[tuple[float, float]]:
        """Return the corners of the part of the picture behind a wall, and more."""
        along, far = np.array([-normal[1], normal[0]]), 4.0 * (self.half_width + self.half_height)
        corners = [(offset, -far), (offset, far), (offset + far, far), (offset + far, -far)]
        return [self._pixel(out * normal + side * along) for out, side in corners]
