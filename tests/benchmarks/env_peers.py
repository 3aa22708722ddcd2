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
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

HORIZON = 100
ROUNDS = 4
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}
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


def serve(name: str, agents: int, copies: int) -> None:
    """Be a worker: for every line of input (seconds) play as long and print environment steps per second."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, [max(os.sched_getaffinity(0))])  # XLA starts threads whatever its flags say
    episode = {
        "ours": lambda: our_episode(agents, copies, obstacles=0),
        "ours-obstacles": lambda: our_episode(agents, copies, obstacles=2 * agents // 3),
        "vmas": lambda: vmas_episode(agents, copies),
        "jaxmarl": lambda: jaxmarl_episode(agents, copies, in_one_call=False),
        "jaxmarl-scan": lambda: jaxmarl_episode(agents, copies, in_one_call=True),
    }[name]()
    episode()  # compiles
    print("ready", flush=True)
    for line in sys.stdin:
        episodes, start = 0, time.perf_counter()
        while time.perf_counter() - start < float(line):
            episode()
            episodes += 1
        print(json.dumps(episodes * HORIZON * copies / (time.perf_counter() - start)), flush=True)


def python_of_peers(folder: Path) -> str:
    """Return the interpreter of the virtual environment, which is made if need be."""
    python = folder / "bin" / "python"
    done = folder / "installed"
    if not done.exists() or done.read_text() != str(PEERS):
        print(f"making {folder} with {', '.join(PEERS)} ...", flush=True)
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(folder)], check=True)
        # PyTorch on its own first, so that it is the build that this package runs on; VMAS needs the old gym, whose
        # set-up does not run with the newest setuptools.
        for packages in (["setuptools<80", f"torch=={version('torch').partition('+')[0]}"], PEERS):
            subprocess.run([python, "-m", "pip", "install", "-q", *packages], check=True)
        done.write_text(str(PEERS))
    return str(python)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, default=9)
    parser.add_argument("--copies", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=4.0, help="per row, over all rounds")
    parser.add_argument("--venv", type=Path, default=Path(tempfile.gettempdir()) / "rllib-maobs-peers")
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        serve(args.serve, args.agents, args.copies)
        return
    peers = python_of_peers(args.venv)
    names = {"ours": sys.executable, "ours-obstacles": sys.executable, "vmas": peers, "jaxmarl": peers}
    names["jaxmarl-scan"] = peers
    size = ["--agents", str(args.agents), "--copies", str(args.copies)]
    workers = {
        name: subprocess.Popen(
            [python, __file__, "--serve", name, *size],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | ONE_THREAD,
        )
        for name, python in names.items()
    }
    best = dict.fromkeys(workers, 0.0)
    for worker in workers.values():
        assert worker.stdout is not None
        while worker.stdout.readline() not in ("ready\n", ""):
            pass  # what libraries print when they are imported
    for _ in range(ROUNDS):
        for name, worker in workers.items():
            assert worker.stdin is not None and worker.stdout is not None
            print(args.seconds / ROUNDS, file=worker.stdin, flush=True)
            best[name] = max(best[name], json.loads(worker.stdout.readline()))
    for worker in workers.values():
        worker.communicate()
    print(f"Spread, {args.agents} agents, {args.copies} copies, one thread, episodes of {HORIZON} steps")
    print(f"{'':>16} {'env steps/s':>12} {'ours / it':>10}")
    for name, speed in best.items():
        print(f"{name:>16} {speed:12,.0f} {best['ours'] / speed:10.1f}")


if __name__ == "__main__":
    main()
