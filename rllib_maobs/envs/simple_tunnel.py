"""Simple Tunnel: pass a narrow gap between walls, everybody to a target of their own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from rllib_maobs.envs.coverage import MOST, TARGET_RADIUS, NonNegative, Positive, others, share_rewards
from rllib_maobs.envs.placement import FixedLayout
from rllib_maobs.envs.scenario import Outcome, Scenario
from rllib_maobs.envs.steering import take_turns, thrust
from rllib_maobs.envs.tunnel import GapOptions, check_gap, column, gap_obstacles
from rllib_maobs.envs.world import Bodies, FloatArray, Wall, World
from rllib_maobs.layout import Entities, Layout, split
from rllib_maobs.options import Range


@dataclass(frozen=True)
class SimpleTunnelOptions(GapOptions):
    """Options of `SimpleTunnel`, documented there."""

    reward_mode: Literal["sum", "mean", "individual"] = "individual"
    num_columns: Annotated[int, Range(1, MOST)] = 1
    column_spacing: Annotated[float, Positive] = 0.25
    wall_x: Annotated[float, Positive] = 1.4
    wall_y: Annotated[float, Positive] = 1.0
    wall_collision_penalty: Annotated[float, NonNegative] = 1.0


class SimpleTunnel(Scenario[SimpleTunnelOptions]):
    """N agents pass the gap between two large obstacles in a walled room, each to its own target.

    Ids `simple-tunnel` (3 agents) and `simple-tunnel-6a` (6). Everything starts at the same place in every episode:
    two circles of radius 1 at (0, 1.125) and (0, -1.125), walls at x = -1.4 and 1.4 and y = -1 and 1. Three agents
    start at (-1; 0.3, 0, -0.3), and agent i has the target of the same height at x = 1. Six agents start in two
    columns, at x = -0.95 (agents 0 to 2) and x = -1.2 (agents 3 to 5); those in front have the targets of the same
    height at x = 1.2, those behind at x = 0.95, so nobody is in the way of those that follow.

    **Observation** of agent i, Box(-inf, inf, (O,), float32) with O = 4 + 2 + 4 + 2(N - 1): 14, 20. Own velocity
    (2), own position (2), then relative to the agent: its target (2), the centres of the two obstacles (4), the
    other agents in the order of their ids (2(N - 1)). Walls are not observed: the own position tells where they are.

    **Action**: see `action_mode`; Box(-1, 1, (5,), float32) by default.

    **State**: "observations", N * O numbers (42, 120), or "world", a row for each body: position (2) and
    velocity (2) of the agents, then position (2) of obstacles and targets, 2(3N + 2) (22, 40).

    **Reward**: r_i = - distance of agent i to its target - A_i - O_i - W_i, where A_i, O_i and W_i count the
    agents, obstacles and walls that touch agent i after the step.

    **Episode**: `horizon` steps, then truncated for all; see `terminate_on_success`.

    **Metrics** beside those of every scenario (see `EpisodeTracker`): `success_agent_0`, ... (1 if that agent is
    within `goal_radius` of its target at the end), `coverage` (share of the agents that are), `coverage_mean` (mean
    over the steps), `all_covered` and `all_covered_mean` (1 where all are), `target_distance` (mean over the steps
    of the sum over agents of the distance to the own target). Success means that all agents are at their targets.

    **Reference returns** of `simple-tunnel` / `simple-tunnel-6a`, mean over the agents: uniformly random actions -227 /
    -241 (200 episodes, seeds 0 to 199). The heuristic (queue, pass one after the other) -32 / -53, of agent 0 -33 /
    -38; everybody is at the target from step 34 / 51 on, without a contact.

    Args:
        num_agents: N agents and as many targets; a multiple of `num_columns`. [paper: 3, 6]
        agent_radius: [our choice: 0.075]
        obstacle_radius: [our choice: 1]
        goal_radius: How near an agent must be to its target. [our choice: 0.1]
        reward_mode: "individual" (r_i), "sum" (everybody gets sum_i r_i) or "mean". [paper: individual]
        agent_collision_penalty: Price of one contact with an agent, for each of the two. [our choice: 1]
        obstacle_collision_penalty: Price of one contact with an obstacle. [our choice: 1]
        accel: Force at full action. [MPE: 5]
        max_speed: Speed limit, None for none. [our choice: 1; MPE has none]
        gap: Free distance between the two obstacles. [our choice: 0.25]
        start_distance: Distance of the front column of agents from the gap. [our choice: 1; 0.95 with 6 agents]
        target_distance: Distance of the near column of targets from the gap. [our choice: 1; 0.95 with 6 agents]
        spacing: Distance of neighbours in a column. [our choice: 0.3]
        start_noise: Agents start uniformly within this distance of their place, along x and along y; those that would
            overlap are drawn again. [our choice: 0, as in the paper]
        num_columns: Columns in which agents and targets stand. [our choice: 1; 2 with 6 agents]
        column_spacing: Distance of the columns. [our choice: 0.25]
        wall_x: Walls stand at -wall_x and wall_x. [our choice: 1.4]
        wall_y: Walls stand at -wall_y and wall_y. [our choice: 1]
        wall_collision_penalty: Price of one contact with a wall. [our choice: 1]
        horizon: Steps per episode. [paper: 100]
        action_mode: "mpe", "force" or "discrete", see `ScenarioOptions`. [MPE: mpe]
        physics: "mpe" or "solid". [MPE: mpe]
        integrator: "semi_implicit" or "explicit". [MPE: semi_implicit]
        terminate_on_success: End as soon as all agents are at their targets. [paper: False]
        state: "observations" or "world". [paper: observations]

    The task is not part of MPE; physics and actions are MPE's. Walls push back like other bodies do, and no body's
    centre passes one at any speed.
    """

    options_class = SimpleTunnelOptions
    own_targets = True

    def __init__(self, /, **options: Any) -> None:
        super().__init__(**options)
        o, n, columns = self.options, self.options.num_agents, self.options.num_columns
        if n % columns:
            raise ValueError(f"SimpleTunnel: num_agents={n} is no multiple of num_columns={columns}")
        check_gap(o.gap, o.agent_radius, o.obstacle_radius)
        rank = np.repeat(np.arange(columns), n // columns)  # 0 for the agents in front
        y = np.tile(column(n // columns, o.spacing), columns)
        starts = np.stack([-o.start_distance - rank * o.column_spacing, y], axis=1)
        targets = np.stack([o.target_distance + (columns - 1 - rank) * o.column_spacing, y], axis=1)
        agents, obstacles = list(range(n)), [n, n + 1]
        names = [f"{group.name}_{i}" for group in self.bodies() for i in range(group.count)]
        self._layout = FixedLayout(
            names,
            position=[*starts, *gap_obstacles(o.gap, o.obstacle_radius), *targets],
            room=[o.agent_radius] * n + [o.obstacle_radius] * 2 + [o.agent_radius] * n,
            exclusive=[agents + obstacles, obstacles + list(range(n + 2, 2 * n + 2))],
            noise=o.start_noise,
            num_noisy=n,
        )
        self._check_walls(names[:n], starts, o.agent_radius + o.start_noise)
        self._check_walls(names[n + 2 :], targets, o.agent_radius)
        self._observation_layout = (
            Entities("self", 1, 4),
            Entities("target", 1, 2, position=2),
            Entities("obstacle", 2, 2, position=2),
            Entities("agent", n - 1, 2, position=2),
        )
        self._others = others(n, len(names))

    def bodies(self) -> Sequence[Bodies]:
        """Return agents, the two obstacles, targets."""
        o = self.options
        return [
            Bodies("agent", o.num_agents, o.agent_radius, movable=True, accel=o.accel, max_speed=o.max_speed),
            Bodies("obstacle", 2, o.obstacle_radius),
            Bodies("target", o.num_agents, TARGET_RADIUS, collides=False),
        ]

    def walls(self) -> Sequence[Wall]:
        """Return the four walls of the room."""
        o = self.options
        x, y = o.wall_x, o.wall_y
        return [Wall((1.0, 0.0), x), Wall((-1.0, 0.0), x), Wall((0.0, 1.0), y), Wall((0.0, -1.0), y)]

    def metric_reductions(self) -> Mapping[str, str]:
        """Return the metrics of the class docstring."""
        return {
            **{f"success_agent_{i}": "last" for i in range(self.options.num_agents)},
            "coverage": "last",
            "coverage_mean": "mean",
            "all_covered": "last",
            "all_covered_mean": "mean",
            "target_distance": "mean",
        }

    def place(self, rngs: Sequence[Generator]) -> FloatArray:
        """Return the start positions."""
        return self._layout.sample(rngs)

    @property
    def observation_layout(self) -> Layout:
        """Own velocity and position, then offsets of the own target, obstacles, other agents."""
        return self._observation_layout

    def observe(self, world: World, out: NDArray[np.float32]) -> None:
        """Write velocity and position, own target, obstacles, other agents."""
        e, n, offset = world.num_envs, self.options.num_agents, world.offset
        parts = split(self._observation_layout, out)
        parts["self"][:, :, 0, 0:2] = world.velocity[:, :n]
        parts["self"][:, :, 0, 2:4] = world.position[:, :n]
        parts["target"][:, :, 0] = self._own_target(world)
        parts["obstacle"][...] = offset[:, :, world.index["obstacle"]]
        parts["agent"][...] = offset.reshape(e, -1, 2).take(self._others, axis=1).reshape(e, n, n - 1, 2)

    def outcome(self, world: World) -> Outcome:
        """Return the reward of the class docstring and who is at the own target."""
        o, n = self.options, self.options.num_agents
        distance = world.distance[:, range(n), range(n + 2, 2 * n + 2)]  # (E, N)
        rewards = -distance - o.agent_collision_penalty * world.contacts("agent")
        rewards -= o.obstacle_collision_penalty * world.contacts("obstacle")
        rewards -= o.wall_collision_penalty * world.wall_contacts()
        there = distance < o.goal_radius
        share, everybody = there.mean(axis=1), np.asarray(there.all(axis=1))
        metrics = {
            **{f"success_agent_{i}": there[:, i] for i in range(n)},
            "coverage": share,
            "coverage_mean": share,
            "all_covered": everybody,
            "all_covered_mean": everybody,
            "target_distance": distance.sum(axis=1),
        }
        return Outcome(share_rewards(rewards, o.reward_mode), everybody, metrics)

    def view(self) -> tuple[float, float]:
        """Return what pictures show: the room."""
        return self.options.wall_x + 0.1, self.options.wall_y + 0.1

    def heuristic(self, world: World) -> FloatArray:
        """Queue for the gap, pass it one by one, and go to the own target behind it."""
        return thrust(world, take_turns(world, self._own_target(world)))

    def _own_target(self, world: World) -> FloatArray:
        n = self.options.num_agents
        return world.offset[:, range(n), range(n + 2, 2 * n + 2)]

    def _check_walls(self, names: Sequence[str], position: FloatArray, room: float) -> None:
        missing = np.abs(position) + room - np.array([self.options.wall_x, self.options.wall_y])
        if (missing > 1e-9).any():
            body, axis = divmod(int(missing.argmax()), 2)
            raise ValueError(
                f"{names[body]} does not fit in the room: {missing[body, axis]:.3f} is missing along {'xy'[axis]}; "
                f"move the walls, or place the body nearer to the gap"
            )
