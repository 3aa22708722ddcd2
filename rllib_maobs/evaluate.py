"""How good is what was trained: `python -m rllib_maobs.evaluate CHECKPOINT... [options of the environment]`.

    python -m rllib_maobs.evaluate results/spread-9a/maddpg-entity-seed0
    python -m rllib_maobs.evaluate results/spread-3a/*-seed0 --csv table.csv --record best.mp4
    python -m rllib_maobs.evaluate results/spread-3a/maddpg-entity-seed0 --num-agents 3 6 9 12 20

CHECKPOINT is the folder of an RLlib algorithm checkpoint (of this package, or of a stock algorithm trained on
`MAObsEnv`), or of a trial, whose last checkpoint counts, or a file of `rllib_maobs.export`. Each plays without
exploration in the environment and with the options that its training evaluated with, unless NAME=VALUE says otherwise.
Beside them play random play, the scenario's heuristic and, where each agent has a target, ORCA
(`pip install -c constraints.txt -e ".[orca]"`), always with the task's own action_mode. Of every measure there is the
mean over the episodes and a 95 % bootstrap interval of it. The return is the mean over the agents; scores elsewhere are
the first agent's return, which is another number where rewards differ (walled tunnels).
"""

import argparse
import json
import logging
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import bootstrap

from rllib_maobs.envs import SCENARIOS, Recorder, VectorEnv, make_scenario, make_vec, parallel_env
from rllib_maobs.experiment.baselines import play_many, task_options
from rllib_maobs.experiment.tables import format_table
from rllib_maobs.memory import gigabytes, memory_of
from rllib_maobs.orca import import_pyrvo
from rllib_maobs.paths import local
from rllib_maobs.play import parse_options, play
from rllib_maobs.policies import BASELINES, make_policy, saved_options, trained_on

# Of entity networks: what one copy with 200 agents took, 4.9 GB, by 200^3.
_BYTES_OF_PAIRS = 612
# What the table shows, in its order, and how; a task reports those that make sense for it.
LABELS = {
    "return": ("return", "{:.1f}"),
    "success": ("success", "{:.0%}"),
    "coverage": ("coverage", "{:.3f}"),
    "captures": ("captures", "{:.1f}"),
    "collisions_agents": ("contacts: agents", "{:.2f}"),
    "collisions_obstacles": ("obstacles", "{:.2f}"),
    "collisions_walls": ("walls", "{:.2f}"),
    "collision_free": ("contact-free", "{:.0%}"),
    "time_to_goal": ("steps to success", "{:.1f}"),
    "path_efficiency": ("path efficiency", "{:.2f}"),
}


class Task(NamedTuple):
    """Where something is evaluated: an environment's id, and all its options."""

    env: str
    options: dict[str, Any]

    @property
    def num_agents(self) -> int:
        """N."""
        return len(make_scenario(self.env, **self.options).agents)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line.

    Args:
        arguments: Those of the command line by default.
    """
    parser = argparse.ArgumentParser(
        prog="python -m rllib_maobs.evaluate", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoints", nargs="+", metavar="CHECKPOINT | NAME=VALUE", help="what to evaluate, and how")
    parser.add_argument("--env", help=f"another environment than in training: {', '.join(SCENARIOS)}")
    parser.add_argument("--num-agents", nargs="+", type=int, default=[], metavar="N", help="teams of these sizes")
    parser.add_argument("--episodes", type=int, default=100, help="of each (default: 100)")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; the next one adds 1 (default: 0)")
    parser.add_argument(
        "--baselines",
        type=_baselines,
        default=BASELINES,
        metavar="NAME,NAME",
        help=f"what to play beside them, or none (default: {','.join(BASELINES)})",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table as JSON")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the table as CSV")
    parser.add_argument("--per-episode", type=Path, metavar="FILE", help="write a CSV row for each episode")
    parser.add_argument("--record", type=Path, metavar="FILE", help="film the best one's first episode (.gif or .mp4)")
    args = parser.parse_intermixed_args(arguments)
    pairs = [text for text in args.checkpoints if "=" in text and not os.path.exists(text)]
    paths = [*{os.path.abspath(text): text for text in args.checkpoints if text not in pairs}.values()]
    sizes = [*dict.fromkeys(args.num_agents)]
    files = [path for path in (args.json, args.csv, args.per_episode, args.record) if path is not None]
    try:
        check_arguments(args.episodes, sizes, files, paths, parse_options(pairs))
        recorder = Recorder(args.record) if args.record else None
        if args.baselines is not BASELINES and "orca" in args.baselines:
            import_pyrvo()  # who asks for it does not want it left out
        jobs = [job for path in paths for job in jobs_of(path, args.env, sizes, parse_options(pairs), args.seed)]
    except (ValueError, ImportError) as error:
        parser.error(str(error))
    names = dict(zip(paths, _short(paths), strict=True))
    rows: list[pd.DataFrame] = []
    tasks: list[Task] = []
    for path, task in jobs:
        untrained = Task(task.env, task_options(task.env, task.options))
        if untrained not in tasks:  # each task's baselines once, before what is to be held against them
            tasks.append(untrained)
            for name in baselines_of(untrained, args.baselines):
                rows.append(evaluated(untrained, name, args.episodes, args.seed))
        rows.append(evaluated(task, path, args.episodes, args.seed).assign(policy=names[path]))
    episodes = pd.concat(rows, ignore_index=True)
    table = summarise_episodes(episodes)
    print(to_text(table))
    print(f"\n{args.episodes} episodes each from seed {args.seed}; mean, and below it a 95 % bootstrap interval,")
    print("where episodes differ. Return: the mean over the agents; covered is a target with an agent within 0.1.")
    if {*BASELINES} & {*table["policy"]}:
        print("What is not trained acts with each task's own action_mode.")
    _write(table, episodes, args)
    if recorder is not None:
        of_jobs = table.iloc[[i for i, name in enumerate(table["policy"]) if name not in BASELINES]]
        best, task = jobs[int(of_jobs["return"].to_numpy().argmax())]
        env = parallel_env(task.env, render_mode="rgb_array", **task.options)
        play(env, make_policy(env.vector, best, args.seed), seed=args.seed, recorder=recorder)
        recorder.close()
        print(f"written: {args.record}")


def _baselines(text: str) -> list[str]:
    names = [] if text == "none" else text.split(",")
    if wrong := [name for name in names if name not in BASELINES]:
        raise argparse.ArgumentTypeError(f"{wrong[0]!r} is illegal; legal: none, or some of {','.join(BASELINES)}")
    return names


def check_arguments(
    episodes: int, sizes: Sequence[int], files: Sequence[Path], checkpoints: Sequence[str], options: Mapping[str, Any]
) -> None:
    """Raise a ValueError for what is wrong on the command line."""
    if sizes and (both := {"num_agents", "num_predators"} & {*options}):
        raise ValueError(f"--num-agents and {both.pop()}=... say the same: give one of them")
    if len({path.absolute() for path in files}) < len(files):
        raise ValueError("two of --json, --csv, --per-episode and --record name the same file")
    if episodes < 2:
        raise ValueError(f"--episodes {episodes} is illegal; legal: an integer >= 2")
    if wrong := [size for size in sizes if size < 1]:
        raise ValueError(f"--num-agents {wrong[0]} is illegal; legal: integers >= 1")
    if not checkpoints:
        raise ValueError("nothing to evaluate: give the folder of a checkpoint, or of a trial, or an exported file")
    for path in map(local, files):
        if path.exists():
            raise ValueError(f"{path} exists: remove it, or choose another file")
        if not path.absolute().parent.is_dir():
            raise ValueError(f"there is no folder {path.absolute().parent} for {path.name}")


def jobs_of(
    checkpoint: str, env: str | None, sizes: Sequence[int], options: Mapping[str, Any], seed: int = 0
) -> list[tuple[str, Task]]:
    """Return what one checkpoint is evaluated on; makes everything once, so that what does not fit is an error now.

    Args:
        checkpoint: See `find_checkpoint`.
        env: Id of the environment; None for that of the training.
        sizes: Sizes of teams; none for the one of the training.
        options: Of the environment, before those of the training.
        seed: Of random play.

    Returns:
        The checkpoint and a task for each size.

    Raises:
        ValueError: If the checkpoint, the environment or an option is illegal, or they do not fit.
    """
    if checkpoint in BASELINES:
        raise ValueError(f"{checkpoint} comes by itself beside every checkpoint: give the folder of a checkpoint")
    trained, _ = trained_on(checkpoint)
    if env is None and trained not in SCENARIOS:
        raise ValueError(f"{checkpoint!r} was trained on {trained}; give --env, one of {', '.join(SCENARIOS)}")
    name = env or trained
    task = Task(name, {**saved_options(checkpoint, name), **options})
    scenario = make_scenario(task.env, **task.options)
    # All options, also those that are not given: equal tasks are evaluated once.
    scenarios = [
        make_scenario(task.env, **{**task.options, **scenario.resized(size), **options}) for size in sizes
    ] or [scenario]
    for each in scenarios:
        vec = VectorEnv(each)
        if sizes and (needed := _BYTES_OF_PAIRS * len(vec.agents) ** 3) > (there := memory_of("cpu")):
            raise ValueError(
                f"a team of {len(vec.agents)} needs some {gigabytes(needed)} of memory, as every agent looks at every "
                f"pair of others; this machine has {gigabytes(there)}"
            )
        make_policy(vec, checkpoint, seed)
        vec.reset(seed=seed)  # whether everything fits into the room
    return [(checkpoint, Task(task.env, asdict(each.options))) for each in scenarios]


def summarise_episodes(episodes: pd.DataFrame) -> pd.DataFrame:
    """Return means over episodes.

    Args:
        episodes: Rows with `env`, `agents`, `options`, `policy`, and measures.

    Returns:
        A row for each policy on each task; of every measure the mean, and its 95 % bootstrap interval as
        `<measure>_low` and `<measure>_high`.
    """
    keys = ["env", "agents", "options", "policy"]
    measures = [name for name in LABELS if name in episodes]
    rows = []
    for key, group in episodes.groupby(keys, sort=False):
        row: dict[str, Any] = dict(zip(keys, key, strict=True)) | {"episodes": len(group)}
        for name in measures:
            values = group[name].to_numpy(float)
            row[name], row[f"{name}_low"], row[f"{name}_high"] = values.mean(), *_interval(values)
        rows.append(row)
    return pd.DataFrame(rows)


def _interval(values: np.ndarray[Any, Any]) -> tuple[float, float]:
    if np.isnan(values).any() or np.ptp(values) == 0.0:
        return float(values.mean()), float(values.mean())
    rng = np.random.default_rng(0)
    found = bootstrap((values,), np.mean, n_resamples=2000, method="percentile", rng=rng).confidence_interval
    return float(found.low), float(found.high)


def to_text(table: pd.DataFrame) -> str:
    """Return the table for reading, with an interval below each mean."""
    measures = [name for name in LABELS if name in table and table[name].notna().any()]
    measures = [name for name in measures if name != "collisions_walls" or (table[name] > 0).any()]
    cells = []
    for _, row in table.iterrows():
        show = {name: LABELS[name][1].format for name in measures}
        means = {name: show[name](row[name]) for name in measures}
        if row.get("success") == 0.0:
            means |= {"time_to_goal": "-"}  # no episode has one
        cells.append([f"{row['env']}, {row['agents']} agents", row["policy"], *(means[m] for m in measures)])
        bounds = [[show[name](row[f"{name}_{end}"]) for end in ("low", "high")] for name in measures]
        cells.append(["", "", *("" if low == high else f"{low} .. {high}" for low, high in bounds)])
    return format_table(["task", "policy", *(LABELS[name][0] for name in measures)], cells)


def evaluated(task: Task, policy: str, episodes: int, seed: int) -> pd.DataFrame:
    """Play all episodes of one policy on one task, and say so.

    Args:
        task: The task.
        policy: See `make_policy`.
        episodes: How many.
        seed: Of the first one; the next one adds 1.

    Returns:
        A row for each episode: its measures, and `env`, `agents`, `options`, `policy`.
    """
    print(f"{task.env}, {task.num_agents} agents: {policy} ...", end=" ", file=sys.stderr, flush=True)
    rows = play_many(task.env, task.options, policy, episodes, seed)
    print(f"return {rows['return'].mean():.1f}", file=sys.stderr, flush=True)
    labels = {"env": task.env, "agents": task.num_agents, "options": json.dumps(task.options), "policy": policy}
    return rows.assign(**labels)


def baselines_of(task: Task, wanted: Sequence[str] = BASELINES) -> list[str]:
    """Return those of the wanted baselines that a task has; says which one is left out for want of a package."""
    env = make_vec(task.env, **task.options)
    env.reset(seed=0)
    found = []
    for name in wanted:
        try:
            make_policy(env, name)(env.observe())
        except NotImplementedError:
            continue
        except ImportError as error:
            print(f"left out: {error}", file=sys.stderr, flush=True)
            continue
        found.append(name)
    return found


def _short(paths: Sequence[str]) -> list[str]:
    """Return names for checkpoints: their last folders, as many as it takes to tell them apart."""
    parts = [Path(path).absolute().parts for path in paths]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == len(set(paths)):
            break
    return names


def _write(table: pd.DataFrame, episodes: pd.DataFrame, args: argparse.Namespace) -> None:
    if args.csv:
        table.to_csv(args.csv, index=False)
    if args.json:
        args.json.write_text(json.dumps(json.loads(table.to_json(orient="records")), indent=2) + "\n")
    if args.per_episode:
        episodes.to_csv(args.per_episode, index=False)
    for path in (args.csv, args.json, args.per_episode):
        if path:
            print(f"written: {path}")


if __name__ == "__main__":
    logging.getLogger("ray").setLevel(logging.ERROR)  # notes of RLlib to its own developers
    main(sys.argv[1:])
