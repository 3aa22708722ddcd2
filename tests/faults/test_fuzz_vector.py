"""Environments of many copies against single ones: any order of resets, masks, steps, saves and illegal calls."""

import pickle
from collections import Counter
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule, run_state_machine_as_test

from rllib_maobs.envs import SCENARIOS, VectorEnv, make_vec, parallel_env
from rllib_maobs.envs.joint import StackedEnv
from rllib_maobs.envs.snapshot import snapshot
from tests.faults.fuzz import ARRAYS, attempt, nasty, refused

E = 3
OPTIONS: tuple[dict[str, Any], ...] = (
    {},
    {"action_mode": "force"},
    {"action_mode": "discrete"},
    {"physics": "solid", "state": "world"},
    {"terminate_on_success": True},
)
NO_SEEDS: tuple[Any, ...] = (
    *(
        -1,
        1.5,
        float("nan"),
        "3",
        b"3",
        True,
        2**63,
        2**63 - 1,
        10**30,
        np.float64(3),
        np.datetime64("NaT"),
        object(),
        {},
    ),
    *(
        [1, 2],
        [0.5] * E,
        [1, 2, -3],
        [[1], [2, 3]],
        [None] * E,
        [True] * E,
        [[1]] * E,
        [2**63 - 1] * E + [1],
        {1, 2, 3},
    ),
    *(np.array([1, 2, 3], object), np.zeros((E, E), int), np.array(["1"] * E), ()),
)


class VectorMachine(RuleBasedStateMachine):
    """`env` has E copies; `copies` are E environments of one copy each, and play the same."""

    tally: Counter[str]

    @initialize(
        scenario=st.sampled_from([*SCENARIOS]),
        options=st.sampled_from(OPTIONS),
        horizon=st.integers(2, 6),
        stacked=st.booleans(),
        seed=st.integers(0, 1000),
    )
    def make(self, scenario: str, options: dict[str, Any], horizon: int, stacked: bool, seed: int) -> None:
        options = {"horizon": horizon, **options}
        self.stacked, self.discrete = stacked, options.get("action_mode") == "discrete"
        self.env: Any = make_vec(scenario, num_envs=E, **options)
        if stacked:  # the same by another way: dictionaries of single copies
            self.env = StackedEnv([parallel_env(scenario, **options) for _ in range(E)])
        self.copies = [make_vec(scenario, **options) for _ in range(E)]
        self.running = np.zeros(E, bool)
        self.rng = np.random.default_rng(seed)
        self.begun = False

    def same(self, name: str, ours: Any, theirs: list[Any]) -> None:
        np.testing.assert_array_equal(np.asarray(ours), np.concatenate([np.asarray(one) for one in theirs]), name)

    def look(self) -> None:
        """Nothing else may change what there is to see, either."""
        if self.begun and not self.stacked:
            self.same("observations", self.env.observe(), [copy.observe() for copy in self.copies])
            self.same("state", self.env.state("world"), [copy.state("world") for copy in self.copies])
            self.same("heuristic", self.env.heuristic(), [copy.heuristic() for copy in self.copies])

    @rule(
        seed=st.integers(0, 2**40), how=st.sampled_from(["int", "list", "array"]), mask=st.sets(st.integers(0, E - 1))
    )
    def reset(self, seed: int, how: str, mask: set[int]) -> None:
        chosen = np.isin(np.arange(E), [*mask]) if self.begun else np.ones(E, bool)
        seeds: Any = [seed + e if how == "int" else seed + 7 * e for e in range(E)]
        given = {"int": seed, "list": seeds, "array": np.array(seeds)}[how]
        observations, _ = attempt(lambda: self.env.reset(seed=given, mask=chosen), self.tally)
        for e in np.flatnonzero(chosen):
            self.copies[e].reset(seed=seeds[e])
        self.same("observations", observations, [copy.observe() for copy in self.copies])
        self.running |= chosen
        self.begun = True

    @precondition(lambda self: self.begun)
    @rule(mask=st.sets(st.integers(0, E - 1)))
    def go_on(self, mask: set[int]) -> None:
        """The finished ones, and some in the middle of their episodes, begin the next ones of their streams."""
        chosen = np.isin(np.arange(E), [*mask]) | ~self.running
        observations, _ = attempt(lambda: self.env.reset(mask=chosen), self.tally)
        for e in np.flatnonzero(chosen):
            self.copies[e].reset()
        self.same("observations", observations, [copy.observe() for copy in self.copies])
        self.running |= chosen

    def actions(self) -> np.ndarray:
        agents, space = len(self.env.agents), self.env.action_spaces[self.env.agents[0]]
        if self.discrete:
            return self.rng.integers(0, 5, (E, agents))
        scale = self.rng.choice([0.5, 1.0, 3.0, 1e30])
        return (scale * self.rng.uniform(-1, 1, (E, agents, *space.shape))).astype(self.rng.choice([np.float32, float]))

    @precondition(lambda self: self.begun and self.running.all())
    @rule(odd=st.integers(0, 2), count=st.integers(1, 5))
    def step(self, odd: int, count: int) -> None:
        for _ in range(count):
            if self.running.all():
                self.step_once(odd)

    def step_once(self, odd: int) -> None:
        actions = self.actions()
        before = actions.copy()
        given = np.asfortranarray(actions) if odd == 1 else actions
        if odd == 2:
            given.flags.writeable = False
        observations, rewards, terminated, truncated, info = attempt(lambda: self.env.step(given), self.tally)
        np.testing.assert_array_equal(given, before)
        if self.stacked:
            before = before.astype(self.env.action_spaces[self.env.agents[0]].dtype)  # as an action of the space
        single = [copy.step(before[e : e + 1]) for e, copy in enumerate(self.copies)]
        self.same("observations", observations, [one[0] for one in single])
        self.same("rewards", rewards, [one[1] for one in single])
        self.same("terminated", terminated.all(-1) if self.stacked else terminated, [one[2] for one in single])
        self.same("truncated", truncated, [one[3] for one in single])
        finished = np.concatenate([one[2] | one[3] for one in single])
        assert bool(finished.any()) == ("episode_metrics" in info)
        for name, values in info.get("episode_metrics", {}).items():
            theirs = [one[4].get("episode_metrics", {name: [np.nan]})[name] for one in single]
            np.testing.assert_allclose(values, np.concatenate(theirs), rtol=1e-6, err_msg=name)
        self.running &= ~finished

    @precondition(lambda self: not self.stacked and not self.running.all())
    @rule()
    def step_what_has_ended(self) -> None:
        sentence = refused(lambda: self.env.step(self.actions()), self.tally, errors=(RuntimeError,))
        assert sentence and sentence.startswith("step() ")
        self.look()

    @precondition(lambda self: not self.stacked)
    @rule(data=st.data(), wrong=st.one_of(nasty(), st.sampled_from(ARRAYS)))
    def step_with_what_is_wrong(self, data: Any, wrong: Any) -> None:
        actions = self.actions()
        spoilt = actions.astype(object if self.discrete else float)
        value = data.draw(st.sampled_from([5, -1, 2**40, 0.5, None, "1", True] if self.discrete else [np.nan, np.inf]))
        spoilt[data.draw(st.integers(0, E - 1)), data.draw(st.integers(0, len(self.env.agents) - 1))] = value
        given = data.draw(
            st.sampled_from([spoilt, wrong, actions[:2], actions[:, :1], actions.astype("U9"), actions + 0j])
        )
        assert refused(lambda: self.env.step(given), self.tally, errors=(ValueError, RuntimeError))
        self.look()

    @precondition(lambda self: not self.stacked)
    @rule(data=st.data(), wrong=st.one_of(nasty(), st.sampled_from(ARRAYS)))
    def reset_with_what_is_wrong(self, data: Any, wrong: Any) -> None:
        name = data.draw(st.sampled_from(["seed", "mask"]))
        wrong = data.draw(st.sampled_from(NO_SEEDS)) if name == "seed" else wrong
        if wrong is None:
            return
        assert refused(lambda: self.env.reset(**{name: wrong}), self.tally), f"{name}={wrong!r} was taken"
        if not self.begun:
            assert refused(self.env.state, errors=(RuntimeError,)) == "state() before reset()"
        self.look()

    @rule()
    def save_and_restore(self) -> None:
        saved = snapshot(self.env)
        assert saved is not None
        self.env = pickle.loads(saved)
        self.look()


def test_copies_are_what_single_ones_are(long: bool, tally: Counter[str]) -> None:
    machine = type("Machine", (VectorMachine,), {"tally": tally})
    run_state_machine_as_test(machine, settings=settings(max_examples=300 if long else 30, stateful_step_count=40))


@given(num_envs=nasty().filter(lambda value: not isinstance(value, int) or not 10_000 < value < 2**40))
def test_any_number_of_copies(num_envs: Any, tally: Counter[str]) -> None:
    env = None

    def make() -> None:
        nonlocal env
        env = make_vec("spread-3a", num_envs=num_envs)

    if refused(make, tally) is None:
        assert isinstance(env, VectorEnv) and env.num_envs == num_envs
