"""The sampling side: E environment copies, acting, episodes, and RLlib's EnvRunner around them."""

from rllib_maobs.runner.episodes import EPISODE_METRICS
from rllib_maobs.runner.errors import raise_kept, raised_as_themselves
from rllib_maobs.runner.joint import JointEnvRunner, JointSample
from rllib_maobs.runner.making import env_creator, make_env

__all__ = [
    "EPISODE_METRICS",
    "JointEnvRunner",
    "JointSample",
    "env_creator",
    "make_env",
    "raise_kept",
    "raised_as_themselves",
]
