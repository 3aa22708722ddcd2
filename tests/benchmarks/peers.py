"""MADDPG's update beside those of BenchMARL and AgileRL, and `train()` beside stock RLlib's SAC, in turns, in one run.

    OMP_NUM_THREADS=1 python tests/benchmarks/peers.py [--rounds 5] [--seconds 3] [--venv DIR]

It prints a table for the README and what it compares, and exits with 1 if a ratio is below its bar. The first run makes
two virtual environments, as BenchMARL and AgileRL need different versions of TensorDict (PyTorch and much else come
along: some gigabytes), by default beside the system's other temporary files; later runs use them again. On Linux PyPI's
PyTorch brings CUDA with it; `PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu` gets the small build.

Every library (`tests/benchmarks/libraries/`) has a process of its own, all on the same core and one at a time, and
trains as many agents with observations, actions, minibatches and networks of the same sizes. Rates are per second of
the process's own time on the core, which is time on the clock where nothing else runs.
"""

import argparse
import statistics
import sys
import tempfile
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.benchmarks.libraries import COPIES, HIDDEN, ROWS, Shape
from tests.benchmarks.measure import in_turns, median_ratio, row
from tests.benchmarks.workers import Worker, python_with, same_torch

# Scenario and batch size.
SHAPES = {"N = 9, batch 32": ("spread-9a", 32), "N = 3, batch 128": ("spread-3a", 128)}
# AgileRL does not name peft among what it needs, but imports it.
PACKAGES = {
    "benchmarl": ["benchmarl==1.5.2", "torchrl==0.11.1", "tensordict==0.11.0"],
    "agilerl": ["agilerl==2.58.0", "tensordict==0.13.0", "peft==0.21.0"],
}


class Peer(NamedTuple):
    """A row of the table: its file in `libraries`, what `prepare` is told there, and bars.

    The bars are the least ratios of ours to its updates, and to its env steps at N = 9.
    """

    library: str
    options: tuple[Any, ...] = ()
    updates: float = 0.0
    env_steps: float = 0.0


PEERS = {
    "ours": Peer("ours"),
    "BenchMARL": Peer("benchmarl", (False,), updates=3.0),
    "BenchMARL, fused Adam": Peer("benchmarl", (True,), updates=3.0),
    "AgileRL": Peer("agilerl", (False,), updates=5.0),
    "AgileRL, compiled": Peer("agilerl", (True,), updates=5.0),
    "RLlib SAC": Peer("rllib_sac", env_steps=40.0),
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
Rates = dict[str, dict[str, list[float]]]
"""Of all rounds, by row and column."""


def sizes_of(scenario: str, batch: int) -> Shape:
    """Return a scenario's sizes."""
    from rllib_maobs.envs import MAObsEnv

    env = MAObsEnv({"scenario": scenario})
    agent = env.possible_agents[0]
    widths = env.observation_spaces[agent].shape[0], env.action_spaces[agent].shape[0]
    return Shape(scenario, batch, len(env.possible_agents), *widths)


def python_of(library: str, venv: Path) -> str:
    """Return the interpreter that a library runs in."""
    if library not in PACKAGES:
        return sys.executable
    # In one call, so that PyTorch is the build that this package runs on.
    return python_with(venv / library, [same_torch(), *PACKAGES[library]])


def measure(shape: Shape, arguments: argparse.Namespace) -> tuple[Rates, str]:
    """Return the rates of all rounds, and the networks' sizes in words."""
    workers: dict[str, Worker] = {}
    about: dict[str, dict[str, Any]] = {}
    least = 1.0

    def rate(name: str, column: str) -> float:
        nonlocal least
        value = workers[name].measured(column, arguments.seconds)
        least = min(least, workers[name].share)
        return value

    try:
        for name, peer in PEERS.items():
            target = f"tests.benchmarks.libraries.{peer.library}:prepare"
            workers[name] = Worker(target, shape, *peer.options, python=python_of(peer.library, arguments.venv))
            about[name] = workers[name].ready()
        same = {name: facts["parameters"] for name, facts in about.items() if "update" in facts["columns"]}
        assert all(parameters == same["ours"] for parameters in same.values()), f"networks differ: {same}"
        ways = {(name, column): partial(rate, name, column) for name in PEERS for column in about[name]["columns"]}
        results = in_turns(ways, arguments.rounds)
    finally:
        for worker in workers.values():
            worker.close()
    actor, critic = same["ours"]
    words = (
        f"{shape.scenario}: {shape.agents} agents, observations of {shape.observation} and actions of {shape.action}; "
        f"an actor has {actor} parameters, a critic {critic} (SAC: {about['RLlib SAC']['parameters']})"
    )
    rates: Rates = {name: {} for name in PEERS}
    for (name, column), values in results.items():
        rates[name][column] = values
    return rates, f"{words}; what was measured had at least {least:.0%} of the core"


def row_of(title: str, name: str, rates: Rates, at_nine: bool) -> tuple[str, list[str]]:
    """Return a library's row of the table, and the bars that it misses, in words."""
    cells, below = [], []
    for column in COLUMNS:
        if column not in rates[name]:
            cells.append("-")
            continue
        ratio = median_ratio(rates["ours"][column], rates[name][column])
        median = statistics.median(rates[name][column])
        cells.append(f"{median:.3g}" + ("" if name == "ours" else f" ({ratio:.1f})"))
        bar = PEERS[name].updates if column != "train" else PEERS[name].env_steps if at_nine else 0.0
        if ratio < bar:
            below.append(f"below the bar, {title}: ours / {name}, {column}: {ratio:.2f}, not {bar:g}")
    return row([title, name, *cells]), below


def main() -> None:
    """Prints the table; exits with 1 if a ratio is below its bar."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0, help="per number and round")
    parser.add_argument("--venv", type=Path, default=Path(tempfile.gettempdir()) / "rllib-maobs-maddpg-peers")
    arguments = parser.parse_args()
    notes, below = [], []
    print(f"| | | {' | '.join(COLUMNS.values())} |")
    print("|---" * (2 + len(COLUMNS)) + "|")
    for title, (scenario, batch) in SHAPES.items():
        rates, words = measure(sizes_of(scenario, batch), arguments)
        notes.append(words)
        for name in PEERS:
            line, missed = row_of(title, name, rates, at_nine=scenario == "spread-9a")
            print(line, flush=True)
            below += missed
    print(
        COMPARED.format(
            rounds=arguments.rounds,
            seconds=arguments.seconds,
            versions="; ".join([f"torch {version('torch')}, ray {version('ray')}", *map(", ".join, PACKAGES.values())]),
            hidden=", ".join(map(str, HIDDEN)),
            rows=ROWS,
            copies=COPIES,
        )
    )
    print("\n".join([*(f"- {words}." for words in notes), *below]))
    sys.exit(bool(below))


if __name__ == "__main__":
    main()
