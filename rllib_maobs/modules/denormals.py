"""Numbers too small for a float's full precision, which Intel's processors compute with a hundred times slower."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch

_smallest = sys.float_info.min  # a variable: Python would compute with a constant beforehand


@contextmanager
def denormals_are_zero() -> Iterator[None]:
    """Takes denormal numbers (below 1.2e-38 in single precision) as zero, in this thread and for this block.

    Adam's means of weights without a gradient fall below that within some hundred updates, and a softmax has weights as
    small. Further threads of torch or of compiled code are not changed, see `StackedAdam.clean`.
    """
    was_on = _smallest * 0.5 == 0.0  # torch has no way to ask
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(was_on)
