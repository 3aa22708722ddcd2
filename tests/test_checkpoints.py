"""What is read from checkpoints: a run's last one, and networks to start another run from."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import rllib_maobs as maobs
from rllib_maobs.checkpoints import find_checkpoint, load_networks, saved_networks
from rllib_maobs.experiment.arguments import make_parser, parse, save_settings
from rllib_maobs.experiment.trial import Trial, TrialSpec

ENTITIES = {
    **{"actor": "entity", "critic": "entity", "critic_state": "world", "other_agents_actions": "joint"},
    **{"actor_settings": {"near": 0.2}, "critic_settings": {"near": 0.2}},
}


def spec_of(env: str, **changes: Any) -> TrialSpec:
    settings = {"train_batch_size_per_learner": 8, "num_steps_sampled_before_learning_starts": 16, **ENTITIES}
    training = {**settings, "updates_per_env_step": 0.1, **changes.get("training", {})}
    changes = {name: value for name, value in changes.items() if name != "training"}
    given: dict[str, Any] = {"algorithm": "maddpg", "one_policy": True, "torch_compile": False, **changes}
    return TrialSpec(seed=0, env=env, stop_timesteps=40, steps_per_iteration=20, training=training, **given)


@pytest.fixture(scope="module")
def smaller(ray_session: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trial's folder with two checkpoints of a team of three."""
    folder = tmp_path_factory.mktemp("three")
    trial = Trial(asdict(spec_of("maobs/spread-3a")))
    for number in range(2):
        trial.train()
        (folder / f"checkpoint_{number:06d}").mkdir()
        trial.save_checkpoint(str(folder / f"checkpoint_{number:06d}"))
    trial.stop()
    return folder


def validated(spec: TrialSpec) -> maobs.JointConfig:
    config = spec.build_config()
    assert isinstance(config, maobs.JointConfig)
    config.validate()
    return config


def weights(trial: Trial, policy: str = "all") -> dict[str, torch.Tensor]:
    module = trial._algorithm.learner_group._learner.module[policy]
    return {name: value.clone() for name, value in module.state_dict().items()}


def test_the_last_checkpoint_is_found(smaller: Path, tmp_path: Path) -> None:
    assert find_checkpoint(smaller) == find_checkpoint(smaller / "checkpoint_000001") == smaller / "checkpoint_000001"
    with pytest.raises(ValueError, match="is no checkpoint; legal: the folder of an RLlib algorithm checkpoint"):
        find_checkpoint(tmp_path)


def test_a_trial_starts_from_the_networks_of_a_smaller_team(smaller: Path, tmp_path: Path) -> None:
    saved = saved_networks(validated(spec_of("maobs/spread-3a")), smaller)["all"]
    still = {"train_batch_size_per_learner": 8, "num_steps_sampled_before_learning_starts": 1000}
    trial = Trial(asdict(spec_of("maobs/spread-6a", start_from=str(smaller), training=still)))
    new = weights(trial)
    trial.train()  # too early to learn
    started = weights(trial)
    assert set(started) == set(saved)
    assert all(torch.equal(started[name], torch.as_tensor(saved[name])) for name in saved)
    assert not torch.equal(new["actor.layers.0.weight"], started["actor.layers.0.weight"])
    # A checkpoint of its own comes first: a resumed trial does not start again.
    with torch.no_grad():
        trial._algorithm.learner_group._learner.module["all"].actor.layers[0].weight.add_(1.0)
    trial.save(str(tmp_path / "own"))
    trial.restore(str(tmp_path / "own"))
    trial.train()
    assert torch.equal(weights(trial)["actor.layers.0.weight"], started["actor.layers.0.weight"] + 1.0)
    trial.stop()


def test_all_trials_of_a_run_start_from_one_checkpoint(
    smaller: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also those that begin when it is no longer the last one."""
    parser, folder = make_parser("demo", ["maddpg"], 100), tmp_path / "new"
    given = ["--results-dir", str(folder), "--from", str(smaller)]
    args = parse(parser, "demo", given)
    assert args.start_from == str(smaller / "checkpoint_000001")
    (folder / "trial").mkdir(parents=True)
    save_settings("demo", args)
    for again in (str(smaller), str(smaller / "checkpoint_000001")):
        later = parse(parser, "demo", ["--resume", *given[:-1], again])
        assert later.start_from == args.start_from
    with pytest.raises(SystemExit):
        parse(parser, "demo", ["--resume", *given[:-1], str(smaller / "checkpoint_000000")])
    assert f"--from: the original run has {args.start_from}" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        parse(parser, "demo", ["--results-dir", str(tmp_path / "other"), "--from", str(tmp_path)])
    assert f"--from: {str(tmp_path)!r} is no checkpoint" in capsys.readouterr().err


def test_runners_get_networks_also_after_training(smaller: Path) -> None:
    """RLlib's runners skip weights that are not newer than their own."""
    config = spec_of("maobs/spread-3a", num_env_runners=1).build_config()
    algo = config.build_algo()
    for _ in range(2):
        algo.train()
    load_networks(algo, smaller)
    there = algo.env_runner_group.foreach_env_runner(lambda runner: runner.get_state(), local_env_runner=False)
    (weights_there,) = (state["rl_module"]["all"] for state in there)
    mine = algo.learner_group._learner.module["all"].state_dict()
    acting = {name for name in weights_there if name.startswith("actor.")}
    assert acting and all(np.array_equal(weights_there[name], mine[name].numpy()) for name in acting)
    algo.stop()


def test_policies_of_their_own_start_from_the_one_that_all_shared(smaller: Path) -> None:
    states = saved_networks(validated(spec_of("maobs/spread-3a", one_policy=False)), smaller)
    assert sorted(states) == ["agent_0", "agent_1", "agent_2"]
    assert (states["agent_0"]["actor.layers.0.weight"] == states["agent_2"]["actor.layers.0.weight"]).all()


def test_the_same_weights_as_another_network_are_warned_of(smaller: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("WARNING", "rllib_maobs"):
        saved_networks(validated(spec_of("maobs/spread-6a")), smaller)
    assert not caplog.text
    with caplog.at_level("WARNING", "rllib_maobs"):
        saved_networks(validated(spec_of("maobs/spread-3a", training={"critic_settings": {"near": 0.5}})), smaller)
    assert "had critic_settings={'near': 0.2}, here {'near': 0.5}, with which the same weights may be" in caplog.text


@pytest.mark.parametrize(
    ("env", "changes", "message"),
    [
        ("spread-6a", {"training": {"actor_settings": {"edge": 16}}}, "shape .32, 5., here .16, 3."),
        ("spread-3a", {"training": {"actor": "mlp", "actor_settings": {}}}, "shape .64, 100., here .64, 18."),
        ("obstacle-predator-prey", {}, "of another kind or task than those of maddpg on maobs/obstacle-predator-prey"),
        ("spread-3a", {"algorithm": "facmac"}, r"has no networks for \['mixer'\]; it has those of \['all'\]."),
    ],
)
def test_other_networks_are_refused(smaller: Path, env: str, changes: dict[str, Any], message: str) -> None:
    spec = spec_of(f"maobs/{env}", **changes)
    if "algorithm" in changes:
        del spec.training["other_agents_actions"]
    config = validated(spec)
    with pytest.raises(ValueError, match=message):
        saved_networks(config, smaller)
