"""Sweeps: settings that are tried with several values, by name, as `--sweep` has them on the command line."""

import itertools
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from functools import partial
from typing import Any, NamedTuple

from rllib_maobs.experiment.rows import legal_settings, takes
from rllib_maobs.options import closest

# What the paper's tables III to VII range over.
OF_THE_PAPER = ("train_batch_size_per_learner=32,128,256", "seq_length=3,5", "critic_lr=1e-2,1e-3")
# Where a search looks that is told nothing else.
SEARCHED = ("actor_lr=1e-4..1e-2", "critic_lr=1e-4..1e-2", "tau=0.001..0.1", "train_batch_size_per_learner=32,128,256")
# Tune replaces these in names of folders.
_NOT_IN_NAMES = re.compile(r'[/()<>:"\\|?*]')


class Interval(NamedTuple):
    """All numbers from `low` to `high`, for a search; integers if both are."""

    low: float
    high: float

    @property
    def logarithmic(self) -> bool:
        """Whether to search it by orders of magnitude."""
        return self.low > 0 and self.high >= 10 * self.low


Values = list[Any] | Interval


def parse_sweep(items: Sequence[str], *, intervals: bool) -> dict[str, Values]:
    """Read what `--sweep` was given.

    Args:
        items: Such as "actor_lr=1e-3,3e-4", "actor=mlp,lstm", "env_config.num_obstacles=3,6" or "tau=0.001..0.1".
        intervals: Whether the last form is legal.

    Returns:
        The values of each setting.

    Raises:
        ValueError: If an item is not of this form, or names a value or a setting twice.
    """
    settings: dict[str, Values] = {}
    for item in items:
        name, equals, text = item.partition("=")
        if not (name and equals and all(part.strip() for part in text.split(","))):
            raise ValueError(f"--sweep: {item!r} is not of the form SETTING=VALUE,VALUE, such as actor_lr=1e-3,3e-4.")
        if name in settings:
            raise ValueError(f"--sweep: {name} is there twice; give all of its values at once.")
        settings[name] = values = _interval(item, text) or [_value(part.strip()) for part in text.split(",")]
        if isinstance(values, Interval):
            if not intervals:
                raise ValueError(f"--sweep: {item} is a range, which only --search takes; name its values instead.")
        elif len({_text(value) for value in values}) < len(values):
            raise ValueError(f"--sweep: {item} has the same value twice.")
    return settings


def _interval(item: str, text: str) -> Interval | None:
    if ".." not in text:
        return None
    ends = [_value(end) for end in text.split("..")]
    if len(ends) != 2 or any(type(end) not in (int, float) for end in ends) or not ends[0] < ends[1]:
        raise ValueError(f"--sweep: {item} is no range; legal: two numbers, the lower one first, such as 1e-4..1e-2.")
    return Interval(*ends)


def _value(text: str) -> Any:
    """Return a number, True, False, None, or the text itself."""
    if text.lower() in ("true", "false", "none"):
        return {"true": True, "false": False, "none": None}[text.lower()]
    try:
        number = json.loads(text)
        return number if type(number) in (int, float) and math.isfinite(number) else text
    except ValueError:
        pass
    try:
        return float(Fraction(text))  # 1/8, 1.e-3, .5
    except (ValueError, ZeroDivisionError):
        return text


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def name_of(row: str, point: Mapping[str, Any]) -> str:
    """Return how tables and folders call a row with some settings, such as "maddpg,actor_lr=0.001"."""
    return _NOT_IN_NAMES.sub("_", ",".join([row, *(f"{name}={_text(value)}" for name, value in point.items())]))


def points(settings: Mapping[str, list[Any]]) -> list[dict[str, Any]]:
    """Return all combinations of the values; one that is empty where there are no settings."""
    return [dict(zip(settings, values, strict=True)) for values in itertools.product(*settings.values())]


def vary(settings: Mapping[str, Any], point: Mapping[str, Any], shared: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row's settings with some of them replaced.

    A dotted name is an option within a setting, as in "env_config.num_obstacles" or "exploration.noise". A schedule of
    a learning rate, or a function that makes one from the trial's env steps, keeps its shape and starts at the value.

    Args:
        settings: What the row has for itself.
        point: What is replaced.
        shared: Settings of all rows: what a row has that does not say otherwise.
    """
    settings = dict(settings)
    for name, value in point.items():
        name, dot, option = name.partition(".")
        before = settings.get(name, shared.get(name))
        if dot:
            settings[name] = _changed(before or {}, partial(_with_option, option, value))
        elif name in ("actor_lr", "critic_lr"):
            settings[name] = _changed(before, partial(_starting_at, value))
        else:
            settings[name] = value
    return settings


def _changed(setting: Any, change: Callable[[Any], Any]) -> Any:
    """Change a setting, or what a function makes of the trial's env steps."""
    return (lambda env_steps: change(setting(env_steps))) if callable(setting) else change(setting)


def _with_option(name: str, value: Any, options: Mapping[str, Any]) -> dict[str, Any]:
    return {**options, name: value}


def _starting_at(rate: Any, schedule: Any) -> Any:
    if not isinstance(schedule, list) or not isinstance(rate, int | float):
        return rate
    return [[step, rate * value / schedule[0][1]] for step, value in schedule]


def check_names(names: Iterable[str], algorithms: Iterable[str]) -> None:
    """Check that each setting of a sweep is one that a row may have.

    Args:
        names: Of the settings.
        algorithms: Of the rows, names in `maobs.ALGORITHMS`.

    Raises:
        ValueError: If one is not; names the nearest that is.
    """
    algorithms = list(dict.fromkeys(algorithms))
    for name in names:
        if any(takes(algorithm, name) for algorithm in algorithms):
            continue
        setting, dot, _ = name.partition(".")
        legal = legal_settings(algorithms)
        if setting in legal and not dot:
            raise ValueError(f"--sweep: {name} is a mapping; name one of its options, as in {name}.OPTION=1,2.")
        if setting in legal:
            raise ValueError(f"--sweep: {setting} has no options, so there is no {name}.")
        raise ValueError(
            f"--sweep: no row has a setting {name!r}{closest(name, legal)}; legal are {', '.join(legal)}; and options "
            f"of mappings, such as env_config.num_obstacles."
        )
