"""The page itself: what was read and computed, as tables, charts and text in one HTML file."""

import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np
from bokeh.embed import json_item
from bokeh.models import FactorRange, FixedTicker, HoverTool, NumeralTickFormatter
from bokeh.plotting import figure
from bokeh.resources import Resources
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray

from rllib_maobs.experiment.report import SCORE
from rllib_maobs.experiment.tables import format_time
from rllib_maobs.report.results import MEASURES, Section, Trial
from rllib_maobs.report.statistics import (
    Estimate,
    interquartile_mean,
    learning_curve,
    performance_profile,
    probability_of_improvement,
)

FloatArray = NDArray[np.float64]
# Lines of algorithms: at least 3:1 against both backgrounds, and told apart by their dashes, too.
_COLORS = ("#3f78d1", "#c2630f", "#1f8f6a", "#a85fb0", "#c24f5c", "#7a7f1e", "#2a8fa8", "#8c6d4f")
_DASHES: tuple[list[int], ...] = ([], [8, 4], [2, 4], [10, 4, 2, 4])
_BASELINE, _BASELINE_DASHES = "#7b8088", ([1, 3], [6, 6], [3, 3, 9, 3])
_CURVES = (SCORE, "coverage", "success", "captures", "collisions", "collision_free")
_SHARES = ("coverage", "success", "collision_free")
_TOOLS = "pan,box_zoom,wheel_zoom,reset,save"  # none is active from the start: fingers scroll the page
_MUCH = 5.0  # ratio from which on negative scores get a logarithmic axis
_ROWS = 8  # of a curve's table


def build_page(
    sections: Sequence[Section],
    notes: Sequence[str],
    episodes: Mapping[int, Mapping[str, Mapping[str, Any]]],
    made: str,
) -> str:
    """Return the page.

    Args:
        sections: From `read_results`, with baselines.
        notes: Sentences about what is not there.
        episodes: Of each section, by its number: from `record_episode`, by what they are called.
        made: With which machine and versions the page was made.

    Returns:
        HTML that needs nothing else.
    """
    charts: dict[str, Any] = {}
    shown = [_section(f"task-{number}", section, charts) for number, section in enumerate(sections)]
    for number, view in enumerate(shown):
        view["episodes"] = [*episodes.get(number, {})]
    folders = [trial.folder.parent.name for section in sections for trial in section.trials]
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    here = files("rllib_maobs.report")
    return environment.from_string(here.joinpath("page.html").read_text("utf-8")).render(
        title=f"Results: {', '.join(dict.fromkeys(folders))}",
        subtitle=f"{len(folders)} trained teams on {len(sections)} task{'s' if len(sections) > 1 else ''}.",
        css=Markup(here.joinpath("page.css").read_text("utf-8")),
        js=Markup(here.joinpath("page.js").read_text("utf-8")),
        bokeh=Markup("\n".join(Resources(mode="inline", components=["bokeh"], log_level="warn").js_raw)),
        sections=shown,
        overall=_overall(sections, charts),
        notes=notes,
        origin={**_origin(sections), "page": made},
        data={
            "charts": charts,
            "episodes": {f"task-{number}": [*named.values()] for number, named in episodes.items()},
        },
    )


def _section(name: str, section: Section, charts: dict[str, Any]) -> dict[str, Any]:
    """Return what the template shows of a task; its charts go into `charts`."""
    lines = _lines([*section.rows], [*section.baselines])
    seeds = {label: len(trials) for label, trials in section.rows.items()}
    few = min(seeds.values())
    bands = "95 % intervals of a bootstrap over the seeds" if few > 1 else "no interval where there is one seed"
    last = sorted({trial.last for trial in section.trials})
    scores = {label: [np.array([t.result[SCORE] for t in trials])] for label, trials in section.rows.items()}
    normal = _normalised(section)
    return {
        "id": name,
        "title": section.name,
        "lines": lines,
        "table": _results(section)
        | {
            "text": f"Interquartile means over the seeds, with {bands}. A seed's result is the mean of its last "
            f"{' or '.join(map(str, last))} evaluations, without exploration. Score: undiscounted return of the first "
            f"agent. Baselines: means over 100 episodes."
        },
        "curves": [
            _curves(f"{name}-curve-{measure}", section, measure, lines, charts)
            for measure in section.measures
            if measure in _CURVES
        ],
        "curves_text": f"Interquartile means over the seeds, with {bands}"
        f"{'; with so few seeds they say little' if 1 < few < 5 else ''}. Buttons above show and hide lines.",
        "charts": [
            _final(f"{name}-final", section, lines, charts),
            _profile(f"{name}-profile", normal or scores, lines, charts, normalised=bool(normal)),
            *_improvement(f"{name}-improvement", scores, charts),
        ],
        "charts_text": "Performance profile: which share of the runs scored more than this"
        + (", where 0 is random play and 1 the heuristic. " if normal else ". ")
        + "Probability of improvement: how probably a run of the first algorithm beats one of the second.",
        "speed": _speed(section),
        **_settings(section),
    }


def _overall(sections: Sequence[Section], charts: dict[str, Any]) -> dict[str, Any] | None:
    """Return what the template shows of all tasks together; None if no algorithms have been on several."""
    scores = [normal for section in sections if (normal := _normalised(section))]
    common = [label for label in scores[0] if all(label in score for score in scores)] if len(scores) > 1 else []
    if not common:
        return None
    strata = {label: [score[label][0] for score in scores] for label in common}
    lines = _lines(common, [])
    return {
        "id": "all-tasks",
        "title": "All tasks",
        "text": f"Scores on {len(scores)} tasks, where 0 is random play and 1 the heuristic; runs are drawn anew "
        f"within each task (stratified bootstrap). Only what was trained on all of them.",
        "lines": lines,
        "charts": [
            _dots(
                "all-tasks-final",
                "Normalised score",
                {n: interquartile_mean(s) for n, s in strata.items()},
                lines,
                charts,
                strata,
            ),
            _profile("all-tasks-profile", strata, lines, charts, normalised=True),
            *_improvement("all-tasks-improvement", strata, charts),
        ],
    }


def _lines(labels: Sequence[str], baselines: Sequence[str]) -> list[dict[str, Any]]:
    """Return name, colour and dashes of each line."""
    own = [
        {"name": name, "color": _COLORS[i % len(_COLORS)], "dash": _DASHES[i % len(_DASHES)]}
        for i, name in enumerate(labels)
    ]
    return own + [
        {"name": name, "color": _BASELINE, "dash": dash}
        for name, dash in zip(baselines, _BASELINE_DASHES, strict=False)
    ]


def _normalised(section: Section) -> dict[str, list[FloatArray]]:
    """Return every run's score between random play (0) and the heuristic (1); nothing if they are not known."""
    if not {"random", "heuristic"} <= {*section.baselines}:
        return {}
    zero, one = (section.baselines[policy][SCORE] for policy in ("random", "heuristic"))
    return {
        label: [(np.array([trial.result[SCORE] for trial in trials]) - zero) / (one - zero)]
        for label, trials in section.rows.items()
    }


# Tables.


def _results(section: Section) -> dict[str, Any]:
    measures = section.measures
    rows = []
    for label, trials in section.rows.items():
        cells = [label, str(len(trials)), f"{min(trial.env_steps for trial in trials):,}"]
        for measure in measures:
            runs = np.array([trial.result.get(measure, np.nan) for trial in trials])
            cells.append(_text(measure, interquartile_mean([runs])))
        rows.append(cells)
    for policy, means in section.baselines.items():
        values = [_number(measure, means[measure]) if measure in means else "-" for measure in measures]
        rows.append([policy, "-", "-", *values])
    return {"columns": ["", "seeds", "env steps", *measures.values()], "rows": rows}


def _speed(section: Section) -> dict[str, Any]:
    rows = []
    for label, trials in section.rows.items():
        seconds = np.array([trial.seconds for trial in trials])
        settings = trials[0].settings
        rows.append(
            [
                label,
                f"{np.mean([trial.env_steps / trial.seconds for trial in trials]):,.0f}",
                format_time(float(seconds.mean())),
                format_time(float(seconds.sum())),
                str(settings.get("num_envs_per_env_runner", "-")),
                str(settings.get("num_env_runners", "-")),
            ]
        )
    columns = ["", "env steps / s", "time per trial", "all trials", "environment copies", "remote EnvRunners"]
    return {"columns": columns, "rows": rows}


def _settings(section: Section) -> dict[str, Any]:
    """Return the settings that differ between algorithms, or between the trials of one, and those that do not."""
    flat = {label: [_flat(trial.settings) for trial in trials] for label, trials in section.rows.items()}
    names = dict.fromkeys(name for trials in flat.values() for trial in trials for name in trial)
    varied, same = [], []
    for name in names:
        cells = [" or ".join(dict.fromkeys(trial.get(name, "-") for trial in trials)) for trials in flat.values()]
        if len({*cells}) > 1 or " or " in cells[0]:
            varied.append([name, *cells])
        else:
            same.append([name, cells[0]])
    return {
        "varied": {"columns": ["", *flat], "rows": varied},
        "same": {"columns": ["", "value"], "rows": same},
    }


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return nested settings as text, by their dotted names, without the seed and without what is empty."""
    flat: dict[str, str] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        elif (prefix, name) != ("", "seed") and value not in ("", None):
            # A checkpoint to start from: its folder is nobody's business.
            text = "/".join(str(value).split("/")[-2:]) if name == "start_from" else json.dumps(value, default=str)
            flat[prefix + name] = text.strip('"')
    return flat


def _origin(sections: Sequence[Section]) -> dict[str, Any]:
    rows = [
        [trial.folder.parent.name, trial.folder.name, *(trial.origin.get(key, "-") for key in ("host", "dates", "ray"))]
        for section in sections
        for trial in section.trials
    ]
    return {"columns": ["results", "trial", "trained on host", "dates", "Ray"], "rows": rows}


def _number(measure: str, value: float) -> str:
    if not np.isfinite(value):
        return "-"
    return f"{value:.0%}" if measure in _SHARES else f"{value:,.1f}" if abs(value) >= 10 else f"{value:.2f}"


def _text(measure: str, estimate: Estimate) -> str:
    value, low, high = (_number(measure, float(number)) for number in estimate)
    return value if "-" in (low, high) or low == high else f"{value} ({low} to {high})"


# Charts. Renderers carry the name of their line, and as a tag the x-axis that they belong to: page.js shows them.


def _figure(title: str, **options: Any) -> Any:
    plot = figure(
        height=options.pop("height", 280),
        sizing_mode="stretch_width",
        tools=_TOOLS,
        active_drag=None,
        active_scroll=None,
        toolbar_location="above",
        background_fill_alpha=0,
        border_fill_alpha=0,
        **options,
    )
    plot.toolbar.logo, plot.toolbar.autohide = None, True
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.axis_label_text_font_size = plot.axis.major_label_text_font_size = "12px"
    plot.axis.axis_label_text_font = plot.axis.major_label_text_font = "system-ui, sans-serif"
    return plot


def _add(charts: dict[str, Any], name: str, title: str, plot: Any, columns: list[str], rows: list[list[str]]) -> Any:
    """Keep a chart for the page; return what the template shows of it."""
    charts[name] = json_item(plot)
    return {"id": name, "title": title, "columns": columns, "rows": rows}


def _curves(
    name: str, section: Section, measure: str, lines: Sequence[Mapping[str, Any]], charts: dict[str, Any]
) -> dict[str, Any]:
    """Draw a measure against env steps and against wall time, of which one is shown."""
    title = MEASURES[measure][0].upper() + MEASURES[measure][1:]
    plot = _figure(title)
    plot.x_range.only_visible = plot.y_range.only_visible = True
    levels = {policy: means[measure] for policy, means in section.baselines.items() if measure in means}
    everything = [trial.curve[measure].to_numpy(float) for trial in section.trials if measure in trial.curve]
    scaled = _scaling(plot, np.concatenate([*everything, [*levels.values()]]) if measure == SCORE else None)
    style = {line["name"]: line for line in lines}
    rows: list[list[str]] = []
    for tag, column, unit in (("steps", "env_steps", 1.0), ("time", "time_total_s", 3600.0)):
        end = 0.0
        for label, trials in section.rows.items():
            runs = [
                (trial.curve[column].to_numpy(float) / unit, trial.curve[measure].to_numpy(float))
                for trial in trials
                if measure in trial.curve
            ]
            if not runs:
                continue
            x, curve = learning_curve(runs)
            end = max(end, float(x[-1]))
            _draw_curve(plot, label, style[label], x, curve, measure, tag, scaled)
            if tag == "steps":
                some = np.unique(np.linspace(0, len(x) - 1, _ROWS).round().astype(int))
                rows += [[label, f"{x[i]:,.0f}", _text(measure, Estimate(*(part[i] for part in curve)))] for i in some]
        for policy, level in levels.items():
            plot.line(
                [0, end],
                scaled(np.array([level, level])),
                name=policy,
                tags=[tag],
                line_width=1.5,
                line_color=style[policy]["color"],
                line_dash=style[policy]["dash"] or "solid",
            )
            if tag == "steps":
                rows.append([policy, "-", _number(measure, level)])
    plot.xaxis.tags, plot.xaxis.axis_label = ["env steps", "hours"], "env steps"
    plot.xaxis.formatter = NumeralTickFormatter(format="0,0.[00]")
    if measure in _SHARES:
        plot.yaxis.formatter = NumeralTickFormatter(format="0%")
    return _add(charts, name, title, plot, ["", "env steps", title.lower()], rows)


def _draw_curve(
    plot: Any, label: str, style: Mapping[str, Any], x: FloatArray, curve: Estimate, measure: str, tag: str, scaled: Any
) -> None:
    source = {
        "x": x,
        "y": scaled(curve.value),
        "low": scaled(curve.low),
        "high": scaled(curve.high),
        "place": [f"{place:,.0f} env steps" if tag == "steps" else format_time(3600 * place) for place in x],
        "text": [_text(measure, Estimate(*(part[i] for part in curve))) for i in range(len(x))],
    }
    if np.isfinite(curve.low).any():
        plot.varea("x", "low", "high", source=source, name=label, tags=[tag], fill_color=style["color"], fill_alpha=0.2)
    line = plot.line(
        "x",
        "y",
        source=source,
        name=label,
        tags=[tag],
        line_width=2,
        line_color=style["color"],
        line_dash=style["dash"] or "solid",
    )
    dots = plot.scatter(
        "x", "y", source=source, name=label, tags=[tag], color=style["color"], size=5 if len(x) < 15 else 0.1
    )
    plot.add_tools(
        HoverTool(
            renderers=[line if len(x) > 1 else dots],
            mode="vline",
            visible=False,
            tooltips=[(label, "@text"), ("at", "@place")],
        )
    )


def _scaling(plot: Any, scores: FloatArray | None) -> Any:
    """Make the y-axis logarithmic if all scores are negative and differ much, as sums of distances do.

    Returns:
        A function from values to where they are drawn.
    """
    scores = None if scores is None else scores[np.isfinite(scores)]
    if scores is None or not len(scores) or scores.max() >= 0 or scores.min() > _MUCH * scores.max():
        return lambda values: values
    decades = range(int(np.floor(np.log10(-scores.max()))), int(np.ceil(np.log10(-scores.min()))) + 1)
    ticks = {-float(np.log10(digit * 10.0**decade)): -digit * 10.0**decade for decade in decades for digit in (1, 2, 5)}
    plot.yaxis.ticker = FixedTicker(ticks=[*ticks])
    plot.yaxis.major_label_overrides = {place: f"{score:,g}" for place, score in ticks.items()}
    return lambda values: -np.log10(-values)


def _final(name: str, section: Section, lines: Sequence[Mapping[str, Any]], charts: dict[str, Any]) -> dict[str, Any]:
    """Draw the final score of every algorithm, with its seeds, and of the baselines."""
    runs = {label: [np.array([trial.result[SCORE] for trial in t])] for label, t in section.rows.items()}
    runs |= {policy: [np.array([means[SCORE]])] for policy, means in section.baselines.items() if SCORE in means}
    estimates = {label: interquartile_mean(scores) for label, scores in runs.items()}
    return _dots(name, "Final score", estimates, lines, charts, runs)


def _dots(
    name: str,
    title: str,
    estimates: Mapping[str, Estimate],
    lines: Sequence[Mapping[str, Any]],
    charts: dict[str, Any],
    runs: Mapping[str, Sequence[FloatArray]],
) -> dict[str, Any]:
    plot = _figure(title, y_range=FactorRange(*reversed([*estimates])), height=60 + 36 * len(estimates))
    color = {line["name"]: line["color"] for line in lines}
    for label, estimate in estimates.items():
        every = np.concatenate([*runs.get(label, [])]) if runs.get(label) else np.array([])
        plot.scatter(every, [label] * len(every), name=label, size=6, color=color[label], alpha=0.45)
        if np.isfinite(estimate.low):
            plot.segment(
                [estimate.low], [label], [estimate.high], [label], name=label, line_width=3, line_color=color[label]
            )
        text = _text(SCORE, estimate)
        dot = plot.scatter(
            "x",
            "y",
            source={"x": [float(estimate.value)], "y": [label], "text": [text]},
            name=label,
            size=12,
            marker="diamond",
            color=color[label],
        )
        plot.add_tools(HoverTool(renderers=[dot], visible=False, tooltips=[(label, "@text")]))
    plot.xaxis.formatter = NumeralTickFormatter(format="0,0.[00]")
    rows = [[label, _text(SCORE, estimate)] for label, estimate in estimates.items()]
    return _add(charts, name, title, plot, ["", title.lower()], rows)


def _profile(
    name: str,
    scores: Mapping[str, Sequence[FloatArray]],
    lines: Sequence[Mapping[str, Any]],
    charts: dict[str, Any],
    *,
    normalised: bool,
) -> dict[str, Any]:
    """Draw which share of the runs scored more than a threshold."""
    title = "Performance profile"
    plot = _figure(title)
    every = np.concatenate([run for strata in scores.values() for run in strata])
    margin = 0.05 * max(float(np.ptp(every)), 1e-3)
    thresholds = np.linspace(every.min() - margin, every.max() + margin, 101)
    style = {line["name"]: line for line in lines}
    rows = []
    for label, strata in scores.items():
        share = performance_profile(strata, thresholds)
        if np.isfinite(share.low).all():
            plot.varea(thresholds, share.low, share.high, name=label, fill_color=style[label]["color"], fill_alpha=0.2)
        plot.step(
            thresholds,
            share.value,
            mode="after",
            name=label,
            line_width=2,
            line_color=style[label]["color"],
            line_dash=style[label]["dash"] or "solid",
        )
        rows += [[label, f"{thresholds[i]:,.2f}", f"{share.value[i]:.0%}"] for i in range(0, 101, 20)]
    what = "normalised score" if normalised else "score"
    plot.xaxis.axis_label, plot.yaxis.axis_label = what, "share of runs above"
    plot.yaxis.formatter = NumeralTickFormatter(format="0%")
    return _add(charts, name, title, plot, ["", f"{what} above", "share of runs"], rows)


def _improvement(name: str, scores: Mapping[str, Sequence[FloatArray]], charts: dict[str, Any]) -> list[dict[str, Any]]:
    """Draw how probably one algorithm beats another one, the better one first; nothing if there is only one."""
    labels = sorted(scores, key=lambda label: -float(interquartile_mean(scores[label]).value))
    pairs = {
        f"{a} > {b}": probability_of_improvement(scores[a], scores[b])
        for i, a in enumerate(labels)
        for b in labels[i + 1 :]
    }
    if not pairs:
        return []
    title = "Probability of improvement"
    plot = _figure(title, y_range=FactorRange(*reversed([*pairs])), x_range=(-0.02, 1.02), height=70 + 32 * len(pairs))
    plot.line(
        [0.5, 0.5], [(next(reversed(pairs)), -0.5), (next(iter(pairs)), 0.5)], line_color=_BASELINE, line_dash=[4, 4]
    )
    for pair, estimate in pairs.items():
        if np.isfinite(estimate.low):
            plot.segment([estimate.low], [pair], [estimate.high], [pair], line_width=3, line_color=_COLORS[0])
        plot.scatter([float(estimate.value)], [pair], size=12, marker="diamond", color=_COLORS[0])
    plot.xaxis.formatter = NumeralTickFormatter(format="0%")
    rows = [[pair, _text("success", estimate)] for pair, estimate in pairs.items()]
    return [_add(charts, name, title, plot, ["", "probability"], rows)]


def best_and_median(trials: Sequence[Trial]) -> dict[str, Trial]:
    """Return the teams of one algorithm that the player shows, by what they are called.

    Args:
        trials: Of the algorithm.

    Returns:
        The best one by its score, and the one in the middle (of an even number, the worse of the two there).
    """
    order = sorted(trials, key=lambda trial: trial.result[SCORE])
    best, median = order[-1], order[(len(order) - 1) // 2]
    if best is median:
        return {f"{best.label}, seed {best.settings['seed']}": best}
    return {
        f"{best.label}, best (seed {best.settings['seed']})": best,
        f"{median.label}, median (seed {median.settings['seed']})": median,
    }
