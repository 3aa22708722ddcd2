"""Alike networks of several agents as one: their parameters in one flat tensor, one call for all of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap

Params = dict[str, Tensor]
"""Parameters of M alike networks by name, each `(M, *shape)`."""


class Stack:
    """M networks of one architecture whose parameters live in one flat tensor.

    The networks stay ordinary modules: each of their parameters becomes a view of `flat`, so a checkpoint
    of one of them, `load_state_dict` into one of them, and an optimiser step on `flat` all see the same
    numbers. One flat vector per role also makes Adam and Polyak averaging a single pass each.

    Args:
        networks: The networks; equal architectures, separate parameters.
        methods: The methods of them that the stack can call.

    Raises:
        ValueError: If the networks' parameters differ in name or shape, or are shared between networks.
    """

    def __init__(self, networks: Sequence[nn.Module], methods: Sequence[str] = ("forward",)) -> None:
        shapes = [{name: tuple(p.shape) for name, p in net.named_parameters()} for net in networks]
        for index, shape in enumerate(shapes):
            if shape != shapes[0]:
                raise ValueError(f"Networks 0 and {index} differ, so they cannot be stacked: {shapes[0]} and {shape}.")
        if any(any(True for _ in net.buffers()) for net in networks):
            raise ValueError("Networks with buffers (e.g. BatchNorm) cannot be stacked; use LayerNorm instead.")
        self.networks = list(networks)
        # The first network only lends its code; functional_call puts the stacked parameters in its own's place.
        self._methods = {name: _Method(networks[0], name) for name in methods}
        stacked = {name: torch.stack([net.get_parameter(name).detach() for net in networks]) for name in shapes[0]}
        self._shapes = {name: value.shape for name, value in stacked.items()}
        self.flat = nn.Parameter(torch.cat([value.reshape(-1) for value in stacked.values()]))
        self.params: Params = {}
        self._bind()

    def _bind(self) -> None:
        """Makes `params` and every network's own parameters views of `flat`."""
        self.params = self.unflatten(self.flat.detach())
        for index, net in enumerate(self.networks):
            for name, parameter in net.named_parameters():
                parameter.data = self.params[name][index]

    def share(self, other: Stack) -> None:
        """Uses the tensors of another stack of the same shape from now on, instead of copies of them.

        Raises:
            ValueError: If the other stack's networks have a different architecture or number.
        """
        if self._shapes != other._shapes:
            raise ValueError(f"Stacks differ: {self._shapes} and {other._shapes}.")
        self.flat = other.flat
        self._bind()

    def unflatten(self, flat: Tensor) -> Params:
        """Views of a flat vector `(P,)` as stacked parameters by name."""
        sizes = [shape.numel() for shape in self._shapes.values()]
        parts = flat.split(sizes)
        return {name: part.view(shape) for (name, shape), part in zip(self._shapes.items(), parts, strict=True)}

    def flatten(self, params: Params) -> Tensor:
        """One flat vector `(P,)` from stacked parameters (or gradients) by name; a copy."""
        return torch.cat([params[name].reshape(-1) for name in self._shapes])

    def __call__(self, params: Params, *inputs: tuple[Tensor, int | None], method: str = "forward") -> Tensor:
        """Applies all M networks at once.

        Args:
            params: Stacked parameters to use, e.g. `self.params` or the tracked ones inside `torch.func.grad`.
            *inputs: Pairs of a tensor and the dimension of it that runs over the M networks; None for a
                tensor that all networks see.
            method: The network's method to call.

        Returns:
            The output, with the M networks at dimension 1: `(B, M, ...)`.
        """
        tensors, dims = zip(*inputs, strict=True)

        def one(p: Params, *args: Tensor) -> Tensor:
            return functional_call(self._methods[method], {f"net.{k}": v for k, v in p.items()}, args)

        return vmap(one, in_dims=(0, *dims), out_dims=1)(params, *tensors)


class _Method(nn.Module):
    """Lets `functional_call` run a method other than forward."""

    def __init__(self, net: nn.Module, method: str) -> None:
        super().__init__()
        self.net = net
        self.method = method

    def forward(self, *args: Tensor) -> Tensor:
        """Calls the method."""
        return getattr(self.net, self.method)(*args)
