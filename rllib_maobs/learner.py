"""JointLearner: one stacked update of all agents, gradients routed to the role they belong to."""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType, MethodType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core import ALL_MODULES
from ray.rllib.core.learner.learner import Learner
from ray.rllib.core.learner.torch.torch_learner import TorchLearner
from ray.rllib.core.learner.training_data import TrainingData
from ray.rllib.utils.annotations import override
from ray.rllib.utils.metrics import (
    NUM_ENV_STEPS_SAMPLED_LIFETIME,
    NUM_ENV_STEPS_TRAINED,
    NUM_ENV_STEPS_TRAINED_LIFETIME,
)
from torch import Tensor
from torch.func import grad_and_value

from rllib_maobs.modules import Params, Stack
from rllib_maobs.modules.normalizer import merge
from rllib_maobs.terms import Batch, Columns, Nets, Terms

MIXER = "mixer"
NUM_UPDATES_LIFETIME = "num_updates_lifetime"
_PROGRESS = "progress"
_LAYOUT = 2  # how numbers lie in flat tensors (`Stack`), and so in the optimisers' saved state


class JointLearner(Terms, TorchLearner):
    """Trains a fixed team from joint minibatches; the base of all learners here.

    An algorithm overrides `critic_loss` and, if it has actors, `actor_loss`. Both are given the same parameters,
    those from before the update: first all gradients are computed, then critics (with their mixer) and actors
    step, then the targets move (the order of the code base the paper grew from). The critic loss moves critics
    and nothing else, the actor loss actors: each gradient is taken with respect to its own role alone.

    All agents' networks are stacked (see `Stack`), so a loss is one batched computation instead of a loop
    over agents. With `config.framework(torch_compile_learner=True)` it is compiled, once per run; the numbers
    are the same up to float rounding.
    """

    has_actors = True

    @override(TorchLearner)
    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        # RLlib would compile forward_train, which a stacked update never calls; what is compiled is ours.
        self._torch_compile_forward_train = self._torch_compile_complete_update = False
        self._sum: Tensor | None = None
        self._updates = self._whole_updates = 0
        self._updates_lifetime = 0
        # What an update may depend on but for numbers in tensors: each combination is compiled on its own.
        self.stage = ""
        self._compiled: dict[tuple[str, bool, int], Callable[..., Any]] = {}
        self._with_actors = self.has_actors

    @override(TorchLearner)
    def configure_optimizers(self) -> None:
        """Stacks the agents' networks and registers the optimisers (called by RLlib's `build`).

        One Adam for the actors, and one for the critics together with their mixers.
        """
        config, team = self.config, self.config.team
        modules = [self.module[mid].unwrapped() for mid in config.module_ids]
        self._roles, self._targets = self.stacks(modules)
        self._optimizer_of: dict[str, torch.optim.Adam] = {}
        self.normalizers = Stack([m.normalizer for m in modules]) if config.normalize_observations else None
        for role, trained, lr in (
            ("critic", ("critic", "mixer"), config.critic_lr),
            ("actor", ("actor",), config.actor_lr),
        ):
            parameters = [self._roles[name].flat for name in trained if name in self._roles]
            if parameters:
                optimizer = torch.optim.Adam(parameters)
                for flat in parameters:
                    optimizer.state[flat] = {
                        "step": torch.zeros((), device=flat.device),
                        "exp_avg": torch.zeros_like(flat),
                        "exp_avg_sq": torch.zeros_like(flat),
                    }
                self.register_optimizer(
                    module_id=ALL_MODULES,
                    optimizer_name=role,
                    optimizer=optimizer,
                    params=parameters,
                    lr_or_lr_schedule=lr,
                )
                self._optimizer_of |= {name: optimizer for name in trained if name in self._roles}
        self._bind()
        # Constants of the losses, and the random numbers that they need, drawn outside of what is compiled.
        device = self._device
        mask = torch.from_numpy(team.action_mask).to(device)
        self._action_mask = None if mask.all() else mask
        ids = torch.eye(len(team.agents), device=device)
        self._ids = ids if config.agent_id_input and config.central_critic else None
        columns = torch.tensor(config.state_columns, device=device)
        self._state_columns = None if len(columns) == len(team.agents) * team.observation_size else columns
        self._draw: Callable[..., Tensor] | None = None
        if self.has_actors:
            self._draw = torch.rand if team.discrete else torch.randn if config.target_noise else None
        self._generator = torch.Generator().manual_seed(config.seed or 0)

    def _bind(self) -> None:
        """Adam's tensors of each role, piece by piece: parameters, running means, running squares, steps."""
        self._adam = {}
        for role, stack in self._roles.items():
            state = self._optimizer_of[role].state[stack.flat]
            pieces = [stack.pieces(t) for t in (stack.flat.detach(), state["exp_avg"], state["exp_avg_sq"])]
            self._adam[role] = (*pieces, [state["step"]] * len(pieces[0]))

    def stacks(self, modules: list[Any]) -> tuple[dict[str, Stack], dict[str, Stack]]:
        """Stacks every agent's networks.

        Args:
            modules: The agents' RLModules; one that several share is listed for each of them.

        Returns:
            The stacks of each role ("actor", "critic", "mixer"), and those of their target networks.
        """
        tie = self.config.ties_critics
        online, target = (
            {
                "actor": Stack([getattr(m, f"{prefix}actor") for m in modules], ("forward", "raw")),
                "critic": Stack([getattr(m, f"{prefix}critic") for m in modules], ("encode", "value"), tie=tie),
            }
            for prefix in ("", "target_")
        )
        return online | self.mixer_stack(), target | self.mixer_stack("target_")

    def mixer_stack(self, prefix: str = "") -> dict[str, Stack]:
        """The mixers, stacked, under their role; nothing if the algorithm has none."""
        return (
            {MIXER: Stack(list(getattr(self.module[MIXER].unwrapped(), f"{prefix}mixers")))}
            if MIXER in self.module
            else {}
        )

    @property
    def acting(self) -> Stack:
        """The networks that act."""
        return self._roles["actor"]

    # What an algorithm defines.

    def critic_loss(self, nets: Nets, target: Nets, batch: Batch) -> tuple[Tensor, Tensor, Tensor | tuple[()]]:
        """The critics' loss, as the algorithm defines it.

        Args:
            nets: Parameters; the gradient is taken to those of the critic and the mixer.
            target: Target parameters.
            batch: The minibatch.

        Returns:
            The losses, one for each agent `(N,)` or one for the team `(1,)`; what they are the losses of, `(B, N)`
            or `(B, 1)`; and the encoded state that the actor loss uses again, if there is one.
        """
        raise TypeError(f"{type(self).__name__} defines no critic_loss: derive a learner that does.")

    def actor_loss(self, actions: Tensor, nets: Nets, encoded: Any, batch: Batch) -> Tensor:
        """The actors' loss, as the algorithm defines it.

        Args:
            actions: mu(o), every actor's current action, `(B, N, A)`; the gradient goes through them.
            nets: Parameters from before the update.
            encoded: The state as those critics encode it (third result of `critic_loss`).
            batch: The minibatch.

        Returns:
            The losses, `(N,)` or `(1,)`.
        """
        raise TypeError(f"{type(self).__name__} defines no actor_loss: derive a learner that does.")

    @property
    def trains_mixer(self) -> bool:
        """Whether there is a mixer and this stage trains it."""
        return "mixer" in self._roles

    def stage_at(self, env_steps: int) -> str:
        """The training stage after some env steps, for algorithms that change their losses on the way."""
        return ""

    # The update.

    def _gradients(
        self, nets: Nets, target: Nets, normalizer: Params, columns: Columns
    ) -> tuple[dict[str, list[Tensor]], Tensor]:
        """All roles' gradients and the report."""
        batch = self.prepare(columns, normalizer)

        def critic_loss(critic: Params, mixer: Params) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor | tuple[()]]]:
            losses, q, encoded = self.critic_loss(Nets(nets.actor, critic, mixer), target, batch)
            return losses.sum(), (losses, q, encoded)

        def actor_loss(actor: Params) -> tuple[Tensor, Tensor]:
            output = self.act(actor, batch.history)
            losses = self.actor_loss(self.actions(output, batch.noise), nets, encoded, batch)
            total = losses.sum()
            if self.config.action_regularization:
                total = total + self.config.action_regularization * output.square().mean((0, 2)).sum()
            return total, losses

        # Sums over agents only gather the losses: agent i's parameters are in no other agent's loss, but for
        # the algorithms whose loss is joint by definition, and agents that share their parameters.
        gradients, (_, (critic_losses, q, encoded)) = grad_and_value(critic_loss, argnums=(0, 1), has_aux=True)(
            nets.critic, nets.mixer
        )
        by_role = {"critic": self._clipped("critic", gradients[0])}
        if self.trains_mixer:
            by_role["mixer"] = self._clipped("mixer", gradients[1])
        report = [critic_losses, q.mean(0)]
        if self._with_actors:
            gradient, (_, actor_losses) = grad_and_value(actor_loss, has_aux=True)(nets.actor)
            by_role["actor"] = self._clipped("actor", gradient)
            report.append(actor_losses)
        elif self.has_actors:
            report.append(torch.zeros_like(critic_losses))
        agents = len(self.config.team.agents)
        return by_role, torch.stack([values.expand(agents) for values in report])

    def gradients(self, columns: Columns, *, with_actors: bool | None = None) -> tuple[dict[str, list[Tensor]], Tensor]:
        """All roles' gradients of one minibatch, and the report; compiled if so configured.

        Args:
            columns: The minibatch.
            with_actors: Whether those of the actors, too; None if the algorithm has actors.

        Returns:
            Gradients of "critic", "mixer" and "actor" (those that there are), in the pieces of their stacks, and, for
            every agent, the critic's loss, mean Q and the actor's loss, `(3, N)`; `(2, N)` if there are no actors.
        """
        self._with_actors = self.has_actors if with_actors is None else with_actors
        normalizer = {} if self.normalizers is None else self.normalizers.params
        arguments = self.nets(), self.nets(target=True), normalizer, columns
        if not self.config.torch_compile_learner:
            return self._gradients(*arguments)
        key = (self.stage, self._with_actors, len(columns["rewards"]))
        if key not in self._compiled:
            self._compiled[key] = self._compile()
        return self._compiled[key](*arguments)

    def _clipped(self, role: str, gradient: Params) -> list[Tensor]:
        """One role's gradient in pieces, clipped for every network on its own if so configured."""
        limit, by = self.config.grad_clip, self.config.grad_clip_by
        if limit is not None and by == "value":
            gradient = {name: g.clamp(-limit, limit) for name, g in gradient.items()}
        elif limit is not None:
            squares = {name: g.flatten(1).square().sum(1) for name, g in gradient.items()}  # (rows,) each
            if by == "global_norm":
                squares = dict.fromkeys(squares, torch.stack(list(squares.values())).sum(0))
            gradient = {
                name: g * (limit / squares[name].sqrt().clamp(min=limit)).view(-1, *[1] * (g.dim() - 1))
                for name, g in gradient.items()
            }
        return self._roles[role].flatten(gradient)

    def _compile(self) -> Callable[..., Any]:
        """`_gradients` as compiled code."""
        # Code of its own: compiled code is kept per code object, and not checked against what has changed.
        own = FunctionType(JointLearner._gradients.__code__.replace(), JointLearner._gradients.__globals__)
        config = self.config
        backend, mode = config.torch_compile_learner_dynamo_backend, config.torch_compile_learner_dynamo_mode
        # `gradients` compiles anew for whatever changes between calls, so nothing need be checked at every one.
        options: dict[str, Any] = {"guard_filter_fn": torch.compiler.skip_all_guards_unsafe}
        if backend == "inductor" and self._device.type == "cpu":
            options["cpp_wrapper"] = True  # small kernels: Python between them would take a tenth of the time
        compiled: Callable[..., Any] = torch.compile(
            MethodType(own, self),
            fullgraph=True,
            dynamic=False,
            backend=backend,
            mode=mode,
            options=None if mode else options,
        )
        return compiled

    def nets(self, *, target: bool = False) -> Nets:
        """All roles' parameters, or those of their targets."""
        stacks = self._targets if target else self._roles
        return Nets(*(stacks[role].params if role in stacks else {} for role in Nets._fields))

    @torch.no_grad()
    def step(self, columns: Columns) -> Tensor:
        """One update: gradients, Adam, Polyak averaging.

        With `policy_delay` the actors and all targets take part in every so many updates only (TD3).

        Args:
            columns: The minibatch.

        Returns:
            The report of `gradients`.
        """
        whole = self._updates_lifetime % self.config.policy_delay == 0
        gradients, report = self.gradients(columns, with_actors=whole and self.has_actors)
        self._updates_lifetime += 1
        self._whole_updates += whole
        for role, gradient in gradients.items():
            self._adam_step(role, gradient)
        if whole:
            for role, stack in self._roles.items():
                self._targets[role].flat.lerp_(stack.flat, self.config.tau)
        return report

    def _adam_step(self, role: str, gradient: list[Tensor]) -> None:
        """One step of a role's Adam, on the pieces as they come: `optimizer.step()` wants them copied into one."""
        parameters, means, squares, steps = self._adam[role]
        steps[0].add_(1.0)
        group = self._optimizer_of[role].param_groups[0]
        beta1, beta2 = group["betas"]
        torch._fused_adam_(
            parameters,
            gradient,
            means,
            squares,
            [],
            steps,
            lr=group["lr"],
            beta1=beta1,
            beta2=beta2,
            weight_decay=0.0,
            eps=group["eps"],
            amsgrad=False,
            maximize=False,
        )

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
            batch: Columns with a further leading axis, `(K, B, ...)`.
            training_data: The same, wrapped by RLlib's LearnerGroup.
            timesteps: RLlib's time, for stages of training and learning-rate schedules.
            _no_metrics_reduce: Whether to go on collecting metrics instead of returning them.
            **kwargs: Ignored.

        Returns:
            Means over the updates since the last returned result, for every module, or None.
        """
        columns: Columns = dict(training_data.batch if training_data is not None else batch)
        timesteps = timesteps or {}
        self.before_gradient_based_update(timesteps=timesteps)
        self.stage = self.stage_at(timesteps.get(NUM_ENV_STEPS_SAMPLED_LIFETIME, 0))
        if self._draw is not None:
            actions = columns["actions"]
            columns["noise"] = self._draw(actions.shape, generator=self._generator).to(actions.device)
        updates = {name: column.unbind() for name, column in columns.items()}
        count, size = columns["rewards"].shape[:2]
        for index in range(count):
            report = self.step({name: parts[index] for name, parts in updates.items()})
            self._sum = report.clone() if self._sum is None else self._sum.add_(report)
        self._updates += count
        self._weights_seq_no += 1
        self.metrics.log_value((ALL_MODULES, NUM_ENV_STEPS_TRAINED), count * size, reduce="sum")
        self.metrics.log_value((ALL_MODULES, NUM_ENV_STEPS_TRAINED_LIFETIME), count * size, reduce="lifetime_sum")
        return None if _no_metrics_reduce else self.report(timesteps=timesteps)

    def report(self, *, timesteps: dict[str, Any] | None = None) -> Any:
        """Means of what the updates since the last report said, and the learning rates of their time.

        Args:
            timesteps: RLlib's time, for learning-rate schedules.

        Returns:
            RLlib's reduced metrics, or None if there was no update.
        """
        if self._sum is None:
            return None
        counts = {"critic_loss": self._updates, "q_mean": self._updates, "actor_loss": max(1, self._whole_updates)}
        for (name, count), values in zip(counts.items(), self._sum.tolist(), strict=False):
            by_module: dict[str, list[float]] = {}
            for mid, value in zip(self.config.module_ids, values, strict=True):
                by_module.setdefault(mid, []).append(value / count)
            for mid, of_agents in by_module.items():
                self.metrics.log_value((mid, name), sum(of_agents) / len(of_agents), window=1)
        self.metrics.log_value((ALL_MODULES, NUM_UPDATES_LIFETIME), self._updates, reduce="lifetime_sum")
        self._sum, self._updates, self._whole_updates = None, 0, 0
        self.after_gradient_based_update(timesteps=timesteps or {})
        return self.metrics.reduce()

    def observe(self, observations: NDArray[np.float32]) -> None:
        """Takes newly sampled observations `(..., N, O)` into the running normalisation, if there is one."""
        if self.normalizers is None:
            return
        obs = torch.from_numpy(np.require(observations, np.float32, "W")).to(self._device)
        params, rows = self.normalizers.params, torch.tensor(self.normalizers.rows)
        for row in range(max(self.normalizers.rows) + 1):
            own = obs[..., rows == row, :].flatten(0, -2)
            merge(params["mean"][row], params["square"][row], params["count"][row], own)

    @override(Learner)
    def get_state(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """RLlib's state, the number of updates made and the random numbers to come."""
        state: dict[str, Any] = super().get_state(*args, **kwargs)
        generator = self._generator.get_state().numpy()
        state[_PROGRESS] = {"updates": self._updates_lifetime, "generator": generator, "layout": _LAYOUT}
        return state

    @override(Learner)
    def set_state(self, state: dict[str, Any]) -> None:
        """Goes on from a saved state.

        Raises:
            ValueError: If a revision saved it whose optimisers' numbers lie in another order.
        """
        if _PROGRESS in state and state[_PROGRESS].get("layout") != _LAYOUT:
            raise ValueError(
                f"This learner's state was saved by an earlier revision of rllib-maobs, whose optimisers' numbers lie "
                f"in another order (layout {state[_PROGRESS].get('layout', 1)}, here {_LAYOUT}): go on with it there, "
                f"or take its trained agents with RLModule.from_checkpoint."
            )
        super().set_state(state)
        self._bind()  # the optimisers' tensors are new ones
        if _PROGRESS in state:
            self._updates_lifetime = state[_PROGRESS]["updates"]
            self._generator.set_state(torch.from_numpy(state[_PROGRESS]["generator"]))

    @override(TorchLearner)
    def _log_trainable_parameters(self) -> None:
        """Nothing: RLlib logs these once and reports them as NaN from the second iteration on."""

    @override(TorchLearner)
    def compute_loss_for_module(self, **kwargs: Any) -> Any:
        """Not how this learner works: its losses are joint."""
        raise TypeError("A JointLearner has no loss per module: see critic_loss and actor_loss.")
