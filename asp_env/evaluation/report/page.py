"""The first glance: a few figures that say what came out, and what was run.

MERGED: The report: one file of HTML that needs no network.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from asp_env.data.road_map import RoadMap
from asp_env.errors import DataError, MissingExtraError
from asp_env.evaluation.report.payload import (
    ForecastExamples,
    MapTable,
    drives_payload,
    pictures_payload,
)
from asp_env.evaluation.report.results import Result, Results, best, distinct, note, read_results
from asp_env.evaluation.report.tables import kinds, tables
from asp_env.files import atomic_file

BASELINE = "constant-velocity"
RATIO = "FDE / constant velocity"
DRIVING_METRICS = ("score", "no at-fault collision")
LONG_LIST = 12
"""Longer lists of the manifest are folded."""

SELECTIONS = ("most-probable", "best-of-3")


def cards(results: Results) -> str:
    """Cards: the best predictor beside constant velocity, the best driver beside the expert."""
    found = [*_forecast_cards(results.open_loop), *_driving_cards(results.driving)]
    return f"<div class='cards'>{''.join(found)}</div>" if found else ""


def _forecast_cards(results: Sequence[Result]) -> Iterator[str]:
    subset = _first_subset(results, "moving", "all")
    for selection in SELECTIONS:
        mine = [
            r for r in results if (r.subset, r.selection) == (subset, selection) and r.at_s is None
        ]
        winner = best([r for r in mine if r.metric == "FDE"], better="lower")
        if winner is None:
            continue
        horizon = f" at {winner.horizon_s} s" if winner.horizon_s else ""
        heading = f"FDE{horizon}, {selection.replace('-', ' ')}, {subset or 'all'} targets"
        yield _card(heading, winner, _beside_baseline(winner, mine))


def _beside_baseline(winner: Result, results: Sequence[Result]) -> str:
    """What constant velocity does there, and the paired ratio to it if it was computed."""
    where = (winner.data, winner.horizon_s)
    here = [r for r in results if (r.data, r.horizon_s) == where and r.value is not None]
    base = [r for r in here if r.metric == "FDE" and r.entrant.predictor == BASELINE]
    ratio = [r for r in here if r.metric == RATIO and r.entrant == winner.entrant]
    if not base or winner.entrant.predictor == BASELINE:
        return ""
    told = f"constant velocity: {base[0].value:.2f} m"
    if not ratio:
        return told
    between = (
        ""
        if ratio[0].low is None or ratio[0].high is None
        else f" ({ratio[0].low:.2f} to {ratio[0].high:.2f})"
    )
    return f"{told}; ratio {ratio[0].value:.2f}{between}"


def _driving_cards(results: Sequence[Result]) -> Iterator[str]:
    subset = _first_subset(results, "all")
    mine = [result for result in results if result.subset == subset]
    for metric in DRIVING_METRICS:
        column = [result for result in mine if result.metric == metric]
        winner = best(column, better=note(metric).better)
        if winner is None:
            continue
        expert = [
            f"{note(metric).format(r.value)} {note(metric).unit} for the logged expert"
            for r in column
            if r.entrant.planner == "expert" and r.value is not None and r.data == winner.data
        ]
        yield _card(note(metric).label, winner, "".join(expert[:1]))


def _first_subset(results: Sequence[Result], *first: str) -> str:
    return next(iter(distinct((result.subset for result in results), first=first)), "")


def _card(heading: str, winner: Result, beside: str) -> str:
    told = note(winner.metric)
    return (
        f"<div class='card'><h3>{escape(heading)}</h3>"
        f"<p class='figure'>{told.format(winner.value or 0.0)}<small> {told.unit}</small></p>"
        f"<p>{escape(winner.entrant.name)}</p><p class='beside'>{escape(beside)}</p></div>"
    )


def manifest(found: dict[str, Any]) -> str:
    """The manifest as a list of definitions, nested ones folded."""
    return f"<dl class='manifest'>{''.join(_entry(*item) for item in found.items())}</dl>"


def _entry(name: str, value: Any) -> str:
    return f"<dt>{escape(name.replace('_', ' '))}</dt><dd>{_value(value)}</dd>"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        inner = "".join(_entry(str(name), part) for name, part in value.items())
        many = "1 entry" if len(value) == 1 else f"{len(value)} entries"
        return f"<details><summary>{many}</summary><dl class='manifest'>{inner}</dl></details>"
    if isinstance(value, list) and len(value) > LONG_LIST:
        inner = ", ".join(_value(part) for part in value)
        return f"<details><summary>{len(value)} entries</summary>{inner}</details>"
    if isinstance(value, list):
        return ", ".join(_value(part) for part in value) or "&ndash;"
    return "&ndash;" if value is None or value == "" else escape(str(value))


ASSETS = files("asp_env.evaluation.report") / "assets"
SCRIPTS = ("draw.js", "pictures.js", "replay.js", "page.js")


def check_report_possible() -> None:
    """For commands that work for minutes before they write their report.

    Raises:
        MissingExtraError: plotly is not installed.
    """
    if find_spec("plotly") is None:
        raise MissingExtraError("plotly", "report", "a report")


def write_report(
    out: Path,
    *,
    title: str,
    lead: str = "",
    maps: Mapping[str, RoadMap] | None = None,
    examples: ForecastExamples | None = None,
) -> Path:
    """Writes `report.html` from a run folder and returns its path.

    Read are `metrics.csv` and `manifest.json`, and the drives in `rollouts/`, if any. Those in
    sub-folders, such as `rollouts/sampling + ffw-asp/00-12-300.npz`, are offered by driver, and
    drives of one file name can be compared between drivers.

    Args:
        out: the run folder.
        title: what was done, in a few words.
        lead: a sentence or two below it; plain text.
        maps: by the recording names of the rollouts.
        examples: forecasts to be drawn over the map.

    Raises:
        MissingExtraError: plotly is not installed.
        DataError: a file is missing or damaged, or a rollout's map was not given.
    """
    check_report_possible()
    from plotly.offline import get_plotlyjs

    from asp_env.evaluation.report import plots

    run = _read_manifest(out / "manifest.json")
    results = read_results(out / "metrics.csv", privileged=run.get("privileged", ()))
    colour = plots.colours(results.predictors)
    figures = {
        "final-errors": plots.final_errors(results.open_loop, colour),
        "errors-over-time": plots.errors_over_time(results.open_loop, colour),
        "driving-metrics": plots.driving_metrics(results.driving, colour),
    }
    map_table = MapTable()
    data = {
        "figures": {name: json.loads(text) for name, text in figures.items() if text},
        "colours": colour | {name.partition(":")[0]: value for name, value in colour.items()},
        "pictures": pictures_payload(examples, map_table) if examples else [],
        "drives": drives_payload(out / "rollouts", maps or {}, map_table),
    }
    data["maps"] = map_table.payloads
    sections = _sections(run, results, data)
    page = _fill(
        (ASSETS / "page.html").read_text(encoding="utf-8"),
        {
            "title": escape(title),
            "lead": f"<p class='lead'>{escape(lead)}</p>" if lead else "",
            "cards": cards(results),
            "style": (ASSETS / "style.css").read_text(encoding="utf-8"),
            "navigation": "".join(
                f"<a href='#{name}'>{heading}</a>" for name, (heading, _) in sections.items()
            ),
            "sections": "".join(
                f"<section id='{name}'><h2>{heading}</h2>{body}</section>"
                for name, (heading, body) in sections.items()
            ),
            "data": _script_safe(json.dumps(data, separators=(",", ":"))),
            "plotly": get_plotlyjs() if data["figures"] else "",
            "scripts": "\n".join((ASSETS / s).read_text(encoding="utf-8") for s in SCRIPTS),
        },
    )
    path = out / "report.html"
    with atomic_file(path) as partial:
        partial.write_text(page, encoding="utf-8")
    return path


def _sections(
    run: dict[str, Any], results: Results, data: dict[str, Any]
) -> dict[str, tuple[str, str]]:
    """(heading, body) of the sections that have something to show, by their anchors."""
    replay = (ASSETS / "replay.html").read_text(encoding="utf-8")
    figures = {name: f"<div class='plot' data-figure='{name}'></div>" for name in data["figures"]}
    parts = {
        "forecasts": (
            "How good are the forecasts?",
            tables(results.open_loop)
            + figures.get("final-errors", "")
            + figures.get("errors-over-time", ""),
        ),
        "kinds": ("Which targets are hard?", kinds(results.open_loop)),
        "pictures": ("What do they look like?", PICTURES if data["pictures"] else ""),
        "driving": (
            "How does the car drive with them?",
            tables(results.driving) + figures.get("driving-metrics", ""),
        ),
        "drives": ("Watch the drives", replay if data["drives"] else ""),
        "metrics": ("What the metrics say", _notes(results)),
        "run": ("What was run", manifest(run)),
    }
    return {name: part for name, part in parts.items() if part[1]}


PICTURES = """<p class='hint'>A row per situation, a column per predictor. Width and strength of a
line tell the mode's probability. Click a picture to enlarge it.</p>
<div class='legend' id='picture-legend'></div><div id='picture-grid'></div>
<dialog id='picture-dialog'><canvas></canvas><p></p></dialog>"""


def _notes(results: Results) -> str:
    told = [
        note(name) for name in distinct(r.metric for r in (*results.open_loop, *results.driving))
    ]
    lines = [f"<dt>{escape(one.label)}</dt><dd>{escape(one.text)}</dd>" for one in told if one.text]
    return f"<dl class='notes'>{''.join(lines)}</dl>{INTERVALS}" if lines else ""


INTERVALS = """<p class='hint'>Small figures and whiskers are intervals; how they were
computed stands in what was run. Bold is the best of those who do not
know the recorded future.</p>"""


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not a manifest that can be read ({error})") from error
    if not isinstance(found, dict):
        raise DataError(f"{path}: expected a JSON object, found {type(found).__name__}")
    return found


def _script_safe(text: str) -> str:
    """JSON that no closing tag inside a string can end."""
    return text.replace("<", "\\u003c")


def _fill(template: str, values: Mapping[str, str]) -> str:
    """The template with `{{name}}` replaced, each piece once, nothing inside of pieces."""
    parts = []
    for part in template.split("{{"):
        name, closed, rest = part.partition("}}")
        parts.append(values[name] + rest if closed else part)
    return "".join(parts)
