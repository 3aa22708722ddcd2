"""MADDPG: every agent's critic sees the global state and all actions (paper, section II.B)."""

from __future__ import annotations

from typing import Any, Literal, Self

from ray.rllib.algorithms.algorithm_config import NotProvided
from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import JointConfig, one_of
from rllib_maobs.learner import JointLearner
from rllib_maobs.terms import Batch, Nets

OTHER_AGENTS_ACTIONS = ("replay", "current", "joint")


class MADDPGLearner(JointLearner):
    """Equations 2 and 3."""

    @override(JointLearner)
    def critic_loss(self, nets: Nets, target: Nets, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Eq. 2: L(phi_a) = E[(y_a - Q_a(s, u_1..u_N))^2], y_a = r_a + gamma Q'_a(s', mu'_1(o'_1)..mu'_N(o'_N))."""
        next_actions = self.next_actions(target.actor, batch).flatten(1)  # (B, N * A)
        next_q = self.q(target.critic, self.encode(target.critic, batch.next_state), next_actions).amin(-1)  # (B, N)
        y = batch.rewards + batch.discount * next_q  # (B, N)
        encoded = self.encode(nets.critic, batch.state)  # (B, N, H)
        q = self.q(nets.critic, encoded, batch.actions.flatten(1))  # (B, N, C)
        return self.squared_error(y, q), q[..., 0], encoded

    @override(JointLearner)
    def actor_loss(self, actions: Tensor, nets: Nets, encoded: Tensor, batch: Batch) -> Tensor:
        """Eq. 3: grad J(mu_a) = E[grad mu_a(o_a) grad_{u_a} Q_a(s, u_1..u_N) at u_a = mu_a(o_a)], as a loss."""
        others = self.config.other_agents_actions
        if others == "joint":
            return -self.q(nets.critic, encoded, actions.flatten(1))[..., 0].mean(0)  # (N,)
        fixed = batch.actions if others == "replay" else actions.detach()
        own = self.own_actions(actions, fixed)  # (B, N, N, A): critic a sees a's current action among the fixed ones
        return -self.q(nets.critic, encoded, own.flatten(2))[..., 0].mean(0)  # (N,)


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

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class or MADDPG)
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

    @override(JointConfig)
    def validate(self) -> None:
        """Raises ValueError for settings that are not legal."""
        one_of("other_agents_actions", self.other_agents_actions, OTHER_AGENTS_ACTIONS)
        super().validate()

    @override(JointConfig)
    def critic_sizes(self, agent: str) -> tuple[int, int]:
        """(S, N * A)."""
        return self.state_size, len(self.team.agents) * self.team.action_size

    @override(JointConfig)
    def get_default_learner_class(self) -> type[JointLearner]:
        """Eq. 2 and 3."""
        return MADDPGLearner


class MADDPG(JointAlgorithm):
    """MADDPG, see `MADDPGConfig`."""

    @classmethod
    @override(JointAlgorithm)
    def get_default_config(cls) -> MADDPGConfig:
        """The paper's settings."""
        return MADDPGConfig()
