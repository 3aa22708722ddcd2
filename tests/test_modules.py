"""Networks and RLModules: windows of LSTM actors, mixers, discrete actions; acting and learning are one computation."""

import platform
import resource

import numpy as np
import pytest
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.rl_module import RLModule
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner
from torch import nn
from torch.utils._pytree import tree_map

import rllib_maobs as maobs
from rllib_maobs.layout import Entities, flat, layout_size
from rllib_maobs.learner import TeamNetworks
from rllib_maobs.modules import (
    EntityActor,
    EpsilonGaussian,
    LSTMActor,
    Mixer,
    MLPActor,
    MLPCritic,
    PerAgent,
    RecurrentActor,
    Seen,
    Shared,
    Stack,
)
from rllib_maobs.modules.team import Actors
from rllib_maobs.replay import JointReplayBuffer
from rllib_maobs.runner import JointEnvRunner
from tests.conftest import build_learner, random_batch, small_config

O, A, H = 4, 2, 8  # noqa: E741


@pytest.fixture
def actor() -> LSTMActor:
    torch.manual_seed(0)
    return LSTMActor(flat(O), A, (5, 6), cell_size=H)


def as_torch_lstm(actor: LSTMActor) -> nn.LSTM:
    lstm = nn.LSTM(O, H, batch_first=True)
    lstm.weight_ih_l0.data.copy_(actor.from_observation.weight)
    lstm.bias_ih_l0.data.copy_(actor.from_observation.bias)
    lstm.weight_hh_l0.data.copy_(actor.from_hidden.weight)
    lstm.bias_hh_l0.data.zero_()
    return lstm


def test_one_observation_is_a_cell_from_zero(actor: LSTMActor) -> None:
    obs = torch.randn(5, 1, O)
    cell = nn.LSTMCell(O, H)
    for mine, theirs in zip(cell.parameters(), as_torch_lstm(actor).parameters(), strict=True):
        mine.data.copy_(theirs)
    h, _ = cell(obs[:, 0])
    torch.testing.assert_close(actor.unroll(obs, torch.ones(5, 1))[0], actor.layers(h))


@pytest.mark.parametrize("users", ["abc", "aaa", "abb", "aba", "aabb", "abab", "abcabd", "aabbcd"])
def test_agents_that_share_networks_in_any_way(users: str) -> None:
    """A stack's values and gradients are those of each agent calling its network, whatever the agents see alike."""
    torch.manual_seed(0)
    networks = {name: MLPCritic(flat(O), flat(A), hidden_sizes=(H, 6)).double() for name in sorted(set(users))}
    own = [networks[name] for name in users]
    stack = Stack(own, ("value",))
    each, same = torch.randn(5, len(users), H).double(), torch.randn(5, H).double()
    action, joint = torch.randn(5, len(users), A).double(), torch.randn(5, A).double()
    for encoded, u in ((each, action), (each, joint), (same, action), (same, joint)):

        def of(tensor: torch.Tensor, agent: int) -> torch.Tensor:
            return tensor[:, agent] if tensor.dim() == 3 else tensor

        inputs = [PerAgent(tensor) if tensor.dim() == 3 else Shared(tensor) for tensor in (encoded, u)]
        expected = torch.stack([net.value(of(encoded, i), of(u, i)) for i, net in enumerate(own)], 1)
        torch.testing.assert_close(stack(stack.params, *inputs, function="value"), expected)
        torch.testing.assert_close(stack.act(*inputs, function="value"), expected.detach())
        weights = torch.arange(1.0, len(users) + 1).double()[:, None]
        vector = stack.flat.detach().requires_grad_()
        value = (stack(stack.unflatten(vector), *inputs, function="value") * weights).sum()
        gradient = stack.unflatten(torch.autograd.grad(value, vector)[0])
        for name, network in networks.items():
            parameters = dict(network.rest.named_parameters(prefix="rest"))
            wanted = torch.autograd.grad((expected * weights).sum(), list(parameters.values()), retain_graph=True)
            for key, want in zip(parameters, wanted, strict=True):
                torch.testing.assert_close(stack.own(gradient, users.index(name))[key], want)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("network", [MLPActor, LSTMActor, EntityActor])
def test_acting_plays_back_what_the_networks_would_do(network: type, shared: bool) -> None:
    """To the bit, for every shape of inputs, with the parameters of the moment, of its own or another stack's."""
    names = ["a", "b", "c"]
    layout = (Entities("self", 1, 1), Entities("agent", 2, 2, 2), Entities("target", 3, 3, 2))
    size = layout_size(layout) if network is EntityActor else O

    def actors() -> Actors:
        settings = (layout, A, H, 6) if network is EntityActor else (flat(O), A, (H, 6))
        networks = [network(*settings) for _ in names]
        return Actors(networks[:1] * 3 if shared else networks, names)

    stack, other = actors(), actors()

    def inputs(copies: int) -> Seen:
        if network is not LSTMActor:
            return Seen(torch.randn(copies, 3, size))
        return Seen(torch.randn(copies, 3, 5, O), (torch.rand(copies, 5) > 0.3).float())

    def check(copies: int) -> None:
        seen = inputs(copies)
        outputs = stack.respond(seen)[0]
        assert torch.equal(outputs, stack.outputs(stack.params, seen)[0]) and not outputs.requires_grad

    check(2)
    check(7)
    stack.flat.data.add_(0.1)
    check(7)
    stack.share(other)
    check(7)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library's memory is left as it is")
def test_what_a_call_frees_the_next_one_takes() -> None:
    """Without new pages of the system's: to fill them with zeros takes longer than most of what is computed in them."""
    Stack([MLPActor(flat(O), A)])

    def new_pages() -> int:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        _ = [torch.ones(2**20) for _ in range(10)]
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    # The best of some calls: where other tests have left holes, a call may still take a piece that is new.
    assert min(new_pages() for _ in range(5)) < 100  # of 10 x 1024


def test_a_window_longer_than_the_episode_is_a_full_unroll(actor: LSTMActor) -> None:
    episode = torch.randn(5, 6, O)
    _, (h, _) = as_torch_lstm(actor)(episode)
    window = torch.cat([torch.randn(5, 3, O), episode], dim=1)
    mask = (torch.arange(9) >= 3).float().expand(5, -1)
    torch.testing.assert_close(actor.unroll(window, mask)[0], actor.layers(h[0]), rtol=1e-5, atol=1e-6)


def test_what_lies_in_the_padding_changes_nothing(actor: LSTMActor) -> None:
    """Neither the action nor the gradient, and a masked window equals a shorter one."""
    window, mask = torch.randn(5, 6, O), (torch.arange(6) >= 2).float().expand(5, -1)
    other = window.clone()
    other[:, :2] = 1e6
    results = []
    for seen, counts in ((window, mask), (other, mask), (window[:, 2:], mask[:, 2:])):
        action = actor.unroll(seen, counts)[0]
        results.append((action, *torch.autograd.grad(action.sum(), list(actor.parameters()))))
    for changed in results[1:]:
        for x, y in zip(results[0], changed, strict=True):
            torch.testing.assert_close(x, y, rtol=1e-5, atol=1e-6)


def test_a_carried_state_goes_on(actor: LSTMActor) -> None:
    """Two windows, the second from the first one's h and c, are one long window."""
    window, mask = torch.randn(5, 6, O), torch.ones(5, 6)
    _, state = actor.unroll(window[:, :4], mask[:, :4])
    for got, want in zip(actor.unroll(window[:, 4:], mask[:, 4:], state), actor.unroll(window, mask), strict=True):
        torch.testing.assert_close(got, want)


def test_without_a_mask_all_observations_count(actor: LSTMActor) -> None:
    window = torch.randn(5, 6, O)
    for got, want in zip(actor.unroll(window), actor.unroll(window, torch.ones(5, 6)), strict=True):
        assert torch.equal(got, want)


def test_the_fast_unroll_is_the_plain_one(actor: LSTMActor) -> None:
    """`LSTMActor.unroll` leaves out products with zeros; `RecurrentActor.unroll` goes step by step."""
    window, mask = torch.randn(5, 6, O), (torch.arange(6) >= 2).float().expand(5, -1)
    for state in (None, torch.randn(5, 2, H)):
        fast, plain = actor.unroll(window, mask, state), RecurrentActor.unroll(actor, window, mask, state)
        for got, want in zip(fast, plain, strict=True):
            torch.testing.assert_close(got, want)


def test_the_cell_has_a_size_of_its_own(ray_session: None) -> None:
    """The layers after it and the critic keep theirs; agents saved before there was the setting load as they were."""
    config = small_config("maddpg-lstm").training(stored_state=True).rl_module(model_config={"lstm_cell_size": 5})
    module = build_learner(config).module["agent_0"]
    assert module.actor.initial_state().shape == (2, 5) and module.actor.layers[0].in_features == 5
    assert [module.actor.layers[0].out_features, module.critic.from_state.out_features] == [64, 64]
    old = {name: value for name, value in module.model_config.items() if name != "lstm_cell_size"}
    spaces = {"observation_space": module.observation_space, "action_space": module.action_space}
    assert maobs.AgentModule(**spaces, model_config=old).actor.from_hidden.in_features == 64


@pytest.mark.parametrize("carried", [False, True])
@pytest.mark.parametrize("algorithm", ["maddpg-lstm", "qmix"])
def test_the_action_taken_is_the_learners_recomputation(ray_session: None, algorithm: str, carried: bool) -> None:
    """From the runner through replay to the learner: the same windows, the same actions, to 1e-6."""
    config = small_config(algorithm, horizon=7).training(actor="lstm", seq_length=4, stored_state=carried)
    learner = build_learner(config)
    runner = JointEnvRunner(config=config, worker_index=0, num_workers=0)
    runner.share(learner.acting, None)
    team = config.team
    sizes = len(team.agents), team.observation_size, team.action_size, 0, (2, 64) if carried else None
    buffer = JointReplayBuffer(400, *sizes, seed=0)
    for length in (3, 20, 31):
        (sample,) = runner.sample(num_timesteps=2 * length, explore=False)
        buffer.add(**vars(sample))
    batch = learner.prepare(buffer.sample((300,), gamma=0.9, seq_length=4), {})
    assert set(batch.now.mask.sum(1).tolist()) == {1.0, 2.0, 3.0, 4.0}
    assert (batch.now.recurrent_state is not None) == carried
    online = TeamNetworks(learner.parts, learner._params_of(learner._roles))
    with torch.no_grad():
        outputs = online.outputs(batch.now)
    if team.discrete:
        assert torch.equal(outputs.argmax(-1), batch.actions.argmax(-1))
    else:
        torch.testing.assert_close(torch.tanh(outputs), batch.actions, rtol=0, atol=1e-6)


@pytest.mark.parametrize("algorithm", ["maddpg-lstm", "qmix"])
def test_h_and_c_go_from_window_to_window(ray_session: None, algorithm: str) -> None:
    """Zero at an episode's start, then what the last window ended with, whatever chooses actions; zero would differ."""
    config = small_config(algorithm, horizon=7).training(actor="lstm", seq_length=4, stored_state=True)
    learner = build_learner(config.training(normalize_observations=True))
    runner = JointEnvRunner(config=config, worker_index=0, num_workers=0)
    learner.update_normalizers(np.random.default_rng(0).normal(1.0, 2.0, (50, 3, 18)).astype(np.float32))
    runner.share(learner.acting, learner.normalizers)
    for how in ({"explore": False}, {"explore": True}, {"random_actions": True}):
        (sample,) = runner.sample(num_timesteps=2 * 31, force_reset=True, **how)
        team = config.team
        buffer = JointReplayBuffer(400, 3, team.observation_size, team.action_size, 0, (2, 64), seed=0)
        buffer.add(**vars(sample))
        batch = learner.prepare(buffer.sample((300,), gamma=0.9, seq_length=4), learner.normalizers.params)
        starts = batch.now.mask.sum(1) == 1
        assert torch.equal(batch.now.recurrent_state.flatten(1).any(1), ~starts) and starts.any()
        actors, (_, _, window, mask, state, _) = runner.acting.actors, batch.now
        ended = actors.respond(Seen(window, mask, state))[1]
        from_zero = actors.respond(Seen(window, mask))[1]
        torch.testing.assert_close(batch.next.recurrent_state, ended, rtol=0, atol=1e-6)
        assert ((ended - from_zero).abs().flatten(1).amax(1) > 1e-3).equal(~starts)


def test_windows_do_not_cross_a_reset_in_acting(ray_session: None) -> None:
    """At an episode's first step the actor sees that observation alone, also when the runner starts over."""
    config = small_config("maddpg-lstm", horizon=5)
    config.validate()
    runner = JointEnvRunner(config=config, worker_index=0, num_workers=0)
    (sample,) = runner.sample(num_timesteps=2 * 8, explore=False)
    (again,) = runner.sample(num_episodes=2, explore=False)
    actors, alone = runner.acting.actors, torch.ones(2, 1)
    for part, step in ((sample, 0), (sample, 5), (again, 0)):
        first = torch.from_numpy(part.obs[step])[:, :, None]  # (E, N, T = 1, O)
        want = torch.tanh(actors.respond(Seen(first, alone))[0])
        np.testing.assert_allclose(part.actions[step], want.numpy(), atol=1e-6)


def test_the_lstm_module_works_in_rllibs_own_runner(ray_session: None) -> None:
    """The same actions there as by hand, with the window as the module's state from step to step."""
    config = small_config("maddpg-lstm", horizon=7)
    config.validate()
    config.env_runner_cls = MultiAgentEnvRunner
    runner = MultiAgentEnvRunner(config=config, worker_index=0)
    episodes = runner.sample(num_episodes=2, explore=False)
    module = runner.module["agent_1"]
    for episode in episodes:
        agent = episode.agent_episodes["agent_1"]
        state = {k: v[None] for k, v in module.get_initial_state().items()}
        for t in range(7):
            out = module.forward_inference({"obs": agent.get_observations(t)[None], "state_in": state})
            np.testing.assert_allclose(agent.get_actions(t), out["actions"][0].numpy(), atol=1e-5)
            state = out["state_out"]
    assert runner.sample(num_timesteps=4, explore=True)


@pytest.mark.parametrize("algorithm", ["maddpg-lstm", "qmix"])
def test_carried_h_and_c_are_the_same_in_both_runners(ray_session: None, algorithm: str) -> None:
    """Ours, shown the observations of RLlib's, ends every window with the same h and c and acts the same."""
    config = small_config(algorithm, horizon=7).training(actor="lstm", stored_state=True)
    config.env_runners(num_envs_per_env_runner=1).validate()
    joint = JointEnvRunner(config=config, worker_index=0, num_workers=0)
    config.env_runner_cls = MultiAgentEnvRunner
    stock = MultiAgentEnvRunner(config=config, worker_index=0)
    joint.module.set_state(stock.module.get_state())
    for episode in stock.sample(num_episodes=2, explore=False):
        agents = [episode.agent_episodes[agent] for agent in joint.team.agents]
        joint.acting.forget(np.ones(1, dtype=np.bool_))
        for t in range(7):
            acted = joint.acting(np.stack([agent.get_observations(t) for agent in agents])[None], 0, explore=False)[0]
            want = np.stack([agent.get_actions(t) for agent in agents])
            np.testing.assert_allclose(acted.argmax(-1) if joint.team.discrete else acted, want, atol=1e-6)
            states = [agent.get_extra_model_outputs("state_out", t) for agent in agents]
            want = np.stack([state["recurrent_state"] for state in states])
            np.testing.assert_allclose(joint.acting.recurrent_state[0], want, atol=1e-6)
    assert stock.sample(num_timesteps=4, explore=True)


def test_an_lstm_module_asks_for_its_state(ray_session: None) -> None:
    learner = build_learner(small_config("maddpg-lstm"))
    with pytest.raises(ValueError, match=r'give its state as batch\["state_in"\], get_initial_state\(\)'):
        learner.module["agent_0"].forward_inference({"obs": np.zeros((1, 18), np.float32)})


@pytest.mark.parametrize("algorithm", ["maddpg", "qmix"])
def test_discrete_modules_act_in_both_runners(ray_session: None, algorithm: str) -> None:
    """The best action when they do not explore; drawn from the softmax, or epsilon-greedily, when they do."""
    config = small_config(algorithm, horizon=6, action_mode="discrete")
    config.validate()
    joint = JointEnvRunner(config=config, worker_index=0, num_workers=0)
    (sample,) = joint.sample(num_timesteps=12, explore=False)
    assert set(np.unique(sample.actions)) == {0.0, 1.0} and (sample.actions.sum(-1) == 1).all()
    values, _ = joint.acting.actors.respond(Seen(torch.from_numpy(sample.obs[2])))
    assert np.array_equal(values.argmax(-1).numpy(), sample.actions[2].argmax(-1))
    (random,) = joint.sample(num_timesteps=2000, random_actions=True)
    np.testing.assert_allclose(random.actions.mean((0, 1, 2)), 0.2, atol=0.03)
    config.env_runner_cls = MultiAgentEnvRunner
    stock = MultiAgentEnvRunner(config=config, worker_index=0)
    agent = stock.sample(num_episodes=1, explore=False)[0].agent_episodes["agent_1"]
    module = stock.module["agent_1"]
    want = module.forward_inference({"obs": np.asarray(agent.get_observations(slice(0, 6)))})[Columns.ACTIONS]
    assert want.tolist() == np.asarray(agent.get_actions()).tolist()
    assert stock.sample(num_timesteps=4, explore=True)


def test_discrete_exploration() -> None:
    values = torch.tensor([1.0, 3.0, 2.0, -torch.inf]).expand(20_000, -1)
    generator = torch.Generator().manual_seed(0)

    def shares(exploration: EpsilonGaussian, sample: bool) -> list[float]:
        drawn = exploration.discrete(values, 0, generator, sample=sample)
        return (torch.bincount(drawn, minlength=4) / len(drawn)).tolist()

    third = 0.3 / 3
    assert shares(EpsilonGaussian(epsilon=0.3), False) == pytest.approx([third, 0.7 + third, third, 0], abs=0.01)
    softmax = torch.softmax(values[0], 0).tolist()
    assert shares(EpsilonGaussian(epsilon=0.0), True) == pytest.approx(softmax, abs=0.01)


def mixers(monotone: bool) -> tuple[Mixer, torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(1)
    q, state = torch.randn(500, 3, generator=generator), torch.randn(500, 5, generator=generator)
    return Mixer(3, 5, hidden_size=8, monotone=monotone).double(), q.double(), state.double()


def test_qmix_rises_with_every_agents_value_and_facmac_need_not() -> None:
    """Finite differences over random states and values."""
    for monotone in (True, False):
        mixer, q, state = mixers(monotone)
        slopes = torch.stack([mixer(q + 1e-5 * unit, state) - mixer(q, state) for unit in torch.eye(3).double()])
        assert (slopes >= 0).all() == monotone
        assert slopes.max() > 0
        assert (slopes.min() < -1e-7) != monotone


def test_each_agents_best_action_is_the_teams_for_qmix_and_vdn_only() -> None:
    """Over all joint actions of three agents with three actions each."""
    generator = torch.Generator().manual_seed(2)
    values = torch.randn(200, 3, 3, generator=generator).double()  # (states, agents, actions)
    joint = torch.cartesian_prod(*[torch.arange(3)] * 3)  # (27, 3)
    chosen = torch.stack([values[:, a, joint[:, a]] for a in range(3)], dim=-1)  # (states, 27, agents)
    own = values.argmax(-1)
    agree = {}
    for name in ("vdn", "qmix", "facmac"):
        mixer, _, state = mixers(name == "qmix")
        total = chosen.sum(-1) if name == "vdn" else mixer(chosen, state[:200, None].expand(-1, 27, -1))
        agree[name] = (joint[total.argmax(1)] == own).all(1)
    assert agree["vdn"].all() and agree["qmix"].all()
    assert not agree["facmac"].all()


def test_vdn_is_the_plain_sum(ray_session: None) -> None:
    learner = build_learner(small_config("vdn"))
    q = torch.randn(7, 3)
    torch.testing.assert_close(learner.total(None, q, None), q[:, :1] + q[:, 1:2] + q[:, 2:])


@pytest.mark.parametrize(
    ("algorithm", "shared", "carried"),
    [("maddpg-lstm", False, False), ("facmac", True, False), ("qmix", True, False), ("maddpg-lstm", False, True)],
)
def test_every_kind_of_module_leaves_its_checkpoint(
    ray_session: None, tmp_path, algorithm: str, shared: bool, carried: bool
) -> None:
    """Each acts alone; shared parameters are there once; the mixer is a module of its own."""
    config = small_config(algorithm).training(stored_state=carried)
    if shared:
        config.multi_agent(policies={"all"}, policy_mapping_fn=lambda agent, *a, **k: "all")
    algo = config.build_algo()
    algo.train()
    folder = f"{algo.save_to_path(tmp_path / 'checkpoint')}/learner_group/learner/rl_module"
    names = ["all"] if shared else ["agent_0", "agent_1", "agent_2"]
    assert sorted(
        p.name for p in (tmp_path / "checkpoint/learner_group/learner/rl_module").iterdir() if p.is_dir()
    ) == ([*names, "mixer"] if algorithm in ("facmac", "qmix") else names)
    for name in names:
        module, trained = RLModule.from_checkpoint(f"{folder}/{name}"), algo.get_module(name)
        obs = np.random.default_rng(0).normal(size=(3, 18)).astype(np.float32)
        state = {k: torch.ones(3, *v.shape) for k, v in module.get_initial_state().items()}
        got, want = (m.forward_inference({"obs": obs, "state_in": state}) for m in (module, trained))
        # Alone its weights lie in another order in memory, which moves the last digit.
        torch.testing.assert_close(got["actions"], want["actions"], rtol=0.0, atol=1e-6)
        assert ("recurrent_state" in got.get("state_out", {})) == carried
    parameters = sum(p.numel() for p in algo._learner.module[names[0]].parameters())
    stacked = sum(
        s.flat.numel() for r, s in (*algo._learner._roles.items(), *algo._learner._targets.items()) if r != "mixer"
    )
    if algorithm != "facmac" or shared:
        assert parameters * len(names) == stacked
    algo.stop()


def test_normalised_observations_survive_a_checkpoint(ray_session: None, tmp_path) -> None:
    config = small_config("maddpg").training(normalize_observations=True)
    algo = config.build_algo()
    algo.train()
    path = algo.save_to_path(tmp_path / "checkpoint")
    module = RLModule.from_checkpoint(f"{path}/learner_group/learner/rl_module/agent_1")
    seen = algo.replay_buffer._columns["obs"][: len(algo.replay_buffer), 1]
    assert module.normalizer.count.item() == 40
    torch.testing.assert_close(module.normalizer.mean, algo._learner.module["agent_1"].normalizer.mean)
    assert (module.normalizer.mean - seen.mean(0)).abs().max() < 0.2
    restored = maobs.MADDPG.from_checkpoint(path)
    first, second = algo.train(), restored.train()
    assert first["env_runners"]["num_env_steps_sampled"] == second["env_runners"]["num_env_steps_sampled"]
    assert torch.equal(algo._learner.normalizers.flat, restored._learner.normalizers.flat)
    assert restored.env_runner.acting.normalizers.flat.data_ptr() == restored._learner.normalizers.flat.data_ptr()
    algo.stop()
    restored.stop()


def test_random_numbers_of_the_losses_survive_a_checkpoint(ray_session: None, tmp_path) -> None:
    """Smoothed targets and Gumbel draws go on where they were, and so does the delay of the actors."""
    config = small_config("maddpg").training(twin_critics=True, target_noise=0.2, policy_delay=2)
    algo = config.build_algo()
    algo.train()
    restored = maobs.MADDPG.from_checkpoint(algo.save_to_path(tmp_path / "checkpoint"))
    algo.train()
    restored.train()
    for role, stack in algo._learner._roles.items():
        assert torch.equal(stack.flat, restored._learner._roles[role].flat)
    algo.stop()
    restored.stop()


def test_batches_of_the_tests_are_those_of_replay(ray_session: None) -> None:
    """The random batches that the learner's tests use have the names and shapes that replay gives."""
    for algorithm, stored in (("maddpg", False), ("maddpg-lstm", False), ("qmix", False), ("maddpg-lstm", True)):
        config = small_config(algorithm).training(critic_state="world", stored_state=stored)
        algo = config.build_algo()
        algo.train()
        batch = algo.replay_buffer.sample((32,), gamma=0.9, seq_length=algo.config.window_length)
        made = random_batch(algo.config, size=32)._replace(noise=None)

        def shapes(part: object) -> object:
            return part.shape if isinstance(part, torch.Tensor) else part

        assert tree_map(shapes, batch) == tree_map(shapes, made)
        algo.stop()
