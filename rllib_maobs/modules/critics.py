"""Critics: from a state and an action to values. A class of your own plugs in here."""

from __future__ import annotations

from abc import ABC
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from rllib_maobs.layout import Layout, layout_size
from rllib_maobs.modules.actors import first_to_define
from rllib_maobs.modules.layers import ACTIVATIONS, mlp
from rllib_maobs.registry import Registry


class Critic(nn.Module, ABC):
    """Base of all critics: derive from it, and give the class as `.training(critic=MyCritic)`.

    What "state" and "action" are is the algorithm's choice (`JointConfig.critic_sees`): (o_i, u_i) in IDDPG,
    (s, u_1..u_N) in MADDPG, (s, u_i) in MADDPG-L. Override `forward`. Or, where the part of it that sees only the state
    is worth computing once for the critics' and the actors' loss (for an MLP with nine agents' observations it is a
    tenth of the update, and no compiler finds it), override `encode` and `value`.

    ```python
    class Bilinear(Critic):
        def __init__(self, state_layout, action_layout, num_critics=1, num_agents=0, rank: int = 8):
            super().__init__(state_layout, action_layout, num_critics, num_agents)
            self.of_state = nn.Linear(layout_size(state_layout), num_critics * rank)
            self.of_action = nn.Linear(layout_size(action_layout), num_critics * rank)

        def forward(self, state, action, agent=None):
            product = self.of_state(state) * self.of_action(action)
            return product.unflatten(-1, (self.num_critics, -1)).sum(-1)


    config.training(critic=Bilinear, critic_settings={"rank": 4})
    ```

    Critics are stacked like actors: what `Actor` says of `forward` and of settings holds for them, too.

    Attributes:
        asks_whose: Whether a centralised critic of this class must always be told whose value it is to give, because
            nothing else in its input says so.

    Args:
        state_layout: What the state part of the input is made of.
        action_layout: What the action part is made of.
        num_critics: C, independent critics of the same inputs (two of them for TD3's minimum).
        num_agents: N, if it is told whose value is asked; 0 if it is not.
    """

    asks_whose: ClassVar[bool] = False

    def __init__(self, state_layout: Layout, action_layout: Layout, num_critics: int = 1, num_agents: int = 0) -> None:
        super().__init__()
        self.state_layout, self.action_layout = state_layout, action_layout
        self.num_critics, self.num_agents = num_critics, num_agents

    def encode(self, state: Tensor) -> Tensor:
        """What of the value depends on the state `(..., S)` alone; the state itself, unless overridden."""
        return state

    def value(self, encoded: Tensor, action: Tensor, agent: Tensor | None = None) -> Tensor:
        """Q of every critic, from what `encode` returned: `(..., C)`; the other arguments are those of `forward`."""
        if type(self).forward is Critic.forward:
            raise TypeError(f"{type(self).__name__} must override forward, or encode and value, of Critic.")
        return self(encoded, action, agent)

    def forward(self, state: Tensor, action: Tensor, agent: Tensor | None = None) -> Tensor:
        """Q of every critic.

        Args:
            state: `(..., S)`.
            action: `(..., A)`.
            agent: Whose value it is, a one-hot vector `(..., N)`; None if `num_agents` is 0.

        Returns:
            `(..., C)`.
        """
        return self.value(self.encode(state), action, agent)


def splits(cls: type[Critic]) -> bool:
    """Whether a critic's values are to be computed by `encode` and `value`: not if `forward` is what was overridden."""
    base = cls.__mro__.index(Critic)
    encode, value = first_to_define(cls, "encode"), first_to_define(cls, "value")
    return encode < base and value < base and first_to_define(cls, "forward") >= min(encode, value)


class MLPCritic(Critic):
    """Layers on the state and the action side by side; with C critics, C of them.

    The first layer is kept in two parts, one for each input, so that the state's product is computed once for
    Q(s, u) of the critic loss and Q(s, mu(o)) of the actor loss: the state is by far the widest input.

    Args:
        state_layout: What the state part is made of; only its length S matters here.
        action_layout: What the action part is made of; only its length matters here.
        num_critics: C.
        num_agents: N, if the one-hot vector of the agent is a further input; 0 if not.
        hidden_sizes: Width of each hidden layer.
        activation: A key of `ACTIVATIONS`.
    """

    def __init__(
        self,
        state_layout: Layout,
        action_layout: Layout,
        num_critics: int = 1,
        num_agents: int = 0,
        hidden_sizes: Sequence[int] = (64, 64, 64),
        activation: str = "relu",
    ) -> None:
        super().__init__(state_layout, action_layout, num_critics, num_agents)
        state_size, action_size = layout_size(state_layout), layout_size(action_layout) + num_agents
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

    def value(self, encoded: Tensor, action: Tensor, agent: Tensor | None = None) -> Tensor:
        """Q of every critic: `(..., C * H)` and `(..., A)` to `(..., C)`."""
        if agent is not None:
            action = torch.cat([action, agent.expand(*action.shape[:-1], -1)], dim=-1)
        first = self.activation(encoded + self.from_action(action))
        parts = first.chunk(self.num_critics, dim=-1)
        return torch.cat([rest(part) for rest, part in zip(self.rest, parts, strict=True)], dim=-1)


CRITICS: Registry[Critic] = Registry("critic", Critic)
"""Critics by name, for `.training(critic=...)`."""
CRITICS.register("mlp", MLPCritic)
