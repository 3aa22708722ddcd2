"""MADDPG-L: every agent's critic sees the global state and its own action only (paper, section III.B)."""

from __future__ import annotations

from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import JointConfig
from rllib_maobs.learner import JointLearner
from rllib_maobs.terms import Batch, Nets


class MADDPGLLearner(JointLearner):
    """Equations 11 and 12."""

    @override(JointLearner)
    def critic_loss(self, nets: Nets, target: Nets, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Eq. 11: L(phi_a) = E[(y_a - Q_a(s, u_a))^2], y_a = r_a + gamma Q'_a(s', mu'_a(o'_a))."""
        next_actions = self.next_actions(target.actor, batch)  # (B, N, A)
        next_q = self.q(target.critic, self.encode(target.critic, batch.next_state), next_actions).amin(-1)  # (B, N)
        y = batch.rewards + batch.discount * next_q  # (B, N)
        encoded = self.encode(nets.critic, batch.state)  # (B, N, H)
        q = self.q(nets.critic, encoded, batch.actions)  # (B, N, C)
        return self.squared_error(y, q), q[..., 0], encoded

    @override(JointLearner)
    def actor_loss(self, actions: Tensor, nets: Nets, encoded: Tensor, batch: Batch) -> Tensor:
        """Eq. 12: grad J(mu_a) = E[grad mu_a(o_a) grad_u Q_a(s, u) at u = mu_a(o_a)], as a loss."""
        return -self.q(nets.critic, encoded, actions)[..., 0].mean(0)  # (N,)


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
    def critic_sizes(self, agent: str) -> tuple[int, int]:
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
