"""JointEnvRunner: steps E environment copies at once and returns joint columns instead of episode objects."""

from __future__ import annotations

import math
import pickle
import time
import uuid
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core import COMPONENT_RL_MODULE
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule
from ray.rllib.env import INPUT_ENV_SPACES
from ray.rllib.env.env_context import EnvContext
from ray.rllib.env.env_runner import EnvRunner
from ray.rllib.utils.annotations import override
from ray.rllib.utils.checkpoints import Checkpointable
from ray.rllib.utils.metrics import (
    EPISODE_AGENT_RETURN_MEAN,
    EPISODE_AGENT_STEPS,
    EPISODE_DURATION_SEC_MEAN,
    EPISODE_LEN_MAX,
    EPISODE_LEN_MEAN,
    EPISODE_LEN_MIN,
    EPISODE_MODULE_RETURN_MEAN,
    EPISODE_RETURN_MAX,
    EPISODE_RETURN_MEAN,
    EPISODE_RETURN_MIN,
    NUM_AGENT_STEPS_SAMPLED,
    NUM_AGENT_STEPS_SAMPLED_LIFETIME,
    NUM_ENV_STEPS_SAMPLED,
    NUM_ENV_STEPS_SAMPLED_LIFETIME,
    NUM_EPISODES,
    NUM_EPISODES_LIFETIME,
    NUM_MODULE_STEPS_SAMPLED,
    NUM_MODULE_STEPS_SAMPLED_LIFETIME,
    RLMODULE_INFERENCE_TIMER,
    SAMPLE_TIMER,
    WEIGHTS_SEQ_NO,
)
from ray.tune.registry import ENV_CREATOR, _global_registry

from rllib_maobs.envs.joint import WithAgentIds, make_joint_env, register_envs, snapshot
from rllib_maobs.envs.team import JointEnv, Team
from rllib_maobs.modules import AgentModule, Stack
from rllib_maobs.modules.agent import push

EPISODE_METRICS = "episode_metrics"
COMPONENT_SAMPLING = "sampling"


@dataclass(frozen=True)
class JointSample:
    """L steps of E copies as joint columns: the arguments of `JointReplayBuffer.add`, which explains them."""

    obs: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    final_obs: NDArray[np.float32]
    state: NDArray[np.float32] | None
    final_state: NDArray[np.float32] | None
    hidden: NDArray[np.float32] | None
    final_hidden: NDArray[np.float32] | None
    source: str
    start: int

    def env_steps(self) -> int:
        """L * E."""
        return self.terminated.size

    def agent_steps(self) -> int:
        """L * E * N."""
        return self.rewards.size


def env_creator(config: AlgorithmConfig) -> Any:
    """The function that makes the environment of a config from its `env_config`.

    Raises:
        ValueError: If `config.env` is neither a registered name nor an environment class.
    """
    register_envs()  # names are lost when Ray restarts
    if isinstance(config.env, type):
        return config.env
    if isinstance(config.env, str) and _global_registry.contains(ENV_CREATOR, config.env):
        return _global_registry.get(ENV_CREATOR, config.env)
    raise ValueError(
        f"Unknown environment {config.env!r}; legal are {', '.join(sorted(register_envs()))}, a name registered "
        f"with ray.tune.register_env, or an environment class."
    )


def make_env(config: AlgorithmConfig, num_envs: int, worker_index: int = 0) -> JointEnv:
    """E copies of a config's environment, see `make_joint_env`."""
    context = EnvContext(config.env_config or {}, worker_index=worker_index, num_workers=config.num_env_runners)
    env = make_joint_env(env_creator(config), context, num_envs)
    return WithAgentIds(env) if config.agent_id_input else env


class JointEnvRunner(EnvRunner, Checkpointable):
    """Samples a fixed team's joint steps from E copies that step together.

    All agents of all copies act in one stacked forward pass, and what comes back are arrays `(L, E, N, ...)`.
    Set by the algorithms of this package as `env_runner_cls`; `sample()` and `get_metrics()` keep RLlib's
    signatures and result keys, so RLlib's evaluation, fault tolerance and Tune work with it unchanged.
    RLlib's `on_episode_*` callbacks are not called: there are no episode objects to hand to them.
    """

    @override(EnvRunner)
    def __init__(self, config: AlgorithmConfig, **kwargs: Any) -> None:
        super().__init__(config=config, **kwargs)
        self.team: Team = self.config.team
        self.module_ids: tuple[str, ...] = self.config.module_ids
        self.env: JointEnv | None = None
        self.num_envs: int = self.config.num_envs_per_env_runner
        # One stream of randomness per runner and purpose, far from each other even for neighbouring seeds.
        entropy = None if self.config.seed is None else [self.config.seed, self.worker_index or 0]
        seeds = np.random.SeedSequence(entropy, spawn_key=(int(self.config.in_evaluation),))
        self._env_seeds = [int(s) for s in seeds.spawn(1)[0].generate_state(self.num_envs)]
        self._generator = torch.Generator().manual_seed(int(seeds.generate_state(1)[0]))
        if self.worker_index is None or self.worker_index > 0 or self.num_workers == 0:
            self.make_env()
        elif self.config.create_env_on_local_worker:
            self.make_env()
        self.module: MultiRLModule | None = None
        self._weights_seq_no = 0
        self.make_module()

        # Where the copies are in their episodes.
        self._obs: NDArray[np.float32] | None = None
        self._needs_reset = True
        self._returns = np.zeros((self.num_envs, len(self.team.agents)))
        self._lengths = np.zeros(self.num_envs, dtype=np.int64)
        self._started = np.zeros(self.num_envs)
        self._steps_sampled = 0
        self._source = f"{self.worker_index}-{uuid.uuid4().hex}"
        self._counted = {"steps": 0, "episodes": 0}
        self._done_episodes: list[dict[str, Any]] = []

    @override(EnvRunner)
    def make_env(self) -> None:
        """Makes the E copies anew; they are reset at the next `sample()`."""
        if self.env is not None:
            self.env.close()
        self.env = make_env(self.config, self.num_envs, self.worker_index or 0)
        self._needs_reset = True
        if self.team.discrete:
            return
        # (N, A): the lower bound, and half the range, of what an action in [-1, 1] stands for.
        self._low, self._range = np.zeros((2, *self.team.action_mask.shape), dtype=np.float32)
        for row, space in enumerate(self.team.action_spaces):
            self._low[row, : space.shape[0]] = space.low
            self._range[row, : space.shape[0]] = (space.high - space.low) / 2.0

    @override(EnvRunner)
    def make_module(self) -> None:
        """Builds the agents' modules and stacks their actors, so that all act in one call."""
        spec = self.config.get_multi_rl_module_spec(spaces=self.get_spaces(), inference_only=True)
        self.module = spec.build()
        modules: list[AgentModule] = [self.module[mid] for mid in self.module_ids]
        carries = modules[0].carries
        self.actors = Stack([module.acting for module in modules], ("carry", "head") if carries else ("forward",))
        self.normalizers = (
            Stack([module.normalizer for module in modules]) if self.config.normalize_observations else None
        )
        self._agent = modules[0]
        # (N, A): where shorter actions are padded; None if none are.
        self._padding = None if self.team.action_mask.all() else torch.from_numpy(~self.team.action_mask)
        self._window: tuple[torch.Tensor, ...] | None = None
        if self._agent.seq_length:
            # The modules' own state, of all agents: the last T observations (E, T, N, O), which of them count, and
            # if they are carried the h and c with which the last window ended (E, N, 2, H).
            shape = (self.num_envs, self._agent.seq_length)
            window = torch.zeros(*shape, len(self.team.agents), self.team.observation_size)
            self._window = window, torch.zeros(shape)
            if carries:
                hidden = torch.zeros(self.num_envs, len(self.team.agents), 2, self.config.hidden_size)
                self._window = *self._window, hidden

    def share(self, actors: Stack, normalizers: Stack | None) -> None:
        """Acts with the tensors of a learner in this process from now on, so weights need no syncing."""
        self.actors.share(actors)
        if self.normalizers is not None and normalizers is not None:
            self.normalizers.share(normalizers)

    @override(EnvRunner)
    def sample(
        self,
        *,
        num_timesteps: int | None = None,
        num_episodes: int | None = None,
        explore: bool | None = None,
        random_actions: bool = False,
        force_reset: bool = False,
        **kwargs: Any,
    ) -> list[JointSample]:
        """Steps the copies.

        Args:
            num_timesteps: Env steps to sample at least, over all copies. None: `rollout_fragment_length` steps
                of every copy.
            num_episodes: Episodes to sample instead. They are dealt out to the copies in equal shares, so short
                episodes are not favoured, and all copies start afresh.
            explore: Whether to explore; None takes the config's.
            random_actions: Whether to act uniformly at random.
            force_reset: Whether all copies start afresh.
            **kwargs: Ignored.

        Returns:
            One `JointSample` in a list.

        Raises:
            ValueError: If an observation or reward is not finite; names the agent, copy and step.
        """
        if self.env is None:
            raise ValueError(f"{self} has no environment, so it cannot sample.")
        if num_timesteps is not None and num_episodes is not None:
            raise ValueError("Give either num_timesteps or num_episodes, not both.")
        explore = self.config.explore if explore is None else explore
        with self.metrics.log_time(SAMPLE_TIMER):
            if force_reset or num_episodes is not None or self._needs_reset:
                self._reset_all()
            start = self._steps_sampled
            if num_episodes is not None:
                steps = self._play(num_episodes, explore, random_actions)
                self._needs_reset = True
            else:
                length = self.config.get_rollout_fragment_length(self.worker_index)
                if num_timesteps is not None:
                    length = math.ceil(num_timesteps / self.num_envs)
                steps = [self._step(explore, random_actions) for _ in range(length)]
        columns, finals = [list(part) for part in zip(*steps, strict=True)]
        stacked = [None if c[0] is None else np.stack(c) for c in zip(*columns, strict=True)]
        final = [None if c[0] is None else np.concatenate(c) for c in zip(*finals, strict=True)]
        obs, state, actions, rewards, terminated, truncated, hidden = stacked
        assert obs is not None and actions is not None and rewards is not None and final[0] is not None
        assert terminated is not None and truncated is not None
        always = obs, actions, rewards, terminated, truncated, final[0]
        return [JointSample(*always, state, final[1], hidden, final[2], self._source, start)]

    def _reset_all(self) -> None:
        assert self.env is not None
        # Copies are seeded once; after that each goes on in its own stream.
        seeds = self._env_seeds if self._obs is None else None
        self._obs, _ = self.env.reset(seed=seeds)
        self._check_finite("observation", self._obs)
        self._returns[:] = 0.0
        self._lengths[:] = 0
        self._started[:] = time.time()
        self._needs_reset = False
        self._forget(np.ones(self.num_envs, dtype=np.bool_))
        self._steps_sampled += 1  # a gap: what follows is not linked to what was sampled before

    def _play(self, num_episodes: int, explore: bool, random_actions: bool) -> list[Any]:
        """Plays episodes: copy e plays its share of them; further ones of it are not counted."""
        left = np.full(self.num_envs, num_episodes // self.num_envs)
        left[: num_episodes % self.num_envs] += 1
        steps = []
        while (left > 0).any():
            steps.append(self._step(explore, random_actions, counted=left > 0))
            left -= steps[-1][0][4] | steps[-1][0][5]
        return steps

    def _step(self, explore: bool, random_actions: bool, counted: NDArray[np.bool_] | None = None) -> tuple[Any, Any]:
        """One step of all copies: its row of every column, and the final observations and states."""
        assert self.env is not None and self._obs is not None
        obs, state, hidden = self._obs, self._state(), self._hidden()
        actions = self._act(obs, explore, random_actions)
        played = actions.argmax(-1) if self.team.discrete else self._low + (actions + 1.0) * self._range
        self._obs, rewards, terminated, truncated, info = self.env.step(played)
        self._lengths += 1
        self._check_finite("observation", self._obs)
        self._check_finite("reward", rewards)
        self._returns += rewards
        self._steps_sampled += 1
        self._counted["steps"] += self.num_envs
        self.num_env_steps_sampled_lifetime += self.num_envs * max(1, self.num_workers)
        done = terminated | truncated
        final_obs, final_state = self._obs[done], None
        carried = self._hidden()
        final_hidden = None if carried is None else carried[done]
        if done.any():
            end = self._state()
            final_state = None if end is None else end[done]
            self._finish(done if counted is None else done & counted, info.get(EPISODE_METRICS, {}))
            self._returns[done], self._lengths[done], self._started[done] = 0.0, 0, time.time()
            self._forget(done)
            self._obs, _ = self.env.reset(mask=done)
            self._check_finite("observation", self._obs)
        elif state is not None:
            final_state = state[:0]
        return (obs, state, actions, rewards, terminated, truncated, hidden), (final_obs, final_state, final_hidden)

    def _state(self) -> NDArray[np.float32] | None:
        assert self.env is not None
        return self.env.state("world") if self.team.state_size else None

    def _hidden(self) -> NDArray[np.float32] | None:
        """The h and c from which the next windows start, `(E, N, 2, H)`, if they are carried."""
        return self._window[2].numpy() if self._window is not None and len(self._window) == 3 else None

    def _forget(self, done: NDArray[np.bool_]) -> None:
        """Empties the windows, and zeroes h and c, of the copies whose episodes are over."""
        if self._window is not None:
            for part in self._window:
                part[torch.from_numpy(done)] = 0.0

    def _act(self, obs: NDArray[np.float32], explore: bool, random_actions: bool) -> NDArray[np.float32]:
        """The agents' choices `(E, N, A)`: in [-1, 1], or one-hot."""
        seen: list[torch.Tensor] = [torch.from_numpy(obs)]
        dims: list[int | None] = [1]
        if self._window is not None:
            window, mask, *carried = self._window
            self._window = *push(window, mask, seen[0]), *carried
            seen, dims = list(self._window), [2, None, 1][: len(self._window)]
        carries = len(seen) == 3
        if random_actions and not carries:
            return self._random(obs.shape[:2])
        with self.metrics.log_time(RLMODULE_INFERENCE_TIMER), torch.no_grad():
            seen = [part.to(self.actors.flat.device) for part in seen]
            if self.normalizers is not None:
                seen[0], dims[0] = self.normalizers.act((seen[0], dims[0])), 1
            method = "forward"
            if carries:  # h and c go on with the window, whatever chooses the actions
                hidden = self.actors.act(*zip(seen, dims, strict=True), method="carry")
                assert self._window is not None
                self._window = *self._window[:2], hidden.cpu()
                seen, dims, method = [hidden], [1], "head"
            if random_actions:
                return self._random(obs.shape[:2])
            outputs = self._padded(self.actors.act(*zip(seen, dims, strict=True), method=method).cpu())
            if explore:
                actions = self._agent.explore(outputs, self.num_env_steps_sampled_lifetime, self._generator)
            else:
                actions = self._agent.greedy(outputs)
        return self._encoded(actions)

    def _random(self, shape: Sequence[int]) -> NDArray[np.float32]:
        """Uniformly random actions of `(E, N)` agents."""
        uniform = torch.rand((*shape, self.team.action_size), generator=self._generator)
        return self._encoded(self._padded(uniform).argmax(-1) if self.team.discrete else uniform * 2.0 - 1.0)

    def _padded(self, outputs: torch.Tensor) -> torch.Tensor:
        """The networks' outputs `(E, N, A)` with the value of no discrete action in the padding."""
        if self._padding is None or not self.team.discrete:
            return outputs
        return outputs.masked_fill(self._padding, -torch.inf)

    def _encoded(self, actions: torch.Tensor) -> NDArray[np.float32]:
        """Actions as replay has them: one-hot if they are discrete, with zeros as padding if not."""
        if self.team.discrete:
            actions = torch.nn.functional.one_hot(actions, self.team.action_size).float()
        elif self._padding is not None:
            actions = actions.masked_fill(self._padding, 0.0)
        return actions.numpy()

    def _check_finite(self, what: str, values: NDArray[np.float32]) -> None:
        if np.isfinite(values).all():
            return
        copy, agent = np.argwhere(~np.isfinite(values))[0][:2]
        raise ValueError(
            f"The {what} of agent {self.team.agents[agent]!r} is not finite at step {self._lengths[copy]} of its "
            f"episode in environment copy {copy} (runner {self.worker_index}): {values[copy, agent]}."
        )

    def _finish(self, done: NDArray[np.bool_], metrics: dict[str, NDArray[np.float32]]) -> None:
        now = time.time()
        for copy in np.flatnonzero(done):
            self._counted["episodes"] += 1
            self._done_episodes.append(
                {
                    "returns": self._returns[copy].copy(),
                    "length": int(self._lengths[copy]),
                    "seconds": now - self._started[copy],
                    EPISODE_METRICS: {name: float(value[copy]) for name, value in metrics.items()},
                }
            )

    @override(EnvRunner)
    def get_metrics(self) -> Any:
        """RLlib's result keys for what was sampled since the last call, and each episode's own metrics."""
        steps, episodes = self._counted["steps"], self._counted["episodes"]
        by_agent = dict.fromkeys(self.team.agents, steps)
        by_module: dict[str, int] = {}
        for mid in self.module_ids:
            by_module[mid] = by_module.get(mid, 0) + steps
        for name, value in (
            (NUM_ENV_STEPS_SAMPLED, steps),
            (NUM_EPISODES, episodes),
            (NUM_AGENT_STEPS_SAMPLED, by_agent),
            (NUM_MODULE_STEPS_SAMPLED, by_module),
        ):
            self._log(name, value, reduce="sum")
        for name, value in (
            (NUM_EPISODES_LIFETIME, episodes),
            (NUM_AGENT_STEPS_SAMPLED_LIFETIME, by_agent),
            (NUM_MODULE_STEPS_SAMPLED_LIFETIME, by_module),
        ):
            self._log(name, value, reduce="lifetime_sum")
        self.metrics.log_value(NUM_ENV_STEPS_SAMPLED_LIFETIME, steps, reduce="lifetime_sum", with_throughput=True)
        self.metrics.log_value(WEIGHTS_SEQ_NO, self._weights_seq_no, window=1)
        # The results merge all runners' windows into one.
        window = max(1, math.ceil(self.config.metrics_num_episodes_for_smoothing / max(1, self.num_workers)))
        for episode in self._done_episodes:
            total, length = float(episode["returns"].sum()), episode["length"]
            agents = dict(zip(self.team.agents, map(float, episode["returns"]), strict=True))
            modules: dict[str, float] = {}
            for mid, value in zip(self.module_ids, episode["returns"], strict=True):
                modules[mid] = modules.get(mid, 0.0) + float(value)
            self.metrics.log_dict(
                {
                    EPISODE_LEN_MEAN: length,
                    EPISODE_RETURN_MEAN: total,
                    EPISODE_DURATION_SEC_MEAN: episode["seconds"],
                    EPISODE_AGENT_RETURN_MEAN: agents,
                    EPISODE_AGENT_STEPS: dict.fromkeys(self.team.agents, length),
                    EPISODE_MODULE_RETURN_MEAN: modules,
                    # A metric an episode has no value for (say, a goal never reached) is left out of the mean.
                    EPISODE_METRICS: {k: v for k, v in episode[EPISODE_METRICS].items() if math.isfinite(v)},
                },
                window=window,
            )
            self.metrics.log_dict({EPISODE_LEN_MIN: length, EPISODE_RETURN_MIN: total}, reduce="min", window=window)
            self.metrics.log_dict({EPISODE_LEN_MAX: length, EPISODE_RETURN_MAX: total}, reduce="max", window=window)
        self._counted = {"steps": 0, "episodes": 0}
        self._done_episodes.clear()
        return self.metrics.reduce()

    def _log(self, name: str, value: int | dict[str, int], **how: Any) -> None:
        if isinstance(value, dict):
            self.metrics.log_dict(value, key=name, **how)
        else:
            self.metrics.log_value(name, value, **how)

    @override(EnvRunner)
    def get_spaces(self) -> dict[str, tuple[gym.Space[Any], gym.Space[Any]]]:
        """The spaces of every module, and under RLlib's own key those of every agent."""
        team = self.team
        return {
            INPUT_ENV_SPACES: (
                gym.spaces.Dict(list(zip(team.agents, team.observation_spaces, strict=True))),
                gym.spaces.Dict(list(zip(team.agents, team.action_spaces, strict=True))),
            ),
            **{mid: team.spaces(agent) for mid, agent in zip(self.module_ids, team.agents, strict=True)},
        }

    @override(EnvRunner)
    def assert_healthy(self) -> None:
        """Checks that there is something to sample from and to act with."""
        assert self.env is not None and self.module is not None

    @override(EnvRunner)
    def stop(self) -> None:
        """Closes the environment."""
        if self.env is not None:
            self.env.close()

    @override(Checkpointable)
    def get_state(
        self,
        components: str | Collection[str] | None = None,
        *,
        not_components: str | Collection[str] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """Weights, step count, and where the copies are in their episodes (if the environment can be pickled)."""
        state: dict[str, Any] = {NUM_ENV_STEPS_SAMPLED_LIFETIME: self.num_env_steps_sampled_lifetime}
        if self.module is not None and self._check_component(COMPONENT_RL_MODULE, components, not_components):
            state[COMPONENT_RL_MODULE] = self.module.get_state(
                components=self._get_subcomponents(COMPONENT_RL_MODULE, components),
                not_components=self._get_subcomponents(COMPONENT_RL_MODULE, not_components),
                **kwargs,
            )
            state[WEIGHTS_SEQ_NO] = self._weights_seq_no
        if self.env is not None and self._check_component(COMPONENT_SAMPLING, components, not_components):
            state[COMPONENT_SAMPLING] = {
                "in_evaluation": self.config.in_evaluation,
                "generator": self._generator.get_state().numpy(),
                "env": snapshot(self.env),
                **{name: getattr(self, name) for name in _SAMPLING_STATE},
            }
        return state

    @override(Checkpointable)
    def set_state(self, state: dict[str, Any]) -> None:
        """Goes on from a saved state; an environment that could not be saved starts new episodes."""
        if COMPONENT_RL_MODULE in state and self.module is not None:
            seq_no = state.get(WEIGHTS_SEQ_NO, 0)
            if seq_no == 0 or self._weights_seq_no < seq_no:
                weights = state[COMPONENT_RL_MODULE]
                # RLlib puts the weights for several remote runners into the object store once.
                self.module.set_state(ray.get(weights) if isinstance(weights, ray.ObjectRef) else weights)
            self._weights_seq_no = max(self._weights_seq_no, seq_no)
        if NUM_ENV_STEPS_SAMPLED_LIFETIME in state:
            self.num_env_steps_sampled_lifetime = state[NUM_ENV_STEPS_SAMPLED_LIFETIME]
        sampling = state.get(COMPONENT_SAMPLING)
        # RLlib hands the training runner's state to the evaluation runner, too; its episodes are not for it.
        if sampling is None or self.env is None or sampling["in_evaluation"] != self.config.in_evaluation:
            return
        if sampling["env"] is None or len(sampling["_returns"]) != self.num_envs:
            self._needs_reset = True
            return
        self._generator.set_state(torch.from_numpy(sampling["generator"]))
        self.env = pickle.loads(sampling["env"])
        for name in _SAMPLING_STATE:
            setattr(self, name, pickle.loads(pickle.dumps(sampling[name])))

    @override(Checkpointable)
    def get_ctor_args_and_kwargs(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """What builds this runner again."""
        return (), {"config": self.config}

    @override(Checkpointable)
    def get_checkpointable_components(self) -> list[tuple[str, Checkpointable]]:
        """The agents' modules."""
        return [(COMPONENT_RL_MODULE, self.module)]


_SAMPLING_STATE = (
    "_obs",
    "_window",
    "_needs_reset",
    "_returns",
    "_lengths",
    "_started",
    "_steps_sampled",
    "_source",
    "_counted",
    "_done_episodes",
)
