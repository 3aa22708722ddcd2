"""An experiment as one command: algorithms x seeds as trials of Ray Tune, with a report at the end."""

import logging
import os
import shlex
import sys
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import ray
from ray import tune

import rllib_maobs as maobs
from rllib_maobs.experiment.arguments import PAPER_HORIZON, make_parser, parse, save_settings
from rllib_maobs.experiment.progress import STEPS, ProgressTable, format_time, makespan
from rllib_maobs.experiment.report import FILES, format_table, write_report
from rllib_maobs.experiment.trial import Trial, TrialSpec, measure_env_steps_per_s


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Compares algorithms on one environment; `main()` is the whole program.

        if __name__ == "__main__":
            Experiment(
                name="spread-9a",
                env="maobs/spread-9a",
                algorithms=("iddpg", "maddpg", "maddpg-l"),
                training={"actor_lr": 1e-3, "critic_lr": 1e-2, "train_batch_size_per_learner": 32},
                stop_timesteps=2_000_000,
            ).main()

    Every algorithm is trained with every seed. A trial evaluates its actors without exploration noise every 1000 env
    steps: 10 episodes of 100 steps on environments of its own. Its score is the paper's, the undiscounted return of
    the first agent. The results folder holds, beside the logs of Ray Tune (CSV, JSON, TensorBoard) and a checkpoint
    for each trial: `comparison.md`, `comparison.csv`, `curves.csv`, `curves.png`.

    Attributes:
        name: Names the default results folder.
        env: Registered name of the environment.
        algorithms: Names of the algorithms.
        training: Arguments of the configs' `training()`, the same for all algorithms.
        env_config: Options of the environment.
        stop_timesteps: Env steps of a trial.
    """

    name: str
    env: str
    algorithms: Sequence[str]
    training: Mapping[str, Any]
    env_config: Mapping[str, Any] = field(default_factory=dict)
    stop_timesteps: int = 2_000_000

    def main(self, argv: Sequence[str] | None = None) -> None:
        """Run the command line.

        Args:
            argv: Arguments; None for those of the program.

        Raises:
            SystemExit: With code 1 if a trial failed, 2 for wrong arguments, 130 if it was interrupted.
        """
        parser = make_parser(self.name, self.algorithms, self.stop_timesteps, f"Train on {self.env}.")
        args = parse(parser, self.name, argv)
        specs = self.specs(args)
        try:
            for spec in specs[: len(args.algos)]:  # The first seed's: they differ in nothing that could be wrong.
                spec.build_config().validate()
        except ValueError as error:
            parser.error(str(error))
        try:
            code = self._run(args, specs)
        except KeyboardInterrupt:  # While trials run, Tune takes it: it saves its state and returns.
            print("\nInterrupted before the first trial.")
            code = 130
        if code:
            sys.exit(code)

    def specs(self, args: Namespace) -> list[TrialSpec]:
        """Return the trials, seed by seed, so that the first results compare all algorithms."""
        return [
            TrialSpec(
                algorithm=algorithm,
                seed=seed,
                env=self.env,
                training={**self.training, "critic_state": args.critic_state},
                env_config={**self.env_config, "horizon": args.train_horizon},
                evaluation_env_config={"horizon": PAPER_HORIZON},
                num_env_runners=args.num_env_runners,
                torch_compile=not args.no_compile,
                steps_per_iteration=500 if args.quick else 1000,
                evaluation_duration=5 if args.quick else 10,
            )
            for seed in args.seeds
            for algorithm in args.algos
        ]

    def _run(self, args: Namespace, specs: list[TrialSpec]) -> int:
        """Measure, train, report; return the exit code."""
        # Tune's own tables are long and its warnings about frequent snapshots do not concern a run of a few trials.
        os.environ["RAY_AIR_NEW_OUTPUT"] = "0"
        os.environ.setdefault("TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S", "0")
        quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
        if args.address:
            ray.init(address=args.address, **quiet)
        else:
            cores = args.workers * (1 + args.num_env_runners)
            ray.init(num_cpus=cores, include_dashboard=args.dashboard, **quiet)
        logging.getLogger("ray").setLevel(logging.ERROR)
        try:
            maobs.register()
            if args.resume:
                print(f"Resuming {self.name} in {args.results_dir}", flush=True)
                tuner = tune.Tuner.restore(str(args.results_dir), trainable=Trial, resume_errored=True)
            else:
                self._print_plan(args, specs)
                tuner = _make_tuner(args, specs)
            trials = tuner.fit()
        finally:
            ray.shutdown()
        return self._report(args, trials, len(specs))

    def _print_plan(self, args: Namespace, specs: list[TrialSpec]) -> None:
        """Say what will be run, how long it will take and where it will be found."""
        ratio = specs[0].build_config().updates_per_env_step
        print(
            f"{self.name}: {len(specs)} trials (algorithm x seed: {', '.join(args.algos)} x "
            f"{', '.join(map(str, args.seeds))}), {args.stop_timesteps:,} env steps each, {ratio:g} updates per env step\n"
            f"Measuring how fast they run here{'' if args.no_compile else ' (compiling first)'} ...",
            flush=True,
        )
        at_once = min(int(ray.cluster_resources()["CPU"]) // (1 + args.num_env_runners), len(specs))
        start = time.monotonic()
        pace = _measure(specs[: len(args.algos)], at_once, seconds=2.0 if args.quick else 10.0)
        hours = {name: args.stop_timesteps / speed / 3600 for name, speed in pace.items()}
        rows = [[name, f"{pace[name]:.0f}", f"{hours[name]:.2f}"] for name in args.algos]
        total = makespan([hours[spec.algorithm] for spec in specs], at_once)
        print(
            f"{format_table(['algorithm', 'env steps/s', 'hours per trial'], rows)}\n"
            f"Measured in {format_time(time.monotonic() - start)} with {at_once} at once; evaluation is included, "
            f"compiling is not.\n"
            f"Estimated time for all: {total:.2f} hours, {at_once} trials at once.\n"
            f"Results: {args.results_dir}\n"
            f"TensorBoard: tensorboard --logdir {shlex.quote(str(args.results_dir))}\n"
            f"Ctrl-C stops; the same command with --resume goes on from the last checkpoints.",
            flush=True,
        )

    def _report(self, args: Namespace, trials: tune.ResultGrid, planned: int) -> int:
        """Write and print the results; return the exit code."""
        try:
            print(f"\n{write_report(args.results_dir, self.name)}\n")
            print(f"In {args.results_dir}: {', '.join(FILES)}")
        except FileNotFoundError as error:
            print(error)
        failed = [Path(trial.path) for trial in trials if trial.error]
        for path in failed:
            print(f"FAILED: {path.name}, see {path / 'error.txt'}")
        finished = sum((trial.metrics or {}).get(STEPS, 0) >= args.stop_timesteps for trial in trials)
        if finished + len(failed) < planned:
            print(f"Interrupted. Go on with: {_resume_command(args)}")
            return 130
        if failed:
            print(f"Try them again, from their last checkpoints, with: {_resume_command(args)}")
            return 1
        return 0


def _make_tuner(args: Namespace, specs: list[TrialSpec]) -> tune.Tuner:
    args.results_dir.mkdir(parents=True, exist_ok=True)
    save_settings(args)
    return tune.Tuner(
        Trial,
        param_space=tune.grid_search([asdict(spec) for spec in specs]),
        tune_config=tune.TuneConfig(trial_name_creator=_trial_name, trial_dirname_creator=_trial_name),
        run_config=tune.RunConfig(
            name=args.results_dir.name,
            storage_path=str(args.results_dir.parent),
            stop={STEPS: args.stop_timesteps},
            checkpoint_config=tune.CheckpointConfig(
                checkpoint_frequency=args.checkpoint_freq, checkpoint_at_end=True, num_to_keep=1
            ),
            progress_reporter=ProgressTable(args.stop_timesteps, every_s=10.0 if args.quick else 30.0),
            log_to_file=True,
            verbose=1,
        ),
    )


def _trial_name(trial: Any) -> str:
    return f"{trial.config['algorithm']}-seed{trial.config['seed']}"


def _measure(specs: Sequence[TrialSpec], at_once: int, seconds: float) -> dict[str, float]:
    """Return env steps per second by algorithm, measured with so many at once as there will be trials."""
    remote = ray.remote(num_cpus=1, max_calls=1)(measure_env_steps_per_s)
    pace: dict[str, float] = {}
    waiting, running = list(specs), {}
    while waiting or running:
        while waiting and len(running) < at_once:
            spec = waiting.pop(0)
            running[remote.remote(spec, seconds)] = spec.algorithm
        (done,), _ = ray.wait(list(running))
        pace[running.pop(done)] = ray.get(done)
    return pace


def _resume_command(args: Namespace) -> str:
    return shlex.join(["python", sys.argv[0], "--resume", "--results-dir", str(args.results_dir)])
