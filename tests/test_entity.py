"""Entity networks: what a permutation changes (nothing), teams of another size, refusals, the way out of a checkpoint.

Their losses and gradients are held against loops in test_learner.py.
"""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mpe2 import simple_spread_v3
from ray import tune
from ray.rllib.core.rl_module.rl_module import RLModule
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner
from torch import Tensor

import rllib_maobs as maobs
from rllib_maobs.layout import Entities, Layout, split
from rllib_maobs.modules import EntityActor, EntityCritic, EntityLSTMActor
from rllib_maobs.modules.entity import Edge, squashed
from tests.conftest import small_config

OBSERVATION: Layout = (
    Entities("self", 1, 4),
    Entities("target", 3, 2, 2),
    Entities("obstacle", 2, 2, 2),
    Entities("agent", 2, 2, 2),
)
STATE: Layout = (Entities("agent", 3, 4, 2), Entities("obstacle", 2, 2, 2), Entities("target", 3, 2, 2))
ENTITY: dict[str, Any] = {"actor": "entity", "critic": "entity", "critic_state": "world"}


def permuted(layout: Layout, vector: Tensor, name: str, order: list[int]) -> Tensor:
    groups = split(layout, vector)
    groups[name] = groups[name][..., order, :]
    return torch.cat([group.flatten(-2) for group in groups.values()], dim=-1)


@pytest.mark.parametrize(("name", "order"), [("target", [2, 0, 1]), ("obstacle", [1, 0]), ("agent", [1, 0])])
@pytest.mark.parametrize("near", [None, 0.2])
@pytest.mark.parametrize("actor", [EntityActor, EntityLSTMActor])
def test_permuting_what_an_agent_sees_changes_no_action(
    actor: type, near: float | None, name: str, order: list[int]
) -> None:
    torch.manual_seed(0)
    net = actor(OBSERVATION, 2, near=near).double()
    obs = torch.randn(50, 4, 18).double()
    other = permuted(OBSERVATION, obs, name, order)
    act = net.unroll if actor is EntityLSTMActor else lambda window: (net(window[:, -1]), None)
    torch.testing.assert_close(act(other)[0], act(obs)[0])
    changed = obs.clone()
    changed[..., 4:] += 0.1
    assert not torch.allclose(act(changed)[0], act(obs)[0])


def test_permuting_the_state_changes_no_value() -> None:
    """Targets and obstacles; other agents with their actions; and all agents, with whose value it is."""
    torch.manual_seed(0)
    joint: Layout = (Entities("agent", 3, 2),)
    net = EntityCritic(STATE, joint, 2, 3).double()
    state, action, agent = torch.randn(50, 22).double(), torch.randn(50, 6).double(), torch.eye(3).double()[0]
    value = net(state, action, agent)
    assert value.shape == (50, 2) and not torch.allclose(value[:, 0], value[:, 1])
    for name, order in (("target", [2, 0, 1]), ("obstacle", [1, 0])):
        torch.testing.assert_close(net(permuted(STATE, state, name, order), action, agent), value)
    for order, whose in (([0, 2, 1], 0), ([1, 2, 0], 2)):
        moved, acted = permuted(STATE, state, "agent", order), permuted(joint, action, "agent", order)
        torch.testing.assert_close(net(moved, acted, torch.eye(3).double()[whose]), value)
    assert not torch.allclose(net(state, permuted(joint, action, "agent", [0, 2, 1]), agent), value)


def test_directions_are_right_in_single_precision() -> None:
    """From 1e-8 to 100 away, with the absolute precision that numbers up to 2 have."""
    torch.manual_seed(0)
    offset = torch.randn(1000, 2) * 10.0 ** torch.linspace(-8, 2, 1000)[:, None]
    exact = offset.double()
    distance = (exact.square().sum(-1, keepdim=True) + 1e-12).sqrt()
    expected = torch.cat([exact / distance * 2.0 * torch.tanh(distance / 2.0), distance.clamp(max=4.0)], dim=-1)
    torch.testing.assert_close(squashed(offset).double(), expected, atol=1e-6, rtol=0.0)
    enlarged = torch.cat([expected, exact / (distance + 0.2)], dim=-1)
    torch.testing.assert_close(squashed(offset, near=0.2).double(), enlarged, atol=1e-6, rtol=0.0)


def test_nobody_around_is_heard_as_nothing() -> None:
    edge = Edge(2, 1, 3, 8)
    receiver = torch.randn(5, 1, 3)
    empty = edge(torch.randn(5, 1, 0, 2), torch.randn(5, 0, 1), receiver)
    torch.testing.assert_close(empty, edge.value.bias.expand(5, 1, 8))
    sender, offset = torch.randn(5, 4, 1), torch.randn(5, 1, 4, 2)
    absent = torch.tensor([[0.0, 1.0, 0.0, 1.0]])
    present = edge(offset[:, :, ::2], sender[:, ::2], receiver)
    torch.testing.assert_close(edge(offset, sender, receiver, absent), present)
    torch.testing.assert_close(edge(offset, sender, receiver, torch.ones(1, 4)), empty)


def test_far_off_things_and_speeds_do_not_blow_up() -> None:
    net = EntityCritic(STATE, (Entities("agent", 3, 2),), 1, 3)
    near, far = torch.randn(100, 22), 1e4 * torch.randn(100, 22)
    action, agent = torch.zeros(100, 6), torch.eye(3)[1]
    assert net(far, action, agent).abs().max() < 10 * net(near, action, agent).abs().max()


@pytest.mark.parametrize("num_agents", [1, 2, 6])
def test_a_trained_agent_acts_in_teams_of_any_size(ray_session: None, tmp_path: Path, num_agents: int) -> None:
    """Lifted out in three lines, with the layout of the other team; one that has none gets the module's own."""
    config = small_config("maddpg").training(**ENTITY, actor_settings={"near": 0.2})
    config.multi_agent(policies={"all"}, policy_mapping_fn=lambda agent, *a, **k: "all")
    algo = config.build_algo()
    algo.train()
    path = f"{algo.save_to_path(tmp_path / 'checkpoint')}/learner_group/learner/rl_module/all"
    module = RLModule.from_checkpoint(path)
    env = maobs.make_vec("spread-3a", num_envs=2, num_agents=num_agents)
    obs, _ = env.reset(seed=0)
    other = module.for_layout(env.observation_layouts[env.agents[0]])
    actions = other.forward_inference({"obs": obs.reshape(2 * num_agents, -1)})["actions"]
    assert actions.shape == (2 * num_agents, 5) and actions.isfinite().all()
    same = module.for_layout(module.actor.layout).forward_inference({"obs": obs.reshape(-1)[:18][None]})["actions"]
    torch.testing.assert_close(same, module.forward_inference({"obs": obs.reshape(-1)[:18][None]})["actions"])
    algo.stop()


def test_an_mlp_has_one_team_size(ray_session: None) -> None:
    algo = small_config("maddpg").build_algo()
    layout = maobs.make_vec("spread-6a").observation_layouts["agent_0"]
    with pytest.raises(
        ValueError, match=r"MLPActor .* has parameters of other shapes for .*: those of entity networks dep"
    ):
        algo.get_module("agent_0").for_layout(layout)
    algo.stop()


@pytest.mark.parametrize("actor", ["entity", "entity-lstm"])
def test_it_works_in_rllibs_own_runner(ray_session: None, actor: str) -> None:
    config = small_config("maddpg", horizon=7).training(**{**ENTITY, "actor": actor})
    config.validate()
    config.env_runner_cls = MultiAgentEnvRunner
    runner = MultiAgentEnvRunner(config=config, worker_index=0)
    episode = runner.sample(num_episodes=1, explore=False)[0].agent_episodes["agent_1"]
    module = runner.module["agent_1"]
    state = {k: v[None] for k, v in module.get_initial_state().items()}
    for t in range(7):
        out = module.forward_inference({"obs": episode.get_observations(t)[None], "state_in": state})
        np.testing.assert_allclose(episode.get_actions(t), out["actions"][0].numpy(), atol=1e-5)
        state = out.get("state_out", {})


@pytest.mark.parametrize(
    "scenario", ["spread-6a", "tunnel", "simple-tunnel", "simple-tunnel-6a", "obstacle-predator-prey"]
)
@pytest.mark.parametrize("algorithm", ["maddpg", "iddpg"])
def test_every_task_takes_them(ray_session: None, scenario: str, algorithm: str) -> None:
    config = small_config(algorithm).training(actor="entity", critic="entity")
    if config.uses_state:
        config.training(critic_state="world")
    env_config = {"prey": "learned"} if "prey" in scenario else {}
    algo = config.environment(f"maobs/{scenario}", env_config=env_config).build_algo()
    assert algo.train()["learners"]["__all_modules__"]["num_updates_lifetime"] == 24
    algo.stop()


def test_a_users_own_environment_says_it_in_the_config(ray_session: None) -> None:
    tune.register_env("mpe2_entities", lambda _: simple_spread_v3.parallel_env(continuous_actions=True, max_cycles=8))
    groups = [("self", 1, 4), ("target", 3, 2, 2), ("agent", 2, 2, 2), ("message", 2, 2)]
    config = small_config("iddpg").environment("mpe2_entities").training(actor="entity", critic="entity")
    with pytest.raises(ValueError, match=r"Entity networks need an observation .* observation_layouts"):
        config.build_algo()
    config.training(observation_layouts={f"agent_{i}": groups for i in range(3)})
    algo = config.build_algo()
    assert [name for name, _ in algo.get_module("agent_0").actor.ego.edges.items()] == ["of_target", "of_agent"]
    algo.train()
    algo.stop()


class Blind(maobs.MAObsEnv):
    """A world state that says nothing of its parts."""

    state_layout = None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: c.training(critic_state="observations"),
            r"needs a state whose first groups are the 3 agents.*world",
        ),
        (
            lambda c: c.training(state_layout=[("agent", 2, 4, 2), ("rest", 7, 2, 2)]),
            r"needs a state whose first groups are the 3 agents, with a position",
        ),
        (lambda c: c.training(state_layout=[("agent", 3, 4, 2)]), r"adds up to 3 x 4 \(agent\) = 12 numbers, .* 22"),
        (lambda c: c.training(observation_layouts={"agent_0": [("self", -1, 4)]}), r"a count >= 0"),
        (
            lambda c: c.training(observation_layouts={"agent_0": [("self", 1, 18)]}),
            r"say|need an observation that says",
        ),
        (lambda c: c.training(actor_settings={"edge": 0}), r"EntityActor: edge=0 is illegal; legal: an integer >= 1"),
        (
            lambda c: c.training(critic_settings={"near": 0}),
            r"EntityCritic: near=0 is illegal; legal: a number > 0 or None",
        ),
    ],
)
def test_layouts_that_do_not_do_are_refused(ray_session: None, change: Any, message: str) -> None:
    config = small_config("maddpg").training(**ENTITY)
    change(config)
    with pytest.raises(ValueError, match=message):
        config.build_algo()


def test_groups_of_any_names_have_networks_of_their_own() -> None:
    """Names that differ in a dot, a hyphen or the word between two names are still two."""
    for names in (("a.b", "a-b"), ("a-_b", "a.b"), ("a_from_b", "a"), ("x-f", "xfrom")):
        layout = (Entities("self", 1, 4), *(Entities(name, 2, 3, 2) for name in names), Entities("agent", 2, 2, 2))
        net, x = EntityActor(layout, 2), torch.randn(1, 4 + 2 * 6 + 4)
        assert len(net.ego.edges) == 3 and len(net.ego.heard) == 2
        before = net(x)
        for index in (6, 12):  # the third number of each group
            other = x.clone()
            other[:, index] += 1.0
            assert not torch.equal(before, net(other))


def test_an_observation_of_places_alone() -> None:
    layout = (Entities("target", 3, 2, 2), Entities("agent", 2, 2, 2))
    x = torch.randn(5, 10)
    net = EntityActor(layout, 2)
    assert net(x).shape == (5, 2)
    torch.testing.assert_close(net(permuted(layout, x, "target", [2, 0, 1])), net(x))
    critic = EntityCritic(layout, (Entities("action", 1, 2),))
    assert critic(x, torch.randn(5, 2)).shape == (5, 1)


@pytest.mark.parametrize("setting", [{"agents": None}, {"agents": "agent"}, {"deaf": [1]}, {"deaf": 5}])
def test_what_does_not_name_groups_is_refused(setting: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="is illegal; legal: a list of names of groups"):
        EntityActor(OBSERVATION, 2, **setting)


def test_a_layout_of_tuples_will_do_for_another_team(ray_session: None) -> None:
    algo = small_config("maddpg").training(**ENTITY).build_algo()
    module = algo.get_module("agent_0")
    other = module.for_layout([("self", 1, 4), ("target", 0, 2, 2), ("obstacle", 1, 2, 2), ("agent", 0, 2, 2)])
    assert other.forward_inference({"obs": torch.zeros(3, 6)})["actions"].shape[0] == 3
    with pytest.raises(ValueError, match="legal is a list of groups"):
        module.for_layout(5)
    algo.stop()


def test_spaces_stay_vectors(ray_session: None) -> None:
    """Entity networks need nothing of an environment but its layout."""
    config = small_config("maddpg").training(**ENTITY)
    config.validate()
    assert all(isinstance(space, gym.spaces.Box) for space in config.team.observation_spaces)
