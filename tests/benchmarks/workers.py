"""Processes that measure, one for each thing that is measured, and virtual environments for other libraries.

A `Worker` is a process with a target: a function in a module, given by name, which prepares what is measured and
returns a `Job`. From then on the process waits, and measures whenever it is asked to. Both sides speak in JSON lines.

This runs in the virtual environments of other libraries, too, so it imports the standard library only.
"""

import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[2]
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "PYTHONWARNINGS": "ignore",
}


class Job(NamedTuple):
    """What a target returns: what is called to measure, and what there is to know before."""

    measure: Callable[..., Any]
    about: Any = None


def free_cores() -> list[int]:
    """Return the cores that this process may use; all, where the system cannot say."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def bind(cores: Collection[int]) -> None:
    """Let this process, and what it starts, use these cores only; nothing happens where the system cannot do it."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)


class Worker:
    """A process that measures.

    Args:
        target: Where its function is, `"package.module:function"`.
        *arguments: Of that function; JSON, as everything that is sent.
        cores: Those that the process is bound to from its start; None for all that this one may use.
        python: Its interpreter.
    """

    def __init__(
        self, target: str, *arguments: Any, cores: Collection[int] | None = None, python: str = sys.executable
    ) -> None:
        self.name = " ".join([target, *map(str, arguments)])
        self.share = 0.0  # of a core's time, that it had while it measured last
        self._log = tempfile.TemporaryFile("w+")
        order = json.dumps([target, arguments, cores and sorted(cores)])
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        self._process = subprocess.Popen(
            [python, "-P", "-c", "from tests.benchmarks.workers import serve; serve()", order],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            env=os.environ | ONE_THREAD | {"PYTHONPATH": path},
        )

    def _line(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            self._log.seek(0)
            raise RuntimeError(f"{self.name} failed:\n{self._log.read()[-4000:]}")
        return json.loads(line)

    def ready(self) -> Any:
        """Wait until it can measure; return what there is to know before."""
        return self._line()

    def ask(self, *arguments: Any) -> None:
        """Let it measure."""
        assert self._process.stdin is not None
        print(json.dumps(arguments), file=self._process.stdin, flush=True)

    def answer(self) -> Any:
        """Wait for what it measured."""
        result, self.share = self._line()
        return result

    def measured(self, *arguments: Any) -> Any:
        """Let it measure, and wait for the result."""
        self.ask(*arguments)
        return self.answer()

    def close(self) -> None:
        """End the process."""
        self._process.communicate()
        self._log.close()


def serve() -> None:
    """Be a worker."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what libraries print is not an answer
    target, arguments, cores = json.loads(sys.argv[1])
    if cores:
        bind(cores)
    module, function = target.split(":")
    job = getattr(importlib.import_module(module), function)(*arguments)
    print(json.dumps(job.about), file=answers)
    for line in sys.stdin:
        start, cpu = time.perf_counter(), time.process_time()
        result = job.measure(*json.loads(line))
        share = (time.process_time() - cpu) / (time.perf_counter() - start)
        print(json.dumps([result, share]), file=answers)


def same_torch() -> str:
    """Return the requirement of the PyTorch that this package runs on."""
    return f"torch=={version('torch').partition('+')[0]}"


def python_with(folder: Path, *installs: Sequence[str]) -> str:
    """Return the interpreter of a virtual environment.

    Args:
        folder: Where the environment is; it is made if it does not hold these packages.
        *installs: The packages, those of each call of pip together.
    """
    python, done = folder / "bin" / "python", folder / "installed"
    if not done.exists() or done.read_text() != str(installs):
        names = ", ".join(name for packages in installs for name in packages)
        print(f"making {folder} with {names} ...", file=sys.stderr, flush=True)
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(folder)], check=True)
        for packages in installs:
            subprocess.run([python, "-m", "pip", "install", "-q", *packages], check=True)
        done.write_text(str(installs))
    return str(python)
