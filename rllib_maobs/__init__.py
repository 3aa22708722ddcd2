"""Centralised-critic, deterministic-policy multi-agent RL on RLlib's new API stack."""

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
    Supports,
    VDNConfig,
    register_algorithm,
)
from rllib_maobs.algorithms.registry import register_algorithms
from rllib_maobs.checkpoints import load_networks
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
from rllib_maobs.exported import load_agent
from rllib_maobs.layout import Entities, Layout, layout_size, split
from rllib_maobs.learner import JointLearner, TeamNetworks
from rllib_maobs.modules import (
    ACTORS,
    CRITICS,
    EXPLORATIONS,
    Actor,
    AgentModule,
    Critic,
    EntityActor,
    EntityCritic,
    EntityLSTMActor,
    EpsilonGaussian,
    Exploration,
    LSTMActor,
    Mixer,
    MLPActor,
    MLPCritic,
    OrnsteinUhlenbeck,
    RecurrentActor,
    UtilityModule,
)
from rllib_maobs.replay import Batch, JointReplayBuffer, Moment
from rllib_maobs.runner import JointEnvRunner

__version__ = "0.1.0"


def register() -> None:
    """Tells Ray the environments ("maobs/spread-9a", ...) and algorithms ("MADDPG", ...) by name.

    Ray forgets names when it is shut down, so this may be called again, as often as you like.
    """
    register_envs()
    register_algorithms()


__all__ = [
    "ACTORS",
    "ALGORITHMS",
    "CRITICS",
    "EXPLORATIONS",
    "FACMAC",
    "IDDPG",
    "IQL",
    "MADDPG",
    "MADDPGL",
    "MADDPGLSTM",
    "QMIX",
    "SCENARIOS",
    "VDN",
    "Actor",
    "AgentModule",
    "Batch",
    "Critic",
    "Entities",
    "EntityActor",
    "EntityCritic",
    "EntityLSTMActor",
    "EpisodeMetricsCallback",
    "EpsilonGaussian",
    "Exploration",
    "FACMACConfig",
    "IDDPGConfig",
    "IQLConfig",
    "JointAlgorithm",
    "JointConfig",
    "JointEnvRunner",
    "JointLearner",
    "JointReplayBuffer",
    "LSTMActor",
    "Layout",
    "MADDPGConfig",
    "MADDPGLConfig",
    "MADDPGLSTMConfig",
    "MAObsEnv",
    "MLPActor",
    "MLPCritic",
    "Mixer",
    "Moment",
    "OrnsteinUhlenbeck",
    "PredatorPrey",
    "QMIXConfig",
    "Recorder",
    "RecurrentActor",
    "Scenario",
    "SimpleTunnel",
    "Spread",
    "Supports",
    "TeamNetworks",
    "Tunnel",
    "UtilityModule",
    "VDNConfig",
    "VectorEnv",
    "layout_size",
    "load_agent",
    "load_networks",
    "make_vec",
    "parallel_env",
    "register",
    "register_algorithm",
    "register_scenario",
    "split",
]
