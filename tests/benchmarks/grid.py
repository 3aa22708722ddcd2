"""How long the paper's whole grid takes on this machine, where the time goes, and how far it is from the limit.

    OMP_NUM_THREADS=1 python tests/benchmarks/grid.py
    OMP_NUM_THREADS=1 python tests/benchmarks/grid.py --experiments spread9a --algos maddpg maddpg-lstm --seconds 10

A cell is an experiment of `tuned_examples/` (its environment, batch size, window) and one of its algorithms, trained as
its script would: one update per env step, an evaluation every 1000. Each runs in a process of its own, bound to a core,
as many at once as `--cores`: a core's neighbours are as busy as they will be. Measured is a warmed-up time after
compiling; the hours are those of the script's env steps at that pace.

The columns: what `train()` makes in env steps/s, and the shares of its time (RLlib's is all that is left: metrics,
weight sync, Python between updates); the update alone, beside the loop over agents in ordinary PyTorch
(`tests/reference.py`, where it has the algorithm), in turns; and the machine's limit: the time that the update's matrix
products take by themselves, each measured on its very shape, and the bytes of parameters, targets and Adam's state over
the bandwidth measured on vectors of that size. The last but one column is `train()` as a share of that limit.
"""

import argparse
import contextlib
import csv
import importlib
import io
import json
import os
import resource
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import Any

import ray
import torch
from torch.utils._python_dispatch import TorchDispatchMode

sys.path.insert(0, str(Path(__file__).parents[2]))

from rllib_maobs.experiment.arguments import make_parser
from rllib_maobs.experiment.trial import TrialSpec
from rllib_maobs.learner import JointLearner
from rllib_maobs.terms import Columns

EXPERIMENTS = ["obstacle_predator_prey", "spread3a", "spread6a", "spread9a", "tunnel", "simple_tunnel"]
EXPERIMENTS += ["simple_tunnel6a"]
PARTS = ["acting", "env", "replay", "update", "evaluation", "RLlib"]
HOURS, RLLIB_SHARE = 24.0, 0.2  # bars
# Matrix products, and which of their arguments are the factors.
PRODUCTS = {
    torch.ops.aten.mm: (0, 1),
    torch.ops.aten.bmm: (0, 1),
    torch.ops.aten.addmm: (1, 2),
    torch.ops.aten.baddbmm: (1, 2),
}


class Clock:
    """Adds up the time that is spent in methods."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self._running = False

    def watch(self, part: str, owner: Any, *names: str) -> None:
        """Counts an object's methods as a part; what one watched method does inside of another counts once."""
        for name in names:
            setattr(owner, name, self._timed(part, getattr(owner, name)))

    def _timed(self, part: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            if self._running:
                return method(*args, **kwargs)
            self._running, start = True, time.perf_counter()
            try:
                return method(*args, **kwargs)
            finally:
                self.seconds[part] += time.perf_counter() - start
                self._running = False

        return timed


def best(work: Callable[[], Any], seconds: float) -> float:
    """Seconds of one call at its fastest: what the machine can do when it is not disturbed."""
    work()
    fastest, end = float("inf"), time.perf_counter() + seconds
    while True:
        start = time.perf_counter()
        for _ in range(5):
            work()
        now = time.perf_counter()
        fastest = min(fastest, (now - start) / 5)
        if now > end:
            return fastest


class Products(TorchDispatchMode):
    """Counts the matrix products that are made, by the shapes and strides of their factors."""

    def __init__(self) -> None:
        super().__init__()
        self.count: Counter[tuple[Any, ...]] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Counts one."""
        if func.overloadpacket in PRODUCTS:
            factors = [args[i] for i in PRODUCTS[func.overloadpacket]]
            self.count[tuple((tuple(f.shape), f.stride()) for f in factors)] += 1
        return func(*args, **(kwargs or {}))


def like(shape: tuple[int, ...], strides: tuple[int, ...]) -> torch.Tensor:
    """A tensor that lies in memory as another one did."""
    extent = 1 + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    return torch.randn(extent).as_strided(shape, strides)


def limit(learner: JointLearner, columns: Columns) -> float:
    """Least seconds of an update here: its matrix products, then all its numbers once through the memory."""
    with torch.no_grad(), Products() as products:
        learner._gradients(learner.nets(), learner.nets(target=True), {}, columns)
    seconds = 0.0
    for shapes, count in products.count.items():
        a, b = (like(*shape) for shape in shapes)
        out = torch.matmul(a, b)
        seconds += count * best(lambda a=a, b=b, out=out: torch.matmul(a, b, out=out), 0.05)
    numbers = sum(stack.flat.numel() for stack in learner._roles.values())
    x, y = torch.zeros(numbers), torch.ones(numbers)
    bandwidth = 12 * numbers / best(lambda: x.add_(y), 0.1)  # reads two, writes one
    # Parameter, target and Adam's two means are read and written, the gradient is read.
    return seconds + 4 * 9 * numbers / bandwidth


def loop_seconds(spec: TrialSpec, learner: JointLearner, columns: Columns, seconds: float) -> tuple[float, float]:
    """Seconds of an update in the loop over agents (nan where it has not the algorithm) and of ours, in turns."""
    from tests.benchmarks.update_speed import LOOPS, loop_update

    ours, loop = float("inf"), float("inf") if spec.algorithm in LOOPS else float("nan")
    reference = loop_update(spec.algorithm, learner, columns) if spec.algorithm in LOOPS else None
    for _ in range(4):
        ours = min(ours, best(lambda: learner.step(columns), seconds / 8))
        if reference is not None:
            loop = min(loop, best(reference, seconds / 8))
    return loop, ours


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

    clock, runner = Clock(), algo.env_runner
    clock.watch("acting", runner, "_act")
    clock.watch("env", runner.env, "step", "reset", "state")
    clock.watch("replay", algo.replay_buffer, "add", "sample")
    clock.watch("update", algo._learner, "step")
    steps, start, total = 0, time.perf_counter(), 0.0
    while total < seconds:
        algo.train()
        steps += spec.steps_per_iteration
        total = time.perf_counter() - start
    parts = {part: clock.seconds[part] / steps for part in PARTS if part in clock.seconds}
    parts["RLlib"] = total / steps - sum(parts.values())
    algo.evaluate()
    parts["evaluation"] = best(algo.evaluate, 0.0) / spec.steps_per_iteration
    per_step = sum(parts.values())

    columns = algo.replay_buffer.sample(
        (config.train_batch_size_per_learner,),
        gamma=config.gamma,
        seq_length=config.seq_length if config.actor == "lstm" else 0,
    )
    loop, ours = loop_seconds(spec, algo._learner, columns, seconds)
    result = {
        "env steps/s": 1.0 / per_step,
        "parts": {part: parts[part] / per_step for part in PARTS},
        "update": ours,
        "loop": loop,
        "limit": limit(algo._learner, columns),
        "first": first,
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 + algo.replay_buffer.nbytes,
    }
    algo.stop()
    return result


def spec_of(experiment: str, algorithm: str, critic_state: str) -> tuple[TrialSpec, int]:
    """A cell's trial as its script makes it, and the script's env steps."""
    own = importlib.import_module(f"tuned_examples.{experiment}").experiment
    parser = make_parser(own.name, own.algorithms, own.stop_timesteps)
    arguments = parser.parse_args(["--algos", algorithm, "--seeds", "0", "--critic-state", critic_state])
    return own.specs(arguments)[0], own.stop_timesteps


def run_cell(experiment: str, algorithm: str, critic_state: str, seconds: float) -> None:
    """A cell's process: prints what it measured as JSON."""
    import rllib_maobs as maobs

    with contextlib.redirect_stdout(io.StringIO()):
        ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
        maobs.register()
        spec, steps = spec_of(experiment, algorithm, critic_state)
        result = measure(spec, seconds)
        ray.shutdown()
    print(json.dumps({**result, "steps": steps}))


def run_cells(cells: list[tuple[str, str]], arguments: argparse.Namespace) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Every cell in a process of its own, one per core at once; yields them in order."""
    cores: Queue[int] = Queue()
    for core in sorted(os.sched_getaffinity(0))[: arguments.cores]:
        cores.put(core)

    def run(cell: tuple[str, str]) -> tuple[str, str, dict[str, Any]]:
        core = cores.get()
        command = [sys.executable, __file__, "--cell", *cell, "--critic-state", arguments.critic_state]
        command += ["--seconds", str(arguments.seconds)]
        try:
            done = subprocess.run(
                command,
                env={**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"},
                preexec_fn=lambda: os.sched_setaffinity(0, {core}),
                capture_output=True,
                text=True,
                check=False,
            )
        finally:
            cores.put(core)
        if done.returncode:
            raise RuntimeError(f"{' '.join(cell)} failed:\n{done.stderr[-4000:]}")
        return *cell, json.loads(done.stdout.splitlines()[-1])

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
        f"{100 * r['limit'] * r['env steps/s']:.0f} %",
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
    parser.add_argument("--cores", type=int, default=min(2, len(os.sched_getaffinity(0))), help="cells at once")
    parser.add_argument("--csv", type=Path, help="file to write the table to, too")
    parser.add_argument("--cell", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if not 1 <= arguments.cores <= len(os.sched_getaffinity(0)):
        parser.error(f"--cores: this process may use {len(os.sched_getaffinity(0))}, not {arguments.cores}")
    if arguments.cell:
        return run_cell(*arguments.cell, arguments.critic_state, arguments.seconds)

    cells = [
        (name, algorithm)
        for name in arguments.experiments
        for algorithm in importlib.import_module(f"tuned_examples.{name}").experiment.algorithms
        if not arguments.algos or algorithm in arguments.algos
    ]
    if not cells:
        parser.error(f"--algos: none of {', '.join(arguments.algos)} is compared in {', '.join(arguments.experiments)}")
    header = ["experiment", "algorithm", "env steps/s", *(f"{part} %" for part in PARTS), "updates/s", "x loop"]
    header += ["limit/s", "of limit", "GB", "hours"]
    print(f"{len(cells)} cells, {arguments.cores} at once\n\n| {' | '.join(header)} |\n|{'---|' * len(header)}")
    rows, results = [], []
    for experiment, algorithm, result in run_cells(cells, arguments):
        rows.append(row_of(experiment, algorithm, result))
        results.append(result)
        print(f"| {' | '.join(rows[-1])} |", flush=True)
    if arguments.csv:
        with arguments.csv.open("w", newline="") as file:
            csv.writer(file).writerows([header, *rows])

    steps = sum(r["steps"] for r in results)
    seconds = sum(r["steps"] / r["env steps/s"] for r in results)
    at_limit = sum(r["steps"] * r["limit"] for r in results)
    hours = seconds / 3600 / arguments.cores
    share = max(r["parts"]["RLlib"] for r in results)
    first = max(r["first"] for r in results)
    print(
        f"\n{steps / 1e6:.0f} million env steps: {hours:.1f} hours on {arguments.cores} core(s), "
        f"{steps / seconds:.0f} env steps/s per core; at the limit {at_limit / 3600 / arguments.cores:.1f} hours. "
        f"RLlib's share is at most {100 * share:.0f} %. First iteration in at most {first:.0f} s, compiling included."
    )
    missed = [f"at most {HOURS:.0f} hours"] if hours > HOURS else []
    missed += [f"at most {100 * RLLIB_SHARE:.0f} % of the time in RLlib"] if share > RLLIB_SHARE else []
    for bar in missed:
        print(f"below the bar: {bar}")
    sys.exit(bool(missed))


if __name__ == "__main__":
    main()
