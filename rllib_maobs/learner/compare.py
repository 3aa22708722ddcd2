"""What the stacks compute against every agent's own network, once, before training starts."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from rllib_maobs.learner.networks import TeamNetworks
from rllib_maobs.modules import Actor, RecurrentActor
from rllib_maobs.modules.team import Actors, Critics
from rllib_maobs.replay import Moment

_ROWS = 3


@torch.no_grad()
def compare_networks(nets: TeamNetworks, device: torch.device) -> None:
    """Compares what all agents' networks compute at once with what each computes by itself, on random inputs.

    Args:
        nets: The networks.
        device: Where they are.

    Raises:
        ValueError: If a network fails, if its result has another shape than it must have, or if called for all agents
            at once it computes something else than by itself; names it.
    """
    parts, config, generator = nets.parts, nets.config, torch.Generator().manual_seed(0)
    team, length = config.team, config.window_length
    agents = len(team.agents)

    def drawn(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator).to(device)

    obs, actions = drawn(_ROWS, agents, team.observation_size), drawn(_ROWS, agents, team.action_size)
    window = drawn(_ROWS, agents, length, team.observation_size) if length else None
    mask = torch.ones(_ROWS, length, device=device) if length else None
    state = drawn(_ROWS, config.state_size) if config.uses_state else None
    moment = Moment(obs if window is None else window[:, :, -1], state, window, mask)
    alone = partial(_alone, nets, moment, actions)
    _compare(parts.actors, partial(nets.outputs, moment), alone, team.action_size)
    if parts.critics is not None:
        _compare(parts.critics, partial(nets.q, moment, actions), alone, 1 + config.twin_critics)


def _compare(
    stack: Actors | Critics, together: Callable[[], Tensor], alone: Callable[[Any, int], Tensor], width: int
) -> None:
    """Compares a stack's result, `(B, N, width)`, with that of each agent's own network."""
    agents = len(stack.networks)
    for agent, (network, name) in enumerate(zip(stack.networks, stack.names, strict=True)):
        what = f"{name} ({type(network).__name__})"
        try:
            own = alone(network, agent)
            result = together()
        except Exception as error:
            raise ValueError(f"{what} can't be called for all agents at once by vmap: {error}") from error
        if result.shape != (_ROWS, agents, width):
            raise ValueError(
                f"{what} must return {width} numbers in a last dimension; for {agents} agents and a batch of {_ROWS} "
                f"that is {(_ROWS, agents, width)}, not {tuple(result.shape)}."
            )
        if not torch.isfinite(own).all():
            raise ValueError(f"{what} returns numbers that are not finite for ordinary inputs.")
        stacked = result[:, agent, : own.shape[-1]]
        if not torch.allclose(stacked, own, rtol=1e-3, atol=1e-4):
            raise ValueError(
                f"{what} called for all agents at once computes something else than by itself (by up to "
                f"{(stacked - own).abs().max():.2g}): is there anything in it but parameters, layers and settings?"
            )


def _alone(nets: TeamNetworks, moment: Moment, actions: Tensor, network: Any, agent: int) -> Tensor:
    """What one agent's network computes by itself."""
    config = nets.config
    size = config.team.observation_sizes[agent]
    if isinstance(network, RecurrentActor):
        assert moment.window is not None
        return RecurrentActor.unroll(network, moment.window[:, agent, :, :size], moment.mask)[0]
    if isinstance(network, Actor):
        return network(moment.obs[:, agent, :size])
    state: Tensor | None = moment.obs[:, agent, :size]
    action = actions[:, agent, : config.team.action_sizes[agent]]
    if config.central_critic:
        state = moment.state
        action = actions.flatten(1) if "joint_action" in config.critic_sees else actions[:, agent]
    ids = nets.parts.agent_ids
    result: Tensor = network(state, action) if ids is None else network(state, action, ids[agent])
    return result
