"""JointLearner: one stacked update of all agents, gradients routed to the role they belong to."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Literal

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

from rllib_maobs.learner.compare import compare_networks
from rllib_maobs.learner.health import MOST_SKIPPED, REPORT, Diverged, evidence_of, not_finite
from rllib_maobs.learner.networks import ACTOR, CRITIC, MIXER, Parts, TeamNetworks
from rllib_maobs.learner.update import Recorded, StackedAdam, clipped, compiled
from rllib_maobs.modules import Params, Stack
from rllib_maobs.modules.denormals import denormals_are_zero
from rllib_maobs.modules.normalizer import Normalizers
from rllib_maobs.modules.team import Actors, Critics
from rllib_maobs.replay import Batch, Moment

logger = logging.getLogger(__name__)
NUM_UPDATES_LIFETIME = "num_updates_lifetime"
NUM_UPDATES_SKIPPED_LIFETIME = "num_updates_skipped_lifetime"
_PROGRESS = "progress"
_CLEANED_EVERY = 100  # updates; a mean falls through all denormal numbers in some 150
_LAYOUT = 3  # how numbers lie in flat tensors (`Stack`), and so in the optimisers' saved state


class JointLearner(TorchLearner):
    """Trains a fixed team from joint minibatches; the base of all learners here.

    An algorithm overrides `critic_loss` and, if it has actors, `actor_loss`. Both are given the same parameters,
    those from before the update: first all gradients are computed, then critics (with their mixer) and actors
    step, then the targets move (the order of the code base the paper grew from). The critic loss moves critics
    and nothing else, the actor loss actors: in each the other role's parameters are constants.

    All agents' networks are stacked (see `Stack`), so a loss is one batched computation instead of a loop
    over agents. With `config.framework(torch_compile_learner=True)` it is compiled, once per run; the numbers
    are the same up to float rounding. Compiled code keeps the Python values that a loss read when it was compiled:
    settings of `self.config`, attributes of `self`, numbers from elsewhere. What is to change during training is a
    tensor of the minibatch, or `self.stage`: each stage is compiled on its own (see `stage_at`). Without compiling, a
    learner of your own runs as Python at every update, unless it is `recorded`.

    Attributes:
        has_actors: Whether there are actors, and an `actor_loss`.
        recorded: Whether an update that is not compiled is recorded after a while and played back, the same bits in
            less than half of the time. Its losses are then held to what is said above. Only this package's learners
            are, and those whose class says `recorded = True`.
        noise: Random numbers that the losses need, "normal" or "uniform" in [0, 1), as `batch.noise` `(B, N, A)`.
            Others would not be in a checkpoint. (Discrete actors have uniform ones, smoothed targets normal ones,
            anyway.)
        parts: The stacked networks, and the team's constants.
        target_parts: The target networks.
        normalizers: The agents' running normalisation of observations, or None.
        stage: The training stage, see `stage_at`.
        q_max: The largest |Q| of a minibatch, mean over the updates of the last report.
    """

    has_actors = True
    recorded: ClassVar[bool] = True
    noise: ClassVar[Literal["normal", "uniform"] | None] = None

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Has the updates of a class from elsewhere run as they are, unless it says otherwise itself."""
        super().__init_subclass__(**kwargs)
        if "recorded" not in vars(cls):
            cls.recorded = cls.__module__.startswith("rllib_maobs.")

    @override(TorchLearner)
    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        # RLlib would compile forward_train, which a stacked update never calls; what is compiled is ours.
        self._torch_compile_forward_train = self._torch_compile_complete_update = False
        # With evaluation_parallel_to_training RLlib takes the weights in another thread than it trains in.
        self._updating = threading.Lock()
        self._sum: Tensor | None = None
        self.q_max = 0.0
        self._updates = self._actor_updates = 0
        self._updates_lifetime = self._env_steps = self._skipped_in_a_row = 0
        # What an update may depend on but for numbers in tensors: each combination is compiled (recorded) on its own.
        self.stage = ""
        self._made: dict[tuple[str, bool, int], Callable[..., Any]] = {}
        self._with_actors = self.has_actors

    # What an algorithm defines.

    def critic_loss(self, online: TeamNetworks, target: TeamNetworks, batch: Batch) -> tuple[Tensor, Tensor]:
        """The critics' loss, as the algorithm defines it.

        It is traced and compiled: what it reads of `self.config` and `self` is a constant from then on.

        Args:
            online: The networks; the gradient is taken to the critics' and the mixer's parameters, actors are
                constants.
            target: The target networks, all constants.
            batch: The minibatch.

        Returns:
            The losses, one for each agent `(N,)` or one for the team `(1,)`; and what they are the losses of, `(B, N)`
            or `(B, 1)`.
        """
        raise TypeError(f"{type(self).__name__} defines no critic_loss: derive a learner that does.")

    def actor_loss(self, actions: Tensor, online: TeamNetworks, batch: Batch) -> Tensor:
        """The actors' loss, as the algorithm defines it; what `critic_loss` says of Python values holds here, too.

        Args:
            actions: mu(o), every actor's current action, `(B, N, A)`; the gradient goes through them alone.
            online: The networks from before the update, all constants.
            batch: The minibatch.

        Returns:
            The losses, `(N,)` or `(1,)`.
        """
        raise TypeError(f"{type(self).__name__} defines no actor_loss: derive a learner that does.")

    @property
    def trains_mixer(self) -> bool:
        """Whether there is a mixer and this stage trains it."""
        return MIXER in self._roles

    def stage_at(self, env_steps: int) -> str:
        """The training stage after some env steps, for algorithms that change their losses on the way."""
        return ""

    # The update.

    def joint_gradients(
        self, online: dict[str, Params], target: dict[str, Params], normalizer: Params, batch: Batch
    ) -> tuple[dict[str, list[Tensor]], Tensor]:
        """All roles' gradients and the report: what is compiled. A derived class may override it.

        Args:
            online: Stacked parameters by role.
            target: Those of the target networks.
            normalizer: Those of the normalisation of observations.
            batch: The minibatch, as replay gave it.

        Returns:
            As `gradients`.
        """
        batch = self.prepare(batch, normalizer)
        trained = [CRITIC, *([MIXER] if self.trains_mixer else []), *([ACTOR] if self._with_actors else [])]

        def total(params: dict[str, Params]) -> tuple[Tensor, tuple[Tensor, ...]]:
            # Each loss sees the other role's parameters as they are outside of the gradient: constants.
            tracked = TeamNetworks(self.parts, {**online, **params, ACTOR: online[ACTOR]})
            losses, q = self.critic_loss(tracked, TeamNetworks(self.target_parts, target), batch)
            self._check_losses("critic_loss", losses, q)
            if not self._with_actors:
                return losses.sum(), (losses, q)
            outputs = TeamNetworks(self.parts, params).outputs(batch.now)
            constant = TeamNetworks(self.parts, online, encoded_by=tracked)
            actor_losses = self.actor_loss(constant.actions(outputs, batch.noise), constant, batch)
            self._check_losses("actor_loss", actor_losses)
            regularization = self.config.action_regularization * outputs.square().mean((0, 2)).sum()
            return losses.sum() + actor_losses.sum() + regularization, (losses, q, actor_losses)

        # Sums over agents only gather the losses: agent i's parameters are in no other agent's loss, but for
        # the algorithms whose loss is joint by definition, and agents that share their parameters.
        by_role, (_, (losses, q, *actor_losses)) = grad_and_value(total, has_aux=True)(
            {role: online[role] for role in trained}
        )
        report = [losses, q.mean(0), *(actor_losses or [torch.zeros_like(losses)]), q.abs().amax(0)]
        gradients = {}
        for role, gradient in by_role.items():
            stack = self._roles[role]
            free = {k: torch.zeros_like(g) if k in stack.constants else g for k, g in gradient.items()}
            gradients[role] = stack.flatten(clipped(free, self.config.grad_clip, self.config.grad_clip_by))
        return gradients, torch.stack([values.expand(len(self.config.team.agents)) for values in report])

    def _check_losses(self, name: str, losses: Tensor, q: Tensor | None = None) -> None:
        """Raises a ValueError if what an algorithm's loss returned is not of the shape that it must have."""
        agents = len(self.config.team.agents)
        if losses.shape not in ((agents,), (1,)) or (q is not None and q.shape[1:] not in ((agents,), (1,))):
            of = "" if q is None else f", and what they are of (B, {agents}) or (B, 1), not {tuple(q.shape)}"
            raise ValueError(
                f"{type(self).__name__}.{name} must return losses of shape ({agents},) or (1,), not "
                f"{tuple(losses.shape)}{of}."
            )

    def gradients(self, batch: Batch, *, with_actors: bool | None = None) -> tuple[dict[str, list[Tensor]], Tensor]:
        """All roles' gradients of one minibatch, and the report; compiled if so configured.

        Args:
            batch: The minibatch, as replay gave it.
            with_actors: Whether those of the actors, too; None if the algorithm has actors.

        Returns:
            Gradients of "critic", "mixer" and "actor" (those that there are), a vector for each stacked parameter; and
            the rows of `REPORT` for every agent, `(6, N)`: zeros of actors that take no part.
        """
        self._with_actors = self.has_actors if with_actors is None else with_actors
        normalizer = {} if self.normalizers is None else self.normalizers.params
        arguments = self._params_of(self._roles), self._params_of(self._targets), normalizer, batch
        key = (self.stage, self._with_actors, len(batch.rewards))
        if key not in self._made:
            self._made[key] = self._fast(self._measured_gradients)
        return self._made[key](*arguments)

    def _measured_gradients(self, *arguments: Any) -> tuple[dict[str, list[Tensor]], Tensor]:
        """`joint_gradients` with the norms of the gradients as further rows of the report."""
        gradients, report = self.joint_gradients(*arguments)
        norms = []
        for roles in ((CRITIC, MIXER), (ACTOR,)):
            parts = [torch.linalg.vector_norm(part) for role in roles for part in gradients.get(role, ())]
            norms.append(torch.linalg.vector_norm(torch.stack(parts)) if parts else torch.zeros_like(report[0, 0]))
        return gradients, torch.cat([report, torch.stack(norms)[:, None].expand(-1, report.shape[1])])

    def _fast(self, method: Callable[..., Any]) -> Callable[..., Any]:
        """A method as it is to be called again and again: compiled, recorded, or as it is."""
        if self.config.torch_compile_learner:
            return compiled(method, self.config, self._device)
        return Recorded(method) if self.recorded else method

    @staticmethod
    def _params_of(stacks: dict[str, Stack]) -> dict[str, Params]:
        """Parameters of every role; none where the algorithm has no such role."""
        return {role: stacks[role].params if role in stacks else {} for role in (ACTOR, CRITIC, MIXER)}

    @torch.no_grad()
    def step(self, batch: Batch) -> Tensor | None:
        """One update: gradients, Adam, Polyak averaging.

        With `policy_delay` the actors and all targets take part in every so many updates only (TD3).

        Args:
            batch: The minibatch, as replay gave it.

        Returns:
            The report of `gradients`; None for an update that was skipped.

        Raises:
            Diverged: If it is not finite and none is to be skipped; the networks are as before.
        """
        with_targets = self._updates_lifetime % self.config.policy_delay == 0
        gradients, report = self.gradients(batch, with_actors=with_targets and self.has_actors)
        self._updates_lifetime += 1
        if not math.isfinite(report.sum().item()):
            self._skip(batch, report)
            return None
        self._skipped_in_a_row = 0
        self._actor_updates += with_targets
        for role, gradient in gradients.items():
            self._adam.step(role, gradient)
        if self._updates_lifetime % _CLEANED_EVERY == 0:
            self._adam.clean()
        if with_targets:
            for role, stack in self._roles.items():
                self._targets[role].flat.lerp_(stack.flat, self.config.tau)
        return report

    def _skip(self, batch: Batch, report: Tensor) -> None:
        """Counts an update that is not made, or raises what is to be said of it."""
        what = f"{not_finite(report, self.config.module_ids)} in update {self._updates_lifetime}"
        if self.config.nonfinite_updates == "skip" and self._skipped_in_a_row < MOST_SKIPPED:
            if not self._skipped_in_a_row:
                logger.warning(f"{what}: it is skipped.")
            self._skipped_in_a_row += 1
            self.metrics.log_value((ALL_MODULES, NUM_UPDATES_SKIPPED_LIFETIME), 1, reduce="lifetime_sum")
            return
        after = f", after {MOST_SKIPPED} that were skipped" if self._skipped_in_a_row else ""
        about = {
            "what": what,
            "algorithm": self.config.name,
            "agents": list(self.config.team.agents),
            "policies": list(self.config.module_ids),
            "update": self._updates_lifetime,
            "gamma": self.config.gamma,
            "reward_scale": self.config.reward_scale,
            "learning_rates": {
                name: group["lr"] for name, o in self._named_optimizers.items() for group in o.param_groups
            },
        }
        weights = ((f"{mid}/{k}", v) for mid, m in self.module.items() for k, v in m.unwrapped().state_dict().items())
        raise Diverged(
            f"{what}{after}: training has diverged. Go on from a checkpoint made before, or begin anew, with a lower "
            f"critic_lr or actor_lr, with grad_clip, or with a smaller reward_scale.",
            evidence_of(batch, report, weights, about),
            self._updates_lifetime,
        )

    def prepare(self, batch: Batch, normalizer: Params) -> Batch:
        """A minibatch as the losses see it: observations normalised, rewards scaled, and with its states."""
        now, following = (self._prepared(moment, normalizer) for moment in (batch.now, batch.next))
        return batch._replace(now=now, next=following, rewards=batch.rewards * self.config.reward_scale)

    def _prepared(self, moment: Moment, normalizer: Params) -> Moment:
        if self.normalizers is not None:
            if moment.window is not None:
                window = self.normalizers.normalized(normalizer, moment.window)
                moment = moment._replace(window=window, obs=window[:, :, -1])
            else:
                moment = moment._replace(obs=self.normalizers.normalized(normalizer, moment.obs))
        if moment.state is None and self.config.uses_state:
            state = moment.obs.flatten(1)
            moment = moment._replace(state=state if self._state_columns is None else state[:, self._state_columns])
        return moment

    # RLlib's side of it.

    @override(TorchLearner)
    def configure_optimizers(self) -> None:
        """Stacks the agents' networks and registers the optimisers (called by RLlib's `build`).

        One Adam for the actors, and one for the critics together with their mixers.
        """
        config, team = self.config, self.config.team
        modules = [self.module[mid].unwrapped() for mid in config.module_ids]
        # Constants of the losses, and the random numbers that they need, drawn outside of what is compiled.
        device = self._device
        mask = torch.from_numpy(team.action_mask).to(device)
        ids = torch.eye(len(team.agents), device=device) if config.critics_are_told else None
        columns = torch.tensor(config.state_columns, device=device)
        self._state_columns = None if len(columns) == len(team.agents) * team.observation_size else columns
        self.parts = self.stacks(modules, "", None if mask.all() else mask, ids)
        self.target_parts = self.stacks(modules, "target_", None if mask.all() else mask, ids, like=self.parts)
        self._roles, self._targets = map(self._by_role, (self.parts, self.target_parts))
        self.normalizers = Normalizers([m.normalizer for m in modules]) if config.normalize_observations else None

        optimizer_of: dict[str, torch.optim.Adam] = {}
        for name, roles, lr in (
            (CRITIC, (CRITIC, MIXER), config.critic_lr),
            (ACTOR, (ACTOR,), config.actor_lr),
        ):
            own = [role for role in roles if role in self._roles]
            if own:
                parameters = [self._roles[role].flat for role in own]
                optimizer = torch.optim.Adam(parameters)
                self.register_optimizer(
                    module_id=ALL_MODULES,
                    optimizer_name=name,
                    optimizer=optimizer,
                    params=parameters,
                    lr_or_lr_schedule=lr,
                )
                optimizer_of |= dict.fromkeys(own, optimizer)
        self._adam = StackedAdam(self._roles, optimizer_of)
        kind = self.noise
        if self.has_actors and (team.discrete or config.target_noise):
            kind = "uniform" if team.discrete else "normal"
        draws: dict[str | None, Callable[..., Tensor]] = {"normal": torch.randn, "uniform": torch.rand}
        self._draw = draws.get(kind)
        self._generator = torch.Generator().manual_seed(config.seed or 0)
        for parts, stacks in ((self.parts, self._roles), (self.target_parts, self._targets)):
            compare_networks(TeamNetworks(parts, self._params_of(stacks)), self._device)

    def stacks(
        self,
        modules: Sequence[Any],
        prefix: str,
        action_mask: Tensor | None,
        agent_ids: Tensor | None,
        like: Parts | None = None,
    ) -> Parts:
        """Stacks every agent's networks.

        Args:
            modules: The agents' RLModules; one that several share is listed for each of them.
            prefix: "" for the online networks, "target_" for the target networks.
            action_mask: See `Parts`.
            agent_ids: See `Parts`.
            like: For the target networks, the online ones.
        """
        config = self.config
        actors, critics = (
            ([getattr(m, f"{prefix}{role}") for m in modules], [f"the {role} of {a}" for a in config.team.agents])
            for role in (ACTOR, CRITIC)
        )
        return Parts(
            config=config,
            actors=Actors(*actors, like=None if like is None else like.actors),
            acting_role=ACTOR,
            critics=Critics(*critics, tie=config.ties_critics, like=None if like is None else like.critics),
            mixers=self.mixers(prefix),
            action_mask=action_mask,
            agent_ids=agent_ids,
        )

    def mixers(self, prefix: str) -> Stack | None:
        """The mixers, stacked; None if the algorithm has none."""
        if MIXER not in self.module:
            return None
        return Stack(list(getattr(self.module[MIXER].unwrapped(), f"{prefix}mixers")))

    @staticmethod
    def _by_role(parts: Parts) -> dict[str, Stack]:
        """The stacks that have parameters of their own, by role."""
        stacks: dict[str, Stack | None] = {CRITIC: parts.critics, MIXER: parts.mixers}
        stacks = {parts.acting_role: parts.actors, **{role: s for role, s in stacks.items() if s is not None}}
        return {role: stack for role, stack in stacks.items() if stack is not None}

    @property
    def acting(self) -> Actors:
        """The networks that act."""
        return self.parts.actors

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
            batch: A `Batch` whose tensors have a further leading axis, `(K, B, ...)`.
            training_data: The same, wrapped by RLlib's LearnerGroup.
            timesteps: RLlib's time, for stages of training and learning-rate schedules.
            _no_metrics_reduce: Whether to go on collecting metrics instead of returning them.
            **kwargs: Ignored.

        Returns:
            Means over the updates since the last returned result, for every module, or None.
        """
        whole: Batch = training_data.batch if training_data is not None else batch
        timesteps = timesteps or {}
        self.before_gradient_based_update(timesteps=timesteps)
        self.stage = self.stage_at(timesteps.get(NUM_ENV_STEPS_SAMPLED_LIFETIME, 0))
        if self._draw is not None:
            noise = self._draw(whole.actions.shape, generator=self._generator)
            whole = whole._replace(noise=noise.to(whole.actions.device))
        with self._updating, denormals_are_zero():
            for minibatch in whole.unbind():
                report = self.step(minibatch)
                if report is not None:
                    self._sum = report.clone() if self._sum is None else self._sum.add_(report)
                    self._updates += 1
        count, size = whole.rewards.shape[:2]
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
        for name, values in zip(REPORT, self._sum.tolist(), strict=True):
            of_actors = name.startswith("actor")
            if of_actors and not self.has_actors:
                continue
            count = max(1, self._actor_updates) if of_actors else self._updates
            if name.endswith("norm"):
                self.metrics.log_value((ALL_MODULES, name), values[0] / count, window=1)
                continue
            by_module: dict[str, list[float]] = {}
            for mid, value in zip(self.config.module_ids, values, strict=True):
                by_module.setdefault(mid, []).append(value / count)
            for mid, of_agents in by_module.items():
                value = max(of_agents) if name == "q_max" else sum(of_agents) / len(of_agents)
                self.metrics.log_value((mid, name), value, window=1)
            if name == "q_max":
                self.q_max = max(values) / count
        self.metrics.log_value((ALL_MODULES, NUM_UPDATES_LIFETIME), self._updates, reduce="lifetime_sum")
        self._sum, self._updates, self._actor_updates = None, 0, 0
        self._env_steps = (timesteps or {}).get(NUM_ENV_STEPS_SAMPLED_LIFETIME, 0)
        self.after_gradient_based_update(timesteps=timesteps or {})
        return self.metrics.reduce()

    def update_normalizers(self, observations: NDArray[np.float32]) -> None:
        """Takes newly sampled observations `(..., N, O)` into the running normalisation, if there is one."""
        if self.normalizers is not None:
            self.normalizers.merge(torch.from_numpy(np.require(observations, np.float32, "W")).to(self._device))

    def _shapes(self) -> dict[str, Any]:
        """What lies where in each role's flat tensor: parameters, and whose they are."""
        return {role: {"parameters": dict(s.shapes), "agents": list(s.places)} for role, s in self._roles.items()}

    @override(Learner)
    def get_state(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """RLlib's state, the number of updates made and the random numbers to come.

        Raises:
            Diverged: If weights are not finite: a checkpoint of them would be good for nothing.
        """
        with self._updating:
            if bad := [role for role, stack in self._roles.items() if not torch.isfinite(stack.flat).all()]:
                raise Diverged(f"Weights of {' and '.join(bad)} are not finite: training has diverged.")
            state: dict[str, Any] = super().get_state(*args, **kwargs)
        generator = self._generator.get_state().numpy()
        state[_PROGRESS] = {
            "updates": self._updates_lifetime,
            "env_steps": self._env_steps,
            "generator": generator,
            "layout": _LAYOUT,
            "shapes": self._shapes(),
        }
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
        saved = state.get(_PROGRESS, {}).get("shapes")
        if saved is not None and saved != self._shapes():
            raise ValueError(
                f"This learner's state is that of other networks, or of agents that share them otherwise: {saved} was "
                f"saved, here it would be {self._shapes()}."
            )
        # RLlib's learner skips modules, and runners skip weights, that are not newer than their own; but what is set
        # here is meant.
        newest, self._weights_seq_no = self._weights_seq_no, 0  # type: ignore[has-type]
        super().set_state(state)
        self._weights_seq_no = max(self._weights_seq_no, newest + 1)
        self._adam.bind()  # the optimisers' tensors are new ones
        if _PROGRESS in state:
            self._updates_lifetime = state[_PROGRESS]["updates"]
            self._generator.set_state(torch.from_numpy(state[_PROGRESS]["generator"]))
        if "env_steps" in state.get(_PROGRESS, {}):  # which earlier revisions did not save
            self._env_steps = state[_PROGRESS]["env_steps"]
            # Learning rates are this configuration's, not the saved ones: Tune may have changed them in between.
            for optimizer, schedule in self._optimizer_lr_schedules.items():
                self._set_optimizer_lr(optimizer, lr=schedule.update(timestep=self._env_steps))

    @override(TorchLearner)
    def _log_trainable_parameters(self) -> None:
        """Nothing: RLlib logs these once and reports them as NaN from the second iteration on."""

    @override(TorchLearner)
    def compute_loss_for_module(self, **kwargs: Any) -> Any:
        """Not how this learner works: its losses are joint."""
        raise TypeError("A JointLearner has no loss per module: see critic_loss and actor_loss.")
