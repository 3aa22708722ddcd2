"""Layouts: what an observation or a state is made of, as named groups of entities.

A layout travels from the environment to the networks. A network that treats "three targets" as a set reads it there;
an MLP needs only the total length. Nothing here is about PyTorch: arrays and tensors are cut alike.
"""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Integral
from typing import Any, NamedTuple, TypeVar

from rllib_maobs.options import as_list

ArrayT = TypeVar("ArrayT", bound=Any)


class Entities(NamedTuple):
    """A group of alike entities, which lie one after the other in a vector.

    Attributes:
        name: What they are, e.g. "target"; unique in a layout.
        count: How many there are; 0 is legal.
        size: Numbers for each.
        position: How many of these numbers, the first ones, say where the entity is. In an observation that is
            its offset from the observer, in a state its place in the world. 0 if none do.
    """

    name: str
    count: int  # type: ignore[assignment]  # instead of tuple's method
    size: int
    position: int = 0


Layout = tuple[Entities, ...]
"""The groups of a vector, in its order."""


def flat(size: int, name: str = "vector") -> Layout:
    """The layout of a vector of which nothing but its length is known."""
    return (Entities(name, 1, size),)


def layout_size(layout: Layout) -> int:
    """Length of the vector."""
    return sum(group.count * group.size for group in layout)


def split(layout: Layout, vector: ArrayT) -> dict[str, ArrayT]:
    """Cuts vectors into their groups.

    Args:
        layout: What the vectors are made of.
        vector: NumPy array or tensor `(..., S)`; what lies beyond the layout's length is padding and left out.

    Returns:
        A view `(..., count, size)` for each group, by name: what is written to it is written to `vector`.
    """
    groups, start, leading = {}, 0, vector.shape[:-1]
    for name, count, size, _ in layout:
        end = start + count * size
        groups[name] = vector[..., start:end].reshape(*leading, count, size)
        start = end
    return groups


def as_layout(groups: Iterable[Iterable[Any]], size: int | None, owner: str) -> Layout:
    """Checks a layout and brings it into its canonical form.

    Args:
        groups: The groups: `Entities`, or tuples and lists of the same values, as checkpoints hold them.
        size: Length of the vector that the layout is about; None if any will do.
        owner: What the vector is, for messages, e.g. "observation of agent 'agent_0'".

    Returns:
        The layout.

    Raises:
        ValueError: If a value is not legal, a name is there twice, or the lengths do not add up.
    """
    if (listed := as_list(groups)) is None:
        raise ValueError(f"The layout of the {owner} is {groups!r}; legal is a list of groups (name, count, size).")
    layout = []
    for group in listed:
        try:
            entities = Entities(*group)
        except TypeError:
            raise ValueError(
                f"The layout of the {owner} has a group {group!r}; legal are (name, count, size) or (name, count, "
                f'size, position), e.g. ("target", 3, 2).'
            ) from None
        numbers = entities[1:]
        integers = all(isinstance(n, Integral) and not isinstance(n, bool) for n in numbers)
        if not isinstance(entities.name, str) or not integers or min(numbers) < 0 or entities.size < 1:
            raise ValueError(
                f"The layout of the {owner} has a group {tuple(entities)!r}; legal are a name, a count >= 0, a size >= "
                f"1 and a position >= 0, integers."
            )
        if entities.position > entities.size:
            raise ValueError(
                f"The layout of the {owner}: position ({entities.position}) of group {entities.name!r} must not be "
                f"larger than its size ({entities.size})."
            )
        layout.append(Entities(entities.name, *map(int, numbers)))
    names = [group.name for group in layout]
    if len(set(names)) < len(names):
        raise ValueError(f"The layout of the {owner} names a group twice: {names}.")
    total = layout_size(tuple(layout))
    if size is not None and total != size:
        parts = " + ".join(f"{g.count} x {g.size} ({g.name})" for g in layout)
        raise ValueError(f"The layout of the {owner} adds up to {parts} = {total} numbers, but it has {size}.")
    return tuple(layout)
