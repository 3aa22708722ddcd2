"""Spread: cover all targets, touch nobody."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from rllib_maobs.envs.options import Range
from rllib_maobs.envs.placement import Placement
from rllib_maobs.envs.scenario import Outcome, Scenario, ScenarioOptions
from rllib_maobs.envs.world import Bodies, FloatArray, World

Positive = Range(0.0, exclusive=True)


@dataclass(frozen=True)
class SpreadOptions(ScenarioOptions):
    """Options of `Spread`, documented there."""

    num_agents: Annotated[int, Range(1)] = 3
    num_obstacles: Annotated[int, Range(0)] = 2
    agent_radius: Annotated[float, Positive] = 0.15
    obstacle_radius: Annotated[float, Positive] = 0.1
    goal_radius: Annotated[float, Positive] = 0.1
    reward_mode: Literal["sum", "mean", "individual"] = "sum"
    agent_collision_penalty: Annotated[float, Range(0.0)] = 1.0
    obstacle_collision_penalty: Annotated[float, Range(0.0)] = 1.0
    placement: Literal["separated", "mpe"] = "separated"
    clearance: Annotated[float, Range(0.0)] = 0.02
    agent_range: Annotated[float, Positive] = 1.0
    obstacle_range: Annotated[float, Positive] = 0.9
    accel: Annotated[float, Positive] = 5.0
    max_speed: Annotated[float, Positive] | None = 1.0


class Spread(Scenario[SpreadOptions]):
    """N agents share N targets among M obstacles: stay on all targets at once and collide with nothing.

    Ids `spread-3a`, `spread-6a`, `spread-9a`: N agents with M = 2, 4, 6 obstacles.

    **Observation** of agent i, Box(-inf, inf, (O,), float32) with O = 4 + 2N + 2M + 2(N - 1): 18, 34, 50. Own
    velocity (2), own position (2), then relative to the agent: the targets (2N), the obstacles (2M), the
    other agents in the order of their ids (2(N - 1)).

    **Action**: see `action_mode`; Box(-1, 1, (5,), float32) by default.

    **State**: "observations", N * O numbers (54, 204, 450), or "world", positions of all bodies (agents,
    obstacles, targets) and velocities of the agents, 2(3N + M) (22, 44, 66).

    **Reward**: r_i = - sum over targets of the distance to the nearest agent - A_i - O_i, where A_i and O_i
    count the agents and obstacles that touch agent i after the step. With `reward_mode="sum"` every agent
    gets sum_i r_i.

    **Episode**: `horizon` steps, then truncated for all; see `terminate_on_success`.

    **Metrics** beside those of every scenario (see `EpisodeTracker`): `coverage` (share of targets with an
    agent within `goal_radius`, at the end), `coverage_mean` (mean over the steps), `all_covered` and
    `all_covered_mean` (1 where all are covered), `target_distance` (mean over the steps of the sum over
    targets of the distance to the nearest agent). Success means that all targets are covered.

    Args:
        num_agents: N agents and as many targets. [paper: 3, 6, 9]
        num_obstacles: M. [our choice: 2, 4, 6]
        agent_radius: [MPE: 0.15]
        obstacle_radius: [our choice: 0.1]
        goal_radius: How near an agent must be to cover a target. [MPE: 0.1]
        reward_mode: "sum" (MPE's collaborative reward), "mean" (the same, divided by N) or "individual"
            (r_i). [MPE: sum]
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
    metrics: ClassVar[Mapping[str, str]] = {
        "coverage": "last",
        "coverage_mean": "mean",
        "all_covered": "last",
        "all_covered_mean": "mean",
        "target_distance": "mean",
    }

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        o, n, m = self.options, self.options.num_agents, self.options.num_obstacles
        agents, obstacles, targets = range(n), range(n, n + m), range(n + m, 2 * n + m)
        self._placement = Placement(
            names=[f"{group.name}_{i}" for group in self.bodies() for i in range(group.count)],
            half_width=[o.agent_range] * n + [o.obstacle_range] * m + [o.agent_range] * n,
            room=[o.agent_radius] * n + [o.obstacle_radius] * m + [o.agent_radius] * n,
            clearance=o.clearance,
            exclusive=[[*agents, *obstacles], [*obstacles, *targets]] if o.placement == "separated" else [],
        )
        # The other agents of each agent, in the N * K pairs of an agent and a body.
        num_bodies = 2 * n + m
        self._others = np.array([i * num_bodies + j for i in agents for j in agents if j != i], np.intp)

    def bodies(self) -> Sequence[Bodies]:
        """Return agents, obstacles, targets."""
        o = self.options
        return [
            Bodies("agent", o.num_agents, o.agent_radius, movable=True, accel=o.accel, max_speed=o.max_speed),
            Bodies("obstacle", o.num_obstacles, o.obstacle_radius),
            Bodies("target", o.num_agents, 0.05, collides=False),
        ]

    def place(self, rngs: Sequence[Generator]) -> FloatArray:
        """Return random positions, see `placement`."""
        return self._placement.sample(rngs)

    @property
    def observation_size(self) -> int:
        """O."""
        n, m = self.options.num_agents, self.options.num_obstacles
        return 4 + 2 * n + 2 * m + 2 * (n - 1)

    def observe(self, world: World, out: NDArray[np.float32]) -> None:
        """Write velocity, position, targets, obstacles, other agents."""
        n, m = self.options.num_agents, self.options.num_obstacles
        e = world.num_envs
        relative = world.offset.reshape(e, n, -1)  # (E, N, 2K)
        others = world.offset.reshape(e, -1, 2).take(self._others, axis=1)  # (E, N(N - 1), 2)
        out[..., 0:2] = world.velocity[:, :n]
        out[..., 2:4] = world.position[:, :n]
        out[..., 4 : 4 + 2 * n] = relative[..., 2 * (n + m) :]
        out[..., 4 + 2 * n : 4 + 2 * n + 2 * m] = relative[..., 2 * n : 2 * (n + m)]
        out[..., 4 + 2 * n + 2 * m :] = others.reshape(e, n, -1)

    def outcome(self, world: World) -> Outcome:
        """Return the reward of the class docstring and how well the targets are covered."""
        o = self.options
        nearest = world.distance[:, :, world.index["target"]].min(axis=1)  # (E, N)
        total = nearest.sum(axis=1)
        rewards = -total[:, None] - o.agent_collision_penalty * world.contacts("agent")
        rewards -= o.obstacle_collision_penalty * world.contacts("obstacle")
        covered = nearest < o.goal_radius
        coverage, all_covered = covered.mean(axis=1), covered.all(axis=1)
        metrics = {
            "coverage": coverage,
            "coverage_mean": coverage,
            "all_covered": all_covered,
            "all_covered_mean": all_covered,
            "target_distance": total,
        }
        return Outcome(share_rewards(rewards, o.reward_mode), all_covered, metrics)


def share_rewards(rewards: FloatArray, mode: Literal["sum", "mean", "individual"]) -> FloatArray:
    """Give every agent the sum or the mean of all agents' rewards, or its own.

    Args:
        rewards: (E, N) own rewards.
        mode: "sum", "mean" or "individual".

    Returns:
        (E, N).
    """
    if mode == "individual":
        return rewards
    shared = rewards.sum(axis=1, keepdims=True) if mode == "sum" else rewards.mean(axis=1, keepdims=True)
    return np.broadcast_to(shared, rewards.shape)
