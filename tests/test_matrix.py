"""Algorithms, environments and settings in pairs: every two that go together train, others say why they do not."""

import itertools
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from ray.rllib.env.multi_agent_env import MultiAgentEnv

import rllib_maobs as maobs
from rllib_maobs.algorithms import support_table
from tests.conftest import ALGORITHMS


class TeamOfTwo(MultiAgentEnv):
    """Two agents of different sizes with one reward for both; from step `apart_at` on they are paid differently."""

    def __init__(self, config: dict[str, Any]) -> None:
        super().__init__()
        self.config = dict(config)
        self.possible_agents = self.agents = ["small", "large"]
        sizes = {"small": 2, "large": 3}
        self.observation_spaces = {a: Box(-1.0, 1.0, (n,), np.float32) for a, n in sizes.items()}
        self.action_spaces = {
            a: Discrete(n) if self.config.get("discrete") else Box(-1.0, 1.0, (n,), np.float32)
            for a, n in sizes.items()
        }
        self.steps = 0

    def _obs(self) -> dict[str, Any]:
        return {a: space.sample() for a, space in self.observation_spaces.items()}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        self.steps = 0
        return self._obs(), {}

    def step(self, actions: dict[str, Any]) -> tuple[Any, ...]:
        for agent, action in actions.items():
            assert self.action_spaces[agent].contains(action), (agent, action)
        self.steps += 1
        over = {a: self.steps == 50 for a in [*self.agents, "__all__"]}
        rewards = {"small": 1.0, "large": 2.0 if self.steps >= self.config.get("apart_at", 99) else 1.0}
        return self._obs(), rewards, dict.fromkeys(over, False), over, {}


PREY = "obstacle-predator-prey"
# Environment and options by name, and what of it matters to whether an algorithm is defined there.
ENVIRONMENTS: dict[str, tuple[str, dict[str, Any], set[str]]] = {
    **{name: (name, {}, set() if name.startswith("simple-tunnel") else {"team_reward"}) for name in maobs.SCENARIOS},
    f"{PREY} learned": (PREY, {"prey": "learned"}, {"different_agents"}),
}


class Case(NamedTuple):
    """A choice for each factor of the matrix; all are trained eagerly, since compiled code is tested elsewhere."""

    algorithm: str
    environment: str
    actions: str
    actor: str
    policies: str
    critic_state: str

    def pairs(self) -> set[tuple[tuple[str, str], ...]]:
        """Every two choices, each with the name of its factor."""
        return set(itertools.combinations(self._asdict().items(), 2))

    def refusals(self) -> list[str]:
        """What the errors say with which it is refused; nothing if it is legal."""
        can = maobs.ALGORITHMS[self.algorithm].supports
        env, _, traits = ENVIRONMENTS[self.environment]
        refusals = []
        if self.actions not in can.actions:
            refusals.append(f"{self.algorithm} needs {can.actions[0]} actions, .* maobs/{env} are {self.actions}")
        if can.team_reward and "team_reward" not in traits:
            refusals.append(f"{self.algorithm} learns the value of one team reward, but in maobs/{env} .* differ")
        if not can.different_agents and "different_agents" in traits:
            refusals.append(f"{self.algorithm} needs agents with observations and actions of equal size")
        if not can.recurrent and self.actor == "lstm":
            refusals.append(f"{self.algorithm} is not defined with recurrent actors")
        if not can.parameter_sharing and self.policies == "shared":
            refusals.append(f"{self.algorithm} is not defined with shared policies")
        if self.critic_state == "world" and not maobs.ALGORITHMS[self.algorithm]().uses_state:
            refusals.append(f"critic_state must be 'observations', .*: neither critics nor a mixer of {self.algorithm}")
        if self.policies == "shared" and "different_agents" in traits:
            refusals.append("Agents that share policy 'all' must have spaces of equal size")
        return refusals

    def config(self) -> maobs.JointConfig:
        """The case as a config, small enough to train in a second."""
        env, options, _ = ENVIRONMENTS[self.environment]
        mode = "discrete" if self.actions == "discrete" else "mpe"
        config = maobs.ALGORITHMS[self.algorithm]()
        config.environment(f"maobs/{env}", env_config={**options, "action_mode": mode})
        config.training(train_batch_size_per_learner=16, updates_per_env_step=0.02, replay_buffer_capacity=3_000)
        config.training(actor=self.actor, critic_state=self.critic_state)
        if self.actor == "lstm":
            config.training(seq_length=2)
        if self.policies == "shared":
            config.multi_agent(policies={"all"}, policy_mapping_fn=lambda agent, *args, **kwargs: "all")
        config.env_runners(num_envs_per_env_runner=20)
        return config.reporting(min_sample_timesteps_per_iteration=2_000).debugging(seed=0)

    def __str__(self) -> str:
        return " ".join(self)


EVERYTHING = [
    Case(*choices)
    for choices in itertools.product(
        ALGORITHMS,
        sorted(ENVIRONMENTS),
        ("continuous", "discrete"),
        ("mlp", "lstm"),
        ("own", "shared"),
        ("observations", "world"),
    )
]
LEGAL = [case for case in EVERYTHING if not case.refusals()]
LEGAL_PAIRS = set[Any]().union(*(case.pairs() for case in LEGAL))


def pairwise(cases: list[Case]) -> list[Case]:
    """Few of the cases, in which every pair occurs that occurs in all of them.

    Most errors come from one choice or from two together, so these cases find them. Next comes always the case with
    most new pairs, and of equals the first, so that the choice is the same in every run.
    """
    missing = set[Any]().union(*(case.pairs() for case in cases))
    chosen = []
    while missing:
        chosen.append(max(cases, key=lambda case: len(missing & case.pairs())))
        missing -= chosen[-1].pairs()
    return chosen


MATRIX = pairwise(LEGAL)


def refused() -> list[Case]:
    """A case for each pair of choices that is legal in none, with as few other reasons to refuse it as there can be."""
    pairs = set[Any]().union(*(case.pairs() for case in EVERYTHING)) - LEGAL_PAIRS
    cases = (min((case for case in EVERYTHING if p in case.pairs()), key=lambda c: len(c.refusals())) for p in pairs)
    return sorted(set(cases))


def test_every_legal_pair_of_choices_is_tried() -> None:
    """Counted pair by pair, and not as `pairwise` does it."""
    for a, b in itertools.combinations(Case._fields, 2):
        legal = {(getattr(case, a), getattr(case, b)) for case in LEGAL}
        tried = {(getattr(case, a), getattr(case, b)) for case in MATRIX}
        assert tried == legal, (a, b)
    for field in Case._fields:  # Every choice is legal somewhere.
        assert {getattr(case, field) for case in MATRIX} == {getattr(case, field) for case in EVERYTHING}
    # There is a case for each algorithm and environment at least, and hardly more.
    assert len(MATRIX) < 1.1 * len({(case.algorithm, case.environment) for case in LEGAL})


@pytest.mark.parametrize("case", MATRIX, ids=str)
def test_every_algorithm_trains_where_it_is_defined(ray_session: None, case: Case) -> None:
    """2000 env steps each."""
    algo = case.config().build_algo()
    result = algo.train()
    assert result["num_env_steps_sampled_lifetime"] == 2_000
    learned = result["learners"]
    assert learned["__all_modules__"]["num_updates_lifetime"] == math.floor(0.02 * (2_000 - 20))
    for mid in algo.config.module_ids:
        assert all(math.isfinite(v) for k, v in learned[mid].items() if k in ("critic_loss", "actor_loss", "q_mean"))
    assert result["env_runners"]["num_episodes"] == 20
    algo.stop()


@pytest.mark.parametrize("case", refused(), ids=str)
def test_every_algorithm_says_why_it_is_not_defined_elsewhere(ray_session: None, case: Case) -> None:
    (reason,) = case.refusals()
    with pytest.raises(ValueError, match=reason):
        case.config().build_algo()


def test_unequal_agents_need_critics_of_their_own_in_facmac(ray_session: None) -> None:
    config = maobs.FACMACConfig().environment(TeamOfTwo).training(critic_source="shared")
    config.reporting(min_sample_timesteps_per_iteration=60)
    with pytest.raises(ValueError, match=r"critic_source must be .others. where agents. .* differ, not .shared."):
        config.build_algo()
    algo = config.copy(copy_frozen=False).training(critic_source="others", train_batch_size_per_learner=8).build_algo()
    algo.train()
    algo.stop()


def test_rewards_that_differ_later_are_found_when_they_do(ray_session: None) -> None:
    """The look before the start sees the first steps only."""
    config = maobs.VDNConfig().environment(TeamOfTwo, env_config={"discrete": True, "apart_at": 30})
    config.training(train_batch_size_per_learner=8).env_runners(num_envs_per_env_runner=1)
    algo = config.build_algo()
    with pytest.raises(
        ValueError,
        match=r"one team reward, but agents' rewards differ at step 3\d .* copy 0: {'large': 2.0, 'small': 1.0}",
    ):
        algo.train()
    algo.stop()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"twin_critics": True}, "facmac is not defined with TD3's options; legal are twin_critics=False"),
        ({"critic_source": "mine"}, "critic_source='mine' is illegal; legal: 'shared', 'others', 'own'"),
        ({"mixer_start": -5}, "mixer_start=-5 is illegal; legal: an integer >= 0"),
        ({"mixer_hidden_size": 0}, "mixer_hidden_size=0 is illegal; legal: an integer >= 1"),
    ],
)
def test_wrong_settings_of_facmac_are_refused(ray_session: None, settings: dict[str, Any], message: str) -> None:
    config = maobs.FACMACConfig().environment("maobs/spread-3a")
    with pytest.raises(ValueError, match=message):
        config.training(**settings).build_algo()


def test_the_docs_show_what_the_algorithms_declare() -> None:
    page = (Path(__file__).parent.parent / "docs" / "algorithms.md").read_text()
    assert support_table() in page
