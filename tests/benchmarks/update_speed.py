"""How fast one update is, against a loop over agents, and how much of it is left end to end; on one core.

    OMP_NUM_THREADS=1 python tests/benchmarks/update_speed.py

For each shape of the paper it times, in turns so that a drift of the machine's speed hits all alike:
the loop over agents in ordinary PyTorch (`tests/reference.py`), the stacked update eager and compiled, and
`algo.train()` with one update per env step: sampling, replay, update, metrics and weight sync together.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import ray
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))

import rllib_maobs as maobs
from tests.conftest import random_batch
from tests.reference import LoopLearner

# Environment, batch size, and the least ratios: compiled against the loop, end to end against compiled.
SHAPES = {"N=9 batch 32": ("maobs/spread-9a", 32, 6.0, 0.75), "N=3 batch 128": ("maobs/spread-3a", 128, 3.5, 0.75)}


def config_of(algorithm: str, env: str, batch_size: int, critic_state: str) -> maobs.JointConfig:
    """The paper's settings without evaluation."""
    config = maobs.ALGORITHMS[algorithm]().environment(env)
    config.training(train_batch_size_per_learner=batch_size, replay_buffer_capacity=50_000, critic_state=critic_state)
    return config.reporting(min_sample_timesteps_per_iteration=400).debugging(seed=0)


def rate(work: Callable[[], int], seconds: float) -> float:
    """Calls `work`, which returns how many updates it made, for some seconds; updates per second."""
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        count += work()
    return count / (time.perf_counter() - start)


def measure(algorithm: str, env: str, batch_size: int, critic_state: str, rounds: int, seconds: float) -> dict:
    """Median rates (per second) of the four ways, and the median ratios of the rounds."""
    eager = config_of(algorithm, env, batch_size, critic_state).build_algo()
    start = time.perf_counter()
    algo = config_of(algorithm, env, batch_size, critic_state).framework(torch_compile_learner=True).build_algo()
    algo.train()
    first = time.perf_counter() - start
    config, learner, eager_learner = algo.config, algo._learner, eager._learner
    team = config.team
    sizes = (len(team.agents), team.observation_size, team.action_size, config.state_size)
    loop = LoopLearner(algorithm, *sizes)
    batch = random_batch(config, batch_size)

    def train() -> int:
        algo.train()
        return 400

    ways: dict[str, Callable[[], int]] = {
        "loop": lambda: loop.update(batch._asdict()) or 1,
        "eager": lambda: bool(eager_learner.step(batch)),
        "compiled": lambda: bool(learner.step(batch)),
        "end to end": train,
    }
    rates: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, work in ways.items():
            rates[name].append(rate(work, seconds))
    algo.stop()
    eager.stop()

    def ratio(a: str, b: str) -> float:
        return statistics.median(x / y for x, y in zip(rates[a], rates[b], strict=True))

    return {
        **{name: statistics.median(values) for name, values in rates.items()},
        "compiled/loop": ratio("compiled", "loop"),
        "end to end/compiled": ratio("end to end", "compiled"),
        "first": first,
    }


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
    print("| algorithm | shape | loop /s | eager /s | compiled /s | train() /s | x loop | train()/compiled | first s |")
    print("|---|---|---|---|---|---|---|---|---|")
    for algorithm in arguments.algos:
        for shape, (env, batch_size, least, share) in SHAPES.items():
            r = measure(algorithm, env, batch_size, arguments.critic_state, arguments.rounds, arguments.seconds)
            print(
                f"| {algorithm} | {shape} | {r['loop']:.0f} | {r['eager']:.0f} | {r['compiled']:.0f} "
                f"| {r['end to end']:.0f} | {r['compiled/loop']:.1f} | {r['end to end/compiled']:.2f} "
                f"| {r['first']:.0f} |",
                flush=True,
            )
            if algorithm == "maddpg" and (r["compiled/loop"] < least or r["end to end/compiled"] < share):
                failed = True
                print(f"below the bar: at least {least} x loop and {share} of the compiled update end to end")
    sys.exit(failed)


if __name__ == "__main__":
    main()
