"""All agents' actors and critics as stacks: the place that knows what each kind of network is called with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn

from rllib_maobs.layout import layout_size
from rllib_maobs.modules.actors import Actor, RecurrentActor, unrolled
from rllib_maobs.modules.agent import Seen
from rllib_maobs.modules.critics import Critic, splits
from rllib_maobs.modules.stack import Input, Params, PerAgent, Shared, Stack


class Actors(Stack):
    """The actors of N agents, recurrent or not.

    Args:
        networks: Every agent's; one that is listed several times is shared.
        names: What to call each in messages.
        like: The stack of the networks that these are copies of.

    Raises:
        ValueError: If some are recurrent and others are not, or one can't be stacked.
    """

    def __init__(self, networks: Sequence[nn.Module], names: Sequence[str], like: Stack | None = None) -> None:
        self.recurrent = isinstance(networks[0], RecurrentActor)
        for net, name in zip(networks, names, strict=True):
            if isinstance(net, RecurrentActor) != self.recurrent:
                raise ValueError(
                    f"All agents' actors must be recurrent, or none: {names[0]} is a {type(networks[0]).__name__}, "
                    f"{name} a {type(net).__name__}."
                )
        super().__init__(networks, (_respond,), names, like=like)
        self._width = max(layout_size(net.layout) for net in networks if isinstance(net, Actor))

    def outputs(self, params: Params, seen: Seen) -> tuple[Tensor, Tensor | None]:
        """Raw outputs of what the agents see, with given parameters.

        Args:
            params: Stacked parameters.
            seen: Observations `(B, N, O)`, or windows `(B, N, T, O)` with a mask `(B, T)` and states `(B, N, *H)`.

        Returns:
            `(B, N, A)`, and the states with which the windows end `(B, N, *H)`; None if not recurrent.
        """
        result = self(params, *self._inputs(seen), function=_respond)
        return result if self.recurrent else (result, None)

    def respond(self, seen: Seen) -> tuple[Tensor, Tensor | None]:
        """`outputs` with the present parameters, without gradients and fast (see `Stack.act`)."""
        result = self.act(*self._inputs(seen), function=_respond)
        return result if self.recurrent else (result, None)

    def _inputs(self, seen: Seen) -> list[Input]:
        _check_width("observations", seen.obs, self._width)
        inputs: list[Input] = [PerAgent(seen.obs)]
        if seen.mask is not None:
            inputs.append(Shared(seen.mask))
        if seen.recurrent_state is not None:
            inputs.append(PerAgent(seen.recurrent_state))
        return inputs


class Critics(Stack):
    """The critics of N agents.

    Args:
        networks: Every agent's; one that is listed several times is shared.
        names: What to call each in messages.
        tie: Whether all agents are to share the parameters of the first.
        like: The stack of the networks that these are copies of.
    """

    def __init__(
        self, networks: Sequence[nn.Module], names: Sequence[str], tie: bool = False, like: Stack | None = None
    ) -> None:
        super().__init__(networks, (_encode, _value, _whole), names, tie, like)
        self._widths = tuple(
            max(layout_size(getattr(net, f"{part}_layout")) for net in networks) for part in ("state", "action")
        )
        # Encodings of several kinds of critics would differ in what they are.
        self.encodes = len(self._groups) == 1 and isinstance(networks[0], Critic) and splits(type(networks[0]))

    def encode(self, params: Params, state: Input) -> Input:
        """What of the values depends on the state alone, `(B, N, ...)`; the state itself if critics do not split."""
        _check_width("states", state.tensor, self._widths[0])
        return PerAgent(self(params, state, function=_encode)) if self.encodes else state

    def values(self, params: Params, encoded: Input, action: Input, agents: Tensor | None = None) -> Tensor:
        """Every agent's Q.

        Args:
            params: Stacked parameters.
            encoded: Of `encode`.
            action: What they see of the actions.
            agents: One-hot vectors of whose values they are `(N, N)`, if the critics are told.

        Returns:
            `(B, N, C)`.
        """
        _check_width("actions", action.tensor, self._widths[1])
        whose = [] if agents is None else [PerAgent(agents, 0)]
        result: Tensor = self(params, encoded, action, *whose, function=_value if self.encodes else _whole)
        return result


def _respond(actor: Actor, obs: Tensor, *rest: Tensor) -> Any:
    """What an actor is called for; observations of smaller agents come padded."""
    obs = _without_padding(obs, layout_size(actor.layout))
    return unrolled(actor, obs, *rest) if isinstance(actor, RecurrentActor) else actor(obs)


def _encode(critic: Critic, state: Tensor) -> Tensor:
    return critic.encode(_without_padding(state, layout_size(critic.state_layout)))


def _value(critic: Critic, encoded: Tensor, action: Tensor, *agent: Tensor) -> Tensor:
    return critic.value(encoded, _without_padding(action, layout_size(critic.action_layout)), *agent)


def _whole(critic: Critic, state: Tensor, action: Tensor, *agent: Tensor) -> Tensor:
    state = _without_padding(state, layout_size(critic.state_layout))
    value: Tensor = critic(state, _without_padding(action, layout_size(critic.action_layout)), *agent)
    return value


def _check_width(what: str, tensor: Tensor, width: int) -> None:
    """Raises a ValueError unless the largest network sees all that is given: padding must not hide a mistake."""
    if tensor.shape[-1] != width:
        raise ValueError(f"The networks see {what} of {width} numbers, but are given {tensor.shape[-1]}.")


def _without_padding(vector: Tensor, size: int) -> Tensor:
    return vector if vector.shape[-1] == size else vector[..., :size]
