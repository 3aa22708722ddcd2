"""Entity networks: observations and states as sets of entities, so that no permutation of them must be learned anew.

To an MLP "target 0" and "target 1" are different numbers; to these networks they are two of a set. Nothing in them
depends on how many entities there are: one set of weights serves a team of any size among any number of obstacles.

An `Edge` tells receivers what there is around them: for every pair of a receiver and a sender h = relu(W_offset offset
+ W_receiver receiver + W_sender sender), whose terms are computed for each entity and added by broadcasting; the mean
of h over the senders, weighted in each channel by a softmax of a linear map of h; then a linear map.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rllib_maobs.layout import Entities, Layout, flat, layout_size, split
from rllib_maobs.modules.actors import ACTORS, Actor, LSTMActor
from rllib_maobs.modules.critics import CRITICS, Critic
from rllib_maobs.modules.layers import mlp
from rllib_maobs.options import Range, as_list

Width = Annotated[int, Range(1)]
Near = Annotated[float, Range(0.0, exclusive=True)] | None
_FAR = 4.0  # distances are capped here, so that far-off states can't blow up a value
_CLAMP = 2.0  # and so are an agent's own numbers
AGENTS = ("agent", "predator")
DEAF = ("obstacle",)


def squashed(offset: Tensor, near: Near = None) -> Tensor:
    """What networks see of an offset `(..., D)`: its direction times 2 tanh(distance / 2), and the distance up to 4.

    Args:
        offset: Of a sender from a receiver.
        near: A distance at which small things matter. With it they see the offset once more, divided by
            (distance + near): as if through a magnifying glass, which shows a tenth of `near` ten times as large.

    Returns:
        `(..., D + 1)`, with `near` `(..., 2 D + 1)`.
    """
    distance = (offset.square().sum(-1, keepdim=True) + 1e-12).sqrt()
    # 2 tanh(d / 2) by way of the sigmoid: compiled, torch's own tanh takes three times as long.
    scale = (4.0 * torch.sigmoid(distance) - 2.0) / distance
    close = [] if near is None else [offset / (distance + near)]
    return torch.cat([offset * scale, distance.clamp(max=_FAR), *close], dim=-1)


class Edge(nn.Module):
    """What receivers hear from a set of senders.

    Args:
        space: D, dimensions of an offset.
        sender: Numbers that a sender has besides its place; 0 for none.
        receiver: Numbers that a receiver has besides; 0 for none.
        width: Channels.
        near: See `squashed`.
    """

    def __init__(self, space: int, sender: int, receiver: int, width: int, near: Near = None) -> None:
        super().__init__()
        self.width, self.near = width, near
        self.from_offset = nn.Linear(space + 1 if near is None else 2 * space + 1, width)
        self.from_sender = nn.Linear(sender, width, bias=False) if sender else None
        self.from_receiver = nn.Linear(receiver, width, bias=False) if receiver else None
        self.logit, self.value = nn.Linear(width, width), nn.Linear(width, width)

    def forward(
        self,
        offset: Tensor,
        sender: Tensor | None = None,
        receiver: Tensor | None = None,
        absent: Tensor | None = None,
    ) -> Tensor:
        """What each receiver hears.

        Args:
            offset: Of senders from receivers, `(..., R, S, D)`.
            sender: What the senders have besides, `(..., S, F)`.
            receiver: What the receivers have besides, `(..., R, G)`.
            absent: 1.0 for senders that a receiver does not hear, `(..., R, S)` or what broadcasts to it; None if it
                hears all.

        Returns:
            `(..., R, width)`; the value of silence if there are no senders.
        """
        if offset.shape[-2] == 0:
            return self.value(offset.new_zeros(*offset.shape[:-2], self.width))
        # Sums of the small terms first; the bias of the logits is not used: a softmax does not see it.
        others = self.from_offset.bias
        if self.from_receiver is not None and receiver is not None:
            others = others + self.from_receiver(receiver).unsqueeze(-2)
        if self.from_sender is not None and sender is not None:
            others = others + self.from_sender(sender).unsqueeze(-3)
        pairs = torch.relu(F.linear(squashed(offset, self.near), self.from_offset.weight) + others)  # (..., R, S, W)
        logits = F.linear(pairs, self.logit.weight)
        if absent is not None:
            logits = logits - 1e9 * absent.unsqueeze(-1)
        weights = torch.softmax(logits, dim=-2)
        if absent is not None:
            weights = weights * (1.0 - absent.unsqueeze(-1))  # where nobody is there, nothing is heard
        # The values after the pool, not before: one product for each receiver instead of each pair.
        return self.value((weights * pairs).sum(-2))


class Ego(nn.Module):
    """An agent's view of its surroundings, from its own observation: `(..., O)` to `(..., size)`.

    Groups without a position are the agent's own numbers. It hears every other group; those that are neither agents nor
    deaf hear the agents first, so that a target can be known as taken.

    Args:
        layout: What the observation is made of.
        extra: Further numbers of the agent's own, e.g. its action for a critic.
        edge: Width of the edges.
        agents: Names of the groups that are agents.
        deaf: Names of the groups that do not hear the agents.
        near: A distance at which offsets are seen once more, enlarged (`squashed`); None: not.

    Raises:
        ValueError: If the layout has no group with a position; shows how to write one.
    """

    def __init__(
        self,
        layout: Layout,
        extra: int,
        edge: int,
        agents: Sequence[str] = AGENTS,
        deaf: Sequence[str] = DEAF,
        near: Near = None,
    ) -> None:
        super().__init__()
        self.layout = layout
        around = [group for group in layout if group.position]
        check_entities(around, "an observation")
        check_names(agents=agents, deaf=deaf)
        self.own = [group.name for group in layout if not group.position]
        own = layout_size(tuple(group for group in layout if not group.position)) + extra
        self.around = [group.name for group in around]
        self.position = {group.name: group.position for group in around}
        self.mates = [group for group in around if group.name in agents]
        self.listeners = [group.name for group in around if group.name not in (*agents, *deaf)]
        space = around[0].position
        rest = {group.name: group.size - group.position for group in around}
        self.heard = nn.ModuleDict(
            {
                _key(name, mate.name): Edge(space, rest[mate.name], rest[name], edge, near)
                for name in self.listeners
                for mate in self.mates
            }
        )
        told = {name: len(self.mates) * edge if name in self.listeners else 0 for name in self.around}
        self.edges = nn.ModuleDict(
            {_key(name): Edge(space, rest[name] + told[name], own, edge, near) for name in self.around}
        )
        self.size = own + edge * len(self.around)

    def forward(self, observation: Tensor | Mapping[str, Tensor], extra: Tensor | None = None) -> Tensor:
        """The agent's own numbers, and what it hears of each group: `(..., size)`.

        Args:
            observation: `(..., O)`, or its groups `(..., count, size)` by name, of which there may be any number.
            extra: Further numbers of the agent's own.
        """
        absent: dict[str, Tensor] = {}
        if isinstance(observation, Mapping):
            groups, absent = self._never_empty(observation)
        else:
            groups = split(self.layout, observation)
        parts = [groups[name].flatten(-2).clamp(-_CLAMP, _CLAMP) for name in self.own]
        parts += [] if extra is None else [extra]
        own = torch.cat(parts or [groups[self.around[0]].flatten(-2)[..., :0]], dim=-1)
        offsets = {name: _by_coordinate(groups[name][..., : self.position[name]]) for name in self.around}
        rest = {name: groups[name][..., self.position[name] :].clamp(-_CLAMP, _CLAMP) for name in self.around}
        messages = [own]
        for name in self.around:
            sender = rest[name]
            if name in self.listeners:
                told = [
                    self.heard[_key(name, mate.name)](
                        offsets[mate.name].unsqueeze(-3) - offsets[name].unsqueeze(-2),
                        rest[mate.name],
                        rest[name],
                        absent.get(mate.name),
                    )
                    for mate in self.mates
                ]
                sender = _beside(sender, told)
            heard = self.edges[_key(name)](offsets[name].unsqueeze(-3), sender, own.unsqueeze(-2), absent.get(name))
            messages.append(heard.squeeze(-2))
        return torch.cat(messages, dim=-1)

    def _never_empty(self, groups: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Groups with one entity more, which is absent `(..., 1, count + 1)`: ONNX Runtime fails at empty arrays."""
        full, absent = dict(groups), {}
        for name in self.around:
            group = groups[name]
            ghost = group.new_zeros(*group.shape[:-2], 1, group.shape[-1])
            full[name] = torch.cat([group, ghost], dim=-2)
            present = torch.zeros_like(group[..., 0])
            absent[name] = torch.cat([present, ghost[..., 0] + 1.0], dim=-1).unsqueeze(-2)
        return full, absent


class World(nn.Module):
    """Every agent's view of its surroundings, from the world state and actions.

    Args:
        state_layout: What the state is made of; the agents' groups come first.
        action_layout: The agents' groups with their actions, or one agent's action alone.
        num_agents: N.
        edge: Width of the edges.
        deaf: Names of the groups that do not hear the agents.
        near: A distance at which offsets are seen once more, enlarged (`squashed`); None: not.

    Raises:
        ValueError: If the layout has no positions, or its first groups are not N agents.
    """

    def __init__(
        self,
        state_layout: Layout,
        action_layout: Layout,
        num_agents: int,
        edge: int,
        deaf: Sequence[str] = DEAF,
        near: Near = None,
    ) -> None:
        super().__init__()
        around = [group for group in state_layout if group.position]
        check_entities(around, "a state")
        check_names(deaf=deaf)
        self.layout, self.action_layout = state_layout, action_layout
        self.agents = leading(state_layout, num_agents)
        self.joint = sum(group.count for group in action_layout) == num_agents and num_agents > 1
        self.action_size = action_layout[0].size
        self.around = [group.name for group in around]
        self.position = {group.name: group.position for group in around}
        agent = self.agents[0].size - self.agents[0].position  # what an agent has besides its place
        sender = agent + (self.action_size if self.joint else 0)
        names = [group.name for group in self.agents]
        space = around[0].position
        rest = {g.name: sender if g.name in names else g.size - g.position for g in around}
        self.listeners = [name for name in self.around if name not in (*names, *deaf)]
        self.heard = nn.ModuleDict(
            {
                _key(name, mate): Edge(space, rest[mate], rest[name], edge, near)
                for name in self.listeners
                for mate in names
            }
        )
        told = {name: len(names) * edge if name in self.listeners else 0 for name in self.around}
        own = agent + self.action_size
        self.edges = nn.ModuleDict(
            {_key(name): Edge(space, rest[name] + told[name], own, edge, near) for name in self.around}
        )
        self.size = own + edge * len(self.around)

    def forward(self, state: Tensor, action: Tensor, agent: Tensor) -> Tensor:
        """What one agent has and hears.

        What does not depend on `agent` is computed once for all agents whose parameters and inputs are the same.

        Args:
            state: `(..., S)`.
            action: The joint action `(..., N * A)`, or the agent's own `(..., A)`.
            agent: Whose view it is, one-hot `(..., N)`.

        Returns:
            `(..., size)`.
        """
        groups = split(self.layout, state)
        place = {name: _by_coordinate(groups[name][..., : self.position[name]]) for name in self.around}
        rest = {name: groups[name][..., self.position[name] :].clamp(-_CLAMP, _CLAMP) for name in self.around}
        names = [group.name for group in self.agents]
        team_place = torch.cat([place[name] for name in names], dim=-2)  # (..., N, D)
        team_rest = torch.cat([rest[name] for name in names], dim=-2)
        whose = agent.unsqueeze(-1)  # (..., N, 1)
        own_place, own_rest = (whose * team_place).sum(-2), (whose * team_rest).sum(-2)
        own_action = action
        if self.joint:
            actions = action.unflatten(-1, (-1, self.action_size))  # (..., N, A)
            own_action = (whose * actions).sum(-2)
            start = 0
            for group in self.agents:
                rest[group.name] = torch.cat([rest[group.name], actions[..., start : start + group.count, :]], dim=-1)
                start += group.count
        own = torch.cat([own_rest, own_action], dim=-1)
        messages, start = [own], 0
        for name in self.around:
            sender, absent = rest[name], None
            if name in self.listeners:
                told = [
                    self.heard[_key(name, mate)](
                        place[mate].unsqueeze(-3) - place[name].unsqueeze(-2), rest[mate], rest[name]
                    )
                    for mate in names
                ]
                sender = _beside(sender, told)
            if name in names:
                count = place[name].shape[-2]
                absent = agent[..., None, start : start + count]  # an agent does not hear itself
                start += count
            offset = (place[name] - own_place.unsqueeze(-2)).unsqueeze(-3)
            messages.append(self.edges[_key(name)](offset, sender, own.unsqueeze(-2), absent).squeeze(-2))
        return torch.cat(messages, dim=-1)


class EntityActor(Actor):
    """An actor over the entities of an observation; permuting targets, obstacles or team mates changes no action.

    Args:
        layout: What the observation is made of; without positions it is refused.
        num_outputs: A.
        edge: Width of the edges.
        node: Width of the hidden layers after them.
        agents: Names of the groups that are agents.
        deaf: Names of the groups that do not hear the agents.
        near: A distance at which offsets are seen once more, enlarged (`squashed`); None: not.
    """

    takes_groups: ClassVar[bool] = True

    def __init__(
        self,
        layout: Layout,
        num_outputs: int,
        edge: Width = 32,
        node: Width = 64,
        agents: Sequence[str] = AGENTS,
        deaf: Sequence[str] = DEAF,
        near: Near = None,
    ) -> None:
        super().__init__(layout, num_outputs)
        self.ego = Ego(layout, 0, edge, agents, deaf, near)
        self.layers = mlp((self.ego.size, node, node, num_outputs))

    def forward(self, observation: Tensor) -> Tensor:
        """Maps observations `(..., O)` to raw outputs `(..., A)`."""
        return self.layers(self.ego(observation))


class EntityLSTMActor(LSTMActor):
    """An LSTM over a window of what `EntityActor` hears.

    Args:
        layout: What the observation is made of; without positions it is refused.
        num_outputs: A.
        edge: Width of the edges.
        node: Width of the hidden layers.
        cell_size: H, size of h and c.
        agents: Names of the groups that are agents.
        deaf: Names of the groups that do not hear the agents.
        near: A distance at which offsets are seen once more, enlarged (`squashed`); None: not.
    """

    takes_groups: ClassVar[bool] = True

    def __init__(
        self,
        layout: Layout,
        num_outputs: int,
        edge: Width = 32,
        node: Width = 64,
        cell_size: Width = 64,
        agents: Sequence[str] = AGENTS,
        deaf: Sequence[str] = DEAF,
        near: Near = None,
    ) -> None:
        ego = Ego(layout, 0, edge, agents, deaf, near)
        super().__init__(flat(node), num_outputs, (node, node), cell_size=cell_size)
        self.layout, self.ego = layout, ego
        self.encoder = mlp((ego.size, node, node))

    def unroll(self, window: Tensor, mask: Tensor | None = None, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """`RecurrentActor.unroll`: every observation's surroundings first, then the cell."""
        return super().unroll(torch.relu(self.encoder(self.ego(window))), mask, state)


class EntityCritic(Critic):
    """A critic over entities; permuting targets, obstacles or other agents with their actions changes no value.

    A centralised one sees the world state as rows and is told whose value it is to give, so all agents can share it. A
    local one sees its agent's observation as `EntityActor` does, and its action.

    Args:
        state_layout: What the state (or observation) is made of; without positions it is refused.
        action_layout: What the action is made of.
        num_critics: C.
        num_agents: N for a centralised critic; 0 for a local one.
        edge: Width of the edges.
        node: Width of the hidden layers after them.
        agents: Names of the groups that are agents, in an observation.
        deaf: Names of the groups that do not hear the agents.
        near: A distance at which offsets are seen once more, enlarged (`squashed`); None: not.
    """

    asks_whose: ClassVar[bool] = True

    def __init__(
        self,
        state_layout: Layout,
        action_layout: Layout,
        num_critics: int = 1,
        num_agents: int = 0,
        edge: Width = 32,
        node: Width = 64,
        agents: Sequence[str] = AGENTS,
        deaf: Sequence[str] = DEAF,
        near: Near = None,
    ) -> None:
        super().__init__(state_layout, action_layout, num_critics, num_agents)
        views: list[World | Ego] = [
            World(state_layout, action_layout, num_agents, edge, deaf, near)
            if num_agents
            else Ego(state_layout, layout_size(action_layout), edge, agents, deaf, near)
            for _ in range(num_critics)
        ]
        self.views = nn.ModuleList(views)
        self.layers = nn.ModuleList(mlp((view.size, node, node, 1)) for view in views)

    def forward(self, state: Tensor, action: Tensor, agent: Tensor | None = None) -> Tensor:
        """Q of every critic: `(..., S)` and `(..., A)` to `(..., C)`."""
        whose = () if agent is None else (agent,)
        values = [layers(view(state, action, *whose)) for view, layers in zip(self.views, self.layers, strict=True)]
        return values[0] if len(values) == 1 else torch.cat(values, dim=-1)


def _key(*names: str) -> str:
    """A name that a module may have, whatever groups are called; another one for other groups."""
    plain = (name.replace("-", "--").replace(".", "-_").replace("from", "-f") for name in names)
    return "of_" + "_from_".join(plain)


def _by_coordinate(places: Tensor) -> Tensor:
    """The same places `(..., D)`, in memory coordinate by coordinate: loops over two or three numbers are slow."""
    return places.movedim(-1, 0).contiguous().movedim(0, -1)


def _beside(numbers: Tensor, told: list[Tensor]) -> Tensor:
    """What senders have and what they were told, side by side; without a copy where they have nothing else."""
    parts = [numbers, *told] if numbers.shape[-1] else told
    return parts[0] if len(parts) == 1 else torch.cat(parts or [numbers], dim=-1)


def leading(state_layout: Layout, num_agents: int) -> list[Entities]:
    """The first groups of a state, which are the agents.

    Raises:
        ValueError: If they are not N agents in all, with a place and numbers of one size.
    """
    found, groups = 0, []
    for group in state_layout:
        if found >= num_agents:
            break
        groups.append(group)
        found += group.count
    if found != num_agents or len({group[2:] for group in groups}) > 1 or not groups[0].position:
        raise ValueError(
            f"An entity critic needs a state whose first groups are the {num_agents} agents, with a position and "
            f'of one size, not {[tuple(group) for group in state_layout][:4]}: critic_state="world" of an environment '
            f'that says what its state is made of, or training(state_layout=[("agent", {num_agents}, 4, 2), ...]).'
        )
    return groups


def check_entities(around: Sequence[Entities], what: str) -> None:
    """Raises a ValueError if there are no entities with a position; shows how to write a layout."""
    if not around or len({group.position for group in around}) > 1:
        raise ValueError(
            f"Entity networks need {what} that says where things are: groups (name, count, size, position), where the "
            f"first `position` numbers of each entity are its place, the same number in all groups, e.g. "
            f'[("self", 1, 4), ("target", 3, 2, 2), ("agent", 2, 2, 2)]. Give observation_layouts (and with a '
            f'centralised critic critic_state="world" and state_layout) to config.training().'
        )


def check_names(**settings: Any) -> None:
    """Raises a ValueError if what should name groups does not list texts."""
    for setting, names in settings.items():
        listed = as_list(names)
        if listed is None or not all(isinstance(name, str) for name in listed):
            raise ValueError(f"{setting}={names!r} is illegal; legal: a list of names of groups, such as ['agent']")


ACTORS.register("entity", EntityActor)
ACTORS.register("entity-lstm", EntityLSTMActor)
CRITICS.register("entity", EntityCritic)
