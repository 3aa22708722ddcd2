"""VDN: the team's value is the sum of the agents' (paper, section II.C)."""

from __future__ import annotations

from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import Supports
from rllib_maobs.algorithms.iql import IQLConfig, QLearner
from rllib_maobs.learner import TeamNetworks
from rllib_maobs.replay import Moment


class VDNLearner(QLearner):
    """Equation 4."""

    @override(QLearner)
    def total(self, nets: TeamNetworks, q: Tensor, moment: Moment) -> Tensor:
        """Eq. 4: Q_tot(tau, u) = sum_a Q_a(tau_a, u_a)."""
        return q.sum(-1, keepdim=True)  # (B, 1)


class VDNConfig(IQLConfig):
    """Configuration of VDN (Sunehag et al. 2018); needs discrete actions and one team reward.

    ```python
    config = VDNConfig().environment("maobs/spread-3a", env_config={"action_mode": "discrete"})
    algo = config.build_algo()
    algo.train()
    ```
    """

    name = "vdn"
    supports = Supports(actions=("discrete",), team_reward=True, twin_critics=False)
    learner = VDNLearner


class VDN(JointAlgorithm):
    """VDN, see `VDNConfig`."""

    config_class = VDNConfig
