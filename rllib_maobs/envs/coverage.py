"""What the tasks with shared targets have in common: cover all targets, touch nobody."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from rllib_maobs.envs.scenario import Outcome, Scenario, ScenarioOptions
from rllib_maobs.envs.world import Bodies, FloatArray, World
from rllib_maobs.layout import Entities, Layout, split
from rllib_maobs.options import Range

# With larger numbers the physics would leave what single precision can tell.
Positive, NonNegative = Range(0.0, 1e6, exclusive=True), Range(0.0, 1e6)
MOST = 1000  # bodies of a kind; every pair of bodies takes some bytes in every copy
TARGET_RADIUS = 0.05  # targets touch nothing: for pictures alone


@dataclass(frozen=True)
class TargetOptions(ScenarioOptions):
    """Options of tasks with one target for every agent, documented in these tasks."""

    num_agents: Annotated[int, Range(1, MOST)] = 3
    agent_radius: Annotated[float, Positive] = 0.15
    obstacle_radius: Annotated[float, Positive] = 0.1
    goal_radius: Annotated[float, Positive] = 0.1
    reward_mode: Literal["sum", "mean", "individual"] = "sum"
    agent_collision_penalty: Annotated[float, NonNegative] = 1.0
    obstacle_collision_penalty: Annotated[float, NonNegative] = 1.0
    accel: Annotated[float, Positive] = 5.0
    max_speed: Annotated[float, Positive] | None = 1.0


@dataclass(frozen=True)
class CoverageOptions(TargetOptions):
    """Options of `Coverage`, documented in its subclasses."""

    matching: Literal["nearest", "one_to_one"] = "nearest"


OptionsT = TypeVar("OptionsT", bound=CoverageOptions)


class Coverage(Scenario[OptionsT]):
    """Base of tasks in which N agents share N targets among obstacles.

    Bodies are the groups "agent", "obstacle" and "target"; subclasses say how many obstacles there are and where
    everything starts. Observations, rewards and metrics are described in `Spread`.
    """

    options_class = CoverageOptions
    metrics: ClassVar[Mapping[str, str]] = {
        "coverage": "last",
        "coverage_mean": "mean",
        "all_covered": "last",
        "all_covered_mean": "mean",
        "target_distance": "mean",
    }

    def __init__(self, /, **options: Any) -> None:
        super().__init__(**options)
        groups = self.bodies()
        self._names = [f"{group.name}_{i}" for group in groups for i in range(group.count)]
        n, m = groups[0].count, groups[1].count
        self._observation_layout = (
            Entities("self", 1, 4),
            Entities("target", n, 2, position=2),
            Entities("obstacle", m, 2, position=2),
            Entities("agent", n - 1, 2, position=2),
        )
        self._others = others(n, len(self._names))

    def _make_bodies(self, num_obstacles: int) -> list[Bodies]:
        o = self.options
        return [
            Bodies("agent", o.num_agents, o.agent_radius, movable=True, accel=o.accel, max_speed=o.max_speed),
            Bodies("obstacle", num_obstacles, o.obstacle_radius),
            Bodies("target", o.num_agents, TARGET_RADIUS, collides=False),
        ]

    @property
    def observation_layout(self) -> Layout:
        """Own velocity and position, then offsets of targets, obstacles, other agents."""
        return self._observation_layout

    def observe(self, world: World, out: NDArray[np.float32]) -> None:
        """Write velocity and position, targets, obstacles, other agents."""
        e, n, offset = world.num_envs, self.options.num_agents, world.offset
        parts = split(self._observation_layout, out)
        parts["self"][:, :, 0, 0:2] = world.velocity[:, :n]
        parts["self"][:, :, 0, 2:4] = world.position[:, :n]
        parts["target"][...] = offset[:, :, world.index["target"]]
        parts["obstacle"][...] = offset[:, :, world.index["obstacle"]]
        parts["agent"][...] = offset.reshape(e, -1, 2).take(self._others, axis=1).reshape(e, n, n - 1, 2)

    def outcome(self, world: World) -> Outcome:
        """Return - sum over targets of the distance to the nearest agent - collisions, and the coverage."""
        o = self.options
        distance = world.distance[:, : o.num_agents, world.index["target"]]  # (E, N, N)
        nearest = distance.min(axis=1)  # (E, N)
        total = nearest.sum(axis=1)
        paid = total if o.matching == "nearest" else matched(distance).sum(axis=1)
        rewards = -paid[:, None] - o.agent_collision_penalty * world.contacts("agent")
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


def matched(distance: FloatArray) -> FloatArray:
    """Return the (E, N) distances of the agents to the targets of the one-to-one assignment with the smallest sum.

    Args:
        distance: (E, N, N), of each agent to each target.
    """
    targets = np.array([linear_sum_assignment(cost)[1] for cost in distance], np.intp)
    return np.take_along_axis(distance, targets[..., None], axis=2)[..., 0]


def others(num_agents: int, num_bodies: int) -> NDArray[np.intp]:
    """Return where the other agents of each agent stand in the flattened (N, K) pairs of an agent and a body.

    Args:
        num_agents: N.
        num_bodies: K.

    Returns:
        (N * (N - 1),) numbers, agent by agent.
    """
    agents = range(num_agents)
    return np.array([i * num_bodies + j for i in agents for j in agents if j != i], np.intp)


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
