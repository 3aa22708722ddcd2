"""IDDPG: independent DDPG, every agent on its own (paper, section II.A)."""

from __future__ import annotations

from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import JointConfig
from rllib_maobs.learner import JointLearner
from rllib_maobs.terms import Batch, Nets


class IDDPGLearner(JointLearner):
    """DDPG for every agent: nothing in agent a's losses but o_a, u_a and r_a."""

    @override(JointLearner)
    def critic_loss(self, nets: Nets, target: Nets, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """L(phi_a) = E[(y_a - Q_a(o_a, u_a))^2], y_a = r_a + gamma Q'_a(o'_a, mu'_a(o'_a))."""
        next_actions = self.next_actions(target.actor, batch)  # (B, N, A)
        next_q = self.q(target.critic, self.encode(target.critic, batch.next_obs), next_actions).amin(-1)  # (B, N)
        y = batch.rewards + batch.discount * next_q  # (B, N)
        encoded = self.encode(nets.critic, batch.obs)  # (B, N, H)
        q = self.q(nets.critic, encoded, batch.actions)  # (B, N, C)
        return self.squared_error(y, q), q[..., 0], encoded

    @override(JointLearner)
    def actor_loss(self, actions: Tensor, nets: Nets, encoded: Tensor, batch: Batch) -> Tensor:
        """Eq. 1: grad J = E[grad mu_a(o_a) grad_u Q_a(o_a, u) at u = mu_a(o_a)], as a loss."""
        return -self.q(nets.critic, encoded, actions)[..., 0].mean(0)  # (N,)


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
    central_critic = False

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class or IDDPG)

    @override(JointConfig)
    def critic_sizes(self, agent: str) -> tuple[int, int]:
        """(O, A) of the agent."""
        index = self.team.agents.index(agent)
        return self.team.observation_sizes[index], self.team.action_sizes[index]

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
