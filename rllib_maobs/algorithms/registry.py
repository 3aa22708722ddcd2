"""Algorithms by name: one registry that tables, Ray and the tests iterate over."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from ray.tune.registry import register_trainable

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import JointConfig

_CONFIGS: dict[str, type[JointConfig]] = {}
_CLASSES: dict[type[JointConfig], type[JointAlgorithm]] = {}
ALGORITHMS: Mapping[str, type[JointConfig]] = MappingProxyType(_CONFIGS)
"""Every algorithm's configuration by its name."""


def register_algorithm(config: type[JointConfig], algorithm: type[JointAlgorithm] | None = None) -> type[JointConfig]:
    """Makes an algorithm known by its name: to Ray Tune, to `ALGORITHMS` and to whatever follows them.

    May be used as a decorator. Ray forgets names when it is shut down: `maobs.register()` tells them again.

    Args:
        config: Its configuration, whose `name` it gets; it replaces an algorithm of the same name.
        algorithm: Its Algorithm class; None makes one, named like the configuration without "Config".

    Returns:
        The configuration.

    Raises:
        ValueError: If it is no `JointConfig`, or has no name of its own.
    """
    if not (isinstance(config, type) and issubclass(config, JointConfig)):
        raise ValueError(f"Cannot register {config!r} as algorithm; legal is a subclass of JointConfig.")
    if "name" not in vars(config):
        raise ValueError(f"{config.__name__} has no name of its own: give it one, as a class attribute `name`.")
    if algorithm is None:
        members = {"config_class": config, "__module__": config.__module__, "__doc__": f"See `{config.__name__}`."}
        algorithm = type(config.__name__.removesuffix("Config"), (JointAlgorithm,), members)
    _CONFIGS[config.name] = config
    _CLASSES[config] = algorithm
    register_trainable(algorithm.__name__, algorithm)
    return config


def register_algorithms() -> None:
    """Tells Ray every algorithm's class by its name, e.g. "MADDPG"; may be called again."""
    for algorithm in _CLASSES.values():
        register_trainable(algorithm.__name__, algorithm)


def algorithm_of(config: type[JointConfig]) -> type[JointAlgorithm]:
    """The Algorithm class of a configuration; the common one if none was registered for it."""
    return _CLASSES.get(config, JointAlgorithm)
