"""How much memory there is, to refuse at once what would never fit; and what is kept of it once it is free."""

import ctypes
import math
import os
import sys
from functools import cache

import torch

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h


def memory_of(device: torch.device | str) -> float:
    """Bytes of memory that there are for a device: of the GPU, or of the machine; infinity where nobody says."""
    if torch.device(device).type == "cuda":
        return float(torch.cuda.get_device_properties(device).total_memory)
    if hasattr(os, "sysconf"):  # not on Windows
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    return math.inf


def gigabytes(count: float) -> str:
    """A number of bytes for people; an integer may be larger than any float."""
    return f"{count / 1e9:,.1f} GB" if count < 1e18 else "more than 1,000,000,000 GB"


@cache
def keep_freed_memory() -> None:
    """Has this process keep up to 512 MB that it frees, for its next tensors.

    The GNU C library gives large blocks back to the system, which hands them out again page by page and filled with
    zeros: for tensors of megabytes that takes longer than most of what is computed in them. What the environment says
    (`MALLOC_TRIM_THRESHOLD_`) is left as it is; other C libraries are, too.
    """
    if sys.platform != "linux" or "MALLOC_TRIM_THRESHOLD_" in os.environ:
        return
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(_M_MMAP_THRESHOLD, 32 * 2**20)  # the most that it takes
        mallopt(_M_TRIM_THRESHOLD, 512 * 2**20)
