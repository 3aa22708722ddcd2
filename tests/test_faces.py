"""Every scenario through every face: shapes, spaces, states, seeds, pickles, and PettingZoo's first check."""

import copy
import pickle

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from rllib_maobs.envs import SCENARIOS, MAObsEnv, make_scenario, make_vec, parallel_env
from tests.episodes import roll, sample_actions

PREY = "obstacle-predator-prey"
IDS = sorted(SCENARIOS)
MODES = ["mpe", "force", "discrete"]


@pytest.fixture(params=IDS)
def scenario_id(request):
    return request.param


@pytest.fixture(params=MODES)
def mode(request):
    return request.param


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
        for row in obs:
            assert all(env.observation_spaces[a].contains(x) for a, x in zip(env.agents, row, strict=True))
        assert np.isfinite(obs).all() and np.isfinite(rewards).all()


def test_states(scenario_id):
    env = make_vec(scenario_id, num_envs=2)
    env.reset(seed=0)
    env.world.velocity += 0.5
    obs, movers = env.observe(), env.world.num_movers
    moving = np.concatenate([env.world.position[:, :movers], env.world.velocity[:, :movers]], axis=-1)
    world = np.concatenate([moving.reshape(2, -1), env.world.position[:, movers:].reshape(2, -1)], axis=1)
    np.testing.assert_array_equal(env.state(), obs.reshape(2, -1))
    np.testing.assert_array_equal(env.state("world"), world.astype(np.float32))
    assert env.state("world").shape == (2, env.state_size("world"))
    assert env.state("observations").shape == (2, env.state_size("observations"))
    by_option = make_vec(scenario_id, num_envs=2, state="world")
    env.reset(seed=0), by_option.reset(seed=0)
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
            infos[agent]["episode_metrics"].clear()  # nobody else's
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


def test_faces_copied_in_the_middle_of_an_episode_continue_identically(scenario_id):
    for face in (parallel_env(scenario_id), MAObsEnv({"scenario": scenario_id})):
        face.reset(seed=0)
        actions = face.heuristic()
        for _ in range(40):
            face.step(actions)
        ends = []
        for one in (face, copy.deepcopy(face), pickle.loads(pickle.dumps(face))):
            results = [one.step(actions) for _ in range(60)]
            ends.append((results, one.reset(), one.state()))
            one.close()
        np.testing.assert_equal(ends[1], ends[0])
        np.testing.assert_equal(ends[2], ends[0])


def test_faces_return_what_their_spaces_contain(scenario_id, mode):
    for face in (
        parallel_env(scenario_id, action_mode=mode),
        MAObsEnv({"scenario": scenario_id, "action_mode": mode}),
    ):
        obs, _ = face.reset(seed=0)
        for _ in range(3):
            for agent in face.agents:
                space = (
                    face.get_observation_space(agent) if isinstance(face, MAObsEnv) else face.observation_space(agent)
                )
                assert space.contains(obs[agent])
            obs, *_ = face.step(face.heuristic())


def test_parallel_api(scenario_id, mode, recwarn):
    parallel_api_test(parallel_env(scenario_id, action_mode=mode), num_cycles=250)
    assert not [str(w.message) for w in recwarn]


def test_rllib_env_makes_vectors_of_itself():
    env = MAObsEnv({"scenario": "spread-3a", "num_obstacles": 1, "horizon": 7})
    vec = env.make_vec(5)
    assert vec.num_envs == 5 and vec.horizon == 7 and vec.scenario.options.num_obstacles == 1
    assert vec.observation_spaces == env.observation_spaces


def test_learned_prey_has_its_own_space_on_every_face():
    vec = make_vec(PREY, num_envs=2, prey="learned")
    assert vec.agents == ["predator_0", "predator_1", "predator_2", "prey_0"]
    sizes = {agent: space.shape for agent, space in vec.observation_spaces.items()}
    assert sizes == {"predator_0": (16,), "predator_1": (16,), "predator_2": (16,), "prey_0": (14,)}
    obs, _ = vec.reset(seed=0)
    assert obs.shape == (2, 4, 16) and not obs[:, 3, 14:].any()
    assert vec.state().shape == (2, vec.state_size()) == (2, 62)
    for face in (parallel_env(PREY, prey="learned"), MAObsEnv({"scenario": PREY, "prey": "learned"})):
        rows, _ = face.reset(seed=0)
        np.testing.assert_array_equal(rows["prey_0"], obs[0, 3, :14])
        np.testing.assert_array_equal(rows["predator_1"], obs[0, 1])
        np.testing.assert_array_equal(face.state(), vec.state()[0])
    parallel_api_test(parallel_env(PREY, prey="learned"), num_cycles=150)
