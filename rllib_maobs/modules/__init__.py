"""Networks, the RLModule that holds those of one agent, and their stacking over a team."""

from rllib_maobs.modules.agent import AgentModule
from rllib_maobs.modules.exploration import Exploration
from rllib_maobs.modules.networks import ACTIVATIONS, Critic, MLPActor, mlp
from rllib_maobs.modules.stack import Params, Stack

__all__ = ["ACTIVATIONS", "AgentModule", "Critic", "Exploration", "MLPActor", "Params", "Stack", "mlp"]
