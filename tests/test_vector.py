"""Episodes of many copies: ends, resets, masks, seeds, actions."""

import numpy as np
import pytest

from rllib_maobs.envs import make_vec
from tests.episodes import roll, sample_actions


def test_last_observation_is_the_true_final_one():
    env = make_vec("spread-3a", num_envs=2, horizon=3)
    env.reset(seed=0)
    for step in sample_actions(env, 3):
        obs, _, terminated, truncated, info = env.step(step)
    assert truncated.all() and not terminated.any() and "episode_metrics" in info
    np.testing.assert_array_equal(obs[..., 2:4], env.world.position[:, :3].astype(np.float32))
    start, _ = env.reset()
    assert not np.array_equal(start, obs)


def test_mask_resets_only_those_copies():
    env, twin = (make_vec("spread-3a", num_envs=4, horizon=10) for _ in range(2))
    actions = sample_actions(env, 10)
    roll(env, actions[:6], seed=0), roll(twin, actions[:6], seed=0)
    mask = np.array([True, False, True, False])
    before = env.observe()
    obs, _ = env.reset(mask=mask)
    assert (obs[mask] != before[mask]).any(axis=(1, 2)).all()
    np.testing.assert_array_equal(obs[~mask], before[~mask])
    for t in range(6, 10):
        obs, _, _, truncated, info = env.step(actions[t])
        theirs, *_, twin_info = twin.step(actions[t])
        np.testing.assert_array_equal(obs[~mask], theirs[~mask])
    np.testing.assert_array_equal(truncated, ~mask)
    for name, value in info["episode_metrics"].items():
        assert np.isnan(value[mask]).all()
        np.testing.assert_array_equal(value[~mask], twin_info["episode_metrics"][name][~mask])
    with pytest.raises(RuntimeError, match=r"copies \[1, 3\]: call reset\(mask=terminated \| truncated\) first"):
        env.step(actions[0])
    env.reset(mask=np.array([False, True, False, False]))
    with pytest.raises(RuntimeError, match=r"end of the episode of copies \[3\]"):
        env.step(actions[0])
    env.reset(mask=np.array([False, False, False, True]))
    env.step(actions[0])


def test_masked_seeds():
    env = make_vec("spread-3a", num_envs=3)
    whole, _ = env.reset(seed=[4, 5, 6])
    assert env.seeds.tolist() == [4, 5, 6]
    env.reset(seed=100)
    obs, _ = env.reset(seed=[4, 5, 6], mask=np.array([False, True, False]))
    np.testing.assert_array_equal(obs[1], whole[1])
    assert env.seeds.tolist() == [100, 5, 102]
    # The streams of the others go on.
    twin = make_vec("spread-3a", num_envs=3)
    twin.reset(seed=100)
    np.testing.assert_array_equal(env.reset()[0][[0, 2]], twin.reset()[0][[0, 2]])


def test_without_a_seed_every_environment_is_another():
    first, second = (make_vec("spread-3a", num_envs=2).reset()[0] for _ in range(2))
    assert not np.array_equal(first, second) and not np.array_equal(first[0], first[1])


def test_terminates_on_success_if_asked():
    env = make_vec("spread-3a", num_envs=2, terminate_on_success=True)
    env.reset(seed=0)
    env.world.position[1, :3] = env.world.position[1, env.world.index["target"]]
    _, _, terminated, truncated, info = env.step(np.zeros((2, 3, 5)))
    assert terminated.tolist() == [False, True] and truncated.tolist() == [False, False]
    metrics = {name: value[1] for name, value in info["episode_metrics"].items()}
    assert metrics["success"] == metrics["time_to_goal"] == metrics["episode_length"] == 1.0
    assert metrics["coverage_mean"] == 1.0  # the mean over the steps that were played
    assert np.isnan(info["episode_metrics"]["success"][0])


def test_a_copy_that_solves_the_task_in_the_last_step_terminates():
    env = make_vec("spread-3a", horizon=1, terminate_on_success=True)
    env.reset(seed=0)
    env.world.position[0, :3] = env.world.position[0, env.world.index["target"]]
    _, _, terminated, truncated, _ = env.step(np.zeros((1, 3, 5)))
    assert terminated.all() and not truncated.any()


@pytest.mark.parametrize(
    ("mode", "action", "force"),
    [
        ("mpe", [1.0, 0.7, 0.2, -0.1, 0.3], [0.5, -0.4]),
        ("mpe", [0.0, 9.0, -9.0, 0.0, 0.0], [2.0, 0.0]),
        ("force", [0.3, -7.0], [0.3, -1.0]),
        ("discrete", 0, [0.0, 0.0]),
        ("discrete", 1, [1.0, 0.0]),
        ("discrete", 2, [-1.0, 0.0]),
        ("discrete", 3, [0.0, 1.0]),
        ("discrete", 4, [0.0, -1.0]),
    ],
)
def test_actions_accelerate(mode, action, force):
    env = make_vec("spread-3a", num_agents=1, num_obstacles=0, action_mode=mode, max_speed=None)
    env.reset(seed=0)
    env.step(np.array([[action]]))
    np.testing.assert_allclose(env.world.velocity[0, 0], 0.1 * 5.0 * np.array(force), rtol=1e-12)


def test_more_than_fits_into_memory():
    with pytest.raises(ValueError, match=r"^num_envs=1000000000000: so many copies do not fit into memory"):
        make_vec("spread-3a", num_envs=10**12)
    with pytest.raises(ValueError, match=r"num_agents=1000000000 is illegal; legal: an integer >= 1 and <= 1000$"):
        make_vec("spread-3a", num_agents=10**9)
