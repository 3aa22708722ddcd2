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
from rllib_maobs.modules.networks import ACTORS, Critic, LSTMActor, MLPActor
from rllib_maobs.modules.normalizer import Normalizer


def push(window: Tensor, mask: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
    """Appends an observation to windows, whose oldest one drops out.

    Args:
        window: The last T observations, oldest first, `(B, T, ...)`.
        mask: 1.0 where one counts, `(B, T)`.
        observation: The new ones, `(B, ...)`.

    Returns:
        The new window and mask.
    """
    window = torch.cat([window[:, 1:], observation.unsqueeze(1)], dim=1)
    return window, torch.cat([mask[:, 1:], torch.ones_like(mask[:, :1])], dim=1)


class AgentModule(TorchRLModule, InferenceOnlyAPI, TargetNetworkAPI):
    """Actor, critic and their target networks of one agent.

    Lift a trained agent out of an algorithm's checkpoint and act with it:

    ```python
    module = RLModule.from_checkpoint(f"{checkpoint}/learner_group/learner/rl_module/agent_0")
    action = module.forward_inference({"obs": obs})["actions"]  # (B, O) -> (B, A) in [-1, 1]
    ```

    Actions are in [-1, 1], as RLlib's `normalize_actions=True` expects of a module. What an environment
    takes is the unsquashed one: `low + (action + 1) / 2 * (high - low)`. With a Discrete action space they are
    the actions' numbers, `(B,)`.

    An LSTM actor is stateful: its state is the window of the last T observations, with `carry_hidden` also the h and c
    with which the last window ended and the next one starts. Start every episode with `get_initial_state()` (batched),
    and give each call the state that the one before returned:

    ```python
    state = {name: value[None] for name, value in module.get_initial_state().items()}
    out = module.forward_inference({"obs": obs, "state_in": state})
    state = out["state_out"]
    ```

    Settings (`model_config`): `hidden_sizes`, `activation`, `actor` ("mlp" or "lstm"), `lstm_cell_size` (H),
    `seq_length` (T), `carry_hidden`, `exploration` (see `Exploration`), `normalize_observations`, and
    `critic_state_size`, `critic_action_size`, `num_critics`: the widths of what the algorithm's critic sees and how
    many there are of it. Without the critic's sizes the module has no critic: enough for acting.
    """

    actor: MLPActor | LSTMActor
    critic: Critic
    target_actor: nn.Module
    target_critic: nn.Module
    # Whether exploring with discrete actions draws from the softmax of the outputs (else it takes their maximum).
    _samples = True

    @override(TorchRLModule)
    def setup(self) -> None:
        """Builds the networks from the spaces and `model_config`."""
        self.actor = self._acting_network()
        settings: dict[str, Any] = self.model_config
        if "critic_state_size" in settings and not self.inference_only:
            shape = {k: settings[k] for k in ("hidden_sizes", "activation", "num_critics") if k in settings}
            self.critic = Critic(settings["critic_state_size"], settings["critic_action_size"], **shape)
            self.make_target_networks()

    def _acting_network(self) -> MLPActor | LSTMActor:
        """A network from observations to actions, or to values of discrete actions, and what belongs to its use."""
        settings: dict[str, Any] = self.model_config
        assert isinstance(self.observation_space, gym.spaces.Box)
        size = self.observation_space.shape[0]
        normalize = settings.get("normalize_observations", False)
        self.normalizer: nn.Module = Normalizer(size) if normalize else nn.Identity()
        self.exploration = Exploration.from_dict(settings.get("exploration", {}))
        self.discrete = isinstance(self.action_space, gym.spaces.Discrete)
        actor = settings.get("actor", "mlp")
        self.seq_length: int = settings.get("seq_length", 1) if actor == "lstm" else 0
        self.carries = actor == "lstm" and settings.get("carry_hidden", False)
        shape: dict[str, Any] = {k: settings[k] for k in ("hidden_sizes", "activation") if k in settings}
        if actor == "lstm":
            shape["cell_size"] = settings.get("lstm_cell_size")
        outputs = int(self.action_space.n) if self.discrete else self.action_space.shape[0]
        return ACTORS[actor](size, outputs, **shape, discrete=self.discrete)

    @property
    def acting(self) -> MLPActor | LSTMActor:
        """The network that acts."""
        return self.actor

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
        """The target network's actions for the same batch as `forward_inference`."""
        return self._act(batch, self.get_target_network_pairs()[0][1])

    @override(InferenceOnlyAPI)
    def get_non_inference_attributes(self) -> list[str]:
        """What acting does not need."""
        return ["critic", "target_actor", "target_critic"]

    @override(TorchRLModule)
    def get_initial_state(self) -> dict[str, Tensor]:
        """An empty window `(T, O)`, its mask `(T,)`, and `(H,)` h and c if carried; nothing but for an LSTM."""
        if not self.seq_length:
            return {}
        size = self.observation_space.shape[0]
        state = {"window": torch.zeros(self.seq_length, size), "mask": torch.zeros(self.seq_length)}
        if self.carries:
            assert isinstance(self.acting, LSTMActor)
            state |= {name: torch.zeros(self.acting.from_hidden.in_features) for name in ("hidden", "cell")}
        return state

    def greedy(self, output: Tensor) -> Tensor:
        """The actions of the network's outputs `(..., A)`: those outputs or, if discrete, the best one's number."""
        return output.argmax(-1) if self.discrete else output

    def explore(self, output: Tensor, t: int, generator: torch.Generator | None = None) -> Tensor:
        """Actions that explore around the network's outputs `(..., A)` after t env steps."""
        if self.discrete:
            return self.exploration.discrete(output, t, generator, sample=self._samples)
        return self.exploration(output, t, generator)

    def _act(self, batch: dict[str, Any], network: nn.Module, t: int | None = None) -> dict[str, Any]:
        """Acts with a network: greedily, or exploring after t env steps."""
        obs = torch.as_tensor(batch[Columns.OBS], dtype=torch.float32)
        if not self.seq_length:
            outputs, state = network(self.normalizer(obs)), None
        else:
            if not batch.get(Columns.STATE_IN):
                raise ValueError(
                    "This agent's actor is an LSTM over a window of observations: give its state as "
                    'batch["state_in"], get_initial_state() with a batch dimension at an episode\'s start and '
                    'the last call\'s "state_out" after that.'
                )
            window, mask, *carried = (
                torch.as_tensor(batch[Columns.STATE_IN][k], dtype=torch.float32) for k in self.get_initial_state()
            )
            hidden = torch.stack(carried, -2) if carried else None
            steps = []
            for now in obs.unsqueeze(1).unbind(1) if obs.dim() == 2 else obs.unbind(1):  # RLlib adds a time axis
                window, mask = push(window, mask, now)
                if hidden is None:
                    steps.append(network(self.normalizer(window), mask))
                else:
                    assert isinstance(network, LSTMActor)
                    hidden = network.carry(self.normalizer(window), mask, hidden)
                    steps.append(network.head(hidden))
            outputs = steps[0] if obs.dim() == 2 else torch.stack(steps, dim=1)
            state = {"window": window, "mask": mask}
            if hidden is not None:
                state |= {"hidden": hidden[..., 0, :], "cell": hidden[..., 1, :]}
        actions = self.greedy(outputs) if t is None else self.explore(outputs, t)
        return {Columns.ACTIONS: actions} | ({Columns.STATE_OUT: state} if state else {})

    @override(TorchRLModule)
    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return self._act(batch, self.acting)

    @override(TorchRLModule)
    def _forward_exploration(self, batch: dict[str, Any], t: int = 0, **kwargs: Any) -> dict[str, Any]:
        with torch.no_grad():
            return self._act(batch, self.acting, t)


class UtilityModule(AgentModule):
    """Utility Q_a(o, .) of one agent with discrete actions, and its target network: the agent of VDN and QMIX.

    It acts by the action of the highest utility and explores epsilon-greedily. Settings and use are those of
    `AgentModule`; there is no critic.
    """

    utility: MLPActor | LSTMActor
    target_utility: nn.Module
    _samples = False

    @override(AgentModule)
    def setup(self) -> None:
        """Builds the networks from the spaces and `model_config`."""
        self.utility = self._acting_network()
        if not self.inference_only:
            self.make_target_networks()

    @property
    @override(AgentModule)
    def acting(self) -> MLPActor | LSTMActor:
        """The utility."""
        return self.utility

    @override(AgentModule)
    def make_target_networks(self) -> None:
        """The target network starts as a copy of the online one."""
        self.target_utility = make_target_network(self.utility)

    @override(AgentModule)
    def get_target_network_pairs(self) -> list[tuple[nn.Module, nn.Module]]:
        """The (online, target) pair that Polyak averaging runs over."""
        return [(self.utility, self.target_utility)]

    @override(AgentModule)
    def get_non_inference_attributes(self) -> list[str]:
        """What acting does not need."""
        return ["target_utility"]
