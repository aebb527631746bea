"""The report: one file of HTML that shows the results of a run and needs no network."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from asp_env.data.road_map import RoadMap
from asp_env.errors import DataError, MissingExtraError
from asp_env.evaluation.report.payload import (
    ForecastExamples,
    MapTable,
    examples_payload,
    rollouts_payload,
)
from asp_env.evaluation.report.results import (
    MetricNote,
    Result,
    Results,
    best_result,
    distinct,
    metric_note,
    read_results,
)
from asp_env.evaluation.report.tables import (
    breakdown_figures,
    comparison_figures,
    result_figures,
)
from asp_env.evaluation.results import SCORE, difference_of
from asp_env.evaluation.selection import split_name
from asp_env.files import atomic_file
from asp_env.stored import brief, parse_json

BASELINE = "constant-velocity"
RATIO = "FDE / constant velocity"
CARD_METRICS = ("score", "no at-fault collision")
CARD_SELECTIONS = ("most-probable", "best-of-3")
ASSETS = files("asp_env.evaluation.report") / "assets"
SCRIPTS = ("draw.js", "pictures.js", "replay.js", "page.js")


@dataclass(frozen=True, slots=True, kw_only=True)
class Card:
    """The best value of a metric, shown at the top of the page."""

    heading: str
    value: str
    unit: str
    method: str
    comparison: str
    """The value of a reference method; may be empty."""


def check_report_possible() -> None:
    """Checks that the packages of the extra `report` are installed, before a long run begins.

    Raises:
        MissingExtraError: plotly or jinja2 is not installed.
    """
    for package in ("plotly", "jinja2"):
        if find_spec(package) is None:
            raise MissingExtraError(package, "report", "a report")


def write_report(
    out: Path,
    *,
    title: str,
    lead: str = "",
    maps: Mapping[str, RoadMap] | None = None,
    examples: ForecastExamples | None = None,
) -> Path:
    """Writes `report.html` into a run folder.

    The function reads `metrics.csv`, `manifest.json` and the rollouts below `rollouts/`. Rollouts
    in sub-folders, such as `rollouts/sampling + ffw-asp/00-12-300.npz`, are grouped by method;
    those of one file name can be compared between methods.

    Args:
        out: The run folder.
        title: Title of the page, plain text.
        lead: A sentence or two below the title, plain text.
        maps: Road maps by the names of the rollouts' recordings.
        examples: Forecasts to draw over the map.

    Returns:
        The path of the page.

    Raises:
        MissingExtraError: plotly or jinja2 is not installed.
        DataError: A file is missing or damaged, or the map of a rollout is missing.
    """
    check_report_possible()
    from plotly.offline import get_plotlyjs

    run = _read_manifest(out / "manifest.json")
    results = read_results(out / "metrics.csv", privileged=run.get("privileged", ()))
    map_table = MapTable()
    data = {
        **_plots(results),
        "pictures": examples_payload(examples, map_table) if examples else [],
        "drives": rollouts_payload(out / "rollouts", maps or {}, map_table),
    }
    data["maps"] = map_table.payloads
    context = {
        "cards": [*_forecast_cards(results.open_loop), *_driving_cards(results.driving)],
        "forecast_figures": result_figures(results.open_loop),
        "breakdown_figures": breakdown_figures(results.open_loop),
        "comparison_figures": comparison_figures(results.driving),
        "driving_figures": result_figures(results.driving),
        "notes": _notes(results),
        "run": run,
        "data": data,
    }
    page = _page_template().render(
        context,
        title=title,
        lead=lead,
        sections=_sections(context),
        plotly=_markup(get_plotlyjs() if data["figures"] else ""),
    )
    path = out / "report.html"
    with atomic_file(path) as partial:
        partial.write_text(page, encoding="utf-8")
    return path


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not a manifest that can be read ({error})") from error
    if not isinstance(manifest, dict):
        raise DataError(f"{path}: expected a JSON object, found {type(manifest).__name__}")
    privileged = manifest.get("privileged", [])
    if not (isinstance(privileged, list) and all(isinstance(name, str) for name in privileged)):
        raise DataError(
            f"{path}: privileged is {brief(repr(privileged))}, expected a list of names; make the "
            "results again"
        )
    return manifest


def _plots(results: Results) -> dict[str, Any]:
    """The plotly figures that have data, and the colour of each predictor."""
    from asp_env.evaluation.report import plots

    colours = plots.colours(results.predictors)
    figures = {
        "final-errors": plots.final_errors(results.open_loop, colours),
        "errors-over-time": plots.errors_over_time(results.open_loop, colours),
        "driving-metrics": plots.driving_metrics(results.driving, colours),
    }
    return {
        "figures": {name: json.loads(text) for name, text in figures.items() if text},
        "colours": colours | {split_name(name)[0]: value for name, value in colours.items()},
    }


def _sections(context: Mapping[str, Any]) -> dict[str, str]:
    """Headings of the sections that have something to show, by their anchors."""
    data = context["data"]
    sections = {
        "forecasts": ("Forecast errors", context["forecast_figures"]),
        "breakdown": ("Forecast errors by kind of target", context["breakdown_figures"]),
        "examples": ("Example forecasts", data["pictures"]),
        "driving": (
            "Closed-loop driving",
            [*context["comparison_figures"], *context["driving_figures"]],
        ),
        "rollouts": ("Rollouts", data["drives"]),
        "metrics": ("Metrics", context["notes"]),
        "manifest": ("Manifest", True),
    }
    return {anchor: heading for anchor, (heading, shown) in sections.items() if shown}


@cache
def _page_template() -> Any:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("asp_env.evaluation.report", "assets"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    environment.globals["style"] = _markup((ASSETS / "style.css").read_text(encoding="utf-8"))
    environment.globals["scripts"] = _markup(
        "\n".join((ASSETS / name).read_text(encoding="utf-8") for name in SCRIPTS)
    )
    return environment.get_template("page.html.j2")


def _markup(text: str) -> Any:
    """Trusted text, which the template does not escape."""
    from markupsafe import Markup

    return Markup(text)


def _forecast_cards(results: Sequence[Result]) -> Iterator[Card]:
    """FDE of the best predictor beside constant velocity, for each selection of modes."""
    subset = _first_subset(results, "moving", "all")
    for selection in CARD_SELECTIONS:
        comparable = [
            r for r in results if (r.subset, r.selection) == (subset, selection) and r.at_s is None
        ]
        winner = best_result([r for r in comparable if r.metric == "FDE"], better="lower")
        if winner is not None:
            horizon = f" at {winner.horizon_s} s" if winner.horizon_s else ""
            heading = f"FDE{horizon}, {selection.replace('-', ' ')}, {subset or 'all'} targets"
            yield _card(heading, winner, _beside_baseline(winner, comparable))


def _beside_baseline(winner: Result, results: Sequence[Result]) -> str:
    """FDE of constant velocity on the same data, and the paired ratio to it where there is one."""
    same_data = [
        r
        for r in results
        if (r.data, r.horizon_s) == (winner.data, winner.horizon_s) and r.value is not None
    ]
    base = [r for r in same_data if r.metric == "FDE" and r.method.predictor == BASELINE]
    ratio = [r for r in same_data if r.metric == RATIO and r.method == winner.method]
    if not base or winner.method.predictor == BASELINE:
        return ""
    text = f"constant velocity: {base[0].value:.2f} m"
    if ratio:
        text += f"; ratio {ratio[0].value:.2f}"
        if ratio[0].low is not None and ratio[0].high is not None:
            text += f" ({ratio[0].low:.2f} to {ratio[0].high:.2f})"
    return text


def _driving_cards(results: Sequence[Result]) -> Iterator[Card]:
    """The best method beside the expert, for each of the main metrics."""
    subset = _first_subset(results, "all")
    for metric in CARD_METRICS:
        note = metric_note(metric)
        column = [r for r in results if (r.subset, r.metric) == (subset, metric)]
        winner = best_result(column, better=note.better)
        if winner is not None:
            expert = [
                f"expert: {note.format(r.value)} {note.unit}"
                for r in column
                if r.method.planner == "expert" and r.value is not None and r.data == winner.data
            ]
            yield _card(metric.capitalize(), winner, "".join(expert[:1]))


def _first_subset(results: Sequence[Result], *preferred: str) -> str:
    return next(iter(distinct((result.subset for result in results), first=preferred)), "")


def _card(heading: str, winner: Result, comparison: str) -> Card:
    note = metric_note(winner.metric)
    return Card(
        heading=heading,
        value=note.format(winner.value or 0.0),
        unit=note.unit,
        method=winner.method.name,
        comparison=comparison,
    )


def _notes(results: Results) -> list[MetricNote]:
    """Notes of all metrics; of the differences, only those of the score are explained."""
    names = distinct(result.metric for result in (*results.open_loop, *results.driving))
    differences = {name: difference_of(name) for name in names}
    return [
        metric_note(name)
        for name, pair in differences.items()
        if metric_note(name).text and (pair is None or pair[0] == SCORE)
    ]
