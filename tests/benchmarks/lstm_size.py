"""How the size of the LSTM changes what MADDPG-LSTMactor learns on simple-tunnel.

    OMP_NUM_THREADS=1 python tests/benchmarks/lstm_size.py --sizes 48 64 --seeds 0 1 2 3 4

One trial after the other, each as `tuned_examples/simple_tunnel.py` trains it but for the size; at 200 env steps/s
one takes some ten minutes. Prints means over a trial's evaluations from 20 000 env steps on, and over its last ten.
"""

import argparse
import sys
from pathlib import Path
from statistics import mean

import ray
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))

import rllib_maobs as maobs
from rllib_maobs.experiment.arguments import make_parser
from rllib_maobs.experiment.report import evaluation_metrics
from tuned_examples.simple_tunnel import experiment

METRICS = ("score", "coverage", "target_distance", "collisions")


def main() -> None:
    """Trains and prints a row per trial."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", type=int, default=[32, 48, 64])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--iterations", type=int, default=100, help="of 1000 env steps")
    own = parser.parse_args()
    torch.set_num_threads(1)
    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    maobs.register()
    for seed in own.seeds:
        for size in own.sizes:
            options = make_parser(experiment.name, experiment.algorithms, experiment.stop_timesteps).parse_args(
                ["--algos", "maddpg-lstm", "--seeds", str(seed)]
            )
            config = experiment.specs(options)[0].build_config().rl_module(model_config={"lstm_cell_size": size})
            algo = config.build_algo()
            results = [evaluation_metrics(algo.train()) for _ in range(own.iterations)]
            algo.stop()
            for name, part in (("from 20 000 on", results[20:] or results), ("last ten", results[-10:])):
                values = ", ".join(f"{m} {mean(r[m] for r in part):.2f}" for m in METRICS)
                print(f"{size} units, seed {seed}, {name}: {values}", flush=True)


if __name__ == "__main__":
    main()
