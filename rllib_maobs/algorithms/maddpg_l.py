"""MADDPG-L: every agent's critic sees the global state and its own action only (paper, section III.B)."""

from __future__ import annotations

from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm, JointConfig
from rllib_maobs.learner import Batch, JointLearner, Nets
from rllib_maobs.modules import Params


class MADDPGLLearner(JointLearner):
    """Equations 11 and 12."""

    @override(JointLearner)
    def critic_loss(self, critic: Params, target: Nets, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Eq. 11: L(phi_a) = E[(y_a - Q_a(s, u_a))^2], y_a = r_a + gamma Q'_a(s', mu'_a(o'_a))."""
        next_actions = self.act(target.actor, batch.next_obs)  # (B, N, A)
        next_q = self.q(target.critic, self.encode(target.critic, batch.next_state), next_actions)  # (B, N)
        y = batch.rewards + self.config.gamma * (1.0 - batch.terminated) * next_q  # (B, N)
        encoded = self.encode(critic, batch.state)  # (B, N, H)
        q = self.q(critic, encoded, batch.actions)  # (B, N)
        return (y - q).square().mean(0), q, encoded

    @override(JointLearner)
    def actor_loss(self, actor: Params, critic: Params, encoded: Tensor, batch: Batch) -> Tensor:
        """Eq. 12: grad J(mu_a) = E[grad mu_a(o_a) grad_u Q_a(s, u) at u = mu_a(o_a)], as a loss."""
        return -self.q(critic, encoded, self.act(actor, batch.obs)).mean(0)  # (N,)


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

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class or MADDPGL)

    @override(JointConfig)
    def critic_sizes(self) -> tuple[int, int]:
        """(S, A)."""
        return self.state_size, self.team.action_size

    @override(JointConfig)
    def get_default_learner_class(self) -> type[JointLearner]:
        """Eq. 11 and 12."""
        return MADDPGLLearner


class MADDPGL(JointAlgorithm):
    """MADDPG-L, see `MADDPGLConfig`."""

    @classmethod
    @override(JointAlgorithm)
    def get_default_config(cls) -> MADDPGLConfig:
        """The paper's settings."""
        return MADDPGLConfig()
