"""Environments in the middle of their episodes as bytes, if they come back from them as they were."""

from __future__ import annotations

import io
import pickle
from copyreg import __newobj__  # type: ignore[attr-defined]
from typing import Any

import numpy as np
import torch
from gymnasium.utils import EzPickle

from rllib_maobs.envs.team import JointEnv


def snapshot(env: JointEnv) -> bytes | None:
    """An environment in the middle of its episodes, or None if it cannot be continued exactly from the bytes.

    Many environments pickle as the arguments that made them (`EzPickle`: all of mpe2), which would begin anew in the
    place of an episode. Of these everything is saved instead. Whatever is saved is read back and compared: numbers,
    arrays, texts and generators of random numbers that do not come back as they were make it None.
    """
    try:
        with io.BytesIO() as file:
            _Whole(file).dump(env)
            saved = file.getvalue()
        return saved if _same(env, pickle.loads(saved), set()) else None
    except Exception:  # whatever the environment's own classes raise
        return None


class _Whole(pickle.Pickler):
    """Pickles what an `EzPickle` object has become, instead of what made it."""

    def reducer_override(self, obj: Any) -> Any:
        if not isinstance(obj, EzPickle):
            return NotImplemented
        return __newobj__, (type(obj),), vars(obj), None, None, _set_state


def _set_state(obj: Any, state: dict[str, Any]) -> None:
    vars(obj).update(state)


def _same(a: Any, b: Any, seen: set[tuple[int, int]]) -> bool:
    """Whether what has numbers in it has the same ones; what cannot be looked into is taken to be the same."""
    if a is b or (id(a), id(b)) in seen:
        return True
    if type(a) is not type(b):
        return False
    if isinstance(a, int | float | complex | str | bytes | np.generic):
        return bool(a == b or (a != a and b != b))
    seen.add((id(a), id(b)))
    if isinstance(a, np.ndarray) and a.dtype != object:
        return np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, np.random.Generator):
        return _same(a.bit_generator.state, b.bit_generator.state, set())
    if isinstance(a, np.random.RandomState):
        return _same(a.get_state(), b.get_state(), set())
    if isinstance(a, dict):
        return list(a) == list(b) and all(_same(x, y, seen) for x, y in zip(a.values(), b.values(), strict=True))
    if isinstance(a, list | tuple | np.ndarray):
        return len(a) == len(b) and all(_same(x, y, seen) for x, y in zip(a, b, strict=True))
    if isinstance(a, set | frozenset):
        return len(a) == len(b)
    return _same(getattr(a, "__dict__", None), getattr(b, "__dict__", None), seen)
