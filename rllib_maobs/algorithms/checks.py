"""All checks of a configuration, before a run starts; each raises a ValueError that says what is legal."""

from __future__ import annotations

import inspect
import os
import shlex
import shutil
import sys
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.core import ALL_MODULES
from ray.rllib.core.rl_module import RLModule, validate_module_id
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.policy.policy import PolicySpec
from ray.rllib.utils import force_list

from rllib_maobs.algorithms import settings
from rllib_maobs.envs.team import Team, shares_reward
from rllib_maobs.layout import Layout
from rllib_maobs.learner import MIXER, JointLearner
from rllib_maobs.memory import gigabytes, memory_of
from rllib_maobs.modules import ACTIVATIONS, ACTORS, CRITICS, EntityActor, EntityLSTMActor, RecurrentActor
from rllib_maobs.modules.agent import ACTOR_ARGUMENTS, COMMON_SETTINGS, CRITIC_ARGUMENTS, network_settings, takes
from rllib_maobs.modules.exploration import make_exploration
from rllib_maobs.options import closest
from rllib_maobs.runner import JointEnvRunner, make_env

if TYPE_CHECKING:
    from rllib_maobs.algorithms.config import JointConfig

_LARGEST, _MOST_LAYERS = 65_536, 100  # units of a layer, layers of a network
_CRITICS_SEE = (), ("observation", "action"), ("state", "action"), ("state", "joint_action")
# What a policy's own RLModuleSpec may set.
_OF_A_POLICY = (*COMMON_SETTINGS, "actor", "actor_settings", "critic", "critic_settings")


def one_of(name: str, value: Any, legal: Collection[str]) -> None:
    """Raises a ValueError that names the legal values unless the value is one of them."""
    if value not in legal:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, legal))}, not {value!r}.")


def check_call(name: str, function: Any, *arguments: Any) -> None:
    """Raises a ValueError unless a function takes such arguments."""
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError as error:
        given = ", ".join(type(argument).__name__ for argument in arguments)
        raise ValueError(
            f"{name} can't be called as RLlib does, with {len(arguments)} arguments ({given}): {error}."
        ) from None
    except ValueError:  # it has no signature
        pass


def own_policy(agent_id: str, episode: Any = None, **kwargs: Any) -> str:
    """The default policy mapping: every agent has a policy of its own, named like it."""
    return agent_id


def check_settings_of(config: JointConfig) -> None:
    """Checks each setting by itself, those that exclude each other, and those of RLlib that joint training needs."""
    settings.check_values(config)
    if config.critic_sees not in _CRITICS_SEE:
        raise ValueError(f"critic_sees must be one of {', '.join(map(str, _CRITICS_SEE))}, not {config.critic_sees!r}.")
    for name in ("exploration", "actor_settings", "critic_settings"):
        if not isinstance(getattr(config, name), dict):
            raise ValueError(f"{name} must be a dict of settings by name, not {getattr(config, name)!r}.")
    for name in ("train_batch_size_per_learner", "num_steps_sampled_before_learning_starts", "seq_length", "n_step"):
        if getattr(config, name) > config.replay_buffer_capacity:
            raise ValueError(
                f"{name} ({getattr(config, name)}) must not be larger than "
                f"replay_buffer_capacity ({config.replay_buffer_capacity})."
            )
    steps = config.num_envs_per_env_runner * config.get_rollout_fragment_length()
    if steps > config.replay_buffer_capacity and not config.in_evaluation:
        raise ValueError(
            f"num_envs_per_env_runner ({config.num_envs_per_env_runner}) times rollout_fragment_length "
            f"({config.get_rollout_fragment_length()}) must not be larger than replay_buffer_capacity "
            f"({config.replay_buffer_capacity}): replay takes so many steps at once."
        )
    if not config.supports.twin_critics and (config.twin_critics or config.target_noise or config.policy_delay > 1):
        legal = "twin_critics=False, target_noise=0.0 and policy_delay=1"
        raise ValueError(f"{config.name} is not defined with TD3's options; legal are {legal}.")
    if not issubclass(config.env_runner_cls or object, JointEnvRunner):
        raise ValueError(f"env_runner_cls must be a JointEnvRunner, not {config.env_runner_cls}: replay is joint.")
    if not issubclass(config.learner_class, JointLearner):
        raise ValueError(f"learner_class must be a JointLearner, not {config.learner_class}: its losses are joint.")
    for callback in force_list(config.callbacks_class):
        if not callable(callback) or (isinstance(callback, type) and not issubclass(callback, RLlibCallback)):
            raise ValueError(
                f"callbacks_class must be a subclass of RLlibCallback, or a list of them, not {callback!r}."
            )
    for name in settings.CALLBACKS:
        if wrong := [function for function in force_list(getattr(config, name)) if not callable(function)]:
            raise ValueError(f"{name} must be a function, or a list of functions, not {wrong[0]!r}.")
    settings.check_known(config)
    if not config.in_evaluation:
        settings.check_evaluation(config)


def check_networks(config: JointConfig) -> None:
    """Checks the networks' classes and their settings."""
    _check_model_config(config._model_config, "model_config", COMMON_SETTINGS)
    spec = config._rl_module_spec
    if isinstance(spec, RLModuleSpec):
        _check_module_spec(config, spec, "The RLModuleSpec")
    elif isinstance(spec, MultiRLModuleSpec):
        for policy, own in spec.rl_module_specs.items():
            _check_module_spec(config, own, f"The RLModuleSpec of policy {policy!r}")
    model_config = config.model_config
    one_of("model_config['activation']", model_config.get("activation", "relu"), ACTIVATIONS)
    hidden = model_config.get("hidden_sizes", (64,))
    listed = isinstance(hidden, list | tuple) and 0 < len(hidden) <= _MOST_LAYERS
    if not listed or not all(_is_size(size) for size in hidden):
        raise ValueError(
            f"model_config['hidden_sizes'] must be positive integers, e.g. (64, 64), not {hidden!r}: up to {_LARGEST} "
            f"units in up to {_MOST_LAYERS} layers."
        )
    cell = model_config.get("lstm_cell_size", 64)
    if not _is_size(cell):
        raise ValueError(
            f"model_config['lstm_cell_size'] must be a positive integer, e.g. 64, not {cell!r}: up to {_LARGEST}."
        )
    actor = ACTORS.resolve(config.actor)
    network_settings(actor, model_config, config.actor_settings, ACTOR_ARGUMENTS)
    if config.normalize_observations and issubclass(actor, EntityActor | EntityLSTMActor):
        raise ValueError(
            f"normalize_observations must be False with {actor.__name__}: it shifts and scales each number on its "
            f"own, so that alike entities would differ."
        )
    recurrent = issubclass(actor, RecurrentActor)
    if recurrent and not config.supports.recurrent:
        raise ValueError(f"{config.name} is not defined with recurrent actors; {actor.__name__} is one.")
    if config.stored_state and not recurrent:
        raise ValueError(
            f"stored_state=True needs a recurrent actor, e.g. actor='lstm'; {config.actor!r} has no state to store."
        )
    critic = CRITICS.resolve(config.critic)
    if config.critic_sees:
        network_settings(critic, model_config, config.critic_settings, CRITIC_ARGUMENTS)
    elif config.critic != "mlp" or config.critic_settings:
        raise ValueError(
            f"{config.name} has no critics, so it takes neither critic ({config.critic!r}) nor critic_settings "
            f"({config.critic_settings!r}): its utilities are the actor."
        )
    networks: list[type[Any]] = [actor, critic] if config.critic_sees else [actor]
    if isinstance(spec, MultiRLModuleSpec):  # policies may have others
        given = [own.model_config or {} for own in spec.rl_module_specs.values()]
        networks += [ACTORS.resolve(own["actor"]) for own in given if "actor" in own]
        networks += [CRITICS.resolve(own["critic"]) for own in given if "critic" in own]
    names = " and ".join(network.__name__ for network in networks)
    for name in config._model_config:
        if not any(takes(network, name) for network in networks):
            raise ValueError(f"model_config[{name!r}] has no effect: {names} take no such setting.")


def _is_size(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(0 < value <= _LARGEST)


def _check_model_config(given: Any, what: str, legal: Collection[str]) -> None:
    """Raises a ValueError unless it is a dict of settings that policies may have."""
    if not isinstance(given, dict):
        raise ValueError(f"{what} must be a dict with some of {', '.join(legal)}, not {given!r}.")
    for name in given:
        if name not in legal:
            raise ValueError(
                f"{what} sets {name!r}{closest(name, list(legal))}; legal are {', '.join(legal)}. Settings of one "
                f"network alone are training(actor_settings={{...}}) and training(critic_settings={{...}}), and all "
                f"else is training()'s."
            )


def _check_module_spec(config: JointConfig, spec: RLModuleSpec, what: str) -> None:
    """Raises a ValueError if a policy's own module is no `AgentModule`, or has settings that are training()'s."""
    if spec.model_config is not None:
        _check_model_config(spec.model_config, what, _OF_A_POLICY)
    cls = spec.module_class
    if cls is not None and not issubclass(cls, config.module):
        missing = [name for name in vars(config.module) if name[0] != "_" and not hasattr(cls, name)]
        raise ValueError(
            f"{what} has module_class {cls.__name__}, which lacks {', '.join(missing)} of {config.module.__name__}: "
            f"derive it from that, or plug in its networks alone by training(actor=..., critic=...)."
        )


def inspect_team(config: JointConfig) -> Team:
    """Makes one copy of the environment to learn who its agents are, and whether the algorithm is defined for them."""
    if config.env is None:
        raise ValueError('No environment: set one with config.environment("maobs/spread-3a").')
    env = make_env(config, num_envs=1)
    try:
        team = Team.of(
            env,
            with_state=config.uses_state and config.critic_state == "world",
            observation_layouts=config.observation_layouts,
            state_layout=config.state_layout,
        )
        if config.supports.team_reward and not shares_reward(env):
            raise ValueError(
                f"{config.name} learns the value of one team reward, but in {config.env} agents' rewards differ: give "
                f'all agents the same (option reward_mode="sum" of this package\'s environments), or use another '
                f"algorithm."
            )
    finally:
        env.close()
    decided: Team | None = getattr(config, "team", None)
    if decided is not None and config.in_evaluation:
        decided.check(env, f"the evaluation environment {config.env!r}")
    if decided is not None and set(decided.agents) == set(team.agents):
        return team.ordered(decided.agents)  # once decided, an order stays
    return team


def map_policies(config: JointConfig) -> tuple[str, ...]:
    """Every agent's policy, in the team's order; one each if none are configured."""
    team = config.team
    default = type(config)()
    mapped = config.policy_mapping_fn is not default.policy_mapping_fn
    if not mapped and (unnamed := [agent for agent in team.agents if not isinstance(agent, str)]):
        raise ValueError(
            f"Agents are called {unnamed}, and policies, which are called after them, must be strings: give "
            f"config.multi_agent(policies={{'p0', ...}}, policy_mapping_fn=lambda agent, *a, **k: f'p{{agent}}')."
        )
    if not config.is_multi_agent and not mapped:
        policies = {agent: PolicySpec() for agent in team.agents}
        config.multi_agent(policies=policies, policy_mapping_fn=own_policy)
    elif not mapped:
        raise ValueError(
            f"multi_agent(policies=...) has {sorted(config.policies)}, but no policy_mapping_fn: say which agent has "
            f"which, e.g. policy_mapping_fn=lambda agent, *args, **kwargs: agent."
        )
    for policy, spec in config.policies.items():
        if isinstance(spec, PolicySpec) and spec.config:
            raise ValueError(
                f"The PolicySpec of {policy!r} has a config, {spec.config}, which RLlib's new API stack does not read: "
                f"policies may differ in exploration, by multi_agent(algorithm_config_overrides_per_module=...), and "
                f"in networks, by rl_module(rl_module_spec=...)."
            )
    check_call("policy_mapping_fn", config.policy_mapping_fn, team.agents[0], None)
    module_ids = tuple(config.policy_mapping_fn(agent, None) for agent in team.agents)
    if unnamed := [mid for mid in module_ids if not isinstance(mid, str)]:
        raise ValueError(f"policy_mapping_fn must return names of policies (strings), not {unnamed[0]!r}.")
    mapping = dict(zip(team.agents, module_ids, strict=True))
    if set(module_ids) != set(config.policies):
        raise ValueError(
            f"The policy mapping must use every policy and no other: policies are {sorted(config.policies)}, agents "
            f"are mapped to {mapping}."
        )
    for policy in config.policies:
        spaces = {agent: team.spaces(agent) for agent, own in mapping.items() if own == policy}
        if len({(obs.shape, getattr(act, "n", act.shape)) for obs, act in spaces.values()}) > 1:
            raise ValueError(f"Agents that share policy {policy!r} must have spaces of equal size, not {spaces}.")
        layouts = {team.observation_layouts[team.agents.index(agent)] for agent in spaces}
        if len(layouts) > 1:
            raise ValueError(f"Agents that share policy {policy!r} must have one observation layout, not {layouts}.")
        if len(spaces) > 1 and not config.supports.parameter_sharing:
            raise ValueError(f"{config.name} is not defined with shared policies; {policy!r} is that of {[*spaces]}.")
    for policy in config.policies:
        validate_module_id(policy, error=True)  # it names a folder of checkpoints
        if policy in (MIXER, ALL_MODULES):
            raise ValueError(
                f"No policy can be called {policy!r}, which RLlib or this package calls something else: rename the "
                f"agent, or give agents policies of other names by config.multi_agent(policies=..., "
                f"policy_mapping_fn=...)."
            )
    return module_ids


def check_team(config: JointConfig) -> None:
    """Checks whether the algorithm and the exploration are defined for the team's actions."""
    team = config.team
    kind = "discrete" if team.discrete else "continuous"
    if kind not in config.supports.actions:
        raise ValueError(
            f"{config.name} needs {config.supports.actions[0]} actions, but those of {config.env} are {kind}: choose "
            f'them in the environment (option action_mode="discrete" or "mpe" of this package\'s).'
        )
    different = len({*team.observation_sizes}) > 1 or len({*team.action_sizes}) > 1
    if different and not config.supports.different_agents:
        raise ValueError(
            f"{config.name} needs agents with observations and actions of equal size, but those of {config.env} have "
            f"{dict(zip(team.agents, zip(team.observation_sizes, team.action_sizes, strict=True), strict=True))}."
        )
    if not team.discrete and config.gumbel_temperature != 1.0:
        raise ValueError(
            f"gumbel_temperature must be 1.0, not {config.gumbel_temperature}: the actions of {config.env} are "
            f"continuous, and it is the softmax's of discrete ones."
        )
    if team.discrete and config.target_noise:
        raise ValueError(
            f"target_noise must be 0.0 where actions are discrete, not {config.target_noise}: a one-hot action "
            f"can't be smoothed."
        )
    overrides = config.algorithm_config_overrides_per_module
    if unknown := sorted(set(overrides) - set(config.module_ids)):
        raise ValueError(
            f"algorithm_config_overrides_per_module has no policies {unknown}; "
            f"legal are {sorted(set(config.module_ids))}."
        )
    for mid in dict.fromkeys(config.module_ids):
        changes = overrides.get(mid, {})
        changes = changes if isinstance(changes, dict) else changes.to_dict()
        if others := sorted(set(changes) - {"exploration"}):
            raise ValueError(
                f"algorithm_config_overrides_per_module[{mid!r}] sets {others}; policies may differ in exploration "
                f"alone: all are learned in one stacked update."
            )
        make_exploration(config.exploration_of(mid), discrete=team.discrete)


def check_layouts(config: JointConfig) -> None:
    """Builds every policy's networks once, so that one which can't do with its layout is an error now."""
    if config.mixes and config.mixer_settings() is None:
        raise ValueError(f"{config.name} mixes values (mixes=True), but its mixer_settings() says not how.")
    built_modules(config)


def built_modules(config: JointConfig) -> dict[str, RLModule]:
    """The modules that a learner would start with, by policy."""
    team = config.team
    spaces = {mid: team.spaces(agent) for agent, mid in zip(team.agents, config.module_ids, strict=True)}
    specs = config.get_multi_rl_module_spec(spaces=spaces).rl_module_specs
    if any(_is_wide(spec.model_config) for spec in specs.values()):
        _check_size(specs)
    with torch.random.fork_rng(devices=[]):  # the run's own networks start as if there had been no check
        return {mid: spec.build() for mid, spec in specs.items()}


def _is_wide(settings: Any) -> bool:
    """Whether there is a number among settings that may stand for a large layer."""
    if isinstance(settings, Mapping):
        settings = [*settings.values()]
    if isinstance(settings, list | tuple):
        return any(map(_is_wide, settings))
    return isinstance(settings, int | np.integer) and bool(settings > 2048)


def _check_size(specs: Mapping[str, RLModuleSpec]) -> None:
    """Raises a ValueError if networks do not fit into memory, before they are put there."""
    try:
        with torch.device("meta"):
            size = sum(value.nbytes for spec in specs.values() for value in spec.build().state_dict().values())
    except (NotImplementedError, RuntimeError):  # a user's network takes real numbers, or a size is beyond PyTorch
        size = 0
    # The parameters themselves, their gradients and Adam's two moments.
    if (needed := 4 * size) > (memory := memory_of("cpu")):
        raise ValueError(
            f"The networks take {gigabytes(needed)} while they learn, and there are {gigabytes(memory)}: make them "
            f"smaller, e.g. by rl_module(model_config={{'hidden_sizes': (64, 64)}})."
        )


def check_machine(config: JointConfig) -> None:
    """Checks that the machine of the learner has what the configuration asks for; the others need not."""
    if config.num_gpus_per_learner > 0 and not torch.cuda.is_available():
        raise ValueError(
            f"num_gpus_per_learner must be 0 where PyTorch finds no GPU, not {config.num_gpus_per_learner}: "
            f"torch.cuda.is_available() is False."
        )
    team: Team = config.team
    observations = config.train_batch_size_per_learner * max(1, config.window_length)
    size = 8 * observations * len(team.agents) * team.observation_size  # now and next, in single precision
    if size > (memory := memory_of("cuda" if config.num_gpus_per_learner > 0 else "cpu")):
        raise ValueError(
            f"A minibatch takes {gigabytes(size)}, and there are {gigabytes(memory)}: lower "
            f"train_batch_size_per_learner ({config.train_batch_size_per_learner}) or seq_length "
            f"({config.seq_length}, with recurrent actors)."
        )
    if config.torch_compile_learner and config.torch_compile_learner_dynamo_backend == "inductor":
        check_compiler()


def check_compiler() -> None:
    """Checks that there is the C++ compiler that `torch.compile` calls."""
    given = os.environ.get("CXX") or {"darwin": "clang++", "win32": "cl"}.get(sys.platform, "g++")
    if shutil.which(shlex.split(given)[0]) is None:
        raise ValueError(
            f"Compiled updates need a C++ compiler, and there is no {given!r} on the PATH: install one (apt install "
            f"g++, or conda install gxx), or go without by framework(torch_compile_learner=False), which is "
            f"--no-compile of the example scripts: the same numbers, several times slower."
        )


def agent_groups(config: JointConfig, state: Layout) -> list[tuple[str, int]]:
    """Names and counts of the agents' groups in a joint action: the first ones of the state, where it has them."""
    num_agents = len(config.team.agents)
    groups, found = [], 0
    if config.critic_state == "world":
        for group in state:
            if found == num_agents:
                break
            groups.append((group.name, group.count))
            found += group.count
    return groups if found == num_agents else [("agent", num_agents)]


def default_algorithm(config: type[JointConfig]) -> type:
    """The Algorithm class that a configuration builds unless it is told another: the one that was registered for it."""
    from rllib_maobs.algorithms.registry import algorithm_of

    return algorithm_of(config)
