"""Networks of several agents as one: their parameters in one flat tensor, one call for all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.utils._pytree import tree_map

from rllib_maobs.memory import keep_freed_memory
from rllib_maobs.modules.tracing import traced
from rllib_maobs.registry import same

Params = dict[str, Tensor]
"""Parameters of stacked networks: each `(M, *shape)`, for the M alike networks of a group, as "group.name"."""
Function = str | Callable[..., Any]
"""A method of a network by name, or a function of a network and its inputs."""


class PerAgent(NamedTuple):
    """An input of which every agent has its own part.

    Attributes:
        tensor: The parts of all N agents, e.g. `(B, N, O)`.
        dim: The dimension that runs over the agents.
    """

    tensor: Tensor
    dim: int = 1


class Shared(NamedTuple):
    """An input that all agents see alike, e.g. `(B, S)`."""

    tensor: Tensor


Input = PerAgent | Shared


class _Group:
    """Alike networks, each used by equally many agents: one batched computation.

    Attributes:
        networks: The M networks.
        members: Who uses each of them.
        agents: Who uses the first of them, then the second, ...
        shapes: Of their stacked parameters, `(M, *shape)`, by name.
    """

    def __init__(self, networks: list[nn.Module], members: list[list[int]], functions: Sequence[Function]) -> None:
        self.networks, self.members = networks, members
        self.agents = [agent for agents in members for agent in agents]
        # The first network only lends its code; functional_call puts the stacked parameters in its own's place.
        self._calls = {function: _Call(networks[0], function) for function in functions}
        self.shapes = {name: (len(networks), *p.shape) for name, p in networks[0].named_parameters()}

    def __call__(self, params: Params, inputs: Sequence[Input], function: Function) -> Any:
        """The output for this group's agents, in its order, at dimension 1."""
        networks, users = len(self.networks), len(self.agents) // len(self.networks)
        tensors, dims = [], []
        for given in inputs:
            dim = given.dim if isinstance(given, PerAgent) else None
            tensors.append(given.tensor if dim is None else _take(given.tensor, self.agents, dim))
            dims.append(dim)
        call = self._calls[function]

        def one(p: Params, *args: Tensor) -> Any:
            return functional_call(call, {f"net.{k}": v for k, v in p.items()}, args)

        def shared(p: Params, *args: Tensor) -> Any:
            """One network for all its users: its weights meet all their inputs in one product."""
            if any(dim is not None for dim in dims):
                return _over(one, (None, *dims))(p, *args)
            return _expanded(one(p, *args), users)

        if users == 1:
            return _over(one, (0, *dims))(params, *tensors)
        if networks == 1:
            return shared({name: value[0] for name, value in params.items()}, *tensors)
        tensors = [
            tensor if dim is None else tensor.unflatten(dim, (networks, users))
            for tensor, dim in zip(tensors, dims, strict=True)
        ]
        output = _over(shared, (0, *dims))(params, *tensors)
        return tree_map(lambda tensor: tensor.flatten(1, 2), output)


class Stack:
    """The networks of N agents, whose parameters live in one flat tensor.

    The networks stay ordinary modules: each of their parameters becomes a view of `flat`, so a checkpoint
    of one of them, `load_state_dict` into one of them, and an optimiser step on `flat` all see the same
    numbers. One flat vector per role also makes Adam and Polyak averaging a single pass each.

    Alike networks (of one class, with parameters of the same names and shapes, and with the same settings and layouts)
    are one batched computation; others make further ones. Agents may share a network (parameter sharing): it then has
    its parameters once, however many agents use it. Parameters may have any shape.

    Args:
        networks: Every agent's network. One that is listed several times is shared.
        functions: What the stack can call.
        names: What to call each network in messages, e.g. "the actor of agent_0".
        tie: Whether all agents are to share the parameters of the first network.
        like: The stack of networks that these are copies of (target networks): grouped as those are.

    Raises:
        ValueError: If a network can't be stacked; says which and why.
    """

    def __init__(
        self,
        networks: Sequence[nn.Module],
        functions: Sequence[Function] = ("forward",),
        names: Sequence[str] | None = None,
        tie: bool = False,
        like: Stack | None = None,
    ) -> None:
        keep_freed_memory()  # what one call frees, the next one takes
        self.networks = list(networks)
        self.names = list(names or (f"network {i}" for i in range(len(networks))))
        for net, name in zip(networks, self.names, strict=True):
            _check(net, name)
        owners = [networks[0]] * len(networks) if tie else self.networks
        _check_apart(owners, self.names)
        users: dict[int, list[int]] = {}
        for agent, net in enumerate(owners):
            users.setdefault(id(net), []).append(agent)
        if like is not None:
            members: list[list[list[int]]] = [group.members for group in like._groups]
        else:
            members = []
            for agents in users.values():
                for alike in members:
                    if len(alike[0]) == len(agents) and _alike(owners[alike[0][0]], owners[agents[0]]):
                        alike.append(agents)
                        break
                else:
                    members.append([agents])
        if tie and (other := next((net for net in networks if not _alike(net, networks[0])), None)) is not None:
            raise ValueError(f"{self.names[self.networks.index(other)]} can't share {self.names[0]}: they differ.")
        self._groups: list[_Group] = [
            _Group([owners[agents[0]] for agents in alike], alike, functions) for alike in members
        ]
        order = [agent for group in self._groups for agent in group.agents]
        self._order = [order.index(agent) for agent in range(len(order))]
        # Where each agent's parameters are: the group, and which of its networks.
        self.places = [
            (g, group.agents.index(agent) * len(group.networks) // len(group.agents))
            for agent in range(len(order))
            for g, group in enumerate(self._groups)
            if agent in group.agents
        ]
        self.shapes: dict[str, tuple[int, ...]] = {
            f"{g}.{name}": shape for g, group in enumerate(self._groups) for name, shape in group.shapes.items()
        }
        first = next(networks[0].parameters())
        total = sum(torch.Size(shape).numel() for shape in self.shapes.values())
        self.flat = nn.Parameter(torch.empty(total, dtype=first.dtype, device=first.device))
        self.params: Params = self.unflatten(self.flat.detach())
        for agent, net in enumerate(owners):
            own = self.own(self.params, agent)
            for name, parameter in net.named_parameters():
                own[name].copy_(parameter.detach())
        # Parameters with requires_grad=False: constants, which no update moves.
        self.constants = {
            f"{g}.{name}"
            for g, group in enumerate((like or self)._groups)
            for name, parameter in group.networks[0].named_parameters()
            if not parameter.requires_grad
        }
        self._recorded: dict[tuple[Any, ...], Callable[..., Any]] = {}
        self._bind()

    def _bind(self) -> None:
        """Makes `params` and every network's own parameters views of `flat`."""
        self.params = self.unflatten(self.flat.detach())
        for agent, net in enumerate(self.networks):
            own = self.own(self.params, agent)
            for name, parameter in net.named_parameters():
                parameter.data = own[name]

    def own(self, params: Params, agent: int) -> Params:
        """One agent's part of stacked parameters (or gradients), by its network's names; views."""
        g, row = self.places[agent]
        return {name: params[f"{g}.{name}"][row] for name in self._groups[g].shapes}

    def share(self, other: Stack) -> None:
        """Uses the tensors of another stack of the same shape from now on, instead of copies of them.

        Raises:
            ValueError: If the other stack's networks have a different architecture or number.
        """
        if self.shapes != other.shapes or self.places != other.places:
            raise ValueError(f"Stacks differ: {self.shapes} and {other.shapes}.")
        self.flat = other.flat
        self._bind()

    def views(self, flat: Tensor) -> list[Tensor]:
        """A flat vector `(P,)` cut into one vector for each stacked parameter, in order; views."""
        return list(flat.split([torch.Size(shape).numel() for shape in self.shapes.values()]))

    def unflatten(self, flat: Tensor) -> Params:
        """Views of a flat vector `(P,)` as stacked parameters by name."""
        # Weights lie input by output: the order in which batched products take them, and leave their gradients.
        return {
            name: view.view(shape) if len(shape) != 3 else view.view(shape[0], shape[2], shape[1]).mT
            for (name, shape), view in zip(self.shapes.items(), self.views(flat), strict=True)
        }

    def flatten(self, params: Params) -> list[Tensor]:
        """Stacked parameters (or gradients) as `views` has them; copied only where they lie otherwise in memory."""
        return [(p if p.dim() != 3 else p.mT).reshape(-1) for p in (params[name] for name in self.shapes)]

    def __call__(self, params: Params, *inputs: Input, function: Function = "forward") -> Any:
        """Applies all agents' networks at once.

        Args:
            params: Stacked parameters to use, e.g. `self.params` or the tracked ones inside `torch.func.grad`.
            *inputs: What the networks are called with.
            function: One of the stack's functions.

        Returns:
            The output (a tensor, or a tuple of them), with the N agents at dimension 1: `(B, N, ...)`. Shorter outputs
            of some agents are padded with zeros.
        """
        outputs = []
        for g, group in enumerate(self._groups):
            own = {name: params[f"{g}.{name}"] for name in group.shapes}
            outputs.append(group(own, inputs, function))
        return outputs[0] if len(outputs) == 1 and self._in_order else self._gathered(outputs)

    @property
    def _in_order(self) -> bool:
        return self._order == list(range(len(self._order)))

    def _gathered(self, outputs: list[Any]) -> Any:
        """The groups' outputs, in the order of the agents."""
        if isinstance(outputs[0], tuple):
            return tuple(self._gathered(list(parts)) for parts in zip(*outputs, strict=True))
        width = max(output.shape[-1] for output in outputs)
        padded = [
            nn.functional.pad(output, (0, width - output.shape[-1]))
            if output.dim() > 2 and output.shape[-1] != width
            else output
            for output in outputs
        ]
        return _take(torch.cat(padded, dim=1) if len(padded) > 1 else padded[0], self._order, 1)

    @torch.no_grad()
    def act(self, *inputs: Input, function: Function = "forward") -> Any:
        """`__call__` with the present parameters and without gradients, for one call after the other.

        Its tensor operations are recorded at the first call for inputs of some shape, see `traced`.
        """
        kinds = [(type(given), given[1:]) for given in inputs]
        tensors = [given.tensor for given in inputs]
        key = (function, *map(str, kinds), *(tensor.shape for tensor in tensors))
        if key not in self._recorded:

            def call(params: Params, *tensors: Tensor) -> Any:
                again = [kind(tensor, *rest) for tensor, (kind, rest) in zip(tensors, kinds, strict=True)]
                return self(params, *again, function=function)

            self._recorded[key] = traced(call, self.params, *tensors)
        return self._recorded[key](self.params, *tensors)


_MODULE = frozenset(vars(nn.Module()))  # what every module has


def _own(net: nn.Module) -> dict[str, Any]:
    """The plain attributes of a network and of all its parts, by name."""
    return {
        f"{part}.{name}" if part else name: value
        for part, module in net.named_modules()
        for name, value in vars(module).items()
        if name not in _MODULE
    }


def _check(net: nn.Module, name: str) -> None:
    """Raises a ValueError if a network can't be stacked."""
    what = f"{name} ({type(net).__name__}) can't be stacked"
    if buffers := [key for key, _ in net.named_buffers()]:
        raise ValueError(
            f"{what}: it has the buffers {buffers} (BatchNorm?). Use LayerNorm, or parameters with requires_grad=False."
        )
    for key, value in _own(net).items():
        values = [*value.values()] if isinstance(value, dict) else value if isinstance(value, list | tuple) else [value]
        if any(isinstance(part, Tensor | nn.Module) for part in values):
            raise ValueError(
                f"{what}: its attribute {key!r} hides tensors or modules. Use nn.ModuleList for layers, and for "
                f"constants nn.Parameter(..., requires_grad=False)."
            )
    parameters = list(net.named_parameters())
    if not parameters:
        raise ValueError(f"{what}: it has no parameters.")
    kinds = {(p.dtype, p.device) for _, p in parameters}
    if len(kinds) > 1:
        raise ValueError(
            f"{what}: its parameters must be of one type and on one device, not "
            f"{ {key: (p.dtype, str(p.device)) for key, p in parameters} }."
        )


def _check_apart(owners: Sequence[nn.Module], names: Sequence[str]) -> None:
    """Raises a ValueError if networks of different agents have a parameter in common, or different types of numbers."""
    owner_of: dict[int, nn.Module] = {}
    for net, name in zip(owners, names, strict=True):
        for key, parameter in net.named_parameters():
            if owner_of.setdefault(id(parameter), net) is not net:
                raise ValueError(
                    f"{name} ({type(net).__name__}) can't be stacked: its parameter {key!r} is another agent's, too."
                )
            if parameter.dtype != next(owners[0].parameters()).dtype:
                raise ValueError(
                    f"{name} has parameters of {parameter.dtype}, {names[0]} others: they can't be stacked."
                )


def _alike(net: nn.Module, other: nn.Module) -> bool:
    """Whether networks differ in the numbers of their parameters alone."""
    shapes = [[(name, tuple(p.shape), p.requires_grad) for name, p in each.named_parameters()] for each in (net, other)]
    return (
        type(net) is type(other)
        and shapes[0] == shapes[1]
        and repr(net) == repr(other)
        and same(_own(net), _own(other))
    )


def _over(function: Callable[..., Any], dims: tuple[int | None, ...]) -> Callable[..., Any]:
    """`vmap` with the agents at dimension 1, also of an output that depends on no agent."""

    def call(*args: Any) -> Any:
        return tree_map(lambda tensor: tensor.movedim(0, 1), vmap(function, in_dims=dims)(*args))

    return call


def _expanded(output: Any, users: int) -> Any:
    """What all users of a network have alike, `(B, users, ...)`."""
    return tree_map(lambda same: same.unsqueeze(1).expand(-1, users, *same.shape[1:]), output)


def _take(tensor: Tensor, positions: list[int], dim: int) -> Tensor:
    """The entries at some positions along a dimension: a view if they are neighbours."""
    start, count = positions[0], len(positions)
    if positions == list(range(start, start + count)):
        return tensor if count == tensor.shape[dim] else tensor.narrow(dim, start, count)
    return tensor.index_select(dim, torch.tensor(positions, device=tensor.device))


class _Call(nn.Module):
    """Lets `functional_call` run a method other than forward, or a function of the network."""

    def __init__(self, net: nn.Module, function: Function) -> None:
        super().__init__()
        self.net, self.function = net, function

    def forward(self, *args: Tensor) -> Any:
        """Calls it."""
        return (
            getattr(self.net, self.function)(*args)
            if isinstance(self.function, str)
            else self.function(self.net, *args)
        )
