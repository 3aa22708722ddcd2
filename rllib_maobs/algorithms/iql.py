"""IQL: independent Q-learning, the Q-learning family without a mixer; what VDN and QMIX derive from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

from ray.rllib.algorithms.algorithm_config import NotProvided
from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import JointConfig, Supports
from rllib_maobs.learner import CRITIC, JointLearner, Parts, TeamNetworks
from rllib_maobs.modules import UtilityModule
from rllib_maobs.modules.team import Actors
from rllib_maobs.replay import Batch, Moment


class QLearner(JointLearner):
    """Q-learning of utilities Q_a(tau_a, .), mixed as a derived class says."""

    has_actors = False

    @override(JointLearner)
    def critic_loss(self, online: TeamNetworks, target: TeamNetworks, batch: Batch) -> tuple[Tensor, Tensor]:
        """L = E[(y - Q)^2], y = r + gamma Q'(u*'), with Q mixed and u*_a' = argmax Q'_a (or Q_a with `double_q`)."""
        q = (online.outputs(batch.now) * batch.actions).sum(-1)  # (B, N)
        next_q = target.outputs(batch.next)  # (B, N, A)
        judge = online.outputs(batch.next).detach() if self.config.double_q else next_q
        best = target.legal(judge).argmax(-1, keepdim=True)  # (B, N, 1)
        next_q = next_q.gather(-1, best).squeeze(-1)  # (B, N)
        total, next_total = self.total(online, q, batch.now), self.total(target, next_q, batch.next)
        # One value of the team goes on until all agents terminate.
        discount = batch.discount if total.shape[1] == next_q.shape[1] else batch.team_discount
        y = (batch.rewards[:, : total.shape[1]] + discount * next_total).detach()  # (B, N) or (B, 1)
        return (y - total).square().mean(0), total

    def total(self, nets: TeamNetworks, q: Tensor, moment: Moment) -> Tensor:
        """What is learned from all agents' values `(B, N)`: here every agent's own, `(B, N)`."""
        return q

    @override(JointLearner)
    def stacks(
        self,
        modules: Sequence[Any],
        prefix: str,
        action_mask: Tensor | None,
        agent_ids: Tensor | None,
        like: Parts | None = None,
    ) -> Parts:
        """The utilities, and the mixer if there is one."""
        networks = [getattr(m, f"{prefix}utility") for m in modules]
        names = [f"the utility of {agent}" for agent in self.config.team.agents]
        return Parts(
            config=self.config,
            actors=Actors(networks, names, like=None if like is None else like.actors),
            acting_role=CRITIC,  # utilities act, and are learned as critics are
            critics=None,
            mixers=self.mixers(prefix),
            action_mask=action_mask,
            agent_ids=None,
        )


class IQLConfig(JointConfig):
    """Configuration of independent Q-learning with discrete actions (Tan 1993; Mnih et al. 2015).

    ```python
    config = IQLConfig().environment("maobs/spread-3a", env_config={"action_mode": "discrete"})
    algo = config.build_algo()
    algo.train()
    ```

    Epsilon-greedy from 1.0 to 0.05 over 50 000 env steps (PyMARL's), soft targets. `critic_lr` is the learning rate.
    """

    name = "iql"
    supports = Supports(actions=("discrete",), twin_critics=False)
    critic_sees = ()
    learner = QLearner
    module = UtilityModule
    default_exploration: ClassVar[dict[str, Any]] = {"epsilon": 1.0, "noise": 0.0, "decay": 1.9e-5, "final": 0.05}
    legal: ClassVar[dict[str, Any]] = {**JointConfig.legal, "double_q": bool}

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class)
        self.double_q = False
        self.critic_lr = 1e-3

    @override(JointConfig)
    def training(self, *, double_q: bool = NotProvided, **kwargs: Any) -> Self:
        """Sets the training settings.

        Args:
            double_q: Whether the online utilities choose the next actions that the target ones value (van Hasselt et
                al. 2016). Default False.
            **kwargs: Those of every algorithm, see `JointConfig.training`; `actor="lstm"` makes the utilities LSTMs.
        """
        super().training(**kwargs)
        if double_q is not NotProvided:
            self.double_q = double_q
        return self


class IQL(JointAlgorithm):
    """IQL, see `IQLConfig`."""

    config_class = IQLConfig
