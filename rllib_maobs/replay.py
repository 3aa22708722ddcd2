"""Joint replay: a ring of joint steps that stores every observation once and keeps agents aligned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.utils.annotations import override
from ray.rllib.utils.checkpoints import Checkpointable
from torch import Tensor

_NONE = -1  # "no such row" in the links between rows


class JointReplayBuffer(Checkpointable):
    """Uniform replay of a fixed team's joint transitions.

    A row holds what belongs to one env step of one environment copy: observations `(N, O)`, actions `(N, A)`,
    rewards `(N,)`, whether the episode terminated there and, if wanted, the state `(S,)`. The next
    observation is not stored a second time: each row links to its successor. An episode's true last
    observation gets a row of its own, without an action, so a truncated step bootstraps from what was really
    there and never from the observation after the reset. Rows of several environment copies lie mixed in
    one ring; the links keep their episodes apart.

    Args:
        capacity: Rows in the ring. An episode of T steps takes T + 1 of them.
        num_agents: N.
        observation_size: O.
        action_size: A.
        state_size: S, length of the stored state; 0 stores none.
        seed: Seed of the sampling.
        device: Where the rows live and are sampled to.
    """

    def __init__(
        self,
        capacity: int,
        num_agents: int,
        observation_size: int,
        action_size: int,
        state_size: int = 0,
        *,
        seed: int | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.capacity = capacity
        self._arguments: dict[str, Any] = {
            "capacity": capacity,
            "num_agents": num_agents,
            "observation_size": observation_size,
            "action_size": action_size,
            "state_size": state_size,
        }
        shapes: dict[str, tuple[int, ...]] = {
            "obs": (num_agents, observation_size),
            "actions": (num_agents, action_size),
            "rewards": (num_agents,),
            "terminated": (1,),
        }
        if state_size:
            shapes["state"] = (state_size,)
        # Empty memory is not touched, so it costs nothing until rows are written to it.
        self._columns = {name: torch.empty((capacity, *shape), device=device) for name, shape in shapes.items()}
        # Rows are numbered for ever; row i lies at i % capacity and is there while i >= head - capacity.
        self._head = 0
        self._next = np.full(capacity, _NONE, dtype=np.int64)
        # The last row of each stream (one environment copy of one runner) and its position in the stream.
        self._tails: dict[tuple[str, int], tuple[int, int]] = {}
        self._rng = np.random.default_rng(seed)

    def __len__(self) -> int:
        """Rows held at present."""
        return min(self._head, self.capacity)

    @property
    def nbytes(self) -> int:
        """Bytes that the full ring takes."""
        return sum(c.nbytes for c in self._columns.values()) + self._next.nbytes

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
        source: str = "",
        start: int = 0,
    ) -> None:
        """Appends L steps of E copies that stepped together.

        Args:
            obs: Observations before each step, `(L, E, N, O)`.
            actions: Actions in [-1, 1], `(L, E, N, A)`.
            rewards: Rewards, `(L, E, N)`.
            terminated: Whether the episode ended in a terminal state at this step, `(L, E)`.
            truncated: Whether a time limit cut it at this step, `(L, E)`.
            final_obs: The true last observations of the episodes that ended, in the order of their steps
                (step first, then copy), `(D, N, O)`.
            state: States before each step, `(L, E, S)`, if states are stored.
            final_state: States at the episodes' ends, `(D, S)`, if states are stored.
            source: Who sampled the steps. Steps of one source that follow one another are linked.
            start: Number of the first step among the source's. A gap to what was added before (a lost or
                restarted runner) breaks the link instead of joining two episodes.
        """
        length, copies = terminated.shape
        done = terminated | truncated
        steps = length * copies
        row = self._head + np.arange(steps).reshape(length, copies)
        last = self._head + steps + np.arange(int(done.sum()))  # the rows of the final observations
        if steps + last.size > self.capacity:
            raise ValueError(
                f"{steps} steps and {last.size} final observations at once do not fit into a replay buffer of "
                f"{self.capacity} rows: raise replay_buffer_capacity or lower rollout_fragment_length."
            )
        # Links: the step after it, the final observation where the episode ended, open at the fragment's end.
        following = np.full((length, copies), _NONE, dtype=np.int64)
        following[:-1] = row[1:]
        following[done] = last
        last_kept = self._head + steps + last.size - self.capacity
        self._next[row % self.capacity] = following
        self._next[last % self.capacity] = _NONE
        for copy in range(copies):
            tail, position = self._tails.get((source, copy), (_NONE, 0))
            alive = tail != _NONE and tail >= last_kept
            if alive and position == start:
                self._next[tail % self.capacity] = row[0, copy]
            self._tails[source, copy] = (_NONE if done[-1, copy] else row[-1, copy], start + length)

        self._write(row.reshape(-1), obs=obs, actions=actions, rewards=rewards, terminated=terminated[..., None])
        self._write(last, obs=final_obs)
        if "state" in self._columns:
            self._write(row.reshape(-1), state=state)
            self._write(last, state=final_state)
        self._head += steps + last.size

    def _write(self, rows: NDArray[np.int64], **columns: NDArray[Any] | None) -> None:
        if rows.size == 0:
            return
        # Rows are consecutive: one or two slices instead of an index.
        first = int(rows[0] % self.capacity)
        split = min(rows.size, self.capacity - first)
        for name, values in columns.items():
            column = self._columns[name]
            if values is None:
                raise ValueError(f"The replay buffer stores {name!r}, but none was given.")
            # np.require: arrays from a remote runner are read-only, which torch warns of.
            flat = torch.from_numpy(np.require(values, np.float32, "W")).reshape(rows.size, *column.shape[1:])
            column[first : first + split] = flat[:split]
            column[: rows.size - split] = flat[split:]

    def sample(self, shape: Sequence[int]) -> dict[str, Tensor]:
        """Draws transitions uniformly, with replacement.

        Args:
            shape: Leading shape of the result, e.g. `(updates, batch)`.

        Returns:
            `obs` and `next_obs` `(*shape, N, O)`, `actions` `(*shape, N, A)`, `rewards` `(*shape, N)`,
            `terminated` `(*shape, 1)` as 0.0 or 1.0 and, if stored, `state` and `next_state` `(*shape, S)`.

        Raises:
            ValueError: If no complete transition is stored yet.
        """
        rows = self._draw(int(np.prod(shape)))
        following = self._next[rows]
        here, there = (torch.from_numpy(i % self.capacity) for i in (rows, following))
        batch = {name: self._take(name, here, shape) for name in self._columns}
        batch["next_obs"] = self._take("obs", there, shape)
        if "state" in self._columns:
            batch["next_state"] = self._take("state", there, shape)
        return batch

    def _take(self, name: str, index: Tensor, shape: Sequence[int]) -> Tensor:
        column = self._columns[name]
        return column.index_select(0, index.to(column.device)).view(*shape, *column.shape[1:])

    def _draw(self, count: int) -> NDArray[np.int64]:
        """Places of rows that have a successor, uniformly: the few others are drawn again."""
        rows = self._rng.integers(len(self), size=count) if len(self) else np.empty(0, dtype=np.int64)
        missing = np.flatnonzero(self._next[rows] == _NONE)
        if not len(self) or (missing.size == count and not (self._next[: len(self)] != _NONE).any()):
            raise ValueError("The replay buffer holds no complete transition yet.")
        while missing.size:
            rows[missing] = self._rng.integers(len(self), size=missing.size)
            missing = missing[self._next[rows[missing]] == _NONE]
        return rows

    @override(Checkpointable)
    def get_state(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Everything that sampling and adding go on from; rows that were never written are left out."""
        return {
            **self._arguments,
            "columns": {name: column[: len(self)].cpu().numpy() for name, column in self._columns.items()},
            "next": self._next[: len(self)].copy(),
            "head": self._head,
            "tails": dict(self._tails),
            "rng": self._rng.bit_generator.state,
        }

    @override(Checkpointable)
    def set_state(self, state: dict[str, Any]) -> None:
        """Goes on from a saved state.

        Raises:
            ValueError: If the state is of a buffer with another capacity or team.
        """
        saved = {name: state[name] for name in self._arguments}
        if saved != self._arguments:
            raise ValueError(f"The saved replay buffer is {saved}, this one {self._arguments}.")
        self._head = state["head"]
        for name, column in self._columns.items():
            column[: len(self)] = torch.from_numpy(state["columns"][name])
        self._next[:] = _NONE
        self._next[: len(self)] = state["next"]
        self._tails = dict(state["tails"])
        self._rng.bit_generator.state = state["rng"]

    @override(Checkpointable)
    def get_ctor_args_and_kwargs(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """What builds an empty buffer of this shape."""
        return (), dict(self._arguments)
