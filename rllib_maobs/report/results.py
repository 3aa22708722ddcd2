"""What results folders hold: trials, sorted by the task that they were evaluated on."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from rllib_maobs.envs import SCENARIOS, make_scenario
from rllib_maobs.experiment.arguments import read_object
from rllib_maobs.experiment.baselines import task_options
from rllib_maobs.experiment.report import LABELS, LAST, LAST_QUICK, SCORE, load_curves

MEASURES = {
    **{name: label for name, label in LABELS.items() if name not in ("all_covered", "collision_free")},
    "collisions": "contacts / episode",
    "collisions_agents": "with agents",
    "collisions_obstacles": "with obstacles",
    "collisions_walls": "with walls",
    "collision_free": "contact-free",
    "time_to_goal": "steps to success",
    "path_efficiency": "path efficiency",
}


@dataclass
class Trial:
    """One trained team.

    Attributes:
        folder: Where it lies.
        label: What it is called on the page: its algorithm, and its experiment where that does not say enough.
        settings: Of its `TrialSpec`, by name.
        curve: Its evaluations, see `load_curves`.
        last: How many evaluations at the end are its result.
        failed: Whether an error ended it.
        origin: Hosts and dates of the training, and the release of Ray.
    """

    folder: Path
    label: str
    settings: Mapping[str, Any]
    curve: pd.DataFrame
    last: int
    failed: bool
    origin: Mapping[str, str]

    @property
    def result(self) -> dict[str, float]:
        """Means over the last evaluations, by measure."""
        measures = [name for name in MEASURES if name in self.curve]
        return {name: float(value) for name, value in self.curve[measures].tail(self.last).mean().items()}

    @property
    def env_steps(self) -> int:
        """How far it has come."""
        return int(self.curve["env_steps"].iloc[-1])

    @property
    def seconds(self) -> float:
        """How long that took."""
        return float(self.curve["time_total_s"].iloc[-1])

    @property
    def state(self) -> str:
        """What is to be said about its end; "" if it is finished."""
        if self.failed:
            return f"failed after {self.env_steps:,} env steps"
        stop = int(self.settings["stop_timesteps"])
        return "" if self.env_steps >= stop else f"unfinished, {self.env_steps:,} of {stop:,} env steps"


@dataclass
class Section:
    """All trials of one task.

    Attributes:
        env: Registered name of the environment.
        options: Of the evaluation; all of them if the environment is one of this package.
        trials: In the order of the folders.
        baselines: Means over episodes of policies that are not trained, by policy and measure.
    """

    env: str
    options: dict[str, Any]
    trials: list[Trial] = field(default_factory=list)
    baselines: dict[str, dict[str, float]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """What the page calls it: the environment, and the options that are not its usual ones."""
        scenario = self.env.removeprefix("maobs/")
        usual = asdict(make_scenario(scenario).options) if scenario in SCENARIOS else {}
        unusual = [f"{key}={value}" for key, value in self.options.items() if value != usual.get(key)]
        return ", ".join([scenario, *unusual])

    @property
    def rows(self) -> dict[str, list[Trial]]:
        """The trials of each label."""
        rows: dict[str, list[Trial]] = {}
        for trial in self.trials:
            rows.setdefault(trial.label, []).append(trial)
        return rows

    @property
    def measures(self) -> dict[str, str]:
        """How what was measured is called, by name; contacts that nobody can have are left out."""
        found = [name for name in MEASURES if any(name in trial.curve for trial in self.trials)]
        results = [*(trial.result for trial in self.trials), *self.baselines.values()]
        walls = any(result.get("collisions_walls") for result in results)
        return {name: MEASURES[name] for name in found if walls or name != "collisions_walls"}


def read_results(folders: Sequence[Path]) -> tuple[list[Section], list[str]]:
    """Read results folders.

    Args:
        folders: What programs in `tuned_examples/` wrote to, finished or not.

    Returns:
        A section for each task, and sentences about what is not there.

    Raises:
        ValueError: If one of them is no results folder, or nothing has been evaluated there yet.
    """
    sections: list[Section] = []
    notes: list[str] = []
    for folder in folders:
        trials, planned = _read_folder(folder)
        missing = planned - {trial.folder.name for trial in trials}
        if len(missing) == len(planned) - len(trials):  # else trials have other names than an experiment gives them
            notes += [f"{folder.name}/{name}: nothing evaluated yet" for name in sorted(missing)]
        notes += [f"{folder.name}/{trial.folder.name}: {trial.state}" for trial in trials if trial.state]
        for trial in trials:
            options = _task_options(trial.settings)
            env = str(trial.settings["env"])
            section = next((s for s in sections if (s.env, s.options) == (env, options)), None)
            if section is None:
                sections.append(section := Section(env, options))
            section.trials.append(trial)
    for section in sections:
        _tell_apart(section.trials)
    return sections, notes


def _read_folder(folder: Path) -> tuple[list[Trial], set[str]]:
    """Return the trials of a folder, and the names that its experiment planned."""
    if not folder.is_dir():
        raise ValueError(f"there is no folder {str(folder)!r}; give the results folder of an experiment")
    experiment = folder / "experiment.json"
    try:
        curves = load_curves(folder)
    except (OSError, LookupError, TypeError, ValueError, AttributeError):  # nothing is there, or something else
        if experiment.is_file():
            raise ValueError(f"{str(folder)!r} has no evaluation yet: try again later") from None
        if (folder / "result.json").is_file():
            raise ValueError(f"{str(folder)!r} is a trial: give its experiment's, {str(folder.parent)!r}") from None
        raise ValueError(
            f"{str(folder)!r} is no results folder; legal: what a program in tuned_examples/ wrote to, with a folder "
            f"for each trial that holds its result.json"
        ) from None
    plan = read_object(experiment) if experiment.is_file() else {}
    planned = {f"{algorithm}-seed{seed}" for algorithm in plan.get("algos", []) for seed in plan.get("seeds", [])}
    trials = []
    for name, curve in curves.groupby("trial", sort=False):
        path = folder / str(name)
        curve = curve.dropna(subset=[SCORE]) if SCORE in curve else curve[:0]
        if curve.empty:
            continue
        lines = path.joinpath("result.json").read_text().splitlines()
        first, latest = _first_whole(lines), _first_whole(lines[::-1])
        trials.append(
            Trial(
                folder=path,
                label=str(curve["algorithm"].iloc[0]),
                settings=first["config"],
                curve=curve.reset_index(drop=True),
                last=LAST_QUICK if plan.get("quick") else LAST,
                failed=path.joinpath("error.txt").exists() and not latest.get("done"),
                origin=_origin(path, (first, latest)),
            )
        )
    if not trials:
        raise ValueError(f"{str(folder)!r} has no evaluation yet: try again later")
    return trials, planned


def _first_whole(lines: Sequence[str]) -> dict[str, Any]:
    """Return the first result among lines of JSON; that of a run that was killed while it wrote is not whole."""
    for line in lines:
        try:
            result: dict[str, Any] = json.loads(line)
        except json.JSONDecodeError:
            continue
        return result
    return {}


def _origin(trial: Path, results: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return where and when a trial was trained."""
    origin = {
        "host": ", ".join(dict.fromkeys(str(result.get("hostname", "?")) for result in results)),
        "dates": " to ".join(dict.fromkeys(str(result.get("date", "?")).partition("_")[0] for result in results)),
    }
    saved = max(trial.glob("checkpoint_*/rllib_checkpoint.json"), default=None)
    return origin | ({"ray": str(json.loads(saved.read_text())["ray_version"])} if saved else {})


def _task_options(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a trial was evaluated on, without what makes no other task."""
    options = {**settings.get("env_config", {}), **settings.get("evaluation_env_config", {})}
    return task_options(str(settings["env"]).removeprefix("maobs/"), options)


def _tell_apart(trials: Sequence[Trial]) -> None:
    """Name the folder in the label where trials of one name come from several and are not one another's seeds."""
    for label in {trial.label for trial in trials}:
        alike = [trial for trial in trials if trial.label == label]
        kinds = [json.dumps(_training(trial.settings), sort_keys=True, default=str) for trial in alike]
        seeds = [trial.settings["seed"] for trial in alike]
        folders = {trial.folder.parent for trial in alike}
        if len(folders) > 1 and (len({*kinds}) > 1 or len({*seeds}) < len(seeds)):
            for trial in alike:
                trial.label = f"{label} ({trial.folder.parent.name})"


def _training(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return what seeds of one training have in common: each may start from a seed of another one.

    How often they are saved changes nothing, and what is empty may not have been there in an earlier revision.
    """
    same = {name: value for name, value in settings.items() if name not in ("seed", "checkpoint_freq") and value != {}}
    return {**same, "start_from": str(Path(settings.get("start_from") or "").parent)}
