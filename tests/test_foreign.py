"""Environments of others: what they return is checked, who terminated is kept apart, actions lie in their spaces."""

import logging
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils import EzPickle
from mpe2 import simple_spread_v3
from pettingzoo import ParallelEnv
from ray import tune
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.env.env_context import EnvContext
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv

from rllib_maobs.envs.joint import StackedEnv, make_joint_env
from rllib_maobs.envs.snapshot import snapshot
from rllib_maobs.envs.team import Team, finished, shares_reward
from rllib_maobs.envs.wrappers import WithAgentIds
from rllib_maobs.modules.exploration import EpsilonGaussian
from rllib_maobs.replay import JointReplayBuffer
from rllib_maobs.runner import JointEnvRunner
from rllib_maobs.runner.acting import Acting
from tests.conftest import small_config

Box, Discrete = gym.spaces.Box, gym.spaces.Discrete


class Pair(ParallelEnv):
    """Agents a and b observe the step; `change` may put something else in the place of what a step returns."""

    metadata: dict[str, Any] = {"name": "pair"}  # noqa: RUF012

    def __init__(self, change: Callable[..., Any] | None = None, horizon: int = 5, space: Any = None) -> None:
        self.possible_agents = self.agents = ["a", "b"]
        self.change, self.horizon, self.t = change, horizon, 0
        self.space = space or Box(-1.0, 1.0, (2,), np.float32)
        self.taken: list[dict[str, Any]] = []

    def observation_space(self, agent: str) -> Any:
        return Box(-np.inf, np.inf, (3,), np.float32)

    def action_space(self, agent: str) -> Any:
        return self.space

    def state(self) -> np.ndarray:
        return np.full(2, np.nan if self.t == 3 else self.t, np.float32)

    def seen(self) -> dict[str, Any]:
        return {agent: np.full(3, self.t, np.float32) for agent in self.possible_agents}

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.t, self.agents = 0, list(self.possible_agents)
        return self.seen(), {}

    def step(self, actions: dict[str, Any]) -> Any:
        self.t += 1
        self.taken.append(actions)
        end = self.t >= self.horizon
        who = self.possible_agents
        result = self.seen(), dict.fromkeys(who, 1.0), dict.fromkeys(who, False), dict.fromkeys(who, end)
        result = (*result, {agent: {} for agent in who})
        return result if self.change is None else self.change(self, *result)


SHARED = Pair()


def shared_pair(context: Any) -> Pair:
    return SHARED


def played(env: Any, steps: int = 5) -> list[Any]:
    """What a stacked environment returns step by step."""
    env.reset(seed=0)
    return [env.step(np.zeros((env.num_envs, 2, 2), np.float32)) for _ in range(steps)]


# What an environment returns.


class OldReset(Pair):
    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        return super().reset()[0]


class NoSeed(Pair):
    def reset(self) -> Any:  # type: ignore[override]
        return super().reset()


class NoState(Pair):
    def state(self) -> Any:
        return ParallelEnv.state(self)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (OldReset, r"OldReset: reset\(\) returns a dict in environment copy 0 at step 0 .*; legal: two dicts by agent"),
        (NoSeed, r"NoSeed.reset\(\) takes no seed \(.*'seed'\); legal: reset\(seed=None\)"),
        (
            lambda: Pair(lambda env, o, r, d, t, i: (o, r, d, i)),
            r"step\(\) returns 4 values \(dict, dict, dict, dict\) in",
        ),
        (lambda: Pair(lambda env, o, *rest: ([*o.values()], *rest)), r"step\(\) returns 5 values \(list, dict, "),
        (
            lambda: Pair(lambda env, o, r, *rest: (o, r | {"b": np.ones(1)}, *rest)),
            r"Pair: the reward of agent 'b' is array\(\[1\.\]\) in environment copy 0 at step 1 .*; legal: one number",
        ),
        (lambda: Pair(lambda env, o, r, *rest: (o, {"a": 1.0}, *rest)), r"the reward of agent 'b' is 'missing'"),
        (lambda: Pair(lambda env, o, r, *rest: (o, r | {"a": None}, *rest)), r"the reward of agent 'a' is None"),
        # What float() would take for one.
        (lambda: Pair(lambda env, o, r, *rest: (o, r | {"a": "3"}, *rest)), r"the reward of agent 'a' is '3' in env"),
        (lambda: Pair(lambda env, o, r, *rest: (o, r | {"b": True}, *rest)), r"the reward of agent 'b' is True in"),
        (lambda: Pair(lambda env, o, r, *rest: (o, r | {"b": np.bool_(0)}, *rest)), r"reward of agent 'b' is .*False"),
        (
            lambda: Pair(lambda env, o, r, *rest: (o, r | {"b": [1, [2]]}, *rest)),
            r"reward of agent 'b' is \[1, \[2\]\]",
        ),
        (
            lambda: Pair(lambda env, o, r, *rest: (o, r | {"c": 1.0}, *rest)),
            r"there are rewards of \['c'\] in .*; legal",
        ),
        (
            lambda: Pair(lambda env, o, *rest: (o | {"a": np.array(["1", "2", "3"])}, *rest)),
            r"observation of agent 'a' is no array of numbers \(values of dtype <U1\)",
        ),
        (
            lambda: Pair(lambda env, o, *rest: (o | {"a": torch.zeros(3, requires_grad=True)}, *rest)),
            r"observation of agent 'a' is no array of numbers \(Can't call numpy",
        ),
        (
            lambda: Pair(lambda env, *rest: (*rest[:-1], {"a": [1], "b": {}})),
            r"Pair: the info of 'a' is \[1\] in environment copy 0 at step 1 .*; legal: a dict, or None",
        ),
        (
            lambda: Pair(lambda env, *rest: (*rest[:-1], {"b": {"episode_metrics": {"x": [1, 2]}}})),
            r"episode_metrics in the info of 'b' are .*x.* at step 5 .*; legal: a dict of single numbers by name",
        ),
        (
            lambda: Pair(lambda env, *rest: (*rest[:-1], {"a": {"episode_metrics": 3}})),
            r"episode_metrics in the info of 'a' are 3 in",
        ),
        (
            lambda: Pair(lambda env, o, *rest: (o | {"b": np.zeros(env.t)}, *rest)),
            r"observation of agent 'b' has 1 numbers in environment copy 0 at step 1 .*; legal: what is in its space B",
        ),
        (lambda: Pair(lambda env, o, *rest: (o | {"a": "far"}, *rest)), r"observation of agent 'a' is no array of num"),
        (
            lambda: Pair(lambda env, o, *rest: ({"a": o["a"]}, *rest)),
            r"Pair: the team changed in environment copy 0 at step 1: missing agents \['b'\]",
        ),
        (
            lambda: Pair(lambda env, o, r, d, *rest: (o, r, d | {"a": env.t == 2}, *rest)),
            r"Pair: the team changed: \['a'\] ended, others go on in environment copy 0 at step 2 .*same step",
        ),
    ],
)
def test_what_is_not_legal_is_named(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        played(StackedEnv([make(), make()]))


def test_states_are_checked() -> None:
    env = StackedEnv([Pair(), Pair()])
    played(env, 2)
    assert env.state().tolist() == [[2.0, 2.0]] * 2
    played(env, 3)
    with pytest.raises(ValueError, match=r"Pair: number 0 of the state is nan in environment copy 0 at step 3 of its"):
        env.state()
    with pytest.raises(ValueError, match=r'NoState has no state\(\).*NotImplementedError.*critic_state="observations"'):
        StackedEnv([NoState()]).state()


def test_copies_have_the_same_spaces() -> None:
    with pytest.raises(ValueError, match=r"The spaces of Pair are .* in copy 0, but .* in copy 1: legal are the same"):
        StackedEnv([Pair(), Pair(space=Box(-2.0, 2.0, (2,), np.float32))])


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"a": "False", "b": False}, "the termination or truncation of 'a' is 'False' in environment copy 0 at step 1"),
        ({"a": 7, "b": False}, "the termination or truncation of 'a' is 7"),
        ({"a": False, "b": False, "__ALL__": False}, "the termination or truncation of '__ALL__' is False"),
    ],
)
def test_flags_are_flags_of_agents(flags: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        played(StackedEnv([Pair(lambda env, obs, reward, terminated, *rest: (obs, reward, flags, *rest))]), 1)


def test_any_agent_may_tell_the_metrics() -> None:
    infos = {"b": {"episode_metrics": {"x": np.float64(2.0)}}, "a": {"episode_metrics": {"y": 1}}}
    *_, last = played(StackedEnv([Pair(), Pair(lambda env, *rest: (*rest[:-1], infos))]))
    metrics = {name: values.tolist() for name, values in last[4]["episode_metrics"].items()}
    np.testing.assert_equal(metrics, {"x": [np.nan, 2.0], "y": [np.nan, 1.0]})


def test_rewards_are_numbers_of_any_kind() -> None:
    given = iter([1, np.float32(2.0), np.array(3.0), torch.tensor(4.0), np.int64(5)])

    def change(env: Pair, o: Any, r: Any, *rest: Any) -> Any:
        return o, r | {"b": next(given)}, *rest

    assert [result[1][0, 1] for result in played(StackedEnv([Pair(change)]))] == [1.0, 2.0, 3.0, 4.0, 5.0]


def test_infos_of_none_say_nothing() -> None:
    for infos in ({"a": None, "b": None}, None, {"a": {"episode_metrics": None}, "b": None}):
        *_, last = played(StackedEnv([Pair(lambda env, *rest, infos=infos: (*rest[:-1], infos))]))
        assert last[3].all() and not last[4].get("episode_metrics")


def test_an_environment_of_turns_is_told_its_parallel_form() -> None:
    with pytest.raises(ValueError, match=r"is an AEC environment, .* use its parallel_env\(\)"):
        make_joint_env(lambda context: simple_spread_v3.env(continuous_actions=True), {}, 1)


def test_copies_that_are_one_object_are_refused(ray_session: None) -> None:
    shared = Pair()
    for wrap in (lambda env: env, ParallelPettingZooEnv):
        envs = iter([Pair(), shared, Pair(), shared])
        with pytest.raises(ValueError, match=r"copies 1 and 3 of Pair are one object: .* must return a new one"):
            make_joint_env(lambda context, envs=envs, wrap=wrap: wrap(next(envs)), {}, 4)
    # With one copy each, training and evaluation would step the same object.
    tune.register_env("pair", shared_pair)
    config = small_config("maddpg").environment("pair", env_config={}).env_runners(num_envs_per_env_runner=1)
    config.evaluation(evaluation_interval=1)
    with pytest.raises(ValueError, match=r"copy 0 of Pair and one of another runner .* are one object"):
        config.build_algo()


def test_every_copy_has_its_own_config() -> None:
    nested = {"limits": [1, 2]}
    seen: list[Any] = []

    def creator(context: Any) -> Any:
        seen.append((context.pop("horizon"), context["nested"]["limits"].pop(), context.vector_index))
        assert (context.worker_index, context.num_workers) == (3, 4)
        return Pair()

    context = EnvContext({"horizon": 7, "nested": nested}, worker_index=3, num_workers=4)
    make_joint_env(creator, context, 3)
    assert seen == [(7, 2, 0), (7, 2, 1), (7, 2, 2)]
    assert context["horizon"] == 7 and nested == {"limits": [1, 2]}


@pytest.mark.parametrize(
    "space", [Box(0, 1, (2,), np.bool_), Box(0.0, 1.0, (2, 2)), Box(0.0, 1.0, (0,)), gym.spaces.MultiBinary(2)]
)
def test_actions_that_are_no_vectors_of_numbers_are_refused(space: Any) -> None:
    with pytest.raises(
        ValueError, match=r"The action space of agent 'a' is .*; legal are Box of one dimension, of int"
    ):
        Team.of(StackedEnv([Pair(space=space)]), with_state=False)


@pytest.mark.parametrize("space", [Discrete(3), Box(0.0, 1.0, (2, 2)), gym.spaces.Dict({"x": Discrete(2)})])
def test_observations_that_are_no_vectors_are_refused(space: Any) -> None:
    env = Pair()
    env.observation_space = lambda agent: space  # type: ignore[method-assign]
    for stacked in (StackedEnv([env]), WithAgentIds(StackedEnv([env]))):
        with pytest.raises(ValueError, match=r"observation space of agent 'a' is (Discrete|Box|Dict).*flatten it"):
            Team.of(stacked, with_state=False)


# Who terminated.


def last_of(change: Callable[..., Any], wrapped: bool = False) -> tuple[list[bool], bool]:
    """Which agents terminated in the last step, and whether others were truncated."""
    env = StackedEnv([ParallelPettingZooEnv(Pair(change)) if wrapped else Pair(change)])
    results = played(env)
    assert not any(finished(result[2], result[3]).any() for result in results[:-1])
    terminated = dict(zip(env.agents, results[-1][2][0].tolist(), strict=True))  # RLlib's wrapper lists a set
    return [terminated["a"], terminated["b"]], bool(results[-1][3][0])


def flags(**of: tuple[bool, bool]) -> Callable[..., Any]:
    """Flags (terminated, truncated) at the last step, by agent and `all`."""

    def change(env: Pair, obs: Any, reward: Any, terminated: Any, truncated: Any, infos: Any) -> Any:
        if env.t == env.horizon:
            given = {"__all__" if name == "all" else name: pair for name, pair in of.items()}
            terminated, truncated = ({name: pair[i] for name, pair in given.items()} for i in (0, 1))
        return obs, reward, terminated, truncated, infos

    return change


def test_each_agent_has_its_own_end() -> None:
    some, none = (True, False), (False, True)
    for wrapped in (False, True):
        assert last_of(flags(a=some, b=none), wrapped) == ([True, False], True)
        assert last_of(flags(a=some, b=some), wrapped) == ([True, True], False)
        assert last_of(flags(a=none, b=none), wrapped) == ([False, False], True)
    assert last_of(flags(all=some)) == ([True, True], False)
    assert last_of(flags(all=none)) == ([False, False], True)
    # An agent's own flag counts before that of all.
    assert last_of(flags(b=none, all=some)) == ([True, False], True)
    assert last_of(flags(a=some, all=none)) == ([True, False], True)


def test_an_emptied_list_of_agents_ends_the_episode() -> None:
    def change(env: Pair, obs: Any, reward: Any, terminated: Any, truncated: Any, infos: Any) -> Any:
        if env.t == env.horizon:
            env.agents = []
        return obs, reward, {"a": env.t == env.horizon}, {}, infos

    assert last_of(change) == ([True, False], True)


def test_only_who_was_truncated_bootstraps(ray_session: None) -> None:
    """From the flags of an environment to the discounts of a minibatch."""
    tune.register_env("pair", lambda context: Pair(flags(a=(True, False), b=(False, True))))
    config = small_config("maddpg").environment("pair", env_config={})
    config.validate()
    runner = JointEnvRunner(config=config, worker_index=0, num_workers=0)
    (s,) = runner.sample(num_timesteps=20)
    assert s.terminated.shape == (10, 2, 2) and s.terminated.any(1).nonzero()[0].tolist() == [4, 9]
    buffer = JointReplayBuffer(100, 2, 3, 2, seed=0)
    buffer.add(**vars(s))
    batch = buffer.sample((200,), gamma=0.9)
    last = batch.next.obs[:, 0, 0] == 5.0
    want = torch.where(last[:, None], torch.tensor([0.0, 0.9]), torch.tensor([0.9, 0.9]))
    assert torch.equal(batch.discount, want) and 0 < last.sum() < 200
    assert len(runner.sample(num_episodes=4)[0].truncated) == 10


# Actions.


def random_box(rng: np.random.Generator) -> Box:
    dtype = rng.choice(["float16", "float32", "float64", "int8", "uint8", "int32", "int64"])
    size = int(rng.integers(1, 4))
    if np.issubdtype(dtype, np.integer):
        info = np.iinfo(dtype)
        top = min(2**53, info.max) if rng.random() < 0.2 else min(1000, info.max)
        bounds = rng.integers(max(-top, info.min), top, (2, size), endpoint=True)
    else:
        scale = 10.0 ** rng.uniform(-3, 4 if dtype == "float16" else 30)
        bounds = rng.normal(size=(2, size)) * scale + rng.choice([0.0, scale * 1e3 if dtype == "float64" else 0.0])
    bounds = np.sort(bounds.astype(dtype), axis=0)
    return Box(bounds[0], bounds[1], dtype=np.dtype(dtype).type)


def test_actions_lie_in_the_declared_space() -> None:
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    explore = EpsilonGaussian(epsilon=0.3, noise=2.0, final=0.3)
    ends = 0
    for case in range(1000):
        space = Discrete(int(rng.integers(1, 9)), start=int(rng.integers(-5, 6))) if case % 10 == 0 else random_box(rng)
        env = StackedEnv([Pair(space=space) for _ in range(2)])
        env.reset(seed=0)
        acting = Acting.__new__(Acting)  # the part that knows spaces
        acting._team = Team.of(env, with_state=False)
        acting._scale(acting._team)
        if isinstance(space, Discrete):
            chosen = explore.discrete(torch.randn(2, 2, int(space.n), generator=generator), 0, generator, sample=False)
            actions = torch.nn.functional.one_hot(chosen, int(space.n)).numpy()
        else:
            actions = explore(torch.randn(2, 2, *space.shape, generator=generator), 0, generator).clamp(-1, 1).numpy()
            actions[0, 0], actions[0, 1] = 1.0, -1.0
        env.step(acting.to_env(actions))
        taken = [one.taken[-1] for one in env.envs]
        assert all(space.contains(action) for joint in taken for action in joint.values()), (space, taken)
        if isinstance(space, Box):
            np.testing.assert_allclose(taken[0]["a"].astype(float), space.high.astype(float), rtol=1e-3, atol=1e-2)
            assert (taken[0]["b"] == space.low).all()
            ends += 1
        assert shares_reward(env, steps=2) and all(space.contains(a) for a in env.envs[0].taken[-1].values())
    assert ends == 900


def test_integers_get_equal_shares() -> None:
    env = StackedEnv([Pair(space=Box(-1, 2, (1,), np.int64))])
    acting = Acting.__new__(Acting)
    acting._team = Team.of(env, with_state=False)
    acting._scale(acting._team)
    even = np.linspace(-1.0, 1.0, 4001, dtype=np.float32)[:-1].reshape(-1, 1, 1).repeat(2, 1)
    values, counts = np.unique(acting.to_env(even)[:, 0], return_counts=True)
    assert values.tolist() == [-1, 0, 1, 2] and np.abs(counts - 1000).max() <= 1


def test_exact_bounds_are_not_clipped_again(ray_session: None) -> None:
    """The package's own environments pay nothing."""
    config = small_config("maddpg")
    config.validate()
    assert JointEnvRunner(config=config, worker_index=0, num_workers=0).acting._limits is None


@pytest.mark.parametrize(
    "space",
    [
        Box(-np.inf, 1.0, (2,), np.float32),
        Box(0.0, np.inf, (2,), np.float64),
        Box(-np.inf, np.inf, (2,), np.float32),
        Box(-np.finfo(np.float32).max, np.finfo(np.float32).max, (2,), np.float32),
        Box(np.iinfo(np.int64).min, np.iinfo(np.int64).max, (2,), np.int64),
    ],
)
def test_bounds_that_nothing_can_be_scaled_to_are_refused(space: Box) -> None:
    with pytest.raises(ValueError, match=r"action space of agent 'a' is unbounded: Box.*needs finite bounds"):
        Team.of(StackedEnv([Pair(space=space)]), with_state=False)


# Going on from a checkpoint.


class Ez(Pair, EzPickle):
    def __init__(self) -> None:
        EzPickle.__init__(self)
        Pair.__init__(self, horizon=20)
        self.rng = np.random.default_rng(0)


class Forgets(Pair):
    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "t": 0}


class Locked(Pair):
    def __getstate__(self) -> Any:
        raise TypeError("cannot pickle a device")


def test_only_what_comes_back_as_it_was_is_saved() -> None:
    for make, comes_back in ((Pair, True), (Ez, True), (Forgets, False), (Locked, False)):
        env = StackedEnv([make(), make()])
        played(env, 2)
        saved = snapshot(env)
        assert (saved is not None) == comes_back, make
        if saved is not None:
            again = pickle.loads(saved)
            for _ in range(2):
                one, other = (e.step(np.zeros((2, 2, 2), np.float32)) for e in (env, again))
                np.testing.assert_array_equal(one[0], other[0])
    spread = StackedEnv([simple_spread_v3.parallel_env(continuous_actions=True)])
    spread.reset(seed=0)
    spread.step(np.zeros((1, 3, 5), np.float32))
    assert snapshot(spread) is None


@pytest.mark.parametrize(("make", "exact"), [(Ez, True), (lambda: Forgets(horizon=20), False)])
def test_what_cannot_be_continued_starts_a_new_episode(
    ray_session: None, tmp_path: Any, caplog: Any, monkeypatch: Any, make: Any, exact: bool
) -> None:
    monkeypatch.setattr("ray.util.debug._logged", set())
    tune.register_env("pair", lambda context: make())
    config = small_config("maddpg").environment("pair", env_config={}).reporting(min_sample_timesteps_per_iteration=14)
    algo = config.build_algo()
    algo.train()  # 7 steps of each copy
    path = algo.save_to_path(tmp_path / "checkpoint")
    with caplog.at_level(logging.WARNING, "rllib_maobs"):
        restored = [Algorithm.from_checkpoint(path) for _ in range(2)]
    complaints = [record.getMessage() for record in caplog.records if "starts new episodes" in record.getMessage()]
    assert len(complaints) == (0 if exact else 1)
    runner = restored[0].env_runner
    obs = runner.sample(num_timesteps=6)[0].obs[:, 0, 0, 0].tolist()
    assert obs == ([7.0, 8.0, 9.0] if exact else [0.0, 1.0, 2.0])
    assert runner._episodes.lengths.tolist() == ([10, 10] if exact else [3, 3])
    # Random numbers go on with an exact copy; otherwise they are new ones, too, not those that the run began with.
    config.validate()
    begun = JointEnvRunner(config=config, worker_index=0, num_workers=0)
    runners = [algo.env_runner, restored[1].env_runner, begun]
    going_on, again, at_first = (one.sample(num_timesteps=2, random_actions=True)[0].actions for one in runners)
    assert (going_on == again).all() == exact and (again != at_first).any()
    for one in (algo, *restored):
        one.stop()


class Twice(Pair):
    def __init__(self) -> None:
        super().__init__()
        self.possible_agents = ["a", "a"]


class Growing(Pair):
    def state(self) -> np.ndarray:
        return np.zeros(2 + self.t, np.float32)


class Wordy(Pair):
    def state(self) -> Any:
        return {"a": 1.0}


class Still(Pair):
    state = np.zeros(2)  # type: ignore[assignment]


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        (
            {"observation_space": None},
            r"has no observation_space for each of \['a', 'b'\] \(TypeError: .*; legal are a",
        ),
        ({"action_space": lambda self, agent: None}, r"action_space of agent 'a' is None; legal is a space of gymn"),
        (
            {"get_action_space": lambda self, agent: {"a": Discrete(2)}[agent]},
            r"no action_space for each .*KeyError: 'b",
        ),
        ({"possible_agents": property(lambda self: 5, lambda self, _: None)}, "lists no `possible_agents`"),
        ({"observation_layouts": 3}, "observation_layouts must be a dict by agent, not 3"),
        (
            {"observation_layouts": {"a": 3}},
            "The layout of the observation of agent 'a' is 3; legal is a list of groups",
        ),
    ],
)
def test_what_an_environment_says_of_itself_is_checked(attributes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Team.of(StackedEnv([type("Odd", (Pair,), attributes)()]), with_state=False)


def test_teams_and_states_that_are_none_are_named() -> None:
    with pytest.raises(ValueError, match=r"The agents of Twice are \['a', 'a'\]; legal are different names"):
        StackedEnv([Twice()])
    growing = StackedEnv([Growing()])
    growing.reset(seed=0)
    growing.state()
    growing.step(np.zeros((1, 2, 2), np.float32))
    with pytest.raises(ValueError, match=r"the state has 3 numbers in environment copy 0 at step 1 .*; legal: 2"):
        growing.state()
    for cls, message in ((Wordy, "the state is a dict"), (Still, r"state\(\) cannot be called")):
        env = StackedEnv([cls()])
        env.reset(seed=0)
        with pytest.raises(ValueError, match=message):
            env.state()
