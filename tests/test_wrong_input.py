"""Whatever is wrong is an error that says what is legal."""

import numpy as np
import pytest

from rllib_maobs.envs import MAObsEnv, Spread, make_scenario, make_vec, parallel_env, register_scenario

PREY = "obstacle-predator-prey"

# Options and layouts.


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
        ({"max_speed": -1}, r"max_speed=-1 is illegal; legal: a number > 0 and <= 1e\+06 or None"),
        ({"reward_mode": "total"}, r"reward_mode='total' is illegal; legal: 'sum', 'mean', 'individual'"),
        ({"reward_mode": ["sum"]}, r"reward_mode=\['sum'\] is illegal; legal: 'sum', 'mean', 'individual'"),
        ({"reward_mode": np.array(["sum", "mean"])}, r"reward_mode=array.* is illegal"),
        ({"terminate_on_success": 1}, r"terminate_on_success=1 is illegal; legal: True or False"),
        ({"agent_range": 1e30}, r"agent_range=1e\+30 is illegal; legal: a number > 0 and <= 1e\+06"),
        (
            {"physics": "solid", "agent_radius": 1e-9, "obstacle_radius": 1e-9},
            r"physics='solid' can't stop bodies that are so fast \(1\) and so small \(a contact at 2e-09\): make them",
        ),
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
    with pytest.raises(ValueError, match=r"must be a dict, such as .*, not 'spread-3a'"):
        MAObsEnv("spread-3a")
    for config in ({}, None):
        with pytest.raises(ValueError, match='needs a "scenario"'):
            MAObsEnv(config)


@pytest.mark.parametrize("num_envs", [0, -1, 2.0, "2", True, None])
def test_illegal_numbers_of_copies(num_envs):
    with pytest.raises(ValueError, match=rf"num_envs={num_envs!r} is illegal; legal: an integer >= 1"):
        make_vec("spread-3a", num_envs=num_envs)


@pytest.mark.parametrize("scenario", [None, 3, int, Spread()])
def test_illegal_scenarios(scenario):
    with pytest.raises(ValueError, match=r"is illegal; legal: an id, or a subclass of Scenario \(not an instance\)"):
        make_scenario(scenario)


def test_only_scenarios_are_registered():
    with pytest.raises(ValueError, match=r"cannot register <class 'int'>; legal: a subclass of Scenario"):
        register_scenario("int", int)
    with pytest.raises(ValueError, match="Spread has no option 'agents'"):
        register_scenario("spread-4a", Spread, agents=4)
    with pytest.raises(ValueError, match="unknown scenario 'spread-4a'"):
        make_scenario("spread-4a")


# Seeds, resets, steps.


def test_nothing_is_known_before_the_first_reset():
    for env in (make_vec("tunnel"), parallel_env("tunnel"), MAObsEnv({"scenario": "tunnel"})):
        for method in (env.state, env.heuristic):
            with pytest.raises(RuntimeError, match=rf"^{method.__name__}\(\) before reset\(\)$"):
                method()
    with pytest.raises(RuntimeError, match=r"^render\(\) before reset\(\)$"):
        parallel_env("tunnel", render_mode="rgb_array").render()


@pytest.mark.parametrize("seed", [-1, 1.5, "a", True, 2**63, [1, 2], [0.5, 1.0, 2.0], [1, 2, -3]])
def test_illegal_seeds(seed):
    env = make_vec("spread-3a", num_envs=3)
    with pytest.raises(ValueError, match=r"seed=.* is illegal; legal: an integer >= 0, or 3 of them, or None"):
        env.reset(seed=seed)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((3, 5)), r"actions have shape \(3, 5\); expected \(E, N, A\) = \(3, 3, 5\)"),
        (None, r"actions have shape \(\)"),
        ([[1.0, 2.0], [1.0]], "actions are no array"),
        (np.full((3, 3, 5), "x"), "actions are <U1; expected numbers"),
        (np.full((3, 3, 5), None), "actions are object; expected numbers"),
        (np.full((3, 3, 5), 1j), "actions are complex128; expected numbers"),
    ],
)
def test_illegal_arrays_of_actions(actions, message):
    env = make_vec("spread-3a", num_envs=3)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(actions)


def test_illegal_steps():
    env = make_vec("spread-3a", num_envs=3)
    actions = np.zeros((3, 3, 5), np.float32)
    with pytest.raises(RuntimeError, match=r"step\(\) before reset\(\): copies \[0, 1, 2\] were never reset"):
        env.step(actions)
    env.reset(seed=0)
    actions[2, 1, 0] = np.nan
    with pytest.raises(ValueError, match="action of agent_1 in copy 2 is not finite"):
        env.step(actions)
    with pytest.raises(ValueError, match=r"mask is int64 of shape \(3,\); expected bool"):
        env.reset(mask=np.array([0, 1, 0]))


def test_illegal_discrete_steps():
    env = make_vec("spread-3a", num_envs=2, action_mode="discrete")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action of agent_2 in copy 0 is not in 0 \.\. 4: 5"):
        env.step(np.array([[0, 1, 5], [0, 0, 0]]))
    with pytest.raises(ValueError, match="discrete actions are float64; expected integers"):
        env.step(np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (1.0, "action of agent_1 is float64; expected an integer"),
        (np.nan, "action of agent_1 is float64; expected an integer"),
        (True, "action of agent_1 is bool; expected an integer"),
        (np.zeros(5), r"action of agent_1 has shape \(5,\); expected \(\)"),
        (-1, r"action of agent_1 in copy 0 is not in 0 \.\. 4: -1"),
    ],
)
def test_faces_name_the_agent_of_an_illegal_discrete_action(action, message):
    env = parallel_env("simple-tunnel", action_mode="discrete")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step({"agent_0": 0, "agent_1": action, "agent_2": 4})


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
    with pytest.raises(ValueError, match=r"action of agent_1 is <U1; expected numbers"):
        env.step(actions | {"agent_1": np.full(5, "x")})
    with pytest.raises(ValueError, match=r"actions are a list; expected a dict with the action of each agent"):
        env.step(list(actions.values()))
    with pytest.raises(ValueError, match="action of agent_2 in copy 0 is not finite"):
        env.step(actions | {"agent_2": np.array([0.0, np.inf, 0.0, 0.0, 0.0])})
    for _ in range(100):
        env.step(actions)
    for late in (actions, {}):
        with pytest.raises(RuntimeError, match=r"step\(\) after the end of the episode: call reset\(\) first"):
            env.step(late)


@pytest.mark.parametrize(
    ("scenario_id", "options", "message"),
    [
        ("tunnel", {"gap": 0.14}, r"radius 0.075 do not fit through a gap of 0.14 .* more than 0.010 is missing"),
        ("simple-tunnel", {"agent_radius": 0.2}, r"more than 0.150 is missing; use a wider gap or smaller agents"),
        ("tunnel", {"spacing": 0.1}, r"agent_0 and agent_1 do not fit: 0.050 of room is missing between them"),
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
