"""Episodes as gif and mp4 files."""

from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from rllib_maobs.envs.rendering import Frame
from rllib_maobs.paths import local

_WRITERS = {".gif": ("PIL.Image",), ".mp4": ("imageio.v2", "imageio_ffmpeg")}


class Recorder:
    """Collects pictures of an environment and writes them to a file when it is closed.

    Example:
    ```python
    env = parallel_env("spread-9a", render_mode="rgb_array")
    with Recorder("episode.gif") as recorder:
        env.reset(seed=0)
        recorder.add(env.render())
        while env.agents:
            env.step(env.heuristic())
            recorder.add(env.render())
    ```

    Args:
        path: Where to write; the name ends in ".gif" or ".mp4". Its folder is made if need be.
        frames_per_second: Speed of the film; 10 is the speed of the simulated time.

    Raises:
        ValueError: If the name ends differently.
        ImportError: If what writes such a file is not installed.
    """

    def __init__(self, path: str | Path, frames_per_second: int = 10) -> None:
        self.path = local(path)
        if self.path.suffix.lower() not in _WRITERS:
            raise ValueError(f"cannot record to {str(path)!r}; legal are names that end in {' or '.join(_WRITERS)}")
        for name in _WRITERS[self.path.suffix.lower()]:
            _import(name)  # rather now than after the episode
        self.frames_per_second = frames_per_second
        self._frames: list[Frame] = []

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()

    def add(self, frame: Frame) -> None:
        """Append a picture, (H, W, 3) uint8, of the size of those before."""
        if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise ValueError('a picture is a uint8 array (H, W, 3), as render() returns with render_mode="rgb_array"')
        if self._frames and frame.shape != self._frames[0].shape:
            raise ValueError(f"pictures must have one size: {self._frames[0].shape} before, now {frame.shape}")
        self._frames.append(frame)

    def close(self) -> None:
        """Write the file.

        Raises:
            ValueError: If there is no picture.
        """
        if not self._frames:
            raise ValueError(f"nothing to write to {self.path}: no picture was added")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.suffix.lower() == ".gif":
            _write_gif(self.path, self._frames, self.frames_per_second)
        else:
            _write_mp4(self.path, self._frames, self.frames_per_second)


def _write_gif(path: Path, frames: list[Frame], frames_per_second: int) -> None:
    image = _import("PIL.Image")
    # One palette for the whole film: pictures then differ only where something moves, and the file stays small.
    sample = np.concatenate(frames[:: max(1, len(frames) // 16)])
    palette = image.fromarray(sample).quantize(64, dither=image.Dither.NONE)
    pictures = [image.fromarray(frame).quantize(palette=palette, dither=image.Dither.NONE) for frame in frames]
    duration = round(1000 / frames_per_second)
    # The last picture stays for a second.
    durations = [duration] * (len(pictures) - 1) + [max(1000, duration)]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations, loop=0, optimize=True)


def _write_mp4(path: Path, frames: Iterable[Frame], frames_per_second: int) -> None:
    imageio = _import("imageio.v2")
    with imageio.get_writer(path, fps=frames_per_second, macro_block_size=2) as writer:
        for frame in frames:
            writer.append_data(frame)


def _import(name: str) -> Any:
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(f'recording needs {name}: pip install -c constraints.txt -e ".[render]"') from error
