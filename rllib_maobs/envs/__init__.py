"""Multi-agent obstacle-avoidance tasks: one simulator, three faces (arrays, PettingZoo, RLlib)."""

from rllib_maobs.envs.pettingzoo_env import MAObsParallelEnv, parallel_env
from rllib_maobs.envs.predator_prey import PredatorPrey
from rllib_maobs.envs.recording import Recorder
from rllib_maobs.envs.registry import SCENARIOS, make_scenario, make_vec, register_scenario
from rllib_maobs.envs.rllib_env import EpisodeMetricsCallback, MAObsEnv
from rllib_maobs.envs.scenario import Outcome, Scenario, ScenarioOptions
from rllib_maobs.envs.simple_tunnel import SimpleTunnel
from rllib_maobs.envs.spread import Spread
from rllib_maobs.envs.tunnel import Tunnel
from rllib_maobs.envs.vector import VectorEnv
from rllib_maobs.envs.world import Bodies, Wall, World
from rllib_maobs.layout import Entities, Layout, split
from rllib_maobs.options import Range

__all__ = [
    "SCENARIOS",
    "Bodies",
    "Entities",
    "EpisodeMetricsCallback",
    "Layout",
    "MAObsEnv",
    "MAObsParallelEnv",
    "Outcome",
    "PredatorPrey",
    "Range",
    "Recorder",
    "Scenario",
    "ScenarioOptions",
    "SimpleTunnel",
    "Spread",
    "Tunnel",
    "VectorEnv",
    "Wall",
    "World",
    "make_scenario",
    "make_vec",
    "parallel_env",
    "register_scenario",
    "split",
]
