"""Acting: from the observations of E copies to the team's actions, with windows, normalisation and exploration."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rllib_maobs.envs.team import Team
from rllib_maobs.modules import AgentModule, PerAgent, Seen
from rllib_maobs.modules.agent import append
from rllib_maobs.modules.denormals import denormals_are_zero
from rllib_maobs.modules.exploration import make_exploration
from rllib_maobs.modules.normalizer import Normalizers
from rllib_maobs.modules.team import Actors
from rllib_maobs.registry import same


class Acting:
    """How the agents of E copies act: all of them in one stacked forward pass.

    Attributes:
        actors: The stacked actors.
        normalizers: The stacked normalisation of observations, or None.
        generator: Source of all random numbers.

    Args:
        modules: Every agent's module, in the team's order.
        team: The agents.
        num_envs: E.
        generator: Source of all random numbers.

    Raises:
        ValueError: If agents' memories differ (windows of other lengths, stored states).
    """

    def __init__(self, modules: Sequence[AgentModule], team: Team, num_envs: int, generator: torch.Generator) -> None:
        self._team, self._num_envs, self.generator = team, num_envs, generator
        first = modules[0]
        memories = {agent: (m.seq_length, m.stored_state) for agent, m in zip(team.agents, modules, strict=True)}
        if len(set(memories.values())) > 1:
            raise ValueError(f"All agents must have the same seq_length and stored_state, not {memories}.")
        self.actors = Actors([module.acting for module in modules], [f"the actor of {agent}" for agent in team.agents])
        normalized = not isinstance(first.normalizer, torch.nn.Identity)
        self.normalizers = Normalizers([module.normalizer for module in modules]) if normalized else None
        self._draws = first.draws
        # (N, A): where shorter actions are padded; None if none are.
        self._padding = None if team.action_mask.all() else torch.from_numpy(~team.action_mask)
        self._scale(team)
        # Policies with equal settings explore together: one call, and one stream of random numbers.
        together: list[tuple[dict[str, Any], list[int]]] = []
        for agent, module in enumerate(modules):
            settings = module.model_config.get("exploration", {})
            for other, agents in together:
                if same(settings, other):
                    agents.append(agent)
                    break
            else:
                together.append((settings, [agent]))
        self._explorations = [
            (agents, make_exploration(settings, discrete=team.discrete)) for settings, agents in together
        ]
        # The last T observations (E, T, N, O), which of them count (E, T), and the recurrent states (E, N, *H) with
        # which the last windows ended, if the next ones start from them.
        self._window: tuple[Tensor, Tensor] | None = None
        self._recurrent_state: Tensor | None = None
        if first.recurrent:
            shape = (num_envs, first.seq_length)
            self._window = torch.zeros(*shape, len(team.agents), team.observation_size), torch.zeros(shape)
        if first.stored_state:
            states = [actor.initial_state() for actor in self.actors.networks]  # type: ignore[operator]
            shapes = {agent: tuple(state.shape) for agent, state in zip(team.agents, states, strict=True)}
            if len(set(shapes.values())) > 1:
                raise ValueError(f"Recurrent states that are stored must have one shape for all agents, not {shapes}.")
            self._recurrent_state = torch.zeros(num_envs, len(modules), *next(iter(shapes.values())))

    def _scale(self, team: Team) -> None:
        """Finds the lower bound, and half the range, of what an action in [-1, 1] stands for, `(N, A)` each.

        Integers get equal shares of [-1, 1]: the range is one wider, and what it is scaled to rounded down.
        """
        boxes = [(row, space) for row, space in enumerate(team.action_spaces) if isinstance(space, gym.spaces.Box)]
        single = all(space.dtype in (np.float16, np.float32) for _, space in boxes)
        self._low, high = np.zeros((2, *team.action_mask.shape), dtype=np.float32 if single else np.float64)
        whole = np.zeros(team.action_mask.shape, dtype=np.bool_)
        for row, space in boxes:
            own = slice(space.shape[0])
            self._low[row, own], high[row, own] = space.low, space.high
            whole[row, own] = np.issubdtype(space.dtype, np.integer)
        self._range = (high - self._low + whole) / 2.0
        # Rounding may lead out of the bounds at their upper ends; where it does not, nothing is clipped.
        exact = single and bool((self._low + 2.0 * self._range <= high).all())
        self._limits = None if exact else (high, whole)

    def share(self, actors: Actors, normalizers: Normalizers | None) -> None:
        """Acts with the tensors of a learner in this process from now on, so weights need no syncing."""
        self.actors.share(actors)
        if self.normalizers is not None and normalizers is not None:
            self.normalizers.share(normalizers)

    @property
    def recurrent_state(self) -> NDArray[np.float32] | None:
        """The states from which the next windows start, `(E, N, *H)`, if they are stored."""
        return None if self._recurrent_state is None else self._recurrent_state.numpy()

    def forget(self, done: NDArray[np.bool_]) -> None:
        """Empties what there is to remember of the copies `(E,)` whose episodes are over."""
        mask = torch.from_numpy(done)
        for part in self._window or ():
            part[mask] = 0.0
        if self._recurrent_state is not None:
            # Asked for anew: it may be made from parameters.
            initial = [actor.initial_state().detach().cpu() for actor in self.actors.networks]  # type: ignore[operator]
            self._recurrent_state[mask] = torch.stack(initial)
        for _, exploration in self._explorations:
            exploration.reset(mask)

    @torch.no_grad()
    def __call__(self, obs: NDArray[np.float32], t: int, *, explore: bool, random: bool = False) -> NDArray[np.float32]:
        """The agents' actions.

        Args:
            obs: `(E, N, O)`.
            t: Env steps sampled so far.
            explore: Whether to explore.
            random: Whether to act uniformly at random instead.

        Returns:
            `(E, N, A)` in [-1, 1], or one-hot; with zeros as padding.
        """
        seen = self._seen(torch.from_numpy(obs))
        if random and self._recurrent_state is None:
            return self._random(obs.shape[:2])
        device = self.actors.flat.device
        seen = Seen(*(None if part is None else part.to(device) for part in seen))  # type: ignore[arg-type]
        if self.normalizers is not None:
            seen = seen._replace(obs=self.normalizers.act(PerAgent(seen.obs)))
        with denormals_are_zero():
            outputs, state = self.actors.respond(seen)
        if self._recurrent_state is not None:  # it goes on with the window, whatever chooses the actions
            assert state is not None
            self._recurrent_state = state.cpu()
        if random:
            return self._random(obs.shape[:2])
        return self._encoded(self._chosen(outputs.cpu(), t, explore))

    def _seen(self, obs: Tensor) -> Seen:
        """What the actors act on: observations `(E, N, O)`, or windows `(E, N, T, O)`."""
        if self._window is None:
            return Seen(obs)
        self._window = append(*self._window, obs)
        window, mask = self._window
        return Seen(window.transpose(1, 2), mask, self._recurrent_state)

    def _chosen(self, outputs: Tensor, t: int, explore: bool) -> Tensor:
        """Actions `(E, N, A)`, or the numbers of discrete ones `(E, N)`, of raw outputs."""
        values = self._legal(outputs) if self._team.discrete else torch.tanh(outputs)
        if not explore:
            return values.argmax(-1) if self._team.discrete else values
        parts = []
        for agents, exploration in self._explorations:
            own = values if len(self._explorations) == 1 else values[:, agents]
            if self._team.discrete:
                parts.append(exploration.discrete(own, t, self.generator, sample=self._draws))
            else:
                explored = exploration(own, t, self.generator)
                if explored.shape != own.shape:
                    raise ValueError(
                        f"{type(exploration).__name__} must return actions of shape {tuple(own.shape)}, as given, "
                        f"not {tuple(explored.shape)}."
                    )
                parts.append(explored.clamp(-1.0, 1.0))
        if len(parts) == 1:
            return parts[0]
        order = np.argsort([agent for agents, _ in self._explorations for agent in agents])
        return torch.cat(parts, dim=1)[:, torch.from_numpy(order)]

    def _random(self, shape: Sequence[int]) -> NDArray[np.float32]:
        """Uniformly random actions of `(E, N)` agents."""
        uniform = torch.rand((*shape, self._team.action_size), generator=self.generator)
        return self._encoded(self._legal(uniform).argmax(-1) if self._team.discrete else uniform * 2.0 - 1.0)

    def _legal(self, values: Tensor) -> Tensor:
        """Values of discrete actions `(E, N, A)`, -inf for those that an agent has not."""
        return values if self._padding is None else values.masked_fill(self._padding, -torch.inf)

    def _encoded(self, actions: Tensor) -> NDArray[np.float32]:
        """Actions as replay has them: one-hot if they are discrete, with zeros as padding if not."""
        if self._team.discrete:
            actions = torch.nn.functional.one_hot(actions, self._team.action_size).float()
        elif self._padding is not None:
            actions = actions.masked_fill(self._padding, 0.0)
        return actions.numpy()

    def to_env(self, actions: NDArray[np.float32]) -> NDArray[Any]:
        """Actions as the environment takes them: scaled to its bounds `(E, N, A)`, or numbers `(E, N)`."""
        if self._team.discrete:
            return actions.argmax(-1)
        scaled = self._low + (actions + 1.0) * self._range
        if self._limits is None:
            return scaled
        high, whole = self._limits
        return np.clip(np.where(whole, np.floor(scaled), scaled), self._low, high)

    def get_state(self) -> dict[str, Any]:
        """What acting remembers, and the random numbers to come."""
        return {
            "generator": self.generator.get_state().numpy(),
            "window": self._window,
            "recurrent_state": self._recurrent_state,
            "explorations": [exploration.get_state() for _, exploration in self._explorations],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Goes on from a saved state."""
        self.generator.set_state(torch.from_numpy(state["generator"]))
        self._window, self._recurrent_state = pickle.loads(pickle.dumps((state["window"], state["recurrent_state"])))
        for (_, exploration), saved in zip(self._explorations, state["explorations"], strict=True):
            exploration.set_state(saved)
