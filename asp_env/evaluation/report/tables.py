"""Metrics as HTML: one table per data set and horizon, a tab per subset."""

from collections.abc import Iterator, Sequence
from html import escape

from asp_env.evaluation.report.notes import MetricNote, note
from asp_env.evaluation.report.results import Entrant, Result, best, distinct, entrants

SUBSETS = ("all", "moving")
SELECTIONS = ("most-probable", "best-of-3", "")
"""A metric without a selection speaks of all modes together."""

Column = tuple[str, str]
"""(selection, metric)."""


def tables(results: Sequence[Result]) -> str:
    """All tables of some results; metrics over time are left to the plots."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        if result.at_s is None:
            groups.setdefault((result.data, result.horizon_s), []).append(result)
    parts = [
        f"<figure class='results'>{_caption(group[0])}{_tabs(group)}</figure>"
        for group in groups.values()
    ]
    return "".join(parts)


def _caption(one: Result) -> str:
    horizon = [f"horizon {one.horizon_s} s"] if one.horizon_s else []
    details = " · ".join(escape(text) for text in (*horizon, *one.fixed))
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
    cells: dict[Column, dict[Entrant, Result]] = {}
    for selection in distinct((result.selection for result in results), first=SELECTIONS):
        for result in results:
            if result.selection == selection:
                cells.setdefault((selection, result.metric), {})[result.entrant] = result
    columns = list(cells)
    bold = {column: _bold(list(cells[column].values())) for column in columns}
    body = []
    for entrant in entrants(results):
        values = "".join(
            _cell(cells[column].get(entrant), bold[column], _first(columns, number))
            for number, column in enumerate(columns)
        )
        kind = " class='privileged'" if entrant.privileged else ""
        body.append(f"<tr{kind}>{_row_head(entrant)}{values}</tr>")
    return (
        "<div class='scroll'><table>"
        f"<thead>{''.join(_head(columns))}</thead><tbody>{''.join(body)}</tbody></table></div>"
    )


def _head(columns: Sequence[Column]) -> Iterator[str]:
    selections = distinct(selection for selection, _ in columns)
    if selections != [""]:
        spans = "".join(
            f"<th class='first' colspan='{sum(s == selection for s, _ in columns)}'>"
            f"{escape(selection.replace('-', ' ') or 'all modes')}</th>"
            for selection in selections
        )
        yield f"<tr class='groups'><th></th>{spans}</tr>"
    names = "".join(
        f"<th{_first(columns, number)} title='{escape(note(metric).text, quote=True)}'>"
        f"{escape(note(metric).label)}{_unit(note(metric))}</th>"
        for number, (_, metric) in enumerate(columns)
    )
    yield f"<tr><th></th>{names}</tr>"


def _unit(told: MetricNote) -> str:
    arrow = {"lower": "↓", "higher": "↑", "neither": ""}[told.better]
    unit = " ".join(part for part in (told.unit, arrow) if part)
    return f"<small>{unit}</small>" if unit else ""


def _first(columns: Sequence[Column], number: int) -> str:
    starts = number == 0 or columns[number - 1][0] != columns[number][0]
    return " class='first'" if starts else ""


def _bold(column: Sequence[Result]) -> str | None:
    """The best value as printed, where there is a choice between those who are comparable."""
    told = note(column[0].metric)
    winner = best(column, better=told.better)
    rivals = [r for r in column if r.value is not None and not r.entrant.privileged]
    if winner is None or winner.value is None or told.better == "neither" or len(rivals) < 2:
        return None
    return told.format(winner.value)


def _row_head(entrant: Entrant) -> str:
    details = "".join(f"<small>{escape(detail)}</small>" for detail in entrant.details)
    mark = "<i class='badge'>knows the future</i>" if entrant.privileged else ""
    return f"<th>{escape(entrant.name)}{mark}{details}</th>"


def _cell(result: Result | None, bold: str | None, first: str) -> str:
    if result is None or result.value is None:
        return f"<td{first}>&ndash;</td>"
    told = note(result.metric)
    text = told.format(result.value)
    if text == bold and not result.entrant.privileged:
        text = f"<b>{text}</b>"
    if result.low is not None and result.high is not None:
        low, high = told.format(result.low), told.format(result.high)
        text += f"<small>{low}&thinsp;&ndash;&thinsp;{high}</small>"
    count = "" if result.n is None else f" title='n = {result.n:.0f}'"
    return f"<td{first}{count}>{text}</td>"
