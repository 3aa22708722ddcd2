"""What users' networks may do: stacked, they compute and learn what each would alone, or are refused by name."""

from typing import Any

import pytest
import torch
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from torch import Tensor, nn

import rllib_maobs as maobs
from rllib_maobs.layout import layout_size
from rllib_maobs.learner import TeamNetworks
from rllib_maobs.modules.stack import PerAgent, Stack
from tests.conftest import build_learner, random_batch, small_config


class Linear(maobs.Actor):
    """The least that an actor can be; what follows differs from it in one way."""

    def __init__(self, layout: maobs.Layout, num_outputs: int, scale: Any = 1.0) -> None:
        super().__init__(layout, num_outputs)
        self.layer, self.scale = nn.Linear(layout_size(layout), num_outputs), scale

    def forward(self, observation: Tensor) -> Tensor:
        return self.scale * self.layer(observation)


class Private(Linear):
    def __init__(self, layout: maobs.Layout, num_outputs: int, scale: Any = 1.0) -> None:
        super().__init__(layout, num_outputs)
        self._scale = scale

    def forward(self, observation: Tensor) -> Tensor:
        return self._scale * self.layer(observation)


class Scale(nn.Module):
    def __init__(self, by: Any) -> None:
        super().__init__()
        self.by = by

    def forward(self, x: Tensor) -> Tensor:
        return self.by * x


class Nested(Linear):
    def __init__(self, layout: maobs.Layout, num_outputs: int, scale: Any = 1.0) -> None:
        super().__init__(layout, num_outputs)
        self.layer = nn.Sequential(self.layer, Scale(scale))


class Times:
    """A setting without a `repr` or an equality of its own."""

    def __init__(self, by: float) -> None:
        self.by = by

    def __mul__(self, x: Tensor) -> Tensor:
        return self.by * x


class Frozen(Linear):
    def __init__(self, layout: maobs.Layout, num_outputs: int) -> None:
        super().__init__(layout, num_outputs)
        self.fixed = nn.Parameter(torch.randn(num_outputs), requires_grad=False)
        self.factor = nn.Parameter(torch.tensor(2.0))

    def forward(self, observation: Tensor) -> Tensor:
        return self.factor * self.layer(observation) + self.fixed


class Doubled(maobs.MLPCritic):
    """Overrides `forward` of a critic that splits."""

    def forward(self, state: Tensor, action: Tensor, agent: Tensor | None = None) -> Tensor:
        return 2.0 * super().forward(state, action, agent)


class Helper(maobs.Critic):
    """Has a method that happens to be called encode."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.layer = nn.Linear(layout_size(self.state_layout) + layout_size(self.action_layout), self.num_critics)

    def encode(self, state: Tensor) -> Tensor:
        return torch.tanh(state)

    def forward(self, state: Tensor, action: Tensor, agent: Tensor | None = None) -> Tensor:
        return self.layer(torch.cat([self.encode(state), action], -1))


class Restless(maobs.LSTMActor):
    """Overrides `forward`, which the fast `unroll` does not call."""

    def forward(self, observation: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        output, state = super().forward(observation, state)
        return output + 1.0, 0.5 * state


def specs(**model_configs: dict[str, Any]) -> MultiRLModuleSpec:
    return MultiRLModuleSpec(
        rl_module_specs={policy: RLModuleSpec(model_config=own) for policy, own in model_configs.items()}
    )


@pytest.mark.parametrize("actor", [Linear, Private, Nested])
@pytest.mark.parametrize("scales", [(1.0, 3.0), (Times(1.0), Times(3.0))])
def test_agents_with_other_settings_compute_with_their_own(ray_session: None, actor: type, scales: Any) -> None:
    """Whatever keeps the setting; a stack of alike networks has one code, so those that differ form another."""
    config = small_config("maddpg").training(actor=actor, actor_settings={"scale": scales[0]}, tau=1.0)
    config.rl_module(rl_module_spec=specs(agent_1={"actor_settings": {"scale": scales[1]}}))
    learner = build_learner(config)
    batch = random_batch(learner.config)
    outputs = TeamNetworks(learner.parts, learner._params_of(learner._roles)).outputs(batch.now)
    for agent in range(3):
        own = learner.module[f"agent_{agent}"].actor(batch.now.obs[:, agent])
        torch.testing.assert_close(outputs[:, agent], own)
    learner.step(batch)
    for agent in range(3):  # tau = 1: each target is its own online network, and no other
        module = learner.module[f"agent_{agent}"]
        for online, target in zip(module.actor.parameters(), module.target_actor.parameters(), strict=True):
            assert torch.equal(online, target)


def test_constants_stay_and_scalars_learn(ray_session: None) -> None:
    config = small_config("maddpg").training(actor=Frozen, grad_clip=0.5)
    learner = build_learner(config)
    before = {n: p.detach().clone() for n, p in learner.module["agent_0"].actor.named_parameters()}
    learner.step(random_batch(learner.config))
    moved = {n: not torch.equal(p, before[n]) for n, p in learner.module["agent_0"].actor.named_parameters()}
    assert moved == {"fixed": False, "factor": True, "layer.weight": True, "layer.bias": True}


@pytest.mark.parametrize("critic", [Doubled, Helper])
def test_an_overridden_forward_counts(ray_session: None, critic: type) -> None:
    learner = build_learner(small_config("maddpg").training(critic=critic))
    batch = learner.prepare(random_batch(learner.config), {})
    q = TeamNetworks(learner.parts, learner._params_of(learner._roles)).q(batch.now, batch.actions)
    own = learner.module["agent_2"].critic(batch.now.state, batch.actions.flatten(1))
    torch.testing.assert_close(q[:, 2], own)


def test_an_overridden_step_of_a_recurrent_actor_counts(ray_session: None) -> None:
    learner = build_learner(small_config("maddpg-lstm").training(actor=Restless))
    now = random_batch(learner.config).now
    outputs = TeamNetworks(learner.parts, learner._params_of(learner._roles)).outputs(now)
    own = maobs.RecurrentActor.unroll(learner.module["agent_1"].actor, now.window[:, 1], now.mask)[0]
    torch.testing.assert_close(outputs[:, 1], own, rtol=1e-4, atol=1e-5)


def test_values_are_those_of_what_is_asked(ray_session: None) -> None:
    """Another state of the same moment, or all pairs after each one's own: no value is taken from the one before."""
    learner = build_learner(small_config("iddpg"))
    batch = random_batch(learner.config, size=3)  # as many rows as agents
    nets = TeamNetworks(learner.parts, learner._params_of(learner._roles))
    q = nets.q(batch.now, batch.actions)
    torch.testing.assert_close(nets.cross_q(batch.now, batch.actions).diagonal(dim1=1, dim2=2).mT, q)
    fresh = TeamNetworks(learner.parts, learner._params_of(learner._roles))
    mirrored = batch.now._replace(obs=-batch.now.obs)
    torch.testing.assert_close(nets.q(mirrored, batch.actions), fresh.q(mirrored, batch.actions))
    assert not torch.allclose(nets.q(mirrored, batch.actions), q)


class Same(nn.Module):
    """Depends on no input of its agent's and on no parameter."""

    def __init__(self) -> None:
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))

    def forward(self, x: Tensor) -> Tensor:
        return x[..., :2]


@pytest.mark.parametrize("rows", [2, 3])
def test_what_depends_on_no_agent_has_agents_in_the_second_dimension(rows: int) -> None:
    from rllib_maobs.modules import Shared

    stack, x = Stack([Same(), Same()]), torch.randn(rows, 4)
    want = x[:, None, :2].expand(rows, 2, 2)
    torch.testing.assert_close(stack(stack.params, Shared(x)), want)
    torch.testing.assert_close(stack(stack.params, PerAgent(x[:, None].expand(rows, 2, 4))), want)


class Hidden(Linear):
    def __init__(self, layout: maobs.Layout, num_outputs: int) -> None:
        super().__init__(layout, num_outputs)
        self.more = [nn.Linear(num_outputs, num_outputs)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"actor": Hidden}, r"the actor of agent_0 \(Hidden\) can't be stacked: its attribute 'more' hides tensors or"),
        ({"actor": Linear, "actor_settings": {"scale": torch.ones(5)}}, r"its attribute 'scale' hides tensors"),
        ({"actor": "entity", "normalize_observations": True}, "normalize_observations must be False with EntityActor"),
        ({"exploration": maobs.OrnsteinUhlenbeck}, "exploration must be a dict of settings by name"),
    ],
)
def test_what_would_be_silently_wrong_is_refused(ray_session: None, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small_config("maddpg").training(**change).build_algo()


def test_policies_differ_in_their_networks_alone(ray_session: None) -> None:
    config = small_config("maddpg-lstm").rl_module(rl_module_spec=specs(agent_1={"seq_length": 2}))
    with pytest.raises(
        ValueError, match="RLModuleSpec of policy 'agent_1' sets 'seq_length'; legal are hidden_sizes, "
    ):
        config.build_algo()


def test_a_state_of_other_shares_is_refused(ray_session: None) -> None:
    """The same shapes, but the second policy is another agent's: Adam's numbers would be those of other parameters."""

    def learner(policies: list[str]) -> Any:
        def mapping(agent: str, *args: Any, **kwargs: Any) -> str:
            return policies[int(agent[-1])]

        return build_learner(small_config("maddpg").multi_agent(policies={"a", "b"}, policy_mapping_fn=mapping))

    state = learner(["a", "b", "a"]).get_state()
    with pytest.raises(ValueError, match="of agents that share them otherwise"):
        learner(["b", "a", "a"]).set_state(state)


@pytest.mark.parametrize(("losses", "what"), [("mean", r"\(\)"), ("rows", r"\(16,\)")])
def test_losses_of_another_shape_are_refused(ray_session: None, losses: str, what: str) -> None:
    class Odd(maobs.MADDPGConfig.learner):
        def critic_loss(self, *args: Any) -> Any:
            own, q = super().critic_loss(*args)
            return (own.mean() if losses == "mean" else q.mean(1)), q

    learner = build_learner(small_config("maddpg").learners(learner_class=Odd))
    with pytest.raises(ValueError, match=rf"Odd.critic_loss must return losses of shape \(3,\) or \(1,\), not {what}"):
        learner.step(random_batch(learner.config, size=16))
