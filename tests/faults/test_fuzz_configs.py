"""Configurations: every method that sets settings, with any name and any value."""

import copy
from collections import Counter
from typing import Any

import ray.rllib
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig

import rllib_maobs as maobs
from rllib_maobs.algorithms import settings
from rllib_maobs.registry import same
from tests.conftest import ALGORITHMS, small_config
from tests.faults.fuzz import PACKAGE, little_memory, names_like, nasty, refused

FEW = examples(max_examples=min(250, examples.default.max_examples))  # each of them is validated, which takes a while
SOURCES = (PACKAGE, ray.rllib.__path__[0])  # RLlib has sentences of its own
OURS = sorted({*maobs.JointConfig.legal, "actor", "actor_settings", "critic", "critic_settings", "exploration"})
METHODS = {method: settings.settings_of_method(method) for method in settings.METHODS}
METHODS["training"] = sorted({*METHODS["training"], *OURS})
VALUES = st.one_of(
    nasty(),
    st.integers(-1, 100),
    st.floats(0, 2),
    st.booleans(),
    st.sampled_from(
        ["mlp", "lstm", "entity", "entity-lstm", "world", "observations", "auto", "episodes", "norm", "value"]
    ),
    st.sampled_from([[[0, 1e-3], [100, 1e-4]], [[0, 1e-3]], [[1, 1]], [[]], [[0, float("nan")]], {"epsilon": 0.5}]),
    st.sampled_from([{"type": "ornstein-uhlenbeck"}, {"type": int}, {"hidden_sizes": [8]}, {"lstm_cell_size": 4}]),
    st.sampled_from([{"agent_0": {"exploration": {}}}, {"agent_0", "agent_1", "agent_2"}, {"all"}]),
    st.sampled_from(
        [{"agent_0": [("self", 1, 18)]}, [("agent", 3, 4, 2), ("rest", 1, 10)], {"hidden_sizes": [10**5] * 3}]
    ),
    st.sampled_from([maobs.MADDPG, maobs.JointEnvRunner, maobs.JointLearner, maobs.MLPActor, maobs.MAObsEnv, dict]),
    st.sampled_from([{"env_config": 3}, {"explore": 1}, {"seed": -1}, {"num_envs_per_env_runner": 2}, {"gamma": 0.9}]),
)
ENVS = names_like(["maobs/spread-3a", "maobs/tunnel", "maobs/spread-9a"])


def contents(config: maobs.JointConfig) -> dict[str, Any]:
    """All there is in a configuration, apart from what may be changed later."""
    return {name: copy.copy(value) for name, value in vars(config).items()}


def check(config: maobs.JointConfig, change: Any, tally: Counter[str]) -> None:
    """A change is taken or refused as a whole; what was taken is legal or refused before anything is built."""
    before = contents(config)
    with little_memory():
        if refused(change, tally, sources=SOURCES) is not None:
            assert same(contents(config), before)
            config.validate()
        elif refused(lambda: config.copy(copy_frozen=False).validate(), sources=SOURCES) is None:
            assert config.copy(copy_frozen=False).num_env_runners >= 0


@FEW
@given(data=st.data(), algorithm=st.sampled_from(ALGORITHMS), method=st.sampled_from(sorted(METHODS)))
def test_settings_by_method(data: Any, algorithm: str, method: str, tally: Counter[str]) -> None:
    config = small_config(algorithm)
    names = [name for name in METHODS[method] if name not in ("self", "kwargs")]
    given = {name: data.draw(VALUES) for name in data.draw(st.lists(names_like(names), min_size=1, max_size=3))}
    given.pop("self", None)
    check(config, lambda: getattr(config, method)(**given), tally)


@FEW
@given(data=st.data(), algorithm=st.sampled_from(ALGORITHMS))
def test_settings_of_ours(data: Any, algorithm: str, tally: Counter[str]) -> None:
    config = small_config(algorithm)
    names = sorted({*config.legal} & {*vars(config)} | {"actor", "critic", "exploration", "actor_settings"})
    given = {name: data.draw(VALUES) for name in data.draw(st.sets(st.sampled_from(names), min_size=1, max_size=3))}
    legal = {
        name: value for name, value in given.items() if name in settings.settings_of_method("training") or name in OURS
    }
    check(config, lambda: config.training(**legal), tally)


@FEW
@given(data=st.data(), algorithm=st.sampled_from(ALGORITHMS))
def test_settings_by_a_dict(data: Any, algorithm: str, tally: Counter[str]) -> None:
    """As Tune gives them, or a user's file."""
    config = small_config(algorithm)
    names = sorted({*vars(AlgorithmConfig()), *OURS, "multiagent", "framework", "model_config"})
    changes = data.draw(st.one_of(nasty(), st.dictionaries(names_like(names), VALUES, min_size=1, max_size=3)))
    check(config, lambda: config.update_from_dict(changes), tally)


@FEW
@given(
    env=st.one_of(ENVS, nasty()), options=st.one_of(nasty(), st.dictionaries(st.text(max_size=9), nasty(), max_size=2))
)
def test_environments_of_a_config(env: Any, options: Any, tally: Counter[str]) -> None:
    config = small_config("maddpg")
    check(config, lambda: config.environment(env, env_config=options), tally)
    check(config, lambda: config.environment(env), tally)


def test_a_refused_call_changes_nothing() -> None:
    """Also where the first of its settings is legal, and RLlib's own method would have set it by then."""
    config = small_config("maddpg")
    before = contents(config)
    for change in (
        lambda: config.training(actor_lr=0.5, tau=2.0),
        lambda: config.training(gamma=0.5, other_agents_actions=3),
        lambda: config.env_runners(num_env_runners=3, explore=7),
        lambda: config.environment("maobs/tunnel", env_cofig={}),
        lambda: config.update_from_dict({"gamma": 0.5, "env_config": 3}),
    ):
        assert refused(change) is not None
        assert same(contents(config), before)


def test_a_whole_configuration_is_taken() -> None:
    """As itself, and as the dict that RLlib makes of it, which has older names for some settings."""
    whole = small_config("qmix").training(gamma=0.5)
    for form in (whole, whole.to_dict()):
        config = maobs.QMIXConfig().update_from_dict(form)
        config.validate()
        assert config.gamma == 0.5 and config.env_config == whole.env_config
