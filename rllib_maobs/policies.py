"""Who plays: random and hand-written policies, and what was trained, as functions from observations to actions."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module import RLModule
from ray.rllib.utils.spaces.space_utils import unsquash_action

from rllib_maobs.checkpoints import find_checkpoint, module_folders, saved_config
from rllib_maobs.envs import SCENARIOS, VectorEnv
from rllib_maobs.exported import OnnxActor, describe, is_exported, read_exported
from rllib_maobs.layout import Layout
from rllib_maobs.options import closest
from rllib_maobs.orca import OrcaPolicy

# Policies that need no training, as the commands call them.
BASELINES = ("random", "heuristic", "orca")
# Actions `(E, N, A)` for observations `(E, N, O)`; discrete ones are numbers `(E, N)`.
Policy = Callable[[NDArray[np.float32]], NDArray[Any]]


def make_policy(env: VectorEnv, name: str, seed: int = 0) -> Policy:
    """Return a policy for an environment.

    Args:
        env: The environment.
        name: "random", "heuristic", "orca" (see `OrcaPolicy`), the folder of an RLlib algorithm checkpoint, or of a
            trial, or an exported file.
        seed: Of the random policy, and of the random part of ORCA's.

    Raises:
        ValueError: If there is no such folder, or its modules do not fit the environment.
        NotImplementedError: If there is no ORCA for the environment. Where it has no heuristic, playing it says so.
        ImportError: If ORCA's library is not installed.
    """
    if name == "heuristic":
        return lambda observations: env.heuristic()
    if name == "orca":
        return OrcaPolicy(env, seed)
    if name != "random":
        return CheckpointPolicy(env, name)
    rng = np.random.default_rng(seed)
    space, shape = env.action_spaces[env.agents[0]], (env.num_envs, len(env.agents))
    if isinstance(space, gym.spaces.Discrete):
        return lambda observations: rng.integers(0, space.n, shape)
    return lambda observations: rng.uniform(-1.0, 1.0, (*shape, *(space.shape or ())))


def play_episodes(env: VectorEnv, policy: Policy, seed: int = 0) -> pd.DataFrame:
    """Play one episode in every copy.

    Args:
        env: The environment.
        policy: Who plays.
        seed: Copy e plays the episode of seed + e.

    Returns:
        A row for each episode: its metrics, and the mean of the agents' returns as "return".
    """
    observations, _ = env.reset(seed=seed)
    if isinstance(policy, CheckpointPolicy):
        policy.reset()
    running = np.ones(env.num_envs, bool)
    rows = pd.DataFrame({"seed": seed + np.arange(env.num_envs), "return": 0.0})
    returns = np.zeros(env.num_envs)
    while running.any():
        observations, rewards, terminated, truncated, info = env.step(policy(observations))
        returns += np.where(running, rewards.mean(axis=1), 0.0)
        finished = terminated | truncated
        for name, values in info.get("episode_metrics", {}).items():
            rows.loc[finished & running, name] = values[finished & running]
        running &= ~finished
        if finished.any() and running.any():  # Where episodes may terminate, the others go on.
            observations, _ = env.reset(mask=finished)
    return rows.assign(**{"return": returns})


def saved_options(policy: str, scenario_id: str) -> dict[str, Any]:
    """Return the environment options of a checkpoint, those of its evaluation where they differ from the training's.

    Args:
        policy: Folder of an algorithm checkpoint or of a trial, or an exported file; anything else has no options.
        scenario_id: What is to be played. If that is not what was trained, its own preset options come first, such as
            the number of agents of spread-9a.
    """
    try:
        trained, saved = trained_on(policy)
    except (ValueError, FileNotFoundError):
        return {}
    if scenario_id not in SCENARIOS or trained is None:
        return {}  # of an environment that is not this package's
    cls, preset = SCENARIOS[scenario_id]
    legal = cls.options_class.__dataclass_fields__
    return {
        name: value
        for name, value in saved.items()
        if name in legal and (trained in (scenario_id, cls) or name not in preset)
    }


def trained_on(checkpoint: str) -> tuple[Any, dict[str, Any]]:
    """Return what a checkpoint's training evaluated on.

    Returns:
        The scenario's id or class, None if it is not one of this package; and the environment's options.

    Raises:
        ValueError: If it is neither a checkpoint nor an exported file.
    """
    if is_exported(checkpoint):
        said = describe(checkpoint)
        return (said.env if said.env in SCENARIOS else None), said.env_options
    config = saved_config(find_checkpoint(checkpoint))
    evaluation = config.get("evaluation_config") or {}
    options = {**(config.get("env_config") or {}), **(evaluation.get("env_config") or {})}
    env = str(config.get("env"))
    return options.pop("scenario", env.removeprefix("maobs/") if env.startswith("maobs/") else None), options


class CheckpointPolicy:
    """Acts like the modules of an RLlib checkpoint, or of an exported file, without exploration.

    Modules with entity networks act in teams of another size than they were trained in, too.

    Args:
        env: The environment.
        checkpoint: Folder of an algorithm checkpoint, or of a trial, whose last one counts, or an exported file. Its
            policy mapping says which module acts for which agent.

    Raises:
        ValueError: If it holds none for an agent, or observations or actions have another size than those of the
            environment.
    """

    def __init__(self, env: VectorEnv, checkpoint: str | Path) -> None:
        trained = _exported(checkpoint) if is_exported(checkpoint) else _checkpoint(checkpoint)
        module_of = {agent: trained.module_of(agent) for agent in env.agents}
        for agent, module_id in module_of.items():
            if module_id not in trained.modules:
                raise ValueError(
                    f"{trained.name} has no module for {agent}; it has {', '.join(trained.modules)}. Teams of any size "
                    f"are played by one policy for all, with entity networks"
                )
        modules = {mid: trained.modules[mid]() for mid in sorted(set(module_of.values()))}
        # What observations begin with: the agent's number as a one-hot vector if it was trained so, else nothing.
        size = len(env.agents) if trained.agent_ids else 0
        self._ids = np.eye(len(env.agents), size, dtype=np.float32)
        # Agents of one module that see the same act together.
        agents = dict[tuple[str, Layout], list[int]]()
        for index, (agent, module_id) in enumerate(module_of.items()):
            _check_actions(env, agent, modules[module_id].action_space, trained.options)
            agents.setdefault((module_id, env.observation_layouts[agent]), []).append(index)
        self._groups = [
            (_fitting(env, env.agents[columns[0]], modules[module_id], size), columns)
            for (module_id, _), columns in agents.items()
        ]
        self._sizes = [env.observation_spaces[agent].shape[0] for agent in env.agents]
        self._space = env.action_spaces[env.agents[0]]
        self._states = dict[int, Any]()

    def reset(self) -> None:
        """Begin episodes in all copies: recurrent modules forget."""
        self._states.clear()

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Return actions `(E, N, A)` for observations `(E, N, O)`; numbers `(E, N)` if they are discrete."""
        copies, team = observations.shape[:2]
        actions = np.empty((copies, team, *(self._space.shape or ())), self._space.dtype)
        for number, (module, columns) in enumerate(self._groups):
            ids = np.broadcast_to(self._ids[columns], (copies, len(columns), self._ids.shape[1]))
            seen = np.concatenate([ids, observations[:, columns, : self._sizes[columns[0]]]], axis=-1)
            acts = self._act(number, module, seen.reshape(copies * len(columns), -1))
            actions[:, columns] = acts.reshape(copies, len(columns), *acts.shape[1:])
        return actions

    def _act(self, number: int, module: Any, seen: NDArray[np.float32]) -> NDArray[Any]:
        """Return one group's actions `(B, A)` for what its agents see, `(B, O)`."""
        if isinstance(module, OnnxActor):
            actions, self._states[number] = module.act(seen, self._states.get(number))
            return actions
        batch: dict[str, Any] = {Columns.OBS: torch.from_numpy(seen)}
        if module.is_stateful():
            if number not in self._states:
                start = {key: torch.as_tensor(value) for key, value in module.get_initial_state().items()}
                self._states[number] = {k: v.expand(len(seen), *v.shape).clone() for k, v in start.items()}
            batch = {Columns.OBS: batch[Columns.OBS][:, None], Columns.STATE_IN: self._states[number]}
        with torch.no_grad():
            out = module.forward_inference(batch)
        if module.is_stateful():
            self._states[number] = out[Columns.STATE_OUT]
        if Columns.ACTIONS in out:
            action = out[Columns.ACTIONS]
        else:
            distribution = module.get_inference_action_dist_cls().from_logits(out[Columns.ACTION_DIST_INPUTS])
            action = distribution.to_deterministic().sample()
        flat: NDArray[Any] = action.reshape(len(seen), *(self._space.shape or ())).numpy()
        return np.asarray(unsquash_action(flat, self._space)) if self._space.shape else flat


class _Trained(NamedTuple):
    """What was trained, wherever it lies: `modules` makes each one when it is asked for."""

    name: str
    modules: Mapping[str, Callable[[], Any]]
    module_of: Callable[[str], str]
    agent_ids: bool
    options: Mapping[str, Any]


def _checkpoint(path: str | Path) -> _Trained:
    """The modules of a checkpoint."""
    try:
        folder = find_checkpoint(path)
    except ValueError as error:
        raise ValueError(
            f"{error} Other policies are {', '.join(BASELINES)}{closest(str(path), [*BASELINES])}."
        ) from None
    config = saved_config(folder)
    return _Trained(
        name=f"checkpoint {folder}",
        modules={mid: partial(RLModule.from_checkpoint, place) for mid, place in module_folders(folder).items()},
        module_of=lambda agent: str(config["policy_mapping_fn"](agent, None)),
        agent_ids=config.get("agent_id_input", False),
        options=config.get("env_config") or {},
    )


def _exported(path: str | Path) -> _Trained:
    """The actors of an exported file."""
    said, actors = read_exported(path)
    return _Trained(
        name=f"file {path}",
        modules={name: partial(actors.__getitem__, name) for name in actors},
        module_of=said.actor_of,
        # Actors of ONNX files have their numbers inside.
        agent_ids=said.agent_id_input and Path(path).suffix.lower() != ".onnx",
        options=said.env_options,
    )


def _check_actions(env: VectorEnv, agent: str, trained: Any, options: Mapping[str, Any]) -> None:
    """Raise a ValueError if an agent was trained with other actions than those of the environment."""
    here = env.action_spaces[agent]
    if (here.shape, getattr(here, "n", None)) == (trained.shape, getattr(trained, "n", None)):
        return
    mode = options.get("action_mode", "mpe")
    raise ValueError(
        f"{agent} has actions {_size(here)} in {env.scenario}, but was trained with {_size(trained)}: give the "
        f"environment the options of the training, such as action_mode={mode}"
    )


def _size(space: Any) -> str:
    return f"({space.shape[0]},)" if space.shape else f"0 to {space.n - 1}"


def _fitting(env: VectorEnv, agent: str, module: Any, id_size: int) -> Any:
    """Return a module that acts on what an agent observes: the trained one, or the same for a team of another size.

    Args:
        env: The environment.
        agent: Whose.
        module: As it was trained.
        id_size: Length of the agent's number before its observation.

    Raises:
        ValueError: If the sizes differ, and the module's networks cannot act on another.
    """
    (here,) = env.observation_spaces[agent].shape
    trained = module.observation_space.shape[0] - id_size
    layout = env.observation_layouts[agent]
    known = getattr(module, "model_config", None)
    known = known.get("observation_layout") if isinstance(known, dict) else None
    # A layout may differ at the same size, too: to entity networks, that is another team.
    if trained == here and (known is None or id_size or [tuple(group) for group in known] == [*map(tuple, layout)]):
        return module
    try:
        if id_size or not hasattr(module, "for_layout"):
            raise ValueError("its networks act on one size")
        return module.for_layout(layout)
    except ValueError as error:
        if trained == here:
            return module
        raise ValueError(
            f"{agent} observes ({here},) in {env.scenario}, but was trained on ({trained},): "
            f"{str(error).rstrip('.')}. Networks that "
            f'act in teams of any size are those of training(actor="entity"), without agent_id_input and '
            f"normalize_observations"
        ) from error
