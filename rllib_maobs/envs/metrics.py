"""One number per episode and metric, accumulated step by step."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rllib_maobs.envs.scenario import Outcome, Scenario
from rllib_maobs.envs.world import FloatArray, World

_REDUCTIONS = ("last", "mean", "sum", "min", "max", "first")
_START = {"min": np.inf, "max": -np.inf, "first": np.inf}


class EpisodeTracker:
    """Metrics of the running episode of each copy.

    Every scenario reports the following, and what it declares in `Scenario.metrics`. Agents are here those of
    the team, the first group of bodies; contacts of predators with their prey, for one, are no collisions.

    - `success`: 1 if the task is solved at the end of the episode, unless the scenario says otherwise.
    - `time_to_goal`: first step at which the task is solved; the horizon if it never is.
    - `collisions_agents`: pairs of agents in contact, summed over the steps.
    - `collisions_obstacles`, `collisions_walls`: contacts of agents with them, summed over agents and steps.
    - `collision_free`: 1 if all three are zero.
    - `min_clearance`: smallest distance in the episode between the surface of an agent and any other surface
      that it can touch; negative in contact, +inf if there is nothing to touch.
    - `path_efficiency`: straight line from start to end over travelled distance, mean over agents (1 for one
      that never moved).
    - `return_agent_0`: undiscounted return of the first agent, the score of the paper if actions are free of
      noise.
    - `episode_length`: steps.

    Args:
        scenario: The task.
        world: Its physics.
    """

    def __init__(self, scenario: Scenario, world: World) -> None:  # type: ignore[type-arg]
        team = world.groups[0]
        self._team, self._num_agents = team.name, team.count
        self._horizon = scenario.options.horizon
        # What the team should keep clear of: itself and what does not move.
        num_colliders = world.gap.shape[-1]
        movers = range(team.count, min(world.num_movers, num_colliders))
        keep_clear = [k for k in range(num_colliders) if k not in movers]
        self._keep_clear: slice | list[int] = keep_clear if movers else slice(None)
        own = {
            "success": "last",
            "time_to_goal": "first",
            "collisions_agents": "sum",
            "collisions_obstacles": "sum",
            "collisions_walls": "sum",
            "min_clearance": "min",
            "return_agent_0": "sum",
        }
        self._reduce: Mapping[str, str] = own | dict(scenario.metric_reductions())
        for name, how in self._reduce.items():
            if how not in _REDUCTIONS:
                raise ValueError(f"metric {name!r} has reduction {how!r}; legal: {', '.join(_REDUCTIONS)}")
        self._names = {how: [n for n, h in self._reduce.items() if h == how] for how in _REDUCTIONS}
        e = world.num_envs
        self._values = {how: np.zeros((len(names), e)) for how, names in self._names.items()}
        self._steps = np.zeros(e, np.int64)
        self._travelled = np.zeros((e, self._num_agents))
        self._start = np.zeros((e, self._num_agents, 2))
        self._last = np.zeros((e, self._num_agents, 2))

    def reset(self, copies: NDArray[np.intp]) -> None:
        """Begin an episode in some copies.

        Args:
            copies: Their numbers.
        """
        for how, values in self._values.items():
            values[:, copies] = _START.get(how, 0.0)
        self._steps[copies] = 0
        self._travelled[copies] = 0.0

    def before_step(self, world: World) -> None:
        """Note where the agents are, also if somebody has moved them by hand."""
        np.copyto(self._last, world.position[:, : self._num_agents])
        begins = self._steps == 0
        if begins.any():
            self._start[begins] = self._last[begins]

    def update(self, world: World, outcome: Outcome) -> None:
        """Take in one step of all copies."""
        agents = slice(0, self._num_agents)
        position = world.position[:, agents]
        self._travelled += _length(position - self._last)
        np.copyto(self._last, position)
        self._steps += 1

        step: dict[str, NDArray[np.generic]] = dict(outcome.metrics)
        step["success"] = step["time_to_goal"] = outcome.success
        step["collisions_agents"] = world.contacts(self._team)[:, agents].sum(axis=1) / 2.0
        step["collisions_obstacles"] = self._count(world, "obstacle")
        step["collisions_walls"] = world.wall_contacts()[:, agents].sum(axis=1)
        gaps = world.gap[:, agents, self._keep_clear], world.wall_gap[:, agents]
        clearances = [gap.min(axis=(1, 2), initial=np.inf) for gap in gaps]
        step["min_clearance"] = np.minimum(*clearances)
        step["return_agent_0"] = outcome.rewards[:, 0]

        for how, names in self._names.items():
            if names:
                self._accumulate(how, np.stack([step[name] for name in names]).astype(np.float64))

    def report(self, finished: NDArray[np.bool_]) -> dict[str, FloatArray]:
        """Return the metrics by name.

        Args:
            finished: (E,) which copies have ended their episode.

        Returns:
            (E,) values, NaN for copies that have not finished.
        """
        result: dict[str, FloatArray] = {}
        for how, names in self._names.items():
            values = self._values[how]
            if how == "mean":
                values = values / np.maximum(self._steps, 1)
            elif how == "first":
                values = np.minimum(values, self._horizon)
            result |= dict(zip(names, values, strict=True))
        collisions = result["collisions_agents"] + result["collisions_obstacles"] + result["collisions_walls"]
        result["collision_free"] = (collisions == 0.0).astype(np.float64)
        straight = _length(self._last - self._start)
        still = self._travelled < 1e-9
        efficiency = np.where(still, 1.0, straight / np.where(still, 1.0, self._travelled))
        result["path_efficiency"] = efficiency.mean(axis=1)
        result["episode_length"] = self._steps.astype(np.float64)
        return {name: np.where(finished, value, np.nan) for name, value in result.items()}

    def _count(self, world: World, group: str) -> NDArray[np.generic]:
        if group not in world.index:
            return np.zeros(world.num_envs)
        return world.contacts(group)[:, : self._num_agents].sum(axis=1)

    def _accumulate(self, how: str, step: FloatArray) -> None:
        """Fold (metrics, E) values of one step into the episode's."""
        values = self._values[how]
        if how == "last":
            values[...] = step
        elif how in ("mean", "sum"):
            values += step
        elif how == "min":
            np.minimum(values, step, out=values)
        elif how == "max":
            np.maximum(values, step, out=values)
        else:
            np.minimum(values, np.where(step > 0.0, self._steps, np.inf), out=values)


def _length(vector: FloatArray) -> FloatArray:
    return np.sqrt(vector[..., 0] ** 2 + vector[..., 1] ** 2)
