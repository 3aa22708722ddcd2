"""Updates that are not finite end training or are skipped, and leave what a post-mortem needs; values are watched."""

import contextlib
import logging
import math
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from pyarrow.fs import LocalFileSystem

import rllib_maobs as maobs
from rllib_maobs import postmortem
from rllib_maobs.experiment.trial import Trial, TrialSpec
from rllib_maobs.learner import Diverged, JointLearner
from rllib_maobs.learner.health import MOST_SKIPPED, REPORT
from rllib_maobs.replay import Batch
from tests.conftest import build_learner, random_batch, small_config


def with_rewards(batch: Batch, value: float) -> Batch:
    rewards = batch.rewards.clone()
    rewards[3, 1] = value
    return batch._replace(rewards=rewards)


def weights(learner: JointLearner) -> list[torch.Tensor]:
    stacks = (*learner._roles.values(), *learner._targets.values())
    return [stack.flat.detach().clone() for stack in stacks]


def many(*batches: Batch) -> Batch:
    """Minibatches as one batch of several."""

    def stacked(parts: list[Any]) -> Any:
        if isinstance(parts[0], torch.Tensor):
            return torch.stack(parts)
        if not isinstance(parts[0], tuple):
            return parts[0]
        return type(parts[0])(*map(stacked, map(list, zip(*parts, strict=True))))

    return stacked(list(batches))


def test_training_that_diverges_leaves_a_post_mortem(
    ray_session: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    algo = small_config("maddpg").training(reward_scale=1e25).build_algo()
    try:
        with pytest.raises(Diverged, match=r"^critic_loss of agent_0 is inf in update \d+: training has ") as caught:
            for _ in range(3):
                algo.train()
        path = Path(algo.logdir) / f"postmortem-{caught.value.update}.npz"
        assert str(caught.value).endswith(f"python -m rllib_maobs.postmortem {path}")
        learner = algo._learner
        assert all(torch.isfinite(flat).all() for flat in weights(learner))
    finally:
        algo.stop()
    about, arrays = postmortem.read(path)
    assert about["agents"] == ["agent_0", "agent_1", "agent_2"] and about["update"] == caught.value.update
    assert arrays["batch/now.obs"].shape[:2] == (16, 3) and arrays["batch/rewards"].dtype == np.float32
    saved = learner.module["agent_1"].unwrapped().state_dict()
    for name, value in saved.items():  # the networks from which it can be computed again
        assert np.array_equal(arrays[f"weights/agent_1/{name}"], value.numpy())
    postmortem.main([str(path)])
    shown = capsys.readouterr().out
    assert "maddpg: critic_loss of agent_0 is inf in update" in shown and "reward_scale 1e+25" in shown
    rewards = arrays["batch/rewards"]
    row, agent = map(int, np.unravel_index(np.abs(rewards).argmax(), rewards.shape))
    assert f"largest [{row}, {agent}]: {rewards[row, agent]:.4g}, [" in shown
    monkeypatch.setattr(sys, "argv", ["postmortem", str(path)])
    runpy.run_module("rllib_maobs.postmortem", run_name="__main__")
    assert capsys.readouterr().out == shown
    whole = path.read_bytes()
    for place in range(0, len(whole), len(whole) // 60):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :])
        with contextlib.suppress(ValueError):  # a bit of the archive's own notes may not matter
            assert len(list(postmortem.shown(*postmortem.read(path)))) > 10
    path.write_bytes(whole[:-100])
    for wrong in (path, tmp_path, tmp_path / "none.npz"):
        with pytest.raises(ValueError, match="is no whole post-mortem; legal: a file postmortem"):
            postmortem.read(wrong)
    with pytest.raises(SystemExit):
        postmortem.main([str(path)])
    assert "is no whole post-mortem" in capsys.readouterr().err


@pytest.mark.parametrize("role", ["critic", "actor"])
def test_a_gradient_that_is_not_finite_changes_nothing(
    ray_session: None, role: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where all losses are."""
    learner = build_learner(small_config("maddpg"))
    batch, before, whole = random_batch(learner.config), weights(learner), learner.joint_gradients

    def broken(*arguments: Any) -> Any:
        gradients, report = whole(*arguments)
        gradients[role][2][5] = torch.nan
        return gradients, report

    monkeypatch.setattr(learner, "joint_gradients", broken)
    with pytest.raises(Diverged, match=f"^{role}_gradient_norm is nan in update 1: training has diverged"):
        learner.step(batch)
    assert all(map(torch.equal, before, weights(learner)))


def test_updates_are_skipped_and_counted(ray_session: None, caplog: pytest.LogCaptureFixture) -> None:
    """The others are as they would be without them."""
    good = [random_batch(small_checked(), seed=seed) for seed in range(3)]
    bad = with_rewards(good[1], math.inf)
    learner = build_learner(small_config("maddpg").training(nonfinite_updates="skip"))
    other = build_learner(small_config("maddpg"))
    with caplog.at_level(logging.WARNING):
        learner.update(many(good[0], bad, good[2]), _no_metrics_reduce=True)
    other.update(many(good[0], good[2]), _no_metrics_reduce=True)
    assert all(map(torch.equal, weights(learner), weights(other)))
    assert "critic_loss of agent_1 is inf in update 2: it is skipped." in caplog.text
    got, want = learner.report(), other.report()
    assert got["__all_modules__"]["num_updates_skipped_lifetime"].peek() == 1
    assert got["__all_modules__"]["num_updates_lifetime"].peek() == 2
    for name in ("critic_loss", "q_mean", "q_max", "actor_loss"):
        assert got["agent_1"][name].peek() == want["agent_1"][name].peek()
    with pytest.raises(Diverged, match=rf"^critic_loss .* in update 104, after {MOST_SKIPPED} that were skipped: "):
        learner.update(many(*[bad] * (MOST_SKIPPED + 1)), _no_metrics_reduce=True)
    with pytest.raises(ValueError, match=r"nonfinite_updates='ignore' is illegal; legal: 'raise', 'skip'"):
        small_config("maddpg").training(nonfinite_updates="ignore").validate()


def small_checked() -> maobs.JointConfig:
    config = small_config("maddpg")
    config.validate()
    return config


def test_bad_networks_are_not_saved(ray_session: None, tmp_path: Path) -> None:
    algo = small_config("maddpg").build_algo()
    try:
        algo._learner._roles["critic"].flat.data[7] = torch.inf
        with pytest.raises(Diverged, match=r"^Weights of critic are not finite: training has diverged\.$"):
            algo.save_to_path(tmp_path / "checkpoint")
    finally:
        algo.stop()


def test_a_trial_keeps_it_in_its_folder(ray_session: None, tmp_path: Path) -> None:
    """Wherever that is: Tune says how to write there."""
    spec = TrialSpec(
        algorithm="maddpg",
        seed=0,
        env="maobs/spread-3a",
        stop_timesteps=1000,
        training={"reward_scale": 1e25, "train_batch_size_per_learner": 16},
        torch_compile=False,
        steps_per_iteration=100,
        evaluation_duration=1,
    )
    trial = Trial(vars(spec))
    trial._storage = SimpleNamespace(storage_filesystem=LocalFileSystem(), trial_fs_path=str(tmp_path))
    try:
        with pytest.raises(Diverged) as caught:
            trial.train()
    finally:
        trial.stop()
    (path,) = tmp_path.iterdir()
    assert str(caught.value).endswith(f"python -m rllib_maobs.postmortem {path}")
    assert postmortem.read(path)[0]["algorithm"] == "maddpg"


def test_values_beyond_any_return_are_warned_of_once(ray_session: None, caplog: pytest.LogCaptureFixture) -> None:
    algo = small_config("maddpg").training(reward_scale=0.5, gamma=0.9).build_algo()
    try:
        with caplog.at_level(logging.WARNING):
            learned = algo.train()["learners"]
            assert "Values diverge" not in caplog.text
            largest = algo._progress["largest_reward"]
            rewards = algo.replay_buffer._columns["rewards"][: len(algo.replay_buffer)]
            assert largest >= rewards.abs().max() > 0.5 * largest  # rows of last observations have none
            assert learned["__all_modules__"]["q_limit"] == pytest.approx(largest * 0.5 / 0.1)
            for agent in ("agent_0", "agent_1"):
                assert learned[agent]["q_max"] >= abs(learned[agent]["q_mean"]) > 0
            assert learned["__all_modules__"]["critic_gradient_norm"] > 0
            for module in algo.config.module_ids:  # the bias of the last layer
                [*algo._learner.module[module].unwrapped().critic.parameters()][-1].data.fill_(1e4)
            algo.train()
            algo.train()
        assert caplog.text.count("Values diverge: |Q| comes to ") == 1
        saved = algo.get_state()["progress"]["largest_reward"]
        assert saved >= largest
    finally:
        algo.stop()


def test_the_report_holds_what_it_says(ray_session: None) -> None:
    """Norms of all gradients, and the largest |Q|, for an algorithm without actors, too."""
    for name in ("maddpg", "facmac", "iql"):
        learner = build_learner(small_config(name))
        gradients, report = learner.gradients(random_batch(learner.config))
        rows = dict(zip(REPORT, report, strict=True))
        for kind, roles in (("critic", ("critic", "mixer")), ("actor", ("actor",))):
            parts = [part for role in roles for part in gradients.get(role, [])]
            want = math.sqrt(sum(float(part.double().square().sum()) for part in parts))
            assert rows[f"{kind}_gradient_norm"].tolist() == pytest.approx([want] * 3, rel=1e-5)
        assert (rows["q_max"] >= rows["q_mean"].abs()).all() and rows["q_max"].min() > 0
        assert bool(rows["actor_loss"].any()) == learner.has_actors
