"""Running normalisation of observations, kept with the network that needs it."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from rllib_maobs.modules.stack import Params, PerAgent, Stack

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
        """Normalises observations `(..., O)`; what comes after them is padding and stays."""
        size = len(self.mean)
        own, padding = observation[..., :size], observation[..., size:]
        deviation = self.square.sqrt().clamp(min=1e-2)  # what hardly moves is not blown up
        normalized = ((own - self.mean) / deviation).clamp(-_LIMIT, _LIMIT)
        return torch.cat([normalized, padding], dim=-1) if padding.shape[-1] else normalized


class Normalizers(Stack):
    """The running normalisation of N agents.

    Args:
        networks: Every agent's; one that is listed several times is shared.
    """

    def __init__(self, networks: Sequence[nn.Module]) -> None:
        super().__init__(networks)

    def normalized(self, params: Params, observations: Tensor) -> Tensor:
        """Normalises observations `(B, N, ..., O)` with given parameters."""
        result: Tensor = self(params, PerAgent(observations))
        return result

    def merge(self, observations: Tensor) -> None:
        """Takes further observations `(..., N, O)` into the running numbers, in place."""
        users: dict[int, list[int]] = {}
        for agent, net in enumerate(self.networks):
            users.setdefault(id(net), []).append(agent)
        for agents in users.values():
            own = self.own(self.params, agents[0])
            rows = observations[..., torch.tensor(agents), : own["mean"].shape[0]].flatten(0, -2)
            merge(own["mean"], own["square"], own["count"], rows)


def merge(mean: Tensor, square: Tensor, count: Tensor, observations: Tensor) -> None:
    """Takes further observations `(rows, O)` into running numbers, in place (Chan et al. 1979)."""
    new, rows = observations.mean(0), len(observations)
    total = count + rows
    shift = new - mean
    spread = observations.var(0, correction=0)
    square.copy_((square * count + spread * rows + shift.square() * count * rows / total) / total)
    mean.add_(shift * rows / total)
    count.copy_(total)
