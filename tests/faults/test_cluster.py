"""Many machines: trials on the nodes of a cluster, nodes that go and come, results at a URL, and what cannot work."""

import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import ray
import yaml
from ray.autoscaler._private.util import prepare_config, validate_config
from ray.cluster_utils import Cluster

from rllib_maobs.experiment import load_curves
from rllib_maobs.experiment.dashboards import check_dashboards
from rllib_maobs.experiment.run import _check_cpus as check_cpus
from rllib_maobs.experiment.run import _start_ray as start_ray
from rllib_maobs.experiment.storage import Storage
from tests.test_extending import EXPERIMENT, arguments

# --- Results at a URL ---------------------------------------------------------------------------------------------


def test_results_may_be_at_a_url(
    ray_session: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Begun there, and made longer, as on another machine; every program has a folder of its own meanwhile."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "shared" / "a run"
    url = folder.as_uri()
    EXPERIMENT.main(["--results-dir", url + "/", "--quick", "--no-compile", "--algos", "iddpg"])
    out = capsys.readouterr().out
    assert f"Results: {url}\n" in out and f"In {url}: comparison.md, " in out
    assert f"An episode of iddpg-seed0, the best one: {url}/episode.gif" in out
    assert load_curves(folder)["env_steps"].tolist() == [24, 48]
    EXPERIMENT.main(["--results-dir", url, "--resume", "--stop-timesteps", "96"])
    out = capsys.readouterr().out
    assert f"Resuming demo in {url}\n" in out
    assert load_curves(folder)["env_steps"].tolist() == [24, 48, 72, 96]
    assert " 96 |" in (folder / "comparison.md").read_text()
    for name in ("comparison.csv", "curves.csv", "curves.png", "episode.gif", "experiment.json"):
        assert (folder / name).stat().st_size > 0
    assert not (folder / ".lock").exists() and [path.name for path in tmp_path.iterdir()] == ["shared"]
    with pytest.raises(SystemExit, match="2"):
        EXPERIMENT.main(["--results-dir", url])
    assert f"{url} is not empty: continue the run there with --resume" in capsys.readouterr().err


def test_a_storage_copies_all_but_checkpoints(tmp_path: Path) -> None:
    there = tmp_path / "there"
    for name in ("a/result.json", "a/checkpoint_000001/state.pkl", "b/checkpoint_000002/state.pkl"):
        (there / name).parent.mkdir(parents=True)
        (there / name).write_text(name)
    storage = Storage(there.as_uri())

    def here() -> list[str]:
        return sorted(str(path.relative_to(storage.folder)) for path in storage.folder.rglob("*") if path.is_file())

    storage.pull()
    assert here() == ["a/result.json"]
    storage.pull("b")
    assert here() == ["a/result.json", "b/checkpoint_000002/state.pkl"]
    (storage.folder / "b/checkpoint_000002/state.pkl").write_text("is not pushed")
    (storage.folder / "a/result.json").write_text("is pushed")
    storage.push()
    assert (there / "a/result.json").read_text() == "is pushed"
    assert (there / "b/checkpoint_000002/state.pkl").read_text() == "b/checkpoint_000002/state.pkl"
    storage.remove("a/result.json")
    assert not (there / "a/result.json").exists()


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("nowhere://bucket/run", "nowhere://bucket/run is no place for results (Unrecognized filesystem type in URI: "),
        ("s3://bucket", "s3://bucket names no folder; legal is, say, s3://bucket/results/my-run"),
        ("file:///proc/nothing/here", "file:///proc/nothing/here cannot be written: "),
    ],
)
def test_places_that_cannot_be(
    place: str, message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray, "init", None)  # nothing is started
    with pytest.raises(SystemExit, match="2"):
        EXPERIMENT.main(["--results-dir", place])
    assert f"error: --results-dir: {message}" in capsys.readouterr().err


def test_what_needs_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    url = (tmp_path / "run").as_uri()
    args = arguments(tmp_path / "new")
    args.storage = Storage(url)
    monkeypatch.setattr("rllib_maobs.experiment.dashboards.find_spec", lambda package: True)
    check_dashboards(args, "maobs/spread-3a")
    args.mlflow = True
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    with pytest.raises(ValueError, match="--mlflow with results at a URL needs a server"):
        check_dashboards(args, "maobs/spread-3a")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://server")
    args.wandb = True
    check_dashboards(args, "maobs/spread-3a")
    monkeypatch.setenv("WANDB_MODE", "offline")
    with pytest.raises(ValueError, match="WANDB_MODE=offline needs a folder"):
        check_dashboards(args, "maobs/spread-3a")
    with pytest.raises(SystemExit):
        EXPERIMENT.main(["--from", url])
    assert f"{url} is a URL; copy the checkpoint to a folder" in capsys.readouterr().err


# --- Clusters -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("address", "reason"), [("127.0.0.1:1", r"Connection refused"), ("nonsense", "Invalid address format")]
)
def test_a_cluster_that_cannot_be_reached(
    address: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    args = arguments(tmp_path / "new", "--address", address)
    with pytest.raises(SystemExit, match=rf"--address {address}: no Ray cluster can be reached there \(.*{reason}"):
        start_ray(args)


def test_a_trial_that_no_machine_can_run(ray_session: None, tmp_path: Path) -> None:
    args = arguments(tmp_path / "new", "--num-env-runners", "1")
    check_cpus(args)
    args.num_env_runners = 2
    with pytest.raises(SystemExit, match=r"a trial needs 3 CPUs .its own process and 2 EnvRunners., and .* has 2"):
        check_cpus(args)


def test_the_cluster_file_is_one() -> None:
    """By Ray's own schema; and it names what there is."""
    root = Path(__file__).parents[2]
    path = root / "tuned_examples" / "cluster.yaml"
    config = yaml.safe_load(path.read_text())
    validate_config(prepare_config(config))
    assert config["file_mounts"] == {"/home/ubuntu/rllib-maobs": "."} and (root / "constraints.txt").exists()


class Machines:
    """A cluster of a head, which runs no trials, and nodes of one CPU each that may be taken away."""

    def __init__(self) -> None:
        self.cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        self.nodes = [self.cluster.add_node(num_cpus=1), self.cluster.add_node(num_cpus=1)]

    def lose(self, node: Any) -> None:
        self.cluster.remove_node(node, allow_graceful=False)


@pytest.fixture
def machines(monkeypatch: pytest.MonkeyPatch, long: bool) -> Iterator[Machines]:
    if not long:
        pytest.skip("starts a cluster: pytest -m faults")
    # A place of its own for what Ray writes, and short for its sockets: else `ray.init()` anywhere on this machine
    # would join this cluster.
    with tempfile.TemporaryDirectory(prefix="r", dir="/tmp", ignore_cleanup_errors=True) as folder:
        monkeypatch.setenv("RAY_TMPDIR", folder)
        made = Machines()
        yield made
        made.cluster.shutdown()


SCRIPT = """
from rllib_maobs.experiment import Experiment

small = {
    "algorithm": "iddpg",
    "num_random_steps": 16,
    "num_steps_sampled_before_learning_starts": 16,
    "train_batch_size_per_learner": 8,
    "num_envs_per_env_runner": 4,
    "quick": {"stop_timesteps": 6000, "steps_per_iteration": 100, "evaluation_duration": 1},
}
experiment = Experiment(
    name="spread",
    env="maobs/spread-3a",
    algorithms=("one",),
    variants={"one": small},
    training={"updates_per_env_step": 0.1},
)
if __name__ == "__main__":
    experiment.main()
"""


def raylet_of(pid: int) -> int:
    """The process of the node that started a worker process."""
    environ = (Path("/proc") / str(pid) / "environ").read_text().split("\0")
    return int(next(line for line in environ if line.startswith("RAY_RAYLET_PID=")).partition("=")[2])


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().split("\n")[:-1]] if path.exists() else []


def test_trials_of_a_node_that_goes_run_on_another(machines: Machines, tmp_path: Path, tally: Counter[str]) -> None:
    """Two trials on two nodes; one goes, and one that comes later takes its place."""
    script, results = tmp_path / "spread.py", tmp_path / "results"
    script.write_text(SCRIPT)
    command = [sys.executable, str(script), "--quick", "--no-compile", "--seeds", "0", "1", "--checkpoint-freq", "5"]
    command += ["--address", machines.cluster.address, "--results-dir", results.as_uri()]
    trials = [results / f"one-seed{seed}" for seed in (0, 1)]
    with (tmp_path / "out.txt").open("w") as out:
        run = subprocess.Popen(command, cwd=tmp_path, stdout=out, stderr=subprocess.STDOUT, text=True)

    def said() -> str:
        return (tmp_path / "out.txt").read_text()

    def wait_for(condition: Any) -> Any:
        deadline = time.monotonic() + 240
        while not (value := condition()):
            assert run.poll() is None, said()
            assert time.monotonic() < deadline, said()
            time.sleep(0.2)
        return value

    try:
        wait_for(lambda: all(lines_of(trial / "result.json") and [*trial.glob("checkpoint_*")] for trial in trials))
        pids = [lines_of(trial / "result.json")[0]["pid"] for trial in trials]
        lost, kept = machines.nodes
        raylets = [node.all_processes["raylet"][0].process.pid for node in (lost, kept)]
        on = [raylet_of(pid) for pid in pids]
        assert sorted(on) == sorted(raylets)
        first = on.index(raylets[0])
        machines.lose(lost)
        wait_for(lambda: "failed (" in said())
        new = machines.cluster.add_node(num_cpus=1)
        wait_for(lambda: lines_of(trials[first] / "result.json")[-1]["pid"] != pids[first])
        again = lines_of(trials[first] / "result.json")[-1]
        assert raylet_of(again["pid"]) == new.all_processes["raylet"][0].process.pid
        assert again["iterations_since_restore"] < again["training_iteration"]
        assert run.wait(timeout=240) == 0, said()
    finally:
        run.kill()
    curves = load_curves(results).groupby("trial")["env_steps"]
    for trial in trials:
        assert curves.get_group(trial.name).tolist() == list(range(100, 6001, 100))
    assert {line["pid"] for line in lines_of(trials[1 - first] / "result.json")} == {pids[1 - first]}
    tally["machines lost"] += 1
