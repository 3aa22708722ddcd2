"""The command line of an experiment."""

import argparse
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rllib_maobs.checkpoints import find_checkpoint
from rllib_maobs.experiment.claim import LOCK
from rllib_maobs.experiment.rows import PAPER_HORIZON
from rllib_maobs.experiment.rows import QUICK as QUICK_ROW
from rllib_maobs.experiment.storage import Storage, is_url
from rllib_maobs.experiment.sweep import OF_THE_PAPER, SEARCHED
from rllib_maobs.paths import local, write_aside

_FILE = "experiment.json"
_BEFORE_START = (_FILE, "tuner.pkl", "mlflow.db", LOCK)  # What is written before the first trial starts.
# What --quick changes; a flag that is given still wins.
QUICK = {"seeds": [0], "checkpoint_freq": 2}
# What decides the results: a resumed run must have the same.
SETTINGS = (
    "algos",
    "seeds",
    "stop_timesteps",
    "train_horizon",
    "critic_state",
    "num_env_runners",
    "checkpoint_freq",
    "no_compile",
    "quick",
    "start_from",
    "sweep",
    "search",
    "num_samples",
    "lengthened_to",
)


def save_settings(name: str, args: argparse.Namespace) -> None:
    """Write what a resumed run must know into the results folder.

    Args:
        name: Of the experiment.
        args: From `parse`.
    """
    settings = {setting: getattr(args, setting) for setting in SETTINGS}
    text = json.dumps({"experiment": name, **settings}, indent=2) + "\n"
    write_aside(args.results_dir / _FILE, text.encode())


def read_object(path: Path) -> dict[str, Any]:
    """Read a file that holds a JSON object.

    Raises:
        ValueError: If it does not.
    """
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} can't be read: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} can't be read: it is no JSON object")
    return content


def _whole_number(low: int, high: float = math.inf) -> Callable[[str], int]:
    """Return an argparse type: whole numbers in a range, also written 2e6 or 2_000_000."""

    def parse_number(text: str) -> int:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or value != int(value) or not low <= value <= high:
            bound = f" and <= {high:.0f}" if math.isfinite(high) else ""
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number >= {low}{bound}")
        return int(value)

    return parse_number


def _absolute(path: str) -> str:
    if not path:  # it would be the present folder
        raise argparse.ArgumentTypeError("an empty path; give the folder of a checkpoint, or of a trial")
    if is_url(path):
        raise argparse.ArgumentTypeError(f"{path} is a URL; copy the checkpoint to a folder that all machines see")
    try:
        return str(local(path).resolve())
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _place(text: str) -> Path | str:
    return text if is_url(text) else Path(text)  # a Path would make one slash of two


class _Help(argparse.ArgumentDefaultsHelpFormatter):
    """Shows defaults, but not that a switch is off or that there is none."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        return action.help if not action.default else super()._get_help_string(action)


def make_parser(
    name: str, algos: Sequence[str], stop_timesteps: int, doc: str | None = None, quick_algos: Sequence[str] = ()
) -> argparse.ArgumentParser:
    """Build the command line.

    Args:
        name: Of the experiment.
        algos: Legal algorithms.
        stop_timesteps: Env steps of a trial that has none of its own.
        doc: Description.
        quick_algos: Those of a quick run; none for all.

    Returns:
        The parser.
    """
    quick = f"{' and '.join(quick_algos)}, " if quick_algos else ""
    quick += (
        f"seed 0, {QUICK_ROW['stop_timesteps']} env steps without compiling but for rows that say otherwise; flags "
        f"that are given still count"
    )
    positive, natural, seed = _whole_number(1), _whole_number(0), _whole_number(0, 2**32 - 1)
    parser = argparse.ArgumentParser(description=doc, formatter_class=_Help, allow_abbrev=False)
    # Env steps of a finished run that goes on, and results at a URL: see `parse`.
    parser.set_defaults(lengthened_to=None, storage=None)
    what = parser.add_argument_group("what to train")
    what.add_argument("--algos", nargs="+", choices=algos, default=list(algos), help="algorithms to compare")
    what.add_argument(
        "--seeds",
        nargs="+",
        type=seed,
        default=[0, 1, 2],
        help="one trial per algorithm and seed; of a search, the one seed (default: 0)",
    )
    # None: each row has its own, and what is given here holds for all.
    what.add_argument(
        "--stop-timesteps",
        type=positive,
        help=f"env steps of every trial (default: {stop_timesteps:,}, or what a row has for itself)",
    )
    what.add_argument(
        "--train-horizon",
        type=positive,
        help=f"steps of a training episode (default: {PAPER_HORIZON}, or what a row has for itself); evaluation "
        f"episodes always have {PAPER_HORIZON}",
    )
    what.add_argument(
        "--critic-state",
        choices=["observations", "world"],
        default="observations",
        help="the state that centralised critics see: all observations side by side, or the positions and velocities; "
        "rows with a critic_state of their own keep it",
    )
    what.add_argument(
        "--from",
        dest="start_from",
        metavar="CHECKPOINT",
        type=_absolute,
        help="start from the networks of another run, such as a trial's folder of a smaller team; all rows must have "
        "networks of the same kind",
    )
    what.add_argument(
        "--sweep",
        nargs="*",
        metavar="SETTING=VALUE,VALUE",
        help="train every row with all combinations of some settings' values, where it takes them, such as "
        "actor_lr=1e-3,3e-4 tau=0.01,0.005; with --search also ranges, such as tau=0.001..0.1; without any, those that "
        f"the paper's tables have: {' '.join(OF_THE_PAPER)}",
    )
    what.add_argument(
        "--search",
        choices=["optuna"],
        help="instead of all combinations, let Optuna look for the best rows and settings among those of --sweep, and "
        f"stop early what scores worse than two thirds of the trials that have come as far (ASHA); without --sweep "
        f"among {' '.join(SEARCHED)}",
    )
    what.add_argument("--num-samples", type=positive, default=50, help="trials of a search")
    what.add_argument("--quick", action="store_true", help=f"a small job of about five minutes: {quick}")

    how = parser.add_argument_group("how to run it")
    how.add_argument("--workers", type=positive, default=2, help="trials at once on this machine, one core each")
    how.add_argument(
        "--num-env-runners",
        type=natural,
        default=0,
        help="EnvRunner actors per trial, one core each; with 0 the trial's own process samples",
    )
    how.add_argument(
        "--address",
        help="Ray cluster to run on (auto: the one that this machine is in) instead of starting one here; all its "
        "machines must have this package, and reach --results-dir: a folder that they share, or a URL",
    )
    how.add_argument(
        "--max-failures",
        type=natural,
        default=2,
        metavar="N",
        help="how often a trial may fail, say because its process or machine dies, and go on from its last checkpoint; "
        "errors that would come again (wrong input, training that diverges) end it at once",
    )
    how.add_argument("--no-compile", action="store_true", help="update without torch.compile: slower, starts at once")
    how.add_argument("--dashboard", action="store_true", help="start Ray's dashboard (pip install ray[default])")

    how.add_argument("--wandb", action="store_true", help="log to Weights & Biases; WANDB_MODE=offline keeps it here")
    how.add_argument(
        "--mlflow", action="store_true", help="log to MLflow: to MLFLOW_TRACKING_URI, or mlflow.db in --results-dir"
    )
    how.add_argument("--video", action="store_true", help="film an episode of every checkpoint, for the dashboards")

    where = parser.add_argument_group("where results go")
    where.add_argument(
        "--results-dir",
        type=_place,
        metavar="FOLDER_OR_URL",
        help=f"folder for everything that is written, or its URL (s3://..., docs/experiments.md; default: "
        f"results/{name}, with --quick results/{name}-quick)",
    )
    where.add_argument(
        "--checkpoint-freq",
        type=positive,
        help="iterations (of 1000 env steps, or what a row has for itself) between checkpoints (default: as many as "
        "make 50,000 env steps)",
    )
    where.add_argument(
        "--resume",
        action="store_true",
        help="go on with the run in --results-dir from its last checkpoints, with its settings; finished trials stay, "
        "unless --stop-timesteps is more than they had",
    )
    where.add_argument(
        "--add-seeds", nargs="+", type=seed, default=[], help="resume, with trials of more seeds for every algorithm"
    )
    where.add_argument(
        "--add-algos", nargs="+", choices=algos, default=[], help="resume, with trials of more algorithms"
    )
    return parser


def parse(
    parser: argparse.ArgumentParser, name: str, argv: Sequence[str] | None = None, quick_algos: Sequence[str] = ()
) -> argparse.Namespace:
    """Read the command line; errors end the program with a message and code 2, before anything is started.

    Args:
        parser: From `make_parser`.
        name: Of the experiment.
        argv: Arguments; None for those of the program.
        quick_algos: Algorithms of a quick run; none for all.

    Returns:
        The arguments, with an absolute `results_dir`; those of the original run with `--resume`. Of results at a URL
        `results_dir` is the folder of `storage`.
    """
    args = parser.parse_args(argv)
    if args.search:
        parser.set_defaults(seeds=[0])
        args = parser.parse_args(argv)
        if len(args.seeds) > 1:
            parser.error("--seeds: a search has one seed; train the best settings with more of them by --sweep")
    if args.quick:
        parser.set_defaults(**QUICK, **({"algos": list(quick_algos)} if quick_algos else {}))
        args = parser.parse_args(argv)
    for several in ("algos", "seeds", "add_algos", "add_seeds"):
        values = getattr(args, several)
        if len(set(values)) < len(values):
            parser.error(f"{_flag(several)}: {' '.join(map(str, values))} names one of them twice")
    if args.address and args.workers != parser.get_default("workers"):
        parser.error("--workers is for this machine; with --address the free cores of the cluster decide")

    place = args.results_dir or Path("results") / (f"{name}-quick" if args.quick else name)
    storage = None
    try:
        if isinstance(place, str):
            storage = Storage(place)
            storage.pull()
            results_dir = storage.folder
        else:
            place = results_dir = local(place).resolve()
    except ValueError as error:
        parser.error(str(error) if isinstance(place, str) else f"--results-dir: {error}")
    if results_dir.exists() and not results_dir.is_dir():
        parser.error(f"--results-dir: {results_dir} is not a folder")
    args.resume = args.resume or bool(args.add_seeds or args.add_algos)
    if args.resume:
        if not has_started(results_dir) or not (results_dir / _FILE).is_file():
            quick = "" if args.quick or args.results_dir else ", or add --quick if that was a quick run"
            parser.error(f"there is nothing to resume in {place}: leave --resume out, or correct --results-dir{quick}")
        try:
            stored = read_object(results_dir / _FILE)
        except ValueError as error:
            parser.error(str(error))
        if (other := stored.pop("experiment", None)) != name:
            parser.error(f"{place} holds a run of {other}, not of {name}: correct --results-dir")
        args = _with_stored_settings(parser, argv, {"lengthened_to": None, **stored})
    elif has_started(results_dir):
        parser.error(f"{place} is not empty: continue the run there with --resume, or choose another --results-dir")
    elif args.start_from:
        try:  # all trials start from the same one, also those that begin when it is no longer the last
            args.start_from = str(find_checkpoint(args.start_from))
        except ValueError as error:
            parser.error(f"--from: {error}")
    args.results_dir, args.storage = results_dir, storage
    return args


def has_started(results_dir: Path) -> bool:
    """Return whether a folder holds more than what is written before the first trial starts."""
    return results_dir.is_dir() and any(path.name not in _BEFORE_START for path in results_dir.iterdir())


def _flag(name: str) -> str:
    return "--from" if name == "start_from" else f"--{name.replace('_', '-')}"


def _with_stored_settings(
    parser: argparse.ArgumentParser, argv: Sequence[str] | None, stored: dict[str, Any]
) -> argparse.Namespace:
    """Parse again with the settings of the original run as defaults, and refuse flags that contradict them.

    The trials may become longer and more; `stop_timesteps` stays what they had at first.
    """
    parser.set_defaults(**stored)
    args = parser.parse_args(argv)
    args.resume = True
    if args.start_from and stored["start_from"] and Path(args.start_from) == Path(stored["start_from"]).parent:
        args.start_from = stored["start_from"]  # the trial whose checkpoint it was
    longer = args.stop_timesteps if args.stop_timesteps != stored["stop_timesteps"] else None
    args.stop_timesteps = stored["stop_timesteps"]
    for name, value in stored.items():
        if getattr(args, name) != value:
            stands = "what each row has for itself" if value is None else value
            parser.error(
                f"{_flag(name)}: the original run has {stands}, and --resume continues it as it is: leave "
                f"{_flag(name)} out, or start a new run in another --results-dir"
            )
    if args.search and (longer or args.add_seeds or args.add_algos):
        parser.error(
            "the run is a search, which compares trials of one length: start a new one in another --results-dir"
        )
    if longer and longer < (args.lengthened_to or 0):
        parser.error(f"--stop-timesteps: {longer:,} is less than the {args.lengthened_to:,} that the trials have")
    args.lengthened_to = longer or args.lengthened_to
    for name in ("algos", "seeds"):
        if known := [value for value in getattr(args, f"add_{name}") if value in stored[name]]:
            parser.error(f"--add-{name}: {' '.join(map(str, known))} is there already; --resume goes on with it")
        setattr(args, name, [*stored[name], *getattr(args, f"add_{name}")])
    return args
