"""How long the paper's whole grid takes on this machine, where the time goes, and how far it is from the limit.

    OMP_NUM_THREADS=1 python tests/benchmarks/grid.py
    OMP_NUM_THREADS=1 python tests/benchmarks/grid.py --experiments spread9a --algos maddpg maddpg-lstm --seconds 10

A cell is an experiment of `tuned_examples/` (its environment, batch size, window) and one of its algorithms, trained as
its script would: the paper's with one update per env step, an evaluation every 1000. Beside these are two cells of
entity networks, with fewer and larger updates that are not mostly products. Each cell runs in a process of its own,
bound to a core, as many at once as `--cores`: a core's neighbours are as busy as they will be. Measured is a warmed-up
time after compiling; the hours are those of the script's env steps at that pace.

The columns: what `train()` makes in env steps/s, and the shares of its time (RLlib's is all that is left: metrics,
weight sync, Python between updates); the update alone, beside the loop over agents in ordinary PyTorch
(`tests/benchmarks/loop.py`, where it has the algorithm), in turns; and the machine's limit: the time that the update's
matrix products take by themselves, each measured on its very shape, and the bytes of parameters, targets and Adam's
state over the bandwidth measured on vectors of that size. The last but one column is `train()` as a share of that
limit.
"""

import argparse
import csv
import importlib
import resource
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from queue import Queue
from typing import Any

import ray
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))

import rllib_maobs as maobs
from rllib_maobs.experiment.arguments import make_parser
from rllib_maobs.experiment.trial import TrialSpec
from rllib_maobs.replay import Batch
from tests.benchmarks.internals import (
    LOOPS,
    bytes_of_replay,
    learner_of,
    loop_update_of,
    minibatch,
    update_of,
    watch_parts,
)
from tests.benchmarks.limit import limit
from tests.benchmarks.measure import Stopwatch, best, count, end, in_turns, row
from tests.benchmarks.workers import Job, Worker, free_cores

EXPERIMENTS = ["obstacle_predator_prey", "spread3a", "spread6a", "spread9a", "tunnel", "simple_tunnel"]
EXPERIMENTS += ["simple_tunnel6a"]
ENTITIES = [("spread3a", "maddpg-entity"), ("spread9a", "maddpg-entity")]  # not of the paper: no part of its hours
PARTS = ["acting", "env", "replay", "update", "evaluation", "RLlib"]
HOURS, RLLIB_SHARE = 24.0, 0.2  # bars


def loop_seconds(algorithm: str, learner: Any, batch: Batch, seconds: float) -> tuple[float, float]:
    """Seconds of an update in the loop over agents (nan where it has not the algorithm) and of ours, in turns."""
    ways = {"ours": partial(best, update_of(learner, batch), seconds / 8)}
    if algorithm in LOOPS:
        ways["loop"] = partial(best, loop_update_of(algorithm, learner, batch), seconds / 8)
    results = in_turns(ways, 4)
    return min(results.get("loop", [float("nan")])), min(results["ours"])


def measure(spec: TrialSpec, seconds: float) -> dict[str, Any]:
    """One cell: its pace, the parts of its time, its loop, its limit, its memory."""
    torch.set_num_threads(1)
    config = spec.build_config().evaluation(evaluation_interval=10**9)
    start = time.perf_counter()
    algo = config.build_algo()
    built = time.perf_counter() - start
    while not any(key != "__all_modules__" for key in algo.train().get("learners", {})):
        pass
    first = time.perf_counter() - start - built

    def train() -> int:
        algo.train()
        return spec.steps_per_iteration

    stopwatch = Stopwatch()
    watch_parts(algo, stopwatch)
    trained = count(train, seconds)
    parts = {part: stopwatch.seconds[part] / trained.made for part in PARTS if part in stopwatch.seconds}
    parts["RLlib"] = 1 / trained.rate - sum(parts.values())
    algo.evaluate()
    parts["evaluation"] = best(algo.evaluate, 0.0) / spec.steps_per_iteration
    per_step = sum(parts.values())

    learner, batch = learner_of(algo), minibatch(algo, config.train_batch_size_per_learner)
    loop, ours = loop_seconds(spec.algorithm, learner, batch, seconds)
    result = {
        "env steps/s": 1.0 / per_step,
        "parts": {part: parts[part] / per_step for part in PARTS},
        "update": ours,
        "loop": loop,
        "limit": limit(learner, batch),
        "updates": config.updates_per_env_step,
        "first": first,
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 + bytes_of_replay(algo),
    }
    algo.stop()
    return result


def spec_of(experiment: str, algorithm: str, critic_state: str) -> tuple[TrialSpec, int]:
    """A cell's trial as its script makes it, and its env steps."""
    own = importlib.import_module(f"tuned_examples.{experiment}").experiment
    parser = make_parser(own.name, own.algorithms, own.stop_timesteps)
    arguments = parser.parse_args(["--algos", algorithm, "--seeds", "0", "--critic-state", critic_state])
    spec = own.specs(arguments)[0]
    return spec, spec.stop_timesteps


def prepare(experiment: str, algorithm: str, critic_state: str) -> Job:
    """Be the target of a worker: start Ray, and measure a cell when asked to."""
    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    maobs.register()
    spec, steps = spec_of(experiment, algorithm, critic_state)
    return Job(lambda seconds: {**measure(spec, seconds), "steps": steps})


def run_cells(cells: list[tuple[str, str]], arguments: argparse.Namespace) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Every cell in a process of its own, one per core at once; yields them in order."""
    cores: Queue[int] = Queue()
    for core in free_cores()[: arguments.cores]:
        cores.put(core)

    def run(cell: tuple[str, str]) -> tuple[str, str, dict[str, Any]]:
        core = cores.get()
        try:
            worker = Worker("tests.benchmarks.grid:prepare", *cell, arguments.critic_state, cores={core})
            worker.ready()
            result = worker.measured(arguments.seconds)
            worker.close()
        finally:
            cores.put(core)
        return *cell, result

    with ThreadPoolExecutor(arguments.cores) as pool:
        yield from pool.map(run, cells)


def row_of(experiment: str, algorithm: str, r: dict[str, Any]) -> list[str]:
    """A cell's row of the table."""
    loop = "-" if r["loop"] != r["loop"] else f"{r['loop'] / r['update']:.1f}"
    return [
        experiment,
        algorithm,
        f"{r['env steps/s']:.0f}",
        *(f"{100 * r['parts'][part]:.0f}" for part in PARTS),
        f"{1 / r['update']:.0f}",
        loop,
        f"{1 / r['limit']:.0f}",
        f"{100 * r['limit'] * r['updates'] * r['env steps/s']:.0f} %",
        f"{r['memory'] / 1e9:.1f}",
        f"{r['steps'] / r['env steps/s'] / 3600:.2f}",
    ]


def main() -> None:
    """Prints the table, a row as soon as it is there; exits with 1 if a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", nargs="+", choices=EXPERIMENTS, default=EXPERIMENTS)
    parser.add_argument("--algos", nargs="+", help="only these algorithms (default: all that an experiment compares)")
    parser.add_argument("--critic-state", choices=["observations", "world"], default="observations")
    parser.add_argument("--seconds", type=float, default=6.0, help="of training that are measured, per cell")
    parser.add_argument("--cores", type=int, default=min(2, len(free_cores())), help="cells at once")
    parser.add_argument("--csv", type=Path, help="file to write the table to, too")
    arguments = parser.parse_args()
    if not 1 <= arguments.cores <= len(free_cores()):
        parser.error(f"--cores: this process may use {len(free_cores())}, not {arguments.cores}")

    cells = [
        (name, algorithm)
        for name in arguments.experiments
        for algorithm in importlib.import_module(f"tuned_examples.{name}").experiment.algorithms
        if algorithm in maobs.ALGORITHMS or (name, algorithm) in ENTITIES
        if not arguments.algos or algorithm in arguments.algos
    ]
    if not cells:
        parser.error(f"--algos: none of {', '.join(arguments.algos)} is compared in {', '.join(arguments.experiments)}")
    header = ["experiment", "algorithm", "env steps/s", *(f"{part} %" for part in PARTS), "updates/s", "x loop"]
    header += ["limit/s", "of limit", "GB", "hours"]
    print(f"{len(cells)} cells, {arguments.cores} at once\n\n{row(header)}\n|{'---|' * len(header)}")
    rows, results = [], []
    for experiment, algorithm, result in run_cells(cells, arguments):
        rows.append(row_of(experiment, algorithm, result))
        results.append(result)
        print(row(rows[-1]), flush=True)
    if arguments.csv:
        with arguments.csv.open("w", newline="") as file:
            csv.writer(file).writerows([header, *rows])

    paper = [r for (_, algorithm), r in zip(cells, results, strict=True) if algorithm in maobs.ALGORITHMS]
    if not paper:
        return
    steps = sum(r["steps"] for r in paper)
    seconds = sum(r["steps"] / r["env steps/s"] for r in paper)
    at_limit = sum(r["steps"] * r["limit"] for r in paper)
    hours = seconds / 3600 / arguments.cores
    share = max(r["parts"]["RLlib"] for r in paper)
    first = max(r["first"] for r in paper)
    print(
        f"\n{steps / 1e6:.0f} million env steps: {hours:.1f} hours on {arguments.cores} core(s), "
        f"{steps / seconds:.0f} env steps/s per core; at the limit {at_limit / 3600 / arguments.cores:.1f} hours. "
        f"RLlib's share is at most {100 * share:.0f} %. First iteration in at most {first:.0f} s, compiling included."
    )
    missed = [f"at most {HOURS:.0f} hours"] if hours > HOURS else []
    missed += [f"at most {100 * RLLIB_SHARE:.0f} % of the time in RLlib"] if share > RLLIB_SHARE else []
    end(missed)


if __name__ == "__main__":
    main()
