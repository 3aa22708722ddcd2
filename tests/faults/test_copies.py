"""One copy of an environment that raises or hangs: it is made anew, and the others do not notice."""

import signal
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rllib_maobs as maobs
from rllib_maobs.replay import JointReplayBuffer
from tests.conftest import small_config
from tests.test_callbacks import Lamp
from tests.test_faults import MADE, Faulty, config_of, runner_of


class Broken(Faulty):
    """Copy 0 goes wrong whenever it is made."""

    def __init__(self, config: dict) -> None:
        super().__init__(config)
        self.bad = config.vector_index == 0


class Hanging(Lamp):
    """A method of copy 1, in some runners, does not return; with a flag's path only the first time."""

    def __init__(self, config: dict) -> None:
        super().__init__(config)
        self.how, self.where, self.flag = config["how"], config.get("where", "step"), config.get("flag")
        self.bad = config.vector_index == 1 and getattr(config, "worker_index", 0) in config.get("runners", (0, 1))

    def _hang(self, where: str) -> None:
        if not self.bad or where != self.where or (self.flag and Path(self.flag).exists()):
            return
        if self.flag:
            Path(self.flag).touch()
        while self.how == "computes":
            pass
        if self.how == "swallows":
            with suppress(TimeoutError):
                time.sleep(20)
        time.sleep(20)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        self._hang("reset")
        return super().reset(seed=seed)

    def step(self, actions: dict) -> tuple:
        if self.t == 2:
            self._hang("step")
        return super().step(actions)


def hanging(**env_config: Any) -> maobs.JointConfig:
    config = small_config("iddpg").environment(Hanging, env_config={"how": "waits", **env_config})
    config.env_runners(num_envs_per_env_runner=2, rollout_fragment_length=10)
    return config.training(env_timeout_s=0.3)


def test_a_copy_that_fails_is_made_anew_alone(ray_session: None, caplog: pytest.LogCaptureFixture) -> None:
    config = config_of(bad_copies=1).fault_tolerance(restart_failed_sub_environments=True)
    ended: list[tuple[int, int]] = []
    stepped: list[int] = []
    config.callbacks(
        on_episode_step=lambda *, episode, env_index, **given: stepped.append(len(episode)) if env_index == 0 else None,
        on_episode_end=lambda *, episode, env_index, **given: ended.append((env_index, len(episode))),
    )
    config.env_runners(rollout_fragment_length=9)
    runner = runner_of(config)
    (sample,) = runner.sample()
    assert len(MADE) == 3 and runner.env.envs == [MADE[2], MADE[1]]
    # Copy 0 fails in its third step; the other one plays its episodes of five.
    assert sample.obs[:, :, 0, 0].T.tolist() == [[0, 1, 2, 0, 1, 2, 3, 4, 0], [0, 1, 2, 3, 4, 0, 1, 2, 3]]
    assert np.argwhere(sample.failed).tolist() == [[2, 0]]
    assert np.argwhere(sample.terminated.all(-1)).tolist() == [[4, 1], [7, 0]]
    metrics = runner.get_metrics()
    assert ended == [(1, 5), (0, 5)] and stepped == [1, 2, 1, 2, 3, 4, 5, 1]
    assert (int(metrics["num_episodes"].peek()), int(metrics["episode_len_max"].peek())) == (2, 5)
    assert "Copy 0 of the environment of runner 0 raised KeyError('lidar') and is made anew (failure 1" in caplog.text
    assert not runner._failures_of_copies
    # Nothing is learned of the step that failed, nor of one from its episode into the next.
    team = runner.team
    replay = JointReplayBuffer(100, len(team.agents), team.observation_size, team.action_size, seed=0)
    replay.add(**vars(sample))
    batch = replay.sample((500,), gamma=0.9, n_step=2, seq_length=3)
    now, later = batch.now.obs[:, 0, 0], batch.next.obs[:, 0, 0]
    assert {*zip(now.tolist(), later.tolist(), strict=True)} == {(0, 2), (1, 2), (1, 3), (2, 3), (2, 4), (3, 5), (4, 5)}
    assert (batch.now.mask.sum(-1) == np.minimum(now + 1, 3)).all()
    # Fragments that end with a failure are not joined to the next, either.
    ends = {name: value[:3] for name, value in vars(sample).items() if name in ("obs", "actions", "rewards", "failed")}
    ends |= {"terminated": sample.terminated[:3], "truncated": sample.truncated[:3], "final_obs": sample.final_obs[:0]}
    rest = {name: value[3:4] for name, value in vars(sample).items() if name in ("obs", "actions", "rewards")}
    rest |= {
        "terminated": sample.terminated[3:4],
        "truncated": sample.truncated[3:4],
        "final_obs": sample.final_obs[:0],
    }
    replay = JointReplayBuffer(100, len(team.agents), team.observation_size, team.action_size)
    replay.add(**ends, source="a", start=0)
    replay.add(**rest, source="a", start=3)
    assert replay._next[:6].tolist() == [2, 3, 4, 5, -1, 7]
    with pytest.raises(ValueError, match=r"'failed' must be an array \(3, 2\), and true where no episode ended"):
        replay.add(**{**ends, "failed": ends["failed"][:1]})


def test_new_copies_play_other_episodes(ray_session: None) -> None:
    """They are seeded anew, once each time."""
    seeds: list[int | None] = []

    class Seeded(Faulty):
        def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
            seeds.append(seed)
            return super().reset()

    config = config_of(bad_copies=1).environment(Seeded, env_config={"bad_copies": 1})
    runner = runner_of(config.fault_tolerance(restart_failed_sub_environments=True))
    seeds.clear()
    runner.sample()
    first, other, anew, *later = seeds
    assert len({first, other, anew}) == 3 and None not in (first, other, anew) and set(later) == {None}


def test_failures_are_counted_for_each_copy(ray_session: None) -> None:
    """However many episodes the others end."""
    config = config_of().environment(Broken, env_config={}).env_runners(rollout_fragment_length=100)
    config.fault_tolerance(restart_failed_sub_environments=True, num_consecutive_env_runner_failures_tolerance=3)
    runner = runner_of(config)
    with pytest.raises(KeyError, match="lidar"):
        runner.sample()
    assert len(MADE) == 2 + 3 and runner._needs_reset
    assert runner.error is not None and runner.env.envs[1] is MADE[1]


@pytest.mark.parametrize(
    ("how", "where", "at"),
    [("waits", "step", 2), ("computes", "step", 2), ("waits", "reset", 0), ("swallows", "step", 2)],
)
def test_what_hangs_is_named(ray_session: None, how: str, where: str, at: int) -> None:
    config = hanging(how=how, where=where)
    config.validate()
    runner = config.env_runner_cls(config=config, worker_index=0, num_workers=0)
    before, start = signal.getsignal(signal.SIGALRM), time.monotonic()
    with pytest.raises(TimeoutError) as caught:
        runner.sample()
    assert str(caught.value) == (
        f"Hanging: {where}() takes longer than env_timeout_s=0.3 s in environment copy 1 at step {at} of its episode."
    )
    assert 0.2 < time.monotonic() - start < 10.0
    assert signal.getsignal(signal.SIGALRM) is before and signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


@pytest.mark.parametrize("where", ["step", "reset"])
def test_what_hangs_is_made_anew(ray_session: None, tmp_path: Path, where: str) -> None:
    config = hanging(flag=str(tmp_path / "flag"), where=where).fault_tolerance(restart_failed_sub_environments=True)
    config.validate()
    runner = config.env_runner_cls(config=config, worker_index=0, num_workers=0)
    first = runner.env.envs
    copies = list(first)
    (sample,) = runner.sample()
    assert (tmp_path / "flag").exists() and len(sample.obs) == 10
    # A reset that fails is one of all copies.
    assert [one is other for one, other in zip(copies, runner.env.envs, strict=True)] == [where == "step", False]
    assert (sample.failed is not None) == (where == "step")
    # An environment that goes on from a checkpoint has the limits of the configuration, too.
    state = runner.get_state()
    runner.env.timeout_s, runner.env.isolates = None, False
    runner.set_state(state)
    assert (runner.env.timeout_s, runner.env.isolates) == (0.3, True)


def test_limits_that_there_cannot_be(ray_session: None) -> None:
    with pytest.raises(
        ValueError, match=r"env_timeout_s=2 has no effect on 'maobs/spread-3a', whose copies are stepped"
    ):
        small_config("iddpg").training(env_timeout_s=2.0).validate()
    with pytest.raises(ValueError, match="env_timeout_s=0 is illegal"):
        small_config("iddpg").training(env_timeout_s=0).validate()
    raised: list[ValueError] = []

    def validate() -> None:
        try:
            hanging().validate()
        except ValueError as error:
            raised.append(error)

    thread = threading.Thread(target=validate)
    thread.start()
    thread.join()
    assert "env_timeout_s needs signals: the main thread of a process, on Linux or macOS" in str(raised[0])


def test_remote_runners_that_hang(ray_session: None, tmp_path: Path, long: bool) -> None:
    """Within the limit the copy is made anew; without one, training goes on with the others' samples."""
    config = hanging(flag=str(tmp_path / "flag")).env_runners(num_env_runners=1, num_cpus_per_env_runner=0.5)
    algo = config.build_algo()
    try:
        assert algo.train()["num_env_steps_sampled_lifetime"] == 40 and (tmp_path / "flag").exists()
    finally:
        algo.stop()
    if not long:
        return
    config = hanging(runners=(2,)).training(env_timeout_s=None)
    config.env_runners(num_env_runners=2, num_cpus_per_env_runner=0.5, sample_timeout_s=2.0)
    algo = config.build_algo()
    try:
        start = time.monotonic()
        result = algo.train()
        assert result["num_env_steps_sampled_lifetime"] == algo._progress["env_steps"] == 40
        assert time.monotonic() - start < 60
    finally:
        algo.stop()
