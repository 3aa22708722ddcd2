"""What an experiment says before it starts: how many trials, how long they take here, where results go."""

import shlex
import shutil
import time
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import ray

from rllib_maobs.experiment.progress import makespan
from rllib_maobs.experiment.report import load_curves
from rllib_maobs.experiment.storage import shown
from rllib_maobs.experiment.tables import format_table, format_time
from rllib_maobs.experiment.trial import Pace, TrialSpec, measure_pace

# Settings whose value does not change how long an update takes: rows that differ in nothing else are measured once.
_NO_COST = {"actor_lr", "critic_lr", "gamma", "tau", "exploration", "reward_scale"}


def of_one_seed(specs: Sequence[TrialSpec]) -> list[TrialSpec]:
    """Return the trials of the first seed: one for each row of the comparison."""
    return [spec for spec in specs if spec.seed == specs[0].seed]


def print_plan(name: str, args: Namespace, specs: Sequence[TrialSpec], note: str = "") -> None:
    """Print how many trials there are, what they take on this machine, and where results will be.

    Args:
        name: Of the experiment.
        args: Of the command line.
        specs: The trials; of a search, its rows.
        note: A line that stands below the first one.
    """
    rows = {spec.algorithm: spec for spec in of_one_seed(specs)}
    count = args.num_samples if args.search else len(specs)
    named = ", ".join(args.algos if len(rows) > len(args.algos) else rows)
    print(f"{name}: {count} trial{'s' * (count != 1)}, {named} with seed {', '.join(map(str, args.seeds))}")
    if args.search:
        print(f"Optuna chooses their settings one after the other: {' '.join(args.sweep or [])}")
    elif len(rows) > len(args.algos):
        print(f"Each with what it takes of the sweep: {len(rows)} rows for each seed.")
    if args.start_from:
        print(f"Networks start from {args.start_from}")
    if note:
        print(note)
    pace: dict[str, Pace] = {}
    # A quick run of its own size takes minutes: to measure how many would compile everything once more.
    if args.quick and args.stop_timesteps is None and count == len(args.algos):
        estimate = "Estimated: at most about five minutes on two free cores; in a quick run nothing is measured."
    else:
        pace, estimate = _measured(args, specs, count)
    header = ["algorithm", "env steps", "updates per env step"]
    cells = [
        [name, f"{spec.stop_timesteps:,}", f"{spec.build_config().updates_per_env_step:g}"]
        for name, spec in rows.items()
    ]
    if pace:
        header += ["env steps/s", "time per trial"]
        for (name, spec), row in zip(rows.items(), cells, strict=True):
            speed = pace[name].env_steps_per_s
            row += [f"{speed:.0f}", format_time(spec.stop_timesteps / speed)]
    print(
        f"\n{format_table(header, cells)}\n\n{estimate}\n"
        f"Results: {shown(args)}\n"
        f"TensorBoard: tensorboard --logdir {shlex.quote(shown(args))}\n"
        f"A trial that fails goes on from its last checkpoint, {args.max_failures} times at most (--max-failures).\n"
        f"Ctrl-C stops; then --resume goes on from the last checkpoints.\n",
        flush=True,
    )


def print_rest(args: Namespace, specs: Sequence[TrialSpec], longer: Sequence[str]) -> None:
    """Print what a resumed run that was lengthened, or has more trials, has left to do, and what that takes.

    Args:
        args: Of the command line.
        specs: All trials.
        longer: Names of those that go on for longer than they were meant to.
    """
    try:
        curves = load_curves(args.results_dir)
    except FileNotFoundError:  # It ended before anything was evaluated: nothing is known.
        return
    done = curves.groupby("trial")["env_steps"].max()
    speeds = curves.groupby("algorithm")["env_steps_per_s"].median()
    left = [(spec.algorithm, spec.stop_timesteps - int(done.get(spec.name, 0))) for spec in specs]
    seconds = [steps / speeds.get(algorithm, speeds.mean()) for algorithm, steps in left if steps > 0]
    at_once = _at_once(args, len(seconds))
    new = sum(spec.name not in done.index for spec in specs)
    print(
        f"{len(specs)} trials; {new} have no result yet, {len(longer)} go on for longer.\n"
        f"Estimated: {makespan(seconds, at_once) / 3600:.2f} hours for all that is left, {at_once} at once, if they "
        f"are as fast as those before.\n",
        flush=True,
    )


def _at_once(args: Namespace, trials: int) -> int:
    cores = int(ray.cluster_resources().get("CPU", 0))
    return max(1, min(cores // (1 + args.num_env_runners), trials))


def _measured(args: Namespace, specs: Sequence[TrialSpec], count: int) -> tuple[dict[str, Pace], str]:
    """Measure the pace of each row; return it, and what it says of the whole run."""
    compiles = any(spec.torch_compile for spec in specs)
    print(f"Measuring how fast that is here{' (and compiling)' if compiles else ''} ...", flush=True)
    start = time.monotonic()
    rows = of_one_seed(specs)
    at_once = _at_once(args, count)
    pace = _measure(rows, at_once, seconds=2.0 if args.quick else 10.0)
    each = [spec.stop_timesteps / pace[spec.algorithm].env_steps_per_s for spec in specs]
    # A search chooses among the rows, and stops most trials early.
    total = makespan([sum(each) / len(each)] * count if args.search else each, at_once)
    megabytes = max(
        min(spec.stop_timesteps, spec.build_config().replay_buffer_capacity)
        * pace[spec.algorithm].bytes_per_env_step
        / 1e6
        for spec in rows
    )
    free = "" if args.storage else f"; free disk: {shutil.disk_usage(args.results_dir).free / 1e6:,.0f} MB"
    return pace, (
        f"Measured with {at_once} at once in {format_time(time.monotonic() - start)}, with evaluation. Compiling "
        f"is not in what follows.\n"
        f"Estimated: {'at most ' if args.search else ''}{total / 3600:.2f} hours for all, {at_once} at once.\n"
        f"Replay will take up to {megabytes:,.0f} MB of memory per trial, and twice that of disk in its two "
        f"checkpoints{free}."
    )


def _measure(specs: Sequence[TrialSpec], at_once: int, seconds: float) -> dict[str, Pace]:
    """Measure the pace of each row with so many at once as there will be trials."""
    alike: dict[str, list[TrialSpec]] = {}
    for spec in specs:
        alike.setdefault(_costs(spec), []).append(spec)
    measure = ray.remote(num_cpus=1)(measure_pace)
    pace: dict[str, Pace] = {}
    waiting, running = list(alike.values()), dict[Any, list[TrialSpec]]()
    while waiting or running:
        while waiting and len(running) < at_once:
            group = waiting.pop(0)
            running[measure.remote(group[0], seconds)] = group
        (done,), _ = ray.wait(list(running))
        pace |= dict.fromkeys((spec.algorithm for spec in running.pop(done)), ray.get(done))
    return pace


def _costs(spec: TrialSpec) -> str:
    """Return what decides how fast a trial is."""
    training = {key: value for key, value in spec.training.items() if key not in _NO_COST}
    return repr(replace(spec, algorithm="", variant_of=spec.variant_of or spec.algorithm, varied={}, training=training))
