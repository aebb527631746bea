"""Metrics as HTML: one table per data set and horizon, a tab per subset."""

from collections.abc import Sequence
from html import escape

from asp_env.evaluation.report.results import (
    MethodResult,
    MetricNote,
    Result,
    best,
    distinct,
    entrants,
    note,
)

SUBSETS = ("all", "moving")
KIND_METRIC = "FDE"
"""What is shown of kinds of targets: subsets such as `manoeuvre:left`."""

SELECTIONS = ("most-probable", "best-of-3", "")
"""A metric without a selection speaks of all modes together."""


def tables(results: Sequence[Result]) -> str:
    """All tables of some results; metrics over time are left to the plots, kinds to `kinds`."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        if result.at_s is None and ":" not in result.subset:
            groups.setdefault((result.data, result.horizon_s), []).append(result)
    parts = [
        f"<figure class='results'>{_caption(group[0])}{_tabs(group)}</figure>"
        for group in groups.values()
    ]
    return "".join(parts)


def kinds(results: Sequence[Result]) -> str:
    """FDE by manoeuvre and by class: a table for each and for each selection."""
    groups: dict[tuple[str, str, str], list[Result]] = {}
    for result in results:
        what, is_kind, _ = result.subset.partition(":")
        if is_kind and result.metric == KIND_METRIC and result.at_s is None:
            groups.setdefault((result.data, result.horizon_s, what), []).append(result)
    parts = []
    for (*_, what), group in groups.items():
        found = distinct((result.selection for result in group), first=SELECTIONS)
        inner = "".join(
            _kind_table([result for result in group if result.selection == selection])
            for selection in found
        )
        caption = _caption(group[0], f"{KIND_METRIC} by {what}")
        parts.append(f"<figure class='results'>{caption}{inner}</figure>")
    return "".join(parts)


def _kind_table(results: Sequence[Result]) -> str:
    columns: dict[str, dict[MethodResult, Result]] = {}
    for result in results:
        columns.setdefault(result.subset.partition(":")[2], {})[result.entrant] = result
    counts = {kind: max(r.n or 0 for r in column.values()) for kind, column in columns.items()}
    headings = "".join(
        f"<th>{escape(kind.replace('_', ' '))}<small>n = {count:.0f}</small></th>"
        for kind, count in counts.items()
    )
    return _grid(
        results[0].selection.replace("-", " "),
        headings,
        list(columns.values()),
        entrants(results),
    )


def _caption(one: Result, *what: str) -> str:
    horizon = [f"horizon {one.horizon_s} s"] if one.horizon_s else []
    details = " · ".join(escape(text) for text in (*what, *horizon, *one.fixed))
    return f"<figcaption><b>{escape(one.data)}</b> <span>{details}</span></figcaption>"


def _tabs(results: Sequence[Result]) -> str:
    subsets = distinct((result.subset for result in results), first=SUBSETS)
    if len(subsets) == 1:
        return _table(results)
    buttons, panels = [], []
    for number, subset in enumerate(subsets):
        buttons.append(
            f"<button role='tab' aria-selected='{str(number == 0).lower()}'>"
            f"{escape(subset or 'all')}</button>"
        )
        mine = [result for result in results if result.subset == subset]
        hidden = "" if number == 0 else " hidden"
        panels.append(f"<div role='tabpanel'{hidden}>{_table(mine)}</div>")
    return f"<div class='tabs'><div role='tablist'>{''.join(buttons)}</div>{''.join(panels)}</div>"


def _table(results: Sequence[Result]) -> str:
    parts = []
    for selection in distinct((result.selection for result in results), first=SELECTIONS):
        mine = [result for result in results if result.selection == selection]
        heading = selection.replace("-", " ") or ("all modes" if parts else "")
        parts.append(_selection_table(heading, mine))
    return "".join(parts)


def _selection_table(heading: str, results: Sequence[Result]) -> str:
    cells: dict[str, dict[MethodResult, Result]] = {}
    for result in results:
        cells.setdefault(result.metric, {})[result.entrant] = result
    names = "".join(
        f"<th title='{escape(note(metric).text, quote=True)}'>"
        f"{escape(note(metric).label)}{_unit(note(metric))}</th>"
        for metric in cells
    )
    return _grid(heading, names, list(cells.values()), entrants(results))


def _grid(
    heading: str,
    names: str,
    columns: Sequence[dict[MethodResult, Result]],
    rows: Sequence[MethodResult],
) -> str:
    """A table with a row for each entrant; the best value of each column is bold."""
    bold = [_bold(list(column.values())) for column in columns]
    body = []
    for entrant in rows:
        values = "".join(
            _cell(column.get(entrant), best_of)
            for column, best_of in zip(columns, bold, strict=True)
        )
        kind = " class='privileged'" if entrant.privileged else ""
        body.append(f"<tr{kind}>{_row_head(entrant)}{values}</tr>")
    return (
        f"<div class='scroll'><table style='min-width: {14 + 7.5 * len(columns)}rem'>"
        f"<thead><tr><th>{escape(heading)}</th>{names}</tr></thead>"
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _unit(told: MetricNote) -> str:
    arrow = {"lower": "↓", "higher": "↑", "neither": ""}[told.better]
    unit = " ".join(part for part in (told.unit, arrow) if part)
    return f"<small>{unit}</small>" if unit else ""


def _bold(column: Sequence[Result]) -> str | None:
    """The best value as printed, where there is a choice between those who are comparable."""
    told = note(column[0].metric)
    winner = best(column, better=told.better)
    rivals = [r for r in column if r.value is not None and not r.entrant.privileged]
    if winner is None or winner.value is None or told.better == "neither" or len(rivals) < 2:
        return None
    return told.format(winner.value)


def _row_head(entrant: MethodResult) -> str:
    details = "".join(f"<small>{escape(detail)}</small>" for detail in entrant.details)
    mark = "<i class='badge'>knows the future</i>" if entrant.privileged else ""
    return f"<th>{escape(entrant.name)}{mark}{details}</th>"


def _cell(result: Result | None, bold: str | None) -> str:
    if result is None or result.value is None:
        return "<td>&ndash;</td>"
    told = note(result.metric)
    text = told.format(result.value)
    if text == bold and not result.entrant.privileged:
        text = f"<b>{text}</b>"
    if result.low is not None and result.high is not None:
        low, high = told.format(result.low), told.format(result.high)
        text += f"<small>{low}&thinsp;&ndash;&thinsp;{high}</small>"
    count = "" if result.n is None else f" title='n = {result.n:.0f}'"
    return f"<td{count}>{text}</td>"
