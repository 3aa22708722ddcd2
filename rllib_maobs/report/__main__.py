"""What experiments showed, as one page: `python -m rllib_maobs.report RESULTS_DIR [MORE...]`.

    python -m rllib_maobs.report results/spread-9a
    python -m rllib_maobs.report results/spread-3a results/spread-9a --output both.html

RESULTS_DIR is what a program in tuned_examples/ wrote to; the run may still be going on. The page holds learning
curves, final scores, statistics over the seeds, settings, speed and episodes to watch, beside random play, the
heuristic and ORCA. It is one HTML file that needs no network.
"""

import argparse
import logging
import os
import platform
import sys
import tempfile
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rllib_maobs.envs import SCENARIOS
from rllib_maobs.evaluate import Task, baselines_of, evaluated, jobs_of
from rllib_maobs.experiment.report import SCORE
from rllib_maobs.paths import local
from rllib_maobs.report.episodes import best_and_median, record_episode
from rllib_maobs.report.results import Section, read_results

OUTPUT = "report.html"
_EPISODES = 100  # of each baseline


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line.

    Args:
        arguments: Those of the command line by default.
    """
    parser = argparse.ArgumentParser(
        prog="python -m rllib_maobs.report", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="RESULTS_DIR", help="results of experiments")
    parser.add_argument("--output", type=Path, metavar="FILE", help=f"default: {OUTPUT} in the first folder")
    parser.add_argument("--force", action="store_true", help="replace the file if there is one")
    parser.add_argument("--seed", type=int, default=0, help="of the episodes to watch (default: 0)")
    args = parser.parse_args(arguments)
    try:
        # Not resolved: the page calls results what the user calls them.
        folders = list(dict.fromkeys(Path(os.path.abspath(local(folder))) for folder in args.folders))
        if find_spec("bokeh") is None:
            raise ValueError('the report needs bokeh: pip install -c constraints.txt -e ".[report]"')
        if not 0 <= args.seed < 2**63:
            raise ValueError(f"--seed {args.seed} is illegal; legal: an integer >= 0 of 63 bits")
        sections, notes = read_results(folders)
        output = local(args.output or folders[0] / OUTPUT).resolve()
        check_output(output, force=args.force)
    except ValueError as error:
        parser.error(str(error))
    from rllib_maobs.report.page import build_page  # needs bokeh

    episodes = []
    for section in sections:
        section.baselines = play_baselines(section)
        played, missing = play_teams(section, args.seed)
        episodes.append(played)
        notes += missing

    write_whole(output, build_page(sections, notes, episodes, machine()))
    for note in notes:
        print(note)
    print(f"written: {output} ({output.stat().st_size / 1e6:.1f} MB)")


def check_output(output: Path, *, force: bool) -> None:
    """Raise a ValueError if the page cannot be written there."""
    if output.is_dir():
        raise ValueError(f"--output {output} is a folder: give a file in it, such as {output / OUTPUT}")
    if not output.parent.is_dir():
        raise ValueError(f"there is no folder {output.parent} for {output.name}")
    if output.exists() and not force:
        raise ValueError(f"{output} exists: add --force to replace it, or choose another file with --output")
    if not os.access(output.parent, os.W_OK):
        raise ValueError(f"{output.parent} cannot be written: choose another file with --output")


def write_whole(output: Path, text: str) -> None:
    """Write a file so that it is there whole, or as it was before."""
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", dir=output.parent, delete=False) as file:
        try:
            file.write(text)
            file.flush()
            os.chmod(file.name, 0o644)
            os.replace(file.name, output)
        except BaseException:
            os.unlink(file.name)
            raise


def play_baselines(section: Section) -> dict[str, dict[str, float]]:
    """Return the means over episodes of what is not trained, by policy and measure; nothing on foreign tasks."""
    task = _task(section)
    if task is None:
        return {}
    means = {}
    for policy in baselines_of(task):
        rows = evaluated(task, policy, _EPISODES, seed=0).drop(columns=["env", "agents", "options", "policy"])
        mean = {str(name): float(value) for name, value in rows.mean().items()}
        contacts = sum(value for name, value in mean.items() if name.startswith("collisions_"))
        means[policy] = mean | {SCORE: mean["return_agent_0"], "collisions": contacts}
    return means


def play_teams(section: Section, seed: int) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Play an episode with the best and the median team of every algorithm, and with the baselines.

    Args:
        section: The task.
        seed: Of the episode, the same for all.

    Returns:
        Episodes by what they are called, and sentences about those that there are none of.
    """
    task = _task(section)
    if task is None:
        return {}, [f"{section.name}: no episodes to watch, for it is not an environment of this package"]
    episodes, missing = {}, []
    for trials in section.rows.values():
        for name, trial in best_and_median(trials).items():
            try:
                ((checkpoint, own),) = jobs_of(str(trial.folder), None, [], {})
                episodes[name] = record_episode(own, checkpoint, seed)
            except (ValueError, OSError, EOFError, KeyError) as error:  # such as a checkpoint that is being written
                # Without the path: the page is to be sent to others.
                reason = str(error).partition("; legal")[0].replace(str(trial.folder), trial.folder.name)
                missing.append(f"{section.name}: no episode of {name}: {reason}")
    for policy in section.baselines:
        episodes[f"{policy} (not trained)"] = record_episode(task, policy, seed)
    return episodes, missing


def _task(section: Section) -> Task | None:
    scenario = section.env.removeprefix("maobs/")
    return Task(scenario, section.options) if scenario in SCENARIOS else None


def machine() -> str:
    """Return the machine and the versions that make the page."""
    names = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    cpu = next((line.partition(": ")[2] for line in names if line.startswith("model name")), platform.machine())
    packages: Mapping[str, str] = {name: version(name) for name in ("rllib-maobs", "ray", "torch", "numpy", "bokeh")}
    return ", ".join(
        [
            f"{os.cpu_count()} cores ({cpu})",
            f"{platform.system()}",
            f"Python {platform.python_version()}",
            *(f"{name} {number}" for name, number in packages.items()),
        ]
    )


if __name__ == "__main__":
    logging.getLogger("ray").setLevel(logging.ERROR)  # notes of RLlib to its own developers
    main(sys.argv[1:])
