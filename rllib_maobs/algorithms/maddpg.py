"""MADDPG: every agent's critic sees the global state and all actions (paper, section II.B)."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, Self

from ray.rllib.algorithms.algorithm_config import NotProvided
from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import JointConfig
from rllib_maobs.learner import JointLearner, TeamNetworks, squared_error
from rllib_maobs.replay import Batch


class MADDPGLearner(JointLearner):
    """Equations 2 and 3."""

    @override(JointLearner)
    def critic_loss(self, online: TeamNetworks, target: TeamNetworks, batch: Batch) -> tuple[Tensor, Tensor]:
        """Eq. 2: L(phi_a) = E[(y_a - Q_a(s, u_1..u_N))^2], y_a = r_a + gamma Q'_a(s', mu'_1(o'_1)..mu'_N(o'_N))."""
        next_q = target.q(batch.next, target.next_actions(batch)).amin(-1)  # (B, N)
        y = (batch.rewards + batch.discount * next_q).detach()  # (B, N)
        q = online.q(batch.now, batch.actions)  # (B, N, C)
        return squared_error(y, q), q[..., 0]

    @override(JointLearner)
    def actor_loss(self, actions: Tensor, online: TeamNetworks, batch: Batch) -> Tensor:
        """Eq. 3: grad J(mu_a) = E[grad mu_a(o_a) grad_{u_a} Q_a(s, u_1..u_N) at u_a = mu_a(o_a)], as a loss."""
        others = {"replay": batch.actions, "current": actions.detach(), "joint": None}
        q = online.q(batch.now, actions, others=others[self.config.other_agents_actions])  # (B, N, C)
        return -q[..., 0].mean(0)  # (N,)


class MADDPGConfig(JointConfig):
    """Configuration of MADDPG.

    ```python
    config = MADDPGConfig().environment("maobs/spread-3a").training(other_agents_actions="replay")
    algo = config.build_algo()
    algo.train()
    ```

    `other_agents_actions` names what three kinds of libraries call MADDPG, the others' actions in agent a's
    actor loss: "replay", those in the replay buffer (the paper, and Lowe et al. 2017); "current", what the
    others would do now, without a gradient to them; "joint", what all would do now, every actor following the
    gradient of all agents' critics.
    """

    name = "maddpg"
    critic_sees = ("state", "joint_action")
    learner = MADDPGLearner
    legal: ClassVar[dict[str, Any]] = {
        **JointConfig.legal,
        "other_agents_actions": Literal["replay", "current", "joint"],
    }

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class)
        self.other_agents_actions: Literal["replay", "current", "joint"] = "replay"

    @override(JointConfig)
    def training(
        self, *, other_agents_actions: Literal["replay", "current", "joint"] = NotProvided, **kwargs: Any
    ) -> Self:
        """Sets the training settings.

        Args:
            other_agents_actions: "replay" (default), "current" or "joint", see the class.
            **kwargs: Those of every algorithm, see `JointConfig.training`.
        """
        super().training(**kwargs)
        if other_agents_actions is not NotProvided:
            self.other_agents_actions = other_agents_actions
        return self


class MADDPG(JointAlgorithm):
    """MADDPG, see `MADDPGConfig`."""

    config_class = MADDPGConfig
