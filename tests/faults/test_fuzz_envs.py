"""Environments, this package's and those of users: odd options, actions, layouts, scenarios and return values."""

import dataclasses
from collections import Counter
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from ray.rllib.env.env_context import EnvContext
from ray.rllib.env.multi_agent_env import MultiAgentEnv
from ray.tune.registry import ENV_CREATOR, _global_registry

import rllib_maobs as maobs
from rllib_maobs.envs import SCENARIOS, MAObsEnv, Outcome, ScenarioOptions, make_scenario, make_vec, parallel_env
from rllib_maobs.envs.joint import make_joint_env
from rllib_maobs.envs.team import Team
from rllib_maobs.envs.world import Bodies
from rllib_maobs.layout import Entities, as_layout, layout_size, split
from tests.faults.fuzz import attempt, little_memory, names_like, nasty, refused

maobs.register()
FIELDS = {
    scenario: [field.name for field in dataclasses.fields(cls.options_class)]
    for scenario, (cls, _) in SCENARIOS.items()
}
# Legal ones among them, often with one another not.
VALUES = st.one_of(
    st.integers(-1, 12),
    st.integers(0, 10**7),
    st.floats(0, 3),
    st.floats(0, 1e7),
    st.sampled_from([5e-324, 1e-300, 1e-30, 1e-9, 1e9, 1e30, 1e150, 1e300, 10**12]),
    st.sampled_from(
        ["mpe", "force", "discrete", "solid", "world", "observations", "individual", "sum", "flee", "learned"]
    ),
    st.booleans(),
    nasty(),
)


def by_name(scenario: str, options: dict[str, Any]) -> Any:
    return _global_registry.get(ENV_CREATOR, f"maobs/{scenario}")(EnvContext(options, worker_index=0))


FACES = {
    "vector": lambda scenario, options: make_vec(scenario, num_envs=2, **options),
    "pettingzoo": lambda scenario, options: parallel_env(scenario, **options),
    "rllib": lambda scenario, options: MAObsEnv({"scenario": scenario, **options}),
    "name": by_name,
}


def play(env: Any, face: str) -> None:
    """Some steps, whose numbers are all finite."""
    vector = env if face == "vector" else env.vector if face == "pettingzoo" else env._copy.env
    vector.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(3):
        if vector._finished.any():
            return
        space, shape = vector.action_spaces[vector.agents[0]], (vector.num_envs, len(vector.agents))
        discrete = isinstance(space, gym.spaces.Discrete)
        actions = rng.integers(0, 5, shape) if discrete else rng.uniform(-1, 1, (*shape, *space.shape))
        observations, rewards, *_ = vector.step(actions)
        assert np.isfinite(observations).all() and np.isfinite(rewards).all()
        assert np.isfinite(vector.state("world")).all()
        assert np.isfinite(vector.heuristic()).all()


@given(data=st.data(), scenario=st.sampled_from([*SCENARIOS]), face=st.sampled_from([*FACES]))
def test_options_of_every_task(data: Any, scenario: str, face: str, tally: Counter[str]) -> None:
    """Each works in every face, or is refused before the first step."""
    names = st.lists(names_like(FIELDS[scenario]), min_size=1, max_size=3, unique=True)
    options = {name: data.draw(VALUES) for name in data.draw(names)}
    options.pop("self", None)  # Python's own
    with little_memory():
        refused(lambda: play(FACES[face](scenario, options), face), tally)


@given(scenario=st.one_of(names_like([*SCENARIOS]), nasty()), config=st.one_of(nasty(), st.just({})))
def test_scenarios_by_any_name(scenario: Any, config: Any, tally: Counter[str]) -> None:
    refused(lambda: make_scenario(scenario), tally)
    refused(lambda: parallel_env(scenario, render_mode=config), tally, errors=(ValueError, ImportError))
    refused(lambda: MAObsEnv({"scenario": scenario}), tally)
    refused(lambda: MAObsEnv(config), tally)


@given(
    data=st.data(), face=st.sampled_from(["pettingzoo", "rllib"]), mode=st.sampled_from(["mpe", "force", "discrete"])
)
def test_actions_by_agent(data: Any, face: str, mode: str, tally: Counter[str]) -> None:
    """Odd ones are refused, and the step that then comes is what it would have been without them."""
    env, other = (FACES[face]("spread-3a", {"action_mode": mode, "horizon": 2}) for _ in range(2))
    for one in (env, other):
        one.reset(seed=3)
    space = (env.get_action_space if face == "rllib" else env.action_space)("agent_0")
    legal = {agent: space.sample() for agent in env.possible_agents}
    if data.draw(st.booleans()):
        agent = data.draw(st.sampled_from(["agent_0", "agent_2", "agent_3", None, 0, ("agent_0",)]))
        odd: Any = {**legal, agent: data.draw(nasty())}
    else:
        odd = data.draw(nasty())
    if refused(lambda: env.step(odd), tally) is not None:
        for name, value in env.step(legal)[0].items():
            np.testing.assert_array_equal(value, other.step(legal)[0][name] if name == "agent_0" else value)


@given(
    groups=st.one_of(
        nasty(),
        st.lists(
            st.one_of(
                nasty(), st.tuples(st.text(max_size=3), st.integers(-1, 9), st.integers(-1, 9), st.integers(-1, 9))
            ),
            max_size=3,
        ),
    ),
    size=st.one_of(st.none(), st.integers(0, 40)),
)
def test_layouts(groups: Any, size: Any, tally: Counter[str]) -> None:
    layout = None

    def make() -> None:
        nonlocal layout
        layout = as_layout(groups, size, "observation of agent 'a'")

    if refused(make, tally) is None and layout_size(layout) < 1000:
        parts = split(layout, np.arange(layout_size(layout)))
        assert [part.shape for part in parts.values()] == [(group.count, group.size) for group in layout]


# Scenarios of users.


@dataclass(frozen=True)
class OddOptions(ScenarioOptions):
    part: str = ""
    value: Any = None


class Odd(maobs.Scenario[OddOptions]):
    """A scenario of two agents that is right but for one part, which is anything."""

    options_class = OddOptions
    metrics = {"distance": "mean"}  # noqa: RUF012

    def odd(self, part: str, usual: Any) -> Any:
        return self.options.value if self.options.part == part else usual

    def bodies(self) -> Any:
        radius, count, accel = (
            self.odd(part, usual) for part, usual in (("radius", 0.1), ("count", 2), ("accel", 5.0))
        )
        return self.odd("bodies", [Bodies(self.odd("name", "agent"), count, radius=radius, movable=True, accel=accel)])

    def place(self, rngs: Any) -> Any:
        return self.odd("place", np.stack([rng.uniform(-1, 1, (2, 2)) for rng in rngs]))

    @property
    def observation_layout(self) -> Any:
        return self.odd("layout", (Entities("self", 1, 4), Entities("agent", 1, 2, 2)))

    def observe(self, world: Any, out: Any) -> None:
        if self.options.part == "layout":
            return
        parts = split(self.observation_layout, out)
        parts["self"][..., 0, 0:2] = world.velocity
        parts["self"][..., 0, 2:4] = world.position
        parts["agent"][...] = self.odd("observe", world.offset[:, ~np.eye(2, dtype=bool)].reshape(-1, 2, 1, 2))

    def outcome(self, world: Any) -> Any:
        distance = np.linalg.norm(world.position, axis=-1)
        return self.odd(
            "outcome",
            Outcome(
                self.odd("rewards", -distance),
                self.odd("success", (distance < 0.3).all(axis=1)),
                self.odd("metrics", {"distance": self.odd("metric", distance.mean(axis=1))}),
            ),
        )

    def metric_reductions(self) -> Any:
        return self.odd("reductions", self.metrics)


ODD_PARTS = ("radius count accel bodies name place layout rewards success metrics metric outcome reductions").split()


@given(part=st.sampled_from(ODD_PARTS), value=nasty())
def test_scenarios_of_users(part: str, value: Any, tally: Counter[str]) -> None:
    def play_it() -> None:
        env = make_vec(Odd, num_envs=2, part=part, value=value, horizon=2)
        env.reset(seed=0)
        for _ in range(2):
            *arrays, info = env.step(np.zeros((2, len(env.agents), 5)))
            assert [array.dtype for array in arrays] == [np.float32, np.float32, bool, bool]
        assert {"success", *env.scenario.metric_reductions()} <= {*info["episode_metrics"]}

    with little_memory():
        refused(play_it, tally)


# Environments of users.


class Foreign(MultiAgentEnv):
    """Two agents; right but for one part of what it says or returns, which is anything."""

    def __init__(self, config: Any) -> None:
        super().__init__()
        self.part, self.value, self.t = config.get("part"), config.get("value"), 0
        self.agents = self.possible_agents = self.odd("agents", ["a", "b"])
        box, act = gym.spaces.Box(-1, 1, (3,), np.float32), self.odd("action space", gym.spaces.Box(-1, 1, (2,)))
        self.observation_spaces = self.odd("spaces", {"a": box, "b": self.odd("space", box)})
        self.action_spaces = {"a": act, "b": act}
        if self.part == "layouts":
            self.observation_layouts = self.value
        if self.part == "state layout":
            self.state_layout = self.value

    def odd(self, part: str, usual: Any) -> Any:
        return self.value if self.part == part else usual

    def state(self) -> Any:
        return self.odd("state", np.zeros(4, np.float32))

    def observations(self) -> Any:
        obs = np.full(3, self.t, np.float32)
        return self.odd("observations", {"a": obs, "b": self.odd("observation", obs)})

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.t = 0
        return self.odd("reset", (self.observations(), self.odd("reset infos", {})))

    def step(self, action: Any) -> Any:
        self.t += 1
        over = self.t == 2
        return self.odd(
            "step",
            (
                self.observations(),
                self.odd("rewards", {"a": 0.0, "b": self.odd("reward", 1.0)}),
                self.odd("terminateds", {"__all__": self.odd("terminated", over)}),
                self.odd("truncateds", {"__all__": False}),
                self.odd(
                    "infos",
                    {"a": self.odd("info", {"episode_metrics": self.odd("metrics", {"x": self.odd("metric", 1.0)})})},
                ),
            ),
        )


FOREIGN_PARTS = (
    "agents action_space spaces space layouts state_layout state observations observation reset reset_infos step "
    "rewards reward terminateds terminated truncateds infos info metrics metric"
).split()
SPACES = st.sampled_from(
    [
        gym.spaces.Box(0, 1, (2,), np.bool_),
        gym.spaces.Box(-1, 1, (2, 2)),
        gym.spaces.Box(-np.inf, 1, (2,)),
        gym.spaces.Box(0, 255, (2,), np.uint8),
        gym.spaces.Discrete(3),
        gym.spaces.MultiDiscrete([2, 3]),
        gym.spaces.MultiBinary(3),
        gym.spaces.Dict({"x": gym.spaces.Discrete(2)}),
        gym.spaces.Text(3),
    ]
)


@given(data=st.data(), part=st.sampled_from(FOREIGN_PARTS), copies=st.integers(1, 2))
def test_environments_of_users(data: Any, part: str, copies: int, tally: Counter[str]) -> None:
    value = data.draw(st.one_of(nasty(), SPACES) if "space" in part else nasty())

    def play_it() -> None:
        context = EnvContext({"part": part.replace("_", " "), "value": value}, worker_index=0)
        env = make_joint_env(Foreign, context, copies)
        try:
            team = Team.of(env, with_state=True)
            env.reset(seed=0)
            for _ in range(2):
                shape = (copies, len(team.agents))
                zeros = np.zeros(shape, int) if team.discrete else np.zeros((*shape, team.action_size), np.float32)
                observations, rewards, *_ = env.step(zeros)
                assert observations.dtype == np.float32 and rewards.dtype == np.float32
        finally:
            env.close()

    with little_memory():
        refused(play_it, tally)


def test_what_the_fuzzers_play_is_right_by_itself() -> None:
    attempt(lambda: make_vec(Odd).reset(seed=0))
    for name in ("agents", "nothing"):
        env = make_joint_env(Foreign, {"part": name, "value": ["a", "b"]}, 2)
        env.reset(seed=0)
        assert env.step(np.zeros((2, 2, 2)))[1].tolist() == [[0, 1]] * 2
