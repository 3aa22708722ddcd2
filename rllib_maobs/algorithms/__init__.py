"""One file per algorithm: its configuration, what it is defined for, and its losses."""

from rllib_maobs.algorithms.base import Abilities, JointAlgorithm, JointConfig
from rllib_maobs.algorithms.facmac import FACMAC, FACMACConfig
from rllib_maobs.algorithms.iddpg import IDDPG, IDDPGConfig
from rllib_maobs.algorithms.iql import IQL, IQLConfig
from rllib_maobs.algorithms.maddpg import MADDPG, MADDPGConfig
from rllib_maobs.algorithms.maddpg_l import MADDPGL, MADDPGLConfig
from rllib_maobs.algorithms.maddpg_lstm import MADDPGLSTM, MADDPGLSTMConfig
from rllib_maobs.algorithms.qmix import QMIX, QMIXConfig
from rllib_maobs.algorithms.vdn import VDN, VDNConfig

ALGORITHMS: dict[str, type[JointConfig]] = {
    config.name: config
    for config in (
        IDDPGConfig,
        MADDPGConfig,
        MADDPGLSTMConfig,
        MADDPGLConfig,
        FACMACConfig,
        IQLConfig,
        VDNConfig,
        QMIXConfig,
    )
}
"""Every algorithm's configuration by its name."""

__all__ = [
    "ALGORITHMS",
    "FACMAC",
    "IDDPG",
    "IQL",
    "MADDPG",
    "MADDPGL",
    "MADDPGLSTM",
    "QMIX",
    "VDN",
    "Abilities",
    "FACMACConfig",
    "IDDPGConfig",
    "IQLConfig",
    "JointAlgorithm",
    "JointConfig",
    "MADDPGConfig",
    "MADDPGLConfig",
    "MADDPGLSTMConfig",
    "QMIXConfig",
    "VDNConfig",
]
