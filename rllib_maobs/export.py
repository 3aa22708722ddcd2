"""Take agents elsewhere, or share them: `python -m rllib_maobs.export CHECKPOINT [--agent AGENT]`.

    python -m rllib_maobs.export results/spread-3a/maddpg-entity-seed0
    python -m rllib_maobs.export results/spread-3a/maddpg-lstm-seed0 --agent agent_0 --format safetensors

CHECKPOINT is the folder of an algorithm checkpoint of this package, or of a trial, whose last checkpoint counts. An
ONNX file maps an environment's observations to its actions: normalisation and action bounds are inside, what an LSTM
remembers goes in and comes out, and entity networks take any number of entities. ONNX Runtime runs it without Ray and
PyTorch. A safetensors file holds the weights for `rllib_maobs.load_agent`. Both say what they are in their metadata,
and `rllib_maobs.play` and `rllib_maobs.evaluate` take them like checkpoints. Reading them runs no code; checkpoints
are pickles, so load those of people you trust only.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from ray.rllib.core.rl_module import RLModule

from rllib_maobs.checkpoints import find_checkpoint, module_folders, saved_config
from rllib_maobs.envs import SCENARIOS
from rllib_maobs.exported import (
    CHECKSUM,
    CLASSES,
    FORMATS,
    KEY,
    SETTINGS,
    UNSEALED,
    VERSION,
    ActorDescription,
    Description,
    OnnxActor,
    sealed,
)
from rllib_maobs.layout import Layout, layout_size
from rllib_maobs.modules import ACTORS, AgentModule
from rllib_maobs.modules.portable import PortableActor, PortableTeam
from rllib_maobs.options import closest
from rllib_maobs.paths import file_name, local, write_aside
from rllib_maobs.policies import trained_on

NEEDED = {".onnx": ("onnx", "onnxscript", "onnxruntime"), ".safetensors": ("safetensors",)}
TOLERANCE = 1e-5  # between the file's actions and the module's


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line.

    Args:
        arguments: Those of the command line by default.
    """
    parser = argparse.ArgumentParser(
        prog="python -m rllib_maobs.export", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help="folder of a checkpoint, or of a trial")
    who = parser.add_mutually_exclusive_group()
    who.add_argument("--agent", help="one agent")
    who.add_argument("--all", action="store_true", help="the whole team in one file (default)")
    parser.add_argument("--format", choices=[end[1:] for end in FORMATS], help="default: as --output ends, or onnx")
    parser.add_argument("--output", type=Path, metavar="FILE", help="default: AGENT.onnx or team.onnx, here")
    parser.add_argument("--force", action="store_true", help="replace a file that is there")
    args = parser.parse_args(arguments)
    ending = f".{args.format}" if args.format else args.output.suffix.lower() if args.output else ".onnx"
    path = args.output.expanduser() if args.output else Path(file_name(args.agent or "team") + ending)
    try:
        if path.suffix.lower() != ending:
            raise ValueError(f"--output {path} does not end in {ending}, as --format says")
        description = export_agents(args.checkpoint, path, args.agent, replace=args.force)
    except (ValueError, ImportError) as error:
        parser.error(str(error))
    print(f"written: {path} ({path.stat().st_size / 1e3:.0f} kB)")
    for name, actor in description.actors.items():
        print(f"  {name}: acts for {', '.join(actor.agents)}")
        for key, shape in {**actor.inputs, **actor.state}.items() if ending == ".onnx" else ():
            print(f"    {key}: batch x {' x '.join('any' if size is None else str(size) for size in shape)}")


def export_agents(
    checkpoint: str | Path, path: str | Path, agent: str | None = None, *, replace: bool = False
) -> Description:
    """Write agents of a checkpoint into one file for sharing.

    Args:
        checkpoint: Folder of a checkpoint of one of this package's algorithms, or of a trial, whose last one counts.
        path: The file; its ending, .onnx or .safetensors, says what kind. It is written aside and renamed.
        agent: One agent; None for the whole team.
        replace: Whether to replace a file that is there.

    Returns:
        What the file says of itself.

    Raises:
        ValueError: If it is no such checkpoint or agent, the file is there or can't be written, or a network can't be
            exported.
        ImportError: If what writes such a file is not installed.
    """
    path = local(path)
    ending = path.suffix.lower()
    if ending not in FORMATS:
        raise ValueError(f"{str(path)!r} is no file to export to; legal are names that end in {' or '.join(FORMATS)}")
    if missing := [name for name in NEEDED[ending] if find_spec(name) is None]:
        raise ImportError(f'{ending} files need {", ".join(missing)}: pip install -c constraints.txt -e ".[export]"')
    find_checkpoint(checkpoint)  # before the file: one that is there is not what is wrong with a wrong checkpoint
    if path.exists() and not replace:
        raise ValueError(f"{path} exists: remove it, choose another file, or say --force (replace=True)")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"there is no folder {path.absolute().parent} for {path.name}")
    source, description = _source(checkpoint, agent, ending)
    if ending == ".onnx":
        write_aside(path, _onnx(source, description))
    else:
        write_aside(path, _safetensors(source, description))
    return description


class _Exported(NamedTuple):
    """One actor of a file to be."""

    module: AgentModule
    portable: PortableActor


def _source(checkpoint: str | Path, agent: str | None, ending: str) -> tuple[dict[str, _Exported], Description]:
    """The actors to export by name, and what the file will say of them."""
    folder = find_checkpoint(checkpoint)
    config, folders = saved_config(folder), module_folders(folder)
    team = config.get("team")
    if team is None:
        raise ValueError(f"{str(checkpoint)!r} is of a stock algorithm; legal: a checkpoint of this package's.")
    agents = list(team.agents)
    if agent is not None and agent not in agents:
        raise ValueError(f"{str(checkpoint)!r} has no agent {agent!r}{closest(agent, agents)}; legal: {agents}.")
    module_of = {name: str(config["policy_mapping_fn"](name, None)) for name in agents}
    modules = {mid: RLModule.from_checkpoint(folders[mid]) for mid in dict.fromkeys(module_of.values())}
    if wrong := [mid for mid, module in modules.items() if not isinstance(module, AgentModule)]:
        raise ValueError(f"policy {wrong[0]!r} is a {type(modules[wrong[0]]).__name__}; only AgentModules are exported")
    # Agents of one module are one actor, unless each has its own number inside, as an ONNX file's have.
    numbered = bool(config.get("agent_id_input", False))
    alone = numbered and ending == ".onnx"
    actor_of = {name: name if alone or len(modules) == len(agents) else module_of[name] for name in agents}
    source: dict[str, _Exported] = {}
    for index, name in enumerate(agents):
        if actor_of[name] not in source and agent in (None, name):
            number = torch.eye(len(agents))[index] if numbered else None
            module = modules[module_of[name]]
            source[actor_of[name]] = _Exported(module, PortableActor(module, number))
    env, options = trained_on(str(folder))
    env = env if isinstance(env, str) and env in SCENARIOS else _name(env or config.get("env"))
    plain = {name: value for name, value in options.items() if _is_plain(value)}
    if left := [name for name in options if name not in plain]:
        warnings.warn(f"The file will not name the environment's {', '.join(left)}: no plain values.", stacklevel=3)
    from rllib_maobs import __version__

    description = Description(
        version=VERSION,
        package_version=__version__,
        algorithm=config["class"].name,
        env=env,
        env_options=plain,
        agent_id_input=numbered,
        team=agents,
        actors={
            name: _described(
                actor,
                [each for each in agents if actor_of[each] == name],
                f"{name}/" if len(source) > 1 else "",
                _settings(actor.module) if ending == ".safetensors" else None,
            )
            for name, actor in source.items()
        },
    )
    description.to_json()  # whether it can be written
    return source, description


def _described(actor: _Exported, agents: list[str], prefix: str, module: dict[str, Any] | None) -> ActorDescription:
    """What a file says of one actor, whose arrays have names with a prefix."""
    portable, space = actor.portable, actor.portable.action_space
    if isinstance(space, gym.spaces.Discrete):
        action: dict[str, Any] = {"n": int(space.n), "start": int(space.start)}
    else:
        action = {"low": space.low.tolist(), "high": space.high.tolist(), "dtype": str(space.dtype)}
    shapes = _shapes(portable, {group.name: None for group in portable.layout if group.position})
    return ActorDescription(
        agents=agents,
        observation_layout=[list(group) for group in portable.layout],
        action=action,
        inputs={prefix + name: shapes[name] for name in portable.inputs},
        state={prefix + name: shapes[name] for name in portable.state},
        outputs=[prefix + "action", *(f"{prefix}next.{name}" for name in portable.state)],
        module=module,
    )


def _shapes(portable: PortableActor, counts: Mapping[str, Any]) -> dict[str, list[Any]]:
    """An actor's inputs and states by name, with counts of its groups where they are free."""
    shapes = {name: list[Any](shape) for name, shape in {**portable.inputs, **portable.state}.items()}
    if portable.free:
        for group, count in counts.items():
            shapes[f"observation.{group}"][-2] = count
            if portable.state:
                shapes[f"window.{group}"][-2] = count
    return shapes


def _settings(module: AgentModule) -> dict[str, Any]:
    """What a safetensors file says of a module."""
    settings = {name: value for name, value in module.model_config.items() if name in SETTINGS}
    if type(module) not in CLASSES.values():
        raise ValueError(
            f"{type(module).__name__} is a module of your own; safetensors take this package's: export onnx"
        )
    actor = ACTORS.reference(settings.get("actor", "mlp"))
    # A class that can't be imported has a name, too: whoever loads the file gives the class.
    settings["actor"] = actor if isinstance(actor, str) else f"{actor.__module__}:{actor.__qualname__}"
    return {"class": type(module).__name__, "model_config": settings}


def _safetensors(source: Mapping[str, _Exported], description: Description) -> bytes:
    """The file: every actor's weights, and its normalisation, by `<actor>/<parameter>`."""
    from safetensors.torch import save

    tensors = {
        f"{name}/{key}": torch.as_tensor(value).contiguous().clone()
        for name, actor in source.items()
        for key, value in actor.module.get_state(inference_only=True).items()
    }
    return sealed(bytes(save(tensors, {KEY: description.to_json(), CHECKSUM: UNSEALED})))


def _onnx(source: Mapping[str, _Exported], description: Description) -> bytes:
    """The file: one network for all actors; it was run, and acts as the modules do."""
    actors = [actor.portable for actor in source.values()]
    arrays: list[torch.Tensor] = []
    free: list[dict[int, Any]] = []
    for actor in actors:
        # Sizes of an example that mean themselves: 0 and 1 would be taken for fixed, equal ones for the same.
        counts = {group.name: 2 + i for i, group in enumerate(actor.layout) if group.position}
        examples = _shapes(actor, counts)
        marked = _shapes(actor, dict.fromkeys(counts))
        arrays += [torch.randn(2, *shape) for shape in examples.values()]
        free += [
            {0: torch.export.Dim.DYNAMIC}
            | {axis + 1: torch.export.Dim.DYNAMIC for axis, size in enumerate(shape) if size is None}
            for shape in marked.values()
        ]
    described = description.actors.values()
    # It warns of other packages that are not installed.
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                PortableTeam(actors),
                tuple(arrays),
                dynamo=True,
                optimize=False,  # it takes 1e-12 for nothing, and a distance of 0 would become NaN
                verbose=False,
                external_data=False,
                dynamic_shapes=(tuple(free),),
                input_names=[name for each in described for name in (*each.inputs, *each.state)],
                output_names=[name for each in described for name in each.outputs],
            )
    except Exception as error:  # the tracer's own classes, and whatever a network raises
        kinds = ", ".join(dict.fromkeys(type(actor.actor).__name__ for actor in actors))
        reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise ValueError(
            f"{kinds} can't be traced for ONNX ({reason}): see what networks are made of in docs/your_own.md, or "
            f"export safetensors"
        ) from error
    assert program is not None
    _tidy(program.model)
    model = program.model_proto
    for key, value in {KEY: description.to_json(), CHECKSUM: UNSEALED}.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
    # The tracer's notes name files of this machine.
    for part in (*model.graph.node, *model.graph.value_info, *model.graph.input, *model.graph.output, model.graph):
        del part.metadata_props[:]
    content = sealed(model.SerializeToString())
    _check(content, source, description)
    return content


def _tidy(model: Any) -> None:
    """Computes once what is constant, and drops what is not needed: ONNX Runtime warns of it otherwise."""
    from onnx_ir.passes.common import InlinePass
    from onnxscript.optimizer import fold_constants, remove_unused_functions, remove_unused_nodes

    InlinePass()(model)
    fold_constants(model)
    remove_unused_nodes(model)
    remove_unused_functions(model)


def _check(content: bytes, source: Mapping[str, _Exported], description: Description) -> None:
    """Raise a ValueError if ONNX Runtime does not act as the modules do, over some random steps."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(0)
    for name, actor in source.items():
        here = OnnxActor(session, description, name)
        layouts: list[Layout] = [actor.portable.layout]
        if actor.portable.free:
            layouts += [tuple(g._replace(count=n if g.position else g.count) for g in layouts[0]) for n in (0, 1, 4)]
        for layout in layouts:
            module = actor.module if layout == layouts[0] else actor.module.for_layout(layout)
            number = actor.portable.number
            state, expected_state = None, _batch(module.get_initial_state(), 8)
            for _ in range(3):
                seen = rng.normal(size=(8, layout_size(layout))).astype(np.float32)
                action, state = (here if layout == layouts[0] else here.for_layout(layout)).act(seen, state)
                batch: dict[str, Any] = {"obs": torch.from_numpy(seen)}
                if number is not None:
                    batch["obs"] = torch.cat([number.expand(8, -1), batch["obs"]], -1)
                with torch.no_grad():
                    out = module.forward_inference(batch | ({"state_in": expected_state} if expected_state else {}))
                expected_state = out.get("state_out", {})
                _compare(name, action, out["actions"].numpy(), actor.portable)


def _compare(name: str, action: Any, expected: Any, actor: PortableActor) -> None:
    """Raise a ValueError if actions differ from a module's."""
    space = actor.action_space
    if isinstance(space, gym.spaces.Discrete):
        wrong, far = bool((action - space.start != expected).mean() > 0.25), 1.0  # the best two may be equal
    else:
        scale = (space.high - space.low + 1.0 * actor.whole) / 2.0
        near = space.low + (expected + 1.0) * scale
        far = float(
            (np.abs(action - np.clip(np.floor(near) if actor.whole else near, space.low, space.high)) / scale).max()
        )
        wrong = not far <= (2.0 if actor.whole else TOLERANCE)
    if wrong:
        raise ValueError(
            f"traced for ONNX, {type(actor.actor).__name__} of {name} acts otherwise than its module (by {far:.2g}): "
            f"see what networks are made of in docs/your_own.md, or export safetensors"
        )


def _batch(state: Mapping[str, torch.Tensor], size: int) -> dict[str, torch.Tensor]:
    return {name: value.expand(size, *value.shape).clone() for name, value in state.items()}


def _name(given: Any) -> str:
    """A name for an environment: a text, or that of a class or function."""
    return given if isinstance(given, str) else getattr(given, "__name__", type(given).__name__)


def _is_plain(value: Any) -> bool:
    try:
        return json.loads(json.dumps(value, allow_nan=False)) == value
    except (TypeError, ValueError):
        return False


if __name__ == "__main__":
    logging.getLogger("ray").setLevel(logging.ERROR)  # notes of RLlib to its own developers
    main(sys.argv[1:])
