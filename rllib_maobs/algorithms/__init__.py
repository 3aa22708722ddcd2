"""One file per algorithm: its configuration, what it is defined for, and its losses."""

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import JointConfig, Supports
from rllib_maobs.algorithms.facmac import FACMAC, FACMACConfig
from rllib_maobs.algorithms.iddpg import IDDPG, IDDPGConfig
from rllib_maobs.algorithms.iql import IQL, IQLConfig
from rllib_maobs.algorithms.maddpg import MADDPG, MADDPGConfig
from rllib_maobs.algorithms.maddpg_l import MADDPGL, MADDPGLConfig
from rllib_maobs.algorithms.maddpg_lstm import MADDPGLSTM, MADDPGLSTMConfig
from rllib_maobs.algorithms.qmix import QMIX, QMIXConfig
from rllib_maobs.algorithms.registry import ALGORITHMS, register_algorithm
from rllib_maobs.algorithms.vdn import VDN, VDNConfig

for _algorithm in (IDDPG, MADDPG, MADDPGLSTM, MADDPGL, FACMAC, IQL, VDN, QMIX):
    register_algorithm(_algorithm.config_class, _algorithm)


def support_table() -> str:
    """What every algorithm is defined for, as a Markdown table; that of docs/algorithms.md."""
    lines = [
        "| | actions | needs one team reward | agents may differ | LSTM | parameter sharing | twin critics (TD3) |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, config in ALGORITHMS.items():
        can = config.supports
        flags = (can.team_reward, can.different_agents, can.recurrent, can.parameter_sharing, can.twin_critics)
        lines.append(f"| `{name}` | {', '.join(can.actions)} | {' | '.join('yes' if f else 'no' for f in flags)} |")
    return "\n".join(lines)


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
    "FACMACConfig",
    "IDDPGConfig",
    "IQLConfig",
    "JointAlgorithm",
    "JointConfig",
    "MADDPGConfig",
    "MADDPGLConfig",
    "MADDPGLSTMConfig",
    "QMIXConfig",
    "Supports",
    "VDNConfig",
    "register_algorithm",
    "support_table",
]
