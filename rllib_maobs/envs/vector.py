"""E copies of a scenario, stepped together."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from rllib_maobs.envs.checking import check_outcome, check_scenario, checked_places
from rllib_maobs.envs.metrics import EpisodeTracker
from rllib_maobs.envs.scenario import Scenario
from rllib_maobs.layout import Layout, as_layout
from rllib_maobs.memory import gigabytes, memory_of

Info = dict[str, Any]


class VectorEnv:
    """E copies of a scenario that step at once, arrays in and arrays out.

    Copy e of an environment reset with seed s plays the same episodes as a single copy reset with seed s + e.
    Nothing is reset automatically: the observation of the last step is the true final one, and
    `reset(mask=terminated | truncated)` begins the next episode of the copies that have finished.

    The environment can be pickled at any time; the copy continues identically.

    Example:
    ```python
    env = make_vec("spread-9a", num_envs=64)
    obs, _ = env.reset(seed=0)
    for _ in range(1000):
        actions = np.random.default_rng().uniform(-1, 1, (64, 9, 5))
        obs, rewards, terminated, truncated, info = env.step(actions)
        if (finished := terminated | truncated).any():
            print(info["episode_metrics"]["coverage"][finished].mean())
            obs, _ = env.reset(mask=finished)
    ```

    Attributes:
        scenario: The task.
        num_envs: E.
        agents: Ids of the N agents, in the order of all arrays.
        horizon: Steps until an episode is truncated.
        observation_spaces: Space of each agent, by id.
        action_spaces: Space of each agent, by id.
        observation_layouts: What each agent's observation is made of, by id.
        state_layout: What `state("world")` is made of.
        world: The physics; `world.position` and `world.velocity` (E, K, 2) may be written at any time.
        seeds: (E,) seed that each copy's generator started from.

    Args:
        scenario: The task.
        num_envs: E.
    """

    def __init__(self, scenario: Scenario[Any], num_envs: int = 1) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise ValueError(f"num_envs={num_envs!r} is illegal; legal: an integer >= 1")
        check_scenario(scenario)
        self.scenario = scenario
        self.num_envs = int(num_envs)
        self.agents = list(scenario.agents)
        self.horizon: int = scenario.options.horizon
        layouts, sizes = scenario.observation_layouts, list(scenario.observation_sizes)
        self.observation_layouts: dict[str, Layout] = {
            agent: as_layout(layout, size, f"observation of agent {agent!r}")
            for agent, layout, size in zip(self.agents, layouts, sizes, strict=True)
        }
        self.state_layout = as_layout(scenario.state_layout, scenario.world_state_size(), "world state")
        n, self._observation_size = len(self.agents), scenario.observation_size
        if self._observation_size != max(sizes):
            raise ValueError(
                f"{scenario} has observation_size {self._observation_size}, but its agents' observation_layouts have "
                f"{sizes} numbers: override Scenario.observation_layout, of the longest one where they differ"
            )
        spaces = {a: gym.spaces.Box(-np.inf, np.inf, (o,), np.float32) for a, o in zip(self.agents, sizes, strict=True)}
        # (N, O), where an observation ends and its padding begins; None where no agent has any.
        padding = np.arange(self._observation_size) >= np.array(sizes)[:, None]
        self._padding: NDArray[np.bool_] | None = padding if padding.any() else None
        self.observation_spaces: dict[str, gym.Space[Any]] = dict(spaces)
        self.shared_reward = scenario.shared_reward
        self.action_spaces = {agent: scenario.action_space() for agent in self.agents}
        action_shape: tuple[int, ...] = scenario.action_space().shape or ()
        self._actions_shape = (self.num_envs, n, *action_shape)
        self._discrete = scenario.options.action_mode == "discrete"

        # Of every pair of a body that moves and any other there are offset, distance, gap, and room to compute them.
        bodies = scenario.bodies()
        pairs = sum(group.count for group in bodies if group.movable) * sum(group.count for group in bodies)
        if (size := 48 * self.num_envs * pairs) > memory_of("cpu"):
            raise ValueError(
                f"num_envs={num_envs}: so many copies do not fit into memory (they take {gigabytes(size)})"
            )
        self.world = scenario.make_world(self.num_envs)
        accel = [g.accel for g in self.world.groups if g.movable for _ in range(g.count)]
        self._accel = np.array(accel)[:, None]
        self.seeds: NDArray[np.int64] = np.full(self.num_envs, -1, np.int64)
        self._rngs: list[Generator] | None = None
        self._tracker = EpisodeTracker(scenario, self.world)
        self._steps = np.zeros(self.num_envs, np.int64)
        # A copy that was never reset is treated like one that has finished: it must be reset.
        self._finished = np.ones(self.num_envs, bool)
        self._checked = False

    def reset(
        self, seed: int | Sequence[int] | None = None, mask: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.float32], Info]:
        """Begin a new episode in all copies, or in some.

        Args:
            seed: An int s gives copy e the seed s + e; a sequence holds E seeds; None goes on with each
                copy's stream of random numbers (the first reset then takes a seed from the operating system).
            mask: (E,) bool, the copies to reset; None for all. The others go on with their episodes.

        Returns:
            (E, N, O) observations of all copies, and an empty info.
        """
        copies, seeds = np.flatnonzero(self._check_mask(mask)), self._check_seed(seed)
        self._seed(seeds, copies)
        assert self._rngs is not None
        if copies.size:
            position = self.scenario.place([self._rngs[e] for e in copies.tolist()])
            self.world.position[copies] = checked_places(self.scenario, position, copies.size, self.world.num_bodies)
            self.world.velocity[copies] = 0.0
            self._tracker.reset(copies)
            self._steps[copies] = 0
            self._finished[copies] = False
        return self.observe(), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], Info]:
        """Step all copies.

        Args:
            actions: (E, N, A), clipped to [-1, 1]; (E, N) integers for discrete actions.

        Returns:
            (E, N, O) observations, (E, N) rewards, (E,) terminated, (E,) truncated, info. Where any copy has
            finished, info["episode_metrics"] holds an (E,) array per metric, NaN for the copies that have not
            finished.

        Raises:
            RuntimeError: If a copy has finished, or was never reset.
            ValueError: If actions have a wrong shape, are not finite or are out of range; names agent and
                copy.
        """
        self.check_running()
        actions = self._check_actions(actions)
        world, scenario = self.world, self.scenario
        control = scenario.control(actions)
        if world.num_movers > len(self.agents):
            assert self._rngs is not None
            world.refresh()
            control = np.concatenate([control, scenario.scripted_control(world, self._rngs)], axis=1)
        self._tracker.before_step(world)
        world.step(control * self._accel)
        self._steps += 1

        outcome = scenario.outcome(world)
        if not self._checked:  # all steps are alike
            check_outcome(scenario, outcome, self.num_envs)
            self._checked = True
        self._tracker.update(world, outcome)
        ends = outcome.success if scenario.options.terminate_on_success else np.zeros(self.num_envs, bool)
        terminated = np.array(ends, bool)
        truncated = (self._steps >= self.horizon) & ~terminated
        self._finished = terminated | truncated
        info: Info = {}
        if self._finished.any():
            info["episode_metrics"] = self._tracker.report(self._finished)
        return self.observe(), outcome.rewards.astype(np.float32), terminated, truncated, info

    def observe(self) -> NDArray[np.float32]:
        """Return the (E, N, O) observations of the current situation, also after a write to the world.

        Where the agents' observations differ in length, O is that of the longest and the others end in zeros;
        `observation_spaces` tells the true lengths.
        """
        self.world.refresh()
        out = np.empty((self.num_envs, len(self.agents), self._observation_size), np.float32)
        self.scenario.observe(self.world, out)
        if self._padding is not None:
            out[:, self._padding] = 0.0
        return out

    def heuristic(self) -> NDArray[Any]:
        """Return the actions of the scenario's hand-written policy in the current situation.

        Returns:
            (E, N, A); (E, N) integers for discrete actions.

        Raises:
            NotImplementedError: If the scenario has none.
            RuntimeError: If the environment was never reset.
        """
        self.check_begun("heuristic")
        self.world.refresh()
        return self.scenario.actions(self.scenario.heuristic(self.world))

    def state(self, kind: str | None = None) -> NDArray[np.float32]:
        """Return the (E, S) global state of the current situation.

        Args:
            kind: "observations" (all agents' observations in a row, without padding) or "world" (a row for each
                body, see `Scenario.state_layout`); None for the scenario's option `state`.

        Raises:
            RuntimeError: If the environment was never reset.
        """
        self.check_begun("state")
        if self._state_kind(kind) == "world":
            return self.scenario.world_state(self.world)
        observations = self.observe()
        return observations.reshape(self.num_envs, -1) if self._padding is None else observations[:, ~self._padding]

    def state_size(self, kind: str | None = None) -> int:
        """Return S of a kind of state; see `state`."""
        if self._state_kind(kind) == "world":
            return self.scenario.world_state_size()
        return sum(self.scenario.observation_sizes)

    def close(self) -> None:
        """Free nothing: here because every environment has it."""

    def _state_kind(self, kind: str | None) -> str:
        if kind is None:
            return str(self.scenario.options.state)
        if kind not in ("observations", "world"):
            raise ValueError(f"state kind {kind!r} is illegal; legal: 'observations', 'world'")
        return kind

    def _check_mask(self, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
        if mask is None:
            return np.ones(self.num_envs, bool)
        mask = as_array(mask, "mask")
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"mask is {mask.dtype} of shape {mask.shape}; expected bool of shape ({self.num_envs},)")
        return mask

    def _check_seed(self, seed: int | Sequence[int] | None) -> NDArray[np.int64] | None:
        """Return the (E,) seeds that are meant; None for none."""
        if seed is None:
            return None
        seeds = as_array(seed, "seed")
        if seeds.shape == () and seeds.dtype.kind in "iu":
            seeds = seeds + np.arange(self.num_envs)
        if seeds.shape != (self.num_envs,) or seeds.dtype.kind not in "iu" or (seeds < 0).any():
            raise ValueError(f"seed={seed!r} is illegal; legal: an integer >= 0, or {self.num_envs} of them, or None")
        return seeds

    def _seed(self, seeds: NDArray[np.int64] | None, copies: NDArray[np.intp]) -> None:
        """Give the copies new generators, or leave them theirs; the first time, all copies get one."""
        if self._rngs is None:
            first = int(np.random.SeedSequence().generate_state(1)[0])
            self.seeds[:] = first + np.arange(self.num_envs)
            self._rngs = [np.random.default_rng(s) for s in self.seeds]
        if seeds is not None:
            self.seeds[copies] = seeds[copies]
            for e in copies.tolist():
                self._rngs[e] = np.random.default_rng(self.seeds[e])

    def check_begun(self, method: str) -> None:
        """Raise a RuntimeError if the environment was never reset: bodies then have no places yet."""
        if self._rngs is None:
            raise RuntimeError(f"{method}() before reset()")

    def check_running(self) -> None:
        """Raise a RuntimeError if a copy cannot be stepped: it was never reset, or its episode has ended."""
        if not self._finished.any():
            return
        copies = np.flatnonzero(self._finished).tolist()
        single = self.num_envs == 1
        if (self._steps[copies] == 0).all():
            raise RuntimeError("step() before reset()" + ("" if single else f": copies {copies} were never reset"))
        if single:
            raise RuntimeError("step() after the end of the episode: call reset() first")
        raise RuntimeError(
            f"step() after the end of the episode of copies {copies}: call reset(mask=terminated | truncated) first"
        )

    def _check_actions(self, joint: NDArray[Any]) -> NDArray[Any]:
        actions = as_array(joint, "actions")
        if actions.shape != self._actions_shape:
            letters = "(E, N)" if self._discrete else "(E, N, A)"
            raise ValueError(f"actions have shape {actions.shape}; expected {letters} = {self._actions_shape}")
        if self._discrete:
            if not np.issubdtype(actions.dtype, np.integer):
                raise ValueError(f"discrete actions are {actions.dtype}; expected integers")
            self._reject(actions, (actions < 0) | (actions >= 5), "not in 0 .. 4")
        elif actions.dtype.kind not in "fiub":
            raise ValueError(f"actions are {actions.dtype}; expected numbers")
        elif not np.isfinite(actions).all():
            self._reject(actions, ~np.isfinite(actions).all(axis=-1), "not finite")
        return actions

    def _reject(self, actions: NDArray[Any], bad: NDArray[np.bool_], reason: str) -> None:
        """Raise for the first bad action, if any; bad is (E, N)."""
        if bad.any():
            copy, agent = np.argwhere(bad)[0]
            raise ValueError(f"action of {self.agents[agent]} in copy {copy} is {reason}: {actions[copy, agent]}")


def as_array(values: Any, name: str) -> NDArray[Any]:
    """Return an array of what was given under a name; raise a ValueError that has the name if there is none."""
    try:
        return np.asarray(values)
    except (ValueError, TypeError, OverflowError) as error:  # such as rows of different lengths
        raise ValueError(f"{name} {'are' if name.endswith('s') else 'is'} no array: {error}") from None
