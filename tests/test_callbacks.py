"""RLlib's callbacks: the joint runner makes the calls that RLlib's own runner makes, and none where nobody listens."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from ray import tune
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.env.multi_agent_env import MultiAgentEnv
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner

import rllib_maobs as maobs
from rllib_maobs.runner import JointEnvRunner, JointSample
from tests.conftest import small_config

CALLS: list[tuple[Any, ...]] = []


class Lamp(MultiAgentEnv):
    """Two agents that differ, five steps, and infos; terminal or not."""

    def __init__(self, config: dict) -> None:
        super().__init__()
        self.possible_agents = self.agents = ["left", "right"]
        self.observation_spaces = {
            a: gym.spaces.Box(-9.0, 9.0, (n,), np.float32) for a, n in (("left", 2), ("right", 3))
        }
        one = gym.spaces.Discrete(3) if config.get("discrete") else gym.spaces.Box(2.0, 6.0, (2,), np.float32)
        self.action_spaces = {"left": one, "right": one}
        self.terminal, self.t = config.get("terminal", True), 0

    def _seen(self) -> tuple[dict, dict]:
        obs = {a: np.full(space.shape, self.t, np.float32) for a, space in self.observation_spaces.items()}
        return obs, {a: {"t": self.t, "who": a} for a in self.agents}

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        self.t = 0
        return self._seen()

    def step(self, actions: dict) -> tuple:
        self.t += 1
        obs, infos = self._seen()
        rewards = {a: self.t + float(np.sum(actions[a])) for a in self.agents}
        over, never = (dict.fromkeys([*self.agents, "__all__"], flag) for flag in (self.t == 5, False))
        return obs, rewards, *((over, never) if self.terminal else (never, over)), infos


def look(name: str, given: dict[str, Any]) -> tuple[Any, ...]:
    """What a callback can see, as it will not change any more."""
    episode = given.get("episode")
    if episode is None:
        return name, sorted(given)
    seen: tuple[Any, ...] = (name, sorted(given), given["env_index"], episode.env_t)
    if "prev_episode_chunks" in given:
        seen += (given["prev_episode_chunks"],)
    if not episode.is_reset:
        return seen
    parts = (episode.get_observations, episode.get_infos, episode.get_actions, episode.get_rewards)
    return (
        *seen,
        [get(-1) for get in parts[: 2 if episode.env_t == 0 else 4]],
        [episode.get_return(), len(episode), episode.is_terminated, episode.is_truncated],
        [{a: one.get_return() for a, one in episode.agent_episodes.items()}, episode.module_for("right")],
        [episode.get_terminateds(), episode.get_truncateds()],
        [given["env"].envs[given["env_index"]].unwrapped.t],
    )


class Recorder(RLlibCallback):
    """Notes every call of a runner."""

    def __init__(self) -> None:
        def note(name: str) -> Any:
            return lambda **given: CALLS.append(look(name, given))

        for name in (
            "environment_created",
            "sample_end",
            *(f"episode_{p}" for p in ("created", "start", "step", "end")),
        ):
            setattr(self, f"on_{name}", note(f"on_{name}"))


def config_of(callbacks: Any = None, **env_config: Any) -> maobs.JointConfig:
    algorithm = "iql" if env_config.get("discrete") else "maddpg"
    config = small_config(algorithm).environment(Lamp, env_config=env_config)
    if callbacks is not None:
        config.callbacks(callbacks)
    config.validate()
    return config


def calls_of(config: Any, runner_class: type, weights: Any = None) -> tuple[list[Any], Any]:
    """The calls of one runner that samples fragments and then episodes, and its weights."""
    CALLS.clear()
    config.env_runner_cls = runner_class
    runner = runner_class(config=config, worker_index=0, num_workers=0)
    if weights is not None:
        runner.module.set_state(weights)
    runner.sample(num_timesteps=24, explore=False)
    runner.sample(num_episodes=2, explore=False)
    runner.sample(num_episodes=2, explore=False)
    return list(CALLS), runner.module.get_state()


def near(one: Any, other: Any) -> bool:
    """Equality that floats of another order of sums pass."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(near(value, other[key]) for key, value in one.items())
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(near, one, other))
    if isinstance(one, np.ndarray | float | int | np.number):
        return np.shape(one) == np.shape(other) and np.allclose(one, other, atol=1e-5)
    return bool(one == other)


@pytest.mark.parametrize("options", [{}, {"terminal": False}])
def test_the_calls_are_those_of_rllibs_runner(ray_session: None, options: dict[str, Any]) -> None:
    want, weights = calls_of(config_of(Recorder, **options), MultiAgentEnvRunner)
    got, _ = calls_of(config_of(Recorder, **options), JointEnvRunner, weights)
    assert [call[:4] for call in got] == [call[:4] for call in want]
    assert {call[0] for call in want} > {"on_environment_created", "on_sample_end", "on_episode_end"}
    for mine, theirs in zip(got, want, strict=True):
        assert near(mine, theirs), f"{mine} is not {theirs}"


def test_episodes_are_whole_and_add_up(ray_session: None) -> None:
    """With fragments of one step and discrete actions; RLlib's runner would cut them to chunks of one step."""
    ended: list[Any] = []

    def end(*, episode: Any, metrics_logger: Any, **given: Any) -> None:
        ended.append((episode, given["prev_episode_chunks"]))
        metrics_logger.log_value("last_t", episode.get_infos(-1)["left"]["t"])
        metrics_logger.log_value("marks", len(episode.custom_data["marks"]))

    def step(*, episode: Any, **given: Any) -> None:
        episode.custom_data.setdefault("marks", []).append(episode.env_t)

    config = config_of(discrete=True).callbacks(on_episode_end=end, on_episode_step=[step, step])
    runner = JointEnvRunner(config=config, worker_index=0, num_workers=0)
    samples = [sample for _ in range(10) for sample in runner.sample()]
    results = runner.get_metrics()
    assert results["last_t"].peek() == 5 and results["marks"].peek() == 10
    assert len(ended) == 4 and len({episode.id_ for episode, _ in ended}) == 4
    rewards = np.concatenate([sample.rewards for sample in samples])  # (10, 2, 2)
    for number, (episode, chunks) in enumerate(ended):
        own = rewards[number // 2 * 5 :, number % 2][:5]
        assert chunks == [] and len(episode) == 5
        assert episode.get_return() == pytest.approx(own.sum())
        assert all(action in (0, 1, 2) for action in episode.get_actions(slice(0, 5))["left"])
        # The reward is the step's number and the action.
        assert np.add(episode.get_actions(slice(0, 5))["left"], np.arange(1, 6)).tolist() == own[:, 0].tolist()


def test_nothing_is_kept_where_nobody_looks(ray_session: None) -> None:
    class SampleEnd(RLlibCallback):
        def on_sample_end(self, *, samples: Any, **given: Any) -> None:
            CALLS.append(tuple(samples))

    CALLS.clear()
    for callbacks in (None, SampleEnd, [SampleEnd, RLlibCallback]):
        config = config_of(callbacks)
        runner = JointEnvRunner(config=config, worker_index=0, num_workers=0)
        runner.sample(num_timesteps=4)
        assert runner._watcher is None
    assert len(CALLS) == 2 and all(isinstance(samples[0], JointSample) for samples in CALLS)


def test_a_restored_runner_goes_on_with_its_episodes(ray_session: None) -> None:
    lengths: list[int] = []

    def end(*, episode: Any, **given: Any) -> None:
        lengths.append(len(episode))

    config = config_of().callbacks(on_episode_end=end)
    first, second, third = (JointEnvRunner(config=config, worker_index=0, num_workers=0) for _ in range(3))
    first.sample(num_timesteps=2 * 3)
    state = first.get_state()
    second.set_state(state)
    second.sample(num_timesteps=2 * 2)
    assert lengths == [5, 5]
    # Episodes of which the beginning is not known are not shown in part.
    state["sampling"]["watched"] = None
    third.sample(num_timesteps=2)
    third.set_state(state)
    third.sample(num_timesteps=2 * 7)
    assert lengths == [5, 5, 5, 5]


def test_episodes_that_do_not_count_are_not_shown(ray_session: None) -> None:
    """Three episodes on two copies: the second one's second episode is played, but not counted."""
    CALLS.clear()
    runner = JointEnvRunner(config=config_of(Recorder), worker_index=0, num_workers=0)
    runner.sample(num_episodes=3, explore=False)
    names = [call[0] for call in CALLS]
    assert names.count("on_episode_start") == names.count("on_episode_end") == 3
    assert names.count("on_episode_step") == 15


def test_training_and_evaluation_call_them(ray_session: None) -> None:
    """On the package's own environment, which has no infos: the metrics of an episode are in its last ones."""

    class Marks(RLlibCallback):
        def on_environment_created(self, *, env_runner: Any, env: Any, env_context: Any, **given: Any) -> None:
            assert env.num_envs == 2 and env_context.worker_index == env_runner.worker_index
            self.agents = env.agents

        def on_episode_end(self, *, episode: Any, env_runner: Any, metrics_logger: Any, **given: Any) -> None:
            assert sorted(episode.agent_ids) == self.agents
            assert "collisions_agents" in episode.get_infos(-1)["agent_0"]["episode_metrics"]
            metrics_logger.log_value("in_evaluation", float(env_runner.config.in_evaluation), window=1)

    config = small_config("maddpg", horizon=10).callbacks(Marks)
    config.training(agent_id_input=True)
    config.evaluation(evaluation_interval=1, evaluation_duration=2)
    algo = config.build_algo()
    try:
        result = algo.train()
    finally:
        algo.stop()
    training, evaluation = result["env_runners"], result["evaluation"]["env_runners"]
    assert (training["in_evaluation"], evaluation["in_evaluation"]) == (0, 1)


def test_stock_episode_metrics_callback_changes_nothing(ray_session: None) -> None:
    def metrics(config: maobs.JointConfig) -> dict[str, float]:
        config.validate()
        runner = JointEnvRunner(config=config, worker_index=0, num_workers=0)
        runner.sample(num_timesteps=20)
        return {name: value.peek() for name, value in runner.get_metrics()["episode_metrics"].items()}

    plain = metrics(small_config("maddpg", horizon=5))
    assert plain
    assert metrics(small_config("maddpg", horizon=5).callbacks(maobs.EpisodeMetricsCallback)) == pytest.approx(plain)


def test_a_dict_environment_is_what_callbacks_get(ray_session: None) -> None:
    """Behind agent ids and another order of the agents, too."""
    found: list[Any] = []
    made: list[Lamp] = []

    def make(config: dict) -> Lamp:
        made.append(Lamp(config))
        if len(made) > 1:  # the first one says which order is the team's
            made[-1].possible_agents = ["right", "left"]
        return made[-1]

    tune.register_env("lamp", make)
    config = small_config("maddpg").environment("lamp").training(agent_id_input=True)
    config.callbacks(on_environment_created=lambda *, env, **given: found.extend(env.envs)).validate()
    JointEnvRunner(config=config, worker_index=0, num_workers=0)
    assert [type(env) for env in found] == [Lamp, Lamp] and found[0] is not found[1]
