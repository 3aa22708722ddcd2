"""Spread with three agents: cover three targets among two obstacles without collisions (figure 9 of the paper).

    python tuned_examples/spread3a.py                 # the paper's five algorithms and maddpg-entity, three seeds
    python tuned_examples/spread3a.py --quick         # in five minutes: maddpg-entity, and a little of maddpg
    python tuned_examples/spread3a.py --help

Before it starts, the full run measures how fast it is on this machine, and says how long it will take.
"""

from rllib_maobs.experiment import Experiment, decayed, fading

experiment = Experiment(
    name="spread-3a",
    env="maobs/spread-3a",
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
            "gamma": 0.8,  # short sight: values that span many steps hide small distances and contacts
            "tau": 0.01,
            "train_batch_size_per_learner": 128,
            "updates_per_env_step": 1 / 4,
            "action_regularization": 0.01,  # without it a team may run away for good, its actions all at the limit
            "num_random_steps": 5_000,
            "num_steps_sampled_before_learning_starts": 5_000,
            "exploration": fading(epsilon=0.1, noise=0.2, final=0.05),
            "env_config": {"action_mode": "force"},
            # Scores are those of the task's own reward. Training is stricter with contacts, and gives everyone a target
            # of its own: short-sighted ones would wait beside one that is taken.
            "train_env_config": {
                "reward_mode": "mean",
                "matching": "one_to_one",
                "agent_collision_penalty": 8.0,
                "obstacle_collision_penalty": 8.0,
            },
            "train_horizon": 50,
            "num_envs_per_env_runner": 32,
            "stop_timesteps": 200_000,
            "quick": {
                "stop_timesteps": 60_000,
                "steps_per_iteration": 4_000,
                "evaluation_duration": 20,
                "torch_compile": True,
            },
        },
    },
    quick_algorithms=("maddpg-entity", "maddpg"),
    stop_timesteps=2_000_000,  # table II
    training={
        # Table IV.
        "actor_lr": 0.001,
        "critic_lr": 0.01,
        "train_batch_size_per_learner": 128,
        "seq_length": 5,  # of LSTM actors
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
