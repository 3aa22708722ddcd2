"""Episodes for the page's player: where everybody was at every step, and who touched whom."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rllib_maobs.envs import VectorEnv, make_vec
from rllib_maobs.envs.rendering import FRAMES_PER_SECOND
from rllib_maobs.evaluate import Task
from rllib_maobs.experiment.report import SCORE
from rllib_maobs.policies import make_policy
from rllib_maobs.report.results import Trial

_DIGITS = 4  # of positions; the pictures are a few hundred pixels wide


def record_episode(task: Task, policy: str, seed: int = 0) -> dict[str, Any]:
    """Play one episode and note what a picture of each step shows.

    Args:
        task: The task.
        policy: See `make_policy`.
        seed: Of the episode.

    Returns:
        Plain values. `bodies`: `name`, `kind` (the group), `radius`, whether it `moves`, and `owner` of a target that
        belongs to an agent; `walls`: normal and offset of each; `view`: half of what the picture shows. For every step,
        the start included, `positions` [x, y, x, y, ...] of the bodies that move and the numbers of those in
        `contact`; `fixed` the positions of the others; `summary` says how it ended, and `fps` is the speed of its time.
    """
    env = make_vec(task.env, **task.options)
    player = make_policy(env, policy, seed)
    observations, _ = env.reset(seed=seed)
    positions, contact = [_positions(env, moving=True)], [_touching(env)]
    finished, info = False, dict[str, Any]()
    while not finished:
        observations, _, terminated, truncated, info = env.step(player(observations))
        positions.append(_positions(env, moving=True))
        contact.append(_touching(env))
        finished = bool(terminated[0] or truncated[0])
    world, scenario = env.world, env.scenario
    bodies = [
        {"name": f"{group.name} {i}", "kind": group.name, "radius": group.radius, "moves": group.movable}
        | ({"owner": i} if group.name == "target" and scenario.own_targets else {})
        for group in world.groups
        for i in range(group.count)
    ]
    for body in bodies:
        if body["kind"] == "target":
            body["radius"] = getattr(scenario.options, "goal_radius", body["radius"])
    return {
        "bodies": bodies,
        "walls": [[*wall.normal, wall.offset] for wall in world.walls],
        "view": [*scenario.view()],
        "fixed": _positions(env, moving=False),
        "positions": positions,
        "contact": contact,
        "summary": _summary({name: float(values[0]) for name, values in info["episode_metrics"].items()}),
        "fps": FRAMES_PER_SECOND,
    }


def best_and_median(trials: Sequence[Trial]) -> dict[str, Trial]:
    """Return the teams of one algorithm that are worth watching, by what they are called.

    Args:
        trials: Of the algorithm.

    Returns:
        The best one by its score, and the one in the middle; of an even number, the worse of the two there.
    """
    order = sorted(trials, key=lambda trial: trial.result[SCORE])
    best, median = order[-1], order[(len(order) - 1) // 2]
    if best is median:
        return {f"{best.label}, seed {best.settings['seed']}": best}
    return {
        f"{best.label}, best (seed {best.settings['seed']})": best,
        f"{median.label}, median (seed {median.settings['seed']})": median,
    }


def _summary(metrics: Mapping[str, float]) -> str:
    contacts = sum(value for name, value in metrics.items() if name.startswith("collisions_"))
    share = f", {metrics['coverage']:.0%} covered" if "coverage" in metrics else ""
    solved = f"solved at step {metrics['time_to_goal']:.0f}" if metrics["success"] else "not solved at the end"
    return f"score {metrics['return_agent_0']:,.1f}{share}, {solved}, {contacts:.0f} contacts"


def _positions(env: VectorEnv, *, moving: bool) -> list[float]:
    world = env.world
    bodies = slice(0, world.num_movers) if moving else slice(world.num_movers, None)
    return [float(number) for number in world.position[0, bodies].round(_DIGITS).ravel()]


def _touching(env: VectorEnv) -> list[int]:
    """Return the numbers of the bodies in contact now."""
    world = env.world
    world.refresh()
    touching = world.gap[0] < 0.0  # (M, C)
    found = np.zeros(world.num_bodies, bool)
    found[: world.num_movers] = touching.any(axis=1) | (world.wall_gap[0] < 0.0).any(axis=1)
    found[: touching.shape[1]] |= touching.any(axis=0)
    return np.flatnonzero(found).tolist()
