"""Learners on a GPU: what they compute is what they compute on the CPU. Skipped where PyTorch finds no GPU."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._pytree import tree_map

import rllib_maobs as maobs
from rllib_maobs.learner import JointLearner, update
from rllib_maobs.replay import Batch
from tests.benchmarks.internals import adam_means
from tests.conftest import ALGORITHMS, build_learner, random_batch, small_config
from tests.test_learner import CASES, ENTITY, TD3, configured, one_policy

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no GPU here"),
    pytest.mark.usefixtures("ray_session"),
]


@pytest.fixture
def double_precision() -> Any:
    """What rounds differently there shows in the last digits of double precision only."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def on(device: str, config: maobs.JointConfig) -> JointLearner:
    """The learner of a config on a device."""
    return build_learner(config.learners(num_gpus_per_learner=int(device == "cuda")))


def sent(batch: Batch, device: str) -> Batch:
    return tree_map(lambda part: part.to(device) if isinstance(part, torch.Tensor) else part, batch)


def weights(learner: JointLearner) -> list[torch.Tensor]:
    """All weights, those of the targets too."""
    stacks = (*learner._roles.values(), *learner._targets.values())
    return [stack.flat.detach().cpu().clone() for stack in stacks]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.usefixtures("double_precision")
def test_losses_and_gradients_are_those_of_the_cpu(case: str) -> None:
    learners = [on(device, configured(case)) for device in ("cpu", "cuda")]
    for a, b in zip(*map(weights, learners), strict=True):
        assert torch.equal(a, b)
    batch = random_batch(learners[0].config, size=6)
    (want, want_report), (got, got_report) = learners[0].gradients(batch), learners[1].gradients(sent(batch, "cuda"))
    torch.testing.assert_close(got_report.cpu(), want_report, rtol=1e-8, atol=1e-10)
    for role, views in want.items():
        assert all(view.is_cuda for view in got[role])
        torch.testing.assert_close([view.cpu() for view in got[role]], list(views), rtol=1e-7, atol=1e-10)


WAYS: dict[str, tuple[str, dict[str, Any], bool]] = {
    "maddpg": ("maddpg", {}, False),
    "maddpg-lstm": ("maddpg-lstm", {}, False),
    "facmac": ("facmac", {"critic_lr": 1e-3}, False),
    "qmix": ("qmix", {}, False),
    "td3": ("maddpg", {**TD3, "policy_delay": 2}, False),
    "entities": ("maddpg", {**ENTITY, "actor_lr": 1e-4, "critic_lr": 1e-4}, True),
}


@pytest.mark.parametrize("how", ["recorded", "compiled"])
@pytest.mark.parametrize("case", WAYS)
@pytest.mark.usefixtures("double_precision")
def test_many_updates_are_those_of_the_cpu(monkeypatch: pytest.MonkeyPatch, how: str, case: str) -> None:
    monkeypatch.setattr(update, "_RECORDED_AT", 5)
    algorithm, settings, shared = WAYS[case]
    learners = []
    for device in ("cpu", "cuda"):
        config = small_config(algorithm).training(**settings)
        if shared:
            one_policy(config)
        learners.append(on(device, config.framework(torch_compile_learner=device == "cuda" and how == "compiled")))
    for seed in range(30):
        batch = random_batch(learners[0].config, seed=seed)
        want = learners[0].step(batch)
        got = learners[1].step(sent(batch, "cuda"))
        assert want is not None and got is not None
        torch.testing.assert_close(got.cpu(), want, rtol=1e-6, atol=1e-8, msg=lambda m, s=seed: f"update {s}: {m}")
    for a, b in zip(*map(weights, learners), strict=True):
        torch.testing.assert_close(b, a, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_trains_there_and_its_agents_act_anywhere(tmp_path: Path, algorithm: str) -> None:
    """Replay, networks and Adam are there; a checkpoint goes on on the CPU and on the GPU."""

    def build(device: str) -> Any:
        return small_config(algorithm).learners(num_gpus_per_learner=int(device == "cuda")).build_algo()

    algo = build("cuda")
    for _ in range(4):
        algo.train()
    assert algo._learner.device.type == algo.replay_buffer.sample((4,), gamma=0.9).rewards.device.type == "cuda"
    algo.save_to_path(tmp_path)
    for device in ("cpu", "cuda"):
        other = build(device)
        other.restore_from_path(tmp_path)
        for a, b in zip(weights(algo._learner), weights(other._learner), strict=True):
            assert torch.equal(a, b)
        for there, here in zip(adam_means(algo._learner), adam_means(other._learner), strict=True):
            assert here.device.type == device
            assert torch.equal(there.cpu(), here.cpu())
        assert len(other.replay_buffer) == len(algo.replay_buffer)
        before = weights(other._learner)
        other.train()
        assert not torch.equal(before[0], weights(other._learner)[0])
        other.stop()
    algo.stop()


def test_a_checkpoint_goes_on_there_to_the_bit(tmp_path: Path) -> None:
    def config() -> maobs.JointConfig:
        return small_config("maddpg").learners(num_gpus_per_learner=1)

    algo = config().build_algo()
    for _ in range(3):
        algo.train()
    algo.save_to_path(tmp_path)
    algo.train()
    other = config().build_algo()
    other.restore_from_path(tmp_path)
    other.train()
    for a, b in zip(weights(algo._learner), weights(other._learner), strict=True):
        assert torch.equal(a, b)
    algo.stop()
    other.stop()
