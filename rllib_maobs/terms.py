"""Terms: what the algorithms' equations are made of, for all agents at once."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rllib_maobs.modules import Params, Stack
from rllib_maobs.modules.exploration import gumbel

Columns = dict[str, Tensor]
"""A minibatch as replay gives it, see `JointReplayBuffer.sample`."""


class Batch(NamedTuple):
    """A minibatch as the losses see it."""

    obs: Tensor  # (B, N, O)
    # What actors see: (obs,), or windows (B, N, T, O), their mask (B, T) and, if carried, the h and c (B, N, 2, H)
    # with which acting began them: constants, whatever weights made them (Kapturowski et al. 2019's stored state).
    history: tuple[Tensor, ...]
    state: Tensor  # (B, S)
    actions: Tensor  # (B, N, A) in [-1, 1], or one-hot
    rewards: Tensor  # (B, N), of n steps
    discount: Tensor  # (B, 1): gamma^n, or 0.0 where the episode really ended; a time limit bootstraps
    next_obs: Tensor  # (B, N, O), n steps later
    next_history: tuple[Tensor, ...]
    next_state: Tensor
    noise: Tensor | None  # (B, N, A): normal for smoothed target actions, uniform for discrete actors


class Nets(NamedTuple):
    """Stacked parameters by role; empty where an algorithm has no such role."""

    actor: Params
    critic: Params
    mixer: Params


class Terms:
    """Actions, values and targets as batched computations over stacked networks; a part of `JointLearner`.

    Attributes:
        config: The algorithm's.
        normalizers: The agents' running normalisation of observations, or None.
    """

    config: Any
    normalizers: Stack | None
    _roles: dict[str, Stack]
    _action_mask: Tensor | None  # (N, A): False where shorter actions are padded; None if none are
    _ids: Tensor | None  # (N, N): what centralised critics see of whose they are, if they do
    _state_columns: Tensor | None  # of all agents' padded observations those that are the state; None for all

    @property
    def critics(self) -> Stack:
        """The critics."""
        return self._roles["critic"]

    def prepare(self, columns: Columns, normalizer: Params) -> Batch:
        """A minibatch as the losses see it: normalised, scaled, and with the state put together."""
        seen: dict[str, tuple[Tensor, ...]] = {}
        for prefix in ("", "next_"):
            if f"{prefix}window" in columns:
                # (B, T, N, O) in replay, where a window is T rows
                seen[prefix] = columns[f"{prefix}window"].transpose(1, 2), columns[f"{prefix}mask"]
                if f"{prefix}hidden" in columns:
                    seen[prefix] += (columns[f"{prefix}hidden"],)
            else:
                seen[prefix] = (columns[f"{prefix}obs"],)
            if self.normalizers is not None:
                seen[prefix] = self.normalizers(normalizer, (seen[prefix][0], 1)), *seen[prefix][1:]
        obs, next_obs = (h[0] if h[0].dim() == 3 else h[0][:, :, -1] for h in (seen[""], seen["next_"]))
        if "state" in columns:
            state, next_state = columns["state"], columns["next_state"]
        else:
            state, next_state = obs.flatten(1), next_obs.flatten(1)
            if self._state_columns is not None:
                state, next_state = state[:, self._state_columns], next_state[:, self._state_columns]
        rewards = columns["rewards"] * self.config.reward_scale
        return Batch(
            obs=obs,
            history=seen[""],
            state=state,
            actions=columns["actions"],
            rewards=rewards,
            discount=columns["discount"],
            next_obs=next_obs,
            next_history=seen["next_"],
            next_state=next_state,
            noise=columns.get("noise"),
        )

    def act(self, actor: Params, history: tuple[Tensor, ...]) -> Tensor:
        """Every agent's network on what it sees, before tanh: `(B, N, A)`."""
        dims = (1, None, 1)[: len(history)]
        return self._roles["actor"](actor, *zip(history, dims, strict=True), method="raw")

    def actions(self, output: Tensor, noise: Tensor | None) -> Tensor:
        """Actions of the actors' outputs: tanh, or for discrete actions a straight-through Gumbel-softmax.

        The discrete action is one-hot, a draw from the softmax of the outputs; its gradient is that of the
        softmax itself (Jang et al. 2017).

        Args:
            output: Of `act`, `(B, N, A)`.
            noise: Uniform random numbers in [0, 1) of the same shape, if actions are discrete.

        Returns:
            `(B, N, A)`.
        """
        if not self.config.team.discrete:
            actions = torch.tanh(output)
            return actions if self._action_mask is None else actions * self._action_mask
        assert noise is not None
        logits = output if self._action_mask is None else output.masked_fill(~self._action_mask, -1e9)
        soft = F.softmax((logits + gumbel(noise)) / self.config.gumbel_temperature, dim=-1)
        return F.one_hot(soft.argmax(-1), soft.shape[-1]) + soft - soft.detach()

    def next_actions(self, actor: Params, batch: Batch) -> Tensor:
        """The target actors' actions mu'(o'), smoothed by clipped noise if so configured: `(B, N, A)`."""
        output, config = self.act(actor, batch.next_history), self.config
        if config.team.discrete:
            logits = output if self._action_mask is None else output.masked_fill(~self._action_mask, -1e9)
            return F.one_hot(logits.argmax(-1), output.shape[-1]).to(output.dtype)
        actions = self.actions(output, None)
        if not config.target_noise:
            return actions
        assert batch.noise is not None
        limit = config.target_noise_clip
        actions = (actions + (config.target_noise * batch.noise).clamp(-limit, limit)).clamp(-1.0, 1.0)
        return actions if self._action_mask is None else actions * self._action_mask

    def encode(self, critic: Params, state: Tensor) -> Tensor:
        """The critics' share of what they see of the state, to be used by both losses.

        Args:
            critic: Parameters of the critics.
            state: One state for all `(B, S)`, or one for each `(B, N, S)`.

        Returns:
            `(B, N, H)`.
        """
        return self.critics(critic, (state, 1 if state.dim() == 3 else None), method="encode")

    def q(self, critic: Params, encoded: Tensor, actions: Tensor) -> Tensor:
        """Every agent's Q_i.

        Args:
            critic: Parameters of the critics.
            encoded: Result of `encode`, `(B, N, H)`.
            actions: What each critic sees of the actions: one joint action for all `(B, N * A)`, or one entry
                for each `(B, N, ...)`.

        Returns:
            `(B, N, C)`; C is 1, or 2 with `twin_critics`.
        """
        if self._ids is not None:
            each = actions if actions.dim() == 3 else actions.unsqueeze(1).expand(-1, len(self._ids), -1)
            actions = torch.cat([each, self._ids.expand(len(each), -1, -1)], dim=-1)
        return self.critics(critic, (encoded, 1), (actions, 1 if actions.dim() == 3 else None), method="value")

    @staticmethod
    def own_actions(actions: Tensor, fixed: Tensor) -> Tensor:
        """For every agent a the joint action in which its own is its current one and the others' are fixed.

        Args:
            actions: Current actions, with a gradient, `(B, N, A)`.
            fixed: The others', `(B, N, A)`.

        Returns:
            `(B, N, N, A)`; the first N runs over the agents a.
        """
        own = torch.eye(actions.shape[1], device=actions.device, dtype=actions.dtype)[:, :, None]  # (N, N, 1)
        return own * actions[:, None] + (1.0 - own) * fixed[:, None]

    @staticmethod
    def squared_error(y: Tensor, q: Tensor) -> Tensor:
        """E[(y - Q)^2] of every agent `(N,)` for targets `(B, N)` and `(B, N, C)`; summed over the C critics."""
        return (y.unsqueeze(-1) - q).square().mean(0).sum(-1)

    def mix(self, mixer: Params, q: Tensor, state: Tensor) -> Tensor:
        """Every mixer's Q_tot(s, Q_1..Q_N).

        Args:
            mixer: Parameters of the M mixers.
            q: The values to mix: `(B, N)` for all mixers, or `(B, M, N)`.
            state: s, `(B, S)`.

        Returns:
            `(B, M)`.
        """
        return self._roles["mixer"](mixer, (q, 1 if q.dim() == 3 else None), (state, None))
