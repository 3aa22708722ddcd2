"""Whole algorithms: update ratio, evaluation, checkpoints, remote runners, foreign environments, wrong settings."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
import torch
from gymnasium.spaces import Box, Discrete
from mpe2 import simple_spread_v3
from ray import tune
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.core.rl_module.rl_module import RLModule

import rllib_maobs as maobs
from rllib_maobs.modules import Seen
from rllib_maobs.replay import Batch
from tests.conftest import ALGORITHMS, small_config
from tests.test_runner import TwoAgents


def updates_of(algo: Algorithm) -> int:
    return int(algo.metrics.peek(("learners", "__all_modules__", "num_updates_lifetime"), default=0))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_training_reports_what_rllib_users_look_for(ray_session: None, algorithm: str) -> None:
    config = small_config(algorithm, horizon=10)
    config.evaluation(
        evaluation_interval=1,
        evaluation_duration=3,
        evaluation_config=maobs.JointConfig.overrides(env_config={"horizon": 20}, num_envs_per_env_runner=3),
    )
    algo = config.build_algo()
    start = algo._learner.acting.flat.detach().clone()
    result = algo.train()
    assert not torch.equal(algo._learner.acting.flat, start)
    assert result["num_env_steps_sampled_lifetime"] == 40
    sampled, evaluated = result["env_runners"], result["evaluation"]["env_runners"]
    assert sampled["num_episodes"] == 4 and evaluated["num_episodes"] == 3
    assert sampled["episode_len_mean"] == 10 and evaluated["episode_len_mean"] == 20
    by_agent = evaluated["agent_episode_returns_mean"]
    assert sum(by_agent.values()) == pytest.approx(evaluated["episode_return_mean"])
    assert 0 <= evaluated["episode_metrics"]["coverage"] <= 1
    assert result["learners"]["agent_0"]["critic_loss"] > 0
    assert result["learners"]["__all_modules__"]["num_updates_lifetime"] == 40 - 16
    assert "learner_update_timer" in result["timers"]
    algo.stop()


@pytest.mark.parametrize(
    ("copies", "fragment", "ratio"), [(1, 1, 1.0), (7, 3, 1.0), (64, 1, 1.0), (5, 4, 0.3), (3, 1, 2.5), (8, 16, 0.01)]
)
def test_updates_per_env_step_is_exact_over_time(ray_session: None, copies: int, fragment: int, ratio: float) -> None:
    config = small_config("iddpg")
    config.env_runners(num_envs_per_env_runner=copies, rollout_fragment_length=fragment)
    config.training(updates_per_env_step=ratio, num_steps_sampled_before_learning_starts=100)
    config.rl_module(model_config={"hidden_sizes": (8,)})
    config.reporting(min_sample_timesteps_per_iteration=1)
    algo = config.build_algo()
    steps = 0
    while steps < 500:
        steps = int(algo.train()["num_env_steps_sampled_lifetime"])
        assert algo._progress["updates"] == max(0, math.floor(ratio * (steps - 100)))
    assert updates_of(algo) == math.floor(ratio * (steps - 100))
    algo.stop()


def test_random_steps_come_first(ray_session: None) -> None:
    config = small_config("maddpg").training(num_random_steps=40, updates_per_env_step=0)
    algo = config.training(exploration={"epsilon": 0.0, "noise": 0.0}).build_algo()
    algo.train()
    algo.train()
    obs, actions = (algo.replay_buffer._columns[k][:80] for k in ("obs", "actions"))
    greedy = torch.tanh(algo.env_runner.acting.actors.respond(Seen(obs))[0])
    assert (actions - greedy)[:40].abs().mean() > 0.3
    assert actions[:40].std().item() == pytest.approx(1 / math.sqrt(3), abs=0.02)
    torch.testing.assert_close(actions[40:], greedy[40:])
    algo.stop()


@pytest.mark.parametrize(
    ("algorithm", "settings"),
    [*((name, {}) for name in ALGORITHMS)] + [(a, {"actor": "lstm", "stored_state": True}) for a in ("maddpg", "qmix")],
)
def test_a_restored_run_goes_on_exactly_as_the_first(
    ray_session: None, algorithm: str, settings: dict[str, Any], tmp_path: Path
) -> None:
    config = small_config(algorithm, horizon=15).training(**settings)
    config.evaluation(evaluation_interval=1, evaluation_duration=2)
    algo = config.build_algo()
    algo.train()
    path = algo.save_to_path(tmp_path / "checkpoint")
    restored = Algorithm.from_checkpoint(path)
    assert restored._learner.acting.flat.data_ptr() == restored.env_runner.acting.actors.flat.data_ptr()
    for _ in range(2):
        first, second = algo.train(), restored.train()
        for stacks, others in (
            (algo._learner._roles, restored._learner._roles),
            (algo._learner._targets, restored._learner._targets),
        ):
            for role, stack in stacks.items():
                assert torch.equal(stack.flat, others[role].flat)
        assert first["env_runners"]["episode_return_mean"] == second["env_runners"]["episode_return_mean"]
        assert first["num_env_steps_sampled_lifetime"] == second["num_env_steps_sampled_lifetime"]
    obs = np.random.default_rng(0).normal(size=(4, 18)).astype(np.float32)
    for agent in algo.config.module_ids:
        start = algo.get_module(agent).get_initial_state()
        batch = {"obs": obs, "state_in": {k: v.expand(4, *v.shape) for k, v in start.items()}}
        a, b = (x.get_module(agent).forward_inference(batch)["actions"] for x in (algo, restored))
        assert torch.equal(a, b)
    algo.stop()
    restored.stop()


def test_without_a_saved_buffer_learning_waits_until_it_is_refilled(ray_session: None, tmp_path: Path) -> None:
    algo = small_config("maddpg").training(store_buffer_in_checkpoints=False).build_algo()
    algo.train()
    path = Path(algo.save_to_path(tmp_path / "checkpoint"))
    assert not (path / "replay_buffer").exists()
    restored = Algorithm.from_checkpoint(str(path))
    assert len(restored.replay_buffer) == 0
    restored.train()
    progress = {"env_steps": 80, "learning_starts": 56, "updates": 24, "updates_per_env_step": 1.0}
    assert {name: restored._progress[name] for name in progress} == progress
    algo.stop()
    restored.stop()


def test_one_agent_leaves_a_checkpoint_in_three_lines(ray_session: None, tmp_path: Path) -> None:
    algo = small_config("maddpg").build_algo()
    algo.train()
    checkpoint = algo.save_to_path(tmp_path / "checkpoint")
    obs = np.random.default_rng(0).normal(size=(1, 18)).astype(np.float32)

    module = RLModule.from_checkpoint(f"{checkpoint}/learner_group/learner/rl_module/agent_0")
    action = module.forward_inference({"obs": obs})["actions"]

    assert action.shape == (1, 5) and action.abs().max() <= 1
    # Alone its weights lie in another order in memory, which moves the last digit.
    want = algo.get_module("agent_0").forward_inference({"obs": obs})["actions"]
    torch.testing.assert_close(action, want, rtol=0.0, atol=1e-6)
    algo.stop()


def test_remote_runners_sample_learn_and_survive_a_kill(ray_session: None) -> None:
    config = small_config("maddpg", horizon=10)
    config.env_runners(num_env_runners=1, num_envs_per_env_runner=4, rollout_fragment_length=5)
    algo = config.build_algo()
    result = algo.train()
    assert result["num_env_steps_sampled_lifetime"] == 40
    assert result["fault_tolerance"]["num_remote_worker_restarts"] == 0
    (weights,) = algo.env_runner_group.foreach_env_runner(
        lambda r: r.acting.actors.flat.detach().clone(), local_env_runner=False
    )
    assert torch.equal(weights, algo._learner.acting.flat)
    (actor,) = algo.env_runner_group._worker_manager.actors().values()
    ray.kill(actor, no_restart=False)
    steps = updates = 0
    for _ in range(20):
        result = algo.train()
        steps, updates = int(result["num_env_steps_sampled_lifetime"]), algo._progress["updates"]
        if steps >= 120:
            break
    assert steps >= 120 and updates == algo._progress["env_steps"] - 16
    algo.stop()


def test_a_foreign_parallel_env_is_trained(ray_session: None) -> None:
    tune.register_env("mpe2_spread", lambda _: simple_spread_v3.parallel_env(continuous_actions=True, max_cycles=8))
    config = small_config("maddpg-l").environment("mpe2_spread").training(critic_state="world")
    algo = config.build_algo()
    result = algo.train()
    assert result["env_runners"]["num_episodes"] == 4
    assert result["learners"]["__all_modules__"]["num_updates_lifetime"] == 24
    algo.stop()


def test_names_survive_a_restart_of_ray(ray_session: None, tmp_path: Path) -> None:
    maobs.register()
    maobs.register()
    config = small_config("maddpg-l").evaluation(evaluation_interval=1, evaluation_duration=1)
    results = tune.Tuner(
        "MADDPGL",
        param_space=config,
        run_config=tune.RunConfig(stop={"training_iteration": 2}, storage_path=str(tmp_path), verbose=0),
    ).fit()
    assert not results.errors
    assert results[0].metrics["num_env_steps_sampled_lifetime"] == 80


class MixedAgents(TwoAgents):
    def __init__(self, config: dict[str, Any]) -> None:
        super().__init__(config)
        self.action_spaces["right"] = Discrete(5)


class PictureAgents(TwoAgents):
    def __init__(self, config: dict[str, Any]) -> None:
        super().__init__(config)
        self.observation_spaces = dict.fromkeys(self.agents, Box(0.0, 1.0, (4, 4), np.float32))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: c.training(actor_lr=-1e-3),
            r"MADDPGConfig: actor_lr=-0.001 is illegal; legal: a number > 0 or a list",
        ),
        (lambda c: c.training(critic_lr=float("nan")), r"critic_lr=nan is illegal"),
        (lambda c: c.training(tau=1.5), r"tau=1.5 is illegal; legal: a number > 0 and <= 1"),
        (lambda c: c.training(gamma=float("inf")), r"gamma=inf is illegal; legal: a number >= 0 and <= 1"),
        (lambda c: c.training(updates_per_env_step=-1), r"updates_per_env_step=-1 is illegal; legal: a number >= 0"),
        (
            lambda c: c.training(train_batch_size_per_learner=0),
            r"train_batch_size_per_learner=0 is illegal; legal: an integer >= 1",
        ),
        (lambda c: c.training(train_batch_size_per_learner=9_000), r"\(9000\) must not be larger .*capacity \(5000\)"),
        (lambda c: c.training(num_steps_sampled_before_learning_starts=9_000), r"\(9000\) must not be larger"),
        (lambda c: c.training(critic_state="all"), r"critic_state='all' is illegal; legal: 'observations', 'world'"),
        (
            lambda c: c.training(other_agents_actions="mine"),
            r"other_agents_actions='mine' is illegal; legal: 'replay', 'current', 'joint'",
        ),
        (
            lambda c: c.training(exploration={"eps": 0.1}),
            r"EpsilonGaussian has no setting 'eps' .*'epsilon'.*; legal are epsilon, noise",
        ),
        (lambda c: c.training(grad_clip=0.0), r"grad_clip=0.0 is illegal; legal: a number > 0 or None"),
        (
            lambda c: c.training(grad_clip_by="max"),
            r"grad_clip_by='max' is illegal; legal: 'global_norm', 'norm', 'value'",
        ),
        (
            lambda c: c.training(actor="gru"),
            r"actor 'gru' is illegal.*; legal are 'mlp', 'lstm', .*, a subclass of Actor, or where",
        ),
        (lambda c: c.training(seq_length=0), r"seq_length=0 is illegal; legal: an integer >= 1"),
        (lambda c: c.training(seq_length=2.5), r"seq_length=2.5 is illegal; legal: an integer >= 1"),
        (lambda c: c.training(stored_state=True), r"stored_state=True needs a recurrent actor, .*'lstm'; 'mlp' has no"),
        (lambda c: c.training(carry_hidden=True), r"carry_hidden is now called stored_state"),
        (lambda c: c.training(n_step=0), r"n_step=0 is illegal; legal: an integer >= 1"),
        (lambda c: c.training(policy_delay=0), r"policy_delay=0 is illegal; legal: an integer >= 1"),
        (lambda c: c.training(gumbel_temperature=0.0), r"gumbel_temperature=0.0 is illegal; legal: a number > 0"),
        (lambda c: c.training(reward_scale=float("nan")), r"reward_scale=nan is illegal"),
        (lambda c: c.rl_module(model_config={"activation": "step"}), r"activation'\] must be one of 'relu', 'tanh'"),
        (lambda c: c.rl_module(model_config={"hidden_sizes": ()}), r"hidden_sizes'\] must be positive integers"),
        (lambda c: c.rl_module(model_config={"lstm_cell_size": 0}), r"lstm_cell_size'\] must be a positive integer"),
        (
            lambda c: c.rl_module(model_config={"hiden": (8,)}),
            r"model_config sets 'hiden' \(did you mean 'hidden_sizes'\?\); legal are",
        ),
        (lambda c: c.learners(num_learners=1), r"num_learners must be 0, not 1"),
        (
            lambda c: c.multi_agent(policies={"all", "none"}, policy_mapping_fn=lambda a, e, **k: "all"),
            r"must use every policy and no other: policies are \['all', 'none'\]",
        ),
        (
            lambda c: c.environment(TwoAgents, env_config={"sizes": (3, 4)}).multi_agent(
                policies={"all"}, policy_mapping_fn=lambda a, e, **k: "all"
            ),
            r"share policy 'all' must have spaces of equal size, not {'left': ",
        ),
        (lambda c: c.multi_agent(policies_to_train=["agent_0"]), r"policies_to_train must be None"),
        (
            lambda c: c.environment("maobs/spread-4a"),
            r"Unknown environment 'maobs/spread-4a' \(did you mean 'maobs/spread-9a'\?\); legal are maobs/",
        ),
        (lambda c: c.environment(None), r"No environment: set one with"),
        (lambda c: c.environment(env_config={"num_agnts": 4}), r"num_agnts.*num_agents"),
        (lambda c: c.environment(MixedAgents), r"'left' and 'right' must both be Box or both Discrete"),
        (lambda c: c.environment(PictureAgents), r"observation space of agent 'left' is Box.*flatten it"),
        (lambda c: c.environment(TwoAgents).training(critic_state="world"), r'use critic_state="observations"'),
    ],
)
def test_wrong_settings_are_refused_before_anything_starts(ray_session: None, change: Any, message: str) -> None:
    config = small_config("maddpg")
    with pytest.raises(ValueError, match=message):
        change(config)
        config.build_algo()


@pytest.mark.parametrize("algorithm", ["iddpg", "maddpg", "maddpg-l"])
def test_the_state_is_what_the_critic_is_fed(ray_session: None, algorithm: str) -> None:
    """The critic's input widths, for both kinds of state, are those of the family table."""
    widths = {
        "iddpg": {"observations": (18, 5)},
        "maddpg": {"observations": (54, 15), "world": (22, 15)},
        "maddpg-l": {"observations": (54, 5), "world": (22, 5)},
    }[algorithm]
    for kind, want in widths.items():
        algo = small_config(algorithm).training(critic_state=kind).build_algo()
        critic = algo._learner.module["agent_0"].critic
        assert (critic.from_state.in_features, critic.from_action.in_features) == want
        seen: list[Batch] = []
        algo._learner.step = lambda batch, seen=seen: seen.append(batch) or torch.zeros(6, 3)
        algo.train()
        now = algo._learner.prepare(seen[0], {}).now
        if algorithm == "iddpg":
            assert now.state is None
        elif kind == "world":
            assert now.state.shape[-1] == want[0]
            torch.testing.assert_close(now.state[:, :12].unflatten(1, (3, 4))[..., :2], now.obs[..., 2:4])
        else:
            torch.testing.assert_close(now.state, now.obs.flatten(1))
        algo.stop()
