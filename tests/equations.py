"""Every algorithm's losses, written from the equations as loops over agents in plain PyTorch.

It shares no code with the package but the names of a minibatch's parts: networks are lists of weight matrices taken
from its modules, nothing is stacked, padded or masked: windows are unrolled by `torch.nn.LSTMCell` over the
observations that count and no others, agents with shorter observations get theirs without the padding, and agents that
share a policy use the very same tensors, so that autograd adds their gradients up.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from rllib_maobs.replay import Batch, Moment
from tests import entities

Layers = list[Tensor]  # weight, bias, weight, bias, ...


def leaves(network: nn.Module) -> Layers:
    """A network's parameters as tensors of our own; a critic's first weight, kept in two parts, is put together."""
    tensors = [p.detach().clone() for p in network.parameters()]
    if hasattr(network, "from_state"):
        tensors = [torch.cat(tensors[:2], dim=1), *tensors[2:]]
    return [t.requires_grad_() for t in tensors]


def mlp(layers: Layers, x: Tensor) -> Tensor:
    for i in range(0, len(layers), 2):
        x = layers[i] @ x + layers[i + 1]
        if i < len(layers) - 2:
            x = x.clamp(min=0.0)
    return x


def lstm(layers: Layers, observations: Tensor, start: Tensor | None) -> Tensor:
    """An LSTM cell from h and c `(2, H)`, or from zero, over observations `(t, O)`, then the other layers."""
    weight, bias, recurrent, *rest = layers
    size = recurrent.shape[1]
    cell = nn.LSTMCell(observations.shape[1], size)
    own = {"weight_ih": weight, "bias_ih": bias, "weight_hh": recurrent, "bias_hh": torch.zeros(4 * size)}
    h, c = torch.zeros(2, size) if start is None else start
    for x in observations:
        h, c = functional_call(cell, own, (x, (h, c)))
    return mlp(rest, h)


class Equations:
    """Losses and gradients of a learner's algorithm, for its present parameters."""

    def __init__(self, learner: Any) -> None:
        self.config = learner.config
        team = self.config.team
        self.agents = range(len(team.agents))
        self.sizes, self.actions = team.observation_sizes, team.action_sizes
        self.discrete, self.name = team.discrete, self.config.name
        modules = {mid: learner.module[mid] for mid in self.config.module_ids}
        self.modules = [modules[mid] for mid in self.config.module_ids]
        kinds = ["utility"] if hasattr(next(iter(modules.values())), "utility") else ["actor", "critic"]
        self.nets: dict[str, list[Layers]] = {}
        self.optimizers: dict[str, torch.optim.Adam] = {}
        for kind in (*kinds, *(f"target_{kind}" for kind in kinds)):
            own = {mid: leaves(getattr(module, kind)) for mid, module in modules.items()}
            first = own[self.config.module_ids[0]]
            tied = kind.endswith("critic") and getattr(self.config, "critic_source", "") == "shared"
            self.nets[kind] = [first if tied else own[mid] for mid in self.config.module_ids]
        self.mixers: list[dict[str, Tensor]] = []
        self.target_mixers: list[dict[str, Tensor]] = []
        if "mixer" in learner.module:
            for kind, mixers in (("mixers", self.mixers), ("target_mixers", self.target_mixers)):
                for network in getattr(learner.module["mixer"], kind):
                    mixers.append({n: p.detach().clone().requires_grad_() for n, p in network.named_parameters()})

    # What the networks see.

    def seen(self, moment: Moment, row: int, agent: int) -> Tensor:
        """What an agent sees: its observations `(t, O)`, the last one being the present one."""
        size = self.sizes[agent]
        if moment.window is not None and moment.mask is not None:
            counts = int(moment.mask[row].sum())
            return moment.window[row, agent, -counts:, :size]
        return moment.obs[row, None, agent, :size]

    def output(self, kind: str, moment: Moment, row: int, agent: int) -> Tensor:
        observations, layers = self.seen(moment, row, agent), self.nets[kind][agent]
        if self.config.actor.startswith("entity"):
            return self.entity_output(kind, layers, observations, agent)
        if self.config.actor == "mlp":
            return mlp(layers, observations[-1])
        start = None if moment.recurrent_state is None else moment.recurrent_state[row, agent]
        return lstm(layers, observations, start)

    def entity_output(self, kind: str, layers: Layers, observations: Tensor, agent: int) -> Tensor:
        network = getattr(self.modules[agent], kind)
        p = dict(zip(dict(network.named_parameters()), layers, strict=True))
        near = self.config.actor_settings.get("near")
        seen = [entities.ego(p, "ego", network.layout, x, None, near) for x in observations]
        if self.config.actor == "entity":
            return entities.layers(p, "layers", seen[-1])
        encoded = torch.stack([entities.layers(p, "encoder", x).clamp(min=0.0) for x in seen])
        names = ("from_observation.weight", "from_observation.bias", "from_hidden.weight")
        rest = [tensor for name, tensor in p.items() if name.startswith("layers.")]
        return lstm([*(p[name] for name in names), *rest], encoded, None)

    def entity_critic(self, layers: Layers, x: Tensor, u: Tensor, agent: int) -> Tensor:
        network = self.modules[agent].critic
        p = dict(zip(dict(network.named_parameters()), layers, strict=True))
        values, near = [], self.config.critic_settings.get("near")
        for c in range(network.num_critics):
            if self.config.central_critic:
                joint = "joint_action" in self.config.critic_sees
                count = len(self.agents)
                view = entities.world(p, f"views.{c}", network.state_layout, x, u, agent, count, joint, near)
            else:
                view = entities.ego(p, f"views.{c}", network.state_layout, x, u, near)
            values.append(entities.layers(p, f"layers.{c}", view))
        return torch.cat(values)

    def state(self, moment: Moment, row: int) -> Tensor:
        if moment.state is not None:
            return moment.state[row]
        ids = len(self.agents) if self.config.agent_id_input else 0
        return torch.cat([self.seen(moment, row, a)[-1][ids:] for a in self.agents])

    def next_action(self, sample: Batch, row: int, agent: int) -> Tensor:
        output = self.output("target_actor", sample.next, row, agent)
        if self.discrete:
            return torch.eye(len(output))[output.argmax()]
        action = torch.tanh(output)
        if self.config.target_noise:
            limit = self.config.target_noise_clip
            noise = sample.noise[row, agent, : len(action)] * self.config.target_noise
            action = (action + noise.clamp(-limit, limit)).clamp(-1, 1)
        return action

    def action(self, sample: Batch, row: int, agent: int) -> tuple[Tensor, Tensor]:
        """The current action of an agent, through which its actor learns, and the output before tanh."""
        output = self.output("actor", sample.now, row, agent)
        if not self.discrete:
            return torch.tanh(output), output
        uniform = sample.noise[row, agent, : len(output)]
        soft = torch.softmax((output - torch.log(-torch.log(uniform))) / self.config.gumbel_temperature, 0)
        return torch.eye(len(output))[soft.argmax()] - soft.detach() + soft, output

    def q(self, kind: str, moment: Moment, row: int, agent: int, joint: list[Tensor]) -> Tensor:
        """Q of one agent's critics in the joint action, one for each of its twins."""
        if self.config.critic == "entity":
            seen = self.seen(moment, row, agent)[-1] if self.name == "iddpg" else self.state(moment, row)
            u = torch.cat(joint) if "joint_action" in self.config.critic_sees else joint[agent]
            return self.entity_critic(self.nets[kind][agent], seen, u, agent)
        ids = self.config.agent_id_input and self.config.uses_state
        own = [torch.eye(len(self.agents))[agent]] if ids else []
        if self.name == "iddpg":
            x = torch.cat([self.seen(moment, row, agent)[-1], joint[agent]])
        elif self.name == "maddpg-l":
            padding = [torch.zeros(max(self.actions) - len(joint[agent]))]
            x = torch.cat([self.state(moment, row), joint[agent], *padding, *own])
        else:
            padded = [torch.cat([u, torch.zeros(max(self.actions) - len(u))]) for u in joint]
            x = torch.cat([self.state(moment, row), *padded, *own])
        return self.critic(self.nets[kind][agent], x)

    def critic(self, layers: Layers, x: Tensor) -> Tensor:
        first, bias, *rest = layers
        heads = 2 if self.config.twin_critics else 1
        width, depth = len(bias) // heads, len(rest) // heads
        return torch.cat(
            [
                mlp(
                    [
                        first[h * width : (h + 1) * width],
                        bias[h * width : (h + 1) * width],
                        *rest[h * depth : (h + 1) * depth],
                    ],
                    x,
                )
                for h in range(heads)
            ]
        )

    def mixed(self, mixer: dict[str, Tensor], values: list[Tensor], state: Tensor) -> Tensor:
        """ELU(q W_1(s) + b_1(s)) w_2(s) + b_2(s), in sums over agents and mixing units."""
        generated = {n: mixer[f"{n}.weight"] @ state + mixer[f"{n}.bias"] for n in ("weight_1", "bias_1", "weight_2")}
        if self.name == "qmix":
            generated["weight_1"], generated["weight_2"] = generated["weight_1"].abs(), generated["weight_2"].abs()
        units = len(generated["bias_1"])
        total = mlp([mixer[f"bias_2.{n}"] for n in ("0.weight", "0.bias", "2.weight", "2.bias")], state)[0]
        for unit in range(units):
            x = generated["bias_1"][unit]
            for agent, value in enumerate(values):
                x = x + value * generated["weight_1"][agent * units + unit]
            total = total + torch.where(x > 0, x, torch.exp(x) - 1) * generated["weight_2"][unit]
        return total

    # The losses.

    def losses(self, sample: Batch, stage: str = "") -> tuple[list[Tensor], list[Tensor]]:
        """The critics' and the actors' losses, one for each agent or one for the team."""
        rewards = sample.rewards * self.config.reward_scale
        rows = range(len(rewards))
        critic: dict[int, list[Tensor]] = {}
        actor: dict[int, list[Tensor]] = {}
        for row in rows:
            r, discount = rewards[row], sample.discount[row]  # (N,) each
            if self.name in ("iql", "vdn", "qmix"):
                self.q_learning(sample, row, r, discount, critic)
                continue
            taken = [sample.actions[row, a, : self.actions[a]] for a in self.agents]
            nexts = [self.next_action(sample, row, a).detach() for a in self.agents]
            now, outputs = zip(*(self.action(sample, row, a) for a in self.agents), strict=True)
            for a in self.agents:
                regular = self.config.action_regularization * outputs[a].square().sum() / max(self.actions)
                actor.setdefault(-1, []).append(regular)
            if self.name == "facmac":
                self.facmac(sample, row, r, discount, taken, nexts, now, stage, critic, actor)
                continue
            for a in self.agents:
                y = r[a] + discount[a] * self.q("target_critic", sample.next, row, a, nexts).min().detach()
                q = self.q("critic", sample.now, row, a, taken)
                critic.setdefault(a, []).append((y - q).square().sum())
                others = getattr(self.config, "other_agents_actions", "replay")
                fixed = taken if others == "replay" else [u.detach() for u in now] if others == "current" else now
                joint = [now[b] if a == b else fixed[b] for b in self.agents]
                actor.setdefault(a, []).append(-self.q("critic", sample.now, row, a, joint)[0])
        self.regular = torch.stack(actor.pop(-1)).sum() / len(rows) if actor else torch.zeros(())

        def mean(parts: dict[int, list[Tensor]]) -> list[Tensor]:
            return [torch.stack(terms).mean() for _, terms in sorted(parts.items())]

        return mean(critic), mean(actor)

    def facmac(
        self,
        sample: Batch,
        row: int,
        r: Tensor,
        discount: Tensor,
        taken: list[Tensor],
        nexts: list[Tensor],
        now: tuple[Tensor, ...],
        stage: str,
        critic: dict[int, list[Tensor]],
        actor: dict[int, list[Tensor]],
    ) -> None:
        own = self.config.critic_source == "own"

        def local(kind: str, judge: int, judged: int, u: Tensor, moment: Moment) -> Tensor:
            if self.config.critic == "entity":
                return self.entity_critic(self.nets[kind][judge], self.seen(moment, row, judged)[-1], u, judged)[0]
            x = torch.cat([self.seen(moment, row, judged)[-1], u])
            return self.critic(self.nets[kind][judge], x)[0]

        if stage == "local":
            for a in self.agents:
                y = r[a] + discount[a] * local("target_critic", a, a, nexts[a], sample.next).detach()
                critic.setdefault(a, []).append((y - local("critic", a, a, taken[a], sample.now)).square())
                actor.setdefault(a, []).append(-local("critic", a, a, now[a], sample.now))
            return
        for m, (mixer, target_mixer) in enumerate(zip(self.mixers, self.target_mixers, strict=True)):
            values = [local("target_critic", m if own else j, j, nexts[j], sample.next) for j in self.agents]
            y = r[0] + max(discount) * self.mixed(target_mixer, values, self.state(sample.next, row)).detach()
            values = [local("critic", m if own else j, j, taken[j], sample.now) for j in self.agents]
            critic.setdefault(m, []).append((y - self.mixed(mixer, values, self.state(sample.now, row))).square())
            current = [now[j].detach() if own and j != m else now[j] for j in self.agents]
            values = [local("critic", m if own else j, j, current[j], sample.now) for j in self.agents]
            actor.setdefault(m, []).append(-self.mixed(mixer, values, self.state(sample.now, row)))

    def q_learning(self, sample: Batch, row: int, r: Tensor, discount: Tensor, critic: dict[int, list[Tensor]]) -> None:
        values, nexts = [], []
        for a in self.agents:
            values.append(self.output("utility", sample.now, row, a)[sample.actions[row, a].argmax()])
            after = self.output("target_utility", sample.next, row, a).detach()
            judge = self.output("utility", sample.next, row, a) if self.config.double_q else after
            nexts.append(after[judge.argmax()])
        if self.name == "iql":
            for a in self.agents:
                critic.setdefault(a, []).append((r[a] + discount[a] * nexts[a] - values[a]).square())
            return
        if self.name == "vdn":
            q, next_q = sum(values), sum(nexts)
        else:
            q = self.mixed(self.mixers[0], values, self.state(sample.now, row))
            next_q = self.mixed(self.target_mixers[0], nexts, self.state(sample.next, row)).detach()
        critic.setdefault(0, []).append((r[0] + max(discount) * next_q - q).square())

    def gradients(self, sample: Batch, stage: str = "") -> dict[str, Any]:
        """Losses by role, and gradients: of every distinct network a list, in the order of its parameters."""
        critic, actor = self.losses(sample, stage)
        kind = "utility" if "utility" in self.nets else "critic"
        result: dict[str, Any] = {"critic_loss": [x.item() for x in critic], "actor_loss": [x.item() for x in actor]}

        def distinct(nets: list[Layers]) -> list[Layers]:
            return list({id(net): net for net in nets}.values())

        def gradient(total: Tensor, nets: list[Layers]) -> list[Layers]:
            flat = [tensor for net in nets for tensor in net]
            found = iter(torch.autograd.grad(total, flat, retain_graph=True, allow_unused=True))
            return [[torch.zeros_like(t) if (g := next(found)) is None else g for t in net] for net in nets]

        total = torch.stack(critic).sum()
        result["critic"] = gradient(total, distinct(self.nets[kind]))
        if self.mixers and stage != "local":
            result["mixer"] = gradient(total, [list(mixer.values()) for mixer in self.mixers])
        if not actor:
            return result
        # Where a loss is one agent's alone, the others' actions in it are constants: the sum keeps the gradients apart.
        result["actor"] = gradient(torch.stack(actor).sum() + self.regular, distinct(self.nets["actor"]))
        return result

    def update(self, sample: Batch) -> None:
        """One update: gradients of both roles from the same parameters, then Adam, then Polyak averaging."""
        found = self.gradients(sample)
        for role in ("critic", "actor"):
            online, target = (list({id(n): n for n in self.nets[f"{p}{role}"]}.values()) for p in ("", "target_"))
            flat = [tensor for net in online for tensor in net]
            if role not in self.optimizers:
                self.optimizers[role] = torch.optim.Adam(flat, lr=getattr(self.config, f"{role}_lr"))
            for tensor, gradient in zip(flat, [g for net in found[role] for g in net], strict=True):
                tensor.grad = gradient
            self.optimizers[role].step()
            with torch.no_grad():
                for tensor, moved in zip([t for net in target for t in net], flat, strict=True):
                    tensor.lerp_(moved, self.config.tau)
