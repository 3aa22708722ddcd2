"""Exported files: flipped, truncated, made up and malicious ones are read or refused, and never run code."""

import dataclasses
import json
import os
import pickle
import struct
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import onnx.helper
import onnx.numpy_helper
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import rllib_maobs as maobs
from rllib_maobs.evaluate import main as evaluate
from rllib_maobs.export import export_agents
from rllib_maobs.exported import CHECKSUM, KEY, UNSEALED, Description, OnnxActor, describe, read_exported, sealed
from rllib_maobs.play import main as play
from rllib_maobs.policies import make_policy
from tests.faults.fuzz import PATHS, attempt, little_memory, nasty, refused, watched
from tests.test_export import made, written

FORMATS = ("onnx", "safetensors")


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A team in both formats."""
    env = maobs.make_vec("spread-3a")
    modules = {
        agent: made(env.action_spaces[agent], observation_layout=[*map(list, layout)], hidden_sizes=[8])
        for agent, layout in env.observation_layouts.items()
    }
    folder = tmp_path_factory.mktemp("fuzz")
    paths = {ending: folder / f"team.{ending}" for ending in FORMATS}
    written(paths["safetensors"], modules)
    paths["onnx"].write_bytes(onnx_of(describe(paths["safetensors"])))
    return paths


def onnx_of(said: Description) -> bytes:
    """A file as the package writes them, by hand: tracing a network takes long."""
    actors = {
        name: dataclasses.replace(
            actor, inputs={f"{name}/observation": [18]}, outputs=[f"{name}/action"], agents=[name], module=None
        )
        for name, actor in said.actors.items()
    }
    weight = onnx.numpy_helper.from_array(np.ones((18, 5), np.float32) / 100, "weight")
    ends = [("observation", 18), ("action", 5)]
    put, out = (
        [onnx.helper.make_tensor_value_info(f"{name}/{end}", 1, ["batch", size]) for name in actors]
        for end, size in ends
    )
    nodes = [onnx.helper.make_node("MatMul", [f"{name}/observation", "weight"], [f"{name}/action"]) for name in actors]
    model = onnx.helper.make_model(
        onnx.helper.make_graph(nodes, "team", put, out, [weight]),
        ir_version=10,
        opset_imports=[onnx.helper.make_opsetid("", 20)],
    )
    description = dataclasses.replace(said, actors=actors).to_json()
    onnx.helper.set_model_props(model, {KEY: description, CHECKSUM: UNSEALED})
    return sealed(model.SerializeToString())


def act(path: Path) -> None:
    """Read a file in all ways that there are, and act with what is in it."""
    description, actors = read_exported(path)
    assert describe(path).team == description.team
    for actor in actors.values():
        zeros = torch.zeros(2, *actor.observation_space.shape)
        if isinstance(actor, OnnxActor):
            actor.act(zeros.numpy())
        else:
            actor.forward_inference({"obs": zeros})
    if path.suffix == ".safetensors":
        maobs.load_agent(path, next(iter(description.actors[next(iter(actors))].agents), None))
    env = maobs.make_vec("spread-3a", num_envs=2)
    env.reset(seed=0)
    actions = make_policy(env, str(path))(env.observe())
    assert actions.shape == (2, 3, 5)


def check(path: Path, content: bytes, tally: Counter[str]) -> bool:
    """Whether a file is refused; in any case it does nothing but being read."""
    path.write_bytes(content)
    with watched() as seen, little_memory():
        sentence = refused(lambda: act(path), tally)
    assert not seen
    return sentence is not None


@given(data=st.data(), ending=st.sampled_from(FORMATS))
def test_flipped_bits(data: Any, ending: str, files: dict[str, Path], tally: Counter[str]) -> None:
    content = bytearray(files[ending].read_bytes())
    if data.draw(st.booleans()):  # what the checksum would hide
        content = content.replace(CHECKSUM.encode(), b"x" * len(CHECKSUM))
    unsealed = CHECKSUM.encode() not in content
    for _ in range(data.draw(st.integers(1, 3))):
        # Most of a file is numbers: what is about them comes first in the one kind, and last in the other.
        near = st.integers(0, 4000) if ending == "safetensors" else st.integers(len(content) - 4000, len(content) - 1)
        place = data.draw(st.one_of(st.integers(0, len(content) - 1), near)) % len(content)
        content[place] ^= 1 << data.draw(st.integers(0, 7))
    found = check(files[ending].with_stem("flipped"), bytes(content), tally)
    if not unsealed and CHECKSUM.encode() in content and content != files[ending].read_bytes():
        tally["bytes flipped"] += 1
        tally["bytes flipped and found"] += found
        assert found


@pytest.mark.parametrize("ending", FORMATS)
def test_a_flipped_weight_is_found(ending: str, files: dict[str, Path]) -> None:
    """Of which nothing but the checksum can tell."""
    content = bytearray(files[ending].read_bytes())
    place = len(content) - 9 if ending == "safetensors" else content.index(np.float32(0.01).tobytes() * 9) + 8
    content[place] ^= 1
    path = files[ending].with_stem("weight")
    path.write_bytes(content)
    assert "is damaged" in str(refused(lambda: act(path)))
    path.write_bytes(content.replace(CHECKSUM.encode(), b"x" * len(CHECKSUM)))
    attempt(lambda: act(path))


@given(data=st.data(), ending=st.sampled_from(FORMATS))
def test_cut_and_patched_files(data: Any, ending: str, files: dict[str, Path], tally: Counter[str]) -> None:
    content = files[ending].read_bytes()
    start, end = sorted(data.draw(st.integers(0, len(content))) for _ in range(2))
    kind = data.draw(st.sampled_from(["cut", "patched", "doubled", "any"]))
    patched = {
        "cut": content[:start],
        "patched": content[:start] + data.draw(st.binary(max_size=20)) + content[end:],
        "doubled": content[:end] + content[start:],
        "any": data.draw(st.binary(max_size=200)),
    }[kind]
    found = check(files[ending].with_stem("cut"), patched, tally)
    assert found or patched == content


def changed(said: Any, path: list[Any], value: Any) -> None:
    """Replace what lies at some path in nested dicts and lists."""
    for key in path[:-1]:
        said = said[key]
    said[path[-1]] = value


def places(said: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """All paths in nested dicts and lists."""
    inside = said.items() if isinstance(said, dict) else enumerate(said) if isinstance(said, list) else ()
    return [place for key, value in inside for place in ((*path, key), *places(value, (*path, key)))]


JSON = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.sampled_from(["", *PATHS[:-3]]),
        st.sampled_from([10**9, 10**30, "os:system", "builtins:eval", "x" * 1000, "agent_1", "mlp", "lstm", "entity"]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=2)),
)  # fmt: skip


@given(data=st.data())
def test_descriptions_that_say_something_else(data: Any, files: dict[str, Path], tally: Counter[str]) -> None:
    """What a stranger may write into the metadata, all else being right."""
    path = files["safetensors"]
    content = path.read_bytes()
    (size,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + size])
    said = json.loads(header["__metadata__"][KEY])
    place = data.draw(st.sampled_from(places(said)))
    changed(said, list(place), data.draw(JSON))
    header["__metadata__"] = {KEY: json.dumps(said)}  # no checksum: a stranger would write the right one
    text = json.dumps(header).encode()
    check(path.with_stem("said"), struct.pack("<Q", len(text)) + text + content[8 + size :], tally)


@given(path=nasty(), agent=nasty())
def test_any_path(path: Any, agent: Any, files: dict[str, Path], tally: Counter[str]) -> None:
    for call in (
        lambda: maobs.load_agent(path),
        lambda: describe(path),
        lambda: read_exported(path),
        lambda: maobs.load_agent(files["safetensors"], agent),
        lambda: export_agents(path, files["onnx"].with_stem("new")),
    ):
        with watched() as seen:
            refused(call, tally)
        assert not seen


# Trust.


class Bomb:
    """Its pickle makes a file."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.mark),)


@pytest.mark.parametrize("ending", [*FORMATS, "ONNX", "pkl.onnx"])
def test_a_pickle_in_the_place_of_a_file_is_not_read(ending: str, tmp_path: Path, tally: Counter[str]) -> None:
    mark = tmp_path / "ran"
    bombs = {"plain": pickle.dumps(Bomb(mark)), "object array": b""}
    np.save(tmp_path / "bomb.npy", np.array([Bomb(mark)], object), allow_pickle=True)
    torch.save(Bomb(mark), tmp_path / "bomb.pt")
    bombs |= {"npy": (tmp_path / "bomb.npy").read_bytes(), "pt": (tmp_path / "bomb.pt").read_bytes()}
    path = tmp_path / f"agent.{ending}"
    for content in bombs.values():
        path.write_bytes(content)
        with watched() as seen:
            for call in (maobs.load_agent, describe, read_exported):
                assert refused(lambda call=call: call(path), tally) is not None
            for main in (
                lambda: play(["spread-3a", "--no-window", "--policy", str(path)]),
                lambda: evaluate([str(path)]),
            ):
                with pytest.raises(SystemExit, match="2"):
                    main()
        assert not [event for event in seen if event[0] != "write"] and not mark.exists()


def test_a_bomb_does_explode_where_pickles_are_read(tmp_path: Path) -> None:
    """So that the test before could fail; and what is watched is seen."""
    with watched() as seen:
        pickle.loads(pickle.dumps(Bomb(tmp_path / "ran")))
    assert (tmp_path / "ran").exists()
    assert {what for what, _ in seen} == {"pickle.find_class", "write"}


def test_a_folder_that_is_called_like_a_file_is_not_read(tmp_path: Path) -> None:
    """A checkpoint is a pickle: it is not read in the place of a file that is none."""
    folder = tmp_path / "agent.safetensors"
    (folder / "learner_group" / "learner" / "rl_module" / "agent_0").mkdir(parents=True)
    for name in ("class_and_ctor_args.pkl", "learner_group/learner/rl_module/agent_0/class_and_ctor_args.pkl"):
        (folder / name).write_bytes(pickle.dumps(Bomb(tmp_path / "ran")))
    env = maobs.make_vec("spread-3a")
    with watched() as seen:
        for call in (maobs.load_agent, describe, read_exported, lambda path: make_policy(env, str(path))):
            assert "there is no file" in str(refused(lambda call=call: call(folder)))
    assert not seen


def test_an_actor_of_a_file_is_not_imported(tmp_path: Path, files: dict[str, Path]) -> None:
    """Importing a module runs it."""
    (tmp_path / "evil.py").write_text("raise SystemExit('imported')\n")
    content = files["safetensors"].read_bytes()
    (size,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + size])
    said = json.loads(header["__metadata__"][KEY])
    for actor in said["actors"].values():
        actor["module"]["model_config"]["actor"] = "evil:Actor"
    header["__metadata__"] = {KEY: json.dumps(said)}  # no checksum: a stranger would write the right one
    text = json.dumps(header).encode()
    path = tmp_path / "agent.safetensors"
    path.write_bytes(struct.pack("<Q", len(text)) + text + content[8 + size :])
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(tmp_path))
        assert "a class that is not this package's" in str(refused(lambda: maobs.load_agent(path, "agent_0")))


def test_what_the_fuzzers_flip_is_right_by_itself(files: dict[str, Path]) -> None:
    for path in files.values():
        attempt(lambda path=path: act(path))
