"""Checkpoints that are whole: written aside, listed with checksums, renamed into place, and checked before use."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import shutil
import zlib
from collections.abc import Iterator
from pathlib import Path

logger = logging.getLogger(__name__)

CHECKSUMS = "checksums.txt"
"""The list of a folder's files, written last: a line for each, `crc32 size path`, and the crc32 of these lines."""
METADATA = "rllib_checkpoint.json"
"""RLlib's file in every checkpoint of an algorithm. That of a checkpoint with checksums says that it has some."""
# As much as is read at a time.
_CHUNK = 1 << 22


class TornError(ValueError):
    """A checkpoint is torn or damaged, and there is none before it."""


def write_checksums(folder: Path) -> None:
    """Lists all files of a folder with their sizes and checksums, in the folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / CHECKSUMS)
    lines = "".join(
        f"{_checksum(path):08x} {path.stat().st_size} {path.relative_to(folder).as_posix()}\n" for path in files
    )
    aside = folder / f".{CHECKSUMS}"
    aside.write_bytes(f"{lines}{zlib.crc32(lines.encode()):08x}\n".encode())
    aside.replace(folder / CHECKSUMS)


def find_fault(folder: Path) -> str | None:
    """Says what is wrong with a checkpoint: the first file that is missing, of another size or changed.

    Args:
        folder: Of a checkpoint, or another one with checksums. A checkpoint that was saved without any, as RLlib's own
            are, is taken as it is.

    Returns:
        The fault; None if there is none.
    """
    try:
        text = (folder / CHECKSUMS).read_bytes()
    except OSError:
        return _fault_without_checksums(folder)
    lines, last = text[:-9], text[-9:]
    if last != f"{zlib.crc32(lines):08x}\n".encode():
        return f"{CHECKSUMS} is damaged"
    for line in lines.decode().splitlines():
        checksum, size, name = line.split(" ", 2)
        path = folder / name
        if not path.is_file():
            return f"{name} is missing"
        if (found := path.stat().st_size) != int(size):
            return f"{name} has {found:,} bytes instead of {int(size):,}"
        if _checksum(path) != int(checksum, 16):
            return f"{name} has changed since it was saved (another checksum)"
    return None


def _fault_without_checksums(folder: Path) -> str | None:
    try:
        due = json.loads((folder / METADATA).read_bytes()).get("checksums")
    except FileNotFoundError:
        return f"{METADATA} is missing"
    except (OSError, ValueError, AttributeError):
        return f"{METADATA} is damaged"
    return f"{CHECKSUMS} is missing" if due else None


def _checksum(path: Path) -> int:
    checksum = 0
    with path.open("rb", buffering=0) as file:
        while chunk := file.read(_CHUNK):
            checksum = zlib.crc32(chunk, checksum)
    return checksum


def first_whole(*candidates: Path) -> Path:
    """Returns the first checkpoint that is whole, and warns of those before it that are not.

    Args:
        candidates: Folders, the one that is wanted first.

    Raises:
        TornError: If none is whole.
    """
    faults = list[tuple[Path, str]]()
    for folder in candidates:
        if (fault := find_fault(folder)) is None:
            for torn, found in faults:
                logger.warning(
                    f"{str(torn)!r} is no whole checkpoint: {found}. The one before it is used: {str(folder)!r}."
                )
            return folder
        faults.append((folder, fault))
    torn, fault = faults[0]
    others = "; nor is any before it whole" if len(faults) > 1 else ", and there is none before it"
    raise TornError(f"{str(torn)!r} is no whole checkpoint: {fault}{others}.")


def with_those_before(folder: Path) -> list[Path]:
    """Returns a checkpoint's folder and those that may take its place, newest first.

    Those are what was there before it was saved anew, and the earlier ones of a trial.
    """
    before = _before(folder)
    older = [path for path in numbered(folder.parent) if path.name < folder.name] if _is_numbered(folder) else []
    return [folder, *([before] if before.is_dir() else []), *older]


def numbered(trial: Path) -> list[Path]:
    """Returns the folders that Tune has numbered in a trial's folder, newest first."""
    return sorted(filter(_is_numbered, trial.iterdir()), reverse=True) if trial.is_dir() else []


def _is_numbered(path: Path) -> bool:
    return re.fullmatch(r"checkpoint_\d+", path.name) is not None and path.is_dir()


@contextlib.contextmanager
def written_aside(folder: Path) -> Iterator[Path]:
    """Gives a folder aside to write to, which then takes the place of what was there, with checksums.

    At every moment there is either the old or the new one, whole, under the folder's name or, for the time of one
    renaming, under that of `with_those_before`. In a folder that other files are in, too, files are replaced one by one
    and the checksums come last, so one that is half replaced is recognised. If anything fails, the old one stays, and
    nothing half-written.

    Args:
        folder: Where it shall be.
    """
    folder = Path(os.path.realpath(folder))
    alone = not os.path.ismount(folder) and _holds_nothing_else(folder)
    parent = folder.parent if alone else folder
    aside = parent / f".{folder.name}.{os.getpid()}.part"
    shutil.rmtree(aside, ignore_errors=True)
    try:
        aside.mkdir(parents=True)
        yield aside
        write_checksums(aside)
        if alone:
            _exchange(aside, folder)
        else:
            _replace_each(aside, folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _before(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.before")


def _exchange(aside: Path, folder: Path) -> None:
    before = _before(folder)
    if folder.is_dir():
        shutil.rmtree(before, ignore_errors=True)
        folder.rename(before)
    aside.rename(folder)
    shutil.rmtree(before, ignore_errors=True)


def _replace_each(aside: Path, folder: Path) -> None:
    for path in sorted(aside.iterdir(), key=lambda path: path.name == CHECKSUMS):
        target = folder / path.name
        if target.is_dir():
            shutil.rmtree(target)
        path.replace(target)


def _holds_nothing_else(folder: Path) -> bool:
    """Whether a folder is empty, or a checkpoint and nothing but it."""
    if not folder.is_dir():
        return True
    found = {path.name for path in folder.iterdir()}
    try:
        listed = {line.split(" ", 2)[2].split("/")[0] for line in (folder / CHECKSUMS).read_text().splitlines()[:-1]}
    except (OSError, ValueError, IndexError):
        return not found
    return found <= {*listed, CHECKSUMS}
