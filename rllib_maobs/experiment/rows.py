"""Rows of a comparison: what an algorithm may have for itself, and what `--quick` makes of it."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from typing import Annotated, Any

import rllib_maobs as maobs
from rllib_maobs.envs import SCENARIOS, make_scenario
from rllib_maobs.options import Range, check_value, closest
from rllib_maobs.paths import file_name

PAPER_HORIZON = 100
_Count = Annotated[int, Range(1)]
# What a row may set beside arguments of training(), and what is legal for it.
OF_THE_TRIAL: dict[str, Any] = {
    "env_config": None,
    "train_env_config": None,
    "train_horizon": _Count,
    "num_envs_per_env_runner": _Count,
    "one_policy": bool,
    "stop_timesteps": _Count,
    "steps_per_iteration": _Count,
    "evaluation_duration": _Count,
    "torch_compile": bool,
}
# Those of RLlib's own arguments of training() that mean something here; it has others, such as `lr`, that do not.
_OF_RLLIB = ("gamma", "train_batch_size_per_learner", "grad_clip", "grad_clip_by")
DEFAULTS: dict[str, Any] = {
    "env_config": {},
    "train_env_config": {},
    "train_horizon": PAPER_HORIZON,
    "num_envs_per_env_runner": 8,
    "one_policy": False,
    "steps_per_iteration": 1000,
    "evaluation_duration": 10,
    "torch_compile": True,
}
# What `--quick` makes of every row, unless its own "quick" says otherwise.
QUICK: dict[str, Any] = {
    "stop_timesteps": 4000,
    "steps_per_iteration": 400,
    "evaluation_duration": 5,
    "torch_compile": False,
}


def decayed(rate: float) -> Callable[[int], list[list[float]]]:
    """Return a learning rate for a row's settings: constant for the first half, then down to a twentieth.

        "actor_lr": decayed(5e-4)

    Args:
        rate: Of the first half.

    Returns:
        A function from a trial's env steps to RLlib's schedule over env steps.
    """

    def schedule(env_steps: int) -> list[list[float]]:
        return [[0, rate], [env_steps // 2, rate], [env_steps, rate / 20]]

    return schedule


def fading(epsilon: float, noise: float, final: float) -> Callable[[int], dict[str, float]]:
    """Return exploration for a row's settings that falls evenly over the first 60 % of a trial, to `final`.

        "exploration": fading(epsilon=0.1, noise=0.2, final=0.02)

    Args:
        epsilon: Share of random actions at the start.
        noise: Standard deviation of the Gaussian noise at the start.
        final: Where both stop.

    Returns:
        A function from a trial's env steps to settings of `EpsilonGaussian`.
    """

    def settings(env_steps: int) -> dict[str, float]:
        decay = (max(epsilon, noise) - final) / (0.6 * env_steps)
        return {"epsilon": epsilon, "noise": noise, "decay": decay, "final": final}

    return settings


def check_row(name: str, row: Mapping[str, Any]) -> None:
    """Check the names of a row's settings, and the values of those that are the trial's.

    Args:
        name: Of the row.
        row: Its settings.

    Raises:
        ValueError: If one is unknown or illegal; names the legal ones.
    """
    if not isinstance(row, Mapping):
        raise ValueError(f"Row {name!r}: {row!r} is illegal; legal: a mapping of settings.")
    if not isinstance(name, str) or name != file_name(name):
        raise ValueError(
            f"Row {name!r}: folders of trials are named after it; legal are letters, digits and . _ + - (no dot first)."
        )
    algorithm = row.get("algorithm", "")
    if not isinstance(algorithm, str) or algorithm not in maobs.ALGORITHMS:
        legal = ", ".join(maobs.ALGORITHMS)
        raise ValueError(f"Row {name!r}: unknown algorithm {algorithm!r}; legal are {legal}.")
    training = _training_arguments(maobs.ALGORITHMS[algorithm])
    _check(f"Row {name!r}", {key: row[key] for key in row if key not in ("algorithm", "quick")}, training, ["quick"])
    quick = row.get("quick", {})
    if not isinstance(quick, Mapping):
        raise ValueError(f"Row {name!r}: quick={quick!r} is illegal; legal: a mapping of settings.")
    _check(f"Row {name!r}, quick", quick, training, [])


def takes(algorithm: str, name: str) -> bool:
    """Return whether a row of an algorithm may have a setting, or, with a dotted name, options within it."""
    setting, dot, _ = name.partition(".")
    mappings = ("env_config", "train_env_config", "exploration")
    known = [*OF_THE_TRIAL, *_training_arguments(maobs.ALGORITHMS[algorithm])]
    return setting in known and bool(dot) == (setting in mappings)


def legal_settings(algorithms: Iterable[str]) -> list[str]:
    """Return what rows of some algorithms may have: of the trial, and of their configs' `training()`."""
    training = (name for algorithm in algorithms for name in _training_arguments(maobs.ALGORITHMS[algorithm]))
    return list(dict.fromkeys([*OF_THE_TRIAL, *training]))


def _check(owner: str, given: Mapping[str, Any], training: list[str], more: list[str]) -> None:
    for key, value in given.items():
        if OF_THE_TRIAL.get(key) is not None:
            check_value(value, OF_THE_TRIAL[key], key, owner)
        elif key in OF_THE_TRIAL and not isinstance(value, Mapping):
            raise ValueError(f"{owner}: {key}={value!r} is illegal; legal: a mapping of the environment's options.")
        elif key in OF_THE_TRIAL:
            continue
        elif key not in training:
            raise ValueError(
                f"{owner} has no setting {key!r}{closest(key, [*OF_THE_TRIAL, *more, *training])}; legal are "
                f"{', '.join([*OF_THE_TRIAL, *more])}, and arguments of training(): {', '.join(training)}."
            )


def _training_arguments(config: type[Any]) -> list[str]:
    """Return what a config's `training()` takes by name; each class adds to that of its base."""
    names = list[str]()
    for cls in config.__mro__:
        if issubclass(cls, maobs.JointConfig) and (function := vars(cls).get("training")):
            parameters = inspect.signature(function).parameters.values()
            names += [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.name not in names]
    return [*names, *_OF_RLLIB]


def settings_of_row(row: Mapping[str, Any], stop_timesteps: int, *, quick: bool) -> dict[str, Any]:
    """Return all settings of a row.

    Args:
        row: What it has for itself.
        stop_timesteps: Env steps if it does not say.
        quick: Whether the run is a quick one.

    Returns:
        Those of `OF_THE_TRIAL`, all of them, and those of `training()` that are the row's own.
    """
    own = {key: value for key, value in row.items() if key not in ("algorithm", "quick")}
    small = {**QUICK, **row.get("quick", {})} if quick else {}
    return {**DEFAULTS, "stop_timesteps": stop_timesteps, **own, **small}


def options_before(env: str, env_config: Mapping[str, Any], changed: Mapping[str, Any]) -> dict[str, Any]:
    """Return what an environment's options are where training changes them: those that evaluation goes by.

    Args:
        env: Registered name of the environment.
        env_config: Its options.
        changed: Those that training changes.

    Raises:
        ValueError: If that is not known (a foreign environment's default), or one is illegal.
    """
    scenario = env.removeprefix("maobs/")
    if scenario in SCENARIOS:
        make_scenario(scenario, **{**env_config, **changed})
        env_config = asdict(make_scenario(scenario, **env_config).options)
    if unknown := [name for name in changed if name not in env_config]:
        raise ValueError(
            f"train_env_config changes {', '.join(unknown)} of {env}: give what evaluation shall have, in env_config."
        )
    return {name: env_config[name] for name in changed}
