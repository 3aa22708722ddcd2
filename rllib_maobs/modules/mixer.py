"""Mixing networks: all agents' values and the state to the value of the joint action."""

from typing import Any

from ray.rllib.core.learner.utils import make_target_network
from ray.rllib.core.rl_module.torch.torch_rl_module import TorchRLModule
from ray.rllib.utils.annotations import override
from torch import Tensor, nn


class Mixer(nn.Module):
    """Mixes N values into one by a two-layer network whose weights hypernetworks make from the state.

    `Q_tot = ELU(q W_1(s) + b_1(s)) w_2(s) + b_2(s)`, with one linear layer for each of W_1, b_1 and w_2, and two
    for b_2 (Rashid et al. 2018, figure 2). Monotone, it takes the absolute values of W_1 and w_2, so Q_tot rises
    with every agent's value: QMIX's f_psi (eq. 5). Without, it is FACMAC's g_psi (eq. 7), which may fall.

    Args:
        num_agents: N.
        state_size: S.
        hidden_size: M, width of the mixing layer.
        monotone: Whether Q_tot may only rise with every agent's value.
    """

    def __init__(self, num_agents: int, state_size: int, hidden_size: int = 32, monotone: bool = True) -> None:
        super().__init__()
        self.monotone = monotone
        self.weight_1 = nn.Linear(state_size, num_agents * hidden_size)
        self.bias_1 = nn.Linear(state_size, hidden_size)
        self.weight_2 = nn.Linear(state_size, hidden_size)
        self.bias_2 = nn.Sequential(nn.Linear(state_size, hidden_size), nn.ReLU(), nn.Linear(hidden_size, 1))

    def forward(self, q: Tensor, state: Tensor) -> Tensor:
        """Mixes values `(..., N)` in states `(..., S)` to Q_tot `(...)`."""
        weight_1, weight_2 = self.weight_1(state), self.weight_2(state)
        if self.monotone:
            weight_1, weight_2 = weight_1.abs(), weight_2.abs()
        weight_1 = weight_1.unflatten(-1, (-1, weight_2.shape[-1]))  # (..., N, M)
        hidden = nn.functional.elu((q.unsqueeze(-1) * weight_1).sum(-2) + self.bias_1(state))
        return (hidden * weight_2).sum(-1) + self.bias_2(state).squeeze(-1)


class MixerModule(TorchRLModule):
    """The team's mixers and their target networks; only a learner needs them.

    Settings (`model_config`): `num_agents`, `state_size`, `hidden_size`, `monotone` (see `Mixer`), and
    `num_mixers`: one for the team, or one for each agent.
    """

    @override(TorchRLModule)
    def setup(self) -> None:
        """Builds the mixers from `model_config`."""
        settings: dict[str, Any] = dict(self.model_config)
        num_mixers = settings.pop("num_mixers", 1)
        self.mixers = nn.ModuleList(Mixer(**settings) for _ in range(num_mixers))
        self.target_mixers: nn.ModuleList = make_target_network(self.mixers)

    @override(TorchRLModule)
    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        raise TypeError("Mixers do not act: they are a part of the learner's critic.")
