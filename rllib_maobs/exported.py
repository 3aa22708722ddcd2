"""Files for sharing agents, safetensors and ONNX: what is in them, and how they are read. Reading one runs no code.

Both hold the same description under the key "rllib_maobs" of their metadata, as JSON (see `Description`).
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from rllib_maobs.layout import Layout, as_layout, layout_size, split
from rllib_maobs.modules import ACTORS, Actor, AgentModule, UtilityModule
from rllib_maobs.paths import local

FORMATS = (".onnx", ".safetensors")
KEY = "rllib_maobs"
CHECKSUM = "rllib_maobs_crc32"
UNSEALED = "00000000"  # what stands in the place of the checksum that is being computed
_SEAL = re.compile(CHECKSUM.encode() + rb"\W{1,8}([0-9a-f]{8})")
VERSION = 1
CLASSES = {"AgentModule": AgentModule, "UtilityModule": UtilityModule}
# What of a module's settings a file may set: acting needs no others, and no other is looked at.
SETTINGS = (
    "actor",
    "actor_settings",
    "hidden_sizes",
    "activation",
    "lstm_cell_size",
    "observation_layout",
    "seq_length",
    "stored_state",
    "normalize_observations",
)


@dataclass(frozen=True)
class ActorDescription:
    """One actor of a file.

    Attributes:
        agents: Whom it acted for.
        observation_layout: What their observation is made of, as groups (name, count, size, position).
        action: Bounds of the environment's actions, `{"low": [...], "high": [...], "dtype": "float32"}`, or discrete
            ones, `{"n": 5, "start": 0}`.
        inputs: Names and shapes of what it observes, in order; null for what has any length.
        state: The same for what a recurrent actor remembers; all zeros at an episode's start.
        outputs: Names of the action, and of the state for the next call.
        module: Of safetensors: the RLModule's class and settings.
    """

    agents: list[str]
    observation_layout: list[list[Any]]
    action: dict[str, Any]
    inputs: dict[str, list[int | None]]
    state: dict[str, list[int | None]]
    outputs: list[str]
    module: dict[str, Any] | None = None

    @property
    def layout(self) -> Layout:
        """What the observation is made of."""
        return as_layout(self.observation_layout, None, "observation")

    @property
    def action_space(self) -> gym.Space[Any]:
        """The environment's."""
        if "n" in self.action:
            return gym.spaces.Discrete(self.action["n"], start=self.action["start"])
        bounds = (np.array(self.action[name], self.action["dtype"]) for name in ("low", "high"))
        return gym.spaces.Box(*bounds, dtype=np.dtype(self.action["dtype"]).type)


@dataclass(frozen=True)
class Description:
    """What a file says of itself.

    Attributes:
        version: Of this form of description.
        package_version: Of the package that wrote it.
        algorithm: That trained it.
        env: What it was trained on: an id of this package, or another name.
        env_options: Options of the environment, those of its evaluation.
        agent_id_input: Whether observations of the modules begin with the agent's number (in ONNX files it is inside).
        team: All agents of the training.
        actors: Who is in the file, by name.
    """

    version: int
    package_version: str
    algorithm: str
    env: str
    env_options: dict[str, Any]
    agent_id_input: bool
    team: list[str]
    actors: dict[str, ActorDescription]

    def to_json(self) -> str:
        """The text that files hold.

        Raises:
            ValueError: If a value is no plain one.
        """
        return json.dumps(asdict(self), allow_nan=False, default=_refuse)

    def actor_of(self, agent: str) -> str:
        """The name of the actor that acts for an agent; the agent's own if there is none."""
        for name, actor in self.actors.items():
            if agent in actor.agents:
                return name
        # One that all of a team shared acts in larger teams, too.
        shared = [name for name, actor in self.actors.items() if actor.agents == self.team and not self.agent_id_input]
        return shared[0] if shared else agent


def sealed(content: bytes) -> bytes:
    """A file with its checksum under the key `CHECKSUM` of its metadata, where `UNSEALED` stood before."""
    place = _SEAL.search(content)
    assert place is not None
    return content[: place.start(1)] + b"%08x" % zlib.crc32(content) + content[place.end(1) :]


def _check_whole(path: Path, content: bytes) -> None:
    """Raise a ValueError for a file that is not as it was written; those without a checksum are not checked."""
    if CHECKSUM.encode() not in content:
        return
    place = _SEAL.search(content)
    unsealed = content[: place.start(1)] + UNSEALED.encode() + content[place.end(1) :] if place else b""
    if place is None or zlib.crc32(unsealed) != int(place.group(1), 16):
        raise ValueError(f"{str(path)!r} is damaged: it is not as it was written, says its checksum")


def is_exported(path: str | Path) -> bool:
    """Whether a path names an exported file, by its ending."""
    return Path(path).suffix.lower() in FORMATS


def load_agent(path: str | Path, agent: str | None = None, actor: type[Actor] | None = None) -> AgentModule:
    """Make an RLModule of a safetensors file that `python -m rllib_maobs.export` wrote.

    ```python
    module = maobs.load_agent("agent_0.safetensors")
    action = module.forward_inference({"obs": obs})["actions"]  # (B, O) -> (B, A) in [-1, 1]
    ```

    No code of the file's is run: it holds numbers and names.

    Args:
        path: The file.
        agent: Whose module; None if all agents in the file have one.
        actor: The actor's class, if it is not one of this package.

    Returns:
        The module, for acting; see `AgentModule`. With `agent_id_input` it expects the agent's number before the
        observation, as in training.

    Raises:
        ValueError: If that is no such file, it has no such agent, or its weights do not fit.
        ImportError: If safetensors is not installed.
    """
    if local(path).suffix.lower() != ".safetensors":
        raise ValueError(f"{str(path)!r} can't be made an RLModule; legal: a .safetensors file.")
    description, modules = read_exported(path, actor)
    agents = [name for each in description.actors.values() for name in each.agents]
    if agent is None and len(modules) > 1:
        raise ValueError(f"{str(path)!r} holds several agents: say which, agent= one of {', '.join(agents)}.")
    if agent is not None and not (isinstance(agent, str) and agent in agents):
        raise ValueError(f"{str(path)!r} has no agent {agent!r}; it has {', '.join(agents)}.")
    module = modules[next(iter(modules)) if agent is None else description.actor_of(agent)]
    assert isinstance(module, AgentModule)
    return module


def describe(path: str | Path) -> Description:
    """Return what an exported file says of itself.

    Raises:
        ValueError: If it says nothing, or nothing that can be understood.
        ImportError: If what reads it is not installed.
    """
    return _parsed(local(path), _opened(local(path))[0])


def read_exported(
    path: str | Path, actor: type[Actor] | None = None
) -> tuple[Description, dict[str, AgentModule | OnnxActor]]:
    """Read an exported file.

    Args:
        path: The file.
        actor: Class of its actors, where it is not one of this package.

    Returns:
        What it says of itself, and its actors by name.

    Raises:
        ValueError: If it is damaged, or not one of this package.
        ImportError: If what reads it is not installed.
    """
    path = local(path)
    metadata, content = _opened(path)
    description = _parsed(path, metadata)
    try:
        if path.suffix.lower() == ".onnx":
            actors: dict[str, AgentModule | OnnxActor] = {}
            for name in description.actors:
                actors[name] = actor_of_file = OnnxActor(content, description, name)
                actor_of_file.check()
            return description, actors
        return description, {name: _module(description, name, content, actor) for name in description.actors}
    except Exception as error:  # whatever networks say to settings that are a stranger's
        raise ValueError(f"{str(path)!r} can't be read: {error}") from error


class OnnxActor:
    """One actor of an ONNX file, run by ONNX Runtime.

    Attributes:
        observation_space: The environment's.
        action_space: The environment's.
        model_config: The observation's layout, where `AgentModule` has it.

    Args:
        session: ONNX Runtime's.
        description: Of the file.
        name: Of the actor.
        layout: What observations are made of, if not what they were in training.
    """

    def __init__(self, session: Any, description: Description, name: str, layout: Layout | None = None) -> None:
        self._made_of = session, description, name
        self._actor = actor = description.actors[name]
        self._layout = actor.layout if layout is None else layout
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (layout_size(self._layout),), np.float32)
        self.action_space = actor.action_space
        self.model_config = {"observation_layout": [list(group) for group in self._layout]}
        known = {put.name for put in (*session.get_inputs(), *session.get_outputs())}
        if missing := [key for key in (*actor.inputs, *actor.state, *actor.outputs) if key not in known]:
            raise ValueError(f"its network has no {', '.join(missing)}")
        # ONNX Runtime wants all inputs; those of the file's other actors are zeros.
        self._others = {
            key: np.zeros([1, *(size or 1 for size in shape)], np.float32)
            for other, each in description.actors.items()
            for key, shape in {**each.inputs, **each.state}.items()
            if other != name
        }

    def check(self) -> None:
        """Act once, whatever ONNX Runtime then raises; raise a ValueError if that is no action of its space."""
        action, _ = self.act(np.zeros((2, *self.observation_space.shape), np.float32))
        if np.shape(action) != (2, *(self.action_space.shape or ())):
            raise ValueError(f"its network acts by an array {np.shape(action)} in {self.action_space}")

    @property
    def _free(self) -> bool:
        """Whether it takes an array for each group, of any number of entities."""
        return any(None in shape for shape in self._actor.inputs.values())

    def for_layout(self, layout: Layout) -> OnnxActor:
        """The same for a team of another size.

        Raises:
            ValueError: If it acts on one size only, or on other groups.
        """
        here, there = ([(g.name, g.size, g.position, g.position or g.count) for g in x] for x in (self._layout, layout))
        if not self._free or here != there:
            raise ValueError("its networks have one size")
        return OnnxActor(*self._made_of, layout)

    def act(
        self, observations: NDArray[np.float32], state: dict[str, NDArray[np.float32]] | None = None
    ) -> tuple[NDArray[Any], dict[str, NDArray[np.float32]]]:
        """Act.

        Args:
            observations: `(B, O)`.
            state: What the last call returned; None at an episode's start.

        Returns:
            Actions as the environment takes them `(B, A)`, or the numbers `(B,)` of discrete ones; and the state.
        """
        (session, *_), actor = self._made_of, self._actor
        seen = list(split(self._layout, observations).values()) if self._free else [observations]
        if state is None:
            # The first states are windows of what is seen, (B, T, ...).
            shapes = [[steps, *array.shape[1:]] for array, (steps, *_) in zip(seen, actor.state.values(), strict=False)]
            shapes += [*actor.state.values()][len(shapes) :]
            zeros = (np.zeros((len(observations), *shape), np.float32) for shape in shapes)
            state = dict(zip(actor.state, zeros, strict=True))
        inputs = dict(zip(actor.inputs, seen, strict=True))
        action, *following = session.run(actor.outputs, {**self._others, **inputs, **state})
        return action, dict(zip(actor.state, following, strict=True))


def _opened(path: Path) -> tuple[Mapping[str, str], Any]:
    """A file's metadata, and its content: an ONNX Runtime session, or tensors by name."""
    if not path.is_file():
        raise ValueError(f"there is no file {str(path)!r}")
    content = path.read_bytes()
    _check_whole(path, content)
    if path.suffix.lower() == ".onnx":
        runtime = _needed("onnxruntime")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = 1  # these networks are small
        options.log_severity_level = 4  # what is wrong is said by the error
        try:
            # From bytes, so that the file cannot refer to others.
            session = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
            return session.get_modelmeta().custom_metadata_map, session
        except Exception as error:  # ONNX Runtime's own classes
            raise ValueError(f"{str(path)!r} is no ONNX file that can be read: {error}") from error
    safetensors = _needed("safetensors")
    try:
        with safetensors.safe_open(path, "pt") as file:
            return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}
    except safetensors.SafetensorError as error:
        raise ValueError(f"{str(path)!r} is no safetensors file that can be read: {error}") from error


def _parsed(path: Path, metadata: Mapping[str, str]) -> Description:
    """What a file's metadata say of it, checked."""
    if KEY not in metadata:
        raise ValueError(f"{str(path)!r} is not of this package: python -m rllib_maobs.export writes such files")
    try:
        said = json.loads(metadata[KEY])
        if said["version"] != VERSION:
            raise ValueError(f"it is of version {said['version']!r}, and this package reads {VERSION}")
        actors = {name: ActorDescription(**actor) for name, actor in said.pop("actors").items()}
        description = Description(**said, actors=actors)
        if not actors or not isinstance(description.env_options, dict):
            raise ValueError("it names no actor, or no options of the environment")
        for actor in actors.values():
            names = [*description.team, *actor.agents, *actor.inputs, *actor.state, *actor.outputs]
            sizes = [size for shape in (*actor.inputs.values(), *actor.state.values()) for size in shape]
            if not all(isinstance(name, str) for name in names) or not all(s is None or 0 <= int(s) for s in sizes):
                raise ValueError("names must be texts, and shapes numbers")
            _ = actor.layout, actor.action_space  # whether they can be made
    except (ValueError, TypeError, KeyError, AttributeError, AssertionError, RecursionError) as error:
        raise ValueError(f"what {str(path)!r} says of itself can't be understood: {error!r}") from error
    return description


def _module(
    description: Description, name: str, tensors: Mapping[str, torch.Tensor], given: type[Actor] | None
) -> AgentModule:
    """The RLModule of one actor in a safetensors file."""
    actor = description.actors[name]
    said = actor.module or {}
    settings = {key: value for key, value in said["model_config"].items() if key in SETTINGS}
    # A place ("package.module:Class") would be imported, which runs what is there.
    if given is None and settings.get("actor", "mlp") not in ACTORS:
        raise ValueError(
            f"its actor is {settings['actor']!r}, a class that is not this package's: give it to "
            f"load_agent(path, actor=...), or make the class known by ACTORS.register, or share an ONNX file instead"
        )
    own = {key.removeprefix(f"{name}/"): value for key, value in tensors.items() if key.startswith(f"{name}/")}
    size = layout_size(as_layout(settings["observation_layout"], None, "observation"))

    def make() -> AgentModule:
        return CLASSES[said["class"]](
            observation_space=gym.spaces.Box(-np.inf, np.inf, (size,), np.float32),
            action_space=actor.action_space,
            inference_only=True,
            model_config=settings | ({} if given is None else {"actor": given}),
        )

    with torch.device("meta"):  # nothing is allocated before the sizes are known to be those of the file
        expected = {key: tuple(value.shape) for key, value in make().state_dict().items()}
    if expected != (there := {key: tuple(value.shape) for key, value in own.items()}):
        differ = sorted({*expected.items()} ^ {*there.items()})
        raise ValueError(f"the weights of {name} are not those of its settings: {differ[0][0]} differs")
    module = make()
    module.load_state_dict(own)
    return module


def _needed(name: str) -> Any:
    """An optional package."""
    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(f'exported files need {name}: pip install -c constraints.txt -e ".[export]"') from error


def _refuse(value: Any) -> Any:
    raise ValueError(f"{value!r} is no plain value")
