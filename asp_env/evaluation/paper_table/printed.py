"""The table in the paper's shape, the differences, and the ablations, for terminals and pages."""

from collections.abc import Callable, Mapping, Sequence

from rich import box
from rich.table import Table
from rich.text import Text

from asp_env.evaluation.intervals import Estimate
from asp_env.evaluation.paper_table.paper import CAVEAT, DATA, PAPER, paper_numbers
from asp_env.evaluation.paper_table.results import (
    FEATURES,
    ORACLE,
    Choice,
    Findings,
    Key,
    Number,
    excludes_zero,
)

SHOWN = ("MAE", "MSE", "FDE")
MARK = "*"
SURE = f"{MARK} the interval excludes zero"
COLUMN_WIDTH = 26
LABEL_WIDTH = 28

Line = tuple[str, str, str, str, str]
"""View, predictor, preset, variant, chaining: a line of the table over all its columns."""


def width_for(columns: int) -> int:
    """Characters that a table of so many columns needs."""
    return LABEL_WIDTH + columns * COLUMN_WIDTH


def main_table(
    findings: Findings, sites: Sequence[str], columns: Sequence[Key], choice: Choice
) -> Table:
    """View and predictor by site and horizon: MAE / MSE / FDE, and the paper's below each.

    Args:
        findings: what was measured.
        sites: all of them, in order: the first is set beside inD, the second beside rounD.
        columns: one key of each site and horizon that is shown.
        choice: selection of modes and subset of snippets.
    """
    table = _table(
        f"{choice.subset} targets, {choice.selection}: MAE m / MSE m² / FDE m, mean over seeds\n"
        "[95 % interval over recordings] and ± deviation over seeds of FDE"
    )
    table.caption = (
        f"paper: Janjoš et al. 2021 on {' and '.join(DATA)}, which mode is not said;\n{CAVEAT};\n"
        f"its SSP-ASP chains 6 s by label matching, as {ORACLE} {MARK} here does:\n"
        f"{MARK} is handed the recorded future"
    )
    _heads(table, sites, columns)
    lines = _lines(findings, columns, lambda key: not key.variant)
    lines += [line for each in PAPER if (line := (*each, "", "", "")) not in lines]
    for view, members in _by_view(lines).items():
        _section(table, view)
        for line in members:
            cells = []
            for column in columns:
                cell = _means(findings.numbers(_key(line, column), choice))
                paper = paper_numbers(line[0], line[1], sites.index(column.site), column.horizon_s)
                if paper is not None and not any(line[2:]):
                    said = " / ".join(f"{value:.2f}" for value in paper)
                    cell.append(f"{chr(10) if cell else ''}paper {said}", style="dim")
                cells.append(cell)
            table.add_row(_name(line), *cells)
    return table


def difference_table(
    findings: Findings, sites: Sequence[str], columns: Sequence[Key], choice: Choice
) -> Table:
    """View, predictor and whom it is compared with by site and horizon."""
    table = _table(
        f"{choice.subset} targets, {choice.selection}: what is between MAE m / MSE m² / FDE m\n"
        "paired over snippets and seeds; [95 % interval over recordings] of FDE"
    )
    table.caption = f"{SURE}; {ORACLE} {MARK} is handed the recorded future"
    _heads(table, sites, columns)
    for view, members in _by_view(_lines(findings, columns, lambda k: not k.variant)).items():
        _section(table, view)
        for line in members:
            keys = [_key(line, column) for column in columns]
            others = [{each.predictor: each for each in findings.references(key)} for key in keys]
            for name in dict.fromkeys(name for each in others for name in each):
                cells = [
                    _less(findings.differences(key, each[name], choice)) if name in each else ""
                    for key, each in zip(keys, others, strict=True)
                ]
                table.add_row(f"{_name(line)}\n  less {_upper(name)}", *cells)
    return table


def ablation_table(findings: Findings, column: Key, choice: Choice) -> Table:
    """Predictor and change: what it makes of the line without it, and of the features."""
    table = _table(
        f"{column.site}, {column.horizon_s:g} s, {choice.subset} targets, {choice.selection}\n"
        "a change less the recipe without it: MAE m / MSE m² / FDE m\n"
        "paired over snippets and seeds; [95 % interval over recordings] of FDE"
    )
    table.caption = f"{SURE}\nR² of ẑ, deviation and effective rank of z on validation"
    table.add_column("", no_wrap=True)
    for heading in ("change", "FDE less DKM's"):
        table.add_column(heading, no_wrap=True)
    for heading in ("R²", "dev.", "rank"):
        table.add_column(heading, justify="right", no_wrap=True)
    lines = _lines(findings, [column], lambda key: key.view != "" and not key.chaining)
    changed = {(line[0], line[1]) for line in lines if line[3]}
    for view, members in _by_view([each for each in lines if each[:2] in changed]).items():
        _section(table, view)
        for line in sorted(members, key=lambda line: [each[1] for each in members].index(line[1])):
            key = _key(line, column)
            base = findings.base(key)
            change = Text("the recipe")
            if base is not None:
                change = _less(findings.differences(key, base, choice))
            dkm = next((k for k in findings.references(key) if k.predictor == "dkm"), None)
            less = _less(findings.differences(key, dkm, choice), ("FDE",)) if dkm else Text()
            table.add_row(_name(line), change, less, *_features(findings, key))
    return table


def _table(title: str) -> Table:
    return Table(title=title, box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))


def _heads(table: Table, sites: Sequence[str], columns: Sequence[Key]) -> None:
    table.add_column("")
    for column in columns:
        site = sites.index(column.site)
        beside = f"\nbeside {DATA[site]}" if site < len(DATA) else ""
        heading = f"{column.site}\n{column.horizon_s:g} s{beside}"
        table.add_column(heading, min_width=COLUMN_WIDTH - 1)


def _section(table: Table, view: str) -> None:
    if view:
        table.add_row(Text(view, style="bold"))


def _lines(findings: Findings, columns: Sequence[Key], wanted: Callable[[Key], bool]) -> list[Line]:
    """The lines that have something in one of the columns, in the order of the findings."""
    places = {(column.site, column.horizon_s) for column in columns}
    found = (
        (key.view, key.predictor, key.preset, key.variant, key.chaining)
        for key in findings.sums
        if (key.site, key.horizon_s) in places and wanted(key)
    )
    return list(dict.fromkeys(found))


def _by_view(lines: Sequence[Line]) -> dict[str, list[Line]]:
    found: dict[str, list[Line]] = {}
    for line in lines:
        found.setdefault(line[0], []).append(line)
    return found


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


def _means(found: Mapping[str, Number]) -> Text:
    if not found:
        return Text()
    text = Text(" / ".join(f"{found[metric].estimate.value:.2f}" for metric in SHOWN))
    spread = found["FDE"].spread
    about = _interval(found["FDE"].estimate) + ("" if spread is None else f" ±{spread:.2f}")
    return text.append(f"\n{about.strip()}", style="dim") if about else text


def _less(found: Mapping[str, Number], shown: Sequence[str] = SHOWN) -> Text:
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
    return text.append(f"\n{interval}", style="dim") if interval else text


def _interval(estimate: Estimate) -> str:
    if estimate.low is None or estimate.high is None:
        return ""
    return f"[{estimate.low:.2f}, {estimate.high:.2f}]"


def _features(findings: Findings, key: Key) -> list[str]:
    seeds = [each for each in findings.features.get(key, ()) if each]
    if not seeds:
        return ["", "", ""]
    formats = (".2f", ".3f", ".0f")
    return [
        format(sum(seed[name] for seed in seeds) / len(seeds), spec)
        for name, spec in zip(FEATURES, formats, strict=True)
    ]
