"""What networks and what algorithms are worth with nine agents: the rows of `spread3a_networks.py` on spread-9a.

    python tuned_examples/spread9a_networks.py           # 18 rows, three seeds each
    python tuned_examples/spread9a_networks.py --quick   # MADDPG with each of the networks, one seed
    python tuned_examples/spread9a_networks.py --help

Not in the paper. Batches are smaller than with three agents, actions regularised, contacts at the task's own price and
entities seen once more from near; and trainings are shorter: an update takes several times as long.
"""

from dataclasses import replace

from spread3a_networks import experiment as three_agents

TRAINING = {"reward_mode": "mean"}
NEAR = {"actor_settings": {"near": 0.2}, "critic_settings": {"near": 0.2}}

experiment = replace(
    three_agents,
    name="spread-9a-networks",
    env="maobs/spread-9a",
    variants={
        row: {**settings, "train_env_config": TRAINING, **(NEAR if row.endswith("-entity") else {})}
        for row, settings in three_agents.variants.items()
    },
    stop_timesteps=40_000,
    training={**three_agents.training, "train_batch_size_per_learner": 64, "action_regularization": 0.01},
)

if __name__ == "__main__":
    experiment.main()
