"""Classes that plug in: by name, by themselves, or by where they can be imported from; and the settings they take."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Collection, Iterator, Mapping
from typing import Any, Generic, TypeVar, get_type_hints

from rllib_maobs.options import check_value, closest

T = TypeVar("T")


class Registry(Generic[T], Mapping[str, type[T]]):
    """Classes of one kind by name.

    Args:
        kind: What they are, for messages, e.g. "actor".
        base: What they derive from.
    """

    def __init__(self, kind: str, base: type[T]) -> None:
        self._kind, self._base = kind, base
        self._classes: dict[str, type[T]] = {}

    def __getitem__(self, name: str) -> type[T]:
        return self._classes[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._classes)

    def __len__(self) -> int:
        return len(self._classes)

    def register(self, name: str, cls: type[T]) -> None:
        """Makes a class known by a name in this process; it replaces one of the same name, but none of this package's.

        Ray's worker processes do not see it: there, give the class itself, or its place as "package.module:Class".

        Raises:
            ValueError: If it is no such class, or the name is taken by one of this package.
        """
        if not (isinstance(cls, type) and issubclass(cls, self._base)):
            raise ValueError(f"Cannot register {cls!r} as {self._kind}; legal is a subclass of {self._base.__name__}.")
        if name in self._classes and _ours(self._classes[name]) and cls is not self._classes[name]:
            raise ValueError(f"{name!r} is this package's {self._classes[name].__name__}: choose another name.")
        self._classes[name] = cls

    def resolve(self, given: Any) -> type[T]:
        """The class that is meant.

        Args:
            given: A name, the class itself, or its place as "package.module:Class".

        Raises:
            ValueError: If it is neither; names what is legal.
        """
        if isinstance(given, str) and given in self._classes:
            return self._classes[given]
        found = _imported(given) if isinstance(given, str) else given
        if isinstance(found, type) and issubclass(found, self._base):
            return found
        hint = closest(given, list(self._classes)) if isinstance(given, str) else ""
        if isinstance(found, Exception):
            raise ValueError(f"{self._kind} {given!r} can't be imported: {found}.") from found
        raise ValueError(
            f"{self._kind} {given!r} is illegal{hint}; legal are {', '.join(map(repr, self._classes))}, a subclass of "
            f'{self._base.__name__}, or where to import one from, as "package.module:Class".'
        )

    def reference(self, given: Any) -> Any:
        """How a checkpoint refers to a class: its name, its place, or the class itself if it has neither.

        A class of a script or a function can't be imported elsewhere: it is pickled whole.
        """
        cls = self.resolve(given)
        for name, known in self._classes.items():
            if known is cls and _ours(cls):
                return name
        place = f"{cls.__module__}:{cls.__qualname__}"
        return place if cls.__module__ != "__main__" and _imported(place) is cls else cls


def _ours(cls: type[Any]) -> bool:
    return cls.__module__.split(".")[0] == __name__.split(".")[0]


def same(one: Any, other: Any) -> bool:
    """Whether two settings are the same: one object, or equal in value; what can't be compared is not."""
    if one is other:
        return True
    if type(one) is not type(other):
        return False
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(value, other[name]) for name, value in one.items())
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    try:
        equal = one == other
        return bool(equal.all()) and one.shape == other.shape if hasattr(one, "shape") else equal is True
    except Exception:
        return False


def _imported(place: str) -> Any:
    """What lies at "package.module:Class", or the error of importing it; None if that is no such place."""
    module, colon, name = place.partition(":")
    if not colon:
        return None
    try:
        found = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except Exception as error:  # whatever a module does when it is imported
        return error
    return found


def settings_of(cls: type[Any], reserved: Collection[str] = ()) -> dict[str, inspect.Parameter]:
    """The settings that a class takes: its constructor's parameters but for some."""
    parameters = dict(inspect.signature(cls).parameters)
    return {name: p for name, p in parameters.items() if name not in reserved}


def check_settings(cls: type[Any], given: Mapping[str, Any], reserved: Collection[str] = ()) -> None:
    """Checks settings against a constructor's signature and its type hints.

    Hints that are understood are those of environment options, e.g. `Annotated[int, Range(1)]`; what has another hint
    is the constructor's own to check.

    Args:
        cls: The class that the settings are for.
        given: The settings by name.
        reserved: Parameters of its constructor that are not settings.

    Raises:
        ValueError: For a name that it does not take, a value that its hint excludes, or one that is missing.
    """
    legal = settings_of(cls, reserved)
    anything = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in legal.values())
    legal = {name: p for name, p in legal.items() if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)}
    try:
        hints = get_type_hints(cls.__init__, include_extras=True)
    except NameError:  # hints of names that only a type checker sees
        hints = {}
    for name, value in given.items():
        if name not in legal:
            if anything and name not in reserved:
                continue
            raise ValueError(
                f"{cls.__name__} has no setting {name!r}{closest(name, list(legal))}; legal are {', '.join(legal)}."
            )
        if name in hints:
            check_value(value, hints[name], name, cls.__name__)
    missing = [name for name, p in legal.items() if p.default is p.empty and name not in given]
    if missing:
        raise ValueError(f"{cls.__name__} needs the settings {', '.join(missing)}, which are not given.")
