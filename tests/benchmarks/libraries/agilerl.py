"""AgileRL: its MADDPG's update."""

from typing import Any

import numpy as np
import torch
from agilerl.algorithms import MADDPG
from agilerl.components import ReplayBuffer
from agilerl.networks import ContinuousQNetwork, DeterministicActor
from gymnasium.spaces import Box, Dict
from tensordict import TensorDict

from tests.benchmarks.libraries import HIDDEN, ROWS, Shape, job, size
from tests.benchmarks.workers import Job


def layers(hidden: list[int]) -> dict[str, Any]:
    """Return the settings of an MLP."""
    return {"hidden_size": hidden, "layer_norm": False}


def networks(observations: list[Box], actions: list[Box], names: list[str]) -> tuple[list[Any], list[Any]]:
    """Return an actor and a critic for each agent.

    They have an encoder and a head each, and are made here because by net_config alone they differ in depth.
    """
    first, *rest = HIDDEN
    actors = [
        DeterministicActor(o, a, encoder_config=layers([first]), latent_dim=rest[0], head_config=layers(rest[1:]))
        for o, a in zip(observations, actions, strict=True)
    ]
    joint = Dict(dict(zip(names, observations, strict=True))), Box(-1.0, 1.0, (sum(a.shape[0] for a in actions),))
    critics = [
        ContinuousQNetwork(*joint, encoder_config={"latent_dim": first}, latent_dim=first, head_config=layers(rest))
        for _ in names
    ]
    return actors, critics


def filled_buffer(shape: Shape, names: list[str]) -> ReplayBuffer:
    """Return a replay buffer full of random transitions."""

    def of_agents(*width: int) -> dict[str, torch.Tensor]:
        return {name: torch.randn(ROWS, *width) for name in names}

    memory = ReplayBuffer(ROWS)
    rows = {
        "obs": of_agents(shape.observation),
        "action": {name: values.tanh() for name, values in of_agents(shape.action).items()},
        "reward": of_agents(1),
        "next_obs": of_agents(shape.observation),
        "done": {name: torch.zeros(ROWS, 1) for name in names},
    }
    memory.add(TensorDict(rows, batch_size=[ROWS]))
    return memory


def prepare(shape: Shape, compiled: bool) -> Job:
    """Make agents and fill replay; compiled or eager."""
    shape = Shape(*shape)
    # Not agent_0, agent_1, ...: agents that are named alike up to the last underscore share their networks.
    names = [f"agent{i}" for i in range(shape.agents)]
    observations = [Box(-np.inf, np.inf, (shape.observation,)) for _ in names]
    actions = [Box(-1.0, 1.0, (shape.action,)) for _ in names]
    actors, critics = networks(observations, actions, names)
    maddpg = MADDPG(
        observations,
        actions,
        agent_ids=names,
        actor_networks=actors,
        critic_networks=critics,
        batch_size=shape.batch,
        tau=0.01,
        torch_compiler="default" if compiled else None,
    )
    assert len(maddpg.actors) == len(maddpg.critics) == shape.agents
    memory = filled_buffer(shape, names)
    minibatch = memory.sample(shape.batch)

    def update() -> int:
        maddpg.learn(minibatch)
        return 1

    def replay() -> int:
        maddpg.learn(memory.sample(shape.batch))
        return 1

    own = maddpg.actors[names[0]], maddpg.critics[names[0]]
    return job({"update": update, "replay": replay}, [size(network) for network in own])
