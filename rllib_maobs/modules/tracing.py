"""Tensor operations that are recorded once and played back: the same numbers without the way to them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor, fx
from torch.fx.experimental.proxy_tensor import make_fx

aten = torch.ops.aten
# Operations that give the numbers of their argument from its start on, in another shape; and how they are called fast.
_VIEWS: dict[Any, Callable[..., Any]] = {
    aten.view.default: Tensor.view,
    aten._unsafe_view.default: Tensor.view,
    aten.expand.default: Tensor.expand,
    aten.permute.default: torch.permute,
    aten.transpose.int: torch.transpose,
    aten.unsqueeze.default: torch.unsqueeze,
    aten.detach.default: torch.detach,
    aten.alias.default: torch.detach,
    aten.t.default: torch.t,
}
_RESHAPES = (aten.view.default, aten._unsafe_view.default)
_PRODUCTS: dict[Any, Callable[..., Any]] = {aten.mul.Scalar: torch.mul, aten.mul.Tensor: torch.mul}
_OTHERS: dict[Any, Callable[..., Any]] = {
    operation: getattr(torch, operation.overloadpacket.__name__)
    for operation in (
        aten._softmax.default,
        aten.add.Tensor,
        aten.bmm.default,
        aten.cat.default,
        aten.clamp.default,
        aten.div.Tensor,
        aten.mm.default,
        aten.pow.Tensor_Scalar,
        aten.relu.default,
        aten.select.int,
        aten.sigmoid.default,
        aten.sqrt.default,
        aten.sub.Tensor,
        aten.sum.dim_IntList,
        aten.tanh.default,
    )
}
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
    """Leaves out what changes nothing, four in ten of the operations: `vmap` and `grad` leave many."""
    if not any(_writes(node) for node in graph.nodes):  # else it matters which tensors are one
        for node, same in _doubles(graph):
            node.replace_all_uses_with(same)
    for node in graph.nodes:
        if node.target in _RESHAPES and node.args[0].target in _RESHAPES:  # of the same numbers
            node.args = node.args[0].args[0], *node.args[1:]
    graph.eliminate_dead_code()
    for node in graph.nodes:
        node.target = {**_VIEWS, **_PRODUCTS, **_OTHERS}.get(node.target, node.target)


def _doubles(graph: fx.Graph) -> Iterator[tuple[fx.Node, fx.Node]]:
    """Products with one, and views that there are already; with what has the same numbers."""
    roots: dict[fx.Node, fx.Node] = {}
    seen: dict[tuple[Any, ...], fx.Node] = {}
    for node in graph.nodes:
        if node.target in _VIEWS:
            source = node.args[0]
            root = roots[node] = roots.get(source, source)
            seen.setdefault((root, *_form(root)), root)
            if (same := seen.setdefault((root, *_form(node)), node)) is not node:
                yield node, same
        elif node.target in _PRODUCTS and node.args[1] == 1 and _form(node) == _form(node.args[0]):
            yield node, node.args[0]


def _form(node: fx.Node) -> tuple[Any, ...]:
    """How a node's tensor lies in memory."""
    tensor = node.meta["val"]
    return tensor.dtype, tensor.shape, tensor.stride()


def _writes(node: fx.Node) -> bool:
    """Whether it writes into one of its arguments."""
    schema = getattr(node.target, "_schema", None)
    return schema is not None and schema.is_mutable
