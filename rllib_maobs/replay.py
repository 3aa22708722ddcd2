"""Joint replay: a ring of joint steps that stores every observation once and keeps agents aligned."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.utils.annotations import override
from ray.rllib.utils.checkpoints import Checkpointable
from torch import Tensor

from rllib_maobs.memory import gigabytes, memory_of
from rllib_maobs.options import Range, check_value

_NONE = -1  # "no such row" in the links between rows


class Moment(NamedTuple):
    """What there was at one time, in every row of a minibatch.

    Attributes:
        obs: `(B, N, O)`.
        state: `(B, S)`; None where none is stored.
        window: The last T observations up to `obs`, oldest first, `(B, N, T, O)`; None without windows.
        mask: 1.0 where one of them counts, 0.0 before the episode's first observation, `(B, T)`.
        recurrent_state: The actors' states from which these windows started when they acted, `(B, N, *H)`: constants,
            whatever weights made them (Kapturowski et al. 2019's stored state). None if they are not stored.
        name: "now" or "next".
    """

    obs: Tensor
    state: Tensor | None = None
    window: Tensor | None = None
    mask: Tensor | None = None
    recurrent_state: Tensor | None = None
    name: str = "now"


class Batch(NamedTuple):
    """A minibatch of joint transitions, from replay to the losses.

    Attributes:
        now: When the agents acted.
        next: n steps later.
        actions: `(B, N, A)` in [-1, 1], or one-hot.
        rewards: Discounted, of the n steps, `(B, N)`.
        discount: Of each agent's value after them, `(B, N)`: gamma^n, or 0.0 for an agent that reached a terminal
            state; one that a time limit stopped bootstraps, also where others terminated in the same step.
        noise: Random numbers of the losses `(B, N, A)`, which the learner adds: normal for smoothed target actions,
            uniform for discrete actors.
    """

    now: Moment
    next: Moment
    actions: Tensor
    rewards: Tensor
    discount: Tensor
    noise: Tensor | None = None

    @property
    def team_discount(self) -> Tensor:
        """Of the team's one value, `(B, 1)`: 0.0 only where every agent terminated.

        As long as one of them was merely stopped by a time limit, there would have been more of the team reward that
        this value is the sum of.
        """
        return self.discount.amax(-1, keepdim=True)

    def unbind(self) -> list[Batch]:
        """The minibatches of a batch whose tensors have a further dimension in front."""
        batches: list[Batch] = _unbound(self)
        return batches


def _unbound(part: Any) -> Any:
    """A list over the first dimension of a tensor, or of all tensors of a named tuple; anything else as it is."""
    if isinstance(part, Tensor):
        return list(part.unbind())
    if not isinstance(part, tuple):
        return part
    columns = [_unbound(column) for column in part]
    count = next(len(column) for column in columns if isinstance(column, list))
    return [type(part)(*(c[i] if isinstance(c, list) else c for c in columns)) for i in range(count)]


def _is_count(value: Any, low: int) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= low)


def _is_shape(value: Any) -> bool:
    return isinstance(value, tuple | list) and all(_is_count(size, 1) for size in value)


class JointReplayBuffer(Checkpointable):
    """Uniform replay of a fixed team's joint transitions.

    A row holds what belongs to one env step of one environment copy: observations `(N, O)`, actions `(N, A)`,
    rewards `(N,)`, which agents terminated there `(N,)` and, if wanted, the state `(S,)`. The next
    observation is not stored a second time: each row links to its successor. An episode's true last
    observation gets a row of its own, without an action, so a truncated step bootstraps from what was really
    there and never from the observation after the reset. Rows of several environment copies lie mixed in
    one ring; the links keep their episodes apart. Windows of several observations and returns of several steps
    are not stored either: both are cut along the links when they are sampled.

    Args:
        capacity: Rows in the ring. An episode of T steps takes T + 1 of them.
        num_agents: N.
        observation_size: O.
        action_size: A.
        state_size: S, length of the stored state; 0 stores none.
        recurrent_state: Shape `(*H)` of the recurrent state with which every agent's window began when it acted; None
            stores none. An LSTM's is (2, H): 2.3 GB for 500 000 rows of nine agents with H = 64.
        seed: Seed of the sampling.
        device: Where the rows live and are sampled to.

    Raises:
        ValueError: If a number is not legal, or the full ring would not fit into memory.
    """

    def __init__(
        self,
        capacity: int,
        num_agents: int,
        observation_size: int,
        action_size: int,
        state_size: int = 0,
        recurrent_state: Sequence[int] | None = None,
        *,
        seed: int | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        positive, natural = Annotated[int, Range(1)], Annotated[int, Range(0)]
        (capacity, num_agents, observation_size, action_size, state_size, seed) = (
            check_value(value, legal, name, type(self).__name__)
            for name, value, legal in (
                ("capacity", capacity, positive),
                ("num_agents", num_agents, positive),
                ("observation_size", observation_size, positive),
                ("action_size", action_size, positive),
                ("state_size", state_size, natural),
                ("seed", seed, natural | None),
            )
        )
        if recurrent_state is not None and not _is_shape(recurrent_state):
            raise ValueError(f"recurrent_state must be None or a shape such as (2, 64), not {recurrent_state!r}.")
        try:
            device = torch.device(device)
        except (RuntimeError, TypeError, ValueError) as error:
            raise ValueError(f"device must be one of PyTorch's, such as 'cpu' or 'cuda', not {device!r}.") from error
        self.capacity = capacity
        self._arguments: dict[str, Any] = {
            "capacity": capacity,
            "num_agents": num_agents,
            "observation_size": observation_size,
            "action_size": action_size,
            "state_size": state_size,
            "recurrent_state": None if recurrent_state is None else tuple(recurrent_state),
        }
        shapes: dict[str, tuple[int, ...]] = {
            "obs": (num_agents, observation_size),
            "actions": (num_agents, action_size),
            "rewards": (num_agents,),
            "terminated": (num_agents,),
        }
        if state_size:
            shapes["state"] = (state_size,)
        if recurrent_state is not None:
            shapes["recurrent_state"] = (num_agents, *recurrent_state)
        row = 16 + sum(math.prod(shape) * (1 if name == "terminated" else 4) for name, shape in shapes.items())
        self._row = row
        if capacity * row > (memory := memory_of(device)):
            raise ValueError(
                f"A replay buffer of {capacity} rows takes {gigabytes(capacity * row)}, {row} bytes for each joint "
                f"step, and there are {gigabytes(memory)}: legal is a capacity up to {int(memory) // row}."
            )
        # Empty memory is not touched, so it costs nothing until rows are written to it.
        self._columns = {
            name: torch.empty(
                (capacity, *shape), dtype=torch.bool if name == "terminated" else torch.float32, device=device
            )
            for name, shape in shapes.items()
        }
        self._shapes = shapes
        # Rows are numbered for ever; row i lies at i % capacity and is there while i >= head - capacity.
        self._head = 0
        self._next = np.full(capacity, _NONE, dtype=np.int64)
        self._previous = np.full(capacity, _NONE, dtype=np.int64)
        # The last row of each stream (one environment copy of one runner) and its position in the stream.
        self._tails: dict[tuple[str, int], tuple[int, int]] = {}
        self._rng = np.random.default_rng(seed)

    def __len__(self) -> int:
        """Rows held at present."""
        return min(self._head, self.capacity)

    @property
    def nbytes(self) -> int:
        """Bytes that the full ring takes."""
        return sum(c.nbytes for c in self._columns.values()) + self._next.nbytes + self._previous.nbytes

    def add(
        self,
        *,
        obs: NDArray[np.float32],
        actions: NDArray[np.float32],
        rewards: NDArray[np.float32],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
        final_obs: NDArray[np.float32],
        state: NDArray[np.float32] | None = None,
        final_state: NDArray[np.float32] | None = None,
        recurrent_state: NDArray[np.float32] | None = None,
        final_recurrent_state: NDArray[np.float32] | None = None,
        source: str = "",
        start: int = 0,
        failed: NDArray[np.bool_] | None = None,
    ) -> None:
        """Appends L steps of E copies that stepped together.

        Args:
            obs: Observations before each step, `(L, E, N, O)`.
            actions: Actions in [-1, 1], `(L, E, N, A)`.
            rewards: Rewards, `(L, E, N)`.
            terminated: Whether each agent reached a terminal state at this step, `(L, E, N)`.
            truncated: Whether a time limit ended the episode for the others at this step, `(L, E)`. It is over there,
                and where all agents terminated.
            final_obs: The true last observations of the episodes that ended, in the order of their steps
                (step first, then copy), `(D, N, O)`.
            state: States before each step, `(L, E, S)`, if states are stored.
            final_state: States at the episodes' ends, `(D, S)`, if states are stored.
            recurrent_state: Recurrent states before each step's window, `(L, E, N, *H)`, if they are stored.
            final_recurrent_state: Those after the episodes' last steps, `(D, N, *H)`, if they are stored.
            source: Who sampled the steps. Steps of one source that follow one another are linked.
            start: Number of the first step among the source's. A gap to what was added before (a lost or
                restarted runner) breaks the link instead of joining two episodes.
            failed: Where the environment failed instead of stepping, `(L, E)`: the episode breaks off with that step's
                observation, and another one follows. None if it nowhere did.
        """
        legal = isinstance(truncated, np.ndarray) and truncated.dtype == np.bool_
        if not legal or truncated.ndim != 2 or truncated.size == 0:
            there = f"{truncated.dtype} {truncated.shape}" if isinstance(truncated, np.ndarray) else repr(truncated)
            raise ValueError(f"'truncated' must be an array (L, E) of bools, L and E at least 1, not {there}.")
        if not isinstance(source, str) or not _is_count(start, 0):
            raise ValueError(f"source must be a string and start an integer >= 0, not {source!r} and {start!r}.")
        length, copies = rows = truncated.shape
        terminated = self._checked("terminated", terminated, rows)
        done = terminated.all(-1) | truncated
        steps = length * copies
        row = self._head + np.arange(steps).reshape(length, copies)
        last = self._head + steps + np.arange(int(done.sum()))  # the rows of the final observations
        if steps + last.size > self.capacity:
            raise ValueError(
                f"{steps} steps and {last.size} final observations at once do not fit into a replay buffer of "
                f"{self.capacity} rows: raise replay_buffer_capacity or lower rollout_fragment_length."
            )
        # All is checked before anything is changed.
        columns: dict[str, NDArray[Any]] = {"terminated": terminated}
        finals: dict[str, NDArray[Any]] = {}
        for name, now, final in (
            ("obs", obs, final_obs),
            ("actions", actions, None),
            ("rewards", rewards, None),
            ("state", state, final_state),
            ("recurrent_state", recurrent_state, final_recurrent_state),
        ):
            if name in self._columns:
                columns[name] = self._checked(name, now, rows)
                if final is not None or (last.size and name not in ("actions", "rewards")):
                    finals[name] = self._checked(name, final, last.shape)
            elif now is not None:
                raise ValueError(f"{name!r} was given, but this replay buffer stores none.")
        # Links: the step after it, the final observation where the episode ended, open at the fragment's end.
        following = np.full((length, copies), _NONE, dtype=np.int64)
        following[:-1] = row[1:]
        following[done] = last
        previous = np.full((length, copies), _NONE, dtype=np.int64)
        over = done
        if failed is not None:
            if failed.shape != done.shape or (failed & done).any():
                raise ValueError(f"'failed' must be an array {done.shape}, and true where no episode ended.")
            following[failed] = _NONE
            over = done | failed
        previous[1:] = np.where(over[:-1], _NONE, row[:-1])
        last_kept = self._head + steps + last.size - self.capacity
        for copy in range(copies):
            tail, position = self._tails.get((source, copy), (_NONE, 0))
            if tail != _NONE and position == start:
                previous[0, copy] = tail  # also where it is overwritten: windows that reach that far are cut
                if tail >= last_kept:
                    self._next[tail % self.capacity] = row[0, copy]
            self._tails[source, copy] = (_NONE if over[-1, copy] else row[-1, copy], start + length)
        self._next[row % self.capacity] = following
        self._next[last % self.capacity] = _NONE
        self._previous[row % self.capacity] = previous
        self._previous[last % self.capacity] = row[done]
        self._write(row.reshape(-1), columns)
        self._write(last, finals)
        self._head += steps + last.size

    def _checked(self, name: str, values: Any, leading: tuple[int, ...]) -> NDArray[Any]:
        """Values of a column `(*leading, ...)` as they are stored.

        Raises:
            ValueError: If there are none, or they are no numbers, or have another shape.
        """
        expected = leading + self._shapes[name]
        what = name if len(leading) == 2 else f"final_{name}"
        if values is None:
            raise ValueError(f"The replay buffer stores {what!r}, but none was given.")
        if getattr(values, "shape", None) != expected:
            there = getattr(values, "shape", f"a {type(values).__name__}")
            hint = f", as 'truncated' is one of {leading}" if name == "terminated" else ""
            raise ValueError(f"{what!r} must be an array {expected}{hint}, not {there}.")
        if not isinstance(values, np.ndarray) or values.dtype.kind not in ("b" if name == "terminated" else "fiub"):
            legal = "bools" if name == "terminated" else "numbers"
            raise ValueError(f"{what!r} must be a NumPy array of {legal}, not of {getattr(values, 'dtype', 'others')}.")
        # Arrays from a remote runner are read-only, which torch warns of.
        return np.require(values, np.bool_ if name == "terminated" else np.float32, ["C", "W"])

    def _write(self, rows: NDArray[np.int64], columns: dict[str, NDArray[Any]]) -> None:
        """Writes to rows that follow one another."""
        if rows.size == 0:
            return
        # Rows are consecutive: one or two slices instead of an index.
        first = int(rows[0] % self.capacity)
        split = min(rows.size, self.capacity - first)
        for name, values in columns.items():
            column = self._columns[name]
            flat = torch.from_numpy(values).reshape(rows.size, *column.shape[1:])
            column[first : first + split] = flat[:split]
            column[: rows.size - split] = flat[split:]

    def sample(self, shape: Sequence[int], *, gamma: float, n_step: int = 1, seq_length: int = 0) -> Batch:
        """Draws transitions uniformly, with replacement.

        A transition of n steps ends earlier where its episode does, or where nothing later is stored.

        Args:
            shape: Leading shape of the result, e.g. `(updates, batch)`.
            gamma: Discount of one step.
            n_step: n, steps from an observation to its next one.
            seq_length: T, observations of a window up to each of both; 0 for no windows.

        Returns:
            The transitions; all their tensors have `shape` in the place of B.

        Raises:
            ValueError: If no complete transition is stored yet, or a length is not legal.
        """
        counts = _is_count(n_step, 1) and _is_count(seq_length, 0) and seq_length <= self.capacity
        if not (counts and isinstance(gamma, Real) and 0 <= gamma <= 1):
            raise ValueError(
                f"n_step must be an integer >= 1, seq_length one >= 0 that is no larger than the capacity "
                f"({self.capacity}), and gamma a number from 0 to 1, not {n_step!r}, {seq_length!r} and {gamma!r}."
            )
        size = math.prod(shape) * max(1, seq_length) * self._row if _is_shape(shape) else math.inf
        if size > memory_of(self._columns["obs"].device):
            raise ValueError(f"shape must be integers >= 1 whose samples fit into memory, not {shape!r}.")
        rows = self._draw(math.prod(shape), seq_length)
        rewards = self._columns["rewards"]
        last, steps = rows, np.ones(rows.size)
        total = rewards.index_select(0, self._places(rows))
        for _ in range(n_step - 1):
            ahead = self._next[last] % self.capacity
            more = self._next[ahead] != _NONE
            if not more.any():
                break  # all have come to the ends of their episodes
            factor = torch.from_numpy((gamma**steps).astype(np.float32)).to(rewards.device)[:, None]
            # A row without a successor may have no reward at all: its memory is not even zero.
            further = factor * rewards.index_select(0, self._places(ahead))
            total += torch.where(self._places(more)[:, None], further, 0.0)
            last, steps = np.where(more, ahead, last), steps + more
        following = self._next[last] % self.capacity
        ended = self._columns["terminated"].index_select(0, self._places(last))
        discount = torch.from_numpy((gamma**steps).astype(np.float32)).to(rewards.device)[:, None] * ~ended
        return Batch(
            now=self._moment("now", rows, shape, seq_length),
            next=self._moment("next", following, shape, seq_length),
            actions=self._take("actions", rows, shape),
            rewards=total.view(*shape, -1),
            discount=discount.view(*shape, -1),
        )

    def _moment(self, name: str, rows: NDArray[np.int64], shape: Sequence[int], seq_length: int) -> Moment:
        """What there was at some rows."""
        window = mask = None
        if seq_length:
            places, counts, _ = self._windows(rows, seq_length)
            window = self._take("obs", places, (*shape, seq_length)).transpose(-3, -2)
            obs = window[..., -1, :]
            mask = torch.from_numpy(counts).to(obs.device).view(*shape, seq_length)
        else:
            obs = self._take("obs", rows, shape)
        state, recurrent_state = (
            self._take(column, rows, shape) if column in self._columns else None
            for column in ("state", "recurrent_state")
        )
        return Moment(obs, state, window, mask, recurrent_state, name)

    def _places(self, rows: NDArray[Any]) -> Tensor:
        return torch.from_numpy(rows.reshape(-1)).to(self._columns["obs"].device)

    def _take(self, name: str, rows: NDArray[np.int64], shape: Sequence[int]) -> Tensor:
        column = self._columns[name]
        return column.index_select(0, self._places(rows)).view(*shape, *column.shape[1:])

    def _draw(self, count: int, seq_length: int) -> NDArray[np.int64]:
        """Places of rows that have a successor and a whole window, uniformly: the few others are drawn again."""
        held = len(self)
        rows = self._rng.integers(held, size=count) if held else np.empty(0, dtype=np.int64)
        missing = np.flatnonzero(self._next[rows] == _NONE)
        if not held or (missing.size == count and not (self._next[:held] != _NONE).any()):
            raise ValueError("The replay buffer holds no complete transition yet.")
        missing = np.flatnonzero(self._unusable(rows, seq_length))
        draws = 0
        while missing.size:
            rows[missing] = self._rng.integers(held, size=missing.size)
            draws += 1
            # In a ring of only a few rows there may be no window that its end has not cut: then any will do.
            missing = missing[self._unusable(rows[missing], seq_length if draws < 100 else 0)]
        return rows

    def _unusable(self, rows: NDArray[np.int64], seq_length: int) -> NDArray[np.bool_]:
        """Which rows have no successor yet, or a window that the ring has partly overwritten."""
        open_end: NDArray[np.bool_] = self._next[rows] == _NONE
        if seq_length > 1 and self._head > self.capacity:
            open_end |= self._windows(rows, seq_length)[2]
        return open_end

    def _windows(
        self, rows: NDArray[np.int64], length: int
    ) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.bool_]]:
        """The places of the T rows up to each row, which of them are of its episode, and what was overwritten.

        Returns:
            Places `(rows, T)`, oldest first; mask `(rows, T)`; whether rows of the window are no longer there.
        """
        window = np.empty((rows.size, length), dtype=np.int64)
        mask = np.empty((rows.size, length), dtype=np.float32)
        valid, cut = np.ones((2, rows.size), dtype=np.bool_)
        cut[:] = False
        for step in reversed(range(length)):
            window[:, step], mask[:, step] = rows, valid
            if step == 0:
                break
            previous = self._previous[rows]
            gone = valid & (previous != _NONE) & (previous < self._head - self.capacity)
            cut |= gone
            valid = valid & (previous != _NONE) & ~gone
            rows = np.where(valid, previous % self.capacity, rows)
        return window, mask, cut

    @override(Checkpointable)
    def get_state(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Everything that sampling and adding go on from; rows that were never written are left out."""
        return {
            **self._arguments,
            "columns": {name: column[: len(self)].cpu().numpy() for name, column in self._columns.items()},
            "next": self._next[: len(self)].copy(),
            "previous": self._previous[: len(self)].copy(),
            "head": self._head,
            "tails": dict(self._tails),
            "rng": self._rng.bit_generator.state,
        }

    @override(Checkpointable)
    def set_state(self, state: dict[str, Any]) -> None:
        """Goes on from a saved state.

        Raises:
            ValueError: If the state is of a buffer with another capacity or team, or damaged; nothing has changed then.
        """
        saved = {name: state.get(name) for name in self._arguments}
        try:
            fits = bool(saved == self._arguments)
        except ValueError:  # an array in the place of a number
            fits = False
        if not fits:
            raise ValueError(f"The saved replay buffer is {saved}, this one {self._arguments}.")
        try:
            head, tails, generator = int(state["head"]), dict(state["tails"]), np.random.default_rng()
            generator.bit_generator.state = state["rng"]
            held = min(head, self.capacity)
            columns = {name: torch.from_numpy(state["columns"][name]) for name in self._columns}
            legal = all(len(column) == held for column in columns.values())
            # One flag of all agents is that of each.
            columns = {name: column.expand(held, *self._shapes[name]) for name, column in columns.items()}
            links = state["next"], state["previous"]
            legal &= all(link.shape == (held,) and link.dtype == np.int64 for link in links) and head >= 0
            legal &= all(_is_count(place, _NONE) and _is_count(start, 0) for place, start in tails.values())
            legal &= all((_NONE <= link).all() and (link < head).all() for link in links)
        except (LookupError, TypeError, ValueError, AttributeError, OverflowError, RuntimeError) as error:
            raise ValueError(f"The saved replay buffer is damaged ({type(error).__name__}: {error}).") from error
        if not legal:
            raise ValueError("The saved replay buffer is damaged: its columns and links do not belong together.")
        self._head, self._tails, self._rng = head, tails, generator
        for name, column in self._columns.items():
            column[:held] = columns[name]
        self._next[:] = self._previous[:] = _NONE
        self._next[:held], self._previous[:held] = links

    @override(Checkpointable)
    def get_ctor_args_and_kwargs(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """What builds an empty buffer of this shape."""
        return (), dict(self._arguments)
