"""The tuned preset of an example on a GPU: updates, training, and checkpoints that change the device; in five minutes.

    OMP_NUM_THREADS=1 python tests/benchmarks/gpu.py
    OMP_NUM_THREADS=1 python tests/benchmarks/gpu.py --device cpu        # the same trip where there is no GPU

Networks, optimisers and replay are on the device (`num_gpus_per_learner=1`), environments on the CPU. It prints
updates/s (from replay, and on one minibatch again and again) and env steps/s of `train()`, compiled unless told
otherwise, beside those of the CPU; then a checkpoint of the device goes on training on the CPU, and one of that on the
device: weights, Adam's means and replay must arrive to the bit.

So far this was run with `--device cpu` only: no GPU has been at hand, so what it does there has not been tried.
"""

import argparse
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import ray
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))

import rllib_maobs as maobs
from tests.benchmarks.grid import spec_of
from tests.benchmarks.internals import adam_means, learner_of, minibatch, replayed_updates_of, update_of, weights_of
from tests.benchmarks.measure import Work, count, end, row

DRAW = 16  # minibatches of one draw


def config_on(device: str, experiment: str, compiled: bool) -> Any:
    """The example's tuned preset, without evaluation, learning on a device."""
    config = spec_of(experiment, "maddpg-entity", "world")[0].build_config()
    config.evaluation(evaluation_interval=10**9).learners(num_gpus_per_learner=int(device == "cuda"))
    return config.framework(torch_compile_learner=compiled)


def until_learning(algo: Any) -> Any:
    """Trains until there are updates."""
    while not any(key != "__all_modules__" for key in algo.train().get("learners", {})):
        pass
    return algo


def waited(work: Work, device: str) -> Work:
    """Work that is over when the device has done it."""

    def done() -> int:
        made = work()
        if device == "cuda":
            torch.cuda.synchronize()
        return made

    return done


def rates(algo: Any, device: str, seconds: float) -> list[float]:
    """Updates/s from replay, updates/s on one minibatch, and env steps/s of `train()`."""
    size, copies = algo.config.train_batch_size_per_learner, algo.config.num_envs_per_env_runner

    def train() -> int:
        algo.train()
        least: int = algo.config.min_sample_timesteps_per_iteration
        return -(-least // copies) * copies

    ways = replayed_updates_of(algo, DRAW, size), update_of(learner_of(algo), minibatch(algo, size)), train
    result = []
    for work in map(partial(waited, device=device), ways):
        work()
        result.append(count(work, seconds).rate)
    return result


def numbers(algo: Any) -> list[bytes]:
    """What a checkpoint must bring back: weights, Adam's means, and the columns of replay."""
    state = algo.replay_buffer.get_state()
    columns = [torch.from_numpy(column.copy()) for column in state["columns"].values()]
    tensors = (*weights_of(algo), *adam_means(learner_of(algo)), *columns)
    return [tensor.detach().cpu().numpy().tobytes() for tensor in tensors]  # memory never written may be NaN


def main() -> None:
    """Prints the table and the trip of the checkpoint; exits with 1 if something did not arrive."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda")
    parser.add_argument("--experiment", choices=["spread3a", "spread6a", "spread9a"], default="spread9a")
    parser.add_argument("--seconds", type=float, default=5.0, help="per measurement")
    parser.add_argument("--no-compile", dest="compiled", action="store_false")
    arguments = parser.parse_args()
    if arguments.device == "cuda" and not torch.cuda.is_available():
        parser.error("PyTorch finds no GPU here: --device cpu goes the same way without one.")
    gpus = int(arguments.device == "cuda")
    ray.init(address="local", num_cpus=1, num_gpus=gpus, include_dashboard=False, log_to_driver=False)
    maobs.register()

    header = ["device", "replay on", "first updates after", "updates/s from replay", "on one minibatch"]
    header.append("train(), env steps/s")
    print(f"{row(header)}\n|{'---|' * len(header)}")
    algos = {}
    for device in dict.fromkeys([arguments.device, "cpu"]):
        start = time.perf_counter()
        algo = algos[device] = until_learning(config_on(device, arguments.experiment, arguments.compiled).build_algo())
        first = time.perf_counter() - start
        where = minibatch(algo, 1).rewards.device.type
        cells = [f"{rate:.1f}" for rate in rates(algo, device, arguments.seconds)]
        print(row([device, where, f"{first:.0f} s", *cells]), flush=True)

    missed = []
    algo = algos[arguments.device]
    for there in ("cpu", arguments.device):
        with tempfile.TemporaryDirectory() as folder:
            sent = numbers(algo)
            algo.save_to_path(folder)
            other = config_on(there, arguments.experiment, arguments.compiled).build_algo()
            other.restore_from_path(folder)
        arrived = sent == numbers(other)
        until_learning(other)
        moved = not torch.equal(weights_of(algo)[0].cpu(), weights_of(other)[0].cpu())
        print(
            f"a checkpoint to {there}: {'arrived to the bit' if arrived else 'DIFFERS'}, goes on: {moved}", flush=True
        )
        missed += [] if arrived and moved else [f"a checkpoint that arrives on {there} and goes on"]
        algo = other
    end(missed)


if __name__ == "__main__":
    main()
