"""One agent as an RLModule: works in our runner and in RLlib's own, checkpoints alone, can be lifted out."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping
from functools import cached_property
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.learner.utils import make_target_network
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, TargetNetworkAPI
from ray.rllib.core.rl_module.torch.torch_rl_module import TorchRLModule
from ray.rllib.utils.annotations import override
from torch import Tensor, nn

from rllib_maobs.layout import Layout, as_layout, flat, layout_size
from rllib_maobs.modules.actors import ACTORS, Actor, RecurrentActor, unrolled
from rllib_maobs.modules.critics import CRITICS, Critic
from rllib_maobs.modules.exploration import Exploration, make_exploration
from rllib_maobs.modules.normalizer import Normalizer
from rllib_maobs.paths import AnyPath
from rllib_maobs.registry import check_settings, settings_of

# What RLlib's model_config calls settings that networks of several kinds take.
COMMON_SETTINGS = {"hidden_sizes": "hidden_sizes", "activation": "activation", "lstm_cell_size": "cell_size"}
ACTOR_ARGUMENTS = ("layout", "num_outputs")
CRITIC_ARGUMENTS = ("state_layout", "action_layout", "num_critics", "num_agents")


class Seen(NamedTuple):
    """What actors act on: observations, or for recurrent actors windows of them.

    Attributes:
        obs: `(..., O)`, or windows `(..., T, O)`, oldest first.
        mask: Which of a window's observations count, `(B, T)`; None for all, or without windows.
        recurrent_state: From which windows start, `(..., *H)`; None for the initial one.
    """

    obs: Tensor
    mask: Tensor | None = None
    recurrent_state: Tensor | None = None


def append(window: Tensor, mask: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
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


def network_settings(
    cls: type[Any], model_config: Mapping[str, Any], own: Mapping[str, Any], reserved: Collection[str]
) -> dict[str, Any]:
    """A network's settings: those of RLlib's `model_config` that it takes, and its own, which come first.

    Args:
        cls: The network's class.
        model_config: With `hidden_sizes`, `activation`, `lstm_cell_size`.
        own: `actor_settings` or `critic_settings`.
        reserved: Parameters of its constructor that are not settings.

    Raises:
        ValueError: For one that it does not take; names the legal ones.
    """
    common = {
        own: model_config[name]
        for name, own in COMMON_SETTINGS.items()
        if name in model_config and takes(cls, name, reserved)
    }
    settings = copy.deepcopy({**common, **own})  # each network has its own
    check_settings(cls, settings, reserved)
    return settings


def takes(cls: type[Any], name: str, reserved: Collection[str] = ()) -> bool:
    """Whether a network takes a setting of RLlib's `model_config`."""
    own, parameters = COMMON_SETTINGS[name], settings_of(cls, reserved)
    anything = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    return own in parameters or (anything and own == name)


class AgentModule(AnyPath, TorchRLModule, InferenceOnlyAPI, TargetNetworkAPI):
    """Actor, critic and their target networks of one agent.

    Lift a trained agent out of an algorithm's checkpoint and act with it:

    ```python
    module = RLModule.from_checkpoint(f"{checkpoint}/learner_group/learner/rl_module/agent_0")
    action = module.forward_inference({"obs": obs})["actions"]  # (B, O) -> (B, A) in [-1, 1]
    ```

    Actions are in [-1, 1], as RLlib's `normalize_actions=True` expects of a module. What an environment
    takes is the unsquashed one: `low + (action + 1) / 2 * (high - low)`. With a Discrete action space they are
    the actions' numbers, `(B,)`.

    A recurrent actor is stateful: its state is the window of the last T observations, with `stored_state` also the
    state with which the last window ended and the next one starts. Start every episode with `get_initial_state()`
    (batched), and give each call the state that the one before returned:

    ```python
    state = {name: value[None] for name, value in module.get_initial_state().items()}
    out = module.forward_inference({"obs": obs, "state_in": state})
    state = out["state_out"]
    ```

    Settings (`model_config`, plain values): `actor`, `critic` (names of `ACTORS` and `CRITICS`, or where to import the
    class from) with `actor_settings`, `critic_settings`; `hidden_sizes`, `activation`, `lstm_cell_size` for networks
    that take them; `observation_layout`, `state_layout`, `action_layout` (what the networks see), `num_critics`,
    `num_agents` (see `Critic`); `seq_length` (T), `stored_state`, `exploration`, `normalize_observations`. Without the
    critic's layouts the module has no critic: enough for acting.
    """

    actor: Actor
    critic: Critic
    target_actor: nn.Module
    target_critic: nn.Module
    # Whether exploring with discrete actions draws from the softmax of the outputs (else it takes their maximum).
    draws = True

    @override(TorchRLModule)
    def setup(self) -> None:
        """Builds the networks from the spaces and `model_config`."""
        self.actor = self._acting_network()
        settings = self.model_config
        state, action = (_critic_layout(settings, part) for part in ("state", "action"))
        if state and action and not self.inference_only:
            cls = CRITICS.resolve(settings.get("critic", "mlp"))
            own = network_settings(cls, settings, settings.get("critic_settings", {}), CRITIC_ARGUMENTS)
            self.critic = cls(state, action, settings.get("num_critics", 1), settings.get("num_agents", 0), **own)
            self.make_target_networks()

    def _acting_network(self) -> Actor:
        """The network from observations to raw outputs, and what belongs to its use."""
        settings: dict[str, Any] = self.model_config
        assert isinstance(self.observation_space, gym.spaces.Box)
        size = self.observation_space.shape[0]
        layout = as_layout(settings.get("observation_layout") or flat(size, "observation"), size, "observation")
        normalize = settings.get("normalize_observations", False)
        self.normalizer: nn.Module = Normalizer(size) if normalize else nn.Identity()
        self.discrete = isinstance(self.action_space, gym.spaces.Discrete)
        cls = ACTORS.resolve(settings.get("actor", "mlp"))
        own = network_settings(cls, settings, settings.get("actor_settings", {}), ACTOR_ARGUMENTS)
        actor = cls(layout, int(self.action_space.n) if self.discrete else self.action_space.shape[0], **own)
        self.recurrent = isinstance(actor, RecurrentActor)
        if isinstance(actor, RecurrentActor) and not isinstance(actor.initial_state(), Tensor):
            raise ValueError(
                f"{cls.__name__}.initial_state() must return one tensor, the state of one agent before its first "
                f"observation, not {actor.initial_state()!r}."
            )
        # T, the length of the windows that the actor sees; 0 without windows.
        self.seq_length: int = settings.get("seq_length", 1) if self.recurrent else 0
        self.stored_state: bool = self.recurrent and settings.get("stored_state", False)
        return actor

    @property
    def acting(self) -> Actor:
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
        """An empty window `(T, O)`, its mask `(T,)`, with `stored_state` the actor's `(*H)`; else nothing."""
        if not self.recurrent:
            return {}
        size = self.observation_space.shape[0]
        state = {"window": torch.zeros(self.seq_length, size), "mask": torch.zeros(self.seq_length)}
        acting = self.acting
        if self.stored_state and isinstance(acting, RecurrentActor):
            state["recurrent_state"] = acting.initial_state()
        return state

    def for_layout(self, layout: Layout) -> AgentModule:
        """This agent for a team of another size: the same networks that act, made for another observation.

        ```python
        env = maobs.make_vec("spread-9a")
        module = module.for_layout(env.observation_layouts["agent_0"])
        ```

        Args:
            layout: What the observation is made of there.

        Returns:
            A module that acts; it has copies of the weights, and no critic.

        Raises:
            ValueError: If the layout is illegal, or the network's parameters depend on it, as an MLP's do.
        """
        layout = as_layout(layout, None, "observation")
        size = layout_size(layout)
        settings = {**self.model_config, "observation_layout": [list(group) for group in layout]}
        other = type(self)(
            observation_space=gym.spaces.Box(-np.inf, np.inf, (size,), np.float32),
            action_space=self.action_space,
            inference_only=True,
            model_config=settings,
        )
        own = {name: tuple(p.shape) for name, p in self.acting.named_parameters()}
        if own != {name: tuple(p.shape) for name, p in other.acting.named_parameters()}:
            raise ValueError(
                f"{type(self.acting).__name__} of this agent has parameters of other shapes for an observation of "
                f"{[tuple(group) for group in layout]}: those of entity networks depend on the groups alone."
            )
        other.acting.load_state_dict(self.acting.state_dict())
        if list(self.normalizer.parameters()):
            raise ValueError("An agent with normalize_observations=True has statistics for one observation only.")
        return other

    def exportable(self) -> nn.Module:
        """This agent without RLlib: an ordinary network for `torch.export`, ONNX or TorchScript.

        ```python
        torch.jit.trace(module.exportable(), torch.zeros(1, 18)).save("agent_0.pt")
        ```

        Returns:
            From observations `(B, O)`, as the environment gives them, to actions `(B, A)` in [-1, 1], or to the numbers
            of discrete ones `(B,)`. It has copies of the weights, and of the normalisation of observations.

        Raises:
            ValueError: If the actor is recurrent, so that its actions depend on a state.
        """
        if self.recurrent:
            raise ValueError(
                "The actor is recurrent: its actions depend on a window of observations. Use forward_inference with "
                '"state_in", see the class.'
            )
        return Exportable(copy.deepcopy(self.normalizer), copy.deepcopy(self.acting), self.discrete).eval()

    @cached_property
    def exploration(self) -> Exploration:
        """How it explores; made when it is first needed, so that an agent elsewhere acts without its noise's class."""
        return make_exploration(self.model_config.get("exploration", {}), discrete=self.discrete)

    def greedy(self, outputs: Tensor) -> Tensor:
        """The policy's own actions: tanh of raw outputs `(..., A)`, or if discrete the best one's number `(...)`."""
        return outputs.argmax(-1) if self.discrete else torch.tanh(outputs)

    def explore(self, outputs: Tensor, t: int, generator: torch.Generator | None = None) -> Tensor:
        """Actions that explore around those of raw outputs `(..., A)` after t env steps."""
        if self.discrete:
            return self.exploration.discrete(outputs, t, generator, sample=self.draws)
        return self.exploration(self.greedy(outputs), t, generator)

    def _act(self, batch: dict[str, Any], network: nn.Module, t: int | None = None) -> dict[str, Any]:
        """Acts with a network: greedily, or exploring after t env steps."""
        obs = torch.as_tensor(batch[Columns.OBS], dtype=torch.float32)
        if self.recurrent:
            outputs, state = self._along(obs, batch.get(Columns.STATE_IN), network)
        else:
            outputs, state = network(self.normalizer(obs)), None
        actions = self.greedy(outputs) if t is None else self.explore(outputs, t)
        return {Columns.ACTIONS: actions} | ({Columns.STATE_OUT: state} if state else {})

    def _along(
        self, obs: Tensor, state: Mapping[str, Any] | None, network: nn.Module
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """A recurrent network's outputs for observations `(B, O)`, or RLlib's `(B, steps, O)`, and its state."""
        if not state:
            raise ValueError(
                "This agent's actor is recurrent, over a window of observations: give its state as "
                'batch["state_in"], get_initial_state() with a batch dimension at an episode\'s start and '
                'the last call\'s "state_out" after that.'
            )
        window, mask, *stored = (torch.as_tensor(state[k], dtype=torch.float32) for k in self.get_initial_state())
        recurrent_state = stored[0] if stored else None
        assert isinstance(network, RecurrentActor)
        steps = []
        for now in obs.unsqueeze(1).unbind(1) if obs.dim() == 2 else obs.unbind(1):
            window, mask = append(window, mask, now)
            outputs, ended = unrolled(network, self.normalizer(window), mask, recurrent_state)
            recurrent_state = ended if stored else None
            steps.append(outputs)
        following = {"window": window, "mask": mask}
        if recurrent_state is not None:
            following["recurrent_state"] = recurrent_state
        return steps[0] if obs.dim() == 2 else torch.stack(steps, dim=1), following

    @override(TorchRLModule)
    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return self._act(batch, self.acting)

    @override(TorchRLModule)
    def _forward_exploration(self, batch: dict[str, Any], t: int = 0, **kwargs: Any) -> dict[str, Any]:
        with torch.no_grad():
            return self._act(batch, self.acting, t)


class Exportable(nn.Module):
    """What an agent makes of an observation: normalisation, actor, and tanh or argmax; see `AgentModule.exportable`."""

    def __init__(self, normalizer: nn.Module, actor: nn.Module, discrete: bool) -> None:
        super().__init__()
        self.normalizer, self.actor, self.discrete = normalizer, actor, discrete

    def forward(self, observation: Tensor) -> Tensor:
        """Actions of observations `(B, O)`."""
        outputs: Tensor = self.actor(self.normalizer(observation))
        return outputs.argmax(-1) if self.discrete else torch.tanh(outputs)


class UtilityModule(AgentModule):
    """Utility Q_a(o, .) of one agent with discrete actions, and its target network: the agent of VDN and QMIX.

    It acts by the action of the highest utility and explores epsilon-greedily. Settings and use are those of
    `AgentModule`; there is no critic.
    """

    utility: Actor
    target_utility: nn.Module
    draws = False

    @override(AgentModule)
    def setup(self) -> None:
        """Builds the networks from the spaces and `model_config`."""
        self.utility = self._acting_network()
        if not self.inference_only:
            self.make_target_networks()

    @property
    @override(AgentModule)
    def acting(self) -> Actor:
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


def _critic_layout(settings: Mapping[str, Any], part: str) -> Layout | None:
    """The layout of one of the critic's inputs; None if there is no critic."""
    if (groups := settings.get(f"{part}_layout")) is not None:
        return as_layout(groups, None, part)
    size = settings.get(f"critic_{part}_size")  # as checkpoints had it before there were layouts
    return None if size is None else flat(size, part)
