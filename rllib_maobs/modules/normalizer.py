"""Running normalisation of observations, kept with the network that needs it."""

import torch
from torch import Tensor, nn

_LIMIT = 10.0


class Normalizer(nn.Module):
    """Shifts and scales observations to mean 0 and standard deviation 1, as seen so far, clipped to [-10, 10].

    Its numbers are parameters without a gradient, so that they are stacked, checkpointed and sent to remote
    runners with the networks.

    Args:
        size: O.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self.mean = nn.Parameter(torch.zeros(size), requires_grad=False)
        self.square = nn.Parameter(torch.ones(size), requires_grad=False)  # mean squared distance from the mean
        self.count = nn.Parameter(torch.zeros(1), requires_grad=False)

    def forward(self, observation: Tensor) -> Tensor:
        """Normalises observations `(..., O)`."""
        deviation = self.square.sqrt().clamp(min=1e-2)  # what hardly moves is not blown up
        return ((observation - self.mean) / deviation).clamp(-_LIMIT, _LIMIT)


def merge(mean: Tensor, square: Tensor, count: Tensor, observations: Tensor) -> None:
    """Takes further observations `(rows, O)` into running numbers, in place (Chan et al. 1979)."""
    new, rows = observations.mean(0), len(observations)
    total = count + rows
    shift = new - mean
    spread = observations.var(0, correction=0)
    square.copy_((square * count + spread * rows + shift.square() * count * rows / total) / total)
    mean.add_(shift * rows / total)
    count.copy_(total)
