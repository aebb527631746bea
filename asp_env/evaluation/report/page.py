"""The report: one file of HTML that needs no network."""

import json
import os
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from asp_env.data.road_map import RoadMap
from asp_env.errors import DataError, MissingExtraError
from asp_env.evaluation.report.notes import note
from asp_env.evaluation.report.payload import (
    ForecastExamples,
    MapTable,
    drives_payload,
    pictures_payload,
)
from asp_env.evaluation.report.results import Results, distinct, read_results
from asp_env.evaluation.report.summary import cards, manifest
from asp_env.evaluation.report.tables import kinds, tables

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
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    aside.write_text(page, encoding="utf-8")
    aside.replace(path)
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
