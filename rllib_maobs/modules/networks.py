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
    """Deterministic policy mu(o): observation in, action in [-1, 1] out.

    Args:
        observation_size: O, length of the agent's observation.
        action_size: A, length of its action.
        hidden_sizes: Width of each hidden layer.
        activation: A key of `ACTIVATIONS`.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden_sizes: Sequence[int] = (64, 64, 64),
        activation: str = "relu",
    ) -> None:
        super().__init__()
        self.layers = mlp((observation_size, *hidden_sizes, action_size), activation)

    def forward(self, observation: Tensor) -> Tensor:
        """Maps observations `(..., O)` to actions `(..., A)` in [-1, 1]."""
        return torch.tanh(self.layers(observation))


class Critic(nn.Module):
    """Action value Q(s, u), an MLP on the concatenation of a state and an action.

    What "state" and "action" are is the algorithm's choice: (o_i, u_i) in IDDPG, (s, u_1..u_N) in MADDPG,
    (s, u_i) in MADDPG-L. The first layer is kept in two parts, one for each of its inputs, because its product
    with the state is the same for Q(s, u) of the critic loss and Q(s, mu(o)) of the actor loss: the state is by
    far the widest input, so computing `encode` once for both saves a third of the critic's work at nine agents.

    Args:
        state_size: S, length of the state part of the input.
        action_size: Length of the action part of the input.
        hidden_sizes: Width of each hidden layer.
        activation: A key of `ACTIVATIONS`.
    """

    def __init__(
        self,
        state_size: int,
        action_size: int,
        hidden_sizes: Sequence[int] = (64, 64, 64),
        activation: str = "relu",
    ) -> None:
        super().__init__()
        first = nn.Linear(state_size + action_size, hidden_sizes[0])  # initialised as the one layer that it is
        self.from_state = nn.Linear(state_size, hidden_sizes[0], bias=False)
        self.from_action = nn.Linear(action_size, hidden_sizes[0])
        self.from_state.weight.data.copy_(first.weight[:, :state_size])
        self.from_action.weight.data.copy_(first.weight[:, state_size:])
        self.from_action.bias.data.copy_(first.bias)
        self.activation = ACTIVATIONS[activation]()
        self.rest = mlp((*hidden_sizes, 1), activation)

    def encode(self, state: Tensor) -> Tensor:
        """The first layer's share of the state: `(..., S)` to `(..., H)`."""
        return self.from_state(state)

    def value(self, encoded_state: Tensor, action: Tensor) -> Tensor:
        """Q from an encoded state `(..., H)` and an action `(..., A)`: shape `(...)`."""
        return self.rest(self.activation(encoded_state + self.from_action(action))).squeeze(-1)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Q(s, u) for states `(..., S)` and actions `(..., A)`: shape `(...)`."""
        return self.value(self.encode(state), action)
