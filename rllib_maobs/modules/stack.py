"""Networks of several agents as one: their parameters in one flat tensor, one call for all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.fx.experimental.proxy_tensor import make_fx

Params = dict[str, Tensor]
"""Parameters of M networks by name, each `(M, *shape)`."""


class _Group(NamedTuple):
    """Networks that equally many agents use."""

    rows: list[int]  # of the networks
    agents: list[int]  # who uses the first of them, then the second, ...


class Stack:
    """The networks of N agents, whose parameters live in one flat tensor.

    The networks stay ordinary modules: each of their parameters becomes a view of `flat`, so a checkpoint
    of one of them, `load_state_dict` into one of them, and an optimiser step on `flat` all see the same
    numbers. One flat vector per role also makes Adam and Polyak averaging a single pass each.

    Agents may share a network (parameter sharing): it then has one row, however many agents use it. Networks of
    agents whose observations or actions differ in length are padded with zeros to the largest: inputs padded
    with zeros leave the padding's gradients at zero, so it stays zero, and one batched product serves all.

    Args:
        networks: Every agent's network, of one kind and depth. One that is listed several times is shared.
        methods: The methods of them that the stack can call.
        tie: Whether all agents are to share one row, that of the first network.

    Raises:
        ValueError: If the networks differ in more than the sizes of their parameters.
    """

    def __init__(self, networks: Sequence[nn.Module], methods: Sequence[str] = ("forward",), tie: bool = False) -> None:
        distinct = list({id(net): net for net in networks}.values())
        names = [{name: p.dim() for name, p in net.named_parameters()} for net in distinct]
        for index, own in enumerate(names):
            if own != names[0]:
                raise ValueError(f"Networks 0 and {index} differ, so they cannot be stacked: {names[0]} and {own}.")
        if any(any(True for _ in net.buffers()) for net in distinct):
            raise ValueError("Networks with buffers (e.g. BatchNorm) cannot be stacked; use LayerNorm instead.")
        self.networks = list(networks)
        self.rows = [0 if tie else next(i for i, d in enumerate(distinct) if d is net) for net in networks]
        users = [[agent for agent, own in enumerate(self.rows) if own == row] for row in range(max(self.rows) + 1)]
        self._groups = [
            _Group(rows, [agent for row in rows for agent in users[row]])
            for count in dict.fromkeys(map(len, users))
            if (rows := [row for row, own in enumerate(users) if len(own) == count])
        ]
        order = [agent for group in self._groups for agent in group.agents]
        self._places = [order.index(agent) for agent in range(len(order))]
        owners = distinct[: 1 if tie else None]
        # The first network only lends its code; functional_call puts the stacked parameters in its own's place.
        self._methods = {name: _Method(networks[0], name) for name in methods}
        self._shapes = {
            name: (
                len(owners),
                *(max(sizes) for sizes in zip(*(n.get_parameter(name).shape for n in distinct), strict=True)),
            )
            for name in names[0]
        }
        total = sum(torch.Size(shape).numel() for shape in self._shapes.values())
        like = next(networks[0].parameters())
        self.flat = nn.Parameter(torch.zeros(total, dtype=like.dtype, device=like.device))
        self.params: Params = self.unflatten(self.flat.detach())
        for row, net in enumerate(owners):
            for name, parameter in net.named_parameters():
                _corner(self.params[name][row], parameter).copy_(parameter.detach())
        self._recorded: dict[tuple[Any, ...], Callable[..., Tensor]] = {}
        self._bind()

    def _bind(self) -> None:
        """Makes `params` and every network's own parameters views of `flat`."""
        self.params = self.unflatten(self.flat.detach())
        for row, net in zip(self.rows, self.networks, strict=True):
            for name, parameter in net.named_parameters():
                parameter.data = _corner(self.params[name][row], parameter)

    def share(self, other: Stack) -> None:
        """Uses the tensors of another stack of the same shape from now on, instead of copies of them.

        Raises:
            ValueError: If the other stack's networks have a different architecture or number.
        """
        if self._shapes != other._shapes or self.rows != other.rows:
            raise ValueError(f"Stacks differ: {self._shapes} and {other._shapes}.")
        self.flat = other.flat
        self._bind()

    def pieces(self, flat: Tensor) -> list[Tensor]:
        """Views of a flat vector `(P,)`, one for each parameter in order, each a vector, too."""
        return list(flat.split([torch.Size(shape).numel() for shape in self._shapes.values()]))

    def unflatten(self, flat: Tensor) -> Params:
        """Views of a flat vector `(P,)` as stacked parameters by name."""
        # Weights lie input by output: the order in which batched products take them, and leave their gradients.
        return {
            name: piece.view(shape) if len(shape) < 3 else piece.view(shape[0], shape[2], shape[1]).mT
            for (name, shape), piece in zip(self._shapes.items(), self.pieces(flat), strict=True)
        }

    def flatten(self, params: Params) -> list[Tensor]:
        """The pieces of stacked parameters (or gradients) by name, a vector each; copied only if they lie otherwise."""
        return [(p if p.dim() < 3 else p.mT).reshape(-1) for p in (params[name] for name in self._shapes)]

    def __call__(self, params: Params, *inputs: tuple[Tensor, int | None], method: str = "forward") -> Tensor:
        """Applies all agents' networks at once.

        Args:
            params: Stacked parameters to use, e.g. `self.params` or the tracked ones inside `torch.func.grad`.
            *inputs: Pairs of a tensor and the dimension of it that runs over the N agents; None for a
                tensor that all networks see.
            method: The network's method to call.

        Returns:
            The output, with the N agents at dimension 1: `(B, N, ...)`.
        """
        outputs = [self._call(group, params, inputs, method) for group in self._groups]
        return _take(outputs[0] if len(outputs) == 1 else torch.cat(outputs, dim=1), self._places, 1)

    def _call(self, group: _Group, params: Params, inputs: Sequence[tuple[Tensor, int | None]], method: str) -> Tensor:
        """The output for one group's agents, in its order."""
        networks, users = len(group.rows), len(group.agents) // len(group.rows)
        own = {name: _take(value, group.rows, 0) for name, value in params.items()}
        tensors = [tensor if dim is None else _take(tensor, group.agents, dim) for tensor, dim in inputs]
        dims = [dim for _, dim in inputs]

        def one(p: Params, *args: Tensor) -> Tensor:
            return functional_call(self._methods[method], {f"net.{k}": v for k, v in p.items()}, args)

        def shared(p: Params, *args: Tensor) -> Tensor:
            """One network for all its users: its weights meet all their inputs in one product."""
            if any(dim is not None for dim in dims):
                return vmap(one, in_dims=(None, *dims), out_dims=1)(p, *args)
            same = one(p, *args).unsqueeze(1)
            return same.expand(-1, users, *same.shape[2:])

        if users == 1:
            return vmap(one, in_dims=(0, *dims), out_dims=1)(own, *tensors)
        if networks == 1:
            return shared({name: value[0] for name, value in own.items()}, *tensors)
        tensors = [
            tensor if dim is None else tensor.unflatten(dim, (networks, users))
            for tensor, dim in zip(tensors, dims, strict=True)
        ]
        return vmap(shared, in_dims=(0, *dims), out_dims=1)(own, *tensors).flatten(1, 2)

    @torch.no_grad()
    def act(self, *inputs: tuple[Tensor, int | None], method: str = "forward") -> Tensor:
        """`__call__` with the present parameters and without gradients, for one call after the other.

        The plain tensor operations behind `vmap` are recorded at the first call for inputs of some shape, and played
        back from then on: for small inputs most of the time of a call goes into finding them.
        """
        tensors, dims = zip(*inputs, strict=True)
        key = (method, dims, *(tensor.shape for tensor in tensors))
        if key not in self._recorded:

            def call(params: Params, *tensors: Tensor) -> Tensor:
                return self(params, *zip(tensors, dims, strict=True), method=method)

            self._recorded[key] = make_fx(call)(self.params, *tensors).forward
        return self._recorded[key](self.params, *tensors)


def _take(tensor: Tensor, positions: list[int], dim: int) -> Tensor:
    """The entries at some positions along a dimension: a view if they are neighbours."""
    start, count = positions[0], len(positions)
    if positions == list(range(start, start + count)):
        return tensor if count == tensor.shape[dim] else tensor.narrow(dim, start, count)
    return tensor.index_select(dim, torch.tensor(positions, device=tensor.device))


def _corner(padded: Tensor, like: Tensor) -> Tensor:
    """The part of a padded tensor that has another's shape."""
    return padded[tuple(slice(size) for size in like.shape)]


class _Method(nn.Module):
    """Lets `functional_call` run a method other than forward."""

    def __init__(self, net: nn.Module, method: str) -> None:
        super().__init__()
        self.net = net
        self.method = method

    def forward(self, *args: Tensor) -> Tensor:
        """Calls the method."""
        return getattr(self.net, self.method)(*args)
