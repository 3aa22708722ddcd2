"""Checkpoints lie where the path says, however it is written."""

from pathlib import Path

import pytest
from ray.tune import Checkpoint

import rllib_maobs as maobs
from rllib_maobs.paths import absolute
from rllib_maobs.policies import make_policy
from tests.conftest import small_config

PATHS = ["relative", "./a b/", "ü [1] #x 100%", "~/home sweet", "br[0]*/deep/"]


def test_checkpoints_by_any_path(ray_session: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    algo = small_config("iddpg").build_algo()
    try:
        for given in PATHS:
            folder = Path(given).expanduser().absolute()
            assert algo.save_to_path(given) == str(folder) and (folder / "replay_buffer").is_dir()
            algo.restore_from_path(Path(given))
            maobs.AgentModule.from_checkpoint(f"{given}/learner_group/learner/rl_module/agent_1")
        assert Path(algo.save("saved").checkpoint.path, "replay_buffer").is_dir()
        algo.restore("saved")
        assert not (tmp_path / "~").exists()
        for path in (PATHS[1], Checkpoint.from_directory(PATHS[1])):
            maobs.JointAlgorithm.from_checkpoint(path).stop()
        make_policy(maobs.make_vec("spread-3a"), PATHS[3])
    finally:
        algo.stop()


def test_uris_stay_as_they_are() -> None:
    assert absolute("s3://bucket/a b") == "s3://bucket/a b"
    assert absolute("/a/b/") == "/a/b" and absolute(Path("a")) == str(Path.cwd() / "a")
    assert absolute(None) is None
