"""Obstacle predator-prey: catch a faster prey among obstacles, without collisions (figure 5 of the paper).

    python tuned_examples/obstacle_predator_prey.py         # the paper's five algorithms and maddpg-entity, three seeds
    python tuned_examples/obstacle_predator_prey.py --quick # in five minutes: maddpg-entity, and a little of maddpg
    python tuned_examples/obstacle_predator_prey.py --help

Before it starts, the full run measures how fast it is on this machine, and says how long it will take.
"""

from rllib_maobs.experiment import Experiment, decayed, fading

experiment = Experiment(
    name="obstacle-predator-prey",
    env="maobs/obstacle-predator-prey",
    algorithms=("maddpg-entity", "iddpg", "maddpg", "maddpg-lstm", "maddpg-l", "facmac"),
    variants={
        # Not in the paper: networks that see sets of entities, shared by all agents. They learn in minutes.
        "maddpg-entity": {
            "algorithm": "maddpg",
            "actor": "entity",
            "critic": "entity",
            "actor_settings": {"near": 0.05},
            "critic_settings": {"near": 0.05},
            "critic_state": "world",
            "other_agents_actions": "joint",
            "one_policy": True,
            "actor_lr": decayed(5e-4),
            "critic_lr": decayed(1e-3),
            "gamma": 0.95,
            "tau": 0.01,
            "train_batch_size_per_learner": 128,
            "updates_per_env_step": 1 / 4,
            "num_random_steps": 5_000,
            "num_steps_sampled_before_learning_starts": 5_000,
            "exploration": fading(epsilon=0.1, noise=0.2, final=0.05),
            "env_config": {"action_mode": "force"},
            # Training is stricter with contacts; scores are those of the task's own reward.
            "train_env_config": {"agent_collision_penalty": 3.0, "obstacle_collision_penalty": 3.0},
            "train_horizon": 25,
            "num_envs_per_env_runner": 32,
            "stop_timesteps": 200_000,
            "quick": {
                "stop_timesteps": 40_000,
                "steps_per_iteration": 4_000,
                "evaluation_duration": 20,
                "torch_compile": True,
            },
        },
    },
    quick_algorithms=("maddpg-entity", "maddpg"),
    stop_timesteps=2_000_000,  # table II
    training={
        # Table III.
        "actor_lr": 0.001,
        "critic_lr": 0.01,
        "train_batch_size_per_learner": 256,
        "seq_length": 3,  # of LSTM actors
        # Table II.
        "gamma": 0.95,
        "exploration": {"epsilon": 0.1, "noise": 0.1},
        # Not in the paper; the settings of the code base that it grew from.
        "tau": 0.01,
        "updates_per_env_step": 1.0,
        "replay_buffer_capacity": 500_000,
    },
)

if __name__ == "__main__":
    experiment.main()
