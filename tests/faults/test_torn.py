"""Checkpoints that are torn, damaged or cannot be written: recognised, and the one before takes their place."""

import errno
import logging
import random
import resource
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from ray.train._internal.storage import StorageContext

from rllib_maobs.checkpoints import find_checkpoint, saved_networks
from rllib_maobs.experiment.claim import wait_until_free
from rllib_maobs.experiment.keeping import SAVING
from rllib_maobs.experiment.trial import Trial, TrialSpec
from rllib_maobs.whole import CHECKSUMS, METADATA, TornError, find_fault, numbered
from tests.conftest import small_config
from tests.faults.tiny import flip


@contextmanager
def full_disk(room: int) -> Iterator[None]:
    """No file can become longer than this: the error of the system, in the middle of writing."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture(scope="module")
def saved(ray_session: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimpleNamespace]:
    """An algorithm that was saved three times, at different env steps, in folders as Tune numbers them."""
    folder = tmp_path_factory.mktemp("saved")
    algorithm = small_config("iddpg").build_algo()
    for number in range(3):
        algorithm.train()
        algorithm.save_to_path(folder / f"checkpoint_{number:06d}")
    yield SimpleNamespace(folder=folder, algorithm=algorithm)
    algorithm.stop()


@pytest.fixture
def trial(saved: SimpleNamespace, tmp_path: Path) -> Path:
    """A copy of the folder."""
    return Path(shutil.copytree(saved.folder, tmp_path / "trial"))


def steps(algorithm: Any) -> int:
    return int(algorithm._progress["env_steps"])


@pytest.fixture(scope="module")
def flipped(saved: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(saved.folder / "checkpoint_000000", tmp_path_factory.mktemp("flipped") / "checkpoint"))


def test_any_bit_that_flips_is_found(flipped: Path, long: bool, tally: Counter[str]) -> None:
    chance, files = random.Random(0), sorted(path for path in flipped.rglob("*") if path.is_file())
    for number in range(1000 if long else 60):
        path = files[number % len(files)]
        content = path.read_bytes()
        flip(path, chance.randrange(8 * len(content)))
        fault = find_fault(flipped)
        assert fault is not None, path
        assert path.relative_to(flipped).as_posix() in fault
        path.write_bytes(content)
        tally["bytes flipped and found"] += 1
    assert find_fault(flipped) is None


def test_what_a_copy_leaves_out_or_cuts_is_found(flipped: Path, tally: Counter[str]) -> None:
    """Tune copies several files at a time, in no order: any may be missing or short."""
    for path in sorted(path for path in flipped.rglob("*") if path.is_file()):
        content, name = path.read_bytes(), path.relative_to(flipped).as_posix()
        path.unlink()
        assert find_fault(flipped) == f"{name} is missing"
        path.write_bytes(content[: len(content) // 2])
        assert name in (find_fault(flipped) or "")
        path.write_bytes(content)
        tally["torn checkpoints found"] += 2
    (flipped / METADATA).rename(flipped / "aside")
    (flipped / CHECKSUMS).rename(flipped / "aside too")
    assert find_fault(flipped) == f"{METADATA} is missing"
    (flipped / "aside").rename(flipped / METADATA)
    (flipped / "aside too").rename(flipped / CHECKSUMS)
    assert find_fault(flipped) is None


def test_the_one_before_takes_its_place(saved: SimpleNamespace, trial: Path, caplog: pytest.LogCaptureFixture) -> None:
    flip(trial / "checkpoint_000002" / "algorithm_state.pkl", 80)
    (trial / "checkpoint_000001" / "learner_group" / "learner" / "state.pkl").unlink()
    with caplog.at_level(logging.WARNING):
        assert find_checkpoint(trial) == find_checkpoint(trial / "checkpoint_000002") == trial / "checkpoint_000000"
    warning = (
        f"'{trial}/checkpoint_000002' is no whole checkpoint: algorithm_state.pkl has changed since it was saved "
        f"(another checksum). The one before it is used: '{trial}/checkpoint_000000'."
    )
    assert warning in caplog.messages
    assert any("000001' is no whole checkpoint: learner_group/learner/state.pkl is" in text for text in caplog.messages)
    saved.algorithm.restore_from_path(trial / "checkpoint_000002")
    assert steps(saved.algorithm) == 40
    again = type(saved.algorithm).from_checkpoint(trial / "checkpoint_000002")
    assert steps(again) == 40
    again.stop()


def test_the_one_before_is_found_whatever_is_missing(trial: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Also the file that makes it a checkpoint, or all of it: it was being replaced when the program died."""
    shutil.copytree(trial / "checkpoint_000001", trial / "checkpoint_backup")  # a user's own copy
    assert numbered(trial)[0].name == "checkpoint_000002"
    newest = trial / "checkpoint_000002"
    (newest / METADATA).unlink()
    assert find_checkpoint(newest).name == "checkpoint_000001"
    assert f"{METADATA} is missing" in caplog.text
    shutil.move(trial / "checkpoint_000001", trial / ".mine.before")
    assert find_checkpoint(trial / "mine").name == ".mine.before"


def test_where_there_is_none_before_it_an_error_says_so(saved: SimpleNamespace, trial: Path) -> None:
    first = trial / "checkpoint_000000"
    flip(first / "replay_buffer" / "state.pkl", 800)
    message = "is no whole checkpoint: replay_buffer/state.pkl has changed .*, and there is none before it."
    for read in (saved.algorithm.restore_from_path, type(saved.algorithm).from_checkpoint, find_checkpoint):
        with pytest.raises(ValueError, match=message):
            read(first)
    flip(trial / "checkpoint_000001" / "algorithm_state.pkl", 800)
    flip(trial / "checkpoint_000002" / "algorithm_state.pkl", 800)
    with pytest.raises(TornError, match=r"checkpoint_000002' is no whole .*; nor is any before it whole."):
        find_checkpoint(trial)


def test_checkpoints_without_checksums_are_taken_as_they_are(saved: SimpleNamespace, trial: Path) -> None:
    """As RLlib writes them, and as earlier revisions did."""
    checkpoint = trial / "checkpoint_000002"
    (checkpoint / CHECKSUMS).unlink()
    assert find_fault(checkpoint) == f"{CHECKSUMS} is missing"
    text = (checkpoint / METADATA).read_text()
    (checkpoint / METADATA).write_text(text.replace('"checksums"', '"other"'))
    assert find_fault(checkpoint) is None
    saved.algorithm.restore_from_path(checkpoint)
    assert find_checkpoint(trial) == checkpoint
    assert saved_networks(saved.algorithm.config, checkpoint)


def test_saving_anew_keeps_the_old_one_until_the_new_one_is_whole(
    saved: SimpleNamespace, trial: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed between its two renamings, a checkpoint is found under the name that the old one has meanwhile."""
    checkpoint = trial / "checkpoint_000000"
    saved.algorithm.train()
    now = steps(saved.algorithm)
    with monkeypatch.context() as patched, pytest.raises(InterruptedError):
        renamed: list[Path] = []
        rename = Path.rename

        def once(path: Path, target: Path) -> Path:
            if renamed:
                raise InterruptedError
            renamed.append(target)
            return rename(path, target)

        patched.setattr(Path, "rename", once)
        saved.algorithm.save_to_path(checkpoint)
    assert not checkpoint.exists()
    saved.algorithm.restore_from_path(checkpoint)
    assert steps(saved.algorithm) == 40 < now
    saved.algorithm.save_to_path(checkpoint)
    assert find_fault(checkpoint) is None
    assert sorted(path.name for path in trial.iterdir()) == [f"checkpoint_00000{number}" for number in range(3)]


def test_a_folder_with_other_files_keeps_them(saved: SimpleNamespace, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    for _ in range(2):
        saved.algorithm.save_to_path(tmp_path)
        assert (tmp_path / "thesis.tex").read_text() == "mine"
        assert find_fault(tmp_path) is None
        assert "thesis" not in (tmp_path / CHECKSUMS).read_text()
    saved.algorithm.restore_from_path(tmp_path)


def test_a_full_disk_leaves_the_old_checkpoint(saved: SimpleNamespace, trial: Path) -> None:
    checkpoint = trial / "checkpoint_000000"
    before = {path: path.read_bytes() for path in trial.rglob("*") if path.is_file()}
    saved.algorithm.train()
    with full_disk(100_000), pytest.raises(OSError) as error:
        saved.algorithm.save_to_path(checkpoint)
    assert error.value.errno == errno.EFBIG
    assert {path: path.read_bytes() for path in trial.rglob("*") if path.is_file()} == before
    with full_disk(100_000), pytest.raises(OSError):
        saved.algorithm.save_to_path(trial / "new")
    assert sorted(path.name for path in trial.iterdir()) == [f"checkpoint_00000{number}" for number in range(3)]


def test_a_large_replay_buffer_is_warned_of_once(
    saved: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("rllib_maobs.algorithms.base.LARGE_REPLAY", 1e3)
    for _ in range(2):
        saved.algorithm.save_to_path(tmp_path / "checkpoint")
    (warning,) = [text for text in caplog.messages if "GB of replay" in text]
    assert (
        "store_buffer_in_checkpoints=False) leaves it out; then a restored run first collects 16 env steps" in warning
    )


@pytest.mark.parametrize("when", ["writing", "copying"])
def test_a_trial_goes_on_without_a_checkpoint(
    ray_session: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    """Whether the disk is full while it is written, or while Tune copies it."""
    spec = TrialSpec(
        algorithm="iddpg",
        seed=0,
        env="maobs/spread-3a",
        stop_timesteps=1000,
        training={"train_batch_size_per_learner": 8},
        torch_compile=False,
        steps_per_iteration=16,
        evaluation_duration=1,
    )
    storage = StorageContext(str(tmp_path), "run", trial_dir_name="trial")
    trial, folder = Trial(asdict(spec), storage=storage), tmp_path / "run" / "trial"
    try:
        assert not wait_until_free(folder, 0.0)  # should it outlive its run, a resumed one waits
        trial.train()
        first = Path(trial.save().checkpoint.path)
        trial.train()
        if when == "writing":
            with full_disk(100_000):
                result = trial.save()
            assert trial.why_not_saved() == "File too large"
        else:

            def fails(checkpoint: Any) -> None:
                Path(storage.checkpoint_fs_path).mkdir()
                (Path(storage.checkpoint_fs_path) / "half").write_text("")
                raise OSError(errno.ENOSPC, "No space left on device")

            with monkeypatch.context() as patched:
                patched.setattr(trial._storage, "persist_current_checkpoint", fails)
                result = trial.save()
            assert trial.why_not_saved() == "No space left on device"
        assert result.checkpoint is None
        assert numbered(folder) == [first] and find_fault(first) is None
        assert not (folder / SAVING).exists()
        trial.train()
        assert Path(trial.save().checkpoint.path).name == "checkpoint_000001"
        assert len(numbered(folder)) == 2
    finally:
        trial.stop()
    assert wait_until_free(folder, 0.0)
