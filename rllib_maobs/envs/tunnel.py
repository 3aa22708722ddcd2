"""Tunnel: pass a narrow gap one after the other and cover the targets behind it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.random import Generator

from rllib_maobs.envs.coverage import Coverage, CoverageOptions, NonNegative, Positive, TargetOptions
from rllib_maobs.envs.placement import FixedLayout
from rllib_maobs.envs.steering import assign, take_turns, thrust
from rllib_maobs.envs.world import Bodies, FloatArray, World


@dataclass(frozen=True)
class GapOptions(TargetOptions):
    """Options of tasks with a gap between two obstacles, documented in these tasks."""

    agent_radius: Annotated[float, Positive] = 0.075
    obstacle_radius: Annotated[float, Positive] = 1.0
    gap: Annotated[float, Positive] = 0.25
    start_distance: Annotated[float, Positive] = 1.0
    target_distance: Annotated[float, Positive] = 1.0
    spacing: Annotated[float, Positive] = 0.3
    start_noise: Annotated[float, NonNegative] = 0.0


@dataclass(frozen=True)
class TunnelOptions(GapOptions, CoverageOptions):
    """Options of `Tunnel`, documented there."""


class Tunnel(Coverage[TunnelOptions]):
    """N agents pass the gap between two large obstacles and share the N targets behind it.

    Id `tunnel`. Everything starts at the same place in every episode: two circles of radius 1 at (0, 1.125) and
    (0, -1.125), the agents at (-1; 0.3, 0, -0.3), the targets at (1; 0.3, 0, -0.3). The gap of 0.25 lets one agent
    of diameter 0.15 through at a time. There is also a way round outside, of about 5.6 against 2.1: the gap is the
    best way, not the only one.

    **Observation** of agent i, Box(-inf, inf, (O,), float32) with O = 4 + 2N + 4 + 2(N - 1) = 18. Own velocity (2),
    own position (2), then relative to the agent: the targets (2N), the centres of the two obstacles (4), the other
    agents in the order of their ids (2(N - 1)).

    **Action**: see `action_mode`; Box(-1, 1, (5,), float32) by default.

    **State**: "observations", N * O = 54 numbers, or "world", a row for each body: position (2) and velocity (2) of
    the agents, then position (2) of obstacles and targets, 2(3N + 2) = 22.

    **Reward**: r_i = - sum over targets of the distance to the nearest agent - A_i - O_i, where A_i and O_i count
    the agents and obstacles that touch agent i after the step. With `reward_mode="sum"` every agent gets sum_i r_i.

    **Episode**: `horizon` steps, then truncated for all; see `terminate_on_success`.

    **Metrics** beside those of every scenario (see `EpisodeTracker`): those of `Spread`. Success means that all
    targets are covered.

    **Reference returns** of one agent: uniformly random actions -1718 (mean over 200 episodes, seeds 0 to 199). The
    heuristic (queue, pass one after the other, go to the nearest free target) -208; all targets are covered from
    step 34 on, without a contact. Keeping a safe distance in the queue costs it a few steps: bolder agents are done
    by step 27.

    Args:
        num_agents: N agents and as many targets. [paper: 3]
        agent_radius: [our choice: 0.075]
        obstacle_radius: [our choice: 1]
        goal_radius: How near an agent must be to cover a target. [MPE: 0.1]
        reward_mode: "sum" (MPE's collaborative reward), "mean" (the same, divided by N) or "individual" (r_i).
            [MPE: sum]
        matching: Which distances the reward counts. "nearest": of every target to the nearest agent; "one_to_one": of
            the assignment of one agent to each target with the smallest sum, so that an agent which is nearest to
            no target has somewhere to go. Metrics stay the same. [MPE: nearest; one_to_one is for training]
        agent_collision_penalty: Price of one contact with an agent, for each of the two. [MPE: 1]
        obstacle_collision_penalty: Price of one contact with an obstacle. [our choice: 1]
        accel: Force at full action. [MPE: 5]
        max_speed: Speed limit, None for none. [our choice: 1; MPE has none]
        gap: Free distance between the two obstacles. [our choice: 0.25]
        start_distance: Distance of the agents' start from the gap, along x. [our choice: 1]
        target_distance: Distance of the targets from the gap, along x. [our choice: 1]
        spacing: Distance of neighbours at the start, and of neighbouring targets. [our choice: 0.3]
        start_noise: Agents start uniformly within this distance of their place, along x and along y; those that would
            overlap are drawn again. [our choice: 0, as in the paper; with it, a policy must do more than replay one
            episode, and with much of it starts are explored on either side of the gap]
        horizon: Steps per episode. [paper: 100]
        action_mode: "mpe", "force" or "discrete", see `ScenarioOptions`. [MPE: mpe]
        physics: "mpe" or "solid". [MPE: mpe]
        integrator: "semi_implicit" or "explicit". [MPE: semi_implicit]
        terminate_on_success: End as soon as all targets are covered. [paper: False]
        state: "observations" or "world". [paper: observations]

    The task is not part of MPE; physics, actions and the form of the reward are MPE's.
    """

    options_class = TunnelOptions

    def __init__(self, /, **options: Any) -> None:
        super().__init__(**options)
        o, n = self.options, self.options.num_agents
        check_gap(o.gap, o.agent_radius, o.obstacle_radius)
        y = column(n, o.spacing)
        starts = np.stack([np.full(n, -o.start_distance), y], axis=1)
        targets = np.stack([np.full(n, o.target_distance), y], axis=1)
        agents, obstacles = list(range(n)), [n, n + 1]
        self._layout = FixedLayout(
            self._names,
            position=[*starts, *gap_obstacles(o.gap, o.obstacle_radius), *targets],
            room=[o.agent_radius] * n + [o.obstacle_radius] * 2 + [o.agent_radius] * n,
            exclusive=[agents + obstacles, obstacles + list(range(n + 2, 2 * n + 2))],
            noise=o.start_noise,
            num_noisy=n,
        )

    def bodies(self) -> Sequence[Bodies]:
        """Return agents, the two obstacles, targets."""
        return self._make_bodies(num_obstacles=2)

    def place(self, rngs: Sequence[Generator]) -> FloatArray:
        """Return the start positions."""
        return self._layout.sample(rngs)

    def view(self) -> tuple[float, float]:
        """Return what pictures show: the gap, and everything that starts beside it."""
        o = self.options
        half_width = max(o.start_distance, o.target_distance) + 0.4
        return half_width, max(0.7 * half_width, 0.5 * o.spacing * o.num_agents)

    def heuristic(self, world: World) -> FloatArray:
        """Queue for the gap, pass it one by one, and take the nearest free target behind it."""
        targets = world.index["target"]
        goal = assign(world.distance[..., targets])
        aim = world.offset[:, :, targets][np.arange(world.num_envs)[:, None], np.arange(goal.shape[1]), goal]
        return thrust(world, take_turns(world, aim))


def column(count: int, spacing: float) -> FloatArray:
    """Return the (count,) y of bodies above each other, the highest first, around y = 0."""
    return np.asarray(spacing * ((count - 1) / 2.0 - np.arange(count)), np.float64)


def gap_obstacles(gap: float, radius: float) -> FloatArray:
    """Return the (2, 2) centres of the circles above and below a gap at the origin."""
    return np.array([[0.0, radius + gap / 2.0], [0.0, -radius - gap / 2.0]])


def check_gap(gap: float, agent_radius: float, obstacle_radius: float) -> None:
    """Raise a ValueError if no agent fits through the gap."""
    missing = 2.0 * agent_radius - gap
    if missing >= 0.0:
        raise ValueError(
            f"agents of radius {agent_radius:g} do not fit through a gap of {gap:g} between obstacles of radius "
            f"{obstacle_radius:g}: more than {missing:.3f} is missing; use a wider gap or smaller agents"
        )
