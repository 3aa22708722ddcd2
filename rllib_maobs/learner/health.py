"""Updates that are not finite: how they are told, and what is kept of them for a post-mortem."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

REPORT = ("critic_loss", "q_mean", "actor_loss", "q_max", "critic_gradient_norm", "actor_gradient_norm")
"""Rows of an update's report: losses and mean Q of each agent, its largest |Q|, and the norms of all gradients."""
MOST_SKIPPED = 100
"""Updates that may be skipped one after the other: what lasts is not a bad minibatch, but bad networks."""


class Diverged(FloatingPointError):
    """Training has come to nothing: a loss, a value, a gradient or a weight is not finite.

    Args:
        message: Says which.
        evidence: The minibatch and the networks, as a file of NumPy's (.npz) for `rllib_maobs.postmortem`; may be
            empty.
        update: Number of the update.
    """

    def __init__(self, message: str, evidence: bytes = b"", update: int = 0) -> None:
        super().__init__(message)
        self.evidence, self.update = evidence, update

    @property
    def file_name(self) -> str:
        """A name for the file."""
        return f"postmortem-{self.update}.npz"

    def keep(self, folder: str) -> None:
        """Write the evidence into a folder that is there, and say so in the message; it is written once."""
        if not self.evidence or not Path(folder).is_dir():
            return
        path = Path(folder) / self.file_name
        path.write_bytes(self.evidence)
        self.kept_as(str(path))

    def kept_as(self, path: str) -> None:
        """Say in the message where the evidence is."""
        self.args = (
            f"{self} The minibatch and the networks before it are in {path}: python -m rllib_maobs.postmortem {path}",
        )
        self.evidence = b""


def not_finite(report: Tensor, module_ids: Sequence[str]) -> str:
    """What of a report `(rows, N)` is not finite: the first row that is not, and whose it is."""
    for name, values in zip(REPORT, report.tolist(), strict=True):
        for mid, value in zip(module_ids, values, strict=True):
            if not math.isfinite(value):
                return f"{name} of {mid} is {value}" if not name.endswith("norm") else f"{name} is {value}"
    return "the sum of losses, values and gradients is not finite"


def evidence_of(batch: Any, report: Tensor, weights: Iterator[tuple[str, Tensor]], about: dict[str, Any]) -> bytes:
    """A minibatch, its report and the networks as a file of NumPy's.

    Args:
        batch: The `Batch`.
        report: Its report, `(rows, N)`.
        weights: Networks' parameters, by module and name.
        about: Plain values that say what it is.

    Returns:
        The file: arrays "batch/NAME", "report", "weights/MODULE/NAME", and "about", JSON. It holds no pickles.
    """
    arrays: dict[str, NDArray[Any]] = {
        "about": np.array(json.dumps(about)),
        "report": report.cpu().numpy(),
        **{f"batch/{name}": tensor.cpu().numpy() for name, tensor in _tensors(batch)},
        **{f"weights/{name}": tensor.detach().cpu().numpy() for name, tensor in weights},
    }
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # of its keywords it knows one
    return file.getvalue()


def _tensors(part: Any, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    for name, value in part._asdict().items():
        if isinstance(value, Tensor):
            yield prefix + name, value
        elif hasattr(value, "_asdict"):
            yield from _tensors(value, f"{prefix}{name}.")
