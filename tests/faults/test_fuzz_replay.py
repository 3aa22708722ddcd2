"""Replay against a list that knows every transition: adding, sampling, saving, restoring, wrapping round, odd input."""

import pickle
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from rllib_maobs.replay import Batch, JointReplayBuffer
from tests.faults.fuzz import ARRAYS, attempt, little_memory, nasty, refused

N, O, A, S, H = 2, 3, 2, 2, (2, 2)  # noqa: E741
G = 0.5  # its powers are exact
CAPACITIES = (7, 12, 30, 61)


@dataclass
class Row:
    """One row as the model knows it: what was written, and the rows before and after it in its episode."""

    code: int
    rewards: np.ndarray | None = None  # none where it is an episode's last observation
    terminated: np.ndarray | None = None
    before: int | None = None
    after: int | None = None

    @property
    def obs(self) -> np.ndarray:
        return self.code + np.arange(N * O, dtype=np.float32).reshape(N, O) / 16

    @property
    def actions(self) -> np.ndarray:
        return -self.code - np.arange(N * A, dtype=np.float32).reshape(N, A) / 16

    @property
    def state(self) -> np.ndarray:
        return self.code + np.arange(S, dtype=np.float32) / 4

    @property
    def recurrent_state(self) -> np.ndarray:
        return -self.code + np.arange(N * 4, dtype=np.float32).reshape(N, *H) / 16


@dataclass
class Source:
    """One runner: copies in the middle of episodes, and how many steps it has sampled."""

    copies: int
    start: int = 0
    tails: dict[int, int] = field(default_factory=dict)  # the last row of each copy's episode, by copy


class ReplayMachine(RuleBasedStateMachine):
    tally: Counter[str]

    @initialize(capacity=st.sampled_from(CAPACITIES), more=st.booleans(), seed=st.integers(0, 99))
    def make(self, capacity: int, more: bool, seed: int) -> None:
        self.arguments: tuple[Any, ...] = (capacity, N, O, A, *((S, H) if more else ()))
        self.capacity, self.more = capacity, more
        self.buffer = JointReplayBuffer(*self.arguments, seed=seed)
        self.rows: list[Row] = []
        self.sources = {"a": Source(1), "b": Source(2)}
        self.rng = np.random.default_rng(seed)

    @property
    def first(self) -> int:
        """The oldest row that is there."""
        return max(0, len(self.rows) - self.capacity)

    def fragment(self, name: str, length: int) -> tuple[dict[str, Any], list[Row], dict[int, int]]:
        """What a runner sends, the rows that the model then has, and the runner's tails."""
        source, e = self.sources[name], self.sources[name].copies
        steps = [[Row(0) for _ in range(e)] for _ in range(length)]
        truncated = self.rng.random((length, e)) < 0.1
        terminated = self.rng.random((length, e, 1)) < 0.15
        terminated = terminated | (self.rng.random((length, e, N)) < 0.1)
        done, finals = terminated.all(-1) | truncated, list[Row]()
        rewards = self.rng.integers(-8, 9, (length, e, N)).astype(np.float32)
        new = [row for rows in steps for row in rows]
        tails = dict(source.tails)
        number = {id(row): len(self.rows) + i for i, row in enumerate(new)}
        for t in range(length):
            for copy in range(e):
                row, own = steps[t][copy], number[id(steps[t][copy])]
                row.rewards, row.terminated = rewards[t, copy], terminated[t, copy]
                if copy in tails:
                    row.before = tails[copy]
                tails[copy] = own
                if done[t, copy]:
                    finals.append(Row(0, before=own))
                    del tails[copy]
        new += finals
        for i, row in enumerate(new):
            row.code = len(self.rows) + i
        data: dict[str, Any] = {
            "obs": np.stack([[row.obs for row in rows] for rows in steps]),
            "actions": np.stack([[row.actions for row in rows] for rows in steps]),
            "rewards": rewards,
            "terminated": terminated,
            "truncated": truncated,
            "final_obs": np.array([row.obs for row in finals], np.float32).reshape(-1, N, O),
            "source": name,
            "start": source.start,
        }
        if self.more:
            for column, shape in (("state", (S,)), ("recurrent_state", (N, *H))):
                data[column] = np.stack([[getattr(row, column) for row in rows] for rows in steps])
                data[f"final_{column}"] = np.array([getattr(row, column) for row in finals], np.float32).reshape(
                    -1, *shape
                )
        return data, new, tails

    @rule(name=st.sampled_from(["a", "b"]), length=st.integers(1, 9), odd=st.integers(0, 3))
    def add(self, name: str, length: int, odd: int) -> None:
        data, new, tails = self.fragment(name, length)
        if odd == 1:
            for value in data.values():
                if isinstance(value, np.ndarray):
                    value.flags.writeable = False  # as from a remote runner
        elif odd == 2:
            data["rewards"] = np.asfortranarray(data["rewards"].astype(np.float64))
        elif odd == 3:
            data["obs"] = np.repeat(data["obs"], 2, axis=0)[::2]
        if len(new) > self.capacity:
            assert "do not fit" in str(refused(lambda: self.buffer.add(**data), self.tally))
            return
        attempt(lambda: self.buffer.add(**data), self.tally)
        head = len(self.rows)
        self.rows += new
        for number, row in enumerate(new, head):
            if row.before is not None:
                self.rows[row.before].after = number
        self.sources[name].tails, self.sources[name].start = tails, self.sources[name].start + length

    @rule(name=st.sampled_from(["a", "b"]), length=st.integers(1, 9))
    def lose(self, name: str, length: int) -> None:
        """A fragment never arrives, or the runner is another one: what comes next is no continuation."""
        self.sources[name].start += length
        self.sources[name].tails.clear()

    @rule(
        name=st.sampled_from(["a", "b"]),
        length=st.integers(1, 4),
        data=st.data(),
        wrong=st.one_of(nasty(), st.sampled_from(ARRAYS)),
    )
    def add_what_is_wrong(self, name: str, length: int, data: Any, wrong: Any) -> None:
        """One column is anything; the buffer is then as it was before."""
        fragment = self.fragment(name, length)[0]
        columns = [key for key, value in fragment.items() if isinstance(value, np.ndarray)]
        column = data.draw(st.sampled_from([*columns, "start", "source"]))
        spoilt = data.draw(
            st.sampled_from(
                [wrong, None]
                if column in ("start", "source")
                else [wrong, fragment[column][..., :-1], fragment[column].astype("U8"), fragment[column] + 0j, None]
            )
        )
        before = pickle.dumps(self.buffer.get_state())
        if (
            column in ("start", "source")
            and isinstance(spoilt, int | str | np.integer)
            and not isinstance(spoilt, bool)
        ):
            return
        if spoilt is None and column.startswith("final_") and not fragment[column].size:
            return  # nothing ended, and nothing is given
        sentence = refused(lambda: self.buffer.add(**{**fragment, column: spoilt}), self.tally)
        assert sentence, f"{column}={spoilt!r} was taken"
        assert pickle.dumps(self.buffer.get_state()) == before

    def usable(self, number: int, length: int) -> bool:
        """Whether a row has a successor and no observation of its window was overwritten."""
        row = self.rows[number]
        for _ in range(length - 1):
            if row.before is None:
                break
            if row.before < self.first:
                return False
            row = self.rows[row.before]
        return self.rows[number].after is not None

    @rule(n_step=st.integers(1, 6), seq_length=st.integers(0, 5))
    def sample(self, n_step: int, seq_length: int) -> None:
        held = range(self.first, len(self.rows))
        complete = [i for i in held if self.rows[i].after is not None]
        if not complete:
            how = {"gamma": G, "n_step": n_step, "seq_length": seq_length}
            assert "no complete transition" in str(refused(lambda: self.buffer.sample((4,), **how), self.tally))
            return
        batch = attempt(lambda: self.buffer.sample((5, 8), gamma=G, n_step=n_step, seq_length=seq_length), self.tally)
        usable = [i for i in complete if self.usable(i, seq_length)]
        legal = usable if len(usable) > len(held) / 4 else complete  # it has a hundred tries to find one
        for b in range(5):
            for k in range(8):
                self.check(batch, (b, k), legal, n_step, seq_length)

    def check(self, batch: Batch, at: tuple[int, int], legal: list[int], n_step: int, seq_length: int) -> None:
        number = round(float(batch.now.obs[at][0, 0]))
        assert number in legal
        row, last = self.rows[number], number
        rewards, steps = np.zeros(N, np.float32), 0
        while True:
            rewards += np.float32(G**steps) * self.rows[last].rewards
            steps += 1
            following = self.rows[last].after
            if steps == n_step or self.rows[following].after is None:
                break
            last = following
        np.testing.assert_array_equal(batch.actions[at], row.actions)
        np.testing.assert_array_equal(batch.rewards[at], rewards)
        np.testing.assert_array_equal(batch.discount[at], G**steps * ~self.rows[last].terminated)
        for moment, now in ((batch.now, number), (batch.next, following)):
            there = self.rows[now]
            np.testing.assert_array_equal(moment.obs[at], there.obs)
            if self.more:
                np.testing.assert_array_equal(moment.state[at], there.state)
                np.testing.assert_array_equal(moment.recurrent_state[at], there.recurrent_state)
            if not seq_length:
                assert moment.window is None and moment.mask is None
                continue
            window, place, counts = moment.window[at], now, 0
            for step in reversed(range(seq_length)):
                assert moment.mask[at][step] == 1.0
                np.testing.assert_array_equal(window[:, step], self.rows[place].obs)
                counts += 1
                place = self.rows[place].before
                if place is None or place < self.first:
                    break
            assert moment.mask[at].sum() == counts

    @precondition(lambda self: self.rows)
    @rule()
    def save_and_restore(self) -> None:
        state = pickle.loads(pickle.dumps(self.buffer.get_state()))
        restored = JointReplayBuffer(*self.arguments, seed=123)
        restored.set_state(state)
        if any(self.rows[i].after is not None for i in range(self.first, len(self.rows))):
            one, other = (b.sample((16,), gamma=G, n_step=3, seq_length=3) for b in (self.buffer, restored))
            assert torch.equal(one.now.window, other.now.window) and torch.equal(one.rewards, other.rewards)
        self.buffer = restored

    @precondition(lambda self: self.rows)
    @rule(data=st.data(), wrong=nasty())
    def restore_what_is_wrong(self, data: Any, wrong: Any) -> None:
        """One part of a saved state is anything, or is missing; the buffer is then as it was before."""
        before = pickle.dumps(self.buffer.get_state())
        state = pickle.loads(before)
        part = data.draw(st.sampled_from([*state]))
        if data.draw(st.booleans()):
            del state[part]
        else:
            state[part] = wrong
        sentence = refused(lambda: self.buffer.set_state(state), self.tally)
        if sentence is not None:
            assert pickle.dumps(self.buffer.get_state()) == before
        else:  # what was given is as good as what was there
            self.buffer.set_state(pickle.loads(before))

    @invariant()
    def counts_its_rows(self) -> None:
        if hasattr(self, "rows"):
            assert len(self.buffer) == min(len(self.rows), self.capacity)


def test_replay_is_what_a_list_knows_of_every_transition(long: bool, tally: Counter[str]) -> None:
    machine = type("Machine", (ReplayMachine,), {"tally": tally})
    with little_memory():
        run_state_machine_as_test(
            machine, settings=settings(max_examples=300 if long else 15, stateful_step_count=50 if long else 25)
        )


@given(data=st.data())
def test_buffers_of_any_size(data: Any, tally: Counter[str]) -> None:
    sizes = (
        "capacity",
        "num_agents",
        "observation_size",
        "action_size",
        "state_size",
        "recurrent_state",
        "seed",
        "device",
    )
    arguments: dict[str, Any] = {"capacity": 10, "num_agents": 2, "observation_size": 3, "action_size": 2}
    for name in data.draw(st.sets(st.sampled_from(sizes), min_size=1, max_size=2)):
        arguments[name] = data.draw(nasty())
    with little_memory():
        refused(lambda: JointReplayBuffer(**arguments), tally)


@given(data=st.data())
def test_samples_of_any_shape(data: Any, tally: Counter[str]) -> None:
    buffer = JointReplayBuffer(20, N, O, A, seed=0)
    zeros = np.zeros((6, 1, N))
    buffer.add(
        obs=np.zeros((6, 1, N, O)),
        actions=np.zeros((6, 1, N, A)),
        rewards=zeros,
        terminated=zeros.astype(bool),
        truncated=np.zeros((6, 1), bool),
        final_obs=np.zeros((0, N, O)),
    )
    given: dict[str, Any] = {"shape": (4,), "gamma": 0.9}
    for name in data.draw(st.sets(st.sampled_from(["shape", "gamma", "n_step", "seq_length"]), min_size=1, max_size=2)):
        given[name] = data.draw(nasty())
    with little_memory():
        refused(lambda: buffer.sample(given.pop("shape"), **given), tally)
    buffer.sample((4,), gamma=0.9)
