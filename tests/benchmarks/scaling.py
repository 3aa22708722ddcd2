"""How speed scales: with the number of agents, of environment copies, of EnvRunner actors, and of trials at once.

    OMP_NUM_THREADS=1 python tests/benchmarks/scaling.py
    OMP_NUM_THREADS=1 python tests/benchmarks/scaling.py --parts agents two --seconds 1 --plot scaling.png

It prints a table per part, draws a figure of them, and exits with 1 if a bar is missed. All on `spread-9a`, batch 32:

- agents: the compiled update of teams of 3 to 27, with obstacles in proportion; critics see all actions (MADDPG) or
  their own only (MADDPG-L), and all observations or the world's state. Below each its limit (`grid.limit`): the time
  that the update's matrix products take by themselves, and its numbers once through the memory. N^k says how the time
  has grown since the team before. The fastest calls count.
- copies: `train()` of MADDPG with one update per env step and 1 to 32 environment copies.
- runners: the same, eight copies each, with EnvRunner actors in processes of their own; and with hardly any updates.
- two: two such trials at once, each bound to a core with its Ray, against one alone, in turns; medians of the rounds.

Every configuration runs in a process of its own, bound to a core (runners: free on two). Two at once start and compile,
which takes some 30 s, but one at a time is measured. All parts take some 12 minutes on two free cores. Progress goes to
stderr, with the share of a core's time that a process had while it was measured: on a busy machine it is below 1, and
the numbers say little.
"""

import argparse
import itertools
import math
import statistics
import sys
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.benchmarks.measure import Stopwatch, best, count, end, in_turns, row
from tests.benchmarks.workers import ROOT, Job, Worker, free_cores

TEAMS, COPIES, RUNNERS = [3, 6, 9, 18, 27], [1, 2, 4, 8, 16, 32], [0, 1, 2]
CRITICS = [(algorithm, state) for algorithm in ("maddpg", "maddpg-l") for state in ("observations", "world")]
HARDLY = 0.01  # updates per env step where sampling is measured
ROUNDS = 8
TWO = 1.7  # bar: env steps/s of two trials at once, relative to one


class Cell(NamedTuple):
    """A configuration, and whether its update alone is measured or `train()`."""

    update: bool = False
    agents: int = 9
    algorithm: str = "maddpg"
    state: str = "observations"
    copies: int = 8
    runners: int = 0
    updates: float = 1.0


def update_job(config: Any) -> Job:
    """Compile the update alone; measured are it and its limit."""
    from tests.benchmarks.internals import number_of_parameters, update_of
    from tests.benchmarks.limit import limit
    from tests.conftest import build_learner, random_batch

    learner = build_learner(config)
    batch = random_batch(config)
    update = update_of(learner, batch)

    def measure(seconds: float) -> dict[str, float]:
        fastest = best(update, seconds)
        return {"update": fastest, "limit": limit(learner, batch), "parameters": number_of_parameters(learner)}

    return Job(measure)


def train_job(config: Any) -> Job:
    """Start Ray and compile; measured are `train()`, and the seconds of an update in it."""
    import ray

    from tests.benchmarks.internals import watch_update

    ray.init(address="local", num_cpus=3, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    algo, stopwatch = config.build_algo(), Stopwatch()
    sampled = algo.train()["num_env_steps_sampled_lifetime"]
    watch_update(algo, stopwatch)

    def train() -> int:
        nonlocal sampled
        before, sampled = sampled, algo.train()["num_env_steps_sampled_lifetime"]
        return int(sampled - before)

    def measure(seconds: float) -> dict[str, float]:
        stopwatch.seconds.clear()
        trained = count(train, seconds)
        return {"rate": trained.rate, "update": stopwatch.seconds["update"] / trained.made}

    return Job(measure)


def prepare(*cell: Any) -> Job:
    """Be the target of a worker: build a configuration and measure once, for a moment."""
    from tests.benchmarks.update_speed import config_of

    own = Cell(*cell)
    room = max(1.0, math.sqrt(own.agents / 9))  # as much for each as nine have
    options = {"num_agents": own.agents, "num_obstacles": 2 * own.agents // 3}
    options |= {"agent_range": room, "obstacle_range": 0.9 * room}
    config = config_of(own.algorithm, "N=9 batch 32", own.state).environment(env_config=options)
    config.env_runners(num_env_runners=own.runners, num_envs_per_env_runner=own.copies)
    config.training(updates_per_env_step=own.updates)
    job = (update_job if own.update else train_job)(config)
    job.measure(0.1)
    return job


def worker_of(cell: Cell, cores: set[int]) -> Worker:
    """Start a configuration in a process of its own."""
    return Worker("tests.benchmarks.scaling:prepare", *cell, cores=cores)


def answer(cell: Cell, worker: Worker) -> dict[str, float]:
    """Wait for what a configuration's process measured."""
    result: dict[str, float] = worker.answer()
    numbers = ", ".join(f"{name} {value:.3g}" for name, value in {**result, "share of a core": worker.share}.items())
    print(f"{cell}: {numbers}", file=sys.stderr, flush=True)
    return result


def run(cells: list[Cell], cores: list[set[int]], seconds: float) -> dict[Cell, dict[str, float]]:
    """Measure cells one at a time, after as many as there are sets of cores have been compiled at once."""
    results = {}
    for first in range(0, len(cells), len(cores)):
        workers = {cell: worker_of(cell, own) for cell, own in zip(cells[first:], cores, strict=False)}
        for worker in workers.values():
            worker.ready()
        for cell, worker in workers.items():
            worker.ask(seconds)
            results[cell] = answer(cell, worker)
            worker.close()
    return results


def table(header: list[str], rows: list[list[str]]) -> None:
    """Print a table in Markdown."""
    print("\n" + "\n".join(map(row, (header, ["---"] * len(header), *rows))), flush=True)


def with_exponents(values: list[float], cells: list[str]) -> list[str]:
    """Add to the cells of every team but the first the exponent with which values have grown since the one before."""
    for i in range(1, len(TEAMS)):
        cells[i] += f" N^{math.log(values[i] / values[i - 1], TEAMS[i] / TEAMS[i - 1]):.1f}"
    return cells


def finish(axes: Axes, title: str, x: str, y: str, ticks: list[int]) -> None:
    """Label axes; x is logarithmic where there is much of it."""
    axes.set(title=title, xlabel=x, ylabel=y, xscale="log" if len(ticks) > 3 else "linear")
    axes.set_xticks(ticks, labels=map(str, ticks))
    axes.set_xticks([], minor=True)
    axes.yaxis.set_major_formatter("{x:,g}")
    axes.legend(fontsize="small")


def agents(cores: list[int], seconds: float, axes: Axes) -> list[str]:
    """Time of an update and its limit by number of agents."""
    results = run([Cell(True, n, *critic) for n in TEAMS for critic in CRITICS], [{core} for core in cores], seconds)
    rows = []
    for index, critic in enumerate(CRITICS):
        mine = [results[Cell(True, n, *critic)] for n in TEAMS]
        for what, name, style in (("update", f"{critic[0].upper()}, {critic[1]}", "o-"), ("limit", "its limit", ":")):
            times = [1e3 * r[what] for r in mine]
            rows.append([name, *with_exponents(times, [f"{1e3 / t:,.0f} ({t:.2f} ms)" for t in times])])
            axes.plot(TEAMS, times, style, color=f"C{index}", label=name if what == "update" else None)
        numbers = [r["parameters"] for r in mine]
        rows.append(["its parameters", *with_exponents(numbers, [f"{n / 1e3:,.0f} thousand" for n in numbers])])
    table(["updates/s", *(f"N = {n}" for n in TEAMS)], rows)

    low = min(1e3 * result["limit"] for result in results.values())
    for power, name in ((1, "N"), (2, "N²")):  # what slopes mean
        axes.plot(TEAMS, [low * (n / TEAMS[0]) ** power for n in TEAMS], color="0.8", lw=1, zorder=0)
        axes.text(TEAMS[-1], low * (TEAMS[-1] / TEAMS[0]) ** power, f"  {name}", color="0.5", va="center")
    axes.plot([], [], ":", color="0.4", label="limit: products and memory")
    axes.set(yscale="log", xlim=(2.7, 34))
    finish(axes, "An update, batch 32", "agents N", "time of an update, ms", TEAMS)
    return []


def copies(cores: list[int], seconds: float, axes: Axes) -> list[str]:
    """`train()` by number of environment copies."""
    results = list(run([Cell(copies=n) for n in COPIES], [{core} for core in cores], seconds).values())
    rows = []
    for n, r in zip(COPIES, results, strict=True):
        times = [1e3 / r["rate"], 1e3 * r["update"], 1e3 / r["rate"] - 1e3 * r["update"]]
        rows.append([f"{n}", f"{r['rate']:.0f}", f"{r['rate'] / results[0]['rate']:.2f}", *(f"{t:.2f}" for t in times)])
    table(["copies", "env steps/s", "x one copy", "ms per env step", "of it the update", "all else"], rows)
    axes.plot(COPIES, [r["rate"] for r in results], "o-", label="train(), one update per env step")
    axes.plot(COPIES, [1 / r["update"] for r in results], ":", color="0.4", label="the updates in it alone")
    axes.set_ylim(0, 1.3 / min(r["update"] for r in results))
    finish(axes, "train(), MADDPG, 9 agents", "environment copies", "env steps/s", COPIES)
    return []


def runners(cores: list[int], seconds: float, axes: Axes) -> list[str]:
    """`train()` by number of EnvRunner actors, with an update per env step and with hardly any."""
    cells = [Cell(runners=n, updates=updates) for n in RUNNERS for updates in (1.0, HARDLY)]
    results = run(cells, [set(cores)], seconds)
    rates = {u: [results[Cell(runners=n, updates=u)]["rate"] for n in RUNNERS] for u in (1.0, HARDLY)}
    names = ["one update per env step", f"{HARDLY:g} updates per env step"]
    rows = [[str(n), *(f"{own[i]:,.0f}" for own in rates.values())] for i, n in enumerate(RUNNERS)]
    table(["EnvRunner actors", *(f"env steps/s, {name}" for name in names)], rows)
    print(f"\nOn {len(cores)} core(s); without actors the trial's own process samples.")
    for name, own in zip(names, rates.values(), strict=True):
        axes.plot(RUNNERS, own, "o-", label=name)
        for n, rate in zip(RUNNERS, own, strict=True):
            axes.text(n, 1.3 * rate, f"{rate:,.0f}", ha="center", fontsize="small")
    axes.set(yscale="log", xlim=(-0.4, 2.4), ylim=(0.3 * min(rates[1.0]), 20 * max(rates[HARDLY])))
    finish(axes, f"train() on {len(cores)} core(s)", "EnvRunner actors, 8 copies each", "env steps/s", RUNNERS)
    return []


def two(cores: list[int], seconds: float, axes: Axes) -> list[str]:
    """Two trials at once against one alone; returns the bar if it is missed."""
    workers = [worker_of(Cell(), {core}) for core in cores]
    for worker in workers:
        worker.ready()

    def rate(at_once: list[Worker]) -> float:
        for worker in at_once:
            worker.ask(seconds)
        return sum(answer(Cell(), worker)["rate"] for worker in at_once)

    alone = itertools.cycle(workers)
    ways = {"one": lambda: rate([next(alone)]), "both": partial(rate, workers)}
    rates = list(in_turns(ways, ROUNDS).values())
    for worker in workers:
        worker.close()
    one, both = map(statistics.median, rates)
    values = [("1", one, "1"), ("2", both, f"{both / one:.2f}")]
    rows = [[n, f"{m:.0f}", f"{min(r):.0f} to {max(r):.0f}", x] for (n, m, x), r in zip(values, rates, strict=True)]
    table(["trials at once, a core each", "env steps/s in sum", "all rounds", "x one alone"], rows)
    axes.bar_label(axes.bar([1, 2], [one, both], 0.5), fmt="{:.0f}")
    axes.axhline(TWO * one, ls=":", color="0.4", label=f"bar: {TWO:g} x one alone")
    axes.set(xlim=(0.4, 2.6), ylim=(0, 2.5 * one))
    finish(axes, "Trials at once, a core each", "trials at once", "env steps/s in sum", [1, 2])
    return [f"two trials at once make {both / one:.2f} x the env steps of one, not {TWO:g}"] if both < TWO * one else []


PARTS = {"agents": agents, "copies": copies, "runners": runners, "two": two}


def main() -> None:
    """Print the tables, draw the figure; exit with 1 if a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--seconds", type=float, default=4.0, help="per measurement")
    parser.add_argument("--plot", type=Path, default=ROOT / "docs" / "media" / "scaling.png", help="the figure's file")
    arguments = parser.parse_args()
    cores = free_cores()[:2]
    if "two" in arguments.parts and len(cores) < 2:
        parser.error("--parts: two trials at once need two cores, and this process may use one")

    missed, count = [], len(arguments.parts)
    size = -(-count // 2), min(2, count)
    figure = Figure(figsize=(4.8 * size[1], 3.6 * size[0]), layout="constrained")
    FigureCanvasAgg(figure)
    for index, part in enumerate(arguments.parts):
        missed += PARTS[part](cores, arguments.seconds, figure.add_subplot(*size, index + 1))
    figure.savefig(arguments.plot, dpi=150)
    end(missed)


if __name__ == "__main__":
    main()
