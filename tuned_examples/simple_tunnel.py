"""Simple tunnel: walls around the tunnel and a target of its own for every agent (figure 11 of the paper).

    python tuned_examples/simple_tunnel.py            # the paper's size: all but FACMAC, three seeds each
    python tuned_examples/simple_tunnel.py --quick    # the same job in a few minutes
    python tuned_examples/simple_tunnel.py --help

Agents' rewards differ here, and FACMAC learns the value of one team reward: it is not defined.

Before it starts, the script measures how fast it runs on this machine, and says how long it will take.
"""

from rllib_maobs.experiment import Experiment

experiment = Experiment(
    name="simple-tunnel",
    env="maobs/simple-tunnel",
    algorithms=("iddpg", "maddpg", "maddpg-lstm", "maddpg-l"),
    stop_timesteps=2_000_000,  # table II
    training={
        # Table VI.
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
