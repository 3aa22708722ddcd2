"""Every environment trains with MADDPG-L and with a stock RLlib algorithm: no warning, all metrics."""

import logging
import math
import warnings

import numpy as np
import pytest
from ray.rllib.algorithms.ppo import PPOConfig

import rllib_maobs as maobs
from rllib_maobs.envs import SCENARIOS, EpisodeMetricsCallback, MAObsEnv, make_scenario

PREY = "obstacle-predator-prey"
# The names under env_runners/episode_metrics: people's plots and stopping rules hang on them.
COMMON = set(
    "success time_to_goal collisions_agents collisions_obstacles collisions_walls collision_free min_clearance "
    "path_efficiency return_agent_0 episode_length".split()
)
COVERAGE = COMMON | set("coverage coverage_mean all_covered all_covered_mean target_distance".split())
METRICS = {
    PREY: COMMON | {"captures", "first_capture_step", "prey_distance"},
    "spread-3a": COVERAGE,
    "spread-6a": COVERAGE,
    "spread-9a": COVERAGE,
    "tunnel": COVERAGE,
    "simple-tunnel": COVERAGE | {f"success_agent_{i}" for i in range(3)},
    "simple-tunnel-6a": COVERAGE | {f"success_agent_{i}" for i in range(6)},
}
# What RLlib says for its own example environments too, whatever the algorithm; the last one to who makes two.
RLLIB_OWN = (
    "You are running ",
    "DeprecationWarning: `RLModule(config=",
    "Install gputil for GPU system monitoring",
    "Overriding environment rllib-multi-agent-env-v0 already in registry",
)


@pytest.fixture
def complaints(monkeypatch):
    """What is warned of or logged as a warning during a test, without what RLlib says to everybody."""
    # RLlib logs some things once per process: here, once per test.
    monkeypatch.setattr("ray.util.debug._logged", set())
    found = []

    class Listener(logging.Handler):
        def emit(self, record):
            found.append(record.getMessage())

    listener = Listener(logging.WARNING)
    loggers = [logging.getLogger(name) for name in (None, "ray", "ray.rllib", "ray.tune", "rllib_maobs")]
    for logger in loggers:
        logger.addHandler(listener)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        # PyTorch's about itself while it compiles, which Python hides by default.
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="torch")
        yield lambda: [
            text
            for text in [*found, *(f"{w.filename}: {w.message}" for w in caught)]
            if not any(own in text for own in RLLIB_OWN)
        ]
    for logger in loggers:
        logger.removeHandler(listener)


def ppo_config(scenario_id, shared=False, **options):
    """Stock PPO with a policy per agent, or one for all."""
    policies = {"shared"} if shared else set(make_scenario(scenario_id, **options).agents)
    return (
        PPOConfig()
        .environment(MAObsEnv, env_config={"scenario": scenario_id, **options})
        .env_runners(num_env_runners=0)
        .multi_agent(
            policies=policies, policy_mapping_fn=lambda agent, episode, **kwargs: "shared" if shared else agent
        )
        .training(train_batch_size_per_learner=2000, minibatch_size=500, num_epochs=2)
        .callbacks(EpisodeMetricsCallback)
        .debugging(seed=0)
    )


def maddpg_l_config(scenario_id, **options):
    return (
        maobs.MADDPGLConfig()
        .environment(f"maobs/{scenario_id}", env_config=options)
        .env_runners(num_envs_per_env_runner=8)
        .debugging(seed=0)
    )


def train(config, steps):
    """The results of the last iteration, after as many environment steps."""
    maobs.register()
    algo = config.build_algo()
    try:
        while True:
            results = algo.train()
            if results["env_runners"]["num_env_steps_sampled_lifetime"] >= steps:
                return results
    finally:
        algo.stop()


def check(results, scenario_id, agents):
    metrics = results["env_runners"]["episode_metrics"]
    assert set(metrics) == METRICS[scenario_id]
    assert all(math.isfinite(value) for value in metrics.values()), metrics
    for agent in agents:
        losses = {name: value for name, value in results["learners"][agent].items() if name.endswith("_loss")}
        assert losses and all(math.isfinite(value) for value in losses.values()), losses


def test_every_scenario_has_its_names_here():
    assert set(METRICS) == set(SCENARIOS)


@pytest.mark.parametrize(
    ("scenario_id", "options"),
    [("spread-3a", {}), (PREY, {"prey": "learned"}), ("simple-tunnel", {"start_noise": 0.02})],
)
def test_ppo_trains_without_a_warning(ray_session, complaints, scenario_id, options):
    config = ppo_config(scenario_id, horizon=10, **options)
    config.training(train_batch_size_per_learner=40, minibatch_size=20, num_epochs=1)
    check(train(config, steps=80), scenario_id, make_scenario(scenario_id, **options).agents)
    assert not complaints()


@pytest.mark.parametrize(("scenario_id", "options"), [("simple-tunnel", {}), (PREY, {"prey": "learned"})])
def test_maddpg_l_trains_without_a_warning(ray_session, complaints, scenario_id, options):
    config = maddpg_l_config(scenario_id, horizon=10, **options)
    config.training(train_batch_size_per_learner=16, replay_buffer_capacity=1000)
    config.reporting(min_sample_timesteps_per_iteration=80)
    check(train(config, steps=160), scenario_id, make_scenario(scenario_id, **options).agents)
    assert not complaints()


def test_metrics_of_ppo_are_those_of_its_episodes(ray_session):
    config = ppo_config("spread-3a", shared=True, horizon=20)
    config.training(train_batch_size_per_learner=60, minibatch_size=60, num_epochs=1)
    result = train(config, steps=60)["env_runners"]
    assert 0.0 <= result["episode_metrics"]["coverage_mean"] <= 1.0
    assert result["episode_metrics"]["episode_length"] == result["episode_len_mean"] == 20
    mean_agent = np.mean(list(result["agent_episode_returns_mean"].values()))
    assert result["episode_metrics"]["return_agent_0"] == pytest.approx(mean_agent)


# A learned prey observes less than its predators.
TASKS = [(scenario_id, {}) for scenario_id in METRICS] + [(PREY, {"prey": prey}) for prey in ("flee", "learned")]


@pytest.mark.slow
@pytest.mark.parametrize(("scenario_id", "options"), TASKS)
def test_ppo_trains_20_000_steps_without_a_warning(ray_session, complaints, scenario_id, options):
    results = train(ppo_config(scenario_id, **options), steps=20_000)
    check(results, scenario_id, make_scenario(scenario_id, **options).agents)
    assert not complaints()


@pytest.mark.slow
@pytest.mark.parametrize(("scenario_id", "options"), TASKS)
def test_maddpg_l_trains_20_000_steps_without_a_warning(ray_session, complaints, scenario_id, options):
    config = maddpg_l_config(scenario_id, **options).framework(torch_compile_learner=True)
    check(train(config, steps=20_000), scenario_id, make_scenario(scenario_id, **options).agents)
    assert not complaints()
