"""A time limit for calls into environments of users, which may hang."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def check_time_limits() -> None:
    """Raises a ValueError where there are none.

    They interrupt by a signal, which Python hands to the main thread. That is where Ray's actors work, too.
    """
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        raise ValueError(
            "env_timeout_s needs signals: the main thread of a process, on Linux or macOS. Leave it out, or sample in "
            "other processes (num_env_runners)."
        )


@contextmanager
def time_limit(seconds: float, say: Callable[[], str]) -> Iterator[None]:
    """Interrupts what takes longer by a TimeoutError.

    A call that waits (for a socket, a lock, a process) or computes in Python is interrupted at once; one into code that
    does not come back to Python is not.

    Args:
        seconds: The limit. Whoever catches the error and goes on gets another one after as long.
        say: The error's message.

    Raises:
        TimeoutError: In the middle of what is done.
    """
    armed = True

    def ring(*_: Any) -> None:
        if armed:
            raise TimeoutError(say())

    before = signal.signal(signal.SIGALRM, ring)
    try:
        signal.setitimer(signal.ITIMER_REAL, seconds, seconds)
        try:
            yield
        finally:
            armed = False
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
