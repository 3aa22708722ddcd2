"""Losses, gradients and updates against references; routing; options; sharing; compiled against eager."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

import rllib_maobs as maobs
from rllib_maobs.learner import JointLearner
from rllib_maobs.terms import Columns, Nets
from tests.conftest import ALGORITHMS, random_columns, small_config
from tests.equations import Equations
from tests.reference import LoopLearner, whole_layers

MakeLearner = Callable[[maobs.JointConfig], JointLearner]
FAMILY = ["iddpg", "maddpg", "maddpg-l"]
DDPG = [(name, "replay") for name in FAMILY] + [("maddpg", "current"), ("maddpg", "joint")]


def ddpg(algorithm: str, others: str) -> maobs.JointConfig:
    config = small_config(algorithm)
    return config.training(other_agents_actions=others) if algorithm == "maddpg" else config


def reference_sample(learner: JointLearner, columns: Columns) -> dict[str, torch.Tensor]:
    """Columns as the loop reference wants them."""
    batch = learner.prepare(columns, {})
    flags = {"terminated": (columns["discount"] == 0).to(columns["rewards"].dtype)}
    return {k: v for k, v in batch._asdict().items() if isinstance(v, torch.Tensor)} | flags


def reference_of(learner: JointLearner) -> LoopLearner:
    config = learner.config
    team = config.team
    others = getattr(config, "other_agents_actions", "replay")
    sizes = (len(team.agents), team.observation_size, team.action_size, config.state_size)
    reference = LoopLearner(config.name, *sizes, others=others, gamma=config.gamma, tau=config.tau)
    reference.copy_from([learner.module[mid] for mid in config.module_ids])
    return reference


def with_state(learner: JointLearner, columns: Columns) -> Columns:
    """The loop reference reads a state even where the algorithm has none."""
    return columns | {k: columns[k[:-5] + "obs"].flatten(1) for k in ("state", "next_state")}


def per_network(pieces: list[torch.Tensor], stack: Any) -> list[list[torch.Tensor]]:
    """A stack's gradient as a list of parameters for each distinct network, cut to its own sizes."""
    params = stack.unflatten(torch.cat(pieces))
    result = []
    for row in range(max(stack.rows) + 1):
        network = stack.networks[stack.rows.index(row)]
        own = [
            params[name][row][tuple(slice(size) for size in parameter.shape)]
            for name, parameter in network.named_parameters()
        ]
        result.append([torch.cat(own[:2], dim=1), *own[2:]] if hasattr(network, "from_state") else own)
    return result


@pytest.fixture
def double_precision() -> Iterator[None]:
    """Adam blows single precision's rounding up within a few updates; in double precision equal stays equal."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def discrete(config: maobs.JointConfig) -> maobs.JointConfig:
    return config.environment(env_config={"action_mode": "discrete"})


def one_policy(config: maobs.JointConfig) -> maobs.JointConfig:
    return config.multi_agent(policies={"all"}, policy_mapping_fn=lambda agent, *a, **k: "all")


def two_policies(config: maobs.JointConfig) -> maobs.JointConfig:
    def mapping(agent: str, *args: Any, **kwargs: Any) -> str:
        return "last" if agent == "agent_2" else "first"

    return config.multi_agent(policies={"first", "last"}, policy_mapping_fn=mapping)


def learned_prey(config: maobs.JointConfig) -> maobs.JointConfig:
    return config.environment("maobs/obstacle-predator-prey", env_config={"prey": "learned"})


TD3 = {"twin_critics": True, "target_noise": 0.2, "target_noise_clip": 0.3}
CARRIED = "h and c carried"
# Algorithm, settings, further changes; the name of the case.
CASES: dict[str, tuple[str, dict[str, Any], list[Any]]] = {
    **{f"{a}, {s}": (a, {"critic_state": s}, []) for a in FAMILY for s in ("observations", "world")},
    **{f"maddpg, others' actions {o}": ("maddpg", {"other_agents_actions": o}, []) for o in ("current", "joint")},
    "maddpg-lstm": ("maddpg-lstm", {}, []),
    **{f"{a} with LSTM": (a, {"actor": "lstm"}, []) for a in ("iddpg", "maddpg-l", "facmac", "iql", "vdn", "qmix")},
    **{f"{a}, {CARRIED}": (a, {"actor": "lstm", "carry_hidden": True}, []) for a in ("maddpg-lstm", "facmac", "qmix")},
    **{f"facmac, {c}": ("facmac", {"critic_source": c}, []) for c in ("shared", "others", "own")},
    "facmac, world": ("facmac", {"critic_state": "world"}, []),
    **{f"{a}, double {d}": (a, {"double_q": d}, []) for a in ("iql", "vdn", "qmix") for d in (False, True)},
    "qmix, world": ("qmix", {"critic_state": "world"}, []),
    **{f"{a}, discrete": (a, {"gumbel_temperature": 0.7}, [discrete]) for a in (*FAMILY, "facmac")},
    "maddpg-lstm, discrete": ("maddpg-lstm", {}, [discrete]),
    **{f"{a}, TD3": (a, TD3, []) for a in (*FAMILY, "maddpg-lstm")},
    "maddpg, action regularization": ("maddpg", {"action_regularization": 0.3}, []),
    "maddpg-l, discrete, action regularization": ("maddpg-l", {"action_regularization": 0.3}, [discrete]),
    "maddpg, reward scale": ("maddpg", {"reward_scale": 0.1}, []),
    "qmix, reward scale": ("qmix", {"reward_scale": 0.1}, []),
    "iddpg, three steps": ("iddpg", {"n_step": 3}, []),
    **{f"{a}, one policy": (a, {}, [one_policy]) for a in ALGORITHMS},
    **{f"{a}, one policy with ids": (a, {"agent_id_input": True}, [one_policy]) for a in ALGORITHMS},
    **{f"{a}, two policies": (a, {"agent_id_input": True}, [two_policies]) for a in (*FAMILY, "qmix")},
    "facmac own, two policies": ("facmac", {"critic_source": "own"}, [two_policies]),
    **{f"{a}, learned prey": (a, {}, [learned_prey]) for a in (*FAMILY, "maddpg-lstm")},
    f"maddpg-lstm, learned prey, {CARRIED}": ("maddpg-lstm", {"carry_hidden": True}, [learned_prey]),
    f"maddpg-lstm, one policy, {CARRIED}": ("maddpg-lstm", {"carry_hidden": True}, [one_policy]),
    "maddpg-l, learned prey with ids": ("maddpg-l", {"agent_id_input": True}, [learned_prey]),
}


def configured(case: str) -> maobs.JointConfig:
    algorithm, settings, changes = CASES[case]
    config = small_config(algorithm).training(**settings)
    for change in changes:
        change(config)
    return config


def compare(learner: JointLearner, columns: Columns, stage: str = "") -> None:
    """Losses and gradients of a learner equal those of the equations."""
    want = Equations(learner).gradients(columns, stage)
    learner.stage = stage
    got, report = learner.gradients(columns)
    agents = len(learner.config.team.agents)
    for row, losses in ((0, want["critic_loss"]), (2, want["actor_loss"])):
        if losses:
            expected = losses if len(losses) == agents else losses * agents
            assert report[row].tolist() == pytest.approx(expected, rel=1e-8)
    assert set(got) == {role for role in ("actor", "critic", "mixer") if role in want}
    for role, gradient in got.items():
        networks = per_network(gradient, learner._roles[role])
        assert len(networks) == len(want[role])
        for network_got, network_want in zip(networks, want[role], strict=True):
            assert max(g.abs().max() for g in network_want) > 1e-5  # there is a gradient to compare
            for g, w in zip(network_got, network_want, strict=True):
                torch.testing.assert_close(g, w, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.usefixtures("double_precision")
def test_losses_and_gradients_equal_the_equations(make_learner: MakeLearner, case: str) -> None:
    learner = make_learner(configured(case))
    compare(learner, random_columns(learner.config, size=12))


@pytest.mark.parametrize("source", ["shared", "others", "own"])
@pytest.mark.usefixtures("double_precision")
def test_facmac_learns_locally_before_its_mixer_starts(make_learner: MakeLearner, source: str) -> None:
    """Eq. 13 with the mixer standing still until `mixer_start`, eq. 14 from then on."""
    learner = make_learner(small_config("facmac").training(critic_source=source, mixer_start=1000))
    columns = random_columns(learner.config, size=12)
    compare(learner, columns, "local")
    mixer = learner._roles["mixer"].flat
    start = mixer.detach().clone()
    batches = {name: column[None] for name, column in columns.items()}
    for steps, moves in ((999, False), (1000, True)):
        learner.update(batches, timesteps={"num_env_steps_sampled_lifetime": steps}, _no_metrics_reduce=True)
        assert torch.equal(mixer, start) != moves
    # Adam's first step is one learning rate whichever stage it falls into: its clock did not run meanwhile.
    assert (mixer - start).abs().max().item() == pytest.approx(learner.config.critic_lr, rel=1e-3)
    compare(learner, columns)


@pytest.mark.parametrize(("algorithm", "others"), DDPG)
@pytest.mark.usefixtures("double_precision")
def test_twenty_updates_equal_the_reference(make_learner: MakeLearner, algorithm: str, others: str) -> None:
    learner = make_learner(ddpg(algorithm, others))
    reference = reference_of(learner)
    start = learner.acting.flat.detach().clone()
    for seed in range(20):
        columns = with_state(learner, random_columns(learner.config, seed=seed))
        learner.step(columns)
        reference.update(reference_sample(learner, columns))
    assert (learner.acting.flat - start).abs().max() > 1e-3
    for mid, a in zip(learner.config.module_ids, reference.agents, strict=True):
        module = learner.module[mid]
        for got, want in (
            (list(module.actor.parameters()), reference.actors[a]),
            (whole_layers(list(module.critic.parameters())), reference.critics[a]),
            (list(module.target_actor.parameters()), reference.target_actors[a]),
            (whole_layers(list(module.target_critic.parameters())), reference.target_critics[a]),
        ):
            for p, q in zip(got, want.parameters(), strict=True):
                torch.testing.assert_close(p, q, rtol=1e-7, atol=1e-9)


def test_critic_loss_moves_no_actor_and_actor_loss_no_critic(make_learner: MakeLearner) -> None:
    """With one role's learning rate at zero that role stands still, whatever the other one does."""
    for algorithm in ("maddpg", "facmac"):
        for frozen, moving in (("actor", "critic"), ("critic", "actor")):
            learner = make_learner(small_config(algorithm))
            before = {role: stack.flat.detach().clone() for role, stack in learner._roles.items()}
            learner.get_optimizer("__all_modules__", frozen).param_groups[0]["lr"] = 0.0
            learner.step(random_columns(learner.config))
            moved = {role for role, stack in learner._roles.items() if not torch.equal(stack.flat, before[role])}
            assert frozen not in moved and moving in moved
            assert ("mixer" in moved) == (algorithm == "facmac" and moving == "critic")


@pytest.mark.parametrize("algorithm", [*FAMILY, "maddpg-lstm", "facmac"])
def test_gradients_stay_in_their_role(make_learner: MakeLearner, algorithm: str) -> None:
    """The critic's gradient does not depend on the online actor, the actor's not on rewards or targets."""
    learner = make_learner(small_config(algorithm))
    columns = random_columns(learner.config)

    def flat(columns: Columns) -> dict[str, torch.Tensor]:
        return {role: torch.cat(pieces) for role, pieces in learner.gradients(columns)[0].items()}

    before = flat(columns)
    changed = flat(columns | {"rewards": columns["rewards"] + 1.0})
    assert torch.equal(changed["actor"], before["actor"])
    assert not torch.equal(changed["critic"], before["critic"])
    learner.acting.flat.data.add_(0.1)
    assert torch.equal(flat(columns)["critic"], before["critic"])


@pytest.mark.parametrize("algorithm", [*FAMILY, "iql"])
def test_agents_do_not_leak_into_each_other(make_learner: MakeLearner, algorithm: str) -> None:
    """Agent 0's reward moves agent 0's critic and nobody else's."""
    learner = make_learner(small_config(algorithm))
    columns = random_columns(learner.config)
    before = per_network(learner.gradients(columns)[0]["critic"], learner.critics)
    rewards = columns["rewards"].clone()
    rewards[:, 0] += 1.0
    after = per_network(learner.gradients(columns | {"rewards": rewards})[0]["critic"], learner.critics)
    same = [all(torch.equal(x, y) for x, y in zip(b, a, strict=True)) for b, a in zip(before, after, strict=True)]
    assert same == [False, True, True]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_truncation_bootstraps_and_termination_does_not(make_learner: MakeLearner, algorithm: str) -> None:
    """Where the discount is 0 the target is the reward alone; elsewhere it moves with the target networks."""
    learner = make_learner(small_config(algorithm))
    nets, target = learner.nets(), learner.nets(target=True)
    moved = Nets(target.actor, {k: v + 0.05 for k, v in target.critic.items()}, target.mixer)
    for discount, depends in ((0.0, False), (0.9, True)):
        columns = random_columns(learner.config)
        columns["discount"] = torch.full_like(columns["discount"], discount)
        batch = learner.prepare(columns, {})
        losses = [learner.critic_loss(nets, t, batch)[0] for t in (target, moved)]
        assert torch.equal(*losses) != depends


COMPILED = [*ALGORITHMS, "facmac own", "td3", "shared", "clipped", "normalised", "discrete", "prey"]
COMPILED += ["carried", "qmix carried"]


@pytest.mark.parametrize("case", COMPILED)
@pytest.mark.usefixtures("double_precision")
def test_compiled_equals_eager_over_many_updates(make_learner: MakeLearner, case: str) -> None:
    def config() -> maobs.JointConfig:
        if case in ALGORITHMS:
            return small_config(case)
        return {
            "facmac own": lambda: small_config("facmac").training(critic_source="own", critic_lr=1e-3),
            "td3": lambda: small_config("maddpg").training(**TD3, policy_delay=2),
            "shared": lambda: one_policy(small_config("maddpg-l").training(agent_id_input=True)),
            "clipped": lambda: small_config("maddpg").training(grad_clip=0.5),
            "normalised": lambda: small_config("maddpg-lstm").training(normalize_observations=True),
            "discrete": lambda: discrete(small_config("maddpg")),
            "prey": lambda: learned_prey(small_config("maddpg")),
            "carried": lambda: small_config("maddpg-lstm").training(carry_hidden=True),
            "qmix carried": lambda: small_config("qmix").training(actor="lstm", carry_hidden=True),
        }[case]()

    eager = make_learner(config())
    compiled = make_learner(config().framework(torch_compile_learner=True))
    for stacks, others in ((compiled._roles, eager._roles), (compiled._targets, eager._targets)):
        for role, stack in stacks.items():
            stack.flat.data.copy_(others[role].flat.data)
    for seed in range(100):
        columns = random_columns(eager.config, seed=seed)
        if seed == 0 and eager.normalizers is not None:
            for learner in (eager, compiled):
                learner.observe(columns["window"].numpy())
        eager_report, compiled_report = eager.step(columns), compiled.step(columns)
    assert compiled._compiled and not eager._compiled
    torch.testing.assert_close(compiled_report, eager_report, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(compiled.acting.flat, eager.acting.flat, rtol=1e-6, atol=1e-8)


def test_learners_of_one_process_do_not_share_compiled_code(make_learner: MakeLearner) -> None:
    """Settings that leave all shapes as they are must not be taken over from the learner compiled first."""
    for others, temperature in (("replay", 1.0), ("current", 1.0), ("joint", 0.5)):
        config = discrete(small_config("maddpg"))
        config.training(other_agents_actions=others, gumbel_temperature=temperature, reward_scale=temperature)
        learner = make_learner(config.framework(torch_compile_learner=True))
        columns = random_columns(learner.config)
        compiled, _ = learner.gradients(columns)
        eager, _ = learner._gradients(learner.nets(), learner.nets(target=True), {}, columns)
        for role, pieces in compiled.items():
            torch.testing.assert_close(pieces, eager[role], rtol=1e-4, atol=1e-5)


def test_every_batch_size_is_compiled_on_its_own(make_learner: MakeLearner) -> None:
    """Compiled code checks no sizes when it is called; other compilers than Inductor serve as well."""
    framework = {"torch_compile_learner": True, "torch_compile_learner_dynamo_backend": "aot_eager"}
    compiled = make_learner(small_config("maddpg").framework(**framework))
    for size in (32, 12):
        columns = random_columns(compiled.config, size=size)
        want, _ = compiled._gradients(compiled.nets(), compiled.nets(target=True), {}, columns)
        for role, pieces in compiled.gradients(columns)[0].items():
            torch.testing.assert_close(pieces, want[role], rtol=1e-4, atol=1e-5)


def test_targets_start_equal_to_the_online_networks(ray_session: None) -> None:
    for algorithm in ("maddpg", "qmix"):
        algo = small_config(algorithm).build_algo()
        for mid in algo.config.module_ids:
            for online, target in algo._learner.module[mid].get_target_network_pairs():
                for p, q in zip(online.parameters(), target.parameters(), strict=True):
                    assert torch.equal(p, q)
                    assert p.data_ptr() != q.data_ptr()
        algo.stop()


def test_modules_are_views_of_the_stack(make_learner: MakeLearner) -> None:
    """An update moves every agent's own module; loading one agent's weights moves its row and no other."""
    learner = make_learner(small_config("maddpg"))
    modules = [learner.module[mid] for mid in learner.config.module_ids]
    before = [m.actor.layers[0].weight.detach().clone() for m in modules]
    learner.step(random_columns(learner.config))
    assert all(not torch.equal(m.actor.layers[0].weight, b) for m, b in zip(modules, before, strict=True))
    learner.module["agent_1"].set_state(learner.module["agent_2"].get_state())
    rows = learner.acting.params["layers.0.weight"]
    assert torch.equal(rows[1], rows[2])
    assert not torch.equal(rows[0], rows[1])


def test_padding_stays_empty(make_learner: MakeLearner) -> None:
    """Predators and prey of different sizes lie in one stack; what pads the smaller networks never moves."""
    learner = make_learner(learned_prey(small_config("maddpg")))
    assert len(set(learner.config.team.observation_sizes)) == 2
    for seed in range(10):
        learner.step(random_columns(learner.config, seed=seed))
    for role, stack in learner._roles.items():
        padding = torch.ones_like(stack.flat)
        params = stack.unflatten(padding)
        for row, network in zip(stack.rows, stack.networks, strict=True):
            for name, parameter in network.named_parameters():
                params[name][row][tuple(slice(size) for size in parameter.shape)] = 0.0
        assert padding.any() == (role == "actor")  # a centralised critic sees the same of all
        assert not stack.flat[padding.bool()].any()


def test_shared_parameters_are_stored_once(make_learner: MakeLearner) -> None:
    """One policy for all has a third of the parameters of three, in the stack as in the module."""
    own, shared = make_learner(small_config("maddpg")), make_learner(one_policy(small_config("maddpg")))
    assert 3 * shared.acting.flat.numel() == own.acting.flat.numel()
    assert sorted(shared.module.keys()) == ["all"]
    shared.step(random_columns(shared.config))
    torch.testing.assert_close(shared.module["all"].actor.layers[0].weight, shared.acting.params["layers.0.weight"][0])


@pytest.mark.usefixtures("double_precision")
def test_agent_ids_tell_agents_with_shared_parameters_apart(make_learner: MakeLearner) -> None:
    """Same observation, same action: without ids all agents' Q and actions are equal, with ids they are not."""
    for ids in (False, True):
        learner = make_learner(one_policy(small_config("maddpg-l").training(agent_id_input=ids)))
        columns = random_columns(learner.config)
        start = 3 if ids else 0
        obs = columns["obs"].clone()
        obs[..., start:] = obs[:, :1, start:]
        obs[..., :start] = torch.eye(3)[:, :start]
        batch = learner.prepare(columns | {"obs": obs, "actions": columns["actions"][:, :1].expand(-1, 3, -1)}, {})
        nets = learner.nets()
        q = learner.q(nets.critic, learner.encode(nets.critic, batch.state), batch.actions)[..., 0]
        for values in (q, learner.act(nets.actor, batch.history)):
            assert torch.allclose(values[:, 0], values[:, 1]) != ids


def test_delayed_actors_and_targets_wait_for_their_turn(make_learner: MakeLearner) -> None:
    learner = make_learner(small_config("maddpg").training(policy_delay=3))
    moved = []
    for seed in range(7):
        before = [s.flat.detach().clone() for s in (learner.acting, learner.critics, learner._targets["critic"])]
        report = learner.step(random_columns(learner.config, seed=seed))
        after = (learner.acting, learner.critics, learner._targets["critic"])
        moved.append(tuple(not torch.equal(b, s.flat) for b, s in zip(before, after, strict=True)))
        assert bool(report[2].any()) == moved[-1][0]
    assert moved == [(True,) * 3 if i % 3 == 0 else (False, True, False) for i in range(7)]


def test_delayed_actors_report_the_mean_of_their_own_updates(make_learner: MakeLearner) -> None:
    learner = make_learner(small_config("maddpg").training(policy_delay=2))
    columns = random_columns(learner.config)
    learner.config.tau = 1e-12
    for role in ("actor", "critic"):
        learner.get_optimizer("__all_modules__", role).param_groups[0]["lr"] = 0.0
    want = learner.gradients(columns)[1].mean(1)
    learner.update({k: torch.stack([v] * 4) for k, v in columns.items()}, _no_metrics_reduce=True)
    got = learner.report()
    for row, name in enumerate(("critic_loss", "q_mean", "actor_loss")):
        means = [got[mid][name].peek() for mid in learner.config.module_ids]
        assert sum(means) / 3 == pytest.approx(want[row].item(), rel=1e-5)


@pytest.mark.parametrize("by", ["global_norm", "norm", "value"])
def test_gradients_are_clipped_by_network(make_learner: MakeLearner, by: str) -> None:
    free = make_learner(small_config("maddpg"))
    columns = random_columns(free.config)
    whole = per_network(free.gradients(columns)[0]["critic"], free.critics)
    norms = [torch.cat([g.flatten() for g in network]).norm() for network in whole]
    limit = float(sorted(norms)[1]) if by == "global_norm" else 1e-2  # clips some networks, not all
    clipped = make_learner(small_config("maddpg").training(grad_clip=limit, grad_clip_by=by))
    for role, stack in clipped._roles.items():
        stack.flat.data.copy_(free._roles[role].flat.data)
        clipped._targets[role].flat.data.copy_(free._targets[role].flat.data)
    got = clipped.critics.unflatten(torch.cat(clipped.gradients(columns)[0]["critic"]))
    want = free.critics.unflatten(torch.cat(free.gradients(columns)[0]["critic"]))
    for agent, norm in enumerate(norms):
        for name, gradient in want.items():
            g = gradient[agent]
            if by == "value":
                expected = g.clamp(-limit, limit)
            else:
                expected = g * min(1.0, limit / float(norm if by == "global_norm" else g.norm()))
            torch.testing.assert_close(got[name][agent], expected, rtol=1e-5, atol=1e-9)


def test_observations_are_normalised_by_what_was_seen(make_learner: MakeLearner) -> None:
    """Each agent's by its own statistics, whatever the portions they came in; the same networks see them in acting."""
    learner = make_learner(learned_prey(small_config("maddpg").training(normalize_observations=True)))
    team = learner.config.team
    generator = torch.Generator().manual_seed(0)
    n, o = len(team.agents), team.observation_size
    present = (torch.arange(o) < torch.tensor(team.observation_sizes)[:, None]).float()
    obs = (torch.randn(60, 4, n, o, generator=generator) * torch.arange(1, o + 1) + torch.arange(n)[:, None]) * present
    for part in (obs[:1], obs[1:20], obs[20:]):
        learner.observe(part.numpy())
    columns = random_columns(learner.config)
    columns["obs"] = obs[0].clone()
    batch = learner.prepare(columns | {"next_obs": columns["obs"]}, learner.normalizers.params)
    mean, std = obs.flatten(0, 1).mean(0), obs.flatten(0, 1).std(0, correction=0)
    want = ((obs[0] - mean) / std.clamp(min=1e-2)).clamp(-10, 10) * present
    torch.testing.assert_close(batch.obs, want, rtol=1e-4, atol=1e-5)
    size = team.observation_sizes[-1]
    module = learner.module[learner.config.module_ids[-1]]
    acted = module.forward_inference({"obs": obs[0, :, -1, :size]})["actions"]
    torch.testing.assert_close(acted, torch.tanh(learner.act(learner.nets().actor, batch.history))[:, -1])


def test_a_learning_rate_schedule_is_followed(make_learner: MakeLearner) -> None:
    learner = make_learner(small_config("iddpg").training(actor_lr=[[0, 1e-3], [100, 0.0]]))
    columns = random_columns(learner.config)
    learner.update({k: v[None] for k, v in columns.items()}, _no_metrics_reduce=True)
    learner.report(timesteps={"num_env_steps_sampled_lifetime": 50})
    assert learner.get_optimizer("__all_modules__", "actor").param_groups[0]["lr"] == pytest.approx(5e-4)


@pytest.mark.usefixtures("double_precision")
def test_with_one_agent_all_algorithms_are_ddpg(make_learner: MakeLearner) -> None:
    """One agent's observation is the state and its action the joint action: the same numbers come out."""
    actors = []
    for algorithm in FAMILY:
        learner = make_learner(small_config(algorithm, num_agents=1))
        start = learner.acting.flat.detach().clone()
        for seed in range(20):
            learner.step(random_columns(learner.config, seed=seed))
        assert (learner.acting.flat - start).abs().max() > 1e-3
        actors.append(learner.acting.flat.detach())
    for actor in actors:
        torch.testing.assert_close(actor, actors[0], rtol=1e-7, atol=1e-9)


def test_a_state_in_another_layout_is_refused(make_learner: MakeLearner) -> None:
    """Its numbers would fit, and be those of other parameters."""
    learner = make_learner(small_config("maddpg"))
    state = learner.get_state()
    learner.set_state(state)
    del state["progress"]["layout"]
    with pytest.raises(ValueError, match=r"saved by an earlier revision.*layout 1, here 2.*RLModule\.from_checkpoint"):
        learner.set_state(state)
