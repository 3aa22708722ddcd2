"""Environment steps per second of the simulator beside MPE2, at the same number of agents, on one core.

Run: `OMP_NUM_THREADS=1 python tests/benchmarks/env_speed.py [--scenario spread-9a] [--seconds 2] [--profile]`

All copies count: 64 copies stepped once are 64 environment steps. Observations, rewards, metrics and resets are
included. The candidates take turns, so that a change in the load of the machine meets all of them; the best round
counts. Below the table: what an agent costs in a team three times as large, in a room of the same density, and with
`--profile` where the time goes.
"""

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from mpe2 import simple_spread_v3

sys.path.insert(0, str(Path(__file__).parents[2]))

from rllib_maobs.envs import MAObsParallelEnv, VectorEnv, make_vec, parallel_env
from tests.benchmarks.measure import count, in_turns

HORIZON = 100
COPIES = (1, 8, 64)
PROFILED = (1, 64, 1024)
ROUNDS = 4
Row = tuple[int, Callable[[], float]]


def vector_episode(env: VectorEnv, actions: np.ndarray) -> float:
    """Play one episode of every copy; returns the seconds spent in the reset."""
    start = time.perf_counter()
    env.reset()
    seconds = time.perf_counter() - start
    for step in actions:
        env.step(np.broadcast_to(step, (env.num_envs, *step.shape)))
    return seconds


def parallel_episode(env: MAObsParallelEnv, actions: np.ndarray) -> float:
    """Play one episode through the PettingZoo face; returns the seconds spent in the reset."""
    start = time.perf_counter()
    env.reset()
    seconds = time.perf_counter() - start
    for step in actions:
        env.step(dict(zip(env.agents, step, strict=True)))
    return seconds


def mpe2_episode(env: object, actions: np.ndarray) -> float:
    """Play one episode; returns the seconds spent in the reset."""
    start = time.perf_counter()
    env.reset()  # type: ignore[attr-defined]
    seconds = time.perf_counter() - start
    for step in actions:
        # MPE2 wants [0, 1], and has the opposite signs.
        env.step({f"agent_{i}": action for i, action in enumerate(step[:, [0, 2, 1, 4, 3]])})  # type: ignore[attr-defined]
    return seconds


def measure(episode: Callable[[], float], copies: int, seconds: float) -> tuple[float, float]:
    """Return environment steps per second and the share of time in resets."""
    resets = 0.0

    def work() -> int:
        nonlocal resets
        resets += episode()
        return HORIZON * copies

    played = count(work, seconds)
    return played.rate, resets / played.seconds


def take_turns(rows: dict[str, Row], seconds: float) -> dict[str, tuple[float, float]]:
    """Return the best round of each row: steps per second and the share of resets."""
    ways = {name: partial(measure, episode, copies, seconds / ROUNDS) for name, (copies, episode) in rows.items()}
    return {name: max(own) for name, own in in_turns(ways, ROUNDS).items()}


def vector_row(copies: int, actions: np.ndarray, scenario: str, **options: object) -> Row:
    """Return a row that plays E copies."""
    env = make_vec(scenario, num_envs=copies, **options)
    env.reset(seed=0)
    return copies, lambda: vector_episode(env, actions)


def compare_with_mpe2(scenario: str, seconds: float) -> None:
    """Print steps per second beside MPE2."""
    ours = parallel_env(scenario)
    n = len(ours.possible_agents)
    actions = np.random.default_rng(0).uniform(0, 1, (HORIZON, n, 5)).astype(np.float32)
    theirs = simple_spread_v3.parallel_env(N=n, max_cycles=HORIZON, continuous_actions=True)
    rows: dict[str, Row] = {
        "mpe2": (1, lambda: mpe2_episode(theirs, actions)),
        "PettingZoo face": (1, lambda: parallel_episode(ours, actions)),
        **{f"{copies} copies": vector_row(copies, actions, scenario) for copies in COPIES},
    }
    best = take_turns(rows, seconds)
    print(f"{scenario} ({n} agents) beside mpe2 simple_spread (N={n}), episodes of {HORIZON} steps")
    print(f"{'':>16} {'env steps/s':>12} {'x mpe2':>8} {'us per env step':>16} {'in resets':>10}")
    for name, (speed, resets) in best.items():
        ratio = speed / best["mpe2"][0]
        print(f"{name:>16} {speed:12,.0f} {ratio:8.1f} {1e6 / speed:16.2f} {resets:10.1%}")


def compare_team_sizes(seconds: float) -> None:
    """Print what an agent costs among 9 and among 27, with as much room for each."""
    rows = {}
    for n, factor in ((9, 1.0), (27, 3.0**0.5)):
        actions = np.random.default_rng(0).uniform(0, 1, (HORIZON, n, 5)).astype(np.float32)
        room = {"agent_range": factor, "obstacle_range": 0.9 * factor}
        rows[f"{n} agents"] = vector_row(64, actions, "spread-9a", num_agents=n, num_obstacles=2 * n // 3, **room)
    best = take_turns(rows, seconds)
    cost = {name: 1e6 / speed / int(name.split()[0]) for name, (speed, _) in best.items()}
    print("\nSpread, 64 copies, obstacles and room in proportion: time of one agent in one step")
    for name, microseconds in cost.items():
        print(f"{name:>16} {microseconds:8.2f} us, {best[name][1]:6.1%} in resets")
    print(f"{'ratio':>16} {cost['27 agents'] / cost['9 agents']:8.2f}")


def profile(scenario: str, seconds: float) -> None:
    """Print which share of the time the parts of a step take, with few and with many copies."""
    actions = np.random.default_rng(0).uniform(0, 1, (HORIZON, len(make_vec(scenario).agents), 5))
    shares: dict[int, dict[str, float]] = {}
    for copies in PROFILED:
        env = make_vec(scenario, num_envs=copies)
        spent: dict[str, float] = {}
        for part, owner, method in (
            ("resets", env, "reset"),
            ("distances, in the physics", env.world, "_measure"),
            ("contact forces, in the physics", env.world, "_add_contact_forces"),
            ("physics", env.world, "step"),
            ("rewards", env.scenario, "outcome"),
            ("metrics", env._tracker, "before_step"),
            ("metrics", env._tracker, "update"),
            ("observations", env, "observe"),
        ):
            setattr(owner, method, timed(getattr(owner, method), part, spent))
        start = time.perf_counter()
        while time.perf_counter() - start < seconds:
            vector_episode(env, actions)
        total = time.perf_counter() - start
        shares[copies] = {part: spent[part] / total for part in spent}
        inside = ("physics", "rewards", "metrics", "observations", "resets")
        shares[copies]["checks, actions, bookkeeping"] = 1.0 - sum(shares[copies][part] for part in inside)
    print(f"\n{scenario}: where the time goes{'':>6}" + "".join(f"{copies:>7} copies" for copies in PROFILED))
    for part in shares[PROFILED[0]]:
        print(f"{part:>34}" + "".join(f"{shares[copies][part]:14.0%}" for copies in PROFILED))


def timed(function: Callable[..., object], part: str, spent: dict[str, float]) -> Callable[..., object]:
    """Return the function with its seconds added up under the name of a part."""
    spent.setdefault(part, 0.0)

    def call(*args: object, **kwargs: object) -> object:
        start = time.perf_counter()
        result = function(*args, **kwargs)
        spent[part] += time.perf_counter() - start
        return result

    return call


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="spread-9a")
    parser.add_argument("--seconds", type=float, default=2.0, help="per row, over all rounds")
    parser.add_argument("--profile", action="store_true")
    args = parser.parse_args()
    compare_with_mpe2(args.scenario, args.seconds)
    compare_team_sizes(args.seconds)
    if args.profile:
        profile(args.scenario, args.seconds)


if __name__ == "__main__":
    main()
