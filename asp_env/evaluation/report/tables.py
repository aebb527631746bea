"""The contents of the page's tables: one figure per data set and horizon, a tab per subset."""

from collections.abc import Sequence
from dataclasses import dataclass

from asp_env.evaluation.report.results import (
    SELECTIONS,
    SUBSETS,
    MethodResult,
    Result,
    best_result,
    distinct,
    methods_of,
    metric_note,
)

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


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodRow:
    """A method and its values, None where a value is missing."""

    method: MethodResult
    cells: tuple[Cell | None, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """The heading of a column."""

    label: str
    detail: str
    """Unit and direction, or number of values."""
    title: str = ""
    """Shown when the mouse hovers over the heading."""


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
    """Metrics by method, without comparisons, metrics over time and kinds of targets."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        if result.at_s is None and ":" not in result.subset and not result.is_comparison:
            groups.setdefault((result.data, result.horizon_s), []).append(result)
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


def breakdown_figures(results: Sequence[Result]) -> list[Figure]:
    """FDE by manoeuvre and by class, a figure for each and a table for each selection."""
    groups: dict[tuple[str, str, str], list[Result]] = {}
    for result in results:
        division, is_kind, _ = result.subset.partition(":")
        if is_kind and result.metric == BREAKDOWN_METRIC and result.at_s is None:
            groups.setdefault((result.data, result.horizon_s, division), []).append(result)
    figures = []
    for (*_, division), group in groups.items():
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
    return Figure(data=one.data, details=(*headings, *horizon, *one.fixed), tabs=tuple(tabs))


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
    rows = [
        MethodRow(
            method=method,
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


def _cell(result: Result | None, best: str | None) -> Cell | None:
    if result is None or result.value is None:
        return None
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
