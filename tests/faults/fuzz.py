"""What the fuzzers share: nasty values, and the promise that each of them works or is refused in a sentence."""

import os
import resource
import signal
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

import rllib_maobs as maobs

PACKAGE = str(Path(maobs.__file__).parent)
SECONDS = 5.0  # of computing for one input; on a busy machine that takes longer
WAITING = 60.0  # seconds for one input, whatever it does
MEMORY = 1 << 30  # bytes that the inputs of one test may take

LONG_NAME = "x" * 300
PATHS = ("../x", "/etc/x", "a/b", "a\0b", "..", ".", "~", "~root/x", "C:\\x", "x\n", "\ud800", "ä" * 200, " ")
SCALARS: tuple[Any, ...] = (
    *(None, True, False, "", "3", "1e-3", "nan", "true", "ünï", LONG_NAME, *PATHS),
    *(0, -0.0, 1, -1, 2, 3, 0.5, 1e-300, 1e300, 5e-324, float("nan"), float("inf"), -float("inf")),
    *(2**31, 2**53 + 1, 2**63 - 1, 2**63, -(2**63), 10**30, 10**400, 3 + 4j),
    *(
        np.int64(3),
        np.float32(0.5),
        np.float64("nan"),
        np.bool_(True),
        np.uint8(255),
        np.str_("x"),
        np.datetime64("NaT"),
    ),
    *(b"", b"bytes", int, float, object, len, lambda: None, Ellipsis, NotImplemented, object()),
)
ARRAYS: tuple[Any, ...] = (
    *(np.zeros(0), np.zeros(3), np.array(2), np.array([1, 2], object), np.array(["a"]), np.full((2, 2), np.nan)),
    *(np.zeros((4, 4))[::2, ::2], np.broadcast_to(1.0, (3, 5)), np.zeros((1, 1, 1, 1)), np.array([None])),
)


def nasty() -> st.SearchStrategy[Any]:
    """Values of every kind, of which hardly one is legal anywhere."""
    scalars = st.sampled_from(SCALARS)
    near = st.one_of(
        st.integers(), st.floats(), st.integers(-2, 9), st.floats(-2, 2), st.text(max_size=8), st.binary(max_size=4)
    )
    flat = st.one_of(scalars, near, st.sampled_from(ARRAYS))
    return st.one_of(
        flat,
        st.lists(flat, max_size=3),
        st.tuples(flat, flat),
        st.sets(st.integers(), max_size=2),
        st.dictionaries(st.one_of(st.text(max_size=5), st.integers(), st.none()), flat, max_size=2),
        st.lists(st.lists(flat, max_size=2), max_size=2),
    )


def names_like(legal: list[str]) -> st.SearchStrategy[str]:
    """Names that are legal, nearly legal, or anything."""

    def spoil(name: str, kind: int) -> str:
        return (name.upper(), name[:-1], f"{name}s", f"_{name}", name.replace("_", "-"), f" {name}")[kind]

    return st.one_of(
        st.sampled_from(legal),
        st.sampled_from(legal),
        st.builds(spoil, st.sampled_from(legal), st.integers(0, 5)),
        st.text(max_size=10),
        st.sampled_from((LONG_NAME, "__class__", "self", *PATHS)),
    )


class Refused(Exception):
    """An input was refused as documented; `str()` is the sentence."""


class TooSlowError(BaseException):
    """An input took longer than `SECONDS`; nothing that is tried catches it."""


def attempt(
    call: Callable[[], Any],
    tally: Counter[str] | None = None,
    *,
    errors: tuple[type[BaseException], ...] = (ValueError,),
    sources: tuple[str, ...] = (PACKAGE,),
) -> Any:
    """Try one input: it returns, or raises `Refused` if the package refused it in a sentence.

    Args:
        call: What is tried.
        tally: Where it is counted.
        errors: What is documented.
        sources: Whose errors these are: the innermost frame of the traceback must be in a file that begins so. An error
            that NumPy or Python raised by itself, where no `raise` stands, says nothing about what the user did.
    """
    if tally is not None:
        tally["inputs tried"] += 1

    def stop(*_: Any) -> None:
        raise TooSlowError(f"took longer than {SECONDS} s of computing, or {WAITING} s")

    before = [signal.signal(number, stop) for number in (signal.SIGALRM, signal.SIGPROF)]
    signal.setitimer(signal.ITIMER_REAL, WAITING)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        return call()
    except TooSlowError as error:
        raise AssertionError(str(error)) from error
    except errors as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        sentence = str(error)
        assert where.filename.startswith(sources), f"{type(error).__name__} of {where}: {sentence[:300]}"
        assert (where.line or "").startswith("raise "), f"{type(error).__name__} of {where}: {sentence[:300]}"
        assert len(sentence) >= 20 and " " in sentence, f"no sentence: {sentence!r}"
        assert len(sentence) < 5_000, f"{len(sentence)} characters: {sentence[:300]}"
        raise Refused(sentence) from error
    finally:
        for timer in (signal.ITIMER_REAL, signal.ITIMER_PROF):
            signal.setitimer(timer, 0)
        for number, handler in zip((signal.SIGALRM, signal.SIGPROF), before, strict=True):
            signal.signal(number, handler)


def refused(call: Callable[[], Any], tally: Counter[str] | None = None, **how: Any) -> str | None:
    """The sentence with which an input was refused, None if it works."""
    try:
        attempt(call, tally, **how)
    except Refused as sentence:
        return str(sentence)
    return None


@contextmanager
def little_memory() -> Iterator[None]:
    """Assert that what is done here takes little memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    taken = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    assert taken < MEMORY, f"took {taken / 1e9:.1f} GB"


# What the process does while somebody watches: files that it opens to write, classes that it unpickles.
_watching: list[tuple[str, str]] | None = None
_WRITES = {"os.mkdir": 0, "os.rename": 1, "os.remove": 0, "os.rmdir": 0, "os.link": 1, "os.symlink": 1}


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if _watching is None:
        return
    if event == "pickle.find_class":
        _watching.append((event, f"{arguments[0]}.{arguments[1]}"))
    elif event in ("os.system", "subprocess.Popen", "os.exec", "os.posix_spawn"):
        _watching.append((event, str(arguments[0])))
    elif event in _WRITES:
        _watching.append(("write", os.fsdecode(os.path.abspath(arguments[_WRITES[event]]))))
    elif event == "open":
        path, mode, flags = arguments
        writes = flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT) if mode is None else set(mode) & set("wax+")
        if writes and isinstance(path, str | bytes | os.PathLike):
            _watching.append(("write", os.fsdecode(os.path.abspath(os.fspath(path)))))


_hooked: list[bool] = []


@contextmanager
def watched() -> Iterator[list[tuple[str, str]]]:
    """What is written, run and unpickled in the meantime, as (what, which)."""
    global _watching
    if not _hooked:
        sys.addaudithook(_hook)  # it can't be taken away again
        _hooked.append(True)
    _watching = seen = []
    try:
        yield seen
    finally:
        _watching = None
