"""What MADDPG learns on spread-3a in ten minutes of one core: BenchMARL's, and ours with entity networks.

    OMP_NUM_THREADS=1 python tests/benchmarks/peers_learning.py [--minutes 10] [--seeds 0 1 2] [--venv DIR]

It prints a table for the README and what it compares. The first run makes a virtual environment with BenchMARL, Ray
and what comes with them (some gigabytes; `PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu` gets the small
PyTorch), by default beside the system's other temporary files; later runs use it again.

Every library has a process of its own, one at a time.
"""

import argparse
import sys
import tempfile
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from rllib_maobs.experiment.arguments import make_parser
from rllib_maobs.experiment.trial import TrialSpec
from tests.benchmarks.measure import row
from tests.benchmarks.peers import PACKAGES
from tests.benchmarks.workers import Worker, python_with, same_torch
from tuned_examples.spread3a import experiment

SCENARIO, EPISODES = "spread-3a", 100
PEERS = {"BenchMARL, MLP": "MLP", "BenchMARL, GNN": "GNN"}
COLUMNS = {
    "minutes": "{:.1f}",
    "env_steps": "{:,.0f}",
    "return": "{:.0f}",
    "coverage": "{:.2f}",
    "all_covered": "{:.0%}",
    "contacts": "{:.1f}",
}
COMPARED = """
{episodes} episodes of 100 steps without noise, with the task's own reward; minutes are of the process's own time on one
thread of one core. {versions}.

- BenchMARL: `MaddpgConfig`, `ExperimentConfig` and networks as `get_from_yaml()` gives them: one policy for all agents,
  6000 env steps and then 1000 updates with 128 transitions an iteration, exploration that falls over the first third of
  the time. MLP: two layers of 256 tanh units, actor and critic. GNN: its layer of a graph over all agents before
  that, with which agents tell each other what they see.
- ours: the row "maddpg-entity" of `tuned_examples/spread3a.py`, which ends after {steps:,} env steps; the time of the
  C++ compiler is not counted.
- Both train in the environment of that row: {options}.
"""


def spec_of(seed: int) -> TrialSpec:
    """Return our trial."""
    parser = make_parser(experiment.name, experiment.algorithms, experiment.stop_timesteps)
    (spec,) = experiment.specs(parser.parse_args(["--algos", "maddpg-entity", "--seeds", str(seed)]))
    return spec


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--rows", nargs="+", choices=["ours", *PEERS], default=["ours", *PEERS])
    parser.add_argument("--venv", type=Path, default=Path(tempfile.gettempdir()) / "rllib-maobs-learning-peers")
    own = parser.parse_args()
    ours = [f"ray[rllib]=={version('ray')}", "pettingzoo", "scipy", "matplotlib", "tensorboardX", "torch_geometric"]
    python = sys.executable
    if set(own.rows) & {*PEERS}:
        python = python_with(own.venv, [same_torch(), *PACKAGES["benchmarl"], *ours])
    spec = spec_of(0)
    print(row(["", "seed", *COLUMNS]))
    print("|---" * (2 + len(COLUMNS)) + "|")
    for seed in own.seeds:
        for name in own.rows:
            if name == "ours":
                evaluation = spec.evaluation_options
                worker = Worker(
                    "tests.benchmarks.libraries.ours_learning:prepare", asdict(spec_of(seed)), SCENARIO, evaluation
                )
            else:
                worker = Worker(
                    "tests.benchmarks.libraries.benchmarl_learning:prepare",
                    PEERS[name],
                    seed,
                    SCENARIO,
                    spec.env_config,
                    spec.evaluation_options,
                    python=python,
                )
            try:
                worker.ready()
                found = worker.measured(60.0 * own.minutes, EPISODES)
            finally:
                worker.close()
            cells = [form.format(found[column]) for column, form in COLUMNS.items()]
            print(row([name, str(seed), *cells]), flush=True)
    packages = ", ".join([*PACKAGES["benchmarl"], f"torch {version('torch')}", f"ray {version('ray')}"])
    print(
        COMPARED.format(
            episodes=EPISODES,
            versions=packages,
            steps=spec.stop_timesteps,
            options=", ".join(f"{key}={value}" for key, value in spec.env_config.items()),
        )
    )


if __name__ == "__main__":
    main()
