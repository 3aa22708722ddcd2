"""MADDPG-L: every agent's critic sees the global state and its own action only (paper, section III.B)."""

from __future__ import annotations

from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import JointConfig
from rllib_maobs.learner import JointLearner, TeamNetworks, squared_error
from rllib_maobs.replay import Batch


class MADDPGLLearner(JointLearner):
    """Equations 11 and 12."""

    @override(JointLearner)
    def critic_loss(self, online: TeamNetworks, target: TeamNetworks, batch: Batch) -> tuple[Tensor, Tensor]:
        """Eq. 11: L(phi_a) = E[(y_a - Q_a(s, u_a))^2], y_a = r_a + gamma Q'_a(s', mu'_a(o'_a))."""
        next_q = target.q(batch.next, target.next_actions(batch)).amin(-1)  # (B, N)
        y = (batch.rewards + batch.discount * next_q).detach()  # (B, N)
        q = online.q(batch.now, batch.actions)  # (B, N, C)
        return squared_error(y, q), q[..., 0]

    @override(JointLearner)
    def actor_loss(self, actions: Tensor, online: TeamNetworks, batch: Batch) -> Tensor:
        """Eq. 12: grad J(mu_a) = E[grad mu_a(o_a) grad_u Q_a(s, u) at u = mu_a(o_a)], as a loss."""
        return -online.q(batch.now, actions)[..., 0].mean(0)  # (N,)


class MADDPGLConfig(JointConfig):
    """Configuration of MADDPG-L.

    The light-weight MADDPG: the critic's input grows with the state alone, not with the joint action. How
    light it is depends on `critic_state`: the concatenated observations of nine agents are 450 numbers wide,
    the world state 66.

    ```python
    config = MADDPGLConfig().environment("maobs/spread-9a").training(critic_state="world")
    algo = config.build_algo()
    algo.train()
    ```
    """

    name = "maddpg-l"
    critic_sees = ("state", "action")
    learner = MADDPGLLearner


class MADDPGL(JointAlgorithm):
    """MADDPG-L, see `MADDPGLConfig`."""

    config_class = MADDPGLConfig
