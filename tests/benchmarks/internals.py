"""What the benchmarks use of the package beside its public names, in one place: what changes there is changed here."""

from collections.abc import Callable
from typing import Any

import torch

import rllib_maobs as maobs
from rllib_maobs.replay import Batch
from tests.benchmarks.loop import LoopLearner
from tests.benchmarks.measure import Stopwatch, Work

# What the loop over agents can learn.
LOOPS = ("iddpg", "maddpg", "maddpg-l")


def needs_discrete(config: maobs.JointConfig) -> bool:
    """Whether the algorithm takes discrete actions only."""
    return config.supports.actions == ("discrete",)


def learner_of(algo: Any) -> Any:
    """What makes an algorithm's updates."""
    return algo._learner


def networks_of(algo: Any, agent: str) -> tuple[torch.nn.Module, torch.nn.Module]:
    """An agent's actor and critic."""
    module = learner_of(algo).module[agent].unwrapped()
    return module.actor, module.critic


def number_of_parameters(learner: Any) -> int:
    """How many numbers all networks that an update trains have."""
    return sum(stack.flat.numel() for stack in learner._roles.values())


def weights_of(algo: Any) -> list[torch.Tensor]:
    """All weights that an algorithm trains, a vector for each role."""
    return [stack.flat for stack in learner_of(algo)._roles.values()]


def adam_means(learner: Any) -> list[torch.Tensor]:
    """Adam's first means of all parameters, and its second ones."""
    states = [learner._adam._optimizers[role].state[stack.flat] for role, stack in learner._roles.items()]
    return [torch.cat([state[name] for state in states]) for name in ("exp_avg", "exp_avg_sq")]


def flushing(what: str) -> str:
    """What flushes denormal numbers in updates, for `mock.patch`: the processor's "mode" or the "cleaning"."""
    owner = "rllib_maobs.learner.joint"
    return {"mode": f"{owner}.denormals_are_zero", "cleaning": f"{owner}.StackedAdam.clean"}[what]


def minibatch(algo: Any, *shape: int) -> Batch:
    """A minibatch from an algorithm's replay, or with `(K, B)` K of them in one draw."""
    return algo.replay_buffer.sample(shape, gamma=algo.config.gamma, seq_length=algo.config.window_length)


def update_of(learner: Any, batch: Batch) -> Work:
    """An update of ours, again and again on one minibatch."""

    def update() -> int:
        learner.step(batch)
        return 1

    return update


def replayed_updates_of(algo: Any, copies: int, batch_size: int) -> Work:
    """As many updates as there are copies, with their minibatches from replay in one draw."""

    def update() -> int:
        algo.learner_group.update(batch=minibatch(algo, copies, batch_size), _no_metrics_reduce=True)
        return copies

    return update


def loop_update_of(algorithm: str, learner: Any, batch: Batch) -> Work:
    """The same update in the loop over agents, on the same minibatch."""
    config, team = learner.config, learner.config.team
    sizes = (len(team.agents), team.observation_size, team.action_size, config.state_size)
    loop = LoopLearner(algorithm, *sizes)
    now, following, actions, rewards, discount, _ = learner.prepare(batch, {})
    sample = {"obs": now.obs, "state": now.state, "next_obs": following.obs, "next_state": following.state}
    sample |= {"actions": actions, "rewards": rewards, "terminated": (discount == 0).float()}

    def update() -> int:
        loop.update(sample)
        return 1

    return update


def eager_gradients_of(learner: Any, batch: Batch) -> Callable[[], Any]:
    """All of an update but for Adam's step and the targets', not compiled."""
    online, target = (learner._params_of(stacks) for stacks in (learner._roles, learner._targets))
    return lambda: learner.joint_gradients(online, target, {}, batch)


def watch_update(algo: Any, stopwatch: Stopwatch) -> None:
    """Counts an algorithm's updates."""
    stopwatch.watch("update", learner_of(algo), "step")


def watch_parts(algo: Any, stopwatch: Stopwatch) -> None:
    """Counts the parts of an algorithm's `train()`."""
    runner = algo.env_runner
    runner.acting = stopwatch.watched("acting", runner.acting)
    stopwatch.watch("env", runner.env, "step", "reset", "state")
    stopwatch.watch("replay", algo.replay_buffer, "add", "sample")
    watch_update(algo, stopwatch)


def bytes_of_replay(algo: Any) -> int:
    """Bytes of a full replay buffer."""
    return algo.replay_buffer.nbytes
