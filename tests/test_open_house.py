"""Everything that plugs in, plugged in from one file that the package knows nothing of."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
import torch
from ray.rllib.core.rl_module.rl_module import RLModule
from torch import Tensor, nn

import rllib_maobs as maobs
from rllib_maobs.envs import Bodies, Outcome, ScenarioOptions
from rllib_maobs.layout import Entities, layout_size, split
from rllib_maobs.learner import squared_error
from rllib_maobs.modules.stack import Stack
from rllib_maobs.options import Range

ROOT = Path(__file__).parent.parent


class HeadsActor(maobs.Actor):
    """A vote of H linear policies, in one parameter of three dimensions, after a LayerNorm."""

    def __init__(self, layout: maobs.Layout, num_outputs: int, heads: Annotated[int, Range(1)] = 3) -> None:
        super().__init__(layout, num_outputs)
        self.norm = nn.LayerNorm(layout_size(layout))
        self.heads = nn.Parameter(0.1 * torch.randn(heads, layout_size(layout), num_outputs))

    def forward(self, observation: Tensor) -> Tensor:
        return torch.einsum("...o,hoa->...ha", self.norm(observation), self.heads).mean(-2)


class GRUActor(maobs.RecurrentActor):
    """A minimal gated unit; its state is one vector."""

    def __init__(self, layout: maobs.Layout, num_outputs: int, width: int = 8) -> None:
        super().__init__(layout, num_outputs)
        self.width = width
        self.gate = nn.Linear(layout_size(layout) + width, width)
        self.new = nn.Linear(layout_size(layout) + width, width)
        self.out = nn.Linear(width, num_outputs)

    def initial_state(self) -> Tensor:
        return torch.full((self.width,), 0.5)

    def forward(self, observation: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        both = torch.cat([observation, state], dim=-1)
        keep = torch.sigmoid(self.gate(both))
        state = keep * state + (1.0 - keep) * torch.tanh(self.new(both))
        return self.out(state), state


class QuadraticCritic(maobs.Critic):
    """-|u - W s|^2 + v s: a critic that is no MLP, and sees entities by name."""

    def __init__(
        self, state_layout: maobs.Layout, action_layout: maobs.Layout, num_critics: int = 1, num_agents: int = 0
    ) -> None:
        super().__init__(state_layout, action_layout, num_critics, num_agents)
        self.best = nn.Linear(layout_size(state_layout), layout_size(action_layout))
        self.bias = nn.Linear(sum(group.size for group in state_layout), num_critics)

    def forward(self, state: Tensor, action: Tensor, agent: Tensor | None = None) -> Tensor:
        means = [part.mean(-2) for part in split(self.state_layout, state).values()]
        return self.bias(torch.cat(means, -1)) - (action - self.best(state)).square().sum(-1, keepdim=True)


class Sparks(maobs.Exploration):
    """Every tenth step of a copy its agents turn round; it counts the steps since the copy's reset."""

    def __init__(self, every: Annotated[int, Range(1)] = 10) -> None:
        self.every = every
        self.steps: Tensor | None = None

    def __call__(self, actions: Tensor, t: int, generator: torch.Generator | None = None) -> Tensor:
        if self.steps is None or len(self.steps) != len(actions):
            self.steps = torch.zeros(len(actions), dtype=torch.int64)
        self.steps += 1
        turn = (self.steps % self.every == 0).view(-1, *[1] * (actions.dim() - 1))
        noise = 0.1 * torch.randn(actions.shape, generator=generator)
        return torch.where(turn, -actions, actions + noise).clamp(-1.0, 1.0)

    def reset(self, mask: Tensor) -> None:
        if self.steps is not None:
            self.steps[mask] = 0

    def get_state(self) -> dict[str, Any]:
        return {"steps": None if self.steps is None else self.steps.tolist()}

    def set_state(self, state: dict[str, Any]) -> None:
        self.steps = None if state["steps"] is None else torch.tensor(state["steps"])


class CautiousLearner(maobs.JointLearner):
    """MADDPG-L whose targets are pulled down by a margin, with half of the critics' gradient."""

    def critic_loss(
        self, online: maobs.TeamNetworks, target: maobs.TeamNetworks, batch: maobs.Batch
    ) -> tuple[Tensor, Tensor]:
        next_q = target.q(batch.next, target.next_actions(batch)).amin(-1)
        y = (batch.rewards + batch.discount * next_q - self.config.margin).detach()
        q = online.q(batch.now, batch.actions)
        return squared_error(y, q), q[..., 0]

    def actor_loss(self, actions: Tensor, online: maobs.TeamNetworks, batch: maobs.Batch) -> Tensor:
        return -online.q(batch.now, actions)[..., 0].mean(0)

    def joint_gradients(self, *args: Any) -> Any:
        gradients, report = super().joint_gradients(*args)
        return {**gradients, "critic": [0.5 * part for part in gradients["critic"]]}, report


class CautiousConfig(maobs.JointConfig):
    """Configuration of the algorithm of one's own."""

    name = "cautious"
    critic_sees = ("state", "action")
    learner = CautiousLearner
    legal = {**maobs.JointConfig.legal, "margin": Annotated[float, Range(0.0)]}  # noqa: RUF012

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class)
        self.margin = 0.1


@dataclass(frozen=True)
class HomeOptions(ScenarioOptions):
    """Two agents, by default."""

    num_agents: int = 2


class Home(maobs.Scenario[HomeOptions]):
    """Meet at the origin."""

    options_class = HomeOptions
    metrics = {"distance": "mean"}  # noqa: RUF012

    def bodies(self) -> list[Bodies]:
        return [Bodies("agent", self.options.num_agents, radius=0.1, movable=True, accel=5.0, max_speed=1.0)]

    def place(self, rngs: Any) -> np.ndarray:
        return np.stack([rng.uniform(-1, 1, (self.options.num_agents, 2)) for rng in rngs])

    @property
    def observation_layout(self) -> maobs.Layout:
        return (Entities("velocity", 1, 2), Entities("home", 1, 2, 2))

    def observe(self, world: Any, out: np.ndarray) -> None:
        parts = split(self.observation_layout, out)
        parts["velocity"][..., 0, :], parts["home"][..., 0, :] = world.velocity, -world.position

    def outcome(self, world: Any) -> Outcome:
        distance = np.linalg.norm(world.position, axis=-1)
        return Outcome(-distance, (distance < 0.3).all(axis=1), {"distance": distance.mean(axis=1)})


PLUGS: dict[str, dict[str, Any]] = {
    "actor": {"actor": HeadsActor, "actor_settings": {"heads": 2}},
    "recurrent actor": {"actor": GRUActor, "seq_length": 3, "stored_state": True},
    "critic": {"critic": QuadraticCritic, "critic_state": "world"},
    "exploration": {"exploration": {"type": Sparks, "every": 7}},
    "ornstein-uhlenbeck": {"exploration": {"type": "ornstein-uhlenbeck", "theta": 0.3}},
    "algorithm": {},
    "scenario": {},
    "everything": {"actor": HeadsActor, "critic": QuadraticCritic, "exploration": {"type": Sparks}},
}


def config_of(plug: str, *, compiled: bool = False, shared: bool = False) -> maobs.JointConfig:
    """A configuration with one plug, or all of them."""
    config = CautiousConfig() if plug in ("algorithm", "everything") else maobs.MADDPGConfig()
    scenario = Home if plug in ("scenario", "everything") else "spread-3a"
    config.environment(maobs.MAObsEnv, env_config={"scenario": scenario, "horizon": 25})
    config.training(**PLUGS[plug], train_batch_size_per_learner=16, updates_per_env_step=0.05, critic_lr=1e-3)
    config.env_runners(num_envs_per_env_runner=4).reporting(min_sample_timesteps_per_iteration=1000)
    config.debugging(seed=0)
    if plug != "everything":  # whose networks have no such sizes
        config.rl_module(model_config={"hidden_sizes": (16, 16)})
    if shared:
        config.multi_agent(policies={"all"}, policy_mapping_fn=all_one)
    # Traced alike by another backend, without half a minute of C++ for each.
    backend = "inductor" if plug == "everything" else "aot_eager"
    return config.framework(torch_compile_learner=compiled, torch_compile_learner_dynamo_backend=backend)


def all_one(agent: str, *args: Any, **kwargs: Any) -> str:
    return "all"


def trained(plug: str, **how: Any) -> Any:
    algo = config_of(plug, **how).build_algo()
    for _ in range(2):
        algo.train()
    return algo


def weights(algo: Any) -> dict[str, Tensor]:
    return {role: stack.flat.detach().clone() for role, stack in algo._learner._roles.items()}


@pytest.mark.parametrize("plug", PLUGS)
def test_2000_steps_eager_and_compiled_are_the_same(ray_session: None, plug: str) -> None:
    eager, compiled = trained(plug), trained(plug, compiled=True)
    assert [callable(made.get_compiler_config) for made in compiled._learner._made.values()] == [True]
    assert eager._progress["env_steps"] == 2000 and eager._progress["updates"] == 99
    start = config_of(plug).build_algo()
    for role, want in weights(eager).items():
        torch.testing.assert_close(weights(compiled)[role], want, rtol=1e-2, atol=1e-3)
        assert (want - weights(start)[role]).abs().max() > 1e-2, f"{role} did not move"
    for algo in (eager, compiled, start):
        algo.stop()


@pytest.mark.parametrize("plug", ["actor", "recurrent actor", "critic", "everything"])
def test_agents_share_what_plugs_in(ray_session: None, plug: str) -> None:
    own, shared = config_of(plug).build_algo(), trained(plug, shared=True)
    for role, stack in shared._learner._roles.items():
        users = len(shared.config.team.agents)
        assert users * stack.flat.numel() == own._learner._roles[role].flat.numel()
    own.stop()
    shared.stop()


RESTORE = """
import json, sys
import torch
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.core.rl_module.rl_module import RLModule

import ray
ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
checkpoint, policy, size = sys.argv[1], sys.argv[2], int(sys.argv[3])
module = RLModule.from_checkpoint(f"{checkpoint}/learner_group/learner/rl_module/{policy}")
state = {name: value[None] for name, value in module.get_initial_state().items()}
obs = torch.linspace(-1, 1, size)[None]
alone = module.forward_inference({"obs": obs, "state_in": state})["actions"]
algo = Algorithm.from_checkpoint(checkpoint)
algo.train()
sums = {role: stack.flat.double().sum().item() for role, stack in algo._learner._roles.items()}
print(json.dumps({"alone": alone[0].tolist(), "sums": sums}))
"""


@pytest.mark.parametrize("plug", ["recurrent actor", "exploration", "everything"])
def test_what_plugs_in_goes_on_in_a_new_process(ray_session: None, tmp_path: Path, plug: str) -> None:
    """Restored there, it trains on exactly as here; one agent is lifted out and acts as here."""
    algo = trained(plug)
    path = algo.save_to_path(tmp_path / "checkpoint")
    settings = RLModule.from_checkpoint(f"{path}/learner_group/learner/rl_module/agent_0").model_config
    if "actor" in PLUGS[plug]:
        assert settings["actor"] == f"{__name__}:{PLUGS[plug]['actor'].__name__}"
    groups = maobs.SCENARIOS["spread-3a"][0]().observation_layout if plug != "everything" else Home().observation_layout
    assert settings["observation_layout"] == [list(group) for group in groups]
    size = algo.config.team.observation_size
    module = algo.get_module("agent_0")
    state = {name: value[None] for name, value in module.get_initial_state().items()}
    here = module.forward_inference({"obs": torch.linspace(-1, 1, size)[None], "state_in": state})["actions"]
    result = subprocess.run(
        [sys.executable, "-c", RESTORE, path, "agent_0", str(size)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0, result.stderr[-2000:]
    there = json.loads(result.stdout.splitlines()[-1])
    assert there["alone"] == pytest.approx(here[0].tolist(), abs=1e-6)
    algo.train()
    assert there["sums"] == {role: flat.double().sum().item() for role, flat in weights(algo).items()}
    algo.stop()


def test_every_policy_explores_with_its_own_settings(ray_session: None) -> None:
    overrides = {"agent_1": maobs.JointConfig.overrides(exploration={"epsilon": 0.0, "noise": 0.0})}
    config = config_of("actor").training(exploration={"epsilon": 1.0}, updates_per_env_step=0.0)
    algo = config.rl_module(algorithm_config_overrides_per_module=overrides).build_algo()
    algo.train()
    columns = algo.replay_buffer._columns
    rows = torch.from_numpy(algo.replay_buffer._next[: len(algo.replay_buffer)] >= 0)
    obs, actions = (columns[name][: len(algo.replay_buffer)][rows] for name in ("obs", "actions"))
    for agent, (noisy, quiet) in {0: (True, False), 1: (False, True), 2: (True, False)}.items():
        module = algo.get_module(f"agent_{agent}")
        distance = (actions[:, agent] - module.forward_inference({"obs": obs[:, agent]})["actions"]).abs()
        assert (distance.max() < 1e-5) == quiet and (distance.mean() > 0.2) == noisy
    algo.stop()


def test_noise_with_a_memory_forgets_at_an_episodes_end_and_is_saved(ray_session: None) -> None:
    algo = config_of("exploration").build_algo()
    runner = algo.env_runner
    runner.sample(num_timesteps=4 * 10)
    ((_, noise),) = runner.acting._explorations
    assert noise.steps.tolist() == [10] * 4
    state = runner.get_state()
    runner.sample(num_timesteps=4 * 20)
    assert noise.steps.tolist() == [5] * 4  # episodes have 25 steps
    runner.set_state(state)
    assert noise.steps.tolist() == [10] * 4
    algo.stop()


def test_compiled_code_keeps_the_python_values_that_a_loss_read(ray_session: None) -> None:
    """As `JointLearner` says: a setting that changes later is not seen; a stage of its own is."""

    class StagedLearner(CautiousLearner):
        def stage_at(self, env_steps: int) -> str:
            return "late" if env_steps >= 10 else ""

        def critic_loss(self, *args: Any) -> Any:
            losses, q = super().critic_loss(*args)
            return (losses * 2.0 if self.stage == "late" else losses), q

    learners = []
    for compiled in (False, True):
        config = config_of("algorithm", compiled=compiled)
        algo = config.learners(learner_class=StagedLearner).build_algo()
        algo.train()
        learners.append(algo._learner)
        batch = algo.replay_buffer.sample((16,), gamma=0.9)
    eager, frozen = learners
    frozen._roles["critic"].flat.data.copy_(eager._roles["critic"].flat)
    frozen._targets["critic"].flat.data.copy_(eager._targets["critic"].flat)
    for learner in learners:
        learner._targets["actor"].flat.data.copy_(eager._targets["actor"].flat)

    def losses(learner: Any, stage: str) -> Tensor:
        learner.stage = stage
        return learner.gradients(batch)[1][0]

    before = losses(eager, "late")
    torch.testing.assert_close(losses(frozen, "late"), before)
    torch.testing.assert_close(losses(frozen, ""), before / 2)
    for learner in learners:
        learner.config._is_frozen = False
        learner.config.margin = 5.0
    torch.testing.assert_close(losses(frozen, "late"), before)
    assert not torch.allclose(losses(eager, "late"), before)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"actor": HeadsActor, "actor_settings": {"head": 2}},
            "HeadsActor has no setting 'head' .*'heads'.*legal are heads",
        ),
        (
            {"actor": HeadsActor, "actor_settings": {"heads": 0}},
            "HeadsActor: heads=0 is illegal; legal: an integer >= 1",
        ),
        ({"actor_settings": {"heads": 2}}, "MLPActor has no setting 'heads'"),
        (
            {"actor": QuadraticCritic},
            "actor <class .*QuadraticCritic.* is illegal; legal are 'mlp', 'lstm', .*a subclass of",
        ),
        ({"actor": "tests.nowhere:A"}, "actor 'tests.nowhere:A' can't be imported: No module named 'tests.nowhere'"),
        ({"critic": "mpl"}, r"critic 'mpl' is illegal \(did you mean 'mlp'\?\)"),
        ({"exploration": {"type": Sparks, "every": 0}}, "Sparks: every=0 is illegal; legal: an integer >= 1"),
        (
            {"exploration": {"type": "gauss"}},
            "exploration 'gauss' is illegal; legal are 'epsilon-gaussian', 'ornstein-",
        ),
        ({"replay_buffer_capacity": 1e6}, "replay_buffer_capacity=1000000.0 is illegal; legal: an integer >= 1"),
    ],
)
def test_what_does_not_fit_is_refused(ray_session: None, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        maobs.MADDPGConfig().environment("maobs/spread-3a").training(**change).build_algo()


def test_what_is_not_defined_is_refused(ray_session: None) -> None:
    discrete = {"action_mode": "discrete"}
    for config, message in (
        (maobs.MADDPGConfig().training(target_noise=0.2), "target_noise must be 0.0 where actions are discrete"),
        (maobs.MADDPGConfig().training(exploration={"type": "ornstein-uhlenbeck"}), "not defined for discrete actions"),
        (maobs.QMIXConfig().training(critic=QuadraticCritic), "qmix has no critics, so it takes neither critic"),
    ):
        with pytest.raises(ValueError, match=message):
            config.environment("maobs/spread-3a", env_config=discrete).build_algo()

    class Plain(maobs.MADDPGConfig):
        name = "plain"
        supports = maobs.Supports(recurrent=False, parameter_sharing=False)

    with pytest.raises(ValueError, match="plain is not defined with recurrent actors; LSTMActor is one"):
        Plain().environment("maobs/spread-3a").training(actor="lstm").build_algo()
    shared = Plain().environment("maobs/spread-3a").multi_agent(policies={"all"}, policy_mapping_fn=all_one)
    with pytest.raises(ValueError, match="plain is not defined with shared policies; 'all' is that of"):
        shared.build_algo()


def test_an_algorithm_is_registered_under_its_name(ray_session: None) -> None:
    with pytest.raises(ValueError, match="Cannot register <class 'int'> as algorithm"):
        maobs.register_algorithm(int)  # type: ignore[arg-type]

    class Nameless(maobs.MADDPGConfig):
        pass

    with pytest.raises(ValueError, match="Nameless has no name of its own"):
        maobs.register_algorithm(Nameless)
    maobs.register_algorithm(CautiousConfig)
    try:
        assert maobs.ALGORITHMS["cautious"] is CautiousConfig
        algo = config_of("algorithm").build_algo()
        assert type(algo).__name__ == "Cautious" and isinstance(algo.get_default_config(), CautiousConfig)
        algo.stop()
    finally:
        from rllib_maobs.algorithms import registry

        registry._CONFIGS.pop("cautious"), registry._CLASSES.pop(CautiousConfig)


class Branching(HeadsActor):
    def forward(self, observation: Tensor) -> Tensor:
        return super().forward(observation) if observation.sum() > 0 else -super().forward(observation)


class TooLong(HeadsActor):
    def forward(self, observation: Tensor) -> Tensor:
        return super().forward(observation).repeat_interleave(2, -1)


@pytest.mark.parametrize(
    ("actor", "message"),
    [
        (
            Branching,
            r"the actor of agent_0 \(Branching\) can't be called for all agents at once by vmap",
        ),
        (TooLong, r"the actor of agent_0 \(TooLong\) must return 5 numbers .* not \(3, 3, 10\)"),
    ],
)
def test_a_network_that_does_not_do_is_named_before_training(ray_session: None, actor: type, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        maobs.MADDPGConfig().environment("maobs/spread-3a").training(actor=actor).build_algo()


def test_a_network_that_cannot_be_stacked_is_named() -> None:
    normed = [nn.Sequential(nn.Linear(2, 2), nn.BatchNorm1d(2))]
    with pytest.raises(ValueError, match=r"the actor of left \(Sequential\) can't be stacked: .*running_mean"):
        Stack(normed, names=["the actor of left"])
    with pytest.raises(ValueError, match=r"the actor of left \(Identity\) can't be stacked: it has no parameters"):
        Stack([nn.Identity()], names=["the actor of left"])
    mixed = nn.ModuleList([nn.Linear(2, 2), nn.Linear(2, 2).double()])
    with pytest.raises(ValueError, match="must be of one type"):
        Stack([mixed])
