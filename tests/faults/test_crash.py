"""Trainings that are killed at any moment, and go on as if nothing had happened."""

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import ray
import torch
from ray.tune.result import SHOULD_CHECKPOINT

from rllib_maobs.experiment.claim import hold, wait_until_free
from rllib_maobs.experiment.keeping import LOGS, SAVING, find_unfit, last_result
from rllib_maobs.experiment.preemption import EXIT_CODE, Preemption
from rllib_maobs.experiment.resume import STATES, take_up
from rllib_maobs.whole import numbered
from tests.faults.tiny import EXPERIMENT, ITERATION, TRIAL, flip, iterations, rows, uninterrupted, weights

ROOT = Path(__file__).parent.parent.parent


def train(folder: Path, *given: str) -> None:
    """The program in this process."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("rllib_maobs.experiment.run.film_best", lambda *args: "")
        monkeypatch.setattr("rllib_maobs.experiment.run.play_baselines", lambda *args: {})
        monkeypatch.setattr("rllib_maobs.experiment.run.print_plan", lambda *args: None)
        monkeypatch.setattr("rllib_maobs.experiment.report.plot_curves", lambda *args, **kwargs: None)
        EXPERIMENT.main(["--results-dir", str(folder), *given])


@contextlib.contextmanager
def program(folder: Path, *given: str) -> Iterator[subprocess.Popen[str]]:
    """The program in a process of its own, on this process's Ray."""
    address = ray.get_runtime_context().gcs_address
    command = [sys.executable, "-m", "tests.faults.tiny", "--results-dir", str(folder), "--address", address, *given]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_for(condition: Callable[[], object], process: subprocess.Popen[str] | None = None) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        if process is not None and process.poll() is not None:
            raise AssertionError(f"ended too early: {process.stdout and process.stdout.read()}")
        assert time.monotonic() < deadline, "takes too long"
        time.sleep(0.002)


def newest(folder: Path) -> int:
    return max((int(path.name[-6:]) for path in numbered(folder / TRIAL)), default=-1)


def kill(folder: Path, when: str, chance: random.Random, *given: str) -> str:
    """Start the program and kill it: while it starts, saves, has Tune copy the checkpoint, or at any moment.

    Returns:
        What it has printed.
    """
    before, trial = newest(folder), folder / TRIAL
    with program(folder, *given) as process:
        if when == "start":
            time.sleep(chance.uniform(0.0, 8.0))
        else:
            wait_for(lambda: newest(folder) > before, process)
        if when == "save":
            wait_for((trial / SAVING).exists, process)
            time.sleep(chance.uniform(0.0, 0.08))
        elif when == "copy":
            there = newest(folder)
            wait_for(lambda: newest(folder) > there, process)
            time.sleep(chance.uniform(0.0, 0.01))
        elif when == "any":
            time.sleep(chance.uniform(0.0, 1.0))
        assert process.poll() is None, process.stdout and process.stdout.read()
        process.kill()
        return process.stdout.read() if process.stdout else ""


def test_a_training_that_is_killed_again_and_again(
    ray_session: None,
    tmp_path: Path,
    long: bool,
    tally: Counter[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """First ended by SIGTERM, then killed and resumed: it ends with the rows and weights of the uninterrupted one."""
    folder, chance, steps = tmp_path / "a [killed] run", random.Random(0), ITERATION * (120 if long else 20)
    stop = threading.Timer(0.0, lambda: (wait_for(lambda: newest(folder) >= 1), os.kill(os.getpid(), signal.SIGTERM)))
    stop.start()
    with pytest.raises(SystemExit) as end:
        train(folder, "--quick", "--no-compile", "--stop-timesteps", str(steps), "--checkpoint-freq", "2")
    stop.join()
    assert end.value.code == EXIT_CODE == 143
    assert "SIGTERM: every trial is saved" in (said := capsys.readouterr().out)
    assert "Ended by SIGTERM. Go on with: python " in said
    damaged = numbered(folder / TRIAL)[0]
    assert find_unfit(damaged) is None
    assert last_result(damaged)["training_iteration"] == len(rows(folder)), "it has not saved what it had done"
    flip(damaged / "replay_buffer" / "state.pkl", bit=1000)
    (state,) = folder.glob(STATES)
    state.write_bytes(state.read_bytes()[:1000])  # as Ray leaves it if the program dies while it is copied
    moments = ["any", "save", "start", "copy"] * 5 if long else ["save", "copy"]
    for number, when in enumerate(moments):
        said = kill(folder, when, chance, "--resume")
        tally["kills survived"] += 1
        if number == 0:
            found = "is no whole checkpoint: replay_buffer/state.pkl has changed since it was saved (another checksum)"
            assert f"{TRIAL}: {damaged} {found} (it is kept as damaged_{damaged.name}); the one before it is" in said
            assert damaged.with_name(f"damaged_{damaged.name}").is_dir()
    assert wait_until_free(folder / TRIAL, 10.0), "its processes live on"
    train(folder, "--resume")

    expected = list(range(1, steps // ITERATION + 1))
    for name, found in iterations(folder).items():
        assert found == expected, name
        tally["rows duplicated"] += len(found) - len(set(found))
        tally["rows lost"] += len(set(expected) - set(found))
    results, networks = uninterrupted(steps)
    assert rows(folder) == results
    tally["steps lost"] += int(steps - ITERATION * iterations(folder)["result.json"][-1])
    there = weights(folder)
    assert there.keys() == networks.keys()
    assert all(torch.equal(there[name], value) for name, value in networks.items())
    checkpoint = folder / TRIAL / f"checkpoint_{newest(folder):06d}"
    assert (checkpoint / LOGS / "result.json").read_text() == (folder / TRIAL / "result.json").read_text()

    # A trial that is finished stays so if somebody has removed its checkpoints.
    for path in numbered(folder / TRIAL):
        shutil.rmtree(path)
    assert take_up(folder, kept=2)
    ((trial, _),) = json.loads(max(folder.glob(STATES)).read_text())["trial_data"]
    assert json.loads(trial)["status"] == "TERMINATED"
    assert rows(folder) == results


def test_sigterm_waits_for_every_trial_that_has_made_an_iteration(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = list[int]()
    trials = [SimpleNamespace(trial_id=name, status="RUNNING") for name in ("a", "b", "starts")]
    with Preemption() as preemption:
        for trial in trials[:2]:
            preemption.on_trial_result(0, trials, trial, result := {})
            assert result == {}
        preemption.on_trial_save(0, trials, trials[0])  # before the signal: it does not count
        os.kill(os.getpid(), signal.SIGTERM)
        monkeypatch.setattr(os, "kill", lambda process, number: ended.append(number))
        for trial in trials[:2]:
            assert not ended
            preemption.on_trial_result(0, trials, trial, result := {})
            assert result == {SHOULD_CHECKPOINT: True}
            preemption.on_step_end(0, trials)
            preemption.on_trial_save(0, trials, trial)
            preemption.on_step_end(0, trials)
    assert ended == [signal.SIGUSR1]


def test_a_folder_is_free_when_its_process_has_ended(tmp_path: Path) -> None:
    assert wait_until_free(tmp_path, 0.0)
    held, too = hold(tmp_path), hold(tmp_path)  # a trial's process that is started again, before the old one has ended
    assert held is not None and too is not None
    held.close()
    assert not wait_until_free(tmp_path, 0.2)
    too.close()
    assert wait_until_free(tmp_path, 0.0)


def test_a_second_sigterm_ends_at_once() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with Preemption() as preemption:
        os.kill(os.getpid(), signal.SIGTERM)
        assert preemption.came
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_run_goes_on_while_the_disk_is_full(
    ray_session: None, tmp_path: Path, long: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """A small disk that has room for two checkpoints."""
    if not long:
        pytest.skip("in the long form only; tests/faults/test_torn.py has a trial that cannot save")
    folder = tmp_path / "run"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4600k", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("no rights to mount a tmpfs; tests/faults/test_torn.py has a limit of the process in its place")
    try:
        train(folder, "--quick", "--no-compile", "--stop-timesteps", "240", "--checkpoint-freq", "1")
        assert iterations(folder)["result.json"] == list(range(1, 11))
        there = [int(path.name[-6:]) + 1 for path in numbered(folder / TRIAL)]  # saved after which iteration
        assert len(there) == 2 and max(there) < 10
        assert all(find_unfit(path) is None for path in numbered(folder / TRIAL))
        assert {path.name for path in (folder / TRIAL).glob(".*")} <= {".lock"}
    finally:
        subprocess.run(["umount", str(folder)], check=True)
    told = [
        f"The checkpoint of {TRIAL} at {ITERATION * iteration} env steps could not be written (No space left on device)"
        f"; training goes on, and the one before it stays."
        for iteration in range(max(there) + 1, 11)
    ]
    said = capsys.readouterr().out
    assert said.endswith("\n".join(told) + "\n")
    assert [said.count(sentence) for sentence in told] == [2] * len(told)


def test_the_children_of_a_killed_run_end(tmp_path: Path, long: bool) -> None:
    """One that has started Ray itself; the trial's process is gone before a resumed run reads what it has written."""
    if not long:
        pytest.skip("in the long form only: it starts a Ray of its own")
    folder = tmp_path / "run"
    command = [sys.executable, "-m", "tests.faults.tiny", "--results-dir", str(folder), "--quick", "--no-compile"]
    given = ["--stop-timesteps", "24000", "--checkpoint-freq", "1"]
    with subprocess.Popen([*command, *given], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            wait_for(lambda: newest(folder) >= 1, process)
            children = psutil.Process(process.pid).children(recursive=True)
        finally:
            process.kill()
    trials = [child for child in children if "ray::Trial" in child.name()]
    assert len(trials) == 1
    assert wait_until_free(folder / TRIAL, 10.0)
    gone, alive = psutil.wait_procs(trials, timeout=10.0)
    assert gone and not alive
    there = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    time.sleep(1.0)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == there
