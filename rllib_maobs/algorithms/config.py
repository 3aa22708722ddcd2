"""What all algorithms share: settings, and what each algorithm declares."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Literal, Self, TypeVar, cast

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig, NotProvided
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.utils.annotations import override
from ray.util import log_once

from rllib_maobs.algorithms import checks, settings
from rllib_maobs.envs.team import Team
from rllib_maobs.layout import Entities, Layout, layout_size
from rllib_maobs.learner import MIXER, JointLearner
from rllib_maobs.modules import ACTORS, CRITICS, EXPLORATIONS, Actor, AgentModule, Critic, MixerModule, RecurrentActor
from rllib_maobs.runner import JointEnvRunner


@dataclass(frozen=True)
class Supports:
    """What an algorithm is defined for; validation, the docs' table and the tests follow it.

    Attributes:
        actions: Kinds of action spaces, of "continuous" and "discrete".
        team_reward: Whether it needs one reward for all agents.
        different_agents: Whether agents may differ in the sizes of their observations and actions.
        recurrent: Whether it takes recurrent actors.
        parameter_sharing: Whether agents may share a policy.
        twin_critics: Whether it takes `twin_critics` and the rest of TD3.
    """

    actions: tuple[str, ...] = ("continuous", "discrete")
    team_reward: bool = False
    different_agents: bool = True
    recurrent: bool = True
    parameter_sharing: bool = True
    twin_critics: bool = True


MethodT = TypeVar("MethodT", bound=Callable[..., Any])


def _checked(method: MethodT) -> MethodT:
    """A method that sets settings: it checks what it is given, takes NumPy's numbers, and changes all or nothing."""
    signature = inspect.signature(method)
    anything = any(p.kind is p.VAR_KEYWORD for p in signature.parameters.values())

    @functools.wraps(method)
    def checked(self: JointConfig, *args: Any, **kwargs: Any) -> Any:
        for name in kwargs:
            if name not in signature.parameters and not anything:
                raise ValueError(settings.unknown(self, name))
        given = signature.bind_partial(self, *args, **kwargs)
        named = {name: value for name, value in given.arguments.items() if name not in ("self", "kwargs")}
        with _as_before_if_refused(self):
            return method(self, **settings.checked(self, {**named, **given.kwargs}))

    return cast(MethodT, checked)


@contextmanager
def _as_before_if_refused(config: JointConfig) -> Iterator[None]:
    """Takes back what was set where one of the settings is refused, and makes every refusal a ValueError."""
    before = {name: dict(value) if type(value) is dict else value for name, value in vars(config).items()}
    try:
        yield
    except Exception as error:
        config.__dict__.clear()
        config.__dict__.update(before)
        if isinstance(error, AssertionError | TypeError | LookupError):  # how RLlib refuses some values
            raise ValueError(f"RLlib can't take these settings of {type(config).__name__}: {error!r}.") from error
        raise


class JointConfig(AlgorithmConfig):
    """Settings of every algorithm here; the defaults are the paper's (table II), then its code base's.

    An algorithm of your own derives from it, says what its critics see and which learner has its losses, and is made
    known by `register_algorithm`: docs/your_own.md.

    Attributes:
        name: The algorithm's name in scripts and tables.
        supports: What it is defined for.
        critic_sees: What agent i's critic sees: its "observation" or the "state"; and its own "action" or the
            "joint_action". Empty if there are no critics.
        mixes: Whether values are mixed with the state into one of the team.
        learner: The learner that has its losses.
        legal: What is legal for each setting, as a type hint.
        team: The environment's agents and spaces; filled in by `validate()`.
        module_ids: Every agent's policy, in the team's order; filled in by `validate()`.
    """

    name: ClassVar[str] = "joint"
    supports: ClassVar[Supports] = Supports()
    critic_sees: ClassVar[tuple[str, ...]] = ("state", "joint_action")
    mixes: ClassVar[bool] = False
    learner: ClassVar[type[JointLearner]] = JointLearner
    module: ClassVar[type[AgentModule]] = AgentModule
    default_exploration: ClassVar[dict[str, Any]] = {}
    legal: ClassVar[dict[str, Any]] = settings.LEGAL
    ties_critics: bool = False
    team: Team
    module_ids: tuple[str, ...]

    @override(AlgorithmConfig)
    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class or checks.default_algorithm(type(self)))
        # Paper, table II.
        self.gamma = 0.95
        self.actor_lr: Any = 1e-3
        self.critic_lr: Any = 1e-2
        self.train_batch_size_per_learner = 256
        self.seq_length = 5
        self.exploration: dict[str, Any] = {}
        # The code base the paper grew from.
        self.tau = 0.01
        self.replay_buffer_capacity = 500_000
        self.updates_per_env_step = 1.0
        self.critic_state: Literal["observations", "world"] = "observations"
        # Networks.
        self.actor: str | type[Actor] = "mlp"
        self.actor_settings: dict[str, Any] = {}
        self.critic: str | type[Critic] = "mlp"
        self.critic_settings: dict[str, Any] = {}
        self.observation_layouts: Mapping[str, Any] | None = None
        self.state_layout: Any = None
        # Off by default.
        self.stored_state = False
        self.n_step = 1
        self.twin_critics = False
        self.policy_delay = 1
        self.target_noise = 0.0
        self.target_noise_clip = 0.5
        self.action_regularization = 0.0
        self.gumbel_temperature = 1.0
        self.normalize_observations = False
        self.reward_scale = 1.0
        self.agent_id_input = False
        self.grad_clip_by = "global_norm"
        # Ours.
        self.num_random_steps = 0
        self.num_steps_sampled_before_learning_starts = 0
        self.store_buffer_in_checkpoints = True
        self.nonfinite_updates: Literal["raise", "skip"] = "raise"
        self.env_timeout_s: float | None = None
        # RLlib's, set to what joint sampling wants.
        self.env_runner_cls = JointEnvRunner
        self.num_env_runners = 0
        self.num_envs_per_env_runner = 8
        self.rollout_fragment_length = "auto"
        self.min_sample_timesteps_per_iteration = 1000

    def __init_subclass__(cls) -> None:
        """Lets the settings that an algorithm adds be checked when they are given, as all others are."""
        if "training" in vars(cls):
            cls.training = _checked(cls.training)  # type: ignore[method-assign]

    @override(AlgorithmConfig)
    @_checked
    def training(
        self,
        *,
        actor_lr: Any = NotProvided,
        critic_lr: Any = NotProvided,
        tau: float = NotProvided,
        updates_per_env_step: float = NotProvided,
        replay_buffer_capacity: int = NotProvided,
        critic_state: Literal["observations", "world"] = NotProvided,
        exploration: dict[str, Any] = NotProvided,
        actor: str | type[Actor] = NotProvided,
        actor_settings: dict[str, Any] = NotProvided,
        critic: str | type[Critic] = NotProvided,
        critic_settings: dict[str, Any] = NotProvided,
        observation_layouts: Mapping[str, Any] | None = NotProvided,
        state_layout: Any = NotProvided,
        seq_length: int = NotProvided,
        stored_state: bool = NotProvided,
        n_step: int = NotProvided,
        twin_critics: bool = NotProvided,
        policy_delay: int = NotProvided,
        target_noise: float = NotProvided,
        target_noise_clip: float = NotProvided,
        action_regularization: float = NotProvided,
        gumbel_temperature: float = NotProvided,
        normalize_observations: bool = NotProvided,
        reward_scale: float = NotProvided,
        agent_id_input: bool = NotProvided,
        num_random_steps: int = NotProvided,
        num_steps_sampled_before_learning_starts: int = NotProvided,
        store_buffer_in_checkpoints: bool = NotProvided,
        nonfinite_updates: Literal["raise", "skip"] = NotProvided,
        env_timeout_s: float | None = NotProvided,
        **kwargs: Any,
    ) -> Self:
        """Sets the training settings.

        Hidden sizes and activation are RLlib's to set: `config.rl_module(model_config={"hidden_sizes": (64, 64, 64),
        "activation": "relu", "lstm_cell_size": 64})`. Parameter sharing is RLlib's policy mapping: agents with one
        policy share its networks.

        Args:
            actor_lr: Learning rate of the actors, or an RLlib schedule over env steps `[[0, 1e-3], ...]`.
                Default 1e-3.
            critic_lr: Learning rate of the critics (with their mixers), likewise. Default 1e-2.
            tau: Share of the online network in Polyak averaging, each update. Default 0.01.
            updates_per_env_step: Updates for every env step sampled (summed over copies and runners), exact over
                time: any fraction left over is carried on. Default 1.0.
            replay_buffer_capacity: Rows of the replay ring, one per joint step. Default 500 000.
            critic_state: What a centralised critic or mixer sees as s: "observations", the concatenation of all
                agents' (default, the code base's), or "world", the environment's own `state()`.
            exploration: Settings of `EpsilonGaussian`: `epsilon` 0.1, `noise` 0.1, `decay` 5e-7 per env step,
                `final` 0.05 (the paper's; algorithms of the Q-learning family have others). Or another kind with its
                settings: `{"type": "ornstein-uhlenbeck", "theta": 0.15}`, `{"type": MyNoise}` (see `Exploration`).
                Policies may differ (what one is given replaces what all have):
                `config.rl_module(algorithm_config_overrides_per_module={"agent_0":
                maobs.JointConfig.overrides(exploration={"noise": 0.3})})`.
            actor: "mlp" (default), "lstm" over the last `seq_length` observations (eq. 10), "entity" or "entity-lstm"
                over sets of entities (`EntityActor`; needs layouts), a subclass of `Actor`, or
                where to import one from.
            actor_settings: What the actor's constructor takes besides.
            critic: "mlp" (default), "entity" (`EntityCritic`), a subclass of `Critic`, or where to import one from.
            critic_settings: What the critic's constructor takes besides.
            observation_layouts: What each agent's observation is made of, by agent: `{"agent_0": [("self", 1, 4),
                ("target", 3, 2, 2)], ...}` (see `Entities`). None (default) takes what the environment says, or one
                group if it says nothing.
            state_layout: The same of the environment's own state; the agents come first.
            seq_length: T, the window of a recurrent actor. Default 5 (table II).
            stored_state: Whether a recurrent actor's window starts from the state with which the one a step earlier
                ended, the initial one at an episode's start (eq. 10), instead of always from the initial one. Learning
                starts from those of acting, stored in replay, as constants (Kapturowski et al. 2019). Default False.
            n_step: Steps of reward in a target before it bootstraps (Sutton 1988). Default 1.
            twin_critics: Whether every agent has two critics, whose minimum is the target's value (TD3, Fujimoto et
                al. 2018; MATD3, Ackermann et al. 2019). Default False.
            policy_delay: Updates of the critics for each one of the actors and targets (TD3: 2). Default 1.
            target_noise: Standard deviation of the noise on the target actors' actions (TD3: 0.2). Default 0.
            target_noise_clip: Bound of that noise (TD3: 0.5). Default 0.5.
            action_regularization: Weight of the mean squared actor output before tanh (or of the logits) in
                the actor's loss (1e-3 in Lowe et al.'s MADDPG code). Default 0.
            gumbel_temperature: Of the softmax through which discrete actors learn (Jang et al. 2017). Default 1.
            normalize_observations: Whether networks see observations shifted and scaled to mean 0 and deviation 1
                as seen so far. The "world" state is not normalised. Default False.
            reward_scale: Factor on rewards in the losses; reported returns are not scaled. Default 1.
            agent_id_input: Whether observations, and the input of centralised critics, begin with the agent's number
                as a one-hot vector, so that agents with shared parameters can differ. Default False.
            num_random_steps: Env steps at the start with uniformly random actions. Default 0.
            num_steps_sampled_before_learning_starts: Env steps before the first update; at least one batch is
                sampled in any case. These steps owe no updates. Default 0.
            store_buffer_in_checkpoints: Whether checkpoints hold the replay buffer, so that a restored run goes
                on exactly as it would have. Default True.
            nonfinite_updates: What becomes of an update whose losses, values or gradients are not finite: "raise"
                (default) ends training with what is needed for a post-mortem; "skip" leaves it out and counts it
                (`num_updates_skipped_lifetime`), until 100 come one after the other.
            env_timeout_s: Seconds that one step or reset of one copy of an environment of your own may take. Then it is
                interrupted by a TimeoutError that names copy and step, which counts as an error of the environment
                (docs/callbacks.md). Default None: no limit.
            **kwargs: RLlib's own: `gamma` (0.95), `train_batch_size_per_learner` (256), `grad_clip` (None) with
                `grad_clip_by` ("global_norm": each network's whole gradient on its own; "norm": each of its
                tensors; "value": each number), ...

        Returns:
            This config.
        """
        if "carry_hidden" in kwargs:
            raise ValueError("carry_hidden is now called stored_state (Kapturowski et al. 2019's term).")
        settings.check_arguments(self, kwargs)
        super().training(**kwargs)
        given = {k: v for k, v in locals().items() if k not in ("self", "kwargs", "__class__")}
        for name, value in given.items():
            if value is not NotProvided:
                setattr(self, name, value)
        return self

    @override(AlgorithmConfig)
    def update_from_dict(self, config_dict: dict[str, Any]) -> Self:
        """Changes settings, e.g. by Tune's `param_space`, whichever of their names in RLlib they are given by."""
        named = isinstance(config_dict, Mapping) and all(isinstance(name, str) for name in config_dict)
        if not named and not isinstance(config_dict, AlgorithmConfig):
            raise ValueError(f"A configuration is changed by a dict of settings by name, not {config_dict!r}.")
        changes = settings.as_attributes(config_dict)
        for name in changes if named else ():  # RLlib has older names of some, such as "callbacks"
            settings.check_is_no_part(self, self._translate_special_keys(name, warn_deprecated=False))
        with _as_before_if_refused(self):
            super().update_from_dict(changes)
        return self

    # RLlib's methods that set settings.
    python_environment = _checked(AlgorithmConfig.python_environment)
    resources = _checked(AlgorithmConfig.resources)
    framework = _checked(AlgorithmConfig.framework)
    api_stack = _checked(AlgorithmConfig.api_stack)
    environment = _checked(AlgorithmConfig.environment)
    env_runners = _checked(AlgorithmConfig.env_runners)
    learners = _checked(AlgorithmConfig.learners)
    callbacks = _checked(AlgorithmConfig.callbacks)
    evaluation = _checked(AlgorithmConfig.evaluation)
    offline_data = _checked(AlgorithmConfig.offline_data)
    multi_agent = _checked(AlgorithmConfig.multi_agent)
    reporting = _checked(AlgorithmConfig.reporting)
    checkpointing = _checked(AlgorithmConfig.checkpointing)
    debugging = _checked(AlgorithmConfig.debugging)
    fault_tolerance = _checked(AlgorithmConfig.fault_tolerance)
    rl_module = _checked(AlgorithmConfig.rl_module)
    experimental = _checked(AlgorithmConfig.experimental)

    @override(AlgorithmConfig)
    def get_evaluation_config_object(self) -> JointConfig | None:
        """The config of the runners that evaluate; they explore only if `evaluation_config` says so itself."""
        evaluation = super().get_evaluation_config_object()
        if evaluation is not None and "explore" not in (self.evaluation_config or {}):
            evaluation.explore = False
        return evaluation

    @override(AlgorithmConfig)
    def validate(self) -> None:
        """Checks every setting and inspects the environment, before anything long starts.

        Raises:
            ValueError: If something is not legal; says what, and what would be.
        """
        checks.check_settings_of(self)
        checks.check_networks(self)
        self.team = checks.inspect_team(self)
        self.module_ids = checks.map_policies(self)
        checks.check_team(self)
        checks.check_layouts(self)
        # RLlib would say, once, that its old API stack is a choice, too; here it is none.
        log_once(f"{getattr(self.algo_class, '__name__', '')}_on_new_api_stack")
        super().validate()

    @override(AlgorithmConfig)
    def build_algo(self, env: Any = None, use_copy: bool = True) -> Any:
        """Builds the algorithm, after all settings have been checked."""
        if env is not None:
            self.environment(env)
        # RLlib resets whatever equals -1 (its mark of a deprecated setting) before it validates.
        self.copy(copy_frozen=False).validate()
        return super().build_algo(use_copy=use_copy)

    # What follows from the settings.

    @property
    def central_critic(self) -> bool:
        """Whether critics see the global state."""
        return "state" in self.critic_sees

    @property
    def uses_state(self) -> bool:
        """Whether the algorithm sees the global state when it learns."""
        return self.central_critic or self.mixes

    @property
    def recurrent(self) -> bool:
        """Whether actors are recurrent."""
        return issubclass(ACTORS.resolve(self.actor), RecurrentActor)

    @property
    def window_length(self) -> int:
        """T of the windows that actors see; 0 if they see single observations."""
        return self.seq_length if self.recurrent else 0

    @property
    def critics_are_told(self) -> bool:
        """Whether centralised critics are told whose value they are to give."""
        return self.central_critic and (self.agent_id_input or CRITICS.resolve(self.critic).asks_whose)

    @property
    def state_columns(self) -> list[int]:
        """Which of all agents' padded observations `(N * O,)` are their own: neither padding nor agent ids."""
        start = len(self.team.agents) if self.agent_id_input else 0
        width = self.team.observation_size
        return [i * width + o for i, size in enumerate(self.team.observation_sizes) for o in range(start, size)]

    @property
    def state_groups(self) -> Layout:
        """What the state that the algorithm sees is made of."""
        if self.critic_state == "world":
            assert self.team.state_layout is not None
            return self.team.state_layout
        return tuple(
            group._replace(name=f"{agent}.{group.name}")
            for agent, layout in zip(self.team.agents, self.team.observation_layouts, strict=True)
            for group in (layout[1:] if self.agent_id_input else layout)
        )

    @property
    def state_size(self) -> int:
        """S, the width of the state that the algorithm sees."""
        return layout_size(self.state_groups)

    def critic_layouts(self, agent: str) -> tuple[Layout, Layout] | None:
        """What one agent's critic sees, of the state and of the actions; None if there are no critics."""
        if not self.critic_sees:
            return None
        index, size = self.team.agents.index(agent), self.team.action_size
        if not self.central_critic:
            return self.team.observation_layouts[index], (Entities("self", 1, self.team.action_sizes[index]),)
        state = self.state_groups
        if "joint_action" not in self.critic_sees:
            return state, (Entities("self", 1, size),)
        return state, tuple(Entities(name, count, size) for name, count in checks.agent_groups(self, state))

    def mixer_settings(self) -> dict[str, Any] | None:
        """Settings of the `MixerModule`, or None if values are not mixed."""
        return None

    # RLlib's side of it.

    @property
    @override(AlgorithmConfig)
    def _model_config_auto_includes(self) -> dict[str, Any]:
        return {
            "actor": ACTORS.reference(self.actor),
            "actor_settings": self.actor_settings,
            "critic": CRITICS.reference(self.critic),
            "critic_settings": self.critic_settings,
            "seq_length": self.seq_length,
            "stored_state": self.stored_state,
            "normalize_observations": self.normalize_observations,
            "num_critics": 1 + self.twin_critics,
        }

    def exploration_of(self, module_id: str) -> dict[str, Any]:
        """One policy's settings of exploration."""
        own = self.get_config_for_module(module_id).exploration
        if "type" not in own:
            return {**self.default_exploration, **own}
        return {**own, "type": EXPLORATIONS.reference(own["type"])}

    @override(AlgorithmConfig)
    def get_default_rl_module_spec(self) -> RLModuleSpec:
        """One module per policy."""
        return RLModuleSpec(module_class=self.module)

    @override(AlgorithmConfig)
    def get_default_learner_class(self) -> type[JointLearner]:
        """The learner that the algorithm declares."""
        return self.learner

    @override(AlgorithmConfig)
    def get_multi_rl_module_spec(self, **kwargs: Any) -> MultiRLModuleSpec:
        """The agents' modules, each with what its networks see, and the team's mixers for a learner."""
        spec: MultiRLModuleSpec = super().get_multi_rl_module_spec(**kwargs)
        for agent, mid in zip(self.team.agents, self.module_ids, strict=True):
            index = self.team.agents.index(agent)
            own: dict[str, Any] = {
                "observation_layout": _plain(self.team.observation_layouts[index]),
                "exploration": self.exploration_of(mid),
            }
            if (layouts := self.critic_layouts(agent)) is not None:
                own |= {
                    f"{part}_layout": _plain(groups) for part, groups in zip(("state", "action"), layouts, strict=True)
                }
                own["num_agents"] = len(self.team.agents) if self.critics_are_told else 0
            settings = spec.rl_module_specs[mid].model_config or {}
            settings = settings if isinstance(settings, dict) else asdict(settings)
            spec.rl_module_specs[mid].model_config = {**own, **settings}
        mixing = self.mixer_settings()
        if mixing is not None and not kwargs.get("inference_only"):
            observation_space, action_space = self.team.spaces(self.team.agents[0])
            mixer = RLModuleSpec(MixerModule, observation_space, action_space, learner_only=True, model_config=mixing)
            spec.add_modules({MIXER: mixer})
        return spec

    @override(AlgorithmConfig)
    def get_rollout_fragment_length(self, worker_index: int = 0) -> int:
        """Steps of every copy between two rounds of updates.

        "auto" is 1 where the runner acts with the learner's own weights, as in the paper, and 16 for remote
        runners, where each round costs a message and a weight sync.
        """
        if self.rollout_fragment_length != "auto":
            return int(self.rollout_fragment_length)
        return 1 if self.num_env_runners == 0 else 16


def _plain(layout: Layout) -> list[list[Any]]:
    """A layout as checkpoints hold it."""
    return [list(group) for group in layout]
