"""What is written and printed of findings: long form, page, and tables in the paper's shape."""

import io
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.terminal_theme import DEFAULT_TERMINAL_THEME

from asp_env.evaluation.output import Row, write_manifest, write_metrics
from asp_env.evaluation.paper_table import printed
from asp_env.evaluation.paper_table.cells import Cell
from asp_env.evaluation.paper_table.errors import Errors
from asp_env.evaluation.paper_table.results import (
    CHOICES,
    NO_SEED,
    Choice,
    Findings,
    Key,
    Number,
    Sums,
    best_features,
)
from asp_env.evaluation.paper_table.sites import Site
from asp_env.evaluation.paper_table.worker import Judging, errors_path

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
    if printed.width_for(len(columns)) <= width:
        groups = [columns]
    else:
        groups = [[c for c in columns if c.site == name] for name in names]
    found = []
    for choice in CHOICES:
        for group in filter(None, groups):
            found.append(printed.main_table(findings, names, group, choice))
            found.append(printed.difference_table(findings, names, group, choice))
    for column in columns:
        if any(key.variant and key.view and _same_place(key, column) for key in findings.sums):
            moving = (choice for choice in CHOICES if choice.subset == "moving")
            found += [printed.ablation_table(findings, column, choice) for choice in moving]
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
            "preset": _preset(key, preset),
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
        for name, values in _features(findings, key).items():
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


def _features(findings: Findings, key: Key) -> dict[str, list[float]]:
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


def write(
    out: Path, found: Sequence[Row], shown: Sequence[Table], manifest: Mapping[str, Any]
) -> None:
    """Replaces the results in the table's folder, each file whole."""
    with tempfile.TemporaryDirectory(dir=out, prefix=".fresh") as aside:
        folder = Path(aside)
        write_metrics(folder, found)
        write_manifest(folder, "table", **manifest)
        page = Console(record=True, width=PAGE_WIDTH, file=io.StringIO())
        for table in shown:
            page.print(table, "")
        text = page.export_text(clear=False)
        (folder / TEXT).write_text(text, encoding="utf-8")
        html = page.export_html(theme=DEFAULT_TERMINAL_THEME, code_format=PAGE)
        (folder / REPORT).write_text(html, encoding="utf-8")
        for path in list(folder.iterdir()):
            os.replace(path, out / path.name)
