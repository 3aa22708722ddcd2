"""Checks of what a scenario says and returns: once, where its environment begins, so that steps stay quick."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rllib_maobs.envs.scenario import Outcome, Scenario
from rllib_maobs.envs.world import FloatArray
from rllib_maobs.layout import as_layout


def check_scenario(scenario: Scenario[Any]) -> None:
    """Raise a ValueError unless a scenario's layouts and the names of its metrics are legal."""
    owner = type(scenario).__name__
    for agent, layout in zip(scenario.agents, scenario.observation_layouts, strict=True):
        as_layout(layout, None, f"observation of agent {agent!r}")
    reductions = scenario.metric_reductions()
    if not isinstance(reductions, Mapping) or not all(isinstance(how, str) for how in reductions.values()):
        raise ValueError(f"{owner}.metrics are {reductions!r}; legal: a dict of reductions by name.")


def checked_places(scenario: Scenario[Any], position: Any, num_envs: int, num_bodies: int) -> FloatArray:
    """Return the start positions (E, K, 2), or raise a ValueError unless they are such."""
    places = _array(position)
    if places is None or places.shape != (num_envs, num_bodies, 2) or not np.isfinite(places).all():
        expected = (num_envs, num_bodies, 2)
        raise ValueError(
            f"{type(scenario).__name__}.place() returns {_kind(position)}; legal: finite numbers (copies to place, "
            f"bodies, 2) = {expected}."
        )
    return places


def check_outcome(scenario: Scenario[Any], outcome: Any, num_envs: int) -> None:
    """Raise a ValueError unless that is a scenario's outcome of a step in all copies."""
    owner = f"{type(scenario).__name__}.outcome()"
    if not isinstance(outcome, Outcome):
        raise ValueError(f"{owner} returns {_kind(outcome)}; legal: an Outcome.")
    if not isinstance(outcome.metrics, Mapping):
        raise ValueError(f"{owner} returns metrics {outcome.metrics!r}; legal: a dict of arrays ({num_envs},) by name.")
    expected: dict[str, tuple[Any, tuple[int, ...]]] = {"rewards": (outcome.rewards, (num_envs, len(scenario.agents)))}
    expected["success"] = outcome.success, (num_envs,)
    expected |= {f"metric {name!r}": (value, (num_envs,)) for name, value in outcome.metrics.items()}
    for name, (value, shape) in expected.items():
        if not isinstance(value, np.ndarray) or _array(value) is None or value.shape != shape:
            raise ValueError(f"{owner} returns as {name} {_kind(value)}; legal: an array {shape} of numbers.")
    if outcome.success.dtype != bool:
        raise ValueError(
            f"{owner} returns as success {_kind(outcome.success)}; legal: an array ({num_envs},) of bools."
        )
    if missing := [name for name in scenario.metric_reductions() if name not in {*outcome.metrics, *_OF_ALL}]:
        raise ValueError(f"{owner} has no metrics {missing}, which {type(scenario).__name__}.metrics names.")


_OF_ALL = (
    "success time_to_goal collisions_agents collisions_obstacles collisions_walls min_clearance return_agent_0"
).split()  # what is measured in every scenario


def _array(value: Any) -> NDArray[Any] | None:
    try:
        array = np.asarray(value)
    except (ValueError, TypeError):  # rows of different lengths
        return None
    return array if array.dtype.kind in "fiub" else None


def _kind(value: Any) -> str:
    array = _array(value)
    return f"a {type(value).__name__}" if array is None else f"{array.dtype} {array.shape}"
