"""What networks and what algorithms are worth, on spread-3a: MLP, LSTM and entity networks under six algorithms.

    python tuned_examples/spread3a_networks.py           # 18 rows, three seeds each
    python tuned_examples/spread3a_networks.py --quick   # MADDPG with each of the networks, one seed
    python tuned_examples/spread3a_networks.py --help

Not in the paper. All rows have one budget and the same settings: one policy for all agents, short training episodes, 32
copies, one update for eight env steps, gamma 0.95, and targets that count for whoever is nearest, as in the task.
"""

from typing import Any

from rllib_maobs.experiment import Experiment, decayed, fading

NETWORKS: dict[str, dict[str, Any]] = {
    "mlp": {"agent_id_input": True},  # so that agents which share a policy may differ
    "lstm": {"actor": "lstm", "seq_length": 5, "agent_id_input": True},
    "entity": {"actor": "entity", "critic": "entity"},
}
ALGORITHMS: dict[str, dict[str, Any]] = {
    "iddpg": {"algorithm": "iddpg"},
    "maddpg": {"algorithm": "maddpg", "critic_state": "world", "other_agents_actions": "replay"},
    "maddpg-current": {"algorithm": "maddpg", "critic_state": "world", "other_agents_actions": "current"},
    "maddpg-joint": {"algorithm": "maddpg", "critic_state": "world", "other_agents_actions": "joint"},
    "maddpg-l": {"algorithm": "maddpg-l", "critic_state": "world"},
    "facmac": {"algorithm": "facmac", "critic_state": "world"},
}
ROW: dict[str, Any] = {
    "one_policy": True,
    "env_config": {"action_mode": "force"},
    "train_env_config": {"reward_mode": "mean", "agent_collision_penalty": 3.0, "obstacle_collision_penalty": 3.0},
    "train_horizon": 25,
    "num_envs_per_env_runner": 32,
    "steps_per_iteration": 4_000,
    "evaluation_duration": 20,
    "quick": {"stop_timesteps": 30_000, "steps_per_iteration": 5_000, "torch_compile": True},
}

experiment = Experiment(
    name="spread-3a-networks",
    env="maobs/spread-3a",
    algorithms=tuple(f"{algorithm}-{network}" for network in NETWORKS for algorithm in ALGORITHMS),
    variants={
        f"{algorithm}-{network}": {**ROW, **settings, **of_networks}
        for network, of_networks in NETWORKS.items()
        for algorithm, settings in ALGORITHMS.items()
    },
    quick_algorithms=tuple(f"maddpg-joint-{network}" for network in NETWORKS),
    stop_timesteps=100_000,
    training={
        "actor_lr": decayed(5e-4),
        "critic_lr": decayed(1e-3),
        "gamma": 0.95,
        "tau": 0.01,
        "train_batch_size_per_learner": 128,
        "updates_per_env_step": 1 / 8,
        "num_random_steps": 5_000,
        "num_steps_sampled_before_learning_starts": 5_000,
        "exploration": fading(epsilon=0.1, noise=0.2, final=0.05),
    },
)

if __name__ == "__main__":
    experiment.main()
