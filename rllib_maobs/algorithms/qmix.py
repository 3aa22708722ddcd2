"""QMIX: the team's value rises with every agent's, as the state has it (paper, section II.C)."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Self

from ray.rllib.algorithms.algorithm_config import NotProvided
from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import Supports
from rllib_maobs.algorithms.iql import IQLConfig, QLearner
from rllib_maobs.learner import TeamNetworks
from rllib_maobs.options import Range
from rllib_maobs.replay import Moment


class QMIXLearner(QLearner):
    """Equations 5 and 6."""

    @override(QLearner)
    def total(self, nets: TeamNetworks, q: Tensor, moment: Moment) -> Tensor:
        """Eq. 5: Q_tot(tau, u, s) = f_psi(s, Q_1(tau_1, u_1)..Q_N(tau_N, u_N)), f monotone; its loss is eq. 6."""
        return nets.mix(q, moment)  # (B, 1)


class QMIXConfig(IQLConfig):
    """Configuration of QMIX (Rashid et al. 2018); needs discrete actions and one team reward.

    ```python
    config = QMIXConfig().environment("maobs/spread-3a", env_config={"action_mode": "discrete"})
    algo = config.build_algo()
    algo.train()
    ```
    """

    name = "qmix"
    supports = Supports(actions=("discrete",), team_reward=True, twin_critics=False)
    mixes = True
    learner = QMIXLearner
    legal: ClassVar[dict[str, Any]] = {**IQLConfig.legal, "mixer_hidden_size": Annotated[int, Range(1)]}

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class)
        self.mixer_hidden_size = 32

    @override(IQLConfig)
    def training(self, *, mixer_hidden_size: int = NotProvided, **kwargs: Any) -> Self:
        """Sets the training settings.

        Args:
            mixer_hidden_size: Width of the mixing layer. Default 32 (Rashid et al.).
            **kwargs: Those of IQL and of every algorithm, see `JointConfig.training`.
        """
        super().training(**kwargs)
        if mixer_hidden_size is not NotProvided:
            self.mixer_hidden_size = mixer_hidden_size
        return self

    @override(IQLConfig)
    def mixer_settings(self) -> dict[str, Any]:
        """One monotone mixer for the team."""
        return {
            "num_mixers": 1,
            "num_agents": len(self.team.agents),
            "state_size": self.state_size,
            "hidden_size": self.mixer_hidden_size,
            "monotone": True,
        }


class QMIX(JointAlgorithm):
    """QMIX, see `QMIXConfig`."""

    config_class = QMIXConfig
