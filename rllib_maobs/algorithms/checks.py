"""All checks of a configuration, before a run starts; each raises a ValueError that says what is legal."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import torch
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.policy.policy import PolicySpec

from rllib_maobs.envs.team import Team, shares_reward
from rllib_maobs.layout import Layout
from rllib_maobs.modules import ACTIVATIONS, ACTORS, CRITICS, EntityActor, EntityLSTMActor, RecurrentActor
from rllib_maobs.modules.agent import ACTOR_ARGUMENTS, COMMON_SETTINGS, CRITIC_ARGUMENTS, network_settings
from rllib_maobs.modules.exploration import make_exploration
from rllib_maobs.options import check_value
from rllib_maobs.runner import JointEnvRunner, make_env

if TYPE_CHECKING:
    from rllib_maobs.algorithms.config import JointConfig

_CRITICS_SEE = (), ("observation", "action"), ("state", "action"), ("state", "joint_action")
# What a policy's own RLModuleSpec may set.
_OF_A_POLICY = (*COMMON_SETTINGS, "actor", "actor_settings", "critic", "critic_settings")


def one_of(name: str, value: Any, legal: Collection[str]) -> None:
    """Raises a ValueError that names the legal values unless the value is one of them."""
    if value not in legal:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, legal))}, not {value!r}.")


def own_policy(agent_id: str, episode: Any = None, **kwargs: Any) -> str:
    """The default policy mapping: every agent has a policy of its own, named like it."""
    return agent_id


def check_settings_of(config: JointConfig) -> None:
    """Checks each setting by itself, those that exclude each other, and those of RLlib that joint training needs."""
    for name, hint in config.legal.items():
        setattr(config, name, check_value(getattr(config, name), hint, name, type(config).__name__))
    if config.critic_sees not in _CRITICS_SEE:
        raise ValueError(f"critic_sees must be one of {', '.join(map(str, _CRITICS_SEE))}, not {config.critic_sees!r}.")
    for name in ("exploration", "actor_settings", "critic_settings"):
        if not isinstance(getattr(config, name), dict):
            raise ValueError(f"{name} must be a dict of settings by name, not {getattr(config, name)!r}.")
    for name in ("train_batch_size_per_learner", "num_steps_sampled_before_learning_starts", "seq_length"):
        if getattr(config, name) > config.replay_buffer_capacity:
            raise ValueError(
                f"{name} ({getattr(config, name)}) must not be larger than "
                f"replay_buffer_capacity ({config.replay_buffer_capacity})."
            )
    if not config.supports.twin_critics and (config.twin_critics or config.target_noise or config.policy_delay > 1):
        legal = "twin_critics=False, target_noise=0.0 and policy_delay=1"
        raise ValueError(f"{config.name} is not defined with TD3's options; legal are {legal}.")
    if config.num_learners > 0:
        raise ValueError(
            f"num_learners must be 0, not {config.num_learners}: a stacked update of all agents runs in the "
            f"algorithm's process (on its GPU with num_gpus_per_learner=1). Scale out with num_env_runners "
            f"or with more Tune trials."
        )
    if not issubclass(config.env_runner_cls or object, JointEnvRunner):
        raise ValueError(f"env_runner_cls must be a JointEnvRunner, not {config.env_runner_cls}: replay is joint.")
    if not config.normalize_actions:
        raise ValueError("normalize_actions must be True: the actors' actions are in [-1, 1].")


def check_networks(config: JointConfig) -> None:
    """Checks the networks' classes and their settings."""
    given = config._model_config
    for name in given if isinstance(given, dict) else ():
        if name not in COMMON_SETTINGS:
            raise ValueError(
                f"Unknown model_config setting {name!r}; legal are {', '.join(COMMON_SETTINGS)}. Settings of one "
                f"network alone are training(actor_settings={{...}}) and training(critic_settings={{...}})."
            )
    if isinstance(config._rl_module_spec, MultiRLModuleSpec):
        for policy, spec in config._rl_module_spec.rl_module_specs.items():
            for name in spec.model_config if isinstance(spec.model_config, dict) else ():
                if name not in _OF_A_POLICY:
                    raise ValueError(
                        f"The RLModuleSpec of policy {policy!r} sets {name!r}; policies may differ in "
                        f"{', '.join(_OF_A_POLICY)}, everything else is training()'s."
                    )
    settings = config.model_config
    one_of("model_config['activation']", settings.get("activation", "relu"), ACTIVATIONS)
    hidden = settings.get("hidden_sizes", (64,))
    if not hidden or not all(isinstance(size, int) and size > 0 for size in hidden):
        raise ValueError(f"model_config['hidden_sizes'] must be positive integers, e.g. (64, 64), not {hidden!r}.")
    cell = settings.get("lstm_cell_size", 64)
    if not isinstance(cell, int) or cell < 1:
        raise ValueError(f"model_config['lstm_cell_size'] must be a positive integer, e.g. 64, not {cell!r}.")
    actor = ACTORS.resolve(config.actor)
    network_settings(actor, settings, config.actor_settings, ACTOR_ARGUMENTS)
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
        network_settings(critic, settings, config.critic_settings, CRITIC_ARGUMENTS)
    elif config.critic != "mlp" or config.critic_settings:
        raise ValueError(
            f"{config.name} has no critics, so it takes neither critic ({config.critic!r}) nor critic_settings "
            f"({config.critic_settings!r}): its utilities are the actor."
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
    return team


def map_policies(config: JointConfig) -> tuple[str, ...]:
    """Every agent's policy, in the team's order; one each if none are configured."""
    team = config.team
    if not config.is_multi_agent:
        policies = {agent: PolicySpec() for agent in team.agents}
        config.multi_agent(policies=policies, policy_mapping_fn=own_policy)
    module_ids = tuple(config.policy_mapping_fn(agent, None) for agent in team.agents)
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
    if config.policies_to_train is not None:
        raise ValueError("policies_to_train must be None: all agents of the team are trained.")
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
    team = config.team
    spaces = {mid: team.spaces(agent) for agent, mid in zip(team.agents, config.module_ids, strict=True)}
    specs = config.get_multi_rl_module_spec(spaces=spaces).rl_module_specs
    with torch.random.fork_rng(devices=[]):  # the run's own networks start as if there had been no check
        for spec in specs.values():
            spec.build()


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
