"""How fast one update is, against a loop over agents, and how much of it is left end to end; on one core.

    OMP_NUM_THREADS=1 python tests/benchmarks/update_speed.py
    OMP_NUM_THREADS=1 python tests/benchmarks/update_speed.py --algos maddpg maddpg-lstm maddpg-l facmac qmix

For each shape of the paper it times, in turns so that a drift of the machine's speed hits all alike:
the loop over agents in ordinary PyTorch (`tests/benchmarks/loop.py`, of IDDPG, MADDPG and MADDPG-L), the stacked update
eager and compiled, MADDPG's compiled update to compare the others with, and `algo.train()` with one update per env
step: sampling, replay, update, metrics and weight sync together.
"""

import argparse
import math
import statistics
import sys
import time
from functools import partial
from pathlib import Path

import ray
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))

import rllib_maobs as maobs
from tests.benchmarks.internals import LOOPS, learner_of, loop_update_of, minibatch, needs_discrete, update_of
from tests.benchmarks.measure import Work, count, in_turns, median_ratio, row
from tests.conftest import build_learner, random_batch

# Environment, batch size, sequence length, and least ratios: compiled to the loop, end to end to compiled.
SHAPES = {
    "N=9 batch 32": ("maobs/spread-9a", 32, 3, 6.0, 0.75),
    "N=3 batch 128": ("maobs/spread-3a", 128, 5, 3.5, 0.75),
}
# Least updates of the compiled learner for one of MADDPG's.
AGAINST_MADDPG = {"facmac": 0.7, "qmix": 0.7}


def config_of(algorithm: str, shape: str, critic_state: str, compiled: bool = True) -> maobs.JointConfig:
    """The paper's settings without evaluation."""
    env, batch_size, seq_length, *_ = SHAPES[shape]
    config = maobs.ALGORITHMS[algorithm]()
    config.environment(env, env_config={"action_mode": "discrete"} if needs_discrete(config) else {})
    config.training(train_batch_size_per_learner=batch_size, replay_buffer_capacity=50_000)
    config.framework(torch_compile_learner=compiled)
    if config.uses_state:
        config.training(critic_state=critic_state)
    if config.recurrent:
        config.training(seq_length=seq_length)
    return config.reporting(min_sample_timesteps_per_iteration=400).debugging(seed=0)


def measure(algorithm: str, shape: str, critic_state: str, rounds: int, seconds: float) -> dict[str, float]:
    """Median rates (per second) of the ways, and the median ratios of the rounds."""
    eager = build_learner(config_of(algorithm, shape, critic_state, compiled=False))
    start = time.perf_counter()
    algo = config_of(algorithm, shape, critic_state).build_algo()
    algo.train()
    first = time.perf_counter() - start
    batch = minibatch(algo, SHAPES[shape][1])  # Laid out in memory like those that it was compiled for.
    maddpg = build_learner(config_of("maddpg", shape, critic_state))

    def train() -> int:
        algo.train()
        return 400

    ways: dict[str, Work] = {
        "eager": update_of(eager, batch),
        "compiled": update_of(learner_of(algo), batch),
        "maddpg": update_of(maddpg, random_batch(maddpg.config, SHAPES[shape][1])),
        "end to end": train,
    }
    if algorithm in LOOPS:
        ways["loop"] = loop_update_of(algorithm, eager, batch)
    for work in ways.values():
        work()
    counts = in_turns({name: partial(count, work, seconds) for name, work in ways.items()}, rounds)
    rates = {name: [one.rate for one in own] for name, own in counts.items()}
    algo.stop()

    def ratio(a: str, b: str) -> float:
        return median_ratio(rates[a], rates[b]) if b in rates else math.nan

    return {
        "loop": math.nan,
        **{name: statistics.median(values) for name, values in rates.items()},
        "compiled/loop": ratio("compiled", "loop"),
        "compiled/maddpg": ratio("compiled", "maddpg"),
        "end to end/compiled": ratio("end to end", "compiled"),
        "first": first,
    }


def shown(value: float, digits: int) -> str:
    """A number, or a dash where there is nothing to compare with."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def main() -> None:
    """Prints the table; exits with 1 if a ratio is below its bar."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algos", nargs="+", choices=sorted(maobs.ALGORITHMS), default=["maddpg"])
    parser.add_argument("--critic-state", choices=["observations", "world"], default="observations")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0, help="per way and round")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    header = ["algorithm", "shape", "loop /s", "eager /s", "compiled /s", "train() /s", "x loop", "x MADDPG"]
    header.append("train()/compiled")
    print(f"{row(header)}\n|{'---|' * len(header)}")
    missed = False
    for algorithm in arguments.algos:
        for shape, (*_, least, share) in SHAPES.items():
            r = measure(algorithm, shape, arguments.critic_state, arguments.rounds, arguments.seconds)
            cells = [algorithm, shape, shown(r["loop"], 0), shown(r["eager"], 0), shown(r["compiled"], 0)]
            cells += [shown(r["end to end"], 0), shown(r["compiled/loop"], 1), shown(r["compiled/maddpg"], 2)]
            print(row([*cells, shown(r["end to end/compiled"], 2)]), flush=True)
            below = []
            if algorithm == "maddpg" and (r["compiled/loop"] < least or r["end to end/compiled"] < share):
                below.append(f"at least {least} x loop and {share} of the compiled update end to end")
            if r["compiled/maddpg"] < AGAINST_MADDPG.get(algorithm, 0.0):
                below.append(f"at least {AGAINST_MADDPG[algorithm]} of MADDPG's updates")
            missed = missed or bool(below)
            for bar in below:
                print(f"below the bar: {bar}")
    sys.exit(missed)


if __name__ == "__main__":
    main()
