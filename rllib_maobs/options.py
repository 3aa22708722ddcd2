"""Settings whose type hints are their legal values: options of scenarios, of networks and of algorithms."""

import dataclasses
import difflib
import math
import numbers
import types
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

T = TypeVar("T")


@dataclass(frozen=True)
class Range:
    """Legal range of a number, for `Annotated[int, Range(1)]`.

    Args:
        low: Smallest legal value.
        high: Largest legal value.
        exclusive: Whether `low` itself is illegal.
    """

    low: float = -np.inf
    high: float = np.inf
    exclusive: bool = False

    def __contains__(self, value: float) -> bool:
        return (value > self.low if self.exclusive else value >= self.low) and value <= self.high

    def __str__(self) -> str:
        low, high = (value if isinstance(value, int) else f"{value:g}" for value in (self.low, self.high))
        lower = f"{'>' if self.exclusive else '>='} {low}"
        return lower if self.high == np.inf else f"{lower} and <= {high}"


def closest(name: str, legal: list[str]) -> str:
    """Return " (did you mean ...?)" for a misspelt name, or an empty string."""
    match = difflib.get_close_matches(name, legal, n=1, cutoff=0.5)
    return f" (did you mean {match[0]!r}?)" if match else ""


def as_list(value: Any) -> list[Any] | None:
    """What a value lists; None if it lists nothing, like a number, or something else, like a text or a dict."""
    try:
        return None if isinstance(value, str | bytes | Mapping) else list(value)
    except TypeError:
        return None


def build_options(cls: type[T], values: dict[str, Any], owner: str) -> T:
    """Build an options dataclass from keywords, after checking every name and value.

    Args:
        cls: A frozen dataclass. Legal values come from its hints: `int`, `float`, `bool`, `str`,
            `Literal[...]`, `X | None`, and numbers in a range as `Annotated[int, Range(1)]`.
        values: The keywords.
        owner: Name of the scenario, for the message.

    Returns:
        The dataclass with Python numbers (NumPy scalars, as Tune samples them, are converted).

    Raises:
        ValueError: For an unknown name or an illegal value; the message names what is legal.
    """
    hints = get_type_hints(cls, include_extras=True)
    legal = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]
    for name in values:
        if name not in legal:
            raise ValueError(f"{owner} has no option {name!r}{closest(name, legal)}; legal options: {', '.join(legal)}")
    return cls(**{name: check_value(value, hints[name], name, owner) for name, value in values.items()})


def check_value(value: Any, hint: Any, name: str, owner: str) -> Any:
    """Return the value converted to its hint.

    Args:
        value: What was given.
        hint: `int`, `float`, `bool`, `str`, `Literal[...]`, `X | None`, or a number in a range as `Annotated[int,
            Range(1)]`. Any other hint takes everything.
        name: Of the setting, for the message.
        owner: What the setting belongs to, for the message.

    Raises:
        ValueError: If the value is not legal; says what is.
    """
    for alternative in _alternatives(hint):
        accepted, converted = _accept(value, alternative)
        if accepted:
            return converted
    legal = " or ".join(_describe(alternative) for alternative in _alternatives(hint))
    raise ValueError(f"{owner}: {name}={value!r} is illegal; legal: {legal}")


def _alternatives(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


def _accept(value: Any, hint: Any) -> tuple[bool, Any]:
    """Return whether the value fits one hint, and the value converted."""
    if get_origin(hint) is Annotated:
        inner, limits = get_args(hint)
        accepted, converted = _accept(value, inner)
        return accepted and converted in limits, converted
    if get_origin(hint) is Literal:
        return isinstance(value, Hashable) and value in get_args(hint), value
    if hint is type(None):
        return value is None, None
    if hint is bool:
        return isinstance(value, bool | np.bool_), bool(value) if isinstance(value, bool | np.bool_) else value
    if isinstance(value, bool | np.bool_):
        return False, value
    if hint is int:
        return isinstance(value, numbers.Integral), int(value) if isinstance(value, numbers.Integral) else value
    if hint is float:
        try:
            finite = isinstance(value, numbers.Real) and math.isfinite(value)
        except OverflowError:  # an integer that no float is as large as
            finite = False
        return finite, float(value) if finite else value
    return hint is Any or not isinstance(hint, type) or isinstance(value, hint), value


def _describe(hint: Any) -> str:
    if get_origin(hint) is Annotated:
        inner, limits = get_args(hint)
        return f"{_describe(inner)} {limits}"
    if get_origin(hint) is Literal:
        return ", ".join(repr(value) for value in get_args(hint))
    return _WORDS.get(hint, getattr(hint, "__name__", str(hint)))


_WORDS = {
    int: "an integer",
    float: "a number",
    bool: "True or False",
    str: "a string",
    list: "a list",
    tuple: "a tuple",
    set: "a set",
    dict: "a dict",
    Mapping: "a dict",
    type: "a class",
    Callable: "a function",
    type(None): "None",
}
