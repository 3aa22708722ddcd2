"""Watch an environment, or film it: `python -m rllib_maobs.play ENV [options of the environment]`.

    python -m rllib_maobs.play spread-9a --policy heuristic
    python -m rllib_maobs.play tunnel --policy heuristic --record tunnel.gif start_noise=0.05
    python -m rllib_maobs.play simple-tunnel --policy CHECKPOINT --episodes 20 --no-window

Without `--record` the episodes run in a window, in real time. At the end the mean metrics are printed. CHECKPOINT is
the folder of an RLlib algorithm checkpoint, of this package or of a stock algorithm trained on `MAObsEnv`; its
policies act without exploration. Agents with entity networks that share a policy play teams of any size:

    python -m rllib_maobs.play spread-9a --policy CHECKPOINT-of-spread-3a action_mode=force
"""

import argparse
import ast
import pickle
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rllib_maobs.envs import SCENARIOS, MAObsParallelEnv, Recorder, parallel_env
from rllib_maobs.layout import Layout

Policy = Callable[[Mapping[str, NDArray[np.float32]]], dict[str, Any]]
_MODULES = ("learner_group", "learner", "rl_module")


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
    parser.add_argument("--policy", default="random", help="random, heuristic or CHECKPOINT (default: random)")
    parser.add_argument("--record", metavar="FILE", help="write a .gif or .mp4 instead of opening a window")
    parser.add_argument("--no-window", action="store_true", help="show nothing, print the metrics only")
    parser.add_argument("--episodes", type=int, default=1, help="how many (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; the next one adds 1 (default: 0)")
    args = parser.parse_intermixed_args(arguments)
    if args.episodes < 1:
        parser.error(f"--episodes {args.episodes} is illegal; legal: an integer >= 1")
    try:
        mode = "rgb_array" if args.record else None if args.no_window else "human"
        env = parallel_env(args.env, render_mode=mode, **parse_options(args.options))
        policy = make_policy(env, args.policy, args.seed)
        recorder = Recorder(args.record) if args.record else None
    except (ValueError, ImportError) as error:
        parser.error(str(error))
    metrics = play(env, policy, args.episodes, args.seed, recorder)
    print(f"{args.env}, {args.policy}: mean over {args.episodes} episodes from seed {args.seed}")
    for name, value in metrics.items():
        print(f"  {name:24} {value:10.3f}")
    if recorder is not None:
        recorder.close()
        print(f"written: {recorder.path} ({recorder.path.stat().st_size / 1e3:.0f} kB)")


def parse_options(pairs: Sequence[str]) -> dict[str, Any]:
    """Turn `["gap=0.3", "physics=solid"]` into keywords; values are Python literals, or else strings.

    Raises:
        ValueError: If an entry has no "=".
    """
    options = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals:
            raise ValueError(f"{pair!r} is no option; write NAME=VALUE, such as horizon=50")
        try:
            options[name] = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            options[name] = text
    return options


def play(
    env: MAObsParallelEnv, policy: Policy, episodes: int = 1, seed: int = 0, recorder: Recorder | None = None
) -> dict[str, float]:
    """Play episodes.

    Args:
        env: The environment; it is closed in the end.
        policy: Actions by agent for observations by agent.
        episodes: How many.
        seed: Seed of the first episode; episode k has seed + k.
        recorder: Gets a picture of every step, if there is one.

    Returns:
        Mean of each metric; `return_mean` is the mean over the agents' returns.
    """
    totals: dict[str, list[float]] = {}
    for episode in range(episodes):
        observations, _ = env.reset(seed=seed + episode)
        returns = dict.fromkeys(env.agents, 0.0)
        if isinstance(policy, CheckpointPolicy):
            policy.reset()
        _film(env, recorder)
        infos: dict[str, Any] = {}
        while env.agents:
            observations, rewards, _, _, infos = env.step(policy(observations))
            returns = {agent: total + rewards[agent] for agent, total in returns.items()}
            _film(env, recorder)
        metrics = next(iter(infos.values()))["episode_metrics"]
        for name, value in {"return_mean": float(np.mean(list(returns.values()))), **metrics}.items():
            totals.setdefault(name, []).append(value)
    env.close()
    return {name: float(np.mean(values)) for name, values in totals.items()}


def make_policy(env: MAObsParallelEnv, name: str, seed: int = 0) -> Policy:
    """Return a policy for an environment.

    Args:
        env: The environment.
        name: "random", "heuristic", or the folder of an RLlib algorithm checkpoint.
        seed: Of the random policy.

    Raises:
        ValueError: If there is no such folder, or its modules do not fit the environment.
    """
    if name == "heuristic":
        return lambda observations: env.heuristic()
    if name == "random":
        for i, agent in enumerate(env.possible_agents):
            env.action_space(agent).seed(seed + i)
        return lambda observations: {agent: env.action_space(agent).sample() for agent in observations}
    return CheckpointPolicy(env, Path(name).expanduser())


class CheckpointPolicy:
    """Acts like the modules of an RLlib checkpoint, without exploration.

    Modules with entity networks act in teams of another size than they were trained in, too.

    Args:
        env: The environment.
        checkpoint: Folder of an algorithm checkpoint. Its policy mapping says which module acts for which agent.

    Raises:
        ValueError: If it holds none for an agent, or observations or actions have another size than those of the
            environment.
    """

    def __init__(self, env: MAObsParallelEnv, checkpoint: Path) -> None:
        from ray.rllib.core.rl_module import RLModule

        folder = checkpoint.resolve().joinpath(*_MODULES)
        found = sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
        if not found:
            raise ValueError(
                f"--policy {str(checkpoint)!r} is illegal; legal: random, heuristic, or the folder of an RLlib "
                f"algorithm checkpoint (with modules in {'/'.join(_MODULES)})"
            )
        config = _saved_config(checkpoint)
        self._module_of = {agent: str(config["policy_mapping_fn"](agent, None)) for agent in env.possible_agents}
        for agent, module_id in self._module_of.items():
            if module_id not in found:
                raise ValueError(f"checkpoint {checkpoint} has no module for {agent}; it has {', '.join(found)}")
        self._modules = {m: RLModule.from_checkpoint(folder / m) for m in sorted(set(self._module_of.values()))}
        # What observations begin with: the agent's number as a one-hot vector if it was trained so, else nothing.
        size = len(env.possible_agents) if config.get("agent_id_input", False) else 0
        numbers = np.eye(len(env.possible_agents), size, dtype=np.float32)
        self._ids = dict(zip(env.possible_agents, numbers, strict=True))
        for agent, module_id in self._module_of.items():
            _check_actions(env, agent, self._modules[module_id].action_space, config)
        # What acts for each agent; agents of one module that see the same share what is made for a team of this size.
        self._acting: dict[str, Any] = {}
        made: dict[tuple[str, Layout], Any] = {}
        for agent, module_id in self._module_of.items():
            key = module_id, env.observation_layouts[agent]
            if key not in made:
                made[key] = _fitting(env, agent, self._modules[module_id], len(self._ids[agent]))
            self._acting[agent] = made[key]
        self._spaces = {agent: env.action_space(agent) for agent in env.possible_agents}
        self._states: dict[str, Any] = {}

    def reset(self) -> None:
        """Begin an episode: recurrent modules forget."""
        self._states.clear()

    def __call__(self, observations: Mapping[str, NDArray[np.float32]]) -> dict[str, Any]:
        """Return actions by agent for observations by agent."""
        return {agent: self._act(agent, observation) for agent, observation in observations.items()}

    def _act(self, agent: str, observation: NDArray[np.float32]) -> Any:
        import torch
        from ray.rllib.core.columns import Columns
        from ray.rllib.utils.spaces.space_utils import unsquash_action

        module, space = self._acting[agent], self._spaces[agent]
        seen = np.concatenate([self._ids[agent], observation])
        batch: dict[str, Any] = {Columns.OBS: torch.from_numpy(seen)[None]}
        if module.is_stateful():
            if agent not in self._states:
                start = module.get_initial_state()
                self._states[agent] = {key: torch.as_tensor(value)[None] for key, value in start.items()}
            batch = {Columns.OBS: batch[Columns.OBS][:, None], Columns.STATE_IN: self._states[agent]}
        with torch.no_grad():
            out = module.forward_inference(batch)
        if module.is_stateful():
            self._states[agent] = out[Columns.STATE_OUT]
        if Columns.ACTIONS in out:
            action = out[Columns.ACTIONS]
        else:
            distribution = module.get_inference_action_dist_cls().from_logits(out[Columns.ACTION_DIST_INPUTS])
            action = distribution.to_deterministic().sample()
        flat = action.reshape(space.shape).numpy()
        return unsquash_action(flat, space) if space.shape else int(flat)


def _saved_config(checkpoint: Path) -> Any:
    """Return the settings of a checkpoint's algorithm, by name."""
    return pickle.loads((checkpoint / "class_and_ctor_args.pkl").read_bytes())["ctor_args_and_kwargs"][0][0]


def _check_actions(env: MAObsParallelEnv, agent: str, trained: Any, config: Any) -> None:
    """Raise a ValueError if an agent was trained with other actions than those of the environment."""
    here = env.action_space(agent)
    if (here.shape, getattr(here, "n", None)) == (trained.shape, getattr(trained, "n", None)):
        return
    mode = (config.get("env_config") or {}).get("action_mode", "mpe")
    raise ValueError(
        f"{agent} has actions {_size(here)} in {env.scenario}, but was trained with {_size(trained)}: give the "
        f"environment the options of the training, such as action_mode={mode}"
    )


def _size(space: Any) -> str:
    return f"({space.shape[0]},)" if space.shape else f"0 to {space.n - 1}"


def _fitting(env: MAObsParallelEnv, agent: str, module: Any, id_size: int) -> Any:
    """Return a module that acts on what an agent observes: the trained one, or the same for a team of another size.

    Args:
        env: The environment.
        agent: Whose.
        module: As it was trained.
        id_size: Length of the agent's number before its observation.

    Raises:
        ValueError: If the sizes differ, and the module's networks cannot act on another.
    """
    (here,) = env.observation_space(agent).shape
    trained = module.observation_space.shape[0] - id_size
    layout = env.observation_layouts[agent]
    known = getattr(module, "model_config", None)
    known = known.get("observation_layout") if isinstance(known, dict) else None
    # A layout may differ at the same size, too: to entity networks, that is another team.
    if trained == here and (known is None or id_size or [tuple(group) for group in known] == [*map(tuple, layout)]):
        return module
    try:
        if id_size or not hasattr(module, "for_layout"):
            raise ValueError("its networks have one size")
        return module.for_layout(layout)
    except ValueError as error:
        if trained == here:
            return module
        raise ValueError(
            f"{agent} observes ({here},) in {env.scenario}, but was trained on ({trained},). Networks that act in "
            f'teams of any size are those of training(actor="entity"), without agent_id_input and '
            f"normalize_observations"
        ) from error


def _film(env: MAObsParallelEnv, recorder: Recorder | None) -> None:
    if recorder is not None:
        frame = env.render()
        assert frame is not None
        recorder.add(frame)


if __name__ == "__main__":
    main(sys.argv[1:])
