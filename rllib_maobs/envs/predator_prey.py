"""Obstacle predator-prey: catch a faster prey among obstacles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from rllib_maobs.envs.coverage import MOST, NonNegative, Positive, others
from rllib_maobs.envs.placement import Placement
from rllib_maobs.envs.scenario import Outcome, Scenario, ScenarioOptions
from rllib_maobs.envs.steering import steer, thrust
from rllib_maobs.envs.world import Bodies, FloatArray, World
from rllib_maobs.layout import Entities, Layout, split
from rllib_maobs.options import Range


@dataclass(frozen=True)
class PredatorPreyOptions(ScenarioOptions):
    """Options of `PredatorPrey`, documented there."""

    num_predators: Annotated[int, Range(1, MOST)] = 3
    num_obstacles: Annotated[int, Range(0, MOST)] = 2
    prey: Literal["random", "flee", "learned"] = "random"
    predator_radius: Annotated[float, Positive] = 0.075
    prey_radius: Annotated[float, Positive] = 0.05
    obstacle_radius: Annotated[float, Positive] = 0.2
    capture_reward: Annotated[float, NonNegative] = 10.0
    shaping: Annotated[float, NonNegative] = 0.0
    agent_collision_penalty: Annotated[float, NonNegative] = 1.0
    obstacle_collision_penalty: Annotated[float, NonNegative] = 1.0
    placement: Literal["separated", "mpe"] = "separated"
    clearance: Annotated[float, NonNegative] = 0.02
    agent_range: Annotated[float, Positive] = 1.0
    obstacle_range: Annotated[float, Positive] = 0.9
    prey_range: Annotated[float, Positive] = 1.0
    predator_accel: Annotated[float, Positive] = 3.0
    predator_max_speed: Annotated[float, Positive] | None = 1.0
    prey_accel: Annotated[float, Positive] = 4.0
    prey_max_speed: Annotated[float, Positive] | None = 1.3


class PredatorPrey(Scenario[PredatorPreyOptions]):
    """N predators catch one prey, which is smaller and faster, among M obstacles.

    Id `obstacle-predator-prey`: 3 predators, 2 obstacles. The agents are `predator_0`, ...; the prey is part of the
    environment, or with `prey="learned"` the last agent, `prey_0`.

    **Observation** of a predator, Box(-inf, inf, (O,), float32) with O = 4 + 2M + 2(N - 1) + 4 = 16. Own velocity
    (2), own position (2), then relative to the predator: the obstacles (2M), the other predators in the order of
    their ids (2(N - 1)), the prey (2); then the velocity of the prey (2). Of the learned prey, with O = 4 + 2M + 2N
    = 14: own velocity, own position, obstacles, predators.

    **Action**: see `action_mode`; Box(-1, 1, (5,), float32) by default.

    **State**: "observations", 48 numbers (62 with a learned prey), or "world", a row for each body:
    position (2) and velocity (2) of predators and prey, then position (2) of obstacles, 4(N + 1) + 2M = 20.

    **Reward**: every predator gets r = 10 C - P - O - shaping * D, where C counts the predators that touch the prey
    after the step, P the pairs of predators in contact, O the contacts of predators with obstacles, and D is the
    sum over predators of the distance to the prey. The learned prey gets -10 C + shaping * D - B, where B sums over
    both coordinates a price for being out of bounds: 0 up to |x| = 0.9, then 10 (|x| - 0.9), and beyond 1 the
    smaller of exp(2|x| - 2) and 10.

    **Episode**: `horizon` steps, then truncated for all; see `terminate_on_success`.

    **Metrics** beside those of every scenario (see `EpisodeTracker`), where collisions, path and clearance are those
    of the predators: `captures` (contacts of a predator with the prey, summed over predators and steps),
    `first_capture_step` (`horizon` if there is none), `prey_distance` (mean over predators and steps). Success means
    that the prey was caught at any time in the episode.

    **Reference returns** of one predator, mean over 200 episodes (seeds 0 to 199), with the prey `random` / `flee`:
    uniformly random actions 1 / -5; without the prices for collisions they would be 7 / 0. The heuristic (chase
    where the prey will be) 782 / 192; it catches the prey in every episode, first at step 8 / 15 on average. A
    fleeing prey is faster than the predators, so it is caught for moments, in corners.

    Args:
        num_predators: N. [paper, MPE: 3]
        num_obstacles: M. [MPE: 2]
        prey: What moves the prey. "random": a force drawn uniformly from [-1, 1]^2 in each step; "flee": at full
            thrust away from predators, obstacles and the border; "learned": an agent. [our choice: random]
        predator_radius: [MPE: 0.075]
        prey_radius: [MPE: 0.05]
        obstacle_radius: [MPE: 0.2]
        capture_reward: Reward of every predator for one contact of a predator with the prey. [MPE: 10]
        shaping: Price of the distances to the prey. [MPE: 0, and 0.1 for those who want it]
        agent_collision_penalty: Price of one contact of two predators. [our choice: 1]
        obstacle_collision_penalty: Price of one contact of a predator with an obstacle. [our choice: 1]
        placement: "separated": no two bodies overlap at the start; "mpe": no check. [our choice: separated]
        clearance: Extra room between bodies for "separated". [our choice: 0.02]
        agent_range: Predators and prey start uniformly in [-agent_range, agent_range]^2. [MPE: 1]
        obstacle_range: The same for obstacles. [MPE: 0.9]
        prey_range: A fleeing prey is held in [-prey_range, prey_range]^2; otherwise it would run for ever. [our
            choice: 1]
        predator_accel: Force at full action. [MPE: 3]
        predator_max_speed: Speed limit, None for none. [MPE: 1]
        prey_accel: Force of the prey at full action. [MPE: 4]
        prey_max_speed: Speed limit of the prey, None for none. [MPE: 1.3]
        horizon: Steps per episode. [paper: 100]
        action_mode: "mpe", "force" or "discrete", see `ScenarioOptions`. [MPE: mpe]
        physics: "mpe" or "solid". [MPE: mpe]
        integrator: "semi_implicit" or "explicit". [MPE: semi_implicit]
        terminate_on_success: End with the first capture. [paper: False]
        state: "observations" or "world". [paper: observations]

    Deviations from MPE's simple_tag: the prey is no agent unless asked for; predators pay for contacts with each
    other and with obstacles; bodies start apart; a fleeing prey cannot leave.
    """

    options_class = PredatorPreyOptions
    metrics: ClassVar[Mapping[str, str]] = {
        "success": "max",
        "captures": "sum",
        "first_capture_step": "first",
        "prey_distance": "mean",
    }

    def __init__(self, /, **options: Any) -> None:
        super().__init__(**options)
        o = self.options
        n, m = o.num_predators, o.num_obstacles
        num_bodies = n + 1 + m
        groups = self.bodies()
        self._placement = Placement(
            names=[f"{group.name}_{i}" for group in groups for i in range(group.count)],
            half_width=[o.agent_range] * (n + 1) + [o.obstacle_range] * m,
            room=[group.radius for group in groups for _ in range(group.count)],
            clearance=o.clearance,
            exclusive=[range(num_bodies)] if o.placement == "separated" else [],
        )
        common = Entities("self", 1, 4), Entities("obstacle", m, 2, position=2)
        prey = Entities("prey", 1, 4, position=2)
        self._predator_layout: Layout = (*common, Entities("predator", n - 1, 2, position=2), prey)
        self._prey_layout: Layout = (*common, Entities("predator", n, 2, position=2))
        self._others = others(n, num_bodies)

    def resized(self, num_agents: int) -> dict[str, Any]:
        """Return the options for another number of predators; a learned prey is one of the agents."""
        return {"num_predators": num_agents - (self.options.prey == "learned")}

    def bodies(self) -> Sequence[Bodies]:
        """Return predators, prey, obstacles."""
        o = self.options
        speed, accel, limit = o.predator_max_speed, o.predator_accel, o.prey_range if o.prey == "flee" else None
        return [
            Bodies("predator", o.num_predators, o.predator_radius, movable=True, accel=accel, max_speed=speed),
            Bodies("prey", 1, o.prey_radius, True, accel=o.prey_accel, max_speed=o.prey_max_speed, limit=limit),
            Bodies("obstacle", o.num_obstacles, o.obstacle_radius),
        ]

    def agent_groups(self) -> Sequence[str]:
        """Return the predators, and the prey if it is learned."""
        return ["predator", "prey"] if self.options.prey == "learned" else ["predator"]

    def place(self, rngs: Sequence[Generator]) -> FloatArray:
        """Return random positions, see `placement`."""
        return self._placement.sample(rngs)

    @property
    def observation_layout(self) -> Layout:
        """What a predator's observation is made of; a row of the prey is its offset and its velocity."""
        return self._predator_layout

    @property
    def observation_layouts(self) -> Sequence[Layout]:
        """What every agent's observation is made of."""
        return ([self._predator_layout] * self.options.num_predators + [self._prey_layout])[: len(self.agents)]

    @property
    def shared_reward(self) -> bool:
        """Predators share theirs; a learned prey is paid for the opposite."""
        return self.options.prey != "learned"

    def observe(self, world: World, out: NDArray[np.float32]) -> None:
        """Write velocity and position, obstacles, other predators, and for predators the prey."""
        e, n, agents, offset = world.num_envs, self.options.num_predators, len(self.agents), world.offset
        parts = split(self._predator_layout, out)  # a learned prey's observation begins like a predator's
        parts["self"][:, :, 0, 0:2] = world.velocity[:, :agents]
        parts["self"][:, :, 0, 2:4] = world.position[:, :agents]
        parts["obstacle"][...] = offset[:, :agents, world.index["obstacle"]]
        parts["predator"][:, :n] = offset.reshape(e, -1, 2).take(self._others, axis=1).reshape(e, n, n - 1, 2)
        parts["prey"][:, :n, 0, 0:2] = offset[:, :n, n]
        parts["prey"][:, :n, 0, 2:4] = world.velocity[:, None, n]
        if agents > n:
            split(self._prey_layout, out[:, n])["predator"][...] = offset[:, n, :n]

    def outcome(self, world: World) -> Outcome:
        """Return the rewards of the class docstring, and captures."""
        o, n = self.options, self.options.num_predators
        captures = world.contacts("prey")[:, :n].sum(axis=1)
        distances = world.distance[:, :n, n]
        shaping = o.shaping * distances.sum(axis=1)
        reward = o.capture_reward * captures - shaping
        reward -= o.agent_collision_penalty * world.contacts("predator")[:, :n].sum(axis=1) / 2.0
        reward -= o.obstacle_collision_penalty * world.contacts("obstacle")[:, :n].sum(axis=1)
        rewards = np.repeat(reward[:, None], n, axis=1)
        if o.prey == "learned":
            prey = shaping - o.capture_reward * captures - _out_of_bounds(world.position[:, n]).sum(axis=1)
            rewards = np.concatenate([rewards, prey[:, None]], axis=1)
        caught = captures > 0
        metrics = {"captures": captures, "first_capture_step": caught, "prey_distance": distances.mean(axis=1)}
        return Outcome(rewards, caught, metrics)

    def scripted_control(self, world: World, rngs: Sequence[Generator]) -> FloatArray:
        """Return (E, 1, 2), what moves a prey that is not learned."""
        if self.options.prey == "flee":
            return self._flee(world)
        control = np.empty((world.num_envs, 1, 2))
        for e, rng in enumerate(rngs):
            rng.random(out=control[e])
        return 2.0 * control - 1.0

    def view(self) -> tuple[float, float]:
        """Return what pictures show: where everything starts, and half a unit around it."""
        half = max(self.options.agent_range, self.options.obstacle_range) + 0.5
        return half, half

    def heuristic(self, world: World) -> FloatArray:
        """Chase the point where the prey will be, around obstacles; a learned prey flees."""
        n = self.options.num_predators
        distance = world.distance[:, :n, n, None]
        lead = np.minimum(distance, 0.5) * world.velocity[:, None, n]
        control = thrust(world, steer(world, world.offset[:, :n, n] + lead, ignore="prey"))
        return np.concatenate([control, self._flee(world)], axis=1) if self.options.prey == "learned" else control

    def _flee(self, world: World) -> FloatArray:
        """Return (E, 1, 2), full thrust away from predators, obstacles and the border of `prey_range`."""
        o, n = self.options, self.options.num_predators
        away = -world.offset[:, n] / np.maximum(world.distance[:, n], 1e-6)[..., None]  # (E, K, 2)
        gap = np.maximum(world.distance[:, n] - world.radius - o.prey_radius, 0.02)
        weight = np.where(np.arange(world.num_bodies) <= n, 1.0 / gap, 0.05 / gap**2)
        weight[:, n] = 0.0
        edge = o.prey_range - np.abs(world.position[:, n])
        force = (weight[..., None] * away).sum(axis=1)
        force -= np.sign(world.position[:, n]) * 0.2 / np.maximum(edge, 0.05) ** 2
        return (force / np.maximum(np.abs(force).max(axis=1, keepdims=True), 1e-9))[:, None]


def _out_of_bounds(position: FloatArray) -> FloatArray:
    """Return MPE's price of each coordinate for leaving the arena."""
    x = np.abs(position)
    outside = np.minimum(np.exp(np.minimum(2.0 * x - 2.0, 5.0)), 10.0)
    return np.where(x < 0.9, 0.0, np.where(x < 1.0, 10.0 * (x - 0.9), outside))
