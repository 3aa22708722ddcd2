"""Errors of environments in remote runners, on their way to the caller."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ray import cloudpickle
from ray.exceptions import RayTaskError

# How long a runner may take to say what went wrong; one whose process has crashed says nothing.
_ANSWER_S = 3.0


class EnvError(Exception):
    """An environment's method raised what is the cause of this."""


def portable(error: Exception, where: str) -> Exception:
    """An error as another process can read it: itself, or a RuntimeError that quotes it, with its traceback as a note.

    Args:
        error: The error.
        where: It happened, for the note.
    """
    text = "".join(traceback.format_exception(error))
    try:
        cloudpickle.loads(cloudpickle.dumps(error))
    except Exception:  # it can't be pickled, or can't be made from what its pickle holds
        error = RuntimeError(f"{type(error).__name__}: {error}")
    error.add_note(f"In {where}:\n{text}")
    return error


@contextmanager
def raised_as_themselves(group: Any) -> Iterator[None]:
    """Raises an error that ended a remote runner's `sample()` meanwhile, as itself.

    RLlib takes such a runner out of service, and its own restarts would bring it back to meet the error again. A crash
    of a process is left to them.

    Args:
        group: RLlib's EnvRunnerGroup, or None.

    Raises:
        Exception: The error of the environment.
    """
    healthy = set() if group is None else set(group.healthy_env_runner_ids())
    try:
        yield
    except RayTaskError as error:  # so RLlib hands them on if it neither restarts nor ignores
        raise error.cause from None
    failed = sorted(healthy - set(group.healthy_env_runner_ids())) if healthy else []
    if not failed:
        return
    raise_kept(group, healthy_only=False, remote_worker_ids=failed, timeout_seconds=_ANSWER_S)


def raise_kept(group: Any, **whom: Any) -> None:
    """Raises the first error that a group's remote runners have kept, if one has; `whom` says which are asked."""
    kept = group.foreach_env_runner(lambda runner: runner.error, local_env_runner=False, **whom)
    if errors := [error for error in kept if error is not None]:
        raise errors[0]
