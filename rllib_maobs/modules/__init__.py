"""Networks, the RLModules that hold those of one agent or the mixers, and their stacking over a team."""

from rllib_maobs.modules.actors import ACTORS, Actor, LSTMActor, MLPActor, RecurrentActor
from rllib_maobs.modules.agent import AgentModule, Seen, UtilityModule
from rllib_maobs.modules.critics import CRITICS, Critic, MLPCritic
from rllib_maobs.modules.entity import EntityActor, EntityCritic, EntityLSTMActor
from rllib_maobs.modules.exploration import EXPLORATIONS, EpsilonGaussian, Exploration, OrnsteinUhlenbeck
from rllib_maobs.modules.layers import ACTIVATIONS, mlp
from rllib_maobs.modules.mixer import Mixer, MixerModule
from rllib_maobs.modules.stack import Params, PerAgent, Shared, Stack

__all__ = [
    "ACTIVATIONS",
    "ACTORS",
    "CRITICS",
    "EXPLORATIONS",
    "Actor",
    "AgentModule",
    "Critic",
    "EntityActor",
    "EntityCritic",
    "EntityLSTMActor",
    "EpsilonGaussian",
    "Exploration",
    "LSTMActor",
    "MLPActor",
    "MLPCritic",
    "Mixer",
    "MixerModule",
    "OrnsteinUhlenbeck",
    "Params",
    "PerAgent",
    "RecurrentActor",
    "Seen",
    "Shared",
    "Stack",
    "UtilityModule",
    "mlp",
]
