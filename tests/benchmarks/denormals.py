"""How many denormal numbers gather in Adam's means, with and without flushing them, and what updates then take.

    OMP_NUM_THREADS=1 python tests/benchmarks/denormals.py
    OMP_NUM_THREADS=2 python tests/benchmarks/denormals.py --algo facmac --updates 4000

Weights that get no gradient (those of units that are never active) have means that decay below 1.2e-38, where
processors go on with fewer digits. Intel's take a hundred times as long for that, AMD's hardly longer: on an AMD
machine the counts are what there is to see, and the times tell what flushing costs.

Two learners start alike and make the same updates on minibatches of one replay buffer, in turns: one as the package
does it, one with the flushing taken out. Counted are numbers of Adam's two means, times are medians.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

import ray
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))

import rllib_maobs as maobs
from tests.benchmarks.internals import adam_means, flushing, learner_of, minibatch
from tests.benchmarks.measure import row

BLOCK = 50  # updates on one draw of minibatches


@contextmanager
def unflushed() -> Iterator[None]:
    """Takes the flushing out of the package's updates, for a block."""
    with mock.patch(flushing("mode"), nullcontext), mock.patch(flushing("cleaning"), lambda adam: None):
        yield


def denormals(learner: Any) -> list[float]:
    """Which share of Adam's first and second means is denormal."""
    shares = []
    for means in adam_means(learner):
        # By their bits: a processor that flushes would call them zero.
        bits = means.abs().view(torch.int32)
        shares.append(float(((bits > 0) & (bits < 0x00800000)).float().mean()))
    return shares


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algo", choices=sorted(maobs.ALGORITHMS), default="maddpg")
    parser.add_argument("--env", default="maobs/spread-9a")
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--updates", type=int, default=2000)
    parser.add_argument("--no-compile", dest="compiled", action="store_false")
    arguments = parser.parse_args()
    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False)

    def build() -> Any:
        config = maobs.ALGORITHMS[arguments.algo]().environment(arguments.env).debugging(seed=0)
        config.training(train_batch_size_per_learner=arguments.batch, replay_buffer_capacity=20_000)
        config.training(num_steps_sampled_before_learning_starts=20_000)
        config.reporting(min_sample_timesteps_per_iteration=4000)
        return config.framework(torch_compile_learner=arguments.compiled).build_algo()

    ways = {"flushed": (build(), nullcontext), "not": (build(), unflushed)}
    source = ways["flushed"][0]
    source.train()  # random weights act; all updates are made below
    times: dict[str, list[float]] = {name: [] for name in ways}
    print(f"{arguments.algo}, {arguments.env}, batch {arguments.batch}, {torch.get_num_threads()} threads\n")
    header = ["updates", *(f"{what}, {name}" for name in ways for what in ("first means", "second means"))]
    print(f"{row(header)}\n|{'---|' * len(header)}")
    for made in range(0, arguments.updates, BLOCK):
        batch = minibatch(source, BLOCK, arguments.batch)
        for name, (algo, way) in ways.items():
            with way():
                start = time.perf_counter()
                learner_of(algo).update(batch=batch, _no_metrics_reduce=True)
                if made:  # the first block compiles
                    times[name].append((time.perf_counter() - start) / BLOCK)
        if (made + BLOCK) % max(BLOCK, arguments.updates // 8) < BLOCK:
            shares = [share for algo, _ in ways.values() for share in denormals(learner_of(algo))]
            print(row([str(made + BLOCK), *(f"{100 * share:.2f} %" for share in shares)]), flush=True)
    flushed, plain = (statistics.median(own) for own in times.values())
    ratio = statistics.median(p / f for f, p in zip(*times.values(), strict=True))
    print(f"\nan update takes {1e3 * flushed:.3f} ms flushed, {1e3 * plain:.3f} ms not: median ratio {ratio:.2f}")


if __name__ == "__main__":
    main()
