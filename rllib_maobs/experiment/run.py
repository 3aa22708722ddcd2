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
from typing import Any

import ray
from ray import tune

import rllib_maobs as maobs
from rllib_maobs.experiment.arguments import PAPER_HORIZON, has_started, make_parser, parse, save_settings
from rllib_maobs.experiment.baselines import play_baselines
from rllib_maobs.experiment.progress import ProgressTable, makespan
from rllib_maobs.experiment.report import FILES, STEPS, write_report
from rllib_maobs.experiment.resume import forget_decisions
from rllib_maobs.experiment.tables import format_table, format_time
from rllib_maobs.experiment.trial import Pace, Trial, TrialSpec, measure_pace


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
    for each trial: `comparison.md`, `comparison.csv`, `curves.csv`, `curves.png`.

    Attributes:
        name: Names the default results folder.
        env: Registered name of the environment.
        algorithms: Names of the algorithms, or of variants.
        variants: Algorithms with settings of their own, by the name they shall have in tables: `"algorithm"`, one of
            `maobs.ALGORITHMS`, and arguments of its `training()`. A function there is called with a trial's env steps.
        training: Arguments of the configs' `training()`, the same for all algorithms.
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

    def __post_init__(self) -> None:
        named = [self.variants.get(name, {"algorithm": name}).get("algorithm") for name in self.algorithms]
        if unknown := [repr(name) for name in named if name not in maobs.ALGORITHMS]:
            raise ValueError(f"Unknown algorithms {', '.join(unknown)}; legal are {', '.join(maobs.ALGORITHMS)}.")

    def main(self, argv: Sequence[str] | None = None) -> None:
        """Run the command line.

        Args:
            argv: Arguments; None for those of the program.

        Raises:
            SystemExit: With code 1 if a trial failed, 2 for wrong arguments, 130 if it was interrupted.
        """
        parser = make_parser(self.name, self.algorithms, self.stop_timesteps, f"Train on {self.env}.")
        args = parse(parser, self.name, argv)
        _quiet()
        specs = self.specs(args)
        try:
            for spec in specs[: len(args.algos)]:  # The first seed's: they differ in nothing that could be wrong.
                spec.build_config().validate()
        except ValueError as error:
            parser.error(str(error))
        try:
            code = self._run(args, specs)
        except KeyboardInterrupt:  # While trials run, Tune takes the first one: it saves its state and returns.
            print("\nInterrupted.", f"Go on with: {_resume_command(args)}" if has_started(args.results_dir) else "")
            code = 130
        if code:
            sys.exit(code)

    def specs(self, args: Namespace) -> list[TrialSpec]:
        """Return the trials, seed by seed, so that the first results compare all algorithms."""

        def training(algorithm: str) -> dict[str, Any]:
            own = {name: value for name, value in self.variants.get(algorithm, {}).items() if name != "algorithm"}
            own = {name: value(args.stop_timesteps) if callable(value) else value for name, value in own.items()}
            return {**self.training, "critic_state": args.critic_state, **own}

        return [
            TrialSpec(
                algorithm=algorithm,
                variant_of=self.variants.get(algorithm, {}).get("algorithm", ""),
                seed=seed,
                env=self.env,
                training=training(algorithm),
                env_config={**self.env_config, "horizon": args.train_horizon},
                evaluation_env_config={"horizon": PAPER_HORIZON},
                num_env_runners=args.num_env_runners,
                torch_compile=not args.no_compile,
                steps_per_iteration=400 if args.quick else 1000,
                evaluation_duration=5 if args.quick else 10,
            )
            for seed in args.seeds
            for algorithm in args.algos
        ]

    def _run(self, args: Namespace, specs: list[TrialSpec]) -> int:
        """Measure, train, report; return the exit code."""
        _start_ray(args)
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
            ray.shutdown()
        return self._report(args, trials, len(specs))

    def _print_plan(self, args: Namespace, specs: list[TrialSpec]) -> None:
        """Say what will be run, what it will take and where it will be found."""
        config = specs[0].build_config()
        print(
            f"{self.name}: {len(specs)} trials, {', '.join(args.algos)} with seed {', '.join(map(str, args.seeds))}\n"
            f"{args.stop_timesteps:,} env steps each, {config.updates_per_env_step:g} update(s) per env step\n"
            f"Measuring how fast that is here{'' if args.no_compile else ' (and compiling)'} ...",
            flush=True,
        )
        start = time.monotonic()
        cores = int(ray.available_resources().get("CPU", 0))
        at_once = max(1, min(cores // (1 + args.num_env_runners), len(specs)))
        pace = _measure(specs[: len(args.algos)], at_once, seconds=2.0 if args.quick else 10.0)
        seconds = {name: args.stop_timesteps / pace[name].env_steps_per_s for name in args.algos}
        rows = [[name, f"{pace[name].env_steps_per_s:.0f}", format_time(seconds[name])] for name in args.algos]
        total = makespan([seconds[spec.algorithm] for spec in specs], at_once)
        kept = min(args.stop_timesteps, config.replay_buffer_capacity)
        megabytes = kept * max(each.bytes_per_env_step for each in pace.values()) / 1e6
        print(
            f"\n{format_table(['algorithm', 'env steps/s', 'time per trial'], rows)}\n\n"
            f"Measured with {at_once} at once in {format_time(time.monotonic() - start)}, with evaluation, without "
            f"compiling.\n"
            f"Estimated: {total / 3600:.2f} hours for all, {at_once} at once.\n"
            f"Replay will take {megabytes:,.0f} MB of memory per trial, and as much of disk in its checkpoint; free "
            f"disk: {shutil.disk_usage(args.results_dir).free / 1e6:,.0f} MB.\n"
            f"Results: {args.results_dir}\n"
            f"TensorBoard: tensorboard --logdir {shlex.quote(str(args.results_dir))}\n"
            f"Ctrl-C stops; then --resume goes on from the last checkpoints.\n",
            flush=True,
        )

    def _report(self, args: Namespace, trials: tune.ResultGrid, planned: int) -> int:
        """Write and print the results; return the exit code."""
        failed = [Path(trial.path) for trial in trials if trial.error]
        try:
            baselines = play_baselines(self.env, {**self.env_config, "horizon": PAPER_HORIZON})
            print(f"\n{write_report(args.results_dir, self.name, [path.name for path in failed], baselines)}\n")
            print(f"In {args.results_dir}: {', '.join(FILES)}")
        except FileNotFoundError as error:
            print(error)
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


def _quiet() -> None:
    """Keep Ray's own tables and notes away from the progress table; errors still show."""
    for name in ("ray", "ray.rllib"):
        logging.getLogger(name).setLevel(logging.ERROR)
    # Tune leaves the table to our reporter only in its older form of output.
    os.environ["RAY_AIR_NEW_OUTPUT"] = "0"
    # It warns that a run with frequent checkpoints saves its state often, which takes no time with a few trials.
    os.environ.setdefault("TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S", "0")


def _start_ray(args: Namespace) -> None:
    """Start Ray on this machine with one CPU per process of a trial, or connect to a cluster."""
    if args.address:
        try:
            ray.init(address=args.address, log_to_driver=False, logging_level=logging.ERROR)
        except ConnectionError as error:
            sys.exit(f"error: --address {args.address}: {error}")
        return
    if args.dashboard and find_spec("aiohttp") is None:
        sys.exit('error: --dashboard needs Ray\'s dashboard: pip install -c constraints.txt "ray[default]"')
    ray.init(
        address="local",
        num_cpus=args.workers * (1 + args.num_env_runners),
        include_dashboard=args.dashboard,
        log_to_driver=False,
        logging_level=logging.ERROR,
    )


def _make_tuner(name: str, args: Namespace, specs: list[TrialSpec]) -> tune.Tuner:
    save_settings(name, args)
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
