"""Plain DDPG-family learning, written from the equations as a loop over agents in ordinary PyTorch.

It is the baseline for speed, so it shares no code with the package:
every agent has its own networks and its own two Adam optimisers, and nothing is stacked.
"""

import copy

import torch
from torch import Tensor, nn

Sample = dict[str, Tensor]
"""obs, next_obs (B, N, O); state, next_state (B, S); actions (B, N, A); rewards (B, N); terminated (B, N)."""


def network(inputs: int, outputs: int, hidden: tuple[int, ...], last: nn.Module) -> nn.Sequential:
    sizes = (inputs, *hidden, outputs)
    layers: list[nn.Module] = []
    for i in range(len(sizes) - 1):
        layers += [nn.Linear(sizes[i], sizes[i + 1]), nn.ReLU()]
    return nn.Sequential(*layers[:-1], last)


class LoopLearner:
    """IDDPG, MADDPG or MADDPG-L for N agents, one after the other."""

    def __init__(
        self,
        algorithm: str,
        num_agents: int,
        observation_size: int,
        action_size: int,
        state_size: int,
        *,
        others: str = "replay",
        hidden: tuple[int, ...] = (64, 64, 64),
        actor_lr: float = 1e-3,
        critic_lr: float = 1e-2,
        gamma: float = 0.95,
        tau: float = 0.01,
    ) -> None:
        self.algorithm, self.others, self.gamma, self.tau = algorithm, others, gamma, tau
        self.agents = range(num_agents)
        critic_input = {
            "iddpg": observation_size + action_size,
            "maddpg": state_size + num_agents * action_size,
            "maddpg-l": state_size + action_size,
        }[algorithm]
        self.actors = [network(observation_size, action_size, hidden, nn.Tanh()) for _ in self.agents]
        self.critics = [network(critic_input, 1, hidden, nn.Identity()) for _ in self.agents]
        self.target_actors, self.target_critics = copy.deepcopy(self.actors), copy.deepcopy(self.critics)
        self.actor_optimizers = [torch.optim.Adam(net.parameters(), lr=actor_lr) for net in self.actors]
        self.critic_optimizers = [torch.optim.Adam(net.parameters(), lr=critic_lr) for net in self.critics]

    def critic_input(self, a: int, obs: Tensor, state: Tensor, actions: list[Tensor]) -> Tensor:
        if self.algorithm == "iddpg":
            return torch.cat([obs[:, a], actions[a]], dim=1)
        if self.algorithm == "maddpg":
            return torch.cat([state, *actions], dim=1)
        return torch.cat([state, actions[a]], dim=1)

    def critic_loss(self, a: int, s: Sample, next_actions: list[Tensor]) -> Tensor:
        with torch.no_grad():
            next_q = self.target_critics[a](self.critic_input(a, s["next_obs"], s["next_state"], next_actions))
            y = s["rewards"][:, a : a + 1] + self.gamma * (1 - s["terminated"][:, a : a + 1]) * next_q
        actions = [s["actions"][:, b] for b in self.agents]
        return ((y - self.critics[a](self.critic_input(a, s["obs"], s["state"], actions))) ** 2).mean()

    def actor_loss(self, a: int, s: Sample) -> Tensor:
        """Agent a's own loss: the gradient to its own actor is what it learns from ("replay", "current")."""
        actions = [s["actions"][:, b] for b in self.agents]
        if self.others != "replay":
            actions = [self.actors[b](s["obs"][:, b]) for b in self.agents]
            if self.others == "current":
                actions = [u.detach() for u in actions]
        if self.others != "joint":
            actions[a] = self.actors[a](s["obs"][:, a])
        return -self.critics[a](self.critic_input(a, s["obs"], s["state"], actions)).mean()

    def gradients(self, s: Sample) -> tuple[list[list[Tensor]], list[list[Tensor]], list[float], list[float]]:
        """Every agent's actor and critic gradients, and its actor and critic loss, before any step."""
        with torch.no_grad():
            next_actions = [self.target_actors[b](s["next_obs"][:, b]) for b in self.agents]
        critic_losses = [self.critic_loss(a, s, next_actions) for a in self.agents]
        critic = [
            list(torch.autograd.grad(loss, list(self.critics[a].parameters())))
            for a, loss in zip(self.agents, critic_losses, strict=True)
        ]
        actor_losses = [self.actor_loss(a, s) for a in self.agents]
        if self.others == "joint":
            total = torch.stack(actor_losses).sum()
            actor = [
                list(torch.autograd.grad(total, list(self.actors[a].parameters()), retain_graph=True))
                for a in self.agents
            ]
        else:
            actor = [
                list(torch.autograd.grad(loss, list(self.actors[a].parameters())))
                for a, loss in zip(self.agents, actor_losses, strict=True)
            ]
        return actor, critic, [x.item() for x in actor_losses], [x.item() for x in critic_losses]

    def update(self, s: Sample) -> None:
        """One update of all agents: both losses from the same parameters, then all step, then targets move."""
        actor, critic, _, _ = self.gradients(s)
        for nets, optimizers, gradients in (
            (self.critics, self.critic_optimizers, critic),
            (self.actors, self.actor_optimizers, actor),
        ):
            for a in self.agents:
                for p, g in zip(nets[a].parameters(), gradients[a], strict=True):
                    p.grad = g
                optimizers[a].step()
        with torch.no_grad():
            for nets, targets in ((self.actors, self.target_actors), (self.critics, self.target_critics)):
                for net, target in zip(nets, targets, strict=True):
                    for p, q in zip(net.parameters(), target.parameters(), strict=True):
                        q.mul_(1 - self.tau).add_(self.tau * p)
