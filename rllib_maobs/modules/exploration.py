"""Exploration: how a deterministic policy deviates from its own choice. A class of your own plugs in here."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from rllib_maobs.options import Range
from rllib_maobs.registry import Registry, check_settings

NonNegative = Annotated[float, Range(0.0)]
Probability = Annotated[float, Range(0.0, 1.0)]


def gumbel(uniform: Tensor) -> Tensor:
    """Standard Gumbel noise from uniform numbers in [0, 1)."""
    return -torch.log(-torch.log(uniform.clamp(1e-20, 1.0 - 1e-7)))


def decayed(initial: float, decay: float, final: float, t: int) -> float:
    """`initial` falling by `decay` per env step to `final`; what starts lower stays as it is."""
    return max(min(initial, final), initial - decay * t)


class Exploration(ABC):
    """Base of all exploration: derive from it, and give the class as `.training(exploration={"type": MyNoise})`.

    Policies with equal settings explore together, others on their own. The further keys of the dict are the
    constructor's arguments, checked against its type hints.

    Attributes:
        discrete_actions: Whether it is defined for discrete actions, by `discrete`.
    """

    discrete_actions: ClassVar[bool] = False

    @abstractmethod
    def __call__(self, actions: Tensor, t: int, generator: torch.Generator | None = None) -> Tensor:
        """Explores around the policies' own actions.

        Args:
            actions: In [-1, 1], `(E, n, A)` of E environment copies and n agents; `(B, A)` in RLlib's own runner.
            t: Env steps sampled so far, over all copies.
            generator: Source of randomness; None takes torch's global one.

        Returns:
            Actions in [-1, 1] of the same shape.
        """

    def discrete(
        self, values: Tensor, t: int, generator: torch.Generator | None = None, *, sample: bool = False
    ) -> Tensor:
        """Explores around the best of A discrete actions.

        Args:
            values: One value for each action `(..., A)`; -inf for what is not legal.
            t: Env steps sampled so far, over all environment copies.
            generator: Source of randomness; None takes torch's global one.
            sample: Whether the policy itself draws from the softmax of the values instead of taking their maximum.

        Returns:
            The actions' numbers, `(...)`.
        """
        raise TypeError(f"{type(self).__name__} is not defined for discrete actions.")

    def reset(self, mask: Tensor) -> None:  # noqa: B027
        """Forgets the copies `(E,)` whose episodes are over, for noise that has a memory."""

    def get_state(self) -> dict[str, Any]:
        """What a checkpoint must hold, for noise that has a memory."""
        return {}

    def set_state(self, state: Mapping[str, Any]) -> None:  # noqa: B027
        """Goes on from what `get_state` returned."""


class EpsilonGaussian(Exploration):
    """Epsilon and Gaussian exploration with a linear decay (paper, table II; the decay is its code base's).

    At env step t an agent acts uniformly in [-1, 1] with probability eps(t), else with mu(o) plus Gaussian
    noise of standard deviation sigma(t), clipped to [-1, 1]; both are max(final, initial - decay * t). Of discrete
    actions it takes a uniform one with probability eps(t).

    Args:
        epsilon: Initial probability of a uniform action.
        noise: Initial standard deviation of the noise, in units of half the action range.
        decay: What both lose per env step.
        final: Where both stop falling (a value that starts lower stays as it is).
    """

    discrete_actions = True

    def __init__(
        self,
        epsilon: Probability = 0.1,
        noise: NonNegative = 0.1,
        decay: NonNegative = 5e-7,
        final: NonNegative = 0.05,
    ) -> None:
        self.epsilon, self.noise, self.decay, self.final = epsilon, noise, decay, final

    def at(self, t: int) -> tuple[float, float]:
        """(eps, sigma) after t env steps."""
        return decayed(self.epsilon, self.decay, self.final, t), decayed(self.noise, self.decay, self.final, t)

    def __call__(self, actions: Tensor, t: int, generator: torch.Generator | None = None) -> Tensor:
        """See `Exploration`; every leading entry is one agent's choice."""
        epsilon, sigma = self.at(t)
        noise = torch.randn(actions.shape, generator=generator) * sigma
        uniform = torch.rand(actions.shape, generator=generator) * 2.0 - 1.0
        greedy = torch.rand(actions.shape[:-1], generator=generator).unsqueeze(-1) >= epsilon
        return torch.where(greedy, (actions + noise).clamp(-1.0, 1.0), uniform)

    def discrete(
        self, values: Tensor, t: int, generator: torch.Generator | None = None, *, sample: bool = False
    ) -> Tensor:
        """See `Exploration`; draws from the softmax are made by Gumbel's trick."""
        epsilon, _ = self.at(t)
        uniform = torch.rand(values.shape, generator=generator).masked_fill(values.isneginf(), -1.0).argmax(-1)
        if sample:
            values = values + gumbel(torch.rand(values.shape, generator=generator))
        greedy = torch.rand(values.shape[:-1], generator=generator) >= epsilon
        return torch.where(greedy, values.argmax(-1), uniform)


class OrnsteinUhlenbeck(Exploration):
    """Noise that is correlated in time (Uhlenbeck and Ornstein 1930; Lillicrap et al. 2016 for DDPG).

    x becomes x - theta x + sigma(t) n at every step, n standard normal, zero at an episode's start. RLlib's own runner
    does not say when episodes start: there it goes on.

    Args:
        theta: Pull back to zero, per step.
        noise: sigma at the start, in units of half the action range.
        decay: What sigma loses per env step.
        final: Where it stops falling.
    """

    def __init__(
        self,
        theta: Probability = 0.15,
        noise: NonNegative = 0.2,
        decay: NonNegative = 0.0,
        final: NonNegative = 0.05,
    ) -> None:
        self.theta, self.noise, self.decay, self.final = theta, noise, decay, final
        self._x: Tensor | None = None

    def __call__(self, actions: Tensor, t: int, generator: torch.Generator | None = None) -> Tensor:
        """See `Exploration`."""
        if self._x is None or self._x.shape != actions.shape:
            self._x = torch.zeros(actions.shape)
        sigma = decayed(self.noise, self.decay, self.final, t)
        self._x = (1.0 - self.theta) * self._x + sigma * torch.randn(actions.shape, generator=generator)
        return (actions + self._x).clamp(-1.0, 1.0)

    def reset(self, mask: Tensor) -> None:
        """Back to zero."""
        if self._x is not None:
            self._x[mask] = 0.0

    def get_state(self) -> dict[str, Any]:
        """x, `(E, n, A)`."""
        return {"x": None if self._x is None else self._x.numpy().copy()}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Goes on from x."""
        self._x = None if state["x"] is None else torch.from_numpy(state["x"].copy())


EXPLORATIONS: Registry[Exploration] = Registry("exploration", Exploration)  # type: ignore[type-abstract]
"""Kinds of exploration by name, for `.training(exploration={"type": ...})`."""
EXPLORATIONS.register("epsilon-gaussian", EpsilonGaussian)
EXPLORATIONS.register("ornstein-uhlenbeck", OrnsteinUhlenbeck)


def make_exploration(settings: Mapping[str, Any], *, discrete: bool = False) -> Exploration:
    """Makes what `exploration={"type": .., ...}` describes; without a type it is "epsilon-gaussian".

    Raises:
        ValueError: For an unknown type, a setting that it does not take, or one that is not defined for discrete
            actions.
    """
    own = dict(settings)
    cls = EXPLORATIONS.resolve(own.pop("type", "epsilon-gaussian"))
    check_settings(cls, own)
    if discrete and not cls.discrete_actions:
        raise ValueError(
            f"{cls.__name__} is not defined for discrete actions; legal are "
            f"{', '.join(repr(name) for name, kind in EXPLORATIONS.items() if kind.discrete_actions)}."
        )
    return cls(**own)
