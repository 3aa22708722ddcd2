"""The command that shows and films episodes, with every kind of policy."""

import pickle
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

from rllib_maobs.envs import MAObsEnv, Spread, make_vec, parallel_env
from rllib_maobs.play import main, parse_options, play
from rllib_maobs.policies import CheckpointPolicy, make_policy, saved_options
from tests.conftest import build_learner, small_config


def test_command_line_films(tmp_path):
    film = tmp_path / "film.gif"
    command = [sys.executable, "-m", "rllib_maobs.play", "tunnel", "--policy", "heuristic", "--record", str(film)]
    done = subprocess.run([*command, "horizon=40", "start_noise=0.05"], capture_output=True, text=True, check=True)
    assert Image.open(film).n_frames == 41
    assert "tunnel, heuristic: mean over 1 episodes from seed 0" in done.stdout
    assert f"written: {film}" in done.stdout
    assert "success                       1.000" in done.stdout


def test_metrics_are_those_of_the_episodes(capsys):
    main(["spread-3a", "--no-window", "--policy", "heuristic", "--seed", "5", "--episodes", "3", "horizon=20"])
    printed = dict(line.split() for line in capsys.readouterr().out.splitlines()[1:])
    env, total = make_vec("spread-3a", num_envs=3, horizon=20), 0.0
    env.reset(seed=5)
    for _ in range(20):
        _, rewards, *_, info = env.step(env.heuristic())
        total += rewards.mean()
    expected = {name: value.mean() for name, value in info["episode_metrics"].items()} | {"return_mean": total}
    assert set(printed) == set(expected)
    for name, value in expected.items():
        assert float(printed[name]) == pytest.approx(value, abs=6e-4)


def test_mean_return_is_that_of_all_agents():
    env = parallel_env("simple-tunnel-6a", horizon=10)
    vec, total = make_vec("simple-tunnel-6a", horizon=10), 0.0
    vec.reset(seed=0)
    for _ in range(10):
        total += vec.step(vec.heuristic())[1].mean()
    metrics = play(env, make_policy(env.vector, "heuristic"))
    assert metrics["return_mean"] == pytest.approx(total) != pytest.approx(metrics["return_agent_0"])


def test_random_policy_moves_every_agent_by_itself():
    env = parallel_env("simple-tunnel")
    (actions,) = make_policy(env.vector, "random")(env.vector.observe())
    assert len({tuple(action) for action in actions}) == 3


def test_random_policy_follows_the_seed():
    results = []
    for seed in (0, 0, 1):
        env = parallel_env("simple-tunnel", horizon=10)
        results.append(play(env, make_policy(env.vector, "random", seed), episodes=2))
    assert results[0] == results[1] != results[2]


def test_window_opens_without_record(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    shown = []
    monkeypatch.setattr("rllib_maobs.envs.rendering.Renderer.show", lambda self, fps: shown.append(fps))
    closed = []
    monkeypatch.setattr("rllib_maobs.envs.rendering.Renderer.close", lambda self: closed.append(len(shown)))
    main(["tunnel", "horizon=4"])
    assert len(shown) == 5 and closed == [5]


def test_a_window_that_nobody_would_see_is_refused(monkeypatch, capsys):
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pygame.display.get_driver", lambda: "offscreen")
    with pytest.raises(SystemExit):
        main(["tunnel"])
    assert "there is no display for a window here: give --record FILE, or --no-window" in capsys.readouterr().err
    main(["tunnel", "--no-window", "horizon=2"])


def test_options_are_literals_or_words():
    parsed = parse_options(["gap=0.3", "physics=solid", "max_speed=None", "terminate_on_success=True"])
    assert parsed == {"gap": 0.3, "physics": "solid", "max_speed": None, "terminate_on_success": True}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tunel"], "unknown scenario 'tunel' (did you mean 'tunnel'?)"),
        (["tunnel", "gap"], "'gap' is no option; write NAME=VALUE"),
        (["tunnel", "gasp=1"], "Tunnel has no option 'gasp' (did you mean 'gap'?)"),
        (["tunnel", "--episodes", "0"], "--episodes 0 is illegal"),
        (["tunnel", "--seed", "-1"], "--seed -1 is illegal"),
        (["tunnel", "--seed", str(2**63)], "is illegal; legal: an integer >= 0 of 63 bits"),
        (["tunnel", "--record", ""], "cannot record to ''"),
        (["tunnel", "horizon=3", "horizon=4"], "horizon=... is given twice"),
        (["tunnel", "--policy", ""], "'' is no checkpoint"),
        (["tunnel", "--record", "film.avi"], "cannot record to 'film.avi'"),
        (
            ["tunnel", "--policy", "hueristic", "--no-window"],
            "'hueristic' is no checkpoint; legal: the folder of an RLlib algorithm checkpoint",
        ),
    ],
)
def test_mistakes_end_in_a_sentence(arguments, message, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def acts(policy, observations):
    """Actions by agent, as a policy chooses them for one copy."""
    size = max(map(len, observations.values()))
    joint = np.stack([np.pad(observation, (0, size - len(observation))) for observation in observations.values()])
    return dict(zip(observations, policy(joint[None])[0], strict=True))


@pytest.fixture(scope="module")
def maddpg_checkpoint(ray_session, tmp_path_factory):
    algo = small_config("maddpg-l").build_algo()
    path = algo.save_to_path(str(tmp_path_factory.mktemp("maddpg")))
    modules = {agent: algo.get_module(agent) for agent in ("agent_0", "agent_1", "agent_2")}
    yield path, modules
    algo.stop()


def test_checkpoint_of_this_package_acts_as_trained(maddpg_checkpoint):
    path, modules = maddpg_checkpoint
    env = parallel_env("spread-3a")
    policy = make_policy(env.vector, path)
    observations, _ = env.reset(seed=0)
    actions = acts(policy, observations)
    for agent, module in modules.items():
        with torch.no_grad():
            expected = module.forward_inference({"obs": torch.from_numpy(observations[agent])[None]})["actions"][0]
        np.testing.assert_allclose(actions[agent], expected.numpy(), rtol=1e-5, atol=1e-6)
        assert env.action_space(agent).contains(actions[agent])
    assert not np.allclose(actions["agent_0"], actions["agent_1"])
    with pytest.raises(ValueError, match=r"agent_0 observes \(34,\) in Spread\(.*but was trained on \(18,\)"):
        make_policy(make_vec("spread-3a", num_agents=3, num_obstacles=10), path)
    with pytest.raises(ValueError, match=r"agent_3; it has agent_0, agent_1, agent_2\. Teams of any size are"):
        make_policy(make_vec("spread-3a", num_agents=4), path)


def test_checkpoint_of_agents_that_share_parameters_and_know_their_numbers(ray_session, tmp_path):
    config = small_config("maddpg").training(agent_id_input=True)
    config.multi_agent(policies={"all"}, policy_mapping_fn=lambda agent, *args, **kwargs: "all")
    algo = config.build_algo()
    path, module = algo.save_to_path(str(tmp_path)), algo.get_module("all")
    env = parallel_env("spread-3a")
    policy = make_policy(env.vector, path)
    observations, _ = env.reset(seed=0)
    alike = {agent: observations["agent_0"] for agent in observations}
    actions = acts(policy, alike)
    for index, agent in enumerate(alike):
        seen = np.append(np.eye(3, dtype=np.float32)[index], alike[agent])
        expected = module.forward_inference({"obs": torch.from_numpy(seen)[None]})["actions"][0]
        np.testing.assert_allclose(actions[agent], expected.detach().numpy(), rtol=1e-5, atol=1e-6)
    assert not np.allclose(actions["agent_0"], actions["agent_1"])
    algo.stop()
    with pytest.raises(ValueError, match=r"agent_0 observes \(34,\) in Spread\(.*but was trained on \(18,\)"):
        make_policy(make_vec("spread-3a", num_agents=3, num_obstacles=10), path)


def test_checkpoint_with_a_policy_mapping_of_its_own(ray_session, tmp_path):
    """Predators share a policy, the learned prey has another, with another observation."""
    options = {"prey": "learned", "horizon": 5}
    algo = (
        PPOConfig()
        .environment(MAObsEnv, env_config={"scenario": "obstacle-predator-prey", **options})
        .env_runners(num_env_runners=0)
        .multi_agent(
            policies={"hunters", "hunted"},
            policy_mapping_fn=lambda agent, episode, **kwargs: "hunted" if agent == "prey_0" else "hunters",
        )
        .build_algo()
    )
    path = algo.save_to_path(str(tmp_path))
    modules = {name: algo.get_module(name) for name in ("hunters", "hunted")}
    algo.stop()
    env = parallel_env("obstacle-predator-prey", **options)
    policy = make_policy(env.vector, path)
    observations, _ = env.reset(seed=0)
    actions = acts(policy, observations)
    for agent, name in (("predator_0", "hunters"), ("predator_2", "hunters"), ("prey_0", "hunted")):
        logits = modules[name].forward_inference({"obs": torch.from_numpy(observations[agent])[None]})
        mean = logits["action_dist_inputs"][0, :5].detach().numpy()
        np.testing.assert_allclose(actions[agent], np.clip(mean, -1.0, 1.0), rtol=1e-5, atol=1e-6)
    play(env, policy)
    shutil.rmtree(tmp_path / "learner_group" / "learner" / "rl_module" / "hunters")
    with pytest.raises(ValueError, match="has no module for predator_0; it has hunted"):
        make_policy(env.vector, path)


@pytest.fixture(scope="module")
def entity_checkpoint(ray_session, tmp_path_factory):
    """Three agents with one policy of entity networks, which has learned a little."""
    config = small_config("maddpg", action_mode="force").training(actor="entity", critic="entity", critic_state="world")
    config.multi_agent(policies={"all"}, policy_mapping_fn=lambda agent, *args, **kwargs: "all")
    algo = config.build_algo()
    algo.train()
    path = algo.save_to_path(str(tmp_path_factory.mktemp("entity")))
    module = algo.get_module("all")
    yield path, module
    algo.stop()


def test_a_checkpoint_plays_what_it_was_evaluated_on(ray_session, tmp_path, capsys):
    config = small_config("iddpg", horizon=7, num_agents=2, action_mode="force", num_obstacles=1)
    config.evaluation(evaluation_config={"env_config": {"horizon": 9}})
    algo = config.build_algo()
    path = algo.save_to_path(str(tmp_path))
    algo.stop()
    options = {"horizon": 9, "num_agents": 2, "action_mode": "force", "num_obstacles": 1}
    assert saved_options(path, "spread-3a") == options
    # Another task keeps what its own name says.
    assert saved_options(path, "spread-9a") == {"horizon": 9, "action_mode": "force"}
    assert saved_options(path, "simple-tunnel") == {"horizon": 9, "num_agents": 2, "action_mode": "force"}
    for nothing in ("random", "heuristic", str(tmp_path / "none")):
        assert saved_options(nothing, "spread-3a") == {}
    main(["spread-3a", "--policy", path, "--no-window"])
    printed = capsys.readouterr().out
    assert "options of the checkpoint: horizon=9 num_agents=2 action_mode=force num_obstacles=1" in printed
    assert re.search(r"episode_length +9.000", printed)
    main(["spread-3a", "--policy", path, "--no-window", "horizon=4"])
    assert re.search(r"episode_length +4.000", capsys.readouterr().out)


def test_options_of_stock_ppo_and_of_foreign_environments(tmp_path):
    def checkpoint(name, **config):
        (tmp_path / name / "learner_group" / "learner" / "rl_module").mkdir(parents=True)
        arguments = {"ctor_args_and_kwargs": (({"evaluation_config": None, **config},), {})}
        (tmp_path / name / "rllib_checkpoint.json").write_text("{}")
        (tmp_path / name / "class_and_ctor_args.pkl").write_bytes(pickle.dumps(arguments))
        return str(tmp_path / name)

    ours = checkpoint("ours", env=MAObsEnv, env_config={"scenario": "tunnel", "gap": 0.3, "render_mode": "human"})
    assert saved_options(ours, "tunnel") == {"gap": 0.3}
    assert saved_options(checkpoint("class", env="x", env_config={"scenario": Spread, "horizon": 5}), "spread-3a")
    assert saved_options(checkpoint("foreign", env="mine", env_config={"horizon": 5}), "tunnel") == {}


@pytest.mark.parametrize("algorithm", ["maddpg", "iql"])
def test_a_normalised_agent_takes_its_normaliser_along(ray_session, tmp_path, algorithm):
    """In an algorithm's checkpoint, as its module, and as a network without RLlib."""
    algo = small_config(algorithm).training(normalize_observations=True).build_algo()
    algo.train()
    path, module = algo.save_to_path(str(tmp_path / "checkpoint")), algo.get_module("agent_1")
    algo.stop()
    obs = 3.0 + torch.randn(5, 18, generator=torch.Generator().manual_seed(0))
    want = module.forward_inference({"obs": obs})["actions"]
    plain = module.acting(obs)
    assert not torch.allclose(want.float(), plain.argmax(-1).float() if algorithm == "iql" else torch.tanh(plain))
    network = module.exportable()
    torch.testing.assert_close(network(obs), want)
    torch.jit.trace(network, obs).save(tmp_path / "agent.pt")
    torch.testing.assert_close(torch.jit.load(tmp_path / "agent.pt")(obs), want)
    env = parallel_env("spread-3a", **saved_options(path, "spread-3a"))
    observations, _ = env.reset(seed=0)
    seen = torch.from_numpy(observations["agent_1"])[None]
    (action,) = module.forward_inference({"obs": seen})["actions"].detach().numpy()
    acted = acts(make_policy(env.vector, path), observations)["agent_1"]
    np.testing.assert_allclose(acted, action, rtol=1e-5, atol=1e-6)


def test_a_recurrent_agent_is_no_plain_network(ray_session):
    learner = build_learner(small_config("maddpg-lstm"))
    with pytest.raises(ValueError, match="its actions depend on a window of observations"):
        learner.module["agent_0"].exportable()


@pytest.mark.parametrize(
    ("scenario", "options"),
    [
        ("spread-9a", {}),
        ("spread-3a", {"num_agents": 1}),
        ("spread-3a", {}),
        # As long an observation as the one of the training, of other things.
        ("spread-3a", {"num_agents": 4, "num_obstacles": 0}),
    ],
)
def test_entity_networks_play_in_teams_of_another_size(entity_checkpoint, scenario, options):
    path, module = entity_checkpoint
    env = parallel_env(scenario, action_mode="force", horizon=4, **options)
    policy = make_policy(env.vector, path)
    observations, _ = env.reset(seed=0)
    actions = acts(policy, observations)
    for agent, observation in observations.items():
        here = module.for_layout(env.observation_layouts[agent])
        with torch.no_grad():
            expected = here.forward_inference({"obs": torch.from_numpy(observation)[None]})["actions"][0]
        np.testing.assert_allclose(actions[agent], expected.numpy(), rtol=1e-5, atol=1e-6)
    assert len(policy._groups) == 1
    assert set(play(env, policy)) > {"return_mean", "coverage"}


def test_networks_of_one_size_say_so(entity_checkpoint, maddpg_checkpoint):
    path, _ = maddpg_checkpoint
    with pytest.raises(
        ValueError,
        match=r"was trained on \(18,\): MLPActor of .* Networks that act in teams of any size are those of tr",
    ):
        make_policy(make_vec("spread-3a", num_obstacles=10), path)


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        (
            "mpe",
            r"agent_0 has actions \(5,\) in Spread\(.*\), but was trained with \(2,\): give the environment the "
            "options of the training, such as action_mode=force$",
        ),
        ("discrete", r"agent_0 has actions 0 to 4 in Spread\(.*, but was trained with \(2,\)"),
    ],
)
def test_other_actions_than_in_training_are_named(entity_checkpoint, mode, message):
    path, _ = entity_checkpoint
    with pytest.raises(ValueError, match=message):
        make_policy(make_vec("spread-9a", action_mode=mode), path)


@pytest.mark.parametrize("use_lstm", [False, True])
@pytest.mark.parametrize("mode", ["mpe", "discrete"])
def test_checkpoint_of_stock_ppo_with_one_policy_for_all(ray_session, tmp_path, mode, use_lstm):
    algo = (
        PPOConfig()
        .environment(MAObsEnv, env_config={"scenario": "tunnel", "action_mode": mode})
        .env_runners(num_env_runners=0)
        .multi_agent(policies={"shared"}, policy_mapping_fn=lambda agent, episode, **kwargs: "shared")
        .rl_module(
            model_config=DefaultModelConfig(use_lstm=use_lstm, fcnet_hiddens=[8], lstm_cell_size=8, max_seq_len=5)
        )
        .build_algo()
    )
    path = algo.save_to_path(str(tmp_path))
    algo.stop()
    env = parallel_env("tunnel", action_mode=mode, horizon=5)
    policy = make_policy(env.vector, path)
    assert isinstance(policy, CheckpointPolicy)
    observations, _ = env.reset(seed=0)
    actions = acts(policy, observations)
    assert all(env.action_space(agent).contains(action) for agent, action in actions.items())
    # Without exploration, and with memory forgotten between episodes, all episodes from one seed are alike.
    assert play(env, policy, seed=4) == play(env, policy, seed=4)
    if use_lstm:
        policy.reset()
        first, second = (acts(policy, observations)["agent_0"] for _ in range(2))
        if mode == "mpe":
            assert not np.array_equal(first, second)
