"""How much memory there is, to refuse at once what would never fit."""

import math
import os

import torch


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
