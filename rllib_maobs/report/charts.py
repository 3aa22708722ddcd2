"""The page's charts, and their numbers as tables for those who cannot see them.

A renderer is called as its line is. Where a chart has two x-axes, glyphs are tagged with theirs. The page's buttons
show and hide by these two.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from bokeh.models import FactorRange, FixedTicker, HoverTool, NumeralTickFormatter
from bokeh.plotting import figure
from numpy.typing import NDArray

from rllib_maobs.experiment.report import SCORE
from rllib_maobs.experiment.tables import format_time
from rllib_maobs.report.results import MEASURES, Section
from rllib_maobs.report.statistics import (
    Estimate,
    interquartile_mean,
    learning_curve,
    performance_profile,
    probability_of_improvement,
)

FloatArray = NDArray[np.float64]
# Lines of algorithms, by measure of contrast at least 3:1 against both backgrounds; dashes tell them apart, too.
_COLORS = ("#3f78d1", "#c2630f", "#1f8f6a", "#a85fb0", "#c24f5c", "#7a7f1e", "#2a8fa8", "#8c6d4f")
_DASHES: tuple[list[int], ...] = ([], [8, 4], [2, 4], [10, 4, 2, 4])
_BASELINE, _BASELINE_DASHES = "#7b8088", ([1, 3], [6, 6], [3, 3, 9, 3])
_SHARES = ("coverage", "success", "collision_free")
_MUCH = 5.0  # ratio from which on negative scores get a logarithmic axis
_ROWS = 8  # of a curve's table


class Line(NamedTuple):
    """How an algorithm, or a baseline, is drawn everywhere."""

    name: str
    color: str
    dash: list[int]


class Chart(NamedTuple):
    """A figure of Bokeh, and what it shows as a table."""

    title: str
    figure: Any
    columns: list[str]
    rows: list[list[str]]


def make_lines(labels: Sequence[str], baselines: Sequence[str]) -> dict[str, Line]:
    """Return a line for each algorithm and each baseline, by name."""
    trained = [Line(name, _COLORS[i % len(_COLORS)], _DASHES[i % len(_DASHES)]) for i, name in enumerate(labels)]
    levels = [Line(name, _BASELINE, dash) for name, dash in zip(baselines, _BASELINE_DASHES, strict=False)]
    return {line.name: line for line in (*trained, *levels)}


def curve_chart(section: Section, measure: str, lines: Mapping[str, Line]) -> Chart:
    """Draw a measure against env steps and against hours, of which the page shows one."""
    title = MEASURES[measure][0].upper() + MEASURES[measure][1:]
    plot = _figure()
    plot.x_range.only_visible = plot.y_range.only_visible = True
    levels = {policy: means[measure] for policy, means in section.baselines.items() if measure in means}
    everything = [trial.curve[measure].to_numpy(float) for trial in section.trials if measure in trial.curve]
    everything.append(np.array([*levels.values()]))
    scaled = _scaling(plot.yaxis, np.concatenate(everything)) if measure == SCORE else np.asarray
    rows: list[list[str]] = []
    for tag, column, unit in (("steps", "env_steps", 1.0), ("time", "time_total_s", 3600.0)):
        end = 0.0
        for label, trials in section.rows.items():
            measured = [trial.curve for trial in trials if measure in trial.curve]
            if not measured:
                continue
            x, curve = learning_curve(
                [(c[column].to_numpy(float) / unit, c[measure].to_numpy(float)) for c in measured]
            )
            end = max(end, float(x[-1]))
            text = [estimate_text(measure, Estimate(*(part[i] for part in curve))) for i in range(len(x))]
            place = [f"{at:,.0f} env steps" if tag == "steps" else format_time(3600 * at) for at in x]
            source = {"x": x, "y": scaled(curve.value), "text": text, "place": place}
            if np.isfinite(curve.low).any():
                _band(plot, lines[label], x, scaled(curve.low), scaled(curve.high), tag)
            drawn = _line(plot, lines[label], tag, x="x", y="y", source=source)
            if len(x) < 15:
                plot.scatter("x", "y", source=source, name=label, tags=[tag], color=lines[label].color, size=6)
            tips = [(label, "@text"), ("at", "@place")]
            plot.add_tools(HoverTool(renderers=[drawn], mode="vline", visible=False, tooltips=tips))
            if tag == "steps":
                some = np.unique(np.linspace(0, len(x) - 1, _ROWS).round().astype(int))
                rows += [[label, f"{x[i]:,.0f}", text[i]] for i in some]
        for policy, level in levels.items():
            _line(plot, lines[policy], tag, x=[0.0, end], y=scaled(np.array([level, level])))
    rows += [[policy, "-", number_text(measure, level)] for policy, level in levels.items()]
    plot.xaxis.axis_label, plot.xaxis.tags = "env steps", ["env steps", "hours"]  # page.js puts the other one there
    plot.xaxis.formatter = NumeralTickFormatter(format="0,0.[0000]")
    if measure in _SHARES:
        plot.yaxis.formatter = NumeralTickFormatter(format="0%")
    return Chart(title, plot, ["team", "env steps", title.lower()], rows)


def score_chart(title: str, runs: Mapping[str, Sequence[FloatArray]], lines: Mapping[str, Line]) -> Chart:
    """Draw interquartile means, their intervals, and every run.

    Args:
        title: Of the chart.
        runs: Scores by name; a (runs,) array for each task.
        lines: How to draw them.
    """
    estimates = {label: interquartile_mean(scores) for label, scores in runs.items()}
    plot = _figure(y_range=FactorRange(*reversed([*runs])), height=80 + 36 * len(runs))
    plot.xaxis.formatter = NumeralTickFormatter(format="0,0.[0000]")
    scaled = _scaling(plot.xaxis, np.concatenate([scores for strata in runs.values() for scores in strata]))
    rows = []
    for label, (value, low, high) in estimates.items():
        line, every = lines[label], np.concatenate(runs[label])
        rows.append([label, estimate_text(SCORE, estimates[label])])
        plot.scatter(scaled(every), [label] * len(every), name=label, size=7, color=line.color, alpha=0.45)
        if np.isfinite(low):
            ends = {"x0": [scaled(low)], "x1": [scaled(high)], "y0": [label], "y1": [label]}
            plot.segment(**ends, name=label, line_width=3, line_color=line.color)
        source = {"x": [scaled(value)], "y": [label], "text": [rows[-1][1]]}
        dot = plot.scatter("x", "y", source=source, name=label, size=12, marker="diamond", color=line.color)
        plot.add_tools(HoverTool(renderers=[dot], visible=False, tooltips=[(label, "@text")]))
    return Chart(title, plot, ["team", title.lower()], rows)


def profile_chart(what: str, runs: Mapping[str, Sequence[FloatArray]], lines: Mapping[str, Line]) -> Chart:
    """Draw which share of the runs scored more than a threshold; see `score_chart`."""
    plot = _figure()
    every = np.concatenate([scores for strata in runs.values() for scores in strata])
    margin = 0.05 * max(float(np.ptp(every)), 1e-3)
    thresholds = np.linspace(every.min() - margin, every.max() + margin, 101)
    rows = []
    for label, strata in runs.items():
        share = performance_profile(strata, thresholds)
        if np.isfinite(share.low).all():
            _band(plot, lines[label], thresholds, share.low, share.high)
        _line(plot, lines[label], x=thresholds, y=share.value)
        rows += [[label, f"{thresholds[i]:,.2f}", f"{share.value[i]:.0%}"] for i in range(0, 101, 20)]
    plot.xaxis.axis_label, plot.yaxis.axis_label = what, "share of runs above"
    plot.yaxis.formatter = NumeralTickFormatter(format="0%")
    return Chart("Performance profile", plot, ["team", f"{what} above", "share of runs"], rows)


def improvement_chart(runs: Mapping[str, Sequence[FloatArray]]) -> Chart | None:
    """Draw how probably a run of one algorithm beats one of another, the better one first; None for a single one."""
    order = sorted(runs, key=lambda label: -float(interquartile_mean(runs[label]).value))
    pairs = {
        f"{a} > {b}": probability_of_improvement(runs[a], runs[b]) for i, a in enumerate(order) for b in order[i + 1 :]
    }
    if not pairs:
        return None
    plot = _figure(y_range=FactorRange(*reversed([*pairs])), x_range=(-0.02, 1.02), height=90 + 32 * len(pairs))
    for pair, (value, low, high) in pairs.items():
        if np.isfinite(low):
            plot.segment([low], [pair], [high], [pair], line_width=3, line_color=_COLORS[0])
        plot.scatter([value], [pair], size=12, marker="diamond", color=_COLORS[0])
    plot.xaxis.formatter = NumeralTickFormatter(format="0%")
    rows = [[pair, estimate_text("success", estimate)] for pair, estimate in pairs.items()]
    return Chart("Probability of improvement", plot, ["pair", "probability"], rows)


def number_text(measure: str, value: float) -> str:
    """Write a measure with as many digits as say something."""
    if not np.isfinite(value):
        return "-"
    return f"{value:.0%}" if measure in _SHARES else f"{value:,.1f}" if abs(value) >= 10 else f"{value:.2f}"


def estimate_text(measure: str, estimate: Estimate) -> str:
    """Write a measure and its interval, if it has one."""
    value, low, high = (number_text(measure, float(number)) for number in estimate)
    return value if "-" in (low, high) or low == high else f"{value} ({low} to {high})"


def _figure(**options: Any) -> Any:
    plot = figure(
        height=options.pop("height", 280),
        sizing_mode="stretch_width",
        tools="pan,box_zoom,wheel_zoom,reset,save",
        active_drag=None,  # fingers scroll the page until a tool is chosen
        active_scroll=None,
        toolbar_location="above",
        background_fill_alpha=0,
        border_fill_alpha=0,
        **options,
    )
    plot.toolbar.logo, plot.toolbar.autohide = None, True
    for axis in plot.axis:
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = axis.major_label_text_font_size = "12px"
        axis.axis_label_text_font = axis.major_label_text_font = "system-ui, sans-serif"
    return plot


def _line(plot: Any, line: Line, *tags: str, **data: Any) -> Any:
    dash = line.dash or "solid"
    return plot.line(**data, name=line.name, tags=[*tags], line_width=2, line_color=line.color, line_dash=dash)


def _band(plot: Any, line: Line, x: FloatArray, low: FloatArray, high: FloatArray, *tags: str) -> None:
    plot.varea(x, low, high, name=line.name, tags=[*tags], fill_color=line.color, fill_alpha=0.2)


def _scaling(axis: Any, scores: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Make an axis logarithmic if all scores are negative and differ much, as sums of distances do.

    Returns:
        A function from scores to where they are drawn.
    """
    scores = scores[np.isfinite(scores)]
    if not len(scores) or scores.max() >= 0 or scores.min() > _MUCH * scores.max():
        return np.asarray
    decades = range(int(np.floor(np.log10(-scores.max()))), int(np.ceil(np.log10(-scores.min()))) + 1)
    ticks = {-float(np.log10(digit * 10.0**decade)): -digit * 10.0**decade for decade in decades for digit in (1, 2, 5)}
    axis.ticker = FixedTicker(ticks=[*ticks])
    axis.major_label_overrides = {place: f"{score:,g}" for place, score in ticks.items()}
    return lambda values: -np.log10(-values)
