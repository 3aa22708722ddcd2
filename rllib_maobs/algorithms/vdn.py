"""VDN: the team's value is the sum of the agents' (paper, section II.C)."""

from __future__ import annotations

from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import Abilities
from rllib_maobs.algorithms.iql import IQLConfig, QLearner
from rllib_maobs.learner import JointLearner
from rllib_maobs.modules import Params


class VDNLearner(QLearner):
    """Equation 4."""

    @override(QLearner)
    def total(self, mixer: Params, q: Tensor, state: Tensor) -> Tensor:
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
    abilities = Abilities(actions=("discrete",), team_reward=True, twin_critics=False)

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class or VDN)

    @override(IQLConfig)
    def get_default_learner_class(self) -> type[JointLearner]:
        """Eq. 4."""
        return VDNLearner


class VDN(JointAlgorithm):
    """VDN, see `VDNConfig`."""

    @classmethod
    @override(JointAlgorithm)
    def get_default_config(cls) -> VDNConfig:
        """PyMARL's exploration."""
        return VDNConfig()
