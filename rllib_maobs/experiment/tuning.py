"""What Ray Tune is told: to start the trials of an experiment, or to go on with them."""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from ray import tune

from rllib_maobs.experiment.arguments import save_settings
from rllib_maobs.experiment.dashboards import make_callbacks
from rllib_maobs.experiment.plan import print_rest
from rllib_maobs.experiment.progress import ProgressTable
from rllib_maobs.experiment.resume import (
    NOT_RESTORED,
    STATES,
    Grid,
    StateError,
    forget_decisions,
    known_trials,
    lengthen,
    take_up,
)
from rllib_maobs.experiment.retries import Retries
from rllib_maobs.experiment.search import Search, stopping
from rllib_maobs.experiment.trial import Trial, TrialSpec

# The last one, and the one before it, should that be damaged.
KEPT = 2
# At a URL Tune's state is some minutes old when a run is killed: what it names must still be there.
KEPT_AT_URL = 10


def start(
    name: str,
    args: Namespace,
    specs: Sequence[TrialSpec],
    search: Search | None = None,
    callbacks: Sequence[tune.Callback] = (),
) -> tune.ResultGrid:
    """Train all trials.

    Args:
        name: Of the experiment.
        args: Of the command line.
        specs: The trials; those of a search are its own.
        search: Proposes trials, one after the other.
        callbacks: Called before those of the dashboards.

    Returns:
        Tune's results.
    """
    _save_settings(name, args)
    run_config = tune.RunConfig(
        name=args.results_dir.name,
        storage_path=_storage_path(args),
        checkpoint_config=_checkpoints(args),
        progress_reporter=_progress(args),
        callbacks=[*callbacks, Retries(args.max_failures), *make_callbacks(name, args)],
        verbose=1,
    )
    tune_config = tune.TuneConfig(
        search_alg=search or Grid(),
        scheduler=_scheduler(search, specs),
        num_samples=args.num_samples if search else 1,
        trial_name_creator=_trial_name,
        trial_dirname_creator=_trial_name,
    )
    space = {} if search else _grid(specs)
    return tune.Tuner(Trial, param_space=space, tune_config=tune_config, run_config=run_config).fit()


def resume(
    name: str,
    args: Namespace,
    specs: Sequence[TrialSpec],
    search: Search | None = None,
    callbacks: Sequence[tune.Callback] = (),
) -> tune.ResultGrid:
    """Go on with the trials in a results folder, from their last checkpoints.

    Args:
        name: Of the experiment.
        args: Of the command line.
        specs: The trials. Those that the folder does not hold are started, those that are longer now go on.
        search: As for `start`.
        callbacks: As for `start`.

    Returns:
        Tune's results.

    Raises:
        StateError: If the folder's state is not as the tested release of Ray writes it.
    """
    if args.storage is None and not take_up(args.results_dir, KEPT):
        print("It was killed before it had begun: it is started anew.", flush=True)
        return start(name, args, specs, search, callbacks)
    forget_decisions(args.results_dir)
    others = []
    if not search:
        known = known_trials(args.results_dir)
        others = [spec for spec in specs if spec.name not in known]
        longer = lengthen(args.results_dir, {spec.name: spec.stop_timesteps for spec in specs})
        if longer or args.add_seeds or args.add_algos:
            print_rest(args, specs, longer)
    _save_settings(name, args)
    rest = tune.Experiment(
        name=args.results_dir.name,
        run=Trial,
        config=_grid(others) if others else {},
        num_samples=args.num_samples if search else 1,
        storage_path=_storage_path(args),
        checkpoint_config=_checkpoints(args),
        trial_name_creator=_trial_name,
        trial_dirname_creator=_trial_name,
    )
    way = search or Grid(resumed=True, rest=rest if others else None)
    before = {*args.results_dir.glob(STATES)}
    # What Tuner.restore would do, with other trials than those that it began with.
    analysis = tune.run(
        rest,
        resume_config=tune.ResumeConfig(errored=tune.ResumeConfig.ResumeType.RESUME),
        search_alg=way,
        scheduler=_scheduler(search, specs),
        progress_reporter=_progress(args),
        callbacks=[*callbacks, Retries(args.max_failures), *make_callbacks(name, args)],
        raise_on_failed_trial=False,
        verbose=1,
    )
    if way.restored is False:
        # Tune has gone on with no trials at all, and saved that: the state before it is still good.
        if args.storage:
            args.storage.pull()
        for path in {*args.results_dir.glob(STATES)} - before:
            path.unlink()
            if args.storage:
                args.storage.remove(path.name)
        raise StateError(NOT_RESTORED)
    return tune.ResultGrid(analysis)


def _save_settings(name: str, args: Namespace) -> None:
    """Write what a resumed run must know, and what was changed of its state, to where Tune reads it."""
    save_settings(name, args)
    if args.storage:
        args.storage.push()


def _storage_path(args: Namespace) -> str:
    return args.storage.parent if args.storage else str(args.results_dir.parent)


def _grid(specs: Sequence[TrialSpec]) -> dict[str, Any]:
    grid: dict[str, Any] = tune.grid_search([asdict(spec) for spec in specs])
    return grid


def _scheduler(search: Search | None, specs: Sequence[TrialSpec]) -> Any:
    return stopping(max(spec.stop_timesteps for spec in specs)) if search else None


def _checkpoints(args: Namespace) -> tune.CheckpointConfig:
    kept = KEPT_AT_URL if args.storage else KEPT
    return tune.CheckpointConfig(checkpoint_at_end=True, num_to_keep=kept)  # and whenever a trial asks for one


def _progress(args: Namespace) -> ProgressTable:
    return ProgressTable(every_s=10.0 if args.quick else 30.0)


def _trial_name(trial: Any) -> str:
    return f"{trial.config['algorithm']}-seed{trial.config['seed']}"
