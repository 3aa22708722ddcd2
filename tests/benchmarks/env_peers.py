"""The simulator beside VMAS and JaxMARL on the CPU, in turns, in one run.

Run: `python tests/benchmarks/env_peers.py [--agents 9] [--copies 64] [--seconds 4] [--venv DIR]`

The first run makes a virtual environment with both libraries (PyTorch and JAX come along: some gigabytes), by
default beside the system's other temporary files; later runs use it again. On Linux PyPI's PyTorch brings CUDA with
it; `PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu` gets the small build.

Every library plays Spread with N agents and N targets, continuous actions, episodes of 100 steps, one process at a
time on the same core; observations and rewards are computed. Ours is played without obstacles (the same task) and
with two thirds as many obstacles as agents (`spread-9a`), metrics included. JaxMARL is compiled: a step of all copies
per call, as a training loop with a policy outside of JAX calls it, and also 100 steps in one call, its best case.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.benchmarks.measure import count, in_turns
from tests.benchmarks.workers import Job, Worker, free_cores, python_with, same_torch

HORIZON = 100
ROUNDS = 4
PEERS = ["vmas==1.5.2", "jaxmarl==0.2.0", "jax==0.10.2", "jaxlib==0.10.2"]
Episode = Callable[[], None]


def our_episode(agents: int, copies: int, obstacles: int) -> Episode:
    """Return a function that plays one episode of our Spread."""
    import numpy as np

    from rllib_maobs.envs import make_vec

    env = make_vec("spread-9a", num_envs=copies, num_agents=agents, num_obstacles=obstacles)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(0, 1, (HORIZON, copies, agents, 5)).astype(np.float32)

    def episode() -> None:
        env.reset()
        for step in actions:
            env.step(step)

    return episode


def vmas_episode(agents: int, copies: int) -> Episode:
    """Return a function that plays one episode of VMAS's simple_spread."""
    import torch
    import vmas

    torch.set_num_threads(1)
    env = vmas.make_env("simple_spread", num_envs=copies, device="cpu", continuous_actions=True, n_agents=agents)
    actions = torch.rand(HORIZON, agents, copies, 2) * 2 - 1

    def episode() -> None:
        env.reset()
        for step in actions:
            env.step(list(step))

    return episode


def jaxmarl_episode(agents: int, copies: int, in_one_call: bool) -> Episode:
    """Return a function that plays one episode of JaxMARL's simple_spread."""
    import jax
    from jaxmarl import make
    from jaxmarl.environments.mpe.default_params import CONTINUOUS_ACT

    env = make("MPE_simple_spread_v3", num_agents=agents, num_landmarks=agents, action_type=CONTINUOUS_ACT)
    reset = jax.jit(jax.vmap(env.reset))
    step = jax.vmap(env.step_env)
    keys = jax.random.split(jax.random.key(0), copies)
    actions = jax.random.uniform(jax.random.key(1), (HORIZON, copies, agents, 5))
    steps = list(actions)

    def act(state: object, joint: jax.Array) -> tuple[object, object]:
        observations, state, rewards, _, _ = step(keys, state, dict(zip(env.agents, joint.swapaxes(0, 1), strict=True)))
        return state, (observations, rewards)

    single, whole = jax.jit(act), jax.jit(lambda state: jax.lax.scan(act, state, actions))

    def episode() -> None:
        _, state = reset(keys)
        if in_one_call:
            jax.block_until_ready(whole(state))
        else:
            for joint in steps:
                state, result = single(state, joint)
                jax.block_until_ready(result)

    return episode


def prepare(name: str, agents: int, copies: int) -> Job:
    """Be the target of a worker: play an episode, which compiles; measured are environment steps per second."""
    episode = {
        "ours": lambda: our_episode(agents, copies, obstacles=0),
        "ours-obstacles": lambda: our_episode(agents, copies, obstacles=2 * agents // 3),
        "vmas": lambda: vmas_episode(agents, copies),
        "jaxmarl": lambda: jaxmarl_episode(agents, copies, in_one_call=False),
        "jaxmarl-scan": lambda: jaxmarl_episode(agents, copies, in_one_call=True),
    }[name]()
    episode()

    def work() -> int:
        episode()
        return HORIZON * copies

    return Job(lambda seconds: count(work, seconds).rate)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, default=9)
    parser.add_argument("--copies", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=4.0, help="per row, over all rounds")
    parser.add_argument("--venv", type=Path, default=Path(tempfile.gettempdir()) / "rllib-maobs-peers")
    args = parser.parse_args()
    # PyTorch on its own first, so that it is the build that this package runs on; VMAS needs the old gym, whose
    # set-up does not run with the newest setuptools.
    peers = python_with(args.venv, ["setuptools<80", same_torch()], PEERS)
    pythons = {"ours": sys.executable, "ours-obstacles": sys.executable, "vmas": peers, "jaxmarl": peers}
    pythons["jaxmarl-scan"] = peers
    core = free_cores()[-1:]  # XLA starts threads whatever its flags say
    workers = {
        name: Worker("tests.benchmarks.env_peers:prepare", name, args.agents, args.copies, cores=core, python=python)
        for name, python in pythons.items()
    }
    for worker in workers.values():
        worker.ready()
    seconds = args.seconds / ROUNDS
    rates = in_turns({name: partial(worker.measured, seconds) for name, worker in workers.items()}, ROUNDS)
    for worker in workers.values():
        worker.close()
    best = {name: max(own) for name, own in rates.items()}
    print(f"Spread, {args.agents} agents, {args.copies} copies, one thread, episodes of {HORIZON} steps")
    print(f"{'':>16} {'env steps/s':>12} {'ours / it':>10}")
    for name, speed in best.items():
        print(f"{name:>16} {speed:12,.0f} {best['ours'] / speed:10.1f}")


if __name__ == "__main__":
    main()
