"""Plain actor and critic networks: what an `AgentModule` holds and what can be lifted into any project."""

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn

ACTIVATIONS: dict[str, type[nn.Module]] = {
    "relu": nn.ReLU,
    "tanh": nn.Tanh,
    "elu": nn.ELU,
    "leaky_relu": nn.LeakyReLU,
    "silu": nn.SiLU,
}


def mlp(sizes: Sequence[int], activation: str = "relu") -> nn.Sequential:
    """Stacks linear layers with an activation between them (none after the last).

    Args:
        sizes: Width of every layer from input to output, e.g. `(18, 64, 64, 5)`.
        activation: A key of `ACTIVATIONS`.

    Returns:
        The network, mapping `(..., sizes[0])` to `(..., sizes[-1])`.
    """
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        layers += [nn.Linear(fan_in, fan_out), ACTIVATIONS[activation]()]
    return nn.Sequential(*layers[:-1])


class MLPActor(nn.Module):
    """Deterministic policy mu(o), or one value for each of A discrete actions.

    Args:
        observation_size: O, length of the agent's observation.
        action_size: A, length of its action, or the number of its discrete actions.
        hidden_sizes: Width of each hidden layer.
        activation: A key of `ACTIVATIONS`.
        discrete: Whether the output is a value for each discrete action (logits, or Q) instead of an action.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden_sizes: Sequence[int] = (64, 64, 64),
        activation: str = "relu",
        discrete: bool = False,
    ) -> None:
        super().__init__()
        self.discrete = discrete
        self.layers = mlp((observation_size, *hidden_sizes, action_size), activation)

    def raw(self, observation: Tensor) -> Tensor:
        """The last layer's output `(..., A)`, not squashed."""
        return self.layers(observation)

    def forward(self, observation: Tensor) -> Tensor:
        """Maps observations `(..., O)` to actions `(..., A)` in [-1, 1], or to the values of discrete actions."""
        output = self.raw(observation)
        return output if self.discrete else torch.tanh(output)


class LSTMActor(nn.Module):
    """Deterministic policy over a window of the last T observations (eq. 10).

    An LSTM cell takes the place of the first hidden layer and reads the window from its oldest observation to
    its newest, from zero h and c or from given ones; the other layers see its last h. Observations that the
    mask leaves out (before the episode began) do not count: a masked window equals a shorter one. The cell is written
    with linear layers, so it can be stacked; its numbers are those of `nn.LSTM` with one bias.

    Args:
        observation_size: O.
        action_size: A, length of the action, or the number of discrete actions.
        hidden_sizes: Width of each hidden layer; the cell takes the place of the first.
        activation: Of the further layers, a key of `ACTIVATIONS`.
        discrete: Whether the output is a value for each discrete action instead of an action.
        cell_size: H, size of h and c; None for that of the layer whose place the cell takes.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden_sizes: Sequence[int] = (64, 64, 64),
        activation: str = "relu",
        discrete: bool = False,
        cell_size: int | None = None,
    ) -> None:
        super().__init__()
        self.discrete = discrete
        size = cell_size or hidden_sizes[0]
        self.from_observation = nn.Linear(observation_size, 4 * size)
        self.from_hidden = nn.Linear(size, 4 * size, bias=False)
        for parameter in self.parameters():  # nn.LSTM's own way to start
            nn.init.uniform_(parameter, -(size**-0.5), size**-0.5)
        self.layers = mlp((size, *hidden_sizes[1:], action_size), activation)

    def unroll(
        self, window: Tensor, mask: Tensor, hidden: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Runs the cell over a window.

        Args:
            window: Observations, oldest first, `(..., T, O)`.
            mask: 1.0 where an observation counts, 0.0 where it lies before the episode's start, `(..., T)`.
            hidden: h and c to start from, `(..., H)` each; None for zeros.

        Returns:
            The last h and c, `(..., H)` each.
        """
        # Transposed once, not at every step: so the steps' gradients add up as they lie in memory.
        from_observation, from_hidden = self.from_observation.weight.mT, self.from_hidden.weight.mT
        for observation, counts in zip(window.unbind(-2), mask.unbind(-1), strict=True):
            gates = observation @ from_observation + self.from_observation.bias
            i, f, g, o = (gates if hidden is None else gates + hidden[0] @ from_hidden).chunk(4, dim=-1)
            c = torch.sigmoid(i) * _tanh(g)
            if hidden is not None:
                c = c + torch.sigmoid(f) * hidden[1]
            h = torch.sigmoid(o) * _tanh(c)
            valid = counts.unsqueeze(-1) > 0
            if hidden is None:
                hidden = torch.where(valid, h, 0.0), torch.where(valid, c, 0.0)
            else:
                hidden = torch.where(valid, h, hidden[0]), torch.where(valid, c, hidden[1])
        assert hidden is not None
        return hidden

    def raw(self, window: Tensor, mask: Tensor, hidden: Tensor | None = None) -> Tensor:
        """The last layer's output `(..., A)` for the window's last observation, not squashed."""
        return self.layers(self.unroll(window, mask, _pair(hidden))[0])

    def forward(self, window: Tensor, mask: Tensor, hidden: Tensor | None = None) -> Tensor:
        """Maps windows to actions, or to the values of discrete actions.

        Args:
            window: Observations, oldest first, `(..., T, O)`.
            mask: Which of them count, `(..., T)`.
            hidden: h and c to start from, `(..., 2, H)`; None for zeros.

        Returns:
            Actions in [-1, 1], or values, `(..., A)`.
        """
        output = self.raw(window, mask, hidden)
        return output if self.discrete else torch.tanh(output)

    def carry(self, window: Tensor, mask: Tensor, hidden: Tensor | None = None) -> Tensor:
        """The h and c `(..., 2, H)` with which a window ends: the next one may start from them."""
        return torch.stack(self.unroll(window, mask, _pair(hidden)), -2)

    def head(self, hidden: Tensor) -> Tensor:
        """What `forward` makes of the h and c `(..., 2, H)` with which its window ends."""
        output = self.layers(hidden[..., 0, :])
        return output if self.discrete else torch.tanh(output)


def _pair(hidden: Tensor | None) -> tuple[Tensor, Tensor] | None:
    return None if hidden is None else (hidden[..., 0, :], hidden[..., 1, :])


def _tanh(x: Tensor) -> Tensor:
    """Hyperbolic tangent by way of the sigmoid: compiled, torch's own takes three times as long."""
    return 2.0 * torch.sigmoid(2.0 * x) - 1.0


ACTORS: dict[str, type[MLPActor] | type[LSTMActor]] = {"mlp": MLPActor, "lstm": LSTMActor}


class Critic(nn.Module):
    """Action value Q(s, u), an MLP on the concatenation of a state and an action; or C of them side by side.

    What "state" and "action" are is the algorithm's choice: (o_i, u_i) in IDDPG, (s, u_1..u_N) in MADDPG,
    (s, u_i) in MADDPG-L. The first layer is kept in two parts, one for each of its inputs, because its product
    with the state is the same for Q(s, u) of the critic loss and Q(s, mu(o)) of the actor loss: the state is by
    far the widest input, so computing `encode` once for both saves a third of the critic's work at nine agents.

    Args:
        state_size: S, length of the state part of the input.
        action_size: Length of the action part of the input.
        hidden_sizes: Width of each hidden layer.
        activation: A key of `ACTIVATIONS`.
        num_critics: C, independent critics of the same inputs (two of them for TD3's minimum).
    """

    def __init__(
        self,
        state_size: int,
        action_size: int,
        hidden_sizes: Sequence[int] = (64, 64, 64),
        activation: str = "relu",
        num_critics: int = 1,
    ) -> None:
        super().__init__()
        width = num_critics * hidden_sizes[0]
        first = nn.Linear(state_size + action_size, width)  # initialised as the one layer that it is
        self.from_state = nn.Linear(state_size, width, bias=False)
        self.from_action = nn.Linear(action_size, width)
        self.from_state.weight.data.copy_(first.weight[:, :state_size])
        self.from_action.weight.data.copy_(first.weight[:, state_size:])
        self.from_action.bias.data.copy_(first.bias)
        self.activation = ACTIVATIONS[activation]()
        self.rest = nn.ModuleList(mlp((*hidden_sizes, 1), activation) for _ in range(num_critics))

    def encode(self, state: Tensor) -> Tensor:
        """The first layers' share of the state: `(..., S)` to `(..., C * H)`."""
        return self.from_state(state)

    def value(self, encoded_state: Tensor, action: Tensor) -> Tensor:
        """Q of every critic from an encoded state `(..., C * H)` and an action `(..., A)`: `(..., C)`."""
        first = self.activation(encoded_state + self.from_action(action))
        parts = first.chunk(len(self.rest), dim=-1)
        return torch.cat([rest(part) for rest, part in zip(self.rest, parts, strict=True)], dim=-1)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Q(s, u) of every critic for states `(..., S)` and actions `(..., A)`: `(..., C)`."""
        return self.value(self.encode(state), action)
