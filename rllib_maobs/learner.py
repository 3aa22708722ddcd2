"""JointLearner: one stacked update of all agents, gradients routed to the role they belong to."""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType, MethodType
from typing import Any, NamedTuple

import torch
from ray.rllib.core import ALL_MODULES
from ray.rllib.core.learner.learner import Learner
from ray.rllib.core.learner.torch.torch_learner import TorchLearner
from ray.rllib.core.learner.training_data import TrainingData
from ray.rllib.utils.annotations import override
from ray.rllib.utils.metrics import NUM_ENV_STEPS_TRAINED, NUM_ENV_STEPS_TRAINED_LIFETIME
from torch import Tensor
from torch.func import grad_and_value

from rllib_maobs.modules.stack import Params, Stack

NUM_UPDATES_LIFETIME = "num_updates_lifetime"


class Batch(NamedTuple):
    """A minibatch of joint transitions."""

    obs: Tensor  # (B, N, O)
    state: Tensor  # (B, S)
    actions: Tensor  # (B, N, A) in [-1, 1]
    rewards: Tensor  # (B, N)
    terminated: Tensor  # (B, 1): 1.0 where the episode really ended; a time limit is 0.0 and bootstraps
    next_obs: Tensor  # (B, N, O)
    next_state: Tensor  # (B, S)


class Nets(NamedTuple):
    """Parameters of all agents, by role."""

    actor: Params
    critic: Params


class JointLearner(TorchLearner):
    """Trains a fixed team of actors and critics from joint minibatches.

    An algorithm overrides `critic_loss` and `actor_loss`. Both are given the same parameters, those from
    before the update: first both gradients are computed, then critics and actors step, then the targets
    move (the order of the code base the paper grew from). The critic loss moves critics and nothing else, the
    actor loss actors: each gradient is taken with respect to its own role alone.

    All agents' networks are stacked (see `Stack`), so a loss is one batched computation instead of a loop
    over agents. With `config.framework(torch_compile_learner=True)` it is compiled, once per run; the numbers
    are the same up to float rounding.
    """

    @override(TorchLearner)
    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        # RLlib would compile forward_train, which a stacked update never calls; what is compiled is ours.
        self._torch_compile_forward_train = self._torch_compile_complete_update = False
        self._sums: dict[str, Tensor] = {}
        self._updates = 0

    @override(TorchLearner)
    def configure_optimizers(self) -> None:
        """Stacks the agents' networks and registers one Adam per role (called by RLlib's `build`)."""
        modules = [self.module[mid].unwrapped() for mid in self.config.module_ids]
        encode = ("encode", "value")
        self.actors = Stack([m.actor for m in modules])
        self.critics = Stack([m.critic for m in modules], encode)
        self.target_actors = Stack([m.target_actor for m in modules])
        self.target_critics = Stack([m.target_critic for m in modules], encode)
        for role, stack, lr in (
            ("actor", self.actors, self.config.actor_lr),
            ("critic", self.critics, self.config.critic_lr),
        ):
            self.register_optimizer(
                module_id=ALL_MODULES,
                optimizer_name=role,
                optimizer=torch.optim.Adam([stack.flat], fused=True),
                params=[stack.flat],
                lr_or_lr_schedule=lr,
            )
        self.gradients: Callable[..., tuple[Tensor, Tensor, dict[str, Tensor]]] = self._gradients
        if self.config.torch_compile_learner:
            # Code of its own: compiled code is kept per code object, and those unchecked things differ by learner.
            own = FunctionType(JointLearner._gradients.__code__.replace(), JointLearner._gradients.__globals__)
            self.gradients = torch.compile(
                MethodType(own, self),
                fullgraph=True,
                dynamic=False,
                backend=self.config.torch_compile_learner_dynamo_backend,
                mode=self.config.torch_compile_learner_dynamo_mode,
                # Nothing but the tensors changes between calls, so nothing else need be checked at every one.
                options=None
                if self.config.torch_compile_learner_dynamo_mode
                else {"guard_filter_fn": torch.compiler.keep_tensor_guards_unsafe},
            )

    def act(self, actor: Params, obs: Tensor) -> Tensor:
        """Every agent's mu_i(o_i): observations `(B, N, O)` to actions `(B, N, A)` in [-1, 1]."""
        return self.actors(actor, (obs, 1))

    def encode(self, critic: Params, state: Tensor) -> Tensor:
        """The critics' share of what they see of the state, to be used by both losses.

        Args:
            critic: Parameters of the critics.
            state: One state for all `(B, S)`, or one for each `(B, N, S)`.

        Returns:
            `(B, N, H)`.
        """
        if state.dim() == 3:
            return self.critics(critic, (state, 1), method="encode")
        # One state for all: one wide matrix product instead of N narrow ones.
        weight = critic["from_state.weight"]  # (N, H, S)
        return torch.nn.functional.linear(state, weight.flatten(0, 1)).unflatten(-1, weight.shape[:2])

    def q(self, critic: Params, encoded: Tensor, actions: Tensor) -> Tensor:
        """Every agent's Q_i.

        Args:
            critic: Parameters of the critics.
            encoded: Result of `encode`, `(B, N, H)`.
            actions: What each critic sees of the actions: one joint action for all `(B, N * A)`, or one entry
                for each `(B, N, ...)`.

        Returns:
            `(B, N)`.
        """
        return self.critics(critic, (encoded, 1), (actions, 1 if actions.dim() == 3 else None), method="value")

    def critic_loss(self, critic: Params, target: Nets, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """The critics' loss, as the algorithm defines it.

        Args:
            critic: Parameters the gradient is taken to.
            target: Target parameters.
            batch: The minibatch.

        Returns:
            Every agent's loss `(N,)`, its Q `(B, N)` and the encoded state `(B, N, H)` that the actor loss reuses.
        """
        raise TypeError(f"{type(self).__name__} defines no critic_loss: derive a learner that does.")

    def actor_loss(self, actor: Params, critic: Params, encoded: Tensor, batch: Batch) -> Tensor:
        """The actors' loss, as the algorithm defines it.

        Args:
            actor: Parameters the gradient is taken to.
            critic: The critics as they were before this update.
            encoded: The state as those critics encode it, `(B, N, H)`.
            batch: The minibatch.

        Returns:
            Every agent's loss, `(N,)`.
        """
        raise TypeError(f"{type(self).__name__} defines no actor_loss: derive a learner that does.")

    def _gradients(self, nets: Nets, target: Nets, batch: Batch) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Both roles' gradients as flat vectors, and what there is to report."""

        def critic_loss(critic: Params) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
            losses, q, encoded = self.critic_loss(critic, target, batch)
            return losses.sum(), (losses, q, encoded)

        def actor_loss(actor: Params) -> tuple[Tensor, Tensor]:
            losses = self.actor_loss(actor, nets.critic, encoded, batch)
            return losses.sum(), losses

        # Sums over agents only gather the losses: agent i's parameters are in no other agent's loss, but for
        # the algorithms whose actor loss is joint by definition.
        critic_gradient, (_, (critic_losses, q, encoded)) = grad_and_value(critic_loss, has_aux=True)(nets.critic)
        actor_gradient, (_, actor_losses) = grad_and_value(actor_loss, has_aux=True)(nets.actor)
        report = {"critic_loss": critic_losses, "actor_loss": actor_losses, "q_mean": q.mean(0)}
        return self.actors.flatten(actor_gradient), self.critics.flatten(critic_gradient), report

    @torch.no_grad()
    def step(self, batch: Batch) -> dict[str, Tensor]:
        """One update: gradients, Adam, Polyak averaging.

        Args:
            batch: The minibatch.

        Returns:
            `critic_loss`, `actor_loss`, `q_mean` of every agent, `(N,)` each.
        """
        nets = Nets(self.actors.params, self.critics.params)
        target = Nets(self.target_actors.params, self.target_critics.params)
        actor_gradient, critic_gradient, report = self.gradients(nets, target, batch)
        for role, stack, targets, gradient in (
            ("critic", self.critics, self.target_critics, critic_gradient),
            ("actor", self.actors, self.target_actors, actor_gradient),
        ):
            stack.flat.grad = gradient
            self.get_optimizer(ALL_MODULES, role).step()
            targets.flat.lerp_(stack.flat, self.config.tau)
        return report

    @override(Learner)
    def update(
        self,
        batch: Any = None,
        *,
        training_data: TrainingData | None = None,
        timesteps: dict[str, Any] | None = None,
        _no_metrics_reduce: bool = False,
        **kwargs: Any,
    ) -> Any:
        """One update for each of K minibatches, which the batch holds along its first axis.

        Args:
            batch: A `Batch` with a further leading axis, `(K, B, ...)`.
            training_data: The same, wrapped by RLlib's LearnerGroup.
            timesteps: RLlib's time, for learning-rate schedules.
            _no_metrics_reduce: Whether to go on collecting metrics instead of returning them.
            **kwargs: Ignored.

        Returns:
            Means over the updates since the last returned result, for every module, or None.
        """
        batches: Batch = training_data.batch if training_data is not None else batch
        self.before_gradient_based_update(timesteps=timesteps or {})
        for index in range(len(batches.rewards)):
            report = self.step(Batch(*(column[index] for column in batches)))
            for name, value in report.items():
                self._sums[name] = self._sums[name] + value if name in self._sums else value.clone()
            self._updates += 1
        self._weights_seq_no += 1
        trained = batches.rewards.shape[0] * batches.rewards.shape[1]
        self.metrics.log_value((ALL_MODULES, NUM_ENV_STEPS_TRAINED), trained, reduce="sum")
        self.metrics.log_value((ALL_MODULES, NUM_ENV_STEPS_TRAINED_LIFETIME), trained, reduce="lifetime_sum")
        return None if _no_metrics_reduce else self.report(timesteps=timesteps)

    def report(self, *, timesteps: dict[str, Any] | None = None) -> Any:
        """Means of what the updates since the last report said, and the learning rates of their time.

        Args:
            timesteps: RLlib's time, for learning-rate schedules.

        Returns:
            RLlib's reduced metrics, or None if there was no update.
        """
        if not self._updates:
            return None
        for name, total in self._sums.items():
            for mid, value in zip(self.config.module_ids, (total / self._updates).tolist(), strict=True):
                self.metrics.log_value((mid, name), value, window=1)
        self.metrics.log_value((ALL_MODULES, NUM_UPDATES_LIFETIME), self._updates, reduce="lifetime_sum")
        self._sums, self._updates = {}, 0
        self.after_gradient_based_update(timesteps=timesteps or {})
        return self.metrics.reduce()

    @override(TorchLearner)
    def _log_trainable_parameters(self) -> None:
        """Nothing: RLlib logs these once and reports them as NaN from the second iteration on."""

    @override(TorchLearner)
    def compute_loss_for_module(self, **kwargs: Any) -> Any:
        """Not how this learner works: its losses are joint."""
        raise TypeError("A JointLearner has no loss per module: see critic_loss and actor_loss.")
