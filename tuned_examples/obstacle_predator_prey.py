"""Obstacle predator-prey: catch a faster prey among obstacles, without collisions (figure 5 of the paper).

    python tuned_examples/obstacle_predator_prey.py         # the paper's size: all five algorithms, three seeds each
    python tuned_examples/obstacle_predator_prey.py --quick # the same job in a few minutes
    python tuned_examples/obstacle_predator_prey.py --help

Before it starts, the script measures how fast it runs on this machine, and says how long it will take.
"""

from rllib_maobs.experiment import Experiment

experiment = Experiment(
    name="obstacle-predator-prey",
    env="maobs/obstacle-predator-prey",
    algorithms=("iddpg", "maddpg", "maddpg-lstm", "maddpg-l", "facmac"),
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
