"""Every setting of RLlib does what it says or is refused, and so is what nobody knows or what would do nothing."""

import inspect
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.rl_module import MultiRLModuleSpec, RLModuleSpec
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.torch.torch_rl_module import TorchRLModule
from ray.rllib.policy.policy import PolicySpec
from ray.rllib.utils.metrics import NUM_ENV_STEPS_TRAINED_LIFETIME

import rllib_maobs as maobs
from rllib_maobs.algorithms import settings
from tests.conftest import ALGORITHMS, build_learner, small_config
from tests.test_runner import TwoAgents, runner_of, sample

PAGE = Path(__file__).parent.parent / "docs" / "rllib_settings.md"
EVERY = [(method, name) for method in settings.METHODS for name in settings.settings_of_method(method)]
DECIDED = (settings.HONOURED, settings.HARMLESS, settings.REFUSED)

# The table.


def test_rllib_has_no_method_and_no_setting_that_is_not_decided() -> None:
    fluent = {
        name
        for name, method in vars(AlgorithmConfig).items()
        if callable(method) and name[0] != "_" and "Self" in str(getattr(method, "__annotations__", {}).get("return"))
    }
    fluent -= {"copy", "from_dict", "from_state", "update_from_dict", "get_config_for_module"}
    assert fluent == set(settings.METHODS)
    assert not [name for _, name in EVERY if sum(name in table for table in DECIDED) != 1]


def test_nothing_is_decided_that_rllib_does_not_have() -> None:
    names, attributes = {name for _, name in EVERY}, vars(AlgorithmConfig())
    assert set().union(*DECIDED) == names
    assert not [name for name in names if settings.attribute_of(name) not in attributes]


def test_the_page_is_the_table() -> None:
    assert PAGE.read_text().endswith(settings.settings_table())


def test_what_is_refused_is_refused_away_from_its_default() -> None:
    for name in settings.REFUSED:
        config = maobs.MADDPGConfig().environment("maobs/spread-3a")
        setattr(config, settings.attribute_of(name), ["another"])
        with pytest.raises(ValueError, match=rf"^{name} must be .*, not \['another'\]: \w.*\.$"):
            config.validate()


def test_what_has_no_meaning_may_be_given() -> None:
    config = maobs.MADDPGConfig().environment("maobs/spread-3a")
    for name in settings.HARMLESS:
        value = getattr(config, settings.attribute_of(name))
        setattr(config, settings.attribute_of(name), not value if isinstance(value, bool) else value)
    config.env_runners(episodes_to_numpy=False, episode_lookback_horizon=7, merge_env_runner_states=False)
    config.validate()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_defaults_are_never_refused(algorithm: str) -> None:
    config = maobs.ALGORITHMS[algorithm]()
    config.environment("maobs/spread-3a", env_config={"action_mode": "discrete"})
    config.validate()
    config.copy(copy_frozen=False).validate()
    evaluation = config.get_evaluation_config_object()
    evaluation.validate()
    assert evaluation.batch_mode != config.batch_mode  # which is RLlib's doing, and no error


@pytest.mark.parametrize(
    ("given", "explores"), [(None, False), ({"num_envs_per_env_runner": 3}, False), ({"explore": True}, True)]
)
def test_evaluation_explores_only_if_told_to(given: dict[str, Any] | None, explores: bool) -> None:
    config = maobs.MADDPGConfig().environment("maobs/spread-3a").evaluation(evaluation_config=given)
    assert config.get_evaluation_config_object().explore is explores
    assert config.explore is True
    config.validate()


# Wrong settings, in one sentence each.


class Foreign(TorchRLModule):
    """An RLModule that knows nothing of this package."""


def named(*agents: str) -> Any:
    class Named(TwoAgents):
        def __init__(self, config: dict[str, Any]) -> None:
            super().__init__(config)
            for spaces in (self.observation_spaces, self.action_spaces):
                spaces |= dict(zip(agents, list(spaces.values()), strict=True))
            self.agents = self.possible_agents = list(agents)

    return Named


@pytest.mark.parametrize(
    ("algorithm", "change", "message"),
    [
        ("maddpg", lambda c: c.training(lr=0.5), r"^lr must be 0.001, not 0.5: use actor_lr and critic_lr\.$"),
        ("maddpg", lambda c: c.training(num_epochs=7), r"^num_epochs must be 1, not 7: use training\(updates_per_env"),
        ("maddpg", lambda c: c.environment(clip_rewards=True), r"^clip_rewards must be None, not True: use training"),
        ("maddpg", lambda c: c.evaluation(evaluation_config={"lr": 0.5}), r"^lr must be 0.001, not 0.5"),
        # What nobody knows.
        ("maddpg", lambda c: c.training(actor_lrr=1.0), r"MADDPGConfig has no setting 'actor_lrr' \(.*'actor_lr'\?\)"),
        ("maddpg", lambda c: setattr(c, "actor_lrr", 1.0), r"has no setting 'actor_lrr' \(did you mean 'actor_lr'"),
        ("maddpg", lambda c: c.update_from_dict({"taau": 1.0}), r"has no setting 'taau' \(did you mean 'tau'"),
        ("maddpg", lambda c: c.evaluation(evaluation_config={"exploer": False}), r"no setting 'exploer' .*'explore'"),
        # What would do nothing in an evaluation.
        *(
            (
                "maddpg",
                lambda c, name=name, value=value: c.evaluation(evaluation_config={name: value}),
                rf"^evaluation_config sets {name}={value}, which has no effect there: {instead}.*; legal are .*explore",
            )
            for name, value, instead in (
                ("gamma", 0.5, "evaluation has its runners' settings alone"),
                ("actor_lr", 0.5, "evaluation has its runners' settings alone"),
                ("normalize_observations", True, "evaluation has its runners' settings alone"),
                ("num_env_runners", 2, r"use evaluation\(evaluation_num_env_runners"),
                ("rollout_fragment_length", 7, r"use evaluation\(evaluation_duration"),
            )
        ),
        (
            "maddpg",
            lambda c: c.evaluation(evaluation_config={"seed": -1}),
            r"seed=-1 is illegal; legal: an integer >= 0",
        ),
        # What is too large.
        (
            "maddpg",
            lambda c: c.training(n_step=10**6),
            r"n_step=1000000 is illegal; legal: an integer >= 1 and <= 1000",
        ),
        (
            "maddpg",
            lambda c: c.training(n_step=101, replay_buffer_capacity=100, train_batch_size_per_learner=10),
            r"^n_step \(101\) must not be larger than replay_buffer_cap",
        ),
        (
            "maddpg",
            lambda c: c.env_runners(num_envs_per_env_runner=10**6),
            r"^num_envs_per_env_runner \(1000000\) times rollout_fragment_length \(1\) must not be .*\(5000\)",
        ),
        # Functions.
        (
            "maddpg",
            lambda c: c.multi_agent(policies={"x"}, policy_mapping_fn=lambda agent: "x"),
            r"^policy_mapping_fn can't be called as RLlib does, with 2 arguments \(str, NoneType\): too many",
        ),
        (
            "maddpg",
            lambda c: c.multi_agent(policies={"x"}, policy_mapping_fn=lambda agent, *a, **k: 3),
            r"^policy_mapping_fn must return names of policies \(strings\), not 3",
        ),
        (
            "maddpg",
            lambda c: c.callbacks(int),
            r"^callbacks_class must be a subclass of RLlibCallback, .* not <class 'i",
        ),
        (
            "maddpg",
            lambda c: c.callbacks(on_episode_end=[3]),
            r"^callbacks_on_episode_end must be a function, .* not 3",
        ),
        (
            "maddpg",
            lambda c: c.environment(object),
            r"^Unknown environment <class 'object'>; legal are maobs/.*, or an environment class",
        ),
        (
            "maddpg",
            lambda c: c.environment(type("NoConfig", (TwoAgents,), {"__init__": lambda self: None})),
            r"^NoConfig can't be called with env_config \(.*\): legal is a class whose constructor takes it",
        ),
        ("maddpg", lambda c: c.environment("maobs/spread9a"), r"spread9a' \(did you mean 'maobs/spread-9a'\?\); legal"),
        (
            "maddpg",
            lambda c: c.rl_module(model_config={"hidden_sizes": (60_000, 60_000)}),
            r"^The networks take .* GB while they learn, and there are .* GB: make them smaller",
        ),
        (
            "maddpg",
            lambda c: c.rl_module(model_config={"hidden_sizes": (10**9,)}),
            r"must be positive integers, .*: up to 65536 units in up to 100 layers",
        ),
        ("maddpg", lambda c: c.training(double_q=True), r"has no setting 'double_q'; it is one of iql, vdn, qmix\.$"),
        ("qmix", lambda c: c.training(critic_source="own"), r"QMIXConfig has no setting 'critic_source'; .* facmac\.$"),
        # What does nothing with this algorithm, or without another setting.
        ("iddpg", lambda c: c.training(critic_state="world"), r"^critic_state must be 'observations', .* of iddpg see"),
        ("vdn", lambda c: c.training(critic_state="world"), r"^critic_state must be 'observations', .* of vdn see"),
        ("maddpg", lambda c: c.training(seq_length=3), r"^seq_length must be 5, not 3: .* needs a recurrent actor"),
        (
            "iql",
            lambda c: c.training(actor_lr=0.5),
            r"^actor_lr must be 0.001, not 0.5: iql has no actors: .*critic_lr",
        ),
        (
            "qmix",
            lambda c: c.training(gumbel_temperature=0.5),
            r"^gumbel_temperature must be 1.0, .* qmix has no actors",
        ),
        ("maddpg", lambda c: c.training(gumbel_temperature=0.5), r"^gumbel_temperature must be 1.0, .* are continuous"),
        ("maddpg", lambda c: c.training(target_noise_clip=0.1), r"^target_noise_clip must be 0.5, .* target_noise > 0"),
        (
            "maddpg",
            lambda c: c.training(grad_clip_by="value"),
            r"^grad_clip_by must be 'global_norm', .* needs grad_clip",
        ),
        (
            "maddpg",
            lambda c: c.training(state_layout=[("a", 1, 22)]),
            r'^state_layout must .* needs critic_state="world"',
        ),
        # Networks.
        (
            "maddpg",
            lambda c: c.rl_module(model_config={"lstm_cell_size": 8}),
            r"'lstm_cell_size'\] has no effect: MLPAct",
        ),
        (
            "maddpg",
            lambda c: c.rl_module(model_config={"hidden_sizes": 8}),
            r"hidden_sizes'\] must be positive integers",
        ),
        (
            "maddpg",
            lambda c: c.rl_module(model_config=DefaultModelConfig()),
            r"^model_config must be a dict with some of",
        ),
        (
            "maddpg",
            lambda c: c.rl_module(rl_module_spec=RLModuleSpec(model_config={"fcnet_hiddens": [8]})),
            r"^The RLModuleSpec sets 'fcnet_hiddens'.*; legal are hidden_sizes",
        ),
        (
            "maddpg",
            lambda c: c.rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs={"agent_0": RLModuleSpec(Foreign)})),
            r"^The RLModuleSpec of policy 'agent_0' has module_class Foreign, which lacks .*acting, .*make_target_net",
        ),
        (
            "maddpg",
            lambda c: c.learners(learner_class=object),
            r"^learner_class must be a JointLearner, not <class 'obj",
        ),
        # Agents' names.
        ("maddpg", lambda c: c.environment(named("mixer", "b"), env_config={}), r"^No policy can be called 'mixer'"),
        ("maddpg", lambda c: c.environment(named("__all_modules__", "b"), env_config={}), r"can be called '__all_mod"),
        ("maddpg", lambda c: c.environment(named("a/b", "b"), env_config={}), r"PolicyID `a/b` not valid"),
    ],
)
def test_wrong_settings_end_in_a_sentence(ray_session: None, algorithm: str, change: Any, message: str) -> None:
    config = small_config(algorithm)
    with pytest.raises(ValueError, match=message):
        change(config)
        config.validate()


WRONG = ("x", None, [1], {"learner": 3}, -1, float("nan"), 3.5, True, object)
OURS = [
    ("training", name)
    for name in inspect.signature(maobs.JointConfig.training).parameters
    if name not in ("self", "kwargs")
]


@pytest.mark.parametrize(
    ("method", "name"), [(m, n) for m, n in EVERY if n in settings.HONOURED] + OURS, ids=lambda value: value
)
def test_values_of_a_wrong_type_end_in_a_sentence(method: str, name: str) -> None:
    """Each is legal, or one sentence; whoever it says it, ourselves or RLlib."""
    refused = 0
    for value in WRONG:
        config = maobs.FACMACConfig().environment("maobs/spread-3a")
        try:
            getattr(config, method)(**{name: value})
            config.validate()
        except ValueError as error:  # any other error fails the test
            refused += 1
            # RLlib names a wrong policy instead of the setting, and some parts of ours the wrong key.
            assert any(word in str(error) for word in (name, "learner", "PolicyID")), error
    assert refused >= 4


def test_unknown_names_in_a_param_space_are_refused(ray_session: None) -> None:
    with pytest.raises(ValueError, match=r"has no setting 'actor_lrr' \(did you mean 'actor_lr'\?\)"):
        maobs.ALGORITHMS["maddpg"]().algo_class(config={"env": "maobs/spread-3a", "actor_lrr": 1e-3})


def test_what_a_machine_lacks_is_named(ray_session: None, monkeypatch: pytest.MonkeyPatch) -> None:
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match=r"num_gpus_per_learner must be 0 where PyTorch finds no GPU, not 1"):
            small_config("maddpg").learners(num_gpus_per_learner=1).build_algo()
    monkeypatch.setenv("CXX", "no-such-compiler")
    message = r"no 'no-such-compiler' on the PATH: .*apt install g\+\+.*torch_compile_learner=False.*--no-compile"
    with pytest.raises(ValueError, match=message):
        small_config("maddpg").framework(torch_compile_learner=True).build_algo()


def test_a_number_is_a_number(ray_session: None) -> None:
    config = small_config("maddpg", horizon=np.int64(5))
    config.training(
        actor_lr=np.float32(1e-3),
        gamma=np.float64(0.9),
        grad_clip=np.float32(1.0),
        train_batch_size_per_learner=np.int64(8),
        twin_critics=np.bool_(True),
    )
    config.env_runners(num_env_runners=np.int64(0), num_envs_per_env_runner=np.int32(2))
    config.env_runners(rollout_fragment_length=np.int64(2)).debugging(seed=np.int64(3))
    config.rl_module(model_config={"hidden_sizes": (np.int64(8),)})
    config.evaluation(evaluation_interval=np.int64(1), evaluation_duration=np.int64(2))
    algo = config.build_algo()
    assert algo.train()["evaluation"]["env_runners"]["num_episodes"] == 2
    assert algo.config.twin_critics is True and type(algo.config.num_envs_per_env_runner) is int
    algo.stop()


# What is honoured has its effect.


def test_evaluation_is_as_long_as_it_is_asked_to_be(ray_session: None) -> None:
    config = small_config("iddpg", horizon=10).evaluation(
        evaluation_interval=1, evaluation_duration=30, evaluation_duration_unit="timesteps"
    )
    algo = config.build_algo()
    assert algo.train()["evaluation"]["env_runners"]["num_env_steps_sampled"] == 30
    algo.stop()


def test_evaluation_beside_training_by_more_runners_than_episodes(ray_session: None) -> None:
    config = small_config("facmac", horizon=10).resources(num_cpus_for_main_process=0)
    config.evaluation(evaluation_interval=1, evaluation_duration=1, evaluation_num_env_runners=2)
    algo = config.evaluation(evaluation_parallel_to_training=True).build_algo()
    start = time.monotonic()
    result = algo.train()
    assert result["evaluation"]["env_runners"]["num_episodes"] == 1
    assert algo.eval_env_runner_group.num_healthy_remote_workers() == 2
    assert time.monotonic() - start < 30  # which the loss of a runner would take
    # Weights that are set reach all of them, even while others are on their way.
    weights, state = algo.get_weights(), algo.get_state()
    want = algo._learner.acting.flat.detach().clone()
    for restore in (lambda: algo.set_weights(weights), lambda: algo.set_state(state)):
        algo.train()
        algo.evaluate()
        restore()
        acting = algo.eval_env_runner_group.foreach_env_runner(
            lambda runner: runner.acting.actors.flat.detach().clone(), local_env_runner=False
        )
        assert len(acting) == 2 and all(torch.equal(weights_of_one, want) for weights_of_one in acting)
    algo.stop()


@pytest.mark.parametrize("episodes", [1, 3])
def test_means_are_over_as_many_episodes_as_are_asked_for(ray_session: None, episodes: int) -> None:
    config = small_config("iddpg", horizon=5).env_runners(num_envs_per_env_runner=1)
    runner = runner_of(config.reporting(metrics_num_episodes_for_smoothing=episodes))
    rewards = sample(runner, num_timesteps=20).rewards.reshape(4, -1)
    results = runner.get_metrics()
    assert results["episode_return_mean"].peek() == pytest.approx(rewards[-episodes:].sum(1).mean())


def test_reporting_and_callbacks_are_honoured(ray_session: None) -> None:
    calls: list[str] = []
    config = small_config("iddpg", horizon=10).rl_module(model_config={"hidden_sizes": (8,)})
    config.reporting(min_train_timesteps_per_iteration=800)
    config.callbacks(
        on_algorithm_init=lambda **kwargs: calls.append("init"),
        on_train_result=lambda **kwargs: calls.append("result"),
        on_evaluate_start=lambda **kwargs: calls.append("start"),
        on_evaluate_end=lambda **kwargs: calls.append("end"),
    )

    def evaluate(algo: Any, runners: Any) -> tuple[dict[str, Any], int, int]:
        runners.local_env_runner.sample(num_episodes=3)
        metrics = runners.local_env_runner.get_metrics()
        algo.metrics.aggregate([metrics], key=("evaluation", "env_runners"))
        stats = {"num_episodes": metrics["num_episodes"]}
        return {"episodes": 3 * calls.count("start"), "words": "three", "of_runner": stats}, np.int64(30), 90

    config.evaluation(evaluation_interval=1, custom_evaluation_function=evaluate)
    algo = config.build_algo()
    algo.train()
    result = algo.train()
    assert result["learners"]["__all_modules__"][NUM_ENV_STEPS_TRAINED_LIFETIME] >= 800
    assert {name: result["evaluation"][name] for name in ("episodes", "words", "of_runner")} == {
        "episodes": 3 * calls.count("start"),  # what the function returns, not what it returned before
        "words": "three",
        "of_runner": {"num_episodes": 3},
    }
    assert result["evaluation"]["env_runners"]["num_episodes"] == 3
    assert calls == ["init", *["start", "end", "result"] * 2]
    algo.config._is_frozen = False
    algo.config.custom_evaluation_function = lambda algo, runners: {"episodes": 3}
    with pytest.raises(ValueError, match=r"custom_evaluation_function returns {'episodes': 3}; legal are metrics"):
        algo.evaluate()
    algo.stop()


# Restoring, and RLlib's own methods.


def test_a_restored_run_has_the_learning_rates_of_its_configuration(ray_session: None, tmp_path: Path) -> None:
    """What Tune's population-based training does: a checkpoint goes on under another configuration."""
    schedule = [[0, 1e-3], [1000, 1e-5]]
    algo = small_config("maddpg").training(critic_lr=schedule).build_algo()
    algo.train()
    path = algo.save_to_path(tmp_path / "checkpoint")
    other = small_config("maddpg").training(critic_lr=schedule, actor_lr=1e-9).build_algo()
    other.restore_from_path(path)
    before = [algo._learner._roles[role].flat.detach().clone() for role in ("actor", "critic")]
    rates = {name: o.param_groups[0]["lr"] for name, o in other._learner._named_optimizers.items()}
    assert rates["__all_modules___actor"] == 1e-9
    assert rates["__all_modules___critic"] == pytest.approx(1e-3 - 40 / 1000 * (1e-3 - 1e-5))
    other.train()
    after = [other._learner._roles[role].flat.detach() for role in ("actor", "critic")]
    assert (after[0] - before[0]).abs().max() < 1e-6 < 1e-4 < (after[1] - before[1]).abs().max()
    algo.stop()
    other.stop()


def test_weights_that_are_set_are_acted_with(ray_session: None) -> None:
    algo = small_config("facmac").build_algo()
    algo.train()
    weights, state = algo.get_weights(), algo.get_state()
    want = algo._learner.acting.flat.detach().clone()
    for restore in (lambda: algo.set_weights(weights), lambda: algo.set_state(state)):
        algo.train()
        assert not torch.equal(algo._learner.acting.flat, want)
        restore()
        assert torch.equal(algo._learner.acting.flat, want)
        assert algo.env_runner.acting.actors.flat.data_ptr() == algo._learner.acting.flat.data_ptr()
    algo.stop()


def test_methods_of_the_old_stack_show_the_way(ray_session: None) -> None:
    algo = small_config("iddpg").build_algo()
    for method in ("get_policy", "compute_single_action", "compute_actions", "add_policy", "remove_policy"):
        with pytest.raises(NotImplementedError, match=r"algo.get_module\('agent_0'\), and act with module.forward_inf"):
            getattr(algo, method)(np.zeros(18))
    with pytest.raises(NotImplementedError, match="team's modules are fixed"):
        algo.add_module("agent_9", RLModuleSpec())
    with pytest.raises(ValueError, match=r"evaluate\(\) needs runners of its own: config.evaluation\("):
        algo.evaluate()
    algo.stop()


def test_policies_differ_in_exploration_and_nothing_else(ray_session: None) -> None:
    config = small_config("maddpg")
    config.rl_module(algorithm_config_overrides_per_module={"agent_1": {"actor_lr": 1e-4}})
    with pytest.raises(
        ValueError, match=r"\['agent_1'\] sets \['actor_lr'\]; policies may differ in exploration alone"
    ):
        config.build_algo()
    overrides = {"agent_1": maobs.JointConfig.overrides(exploration={"noise": 0.7})}
    learner = build_learner(small_config("maddpg").rl_module(algorithm_config_overrides_per_module=overrides))
    assert [learner.module[m].exploration.noise for m in learner.config.module_ids] == [0.1, 0.7, 0.1]


def test_settings_have_two_names_in_a_param_space() -> None:
    config = small_config("iddpg")
    config.update_from_dict({"model_config": {"hidden_sizes": (8,)}, "on_episode_end": print})
    assert config._model_config == {"hidden_sizes": (8,)} and config.callbacks_on_episode_end is print


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"training": {"actor_lr": 5.0}},
            "'training' is part of IDDPGConfig, not a setting",
        ),
        ({"_foo": 1}, "IDDPGConfig has no setting '_foo'"),
        ({"explore": "no"}, "explore='no' is illegal; legal: True or False"),
        ({"evaluation_interval": 1.5}, "evaluation_interval=1.5 is illegal; legal: an integer >= 0"),
        ({"actor_lr": [[0, float("nan")], [10, 1e-4]]}, "actor_lr=.* is illegal; legal: a number > 0, or a schedule"),
        ({"critic_lr": [[5, 1e-3]]}, "critic_lr=.* is illegal; legal: .* that begins with step 0"),
    ],
)
def test_what_is_no_setting_or_no_legal_value_is_named(given: dict[str, Any], message: str) -> None:
    config = small_config("iddpg")
    with pytest.raises(ValueError, match=message):
        config.update_from_dict(given)
        config.validate()


def test_policies_need_a_mapping_and_a_mapping_holds_whatever_they_are_called() -> None:
    shared = small_config("iddpg").multi_agent(
        policies={"default_policy"}, policy_mapping_fn=lambda agent, *args, **kwargs: "default_policy"
    )
    shared.validate()
    assert shared.module_ids == ("default_policy",) * 3  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=r"agents are mapped to .'agent_0': 'x', 'agent_1': 'x'"):
        small_config("iddpg").multi_agent(policy_mapping_fn=lambda agent, *args, **kwargs: "x").validate()
    with pytest.raises(ValueError, match=r"has \['a', 'b'\], but no policy_mapping_fn: say which agent has which"):
        small_config("iddpg").multi_agent(policies={"a", "b"}).validate()
    agents = {agent: PolicySpec(config={"actor_lr": 3.0}) for agent in ("agent_0", "agent_1", "agent_2")}
    own = small_config("iddpg").multi_agent(policies=agents, policy_mapping_fn=lambda agent, *args, **kwargs: agent)
    with pytest.raises(ValueError, match=r"has a config, .*, which RLlib's new API stack does not read"):
        own.validate()


def test_what_a_restored_run_is_told_anew_holds_from_there_on(ray_session: None, tmp_path: Path) -> None:
    def config(**options: Any) -> Any:
        config = small_config("iddpg", **options).training(num_steps_sampled_before_learning_starts=16)
        config.training(train_batch_size_per_learner=8).env_runners(num_envs_per_env_runner=2)
        return config.reporting(min_sample_timesteps_per_iteration=32)

    algo = config(horizon=5).build_algo()
    for _ in range(4):
        algo.train()
    path = algo.save_to_path(str(tmp_path))
    assert algo._progress["updates"] == 112
    with pytest.raises(ValueError, match=r"There are no weights 'agent_9'; modules are"):
        algo.set_weights({"agent_9": {}})
    with pytest.raises(ValueError, match=r"There are no weights 'agent_0.x'"):
        algo.set_weights({"agent_0": {"x": 1}})
    algo.stop()
    other = config(horizon=8).training(updates_per_env_step=0.25).build_algo()
    other.restore_from_path(path)
    lengths = [other.train()["env_runners"]["episode_len_mean"] for _ in range(3)]
    assert lengths[-1] == 8.0
    assert other._progress["updates"] == 3 * 32 // 4
    other.stop()


def test_remote_runners_do_not_repeat_the_first_episodes_after_a_restore(ray_session: None, tmp_path: Path) -> None:
    def first(runner: Any) -> list[float]:
        observed: list[float] = runner.sample()[0].obs[0, 0, 0].tolist()
        return observed

    config = small_config("iddpg").env_runners(num_env_runners=1, num_cpus_per_env_runner=0.5)
    algo = config.build_algo()
    path = algo.save_to_path(str(tmp_path))
    fresh = algo.env_runner_group.foreach_env_runner(first, local_env_runner=False)
    algo.restore_from_path(path)
    assert algo.env_runner_group.foreach_env_runner(first, local_env_runner=False) != fresh
    algo.stop()


def test_a_checkpoint_of_other_networks_or_exploration_is_named(ray_session: None, tmp_path: Path) -> None:
    algo = small_config("iddpg").build_algo()
    path = algo.save_to_path(str(tmp_path))
    algo.stop()
    noise = {"type": "ornstein-uhlenbeck"}
    for settings_, message in (({"twin_critics": True}, "RuntimeError"), ({"exploration": noise}, "KeyError")):
        other = small_config("iddpg").training(**settings_).build_algo()
        with pytest.raises(ValueError, match=f"was saved with other policies, networks.*{message}.*load_networks"):
            other.restore_from_path(path)
        other.stop()


def test_a_run_does_not_go_on_in_other_spaces(ray_session: None, tmp_path: Path, caplog: Any) -> None:
    """The same output of an actor would be another action, in silence."""

    def build(high: float = 1.0, size: int = 3) -> Any:
        class Other(TwoAgents):
            def __init__(self, config: dict[str, Any]) -> None:
                super().__init__(config)
                box = gym.spaces.Box(-high, high, (2,), np.float32)
                self.action_spaces = dict.fromkeys(self.agents, box)
                seen = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
                self.observation_spaces = dict.fromkeys(self.agents, seen)

        return small_config("iddpg").environment(Other, env_config={}).build_algo()

    algo = build()
    path, state = algo.save_to_path(str(tmp_path)), algo.get_state()
    algo.stop()
    for spaces, message in (({"high": 2.0}, r"Box\(-2.0, 2.0.*in the saved run.*-1.0, 1.0"), ({"size": 4}, r"\(4,\)")):
        other = build(**spaces)
        for restore in (lambda other=other: other.restore_from_path(path), lambda other=other: other.set_state(state)):
            with pytest.raises(ValueError, match=rf"^The spaces of agent '.*{message}.*load_networks"):
                restore()
        if "high" in spaces:
            with caplog.at_level("WARNING", "rllib_maobs"):
                maobs.load_networks(other, path)
            assert "the same output is another action" in caplog.text
        other.stop()
