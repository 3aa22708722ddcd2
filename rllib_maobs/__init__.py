"""Centralised-critic, deterministic-policy multi-agent RL on RLlib's new API stack."""

from ray.tune.registry import register_trainable

from rllib_maobs.algorithms import (
    ALGORITHMS,
    IDDPG,
    MADDPG,
    MADDPGL,
    IDDPGConfig,
    JointAlgorithm,
    JointConfig,
    MADDPGConfig,
    MADDPGLConfig,
)
from rllib_maobs.envs import (
    SCENARIOS,
    EpisodeMetricsCallback,
    MAObsEnv,
    Recorder,
    Scenario,
    VectorEnv,
    make_vec,
    parallel_env,
    register_scenario,
)
from rllib_maobs.envs.joint import register_envs
from rllib_maobs.learner import JointLearner
from rllib_maobs.modules import AgentModule
from rllib_maobs.replay import JointReplayBuffer
from rllib_maobs.runner import JointEnvRunner

__version__ = "0.1.0"


def register() -> None:
    """Tells Ray the environments ("maobs/spread-9a", ...) and algorithms ("MADDPG", ...) by name.

    Ray forgets names when it is shut down, so this may be called again, as often as you like.
    """
    register_envs()
    for algorithm in (IDDPG, MADDPG, MADDPGL):
        register_trainable(algorithm.__name__, algorithm)


__all__ = [
    "ALGORITHMS",
    "IDDPG",
    "MADDPG",
    "MADDPGL",
    "SCENARIOS",
    "AgentModule",
    "EpisodeMetricsCallback",
    "IDDPGConfig",
    "JointAlgorithm",
    "JointConfig",
    "JointEnvRunner",
    "JointLearner",
    "JointReplayBuffer",
    "MADDPGConfig",
    "MADDPGLConfig",
    "MAObsEnv",
    "Recorder",
    "Scenario",
    "VectorEnv",
    "make_vec",
    "parallel_env",
    "register",
    "register_scenario",
]
