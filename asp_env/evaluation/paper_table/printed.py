"""The table in the paper's shape, the differences, and the ablations, for terminals and pages."""

from collections.abc import Callable, Sequence

from rich import box
from rich.table import Table
from rich.text import Text

from asp_env.evaluation.intervals import Estimate
from asp_env.evaluation.paper_table.paper import CAVEAT, DATA, PAPER, paper_numbers
from asp_env.evaluation.paper_table.results import (
    FEATURES,
    ORACLE,
    Findings,
    Key,
    Number,
    excludes_zero,
)

SHOWN = ("MAE", "MSE", "FDE")
MARK = "*"
COLUMN_WIDTH = 25
LABELS_WIDTH = 32

Line = tuple[str, str, str, str, str]
"""View, predictor, preset, variant, chaining: a line of the table over all its columns."""


def width_for(columns: int) -> int:
    """Characters that a table of so many columns needs."""
    return LABELS_WIDTH + columns * COLUMN_WIDTH


def main_table(
    findings: Findings, sites: Sequence[str], columns: Sequence[Key], selection: str, subset: str
) -> Table:
    """View and predictor by site and horizon: MAE / MSE / FDE, and the paper's below each.

    Args:
        findings: what was measured.
        sites: all of them, in order: the first is set beside inD, the second beside rounD.
        columns: one key of each site and horizon that is shown.
        selection: of modes.
        subset: of snippets.
    """
    table = _table(
        f"{subset} targets, {selection}: MAE m / MSE m² / FDE m\n"
        "mean over seeds; [95 % interval over recordings] and ± deviation over seeds of FDE"
    )
    table.caption = (
        f"paper: Janjoš et al. 2021 on {' and '.join(DATA)}; {CAVEAT}; it does not say which mode"
        f"\n{MARK} is handed the recorded future"
    )
    _heads(table, sites, columns)
    lines = _lines(findings, columns, lambda key: key.is_base)
    for view, predictor in PAPER:
        line = (view, predictor, "", "", "")
        if line not in lines:
            lines.append(line)
    last = ""
    for line in sorted(lines, key=lambda line: _view_rank(line[0], lines)):
        cells = []
        for column in columns:
            cell = _numbers(findings, _key(line, column), selection, subset)
            paper = paper_numbers(line[0], line[1], sites.index(column.site), column.horizon_s)
            if paper is not None and not any(line[2:]):
                said = " / ".join(f"{value:.2f}" for value in paper)
                cell.append(f"{chr(10) if cell else ''}paper {said}", style="dim")
            cells.append(cell)
        table.add_row("" if line[0] == last else line[0], _name(line), *cells)
        last = line[0]
    return table


def difference_table(
    findings: Findings, sites: Sequence[str], columns: Sequence[Key], selection: str, subset: str
) -> Table:
    """View, predictor and whom it is compared with by site and horizon."""
    table = _table(
        f"{subset} targets, {selection}: less another's MAE m / MSE m² / FDE m\n"
        "paired over snippets and seeds; [95 % interval over recordings] of FDE"
    )
    table.caption = f"{MARK} the interval excludes zero"
    _heads(table, sites, columns)
    for line in _lines(findings, columns, lambda key: key.is_base):
        names = {
            reference.predictor
            for column in columns
            if _key(line, column) in findings.errors
            for reference in findings.references(_key(line, column))
        }
        for name in sorted(names):
            cells = []
            for column in columns:
                key = _key(line, column)
                found = _reference(findings, key, name)
                cells.append(Text() if found is None else _difference(findings, key, found,
                             selection, subset))  # fmt: skip
            table.add_row(line[0], f"{_name(line)} less {_upper(name)}", *cells)
    return table


def ablation_table(findings: Findings, column: Key, subset: str) -> Table:
    """Predictor and change: what it makes of the line without it, and of the features."""
    table = _table(
        f"{column.site}, {column.horizon_s:g} s, {subset} targets: a change less the recipe "
        "without it\nMAE m / MSE m² / FDE m, paired over snippets and seeds; [95 % interval] of FDE"
    )
    table.caption = (
        f"{MARK} the interval excludes zero; on validation: R² of ẑ, sd and rank of z"
    )
    for heading in ("view", "predictor", "most probable", "best of 3", "FDE less DKM's"):
        table.add_column(heading)
    for heading in ("R²", "sd", "rank"):
        table.add_column(heading, justify="right")
    for line in _lines(findings, [column], lambda key: key.view != ""):
        key = _key(line, column)
        base = findings.base(key)
        features = _features(findings, key)
        if base is None and not (any(features) and key.is_base):
            continue
        cells = [
            Text("the recipe") if base is None else _difference(findings, key, base, each, subset)
            for each in ("most-probable", "best-of-3")
        ]
        dkm = _reference(findings, key, "dkm")
        less = (
            Text()
            if dkm is None
            else _difference(findings, key, dkm, "most-probable", subset, shown=("FDE",))
        )
        table.add_row(line[0], _name(line), *cells, less, *features)
    return table


def _table(title: str) -> Table:
    return Table(title=title, box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))


def _heads(table: Table, sites: Sequence[str], columns: Sequence[Key]) -> None:
    table.add_column("view")
    table.add_column("predictor")
    for column in columns:
        site = sites.index(column.site)
        beside = f"\npaper: {DATA[site]}" if site < len(DATA) else ""
        table.add_column(f"{column.site}, {column.horizon_s:g} s{beside}", no_wrap=False)


def _lines(findings: Findings, columns: Sequence[Key], wanted: Callable[[Key], bool]) -> list[Line]:
    """The lines that have something in one of the columns, in the order of the findings."""
    places = {(column.site, column.horizon_s) for column in columns}
    found = (
        (key.view, key.predictor, key.preset, key.variant, key.chaining)
        for key in findings.errors
        if (key.site, key.horizon_s) in places and wanted(key)
    )
    return list(dict.fromkeys(found))


def _view_rank(view: str, lines: Sequence[Line]) -> int:
    return [line[0] for line in lines].index(view)


def _key(line: Line, column: Key) -> Key:
    view, predictor, preset, variant, chaining = line
    return column._replace(
        view=view, predictor=predictor, preset=preset, variant=variant, chaining=chaining
    )


def _name(line: Line) -> str:
    _, predictor, preset, variant, chaining = line
    parts = [_upper(predictor), preset, variant, chaining]
    return " ".join(part for part in parts if part) + (f" {MARK}" if chaining == ORACLE else "")


def _upper(predictor: str) -> str:
    return predictor if predictor.startswith("constant") else predictor.upper()


def _pick(numbers: Sequence[Number], selection: str, subset: str) -> dict[str, Number]:
    return {
        number.metric: number
        for number in numbers
        if (number.selection, number.subset) == (selection, subset)
    }


def _numbers(findings: Findings, key: Key, selection: str, subset: str) -> Text:
    if key not in findings.errors:
        return Text()
    found = _pick([*findings.numbers(key)], selection, subset)
    if not found:
        return Text()
    text = Text(" / ".join(f"{found[metric].estimate.value:.2f}" for metric in SHOWN))
    spread = found["FDE"].spread
    about = _interval(found["FDE"].estimate) + ("" if spread is None else f" ±{spread:.2f}")
    if about:
        text.append(f"\n{about.strip()}", style="dim")
    return text


def _difference(
    findings: Findings,
    key: Key,
    other: Key,
    selection: str,
    subset: str,
    *,
    shown: Sequence[str] = SHOWN,
) -> Text:
    found = _pick([*findings.differences(key, other)], selection, subset)
    if not found:
        return Text()
    text = Text()
    for number, metric in enumerate(shown):
        estimate = found[metric].estimate
        sure = excludes_zero(estimate)
        style = ("green" if estimate.value < 0 else "red") if sure else ""
        text.append(" / " if number else "")
        text.append(f"{estimate.value:+.2f}{MARK if sure else ''}", style=style)
    interval = _interval(found["FDE"].estimate)
    if interval:
        text.append(f"\n{interval}", style="dim")
    return text


def _interval(estimate: Estimate) -> str:
    if estimate.low is None or estimate.high is None:
        return ""
    return f"[{estimate.low:.2f}, {estimate.high:.2f}]"


def _reference(findings: Findings, key: Key, name: str) -> Key | None:
    if key not in findings.errors:
        return None
    return next((each for each in findings.references(key) if each.predictor == name), None)


def _features(findings: Findings, key: Key) -> list[str]:
    seeds = [each for each in findings.features.get(key, ()) if each]
    if not seeds:
        return ["", "", ""]
    formats = (".2f", ".3f", ".0f")
    return [
        format(sum(seed[name] for seed in seeds) / len(seeds), spec)
        for name, spec in zip(FEATURES, formats, strict=True)
    ]
