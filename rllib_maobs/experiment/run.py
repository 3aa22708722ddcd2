"""An experiment as one command: algorithms x seeds as trials of Ray Tune, with a report at the end."""

import logging
import os
import shlex
import shutil
import sys
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import ray
from ray import tune

import rllib_maobs as maobs
from rllib_maobs.algorithms.checks import check_compiler
from rllib_maobs.algorithms.settings import without_effect
from rllib_maobs.checkpoints import saved_networks
from rllib_maobs.experiment.arguments import has_started, make_parser, parse, save_settings
from rllib_maobs.experiment.baselines import play_baselines
from rllib_maobs.experiment.claim import claim
from rllib_maobs.experiment.film import film_best
from rllib_maobs.experiment.progress import ProgressTable, makespan
from rllib_maobs.experiment.report import FILES, LAST, LAST_QUICK, STEPS, write_report
from rllib_maobs.experiment.resume import Grid, forget_decisions
from rllib_maobs.experiment.rows import OF_THE_TRIAL, PAPER_HORIZON, check_row, options_before, settings_of_row
from rllib_maobs.experiment.tables import format_table, format_time
from rllib_maobs.experiment.trial import Pace, Trial, TrialSpec, measure_pace
from rllib_maobs.options import Range, check_value

_LEGAL: dict[str, Any] = {
    "name": str,
    "env": str,
    "algorithms": list | tuple,
    "training": Mapping,
    "variants": Mapping,
    "env_config": Mapping,
    "stop_timesteps": Annotated[int, Range(1)],
    "quick_algorithms": list | tuple,
}


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Compares algorithms on one environment; `main()` is the whole program.

        experiment = Experiment(
            name="spread-9a",
            env="maobs/spread-9a",
            algorithms=("iddpg", "maddpg", "maddpg-l"),
            training={"actor_lr": 1e-3, "critic_lr": 1e-2, "train_batch_size_per_learner": 32},
            stop_timesteps=2_000_000,
        )
        if __name__ == "__main__":
            experiment.main()

    Every algorithm is trained with every seed. A trial evaluates its actors without exploration noise every 1000 env
    steps: 10 episodes of 100 steps on environments of its own. Its score is the paper's, the undiscounted return of
    the first agent. The results folder holds, beside the logs of Ray Tune (CSV, JSON, TensorBoard) and a checkpoint
    for each trial: `comparison.md`, `comparison.csv`, `curves.csv`, `curves.png`, and `episode.gif`, an episode of the
    best one.

    A variant is a row of the comparison with settings of its own, which come before those of the experiment:

        variants={
            "maddpg-entity": {
                "algorithm": "maddpg",
                "actor": "entity",
                "actor_lr": decayed(5e-4),
                "env_config": {"action_mode": "force"},
                "stop_timesteps": 200_000,
                "quick": {"stop_timesteps": 60_000},
            },
        }

    Beside `"algorithm"`, one of `maobs.ALGORITHMS`, and arguments of its `training()` it may have:

    - `env_config`: options of the environment, in training and evaluation, beside the experiment's;
    - `train_env_config`: options that only training has, such as a higher price of contacts; what is reported is what
      the evaluation's own reward says;
    - `train_horizon`: steps of a training episode (100); evaluation episodes always have 100;
    - `num_envs_per_env_runner`: copies of the environment (8);
    - `one_policy`: whether all agents share one policy (False), which needs agents with equal spaces;
    - `stop_timesteps`: the row's own env steps; `--stop-timesteps` on the command line holds for all rows;
    - `steps_per_iteration`: env steps between evaluations (1000), and `evaluation_duration`: episodes of each (10);
    - `torch_compile`: whether its update is compiled (True);
    - `quick`: what `--quick` changes, a mapping of all but `"algorithm"`. It comes after what `--quick` changes for
      every row: 4000 env steps, an evaluation of 5 episodes every 400, no compiling.

    Attributes:
        name: Names the default results folder.
        env: Registered name of the environment.
        algorithms: Names of the algorithms, or of variants.
        variants: Algorithms with settings of their own, by the name they shall have in tables.
        quick_algorithms: Those of `algorithms` that `--quick` trains; none for all.
        training: Arguments of the configs' `training()`, the same for all algorithms. A function among them, or among
            those of a variant, is called with the trial's env steps, see `decayed` and `fading`.
        env_config: Options of the environment.
        stop_timesteps: Env steps of a trial.
    """

    name: str
    env: str
    algorithms: Sequence[str]
    training: Mapping[str, Any]
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    env_config: Mapping[str, Any] = field(default_factory=dict)
    stop_timesteps: int = 2_000_000
    quick_algorithms: Sequence[str] = ()

    def __post_init__(self) -> None:
        for name, hint in _LEGAL.items():
            check_value(getattr(self, name), hint, name, "Experiment")
        if not self.name or Path(self.name).name != self.name:
            raise ValueError(f"Experiment: name={self.name!r} is illegal; legal is a name of a folder.")
        if len(set(self.algorithms)) < max(1, len(self.algorithms)):
            raise ValueError(f"Experiment: algorithms={self.algorithms} are illegal; legal are one or more, once each.")
        if unused := [name for name in self.variants if name not in self.algorithms]:
            raise ValueError(
                f"Experiment: variants {', '.join(map(repr, unused))} are not among the algorithms "
                f"{', '.join(self.algorithms)}, so they would not be trained."
            )
        for name in self.algorithms:
            check_row(name, self.variants.get(name, {"algorithm": name}))
        if unknown := [repr(name) for name in self.quick_algorithms if name not in self.algorithms]:
            legal = ", ".join(self.algorithms)
            raise ValueError(f"Unknown quick_algorithms {', '.join(unknown)}; legal are those of algorithms: {legal}.")

    def main(self, argv: Sequence[str] | None = None) -> None:
        """Run the command line.

        Args:
            argv: Arguments; None for those of the program.

        Raises:
            SystemExit: With code 1 if a trial failed, 2 for wrong arguments, 130 if it was interrupted.
        """
        doc = f"Train on {self.env}."
        parser = make_parser(self.name, self.algorithms, self.stop_timesteps, doc, self.quick_algorithms)
        args = parse(parser, self.name, argv, self.quick_algorithms)
        _quiet()
        try:
            specs = self.specs(args)
            if any(spec.torch_compile for spec in specs) and not args.address:
                check_compiler()
            for spec in specs[: len(args.algos)]:  # The first seed's: they differ in nothing that could be wrong.
                config = spec.build_config()
                config.validate()
                if spec.start_from and not args.resume:
                    saved_networks(config, spec.start_from)
        except ValueError as error:
            parser.error(str(error))
        try:
            claimed = claim(args.results_dir)
        except ValueError as error:
            parser.error(str(error))
        try:
            with claimed:
                code = self._run(args, specs)
        except KeyboardInterrupt:  # While trials run, Tune takes the first one: it saves its state and returns.
            print("\nInterrupted.", f"Go on with: {_resume_command(args)}" if has_started(args.results_dir) else "")
            code = 130
        if code:
            sys.exit(code)

    def specs(self, args: Namespace) -> list[TrialSpec]:
        """Return the trials, seed by seed, so that the first results compare all algorithms."""
        return [self._spec(args, algorithm, seed) for seed in args.seeds for algorithm in args.algos]

    def _spec(self, args: Namespace, algorithm: str, seed: int) -> TrialSpec:
        """Return one trial: what its row says, and what was given on the command line."""
        row = self.variants.get(algorithm, {})
        own = settings_of_row(row, self.stop_timesteps, quick=args.quick)
        steps = args.stop_timesteps or own["stop_timesteps"]
        training = {**self.training, "critic_state": args.critic_state}
        training |= {key: value for key, value in own.items() if key not in OF_THE_TRIAL}
        # A class is a setting, too: of a network, say.
        depends = {key for key, value in training.items() if callable(value) and not isinstance(value, type)}
        training = {key: value(steps) if key in depends else value for key, value in training.items()}
        horizon = args.train_horizon or own["train_horizon"]
        # What all rows share need not mean something to each, such as critic_state to IDDPG.
        config = maobs.ALGORITHMS[row.get("algorithm", algorithm)]().training(**training)
        unheard = {*without_effect(config)} - {*row}
        training = {key: value for key, value in training.items() if key not in unheard}
        env_config = {**self.env_config, **own["env_config"]}
        return TrialSpec(
            algorithm=algorithm,
            variant_of=row.get("algorithm", ""),
            seed=seed,
            env=self.env,
            stop_timesteps=steps,
            training=training,
            env_config={**env_config, **own["train_env_config"], "horizon": horizon},
            evaluation_env_config={
                **options_before(self.env, env_config, own["train_env_config"]),
                "horizon": PAPER_HORIZON,
            },
            num_env_runners=args.num_env_runners,
            num_envs_per_env_runner=own["num_envs_per_env_runner"],
            one_policy=own["one_policy"],
            torch_compile=own["torch_compile"] and not args.no_compile,
            steps_per_iteration=own["steps_per_iteration"],
            evaluation_duration=own["evaluation_duration"],
            start_from=args.start_from or "",
        )

    def _run(self, args: Namespace, specs: list[TrialSpec]) -> int:
        """Measure, train, report; return the exit code."""
        started = _start_ray(args)
        try:
            maobs.register()
            args.results_dir.mkdir(parents=True, exist_ok=True)
            if args.resume:
                print(f"Resuming {self.name} in {args.results_dir}", flush=True)
                forget_decisions(args.results_dir)
                tuner = tune.Tuner.restore(str(args.results_dir), trainable=Trial, resume_errored=True)
            else:
                self._print_plan(args, specs)
                tuner = _make_tuner(self.name, args, specs)
            trials = tuner.fit()
        finally:
            if started:
                ray.shutdown()
        return self._report(args, trials, specs)

    def _print_plan(self, args: Namespace, specs: list[TrialSpec]) -> None:
        """Say what will be run, what it will take and where it will be found."""
        rows = {spec.algorithm: spec for spec in specs[: len(args.algos)]}
        print(f"{self.name}: {len(specs)} trials, {', '.join(rows)} with seed {', '.join(map(str, args.seeds))}")
        left_out = [name for name in self.algorithms if name not in rows]
        if args.quick and left_out and set(rows) == set(self.quick_algorithms):
            print(
                f"--quick trains {' and '.join(rows)} only: {', '.join(left_out)} need hours to show anything (name "
                f"them with --algos, or leave --quick out)."
            )
        pace: dict[str, Pace] = {}
        # A quick run of its own size takes minutes: to measure how many would compile everything once more.
        if args.quick and args.stop_timesteps is None and len(args.seeds) == 1:
            estimate = "Estimated: at most about five minutes on two free cores; in a quick run nothing is measured."
        else:
            pace, estimate = self._measured(args, specs)
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
            f"Results: {args.results_dir}\n"
            f"TensorBoard: tensorboard --logdir {shlex.quote(str(args.results_dir))}\n"
            f"Ctrl-C stops; then --resume goes on from the last checkpoints.\n",
            flush=True,
        )

    def _measured(self, args: Namespace, specs: list[TrialSpec]) -> tuple[dict[str, Pace], str]:
        """Measure the pace of each algorithm; return it, and what it says of the whole run."""
        compiles = any(spec.torch_compile for spec in specs)
        print(f"Measuring how fast that is here{' (and compiling)' if compiles else ''} ...", flush=True)
        start = time.monotonic()
        cores = int(ray.available_resources().get("CPU", 0))
        at_once = max(1, min(cores // (1 + args.num_env_runners), len(specs)))
        pace = _measure(specs[: len(args.algos)], at_once, seconds=2.0 if args.quick else 10.0)
        total = makespan([spec.stop_timesteps / pace[spec.algorithm].env_steps_per_s for spec in specs], at_once)
        megabytes = max(
            min(spec.stop_timesteps, spec.build_config().replay_buffer_capacity)
            * pace[spec.algorithm].bytes_per_env_step
            / 1e6
            for spec in specs[: len(args.algos)]
        )
        return pace, (
            f"Measured with {at_once} at once in {format_time(time.monotonic() - start)}, with evaluation, without "
            f"compiling.\n"
            f"Estimated: {total / 3600:.2f} hours for all, {at_once} at once.\n"
            f"Replay will take up to {megabytes:,.0f} MB of memory per trial, and as much of disk in its checkpoint; "
            f"free disk: {shutil.disk_usage(args.results_dir).free / 1e6:,.0f} MB."
        )

    def _report(self, args: Namespace, trials: tune.ResultGrid, specs: list[TrialSpec]) -> int:
        """Write and print the results, and film the best; return the exit code."""
        failed = [Path(trial.path) for trial in trials if trial.error]
        names = [path.name for path in failed]
        try:
            baselines = play_baselines(self.env, {**self.env_config, "horizon": PAPER_HORIZON})
            # A quick run has few evaluations, of which the first ones are from before it has learned anything.
            last = LAST_QUICK if args.quick else LAST
            print(f"\n{write_report(args.results_dir, self.name, names, baselines, last)}\n")
            print(f"In {args.results_dir}: {', '.join(FILES)}", flush=True)
            print(film_best(args.results_dir, specs, names, last))
        except FileNotFoundError as error:
            print(error)
        for path in failed:
            print(f"FAILED: {path.name}, see {path / 'error.txt'}")
        stops = {spec.name: spec.stop_timesteps for spec in specs}
        finished = sum((trial.metrics or {}).get(STEPS, 0) >= stops[Path(trial.path).name] for trial in trials)
        if finished + len(failed) < len(specs):
            print(f"Interrupted. Go on with: {_resume_command(args)}")
            return 130
        if failed:
            print(f"Try them again, from their last checkpoints, with: {_resume_command(args)}")
            return 1
        return 0


def _quiet() -> None:
    """Keep Ray's own tables and notes away from the progress table; errors still show."""
    for name in ("ray", "ray.rllib"):
        logging.getLogger(name).setLevel(logging.ERROR)
    # Tune leaves the table to our reporter only in its older form of output.
    os.environ["RAY_AIR_NEW_OUTPUT"] = "0"
    # It warns that a run with frequent checkpoints saves its state often, which takes no time with a few trials.
    os.environ.setdefault("TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S", "0")


def _start_ray(args: Namespace) -> bool:
    """Start Ray on this machine with one CPU per process of a trial, or connect to a cluster.

    Returns:
        Whether it was for this to do: a program that has started Ray already goes on with it.
    """
    if ray.is_initialized():
        return False
    if args.address:
        try:
            ray.init(address=args.address, log_to_driver=False, logging_level=logging.ERROR)
        except ConnectionError as error:
            sys.exit(f"error: --address {args.address}: {error}")
        return True
    if args.dashboard and find_spec("aiohttp") is None:
        sys.exit('error: --dashboard needs Ray\'s dashboard: pip install -c constraints.txt "ray[default]"')
    ray.init(
        address="local",
        num_cpus=args.workers * (1 + args.num_env_runners),
        include_dashboard=args.dashboard,
        log_to_driver=False,
        logging_level=logging.ERROR,
    )
    return True


def _make_tuner(name: str, args: Namespace, specs: list[TrialSpec]) -> tune.Tuner:
    save_settings(name, args)
    return tune.Tuner(
        Trial,
        param_space=tune.grid_search([asdict(spec) for spec in specs]),
        tune_config=tune.TuneConfig(
            search_alg=Grid(), trial_name_creator=_trial_name, trial_dirname_creator=_trial_name
        ),
        run_config=tune.RunConfig(
            name=args.results_dir.name,
            storage_path=str(args.results_dir.parent),
            checkpoint_config=tune.CheckpointConfig(
                checkpoint_frequency=args.checkpoint_freq, checkpoint_at_end=True, num_to_keep=1
            ),
            progress_reporter=ProgressTable(every_s=10.0 if args.quick else 30.0),
            verbose=1,
        ),
    )


def _trial_name(trial: Any) -> str:
    return f"{trial.config['algorithm']}-seed{trial.config['seed']}"


def _measure(specs: Sequence[TrialSpec], at_once: int, seconds: float) -> dict[str, Pace]:
    """Measure the pace of each algorithm with so many at once as there will be trials."""
    measure = ray.remote(num_cpus=1)(measure_pace)
    pace: dict[str, Pace] = {}
    waiting, running = list(specs), dict[Any, str]()
    while waiting or running:
        while waiting and len(running) < at_once:
            spec = waiting.pop(0)
            running[measure.remote(spec, seconds)] = spec.algorithm
        (done,), _ = ray.wait(list(running))
        pace[running.pop(done)] = ray.get(done)
    return pace


def _resume_command(args: Namespace) -> str:
    return shlex.join(["python", sys.argv[0], "--resume", "--results-dir", str(args.results_dir)])
