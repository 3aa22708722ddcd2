"""Predator-prey and the tunnels in hand-placed situations; Spread is in test_envs.py."""

import numpy as np
import pytest
from mpe2 import simple_tag_v3
from pettingzoo.test import parallel_api_test
from ray.rllib.algorithms.ppo import PPOConfig

from rllib_maobs.envs import SCENARIOS, EpisodeMetricsCallback, MAObsEnv, make_scenario, make_vec, parallel_env
from rllib_maobs.envs.world import Physics
from tests.episodes import episode_metrics, glide, place, roll, sample_actions

PREY = "obstacle-predator-prey"
FAR = [[9.0, 9.0], [-9.0, 9.0]]  # obstacles out of the way


def chase(**options):
    return make_vec(PREY, **options)


# The table of environments.


@pytest.mark.parametrize(
    ("scenario_id", "agents", "observation", "observations_state", "world_state"),
    [
        (PREY, 3, 16, 48, 20),
        ("spread-3a", 3, 18, 54, 22),
        ("spread-6a", 6, 34, 204, 44),
        ("spread-9a", 9, 50, 450, 66),
        ("tunnel", 3, 18, 54, 22),
        ("simple-tunnel", 3, 14, 42, 22),
        ("simple-tunnel-6a", 6, 20, 120, 40),
    ],
)
def test_sizes(scenario_id, agents, observation, observations_state, world_state):
    env = make_vec(scenario_id)
    sizes = len(env.agents), env.scenario.observation_size, env.state_size("observations"), env.state_size("world")
    assert sizes == (agents, observation, observations_state, world_state)
    documentation = type(env.scenario).__doc__
    for number in (observation, observations_state, world_state):
        assert f"{number}" in documentation


def test_every_id_is_documented():
    for scenario_id, (cls, _) in SCENARIOS.items():
        assert f"`{scenario_id}`" in cls.__doc__


# Predator-prey.


def test_predator_prey_bodies():
    env = chase()
    assert env.agents == ["predator_0", "predator_1", "predator_2"]
    assert env.world.body_names[3:] == ["prey_0", "obstacle_0", "obstacle_1"]
    assert [(g.radius, g.accel, g.max_speed) for g in env.world.groups[:2]] == [(0.075, 3.0, 1.0), (0.05, 4.0, 1.3)]
    assert env.world.radius[4] == 0.2


def test_predator_prey_layouts():
    env = chase(num_envs=256)
    env.reset(seed=0)
    p = env.world.position
    assert 0.99 < np.abs(p[:, :4]).max() <= 1.0 and 0.88 < np.abs(p[:, 4:]).max() <= 0.9
    assert env.world.gap.min() >= 0.02
    unchecked = chase(num_envs=256, placement="mpe")
    unchecked.reset(seed=0)
    assert (unchecked.world.gap < 0.0).any()


def test_predator_prey_observation_by_hand():
    env = chase(num_predators=2, num_obstacles=1, prey="learned")
    place(env, [[0.0, 0.0], [0.5, 0.1], [-0.3, 0.4], [0.9, 0.8]])
    env.world.velocity[0, :3] = [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]
    expected = [
        [0.1, 0.2, 0.0, 0.0, 0.9, 0.8, 0.5, 0.1, -0.3, 0.4, 0.5, 0.6],
        [0.3, 0.4, 0.5, 0.1, 0.4, 0.7, -0.5, -0.1, -0.8, 0.3, 0.5, 0.6],
        [0.5, 0.6, -0.3, 0.4, 1.2, 0.4, 0.3, -0.4, 0.8, -0.3, 0.0, 0.0],
    ]
    np.testing.assert_allclose(env.observe()[0], expected, rtol=1e-6)
    np.testing.assert_allclose(env.state()[0], [*expected[0], *expected[1], *expected[2][:-2]], rtol=1e-6)
    scripted = chase(num_predators=2, num_obstacles=1)
    place(scripted, env.world.position[0])
    scripted.world.velocity[0] = env.world.velocity[0]
    np.testing.assert_allclose(scripted.observe()[0], expected[:2], rtol=1e-6)


def test_learned_prey_has_its_own_space_on_every_face():
    vec = chase(num_envs=2, prey="learned")
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


def test_predators_share_what_they_catch_and_touch():
    """Two predators on the prey, two pairs of predators in contact, one predator on an obstacle."""
    env = chase(capture_reward=5.0, agent_collision_penalty=0.5, obstacle_collision_penalty=2.0)
    place(env, [[-0.1, 0.0], [0.0, 0.1], [0.1, 0.15], [0.0, 0.0], [0.36, 0.15], [9.0, 9.0]])
    env.world.refresh()
    outcome = env.scenario.outcome(env.world)
    assert outcome.metrics["captures"][0] == 2 and outcome.success[0]
    np.testing.assert_allclose(outcome.rewards[0], 3 * [2 * 5.0 - 2 * 0.5 - 2.0])
    shaped = chase(shaping=0.1)
    place(shaped, [[0.3, 0.4], [0.0, 1.0], [-2.0, 0.0], [0.0, 0.0], *FAR])
    shaped.world.refresh()
    np.testing.assert_allclose(shaped.scenario.outcome(shaped.world).rewards[0], 3 * [-0.1 * 3.5])


@pytest.mark.parametrize(
    ("x", "price"), [(0.89, 0.0), (0.95, 0.5), (1.0, 1.0), (-1.2, np.exp(0.4)), (3.0, 10.0), (1e4, 10.0)]
)
def test_learned_prey_pays_for_leaving(x, price):
    env = chase(prey="learned", shaping=0.1)
    place(env, [[x + 0.3, 0.4], [x, 1.0], [x - 2.0, 0.0], [x, 0.0], [2 * x, 50.0], [0.0, 50.0]])
    env.world.refresh()
    np.testing.assert_allclose(env.scenario.outcome(env.world).rewards[0, 3], 0.35 - price, rtol=1e-9)


def test_captures_by_hand():
    """No contact, then one predator, then two, then none: caught, though not at the end."""
    env = chase(horizon=4)
    env.reset(seed=0)
    env.world.physics = Physics(dt=1e-6)  # contacts have no time to part
    for caught in (0, 1, 2, 0):
        hunters = [[0.06 + 0.04 * k, 0.11 * k - 0.05] if k < caught else [2.0 + k, 0.0] for k in range(3)]
        env.world.position[0], env.world.velocity[0] = [*hunters, [0.0, 0.0], *FAR], 0.0
        *_, info = env.step(np.zeros((1, 3, 5)))
    metrics = episode_metrics(info)
    assert (metrics["captures"], metrics["first_capture_step"], metrics["success"]) == (3.0, 2.0, 1.0)
    assert metrics["time_to_goal"] == 2.0
    assert metrics["collisions_agents"] == 1.0  # the two predators of step 3 touch; the prey is no collision
    assert metrics["min_clearance"] < 0.0


def test_nothing_caught():
    env = chase(horizon=2)
    place(env, [[3.0, 0.0], [5.0, 0.0], [7.0, 0.0], [0.0, 0.0], *FAR])
    glide(env, [[0.0, 0.0]] * 3)
    *_, info = glide(env, [[0.0, 0.0]] * 3)
    metrics = episode_metrics(info)
    assert (metrics["captures"], metrics["first_capture_step"], metrics["success"]) == (0.0, 2.0, 0.0)
    assert metrics["prey_distance"] == pytest.approx(5.0, abs=0.05)
    assert metrics["min_clearance"] == pytest.approx(2.0 - 0.15)  # to each other: the prey does not count


def test_the_prey_is_no_obstacle_for_the_clearance():
    env = chase(horizon=1)
    place(env, [[3.0, 0.0], [5.0, 0.0], [7.0, 0.0], [3.0, 0.01], *FAR])
    env.world.physics = Physics(dt=1e-6)  # contacts have no time to part
    metrics = episode_metrics(glide(env, [[0.0, 0.0]] * 3)[-1])
    assert metrics["captures"] == 1.0 and metrics["min_clearance"] > 1.5 and metrics["collision_free"] == 1.0


def test_random_prey_moves_by_its_own_stream():
    env = chase(num_envs=2, num_predators=1)
    env.reset(seed=0)
    env.world.position[:, 0] = [9.0, 0.0]
    forces = []
    for _ in range(100):
        before = env.world.velocity[:, 1].copy()
        env.world.position[:, 1] = 0.0
        env.world.position[:, 2:] = 5.0
        env.step(np.zeros((2, 1, 5)))
        forces.append((env.world.velocity[:, 1] - 0.75 * before) / 0.1 / 4.0)
        if np.hypot(*env.world.velocity[:, 1].T).max() > 1.2:
            env.world.velocity[:, 1] = 0.0  # keep away from the speed limit
    forces = np.array(forces)
    assert np.abs(forces).max() <= 1.0 + 1e-9 and forces.min() < -0.95 and forces.max() > 0.95
    assert abs(forces.mean()) < 0.1 and not np.allclose(forces[:, 0], forces[:, 1])


def test_fleeing_prey_runs_away_but_not_out():
    env = chase(num_envs=64, prey="flee")
    env.reset(seed=0)
    env.world.position[:, 4:] = FAR
    env.world.position[:, :3] = [[0.0, 0.0], [0.1, 0.3], [0.1, -0.3]]
    env.world.position[:, 3] = [0.4, 0.0]
    furthest = np.zeros(64)
    for t in range(100):
        env.step(np.zeros((64, 3, 5)))
        if t == 3:
            assert (env.world.position[:, 3, 0] > 0.5).all()
        furthest = np.maximum(furthest, np.abs(env.world.position[:, 3]).max(axis=1))
    assert (furthest <= 1.0).all() and (furthest > 0.7).all()


def test_fleeing_prey_is_stopped_at_its_limit():
    env = chase(prey="flee", prey_range=0.8)
    place(env, [[0.5, 0.0], [0.4, 0.2], [0.4, -0.2], [0.78, 0.0], *FAR])
    env.world.velocity[0, 3] = [1.2, 0.3]
    env.step(np.zeros((1, 3, 5)))
    assert env.world.position[0, 3, 0] == 0.8 and env.world.velocity[0, 3, 0] == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_predator_prey_is_mpe2_simple_tag(seed):
    """Observations and rewards of a whole episode, in MPE2's order of integration, without our penalties."""
    theirs = simple_tag_v3.parallel_env(
        num_good=1, num_adversaries=3, num_obstacles=2, max_cycles=100, continuous_actions=True
    )
    ours = chase(
        prey="learned",
        integrator="explicit",
        placement="mpe",
        agent_collision_penalty=0.0,
        obstacle_collision_penalty=0.0,
    )
    theirs.reset(seed=seed)
    ours.reset(seed=seed)
    world = theirs.unwrapped.world
    rng = np.random.default_rng(seed)
    for body in world.agents:
        body.state.p_pos = rng.uniform(-0.4, 0.4, 2)
    ours.world.position[0] = [body.state.p_pos for body in world.entities]
    names, captures = ["adversary_0", "adversary_1", "adversary_2", "agent_0"], 0
    for _ in range(100):
        actions = (rng.integers(0, 257, (4, 5)) / 256).astype(np.float32)  # exact also in MPE2's float32 sums
        swapped = actions[:, [0, 2, 1, 4, 3]]  # MPE2 has the opposite signs
        obs, rewards, *_ = theirs.step(dict(zip(names, swapped, strict=True)))
        own_obs, own_rewards, *_ = ours.step(actions[None])
        for i, name in enumerate(names):
            size = ours.scenario.observation_sizes[i]
            np.testing.assert_allclose(own_obs[0, i, :size], obs[name][:size], atol=1e-5)
            assert own_rewards[0, i] == pytest.approx(rewards[name], abs=1e-4)
        captures += own_rewards[0, 0] > 0.0
    assert captures > 0  # else the episode says nothing about captures


# Tunnels.


def test_tunnel_starts_as_drawn():
    env = make_vec("tunnel", num_envs=2)
    env.reset(seed=0)
    rows = [0.3, 0.0, -0.3]
    expected = [*([-1.0, y] for y in rows), [0.0, 1.125], [0.0, -1.125], *([1.0, y] for y in rows)]
    np.testing.assert_allclose(env.world.position, [expected] * 2, atol=1e-12)
    assert env.world.gap[0, 0, 3:5].min() > 0.0 and not env.world.walls
    # A body in the middle of the gap has (0.25 - 0.15) / 2 of room on both sides.
    env.world.position[0, 0] = 0.0
    env.world.refresh()
    np.testing.assert_allclose(env.world.gap[0, 0, 3:5], 0.05)


def test_tunnel_shares_targets():
    env = make_vec("tunnel", reward_mode="individual")
    place(env, [[1.0, 0.0], [5.0, 5.0], [1.0, 0.3], *env.scenario.place([None])[0, 3:]])
    _, rewards, *_ = env.step(np.zeros((1, 3, 5)))
    np.testing.assert_allclose(rewards[0], [-0.3, -0.3, -0.3], rtol=1e-6)
    obs = env.observe()[0, 1]
    np.testing.assert_allclose(obs[4:10], [-4.0, -4.7, -4.0, -5.0, -4.0, -5.3], rtol=1e-5)
    np.testing.assert_allclose(obs[10:], [-5.0, -3.875, -5.0, -6.125, -4.0, -5.0, -4.0, -4.7], rtol=1e-5)


def test_simple_tunnel_6a_front_row_goes_to_the_far_column():
    env = make_vec("simple-tunnel-6a")
    env.reset(seed=0)
    p, rows = env.world.position[0], [0.3, 0.0, -0.3]
    np.testing.assert_allclose(p[:6], [*([-0.95, y] for y in rows), *([-1.2, y] for y in rows)], atol=1e-12)
    np.testing.assert_allclose(p[8:], [*([1.2, y] for y in rows), *([0.95, y] for y in rows)], atol=1e-12)


def test_simple_tunnel_observes_and_pays_the_own_target():
    """Agent 0 is at its target; agent 1 at that of agent 2, in a corner both walls touch; agent 2 is on a circle."""
    env = make_vec("simple-tunnel", wall_collision_penalty=3.0, obstacle_collision_penalty=2.0)
    place(env, [[1.0, 0.3], [1.36, 0.96], [0.5, -0.2], *env.scenario.place([None])[0, 3:]])
    obs = env.observe()[0]
    np.testing.assert_allclose(obs[1, 4:6], [-0.36, -0.96], rtol=1e-5)
    np.testing.assert_allclose(obs[1, 6:10], [-1.36, 0.165, -1.36, -2.085], rtol=1e-5)
    np.testing.assert_allclose(obs[1, 10:], [-0.36, -0.66, -0.86, -1.16], rtol=1e-5)
    outcome = env.scenario.outcome(env.world)
    lengths = [0.0, np.hypot(0.36, 0.96), np.hypot(0.5, 0.1)]
    np.testing.assert_allclose(outcome.rewards[0], [-lengths[0], -lengths[1] - 6.0, -lengths[2] - 2.0], rtol=1e-9)
    assert outcome.metrics["target_distance"][0] == pytest.approx(sum(lengths))
    shared = make_vec("simple-tunnel", reward_mode="mean", wall_collision_penalty=3.0, obstacle_collision_penalty=2.0)
    place(shared, env.world.position[0])
    shared.world.refresh()
    np.testing.assert_allclose(shared.scenario.outcome(shared.world).rewards[0], 3 * [outcome.rewards[0].mean()])


def test_simple_tunnel_success_is_per_agent():
    """Agents 1 and 2 stand on each other's targets: covered for Tunnel, not here; then agent 1 comes home."""
    env = make_vec("simple-tunnel", horizon=2)
    rest = env.scenario.place([None])[0, 3:]
    place(env, [[1.0, 0.25], [1.0, -0.3], [1.0, 0.0], *rest])
    env.step(np.zeros((1, 3, 5)))
    env.world.position[0, 1:3], env.world.velocity[0] = [[0.95, 0.0], [1.0, 0.6]], 0.0
    *_, info = env.step(np.zeros((1, 3, 5)))
    metrics = episode_metrics(info)
    assert [metrics[f"success_agent_{i}"] for i in range(3)] == [1.0, 1.0, 0.0]
    assert metrics["coverage"] == pytest.approx(2 / 3) and metrics["coverage_mean"] == pytest.approx(0.5)
    assert metrics["all_covered"] == metrics["success"] == metrics["all_covered_mean"] == 0.0


def test_simple_tunnel_walls_hold():
    env = make_vec("simple-tunnel-6a", num_envs=8, max_speed=None, accel=500.0)
    _, _, metrics = roll(env, sample_actions(env, 100), seed=0)
    assert (np.abs(env.world.position[:, :6]) <= [1.4 + 1e-12, 1.0 + 1e-12]).all()
    assert (metrics["collisions_walls"] > 100).all()


def test_start_noise_moves_agents_alone_and_differs_between_copies():
    env = make_vec("tunnel", num_envs=128, start_noise=0.05)
    still = make_vec("tunnel")
    env.reset(seed=0), still.reset(seed=0)
    shift = env.world.position - still.world.position
    assert not shift[:, 3:].any()
    assert 0.049 < np.abs(shift[:, :3]).max() <= 0.05 and shift.min() < -0.045
    assert not np.array_equal(shift[0], shift[1])


@pytest.mark.parametrize(
    ("scenario_id", "options", "message"),
    [
        ("tunnel", {"gap": 0.14}, r"radius 0.075 do not fit through a gap of 0.14 .* more than 0.010 is missing"),
        ("simple-tunnel", {"agent_radius": 0.2}, r"more than 0.150 is missing; use a wider gap or smaller agents"),
        ("tunnel", {"spacing": 0.1}, r"agent_0 and agent_1 do not fit: 0.050 of room is missing between them"),
        ("tunnel", {"start_noise": 0.1}, r"agent_0 and agent_1 do not fit: 0.133 of room"),
        ("tunnel", {"target_distance": 0.1}, r"obstacle_0 and target_0 do not fit: 0.244 of room"),
        ("simple-tunnel", {"start_distance": 1.35}, r"agent_0 does not fit in the room: 0.025 is missing along x"),
        (
            "simple-tunnel",
            {"start_distance": 1.31, "start_noise": 0.05},
            r"agent_0 does not .*: 0.035 is missing along x",
        ),
        ("simple-tunnel", {"wall_y": 0.35}, r"agent_0 does not fit in the room: 0.025 is missing along y"),
        ("simple-tunnel-6a", {"num_agents": 5}, r"num_agents=5 is no multiple of num_columns=2"),
        (PREY, {"num_obstacles": 40}, r"predator_0 .. obstacle_39 \(44 bodies\) do not fit: .* missing\)"),
        (PREY, {"prey": "lerned"}, r"prey='lerned' is illegal; legal: 'random', 'flee', 'learned'"),
        (PREY, {"num_agents": 4}, r"PredatorPrey has no option 'num_agents' \(did you mean 'num_predators'\?\)"),
    ],
)
def test_impossible_layouts_and_options(scenario_id, options, message):
    with pytest.raises(ValueError, match=message):
        make_scenario(scenario_id, **options)


@pytest.mark.parametrize(
    ("scenario_id", "options", "metric"),
    [
        (PREY, {"prey": "learned"}, "captures"),
        ("tunnel", {}, "coverage_mean"),
        ("simple-tunnel", {"start_noise": 0.02}, "success_agent_2"),
    ],
)
def test_stock_ppo_reports_the_metrics_of_every_kind(ray_session, scenario_id, options, metric):
    agents = make_scenario(scenario_id, **options).agents
    config = (
        PPOConfig()
        .environment(MAObsEnv, env_config={"scenario": scenario_id, "horizon": 10, **options})
        .env_runners(num_env_runners=0)
        .multi_agent(policies=set(agents), policy_mapping_fn=lambda agent, episode, **kwargs: agent)
        .training(train_batch_size_per_learner=20, minibatch_size=20, num_epochs=1)
        .callbacks(EpisodeMetricsCallback)
    )
    algo = config.build_algo()
    try:
        metrics = algo.train()["env_runners"]["episode_metrics"]
    finally:
        algo.stop()
    assert np.isfinite(metrics[metric])
    common = "success time_to_goal collisions_agents collisions_obstacles collisions_walls collision_free min_clearance"
    assert set(f"{common} path_efficiency return_agent_0 episode_length".split()) < set(metrics)
