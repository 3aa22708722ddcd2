"""Centralised-critic, deterministic-policy multi-agent RL on RLlib's new API stack."""

from ray.tune.registry import register_trainable

from rllib_maobs.algorithms import (
    ALGORITHMS,
    FACMAC,
    IDDPG,
    IQL,
    MADDPG,
    MADDPGL,
    MADDPGLSTM,
    QMIX,
    VDN,
    FACMACConfig,
    IDDPGConfig,
    IQLConfig,
    JointAlgorithm,
    JointConfig,
    MADDPGConfig,
    MADDPGLConfig,
    MADDPGLSTMConfig,
    QMIXConfig,
    VDNConfig,
)
from rllib_maobs.envs import (
    SCENARIOS,
    EpisodeMetricsCallback,
    MAObsEnv,
    PredatorPrey,
    Recorder,
    Scenario,
    SimpleTunnel,
    Spread,
    Tunnel,
    VectorEnv,
    make_vec,
    parallel_env,
    register_scenario,
)
from rllib_maobs.envs.joint import register_envs
from rllib_maobs.learner import JointLearner
from rllib_maobs.modules import AgentModule, Critic, LSTMActor, Mixer, MLPActor, UtilityModule
from rllib_maobs.replay import JointReplayBuffer
from rllib_maobs.runner import JointEnvRunner

__version__ = "0.1.0"


def register() -> None:
    """Tells Ray the environments ("maobs/spread-9a", ...) and algorithms ("MADDPG", ...) by name.

    Ray forgets names when it is shut down, so this may be called again, as often as you like.
    """
    register_envs()
    for algorithm in (IDDPG, MADDPG, MADDPGLSTM, MADDPGL, FACMAC, IQL, VDN, QMIX):
        register_trainable(algorithm.__name__, algorithm)


__all__ = [
    "ALGORITHMS",
    "FACMAC",
    "IDDPG",
    "IQL",
    "MADDPG",
    "MADDPGL",
    "MADDPGLSTM",
    "QMIX",
    "SCENARIOS",
    "VDN",
    "AgentModule",
    "Critic",
    "EpisodeMetricsCallback",
    "FACMACConfig",
    "IDDPGConfig",
    "IQLConfig",
    "JointAlgorithm",
    "JointConfig",
    "JointEnvRunner",
    "JointLearner",
    "JointReplayBuffer",
    "LSTMActor",
    "MADDPGConfig",
    "MADDPGLConfig",
    "MADDPGLSTMConfig",
    "MAObsEnv",
    "MLPActor",
    "Mixer",
    "PredatorPrey",
    "QMIXConfig",
    "Recorder",
    "Scenario",
    "SimpleTunnel",
    "Spread",
    "Tunnel",
    "UtilityModule",
    "VDNConfig",
    "VectorEnv",
    "make_vec",
    "parallel_env",
    "register",
    "register_scenario",
]
