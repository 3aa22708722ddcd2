"""Networks, the RLModules that hold those of one agent or the mixers, and their stacking over a team."""

from rllib_maobs.modules.agent import AgentModule, UtilityModule
from rllib_maobs.modules.exploration import Exploration
from rllib_maobs.modules.mixer import Mixer, MixerModule
from rllib_maobs.modules.networks import ACTIVATIONS, ACTORS, Critic, LSTMActor, MLPActor, mlp
from rllib_maobs.modules.stack import Params, Stack

__all__ = [
    "ACTIVATIONS",
    "ACTORS",
    "AgentModule",
    "Critic",
    "Exploration",
    "LSTMActor",
    "MLPActor",
    "Mixer",
    "MixerModule",
    "Params",
    "Stack",
    "UtilityModule",
    "mlp",
]
