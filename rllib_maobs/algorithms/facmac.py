"""FACMAC: local critics, mixed without constraint into the value of the joint action (paper, section II.D)."""

from __future__ import annotations

from typing import Any, Literal, Self

from ray.rllib.algorithms.algorithm_config import NotProvided
from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import Abilities, JointConfig, in_range, one_of
from rllib_maobs.learner import JointLearner
from rllib_maobs.modules import Params
from rllib_maobs.terms import Batch, Nets

CRITIC_SOURCES = ("shared", "others", "own")
LOCAL = "local"  # the training stage before the mixer


class FACMACLearner(JointLearner):
    """Equations 7 to 9, and for the two stages of figure 7, 13 and 14."""

    @override(JointLearner)
    def critic_loss(self, nets: Nets, target: Nets, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Eq. 8: L(phi, psi) = E[(y - Q_tot)^2], y = r + gamma Q'_tot(tau', mu'(tau'), s').

        Before `mixer_start`: IDDPG's, every local critic with a target of its own.
        """
        next_actions = self.next_actions(target.actor, batch)  # (B, N, A)
        next_q = self.local_q(target.critic, self.local_encode(target.critic, batch.next_obs), next_actions)
        encoded = self.local_encode(nets.critic, batch.obs)
        q = self.local_q(nets.critic, encoded, batch.actions)  # (B, N) or (B, N, N)
        if self.stage == LOCAL:
            y = batch.rewards + batch.discount * self.of_itself(next_q)  # (B, N)
            return (y - self.of_itself(q)).square().mean(0), self.of_itself(q), encoded  # (N,)
        y = batch.rewards[:, :1] + batch.discount * self.mix(target.mixer, next_q, batch.next_state)  # (B, M)
        q_tot = self.mix(nets.mixer, q, batch.state)  # (B, M)
        return (y - q_tot).square().mean(0), q_tot, encoded  # (M,)

    @override(JointLearner)
    def actor_loss(self, actions: Tensor, nets: Nets, encoded: Tensor, batch: Batch) -> Tensor:
        """Eq. 9 and 14: grad J(mu) = E[grad mu grad_mu Q_tot(tau, mu_1(tau_1)..mu_N(tau_N), s)], as a loss.

        Before `mixer_start`, eq. 13: grad J(mu_a) = E[grad mu_a grad_u Q_a(o_a, u) at u = mu_a(o_a)].
        """
        if self.config.critic_source == "own":
            # Q_tot^a is of agent a alone: all current actions are in it, the gradient goes to a's.
            actions = self.own_actions(actions, actions.detach())  # (B, N, N, A)
        q = self.local_q(nets.critic, encoded, actions)
        if self.stage == LOCAL:
            return -self.of_itself(q).mean(0)  # (N,)
        return -self.mix(nets.mixer, q, batch.state).mean(0)  # (M,)

    def local_encode(self, critic: Params, obs: Tensor) -> Tensor:
        """What the local critics see of the observations: `(B, N, H)`, or of every critic on each `(B, N, N, H)`."""
        if self.config.critic_source == "own":
            return self.critics(critic, (obs, None), method="encode")
        return self.encode(critic, obs)

    def local_q(self, critic: Params, encoded: Tensor, actions: Tensor) -> Tensor:
        """Q_j(o_j, u_j), `(B, N)`; with `critic_source="own"` Q_a(o_j, u_j) of every critic a, `(B, N, N)`."""
        dim = None if self.config.critic_source == "own" and actions.dim() == 3 else 1
        return self.critics(critic, (encoded, 1), (actions, dim), method="value").squeeze(-1)

    @staticmethod
    def of_itself(q: Tensor) -> Tensor:
        """Every critic's value of its own agent, `(B, N)`."""
        return q if q.dim() == 2 else q.diagonal(dim1=1, dim2=2)

    @property
    @override(JointLearner)
    def trains_mixer(self) -> bool:
        """Not before `mixer_start`."""
        return self.stage != LOCAL

    @override(JointLearner)
    def stage_at(self, env_steps: int) -> str:
        """Local until `mixer_start` env steps."""
        return LOCAL if env_steps < self.config.mixer_start else ""


class FACMACConfig(JointConfig):
    """Configuration of FACMAC (Peng et al. 2021).

    ```python
    config = FACMACConfig().environment("maobs/spread-3a").training(critic_source="shared")
    algo = config.build_algo()
    algo.train()
    ```

    `critic_source` says whose critics the mixer mixes (the paper's figure 6): "shared", one critic for all agents
    (the original's); "others", every agent's own, in one mixer with one loss; "own", for each agent a its own
    critic in the place of all others', Q_a(o_j, u_j), with a mixer and a loss of its own.

    `mixer_start` makes two stages of it (figure 7): until that many env steps local critics and actors learn alone
    (eq. 13), and the mixer stands still; then eq. 14.

    There is one value of the team, so it needs one team reward.
    """

    name = "facmac"
    abilities = Abilities(team_reward=True, twin_critics=False)
    central_critic = False

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class or FACMAC)
        self.critic_source: Literal["shared", "others", "own"] = "shared"
        self.mixer_start = 0
        self.mixer_hidden_size = 32

    @override(JointConfig)
    def training(
        self,
        *,
        critic_source: Literal["shared", "others", "own"] = NotProvided,
        mixer_start: int = NotProvided,
        mixer_hidden_size: int = NotProvided,
        **kwargs: Any,
    ) -> Self:
        """Sets the training settings.

        Args:
            critic_source: "shared" (default), "others" or "own", see the class.
            mixer_start: Env steps before the mixer takes part. Default 0.
            mixer_hidden_size: Width of the mixing layer. Default 32 (QMIX's).
            **kwargs: Those of every algorithm, see `JointConfig.training`.
        """
        super().training(**kwargs)
        own = {"critic_source": critic_source, "mixer_start": mixer_start, "mixer_hidden_size": mixer_hidden_size}
        for name, value in own.items():
            if value is not NotProvided:
                setattr(self, name, value)
        return self

    @override(JointConfig)
    def validate(self) -> None:
        """Raises ValueError for settings that are not legal."""
        one_of("critic_source", self.critic_source, CRITIC_SOURCES)
        in_range("mixer_start", self.mixer_start, 0)
        in_range("mixer_hidden_size", self.mixer_hidden_size, 1)
        super().validate()
        sizes = set(zip(self.team.observation_sizes, self.team.action_sizes, strict=True))
        if len(sizes) > 1 and self.critic_source != "others":
            raise ValueError(
                f"critic_source must be 'others' where agents' observations or actions differ in size, not "
                f"{self.critic_source!r}: one critic cannot judge them all."
            )

    @property
    def ties_critics(self) -> bool:  # type: ignore[override]
        """Whether all agents have the same critic."""
        return self.critic_source == "shared"

    @override(JointConfig)
    def critic_sizes(self, agent: str) -> tuple[int, int]:
        """(O, A) of the agent."""
        index = self.team.agents.index(agent)
        return self.team.observation_sizes[index], self.team.action_sizes[index]

    @override(JointConfig)
    def mixer_settings(self) -> dict[str, Any]:
        """An unconstrained mixer for the team, or one for each agent."""
        agents = len(self.team.agents)
        return {
            "num_mixers": agents if self.critic_source == "own" else 1,
            "num_agents": agents,
            "state_size": self.state_size,
            "hidden_size": self.mixer_hidden_size,
            "monotone": False,
        }

    @override(JointConfig)
    def get_default_learner_class(self) -> type[JointLearner]:
        """Eq. 7 to 9, 13 and 14."""
        return FACMACLearner


class FACMAC(JointAlgorithm):
    """FACMAC, see `FACMACConfig`."""

    @classmethod
    @override(JointAlgorithm)
    def get_default_config(cls) -> FACMACConfig:
        """The original's critic, the paper's other settings."""
        return FACMACConfig()
