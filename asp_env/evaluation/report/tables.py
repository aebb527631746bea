"""The contents of the page's tables: one figure per data set and horizon, a tab per subset."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from asp_env.evaluation.report.results import (
    SELECTIONS,
    SUBSETS,
    MethodResult,
    MetricNote,
    Result,
    best_result,
    distinct,
    methods_of,
    metric_note,
    short_labels,
)
from asp_env.evaluation.results import HEADROOM, ORACLE_SHARE, SCORE, difference_name, difference_of
from asp_env.evaluation.verdicts import NOT_RESOLVED, RESOLVED, verdict_text

COMPARISON = (ORACLE_SHARE, HEADROOM)
"""Metrics beside the difference of the score."""
COMPARED_SUBSETS = ("all", "interactive")
"""The subsets of scenarios that come first in comparisons."""
SHARE_NOTES = {HEADROOM: NOT_RESOLVED}
"""Text of a missing value: the oracle's gain is not resolved."""

BREAKDOWN_METRIC = "FDE"
"""The metric shown by kind of target, that is for subsets such as `manoeuvre:left`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A value as it is printed."""

    value: str
    best: bool
    """Whether it is the best of its column among methods that are not privileged."""
    interval: tuple[str, str] | None
    count: str | None
    """Number of values averaged."""
    note: str | None = None
    """Text below the value."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodRow:
    """A method and its values, None where a value is missing."""

    method: MethodResult
    name: str
    """The method's name, without its planner where all have the same."""
    cells: tuple[Cell | None, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """The heading of a column."""

    label: str
    detail: str
    """Unit and direction, or number of values."""
    title: str = ""
    """Shown when the mouse hovers over the heading."""


DIFFERENCE_COLUMNS = (
    Column(
        label="Difference",
        detail="↑",
        title="Mean difference of the score in the same scenarios, with its 95 % interval.",
    ),
    Column(
        label="MDE",
        detail="",
        title="Minimal detectable effect: the smallest difference that these scenarios resolve "
        "with 80 % power at the 5 % level, 2.8 standard errors.",
    ),
    Column(
        label="p",
        detail="Holm",
        title="Two-sided p value of the difference, adjusted by Holm's method over the methods.",
    ),
    Column(
        label="Verdict",
        detail="",
        title="Resolved if the interval excludes 0 and the difference is at least the MDE; else "
        "the number of scenarios that would resolve a difference of this size.",
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A row for each method, a column for each metric or kind of target."""

    heading: str
    columns: tuple[Column, ...]
    rows: tuple[MethodRow, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tab:
    """The tables of one subset."""

    label: str
    tables: tuple[Table, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """Tables of one data set and horizon under a caption."""

    data: str
    details: tuple[str, ...]
    tabs: tuple[Tab, ...]


def result_figures(results: Sequence[Result]) -> list[Figure]:
    """Metrics by method, without comparisons, metrics over time and kinds of targets.

    Args:
        results: Results of one condition.
    """
    groups: dict[str, list[Result]] = {}
    for result in results:
        if result.at_s is None and ":" not in result.subset and not result.is_comparison:
            groups.setdefault(result.horizon_s, []).append(result)
    figures = []
    for group in groups.values():
        subsets = distinct((result.subset for result in group), first=SUBSETS)
        tabs = [
            Tab(
                label=subset or "all",
                tables=_metric_tables([result for result in group if result.subset == subset]),
            )
            for subset in subsets
        ]
        figures.append(_figure(group[0], (), tabs))
    return figures


def comparison_figures(results: Sequence[Result]) -> list[Figure]:
    """Differences to the reference with verdicts, oracle shares and headroom, a tab per subset.

    Args:
        results: Closed-loop results of one condition.
    """
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        difference = difference_of(result.metric)
        if difference is not None and difference[0] == SCORE:
            groups.setdefault((result.horizon_s, difference[1]), []).append(result)
    figures = []
    for (horizon_s, reference), group in groups.items():
        same = [r for r in results if r.horizon_s == horizon_s]
        subsets = distinct((result.subset for result in group), first=COMPARED_SUBSETS)
        tabs = [
            _comparison_tab(subset, reference, [r for r in same if r.subset == subset])
            for subset in subsets
        ]
        figures.append(_figure(group[0], (f"less {reference}",), tabs))
    return figures


def _comparison_tab(subset: str, reference: str, results: Sequence[Result]) -> Tab:
    """The differences of the score in a subset."""
    of = {(result.method, result.metric): result for result in results}
    score = difference_name(SCORE, reference)
    methods = [
        result.method
        for result in sorted(
            (r for r in results if r.metric == score), key=lambda r: -(r.value or 0.0)
        )
    ]
    columns = [column for column in COMPARISON if _occurs(column, results)]
    names = _short_names(methods)
    rows = tuple(
        MethodRow(
            method=method,
            name=names[method],
            cells=(
                *_difference_cells(of[method, score]),
                *(_cell(of.get((method, metric)), None, SHARE_NOTES) for metric in columns),
            ),
        )
        for method in methods
    )
    headings = [*DIFFERENCE_COLUMNS, *(_heading(metric_note(metric)) for metric in columns)]
    table = Table(heading=f"score less {reference}", columns=tuple(headings), rows=rows)
    return Tab(label=subset, tables=(table,))


def _short_names(methods: Sequence[MethodResult]) -> dict[MethodResult, str]:
    """Short names of methods; their details stand below."""
    return {m: label.partition(" · ")[0] for m, label in short_labels(methods).items()}


def _occurs(metric: str, results: Sequence[Result]) -> bool:
    return any(result.metric == metric for result in results)


def _heading(note: MetricNote) -> Column:
    return Column(label=note.label, detail=note.unit_and_arrow, title=note.text)


def _difference_cells(result: Result) -> tuple[Cell | None, ...]:
    """The cells below `DIFFERENCE_COLUMNS`."""
    note = metric_note(result.metric)
    verdict, _, reason = verdict_text(result).partition(" (")
    return (
        _cell(result, None),
        None if result.mde is None else _text(note.format(result.mde)),
        None if result.p_holm is None else _text(_p_text(result.p_holm)),
        Cell(
            value=verdict,
            best=verdict == RESOLVED,
            interval=None,
            count=None,
            note=reason.removesuffix(")") or None,
        ),
    )


def _p_text(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def _text(value: str) -> Cell:
    return Cell(value=value, best=False, interval=None, count=None)


def difference_figures(results: Sequence[Result]) -> list[Figure]:
    """Differences of all metrics except the score to the reference, a tab per subset.

    Args:
        results: Closed-loop results of one condition.
    """
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        difference = difference_of(result.metric)
        if difference is not None and difference[0] != SCORE:
            groups.setdefault((result.horizon_s, difference[1]), []).append(result)
    figures = []
    for (_, reference), group in groups.items():
        subsets = distinct((result.subset for result in group), first=COMPARED_SUBSETS)
        tabs = [
            Tab(
                label=subset,
                tables=(_other_differences(reference, [r for r in group if r.subset == subset]),),
            )
            for subset in subsets
        ]
        figures.append(_figure(group[0], (f"less {reference}",), tabs))
    return figures


def _other_differences(reference: str, results: Sequence[Result]) -> Table:
    """A table of the differences of all metrics except the score in a subset."""
    columns: dict[str, dict[MethodResult, Result]] = {}
    for result in results:
        name, _ = difference_of(result.metric) or ("", "")
        columns.setdefault(name, {})[result.method] = result
    methods = methods_of(results)
    names = _short_names(methods)
    rows = tuple(
        MethodRow(
            method=method,
            name=names[method],
            cells=tuple(_cell(column.get(method), None) for column in columns.values()),
        )
        for method in methods
    )
    headings = tuple(_heading(metric_note(metric)) for metric in columns)
    return Table(heading=f"less {reference}", columns=headings, rows=rows)


def breakdown_figures(results: Sequence[Result]) -> list[Figure]:
    """FDE by manoeuvre and by class, a figure for each and a table for each selection.

    Args:
        results: Open-loop results of one condition.
    """
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        division, is_kind, _ = result.subset.partition(":")
        if is_kind and result.metric == BREAKDOWN_METRIC and result.at_s is None:
            groups.setdefault((result.horizon_s, division), []).append(result)
    figures = []
    for (_, division), group in groups.items():
        selections = distinct((result.selection for result in group), first=SELECTIONS)
        tables = tuple(
            _kind_table([result for result in group if result.selection == selection])
            for selection in selections
        )
        heading = f"{BREAKDOWN_METRIC} by {division}"
        figures.append(_figure(group[0], (heading,), [Tab(label="", tables=tables)]))
    return figures


def _figure(one: Result, headings: Sequence[str], tabs: Sequence[Tab]) -> Figure:
    horizon = [f"horizon {one.horizon_s} s"] if one.horizon_s else []
    details = (*headings, *horizon, *one.condition.details, *one.fixed)
    return Figure(data=one.condition.data, details=details, tabs=tuple(tabs))


def _metric_tables(results: Sequence[Result]) -> tuple[Table, ...]:
    tables: list[Table] = []
    for selection in distinct((result.selection for result in results), first=SELECTIONS):
        selected = [result for result in results if result.selection == selection]
        columns: dict[str, dict[MethodResult, Result]] = {}
        for result in selected:
            columns.setdefault(result.metric, {})[result.method] = result
        headings = [
            Column(label=note.label, detail=note.unit_and_arrow, title=note.text)
            for note in map(metric_note, columns)
        ]
        heading = selection.replace("-", " ") or ("all modes" if tables else "")
        tables.append(_table(heading, headings, list(columns.values()), methods_of(selected)))
    return tuple(tables)


def _kind_table(results: Sequence[Result]) -> Table:
    columns: dict[str, dict[MethodResult, Result]] = {}
    for result in results:
        columns.setdefault(result.subset.partition(":")[2], {})[result.method] = result
    headings = [
        Column(
            label=kind.replace("_", " "),
            detail=f"n = {max(result.n or 0 for result in column.values()):.0f}",
        )
        for kind, column in columns.items()
    ]
    heading = results[0].selection.replace("-", " ")
    return _table(heading, headings, list(columns.values()), methods_of(results))


def _table(
    heading: str,
    headings: Sequence[Column],
    columns: Sequence[dict[MethodResult, Result]],
    methods: Sequence[MethodResult],
) -> Table:
    best_texts = [_best_text(list(column.values())) for column in columns]
    names = _short_names(methods)
    rows = [
        MethodRow(
            method=method,
            name=names[method],
            cells=tuple(
                _cell(column.get(method), best)
                for column, best in zip(columns, best_texts, strict=True)
            ),
        )
        for method in methods
    ]
    return Table(heading=heading, columns=tuple(headings), rows=tuple(rows))


def _best_text(column: Sequence[Result]) -> str | None:
    """The best value as printed, None where fewer than two methods can be compared."""
    note = metric_note(column[0].metric)
    winner = best_result(column, better=note.better)
    rivals = [r for r in column if r.value is not None and not r.method.privileged]
    if winner is None or winner.value is None or note.better == "neither" or len(rivals) < 2:
        return None
    return note.format(winner.value)


def _cell(
    result: Result | None, best: str | None, missing: Mapping[str, str] = MappingProxyType({})
) -> Cell | None:
    """A value as it is printed; where it is missing, the text that `missing` has for its metric."""
    if result is None:
        return None
    if result.value is None:
        return _text(missing[result.metric]) if result.metric in missing else None
    note = metric_note(result.metric)
    text = note.format(result.value)
    interval = None
    if result.low is not None and result.high is not None:
        interval = note.format(result.low), note.format(result.high)
    return Cell(
        value=text,
        best=text == best and not result.method.privileged,
        interval=interval,
        count=None if result.n is None else f"{result.n:.0f}",
    )
