"""FACMAC with a mixer that starts half-way, on obstacle predator-prey (figure 7 of the paper).

    python tuned_examples/facmac_two_stage.py         # the paper's size: with and without, three seeds each
    python tuned_examples/facmac_two_stage.py --quick # the same job in a few minutes
    python tuned_examples/facmac_two_stage.py --help

Before it starts, the script measures how fast it runs on this machine, and says how long it will take.
"""

from rllib_maobs.experiment import Experiment

experiment = Experiment(
    name="facmac-two-stage",
    env="maobs/obstacle-predator-prey",
    algorithms=("two-stage", "facmac"),
    variants={
        # Until then local critics learn alone (eq. 13), after it the mixer does, too (eq. 14).
        "two-stage": {"algorithm": "facmac", "critic_source": "own", "mixer_start": lambda env_steps: env_steps // 2},
        "facmac": {"algorithm": "facmac", "critic_source": "own"},
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
