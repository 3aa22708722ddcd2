"""Whose critics FACMAC mixes, on obstacle predator-prey (figure 6 of the paper).

    python tuned_examples/facmac_critic_source.py         # the paper's size: three sources, three seeds each
    python tuned_examples/facmac_critic_source.py --quick # the same job in a few minutes
    python tuned_examples/facmac_critic_source.py --help

Before it starts, the script measures how fast it runs on this machine, and says how long it will take.
"""

from rllib_maobs.experiment import Experiment

experiment = Experiment(
    name="facmac-critic-source",
    env="maobs/obstacle-predator-prey",
    algorithms=("own", "others", "shared"),
    variants={
        "own": {"algorithm": "facmac", "critic_source": "own"},  # agent a's critic in the place of all others'
        "others": {"algorithm": "facmac", "critic_source": "others"},  # every agent's own critic
        "shared": {"algorithm": "facmac", "critic_source": "shared"},  # one critic for all: the original FACMAC
    },
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
