"""Where the copies are in their episodes, and what is reported of finished ones under RLlib's keys."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
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
)
from ray.rllib.utils.metrics.metrics_logger import MetricsLogger

EPISODE_METRICS = "episode_metrics"


class Episodes:
    """Returns, lengths and metrics of E copies' episodes.

    Attributes:
        lengths: Steps that each copy's episode has taken so far, `(E,)`.

    Args:
        agents: The N agents.
        module_ids: Their policies.
        num_envs: E.
    """

    def __init__(self, agents: Sequence[str], module_ids: Sequence[str], num_envs: int) -> None:
        self._agents, self._module_ids, self._num_envs = agents, module_ids, num_envs
        self._returns = np.zeros((num_envs, len(agents)))
        self.lengths = np.zeros(num_envs, dtype=np.int64)
        self._started = np.zeros(num_envs)
        self._steps = self._episodes = 0  # since the last report
        self._finished: list[dict[str, Any]] = []

    def begin(self, copies: NDArray[np.bool_]) -> None:
        """The copies `(E,)` begin an episode."""
        self._returns[copies], self.lengths[copies], self._started[copies] = 0.0, 0, time.time()

    def add(self, rewards: NDArray[np.float32]) -> None:
        """All copies took a step with rewards `(E, N)`."""
        self._returns += rewards
        self.lengths += 1
        self._steps += self._num_envs

    def finish(self, copies: NDArray[np.bool_], metrics: dict[str, NDArray[np.float32]]) -> None:
        """The episodes of the copies `(E,)` are over, with metrics `(E,)` of their own; they count."""
        now = time.time()
        for copy in np.flatnonzero(copies):
            self._episodes += 1
            # A metric an episode has no value for (say, a goal never reached) is left out of the mean.
            values = {name: float(value[copy]) for name, value in metrics.items()}
            self._finished.append(
                {
                    "returns": self._returns[copy].copy(),
                    "length": int(self.lengths[copy]),
                    "seconds": now - self._started[copy],
                    EPISODE_METRICS: {name: value for name, value in values.items() if math.isfinite(value)},
                }
            )

    def report(self, logger: MetricsLogger, window: int) -> None:
        """Logs what happened since the last report.

        Args:
            logger: Where to.
            window: Episodes that a mean is over.
        """
        by_agent, by_module = (
            dict.fromkeys(self._agents, self._steps),
            self._by_module([self._steps] * len(self._agents)),
        )
        for name, value in ((NUM_ENV_STEPS_SAMPLED, self._steps), (NUM_EPISODES, self._episodes)):
            logger.log_value(name, value, reduce="sum")
        logger.log_value(NUM_EPISODES_LIFETIME, self._episodes, reduce="lifetime_sum")
        logger.log_value(NUM_ENV_STEPS_SAMPLED_LIFETIME, self._steps, reduce="lifetime_sum", with_throughput=True)
        for now, lifetime, values in (
            (NUM_AGENT_STEPS_SAMPLED, NUM_AGENT_STEPS_SAMPLED_LIFETIME, by_agent),
            (NUM_MODULE_STEPS_SAMPLED, NUM_MODULE_STEPS_SAMPLED_LIFETIME, by_module),
        ):
            logger.log_dict(values, key=now, reduce="sum")
            logger.log_dict(values, key=lifetime, reduce="lifetime_sum")
        for episode in self._finished:
            returns, length = episode["returns"], episode["length"]
            total = float(returns.sum())
            logger.log_dict(
                {
                    EPISODE_LEN_MEAN: length,
                    EPISODE_RETURN_MEAN: total,
                    EPISODE_DURATION_SEC_MEAN: episode["seconds"],
                    EPISODE_AGENT_RETURN_MEAN: dict(zip(self._agents, map(float, returns), strict=True)),
                    EPISODE_AGENT_STEPS: dict.fromkeys(self._agents, length),
                    EPISODE_MODULE_RETURN_MEAN: self._by_module(map(float, returns)),
                    EPISODE_METRICS: episode[EPISODE_METRICS],
                },
                window=window,
            )
            logger.log_dict({EPISODE_LEN_MIN: length, EPISODE_RETURN_MIN: total}, reduce="min", window=window)
            logger.log_dict({EPISODE_LEN_MAX: length, EPISODE_RETURN_MAX: total}, reduce="max", window=window)
        self._steps = self._episodes = 0
        self._finished.clear()

    def _by_module(self, values: Any) -> dict[str, Any]:
        """Sums over the agents of each policy."""
        sums: dict[str, Any] = {}
        for mid, value in zip(self._module_ids, values, strict=True):
            sums[mid] = sums.get(mid, 0) + value
        return sums
