"""Spread: cover all targets, touch nobody."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.random import Generator

from rllib_maobs.envs.coverage import MOST, Coverage, CoverageOptions, NonNegative, Positive
from rllib_maobs.envs.placement import Placement
from rllib_maobs.envs.steering import assign, steer, thrust
from rllib_maobs.envs.world import Bodies, FloatArray, World
from rllib_maobs.options import Range


@dataclass(frozen=True)
class SpreadOptions(CoverageOptions):
    """Options of `Spread`, documented there."""

    num_obstacles: Annotated[int, Range(0, MOST)] = 2
    placement: Literal["separated", "mpe"] = "separated"
    clearance: Annotated[float, NonNegative] = 0.02
    agent_range: Annotated[float, Positive] = 1.0
    obstacle_range: Annotated[float, Positive] = 0.9


class Spread(Coverage[SpreadOptions]):
    """N agents share N targets among M obstacles: stay on all targets at once and collide with nothing.

    Ids `spread-3a`, `spread-6a`, `spread-9a`: N agents with M = 2, 4, 6 obstacles.

    **Observation** of agent i, Box(-inf, inf, (O,), float32) with O = 4 + 2N + 2M + 2(N - 1): 18, 34, 50. Own
    velocity (2), own position (2), then relative to the agent: the targets (2N), the obstacles (2M), the
    other agents in the order of their ids (2(N - 1)).

    **Action**: see `action_mode`; Box(-1, 1, (5,), float32) by default.

    **State**: "observations", N * O numbers (54, 204, 450), or "world", a row for each body: position
    (2) and velocity (2) of the agents, then position (2) of obstacles and targets, 2(3N + M) (22, 44, 66).

    **Reward**: r_i = - sum over targets of the distance to the nearest agent - A_i - O_i, where A_i and O_i
    count the agents and obstacles that touch agent i after the step. With `reward_mode="sum"` every agent
    gets sum_i r_i.

    **Episode**: `horizon` steps, then truncated for all; see `terminate_on_success`.

    **Metrics** beside those of every scenario (see `EpisodeTracker`): `coverage` (share of targets with an
    agent within `goal_radius`, at the end), `coverage_mean` (mean over the steps), `all_covered` and
    `all_covered_mean` (1 where all are covered), `target_distance` (mean over the steps of the sum over
    targets of the distance to the nearest agent). Success means that all targets are covered.

    **Reference returns** of one agent, mean over 200 episodes (seeds 0 to 199) of `spread-3a` / `spread-6a` /
    `spread-9a`: uniformly random actions -802 / -2197 / -4052. The heuristic (a potential field and the best
    assignment of agents to targets) -35 / -79 / -138; it covers all targets in 99 / 97 / 96 % of the episodes, and 98 /
    79 / 51 % are without any contact. It sees only what is near: where two obstacles, or an agent that has arrived,
    close the straight way, it may stay in the pocket between them.

    Args:
        num_agents: N agents and as many targets. [paper: 3, 6, 9]
        num_obstacles: M. [our choice: 2, 4, 6]
        agent_radius: [MPE: 0.15]
        obstacle_radius: [our choice: 0.1]
        goal_radius: How near an agent must be to cover a target. [MPE: 0.1]
        reward_mode: "sum" (MPE's collaborative reward), "mean" (the same, divided by N) or "individual"
            (r_i). [MPE: sum]
        matching: Which distances the reward counts. "nearest": of every target to the nearest agent; "one_to_one": of
            the assignment of one agent to each target with the smallest sum, so that an agent which is nearest to
            no target has somewhere to go. Metrics stay the same. [MPE: nearest; one_to_one is for training]
        agent_collision_penalty: Price of one contact with an agent, for each of the two. [MPE: 1]
        obstacle_collision_penalty: Price of one contact with an obstacle. [our choice: 1]
        placement: "separated": agents and obstacles do not overlap, and every target leaves room for an agent
            beside obstacles and agents on other targets, so that the task can be solved; an agent may start
            on a target. "mpe": uniform without any check; most layouts of 6 and 9 agents then cannot be
            solved. [our choice: separated]
        clearance: Extra room between bodies for "separated". [our choice: 0.02]
        agent_range: Agents and targets start uniformly in [-agent_range, agent_range]^2. [MPE: 1]
        obstacle_range: The same for obstacles. [MPE: 0.9]
        accel: Force at full action. [MPE: 5]
        max_speed: Speed limit, None for none. [our choice: 1; MPE has none, and agents reach speed 4 and fly
            through obstacles]
        horizon: Steps per episode. [paper: 100]
        action_mode: "mpe", "force" or "discrete", see `ScenarioOptions`. [MPE: mpe]
        physics: "mpe" or "solid". [MPE: mpe]
        integrator: "semi_implicit" or "explicit". [MPE: semi_implicit]
        terminate_on_success: End as soon as all targets are covered. [paper: False]
        state: "observations" or "world". [paper: observations]

    Deviations from MPE's simple_spread: obstacles, the speed limit and separated starts (above); an agent
    does not collide with itself; observations hold no empty communication channels.
    """

    options_class = SpreadOptions

    def __init__(self, /, **options: Any) -> None:
        super().__init__(**options)
        o, n, m = self.options, self.options.num_agents, self.options.num_obstacles
        agents, obstacles, targets = range(n), range(n, n + m), range(n + m, 2 * n + m)
        self._placement = Placement(
            names=self._names,
            half_width=[o.agent_range] * n + [o.obstacle_range] * m + [o.agent_range] * n,
            room=[o.agent_radius] * n + [o.obstacle_radius] * m + [o.agent_radius] * n,
            clearance=o.clearance,
            exclusive=[[*agents, *obstacles], [*obstacles, *targets]] if o.placement == "separated" else [],
        )

    def resized(self, num_agents: int) -> dict[str, Any]:
        """Return the options for another team: obstacles in proportion, and room, so that it is never more crowded.

        The limit is nine agents of radius 0.15 in the usual room, so `spread-3a` resized to six and nine agents is
        `spread-6a` and `spread-9a`.
        """
        o = self.options
        room = max(o.agent_range, o.agent_radius / 0.15 * np.sqrt(num_agents / 9))
        return {
            "num_agents": num_agents,
            "num_obstacles": round(o.num_obstacles * num_agents / o.num_agents),
            "agent_range": float(room),
            "obstacle_range": float(o.obstacle_range * room / o.agent_range),
        }

    def bodies(self) -> Sequence[Bodies]:
        """Return agents, obstacles, targets."""
        return self._make_bodies(self.options.num_obstacles)

    def place(self, rngs: Sequence[Generator]) -> FloatArray:
        """Return random positions, see `placement`."""
        return self._placement.sample(rngs)

    def view(self) -> tuple[float, float]:
        """Return what pictures show: where everything starts, and half a unit around it."""
        half = max(self.options.agent_range, self.options.obstacle_range) + 0.5
        return half, half

    def heuristic(self, world: World) -> FloatArray:
        """Steer every agent to a target of its own, around everything else."""
        targets = world.index["target"]
        goal = assign(world.distance[..., targets])
        aim = world.offset[:, :, targets][np.arange(world.num_envs)[:, None], np.arange(goal.shape[1]), goal]
        return thrust(world, steer(world, aim))
