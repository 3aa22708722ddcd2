"""Plain MPE spread, where other libraries report their MADDPG: does ours learn as much?

    python tests/benchmarks/mpe_spread.py --seeds 0 1 2

Three agents, no obstacles, 25-step episodes, no speed cap, one mean reward. The figure is D, the mean over steps of
the sum over targets of the distance to the nearest agent, in noise-free episodes: about 2.1 for random actions,
0.7 to 0.85 for a trained MADDPG. The settings are close to those libraries', not the paper's.
"""

import argparse
import time

import ray
import torch

import rllib_maobs as maobs

ENV = {
    "num_obstacles": 0,
    "horizon": 25,
    "max_speed": None,
    "placement": "mpe",
    "reward_mode": "mean",
}


STEPS = 400_000


def mpe_spread_config(algorithm: str, seed: int, steps: int = STEPS) -> maobs.JointConfig:
    """An algorithm on plain MPE spread, for a run of so many env steps."""
    config = maobs.ALGORITHMS[algorithm]()
    config.environment("maobs/spread-3a", env_config=ENV)
    config.env_runners(num_envs_per_env_runner=20)
    config.training(
        # Constant for half of the run; without the decay D keeps moving between 0.86 and 0.96 at the end.
        actor_lr=[[0, 5e-4], [steps // 2, 5e-4], [steps, 2e-5]],
        critic_lr=[[0, 1e-3], [steps // 2, 1e-3], [steps, 5e-5]],
        critic_state="world",
        gamma=0.99,
        tau=0.005,
        train_batch_size_per_learner=1000,
        updates_per_env_step=1 / 20,
        num_random_steps=10_000,
        num_steps_sampled_before_learning_starts=10_000,
    )
    config.rl_module(model_config={"hidden_sizes": (128, 128)})
    config.framework(torch_compile_learner=True)
    config.reporting(min_sample_timesteps_per_iteration=20_000)
    config.evaluation(
        evaluation_interval=1,
        evaluation_duration=200,
        evaluation_config=maobs.JointConfig.overrides(num_envs_per_env_runner=200),
    )
    return config.debugging(seed=seed)


def train(algorithm: str, seed: int, steps: int) -> float:
    """Trains and returns the last D."""
    algo = mpe_spread_config(algorithm, seed, steps).build_algo()
    start, distance = time.perf_counter(), float("nan")
    while True:
        result = algo.train()
        done = int(result["num_env_steps_sampled_lifetime"])
        distance = float(result["evaluation"]["env_runners"]["episode_metrics"]["target_distance"])
        minutes = (time.perf_counter() - start) / 60
        print(f"{algorithm} seed {seed}: {done:7,} env steps, {minutes:4.1f} min, D = {distance:.3f}", flush=True)
        if done >= steps:
            algo.stop()
            return distance


def main() -> None:
    """Trains every seed, one after the other on one core."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algo", choices=sorted(maobs.ALGORITHMS), default="maddpg", help="default: maddpg")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="default: 0 1 2")
    parser.add_argument("--steps", type=int, default=STEPS, help=f"env steps; default: {STEPS}")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    distances = [train(arguments.algo, seed, arguments.steps) for seed in arguments.seeds]
    print(f"D of seeds {arguments.seeds}: {', '.join(f'{d:.3f}' for d in distances)}")


if __name__ == "__main__":
    main()
