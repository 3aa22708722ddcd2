"""One file per algorithm: its configuration, what its critic sees, and its two losses."""

from rllib_maobs.algorithms.base import JointAlgorithm, JointConfig
from rllib_maobs.algorithms.iddpg import IDDPG, IDDPGConfig
from rllib_maobs.algorithms.maddpg import MADDPG, MADDPGConfig
from rllib_maobs.algorithms.maddpg_l import MADDPGL, MADDPGLConfig

ALGORITHMS: dict[str, type[JointConfig]] = {
    config.name: config for config in (IDDPGConfig, MADDPGConfig, MADDPGLConfig)
}
"""Every algorithm's configuration by its name."""

__all__ = [
    "ALGORITHMS",
    "IDDPG",
    "MADDPG",
    "MADDPGL",
    "IDDPGConfig",
    "JointAlgorithm",
    "JointConfig",
    "MADDPGConfig",
    "MADDPGLConfig",
]
