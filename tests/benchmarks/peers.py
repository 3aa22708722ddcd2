"""MADDPG's update beside those of BenchMARL and AgileRL, and `train()` beside stock RLlib's SAC, in turns, in one run.

    OMP_NUM_THREADS=1 python tests/benchmarks/peers.py [--rounds 5] [--seconds 3] [--venv DIR]

It prints a table for the README and what it compares, and exits with 1 if a ratio is below its bar. The first run makes
two virtual environments, as BenchMARL and AgileRL need different versions of TensorDict (PyTorch and much else come
along: some gigabytes), by default beside the system's other temporary files; later runs use them again. On Linux PyPI's
PyTorch brings CUDA with it; `PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu` gets the small build.

Every library has a process of its own, all on the same core and one at a time, and trains as many agents with
observations, actions, minibatches and networks of the same sizes. Rates are per second of the process's own time on the
core, which is time on the clock where nothing else runs.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

# Scenario and batch size.
SHAPES = {"N = 9, batch 32": ("spread-9a", 32), "N = 3, batch 128": ("spread-3a", 128)}
# AgileRL does not name peft among what it needs, but imports it.
PEERS = {
    "benchmarl": ["benchmarl==1.5.2", "torchrl==0.11.1", "tensordict==0.11.0"],
    "agilerl": ["agilerl==2.58.0", "tensordict==0.13.0", "peft==0.21.0"],
}
HIDDEN = [64, 64, 64]
ROWS = 10_000  # joint transitions in every library's replay
COPIES = 8  # of the environment in train(), which makes one update for each env step
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
# Rows of the table: who serves them, and the least ratios of ours to updates, and to env steps at N = 9.
ROW_BARS = {
    "ours": ("", 0.0, 0.0),
    "BenchMARL": ("benchmarl", 3.0, 0.0),
    "BenchMARL, fused Adam": ("benchmarl", 3.0, 0.0),
    "AgileRL": ("agilerl", 5.0, 0.0),
    "AgileRL, compiled": ("agilerl", 5.0, 0.0),
    "RLlib SAC": ("", 0.0, 40.0),
}
COLUMNS = {"update": "updates/s", "replay": "updates/s with replay", "train": "`train()`, env steps/s"}
COMPARED = """
One thread of one core, float32; medians of {rounds} rounds of {seconds:g} s, the libraries in turns; ours / it in
brackets. Seconds are of the process's own time on the core.
{versions}.

- An update: critics and actors of all N agents take one step of Adam on a minibatch of B joint transitions, and the
  target networks follow. Every agent has an actor and a critic of its own, {hidden} ReLU units, nothing is
  shared; a critic sees all observations and all actions. Observations and actions are as wide as the scenario's.
  "With replay" is the same with the library's own sampling, from {rows} transitions, as its training loop does it.
- ours: `MADDPGConfig` with `torch_compile_learner=True`: `learner.step`; {copies} minibatches in one draw and `update`.
- BenchMARL: `MaddpgConfig`, `Experiment._optimizer_loop`, once with replay answered by always the same minibatch; no
  gradient clipping. With `Adam` as it is by default, and with `adam_extra_kwargs={{"fused": True}}`. It does less than
  ours: no target actors, and one joint action for all critics when actors learn, everybody's current one.
- AgileRL: `MADDPG.learn`, `ReplayBuffer`; eager, and with `torch_compiler="default"`. The actions enter its critics at
  the second layer.
- RLlib SAC: stock `SACConfig` on `MAObsEnv`, one policy per agent, B transitions for each, the same {copies} copies and
  one update per env step as `train()` of ours; its critics are twins and see their own agent only.
"""


class Shape(NamedTuple):
    """What is trained: the scenario and its sizes."""

    scenario: str
    batch: int  # B
    agents: int  # N
    observation: int  # O
    action: int  # A


class Ways(NamedTuple):
    """What a process measures, by column, each giving how many updates or env steps it made; and sizes of networks."""

    ways: dict[str, Callable[[], int]]
    parameters: list[int]  # of one agent's actor and critic


def size(*modules: Any) -> int:
    """Return how many parameters modules have."""
    return sum(p.numel() for module in modules for p in module.parameters())


def our_ways(shape: Shape) -> Ways:
    """Return MADDPG's compiled update, with and without replay, and `train()`."""
    import ray

    import rllib_maobs as maobs

    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    config = maobs.MADDPGConfig().environment(f"maobs/{shape.scenario}")
    config.env_runners(num_envs_per_env_runner=COPIES).framework(torch_compile_learner=True).debugging(seed=0)
    config.training(train_batch_size_per_learner=shape.batch, updates_per_env_step=1.0, replay_buffer_capacity=ROWS)
    config.training(num_steps_sampled_before_learning_starts=ROWS).reporting(min_sample_timesteps_per_iteration=400)
    config.rl_module(model_config={"hidden_sizes": tuple(HIDDEN), "activation": "relu"})
    algo = config.build_algo()
    for _ in range(ROWS // 400 + 1):
        algo.train()
    columns = algo.replay_buffer.sample((shape.batch,), gamma=config.gamma)

    def update() -> int:
        algo._learner.step(columns)
        return 1

    def replay() -> int:
        minibatches = algo.replay_buffer.sample((COPIES, shape.batch), gamma=config.gamma)
        algo.learner_group.update(batch=minibatches, _no_metrics_reduce=True)
        return COPIES

    def train() -> int:
        algo.train()
        return 400

    module = algo._learner.module["agent_0"].unwrapped()
    return Ways({"update": update, "replay": replay, "train": train}, [size(module.actor), size(module.critic)])


def sac_ways(shape: Shape) -> Ways:
    """Return `train()` of RLlib's SAC, with one update of each agent's policy per env step."""
    import ray
    from ray.rllib.algorithms.sac import SACConfig
    from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

    import rllib_maobs as maobs

    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    steps, before = 40, 1_000
    config = SACConfig().environment(maobs.MAObsEnv, env_config={"scenario": shape.scenario}).debugging(seed=0)
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=COPIES)
    policies = {f"agent_{i}" for i in range(shape.agents)}
    config.multi_agent(policies=policies, policy_mapping_fn=lambda agent, *args, **kwargs: agent)
    # The layers that its critics have besides are left out.
    networks = DefaultModelConfig(fcnet_hiddens=HIDDEN, fcnet_activation="relu", fusionnet_hiddens=[])
    config.rl_module(model_config=networks)
    # The intensity is rows replayed for one sampled: a minibatch for each env step.
    config.training(train_batch_size_per_learner=shape.batch, training_intensity=shape.batch, tau=0.01)
    config.training(replay_buffer_config={"type": "MultiAgentEpisodeReplayBuffer", "capacity": ROWS})
    config.training(num_steps_sampled_before_learning_starts=before)
    config.reporting(min_sample_timesteps_per_iteration=steps, min_time_s_per_iteration=0)
    algo = config.build_algo()
    for _ in range(before // steps + 1):
        algo.train()

    def train() -> int:
        learned = algo.train()["learners"]
        rows = {learned[policy]["num_module_steps_trained"] for policy in policies}
        assert rows == {steps * shape.batch}, f"not one update per env step: {rows}"
        return steps

    module = algo.learner_group._learner.module["agent_0"].unwrapped()
    return Ways({"train": train}, [size(module.pi_encoder, module.pi), size(module.qf_encoder, module.qf)])


def benchmarl_ways(shape: Shape, fused: bool) -> Ways:
    """Return BenchMARL's update, with and without replay; its experiment plays an environment of random numbers."""
    import torch
    from benchmarl.algorithms import MaddpgConfig
    from benchmarl.environments.common import TaskClass
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig
    from torchrl.data import Bounded, Composite, Unbounded
    from torchrl.envs import EnvBase

    names = [f"agent_{i}" for i in range(shape.agents)]

    class RandomEnv(EnvBase):
        def __init__(self) -> None:
            super().__init__()

            def of_agents(**specs: Any) -> Composite:
                return Composite(agents=Composite(specs, shape=(shape.agents,)))

            self.observation_spec = of_agents(observation=Unbounded((shape.agents, shape.observation)))
            self.action_spec = of_agents(action=Bounded(-1.0, 1.0, (shape.agents, shape.action)))
            self.reward_spec = of_agents(reward=Unbounded((shape.agents, 1)))
            self.done_spec = Composite(done=Unbounded((1,), dtype=torch.bool))

        def _reset(self, tensordict: Any, **kwargs: Any) -> Any:
            return self.observation_spec.rand().update({"done": torch.zeros(1, dtype=torch.bool)})

        def _step(self, tensordict: Any) -> Any:
            return self._reset(None).update(self.reward_spec.rand())

        def _set_seed(self, seed: int | None) -> None:
            pass

    class RandomTask(TaskClass):
        def get_env_fun(self, *args: Any, **kwargs: Any) -> Any:
            return RandomEnv

        def supports_continuous_actions(self) -> bool:
            return True

        def supports_discrete_actions(self) -> bool:
            return False

        def max_steps(self, env: Any) -> int:
            return 100

        def has_render(self, env: Any) -> bool:
            return False

        def group_map(self, env: Any) -> dict[str, list[str]]:
            return {"agents": names}

        def observation_spec(self, env: Any) -> Any:
            return env.observation_spec

        def action_spec(self, env: Any) -> Any:
            return env.full_action_spec

        def info_spec(self, env: Any) -> None:
            return None

        state_spec = action_mask_spec = info_spec

        @staticmethod
        def env_name() -> str:
            return "random"

        def __reduce__(self) -> Any:
            return dict, ()  # the experiment saves its task, which a class in a function could not be

    config = ExperimentConfig.get_from_yaml()
    config.share_policy_params = False
    config.polyak_tau, config.clip_grad_val = 0.01, None
    config.adam_extra_kwargs = {"fused": True} if fused else {}
    config.off_policy_train_batch_size, config.off_policy_memory_size = shape.batch, ROWS
    # One iteration, which fills the replay buffer.
    config.max_n_frames = config.off_policy_collected_frames_per_batch = ROWS
    config.off_policy_n_optimizer_steps = 1
    config.evaluation, config.loggers, config.create_json = False, [], False
    algorithm = MaddpgConfig.get_from_yaml()
    algorithm.share_param_critic, algorithm.delay_value = False, True
    networks = [MlpConfig(num_cells=HIDDEN, layer_class=torch.nn.Linear, activation_class=torch.nn.ReLU) for _ in "ac"]
    with tempfile.TemporaryDirectory() as folder:
        config.save_folder = folder
        task = RandomTask("random", {})
        experiment = Experiment(task, algorithm, networks[0], seed=0, config=config, critic_model_config=networks[1])
        experiment.run()
    buffer = experiment.replay_buffers["agents"]
    assert len(buffer) == ROWS
    sample, minibatch = buffer.sample, buffer.sample()

    def update() -> int:
        buffer.sample = minibatch.copy
        experiment._optimizer_loop("agents")
        return 1

    def replay() -> int:
        buffer.sample = sample
        experiment._optimizer_loop("agents")
        return 1

    optimizers = experiment.optimizers["agents"]
    parameters = [
        sum(p.numel() for p in optimizers[loss].param_groups[0]["params"]) // shape.agents
        for loss in ("loss_actor", "loss_value")
    ]
    return Ways({"update": update, "replay": replay}, parameters)


def agilerl_ways(shape: Shape, compiled: bool) -> Ways:
    """Return AgileRL's update, with and without replay."""
    import numpy as np
    import torch
    from agilerl.algorithms import MADDPG
    from agilerl.components import ReplayBuffer
    from agilerl.networks import ContinuousQNetwork, DeterministicActor
    from gymnasium.spaces import Box, Dict
    from tensordict import TensorDict

    # Not agent_0, agent_1, ...: agents that are named alike up to the last underscore share their networks.
    names = [f"agent{i}" for i in range(shape.agents)]
    observations = [Box(-np.inf, np.inf, (shape.observation,)) for _ in names]
    actions = [Box(-1.0, 1.0, (shape.action,)) for _ in names]

    def layers(hidden: list[int]) -> dict[str, Any]:
        return {"hidden_size": hidden, "layer_norm": False}

    # An encoder and a head each. Made here because by net_config alone actors and critics differ in depth.
    first, *rest = HIDDEN
    encoder = {"latent_dim": first}
    actors = [
        DeterministicActor(o, a, encoder_config=layers([first]), latent_dim=rest[0], head_config=layers(rest[1:]))
        for o, a in zip(observations, actions, strict=True)
    ]
    everything = Dict(dict(zip(names, observations, strict=True))), Box(-1.0, 1.0, (shape.agents * shape.action,))
    critics = [
        ContinuousQNetwork(*everything, encoder_config=encoder, latent_dim=first, head_config=layers(rest))
        for _ in names
    ]
    maddpg = MADDPG(
        observations,
        actions,
        agent_ids=names,
        actor_networks=actors,
        critic_networks=critics,
        batch_size=shape.batch,
        tau=0.01,
        torch_compiler="default" if compiled else None,
    )
    assert len(maddpg.actors) == len(maddpg.critics) == shape.agents

    def of_agents(*width: int) -> dict[str, torch.Tensor]:
        return {name: torch.randn(ROWS, *width) for name in names}

    memory = ReplayBuffer(ROWS)
    rows = {
        "obs": of_agents(shape.observation),
        "action": {name: values.tanh() for name, values in of_agents(shape.action).items()},
        "reward": of_agents(1),
        "next_obs": of_agents(shape.observation),
        "done": {name: torch.zeros(ROWS, 1) for name in names},
    }
    memory.add(TensorDict(rows, batch_size=[ROWS]))
    minibatch = memory.sample(shape.batch)

    def update() -> int:
        maddpg.learn(minibatch)
        return 1

    def replay() -> int:
        maddpg.learn(memory.sample(shape.batch))
        return 1

    return Ways({"update": update, "replay": replay}, [size(maddpg.actors[names[0]]), size(maddpg.critics[names[0]])])


def serve(row: str, shape: Shape) -> None:
    """Be a worker: print the networks' sizes, then for every line of input (column, seconds) what was measured."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what libraries print is not an answer
    import torch

    torch.set_num_threads(1)
    ways, parameters = {
        "ours": lambda: our_ways(shape),
        "BenchMARL": lambda: benchmarl_ways(shape, fused=False),
        "BenchMARL, fused Adam": lambda: benchmarl_ways(shape, fused=True),
        "AgileRL": lambda: agilerl_ways(shape, compiled=False),
        "AgileRL, compiled": lambda: agilerl_ways(shape, compiled=True),
        "RLlib SAC": lambda: sac_ways(shape),
    }[row]()
    if hasattr(os, "sched_setaffinity"):  # only now: Ray's own processes may have another core, if there is one
        os.sched_setaffinity(0, [max(os.sched_getaffinity(0))])
    for work in ways.values():
        work()
    print(json.dumps({"columns": list(ways), "parameters": parameters}), file=answers)
    for line in sys.stdin:
        column, seconds = json.loads(line)
        count, start, clock = 0, time.process_time(), time.perf_counter()
        while time.process_time() - start < seconds:
            count += ways[column]()
        own = time.process_time() - start
        print(json.dumps({"rate": count / own, "share": own / (time.perf_counter() - clock)}), file=answers)


class Worker:
    """A library in a process of its own."""

    def __init__(self, row: str, python: str, shape: Shape, log: Path) -> None:
        self.row, self.log = row, log
        self.process = subprocess.Popen(
            [python, __file__, "--serve", row, json.dumps(shape)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log.open("w"),
            text=True,
            env=os.environ | ONE_THREAD,
        )
        ready = self.answer()
        self.columns: list[str] = ready["columns"]
        self.parameters: list[int] = ready["parameters"]

    def answer(self) -> Any:
        """Return the next answer."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.row} failed, see {self.log}:\n{self.log.read_text()[-2000:]}")
        return json.loads(line)

    def rate(self, column: str, seconds: float) -> tuple[float, float]:
        """Return updates or env steps per second, and the share of the core's time that the process had."""
        assert self.process.stdin is not None
        print(json.dumps([column, seconds]), file=self.process.stdin, flush=True)
        answer = self.answer()
        return answer["rate"], answer["share"]


def python_of(peer: str, folder: Path) -> str:
    """Return the interpreter of a peer's virtual environment, which is made if need be."""
    # In one call with everything else, so that PyTorch is the build that this package runs on.
    packages = [f"torch=={version('torch').partition('+')[0]}", *PEERS[peer]]
    python, done = folder / "bin" / "python", folder / "installed"
    if not done.exists() or done.read_text() != str(packages):
        print(f"making {folder} with {', '.join(packages)} ...", file=sys.stderr, flush=True)
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(folder)], check=True)
        subprocess.run([python, "-m", "pip", "install", "-q", *packages], check=True)
        done.write_text(str(packages))
    return str(python)


def sizes_of(scenario: str, batch: int) -> Shape:
    """Return a scenario's sizes."""
    from rllib_maobs.envs import MAObsEnv

    env = MAObsEnv({"scenario": scenario})
    agent = env.possible_agents[0]
    widths = env.observation_spaces[agent].shape[0], env.action_spaces[agent].shape[0]
    return Shape(scenario, batch, len(env.possible_agents), *widths)


def measure(shape: Shape, arguments: argparse.Namespace) -> tuple[dict[str, dict[str, list[float]]], str]:
    """Return the rates of all rounds, by row and column, and the networks' sizes in words."""
    workers: dict[str, Worker] = {}
    try:
        for row, (peer, *_) in ROW_BARS.items():
            python = python_of(peer, arguments.venv / peer) if peer else sys.executable
            workers[row] = Worker(row, python, shape, arguments.venv / f"{row}.log")
        same = {row: worker.parameters for row, worker in workers.items() if "update" in worker.columns}
        assert all(parameters == same["ours"] for parameters in same.values()), f"networks differ: {same}"
        rates = {row: {column: [] for column in worker.columns} for row, worker in workers.items()}
        least = 1.0
        for _ in range(arguments.rounds):
            for row, worker in workers.items():
                for column in worker.columns:
                    rate, share = worker.rate(column, arguments.seconds)
                    rates[row][column].append(rate)
                    least = min(least, share)
    finally:
        for worker in workers.values():
            worker.process.communicate()
    actor, critic = same["ours"]
    words = (
        f"{shape.scenario}: {shape.agents} agents, observations of {shape.observation} and actions of {shape.action}; "
        f"an actor has {actor} parameters, a critic {critic} (SAC: {workers['RLlib SAC'].parameters})"
    )
    return rates, f"{words}; what was measured had at least {least:.0%} of the core"


def main() -> None:
    """Prints the table; exits with 1 if a ratio is below its bar."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0, help="per number and round")
    parser.add_argument("--venv", type=Path, default=Path(tempfile.gettempdir()) / "rllib-maobs-maddpg-peers")
    parser.add_argument("--serve", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        row, shape = arguments.serve
        serve(row, Shape(*json.loads(shape)))
        return
    arguments.venv.mkdir(parents=True, exist_ok=True)
    notes, below = [], []
    print(f"| | | {' | '.join(COLUMNS.values())} |")
    print("|---" * (2 + len(COLUMNS)) + "|")
    for title, (scenario, batch) in SHAPES.items():
        rates, words = measure(sizes_of(scenario, batch), arguments)
        notes.append(words)
        for row, (_, updates, env_steps) in ROW_BARS.items():
            cells = []
            for column in COLUMNS:
                if column not in rates[row]:
                    cells.append("-")
                    continue
                pairs = zip(rates["ours"][column], rates[row][column], strict=True)
                ratio = statistics.median(ours / other for ours, other in pairs)
                median = statistics.median(rates[row][column])
                cells.append(f"{median:.3g}" + ("" if row == "ours" else f" ({ratio:.1f})"))
                bar = updates if column != "train" else env_steps if scenario == "spread-9a" else 0.0
                if ratio < bar:
                    below.append(f"below the bar, {title}: ours / {row}, {column}: {ratio:.2f}, not {bar:g}")
            print(f"| {title} | {row} | {' | '.join(cells)} |", flush=True)
    print(
        COMPARED.format(
            rounds=arguments.rounds,
            seconds=arguments.seconds,
            versions="; ".join([f"torch {version('torch')}, ray {version('ray')}", *map(", ".join, PEERS.values())]),
            hidden=", ".join(map(str, HIDDEN)),
            rows=ROWS,
            copies=COPIES,
        )
    )
    print("\n".join([*(f"- {words}." for words in notes), *below]))
    sys.exit(bool(below))


if __name__ == "__main__":
    main()
