"""Every algorithm on every environment: it trains, or says why it is not defined there."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from ray.rllib.env.multi_agent_env import MultiAgentEnv

import rllib_maobs as maobs
from rllib_maobs.algorithms import abilities_table
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
# Environment, options, and what of it matters to whether an algorithm is defined there.
ENVIRONMENTS: list[tuple[str, dict[str, Any], set[str]]] = [
    *((env, {}, {"team_reward"}) for env in sorted(maobs.SCENARIOS) if not env.startswith("simple-tunnel")),
    *((env, {}, set()) for env in sorted(maobs.SCENARIOS) if env.startswith("simple-tunnel")),
    (PREY, {"prey": "learned"}, {"different_agents"}),
]


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
@pytest.mark.parametrize(
    ("env", "options", "traits"), ENVIRONMENTS, ids=[" ".join((e, *o.values())) for e, o, _ in ENVIRONMENTS]
)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_trains_where_it_is_defined(
    ray_session: None, algorithm: str, env: str, options: dict[str, Any], traits: set[str], kind: str
) -> None:
    """2000 env steps each."""
    config = maobs.ALGORITHMS[algorithm]()
    mode = "discrete" if kind == "discrete" else "mpe"
    config.environment(f"maobs/{env}", env_config={**options, "action_mode": mode})
    config.training(train_batch_size_per_learner=16, updates_per_env_step=0.02, replay_buffer_capacity=3_000)
    config.training(seq_length=2).env_runners(num_envs_per_env_runner=20)
    config.reporting(min_sample_timesteps_per_iteration=2_000).debugging(seed=0)
    abilities = config.abilities
    refusals = []
    if abilities.team_reward and "team_reward" not in traits:
        refusals.append("learns the value of one team reward, but in maobs/.* agents' rewards differ")
    if kind not in abilities.actions:
        refusals.append(rf"{algorithm} needs {abilities.actions[0]} actions, but those of maobs/{env} are {kind}")
    if refusals:
        with pytest.raises(ValueError, match="|".join(refusals)):
            config.build_algo()
        return
    algo = config.build_algo()
    result = algo.train()
    assert result["num_env_steps_sampled_lifetime"] == 2_000
    learned = result["learners"]
    assert learned["__all_modules__"]["num_updates_lifetime"] == math.floor(0.02 * (2_000 - 20))
    for mid in algo.config.module_ids:
        assert all(math.isfinite(v) for k, v in learned[mid].items() if k in ("critic_loss", "actor_loss", "q_mean"))
    assert result["env_runners"]["num_episodes"] == 20
    algo.stop()


def test_unequal_agents_need_critics_of_their_own_in_facmac(ray_session: None) -> None:
    config = maobs.FACMACConfig().environment(TeamOfTwo).training(critic_source="shared")
    config.reporting(min_sample_timesteps_per_iteration=60)
    with pytest.raises(ValueError, match=r"critic_source must be .others. where agents. .* differ in size"):
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
        ValueError, match=r"one team reward, but agents' rewards differ at step 3\d .* copy 0: \[1. 2.\]"
    ):
        algo.train()
    algo.stop()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"twin_critics": True}, "facmac is not defined with TD3's options; legal are twin_critics=False"),
        ({"critic_source": "mine"}, "critic_source must be one of 'shared', 'others', 'own', not 'mine'"),
        ({"mixer_start": -5}, r"mixer_start must be a finite number in \[0, inf\), not -5"),
        ({"mixer_hidden_size": 0}, r"mixer_hidden_size must be a finite number in \[1, inf\), not 0"),
    ],
)
def test_wrong_settings_of_facmac_are_refused(ray_session: None, settings: dict[str, Any], message: str) -> None:
    config = maobs.FACMACConfig().environment("maobs/spread-3a").training(**settings)
    with pytest.raises(ValueError, match=message):
        config.build_algo()


def test_the_readme_shows_what_the_algorithms_declare() -> None:
    readme = (Path(__file__).parent.parent / "README.md").read_text()
    assert abilities_table() in readme
