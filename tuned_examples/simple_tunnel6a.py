"""Simple tunnel with six agents, each with a target of its own (figure 11, right, of the paper).

    python tuned_examples/simple_tunnel6a.py          # all but FACMAC, and maddpg-entity, three seeds
    python tuned_examples/simple_tunnel6a.py --quick  # in five minutes: maddpg-entity, and a little of maddpg
    python tuned_examples/simple_tunnel6a.py --help

Agents' rewards differ here, and FACMAC learns the value of one team reward: it is not defined.

Before it starts, the full run measures how fast it is on this machine, and says how long it will take.
"""

from rllib_maobs.experiment import Experiment, decayed

experiment = Experiment(
    name="simple-tunnel-6a",
    env="maobs/simple-tunnel-6a",
    algorithms=("maddpg-entity", "iddpg", "maddpg", "maddpg-lstm", "maddpg-l"),
    variants={
        # Not in the paper: networks that see sets of entities; a policy for each agent, as in simple_tunnel.py.
        "maddpg-entity": {
            "algorithm": "maddpg",
            "actor": "entity",
            "critic": "entity",
            "critic_state": "world",
            "other_agents_actions": "joint",
            "actor_lr": decayed(5e-4),
            "critic_lr": decayed(1e-3),
            "gamma": 0.95,
            "tau": 0.01,
            "train_batch_size_per_learner": 128,
            "updates_per_env_step": 1 / 2,
            "num_random_steps": 5_000,
            "num_steps_sampled_before_learning_starts": 5_000,
            "exploration": {"epsilon": 0.1, "noise": 0.2, "decay": 1e-6, "final": 0.1},
            "env_config": {"action_mode": "force"},
            "train_horizon": 60,  # the way through the tunnel is long
            "num_envs_per_env_runner": 32,
            "stop_timesteps": 100_000,
            "quick": {
                "stop_timesteps": 20_000,
                "steps_per_iteration": 4_000,
                "evaluation_duration": 20,
                "torch_compile": True,
            },
        },
    },
    quick_algorithms=("maddpg-entity", "maddpg"),
    stop_timesteps=2_000_000,  # table II
    training={
        # Table VII.
        "actor_lr": 0.001,
        "critic_lr": 0.001,
        "train_batch_size_per_learner": 32,
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
