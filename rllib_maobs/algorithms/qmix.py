"""QMIX: the team's value rises with every agent's, as the state has it (paper, section II.C)."""

from __future__ import annotations

from typing import Any, Self

from ray.rllib.algorithms.algorithm_config import NotProvided
from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import Abilities, in_range
from rllib_maobs.algorithms.iql import IQLConfig, QLearner
from rllib_maobs.learner import JointLearner
from rllib_maobs.modules import Params


class QMIXLearner(QLearner):
    """Equations 5 and 6."""

    @override(QLearner)
    def total(self, mixer: Params, q: Tensor, state: Tensor) -> Tensor:
        """Eq. 5: Q_tot(tau, u, s) = f_psi(s, Q_1(tau_1, u_1)..Q_N(tau_N, u_N)), f monotone; its loss is eq. 6."""
        return self.mix(mixer, q, state)  # (B, 1)


class QMIXConfig(IQLConfig):
    """Configuration of QMIX (Rashid et al. 2018); needs discrete actions and one team reward.

    ```python
    config = QMIXConfig().environment("maobs/spread-3a", env_config={"action_mode": "discrete"})
    algo = config.build_algo()
    algo.train()
    ```
    """

    name = "qmix"
    abilities = Abilities(actions=("discrete",), team_reward=True, twin_critics=False)
    uses_state = True

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class or QMIX)
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
    def validate(self) -> None:
        """Raises ValueError for settings that are not legal."""
        in_range("mixer_hidden_size", self.mixer_hidden_size, 1)
        super().validate()

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

    @override(IQLConfig)
    def get_default_learner_class(self) -> type[JointLearner]:
        """Eq. 5 and 6."""
        return QMIXLearner


class QMIX(JointAlgorithm):
    """QMIX, see `QMIXConfig`."""

    @classmethod
    @override(JointAlgorithm)
    def get_default_config(cls) -> QMIXConfig:
        """PyMARL's exploration."""
        return QMIXConfig()
