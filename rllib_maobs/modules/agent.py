"""One agent as an RLModule: works in our runner and in RLlib's own, checkpoints alone, can be lifted out."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.learner.utils import make_target_network
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, TargetNetworkAPI
from ray.rllib.core.rl_module.torch.torch_rl_module import TorchRLModule
from ray.rllib.utils.annotations import override
from torch import Tensor, nn

from rllib_maobs.modules.exploration import Exploration
from rllib_maobs.modules.networks import Critic, MLPActor


class AgentModule(TorchRLModule, InferenceOnlyAPI, TargetNetworkAPI):
    """Actor, critic and their target networks of one agent.

    Lift a trained agent out of an algorithm's checkpoint and act with it:

    ```python
    module = RLModule.from_checkpoint(f"{checkpoint}/learner_group/learner/rl_module/agent_0")
    action = module.forward_inference({"obs": obs})["actions"]  # (B, O) -> (B, A) in [-1, 1]
    ```

    Actions are in [-1, 1], as RLlib's `normalize_actions=True` expects of a module. What an environment
    takes is the unsquashed one: `low + (action + 1) / 2 * (high - low)`.

    Settings (`model_config`): `hidden_sizes`, `activation`, `exploration` (see `Exploration`) and
    `critic_state_size`, `critic_action_size`, the widths of what the algorithm's critic sees. Without
    the last two the module has no critic: enough for acting.
    """

    actor: MLPActor
    critic: Critic
    target_actor: nn.Module
    target_critic: nn.Module

    @override(TorchRLModule)
    def setup(self) -> None:
        """Builds the networks from the spaces and `model_config`."""
        settings: dict[str, Any] = self.model_config
        shape = {k: settings[k] for k in ("hidden_sizes", "activation") if k in settings}
        assert isinstance(self.observation_space, gym.spaces.Box)
        assert isinstance(self.action_space, gym.spaces.Box)
        observation_size, action_size = self.observation_space.shape[0], self.action_space.shape[0]
        self.exploration = Exploration.from_dict(settings.get("exploration", {}))
        self.actor = MLPActor(observation_size, action_size, **shape)
        if "critic_state_size" in settings and not self.inference_only:
            sizes = settings["critic_state_size"], settings["critic_action_size"]
            self.critic = Critic(*sizes, **shape)
            self.make_target_networks()

    @override(TargetNetworkAPI)
    def make_target_networks(self) -> None:
        """Target networks start as copies of the online ones."""
        self.target_actor = make_target_network(self.actor)
        self.target_critic = make_target_network(self.critic)

    @override(TargetNetworkAPI)
    def get_target_network_pairs(self) -> list[tuple[nn.Module, nn.Module]]:
        """The (online, target) pairs that Polyak averaging runs over."""
        return [(self.actor, self.target_actor), (self.critic, self.target_critic)]

    @override(TargetNetworkAPI)
    def forward_target(self, batch: dict[str, Any]) -> dict[str, Any]:
        """The target actor's actions `(B, A)` for observations `(B, O)`."""
        return {Columns.ACTIONS: self.target_actor(batch[Columns.OBS])}

    @override(InferenceOnlyAPI)
    def get_non_inference_attributes(self) -> list[str]:
        """What acting does not need."""
        return ["critic", "target_actor", "target_critic"]

    @override(TorchRLModule)
    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Tensor]:
        observations = torch.as_tensor(batch[Columns.OBS], dtype=torch.float32)
        return {Columns.ACTIONS: self.actor(observations)}

    @override(TorchRLModule)
    def _forward_exploration(self, batch: dict[str, Any], t: int = 0, **kwargs: Any) -> dict[str, Tensor]:
        with torch.no_grad():
            actions = self._forward(batch)[Columns.ACTIONS]
            return {Columns.ACTIONS: self.exploration(actions, t)}
