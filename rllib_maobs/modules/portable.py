"""An agent outside RLlib: from what its environment gives to what it takes, as one network without a memory."""

from __future__ import annotations

import copy

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn

from rllib_maobs.layout import Layout, as_layout, flat
from rllib_maobs.modules.actors import RecurrentActor, unrolled
from rllib_maobs.modules.agent import AgentModule, append


class PortableActor(nn.Module):
    """Normalisation, actor, and the environment's action bounds of one agent, with copies of the weights.

    What a recurrent actor remembers goes in and comes out. It is all zeros at an episode's start, whatever the actor's
    own initial state is.

    Attributes:
        layout: What the environment's observation is made of.
        free: Whether the observation is given group by group, each with any number of entities.
        inputs: Shapes by name, without the batch's axis: `{"observation": (O,)}`; if `free`, an
            `observation.<group>` (count, size) for each group.
        state: The same for what a recurrent actor remembers: the `window` of observations `(T, O)` (or one for each
            group, `(T, count, size)`), its `mask` `(T,)`, and with `stored_state` the actor's `recurrent_state`.

    Args:
        module: The agent.
        number: What its observations begin with besides what the environment gives, `(N,)`: the agent's number if it
            was trained with `agent_id_input`, else nothing.

    Raises:
        ValueError: If actions have no bounds.
    """

    def __init__(self, module: AgentModule, number: Tensor | None = None) -> None:
        super().__init__()
        self.normalizer, self.actor = copy.deepcopy(module.normalizer), copy.deepcopy(module.acting)
        size = module.observation_space.shape[0] - (0 if number is None else len(number))
        layout = module.model_config.get("observation_layout") or flat(size, "observation")
        # The layout of the observation space begins with the agent's number.
        self.layout: Layout = as_layout(layout if number is None else list(layout)[1:], size, "observation")
        self.number = None if number is None else nn.Parameter(number, requires_grad=False)
        plain = isinstance(self.normalizer, nn.Identity) and number is None
        self.free = type(self.actor).takes_groups and plain
        self.inputs: dict[str, tuple[int, ...]] = {"observation": (size,)}
        if self.free:
            self.inputs = {f"observation.{group.name}": (group.count, group.size) for group in self.layout}
        self.state: dict[str, tuple[int, ...]] = {}
        if isinstance(self.actor, RecurrentActor):
            length = module.seq_length
            self.state = {"window" + name.removeprefix("observation"): (length, *s) for name, s in self.inputs.items()}
            self.state["mask"] = (length,)
            if module.stored_state:
                self.state["recurrent_state"] = tuple(self.actor.initial_state().shape)
        self.action_space: gym.Space = module.action_space
        if isinstance(self.action_space, gym.spaces.Box):
            low, high = (
                torch.from_numpy(b.astype(np.float32)) for b in (self.action_space.low, self.action_space.high)
            )
            if not (low.isfinite().all() and high.isfinite().all()):
                raise ValueError(f"Actions without bounds can't be exported: {self.action_space}.")
            self.whole = bool(np.issubdtype(self.action_space.dtype, np.integer))
            self.low, self.high = (nn.Parameter(bound, requires_grad=False) for bound in (low, high))
        self.eval().requires_grad_(False)

    def forward(self, *arrays: Tensor) -> tuple[Tensor, ...]:
        """Acts.

        Args:
            arrays: `inputs`, then `state`, in their order, `(B, ...)` each.

        Returns:
            Actions as the environment takes them, `(B, A)`, or the numbers `(B,)` of discrete ones; then the state
            for the next call.
        """
        observations, state = arrays[: len(self.inputs)], arrays[len(self.inputs) :]
        if not isinstance(self.actor, RecurrentActor):
            return (self._to_environment(self.actor(self._seen(observations))),)
        count = len(self.inputs)
        mask = state[count]
        appended = [append(window, mask, new) for window, new in zip(state, observations, strict=False)]
        windows, mask = tuple(window for window, _ in appended), appended[0][1]
        initial = self.actor.initial_state()
        start = state[count + 1] + initial if "recurrent_state" in self.state else None
        outputs, ended = unrolled(self.actor, self._seen(windows), mask, start)
        following = (*windows, mask) if start is None else (*windows, mask, ended - initial)
        return (self._to_environment(outputs), *following)

    def _seen(self, observations: tuple[Tensor, ...]) -> Tensor:
        """What the actor sees of observations or windows of them: one vector, or a mapping of groups."""
        if self.free:
            groups = [group.name for group in self.layout]
            return dict(zip(groups, observations, strict=True))  # type: ignore[return-value]
        (observation,) = observations
        if self.number is not None:
            number = self.number.expand(*observation.shape[:-1], len(self.number))
            observation = torch.cat([number, observation], dim=-1)
        return self.normalizer(observation)

    def _to_environment(self, outputs: Tensor) -> Tensor:
        """The best discrete action's number, or tanh scaled to the bounds; integers get equal shares of it."""
        if isinstance(self.action_space, gym.spaces.Discrete):
            return outputs.argmax(-1) + int(self.action_space.start)
        half = (self.high - self.low + float(self.whole)) / 2.0
        actions = self.low + (torch.tanh(outputs) + 1.0) * half
        actions = actions.floor() if self.whole else actions
        actions = actions.maximum(self.low).minimum(self.high)  # rounding may lead out of the bounds
        return actions.long() if self.whole else actions


class PortableTeam(nn.Module):
    """Several agents as one network: the arrays of all, one after the other; see `PortableActor`.

    Args:
        actors: The agents.
    """

    def __init__(self, actors: list[PortableActor]) -> None:
        super().__init__()
        self.actors = nn.ModuleList(actors)

    def forward(self, *arrays: Tensor) -> tuple[Tensor, ...]:
        """Acts: all agents' inputs and states in, all agents' actions and states out."""
        out: tuple[Tensor, ...] = ()
        for actor in self.actors:
            count = len(actor.inputs) + len(actor.state)  # type: ignore[arg-type]
            out += actor(*arrays[:count])
            arrays = arrays[count:]
        return out
