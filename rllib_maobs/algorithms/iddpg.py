"""IDDPG: independent DDPG, every agent on its own (paper, section II.A)."""

from __future__ import annotations

from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import JointConfig
from rllib_maobs.learner import JointLearner, TeamNetworks, squared_error
from rllib_maobs.replay import Batch


class IDDPGLearner(JointLearner):
    """DDPG for every agent: nothing in agent a's losses but o_a, u_a and r_a."""

    @override(JointLearner)
    def critic_loss(self, online: TeamNetworks, target: TeamNetworks, batch: Batch) -> tuple[Tensor, Tensor]:
        """L(phi_a) = E[(y_a - Q_a(o_a, u_a))^2], y_a = r_a + gamma Q'_a(o'_a, mu'_a(o'_a))."""
        next_q = target.q(batch.next, target.next_actions(batch)).amin(-1)  # (B, N)
        y = (batch.rewards + batch.discount * next_q).detach()  # (B, N)
        q = online.q(batch.now, batch.actions)  # (B, N, C)
        return squared_error(y, q), q[..., 0]

    @override(JointLearner)
    def actor_loss(self, actions: Tensor, online: TeamNetworks, batch: Batch) -> Tensor:
        """Eq. 1: grad J = E[grad mu_a(o_a) grad_u Q_a(o_a, u) at u = mu_a(o_a)], as a loss."""
        return -online.q(batch.now, actions)[..., 0].mean(0)  # (N,)


class IDDPGConfig(JointConfig):
    """Configuration of IDDPG, the baseline without a centralised critic.

    ```python
    config = IDDPGConfig().environment("maobs/spread-3a").training(actor_lr=1e-3)
    algo = config.build_algo()
    algo.train()
    ```
    """

    name = "iddpg"
    critic_sees = ("observation", "action")
    learner = IDDPGLearner


class IDDPG(JointAlgorithm):
    """IDDPG, see `IDDPGConfig`."""

    config_class = IDDPGConfig
