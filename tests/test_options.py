"""What the documentation of a scenario says, and that every option does something."""

import re

import numpy as np
import pytest

from rllib_maobs.envs import SCENARIOS, Spread, make_scenario, make_vec

PREY = "obstacle-predator-prey"


@pytest.mark.parametrize(
    ("scenario_id", "agents", "observation", "observations_state", "world_state"),
    [
        (PREY, 3, 16, 48, 20),
        ("spread-3a", 3, 18, 54, 22),
        ("spread-6a", 6, 34, 204, 44),
        ("spread-9a", 9, 50, 450, 66),
        ("tunnel", 3, 18, 54, 22),
        ("simple-tunnel", 3, 14, 42, 22),
        ("simple-tunnel-6a", 6, 20, 120, 40),
    ],
)
def test_sizes(scenario_id, agents, observation, observations_state, world_state):
    env = make_vec(scenario_id)
    sizes = len(env.agents), env.scenario.observation_size, env.state_size("observations"), env.state_size("world")
    assert sizes == (agents, observation, observations_state, world_state)
    documentation = type(env.scenario).__doc__
    for number in (observation, observations_state, world_state):
        assert f"{number}" in documentation


def test_every_id_is_documented():
    for scenario_id, (cls, _) in SCENARIOS.items():
        assert f"`{scenario_id}`" in cls.__doc__


def test_scenario_documentation_names_every_option():
    for cls, _ in SCENARIOS.values():
        assert cls.__doc__
        for name in cls.options_class.__dataclass_fields__:
            assert f"{name}:" in cls.__doc__, f"{cls.__name__} does not document {name}"


def test_spread_repr_shows_the_options():
    assert "num_agents=4" in repr(Spread(num_agents=4))


def test_documented_defaults_are_the_defaults():
    """The first word after the origin, as in "[MPE: 0.1]"; ids with several sizes name those of all."""
    for cls, _ in SCENARIOS.values():
        for name, field in cls.options_class.__dataclass_fields__.items():
            entry = re.search(rf"^ {{8}}{name}:(.*?)(?=^ {{4,8}}\w|\Z)", cls.__doc__.split("Args:")[1], re.M | re.S)
            documented = re.search(r"\[(?:paper|MPE|our\s+choice)[^\]:]*:\s+([^\s,;\]]+)", entry.group(1)).group(1)
            default = field.default
            assert documented == (f"{default:g}" if type(default) is float else str(default)), (cls, name)


# Another legal value of every option, with what must also be set to see a difference.
ANOTHER = {
    "horizon": 10,
    "action_mode": "force",
    "physics": "solid",
    "integrator": "explicit",
    "terminate_on_success": True,
    "state": "world",
    "reward_mode": "mean",
    "matching": "one_to_one",
    "placement": "mpe",
    "prey": "flee",
    "num_agents": 4,
    "num_columns": 3,
    "num_obstacles": 3,
    "num_predators": 2,
    "agent_radius": 0.06,
    "obstacle_radius": 0.12,
    "predator_radius": 0.09,
    "prey_radius": 0.2,
    "goal_radius": 0.5,
    "gap": 0.2,
    "spacing": 0.4,
    "start_distance": 0.9,
    "target_distance": 0.9,
    "column_spacing": 0.2,
    "start_noise": 0.01,
    "wall_x": 1.2,
    "wall_y": 0.9,
    "clearance": 0.1,
    "agent_range": 0.9,
    "obstacle_range": 0.7,
    "prey_range": 0.5,
}
NEEDS = {
    "num_columns": {"start_distance": 0.8, "target_distance": 0.8},
    "column_spacing": {"start_distance": 0.8, "target_distance": 0.8, "num_columns": 3},
    "prey_range": {"prey": "flee"},
}


def everything(scenario_id, options):
    """What a user sees of some episodes, played alike whatever the option: by chance, then head over heels."""
    env = make_vec(scenario_id, num_envs=8, **options)
    seen = [env.agents, str(env.action_spaces), env.scenario.view()]
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for t in range(100):
        actions = env.scenario.actions(rng.uniform(-1, 1, (8, len(env.agents), 2)))
        if t == 20:  # a crowd: contacts of everybody with everything
            env.world.position[:, : env.world.num_movers] *= 0.3
            env.world.velocity[:, : env.world.num_movers] *= 2.0
        if t == 40 and "target" in env.world.index:
            env.world.position[:, : len(env.agents)] = env.world.position[:, env.world.index["target"]]
        if t == 45:
            env.world.position[:, : len(env.agents)] += 0.4  # over the wall
        obs, rewards, terminated, truncated, info = env.step(actions)
        seen += [obs, rewards, terminated, truncated, info.get("episode_metrics"), env.state()]
        if (terminated | truncated).any():
            env.reset(mask=terminated | truncated)
    return seen


def same(one, other):
    try:
        np.testing.assert_equal(one, other)
    except AssertionError:
        return False
    return True


@pytest.mark.parametrize(
    ("scenario_id", "option"),
    [
        (i, o)
        for i in ("spread-3a", "tunnel", "simple-tunnel", PREY)
        for o in type(make_scenario(i).options).__dataclass_fields__
    ],
)
def test_every_option_does_something(scenario_id, option):
    default = getattr(make_scenario(scenario_id).options, option)
    another = ANOTHER.get(option, 2.0 * default + 0.1 if isinstance(default, float) else None)
    needs = NEEDS.get(option, {})
    plain = everything(scenario_id, needs)
    assert same(plain, everything(scenario_id, needs | {option: default}))
    assert not same(plain, everything(scenario_id, needs | {option: another}))
