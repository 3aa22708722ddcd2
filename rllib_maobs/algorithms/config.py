"""What all algorithms share: settings, what each is defined for, and all checks before a run starts."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Literal, Self

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig, NotProvided
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.policy.policy import PolicySpec
from ray.rllib.utils.annotations import override
from ray.util import log_once

from rllib_maobs.envs.team import Team, shares_reward
from rllib_maobs.learner import MIXER
from rllib_maobs.modules import ACTIVATIONS, ACTORS, AgentModule, Exploration, MixerModule
from rllib_maobs.runner import JointEnvRunner, make_env

CRITIC_STATES = ("observations", "world")
_MODEL_SETTINGS = (
    "hidden_sizes",
    "activation",
    "lstm_cell_size",
    "actor",
    "seq_length",
    "carry_hidden",
    "exploration",
    "normalize_observations",
    "critic_state_size",
    "critic_action_size",
    "num_critics",
)


def one_of(name: str, value: Any, legal: Collection[str]) -> None:
    """Raises a ValueError that names the legal values unless the value is one of them."""
    if value not in legal:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, legal))}, not {value!r}.")


def in_range(name: str, value: Any, low: float, high: float = math.inf, *, open_low: bool = False) -> None:
    """Raises a ValueError that names the legal range unless the value is a finite number in it."""
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if not number or not (low < value if open_low else low <= value) or value > high:
        bounds = f"{'(' if open_low else '['}{low:g}, {'inf)' if high == math.inf else f'{high:g}]'}"
        raise ValueError(f"{name} must be a finite number in {bounds}, not {value!r}.")


def own_policy(agent_id: str, episode: Any = None, **kwargs: Any) -> str:
    """The default policy mapping: every agent has a policy of its own, named like it."""
    return agent_id


@dataclass(frozen=True)
class Abilities:
    """What an algorithm is defined for; validation, the README's table and the tests follow it.

    Attributes:
        actions: Kinds of action spaces, of "continuous" and "discrete".
        team_reward: Whether it needs one reward for all agents.
        different_agents: Whether agents may differ in the sizes of their observations and actions.
        recurrent: Whether it takes `actor="lstm"`.
        parameter_sharing: Whether agents may share a policy.
        twin_critics: Whether it takes `twin_critics` and the rest of TD3.
    """

    actions: tuple[str, ...] = ("continuous", "discrete")
    team_reward: bool = False
    different_agents: bool = True
    recurrent: bool = True
    parameter_sharing: bool = True
    twin_critics: bool = True


class JointConfig(AlgorithmConfig):
    """Settings of every algorithm here; the defaults are the paper's (table II), then its code base's.

    Attributes:
        name: The algorithm's name in scripts and tables.
        abilities: What it is defined for.
        uses_state: Whether it sees the global state when it learns.
        central_critic: Whether it is the critics that see it (and not only a mixer).
        team: The environment's agents and spaces; filled in by `validate()`.
        module_ids: Every agent's policy, in the team's order; filled in by `validate()`.
    """

    name: ClassVar[str] = "joint"
    abilities: ClassVar[Abilities] = Abilities()
    uses_state: ClassVar[bool] = True
    central_critic: ClassVar[bool] = True
    default_exploration: ClassVar[dict[str, float]] = {}
    ties_critics: bool = False
    team: Team
    module_ids: tuple[str, ...]

    @override(AlgorithmConfig)
    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class)
        # Paper, table II.
        self.gamma = 0.95
        self.actor_lr: Any = 1e-3
        self.critic_lr: Any = 1e-2
        self.train_batch_size_per_learner = 256
        self.seq_length = 5
        self.exploration: dict[str, float] = {}
        # The code base the paper grew from.
        self.tau = 0.01
        self.replay_buffer_capacity = 500_000
        self.updates_per_env_step = 1.0
        self.critic_state: Literal["observations", "world"] = "observations"
        # Off by default.
        self.actor: Literal["mlp", "lstm"] = "mlp"
        self.carry_hidden = False
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
        # RLlib's, set to what joint sampling wants.
        self.env_runner_cls = JointEnvRunner
        self.num_env_runners = 0
        self.num_envs_per_env_runner = 8
        self.rollout_fragment_length = "auto"
        self.min_sample_timesteps_per_iteration = 1000
        self.evaluation_config = AlgorithmConfig.overrides(explore=False)

    @override(AlgorithmConfig)
    def training(
        self,
        *,
        actor_lr: Any = NotProvided,
        critic_lr: Any = NotProvided,
        tau: float = NotProvided,
        updates_per_env_step: float = NotProvided,
        replay_buffer_capacity: int = NotProvided,
        critic_state: Literal["observations", "world"] = NotProvided,
        exploration: dict[str, float] = NotProvided,
        actor: Literal["mlp", "lstm"] = NotProvided,
        seq_length: int = NotProvided,
        carry_hidden: bool = NotProvided,
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
        **kwargs: Any,
    ) -> Self:
        """Sets the training settings.

        Hidden sizes and activation are RLlib's to set: `config.rl_module(model_config={"hidden_sizes": (64, 64, 64),
        "activation": "relu", "lstm_cell_size": 48})`. Parameter sharing is RLlib's policy mapping: agents with one
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
            exploration: Overrides of `Exploration`: `epsilon` 0.1, `noise` 0.1, `decay` 5e-7 per env step,
                `final` 0.05 (the paper's; algorithms of the Q-learning family have others).
            actor: "mlp" (default), or "lstm" over the last `seq_length` observations (eq. 10).
            seq_length: T, the window of an LSTM actor. Default 5 (table II).
            carry_hidden: Whether an LSTM's window starts from the h and c with which the one a step earlier ended, zero
                at an episode's start (eq. 10), instead of always from zero. Learning starts from those of acting,
                stored in replay (2 H floats for each agent and row), as constants (Kapturowski et al. 2019). Needs
                `actor="lstm"`. Default False.
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
            **kwargs: RLlib's own: `gamma` (0.95), `train_batch_size_per_learner` (256), `grad_clip` (None) with
                `grad_clip_by` ("global_norm": each network's whole gradient on its own; "norm": each of its
                tensors; "value": each number), ...

        Returns:
            This config.
        """
        super().training(**kwargs)
        given = {k: v for k, v in locals().items() if k not in ("self", "kwargs", "__class__")}
        for name, value in given.items():
            if value is not NotProvided:
                setattr(self, name, value)
        return self

    @override(AlgorithmConfig)
    def validate(self) -> None:
        """Checks every setting and inspects the environment, before anything long starts.

        Raises:
            ValueError: If something is not legal; says what, and what would be.
        """
        self._validate_numbers()
        one_of("critic_state", self.critic_state, CRITIC_STATES)
        one_of("actor", self.actor, ACTORS)
        if self.carry_hidden and self.actor != "lstm":
            raise ValueError(
                f"carry_hidden=True needs h and c to carry: legal with actor='lstm', not with actor={self.actor!r}."
            )
        Exploration.from_dict({**self.default_exploration, **self.exploration})
        settings = self.model_config
        for name in settings:
            if name not in _MODEL_SETTINGS:
                raise ValueError(f"Unknown model_config setting {name!r}; legal are {', '.join(_MODEL_SETTINGS)}.")
        one_of("model_config['activation']", settings["activation"], ACTIVATIONS)
        hidden = settings["hidden_sizes"]
        if not hidden or not all(isinstance(size, int) and size > 0 for size in hidden):
            raise ValueError(f"model_config['hidden_sizes'] must be positive integers, e.g. (64, 64), not {hidden!r}.")
        cell = settings["lstm_cell_size"]
        if not isinstance(cell, int) or cell < 1:
            raise ValueError(f"model_config['lstm_cell_size'] must be a positive integer, e.g. 48, not {cell!r}.")
        if self.num_learners > 0:
            raise ValueError(
                f"num_learners must be 0, not {self.num_learners}: a stacked update of all agents runs in the "
                f"algorithm's process (on its GPU with num_gpus_per_learner=1). Scale out with num_env_runners "
                f"or with more Tune trials."
            )
        if not issubclass(self.env_runner_cls or object, JointEnvRunner):
            raise ValueError(f"env_runner_cls must be a JointEnvRunner, not {self.env_runner_cls}: replay is joint.")
        if not self.normalize_actions:
            raise ValueError("normalize_actions must be True: the actors' actions are in [-1, 1].")
        if not self.abilities.twin_critics and (self.twin_critics or self.target_noise or self.policy_delay > 1):
            legal = "twin_critics=False, target_noise=0.0 and policy_delay=1"
            raise ValueError(f"{self.name} is not defined with TD3's options; legal are {legal}.")
        self._inspect_environment()
        # RLlib would say, once, that its old API stack is a choice, too; here it is none.
        log_once(f"{getattr(self.algo_class, '__name__', '')}_on_new_api_stack")
        super().validate()

    def _validate_numbers(self) -> None:
        for name in ("actor_lr", "critic_lr"):
            if isinstance(getattr(self, name), int | float):
                in_range(name, getattr(self, name), 0.0, open_low=True)
        in_range("tau", self.tau, 0.0, 1.0, open_low=True)
        in_range("gamma", self.gamma, 0.0, 1.0)
        for name in ("train_batch_size_per_learner", "replay_buffer_capacity", "num_envs_per_env_runner"):
            in_range(name, getattr(self, name), 1)
        for name in ("seq_length", "n_step", "policy_delay"):
            in_range(name, getattr(self, name), 1)
            if not isinstance(getattr(self, name), int):
                raise ValueError(f"{name} must be an integer, not {getattr(self, name)!r}.")
        for name in ("updates_per_env_step", "target_noise", "target_noise_clip", "action_regularization"):
            in_range(name, getattr(self, name), 0.0)
        for name in ("gumbel_temperature", "reward_scale"):
            in_range(name, getattr(self, name), 0.0, open_low=True)
        if self.grad_clip is not None:
            in_range("grad_clip", self.grad_clip, 0.0, open_low=True)
        for name in ("num_random_steps", "num_steps_sampled_before_learning_starts"):
            in_range(name, getattr(self, name), 0)
        for name in ("train_batch_size_per_learner", "num_steps_sampled_before_learning_starts", "seq_length"):
            if getattr(self, name) > self.replay_buffer_capacity:
                raise ValueError(
                    f"{name} ({getattr(self, name)}) must not be larger than "
                    f"replay_buffer_capacity ({self.replay_buffer_capacity})."
                )

    @override(AlgorithmConfig)
    def build_algo(self, env: Any = None, use_copy: bool = True) -> Any:
        """Builds the algorithm, after all settings have been checked."""
        if env is not None:
            self.environment(env)
        # RLlib resets whatever equals -1 (its mark of a deprecated setting) before it validates.
        self.copy(copy_frozen=False).validate()
        return super().build_algo(use_copy=use_copy)

    def _inspect_environment(self) -> None:
        """Makes one copy of the environment to learn its team, and names the policies after the agents."""
        if self.env is None:
            raise ValueError('No environment: set one with config.environment("maobs/spread-3a").')
        env = make_env(self, num_envs=1)
        try:
            self.team = team = Team.of(env, with_state=self.uses_state and self.critic_state == "world")
            if self.abilities.team_reward and not shares_reward(env):
                raise ValueError(
                    f"{self.name} learns the value of one team reward, but in {self.env} agents' rewards differ: give "
                    f'all agents the same (option reward_mode="sum" of this package\'s environments), or use another '
                    f"algorithm."
                )
        finally:
            env.close()
        kind = "discrete" if team.discrete else "continuous"
        if kind not in self.abilities.actions:
            raise ValueError(
                f"{self.name} needs {self.abilities.actions[0]} actions, but those of {self.env} are {kind}: choose "
                f'them in the environment (option action_mode="discrete" or "mpe" of this package\'s).'
            )
        different = len({*team.observation_sizes}) > 1 or len({*team.action_sizes}) > 1
        if different and not self.abilities.different_agents:
            raise ValueError(
                f"{self.name} needs agents with observations and actions of equal size, but those of {self.env} have "
                f"{dict(zip(team.agents, zip(team.observation_sizes, team.action_sizes, strict=True), strict=True))}."
            )
        if not self.is_multi_agent:
            self.multi_agent(
                policies={agent: PolicySpec() for agent in team.agents},
                policy_mapping_fn=own_policy,
            )
        self.module_ids = tuple(self.policy_mapping_fn(agent, None) for agent in team.agents)
        mapping = dict(zip(team.agents, self.module_ids, strict=True))
        if set(self.module_ids) != set(self.policies):
            raise ValueError(
                f"The policy mapping must use every policy and no other: policies are {sorted(self.policies)}, agents "
                f"are mapped to {mapping}."
            )
        for policy in self.policies:
            spaces = {agent: team.spaces(agent) for agent, own in mapping.items() if own == policy}
            if len({(obs.shape, getattr(act, "n", act.shape)) for obs, act in spaces.values()}) > 1:
                raise ValueError(f"Agents that share policy {policy!r} must have spaces of equal size, not {spaces}.")
        if self.policies_to_train is not None:
            raise ValueError("policies_to_train must be None: all agents of the team are trained.")

    @property
    def state_columns(self) -> list[int]:
        """Which of all agents' padded observations `(N * O,)` are their own: neither padding nor agent ids."""
        start = len(self.team.agents) if self.agent_id_input else 0
        width = self.team.observation_size
        return [i * width + o for i, size in enumerate(self.team.observation_sizes) for o in range(start, size)]

    @property
    def state_size(self) -> int:
        """S, the width of what a centralised critic sees as the state."""
        return self.team.state_size if self.critic_state == "world" else len(self.state_columns)

    @property
    def hidden_size(self) -> int:
        """H, the size of the h and c that are carried and stored; 0 if they are not."""
        return self.model_config["lstm_cell_size"] if self.carry_hidden else 0

    def critic_sizes(self, agent: str) -> tuple[int, int] | None:
        """Widths of what one agent's critic sees, of the state and of the actions; None if there are no critics."""
        raise TypeError(f"{type(self).__name__} defines no critic_sizes: derive a config that does.")

    def mixer_settings(self) -> dict[str, Any] | None:
        """Settings of the `MixerModule`, or None if values are not mixed."""
        return None

    @property
    @override(AlgorithmConfig)
    def _model_config_auto_includes(self) -> dict[str, Any]:
        return {
            "hidden_sizes": (64, 64, 64),
            "activation": "relu",
            "lstm_cell_size": 48,
            "actor": self.actor,
            "seq_length": self.seq_length,
            "carry_hidden": self.carry_hidden,
            "exploration": {**self.default_exploration, **self.exploration},
            "normalize_observations": self.normalize_observations,
            "num_critics": 1 + self.twin_critics,
        }

    @override(AlgorithmConfig)
    def get_default_rl_module_spec(self) -> RLModuleSpec:
        """One `AgentModule` per policy."""
        return RLModuleSpec(module_class=AgentModule)

    @override(AlgorithmConfig)
    def get_multi_rl_module_spec(self, **kwargs: Any) -> MultiRLModuleSpec:
        """The agents' modules, each with the sizes of its critic's inputs, and the team's mixers for a learner."""
        spec: MultiRLModuleSpec = super().get_multi_rl_module_spec(**kwargs)
        for agent, mid in zip(self.team.agents, self.module_ids, strict=True):
            if (sizes := self.critic_sizes(agent)) is not None:
                state, actions = sizes
                ids = len(self.team.agents) if self.agent_id_input and self.central_critic else 0
                own = {"critic_state_size": state, "critic_action_size": actions + ids}
                settings = spec.rl_module_specs[mid].model_config or {}
                settings = settings if isinstance(settings, dict) else asdict(settings)
                spec.rl_module_specs[mid].model_config = {**settings, **own}
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
