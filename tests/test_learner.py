"""Losses, gradients and updates against the loop-over-agents reference; routing; compiled against eager."""

from collections.abc import Callable, Iterator

import pytest
import torch

import rllib_maobs as maobs
from rllib_maobs.learner import JointLearner, Nets
from tests.conftest import ALGORITHMS, random_batch, small_config
from tests.reference import LoopLearner, whole_layers

MakeLearner = Callable[[maobs.JointConfig], JointLearner]
VARIANTS = [(name, "replay") for name in ALGORITHMS] + [("maddpg", "current"), ("maddpg", "joint")]


def variant(algorithm: str, others: str, critic_state: str = "observations") -> maobs.JointConfig:
    config = small_config(algorithm).training(critic_state=critic_state)
    return config.training(other_agents_actions=others) if algorithm == "maddpg" else config


def reference_of(learner: JointLearner) -> LoopLearner:
    config = learner.config
    team = config.team
    others = getattr(config, "other_agents_actions", "replay")
    sizes = (len(team.agents), team.observation_size, team.action_size, config.state_size)
    reference = LoopLearner(config.name, *sizes, others=others, gamma=config.gamma, tau=config.tau)
    reference.copy_from([learner.module[mid] for mid in config.module_ids])
    return reference


def per_agent(flat: torch.Tensor, stack: object) -> list[list[torch.Tensor]]:
    """A flat vector of a stack as a list of parameters for each agent."""
    params = stack.unflatten(flat)
    return [[value[i] for value in params.values()] for i in range(len(stack.networks))]


@pytest.fixture
def double_precision() -> Iterator[None]:
    """Adam blows single precision's rounding up within a few updates; in double precision equal stays equal."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("critic_state", ["observations", "world"])
@pytest.mark.parametrize(("algorithm", "others"), VARIANTS)
def test_losses_and_gradients_equal_the_reference(
    make_learner: MakeLearner, algorithm: str, others: str, critic_state: str
) -> None:
    learner = make_learner(variant(algorithm, others, critic_state))
    batch = random_batch(learner.config)
    reference = reference_of(learner)
    actor, critic, report = learner.gradients(
        Nets(learner.actors.params, learner.critics.params),
        Nets(learner.target_actors.params, learner.target_critics.params),
        batch,
    )
    actor_ref, critic_ref, actor_losses, critic_losses = reference.gradients(batch._asdict())
    assert report["actor_loss"].tolist() == pytest.approx(actor_losses, rel=1e-4, abs=1e-6)
    assert report["critic_loss"].tolist() == pytest.approx(critic_losses, rel=1e-4)
    critics = [whole_layers(gradient) for gradient in per_agent(critic, learner.critics)]
    for got, want in ((per_agent(actor, learner.actors), actor_ref), (critics, critic_ref)):
        for agent_got, agent_want in zip(got, want, strict=True):
            assert max(g.abs().max() for g in agent_want) > 1e-4  # there is a gradient to compare
            for g, w in zip(agent_got, agent_want, strict=True):
                torch.testing.assert_close(g, w, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("algorithm", "others"), VARIANTS)
@pytest.mark.usefixtures("double_precision")
def test_twenty_updates_equal_the_reference(make_learner: MakeLearner, algorithm: str, others: str) -> None:
    learner = make_learner(variant(algorithm, others))
    reference = reference_of(learner)
    start = learner.actors.flat.detach().clone()
    for seed in range(20):
        batch = random_batch(learner.config, seed=seed)
        learner.step(batch)
        reference.update(batch._asdict())
    assert (learner.actors.flat - start).abs().max() > 1e-3
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
    for frozen, moving in (("actor", "critic"), ("critic", "actor")):
        learner = make_learner(small_config("maddpg"))
        stacks = {"actor": learner.actors, "critic": learner.critics}
        before = {role: stack.flat.detach().clone() for role, stack in stacks.items()}
        learner.get_optimizer("__all_modules__", frozen).param_groups[0]["lr"] = 0.0
        learner.step(random_batch(learner.config))
        assert torch.equal(stacks[frozen].flat, before[frozen])
        assert not torch.equal(stacks[moving].flat, before[moving])


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_gradients_stay_in_their_role(make_learner: MakeLearner, algorithm: str) -> None:
    """The critic's gradient does not depend on the online actor, the actor's not on rewards or targets."""
    learner = make_learner(small_config(algorithm))
    batch = random_batch(learner.config)
    nets = Nets(learner.actors.params, learner.critics.params)
    target = Nets(learner.target_actors.params, learner.target_critics.params)
    actor, critic, _ = learner.gradients(nets, target, batch)
    other_actor = Nets({k: v + 0.1 for k, v in nets.actor.items()}, nets.critic)
    assert torch.equal(learner.gradients(other_actor, target, batch)[1], critic)
    other_rewards = batch._replace(rewards=batch.rewards + 1.0)
    changed = learner.gradients(nets, target, other_rewards)
    assert torch.equal(changed[0], actor)
    assert not torch.equal(changed[1], critic)


@pytest.mark.parametrize("algorithm", ["iddpg", "maddpg", "maddpg-l"])
def test_agents_do_not_leak_into_each_other(make_learner: MakeLearner, algorithm: str) -> None:
    """Agent 0's reward moves agent 0's critic and nobody else's."""
    learner = make_learner(small_config(algorithm))
    batch = random_batch(learner.config)
    nets = Nets(learner.actors.params, learner.critics.params)
    target = Nets(learner.target_actors.params, learner.target_critics.params)
    before = per_agent(learner.gradients(nets, target, batch)[1], learner.critics)
    rewards = batch.rewards.clone()
    rewards[:, 0] += 1.0
    after = per_agent(learner.gradients(nets, target, batch._replace(rewards=rewards))[1], learner.critics)
    same = [all(torch.equal(x, y) for x, y in zip(b, a, strict=True)) for b, a in zip(before, after, strict=True)]
    assert same == [False, True, True]


def test_truncation_bootstraps_and_termination_does_not(make_learner: MakeLearner) -> None:
    """Where terminated is 1 the target is the reward alone; elsewhere it moves with the target critic."""
    learner = make_learner(small_config("maddpg-l"))
    target = Nets(learner.target_actors.params, learner.target_critics.params)
    moved = Nets(target.actor, {k: v + 0.05 for k, v in target.critic.items()})
    for flag, depends in ((1.0, False), (0.0, True)):
        batch = random_batch(learner.config)
        batch = batch._replace(terminated=torch.full_like(batch.terminated, flag))
        losses = [learner.critic_loss(learner.critics.params, t, batch)[0] for t in (target, moved)]
        assert torch.equal(*losses) != depends


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_compiled_equals_eager_over_many_updates(make_learner: MakeLearner, algorithm: str) -> None:
    eager = make_learner(small_config(algorithm))
    compiled = make_learner(small_config(algorithm).framework(torch_compile_learner=True))
    for stack, other in ((compiled.actors, eager.actors), (compiled.critics, eager.critics)):
        stack.flat.data.copy_(other.flat.data)
    compiled.target_actors.flat.data.copy_(eager.target_actors.flat.data)
    compiled.target_critics.flat.data.copy_(eager.target_critics.flat.data)
    assert compiled.gradients is not compiled._gradients
    for seed in range(100):
        batch = random_batch(eager.config, seed=seed)
        eager_report, compiled_report = eager.step(batch), compiled.step(batch)
    for name, value in eager_report.items():
        torch.testing.assert_close(compiled_report[name], value, rtol=5e-3, atol=5e-3)
    torch.testing.assert_close(compiled.actors.flat, eager.actors.flat, rtol=1e-2, atol=5e-3)


def test_learners_of_one_process_do_not_share_compiled_code(make_learner: MakeLearner) -> None:
    """Settings that leave all shapes as they are must not be taken over from the learner compiled first."""
    for others, gamma in (("replay", 0.95), ("current", 0.95), ("joint", 0.5)):
        config = small_config("maddpg").training(other_agents_actions=others, gamma=gamma)
        learner = make_learner(config.framework(torch_compile_learner=True))
        nets = Nets(learner.actors.params, learner.critics.params)
        target = Nets(learner.target_actors.params, learner.target_critics.params)
        batch = random_batch(learner.config)
        for got, want in zip(
            learner.gradients(nets, target, batch)[:2], learner._gradients(nets, target, batch)[:2], strict=True
        ):
            torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-5)


def test_targets_start_equal_to_the_online_networks(ray_session: None) -> None:
    algo = small_config("maddpg").build_algo()
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
    rows = learner.actors.params["layers.0.weight"]
    assert torch.equal(rows[1], rows[2])
    assert not torch.equal(rows[0], rows[1])


def test_a_learning_rate_schedule_is_followed(make_learner: MakeLearner) -> None:
    learner = make_learner(small_config("iddpg").training(actor_lr=[[0, 1e-3], [100, 0.0]]))
    batches = random_batch(learner.config)
    learner.update(type(batches)(*(c[None] for c in batches)), _no_metrics_reduce=True)
    learner.report(timesteps={"num_env_steps_sampled_lifetime": 50})
    assert learner.get_optimizer("__all_modules__", "actor").param_groups[0]["lr"] == pytest.approx(5e-4)


@pytest.mark.usefixtures("double_precision")
def test_with_one_agent_all_algorithms_are_ddpg(make_learner: MakeLearner) -> None:
    """One agent's observation is the state and its action the joint action: the same numbers come out."""
    actors = []
    for algorithm in ALGORITHMS:
        learner = make_learner(small_config(algorithm, num_agents=1))
        start = learner.actors.flat.detach().clone()
        for seed in range(20):
            batch = random_batch(learner.config, seed=seed)
            learner.step(batch._replace(state=batch.obs.flatten(1), next_state=batch.next_obs.flatten(1)))
        assert (learner.actors.flat - start).abs().max() > 1e-3
        actors.append(learner.actors.flat.detach())
    for actor in actors:
        torch.testing.assert_close(actor, actors[0], rtol=1e-7, atol=1e-9)
