"""IQL: independent Q-learning, the Q-learning family without a mixer; what VDN and QMIX derive from."""

from __future__ import annotations

from typing import Any, ClassVar, Self

from ray.rllib.algorithms.algorithm_config import NotProvided
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import Abilities, JointConfig
from rllib_maobs.learner import JointLearner
from rllib_maobs.modules import Params, Stack, UtilityModule
from rllib_maobs.terms import Batch, Nets


class QLearner(JointLearner):
    """Q-learning of utilities Q_a(tau_a, .), mixed as a derived class says."""

    has_actors = False

    @override(JointLearner)
    def critic_loss(self, nets: Nets, target: Nets, batch: Batch) -> tuple[Tensor, Tensor, tuple[()]]:
        """L = E[(y - Q)^2], y = r + gamma Q'(u*'), with Q mixed and u*_a' = argmax Q'_a (or Q_a with `double_q`)."""
        q = (self.utilities(nets.critic, batch.history) * batch.actions).sum(-1)  # (B, N)
        next_q = self.utilities(target.critic, batch.next_history)  # (B, N, A)
        judge = self.utilities(nets.critic, batch.next_history).detach() if self.config.double_q else next_q
        best = self.legal(judge).argmax(-1, keepdim=True)  # (B, N, 1)
        next_q = next_q.gather(-1, best).squeeze(-1)  # (B, N)
        q_tot, next_q_tot = self.total(nets.mixer, q, batch.state), self.total(target.mixer, next_q, batch.next_state)
        y = batch.rewards[:, : q_tot.shape[1]] + batch.discount * next_q_tot  # (B, N) or (B, 1)
        return (y - q_tot).square().mean(0), q_tot, ()

    def total(self, mixer: Params, q: Tensor, state: Tensor) -> Tensor:
        """What is learned from all agents' values `(B, N)`: here every agent's own, `(B, N)`."""
        return q

    def utilities(self, utility: Params, history: tuple[Tensor, ...]) -> Tensor:
        """Every agent's Q_a of each of its actions, `(B, N, A)`."""
        dims = (1, None, 1)[: len(history)]
        return self._roles["critic"](utility, *zip(history, dims, strict=True))

    def legal(self, values: Tensor) -> Tensor:
        """Values `(B, N, A)` with -inf for actions that an agent has not."""
        return values if self._action_mask is None else values.masked_fill(~self._action_mask, -float("inf"))

    @property
    @override(JointLearner)
    def acting(self) -> Stack:
        """The utilities."""
        return self._roles["critic"]

    @override(JointLearner)
    def stacks(self, modules: list[Any]) -> tuple[dict[str, Stack], dict[str, Stack]]:
        """The utilities, and the mixer if there is one."""
        online = {"critic": Stack([m.utility for m in modules])}
        target = {"critic": Stack([m.target_utility for m in modules])}
        return online | self.mixer_stack(), target | self.mixer_stack("target_")


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
    abilities = Abilities(actions=("discrete",), twin_critics=False)
    uses_state = False
    central_critic = False
    default_exploration: ClassVar[dict[str, float]] = {"epsilon": 1.0, "noise": 0.0, "decay": 1.9e-5, "final": 0.05}

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class or IQL)
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

    @override(JointConfig)
    def critic_sizes(self, agent: str) -> None:
        """No critics: utilities act."""

    @override(JointConfig)
    def get_default_rl_module_spec(self) -> RLModuleSpec:
        """One `UtilityModule` per policy."""
        return RLModuleSpec(module_class=UtilityModule)

    @override(JointConfig)
    def get_default_learner_class(self) -> type[JointLearner]:
        """Q-learning, every agent on its own."""
        return QLearner


class IQL(JointAlgorithm):
    """IQL, see `IQLConfig`."""

    @classmethod
    @override(JointAlgorithm)
    def get_default_config(cls) -> IQLConfig:
        """PyMARL's exploration."""
        return IQLConfig()
