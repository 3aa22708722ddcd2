"""What was wrong with an update that was not finite: `python -m rllib_maobs.postmortem FILE`.

    python -m rllib_maobs.postmortem results/spread-3a/maddpg-seed0/postmortem-1234.npz

Training that diverges ends with a file: the minibatch of that update, what came of it, and the networks as they were
before it. This shows where its numbers are extreme; `read` returns them as arrays. Reading such a file runs no code.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rllib_maobs.learner.health import REPORT

MOST_EXTREME = 3  # rows shown of each array
ABOUT = {"what", "algorithm", "agents", "policies", "update", "gamma", "reward_scale", "learning_rates"}
"""What a file says of itself."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line.

    Args:
        arguments: Those of the command line by default.
    """
    parser = argparse.ArgumentParser(
        prog="python -m rllib_maobs.postmortem",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="postmortem-....npz of a trial's folder")
    args = parser.parse_args(arguments)
    try:
        about, arrays = read(args.file)
    except ValueError as error:
        parser.error(str(error))
    print("\n".join(shown(about, arrays)))


def read(path: str | Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return what a file holds.

    Args:
        path: The file.

    Returns:
        What it is about, plain values by name; and arrays by name: "batch/NAME" as in a `Batch`, "weights/MODULE/NAME",
        and "report", the rows of `REPORT` for each agent.

    Raises:
        ValueError: If it is no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(str(arrays.pop("about")))
        whole = about.keys() >= ABOUT and arrays["report"].shape == (len(REPORT), len(about["agents"]))
    except Exception:  # what is damaged may raise anything, of the archive, its compression, and what is in it
        whole = False
    if whole:
        return about, arrays
    raise ValueError(f"{str(path)!r} is no whole post-mortem; legal: a file postmortem-....npz that training has left.")


def shown(about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Iterator[str]:
    """Yield the lines of the report.

    Args:
        about: As `read` returns it.
        arrays: Likewise.
    """
    rates = ", ".join(f"{name}_lr {rate:g}" for name, rate in about["learning_rates"].items())
    yield f"{about['algorithm']}: {about['what']} ({rates}, reward_scale {about['reward_scale']:g})"
    yield ""
    width = max(len("agent"), *map(len, about["agents"]))
    yield "agent".ljust(width) + "".join(name.rjust(22) for name in REPORT)
    for agent, values in zip(about["agents"], arrays["report"].T, strict=True):
        yield agent.ljust(width) + "".join(f"{value:22.4g}" for value in values)
    yield ""
    yield f"The minibatch, and the {MOST_EXTREME} largest of each array (place: value; places begin with its row):"
    for name, array in arrays.items():
        if name.startswith("batch/"):
            yield _line(name.removeprefix("batch/"), array)
    yield ""
    yield "The networks before the update:"
    for name, array in arrays.items():
        if name.startswith("weights/"):
            yield _line(name.removeprefix("weights/"), array)


def _line(name: str, array: NDArray[Any]) -> str:
    """One array: its shape, how large its numbers are, and where the largest are."""
    flat = np.abs(array.astype(np.float64)).ravel()
    bad = int((~np.isfinite(flat)).sum())
    order = np.argsort(-np.where(np.isnan(flat), np.inf, flat), kind="stable")[:MOST_EXTREME]
    places = (tuple(map(int, np.unravel_index(i, array.shape))) for i in order)
    extreme = ", ".join(f"{list(place)}: {array[place]:.4g}" for place in places)
    median = f"median {np.median(flat[np.isfinite(flat)]):.3g}, " if bad < flat.size else ""
    return f"  {name} {array.shape}: {f'{bad} not finite, ' if bad else ''}{median}largest {extreme}"


if __name__ == "__main__":
    main(sys.argv[1:])
