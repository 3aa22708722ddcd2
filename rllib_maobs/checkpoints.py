"""What other programs read of a run: its last checkpoint, and the networks in it."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ray.rllib.core.rl_module import RLModule

from rllib_maobs.algorithms import JointAlgorithm, JointConfig
from rllib_maobs.algorithms.checks import built_modules
from rllib_maobs.learner.networks import MIXER
from rllib_maobs.paths import local
from rllib_maobs.whole import METADATA, first_whole, numbered, with_those_before

logger = logging.getLogger(__name__)
_MODULES = ("learner_group", "learner", "rl_module")


def find_checkpoint(path: str | Path) -> Path:
    """Return the folder of an algorithm's checkpoint.

    Args:
        path: The folder itself, or a trial's with checkpoints in it, of which the last one counts. In the place of a
            torn or damaged one the one before it counts, with a warning.

    Raises:
        ValueError: If it is neither, or no checkpoint there is whole.
    """
    if not str(path):  # which would be the present folder
        raise ValueError("'' is no checkpoint; legal: the folder of a checkpoint, or of a trial with checkpoints.")
    folder = local(path).resolve()
    # Of a checkpoint anything may be missing, of one that was being replaced all of it.
    itself = (folder / METADATA).exists() or folder.joinpath(*_MODULES[:1]).is_dir() or not folder.exists()
    candidates = with_those_before(folder) if itself else numbered(folder)
    if not any(path.exists() for path in candidates):
        candidates = []
    if candidates and (found := first_whole(*candidates)).joinpath(*_MODULES).is_dir():
        return found
    trials = sorted({str(trial.parent.name) for trial in folder.glob("*/checkpoint_*")}) if folder.is_dir() else []
    inside = f" Trials in it are {', '.join(trials)}." if trials else ""
    raise ValueError(
        f"{str(path)!r} is no checkpoint; legal: the folder of an RLlib algorithm checkpoint (with modules in "
        f"{'/'.join(_MODULES)}), or of a trial with checkpoints.{inside}"
    )


def module_folders(checkpoint: Path) -> dict[str, Path]:
    """Return the folder of each module in a checkpoint, by id."""
    return {path.name: path for path in sorted(checkpoint.joinpath(*_MODULES).iterdir()) if path.is_dir()}


def saved_config(checkpoint: Path) -> Mapping[str, Any]:
    """Return the settings of a checkpoint's algorithm, by name.

    Raises:
        ValueError: If they are not there.
    """
    path = checkpoint / "class_and_ctor_args.pkl"
    if not path.is_file():
        raise ValueError(f"{str(checkpoint)!r} is no whole checkpoint of an RLlib algorithm: it has no {path.name}.")
    stored: Any = pickle.loads(path.read_bytes())
    config: Mapping[str, Any] = stored["ctor_args_and_kwargs"][0][0]
    return config


def saved_networks(config: JointConfig, checkpoint: str | Path) -> dict[str, dict[str, Any]]:
    """Return what each policy of a configuration would take over from another run's checkpoint.

    Args:
        config: A validated configuration.
        checkpoint: See `find_checkpoint`. It must hold the same policies, or one, which all here take over.

    Returns:
        State of the modules by policy: online and target networks, normalisation.

    Raises:
        ValueError: If it has other policies, or networks with other parameters.
    """
    folders, states = module_folders(find_checkpoint(checkpoint)), dict[str, dict[str, Any]]()
    policies = [mid for mid in folders if mid != MIXER]
    here = built_modules(config)
    sources = {mid: policies[0] if len(policies) == 1 and mid != MIXER else mid for mid in here}
    if missing := [mid for mid, source in sources.items() if source not in folders]:
        raise ValueError(f"{str(checkpoint)!r} has no networks for {missing}; it has those of {sorted(folders)}.")
    for mid, module in here.items():
        source = RLModule.from_checkpoint(folders[sources[mid]])
        if source.action_space != module.action_space:
            logger.warning(
                f"The networks of policy {mid!r} in {str(checkpoint)!r} acted in {source.action_space}, here they act "
                f"in {module.action_space}: the same output is another action."
            )
        for settings in ("actor_settings", "critic_settings"):
            was, now = (m.model_config.get(settings, {}) for m in (source, module))
            if was != now:
                logger.warning(
                    f"The networks of policy {mid!r} in {str(checkpoint)!r} had {settings}={was}, here {now}, "
                    f"with which the same weights may be another network."
                )
        states[mid] = source.get_state()
        there = {name: tuple(value.shape) for name, value in states[mid].items()}
        expected = {name: tuple(value.shape) for name, value in module.state_dict().items()}
        for name in dict.fromkeys([*expected, *there]):
            if expected.get(name) != there.get(name):
                raise ValueError(
                    f"The networks in {str(checkpoint)!r} are of another kind or task than those of {config.name} on "
                    f"{config.env}: {name} of policy {mid!r} has shape {there.get(name, 'none (it is not there)')}, "
                    f"here {expected.get(name, 'none (it is not there)')}. For teams of any size are those of "
                    f'training(actor="entity", critic="entity"), but for mixers, and critics of a joint action with '
                    f"one agent."
                )
    return states


def load_networks(algorithm: JointAlgorithm, checkpoint: str | Path) -> None:
    """Let an algorithm start from another run's networks, e.g. from those of a smaller team.

    ```python
    algo = config.build_algo()
    maobs.load_networks(algo, "results/spread-3a/maddpg-entity-seed0")
    ```

    Meant for a new algorithm: optimisers and replay are left as they are. To go on with a run, restore it instead.
    Checkpoints are pickles: load those of people you trust only.

    Args:
        algorithm: One of this package's.
        checkpoint: Folder of a checkpoint, or of a trial, whose last one counts.

    Raises:
        ValueError: If it has other policies, or networks with other parameters.
    """
    learner = algorithm.learner_group._learner
    for mid, state in saved_networks(algorithm.config, checkpoint).items():
        learner.module[mid].unwrapped().set_state(state)
    learner._weights_seq_no += 1  # or runners that have had weights since would skip these
    algorithm.env_runner_group.sync_weights(from_worker_or_learner_group=algorithm.learner_group, inference_only=True)
