"""Environment steps per second of the simulator beside MPE2, at the same number of agents, on one core.

Run: `OMP_NUM_THREADS=1 python tests/benchmarks/env_speed.py [--scenario spread-9a] [--seconds 2]`

All copies count: 64 copies stepped once are 64 environment steps. Observations, rewards, metrics and resets are
included. The two simulators take turns, so that a change in the load of the machine meets both; the best round counts.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
from mpe2 import simple_spread_v3

from rllib_maobs.envs import VectorEnv, make_vec

HORIZON = 100
COPIES = (1, 8, 64)
ROUNDS = 4


def vector_episode(env: VectorEnv, actions: np.ndarray) -> float:
    """Play one episode of every copy; returns the seconds spent in the reset."""
    start = time.perf_counter()
    env.reset()
    seconds = time.perf_counter() - start
    for step in actions:
        env.step(np.broadcast_to(step, (env.num_envs, *step.shape)))
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
    episodes, resets, start = 0, 0.0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        resets += episode()
        episodes += 1
    total = time.perf_counter() - start
    return episodes * HORIZON * copies / total, resets / total


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="spread-9a")
    parser.add_argument("--seconds", type=float, default=2.0, help="per row, over all rounds")
    args = parser.parse_args()

    n = len(make_vec(args.scenario).agents)
    actions = np.random.default_rng(0).uniform(0, 1, (HORIZON, n, 5)).astype(np.float32)
    theirs = simple_spread_v3.parallel_env(N=n, max_cycles=HORIZON, continuous_actions=True)
    rows: dict[str, tuple[int, Callable[[], float]]] = {"mpe2": (1, lambda: mpe2_episode(theirs, actions))}
    for copies in COPIES:
        env = make_vec(args.scenario, num_envs=copies)
        env.reset(seed=0)
        rows[f"{copies} copies"] = (copies, lambda env=env: vector_episode(env, actions))  # type: ignore[misc]

    best = dict.fromkeys(rows, (0.0, 0.0))
    for _ in range(ROUNDS):
        for name, (copies, episode) in rows.items():
            best[name] = max(best[name], measure(episode, copies, args.seconds / ROUNDS))

    print(f"{args.scenario} ({n} agents) beside mpe2 simple_spread (N={n}), episodes of {HORIZON} steps")
    print(f"{'':>10} {'env steps/s':>12} {'x mpe2':>8} {'us per env step':>16} {'in resets':>10}")
    for name, (speed, resets) in best.items():
        ratio = speed / best["mpe2"][0]
        print(f"{name:>10} {speed:12,.0f} {ratio:8.1f} {1e6 / speed:16.2f} {resets:10.1%}")


if __name__ == "__main__":
    main()
