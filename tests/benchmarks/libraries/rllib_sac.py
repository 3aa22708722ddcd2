"""Stock RLlib: `train()` of SAC, with one update of each agent's policy per env step."""

import ray
from ray.rllib.algorithms.sac import SACConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

import rllib_maobs as maobs
from tests.benchmarks.libraries import COPIES, HIDDEN, ROWS, Shape, job, size
from tests.benchmarks.workers import Job

STEPS, BEFORE = 40, 1_000  # env steps of an iteration, and before learning starts


def prepare(shape: Shape) -> Job:
    """Train until it learns."""
    shape = Shape(*shape)
    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    config = SACConfig().environment(maobs.MAObsEnv, env_config={"scenario": shape.scenario}).debugging(seed=0)
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=COPIES)
    policies = {f"agent_{i}" for i in range(shape.agents)}
    config.multi_agent(policies=policies, policy_mapping_fn=lambda agent, *args, **kwargs: agent)
    # The layers that its critics have besides are left out.
    networks = DefaultModelConfig(fcnet_hiddens=HIDDEN, fcnet_activation="relu", fusionnet_hiddens=[])
    config.rl_module(model_config=networks)
    # The intensity is rows replayed for one sampled: a minibatch for each env step.
    config.training(train_batch_size_per_learner=shape.batch, training_intensity=shape.batch, tau=0.01)
    config.training(replay_buffer_config={"type": "MultiAgentEpisodeReplayBuffer", "capacity": ROWS})
    config.training(num_steps_sampled_before_learning_starts=BEFORE)
    config.reporting(min_sample_timesteps_per_iteration=STEPS, min_time_s_per_iteration=0)
    algo = config.build_algo()
    for _ in range(BEFORE // STEPS + 1):
        algo.train()

    def train() -> int:
        learned = algo.train()["learners"]
        rows = {learned[policy]["num_module_steps_trained"] for policy in policies}
        assert rows == {STEPS * shape.batch}, f"not one update per env step: {rows}"
        return STEPS

    module = algo.learner_group._learner.module["agent_0"].unwrapped()
    return job({"train": train}, [size(module.pi_encoder, module.pi), size(module.qf_encoder, module.qf)])
