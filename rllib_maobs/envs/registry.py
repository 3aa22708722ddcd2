"""Scenarios by id."""

from typing import Any

from rllib_maobs.envs.predator_prey import PredatorPrey
from rllib_maobs.envs.scenario import Scenario
from rllib_maobs.envs.simple_tunnel import SimpleTunnel
from rllib_maobs.envs.spread import Spread
from rllib_maobs.envs.tunnel import Tunnel
from rllib_maobs.envs.vector import VectorEnv
from rllib_maobs.options import closest

SCENARIOS: dict[str, tuple[type[Scenario[Any]], dict[str, Any]]] = {
    "obstacle-predator-prey": (PredatorPrey, {}),
    "spread-3a": (Spread, {"num_agents": 3, "num_obstacles": 2}),
    "spread-6a": (Spread, {"num_agents": 6, "num_obstacles": 4}),
    "spread-9a": (Spread, {"num_agents": 9, "num_obstacles": 6}),
    "tunnel": (Tunnel, {}),
    "simple-tunnel": (SimpleTunnel, {}),
    "simple-tunnel-6a": (
        SimpleTunnel,
        {"num_agents": 6, "num_columns": 2, "start_distance": 0.95, "target_distance": 0.95},
    ),
}
"""Class and preset options of each scenario id."""


def register_scenario(scenario_id: str, cls: type[Scenario[Any]], **options: Any) -> None:
    """Make a scenario known by an id in this process.

    Ray's worker processes do not see it; there, pass the class itself instead of an id.

    Args:
        scenario_id: The id; it replaces a scenario of the same id.
        cls: The scenario.
        **options: Preset options; checked here, and overridden by those given when the scenario is made.

    Raises:
        ValueError: If `cls` is no scenario, or has no such options.
    """
    if not (isinstance(cls, type) and issubclass(cls, Scenario)):
        raise ValueError(f"cannot register {cls!r}; legal: a subclass of Scenario")
    cls(**options)
    SCENARIOS[scenario_id] = (cls, options)


def make_scenario(scenario: str | type[Scenario[Any]], /, **options: Any) -> Scenario[Any]:
    """Make a scenario from its id or class.

    Args:
        scenario: A registered id, or a subclass of `Scenario`.
        **options: Options of the scenario, documented in its class.

    Raises:
        ValueError: If the id or an option is unknown, or a value is illegal; names what is legal.
    """
    if isinstance(scenario, type) and issubclass(scenario, Scenario):
        return scenario(**options)
    if not isinstance(scenario, str):
        raise ValueError(f"scenario {scenario!r} is illegal; legal: an id, or a subclass of Scenario (not an instance)")
    if scenario not in SCENARIOS:
        legal = list(SCENARIOS)
        raise ValueError(f"unknown scenario {scenario!r}{closest(scenario, legal)}; legal ids: {', '.join(legal)}")
    cls, preset = SCENARIOS[scenario]
    return cls(**{**preset, **options})


def make_vec(scenario: str | type[Scenario[Any]], num_envs: int = 1, **options: Any) -> VectorEnv:
    """Make a `VectorEnv`: E copies that step at once.

    Args:
        scenario: A registered id, or a subclass of `Scenario`.
        num_envs: E.
        **options: Options of the scenario, documented in its class.
    """
    return VectorEnv(make_scenario(scenario, **options), num_envs)
