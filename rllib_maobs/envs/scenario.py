"""What a task declares: bodies, start positions, observations, rewards and metrics."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar

import gymnasium as gym
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from rllib_maobs.envs.world import Bodies, FloatArray, Wall, World, checked_bodies
from rllib_maobs.layout import Entities, Layout, flat, layout_size, split
from rllib_maobs.options import Range, build_options

# Direction of each discrete action: idle, +x, -x, +y, -y.
_DIRECTIONS = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


@dataclass(frozen=True)
class ScenarioOptions:
    """Options that every scenario has.

    Args:
        horizon: Steps until an episode is truncated.
        action_mode: "mpe": Box(-1, 1, (5,)), the force is (a1 - a2, a3 - a4) and a0 is idle; "force": Box(-1,
            1, (2,)); "discrete": Discrete(5), idle, +x, -x, +y, -y.
        physics: "mpe", or "solid" (stiffer contacts, five substeps).
        integrator: "semi_implicit" (the original MPE), or "explicit" (as MPE2 has it, to compare).
        terminate_on_success: Whether an episode terminates as soon as the task is solved.
        state: What `state()` returns by default: "observations" (all agents' observations in a row) or
            "world" (a row for each body: position and velocity of those that move, position of the others; see
            `Scenario.state_layout`).
    """

    horizon: Annotated[int, Range(1)] = 100
    action_mode: Literal["mpe", "force", "discrete"] = "mpe"
    physics: Literal["mpe", "solid"] = "mpe"
    integrator: Literal["semi_implicit", "explicit"] = "semi_implicit"
    terminate_on_success: bool = False
    state: Literal["observations", "world"] = "observations"


@dataclass(frozen=True)
class Outcome:
    """What a step brought, in every copy.

    Args:
        rewards: (E, N).
        success: (E,) bool, whether the task is solved now.
        metrics: (E,) values by name; the names and how they are reduced over the episode are those of
            `Scenario.metrics`.
    """

    rewards: FloatArray
    success: NDArray[np.bool_]
    metrics: dict[str, NDArray[Any]] = field(default_factory=dict)


OptionsT = TypeVar("OptionsT", bound=ScenarioOptions)


class Scenario(ABC, Generic[OptionsT]):
    """Base of all tasks: subclass it and `register_scenario` (or pass the class itself to the environments).

    A scenario holds options, never episode state: it describes E copies at once, and all its arrays have E
    first.

    What an agent observes is described by groups of entities, `Entities(name, count, size, position)`, in the order of
    the numbers: `count` alike things with `size` numbers each, of which the first `position` are an offset from the
    observer. The agent's own numbers come first, as the group "self"; others are called after what they are, in the
    singular ("target", "obstacle", "agent"). Networks that treat alike things alike read this; an MLP needs only the
    length. `split` cuts arrays into the groups, to write them by name.

    Example: meet at the origin without touching each other.

    ```python
    from dataclasses import dataclass

    import numpy as np

    import rllib_maobs as maobs
    from rllib_maobs.envs import Bodies, Entities, Outcome, ScenarioOptions, split


    @dataclass(frozen=True)
    class HomeOptions(ScenarioOptions):
        num_agents: int = 2
        penalty: float = 1.0


    class Home(maobs.Scenario[HomeOptions]):
        options_class = HomeOptions
        metrics = {"distance": "mean"}  # the mean over the steps of an episode

        def bodies(self):
            return [Bodies("agent", self.options.num_agents, radius=0.1, movable=True, accel=5.0, max_speed=1.0)]

        def place(self, rngs):  # one generator per copy: (E, K, 2)
            return np.stack([rng.uniform(-1, 1, (self.options.num_agents, 2)) for rng in rngs])

        @property
        def observation_layout(self):  # O = 4 + 2(N - 1) numbers
            return Entities("self", 1, 4), Entities("agent", self.options.num_agents - 1, 2, position=2)

        def observe(self, world, out):  # out: (E, N, O)
            n = self.options.num_agents
            parts = split(self.observation_layout, out)  # views: (E, N, 1, 4) and (E, N, N - 1, 2)
            parts["self"][..., 0, 0:2] = world.velocity
            parts["self"][..., 0, 2:4] = world.position
            parts["agent"][...] = world.offset[:, ~np.eye(n, dtype=bool)].reshape(-1, n, n - 1, 2)

        def outcome(self, world):
            distance = np.linalg.norm(world.position, axis=-1)  # (E, N)
            rewards = -distance - self.options.penalty * world.contacts("agent")
            return Outcome(rewards, (distance < 0.3).all(axis=1), {"distance": distance.mean(axis=1)})

        def heuristic(self, world):  # optional: forces in [-1, 1]
            return np.clip(-2.0 * world.position - world.velocity, -1.0, 1.0)


    env = maobs.make_vec(Home, num_envs=8, num_agents=4)  # or parallel_env(Home), or MAObsEnv({"scenario": Home})
    observations, _ = env.reset(seed=0)
    observations, rewards, terminated, truncated, info = env.step(env.heuristic())

    config = (
        maobs.MADDPGLConfig()
        .environment(maobs.MAObsEnv, env_config={"scenario": Home, "num_agents": 3})
        .training(updates_per_env_step=0.1)
    )
    algo = config.build_algo()
    results = algo.train()
    print(results["env_runners"]["episode_metrics"]["distance"])
    algo.stop()
    ```

    An id of its own, such as "home", comes from `register_scenario("home", Home)`. Type hints like
    `Annotated[int, Range(1)]` in the options make illegal values an error.

    Attributes:
        options_class: The frozen dataclass of the options.
        metrics: How each metric of `outcome` becomes one number per episode: "last" (value at the end),
            "mean", "sum", "min" or "max" over the steps, "first" (first step at which it is true, the horizon
            if it never is). An entry for one of `EpisodeTracker`'s own names replaces how that one is reduced.
        own_targets: Whether target i belongs to agent i, for pictures.
        options: The options of this instance.
        agents: Ids of the N agents.

    Args:
        **options: Fields of `options_class`; an unknown name or illegal value is a ValueError that names what
            is legal.
    """

    options_class: ClassVar[type[ScenarioOptions]] = ScenarioOptions
    own_targets: ClassVar[bool] = False
    metrics: ClassVar[Mapping[str, str]] = {}

    def __init__(self, /, **options: Any) -> None:
        owner = type(self).__name__
        if not self._overrides("observation_layout") and not self._overrides("observation_size"):
            raise TypeError(f"{owner} does not say what its agents observe: override Scenario.observation_layout")
        self.options: OptionsT = build_options(self.options_class, options, owner)  # type: ignore[assignment]
        bodies = checked_bodies(self.bodies(), owner)
        acting, names = list(self.agent_groups()), [group.name for group in bodies]
        self.agents = [f"{g.name}_{i}" for g in bodies if g.name in acting for i in range(g.count)]
        if acting != names[: len(acting)] or not self.agents:
            raise ValueError(f"{owner}: groups {acting} of {names} act; legal: the first ones, with one agent at least")

    def __repr__(self) -> str:
        options = ", ".join(f"{name}={value!r}" for name, value in asdict(self.options).items())
        return f"{type(self).__name__}({options})"

    def resized(self, num_agents: int) -> dict[str, Any]:
        """Return the options of this task for a team of another size.

        A scenario where obstacles or room go with the size of the team overrides this.

        Args:
            num_agents: N.

        Raises:
            ValueError: If the scenario has no option num_agents.
        """
        if not hasattr(self.options, "num_agents"):
            raise ValueError(f"{type(self).__name__} has teams of one size: it has no option num_agents")
        return {"num_agents": num_agents}

    @abstractmethod
    def bodies(self) -> Sequence[Bodies]:
        """Return the groups of bodies, in the order agents, scripted bodies, obstacles, targets.

        Metrics and pictures know the groups "obstacle" and "target" by these names.
        """

    def agent_groups(self) -> Sequence[str]:
        """Return the names of the groups that act: the first ones of `bodies`; by default the first alone.

        The first group is the team whose collisions, paths and clearance the metrics are about.
        """
        return [self.bodies()[0].name]

    @abstractmethod
    def place(self, rngs: Sequence[Generator]) -> FloatArray:
        """Return start positions; velocities start at zero.

        Args:
            rngs: One generator per copy to place; the layout of a copy is drawn from its own alone.

        Returns:
            (len(rngs), K, 2).
        """

    @property
    def observation_layout(self) -> Layout:
        """What one agent's observation is made of; that of the longest one where they differ.

        Override this. A scenario that overrides `observation_size` instead has one group without a meaning.
        """
        return flat(self.observation_size, "observation")

    @property
    def observation_layouts(self) -> Sequence[Layout]:
        """What each agent's observation is made of, by default the same for all; override it where they differ."""
        if self._overrides("observation_sizes"):
            return [flat(size, "observation") for size in self.observation_sizes]
        return [self.observation_layout] * len(self.agents)

    @property
    def observation_size(self) -> int:
        """O, the length of one agent's observation; of the longest one where they differ."""
        return layout_size(self.observation_layout)

    @property
    def observation_sizes(self) -> Sequence[int]:
        """Length of each agent's observation; shorter ones are padded with zeros to O in arrays (E, N, O)."""
        return [layout_size(layout) for layout in self.observation_layouts]

    @property
    def shared_reward(self) -> bool | None:
        """Whether all agents always get the same reward, which some algorithms need; None if that is not known.

        An option `reward_mode` tells; a scenario without one may say it here.
        """
        mode = getattr(self.options, "reward_mode", None)
        return None if mode is None else mode != "individual"

    @abstractmethod
    def observe(self, world: World, out: NDArray[np.float32]) -> None:
        """Write the observations of all agents.

        Args:
            world: The copies.
            out: (E, N, O), to be filled with each agent's numbers, by `observation_layouts`; the rest is padding.
                `split` gives the groups as arrays (E, N, count, size) to write to.
        """

    @abstractmethod
    def outcome(self, world: World) -> Outcome:
        """Return rewards, success and metrics of the situation after a step."""

    def heuristic(self, world: World) -> FloatArray:
        """Return what a hand-written policy would do: a baseline, and a proof that the task can be solved.

        It sees the whole world. Played by `VectorEnv.heuristic`.

        Args:
            world: The copies.

        Returns:
            (E, N, 2) directed force in units of a body's `accel`, each component in [-1, 1].

        Raises:
            NotImplementedError: If the scenario has none.
        """
        raise NotImplementedError(f"{type(self).__name__} has no heuristic policy: override Scenario.heuristic")

    def view(self) -> tuple[float, float]:
        """Return half the width and height of what pictures show, around the origin."""
        return 1.5, 1.5

    def metric_reductions(self) -> Mapping[str, str]:
        """Return `metrics`; override it where the names depend on options."""
        return self.metrics

    def walls(self) -> Sequence[Wall]:
        """Return the walls of the arena; none by default."""
        return ()

    @property
    def state_layout(self) -> Layout:
        """What the world state is made of: the groups of `bodies`, in their order, a row for each body.

        The rows of bodies that move are position (2) and velocity (2), those of the others position (2). So the first
        groups are the agents, one row each in the order of `agents`. A scenario that knows more about its world adds
        groups behind these, here and in `world_state`.
        """
        return tuple(Entities(group.name, group.count, 4 if group.movable else 2, 2) for group in self.bodies())

    def world_state_size(self) -> int:
        """S of the world state."""
        return layout_size(self.state_layout)

    def world_state(self, world: World) -> NDArray[np.float32]:
        """Return the (E, S) world state, see `state_layout`."""
        layout = self.state_layout
        state = np.zeros((world.num_envs, layout_size(layout)), np.float32)
        parts = split(layout, state)
        for group in world.groups:
            rows, bodies = parts[group.name], world.index[group.name]
            rows[..., 0:2] = world.position[:, bodies]
            if group.movable:
                rows[..., 2:4] = world.velocity[:, bodies]
        return state

    def make_world(self, num_envs: int) -> World:
        """Return the physics of E copies."""
        return World(num_envs, self.bodies(), self.walls(), self.options.physics, self.options.integrator)

    def action_space(self) -> gym.Space[Any]:
        """Return the action space of one agent; its size depends on `action_mode`."""
        if self.options.action_mode == "discrete":
            return gym.spaces.Discrete(5)
        return gym.spaces.Box(-1.0, 1.0, (5 if self.options.action_mode == "mpe" else 2,), np.float32)

    def control(self, actions: NDArray[Any]) -> FloatArray:
        """Turn legal actions into directed force in units of a body's `accel`.

        Args:
            actions: (E, N, A), or (E, N) integers for discrete actions. Continuous ones are clipped to [-1,
                1].

        Returns:
            (E, N, 2).
        """
        if self.options.action_mode == "discrete":
            return _DIRECTIONS[actions]
        clipped = np.clip(actions, -1.0, 1.0, dtype=np.float64)
        return clipped if self.options.action_mode == "force" else clipped[..., 1::2] - clipped[..., 2::2]

    def actions(self, control: FloatArray) -> NDArray[Any]:
        """Turn directed force into actions, the inverse of `control`.

        Args:
            control: (E, N, 2), components in [-1, 1].

        Returns:
            (E, N, A) float32; (E, N) integers for discrete actions: the direction of the larger component, or
            idle where none is above one half.
        """
        mode = self.options.action_mode
        if mode == "force":
            return control.astype(np.float32)
        if mode == "mpe":
            actions = np.zeros((*control.shape[:-1], 5), np.float32)
            actions[..., 1::2] = np.maximum(control, 0.0)
            actions[..., 2::2] = np.maximum(-control, 0.0)
            return actions
        axis = np.abs(control).argmax(axis=-1)
        strongest = np.take_along_axis(control, axis[..., None], axis=-1)[..., 0]
        return np.where(np.abs(strongest) > 0.5, 1 + 2 * axis + (strongest < 0.0), 0)

    def scripted_control(self, world: World, rngs: Sequence[Generator]) -> FloatArray:
        """Return (E, M - N, 2), the control of the movable bodies that are not agents.

        Args:
            world: The copies.
            rngs: One generator per copy.
        """
        return np.zeros((world.num_envs, world.num_movers - len(self.agents), 2))

    def _overrides(self, name: str) -> bool:
        return getattr(type(self), name) is not getattr(Scenario, name)
