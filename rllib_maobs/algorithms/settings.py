"""What becomes of every setting: of RLlib's a table as data, and of ours what each needs to have an effect."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from ray.rllib.algorithms.algorithm_config import DEPRECATED_VALUE, AlgorithmConfig, NotProvided
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec

from rllib_maobs.options import Range, check_value, closest
from rllib_maobs.registry import same

if TYPE_CHECKING:
    from rllib_maobs.algorithms.config import JointConfig

PositiveInt = Annotated[int, Range(1)]
NonNegativeInt = Annotated[int, Range(0)]
Positive = Annotated[float, Range(0.0, exclusive=True)]
NonNegative = Annotated[float, Range(0.0)]
Amount = NonNegativeInt | NonNegative  # of a resource: a whole number stays one

CALLBACKS = tuple(
    f"callbacks_{name}"
    for name in (
        "on_algorithm_init on_train_result on_evaluate_start on_evaluate_end on_env_runners_recreated "
        "on_checkpoint_loaded on_environment_created on_episode_created on_episode_start on_episode_step "
        "on_episode_end on_sample_end"
    ).split()
)
"""Settings that are functions to be called."""

LEGAL: dict[str, Any] = {
    # Ours.
    "actor_lr": Positive | list,
    "critic_lr": Positive | list,
    "tau": Annotated[float, Range(0.0, 1.0, exclusive=True)],
    "replay_buffer_capacity": PositiveInt,
    "updates_per_env_step": NonNegative,
    "critic_state": Literal["observations", "world"],
    "observation_layouts": Mapping | None,
    "seq_length": PositiveInt,
    "stored_state": bool,
    "n_step": Annotated[int, Range(1, 1000)],  # each of them is one more look into replay, in every update
    "twin_critics": bool,
    "policy_delay": PositiveInt,
    "target_noise": NonNegative,
    "target_noise_clip": NonNegative,
    "action_regularization": NonNegative,
    "gumbel_temperature": Positive,
    "normalize_observations": bool,
    "reward_scale": Positive,
    "agent_id_input": bool,
    "num_random_steps": NonNegativeInt,
    "num_steps_sampled_before_learning_starts": NonNegativeInt,
    "store_buffer_in_checkpoints": bool,
    "nonfinite_updates": Literal["raise", "skip"],
    "env_timeout_s": Positive | None,
    # RLlib's, in the order of `METHODS`.
    "num_cpus_for_main_process": Amount,
    "custom_resources_for_main_process": dict,
    "placement_strategy": Literal["PACK", "SPREAD", "STRICT_PACK", "STRICT_SPREAD"],
    "torch_compile_learner": bool,
    "torch_compile_learner_dynamo_backend": str,
    "torch_compile_learner_dynamo_mode": str | None,
    "env": str | type | None,
    "env_config": dict,
    "env_runner_cls": type,
    "num_env_runners": NonNegativeInt,
    "num_envs_per_env_runner": PositiveInt,
    "create_env_on_local_worker": bool,
    "num_cpus_per_env_runner": Amount,
    "custom_resources_per_env_runner": dict,
    "validate_env_runners_after_construction": bool,
    "sample_timeout_s": Positive | None,
    "max_requests_in_flight_per_env_runner": PositiveInt,
    "rollout_fragment_length": PositiveInt | Literal["auto"],
    "explore": bool,
    "num_cpus_per_learner": Amount | Literal["auto"],
    "num_gpus_per_learner": Amount,
    "local_gpu_idx": NonNegativeInt,
    "learner_class": type | None,
    "learner_config_dict": dict,
    "gamma": Annotated[float, Range(0.0, 1.0)],
    "train_batch_size_per_learner": PositiveInt,
    "grad_clip": Positive | None,
    "grad_clip_by": Literal["global_norm", "norm", "value"],
    "callbacks_class": Callable | list | tuple,
    **dict.fromkeys(CALLBACKS, Callable | list | tuple | None),
    "evaluation_interval": NonNegativeInt | None,
    "evaluation_duration": PositiveInt | Literal["auto"],
    "evaluation_duration_unit": Literal["episodes", "timesteps"],
    "evaluation_config": dict | None,
    "evaluation_auto_duration_min_env_steps_per_sample": PositiveInt,
    "evaluation_auto_duration_max_env_steps_per_sample": PositiveInt,
    "evaluation_sample_timeout_s": Positive | None,
    "evaluation_num_env_runners": NonNegativeInt,
    "evaluation_unhealthy_workers_timeout_s": NonNegative,
    "evaluation_parallel_to_training": bool,
    "evaluation_error_after_n_consecutive_skips": PositiveInt | None,
    "evaluation_force_reset_envs_before_iteration": bool,
    "custom_evaluation_function": Callable | None,
    "policies": dict | set | list | tuple,
    "policy_mapping_fn": Callable,
    "rl_module_spec": RLModuleSpec | MultiRLModuleSpec | None,
    "algorithm_config_overrides_per_module": dict,
    "metrics_num_episodes_for_smoothing": PositiveInt,
    "min_time_s_per_iteration": NonNegative | None,
    "min_train_timesteps_per_iteration": NonNegativeInt | None,
    "min_sample_timesteps_per_iteration": NonNegativeInt | None,
    "custom_stats_cls_lookup": dict,
    "log_level": Literal["DEBUG", "INFO", "WARN", "WARNING", "ERROR"],
    "seed": Annotated[int, Range(0, 2**32 - 1)] | None,
    "restart_failed_env_runners": bool,
    "restart_failed_sub_environments": bool,
    "ignore_env_runner_failures": bool,
    "max_num_env_runner_restarts": NonNegativeInt,
    "delay_between_env_runner_restarts_s": NonNegative,
    "num_consecutive_env_runner_failures_tolerance": NonNegativeInt,
    "env_runner_health_probe_timeout_s": Positive,
    "env_runner_restore_timeout_s": Positive,
    "_validate_config": bool,
}
"""What is legal for each setting of every algorithm, as a type hint."""


def _each(names: str, note: str = "") -> dict[str, str]:
    return dict.fromkeys(names.split(), note)


HONOURED: dict[str, str] = {
    # resources, framework, api_stack
    **_each("num_cpus_for_main_process custom_resources_for_main_process placement_strategy"),
    **_each("torch_compile_learner", "the whole update is compiled, see JointLearner"),
    **_each("torch_compile_learner_dynamo_backend torch_compile_learner_dynamo_mode"),
    # environment
    **_each("env", "a registered name, or a class"),
    **_each("env_config"),
    # env_runners
    **_each("env_runner_cls", "a JointEnvRunner"),
    **_each("num_env_runners num_envs_per_env_runner create_env_on_local_worker"),
    **_each("num_cpus_per_env_runner custom_resources_per_env_runner validate_env_runners_after_construction"),
    **_each("sample_timeout_s explore max_requests_in_flight_per_env_runner"),
    **_each("rollout_fragment_length", "steps of every copy between two rounds of updates"),
    # learners, training
    **_each("num_cpus_per_learner num_gpus_per_learner", "of the algorithm's own process"),
    **_each("local_gpu_idx"),
    **_each("learner_class", "a JointLearner"),
    **_each("learner_config_dict", "for a learner of your own, as config.learner_config_dict"),
    **_each("gamma train_batch_size_per_learner"),
    **_each("grad_clip grad_clip_by", "of each network by itself, see training()"),
    # callbacks
    **_each("callbacks_class on_algorithm_init on_train_result on_evaluate_start on_evaluate_end"),
    **_each("on_env_runners_recreated on_checkpoint_loaded on_environment_created on_sample_end"),
    **_each("on_episode_created on_episode_start on_episode_step on_episode_end"),
    # evaluation
    **_each("evaluation_interval evaluation_duration evaluation_duration_unit"),
    **_each(
        "evaluation_config",
        "settings of the runners that evaluate; others would do nothing there, and are errors; without `explore` they "
        "do not explore",
    ),
    **_each("evaluation_auto_duration_min_env_steps_per_sample evaluation_auto_duration_max_env_steps_per_sample"),
    **_each("evaluation_sample_timeout_s evaluation_num_env_runners evaluation_unhealthy_workers_timeout_s"),
    **_each("evaluation_parallel_to_training", "needs evaluation_num_env_runners"),
    **_each("evaluation_error_after_n_consecutive_skips evaluation_force_reset_envs_before_iteration"),
    **_each(
        "custom_evaluation_function",
        "the metrics that it returns are results; on_evaluate_end sees those alone that it logs in algo.metrics",
    ),
    # multi_agent, rl_module
    **_each("policies policy_mapping_fn", "agents of one policy share its networks"),
    **_each("model_config", "hidden_sizes, activation and lstm_cell_size, where a network takes them"),
    **_each("rl_module_spec", "of AgentModules; policies may differ in their networks"),
    **_each("algorithm_config_overrides_per_module", "of exploration"),
    # reporting, debugging, fault_tolerance, experimental
    **_each("metrics_num_episodes_for_smoothing min_time_s_per_iteration custom_stats_cls_lookup"),
    **_each("min_train_timesteps_per_iteration", "rows of minibatches"),
    **_each("min_sample_timesteps_per_iteration", "how long an iteration's rounds of sampling and updates go on"),
    **_each("log_level seed"),
    **_each(
        "restart_failed_env_runners",
        "after a crash of its process; after an error of its environment that alone is made anew (callbacks.md)",
    ),
    **_each(
        "restart_failed_sub_environments",
        "of environments of your own the copy that fails; as often as failures are tolerated (callbacks.md)",
    ),
    **_each("ignore_env_runner_failures max_num_env_runner_restarts delay_between_env_runner_restarts_s"),
    **_each("num_consecutive_env_runner_failures_tolerance"),
    **_each("env_runner_health_probe_timeout_s env_runner_restore_timeout_s"),
    **_each("_validate_config", "leaves RLlib's own checks out; those of this package find the team and stay"),
}
"""Settings of RLlib that do what its documentation says, and what there is to know of them here."""

HARMLESS: dict[str, str] = {
    **_each("torch_compile_learner_what_to_compile", "the whole update is compiled, whichever is given"),
    **_each("is_atari", "there is no special treatment of Atari to switch on or off"),
    **_each("disable_env_checking", "environments are checked here by what they return"),
    **_each("max_requests_in_flight_per_learner", "the learner is in the algorithm's process"),
    **_each("episode_lookback_horizon episodes_to_numpy", "samples are arrays, not episodes"),
    **_each(
        "merge_env_runner_states broadcast_env_runner_states env_runner_state_server_max_concurrency",
        "runners have no states of connectors",
    ),
    **_each("log_sys_usage", "RLlib 2.60 logs nothing of it, either"),
}
"""Settings of RLlib that may be given, since nothing depends on them here; and why not."""

_OLD = "it belongs to RLlib's old API stack"
_TENSORFLOW = "it belongs to TensorFlow, and networks here are PyTorch's"
_OFFLINE = "learning from recorded data is not offered: a JointReplayBuffer can be filled and sampled by hand"
_CONNECTORS = (
    "joint columns have no connector pipelines; use training(normalize_observations=True), a recurrent actor for the "
    "last observations together, or wrap the environment (docs/callbacks.md)"
)
_LEARNER = "the one learner is in the algorithm's process; use num_env_runners for more samples"
_PASSES = "use training(updates_per_env_step=...): each update takes a minibatch of its own from replay"
_NETWORKS = 'use rl_module(model_config={"hidden_sizes": ...}), or training(actor=..., critic=...)'

REFUSED: dict[str, str] = {
    # python_environment, resources, framework, api_stack
    **_each(
        "extra_python_environs_for_driver extra_python_environs_for_worker",
        'RLlib 2.60 hands it to nobody; use ray.init(runtime_env={"env_vars": ...})',
    ),
    **_each("num_gpus _fake_gpus", "use learners(num_gpus_per_learner=1)"),
    **_each("framework", "networks here are PyTorch's"),
    **_each("eager_tracing eager_max_retraces tf_session_args local_tf_session_args", _TENSORFLOW),
    **_each(
        "torch_compile_worker torch_compile_worker_dynamo_backend torch_compile_worker_dynamo_mode",
        "acting is not compiled; use torch_compile_learner=True for the updates",
    ),
    **_each("torch_ddp_kwargs", _LEARNER),
    **_each(
        "torch_skip_nan_gradients", "a NaN from the environment is an error here; use grad_clip against large steps"
    ),
    **_each("enable_rl_module_and_learner enable_env_runner_and_connector_v2", "there is no old API stack here"),
    # environment
    **_each("observation_space action_space", "spaces are those that the environment declares; wrap it to change them"),
    **_each("render_env", "use python -m rllib_maobs.play for a look"),
    **_each("clip_rewards", "use training(reward_scale=...), or clip rewards in the environment"),
    **_each("normalize_actions", "the actors' actions are in [-1, 1]"),
    **_each("clip_actions", "actions are scaled to the bounds, so none lies outside of them"),
    **_each("action_mask_key", "there are no action masks"),
    # env_runners
    **_each("create_local_env_runner", "the algorithm asks its local runner for modules, spaces and states"),
    **_each("gym_env_vectorize_mode", "copies step together in one process; use num_env_runners for more processes"),
    **_each("num_gpus_per_env_runner", "runners act on the CPU; use num_gpus_per_learner for the updates"),
    **_each(
        "env_to_module_connector module_to_env_connector learner_connector use_env_runner_state_server "
        "add_default_connectors_to_env_to_module_pipeline add_default_connectors_to_module_to_env_pipeline "
        "add_default_connectors_to_learner_pipeline",
        _CONNECTORS,
    ),
    **_each("compress_observations", "replay holds plain arrays; use replay_buffer_capacity to save memory"),
    **_each("batch_mode", "replay keeps together what was sampled piece by piece; use rollout_fragment_length"),
    **_each("exploration_config", "use training(exploration={...})"),
    **_each("observation_filter", "use training(normalize_observations=True)"),
    **_each("update_worker_filter_stats use_worker_filter_stats", "it belongs to observation_filter"),
    **_each(
        "sample_collector remote_worker_envs remote_env_batch_wait_ms preprocessor_pref enable_tf1_exec_eagerly "
        "sampler_perf_stats_ema_coef",
        _OLD,
    ),
    # learners, training
    **_each(
        "num_learners",
        "a stacked update of all agents runs in the algorithm's process (on its GPU with num_gpus_per_learner=1); "
        "scale out with num_env_runners or with more Tune trials",
    ),
    **_each("custom_resources_per_learner", "use resources(custom_resources_for_main_process={...})"),
    **_each("num_aggregator_actors_per_learner max_requests_in_flight_per_aggregator_actor", _LEARNER),
    **_each("lr", "use actor_lr and critic_lr"),
    **_each("train_batch_size", "use train_batch_size_per_learner"),
    **_each("num_epochs minibatch_size shuffle_batch_per_epoch", _PASSES),
    **_each("model", _NETWORKS),
    **_each("optimizer", "the optimiser is Adam; to change it, derive a JointLearner"),
    # callbacks, evaluation
    **_each("on_evaluate_offline_start on_evaluate_offline_end on_offline_eval_runners_recreated", _OFFLINE),
    **_each(
        "off_policy_estimation_methods ope_split_batch_by_episode offline_evaluation_interval "
        "num_offline_eval_runners offline_evaluation_type offline_eval_runner_class offline_loss_for_module_fn "
        "offline_eval_batch_size_per_runner dataset_num_iters_per_offline_eval_runner "
        "offline_eval_rl_module_inference_only num_cpus_per_offline_eval_runner num_gpus_per_offline_eval_runner "
        "custom_resources_per_offline_eval_runner offline_evaluation_timeout_s "
        "max_requests_in_flight_per_offline_eval_runner broadcast_offline_eval_runner_states "
        "validate_offline_eval_runners_after_construction restart_failed_offline_eval_runners "
        "ignore_offline_eval_runner_failures max_num_offline_eval_runner_restarts "
        "offline_eval_runner_health_probe_timeout_s offline_eval_runner_restore_timeout_s",
        _OFFLINE,
    ),
    # offline_data
    **_each(
        "input_ offline_data_class input_read_method input_read_method_kwargs input_read_schema input_read_episodes "
        "input_read_sample_batches input_read_batch_size input_filesystem input_filesystem_kwargs "
        "input_compress_columns materialize_data materialize_mapped_data map_batches_kwargs iter_batches_kwargs "
        "ignore_final_observation prelearner_class prelearner_buffer_class prelearner_buffer_kwargs "
        "prelearner_module_synch_period prelearner_use_recorded_module_states dataset_num_iters_per_learner "
        "input_config actions_in_input_normalized postprocess_inputs shuffle_buffer_size offline_sampling",
        _OFFLINE,
    ),
    **_each(
        "output output_config output_compress_columns output_max_file_size output_max_rows_per_file "
        "output_write_remaining_data output_write_method output_write_method_kwargs output_filesystem "
        "output_filesystem_kwargs output_write_episodes",
        "there are no episodes to write; a callback on_sample_end gets all that is sampled (docs/callbacks.md)",
    ),
    # multi_agent, reporting, checkpointing, debugging, fault_tolerance, experimental
    **_each("policies_to_train", "all agents of the team are trained"),
    **_each("policy_map_capacity policy_states_are_swappable observation_fn", _OLD),
    **_each("count_steps_by", "steps are env steps, of the whole team"),
    **_each(
        "keep_per_episode_custom_metrics",
        "it belongs to RLlib's old API stack; log single values in a callback with metrics_logger.log_value(..., "
        'reduce="item_series")',
    ),
    **_each("metrics_episode_collection_timeout_s fake_sampler export_native_model_files", _OLD),
    **_each("log_gradients", "gradients are not reported; a learner of your own can log them"),
    **_each("checkpoint_trainable_policies_only", "all policies are trained"),
    **_each(
        "_use_msgpack_checkpoints _disable_preprocessor_api _disable_action_flattening "
        "_disable_initialize_loss_from_dummy_batch",
        _OLD,
    ),
    **_each("_tf_policy_handles_more_than_one_loss", _TENSORFLOW),
    **_each("_torch_grad_scaler_class", "updates are in single precision"),
    **_each("_torch_lr_scheduler_classes", "use a schedule, actor_lr=[[0, 1e-3], [100_000, 1e-4]]"),
}
"""Settings of RLlib that are errors when set away from their defaults, and what to use instead."""

IN_EVALUATION: frozenset[str] = frozenset(
    "env env_config explore exploration algorithm_config_overrides_per_module seed env_runner_cls "
    "num_envs_per_env_runner create_env_on_local_worker num_cpus_per_env_runner custom_resources_per_env_runner "
    "validate_env_runners_after_construction max_requests_in_flight_per_env_runner callbacks_class "
    "on_environment_created on_episode_created on_episode_start on_episode_step on_episode_end on_sample_end "
    "metrics_num_episodes_for_smoothing custom_stats_cls_lookup restart_failed_env_runners "
    "restart_failed_sub_environments ignore_env_runner_failures max_num_env_runner_restarts "
    "delay_between_env_runner_restarts_s num_consecutive_env_runner_failures_tolerance "
    "env_runner_health_probe_timeout_s".split()
)
"""Settings that do something in `evaluation_config`: those of the runners which evaluate."""

_NOT_IN_EVALUATION = {
    "num_env_runners": "use evaluation(evaluation_num_env_runners=...)",
    "rollout_fragment_length": "use evaluation(evaluation_duration=...)",
    "sample_timeout_s": "use evaluation(evaluation_sample_timeout_s=...)",
    "on_evaluate_start": "use callbacks(on_evaluate_start=...)",
    "on_evaluate_end": "use callbacks(on_evaluate_end=...)",
}

METHODS = (
    "python_environment resources framework api_stack environment env_runners learners training callbacks evaluation "
    "offline_data multi_agent reporting checkpointing debugging fault_tolerance rl_module experimental"
).split()
"""RLlib's methods that set settings."""

# Where RLlib keeps a setting under another name than that of the argument.
_ATTRIBUTES = {
    "framework": "framework_str",
    "is_atari": "_is_atari",
    "env_to_module_connector": "_env_to_module_connector",
    "module_to_env_connector": "_module_to_env_connector",
    "learner_connector": "_learner_connector",
    "learner_class": "_learner_class",
    "train_batch_size_per_learner": "_train_batch_size_per_learner",
    "model_config": "_model_config",
    "rl_module_spec": "_rl_module_spec",
    "custom_stats_cls_lookup": "stats_cls_lookup",
    "dataset_num_iters_per_offline_eval_runner": "dataset_num_iters_per_eval_runner",
}


def attribute_of(name: str) -> str:
    """The attribute of an `AlgorithmConfig` that holds a setting."""
    return f"callbacks_{name}" if name.startswith("on_") else _ATTRIBUTES.get(name, name)


def as_attributes(given: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by the names of RLlib's attributes, where they are given by those of its arguments."""
    known = {*HONOURED, *HARMLESS, *REFUSED}
    return {attribute_of(name) if name in known else name: value for name, value in given.items()}


def settings_of_method(method: str) -> list[str]:
    """The settings that one of RLlib's methods takes, but for those that RLlib itself has deprecated."""
    parameters = inspect.signature(getattr(AlgorithmConfig, method)).parameters
    return [n for n, p in parameters.items() if n != "self" and p.default != DEPRECATED_VALUE]


_NEEDS: dict[str, tuple[Callable[[JointConfig], bool], str]] = {
    "actor_lr": (lambda c: c.learner.has_actors, "{name} has no actors: its learning rate is critic_lr"),
    "action_regularization": (lambda c: c.learner.has_actors, "{name} has no actors"),
    "gumbel_temperature": (lambda c: c.learner.has_actors, "{name} has no actors"),
    "critic_state": (lambda c: c.uses_state, "neither critics nor a mixer of {name} see the state"),
    "state_layout": (
        lambda c: c.uses_state and c.critic_state == "world",
        'what the world state is made of needs critic_state="world", and an algorithm that sees the state',
    ),
    "seq_length": (lambda c: c.recurrent, "the length of windows needs a recurrent actor, e.g. actor='lstm'"),
    "target_noise_clip": (lambda c: bool(vars(c)["target_noise"]), "the bound of target_noise needs target_noise > 0"),
    "grad_clip_by": (lambda c: c.grad_clip is not None, "how gradients are clipped needs grad_clip"),
}
"""Settings of ours that have an effect only with others: when, and what the error says."""


def changed(config: JointConfig) -> Iterator[tuple[str, Any, Any]]:
    """Every attribute that is set away from its default: its name, its value and the default."""
    defaults = vars(type(config)())
    for name, value in vars(config).items():
        if name in defaults and not same(value, defaults[name]):
            yield name, value, defaults[name]


def without_effect(config: JointConfig) -> dict[str, str]:
    """The settings of ours that are set, but do nothing with this algorithm and its other settings; and why."""
    given = {name for name, _, _ in changed(config)}
    return {name: why for name, why in unheard(config).items() if name in given}


def unheard(config: JointConfig) -> dict[str, str]:
    """The settings of ours that would do nothing with this algorithm and its other settings, set or not; and why."""
    return {name: why.format(name=config.name) for name, (has_effect, why) in _NEEDS.items() if not has_effect(config)}


def plain(value: Any) -> Any:
    """The number that a NumPy scalar is; anything else as it is."""
    return value.item() if isinstance(value, np.generic) else value


def checked(config: JointConfig, given: Mapping[str, Any]) -> dict[str, Any]:
    """What one of RLlib's methods is given, checked before RLlib calculates with it, and plain.

    Raises:
        ValueError: If a value is not legal; says what is.
    """
    owner = type(config).__name__
    values = {name: plain(value) for name, value in given.items()}
    for name, value in values.items():
        if name in config.legal and value is not NotProvided:
            values[name] = check_value(value, config.legal[name], name, owner)
            if name in _RATES:
                check_schedule(name, value)
    return values


def check_values(config: JointConfig) -> None:
    """Checks each setting by itself, and makes NumPy's scalars the numbers that they are.

    Raises:
        ValueError: If a value is not legal; says what is.
    """
    for name, value in list(vars(config).items()):
        if isinstance(value, np.generic):
            setattr(config, name, plain(value))
    for name, hint in config.legal.items():
        attribute = _ATTRIBUTES.get(name, name)
        setattr(config, attribute, check_value(getattr(config, attribute), hint, name, type(config).__name__))
    for name in _RATES:
        check_schedule(name, getattr(config, name, 0.0))


_RATES = ("actor_lr", "critic_lr")


def check_schedule(name: str, rate: Any) -> None:
    """Raises a ValueError unless a learning rate that is a list is a schedule of RLlib's, of no numbers below zero."""
    if not isinstance(rate, list):
        return
    try:
        legal = all(step >= 0 and math.isfinite(value) and value >= 0 for step, value in rate) and rate[0][0] == 0
    except (TypeError, ValueError, IndexError):
        legal = False
    if not legal:
        raise ValueError(
            f"{name}={rate} is illegal; legal: a number > 0, or a schedule [[0, 1e-3], [100000, 1e-4], ...] of env "
            f"steps and numbers >= 0 that begins with step 0."
        )


def check_is_no_part(config: JointConfig, name: str) -> None:
    """Raises a ValueError for the name of what a configuration does or is, and not of a setting."""
    if name not in vars(config) and (name in dir(object) or callable(getattr(type(config), name, None))):
        raise ValueError(
            f"{name!r} is part of {type(config).__name__}, not a setting: give the settings by their names."
        )


def check_known(config: JointConfig) -> None:
    """Checks that there is no setting that nobody knows, and none that would do nothing.

    Raises:
        ValueError: If there is one; says what to use instead.
    """
    defaults = vars(type(config)())
    for name in vars(config):
        if name in defaults or name in _FILLED_IN or name.startswith("__"):  # Tune's own begin so
            continue
        check_is_no_part(config, name)
        raise ValueError(unknown(config, name))
    refused = {attribute_of(name): (name, why) for name, why in REFUSED.items()}
    for name, value, default in changed(config):
        # RLlib itself changes `batch_mode` of an evaluation.
        if name in refused and not (config.in_evaluation and name == "batch_mode"):
            setting, why = refused[name]
            raise ValueError(f"{setting} must be {default!r}, not {value!r}: {why}.")
    for name, why in without_effect(config).items():
        default = defaults[name]
        raise ValueError(f"{name} must be {default!r}, not {getattr(config, name)!r}: {why}.")


# What RLlib and this package note down in a configuration.
_FILLED_IN = ("team", "module_ids", "class", "worker_index")


def unknown(config: JointConfig, name: str) -> str:
    """What is said of a setting that an algorithm does not have: whose it is, or which may be meant."""
    from rllib_maobs.algorithms.registry import ALGORITHMS

    owners = [other for other, cls in ALGORITHMS.items() if name in cls.legal]
    legal = [legal for legal in (*vars(type(config)()), *config.legal) if legal[0] != "_"]
    if config.name in owners:
        return f"{name} is given by training({name}=...)."
    hint = f"; it is one of {', '.join(owners)}" if owners else closest(name, legal)
    return f"{type(config).__name__} has no setting {name!r}{hint}."


def check_evaluation(config: JointConfig) -> None:
    """Checks the settings that evaluation is to have otherwise than training.

    Raises:
        ValueError: If one of them is unknown, or not legal, or would do nothing there.
    """
    evaluation: JointConfig = config.get_evaluation_config_object()
    check_values(evaluation)
    check_known(evaluation)
    legal = {attribute_of(name) for name in (*IN_EVALUATION, *HARMLESS)}
    for name, value in as_attributes(config.evaluation_config or {}).items():
        if name not in legal and not same(value, getattr(config, name, None)):
            setting = name.removeprefix("callbacks_")
            instead = _NOT_IN_EVALUATION.get(setting, "evaluation has its runners' settings alone for itself")
            raise ValueError(
                f"evaluation_config sets {setting}={value!r}, which has no effect there: {instead}; legal are "
                f"{', '.join(sorted(IN_EVALUATION))}."
            )


def check_arguments(config: JointConfig, given: Mapping[str, Any]) -> None:
    """Checks the names of what `training()` was given besides its own arguments.

    Raises:
        ValueError: For a name that RLlib's `training()` does not take, either.
    """
    for name in given:
        if name not in inspect.signature(AlgorithmConfig.training).parameters:
            raise ValueError(unknown(config, name))


def settings_table() -> str:
    """What becomes of every setting of RLlib, as Markdown; the page docs/rllib_settings.md."""
    lines = []
    for method in METHODS:
        lines += [f"## config.{method}()", "", "| setting | | |", "|---|---|---|"]
        for name in settings_of_method(method):
            if name in HONOURED:
                lines.append(f"| `{name}` | honoured | {HONOURED[name]} |")
            elif name in HARMLESS:
                lines.append(f"| `{name}` | no meaning | {HARMLESS[name]} |")
            else:
                lines.append(f"| `{name}` | refused | {REFUSED[name]} |")
        lines.append("")
    return "\n".join(lines)
