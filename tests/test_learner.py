"""Losses, gradients and updates against the equations; routing; options; sharing; compiled against eager."""

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch.utils._pytree import tree_map

import rllib_maobs as maobs
from rllib_maobs.algorithms.maddpg import MADDPGLearner
from rllib_maobs.learner import JointLearner, TeamNetworks, update
from rllib_maobs.modules import Stack
from rllib_maobs.replay import Batch
from tests.conftest import ALGORITHMS, random_batch, small_config
from tests.equations import Equations, leaves

MakeLearner = Callable[[maobs.JointConfig], JointLearner]
FAMILY = ["iddpg", "maddpg", "maddpg-l"]
DDPG = [(name, "replay") for name in FAMILY] + [("maddpg", "current"), ("maddpg", "joint")]


def repeated(batch: Batch, times: int) -> Batch:
    """A minibatch several times along a further dimension, as `JointLearner.update` takes it."""
    return tree_map(lambda part: torch.stack([part] * times) if isinstance(part, torch.Tensor) else part, batch)


def eager_gradients(learner: JointLearner, batch: Batch) -> tuple[dict[str, list[torch.Tensor]], torch.Tensor]:
    """What a compiled learner would do if it were not compiled."""
    return learner.joint_gradients(learner._params_of(learner._roles), learner._params_of(learner._targets), {}, batch)


def ddpg(algorithm: str, others: str) -> maobs.JointConfig:
    config = small_config(algorithm)
    return config.training(other_agents_actions=others) if algorithm == "maddpg" else config


def per_network(views: list[torch.Tensor], stack: Stack) -> dict[str, dict[str, torch.Tensor]]:
    """A stack's gradient by name for each distinct network; a critic's first weight, in two parts, put together."""
    params = stack.unflatten(torch.cat(views))
    result: dict[int, tuple[str, dict[str, torch.Tensor]]] = {}
    for agent, name in enumerate(stack.names):
        own = stack.own(params, agent)
        if "from_state.weight" in own:
            first = torch.cat([own.pop("from_state.weight"), own.pop("from_action.weight")], dim=1)
            own = {"first.weight": first, **own}
        result.setdefault(own[next(reversed(own))].data_ptr(), (name, own))
    return dict(result.values())


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
ENTITY = {"actor": "entity", "critic": "entity", "critic_state": "world"}
NEAR = {"actor_settings": {"near": 0.2}, "critic_settings": {"near": 0.5}}
OTHERS = ("replay", "current", "joint")
CARRIED = "h and c stored"
# Algorithm, settings, further changes; the name of the case.
CASES: dict[str, tuple[str, dict[str, Any], list[Any]]] = {
    **{f"{a}, observations": (a, {}, []) for a in FAMILY},
    **{f"{a}, world": (a, {"critic_state": "world"}, []) for a in FAMILY if a != "iddpg"},
    **{f"maddpg, others' actions {o}": ("maddpg", {"other_agents_actions": o}, []) for o in ("current", "joint")},
    "maddpg-lstm": ("maddpg-lstm", {}, []),
    **{f"{a} with LSTM": (a, {"actor": "lstm"}, []) for a in ("iddpg", "maddpg-l", "facmac", "iql", "vdn", "qmix")},
    **{f"{a}, {CARRIED}": (a, {"actor": "lstm", "stored_state": True}, []) for a in ("maddpg-lstm", "facmac", "qmix")},
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
    f"maddpg-lstm, learned prey, {CARRIED}": ("maddpg-lstm", {"stored_state": True}, [learned_prey]),
    f"maddpg-lstm, one policy, {CARRIED}": ("maddpg-lstm", {"stored_state": True}, [one_policy]),
    **{f"maddpg, entities, {o}": ("maddpg", {**ENTITY, "other_agents_actions": o}, []) for o in OTHERS},
    **{f"{a}, entities": (a, ENTITY, []) for a in ("iddpg", "maddpg-l", "facmac")},
    **{f"{a}, entities": (a, {"actor": "entity"}, []) for a in ("iql", "vdn", "qmix")},
    **{f"{a}, entities, one policy": (a, ENTITY, [one_policy]) for a in (*FAMILY, "facmac")},
    **{f"{a}, entities, TD3": (a, {**ENTITY, **TD3}, []) for a in ("iddpg", "maddpg")},
    **{f"{a}, entities, discrete": (a, ENTITY, [discrete]) for a in ("maddpg-l", "facmac")},
    **{f"{a}, entities, learned prey": (a, ENTITY, [learned_prey]) for a in ("iddpg", "maddpg")},
    **{f"{a}, entities seen from near": (a, {**ENTITY, **NEAR}, []) for a in ("iddpg", "maddpg")},
    "maddpg, LSTM over entities seen from near": ("maddpg", {**ENTITY, **NEAR, "actor": "entity-lstm"}, []),
    "facmac own, entities": ("facmac", {**ENTITY, "critic_source": "own"}, []),
    "maddpg, LSTM over entities": ("maddpg", {**ENTITY, "actor": "entity-lstm"}, []),
    "qmix, LSTM over entities, one policy": ("qmix", {"actor": "entity-lstm"}, [one_policy]),
    "maddpg-l, learned prey with ids": ("maddpg-l", {"agent_id_input": True}, [learned_prey]),
}


def configured(case: str) -> maobs.JointConfig:
    algorithm, settings, changes = CASES[case]
    config = small_config(algorithm)
    if not config.uses_state:
        settings = {name: value for name, value in settings.items() if name != "critic_state"}
    config.training(**settings)
    for change in changes:
        change(config)
    return config


def compare(learner: JointLearner, batch: Batch, stage: str = "") -> None:
    """Losses and gradients of a learner equal those of the equations; says the role, agent and parameter if not."""
    want = Equations(learner).gradients(batch, stage)
    learner.stage = stage
    got, report = learner.gradients(batch)
    agents = len(learner.config.team.agents)
    for row, losses in ((0, want["critic_loss"]), (2, want["actor_loss"])):
        if losses:
            expected = losses if len(losses) == agents else losses * agents
            assert report[row].tolist() == pytest.approx(expected, rel=1e-8)
    assert set(got) == {role for role in ("actor", "critic", "mixer") if role in want}
    for role, gradient in got.items():
        networks = per_network(gradient, learner._roles[role])
        assert len(networks) == len(want[role])
        for (name, network_got), network_want in zip(networks.items(), want[role], strict=True):
            assert max(g.abs().max() for g in network_want) > 1e-5, f"{name} has no gradient to compare"
            for (parameter, g), w in zip(network_got.items(), network_want, strict=True):

                def where(message: str, what: str = f"{parameter} of {name} ({role} loss)") -> str:
                    return f"{what}: {message}"

                torch.testing.assert_close(g, w, rtol=1e-7, atol=1e-10, msg=where)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.usefixtures("double_precision")
def test_losses_and_gradients_equal_the_equations(make_learner: MakeLearner, case: str) -> None:
    learner = make_learner(configured(case))
    compare(learner, random_batch(learner.config, size=2 if "entities" in case else 12))


@pytest.mark.parametrize("source", ["shared", "others", "own"])
@pytest.mark.usefixtures("double_precision")
def test_facmac_learns_locally_before_its_mixer_starts(make_learner: MakeLearner, source: str) -> None:
    """Eq. 13 with the mixer standing still until `mixer_start`, eq. 14 from then on."""
    learner = make_learner(small_config("facmac").training(critic_source=source, mixer_start=1000))
    batch = random_batch(learner.config, size=12)
    compare(learner, batch, "local")
    mixer = learner._roles["mixer"].flat
    start = mixer.detach().clone()
    batches = repeated(batch, 1)
    for steps, moves in ((999, False), (1000, True)):
        learner.update(batches, timesteps={"num_env_steps_sampled_lifetime": steps}, _no_metrics_reduce=True)
        assert torch.equal(mixer, start) != moves
    # Adam's first step is one learning rate whichever stage it falls into: its clock did not run meanwhile.
    assert (mixer - start).abs().max().item() == pytest.approx(learner.config.critic_lr, rel=1e-3)
    compare(learner, batch)


@pytest.mark.parametrize(("algorithm", "others"), DDPG)
@pytest.mark.usefixtures("double_precision")
def test_twenty_updates_equal_the_equations(make_learner: MakeLearner, algorithm: str, others: str) -> None:
    learner = make_learner(ddpg(algorithm, others))
    equations = Equations(learner)
    start = learner.acting.flat.detach().clone()
    for seed in range(20):
        batch = random_batch(learner.config, size=4, seed=seed)
        learner.step(batch)
        equations.update(batch)
    assert (learner.acting.flat - start).abs().max() > 1e-3
    for agent, mid in enumerate(learner.config.module_ids):
        for kind, networks in equations.nets.items():
            for got, want in zip(leaves(getattr(learner.module[mid], kind)), networks[agent], strict=True):
                torch.testing.assert_close(
                    got, want, rtol=1e-7, atol=1e-9, msg=lambda m, k=kind, a=agent: f"{k} {a}: {m}"
                )


def test_critic_loss_moves_no_actor_and_actor_loss_no_critic(make_learner: MakeLearner) -> None:
    """With one role's learning rate at zero that role stands still, whatever the other one does."""
    for algorithm in ("maddpg", "facmac"):
        for frozen, moving in (("actor", "critic"), ("critic", "actor")):
            learner = make_learner(small_config(algorithm))
            before = {role: stack.flat.detach().clone() for role, stack in learner._roles.items()}
            learner.get_optimizer("__all_modules__", frozen).param_groups[0]["lr"] = 0.0
            learner.step(random_batch(learner.config))
            moved = {role for role, stack in learner._roles.items() if not torch.equal(stack.flat, before[role])}
            assert frozen not in moved and moving in moved
            assert ("mixer" in moved) == (algorithm == "facmac" and moving == "critic")


@pytest.mark.parametrize("algorithm", [*FAMILY, "maddpg-lstm", "facmac"])
def test_gradients_stay_in_their_role(make_learner: MakeLearner, algorithm: str) -> None:
    """The critic's gradient does not depend on the online actor, the actor's not on rewards or targets."""
    learner = make_learner(small_config(algorithm))
    batch = random_batch(learner.config)

    def flat(batch: Batch) -> dict[str, torch.Tensor]:
        return {role: torch.cat(views) for role, views in learner.gradients(batch)[0].items()}

    before = flat(batch)
    changed = flat(batch._replace(rewards=batch.rewards + 1.0))
    assert torch.equal(changed["actor"], before["actor"])
    assert not torch.equal(changed["critic"], before["critic"])
    learner.acting.flat.data.add_(0.1)
    assert torch.equal(flat(batch)["critic"], before["critic"])


@pytest.mark.parametrize("algorithm", [*FAMILY, "iql"])
def test_agents_do_not_leak_into_each_other(make_learner: MakeLearner, algorithm: str) -> None:
    """Agent 0's reward moves agent 0's critic and nobody else's."""
    learner = make_learner(small_config(algorithm))
    batch, critics = random_batch(learner.config), learner._roles["critic"]
    before = per_network(learner.gradients(batch)[0]["critic"], critics)
    rewards = batch.rewards.clone()
    rewards[:, 0] += 1.0
    after = per_network(learner.gradients(batch._replace(rewards=rewards))[0]["critic"], critics)
    same = {net: all(torch.equal(g, after[net][name]) for name, g in own.items()) for net, own in before.items()}
    assert list(same.values()) == [False, True, True], same


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_truncation_bootstraps_and_termination_does_not(make_learner: MakeLearner, algorithm: str) -> None:
    """Where the discount is 0 the target is the reward alone; elsewhere it moves with the target networks."""
    learner = make_learner(small_config(algorithm))
    target = learner._params_of(learner._targets)
    moved = {**target, "critic": {k: v + 0.05 for k, v in target["critic"].items()}}
    online = TeamNetworks(learner.parts, learner._params_of(learner._roles))
    for discount, depends in ((0.0, False), (0.9, True)):
        batch = random_batch(learner.config)
        batch = learner.prepare(batch._replace(discount=torch.full_like(batch.discount, discount)), {})
        losses = [learner.critic_loss(online, TeamNetworks(learner.target_parts, t), batch)[0] for t in (target, moved)]
        assert torch.equal(*losses) != depends


COMPILED = [*ALGORITHMS, "facmac own", "td3", "shared", "clipped", "normalised", "discrete", "prey"]
COMPILED += ["stored", "qmix stored", "entities"]


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
            "entities": lambda: one_policy(small_config("maddpg").training(**ENTITY, actor_lr=1e-4, critic_lr=1e-4)),
            "stored": lambda: small_config("maddpg-lstm").training(stored_state=True),
            "qmix stored": lambda: small_config("qmix").training(actor="lstm", stored_state=True),
        }[case]()

    eager = make_learner(config())
    # Half a minute of C++ for the most used; the others are traced alike, by another backend.
    backend = "inductor" if case in ("maddpg", "maddpg-lstm", "facmac", "entities") else "aot_eager"
    framework = {"torch_compile_learner": True, "torch_compile_learner_dynamo_backend": backend}
    compiled = make_learner(config().framework(**framework))
    for stacks, others in ((compiled._roles, eager._roles), (compiled._targets, eager._targets)):
        for role, stack in stacks.items():
            stack.flat.data.copy_(others[role].flat.data)
    for seed in range(100 if backend == "inductor" else 40):
        batch = random_batch(eager.config, seed=seed)
        if seed == 0 and eager.normalizers is not None:
            for learner in (eager, compiled):
                learner.update_normalizers(batch.now.window.transpose(1, 2).numpy())
        eager_report, compiled_report = eager.step(batch), compiled.step(batch)
    torch.testing.assert_close(compiled_report, eager_report, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(compiled.acting.flat, eager.acting.flat, rtol=1e-6, atol=1e-8)


def counted(learner: JointLearner) -> list[int]:
    """Counts the calls of a learner's critic loss from now on, in a list of one number."""
    calls, loss = [0], learner.critic_loss

    def critic_loss(*args: Any) -> Any:
        calls[0] += 1
        return loss(*args)

    learner.critic_loss = critic_loss  # type: ignore[method-assign]
    return calls


RECORDED: list[tuple[str, dict[str, Any], list[Any]]] = [
    ("maddpg", {**TD3, "policy_delay": 2}, []),
    ("maddpg-lstm", {"stored_state": True, "normalize_observations": True}, [learned_prey]),
    ("facmac", {"grad_clip": 0.5}, [discrete]),
    ("qmix", {"agent_id_input": True}, [two_policies]),
    ("maddpg", {**ENTITY, "other_agents_actions": "joint"}, [one_policy]),
]


@pytest.mark.parametrize("case", RECORDED, ids=lambda case: case[0])
def test_recorded_updates_are_the_same_to_the_bit(
    make_learner: MakeLearner, monkeypatch: pytest.MonkeyPatch, case: tuple[str, dict[str, Any], list[Any]]
) -> None:
    monkeypatch.setattr(update, "_RECORDED_AT", 2)
    algorithm, settings, changes = case
    learners, calls = [], []
    for recorded in (True, False):
        config = small_config(algorithm).training(**settings)
        for change in changes:
            change(config)
        learner = make_learner(config)
        learner.recorded = recorded  # type: ignore[misc]
        learners.append(learner)
        calls.append(counted(learner))
    for seed in range(6):
        batch = random_batch(learners[0].config, seed=seed)
        assert torch.equal(*(learner.step(batch) for learner in learners))
        for role, stack in learners[0]._roles.items():
            assert torch.equal(stack.flat, learners[1]._roles[role].flat)
    # Once as it is and once to be recorded, of each kind of update.
    assert calls == [[4 if "policy_delay" in settings else 2], [6]]


@pytest.mark.parametrize("kind", ["own", "said", "branching"])
def test_own_losses_are_recorded_only_if_their_class_says_so(
    make_learner: MakeLearner, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(update, "_RECORDED_AT", 2)

    class Own(MADDPGLearner):
        pass

    class Said(Own):
        recorded = True

    class Branching(Own):
        recorded = True

        def critic_loss(self, online: TeamNetworks, target: TeamNetworks, batch: Batch) -> Any:
            losses, q = super().critic_loss(online, target, batch)
            return (losses if bool(batch.rewards.mean() > 0) else 2.0 * losses), q  # which can't be recorded

    cls = {"own": Own, "said": Said, "branching": Branching}[kind]
    learner = make_learner(small_config("maddpg").learners(learner_class=cls))
    calls = counted(learner)
    for seed in range(4):
        learner.step(random_batch(learner.config, seed=seed))
    assert calls == [{"own": 4, "said": 2, "branching": 5}[kind]]


def test_learners_of_one_process_do_not_share_compiled_code(make_learner: MakeLearner) -> None:
    """Settings that leave all shapes as they are must not be taken over from the learner compiled first."""
    for others, temperature in (("replay", 1.0), ("current", 1.0), ("joint", 0.5)):
        config = discrete(small_config("maddpg"))
        config.training(other_agents_actions=others, gumbel_temperature=temperature, reward_scale=temperature)
        learner = make_learner(config.framework(torch_compile_learner=True))
        batch = random_batch(learner.config)
        compiled, _ = learner.gradients(batch)
        eager, _ = eager_gradients(learner, batch)
        for role, views in compiled.items():
            torch.testing.assert_close(views, eager[role], rtol=1e-4, atol=1e-5)


def test_every_batch_size_is_compiled_on_its_own(make_learner: MakeLearner) -> None:
    """Compiled code checks no sizes when it is called; other compilers than Inductor serve as well."""
    framework = {"torch_compile_learner": True, "torch_compile_learner_dynamo_backend": "aot_eager"}
    compiled = make_learner(small_config("maddpg").framework(**framework))
    for size in (32, 12):
        batch = random_batch(compiled.config, size=size)
        want, _ = eager_gradients(compiled, batch)
        for role, views in compiled.gradients(batch)[0].items():
            torch.testing.assert_close(views, want[role], rtol=1e-4, atol=1e-5)


def test_weights_that_another_thread_takes_are_from_between_updates(make_learner: MakeLearner) -> None:
    learner = make_learner(small_config("maddpg"))
    states = list[dict[str, Any]]()
    thread = threading.Thread(target=lambda: states.append(learner.get_state()))
    step = learner.step

    def slow(minibatch: Batch) -> torch.Tensor:
        if not thread.ident:
            thread.start()
        thread.join(0.05)
        return step(minibatch)

    learner.step = slow  # type: ignore[method-assign]
    learner.update(repeated(random_batch(learner.config), 3))
    thread.join()
    assert states[0]["progress"]["updates"] == 3


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
    learner.step(random_batch(learner.config))
    assert all(not torch.equal(m.actor.layers[0].weight, b) for m, b in zip(modules, before, strict=True))
    learner.module["agent_1"].set_state(learner.module["agent_2"].get_state())
    rows = learner.acting.params["0.layers.0.weight"]
    assert torch.equal(rows[1], rows[2])
    assert not torch.equal(rows[0], rows[1])


def test_agents_that_differ_are_stacked_by_group(make_learner: MakeLearner) -> None:
    """Predators and prey of different sizes: two groups of actors, one of critics, and no number that is nobody's."""
    learner = make_learner(learned_prey(small_config("maddpg")))
    assert len(set(learner.config.team.observation_sizes)) == 2
    groups = {role: {name.split(".")[0] for name in stack.shapes} for role, stack in learner._roles.items()}
    assert groups == {"actor": {"0", "1"}, "critic": {"0"}}  # a centralised critic sees the same of all
    for stack in learner._roles.values():
        assert stack.flat.numel() == sum(p.numel() for network in stack.networks for p in network.parameters())


def test_shared_parameters_are_stored_once(make_learner: MakeLearner) -> None:
    """One policy for all has a third of the parameters of three, in the stack as in the module."""
    own, shared = make_learner(small_config("maddpg")), make_learner(one_policy(small_config("maddpg")))
    assert 3 * shared.acting.flat.numel() == own.acting.flat.numel()
    assert sorted(shared.module.keys()) == ["all"]
    shared.step(random_batch(shared.config))
    torch.testing.assert_close(
        shared.module["all"].actor.layers[0].weight, shared.acting.params["0.layers.0.weight"][0]
    )


@pytest.mark.usefixtures("double_precision")
def test_agent_ids_tell_agents_with_shared_parameters_apart(make_learner: MakeLearner) -> None:
    """Same observation, same action: without ids all agents' Q and actions are equal, with ids they are not."""
    for ids in (False, True):
        learner = make_learner(one_policy(small_config("maddpg-l").training(agent_id_input=ids)))
        batch = random_batch(learner.config)
        start = 3 if ids else 0
        obs = batch.now.obs.clone()
        obs[..., start:] = obs[:, :1, start:]
        obs[..., :start] = torch.eye(3)[:, :start]
        same = batch.actions[:, :1].expand(-1, 3, -1)
        batch = learner.prepare(batch._replace(now=batch.now._replace(obs=obs), actions=same), {})
        online = TeamNetworks(learner.parts, learner._params_of(learner._roles))
        for values in (online.q(batch.now, batch.actions)[..., 0], online.outputs(batch.now)):
            assert torch.allclose(values[:, 0], values[:, 1]) != ids


def test_delayed_actors_and_targets_wait_for_their_turn(make_learner: MakeLearner) -> None:
    learner = make_learner(small_config("maddpg").training(policy_delay=3))
    moved = []
    for seed in range(7):
        before = [
            s.flat.detach().clone() for s in (learner.acting, learner._roles["critic"], learner._targets["critic"])
        ]
        report = learner.step(random_batch(learner.config, seed=seed))
        after = (learner.acting, learner._roles["critic"], learner._targets["critic"])
        moved.append(tuple(not torch.equal(b, s.flat) for b, s in zip(before, after, strict=True)))
        assert bool(report[2].any()) == moved[-1][0]
    assert moved == [(True,) * 3 if i % 3 == 0 else (False, True, False) for i in range(7)]


def test_delayed_actors_report_the_mean_of_their_own_updates(make_learner: MakeLearner) -> None:
    learner = make_learner(small_config("maddpg").training(policy_delay=2))
    batch = random_batch(learner.config)
    learner.config.tau = 1e-12
    for role in ("actor", "critic"):
        learner.get_optimizer("__all_modules__", role).param_groups[0]["lr"] = 0.0
    want = learner.gradients(batch)[1].mean(1)
    learner.update(repeated(batch, 4), _no_metrics_reduce=True)
    got = learner.report()
    for row, name in enumerate(("critic_loss", "q_mean", "actor_loss")):
        means = [got[mid][name].peek() for mid in learner.config.module_ids]
        assert sum(means) / 3 == pytest.approx(want[row].item(), rel=1e-5)


@pytest.mark.parametrize("by", ["global_norm", "norm", "value"])
def test_gradients_are_clipped_by_network(make_learner: MakeLearner, by: str) -> None:
    free = make_learner(small_config("maddpg"))
    batch = random_batch(free.config)
    critics = free._roles["critic"]
    whole = per_network(free.gradients(batch)[0]["critic"], critics)
    norms = [torch.cat([g.flatten() for g in network.values()]).norm() for network in whole.values()]
    limit = float(sorted(norms)[1]) if by == "global_norm" else 1e-2  # clips some networks, not all
    clipped = make_learner(small_config("maddpg").training(grad_clip=limit, grad_clip_by=by))
    for role, stack in clipped._roles.items():
        stack.flat.data.copy_(free._roles[role].flat.data)
        clipped._targets[role].flat.data.copy_(free._targets[role].flat.data)
    got = critics.unflatten(torch.cat(clipped.gradients(batch)[0]["critic"]))
    want = critics.unflatten(torch.cat(free.gradients(batch)[0]["critic"]))
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
        learner.update_normalizers(part.numpy())
    batch = random_batch(learner.config)
    moments = {"now": batch.now._replace(obs=obs[0].clone()), "next": batch.next._replace(obs=obs[0].clone())}
    batch = learner.prepare(batch._replace(**moments), learner.normalizers.params)
    mean, std = obs.flatten(0, 1).mean(0), obs.flatten(0, 1).std(0, correction=0)
    want = ((obs[0] - mean) / std.clamp(min=1e-2)).clamp(-10, 10) * present
    torch.testing.assert_close(batch.now.obs, want, rtol=1e-4, atol=1e-5)
    size = team.observation_sizes[-1]
    module = learner.module[learner.config.module_ids[-1]]
    acted = module.forward_inference({"obs": obs[0, :, -1, :size]})["actions"]
    online = TeamNetworks(learner.parts, learner._params_of(learner._roles))
    torch.testing.assert_close(acted, torch.tanh(online.outputs(batch.now))[:, -1])


def test_a_learning_rate_schedule_is_followed(make_learner: MakeLearner) -> None:
    learner = make_learner(small_config("iddpg").training(actor_lr=[[0, 1e-3], [100, 0.0]]))
    batch = random_batch(learner.config)
    learner.update(repeated(batch, 1), _no_metrics_reduce=True)
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
            learner.step(random_batch(learner.config, seed=seed))
        assert (learner.acting.flat - start).abs().max() > 1e-3
        actors.append(learner.acting.flat.detach())
    for actor in actors:
        torch.testing.assert_close(actor, actors[0], rtol=1e-7, atol=1e-9)


def test_no_denormal_numbers_gather_in_adam(make_learner: MakeLearner) -> None:
    """Means that decay end as zero, not as numbers that Intel's processors are slow with; other code is unchanged."""
    learner = make_learner(small_config("maddpg"))
    batch = random_batch(learner.config)
    # From some of the observations' weights there is no gradient.
    batch = batch._replace(now=batch.now._replace(obs=batch.now.obs * (torch.arange(18) < 10)))
    for role, stack in learner._roles.items():
        learner._adam._optimizers[role].state[stack.flat]["exp_avg"].fill_(1.3e-38)
    learner.update(repeated(batch, 20), _no_metrics_reduce=True)
    smallest = torch.finfo(torch.float32).tiny
    for role, stack in learner._roles.items():
        means = learner._adam._optimizers[role].state[stack.flat]["exp_avg"].abs()
        assert (means == 0).any() and not ((means > 0) & (means < smallest)).any()
    assert torch.tensor(smallest) * 0.5 > 0


def test_means_are_cleaned_where_several_threads_compute(make_learner: MakeLearner) -> None:
    """The processor's mode is that of one thread; a run that goes on from a state is cleaned at the same updates."""
    learner = make_learner(small_config("maddpg"))
    batch = random_batch(learner.config)
    batch = batch._replace(now=batch.now._replace(obs=batch.now.obs * (torch.arange(18) < 10)))
    states = [learner._adam._optimizers[role].state[stack.flat] for role, stack in learner._roles.items()]

    def denormals() -> int:
        means = torch.cat([state[name] for state in states for name in ("exp_avg", "exp_avg_sq")]).abs()
        return int(((means > 0) & (means < torch.finfo(torch.float32).tiny)).sum())

    for state in states:
        state["exp_avg"].fill_(1e-39)
    learner._updates_lifetime = 98
    torch.set_num_threads(2)
    try:
        learner.step(batch)
        assert denormals() > 100
        learner.step(batch)
        assert denormals() == 0
    finally:
        torch.set_num_threads(1)
    assert all((state["exp_avg"] != 0).sum() > 1000 for state in states)


def test_a_state_in_another_layout_is_refused(make_learner: MakeLearner) -> None:
    """Its numbers would fit, and be those of other parameters."""
    learner = make_learner(small_config("maddpg"))
    state = learner.get_state()
    learner.set_state(state)
    del state["progress"]["layout"]
    with pytest.raises(ValueError, match=r"saved by an earlier revision.*layout 1, here 3.*RLModule\.from_checkpoint"):
        learner.set_state(state)
