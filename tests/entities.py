"""Entity networks from their description, pair by pair in loops; shares no code with the package.

Parameters are looked up by the names of the package's modules, everything else is written anew.
"""

import math

import torch
from torch import Tensor

Named = dict[str, Tensor]
AGENTS, DEAF = ("agent", "predator"), ("obstacle",)


def linear(p: Named, name: str, x: Tensor) -> Tensor:
    bias = p.get(f"{name}.bias")
    return p[f"{name}.weight"] @ x + (0.0 if bias is None else bias)


def layers(p: Named, name: str, x: Tensor) -> Tensor:
    indices = sorted({int(key[len(name) + 1 :].split(".")[0]) for key in p if key.startswith(f"{name}.")})
    for index in indices:
        x = linear(p, f"{name}.{index}", x)
        if index != indices[-1]:
            x = x.clamp(min=0.0)
    return x


def squash(offset: Tensor, near: float | None) -> Tensor:
    distance = math.sqrt(sum(float(o) ** 2 for o in offset) + 1e-12)
    enlarged = [] if near is None else [float(o) / (distance + near) for o in offset]
    directed = [float(o) / distance * 2 * math.tanh(distance / 2) for o in offset]
    return torch.tensor([*directed, min(distance, 4.0), *enlarged])


def heard(p: Named, name: str, senders: list[tuple[Tensor, Tensor]], receiver: Tensor, near: float | None) -> Tensor:
    """Pool over senders (offset, features), a softmax in each channel; nothing without senders; then the value."""
    width = len(p[f"{name}.value.bias"])
    values, logits = [], []
    for offset, features in senders:
        x = linear(p, f"{name}.from_offset", squash(offset, near))
        if len(features):
            x = x + linear(p, f"{name}.from_sender", features)
        if len(receiver):
            x = x + linear(p, f"{name}.from_receiver", receiver)
        x = x.clamp(min=0.0)
        values.append(x)
        logits.append(linear(p, f"{name}.logit", x))
    out = []
    for channel in range(width):
        if not senders:
            out.append(torch.zeros(()))
            continue
        weights = [torch.exp(logit[channel] - max(float(other[channel]) for other in logits)) for logit in logits]
        out.append(sum(w * v[channel] for w, v in zip(weights, values, strict=True)) / sum(weights))
    return linear(p, f"{name}.value", torch.stack(out))


def cut(layout: list, x: Tensor) -> dict[str, list[tuple[Tensor, Tensor]]]:
    """Entities of each group as (place, other numbers clamped to 2)."""
    groups: dict[str, list[tuple[Tensor, Tensor]]] = {}
    start = 0
    for name, count, size, position in layout:
        groups[name] = []
        for _ in range(count):
            own = x[start : start + size]
            groups[name].append((own[:position], own[position:].clamp(-2.0, 2.0)))
            start += size
    return groups


def ego(p: Named, name: str, layout: list, x: Tensor, extra: Tensor | None, near: float | None) -> Tensor:
    groups = cut(layout, x)
    own = torch.cat([rest for group in layout if not group[3] for _, rest in groups[group[0]]])
    own = own if extra is None else torch.cat([own, extra])
    around = [group[0] for group in layout if group[3]]
    mates = [g for g in around if g in AGENTS]
    parts = [own]
    for g in around:
        senders = []
        for place, rest in groups[g]:
            if g not in (*AGENTS, *DEAF):
                for mate in mates:
                    told = [(other - place, features) for other, features in groups[mate]]
                    rest = torch.cat(
                        [rest, heard(p, f"{name}.heard.of_{g}_from_{mate}", told, _own(groups[g], place), near)]
                    )
            senders.append((place, rest))
        parts.append(heard(p, f"{name}.edges.of_{g}", senders, own, near))
    return torch.cat(parts)


def _own(group: list[tuple[Tensor, Tensor]], place: Tensor) -> Tensor:
    return next(rest for where, rest in group if where is place)


def world(
    p: Named,
    name: str,
    layout: list,
    x: Tensor,
    action: Tensor,
    agent: int,
    agents: int,
    joint: bool,
    near: float | None,
) -> Tensor:
    groups = cut(layout, x)
    names, count = [], 0
    for group in layout:
        if count < agents:
            names.append(group[0])
            count += group[1]
    size = len(action) // agents if joint else len(action)
    own_action = action[agent * size : (agent + 1) * size] if joint else action
    team = [entity for g in names for entity in groups[g]]
    me = team[agent]
    own = torch.cat([me[1], own_action])
    index = 0
    told_of: dict[str, list[tuple[Tensor, Tensor, int]]] = {}
    for g in names:
        told_of[g] = []
        for place, rest in groups[g]:
            features = torch.cat([rest, action[index * size : (index + 1) * size]]) if joint else rest
            told_of[g].append((place, features, index))
            index += 1
    parts = [own]
    for group in layout:
        g = group[0]
        if not group[3]:
            continue
        if g in names:
            senders = [(place - me[0], features) for place, features, who in told_of[g] if who != agent]
        else:
            senders = []
            for place, rest in groups[g]:
                whole = rest
                if g not in DEAF:
                    for mate in names:
                        told = [(other - place, features) for other, features, _ in told_of[mate]]
                        whole = torch.cat([whole, heard(p, f"{name}.heard.of_{g}_from_{mate}", told, rest, near)])
                senders.append((place - me[0], whole))
        parts.append(heard(p, f"{name}.edges.of_{g}", senders, own, near))
    return torch.cat(parts)
