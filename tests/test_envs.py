"""Every scenario through every face; then Spread in hand-placed situations."""

import pickle

import numpy as np
import pytest
from mpe2 import simple_spread_v3
from pettingzoo.test import parallel_api_test
from ray.rllib.algorithms.ppo import PPOConfig

from rllib_maobs.envs import (
    SCENARIOS,
    EpisodeMetricsCallback,
    MAObsEnv,
    Spread,
    make_scenario,
    make_vec,
    parallel_env,
)
from tests.episodes import episode_metrics, glide, place, roll, sample_actions

IDS = sorted(SCENARIOS)
MODES = ["mpe", "force", "discrete"]


@pytest.fixture(params=IDS)
def scenario_id(request):
    return request.param


@pytest.fixture(params=MODES)
def mode(request):
    return request.param


# Every scenario: interface.


def test_shapes_dtypes_and_spaces(scenario_id, mode):
    env = make_vec(scenario_id, num_envs=3, action_mode=mode)
    n, o = len(env.agents), env.scenario.observation_size
    obs, info = env.reset(seed=0)
    assert obs.shape == (3, n, o) and obs.dtype == np.float32 and info == {}
    for actions in sample_actions(env, 5):
        for agent, action in zip(env.agents, actions[0], strict=True):
            assert env.action_spaces[agent].contains(action)
        obs, rewards, terminated, truncated, info = env.step(actions)
        assert rewards.shape == (3, n) and rewards.dtype == np.float32
        assert terminated.shape == truncated.shape == (3,) and info == {}
        for copy in obs:
            assert all(env.observation_spaces[a].contains(x) for a, x in zip(env.agents, copy, strict=True))
        assert np.isfinite(obs).all() and np.isfinite(rewards).all()


def test_states(scenario_id):
    env = make_vec(scenario_id, num_envs=2)
    obs, _ = env.reset(seed=0)
    world = np.concatenate(
        [env.world.position.reshape(2, -1), env.world.velocity[:, : env.world.num_movers].reshape(2, -1)],
        axis=1,
    )
    np.testing.assert_array_equal(env.state(), obs.reshape(2, -1))
    np.testing.assert_array_equal(env.state("world"), world.astype(np.float32))
    assert env.state("world").shape == (2, env.state_size("world"))
    assert env.state("observations").shape == (2, env.state_size("observations"))
    by_option = make_vec(scenario_id, num_envs=2, state="world")
    by_option.reset(seed=0)
    np.testing.assert_array_equal(by_option.state(), env.state("world"))
    with pytest.raises(ValueError, match="legal: 'observations', 'world'"):
        env.state("wrld")


def test_one_copy_equals_64(scenario_id):
    """Copy e of seed 7 plays what a single copy of seed 7 + e plays, over two episodes."""
    many = make_vec(scenario_id, num_envs=64)
    actions = sample_actions(many, 200)
    first = roll(many, actions[:100], seed=7)
    many.reset()
    second = roll(many, actions[100:])
    for e in (0, 1, 17, 63):
        single = make_vec(scenario_id, num_envs=1)
        ours = roll(single, actions[:100, e : e + 1], seed=7 + e)
        single.reset()
        ours_second = roll(single, actions[100:, e : e + 1])
        for theirs, own in ((first, ours), (second, ours_second)):
            np.testing.assert_array_equal(theirs[0][:, e], own[0][:, 0])
            np.testing.assert_array_equal(theirs[1][:, e], own[1][:, 0])
            for name, value in own[2].items():
                assert theirs[2][name][e] == value[0], name


def test_copies_and_episodes_differ(scenario_id):
    env = make_vec(scenario_id, num_envs=2, physics="solid")
    actions = sample_actions(env, 100)
    actions[:, 1] = actions[:, 0]
    first, _, _ = roll(env, actions, seed=0)
    random_start = not np.array_equal(first[0, 0], first[0, 1])
    obs, _ = env.reset()
    assert np.array_equal(obs, first[0]) != random_start


def test_whole_episode_is_determined_by_the_seed(scenario_id):
    actions = sample_actions(make_vec(scenario_id, num_envs=4), 100)
    a, b, other = (roll(make_vec(scenario_id, num_envs=4), actions, seed=s) for s in (3, 3, 400))
    np.testing.assert_array_equal(a[0], b[0])
    np.testing.assert_array_equal(a[1], b[1])
    assert np.array_equal(a[0], other[0]) == ("tunnel" in scenario_id)  # tunnels always start alike


def test_same_seed_same_episode_on_all_faces(scenario_id, mode):
    options = {"action_mode": mode}
    if hasattr(make_scenario(scenario_id).options, "reward_mode"):
        options["reward_mode"] = "individual"  # else a mix-up of agents could not be seen
    vec = make_vec(scenario_id, num_envs=1, **options)
    actions = sample_actions(vec, 100)
    observations, rewards, metrics = roll(vec, actions, seed=5)
    zoo = parallel_env(scenario_id, **options)
    rllib = MAObsEnv({"scenario": scenario_id, **options})
    for face in (zoo, rllib):
        obs, infos = face.reset(seed=5)
        assert list(obs) == list(infos) == vec.agents
        for t, step in enumerate(actions):
            np.testing.assert_array_equal([obs[a] for a in vec.agents], observations[t, 0])
            assert not any(infos.values())
            obs, reward, terminated, truncated, infos = face.step(dict(zip(vec.agents, step[0], strict=True)))
            assert [reward[a] for a in vec.agents] == rewards[t, 0].tolist()
            assert set(truncated.values()) == {t == 99} and set(terminated.values()) == {False}
        np.testing.assert_array_equal([obs[a] for a in vec.agents], observations[100, 0])
        for agent in vec.agents:
            assert infos[agent]["episode_metrics"] == {name: v[0] for name, v in metrics.items()}
        np.testing.assert_array_equal(face.state(), vec.state()[0])
        np.testing.assert_array_equal(face.state("world"), vec.state("world")[0])
    assert "__all__" in truncated and zoo.agents == [] and rllib.agents == vec.agents


def test_pickled_in_the_middle_of_an_episode_it_continues_identically(scenario_id):
    env = make_vec(scenario_id, num_envs=3)
    actions = sample_actions(env, 150)
    roll(env, actions[:40], seed=0)
    copy = pickle.loads(pickle.dumps(env))
    ends = []
    for one in (env, copy):
        rest = roll(one, actions[40:100])
        obs, _ = one.reset()
        ends.append((*rest, obs, roll(one, actions[100:])[0]))
    for mine, theirs in zip(*ends, strict=True):
        np.testing.assert_equal(mine, theirs)


def test_parallel_api(scenario_id, mode, recwarn):
    parallel_api_test(parallel_env(scenario_id, action_mode=mode), num_cycles=250)
    assert not [str(w.message) for w in recwarn]


def test_rllib_env_makes_vectors_of_itself():
    env = MAObsEnv({"scenario": "spread-3a", "num_obstacles": 1, "horizon": 7})
    vec = env.make_vec(5)
    assert vec.num_envs == 5 and vec.horizon == 7 and vec.scenario.options.num_obstacles == 1
    assert vec.observation_spaces == env.observation_spaces


def test_stock_ppo_trains_and_reports_metrics(ray_session):
    config = (
        PPOConfig()
        .environment(MAObsEnv, env_config={"scenario": "spread-3a", "horizon": 20})
        .env_runners(num_env_runners=0)
        .multi_agent(policies={"shared"}, policy_mapping_fn=lambda agent, episode, **kwargs: "shared")
        .training(train_batch_size_per_learner=60, minibatch_size=60, num_epochs=1)
        .callbacks(EpisodeMetricsCallback)
    )
    algo = config.build_algo()
    try:
        result = algo.train()["env_runners"]
        assert 0.0 <= result["episode_metrics"]["coverage_mean"] <= 1.0
        assert result["episode_metrics"]["episode_length"] == result["episode_len_mean"] == 20
        mean_agent = np.mean(list(result["agent_episode_returns_mean"].values()))
        assert result["episode_metrics"]["return_agent_0"] == pytest.approx(mean_agent)
    finally:
        algo.stop()


# Episodes: ends, resets, masks.


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


def test_terminates_on_success_if_asked():
    env = make_vec("spread-3a", num_envs=2, terminate_on_success=True)
    env.reset(seed=0)
    env.world.position[1, :3] = env.world.position[1, env.world.index["target"]]
    _, _, terminated, truncated, info = env.step(np.zeros((2, 3, 5)))
    assert terminated.tolist() == [False, True] and truncated.tolist() == [False, False]
    metrics = {name: value[1] for name, value in info["episode_metrics"].items()}
    assert metrics["success"] == metrics["time_to_goal"] == metrics["episode_length"] == 1.0
    assert np.isnan(info["episode_metrics"]["success"][0])


def test_a_copy_that_solves_the_task_in_the_last_step_terminates():
    env = make_vec("spread-3a", horizon=1, terminate_on_success=True)
    env.reset(seed=0)
    env.world.position[0, :3] = env.world.position[0, env.world.index["target"]]
    _, _, terminated, truncated, _ = env.step(np.zeros((1, 3, 5)))
    assert terminated.all() and not truncated.any()


# Errors, by message.


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"num_agnets": 3},
            r"Spread has no option 'num_agnets' \(did you mean 'num_agents'\?\); legal options: hori",
        ),
        ({"num_agents": 0}, r"Spread: num_agents=0 is illegal; legal: an integer >= 1"),
        ({"num_agents": 2.0}, r"num_agents=2.0 is illegal; legal: an integer >= 1"),
        ({"num_agents": True}, r"num_agents=True is illegal"),
        ({"agent_radius": 0.0}, r"agent_radius=0.0 is illegal; legal: a number > 0"),
        ({"accel": float("nan")}, r"accel=nan is illegal"),
        ({"max_speed": -1}, r"max_speed=-1 is illegal; legal: a number > 0 or None"),
        ({"reward_mode": "total"}, r"reward_mode='total' is illegal; legal: 'sum', 'mean', 'individual'"),
        ({"terminate_on_success": 1}, r"terminate_on_success=1 is illegal; legal: True or False"),
        (
            {"agent_radius": 1.0, "num_agents": 12},
            r"agent_0 .. obstacle_1 \(14 bodies\) do not fit: .* missing\)",
        ),
    ],
)
def test_illegal_options(options, message):
    with pytest.raises(ValueError, match=message):
        make_vec("spread-3a", **options)


def test_options_take_numpy_scalars():
    options = make_scenario("spread-3a", num_agents=np.int64(4), accel=3, max_speed=None).options
    assert type(options.num_agents) is int and type(options.accel) is float and options.max_speed is None


def test_layouts_that_are_never_found_name_the_bodies():
    env = make_vec("spread-3a", num_agents=12, agent_radius=0.36, num_obstacles=0)
    with pytest.raises(ValueError, match=r"in the last one (agent|target)_\d+ is 0\.\d+ too close to (agent|target)_"):
        env.reset(seed=0)


def test_unknown_ids():
    for make in (make_vec, parallel_env, lambda name: MAObsEnv({"scenario": name})):
        with pytest.raises(ValueError, match=r"'spread-9' \(did you mean 'spread-9a'\?\); legal ids: .*spread-3a"):
            make("spread-9")
    with pytest.raises(ValueError, match='needs a "scenario"'):
        MAObsEnv({})


def test_illegal_steps():
    env = make_vec("spread-3a", num_envs=3)
    actions = np.zeros((3, 3, 5), np.float32)
    with pytest.raises(RuntimeError, match=r"step\(\) before reset\(\): copies \[0, 1, 2\] were never reset"):
        env.step(actions)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(3, 5\); expected \(E, N, A\) = \(3, 3, 5\)"):
        env.step(actions[0])
    actions[2, 1, 0] = np.nan
    with pytest.raises(ValueError, match="action of agent_1 in copy 2 is not finite"):
        env.step(actions)
    with pytest.raises(ValueError, match="legal: an integer >= 0, or 3 of them, or None"):
        env.reset(seed=[1, 2])
    with pytest.raises(ValueError, match=r"mask is int64 of shape \(3,\); expected bool"):
        env.reset(mask=np.array([0, 1, 0]))
    with pytest.raises(ValueError, match="num_envs=0 is illegal"):
        make_vec("spread-3a", num_envs=0)


def test_illegal_discrete_steps():
    env = make_vec("spread-3a", num_envs=2, action_mode="discrete")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action of agent_2 in copy 0 is not in 0 \.\. 4: 5"):
        env.step(np.array([[0, 1, 5], [0, 0, 0]]))
    with pytest.raises(ValueError, match="discrete actions are float64; expected integers"):
        env.step(np.zeros((2, 3)))


def test_faces_want_an_action_of_every_agent():
    env = MAObsEnv({"scenario": "spread-3a"})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"missing: \['agent_2'\], unknown: \['agent_7'\]"):
        env.step({agent: np.zeros(5) for agent in ("agent_0", "agent_1", "agent_7")})


@pytest.mark.parametrize("face", [parallel_env, lambda name: MAObsEnv({"scenario": name})])
def test_faces_name_the_agent_of_an_illegal_action(face):
    env = face("simple-tunnel")
    with pytest.raises(RuntimeError, match=r"^step\(\) before reset\(\)$"):
        env.step({})
    env.reset(seed=0)
    actions = {f"agent_{i}": np.zeros(5, np.float32) for i in range(3)}
    with pytest.raises(ValueError, match=r"action of agent_1 has shape \(2,\); expected \(5,\)"):
        env.step(actions | {"agent_1": np.zeros(2)})
    with pytest.raises(ValueError, match="action of agent_2 in copy 0 is not finite"):
        env.step(actions | {"agent_2": np.array([0.0, np.inf, 0.0, 0.0, 0.0])})
    for _ in range(100):
        env.step(actions)
    for late in (actions, {}):
        with pytest.raises(RuntimeError, match=r"step\(\) after the end of the episode: call reset\(\) first"):
            env.step(late)


# Actions.


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


# Spread: layouts, observations, rewards, metrics.


def test_spread_sizes():
    for name, n, m, o in (("spread-3a", 3, 2, 18), ("spread-6a", 6, 4, 34), ("spread-9a", 9, 6, 50)):
        env = make_vec(name)
        assert (len(env.agents), env.scenario.options.num_obstacles, env.scenario.observation_size) == (
            n,
            m,
            o,
        )
        assert env.world.body_names[0] == "agent_0" and env.world.num_bodies == 2 * n + m
        assert env.state_size("world") == 6 * n + 2 * m


def test_spread_separated_layouts_are_solvable():
    env = make_vec("spread-9a", num_envs=64)
    for seed in (0, 1000):
        env.reset(seed=seed)
        p = env.world.position
        assert (np.abs(p[:, :9]) <= 1.0).all() and (np.abs(p[:, 9:15]) <= 0.9).all()
        assert np.abs(p[:, :9]).max() > 0.97 and np.abs(p[:, 9:15]).max() > 0.87
        distance = np.linalg.norm(p[:, :, None] - p[:, None], axis=-1) + 9.0 * np.eye(24)
        agents, obstacles, targets = slice(0, 9), slice(9, 15), slice(15, 24)
        assert distance[:, agents, agents].min() >= 0.32
        assert distance[:, targets, targets].min() >= 0.32
        assert distance[:, agents, obstacles].min() >= 0.27
        assert distance[:, targets, obstacles].min() >= 0.27
        assert distance[:, agents, targets].min() < 0.1  # an agent may start on a target


def test_spread_mpe_layouts_are_unchecked():
    env = make_vec("spread-9a", num_envs=64, placement="mpe")
    env.reset(seed=0)
    gaps = env.world.gap
    assert (gaps < 0.0).any(axis=(1, 2)).mean() > 0.9


def spread_2(**options):
    return make_vec("spread-3a", num_agents=2, num_obstacles=1, **options)


def test_spread_observation_by_hand():
    env = spread_2()
    place(env, [[0.0, 0.0], [0.5, 0.1], [-0.5, 0.2], [1.0, 1.0], [-1.0, 0.5]])
    env.world.velocity[0, 1] = [0.3, -0.4]
    expected = [
        [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, -1.0, 0.5, -0.5, 0.2, 0.5, 0.1],
        [0.3, -0.4, 0.5, 0.1, 0.5, 0.9, -1.5, 0.4, -1.0, 0.1, -0.5, -0.1],
    ]
    np.testing.assert_allclose(env.observe()[0], expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("mode", "expected"), [("individual", [-3.0, -1.0]), ("sum", [-4.0, -4.0]), ("mean", [-2.0, -2.0])]
)
def test_spread_reward_modes(mode, expected):
    """Targets 0.4 and 0.6 from the nearest agent; agent 0 runs into the obstacle, at twice the price."""
    env = spread_2(reward_mode=mode, obstacle_collision_penalty=2.0)
    place(env, [[0.05, 0.0], [0.0, 1.0], [-0.24, 0.0], [0.4, 0.0], [0.6, 1.0]])
    _, rewards, _, _, _ = glide(env, [[-0.05, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(rewards[0], expected, rtol=1e-6)


def test_spread_agents_in_contact_both_pay():
    env = spread_2(reward_mode="individual", agent_collision_penalty=0.5)
    place(env, [[-0.17, 0.0], [0.17, 0.0], [5.0, 5.0], [-0.12, 0.0], [0.12, 0.0]])
    _, rewards, _, _, _ = glide(env, [[0.05, 0.0], [-0.05, 0.0]])
    np.testing.assert_allclose(rewards[0], [-0.5, -0.5], rtol=1e-6)


def test_spread_coverage_metrics_by_hand():
    """Agent 0 is 0.05 from its target; agent 1 arrives at its own in step 3 of 4, or passes it by."""
    env = spread_2(horizon=4, max_speed=None)
    start = [[0.0, 0.0], [1.0, 0.0], [5.0, 5.0], [0.0, 0.05], [2.0, 0.0]]
    place(env, start)
    for move in (0.1, 0.1, 0.75, 0.0):  # to 1.1, 1.2, 1.95, 1.95
        *_, info = glide(env, [[0.0, 0.0], [move, 0.0]])
    arrived = episode_metrics(info)
    assert arrived["coverage"] == arrived["all_covered"] == arrived["success"] == 1.0
    assert arrived["coverage_mean"] == 0.75 and arrived["all_covered_mean"] == 0.5
    assert arrived["time_to_goal"] == 3.0 and arrived["episode_length"] == 4.0
    assert arrived["target_distance"] == pytest.approx(0.05 + (0.9 + 0.8 + 0.05 + 0.05) / 4)
    assert arrived["collision_free"] == 1.0 and arrived["path_efficiency"] == pytest.approx(1.0)
    assert arrived["min_clearance"] == pytest.approx(1.1 - 0.3)
    place(env, start)
    for move in (0.1, 0.1, 0.7, 0.4):  # to 1.1, 1.2, 1.9 - just not near enough -, 2.3
        *_, info = glide(env, [[0.0, 0.0], [move - 1e-6, 0.0]])
    passed = episode_metrics(info)
    assert passed["coverage"] == passed["coverage_mean"] == 0.5
    assert passed["success"] == passed["all_covered"] == passed["all_covered_mean"] == 0.0
    assert passed["time_to_goal"] == 4.0


def test_spread_collision_metrics_by_hand():
    """One contact of the agents, one of agent 0 with the obstacle, then both agents with it."""
    env = spread_2(horizon=3)
    place(env, [[-0.17, 0.0], [0.17, 0.0], [9.0, 0.0], [3.0, 0.0], [3.0, 0.0]])
    _, first, *_ = glide(env, [[0.05, 0.0], [-0.05, 0.0]])
    env.world.position[0, :3] = [[0.0, 0.0], [5.0, 0.0], [0.29, 0.0]]
    _, second, *_ = glide(env, [[0.05, 0.0], [0.0, 0.0]])
    env.world.position[0, :3] = [[-0.29, 0.0], [0.29, 0.0], [0.0, 0.0]]
    _, third, _, _, info = glide(env, [[0.05, 0.0], [-0.05, 0.0]])
    m = episode_metrics(info)
    assert (m["collisions_agents"], m["collisions_obstacles"], m["collisions_walls"]) == (1.0, 3.0, 0.0)
    assert m["collision_free"] == 0.0
    assert m["min_clearance"] == pytest.approx(0.24 - 0.3, abs=1e-6)
    assert m["return_agent_0"] == pytest.approx(float(first[0, 0] + second[0, 0] + third[0, 0]), rel=1e-6)


def test_path_efficiency_of_a_detour():
    """Moves by hand between the steps are no part of the path."""
    env = make_vec("spread-3a", num_agents=1, num_obstacles=0, horizon=2)
    env.reset(seed=0)
    env.world.position[0, 0] = [0.0, 0.0]
    glide(env, [[0.06, 0.0]])
    *_, info = glide(env, [[0.0, 0.08]])
    assert episode_metrics(info)["path_efficiency"] == pytest.approx(0.1 / 0.14)


def test_metrics_start_anew_each_episode():
    env = make_vec("spread-3a", num_envs=1, horizon=20)
    actions = sample_actions(env, 20)
    first = roll(env, actions, seed=0)[2]
    env.reset(seed=99)
    roll(env, actions)
    again = roll(env, actions, seed=0)[2]
    assert first == again


@pytest.mark.parametrize("seed", range(3))
def test_spread_is_mpe2_simple_spread(seed):
    """Observations and rewards of a whole episode, in MPE2's order of integration, without our additions."""
    n = 9
    theirs = simple_spread_v3.parallel_env(N=n, max_cycles=100, local_ratio=0.5, continuous_actions=True)
    ours = make_vec(
        "spread-9a",
        num_obstacles=0,
        integrator="explicit",
        max_speed=None,
        placement="mpe",
        reward_mode="individual",
    )
    theirs.reset(seed=seed)
    ours.reset(seed=seed)
    world = theirs.unwrapped.world
    ours.world.position[0] = [body.state.p_pos for body in world.entities]
    rng = np.random.default_rng(seed)
    for _ in range(100):
        actions = (rng.integers(0, 257, (n, 5)) / 256).astype(np.float32)  # exact also in MPE2's float32 sums
        swapped = actions[:, [0, 2, 1, 4, 3]]  # MPE2 has the opposite signs
        obs, rewards, _, _, _ = theirs.step({f"agent_{i}": a for i, a in enumerate(swapped)})
        own_obs, own_rewards, _, _, _ = ours.step(actions[None])
        o = ours.scenario.observation_size  # theirs ends in empty communication
        np.testing.assert_allclose(own_obs[0], [obs[f"agent_{i}"][:o] for i in range(n)], atol=1e-5)
        np.testing.assert_allclose(own_rewards[0] / 2, list(rewards.values()), atol=1e-5)


# Documentation.


def test_scenario_documentation_names_every_option():
    for cls, _ in SCENARIOS.values():
        assert cls.__doc__
        for name in cls.options_class.__dataclass_fields__:
            assert f"{name}:" in cls.__doc__, f"{cls.__name__} does not document {name}"


def test_spread_repr_shows_the_options():
    assert "num_agents=4" in repr(Spread(num_agents=4))
