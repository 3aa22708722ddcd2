"""What a finished (or running) experiment shows: learning curves, a picture of them, a comparison table.

Everything here reads the files that Ray Tune writes, so a notebook can use it on any results folder:

    curves = load_curves("results/spread-9a")
    print(summarise(curves))
    plot_curves(curves, "curves.png")
"""

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rllib_maobs.experiment.tables import format_table, format_time

FILES = ("comparison.md", "comparison.csv", "curves.csv", "curves.png")
SCORE = "score"
# How the table calls what is measured, in its order; a task reports those that make sense for it.
LABELS = {
    SCORE: "score",
    "coverage": "coverage",
    "success": "success",
    "all_covered": "all covered",
    "captures": "captures",
    "collisions": "collisions / episode",
    "collision_free": "collision-free",
}
# Evaluations at the end of a trial whose mean is its result; and of one of a quick run.
LAST = 10
LAST_QUICK = 3
STEPS = "num_env_steps_sampled_lifetime"
FILM = "episode.gif"
# How lines of policies that are not trained are drawn, and from which ratio on scores get a logarithmic axis.
_STYLES = (":", "--", "-.")
_MUCH = 5.0


def evaluation_metrics(result: Mapping[str, Any]) -> dict[str, float]:
    """Take the means over the evaluation episodes out of one RLlib result.

    Args:
        result: What `Algorithm.train()` returned.

    Returns:
        The metrics of the environment by name, `score` (undiscounted return of the first agent) and `collisions`
        (with agents, obstacles and walls together). Empty if no episode has been evaluated yet.
    """
    runners = result.get("evaluation", {}).get("env_runners", {})
    metrics = _with_collisions(runners.get("episode_metrics", {}))
    if returns := runners.get("agent_episode_returns_mean"):
        metrics[SCORE] = float(returns[min(returns)])
    return metrics


def _with_collisions(episode_metrics: Mapping[str, Any]) -> dict[str, float]:
    metrics = {name: float(value) for name, value in episode_metrics.items()}
    collisions = [value for name, value in metrics.items() if name.startswith("collisions_")]
    return metrics | ({"collisions": sum(collisions)} if collisions else {})


def load_curves(results_dir: str | Path) -> pd.DataFrame:
    """Read the learning curves of all trials of an experiment.

    Args:
        results_dir: The folder that the experiment wrote to.

    Returns:
        One row per trial and evaluation, ordered by trial and env steps: `trial`, `algorithm`, `seed`, `env_steps`,
        `score`, every metric of the environment, `time_total_s` and `env_steps_per_s` (evaluation included). Rows
        that a resumed trial computed again replace the first ones.

    Raises:
        FileNotFoundError: If no trial has reported anything there.
    """
    trials = {path.parent.name: _read_results(path) for path in sorted(Path(results_dir).glob("*/result.json"))}
    rows = []
    for trial, results in trials.items():
        before = 0
        for result in results:
            steps = int(result[STEPS])
            rows.append(
                {
                    "trial": trial,
                    "algorithm": result["config"]["algorithm"],
                    "seed": int(result["config"]["seed"]),
                    "env_steps": steps,
                    **evaluation_metrics(result),
                    "time_total_s": float(result["time_total_s"]),
                    "env_steps_per_s": (steps - before) / max(float(result["time_this_iter_s"]), 1e-9),
                }
            )
            before = steps
    if not rows:
        raise FileNotFoundError(f"No trial has reported a result in {results_dir}")
    curves = pd.DataFrame(rows)
    first = ["trial", "algorithm", "seed", "env_steps", *(name for name in LABELS if name in curves)]
    return curves[[*first, *(name for name in curves if name not in first)]]


def _read_results(path: Path) -> list[dict[str, Any]]:
    """Read one trial's result.json: one JSON object per line."""
    results: list[dict[str, Any]] = []
    for line in path.read_text().splitlines():
        try:
            result = json.loads(line)
        except json.JSONDecodeError:
            continue  # The last line of a run that was killed while writing it.
        # A resumed trial goes back to its last checkpoint; what it had reported after that is void.
        while results and results[-1][STEPS] >= result[STEPS]:
            results.pop()
        results.append(result)
    return results


def _rewrite_progress_csv(path: Path) -> None:
    """Write one trial's progress.csv anew from its result.json.

    Tune fixes the columns of progress.csv with the first result. What comes later is left out, such as the metrics of
    training episodes that end in a later iteration, and after a resume the columns no longer fit their names.
    """
    table = pd.json_normalize(
        [{key: value for key, value in result.items() if key != "config"} for result in _read_results(path)], sep="/"
    )
    table.to_csv(path.with_name("progress.csv"), index=False)


def summarise(curves: pd.DataFrame, last: int = LAST) -> pd.DataFrame:
    """Compare the algorithms by their last evaluations.

    Args:
        curves: From `load_curves`.
        last: How many evaluations at the end of each trial count; their mean is the trial's result.

    Returns:
        One row per algorithm, best score first: `seeds` (number of trials), `env_steps` (of the shortest trial), for
        every measure its mean over the seeds, `score_std` (sample standard deviation over the seeds, NaN for a
        single one), `env_steps_per_s` and `hours` (per trial, means over the seeds).
    """
    measures = [name for name in LABELS if name in curves]
    if "all_covered" in measures:
        measures.remove("success")  # It is the same there.
    by_trial = curves.groupby(["algorithm", "trial"], sort=False)
    trials = _by_trial(curves, measures, last)
    end = by_trial[["env_steps", "time_total_s"]].last()
    trials["env_steps"] = end["env_steps"]
    trials["env_steps_per_s"] = end["env_steps"] / end["time_total_s"]
    trials["hours"] = end["time_total_s"] / 3600

    by_algorithm = trials.groupby("algorithm", sort=False)
    table = by_algorithm[[*measures, "env_steps_per_s", "hours"]].mean()
    table.insert(0, "seeds", by_algorithm.size())
    table.insert(1, "env_steps", by_algorithm["env_steps"].min())
    if SCORE in table:
        table.insert(table.columns.get_loc(SCORE) + 1, "score_std", by_algorithm[SCORE].std())
        table = table.sort_values(SCORE, ascending=False)
    return table


def _by_trial(curves: pd.DataFrame, measures: list[str], last: int) -> pd.DataFrame:
    """Return the results of each trial, by algorithm and trial."""
    by_trial = curves.groupby(["algorithm", "trial"], sort=False)
    return by_trial[measures].agg(lambda column: column.tail(last).mean())


def best_trial(curves: pd.DataFrame, last: int = LAST) -> str | None:
    """Return the best trial of the best algorithm, by score.

    Args:
        curves: From `load_curves`.
        last: See `summarise`.

    Returns:
        Its name; None if nothing has a score.
    """
    if SCORE not in curves:
        return None
    scores = _by_trial(curves, [SCORE], last)[SCORE].dropna()
    if scores.empty:
        return None
    algorithm = scores.groupby("algorithm", sort=False).mean().idxmax()
    return str(scores[algorithm].idxmax())


def to_markdown(table: pd.DataFrame, baselines: Mapping[str, Mapping[str, float]] | None = None) -> str:
    """Write the table of `summarise` as markdown.

    Args:
        table: From `summarise`.
        baselines: Metrics of policies that are not trained, from `play_baselines`; the last rows.

    Returns:
        A markdown table, aligned to be read as plain text too.
    """
    measures = [name for name in LABELS if name in table]
    header = ["algorithm", "seeds", "env steps", *(LABELS[name] for name in measures), "env steps/s", "time"]
    rows = []
    for algorithm, row in table.iterrows():
        cells = [str(algorithm), f"{row['seeds']:.0f}", f"{row['env_steps']:,.0f}"]
        cells += [format_metric(name, row[name]) for name in measures]
        if SCORE in measures and row["seeds"] > 1:
            cells[3 + measures.index(SCORE)] += f" ± {row['score_std']:.1f}"
        rows.append([*cells, f"{row['env_steps_per_s']:.0f}", format_time(3600 * row["hours"])])
    for policy, metrics in (baselines or {}).items():
        measured = _measured(metrics)
        cells = [format_metric(name, measured[name]) if name in measured else "-" for name in measures]
        rows.append([policy, "-", "-", *cells, "-", "-"])
    return format_table(header, rows, markdown=True)


def _measured(metrics: Mapping[str, float]) -> dict[str, float]:
    """Return the metrics of a policy that is not trained, called as those of trials are."""
    return {**_with_collisions(metrics), SCORE: metrics["return_agent_0"]}


def format_metric(name: str, value: float) -> str:
    """Write a metric with as many decimals as say something."""
    return f"{value:.1f}" if name in (SCORE, "collisions", "captures") else f"{value:.2f}"


def plot_curves(
    curves: pd.DataFrame,
    path: str | Path,
    title: str = "",
    points: int = 50,
    baselines: Mapping[str, Mapping[str, float]] | None = None,
) -> None:
    """Draw score and coverage (or success, for tasks without targets to share) against env steps.

    Each algorithm is a line, the mean over its seeds, in a band from its worst to its best seed. Policies that are not
    trained are horizontal lines. Scores that are all negative and differ much, as sums of distances do, are drawn on a
    logarithmic axis: else random play leaves no room for what is good.

    Args:
        curves: From `load_curves`.
        path: The picture's file; its ending chooses the format.
        title: Written above.
        points: Evaluations are averaged to at most so many points per line.
        baselines: Metrics of policies that are not trained, from `play_baselines`.
    """
    # The figure is drawn without pyplot: no window, no global state, whatever backend a notebook has chosen.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = [name for name in (SCORE, "coverage" if "coverage" in curves else "success") if name in curves]
    width = max(int(curves["env_steps"].max()) / points, 1.0)
    binned = curves.assign(bin=np.ceil(curves["env_steps"] / width))
    by_trial = binned.groupby(["algorithm", "trial", "bin"], sort=False)[["env_steps", *shown]].mean()
    levels = {policy: _measured(metrics) for policy, metrics in (baselines or {}).items()}

    figure = Figure(figsize=(6.0 * len(shown), 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    lines: dict[str, Any] = {}  # one legend for all panels
    for axes, name in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        for algorithm, trials in by_trial.groupby("algorithm", sort=False):
            bins = trials.groupby("bin")
            steps, seeds = bins["env_steps"].mean(), bins[name]
            (line,) = axes.plot(steps, seeds.mean(), marker="o" if len(steps) < 10 else "")
            lines.setdefault(str(algorithm), line)
            axes.fill_between(steps, seeds.min(), seeds.max(), color=line.get_color(), alpha=0.2, linewidth=0)
        here = {policy: level[name] for policy, level in levels.items() if name in level}
        for (policy, level), style in zip(here.items(), _STYLES, strict=False):
            lines.setdefault(policy, axes.axhline(level, color="0.35", linestyle=style, linewidth=1.2))
        axes.set_xlabel("env steps")
        axes.set_ylabel(LABELS[name])
        if name == SCORE:
            scaled = _scale_scores(axes, [*by_trial[name].dropna(), *here.values()])
            axes.set_ylabel("score: return of the first agent" + (", logarithmic" if scaled else ""))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
        axes.grid(alpha=0.3)
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=4)
    if title:
        figure.suptitle(title)
    figure.savefig(path, dpi=150)


def _scale_scores(axes: Any, values: list[float]) -> bool:
    """Make the axis of scores logarithmic if they are all negative and differ much; returns whether it did."""
    from matplotlib.ticker import FixedLocator

    if not values or max(values) >= 0 or min(values) > _MUCH * max(values):
        return False
    best, worst = -max(values), -min(values)
    low, high = best / 1.25, worst * 1.25
    axes.set_yscale("function", functions=(lambda y: -np.log(np.maximum(-y, 1e-9)), lambda y: -np.exp(-y)))
    axes.set_ylim(-high, -low)
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    ticks = [-digit * 10.0**decade for decade in decades for digit in (1, 2, 5)]
    axes.yaxis.set_major_locator(FixedLocator([tick for tick in ticks if low <= -tick <= high]))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:,.0f}" if value <= -1 else f"{value:g}")
    return True


def write_report(
    results_dir: Path,
    title: str,
    failed: Collection[str] = (),
    baselines: Mapping[str, Mapping[str, float]] | None = None,
    last: int = LAST,
) -> str:
    """Write the `FILES` into the results folder, and complete the trials' progress.csv.

    Args:
        results_dir: The folder that the experiment wrote to.
        title: Heading of the picture and of the table.
        failed: Trials that are left out of the comparison; their curves are drawn as far as they got.
        baselines: Metrics of policies that are not trained, from `play_baselines`: rows of the markdown table.
        last: How many evaluations at the end of each trial count; their mean is the trial's result.

    Returns:
        The comparison table as markdown, and what its numbers are.

    Raises:
        FileNotFoundError: If no trial has reported anything there.
    """
    curves = load_curves(results_dir)
    for path in results_dir.glob("*/result.json"):
        _rewrite_progress_csv(path)
    curves.to_csv(results_dir / "curves.csv", index=False)
    plot_curves(curves, results_dir / "curves.png", title, baselines=baselines)
    table = summarise(curves[~curves["trial"].isin(list(failed))], last)
    table.to_csv(results_dir / "comparison.csv")
    note = (
        f"Noise-free evaluation: means over the last {last} evaluations of each trial, then over the seeds (score: ± "
        f"their standard deviation). Time is h:mm:ss per trial."
    )
    if baselines:
        note += f" Not trained: {' and '.join(baselines)}, means over 100 episodes."
    if failed:
        note += f" Failed and left out: {', '.join(failed)}."
    markdown = f"{to_markdown(table, baselines)}\n\n{note}"
    (results_dir / "comparison.md").write_text(f"# {title}\n\n{markdown}\n\n![learning curves](curves.png)\n")
    return markdown


def embed_film(results_dir: Path, trial: str) -> None:
    """Show the film in comparison.md, below the curves.

    Args:
        results_dir: The folder that holds both.
        trial: Whose film it is.
    """
    with (results_dir / "comparison.md").open("a") as file:
        file.write(f"\n![an episode of {trial}]({FILM})\n")
