"""FACMAC: local critics, mixed without constraint into the value of the joint action (paper, section II.D)."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

from ray.rllib.algorithms.algorithm_config import NotProvided
from ray.rllib.utils.annotations import override
from torch import Tensor

from rllib_maobs.algorithms.base import JointAlgorithm
from rllib_maobs.algorithms.config import JointConfig, Supports
from rllib_maobs.learner import JointLearner, TeamNetworks
from rllib_maobs.options import Range
from rllib_maobs.replay import Batch, Moment

LOCAL = "local"  # the training stage before the mixer


class FACMACLearner(JointLearner):
    """Equations 7 to 9, and for the two stages of figure 7, 13 and 14."""

    @override(JointLearner)
    def critic_loss(self, online: TeamNetworks, target: TeamNetworks, batch: Batch) -> tuple[Tensor, Tensor]:
        """Eq. 8: L(phi, psi) = E[(y - Q_tot)^2], y = r + gamma Q'_tot(tau', mu'(tau'), s').

        Before `mixer_start`: IDDPG's, every local critic with a target of its own.
        """
        next_actions = target.next_actions(batch)  # (B, N, A)
        if self.stage == LOCAL:
            y = (batch.rewards + batch.discount * target.q(batch.next, next_actions)[..., 0]).detach()  # (B, N)
            q = online.q(batch.now, batch.actions)[..., 0]  # (B, N)
        else:
            next_q = self.total(target, batch.next, next_actions)  # (B, M)
            y = (batch.rewards[:, :1] + batch.team_discount * next_q).detach()  # (B, M)
            q = self.total(online, batch.now, batch.actions)  # (B, M)
        return (y - q).square().mean(0), q

    @override(JointLearner)
    def actor_loss(self, actions: Tensor, online: TeamNetworks, batch: Batch) -> Tensor:
        """Eq. 9 and 14: grad J(mu) = E[grad mu grad_mu Q_tot(tau, mu_1(tau_1)..mu_N(tau_N), s)], as a loss.

        Before `mixer_start`, eq. 13: grad J(mu_a) = E[grad mu_a grad_u Q_a(o_a, u) at u = mu_a(o_a)].
        """
        if self.stage == LOCAL:
            return -online.q(batch.now, actions)[..., 0].mean(0)  # (N,)
        return -self.total(online, batch.now, actions, others=actions.detach()).mean(0)  # (M,)

    def total(self, nets: TeamNetworks, moment: Moment, actions: Tensor, *, others: Tensor | None = None) -> Tensor:
        """Eq. 7: Q_tot = g_psi(s, Q_1(o_1, u_1)..Q_N(o_N, u_N)), of the team `(B, 1)`, or each agent's own `(B, N)`.

        Q_tot^a of `critic_source="own"` is agent a's alone: it sees the `others`' actions where they are given.
        """
        if self.config.critic_source == "own":
            return nets.mix_each(nets.cross_q(moment, actions, others=others)[..., 0], moment)
        return nets.mix(nets.q(moment, actions)[..., 0], moment)

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

    There is one value of the team, so it needs one team reward. Its target bootstraps unless all agents terminated
    (`Batch.team_discount`); those of the local critics before `mixer_start` bootstrap by each agent's own flag.
    """

    name = "facmac"
    supports = Supports(team_reward=True, twin_critics=False)
    critic_sees = ("observation", "action")
    mixes = True
    learner = FACMACLearner
    legal: ClassVar[dict[str, Any]] = {
        **JointConfig.legal,
        "critic_source": Literal["shared", "others", "own"],
        "mixer_start": Annotated[int, Range(0)],
        "mixer_hidden_size": Annotated[int, Range(1)],
    }

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class)
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
        super().validate()
        layouts = set(zip(self.team.observation_layouts, self.team.action_sizes, strict=True))
        if len(layouts) > 1 and self.critic_source != "others":
            raise ValueError(
                f"critic_source must be 'others' where agents' observations or actions differ, not "
                f"{self.critic_source!r}: one critic cannot judge them all."
            )

    @property
    def ties_critics(self) -> bool:  # type: ignore[override]
        """Whether all agents have the same critic."""
        return self.critic_source == "shared"

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


class FACMAC(JointAlgorithm):
    """FACMAC, see `FACMACConfig`."""

    config_class = FACMACConfig
