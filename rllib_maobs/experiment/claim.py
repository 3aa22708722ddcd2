"""A results folder belongs to one run at a time."""

import contextlib
import os
import socket
import time
from pathlib import Path
from typing import TextIO

try:
    import fcntl
except ImportError:  # Windows has no such locks: there nothing keeps two runs apart
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"
"""The file that is locked. That it is there means nothing: the lock goes with the process, however that ends."""


def claim(folder: Path) -> TextIO:
    """Make a results folder where there is none, and claim it for this process.

    Args:
        folder: The folder.

    Returns:
        An open file; while it is open, the folder is this run's.

    Raises:
        ValueError: If the folder cannot be written, or another run has claimed it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("a+")
    except OSError as error:
        raise ValueError(
            f"--results-dir: {folder} cannot be written ({error.strerror}): choose a folder that can"
        ) from None
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip()
            file.close()
            raise ValueError(
                f"--results-dir: {folder} is in use by another run ({holder}): let it end, or choose another "
                f"--results-dir"
            ) from None
        except OSError:  # some network file systems have no locks
            return file
    with contextlib.suppress(OSError):  # for the message above only
        file.truncate(0)
        print(f"process {os.getpid()} on {socket.gethostname()}", file=file, flush=True)
    return file


def hold(folder: Path) -> TextIO | None:
    """Mark a trial's folder as one that this process writes to.

    Args:
        folder: The folder.

    Returns:
        An open file; while it is open, the folder is marked. None where there are no locks.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("a")
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return None
    return file


def wait_until_free(folder: Path, seconds: float) -> bool:
    """Wait until no process holds a trial's folder: those of a killed run end a few seconds after it.

    Args:
        folder: The folder.
        seconds: How long to wait.

    Returns:
        Whether it is free.
    """
    deadline = time.monotonic() + seconds
    while fcntl is not None and (folder / LOCK).exists():
        with (folder / LOCK).open("a") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return True
            except BlockingIOError:
                if time.monotonic() > deadline:
                    return False
            except OSError:  # some network file systems have no locks
                return True
        time.sleep(0.1)
    return True
