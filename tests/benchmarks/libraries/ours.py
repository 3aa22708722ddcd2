"""Ours: MADDPG's compiled update, and `train()`."""

import ray

import rllib_maobs as maobs
from tests.benchmarks.internals import learner_of, minibatch, networks_of, replayed_updates_of, update_of
from tests.benchmarks.libraries import COPIES, HIDDEN, ROWS, Shape, job, size
from tests.benchmarks.workers import Job

STEPS = 400  # env steps of an iteration


def prepare(shape: Shape) -> Job:
    """Fill replay and compile."""
    shape = Shape(*shape)
    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    config = maobs.MADDPGConfig().environment(f"maobs/{shape.scenario}")
    config.env_runners(num_envs_per_env_runner=COPIES).framework(torch_compile_learner=True).debugging(seed=0)
    config.training(train_batch_size_per_learner=shape.batch, updates_per_env_step=1.0, replay_buffer_capacity=ROWS)
    config.training(num_steps_sampled_before_learning_starts=ROWS).reporting(min_sample_timesteps_per_iteration=STEPS)
    config.rl_module(model_config={"hidden_sizes": tuple(HIDDEN), "activation": "relu"})
    algo = config.build_algo()

    def train() -> int:
        algo.train()
        return STEPS

    for _ in range(ROWS // STEPS + 1):
        train()
    ways = {
        "update": update_of(learner_of(algo), minibatch(algo, shape.batch)),
        "replay": replayed_updates_of(algo, COPIES, shape.batch),
        "train": train,
    }
    return job(ways, [size(network) for network in networks_of(algo, "agent_0")])
