"""How fast one update is, against a loop over agents, and how much of it is left end to end; on one core.

    OMP_NUM_THREADS=1 python tests/benchmarks/update_speed.py
    OMP_NUM_THREADS=1 python tests/benchmarks/update_speed.py --algos maddpg maddpg-lstm maddpg-l facmac qmix

For each shape of the paper it times, in turns so that a drift of the machine's speed hits all alike:
the loop over agents in ordinary PyTorch (`tests/reference.py`, of IDDPG, MADDPG and MADDPG-L), the stacked update
eager and compiled, MADDPG's compiled update to compare the others with, and `algo.train()` with one update per env
step: sampling, replay, update, metrics and weight sync together.
"""

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import ray
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))

import rllib_maobs as maobs
from rllib_maobs.learner import JointLearner
from rllib_maobs.terms import Columns
from tests.conftest import build_learner, random_columns
from tests.reference import LoopLearner

# Environment, batch size, sequence length, and least ratios: compiled to the loop, end to end to compiled.
SHAPES = {
    "N=9 batch 32": ("maobs/spread-9a", 32, 3, 6.0, 0.75),
    "N=3 batch 128": ("maobs/spread-3a", 128, 5, 3.5, 0.75),
}
# What the loop over agents can learn.
LOOPS = ("iddpg", "maddpg", "maddpg-l")
# Least updates of the compiled learner for one of MADDPG's.
AGAINST_MADDPG = {"maddpg-lstm": 0.3, "facmac": 0.7, "qmix": 0.7}


def config_of(algorithm: str, shape: str, critic_state: str, compiled: bool = True) -> maobs.JointConfig:
    """The paper's settings without evaluation."""
    env, batch_size, seq_length, *_ = SHAPES[shape]
    config = maobs.ALGORITHMS[algorithm]()
    discrete = config.abilities.actions == ("discrete",)
    config.environment(env, env_config={"action_mode": "discrete"} if discrete else {})
    config.training(train_batch_size_per_learner=batch_size, replay_buffer_capacity=50_000, critic_state=critic_state)
    config.training(seq_length=seq_length).framework(torch_compile_learner=compiled)
    return config.reporting(min_sample_timesteps_per_iteration=400).debugging(seed=0)


def rate(work: Callable[[], int], seconds: float) -> float:
    """Calls `work`, which returns how many updates it made, for some seconds; updates per second."""
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        count += work()
    return count / (time.perf_counter() - start)


def loop_update(algorithm: str, learner: JointLearner, columns: Columns) -> Callable[[], int]:
    """An update of the loop over agents."""
    config, team = learner.config, learner.config.team
    sizes = (len(team.agents), team.observation_size, team.action_size, config.state_size)
    loop = LoopLearner(algorithm, *sizes)
    batch = learner.prepare(columns, {})._asdict()
    sample = {name: value for name, value in batch.items() if isinstance(value, torch.Tensor)}
    sample["terminated"] = (sample.pop("discount") == 0).float()

    def update() -> int:
        loop.update(sample)
        return 1

    return update


def stacked_update(learner: JointLearner, columns: Columns) -> Callable[[], int]:
    """An update of ours."""

    def update() -> int:
        learner.step(columns)
        return 1

    return update


def measure(algorithm: str, shape: str, critic_state: str, rounds: int, seconds: float) -> dict[str, float]:
    """Median rates (per second) of the ways, and the median ratios of the rounds."""
    eager = build_learner(config_of(algorithm, shape, critic_state, compiled=False))
    start = time.perf_counter()
    algo = config_of(algorithm, shape, critic_state).build_algo()
    algo.train()
    first = time.perf_counter() - start
    columns = random_columns(algo.config, SHAPES[shape][1])
    maddpg = build_learner(config_of("maddpg", shape, critic_state))

    def train() -> int:
        algo.train()
        return 400

    ways: dict[str, Callable[[], int]] = {
        "eager": stacked_update(eager, columns),
        "compiled": stacked_update(algo._learner, columns),
        "maddpg": stacked_update(maddpg, random_columns(maddpg.config, SHAPES[shape][1])),
        "end to end": train,
    }
    if algorithm in LOOPS:
        ways["loop"] = loop_update(algorithm, eager, columns)
    for work in ways.values():
        work()
    rates: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, work in ways.items():
            rates[name].append(rate(work, seconds))
    algo.stop()

    def ratio(a: str, b: str) -> float:
        return statistics.median(x / y for x, y in zip(rates[a], rates[b], strict=True)) if b in rates else math.nan

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
    failed = False
    print(
        "| algorithm | shape | loop /s | eager /s | compiled /s | train() /s | x loop | x MADDPG | train()/compiled |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for algorithm in arguments.algos:
        for shape, (*_, least, share) in SHAPES.items():
            r = measure(algorithm, shape, arguments.critic_state, arguments.rounds, arguments.seconds)
            print(
                f"| {algorithm} | {shape} | {shown(r['loop'], 0)} | {r['eager']:.0f} | {r['compiled']:.0f} "
                f"| {r['end to end']:.0f} | {shown(r['compiled/loop'], 1)} | {r['compiled/maddpg']:.2f} "
                f"| {r['end to end/compiled']:.2f} |",
                flush=True,
            )
            below = []
            if algorithm == "maddpg" and (r["compiled/loop"] < least or r["end to end/compiled"] < share):
                below.append(f"at least {least} x loop and {share} of the compiled update end to end")
            if r["compiled/maddpg"] < AGAINST_MADDPG.get(algorithm, 0.0):
                below.append(f"at least {AGAINST_MADDPG[algorithm]} of MADDPG's updates")
            failed = failed or bool(below)
            for bar in below:
                print(f"below the bar: {bar}")
    sys.exit(failed)


if __name__ == "__main__":
    main()
