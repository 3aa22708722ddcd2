"""TeamNetworks: what the losses are written with; all agents' networks with one set of parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rllib_maobs.modules import Params, PerAgent, Seen, Shared, Stack
from rllib_maobs.modules.exploration import gumbel
from rllib_maobs.modules.stack import Input
from rllib_maobs.modules.team import Actors, Critics
from rllib_maobs.replay import Batch, Moment

ACTOR, CRITIC, MIXER = "actor", "critic", "mixer"


@dataclass(frozen=True)
class Parts:
    """What does not depend on parameters: the networks by role, and constants of the team.

    Attributes:
        config: The algorithm's configuration.
        actors: The networks that act; for Q-learning the utilities.
        acting_role: Whose parameters theirs are: "actor", or "critic" for utilities.
        critics: The critics, or None.
        mixers: The mixers, or None.
        action_mask: False where shorter actions are padded, `(N, A)`; None if none are.
        agent_ids: One-hot vectors `(N, N)` for critics that are told whose value they are to give; None if they are
            not.
    """

    config: Any
    actors: Actors
    acting_role: str
    critics: Critics | None
    mixers: Stack | None
    action_mask: Tensor | None
    agent_ids: Tensor | None


class TeamNetworks:
    """All agents' networks with one set of parameters, e.g. the online or the target ones.

    Everything is computed for all agents at once; agent i's part of a result is at `[:, i]`.

    Args:
        parts: The networks, and the team's constants.
        params: Parameters by role ("actor", "critic", "mixer").
        encoded_by: Networks with the same critics. What those have encoded is not computed again, and is a constant
            here.
    """

    def __init__(self, parts: Parts, params: Mapping[str, Params], encoded_by: TeamNetworks | None = None) -> None:
        self.parts, self.params = parts, params
        self.config = parts.config
        # What the critics saw of states, and their share of it.
        self._encoded: list[tuple[Input, Input]] = []
        if encoded_by is not None:
            for state, encoded in encoded_by._encoded:
                self._encoded.append((state, encoded._replace(tensor=encoded.tensor.detach())))

    def outputs(self, moment: Moment) -> Tensor:
        """Every acting network's raw outputs for what its agent sees, before tanh or softmax: `(B, N, A)`."""
        obs = moment.obs if moment.window is None else moment.window
        params = self.params[self.parts.acting_role]
        return self.parts.actors.outputs(params, Seen(obs, moment.mask, moment.recurrent_state))[0]

    def actions(self, outputs: Tensor, noise: Tensor | None) -> Tensor:
        """Actions of the actors' outputs: tanh, or for discrete actions a straight-through Gumbel-softmax.

        The discrete action is one-hot, a draw from the softmax of the outputs; its gradient is that of the
        softmax itself (Jang et al. 2017).

        Args:
            outputs: Of `outputs`, `(B, N, A)`.
            noise: Uniform random numbers in [0, 1) of the same shape, if actions are discrete.

        Returns:
            `(B, N, A)`.
        """
        if not self.config.team.discrete:
            return self._cut(torch.tanh(outputs))
        assert noise is not None
        soft = F.softmax((self.legal(outputs) + gumbel(noise)) / self.config.gumbel_temperature, dim=-1)
        return highest(soft) + soft - soft.detach()

    def next_actions(self, batch: Batch) -> Tensor:
        """mu(o') of these networks, smoothed by clipped noise if so configured (TD3): `(B, N, A)`."""
        outputs, config = self.outputs(batch.next), self.config
        if config.team.discrete:
            return highest(self.legal(outputs))
        actions = self.actions(outputs, None)
        if not config.target_noise:
            return actions
        assert batch.noise is not None
        limit = config.target_noise_clip
        noise = (config.target_noise * batch.noise).clamp(-limit, limit)
        return self._cut((actions + noise).clamp(-1.0, 1.0))

    def legal(self, values: Tensor) -> Tensor:
        """Values of discrete actions `(B, N, A)`, very low for those that an agent has not."""
        mask = self.parts.action_mask
        return values if mask is None else values.masked_fill(~mask, -1e9)

    def _cut(self, actions: Tensor) -> Tensor:
        """Actions with zeros where they are padded."""
        mask = self.parts.action_mask
        return actions if mask is None else actions * mask

    def q(self, moment: Moment, actions: Tensor, *, others: Tensor | None = None) -> Tensor:
        """Every agent's Q_a of what its critic sees (`critic_sees`).

        Args:
            moment: When: the state, or the observations.
            actions: All agents' actions, `(B, N, A)`.
            others: What critic a is to see in the place of all other agents' actions, `(B, N, A)`: then Q_a's gradient
                is that of agent a's action alone.

        Returns:
            `(B, N, C)`; C is 1, or 2 with `twin_critics`.
        """
        state, action = self.config.critic_sees
        seen: Input = PerAgent(moment.obs) if state == "observation" else Shared(_given(moment.state))
        if action == "action":
            of_actions: Input = PerAgent(actions)
        elif others is None:
            of_actions = Shared(actions.flatten(1))
        else:
            of_actions = PerAgent(one_current(actions, others).flatten(2))
        return self._values(seen, of_actions)

    def cross_q(self, moment: Moment, actions: Tensor, *, others: Tensor | None = None) -> Tensor:
        """Every local critic's value of every agent, Q_a(o_j, u_j); the arguments are those of `q`.

        Returns:
            `(B, N, N, C)`; critic a first, then agent j.
        """
        of_actions: Input = Shared(actions) if others is None else PerAgent(one_current(actions, others))
        return self._values(Shared(moment.obs), of_actions)

    def _values(self, state: Input, action: Input) -> Tensor:
        critics, params = self.parts.critics, self.params[CRITIC]
        assert critics is not None
        for seen, encoded in self._encoded:
            if seen.tensor is state.tensor and type(seen) is type(state):
                return critics.values(params, encoded, action, self.parts.agent_ids)
        self._encoded.append((state, critics.encode(params, state)))
        return critics.values(params, self._encoded[-1][1], action, self.parts.agent_ids)

    def mix(self, values: Tensor, moment: Moment) -> Tensor:
        """The team's Q_tot(s, Q_1..Q_N) of values `(B, N)`: `(B, 1)`."""
        return self._mixed(Shared(values), moment)

    def mix_each(self, values: Tensor, moment: Moment) -> Tensor:
        """The Q_tot of N mixers, each of values of its own `(B, N, N)`: `(B, N)`."""
        return self._mixed(PerAgent(values), moment)

    def _mixed(self, values: Input, moment: Moment) -> Tensor:
        assert self.parts.mixers is not None
        mixed: Tensor = self.parts.mixers(self.params[MIXER], values, Shared(_given(moment.state)))
        return mixed


def _given(state: Tensor | None) -> Tensor:
    assert state is not None, "The algorithm sees a state, but the minibatch has none."
    return state


def highest(values: Tensor) -> Tensor:
    """One-hot vectors of the highest values `(..., A)`; unlike `F.one_hot`, which looks at numbers, it is recorded."""
    return (values.argmax(-1, keepdim=True) == torch.arange(values.shape[-1], device=values.device)).to(values.dtype)


def one_current(actions: Tensor, fixed: Tensor) -> Tensor:
    """For every agent a the joint action in which its own is its current one and the others' are fixed.

    Args:
        actions: Current actions, with a gradient, `(B, N, A)`.
        fixed: The others', `(B, N, A)`.

    Returns:
        `(B, N, N, A)`; the first N runs over the agents a.
    """
    own = torch.eye(actions.shape[1], device=actions.device, dtype=actions.dtype)[:, :, None]  # (N, N, 1)
    return own * actions[:, None] + (1.0 - own) * fixed[:, None]


def squared_error(y: Tensor, q: Tensor) -> Tensor:
    """E[(y - Q)^2] of every agent `(N,)` for targets `(B, N)` and `(B, N, C)`; summed over the C critics."""
    return (y.unsqueeze(-1) - q).square().mean(0).sum(-1)
