"""Paths of checkpoints as people write them."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePath
from typing import Any, Self

from ray.rllib.utils.annotations import override
from ray.rllib.utils.checkpoints import Checkpointable


def absolute(path: Any) -> Any:
    """A path as RLlib takes it: absolute, without `~`; URIs ("s3://...") and Tune's checkpoints stay as they are."""
    if not isinstance(path, str | PurePath) or "://" in os.fspath(path):
        return path
    return str(Path(path).expanduser().absolute())


class AnyPath(Checkpointable):
    """Lets a Checkpointable be saved to, and restored from, relative paths: RLlib takes those for URIs."""

    @override(Checkpointable)
    def save_to_path(self, path: Any = None, **kwargs: Any) -> str:
        """RLlib's; returns the path."""
        saved: str = super().save_to_path(_local(path, kwargs), **kwargs)
        return saved

    @override(Checkpointable)
    def restore_from_path(self, path: Any, **kwargs: Any) -> None:
        """RLlib's."""
        super().restore_from_path(_local(path, kwargs), **kwargs)

    @classmethod
    @override(Checkpointable)
    def from_checkpoint(cls, path: Any, filesystem: Any = None, **kwargs: Any) -> Self:
        """RLlib's."""
        made: Self = super().from_checkpoint(path if filesystem else absolute(path), filesystem=filesystem, **kwargs)
        return made


def _local(path: Any, given: dict[str, Any]) -> Any:
    """With a filesystem a path is that filesystem's own."""
    return path if given.get("filesystem") else absolute(path)


def local(path: Any) -> Path:
    """A path of this machine, as people write it.

    Raises:
        ValueError: If it is none.
    """
    try:
        found = Path(path).expanduser()
        os.stat(found)
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        pass
    except (TypeError, ValueError, OSError, RuntimeError) as error:  # such as NUL, a name too long, an unknown ~user
        raise ValueError(f"{path!r} is no path of a file or folder: {error}") from None
    return found


def file_name(name: str) -> str:
    """A file's name made of one from outside, such as an agent's: it names no other folder, and no hidden file."""
    return re.sub(r"[^\w.+-]", "_", name).lstrip(".")[:100] or "_"


def write_aside(path: Path, content: bytes) -> None:
    """Writes a file aside and renames it: nothing half-written is ever there under its name.

    Raises:
        ValueError: If it can't be written, e.g. for want of space.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        aside.write_bytes(content)
        aside.replace(path)
    except OSError as error:
        raise ValueError(f"{path} can't be written: {error.strerror}") from error
    finally:
        aside.unlink(missing_ok=True)
