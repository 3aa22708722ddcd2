"""An experiment as one command: algorithms x seeds as trials of Ray Tune, with a report at the end."""

import logging
import os
import shlex
import socket
import sys
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
from rllib_maobs.algorithms.settings import unheard, without_effect
from rllib_maobs.checkpoints import saved_networks
from rllib_maobs.experiment.arguments import has_started, make_parser, parse
from rllib_maobs.experiment.baselines import play_baselines
from rllib_maobs.experiment.claim import claim
from rllib_maobs.experiment.dashboards import check_dashboards
from rllib_maobs.experiment.film import film_best
from rllib_maobs.experiment.keeping import Keeper
from rllib_maobs.experiment.plan import of_one_seed, print_plan
from rllib_maobs.experiment.preemption import EXIT_CODE, Preemption
from rllib_maobs.experiment.report import FILES, LAST, LAST_QUICK, STEPS, write_report
from rllib_maobs.experiment.resume import StateError
from rllib_maobs.experiment.rows import OF_THE_TRIAL, PAPER_HORIZON, check_row, options_before, settings_of_row, takes
from rllib_maobs.experiment.search import Search, Space, check_installed
from rllib_maobs.experiment.storage import shown
from rllib_maobs.experiment.sweep import OF_THE_PAPER, SEARCHED, Values, check_names, name_of, parse_sweep, points, vary
from rllib_maobs.experiment.trial import TrialSpec
from rllib_maobs.experiment.tuning import resume, start
from rllib_maobs.options import Range, check_value

BETWEEN_CHECKPOINTS = 50_000  # env steps
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
        if Path(self.name).name != self.name or self.name in ("", "..") or not self.name.isprintable():
            raise ValueError(f"Experiment: name={self.name!r} is illegal; legal is a name of a folder.")
        if unnamed := [n for n in (*self.algorithms, *self.variants, *self.quick_algorithms) if not isinstance(n, str)]:
            raise ValueError(f"Experiment: {unnamed[0]!r} is no name of an algorithm or a row; legal are strings.")
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
            SystemExit: With code 1 if a trial failed, 2 for wrong arguments, 130 if it was interrupted, 143 if SIGTERM
                ended it (all trials are saved then).
        """
        doc = f"Train on {self.env}."
        parser = make_parser(self.name, self.algorithms, self.stop_timesteps, doc, self.quick_algorithms)
        args = parse(parser, self.name, argv, self.quick_algorithms)
        _quiet()
        try:
            check_dashboards(args, self.env)
            if args.search:
                check_installed()
            specs = self.specs(args)
            if any(spec.torch_compile for spec in specs) and not args.address:
                check_compiler()
            for spec in of_one_seed(specs):  # They differ in nothing else that could be wrong.
                config = spec.build_config()
                config.validate()
                if spec.start_from and (not args.resume or args.add_seeds or args.add_algos):
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
        except StateError as error:
            sys.exit(f"error: {error}")
        except KeyboardInterrupt:  # While trials run, Tune takes the first one: it saves its state and returns.
            if args.storage:
                args.storage.pull()
            print("\nInterrupted.", f"Go on with: {_resume_command(args)}" if has_started(args.results_dir) else "")
            code = 130
        if code:
            sys.exit(code)

    def specs(self, args: Namespace) -> list[TrialSpec]:
        """Return the trials, seed by seed, so that the first results compare all algorithms.

        Those of a search are not known before: these are its rows, as they are without it.

        Raises:
            ValueError: If a sweep has settings that there are not, or a row's settings contradict each other.
        """
        rows: list[tuple[str, dict[str, Any]]] = [(name, {}) for name in args.algos]
        if args.search:
            self._searched(args)
        elif args.sweep is not None:
            rows = self._swept(args)
        specs = [self._spec(args, name, seed, point) for seed in args.seeds for name, point in rows]
        if args.lengthened_to and not any(spec.stop_timesteps == args.lengthened_to for spec in specs):
            least = min(spec.stop_timesteps for spec in specs)
            raise ValueError(f"--stop-timesteps: {args.lengthened_to:,} is less than the {least:,} that trials have.")
        return specs

    def _swept(self, args: Namespace) -> list[tuple[str, dict[str, Any]]]:
        """Return each row with all combinations of the swept settings that mean something to it."""
        settings = parse_sweep(args.sweep or OF_THE_PAPER, intervals=False)
        check_names(settings, map(self._algorithm, args.algos))
        rows, silent = list[tuple[str, dict[str, Any]]](), dict[str, str]()
        for name in args.algos:
            taken = {key: values for key, values in settings.items() if takes(self._algorithm(name), key)}
            for point in points(taken):  # type: ignore[arg-type]  # no intervals
                heard, ignored = self._heard(args, name, point)
                silent |= ignored
                if (name, heard) not in rows:
                    rows.append((name, heard))
        without = settings.keys() - set[str]().union(*(point for _, point in rows))
        if args.sweep and without:
            raise ValueError("--sweep: " + "; ".join(silent[key] for key in settings if key in without) + ".")
        return rows

    def _searched(self, args: Namespace) -> dict[str, dict[str, Values]]:
        """Return where a search looks: the settings that each row takes."""
        settings = parse_sweep(args.sweep or SEARCHED, intervals=True)
        check_names(settings, map(self._algorithm, args.algos))
        rows = {
            name: {key: values for key, values in settings.items() if takes(self._algorithm(name), key)}
            for name in args.algos
        }
        for name, taken in rows.items():  # What is legal at both ends of a range is so between them.
            for key, value in ((key, value) for key, values in taken.items() for value in values):
                self._spec(args, name, args.seeds[0], {key: value}).build_config().validate()
        return rows

    def _heard(self, args: Namespace, name: str, point: dict[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
        """Split settings into those that have an effect on a row with all of them, and the others, with the reason."""
        training, _ = self._training(args, name, point)
        silent = unheard(maobs.ALGORITHMS[self._algorithm(name)]().training(**training))
        return (
            {key: value for key, value in point.items() if key not in silent},
            {key: why for key, why in silent.items() if key in point},
        )

    def _algorithm(self, name: str) -> str:
        """Return the algorithm of a row."""
        algorithm: str = self.variants.get(name, {}).get("algorithm", name)
        return algorithm

    def _training(self, args: Namespace, name: str, point: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the arguments of `training()` for a row, and all that it has for itself."""
        row = self.variants.get(name, {})
        own = vary(settings_of_row(row, self.stop_timesteps, quick=args.quick), point, self.training)
        steps = args.stop_timesteps or own["stop_timesteps"]
        training = {**self.training, "critic_state": args.critic_state}
        training |= {key: value for key, value in own.items() if key not in OF_THE_TRIAL}
        return {key: value(steps) if _depends(value) else value for key, value in training.items()}, own

    def _spec(
        self, args: Namespace, name: str, seed: int, point: Mapping[str, Any], sample: int | None = None
    ) -> TrialSpec:
        """Return one trial: what its row says, what a sweep changes, and what was given on the command line."""
        row = self.variants.get(name, {})
        if point:
            whole = {key: value for key, value in point.items() if "." not in key}
            check_row(name, {"algorithm": self._algorithm(name), **whole})
        training, own = self._training(args, name, point)
        steps = args.stop_timesteps or own["stop_timesteps"]
        horizon = args.train_horizon or own["train_horizon"]
        # What all rows share need not mean something to each, such as critic_state to IDDPG.
        config = maobs.ALGORITHMS[self._algorithm(name)]().training(**training)
        silent = {*without_effect(config)} - {*row}
        training = {key: value for key, value in training.items() if key not in silent}
        env_config = {**self.env_config, **own["env_config"]}
        return TrialSpec(
            algorithm=name_of(name, {**point, "sample": sample} if sample else point),
            variant_of=self._algorithm(name) if point else row.get("algorithm", ""),
            seed=seed,
            env=self.env,
            # Rates that fall with the length of a trial are made for its first length.
            stop_timesteps=max(steps, args.lengthened_to or 0),
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
            checkpoint_freq=args.checkpoint_freq or max(1, BETWEEN_CHECKPOINTS // own["steps_per_iteration"]),
            varied=dict(point),
        )

    def _run(self, args: Namespace, specs: list[TrialSpec]) -> int:
        """Measure, train, report; return the exit code."""
        started = _start_ray(args)
        try:
            _check_cpus(args)
            maobs.register()
            args.results_dir.mkdir(parents=True, exist_ok=True)
            if args.resume:
                print(f"Resuming {self.name} in {shown(args)}", flush=True)
                if args.lengthened_to:
                    self._print_kept(args)
            else:
                self._print_plan(args, specs)
            search = self._search(args) if args.search else None
            train, keeper = resume if args.resume else start, Keeper()
            with Preemption() as preemption:
                # What is at a URL is Tune's alone.
                callbacks = [preemption] if args.storage else [keeper, preemption]
                trials = train(self.name, args, specs, search, callbacks)
        finally:
            if started:
                ray.shutdown()
        if preemption.came:  # There may be no time for a report.
            print(*keeper.failures, f"Ended by SIGTERM. Go on with: {_resume_command(args)}", sep="\n", flush=True)
            return EXIT_CODE
        if args.search:  # Only now it is known which trials there are.
            specs = [TrialSpec(**trial.config) for trial in trials if trial.config]
        code = self._report(args, trials, specs)
        print(*keeper.failures, sep="\n", end="\n" if keeper.failures else "", flush=True)
        return code

    def _print_kept(self, args: Namespace) -> None:
        """Say which settings of longer trials were made for their first length."""
        for name in args.algos:
            row = self.variants.get(name, {})
            own = {**self.training, **settings_of_row(row, self.stop_timesteps, quick=args.quick)}
            if (args.stop_timesteps or own["stop_timesteps"]) < args.lengthened_to:
                if kept := [key for key, value in own.items() if key not in OF_THE_TRIAL and _depends(value)]:
                    print(f"{name}: {', '.join(kept)} fall as in the first run, and stay where they ended there.")

    def _search(self, args: Namespace) -> Search:
        """Return Optuna's search among the rows and the settings of --sweep."""

        def make_config(sample: int, name: str, point: dict[str, Any]) -> dict[str, Any]:
            heard, _ = self._heard(args, name, point)
            return asdict(self._spec(args, name, args.seeds[0], heard, sample))

        return Search(Space(self._searched(args)), make_config, seed=args.seeds[0], resumed=args.resume)

    def _print_plan(self, args: Namespace, specs: list[TrialSpec]) -> None:
        """Say what will be run, what it will take and where it will be found."""
        left_out = [name for name in self.algorithms if name not in args.algos]
        note = ""
        if args.quick and left_out and set(args.algos) == set(self.quick_algorithms):
            note = (
                f"--quick trains {' and '.join(args.algos)} only: {', '.join(left_out)} need hours to show anything "
                f"(name them with --algos, or leave --quick out)."
            )
        print_plan(self.name, args, specs, note)

    def _report(self, args: Namespace, trials: tune.ResultGrid, specs: list[TrialSpec]) -> int:
        """Write and print the results, and film the best; return the exit code."""
        failed = [Path(trial.path) for trial in trials if trial.error]
        names = [path.name for path in failed]
        if args.storage:
            args.storage.pull()
        try:
            baselines = play_baselines(self.env, {**self.env_config, "horizon": PAPER_HORIZON})
            # A quick run has few evaluations, of which the first ones are from before it has learned anything.
            last = LAST_QUICK if args.quick else LAST
            print(f"\n{write_report(args.results_dir, self.name, names, baselines, last)}\n")
            print(f"In {shown(args)}: {', '.join(FILES)}", flush=True)
            said = film_best(args.results_dir, specs, names, last, args.storage.pull if args.storage else None)
            print(said.replace(str(args.results_dir), shown(args)))
            if args.storage:
                args.storage.push()
        except FileNotFoundError as error:
            print(error)
        for path in failed:
            print(f"FAILED: {path.name}, see {shown(args)}/{path.name}/error.txt")
        # Trials that a search has stopped early are done, too.
        stops = {spec.name: spec.stop_timesteps for spec in specs}
        metrics = [(Path(trial.path).name, trial.metrics or {}) for trial in trials]
        finished = sum(
            bool(result.get("done")) if args.search else result.get(STEPS, 0) >= stops[name] for name, result in metrics
        )
        if finished + len(failed) < (args.num_samples if args.search else len(specs)):
            print(f"Interrupted. Go on with: {_resume_command(args)}")
            return 130
        if failed:
            print(f"Try them again, from their last checkpoints, with: {_resume_command(args)}")
            return 1
        return 0


def _depends(setting: Any) -> bool:
    """Return whether a setting is a function of the trial's env steps; a class is a setting, too: of a network, say."""
    return callable(setting) and not isinstance(setting, type)


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
        host, _, port = args.address.removeprefix("ray://").rpartition(":")
        try:
            if host and port.isdigit():  # Ray would try for minutes
                socket.create_connection((host, int(port)), timeout=10).close()
            ray.init(address=args.address, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, ValueError, OverflowError) as error:
            sys.exit(f"error: --address {args.address}: no Ray cluster can be reached there ({error})")
        return True
    if args.dashboard and find_spec("aiohttp") is None:
        sys.exit('error: --dashboard needs Ray\'s dashboard: pip install -c constraints.txt "ray[default]"')
    ray.init(
        address="local",
        num_cpus=args.workers * (1 + args.num_env_runners),
        include_dashboard=args.dashboard,
        dashboard_host="127.0.0.1",  # who reaches it can run programs here
        log_to_driver=False,
        logging_level=logging.ERROR,
    )
    return True


def _check_cpus(args: Namespace) -> None:
    """End the program if no trial could ever start: Tune would wait for more CPUs for ever."""
    needed, found = 1 + args.num_env_runners, int(ray.cluster_resources().get("CPU", 0))
    if found < needed:
        sys.exit(
            f"error: a trial needs {needed} CPUs (its own process and {args.num_env_runners} EnvRunners), and the "
            f"cluster has {found}: lower --num-env-runners, or start more machines first"
        )


def _resume_command(args: Namespace) -> str:
    return shlex.join(["python", sys.argv[0], "--resume", "--results-dir", shown(args)])
