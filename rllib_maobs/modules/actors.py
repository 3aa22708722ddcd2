"""Actors: from what an agent sees to raw outputs. What an `AgentModule` holds; a class of your own plugs in here."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, ClassVar

import torch
from torch import Tensor, nn

from rllib_maobs.layout import Layout, layout_size
from rllib_maobs.modules.layers import mlp
from rllib_maobs.options import Range
from rllib_maobs.registry import Registry


class Actor(nn.Module, ABC):
    """Base of all actors: derive from it, and give the class as `.training(actor=MyActor)`.

    An actor maps observations to raw outputs. Squashing by tanh, drawing discrete actions and exploration are not its
    business; with discrete actions its outputs are one value for each (logits, or Q).

    ```python
    class Linear(Actor):
        def __init__(self, layout, num_outputs, scale: float = 1.0):
            super().__init__(layout, num_outputs)
            self.layer, self.scale = nn.Linear(layout_size(layout), num_outputs), scale

        def forward(self, observation):
            return self.scale * self.layer(observation)


    config.training(actor=Linear, actor_settings={"scale": 0.5})
    ```

    All agents' actors are stacked and called at once (see `Stack`), by `torch.func.vmap`. So `forward` is made of
    tensor operations on any leading dimensions: no branch on a tensor's values, no buffers (BatchNorm), no random
    numbers, and no `nn.LSTMCell` and its like, for which vmap has no rule. Parameters may have any shape; constants are
    parameters with `requires_grad=False`. The constructor's first parameters have these names; a further one is a
    setting. Its type hint is checked, and one named `hidden_sizes`, `activation` or `cell_size` is set by RLlib's
    `model_config`, too.

    Attributes:
        takes_groups: Whether an observation may also be given as its groups by name, with any number of entities in
            each: `{"target": (..., count, size), ...}`. Such an actor is exported for any number of them.

    Args:
        layout: What the agent's observation is made of.
        num_outputs: A, length of the agent's action, or the number of its discrete actions.
    """

    takes_groups: ClassVar[bool] = False

    def __init__(self, layout: Layout, num_outputs: int) -> None:
        super().__init__()
        self.layout, self.num_outputs = layout, num_outputs

    @abstractmethod
    def forward(self, observation: Tensor) -> Tensor:
        """Maps observations `(..., O)` to raw outputs `(..., A)`."""


class RecurrentActor(Actor):
    """Base of actors with a state: they act on a window of the last T observations (`seq_length`).

    A state is one tensor of any shape. Windows start from `initial_state()` or, with `stored_state=True`, from the
    state with which the window one step earlier ended.
    """

    @abstractmethod
    def initial_state(self) -> Tensor:
        """The state before the first observation, of one agent: `(*H)`, without leading dimensions."""

    @abstractmethod
    def forward(self, observation: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        """One step: observations `(..., O)` and states `(..., *H)` to raw outputs `(..., A)` and the next states."""

    def unroll(self, window: Tensor, mask: Tensor | None = None, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Runs over windows of observations, `forward` after `forward`; override it where that can be done faster.

        Observations that the mask leaves out do not count: a masked window equals a shorter one.

        Args:
            window: Observations, oldest first, `(..., T, O)`.
            mask: 1.0 where one counts, 0.0 where it lies before the episode's start, `(..., T)`, broadcast; None if all
                count.
            state: To start from, `(..., *H)`; None for `initial_state()`.

        Returns:
            The outputs for the last observation `(..., A)`, and the state after it `(..., *H)`.
        """
        initial = self.initial_state().to(window)
        if state is None:
            state = initial.expand(*window.shape[:-2], *initial.shape)
        output = None
        for step, observation in enumerate(window.unbind(-2)):
            output, following = self(observation, state)
            if mask is not None:
                counts = mask[..., step] > 0
                following = torch.where(counts.reshape(*counts.shape, *[1] * initial.dim()), following, state)
            state = following
        assert output is not None
        return output, state


class MLPActor(Actor):
    """Layers between the observation and the outputs.

    Args:
        layout: What the agent's observation is made of; only its length O matters here.
        num_outputs: A.
        hidden_sizes: Width of each hidden layer.
        activation: A key of `ACTIVATIONS`.
    """

    def __init__(
        self,
        layout: Layout,
        num_outputs: int,
        hidden_sizes: Sequence[int] = (64, 64, 64),
        activation: str = "relu",
    ) -> None:
        super().__init__(layout, num_outputs)
        self.layers = mlp((layout_size(layout), *hidden_sizes, num_outputs), activation)

    def forward(self, observation: Tensor) -> Tensor:
        """Maps observations `(..., O)` to raw outputs `(..., A)`."""
        return self.layers(observation)


class LSTMActor(RecurrentActor):
    """An LSTM cell over the window takes the place of the first hidden layer; the others see its last h (eq. 10).

    The cell is written with linear layers, so it can be stacked; its numbers are those of `nn.LSTM` with one bias. The
    state is h and c, `(2, H)`.

    Args:
        layout: What the agent's observation is made of; only its length O matters here.
        num_outputs: A.
        hidden_sizes: Width of each hidden layer; the cell takes the place of the first.
        activation: Of the further layers, a key of `ACTIVATIONS`.
        cell_size: H, size of h and c.
    """

    def __init__(
        self,
        layout: Layout,
        num_outputs: int,
        hidden_sizes: Sequence[int] = (64, 64, 64),
        activation: str = "relu",
        cell_size: Annotated[int, Range(1)] = 64,
    ) -> None:
        super().__init__(layout, num_outputs)
        self.cell_size = size = cell_size
        self.from_observation = nn.Linear(layout_size(layout), 4 * size)
        self.from_hidden = nn.Linear(size, 4 * size, bias=False)
        for parameter in self.parameters():  # nn.LSTM's own way to start
            nn.init.uniform_(parameter, -(size**-0.5), size**-0.5)
        self.layers = mlp((size, *hidden_sizes[1:], num_outputs), activation)

    def initial_state(self) -> Tensor:
        """Zero h and c, `(2, H)`."""
        return torch.zeros(2, self.cell_size)

    def forward(self, observation: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        """One step: observations `(..., O)` and h and c `(..., 2, H)` to outputs `(..., A)` and the next h and c."""
        return self.unroll(observation.unsqueeze(-2), None, state)

    def unroll(self, window: Tensor, mask: Tensor | None = None, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """`RecurrentActor.unroll`, without the products with h = 0 of a first step from zero."""
        # Transposed once, not at every step: so the steps' gradients add up as they lie in memory.
        from_observation, from_hidden = self.from_observation.weight.mT, self.from_hidden.weight.mT
        h, c = (None, None) if state is None else state.unbind(-2)
        for step, observation in enumerate(window.unbind(-2)):
            gates = observation @ from_observation + self.from_observation.bias
            i, f, g, o = (gates if h is None else gates + h @ from_hidden).chunk(4, dim=-1)
            next_c = torch.sigmoid(i) * _tanh(g)
            if c is not None:
                next_c = next_c + torch.sigmoid(f) * c
            next_h = torch.sigmoid(o) * _tanh(next_c)
            if mask is not None:
                valid = mask[..., step].unsqueeze(-1) > 0
                next_h = torch.where(valid, next_h, 0.0 if h is None else h)
                next_c = torch.where(valid, next_c, 0.0 if c is None else c)
            h, c = next_h, next_c
        assert h is not None and c is not None
        return self.layers(h), torch.stack([h, c], dim=-2)


def first_to_define(cls: type, *methods: str) -> int:
    """How far up in a class's bases the first one is that defines one of the methods."""
    return next(i for i, base in enumerate(cls.__mro__) if any(method in vars(base) for method in methods))


def unrolled(
    actor: RecurrentActor, window: Tensor, mask: Tensor | None = None, state: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """`actor.unroll`; step by step where a derived class overrides `forward` alone."""
    if first_to_define(type(actor), "forward") < first_to_define(type(actor), "unroll"):
        return RecurrentActor.unroll(actor, window, mask, state)
    return actor.unroll(window, mask, state)


def _tanh(x: Tensor) -> Tensor:
    """Hyperbolic tangent by way of the sigmoid: compiled, torch's own takes three times as long."""
    return 2.0 * torch.sigmoid(2.0 * x) - 1.0


ACTORS: Registry[Actor] = Registry("actor", Actor)  # type: ignore[type-abstract]
"""Actors by name, for `.training(actor=...)`."""
ACTORS.register("mlp", MLPActor)
ACTORS.register("lstm", LSTMActor)
