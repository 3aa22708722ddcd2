"""What observations and states say they are made of, from the scenario through the faces to the team."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from rllib_maobs.envs import (
    SCENARIOS,
    Bodies,
    Entities,
    MAObsEnv,
    Outcome,
    Scenario,
    ScenarioOptions,
    make_vec,
    parallel_env,
    split,
)
from rllib_maobs.envs.joint import StackedEnv, make_joint_env
from rllib_maobs.envs.team import Team
from rllib_maobs.envs.wrappers import WithAgentIds
from rllib_maobs.layout import as_layout, flat, layout_size

PREY = "obstacle-predator-prey"
TASKS = [*((scenario_id, {}) for scenario_id in sorted(SCENARIOS)), (PREY, {"prey": "learned"})]
GROUPS = {
    "Spread": ["self", "target", "obstacle", "agent"],
    "Tunnel": ["self", "target", "obstacle", "agent"],
    "SimpleTunnel": ["self", "target", "obstacle", "agent"],
    "PredatorPrey": ["self", "obstacle", "predator", "prey"],
}


def some_steps(scenario_id, options, num_envs=3):
    """An environment in the middle of an episode, where everything that moves does."""
    env = make_vec(scenario_id, num_envs=num_envs, **options)
    env.reset(seed=0)
    env.world.velocity[:, : env.world.num_movers] = np.random.default_rng(0).normal(
        size=(num_envs, env.world.num_movers, 2)
    )
    return env


# Cutting.


def test_groups_are_views():
    layout = (Entities("self", 1, 4), Entities("target", 3, 2, 2), Entities("none", 0, 2), Entities("agent", 2, 2, 2))
    out = np.full((2, 3, 17), np.nan, np.float32)  # three columns of padding
    parts = split(layout, out)
    assert [part.shape for part in parts.values()] == [(2, 3, 1, 4), (2, 3, 3, 2), (2, 3, 0, 2), (2, 3, 2, 2)]
    for number, part in enumerate(parts.values()):
        assert part.size == 0 or np.shares_memory(part, out)
        part[...] = number
    np.testing.assert_array_equal(out, np.broadcast_to([0.0] * 4 + [1.0] * 6 + [3.0] * 4 + [np.nan] * 3, (2, 3, 17)))
    parts["target"][1, 2, 0, 1] = 9.0
    assert out[1, 2, 5] == 9.0
    # Also of some agents, and of an array that is itself a view.
    split(layout, out[:, 1:2])["agent"][...] = 7.0
    assert (out[:, 1, 10:14] == 7.0).all() and not (out[:, 0] == 7.0).any()
    wide = np.zeros((3, 2, 20), np.float32)
    split(layout, wide.transpose(1, 0, 2))["self"][...] = 1.0
    assert wide.sum() == 24.0
    tensor = torch.zeros(2, 14)
    split(layout, tensor)["target"][:, 2] = 1.0
    assert tensor.sum(0).tolist() == [0.0] * 8 + [2.0] * 2 + [0.0] * 4


# Scenarios.


@pytest.mark.parametrize(("scenario_id", "options"), TASKS)
def test_observations_are_what_their_layouts_say(scenario_id, options):
    env = some_steps(scenario_id, options)
    world, scenario, observations = env.world, env.scenario, env.observe()
    world.refresh()
    acting = scenario.agent_groups()
    for i, agent in enumerate(env.agents):
        layout = env.observation_layouts[agent]
        own = observations[:, i, : layout_size(layout)]
        assert env.observation_spaces[agent].shape == (own.shape[-1],)
        expected = GROUPS[type(scenario).__name__]
        assert [group.name for group in layout] == (expected[:-1] if agent == "prey_0" else expected)
        parts = split(layout, own)
        moving = np.concatenate([world.velocity[:, i], world.position[:, i]], axis=-1)
        np.testing.assert_array_equal(parts.pop("self")[:, 0], moving.astype(np.float32))
        assert layout[0] == Entities("self", 1, 4)
        for name, part in parts.items():
            bodies = np.arange(world.num_bodies)[world.index[name]]
            if name in acting:
                bodies = bodies[bodies != i]
            if name == "target" and scenario.own_targets:
                bodies = bodies[[i]]
            offset = world.offset[:, i, bodies]
            if name == "prey":
                offset = np.concatenate([offset, world.velocity[:, bodies]], axis=-1)
            np.testing.assert_array_equal(part, offset.astype(np.float32))
            assert next(group for group in layout if group.name == name).position == 2


@pytest.mark.parametrize(("scenario_id", "options"), TASKS)
def test_the_world_state_has_a_row_for_each_body(scenario_id, options):
    env = some_steps(scenario_id, options)
    world, state = env.world, env.state("world")
    assert [(group.name, group.count) for group in env.state_layout] == [(g.name, g.count) for g in world.groups]
    parts = split(env.state_layout, state)
    for group in world.groups:
        bodies = world.index[group.name]
        rows = [world.position[:, bodies], world.velocity[:, bodies]][: 1 + group.movable]
        np.testing.assert_array_equal(parts[group.name], np.concatenate(rows, axis=-1).astype(np.float32))
    # The agents' rows come first, in their order.
    acting = list(parts)[: len(env.scenario.agent_groups())]
    names = [f"{name}_{i}" for name in acting for i in range(parts[name].shape[1])]
    assert names == env.agents
    assert layout_size(env.state_layout) == env.state_size("world") == state.shape[1]
    assert {group.position for group in env.state_layout} == {2}


@pytest.mark.parametrize(("scenario_id", "options"), TASKS)
def test_longer_arrays_are_written_alike(scenario_id, options):
    env = some_steps(scenario_id, options)
    expected = env.observe()
    out = np.full((*expected.shape[:2], expected.shape[2] + 5), np.nan, np.float32)
    env.scenario.observe(env.world, out)
    for i, size in enumerate(env.scenario.observation_sizes):
        np.testing.assert_array_equal(out[:, i, :size], expected[:, i, :size])
    assert np.isnan(out[..., -5:]).all()


@dataclass(frozen=True)
class TwoOptions(ScenarioOptions):
    num_agents: int = 2


class Two(Scenario[TwoOptions]):
    """Says nothing about observations."""

    options_class = TwoOptions

    def bodies(self):
        return [Bodies("agent", self.options.num_agents, 0.1, movable=True)]

    def place(self, rngs):
        return np.stack([rng.uniform(-1, 1, (self.options.num_agents, 2)) for rng in rngs])

    def observe(self, world, out):
        out[..., 0:2] = world.position

    def outcome(self, world):
        return Outcome(np.zeros((world.num_envs, len(self.agents))), np.zeros(world.num_envs, bool))


def test_a_scenario_must_say_what_it_observes():
    with pytest.raises(TypeError, match=r"Two does not say what its agents observe: override Scenario\.observation_"):
        make_vec(Two)


def test_a_scenario_may_say_sizes_alone():
    class Sized(Two):
        @property
        def observation_size(self):
            return 2

    class Different(Sized):
        observation_sizes = (2, 1)

    scenario = make_vec(Sized).scenario
    assert scenario.observation_layout == flat(2, "observation") and scenario.observation_sizes == [2, 2]
    env = make_vec(Different, num_envs=3)
    assert list(env.observation_layouts.values()) == [flat(2, "observation"), flat(1, "observation")]
    obs, _ = env.reset(seed=0)
    assert obs.shape == (3, 2, 2) and not obs[:, 1, 1].any()


@pytest.mark.parametrize(
    ("members", "message"),
    [
        (
            {"observation_layout": flat(2, "self"), "observation_size": 3},
            r"has observation_size 3, but its agents' observation_layouts have \[2, 2\] numbers",
        ),
        (
            {"observation_layouts": [flat(2, "self")] * 2, "observation_layout": flat(1, "self")},
            r"has observation_size 1, but its agents' observation_layouts have \[2, 2\] numbers",
        ),
        (
            {"observation_layouts": [flat(2, "self")] * 2, "observation_sizes": (2, 1), "observation_size": 2},
            r"observation of agent 'agent_1' adds up to 1 x 2 \(self\) = 2 numbers, but it has 1",
        ),
        (
            {"observation_layout": (Entities("self", 1, 4), Entities("target", -1, 2))},
            r"observation of agent 'agent_0' has a group \('target', -1, 2, 0\); legal are a name, a count >= 0",
        ),
        (
            {"observation_layout": (Entities("self", 1, 1), Entities("self", 1, 1))},
            r"observation of agent 'agent_0' names a group twice: \['self', 'self'\]",
        ),
        (
            {"observation_size": 2, "world_state_size": lambda self: 9},
            r"world state adds up to 2 x 4 \(agent\) = 8 numbers, but it has 9",
        ),
    ],
)
def test_layouts_of_a_scenario_are_checked(members, message):
    with pytest.raises(ValueError, match=message):
        make_vec(type("Odd", (Two,), members))


def test_a_scenario_may_add_to_the_world_state():
    class Timed(Two):
        observation_size = 2

        @property
        def state_layout(self):
            return (*super().state_layout, Entities("clock", 1, 1))

        def world_state(self, world):
            state = super().world_state(world)
            split(self.state_layout, state)["clock"][...] = 0.5
            return state

    env = make_vec(Timed, num_envs=3)
    env.reset(seed=0)
    assert env.state_size("world") == 9 and Team.of(env, with_state=True).state_size == 9
    state = env.state("world")
    np.testing.assert_array_equal(state[:, 0:2], env.world.position[:, 0].astype(np.float32))
    assert (state[:, 8] == 0.5).all()


# Faces.


@pytest.mark.parametrize(("scenario_id", "options"), TASKS)
def test_every_face_says_the_same(scenario_id, options):
    vec = make_vec(scenario_id, **options)
    layouts = dict(zip(vec.agents, vec.scenario.observation_layouts, strict=True))
    rllib = MAObsEnv({"scenario": scenario_id, **options})
    zoo = parallel_env(scenario_id, state="world", **options)
    for face in (vec, rllib, zoo, StackedEnv([zoo]), make_joint_env(MAObsEnv, {"scenario": scenario_id, **options}, 2)):
        assert face.observation_layouts == layouts
        assert face.state_layout == vec.scenario.state_layout
    team = Team.of(vec, with_state=True)
    assert team == Team.of(StackedEnv([zoo]), with_state=True)
    assert team.observation_layouts == tuple(layouts.values()) and team.state_layout == vec.state_layout
    assert team.state_size == vec.state_size("world")
    without = Team.of(vec, with_state=False)
    assert without.observation_layouts == team.observation_layouts
    assert without.state_layout is None and without.state_size == 0


@pytest.mark.parametrize(("scenario_id", "options"), TASKS)
def test_the_pettingzoo_face_describes_its_own_state(scenario_id, options):
    """By default that is all agents' observations."""
    env = parallel_env(scenario_id, **options)
    rows, _ = env.reset(seed=0)
    parts = split(env.state_layout, env.state())
    assert layout_size(env.state_layout) == env.state_space.shape[0] and list(parts) == env.possible_agents
    for agent, row in rows.items():
        np.testing.assert_array_equal(parts[agent], row[None])
    team = Team.of(StackedEnv([parallel_env(scenario_id, **options)]), with_state=True)
    assert team.state_layout == env.state_layout


@pytest.mark.parametrize(("scenario_id", "options"), TASKS)
def test_agent_ids_come_first(scenario_id, options):
    vec = make_vec(scenario_id, num_envs=2, **options)
    with_ids, n = WithAgentIds(vec), len(vec.agents)
    team, plain = Team.of(with_ids, with_state=True), Team.of(vec, with_state=True)
    for own, layout in zip(plain.observation_layouts, team.observation_layouts, strict=True):
        assert layout == (Entities("agent_id", 1, n), *own)
    assert team.state_layout == plain.state_layout
    obs, _ = with_ids.reset(seed=0)
    for i, layout in enumerate(team.observation_layouts):
        np.testing.assert_array_equal(split(layout, obs[:, i])["agent_id"], np.eye(n)[None, [i]].repeat(2, axis=0))


# Foreign environments, and what the user says of them.


class Foreign:
    """Two agents that see 5 and 3 numbers, as RLlib's environments speak."""

    possible_agents = ("a", "b")
    observation_spaces = {"a": Box(-1, 1, (5,)), "b": Box(-1, 1, (3,))}  # noqa: RUF012
    get_action_space = staticmethod(lambda agent: Box(-1, 1, (2,)))

    def get_observation_space(self, agent):
        return self.observation_spaces[agent]

    def reset(self, *, seed=None):
        return {agent: np.zeros(space.shape, np.float32) for agent, space in self.observation_spaces.items()}, {}

    def state(self):
        return np.zeros(7, np.float32)


def foreign(**attributes):
    return StackedEnv([type("Described", (Foreign,), attributes)() for _ in range(2)])


TARGETS = (("self", 1, 1), ("target", 2, 2, 2))


def test_nothing_is_known_of_a_foreign_environment():
    env = foreign()
    assert env.observation_layouts is None and env.state_layout is None
    team = Team.of(env, with_state=True)
    assert team.observation_layouts == (flat(5, "observation"), flat(3, "observation"))
    assert team.state_layout == flat(7, "state")
    with_ids = Team.of(WithAgentIds(env), with_state=True)
    assert with_ids.observation_layouts[1] == (Entities("agent_id", 1, 2), Entities("observation", 1, 3))
    assert with_ids.state_layout == flat(7, "state")


def test_a_foreign_environment_may_say_what_it_is_made_of():
    """For all agents or for some, by tuples or lists."""
    state = [["agent", 2, 3, 2], ["clock", 1, 1]]
    env = foreign(observation_layouts={"a": TARGETS, "b": None}, state_layout=state)
    team = Team.of(env, with_state=True)
    assert team.observation_layouts == ((Entities("self", 1, 1), Entities("target", 2, 2, 2)), flat(3, "observation"))
    assert team.state_layout == (Entities("agent", 2, 3, 2), Entities("clock", 1, 1, 0))
    with_ids = Team.of(WithAgentIds(env), with_state=True)
    ids = Entities("agent_id", 1, 2)
    assert with_ids.observation_layouts == tuple((ids, *layout) for layout in team.observation_layouts)
    assert with_ids.state_layout == team.state_layout


def test_the_user_says_it_instead():
    env = foreign(observation_layouts={"a": (("wrong", 1, 4),)}, state_layout=(("wrong", 1, 1),))
    for wrapped, ids in ((env, ()), (WithAgentIds(env), (Entities("agent_id", 1, 2),))):
        with pytest.raises(ValueError, match=r"\(wrong\)"):
            Team.of(wrapped, with_state=False)
        team = Team.of(wrapped, with_state=True, observation_layouts={"a": TARGETS}, state_layout=[("agent", 1, 7)])
        assert team.observation_layouts[0] == (*ids, Entities("self", 1, 1), Entities("target", 2, 2, 2))
        assert team.observation_layouts[1] == (*ids, *flat(3, "observation"))
        assert team.state_layout == (Entities("agent", 1, 7),)
    # Also instead of what an environment of this package says.
    vec = make_vec("spread-3a")
    team = Team.of(vec, with_state=False, observation_layouts={"agent_1": [("all", 9, 2)]})
    assert team.observation_layouts[1] == (Entities("all", 9, 2),)
    assert team.observation_layouts[0] == vec.observation_layouts["agent_0"]


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (
            {"observation_layouts": {"c": TARGETS}},
            r"observation layouts of \['c'\]; legal are those of .* \['a', 'b'\]",
        ),
        (
            {"observation_layouts": {"b": TARGETS}},
            r"observation of agent 'b' adds up to 1 x 1 \(self\) \+ 2 x 2 \(target\) = 5 numbers, but it has 3",
        ),
        ({"observation_layouts": {"a": [("target", -5, 1)]}}, "agent 'a' has a group .*legal are a name, a count >= 0"),
        ({"observation_layouts": {"a": [("x", 1, 2), ("x", 1, 3)]}}, r"names a group twice: \['x', 'x'\]"),
        ({"observation_layouts": {"a": [("target", 5)]}}, r"legal are \(name, count, size\) or"),
        (
            {"observation_layouts": {"a": [("x", 5, 1, 2)]}},
            r"position \(2\) of group 'x' must not be larger than its si",
        ),
        (
            {"state_layout": [("agent", 2, 3)]},
            r"layout of the state adds up to 2 x 3 \(agent\) = 6 numbers, but it has 7",
        ),
    ],
)
def test_wrong_layouts_say_what_is_legal(own, message):
    """Whoever says it."""
    with pytest.raises(ValueError, match=message):
        Team.of(foreign(), with_state=True, **own)
    with pytest.raises(ValueError, match=message):
        Team.of(foreign(**own), with_state=True)


@pytest.mark.parametrize(
    ("layouts", "message"),
    [
        ({"c": TARGETS}, r"observation layouts of \['c'\]; legal are"),
        ({"b": TARGETS}, r"1 x 2 \(agent_id\) \+ 1 x 1 \(self\) \+ 2 x 2 \(target\) = 7 numbers, but it has 5"),
        ({"a": (("agent_id", 1, 2), ("self", 1, 5))}, r"names a group twice: \['agent_id', 'agent_id', 'self'\]"),
    ],
)
def test_wrong_layouts_beside_agent_ids(layouts, message):
    with pytest.raises(ValueError, match=message):
        Team.of(WithAgentIds(foreign()), with_state=False, observation_layouts=layouts)
    with pytest.raises(ValueError, match=message):
        Team.of(WithAgentIds(foreign(observation_layouts=layouts)), with_state=False)


def test_canonical_layouts():
    assert as_layout([["target", 3, 2]], 6, "observation") == (Entities("target", 3, 2, 0),)
    assert as_layout(flat(4), None, "observation") == (Entities("vector", 1, 4, 0),)
    for bad in (("target", True, 2), (3, 3, 2), ("target", 3.0, 2), ("target", 3, 0), ("target", 1, 2, -1)):
        with pytest.raises(ValueError, match=r"The layout of the state has a group .*; legal are"):
            as_layout([bad], None, "state")
