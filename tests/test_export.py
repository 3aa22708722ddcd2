"""Exported files act as the modules they were made of, everywhere they go, and reading one runs no code."""

import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module import RLModule
from ray.rllib.utils.spaces.space_utils import unsquash_action
from safetensors import safe_open
from safetensors.torch import save_file

import rllib_maobs as maobs
from rllib_maobs import export as command
from rllib_maobs.experiment.rows import check_row
from rllib_maobs.export import export_agents
from rllib_maobs.exported import KEY, describe, read_exported
from rllib_maobs.layout import Entities, layout_size, split
from rllib_maobs.modules.portable import PortableActor
from rllib_maobs.paths import file_name, write_aside
from rllib_maobs.play import main as play_main
from rllib_maobs.policies import make_policy, play_episodes, saved_options
from tests.conftest import small_config
from tests.test_names import Listed

ROOT = Path(__file__).parent.parent
STEPS = 6
LAYOUT = [["self", 1, 4, 0], ["target", 3, 2, 2], ["obstacle", 2, 2, 2], ["agent", 2, 3, 2]]
CONTINUOUS = gym.spaces.Box(np.array([-1.0, 0.0, -3.0], np.float32), np.array([1.0, 5.0, -2.0], np.float32))
DISCRETE = gym.spaces.Discrete(4, start=2)


class Sums(maobs.Actor):
    """An actor of one's own: the sum of each group."""

    def __init__(self, layout: Any, num_outputs: int) -> None:
        super().__init__(layout, num_outputs)
        self.layer = torch.nn.Linear(sum(group.size for group in layout), num_outputs)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.layer(torch.cat([g.sum(-2) for g in split(self.layout, observation).values()], dim=-1))


class Counting(maobs.RecurrentActor):
    """A recurrent actor of one's own that does not start from zeros."""

    def __init__(self, layout: Any, num_outputs: int) -> None:
        super().__init__(layout, num_outputs)
        self.layer = torch.nn.Linear(layout_size(layout) + 1, num_outputs)

    def initial_state(self) -> torch.Tensor:
        return torch.full((1,), 0.7)

    def forward(self, observation: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:  # type: ignore[override]
        return self.layer(torch.cat([observation, state], -1)), state + 0.1


class Branching(maobs.Actor):
    """What cannot be traced."""

    def __init__(self, layout: Any, num_outputs: int) -> None:
        super().__init__(layout, num_outputs)
        self.layer = torch.nn.Linear(layout_size(layout), num_outputs)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.layer(observation) if observation.sum() > 0 else self.layer(-observation)


def made(space: gym.Space = CONTINUOUS, cls: Any = maobs.AgentModule, seed: int = 0, **settings: Any) -> Any:
    torch.manual_seed(seed)
    settings = {"observation_layout": LAYOUT, **settings}
    size = layout_size(tuple(Entities(*group) for group in settings["observation_layout"]))
    module = cls(
        observation_space=gym.spaces.Box(-np.inf, np.inf, (size,), np.float32),
        action_space=space,
        inference_only=True,
        model_config=settings,
    )
    if settings.get("normalize_observations"):
        for parameter in module.normalizer.parameters():
            parameter.data.copy_(1.0 + torch.rand_like(parameter))
    return module


def written(path: Path, modules: dict[str, Any]) -> Path:
    """Modules of policies by agent as a file, without a checkpoint."""
    team = [*modules]
    source = {name: command._Exported(module, PortableActor(module)) for name, module in modules.items()}
    ending = path.suffix
    described = {
        name: command._described(
            actor,
            [name],
            f"{name}/" if len(team) > 1 else "",
            command._settings(actor.module) if ending == ".safetensors" else None,
        )
        for name, actor in source.items()
    }
    description = command.Description(1, "0", "MADDPG", "elsewhere", {}, False, team, described)
    write = command._onnx if ending == ".onnx" else command._safetensors
    write_aside(path, write(source, description))
    return path


# Tracing takes seconds, so networks are small, and windows short.
KINDS: dict[str, dict[str, Any]] = {
    "mlp": {"normalize_observations": True, "hidden_sizes": [8]},
    "lstm": {"actor": "lstm", "seq_length": 2, "stored_state": True, "normalize_observations": True},
    "entity": {"actor": "entity", "actor_settings": {"near": 0.2}},
    "entity-lstm": {"actor": "entity-lstm", "seq_length": 2, "observation_layout": LAYOUT[:2]},
    "discrete": {"space": DISCRETE, "normalize_observations": True},
    "utility": {"space": DISCRETE, "cls": maobs.UtilityModule},
    "integers": {"space": gym.spaces.Box(np.array([0, -2]), np.array([3, 2]), dtype=np.int64)},
    "own": {"actor": Sums},
    "own-recurrent": {"actor": Counting, "seq_length": 2, "stored_state": True},
}


def expected_actions(module: Any, observations: np.ndarray) -> np.ndarray:
    """What a module does over steps (T, B, O), as its environment takes it: (T, B, A)."""
    state = {name: v.expand(len(observations[0]), *v.shape).clone() for name, v in module.get_initial_state().items()}
    actions = []
    for seen in observations:
        with torch.no_grad():
            out = module.forward_inference({"obs": torch.from_numpy(seen), **({"state_in": state} if state else {})})
        state, action = out.get("state_out", {}), out["actions"].numpy()
        space = module.action_space
        if isinstance(space, gym.spaces.Discrete):
            action = action + space.start
        elif np.issubdtype(space.dtype, np.integer):
            shares = space.low + (action + 1) / 2 * (space.high - space.low + 1)
            action = np.clip(np.floor(shares), space.low, space.high)
        else:
            action = unsquash_action(action, space)
        actions.append(action)
    return np.stack(actions)


def onnx_actions(path: Path, observations: np.ndarray, layout: Any) -> np.ndarray:
    """The same of an ONNX file, by ONNX Runtime and what the file says alone."""
    session = onnxruntime.InferenceSession(path)
    said = json.loads(session.get_modelmeta().custom_metadata_map[KEY])
    (actor,) = said["actors"].values()
    groups = split(layout, observations)
    state = {}
    for name, shape in actor["state"].items():
        # The only free size of a state is the number of entities in its group.
        count = groups[name.partition(".")[2]].shape[-2] if None in shape else 0
        state[name] = np.zeros([observations.shape[1], *(count if n is None else n for n in shape)], np.float32)
    actions = []
    for step, seen in enumerate(observations):
        free = "observation" not in actor["inputs"]
        inputs = {n: groups[n.partition(".")[2]][step] for n in actor["inputs"]} if free else {"observation": seen}
        action, *following = session.run(actor["outputs"], {**inputs, **state})
        state = dict(zip(state, following, strict=True))
        actions.append(action)
    return np.stack(actions)


def compared(path: Path, module: Any) -> None:
    """An ONNX file's actions are the module's; with entity networks in teams of other sizes, too."""
    space, base = module.action_space, tuple(Entities(*group) for group in module.model_config["observation_layout"])
    layouts = [base]
    if module.acting.takes_groups:
        layouts += [tuple(g._replace(count=n) if g.position else g for g in base) for n in (0, 1, 5)]
    for layout in layouts:
        observations = np.random.default_rng(0).normal(size=(STEPS, 4, layout_size(layout))).astype(np.float32)
        observations[:, 0] = 0.0  # on top of everything, too
        here = module if layout == base else module.for_layout(layout)
        want, got = expected_actions(here, observations), onnx_actions(path, observations, layout)
        np.testing.assert_allclose(got, want, atol=1e-5)
        assert len(np.unique(want.round(4))) > 1
        if isinstance(space, gym.spaces.Box):
            assert all(space.contains(action.astype(space.dtype)) for action in got.reshape(-1, *space.shape))


@pytest.mark.parametrize("kind", KINDS)
def test_the_network_to_be_traced_acts_as_the_module(kind: str) -> None:
    module = made(**KINDS[kind])
    portable, layout = PortableActor(module), tuple(Entities(*g) for g in module.model_config["observation_layout"])
    observations = np.random.default_rng(0).normal(size=(STEPS, 4, layout_size(layout))).astype(np.float32)
    state, actions = [torch.zeros(4, *shape) for shape in portable.state.values()], []
    for seen in torch.from_numpy(observations):
        inputs = split(layout, seen).values() if portable.free else [seen]
        action, *state = portable(*inputs, *state)
        actions.append(action.numpy())
    np.testing.assert_allclose(np.stack(actions), expected_actions(module, observations), atol=1e-5)


@pytest.mark.parametrize("kind", ["mlp", "lstm", "entity-lstm", "discrete", "integers", "own"])  # tracing takes seconds
def test_onnx_runtime_acts_as_the_module(kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    module = made(**KINDS[kind])
    path = written(tmp_path / "agent.onnx", {"agent_0": module})
    onnx.checker.check_model(str(path))
    assert str(ROOT).encode() not in path.read_bytes() and b"site-packages" not in path.read_bytes()
    capfd.readouterr()
    compared(path, module)
    assert not capfd.readouterr().err  # ONNX Runtime has nothing to warn of


def test_what_cannot_be_traced_is_named_and_nothing_is_written(tmp_path: Path) -> None:
    path = tmp_path / "agent.onnx"
    with pytest.raises(ValueError, match=r"Branching can't be traced for ONNX \(.+\): see what .*export safetensors"):
        written(path, {"agent_0": made(actor=Branching)})
    assert not list(tmp_path.iterdir())


def test_actions_without_bounds_are_refused() -> None:
    with pytest.raises(ValueError, match="Actions without bounds can't be exported"):
        PortableActor(made(gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)))


# Safetensors


@pytest.mark.parametrize("kind", ["lstm", "entity", "utility", "discrete", "own-recurrent"])
def test_safetensors_come_back_as_a_module(kind: str, tmp_path: Path) -> None:
    module = made(**KINDS[kind])
    path = written(tmp_path / "agent.safetensors", {"agent_0": module})
    back = maobs.load_agent(path, actor=KINDS[kind]["actor"] if kind.startswith("own") else None)
    assert type(back) is type(module) and back.action_space == module.action_space
    observations = np.random.default_rng(0).normal(size=(STEPS, 4, 20)).astype(np.float32)
    np.testing.assert_array_equal(expected_actions(back, observations), expected_actions(module, observations))


def test_classes_that_cannot_be_imported_are_given_and_modules_of_ones_own_refused(tmp_path: Path) -> None:
    class Here(Sums):
        pass

    class Own(maobs.AgentModule):
        pass

    module = made(actor=Here)
    path = written(tmp_path / "agent.safetensors", {"agent_0": module})
    observations = np.random.default_rng(0).normal(size=(1, 4, 20)).astype(np.float32)
    got = expected_actions(maobs.load_agent(path, actor=Here), observations)
    np.testing.assert_array_equal(got, expected_actions(module, observations))
    with pytest.raises(ValueError, match="Own is a module of your own; safetensors take this package's: export onnx"):
        written(tmp_path / "own.safetensors", {"agent_0": made(cls=Own)})


def edited(path: Path, change: Any) -> Path:
    """A safetensors file whose description was changed."""
    with safe_open(path, "pt") as file:
        said, tensors = json.loads(file.metadata()[KEY]), {name: file.get_tensor(name) for name in file.keys()}
    change(said)
    target = path.with_name("edited.safetensors")
    save_file(tensors, target, {KEY: json.dumps(said)})
    return target


def test_reading_a_file_imports_nothing_that_it_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "trap.py").write_text("raise SystemExit('code of the file was run')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(pickle, "loads", lambda *a, **k: pytest.fail("unpickled"))
    monkeypatch.setattr(torch, "load", lambda *a, **k: pytest.fail("unpickled"))
    path = written(tmp_path / "agent.safetensors", {"agent_0": made(hidden_sizes=[4])})
    settings = {"actor": "trap:Actor", "critic": "trap:Critic", "exploration": {"type": "trap:Noise"}}

    def trap(said: Any, *names: str) -> None:
        said["actors"]["agent_0"]["module"]["model_config"] |= {name: settings[name] for name in names}

    with pytest.raises(ValueError, match="its actor is 'trap:Actor', a class that is not this package's: give it to"):
        maobs.load_agent(edited(path, lambda said: trap(said, "actor")))
    module = maobs.load_agent(edited(path, lambda said: trap(said, "critic", "exploration")))
    assert not {"critic", "exploration"} & {*module.model_config}
    assert "trap" not in sys.modules


def _set(*place: str, value: Any) -> Any:
    def change(said: Any) -> None:
        for key in place[:-1]:
            said = said[key]
        said[place[-1]] = value

    return change


ACTOR = ("actors", "agent_0")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("version", value=2), "it is of version 2, and this package reads 1"),
        (_set("actors", value={}), "it names no actor"),
        (_set("more", value=1), "unexpected keyword argument 'more'"),
        (_set(*ACTOR, "action", value={"low": [0], "high": [1]}), "KeyError"),
        (_set(*ACTOR, "inputs", value=3), "can't be understood"),
        (_set(*ACTOR, "observation_layout", value=[["self", -1, 4]]), "legal are a name, a count >= 0"),
        # What would take more memory than there is.
        (_set(*ACTOR, "module", "model_config", "hidden_sizes", value=[10**7, 10**7]), "weights of agent_0 are not"),
        (_set(*ACTOR, "module", "model_config", "hidden_sizes", value="many"), "can't be read"),
        (_set(*ACTOR, "module", "model_config", "hidden_sizes", value=[-1]), "can't be read: Trying to create tensor"),
        (_set(*ACTOR, "module", "class", value="os.system"), "can't be read: 'os.system'"),
        (_set(*ACTOR, "module", value=None), "can't be read"),
    ],
)
def test_files_that_lie_are_refused(change: Any, message: str, tmp_path: Path) -> None:
    path = written(tmp_path / "agent.safetensors", {"agent_0": made(hidden_sizes=[4])})
    with pytest.raises(ValueError, match=re.escape(message)):
        maobs.load_agent(edited(path, change))


@pytest.mark.parametrize("ending", [".onnx", ".safetensors"])
def test_files_that_are_none_are_refused(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"agent{ending}"
    with pytest.raises(ValueError, match="there is no file"):
        describe(path)
    path.write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(ValueError, match=r"is no (ONNX|safetensors) file that can be read"):
        describe(path)
    if ending == ".safetensors":
        save_file({"a": torch.zeros(1)}, path)
        with pytest.raises(ValueError, match=r"is not of this package: python -m rllib_maobs.export writes such files"):
            describe(path)


def test_an_onnx_file_reads_no_other_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret").write_bytes(np.zeros(4, np.float32).tobytes())
    weights = onnx.TensorProto(name="w", data_type=1, dims=[4], data_location=onnx.TensorProto.EXTERNAL)
    place = weights.external_data.add()
    place.key, place.value = "location", "secret"
    node, out = onnx.helper.make_node("Identity", ["w"], ["y"]), onnx.helper.make_tensor_value_info("y", 1, [4])
    graph = onnx.helper.make_graph([node], "graph", [], [out], [weights])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=10)
    (tmp_path / "agent.onnx").write_bytes(model.SerializeToString())
    onnxruntime.InferenceSession(tmp_path / "agent.onnx")  # as it would be read elsewhere
    with pytest.raises(ValueError, match="is no ONNX file that can be read"):
        describe(tmp_path / "agent.onnx")


def test_one_agent_of_several_is_asked_for_by_name(tmp_path: Path) -> None:
    modules = {"a": made(seed=1, hidden_sizes=[4]), "b": made(seed=2, hidden_sizes=[4])}
    path = written(tmp_path / "team.safetensors", modules)
    with pytest.raises(ValueError, match="holds several agents: say which, agent= one of a, b"):
        maobs.load_agent(path)
    with pytest.raises(ValueError, match="has no agent 'c'; it has a, b"):
        maobs.load_agent(path, "c")
    observations = np.random.default_rng(0).normal(size=(1, 4, 20)).astype(np.float32)
    got = expected_actions(maobs.load_agent(path, "b"), observations)
    np.testing.assert_array_equal(got, expected_actions(modules["b"], observations))
    with pytest.raises(ValueError, match=r"can't be made an RLModule; legal: a \.safetensors file"):
        maobs.load_agent(tmp_path / "team.onnx")


# Of checkpoints, by the commands


@pytest.fixture(scope="module")
def checkpoints(ray_session: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """An LSTM team whose agents have policies of their own, and agents that share one and know their numbers."""
    configs = {
        "own": small_config("maddpg-lstm", num_agents=2, num_obstacles=1).training(seq_length=2),
        "shared": small_config("maddpg", action_mode="force")
        .training(actor="entity")
        .multi_agent(policies={"all"}, policy_mapping_fn=lambda agent, *args, **kwargs: "all"),
        "numbered": small_config("iql", num_agents=2)
        .training(agent_id_input=True)
        .multi_agent(policies={"all"}, policy_mapping_fn=lambda agent, *args, **kwargs: "all"),
    }
    paths = {}
    for name, config in configs.items():
        algo = config.build_algo()
        algo.train()
        paths[name] = algo.save_to_path(str(tmp_path_factory.mktemp("checkpoints") / name))
        algo.stop()
    yield paths


@pytest.fixture(scope="module")
def files(checkpoints: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("files")
    found = {}
    for name, checkpoint in checkpoints.items():
        for ending in (".onnx", ".safetensors"):
            found[name + ending] = folder / f"{name}{ending}"
            export_agents(checkpoint, found[name + ending])
    return found


@pytest.mark.parametrize("ending", [".onnx", ".safetensors"])
@pytest.mark.parametrize("name", ["own", "shared", "numbered"])
def test_a_file_plays_like_its_checkpoint(
    name: str, ending: str, checkpoints: dict[str, str], files: dict[str, Path]
) -> None:
    options = saved_options(checkpoints[name], "spread-3a")
    sizes = [{}, {"num_agents": 5}, {"num_agents": 1, "num_obstacles": 0}] if name == "shared" else [{}]
    for size in sizes:
        tables = []
        for policy in (checkpoints[name], str(files[name + ending])):
            env = maobs.make_vec("spread-3a", num_envs=2, horizon=10, **options, **size)
            tables.append(play_episodes(env, make_policy(env, policy), seed=3))
        np.testing.assert_allclose(tables[1]["return"], tables[0]["return"], rtol=1e-4)


def loaded(checkpoints: dict[str, str]) -> Any:
    return RLModule.from_checkpoint(f"{checkpoints['shared']}/learner_group/learner/rl_module/all")


def test_onnx_runtime_acts_as_the_module_of_a_checkpoint(checkpoints: dict[str, str], files: dict[str, Path]) -> None:
    compared(
        files["shared.onnx"], RLModule.from_checkpoint(f"{checkpoints['shared']}/learner_group/learner/rl_module/all")
    )


def test_a_trace_that_acts_otherwise_is_refused(files: dict[str, Path], checkpoints: dict[str, str]) -> None:
    module = loaded(checkpoints)
    source = {"all": command._Exported(module, PortableActor(module))}
    content, said = files["shared.onnx"].read_bytes(), describe(files["shared.onnx"])
    command._check(content, source, said)
    module.acting.layers[-1].bias.data += 1e-4
    with pytest.raises(ValueError, match="EntityActor of all acts otherwise than its module"):
        command._check(content, source, said)


def test_a_file_says_what_it_was_trained_on(files: dict[str, Path]) -> None:
    said = describe(files["own.onnx"])
    assert (said.algorithm, said.env, said.env_options) == (
        "maddpg-lstm",
        "spread-3a",
        {"num_agents": 2, "num_obstacles": 1},
    )
    assert said.package_version == maobs.__version__ and said.team == ["agent_0", "agent_1"]
    assert said.actors["agent_1"].agents == ["agent_1"]
    assert said.actors["agent_1"].observation_layout[1] == ["target", 2, 2, 2]
    assert said.actors["agent_1"].action_space == gym.spaces.Box(-1.0, 1.0, (5,), np.float32)
    assert describe(files["shared.onnx"]).actors["all"].agents == ["agent_0", "agent_1", "agent_2"]


def test_commands_take_files_with_the_options_inside(
    files: dict[str, Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    play_main(["spread-3a", "--policy", str(files["own.safetensors"]), "--no-window", "horizon=5"])
    assert "options of the checkpoint: num_agents=2 num_obstacles=1" in capsys.readouterr().out
    from rllib_maobs.evaluate import main as evaluate_main

    table = tmp_path / "table.json"
    evaluate_main(
        [str(files["shared.onnx"]), "--num-agents", "2", "--episodes", "2", "--json", str(table), "horizon=5"]
    )
    rows = {row["policy"]: row for row in json.loads(table.read_text())}
    assert set(rows) == {"random", "heuristic", "orca", "shared.onnx"} and rows["shared.onnx"]["agents"] == 2


def test_what_a_file_does_not_fit_is_said(files: dict[str, Path]) -> None:
    with pytest.raises(ValueError, match=r"file .*own\.onnx has no module for agent_2; it has agent_0, agent_1"):
        make_policy(maobs.make_vec("spread-3a"), str(files["own.onnx"]))
    with pytest.raises(ValueError, match=r"observes \(30,\) .* but was trained on \(12,\)"):
        make_policy(maobs.make_vec("spread-3a", num_agents=2, num_obstacles=10), str(files["own.onnx"]))
    with pytest.raises(ValueError, match=r"has actions \(5,\) .* trained with \(2,\): .* such as action_mode=force"):
        make_policy(maobs.make_vec("spread-3a"), str(files["shared.onnx"]))


def test_the_command_writes_aside_and_replaces_nothing(
    checkpoints: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [checkpoints["own"], "--agent", "agent_1", "--format", "safetensors"]
    command.main(arguments)
    path = tmp_path / "agent_1.safetensors"
    before = path.read_bytes()
    assert "written: agent_1.safetensors" in capsys.readouterr().out
    assert [*read_exported(path)[1]] == ["agent_1"]

    def refused(*more: str) -> str:
        with pytest.raises(SystemExit) as stop:
            command.main([*arguments, *more])
        assert stop.value.code == 2
        return capsys.readouterr().err

    assert "agent_1.safetensors exists: remove it, choose another file, or say --force" in refused()
    with pytest.raises(ValueError, match="'nowhere' is no checkpoint"):  # not that the file exists
        export_agents("nowhere", path)
    assert "--output a.onnx does not end in .safetensors, as --format says" in refused("--output", "a.onnx")
    assert "there is no folder" in refused("--output", "no/a.safetensors")
    # Disk full: nothing half-written, and the old file stays.
    monkeypatch.setattr(Path, "write_bytes", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    assert "can't be written: No space left on device" in refused("--force")
    assert [*tmp_path.iterdir()] == [path] and path.read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--agent", "agent_7"], "has no agent 'agent_7' (did you mean 'agent_1'?)"),
        (["--agent", "agent_0", "--all"], "not allowed with argument"),
        (["--output", "team.pt"], "'team.pt' is no file to export to; legal are names that end in .onnx or .safe"),
    ],
)
def test_mistakes_end_in_a_sentence(
    arguments: list[str], message: str, checkpoints: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        command.main([checkpoints["own"], *arguments])
    assert stop.value.code == 2 and message in capsys.readouterr().err


def test_no_checkpoint_or_a_stock_one_is_refused(ray_session: None, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is no checkpoint; legal: the folder of an RLlib algorithm checkpoint"):
        export_agents(tmp_path, tmp_path / "a.onnx")
    algo = PPOConfig().environment("CartPole-v1").env_runners(num_env_runners=0).build_algo()
    checkpoint = algo.save_to_path(str(tmp_path / "ppo"))
    algo.stop()
    with pytest.raises(ValueError, match="is of a stock algorithm; legal: a checkpoint of this package's"):
        export_agents(checkpoint, tmp_path / "a.onnx")


def test_missing_packages_are_named(tmp_path: Path, files: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "find_spec", lambda name: None if name == "onnxscript" else name)
    with pytest.raises(ImportError, match=r'\.onnx files need onnxscript: pip install .* "\.\[export\]"'):
        export_agents("anywhere", tmp_path / "a.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r'exported files need onnxruntime: pip install .* "\.\[export\]"'):
        describe(files["own.onnx"])


# Names from outside


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("agent_0", "agent_0"),
        ("../../etc/passwd", "_.._etc_passwd"),
        ("..", "_"),
        (".bashrc", "bashrc"),
        ("a/b\\c:d", "a_b_c_d"),
        ("größe 2", "größe_2"),
        ("x" * 500, "x" * 100),
    ],
)
def test_names_from_outside_are_no_paths(name: str, file: str) -> None:
    assert file_name(name) == file and os.path.basename(file) == file


@pytest.mark.parametrize("name", ["../agent", "a/b", ".."])
def test_an_agent_whose_name_would_be_a_path_of_its_checkpoint_is_refused(name: str) -> None:
    config = small_config("maddpg").environment(Listed, env_config={"listed": list, "names": ["a", name]})
    with pytest.raises(ValueError, match=f"PolicyID `{re.escape(name)}` not valid"):
        config.validate()


@pytest.mark.parametrize("name", ["../row", "a/b", ".hidden", ""])
def test_a_row_whose_name_would_be_a_path_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"folders of trials are named after it; legal are letters, digits and \. _"):
        check_row(name, {"algorithm": "maddpg"})


def test_an_agents_name_is_no_path(
    checkpoints: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The default file lies here, whatever an agent is called."""
    written_to = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "export_agents", lambda *args, **k: written_to.append(args[1]) or exit(0))
    with pytest.raises(SystemExit):
        command.main([checkpoints["own"], "--agent", "../../agent"])
    assert written_to == [Path("_.._agent.onnx")]


# Elsewhere

PAGE = ROOT / "docs" / "export.md"


def test_the_pages_loop_runs_without_ray_and_torch(files: dict[str, Path], tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (loop,) = [block for block in blocks if "import onnxruntime" in block]
    shutil.copy(files["shared.onnx"], tmp_path / "team.onnx")
    forbid = """
import sys
class Forbidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("ray", "torch", "rllib_maobs"):
            raise ImportError(name + " is forbidden here")
sys.meta_path.insert(0, Forbidden())
try:
    import torch
except ImportError:
    print("forbidden")
"""
    result = subprocess.run([sys.executable, "-c", forbid + loop], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("forbidden") and "mean distance" in result.stdout
