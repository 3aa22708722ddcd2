"""What goes wrong in environments and in the processes they run in: who hears of it, and what goes on."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
from ray.exceptions import RayTaskError
from ray.rllib.env.env_errors import StepFailedRecreateEnvError

import rllib_maobs as maobs
from rllib_maobs.runner import JointEnvRunner
from rllib_maobs.runner.errors import portable
from tests.conftest import small_config
from tests.test_callbacks import Lamp

MADE: list["Faulty"] = []


class LidarError(Exception):
    """An error that its pickle alone does not make again."""

    def __init__(self, sensor: int, *, at: int) -> None:
        super().__init__(f"sensor {sensor} at step {at}")


class Faulty(Lamp):
    """Goes wrong at a step of its episodes, in the first copies that are made, or in all."""

    def __init__(self, config: dict) -> None:
        super().__init__(config)
        self.config = dict(config)
        self.bad = len(MADE) < self.config.get("bad_copies", 10**9) and not os.path.exists(self.config.get("flag", ""))
        MADE.append(self)
        if self.config.get("what") == "unmade" and getattr(config, "worker_index", 0):
            raise KeyError("no lidar")

    def step(self, actions: dict) -> tuple:
        result = super().step(actions)
        if self.bad and self.t == self.config.get("at", 3):
            self._fail()
            if self.config.get("what") == "nan":
                result[0]["right"][1] = np.nan
        return result

    def close(self) -> None:
        if self.t == self.config.get("at", 3) and self.config.get("what", "key") == "key":
            raise RuntimeError("no lidar to close")

    def _fail(self) -> None:
        what = self.config.get("what", "key")
        if what == "crash":
            Path(self.config["flag"]).touch()
            os._exit(1)
        elif what == "key":
            raise KeyError("lidar")
        elif what == "value":
            raise ValueError("no lidar")
        elif what == "lidar":
            raise LidarError(2, at=self.t)
        elif what == "expected":
            raise StepFailedRecreateEnvError("no lidar")


def config_of(num_env_runners: int = 0, **env_config: Any) -> maobs.JointConfig:
    config = small_config("iddpg").environment(Faulty, env_config=env_config)
    config.env_runners(num_env_runners=num_env_runners, num_envs_per_env_runner=2, rollout_fragment_length=5)
    # A long delay: it is between restarts of processes, and there are none.
    return config.fault_tolerance(delay_between_env_runner_restarts_s=600.0)


def runner_of(config: maobs.JointConfig, worker_index: int = 0) -> JointEnvRunner:
    config.validate()
    MADE.clear()
    return JointEnvRunner(config=config, worker_index=worker_index, num_workers=bool(worker_index))


def test_what_goes_wrong_in_remote_runners(ray_session: None, tmp_path: Path) -> None:
    """Errors reach the caller as themselves, in training and evaluation; a crash of the process is survived."""
    flag = tmp_path / "crashed"
    config = config_of(1, at=3, flag=str(flag)).fault_tolerance(
        num_consecutive_env_runner_failures_tolerance=50, delay_between_env_runner_restarts_s=0.0
    )
    override = maobs.JointConfig.overrides(env_config={"at": 2, "what": "lidar"}, explore=False)
    config.evaluation(evaluation_num_env_runners=1, evaluation_duration=2, evaluation_config=override)
    # Callbacks are called in other processes, too.
    config.callbacks(
        on_episode_end=lambda *, episode, env_runner, metrics_logger, **given: metrics_logger.log_value(
            "length", len(episode) * env_runner.worker_index, window=1
        )
    )
    algo = config.build_algo()

    def change(**settings: Any) -> None:
        def in_runner(runner: JointEnvRunner) -> None:
            for env in runner.env.envs:
                env.config.update(settings)

        algo.env_runner_group.foreach_env_runner(in_runner, local_env_runner=False, healthy_only=False)

    try:
        with pytest.raises(KeyError, match="lidar") as caught:
            algo.train()
        assert not isinstance(caught.value, RayTaskError)
        assert "In env runner 1:\nTraceback" in caught.value.__notes__[0] and "_fail()" in caught.value.__notes__[0]
        # What can't be read in another process is quoted.
        with pytest.raises(RuntimeError, match="LidarError: sensor 2 at step 2"):
            algo.evaluate()
        # The same algorithm goes on, and its runners come back: after an error, and after a crash as a new process.
        change(what="nothing")
        result = algo.train()
        assert result["num_env_steps_sampled_lifetime"] >= 40 and result["env_runners"]["length"] == 5
        assert algo.env_runner_group.num_healthy_remote_workers() == 1
        change(what="crash")
        algo.train()
        assert flag.exists()
        algo.env_runner_group.foreach_env_runner(lambda runner: runner.ping(), healthy_only=False)  # until it is there
        before = algo._progress["env_steps"]
        assert algo.train()["fault_tolerance"]["num_healthy_workers"] == 1
        assert algo._progress["env_steps"] >= before + 40
    finally:
        algo.stop()


@pytest.mark.parametrize(
    ("worker_index", "what", "settings", "attempts"),
    [
        # A local environment's error is the caller's at once, unless it may be made anew.
        (0, "key", {}, 1),
        (0, "key", {"restart_failed_sub_environments": True}, 4),
        (0, "value", {"restart_failed_sub_environments": True}, 4),
        # A remote one's counts as its runner's.
        (1, "key", {}, 4),
        (1, "key", {"max_num_env_runner_restarts": 1}, 2),
        (1, "key", {"restart_failed_env_runners": False}, 1),
        # An illegal value would come again.
        (1, "value", {}, 1),
        (1, "nan", {"restart_failed_sub_environments": True}, 1),
    ],
)
def test_environments_are_made_anew_as_often_as_rllibs_settings_say(
    ray_session: None, worker_index: int, what: str, settings: dict[str, Any], attempts: int
) -> None:
    config = config_of(what=what).fault_tolerance(num_consecutive_env_runner_failures_tolerance=3, **settings)
    runner = runner_of(config, worker_index)
    with pytest.raises(KeyError if what == "key" else ValueError, match=r"lidar|not finite") as caught:
        for _ in range(4):
            runner.sample()
    assert len(MADE) == 2 * attempts
    assert runner.error is caught.value
    assert caught.value.__suppress_context__ == (what != "nan")
    assert runner._needs_reset  # it does not go on in the middle of what went wrong


def test_after_a_failure_sampling_starts_anew(ray_session: None, caplog: pytest.LogCaptureFixture) -> None:
    """What was sampled before is dropped, or, where episodes are counted, kept apart."""
    config = config_of(bad_copies=2)
    runner = runner_of(config, 1)
    (sample,) = runner.sample()
    assert len(MADE) == 4 and sample.obs[:, 0, 0, 0].tolist() == [0, 1, 2, 3, 4] and sample.terminated[4].all()
    assert "The environment of runner 1 raised KeyError('lidar') and is made anew (failure 1" in caplog.text
    assert runner._failures == 0
    runner = runner_of(config, 1)
    before, after = runner.sample(num_episodes=2)
    assert len(before.obs) == 2 and len(after.obs) == 5
    assert after.start > before.start + 2  # a gap: replay does not join the two
    assert int(runner.get_metrics()["num_episodes"].peek()) == 2
    caplog.clear()
    config = config_of(bad_copies=2, what="expected")
    assert len(runner_of(config, 1).sample()) == 1 and not caplog.text


def test_environments_made_anew_play_other_episodes(ray_session: None) -> None:
    def starts(restarts: int) -> np.ndarray:
        config = small_config("maddpg").fault_tolerance(restart_failed_sub_environments=True)
        runner = runner_of(config)
        if restarts:
            runner.env.step = lambda actions: 1 / 0
        return runner.sample(num_timesteps=2)[0].obs[0]

    assert np.array_equal(starts(1), starts(1)) and not np.array_equal(starts(0), starts(1))


def test_failures_without_an_episode_in_between_are_counted(ray_session: None) -> None:
    """Fragments of one step are all sampled, but no episode ever ends."""
    config = config_of(at=2).env_runners(rollout_fragment_length=1)
    config.fault_tolerance(restart_failed_sub_environments=True, num_consecutive_env_runner_failures_tolerance=3)
    runner = runner_of(config)
    with pytest.raises(KeyError, match="lidar"):
        for _ in range(100):
            runner.sample()
    assert len(MADE) == 2 * 4


def test_an_environment_that_a_remote_runner_cannot_make_reaches_the_caller(ray_session: None) -> None:
    config = config_of(1, what="unmade").fault_tolerance(num_consecutive_env_runner_failures_tolerance=2)
    runner = runner_of(config, 1)
    runner.assert_healthy()
    assert isinstance(runner.error, KeyError) and len(MADE) == 1
    # As after a crash, when there is no algorithm to be built that would ask.
    with pytest.raises(KeyError, match="no lidar"):
        runner.sample()
    assert len(MADE) == 4
    with pytest.raises(KeyError, match="no lidar"):
        config.build_algo()


def test_other_errors_are_left_to_rllib(ray_session: None) -> None:
    """RLlib ends the process; so it does with sampling if the runner's failures are to be ignored."""
    runner = runner_of(config_of().fault_tolerance(restart_failed_env_runners=False), 1)
    with pytest.raises(SystemExit):
        runner.apply(lambda runner: 1 / 0)
    with pytest.raises(KeyError, match="lidar"):
        runner.apply(lambda runner: runner.sample())
    assert runner.apply(lambda runner, value: value, 5) == 5
    config = config_of().fault_tolerance(restart_failed_env_runners=False, ignore_env_runner_failures=True)
    with pytest.raises(SystemExit):
        runner_of(config, 1).apply(lambda runner: runner.sample())


def test_errors_are_made_portable() -> None:
    error = portable(KeyError("lidar"), "env runner 3")
    again = ray.cloudpickle.loads(ray.cloudpickle.dumps(error))
    assert type(again) is KeyError and again.__notes__[0].startswith("In env runner 3:\nKeyError: 'lidar'")
    error = portable(LidarError(2, at=1), "env runner 3")
    assert type(error) is RuntimeError and str(error) == "LidarError: sensor 2 at step 1"


def test_runners_that_never_come_back_end_the_training(ray_session: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an error of the environment, as when their processes crash again and again."""
    algo = config_of(at=9).fault_tolerance(num_consecutive_env_runner_failures_tolerance=3).build_algo()
    rounds: list[bool] = []
    monkeypatch.setattr(algo, "_sample", lambda: rounds.append(True) or [])
    with pytest.raises(RuntimeError, match=r"No env runner sampled anything in 4 rounds .*crash, or take longer than"):
        algo.train()
    assert len(rounds) == 4
    algo.stop()


def test_an_error_of_a_callback_at_a_samples_end_reaches_the_caller(ray_session: None) -> None:
    config = small_config("iddpg").env_runners(num_env_runners=1, num_cpus_per_env_runner=0.5)
    algo = config.callbacks(on_sample_end=lambda **given: {}["what I wanted"]).build_algo()
    with pytest.raises(KeyError, match="what I wanted"):
        algo.train()
    algo.stop()


def test_training_that_diverges_ends(ray_session: None) -> None:
    """The squares of such rewards are infinite in single precision; agents' losses are told apart."""
    algo = small_config("maddpg").training(reward_scale=1e25).build_algo()
    try:
        message = r"^critic_loss of agent_0 is inf in update \d+: training has diverged\. .* lower critic_lr"
        with pytest.raises(FloatingPointError, match=message):
            for _ in range(3):
                algo.train()
    finally:
        algo.stop()
