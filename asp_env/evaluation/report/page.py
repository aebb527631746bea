"""The report: one file of HTML that shows the results of a run and needs no network.

For every condition, that is data, traffic and latency, the page answers first: one sentence, then
the ranking of the methods, the forecasts, what decides, and drives to look at.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from itertools import groupby
from pathlib import Path
from typing import Any

from asp_env.data.road_map import RoadMap
from asp_env.errors import DataError, MissingExtraError
from asp_env.evaluation.report import figures
from asp_env.evaluation.report.answer import (
    Answer,
    driving_answer,
    forecast_answer,
    gain,
    outcome,
    score_differences,
)
from asp_env.evaluation.report.episodes import Episode, find_episodes
from asp_env.evaluation.report.partings import PARTED_M, parting_figures
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
    condition_labels,
    condition_parts,
    distinct,
    methods_of,
    metric_note,
    read_results,
    short_labels,
)
from asp_env.evaluation.report.scenario_values import (
    EXPERT,
    ListedDrive,
    ScenarioValues,
    read_scenario_values,
    telling_drives,
    values_in,
    worst_drives,
)
from asp_env.evaluation.report.tables import (
    breakdown_figures,
    comparison_figures,
    difference_figures,
    result_figures,
)
from asp_env.evaluation.results import SCORE, Condition, difference_of
from asp_env.evaluation.selection import split_name
from asp_env.files import atomic_file
from asp_env.stored import brief, parse_json

ASSETS = files("asp_env.evaluation.report") / "assets"
SCRIPTS = ("draw.js", "charts.js", "pictures.js", "stage.js", "player.js", "page.js")
PICTURED = 2
"""Number of the largest gains, and of the largest losses, that are drawn. Chosen by hand: they fit
one screen."""
MOST_WITH_SUBSETS = 4
"""Largest number of conditions with tables of all metrics in every subset of the scenarios. With
more of them the tables show all scenarios alone, as a table of 15 methods takes 50 kB."""
COLOURS = 8
"""Number of colours of predictors in the style sheet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveList:
    """Scenarios under a heading, each with the two methods to be shown side by side."""

    heading: str
    drives: tuple[ListedDrive, ...]
    is_telling: bool
    """Whether these are drives with the largest gains or losses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """What the page shows of one condition."""

    number: int
    condition: Condition
    answer: Answer | None
    comparison_tables: list[Any]
    driving_tables: list[Any]
    has_all_subsets: bool
    """Whether these tables show every subset of the scenarios."""
    same: str
    """The metrics that do not vary, as text."""
    has_tags: bool
    drives: list[DriveList]
    forecast_answer: Answer | None
    forecast_tables: list[Any]
    breakdown_tables: list[Any]
    forecasts_at: int | None
    """Number of the part that shows the forecasts on these data, if it is another one."""
    figures: dict[str, list[dict[str, Any]]]
    """Figures by section."""

    def anchor(self, section: str) -> str:
        """The anchor of one of its sections."""
        return f"{section}-{self.number}" if self.number else section


def check_report_possible() -> None:
    """Checks that the package of the extra `report` is installed, before a long run begins.

    Raises:
        MissingExtraError: jinja2 is not installed.
    """
    if find_spec("jinja2") is None:
        raise MissingExtraError("jinja2", "report", "a report")


def write_report(
    out: Path,
    *,
    title: str,
    lead: str = "",
    maps: Mapping[str, RoadMap] | None = None,
    examples: ForecastExamples | None = None,
    episodes: Sequence[Episode] | None = None,
    answers: Mapping[str, Sequence[str]] | None = None,
) -> Path:
    """Writes `report.html` into a run folder.

    The function reads `metrics.csv`, `manifest.json`, `scenarios.csv` if there is one, and the
    rollouts below `rollouts/`. Rollouts in sub-folders, such as
    `rollouts/sampling + ffw-asp/00-12-300.npz`, are grouped by method; those of one file name can
    be compared between methods. Rows of `metrics.csv` and of `scenarios.csv` with several data,
    traffics or latencies become parts of the page, between which one chooses.

    Args:
        out: The run folder.
        title: Title of the page, plain text.
        lead: A sentence or two below the title, plain text.
        maps: Road maps by the names of the rollouts' recordings; `DATA/RECORDING` for a recording
            whose name occurs in several data.
        examples: Forecasts to draw over the map.
        episodes: The rollouts to show; by default those that `find_episodes` finds.
        answers: Sentences that answer further questions, by question.

    Returns:
        The path of the page.

    Raises:
        MissingExtraError: jinja2 is not installed.
        DataError: A file is missing or damaged, or the map of a rollout is missing.
    """
    check_report_possible()
    manifest = _read_manifest(out / "manifest.json")
    privileged = [*manifest.get("privileged", ())]
    results = read_results(out / "metrics.csv", privileged=privileged)
    values = read_scenario_values(out / "scenarios.csv")
    episodes = find_episodes(out, manifest) if episodes is None else episodes
    colours = {name: i % COLOURS for i, name in enumerate(results.predictors)}
    parts = [
        _part(number, results, values_in(values, condition), privileged, colours)
        for number, condition in enumerate(results.conditions)
    ]
    map_table = MapTable()
    for part in parts:
        if found := _partings(part, episodes, maps or {}, map_table):
            part.figures["partings"] = found
    data = {
        "figures": {
            part.anchor(section): each for part in parts for section, each in part.figures.items()
        },
        "colours": colours | {split_name(name)[0]: number for name, number in colours.items()},
        "pictures": examples_payload(examples, map_table) if examples else [],
        "drives": rollouts_payload(out, episodes, maps or {}, map_table, results.conditions),
        "parted_cm": round(100 * PARTED_M),
        "conditions": condition_labels(results.conditions),
    }
    data["maps"] = map_table.payloads
    page = _page_template().render(
        title=title,
        lead=lead,
        parts=parts,
        summary=_summary(parts, results),
        labels={
            (each.condition, (each.planner, each.predictor)): each.label
            for each in reversed(episodes)
        },
        saved={(each.label, each.path.stem) for each in episodes},
        names=_names(results),
        notes=_notes(results),
        answers=answers or {},
        run=manifest,
        data=data,
        sections=_sections(parts, data, answers or {}),
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


def _part(
    number: int,
    results: Results,
    values: ScenarioValues | None,
    privileged: Sequence[str],
    colours: Mapping[str, int],
) -> Part:
    """What the page shows of a condition."""
    condition = results.conditions[number]
    driving = [r for r in results.driving if r.condition == condition]
    first = next(i for i, s in enumerate(results.conditions) if s.data == condition.data)
    forecasts = [r for r in results.open_loop if r.condition.data == condition.data]
    shown = forecasts if first == number else []
    answer = driving_answer(driving, places=values.places if values else None)
    others, same = figures.other_metrics(driving)
    by_tag = figures.tags(driving)
    is_brief = len(results.conditions) > MOST_WITH_SUBSETS
    in_tables = [r for r in driving if r.subset == "all" or not is_brief]
    drawn = {
        "ranking": figures.rankings(driving),
        "others": others,
        "forecasts": [
            *figures.forecast_errors(shown),
            *figures.errors_over_time(shown, colours),
            figures.regret(shown),
        ],
        "tags": [by_tag],
        "drives": [figures.scenario_differences(driving, values)],
    }
    return Part(
        number=number,
        condition=condition,
        answer=answer or (forecast_answer(forecasts) if not driving else None),
        comparison_tables=comparison_figures(driving),
        driving_tables=[*difference_figures(in_tables), *result_figures(in_tables)],
        has_all_subsets=len(in_tables) == len(driving),
        same=same,
        has_tags=by_tag is not None,
        drives=_drive_lists(driving, values, answer, privileged),
        forecast_answer=forecast_answer(shown) if driving else None,
        forecast_tables=result_figures(shown),
        breakdown_tables=breakdown_figures(shown),
        forecasts_at=first if forecasts and first != number else None,
        figures={
            section: kept
            for section, each in drawn.items()
            if (kept := [figure for figure in each if figure])
        },
    )


def _partings(
    part: Part, episodes: Sequence[Episode], maps: Mapping[str, RoadMap], table: MapTable
) -> list[dict[str, Any]]:
    """Pictures of the drives with the largest gains and losses."""
    saved = {
        (each.path.stem, (each.planner, each.predictor)): each
        for each in reversed(episodes)
        if each.condition == part.condition
    }
    return [
        figure
        for each in part.drives
        if each.is_telling
        for figure in parting_figures(
            each.drives, saved, maps, table, condition=part.number, most=PICTURED
        )
    ]


def _drive_lists(
    driving: Sequence[Result],
    values: ScenarioValues | None,
    answer: Answer | None,
    privileged: Sequence[str],
) -> list[DriveList]:
    """The drives with the largest gains and losses, and the worst ones."""
    if values is None:
        return []
    scores = score_differences(driving)
    pair = difference_of(scores[0].metric) if scores else None
    lists: list[tuple[str, Sequence[ListedDrive], bool]] = []
    if pair is not None:
        gains, losses = telling_drives(values, pair[1], privileged)
        lists = [("Largest gains", gains, True), ("Largest losses", losses, True)]
    methods = [m for m in values.scores if m[0] != EXPERT]
    if methods:
        best = answer.method if answer else None
        key = (best.planner, best.predictor) if best else methods[-1]
        reference = (key[0], pair[1]) if pair else methods[0]
        worst = worst_drives(values, key, reference)
        heading = f"Lowest scores of {' + '.join(filter(None, _short(key)))}"
        lists.append((heading, worst, False))
    return [
        DriveList(heading=heading, drives=tuple(each), is_telling=is_telling)
        for heading, each, is_telling in lists
        if each
    ]


def _short(method: tuple[str, str]) -> tuple[str, str]:
    return method[0], split_name(method[1])[0]


def _names(results: Results) -> dict[tuple[str, str], str]:
    """Short names of methods by planner and predictor."""
    labels = short_labels(methods_of(results.driving))
    return {(m.planner, m.predictor): label for m, label in labels.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """The differences of the score by method and condition."""

    groups: tuple[tuple[tuple[str, int], ...], ...]
    """Rows of headings above the last one: the text, and the number of columns below it."""
    conditions: tuple[tuple[int, str], ...]
    """Number and heading of each column."""
    rows: tuple[tuple[str, bool, tuple[tuple[str, str, str] | None, ...]], ...]
    """Name, whether privileged, and text, interval and outcome of each cell."""
    sentence: str


def _summary(parts: Sequence[Part], results: Results) -> Summary | None:
    """The summary of several conditions; None if there is one, or no differences."""
    scores = [score_differences([r for r in results.driving if r.condition == p.condition])
              for p in parts]  # fmt: skip
    methods = methods_of(r for each in scores for r in each)
    if len(parts) < 2 or not methods:
        return None
    labels = short_labels(methods)
    columns = [{r.method: r for r in each} for each in scores]
    rows = []
    for method in methods:
        cells = []
        for column in columns:
            result = column.get(method)
            value, _, interval = gain(result).partition(" ") if result else ("", "", "")
            cells.append((value, interval, outcome(result)) if result else None)
        rows.append((labels[method], method.privileged, tuple(cells)))
    verdicts = [part.answer.verdict for part in parts if part.answer]
    counts = [f"{verdict} in {verdicts.count(verdict)}" for verdict in distinct(verdicts)]
    headings = condition_parts(results.conditions)
    return Summary(
        groups=tuple(
            _runs([parts[: level + 1] for parts in headings])
            for level in range(len(headings[0]) - 1)
        ),
        conditions=tuple(enumerate(parts[-1] for parts in headings)),
        rows=tuple(rows),
        sentence=f"{len(parts)} conditions: {', '.join(counts)}.",
    )


def _runs(keys: Sequence[tuple[str, ...]]) -> tuple[tuple[str, int], ...]:
    """The last texts of consecutive equal keys, and how many there are of each."""
    return tuple((key[-1], len([*same])) for key, same in groupby(keys))


def _sections(
    parts: Sequence[Part], data: Mapping[str, Any], answers: Mapping[str, Sequence[str]]
) -> dict[str, str]:
    """Headings of the sections that have something to show in any part, by their anchors."""
    sections = {
        "ranking": ("Ranking", any(p.comparison_tables or p.driving_tables for p in parts)),
        "forecasts": ("Forecasts", any(p.forecast_tables for p in parts)),
        "examples": ("Example forecasts", data["pictures"]),
        "tags": ("What decides", any(p.has_tags for p in parts)),
        "drives": ("Drives", any(p.drives or "drives" in p.figures for p in parts)),
        "questions": ("Questions", answers),
        "player": ("Player", data["drives"]),
        "metrics": ("Metrics", True),
        "manifest": ("Manifest", True),
    }
    return {anchor: heading for anchor, (heading, shown) in sections.items() if shown}


@cache
def _page_template() -> Any:
    import jinja2
    from markupsafe import Markup

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("asp_env.evaluation.report", "assets"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    environment.globals["style"] = Markup((ASSETS / "style.css").read_text(encoding="utf-8"))
    environment.globals["scripts"] = Markup(
        "\n".join((ASSETS / name).read_text(encoding="utf-8") for name in SCRIPTS)
    )
    return environment.get_template("page.html.j2")


def _notes(results: Results) -> list[MetricNote]:
    """Notes of all metrics; of the differences, only those of the score are explained."""
    names = distinct(result.metric for result in (*results.open_loop, *results.driving))
    differences = {name: difference_of(name) for name in names}
    return [
        metric_note(name)
        for name, pair in differences.items()
        if metric_note(name).text and (pair is None or pair[0] == SCORE)
    ]
