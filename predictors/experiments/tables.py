"""The table of Janjoš, Dolgov and Zöllner (2021): on inD and rounD, 3 s and 6 s.

MERGED: The table in the paper's shape, the differences, and the ablations, for terminals and pages.
MERGED: What is written and printed of findings: long form, page, and tables in the paper's shape.
"""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table
from rich.terminal_theme import DEFAULT_TERMINAL_THEME
from rich.text import Text

from asp_env.evaluation.results import Row, write_manifest, write_metrics
from asp_env.evaluation.statistics import Estimate
from asp_env.files import atomic_file
from predictors.experiments.cells import Cell, Site
from predictors.experiments.errors import Errors
from predictors.experiments.results import (
    CHOICES,
    FEATURES,
    NO_SEED,
    ORACLE,
    Choice,
    Findings,
    Key,
    Number,
    Sums,
    best_features,
    excludes_zero,
)
from predictors.experiments.worker import Judging, errors_path

DATA = ("inD", "rounD")
HORIZONS_S = (3.0, 6.0)
CAVEAT = "other data, not comparable in size"


class Numbers(NamedTuple):
    """Metres; MSE square metres."""

    mae: float
    mse: float
    fde: float


PaperLine = tuple[Numbers, Numbers, Numbers, Numbers]


def _line(*numbers: tuple[float, float, float]) -> PaperLine:
    first, second, third, fourth = (Numbers(*each) for each in numbers)
    return first, second, third, fourth


PAPER: Mapping[tuple[str, str], PaperLine] = MappingProxyType(
    {
        ("chauffeurnet", "dkm"): _line(
            (0.48, 0.86, 2.01), (1.27, 7.44, 5.91), (0.29, 0.29, 1.12), (1.35, 7.22, 5.55)
        ),
        ("chauffeurnet", "ffw-asp"): _line(
            (0.27, 0.33, 1.23), (1.13, 6.42, 5.45), (0.22, 0.18, 0.93), (1.12, 6.17, 5.08)
        ),
        ("chauffeurnet", "ssp-asp"): _line(
            (0.21, 0.24, 0.98), (1.23, 6.52, 5.15), (0.17, 0.12, 0.73), (1.34, 6.44, 4.69)
        ),
        ("mtp", "dkm"): _line(
            (0.58, 1.19, 2.36), (1.34, 7.89, 6.29), (0.29, 0.28, 1.22), (1.25, 6.13, 5.51)
        ),
        ("mtp", "ffw-asp"): _line(
            (0.30, 0.39, 1.41), (1.19, 6.78, 5.72), (0.22, 0.18, 0.94), (1.08, 5.84, 4.76)
        ),
        ("mtp", "ssp-asp"): _line(
            (0.22, 0.25, 1.04), (1.15, 6.08, 5.02), (0.17, 0.12, 0.74), (1.25, 7.08, 4.61)
        ),
    }
)
"""By view and predictor: inD 3 s, inD 6 s, rounD 3 s, rounD 6 s."""


def paper_numbers(view: str, predictor: str, site: int, horizon_s: float) -> Numbers | None:
    """What the paper has at a place of its table; None where it has nothing.

    Args:
        view: of the table.
        predictor: of the table.
        site: 0 is inD, 1 is rounD.
        horizon_s: seconds.
    """
    line = PAPER.get((view, predictor))
    if line is None or site >= len(DATA) or horizon_s not in HORIZONS_S:
        return None
    return line[site * len(HORIZONS_S) + HORIZONS_S.index(horizon_s)]


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
            table.add_row(_name(line), change, less, *_feature_table(findings, key))
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


def _feature_table(findings: Findings, key: Key) -> list[str]:
    seeds = [each for each in findings.features.get(key, ()) if each]
    if not seeds:
        return ["", "", ""]
    formats = (".2f", ".3f", ".0f")
    return [
        format(sum(seed[name] for seed in seeds) / len(seeds), spec)
        for name, spec in zip(FEATURES, formats, strict=True)
    ]


REPORT, TEXT = "report.html", "table.txt"
PAGE_WIDTH = 200

PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="UTF-8"><title>The paper's table</title>
<style>{stylesheet} body {{ color: {foreground}; background: {background}; }}
pre {{ font-family: ui-monospace, Menlo, Consolas, monospace; line-height: 1.25; }}</style></head>
<body><h1>The table of Janjoš et al. (2021) on other data</h1><pre>{code}</pre></body></html>
"""


def read_findings(judged: Mapping[Cell, Judging]) -> Findings:
    """What was kept of the cells that are finished."""
    sums: dict[Key, dict[int, Sums]] = {}
    features: dict[Key, list[dict[str, float]]] = {}
    for cell, judging in judged.items():
        if not judging.done:
            continue
        seed = NO_SEED if cell.seed is None else cell.seed
        for chaining in ("", *judging.chainings):
            path = errors_path(judging.errors, chaining)
            if path.exists():
                sums.setdefault(Key.of(cell, chaining), {})[seed] = Sums.of(Errors.load(path))
        if judging.run:
            features.setdefault(Key.of(cell), []).append(best_features(Path(judging.run)))
    return Findings(sums=sums, features=features)


def tables(findings: Findings, sites: Sequence[Site], width: int) -> list[Table]:
    """All tables, in the paper's shape where they fit, and site by site where they do not."""
    places = {(key.site, key.horizon_s): key for key in findings.sums}
    names = [site.name for site in sites]
    columns = [places[place] for place in sorted(places, key=lambda p: (names.index(p[0]), p[1]))]
    if not columns:
        return []
    if width_for(len(columns)) <= width:
        groups = [columns]
    else:
        groups = [[c for c in columns if c.site == name] for name in names]
    found = []
    for choice in CHOICES:
        for group in filter(None, groups):
            found.append(main_table(findings, names, group, choice))
            found.append(difference_table(findings, names, group, choice))
    for column in columns:
        if any(key.variant and key.view and _same_place(key, column) for key in findings.sums):
            moving = (choice for choice in CHOICES if choice.subset == "moving")
            found += [ablation_table(findings, column, choice) for choice in moving]
    return found


def _same_place(key: Key, column: Key) -> bool:
    return (key.site, key.horizon_s) == (column.site, column.horizon_s)


def rows(findings: Findings, sites: Mapping[str, Site], preset: str) -> list[Row]:
    """The long form: means, deviations over seeds, differences, and what is known of features."""
    found: list[Row] = []
    for key in findings.sums:
        site = sites[key.site]
        who: dict[str, Any] = {
            "data": site.judged_on,
            "predictor": key.predictor,
            "trained_on": site.data if key.view else "",
            "view": key.view,
            "recipe": _preset(key, preset),
            "chaining": key.chaining,
            "horizon_s": key.horizon_s,
        }
        base = findings.base(key)
        others = [(f" less {each.predictor}", each) for each in findings.references(key)]
        others += [] if base is None else [(" less the recipe", base)]
        for choice in CHOICES:
            found += _rows(who, choice, findings.numbers(key, choice))
            for ending, other in others:
                found += _rows(who, choice, findings.differences(key, other, choice), ending)
        for name, values in _feature_rows(findings, key).items():
            value = sum(values) / len(values)
            found.append(Row(**who, metric=name, value=value, n=len(values)))
    return found


def _rows(
    who: Mapping[str, Any], choice: Choice, numbers: Mapping[str, Number], ending: str = ""
) -> Iterator[Row]:
    for metric, (estimate, spread) in numbers.items():
        name = metric + ending
        where = {**who, **choice._asdict(), "n": estimate.n}
        low, high = estimate.low, estimate.high
        yield Row(**where, metric=name, value=estimate.value, low=low, high=high)
        if spread is not None:
            yield Row(**where, metric=f"{name}, deviation over seeds", value=spread)


def _feature_rows(findings: Findings, key: Key) -> dict[str, list[float]]:
    by_name: dict[str, list[float]] = {}
    for seed in findings.features.get(key, ()):
        for name, value in seed.items():
            by_name.setdefault(name, []).append(value)
    return by_name


def _preset(key: Key, preset: str) -> str:
    """As checkpoints call it: the recipe, and its change."""
    if not key.view:
        return key.variant
    return "+".join(part for part in (key.preset or preset, key.variant) if part)


def export(
    out: Path, found: Sequence[Row], shown: Sequence[Table], manifest: Mapping[str, Any]
) -> None:
    """Replaces the results in the table's folder, each file whole."""
    page = Console(record=True, width=PAGE_WIDTH, file=io.StringIO())
    for table in shown:
        page.print(table, "")
    text = page.export_text(clear=False)
    html = page.export_html(theme=DEFAULT_TERMINAL_THEME, code_format=PAGE)
    write_metrics(out, found)
    write_manifest(out, "table", **manifest)
    for name, content in ((TEXT, text), (REPORT, html)):
        with atomic_file(out / name) as partial:
            partial.write_text(content, encoding="utf-8")
