"""Exploration of a deterministic policy: epsilon-greedy with uniform actions, else Gaussian noise."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


def gumbel(uniform: Tensor) -> Tensor:
    """Standard Gumbel noise from uniform numbers in [0, 1)."""
    return -torch.log(-torch.log(uniform.clamp(1e-20, 1.0 - 1e-7)))


@dataclass(frozen=True)
class Exploration:
    """Epsilon and Gaussian exploration with a linear decay (paper, table II; the decay is its code base's).

    At env step t an agent acts uniformly in [-1, 1] with probability eps(t), else with mu(o) plus Gaussian
    noise of standard deviation sigma(t), clipped to [-1, 1]; both are max(final, initial - decay * t).

    Attributes:
        epsilon: Initial probability of a uniform action.
        noise: Initial standard deviation of the noise, in units of half the action range.
        decay: What both lose per env step.
        final: Where both stop falling (a value that starts lower stays as it is).
    """

    epsilon: float = 0.1
    noise: float = 0.1
    decay: float = 5e-7
    final: float = 0.05

    def at(self, t: int) -> tuple[float, float]:
        """(eps, sigma) after t env steps."""

        def value(initial: float) -> float:
            return max(min(initial, self.final), initial - self.decay * t)

        return value(self.epsilon), value(self.noise)

    def __call__(self, actions: Tensor, t: int, generator: torch.Generator | None = None) -> Tensor:
        """Explores around greedy actions.

        Args:
            actions: Greedy actions in [-1, 1], `(..., A)`; every leading entry is one agent's choice.
            t: Env steps sampled so far, over all environment copies.
            generator: Source of randomness; None takes torch's global one.

        Returns:
            Actions in [-1, 1], `(..., A)`.
        """
        epsilon, sigma = self.at(t)
        noise = torch.randn(actions.shape, generator=generator) * sigma
        uniform = torch.rand(actions.shape, generator=generator) * 2.0 - 1.0
        greedy = torch.rand(actions.shape[:-1], generator=generator).unsqueeze(-1) >= epsilon
        return torch.where(greedy, (actions + noise).clamp(-1.0, 1.0), uniform)

    def discrete(
        self, values: Tensor, t: int, generator: torch.Generator | None = None, *, sample: bool = False
    ) -> Tensor:
        """Explores around the best of A discrete actions.

        Args:
            values: One value for each action `(..., A)`; -inf for what is not legal.
            t: Env steps sampled so far, over all environment copies.
            generator: Source of randomness; None takes torch's global one.
            sample: Whether an action that is not uniform is drawn from the softmax of the values (by Gumbel's
                trick) instead of being their maximum.

        Returns:
            The actions' numbers, `(...)`.
        """
        epsilon, _ = self.at(t)
        uniform = torch.rand(values.shape, generator=generator).masked_fill(values.isneginf(), -1.0).argmax(-1)
        if sample:
            values = values + gumbel(torch.rand(values.shape, generator=generator))
        greedy = torch.rand(values.shape[:-1], generator=generator) >= epsilon
        return torch.where(greedy, values.argmax(-1), uniform)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "Exploration":
        """From `exploration={"epsilon": .., "noise": .., "decay": .., "final": ..}` of an algorithm config.

        Raises:
            ValueError: For an unknown key, or a value that is negative or not finite; names the legal ones.
        """
        legal = cls.__dataclass_fields__
        for key, value in values.items():
            if key not in legal:
                raise ValueError(f"Unknown exploration setting {key!r}; legal are {sorted(legal)}.")
            upper = 1.0 if key == "epsilon" else float("inf")
            if not isinstance(value, int | float) or not 0.0 <= value <= upper or value == float("inf"):
                raise ValueError(f"exploration[{key!r}] must be finite and in [0, {upper:g}], not {value!r}.")
        return cls(**values)
