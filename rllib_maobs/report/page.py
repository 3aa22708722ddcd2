"""The page itself: what was read and computed, as tables, charts and text in one HTML file."""

import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np
from bokeh.embed import json_item
from bokeh.resources import Resources
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray

from rllib_maobs.experiment.report import SCORE
from rllib_maobs.experiment.tables import format_time
from rllib_maobs.report.charts import (
    Chart,
    curve_chart,
    estimate_text,
    improvement_chart,
    make_lines,
    number_text,
    profile_chart,
    score_chart,
)
from rllib_maobs.report.results import Section
from rllib_maobs.report.statistics import interquartile_mean

_CURVES = (SCORE, "coverage", "success", "captures", "collisions", "collision_free")
Scores = dict[str, list[NDArray[np.float64]]]


def build_page(
    sections: Sequence[Section], notes: Sequence[str], episodes: Sequence[Mapping[str, Mapping[str, Any]]], made: str
) -> str:
    """Return the page.

    Args:
        sections: From `read_results`, with baselines.
        notes: Sentences about what is not there.
        episodes: Of each section: from `record_episode`, by what they are called.
        made: With which machine and versions the page was made.

    Returns:
        HTML that needs nothing else.
    """
    shown = [
        _section(f"task-{number}", section, [*named])
        for number, (section, named) in enumerate(zip(sections, episodes, strict=True))
    ]
    overall = _overall(sections)
    drawn = [chart for view in (*shown, overall or {}) for part in ("curves", "charts") for chart in view.get(part, [])]
    folders = [trial.folder.parent.name for section in sections for trial in section.trials]
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    # As it is: Bokeh's objects come before what refers to them.
    environment.policies["json.dumps_kwargs"] = {"sort_keys": False, "allow_nan": False, "separators": (",", ":")}
    here = files("rllib_maobs.report")
    return environment.from_string(here.joinpath("page.html").read_text("utf-8")).render(
        title=f"Results: {', '.join(dict.fromkeys(folders))}",
        subtitle=f"{_counted(len(folders), 'trained team')} on {_counted(len(sections), 'task')}.",
        css=Markup(here.joinpath("page.css").read_text("utf-8")),
        js=Markup(here.joinpath("page.js").read_text("utf-8")),
        bokeh=Markup("\n".join(Resources(mode="inline", components=["bokeh"], log_level="warn").js_raw)),
        sections=shown,
        overall=overall,
        notes=notes,
        origin={**_origin(sections), "page": made},
        data={
            "charts": {chart["id"]: json_item(chart.pop("figure")) for chart in drawn},
            "episodes": {view["id"]: [*named.values()] for view, named in zip(shown, episodes, strict=True)},
        },
    )


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _section(name: str, section: Section, episodes: list[str]) -> dict[str, Any]:
    """Return what the template shows of a task."""
    lines = make_lines([*section.rows], [*section.baselines])
    few = min(len(trials) for trials in section.rows.values())
    bands = "95 % intervals of a bootstrap over the seeds" if few > 1 else "no interval where there is one seed"
    last = sorted({trial.last for trial in section.trials})
    runs: Scores = {label: [np.array([t.result[SCORE] for t in trials])] for label, trials in section.rows.items()}
    levels: Scores = {name: [np.array([means[SCORE]])] for name, means in section.baselines.items()}
    normal = _normalised(section)
    charts = [
        score_chart("Final score", runs | levels, lines),
        profile_chart("normalised score", normal, lines) if normal else profile_chart("score", runs, lines),
        improvement_chart(runs),
    ]
    return {
        "id": name,
        "title": section.name,
        "lines": [line._asdict() for line in lines.values()],
        "episodes": episodes,
        "table": _results(section),
        "table_text": f"Interquartile means over the seeds, with {bands}. A seed's result is the mean of its last "
        f"{' or '.join(map(str, last))} evaluations, without exploration. Score: undiscounted return of the first "
        f"agent. Baselines, which are not trained: means over 100 episodes, with the task's own action_mode.",
        "curves": _placed(f"{name}-curve", [curve_chart(section, m, lines) for m in section.measures if m in _CURVES]),
        "curves_text": f"Interquartile means over the seeds, with {bands}"
        f"{'; with so few seeds they say little' if 1 < few < 5 else ''}.",
        "charts": _placed(f"{name}-chart", charts),
        "charts_text": "Dots are seeds, diamonds interquartile means. Performance profile: which share of the runs "
        f"scored more than this{', where 0 is random play and 1 the heuristic' if normal else ''}. Probability of "
        f"improvement: how probably a run of the first algorithm beats one of the second.",
        "speed": _speed(section),
        **_settings(section),
    }


def _overall(sections: Sequence[Section]) -> dict[str, Any] | None:
    """Return what the template shows of all tasks together; None if no algorithms have been on several."""
    scores = [normal for section in sections if (normal := _normalised(section))]
    common = [label for label in scores[0] if all(label in score for score in scores)] if len(scores) > 1 else []
    if not common:
        return None
    runs: Scores = {label: [score[label][0] for score in scores] for label in common}
    lines = make_lines(common, [])
    charts = [
        score_chart("Normalised score", runs, lines),
        profile_chart("normalised score", runs, lines),
        improvement_chart(runs),
    ]
    return {
        "id": "all-tasks",
        "title": "All tasks",
        "text": f"Scores on {len(scores)} tasks, where 0 is random play and 1 the heuristic, of what was trained on "
        f"all of them. The bootstrap draws the runs anew within each task; where one has a single run there is none.",
        "lines": [line._asdict() for line in lines.values()],
        "charts": _placed("all-tasks-chart", charts),
    }


def _placed(name: str, charts: Sequence[Chart | None]) -> list[dict[str, Any]]:
    """Return charts as the template takes them, with ids."""
    there = [chart for chart in charts if chart is not None]
    return [
        {**chart._asdict(), "id": f"{name}-{number}", "height": chart.figure.height}
        for number, chart in enumerate(there)
    ]


def _normalised(section: Section) -> Scores:
    """Return every run's score between random play (0) and the heuristic (1); nothing if they are not known."""
    if not {"random", "heuristic"} <= {*section.baselines}:
        return {}
    zero, one = (section.baselines[policy][SCORE] for policy in ("random", "heuristic"))
    return {
        label: [(np.array([trial.result[SCORE] for trial in trials]) - zero) / (one - zero)]
        for label, trials in section.rows.items()
    }


def _results(section: Section) -> dict[str, Any]:
    measures = section.measures
    rows = []
    for label, trials in section.rows.items():
        cells = [label, str(len(trials)), f"{min(trial.env_steps for trial in trials):,}"]
        for measure in measures:
            runs = np.array([trial.result.get(measure, np.nan) for trial in trials])
            cells.append(estimate_text(measure, interquartile_mean([runs])).replace(" (", "\n("))
        rows.append(cells)
    for policy, means in section.baselines.items():
        rows.append([policy, "-", "-", *(number_text(measure, means.get(measure, np.nan)) for measure in measures)])
    return {"columns": ["team", "seeds", "env steps", *measures.values()], "rows": rows}


def _speed(section: Section) -> dict[str, Any]:
    rows = []
    for label, trials in section.rows.items():
        seconds, settings = [trial.seconds for trial in trials], trials[0].settings
        rows.append(
            [
                label,
                f"{np.mean([trial.env_steps / trial.seconds for trial in trials]):,.0f}",
                format_time(sum(seconds) / len(seconds)),
                format_time(sum(seconds)),
                str(settings.get("num_envs_per_env_runner", "-")),
                str(settings.get("num_env_runners", "-")),
            ]
        )
    columns = ["team", "env steps / s", "time per trial", "all trials", "environment copies", "remote EnvRunners"]
    return {"columns": columns, "rows": rows}


def _settings(section: Section) -> dict[str, Any]:
    """Return the settings that differ between algorithms, or between the trials of one, and those that do not."""
    flat = {label: [_flat(trial.settings) for trial in trials] for label, trials in section.rows.items()}
    names = dict.fromkeys(name for trials in flat.values() for trial in trials for name in trial)
    varied, same = [], []
    for name in names:
        values = [dict.fromkeys(trial.get(name, "-") for trial in trials) for trials in flat.values()]
        cells = [" or ".join(each) for each in values]
        if len({*cells}) > 1 or len(values[0]) > 1:
            varied.append([name, *cells])
        else:
            same.append([name, cells[0]])
    return {
        "varied": {"columns": ["setting", *flat], "rows": varied},
        "same": {"columns": ["setting", "value"], "rows": same},
    }


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return nested settings as text, by their dotted names, without the seed and without what is empty."""
    flat: dict[str, str] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        elif (prefix, name) != ("", "seed") and value not in ("", None):
            # Of a checkpoint to start from the last two folders: the page is to be sent to others.
            value = "/".join(str(value).split("/")[-2:]) if name == "start_from" else value
            flat[prefix + name] = (
                f"{value:g}" if isinstance(value, float) else json.dumps(value, default=str).strip('"')
            )
    return flat


def _origin(sections: Sequence[Section]) -> dict[str, Any]:
    rows = [
        [trial.folder.parent.name, trial.folder.name, *(trial.origin.get(key, "-") for key in ("host", "dates", "ray"))]
        for section in sections
        for trial in section.trials
    ]
    return {"columns": ["results", "trial", "trained on host", "dates", "Ray"], "rows": rows}
