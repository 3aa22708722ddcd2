"""Watch an environment, or film it: `python -m rllib_maobs.play ENV [options of the environment]`.

    python -m rllib_maobs.play spread-9a --policy heuristic
    python -m rllib_maobs.play tunnel --policy heuristic --record tunnel.gif start_noise=0.05
    python -m rllib_maobs.play simple-tunnel --policy CHECKPOINT --episodes 20 --no-window

Without `--record` the episodes run in a window, in real time. At the end the mean metrics are printed. CHECKPOINT is
the folder of an RLlib algorithm checkpoint (of this package, or of a stock algorithm trained on `MAObsEnv`), or of a
trial, whose last checkpoint counts, or a file of `rllib_maobs.export`; its policies act without exploration. They play
what they were evaluated on: the options in the checkpoint hold unless the command line says otherwise. Checkpoints are
pickles: play those of people you trust only; files may come from anybody. Agents with entity networks that share a
policy play teams of any size:

    python -m rllib_maobs.play spread-9a --policy CHECKPOINT-of-spread-3a
"""

import argparse
import ast
import logging
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from rllib_maobs.envs import SCENARIOS, MAObsParallelEnv, Recorder, parallel_env
from rllib_maobs.envs.rendering import has_display
from rllib_maobs.policies import CheckpointPolicy, Policy, make_policy, saved_options


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line.

    Args:
        arguments: Those of the command line by default.
    """
    parser = argparse.ArgumentParser(
        prog="python -m rllib_maobs.play", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("env", metavar="ENV", help=f"one of {', '.join(SCENARIOS)}")
    parser.add_argument("options", nargs="*", metavar="NAME=VALUE", help="options of the environment")
    parser.add_argument("--policy", default="random", help="random, heuristic, orca or CHECKPOINT (default: random)")
    parser.add_argument("--record", metavar="FILE", help="write a .gif or .mp4 instead of opening a window")
    parser.add_argument("--no-window", action="store_true", help="show nothing, print the metrics only")
    parser.add_argument("--episodes", type=int, default=1, help="how many (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; the next one adds 1 (default: 0)")
    args = parser.parse_intermixed_args(arguments)
    if args.episodes < 1:
        parser.error(f"--episodes {args.episodes} is illegal; legal: an integer >= 1")
    if not 0 <= args.seed < 2**63 - args.episodes:
        parser.error(f"--seed {args.seed} is illegal; legal: an integer >= 0 of 63 bits")
    try:
        mode = "rgb_array" if args.record is not None else None if args.no_window else "human"
        options = parse_options(args.options)
        saved = {name: value for name, value in saved_options(args.policy, args.env).items() if name not in options}
        env = parallel_env(args.env, render_mode=mode, **saved, **options)
        policy = make_policy(env.vector, args.policy, args.seed)
        if mode == "human" and not has_display():
            raise ValueError("there is no display for a window here: give --record FILE, or --no-window")
        recorder = Recorder(args.record) if args.record is not None else None
    except (ValueError, ImportError, NotImplementedError) as error:
        parser.error(str(error))
    metrics = play(env, policy, args.episodes, args.seed, recorder)
    if saved:
        print(f"options of the checkpoint: {' '.join(f'{name}={value}' for name, value in saved.items())}")
    print(f"{args.env}, {args.policy}: mean over {args.episodes} episodes from seed {args.seed}")
    for name, value in metrics.items():
        print(f"  {name:24} {value:10.3f}")
    if recorder is not None:
        recorder.close()
        print(f"written: {recorder.path} ({recorder.path.stat().st_size / 1e3:.0f} kB)")


def parse_options(pairs: Sequence[str]) -> dict[str, Any]:
    """Turn `["gap=0.3", "physics=solid"]` into keywords; values are Python literals, or else strings.

    Raises:
        ValueError: If an entry has no "=", or names no option of a task, or one that is there already.
    """
    options = dict[str, Any]()
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals:
            raise ValueError(f"{pair!r} is no option; write NAME=VALUE, such as horizon=50")
        if name in ("scenario", "render_mode", "num_envs"):
            raise ValueError(f"{name}=... is no option of a task; legal are those of its class, such as horizon=50")
        if name in options:
            raise ValueError(f"{name}=... is given twice")
        try:
            options[name] = ast.literal_eval(text)
        except (ValueError, SyntaxError, MemoryError, RecursionError):  # the last ones are of many brackets
            options[name] = text
    return options


def play(
    env: MAObsParallelEnv, policy: Policy, episodes: int = 1, seed: int = 0, recorder: Recorder | None = None
) -> dict[str, float]:
    """Play episodes.

    Args:
        env: The environment; it is closed in the end.
        policy: Of its one copy.
        episodes: How many.
        seed: Seed of the first episode; episode k has seed + k.
        recorder: Gets a picture of every step, if there is one.

    Returns:
        Mean of each metric; `return_mean` is the mean over the agents' returns.
    """
    totals: dict[str, list[float]] = {}
    for episode in range(episodes):
        env.reset(seed=seed + episode)
        returns = dict.fromkeys(env.agents, 0.0)
        if isinstance(policy, CheckpointPolicy):
            policy.reset()
        _film(env, recorder)
        infos: dict[str, Any] = {}
        while env.agents:
            (actions,) = policy(env.vector.observe())
            _, rewards, _, _, infos = env.step(dict(zip(env.agents, actions, strict=True)))
            returns = {agent: total + rewards[agent] for agent, total in returns.items()}
            _film(env, recorder)
        metrics = next(iter(infos.values()))["episode_metrics"]
        for name, value in {"return_mean": float(np.mean(list(returns.values()))), **metrics}.items():
            totals.setdefault(name, []).append(value)
    env.close()
    return {name: float(np.mean(values)) for name, values in totals.items()}


def _film(env: MAObsParallelEnv, recorder: Recorder | None) -> None:
    if recorder is not None:
        frame = env.render()
        assert frame is not None
        recorder.add(frame)


if __name__ == "__main__":
    logging.getLogger("ray").setLevel(logging.ERROR)  # notes of RLlib to its own developers
    main(sys.argv[1:])
