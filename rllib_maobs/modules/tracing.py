"""Tensor operations that are recorded once and played back: the same numbers without the way to them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import torch
from torch import fx
from torch.fx.experimental.proxy_tensor import make_fx

aten = torch.ops.aten
# What is nothing but another view of its argument.
_VIEWS = {aten.view.default, aten._unsafe_view.default, aten.expand.default, aten.permute.default, aten.detach.default}
_PRODUCTS = {aten.mul.Scalar, aten.mul.Tensor}
_recording = threading.Lock()  # torch.fx replaces functions of all threads while it records


def traced(function: Callable[..., Any], *args: Any) -> Callable[..., Any]:
    """Records the plain tensor operations behind a function, `vmap`, `grad` and modules, to be played back.

    For small tensors most of the time of a call goes into finding the operations. They are the same ones on the same
    numbers, so results are equal bit for bit. What the function does in Python it does here, once.

    Args:
        function: The function.
        *args: What it is to be called with. Later ones may differ from these in nothing but the numbers in their
            tensors.

    Returns:
        The function, played back.

    Raises:
        RuntimeError: If what the function does depends on the numbers in its tensors.
    """
    with _recording:
        played = make_fx(lambda *given: function(*given))(*args)
    _tidy(played.graph)
    played.recompile()
    return played.forward


def _tidy(graph: fx.Graph) -> None:
    """Leaves out what changes nothing, half of the operations: `vmap` and `grad` leave many."""
    if not any(_writes(node) for node in graph.nodes):
        for node in graph.nodes:
            if node.target in _VIEWS or (node.target in _PRODUCTS and node.args[1] == 1):
                before, after = node.args[0].meta["val"], node.meta["val"]
                if (before.shape, before.stride(), before.dtype) == (after.shape, after.stride(), after.dtype):
                    node.replace_all_uses_with(node.args[0])
    graph.eliminate_dead_code()


def _writes(node: fx.Node) -> bool:
    """Whether it writes into one of its arguments: then it matters which tensors are one."""
    schema = getattr(node.target, "_schema", None)
    return schema is not None and schema.is_mutable
