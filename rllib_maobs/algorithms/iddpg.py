"""IDDPG: independent DDPG, every agent on its own (paper, section II.A)."""

from __future__ import annotations

from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm, JointConfig
from rllib_maobs.learner import Batch, JointLearner, Nets
from rllib_maobs.modules import Params


class IDDPGLearner(JointLearner):
    """DDPG for every agent: nothing in agent a's losses but o_a, u_a and r_a."""

    @override(JointLearner)
    def critic_loss(self, critic: Params, target: Nets, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """L(phi_a) = E[(y_a - Q_a(o_a, u_a))^2], y_a = r_a + gamma Q'_a(o'_a, mu'_a(o'_a))."""
        next_actions = self.act(target.actor, batch.next_obs)  # (B, N, A)
        next_q = self.q(target.critic, self.encode(target.critic, batch.next_obs), next_actions)  # (B, N)
        y = batch.rewards + self.config.gamma * (1.0 - batch.terminated) * next_q  # (B, N)
        encoded = self.encode(critic, batch.obs)  # (B, N, H)
        q = self.q(critic, encoded, batch.actions)  # (B, N)
        return (y - q).square().mean(0), q, encoded

    @override(JointLearner)
    def actor_loss(self, actor: Params, critic: Params, encoded: Tensor, batch: Batch) -> Tensor:
        """Eq. 1: grad J = E[grad mu_a(o_a) grad_u Q_a(o_a, u) at u = mu_a(o_a)], as a loss."""
        return -self.q(critic, encoded, self.act(actor, batch.obs)).mean(0)  # (N,)


class IDDPGConfig(JointConfig):
    """Configuration of IDDPG, the baseline without a centralised critic.

    ```python
    config = IDDPGConfig().environment("maobs/spread-3a").training(actor_lr=1e-3)
    algo = config.build_algo()
    algo.train()
    ```
    """

    name = "iddpg"
    uses_state = False

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class or IDDPG)

    @override(JointConfig)
    def critic_sizes(self) -> tuple[int, int]:
        """(O, A)."""
        return self.team.observation_size, self.team.action_size

    @override(JointConfig)
    def get_default_learner_class(self) -> type[JointLearner]:
        """Eq. 1, for every agent."""
        return IDDPGLearner


class IDDPG(JointAlgorithm):
    """IDDPG, see `IDDPGConfig`."""

    @classmethod
    @override(JointAlgorithm)
    def get_default_config(cls) -> IDDPGConfig:
        """The paper's settings."""
        return IDDPGConfig()
