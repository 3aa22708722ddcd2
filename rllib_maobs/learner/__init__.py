"""The learning side: networks with parameters, losses to gradients, gradients to updates."""

from rllib_maobs.learner.health import Diverged
from rllib_maobs.learner.joint import NUM_UPDATES_LIFETIME, JointLearner
from rllib_maobs.learner.networks import ACTOR, CRITIC, MIXER, Parts, TeamNetworks, squared_error

__all__ = [
    "ACTOR",
    "CRITIC",
    "MIXER",
    "NUM_UPDATES_LIFETIME",
    "Diverged",
    "JointLearner",
    "Parts",
    "TeamNetworks",
    "squared_error",
]
