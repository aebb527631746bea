"""Tables of the results beside the numbers of the paper, and the files that they are written to.

The paper is F. Janjoš, M. Dolgov and J. M. Zöllner, "Self-Supervised Action-Space Prediction for
Automated Driving", IV 2021. Its table compares views and predictors on inD and rounD for horizons
of 3 s and 6 s. The tables here have the same shape: a line for each view and predictor, a column
for each site and horizon. The first site is compared with inD, the second one with rounD.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from rich import box
from rich.table import Table
from rich.terminal_theme import DEFAULT_TERMINAL_THEME
from rich.text import Text

from asp_env.console import page_console
from asp_env.evaluation.results import Row, write_manifest, write_metrics
from asp_env.evaluation.statistics import Estimate
from asp_env.files import atomic_file
from predictors.experiments.cells import Cell, Site
from predictors.experiments.errors import VIOLATIONS, Errors
from predictors.experiments.job import EvaluationJob, errors_path
from predictors.experiments.results import (
    CHOICES,
    FEATURES,
    NO_SEED,
    ORACLE,
    SUBSETS,
    Choice,
    Findings,
    Key,
    SeedMean,
    Sums,
    Training,
    best_features,
    excludes_zero,
)

PAPER_DATA = ("inD", "rounD")
PAPER_HORIZONS_S = (3.0, 6.0)
CAVEAT = "other data, not comparable in size"
PER_COORDINATE = "MAE and MSE are means over time and both coordinates, FDE is a distance"
"""Meaning of the errors. The paper's footnotes call MSE a mean L2 distance; its numbers are of
squares."""


class PaperErrors(NamedTuple):
    """Errors in the paper, in metres and square metres."""

    mae: float
    mse: float
    fde: float


PaperLine = tuple[PaperErrors, PaperErrors, PaperErrors, PaperErrors]


def _line(*errors: tuple[float, float, float]) -> PaperLine:
    first, second, third, fourth = (PaperErrors(*each) for each in errors)
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
"""The paper's table by view and predictor: inD 3 s, inD 6 s, rounD 3 s, rounD 6 s."""


def paper_errors(view: str, predictor: str, site: int, horizon_s: float) -> PaperErrors | None:
    """The errors of a cell of the paper's table; None if the table has no such cell.

    Args:
        view: name of the view.
        predictor: name of the predictor.
        site: 0 for inD, 1 for rounD.
        horizon_s: horizon in seconds.
    """
    line = PAPER.get((view, predictor))
    if line is None or site >= len(PAPER_DATA) or horizon_s not in PAPER_HORIZONS_S:
        return None
    return line[site * len(PAPER_HORIZONS_S) + PAPER_HORIZONS_S.index(horizon_s)]


SHOWN = ("MAE", "MSE", "FDE")
MARK = "*"
SIGNIFICANT = f"{MARK} the interval excludes zero"
COLUMN_WIDTH = 26
LABEL_WIDTH = 28


class Line(NamedTuple):
    """A line of a table, over all its columns."""

    view: str
    predictor: str
    recipe: str = ""
    variant: str = ""
    chaining: str = ""


def table_width(columns: int) -> int:
    """Width in characters of a table with this number of columns."""
    return LABEL_WIDTH + columns * COLUMN_WIDTH


def main_table(
    findings: Findings, sites: Sequence[str], columns: Sequence[Key], choice: Choice
) -> Table:
    """Errors by view and predictor (lines), site and horizon (columns), with those of the paper.

    Args:
        findings: results of the cells.
        sites: names of all sites; the first is compared with inD, the second with rounD.
        columns: one key of each site and horizon that is shown.
        choice: selection of modes and subset of snippets.
    """
    table = _table(
        f"{choice.subset} targets, {choice.selection}: MAE m / MSE m² / FDE m, mean over seeds\n"
        "FDE: [95 % interval over recordings] ± standard deviation over seeds"
    )
    table.caption = (
        f"paper: Janjoš et al. 2021 on {' and '.join(PAPER_DATA)}, mode not stated;\n{CAVEAT};\n"
        f"its SSP-ASP chains segments for 6 s by label matching, as {ORACLE} {MARK} does;\n"
        f"{MARK} uses the recorded future; {PER_COORDINATE}"
    )
    _add_columns(table, sites, columns)
    lines = _lines(findings, columns, lambda key: not key.variant)
    lines += [line for each in PAPER if (line := Line(*each)) not in lines]
    for view, members in _by_view(lines).items():
        _section(table, view)
        for line in members:
            cells = []
            for column in columns:
                cell = _means(findings.means(_key(line, column), choice))
                site = sites.index(column.site)
                paper = paper_errors(line.view, line.predictor, site, column.horizon_s)
                if paper is not None and not any(line[2:]):
                    errors = " / ".join(f"{value:.2f}" for value in paper)
                    cell.append(f"{chr(10) if cell else ''}paper {errors}", style="dim")
                cells.append(cell)
            table.add_row(_name(line), *cells)
    return table


def difference_table(
    findings: Findings, sites: Sequence[str], columns: Sequence[Key], choice: Choice
) -> Table:
    """Differences to the reference predictors by view and predictor, site and horizon.

    Args:
        findings: results of the cells.
        sites: names of all sites.
        columns: one key of each site and horizon that is shown.
        choice: selection of modes and subset of snippets.
    """
    table = _table(
        f"{choice.subset} targets, {choice.selection}: differences of MAE m / MSE m² / FDE m\n"
        "paired over snippets and seeds; FDE: [95 % interval over recordings]"
    )
    table.caption = f"{SIGNIFICANT}; {ORACLE} {MARK} uses the recorded future"
    _add_columns(table, sites, columns)
    for view, members in _by_view(_lines(findings, columns, lambda k: not k.variant)).items():
        _section(table, view)
        for line in members:
            keys = [_key(line, column) for column in columns]
            others = [{each.predictor: each for each in findings.references(key)} for key in keys]
            for name in dict.fromkeys(name for each in others for name in each):
                cells = [
                    _differences(findings.differences(key, each[name], choice))
                    if name in each
                    else ""
                    for key, each in zip(keys, others, strict=True)
                ]
                table.add_row(f"{_name(line)}\n  less {_upper(name)}", *cells)
    return table


def violation_table(
    findings: Findings, sites: Sequence[str], columns: Sequence[Key], subset: str
) -> Table:
    """Share of the modes that cannot be driven, by view and predictor, site and horizon.

    Args:
        findings: results of the cells.
        sites: names of all sites.
        columns: one key of each site and horizon that is shown.
        subset: one of `SUBSETS`.
    """
    table = _table(
        f"{subset} targets, all modes, mean over seeds: share of modes that are\n"
        "infeasible / off-road / overlap another agent, %; infeasible: [95 % interval]"
    )
    table.caption = (
        "infeasible: over 10.4 m/s² or 0.3 1/m between any two states (Waymax);\n"
        "MTP forecasts positions, the other networks actions of the bicycle model"
    )
    _add_columns(table, sites, columns)
    for view, members in _by_view(_lines(findings, columns, lambda k: not k.variant)).items():
        _section(table, view)
        for line in members:
            means = [findings.violations(_key(line, column), subset) for column in columns]
            table.add_row(_name(line), *(_shares(each) for each in means))
    return table


def ablation_table(findings: Findings, column: Key, choice: Choice) -> Table:
    """Differences of variants to their recipes, and feature statistics.

    Args:
        findings: results of the cells.
        column: one key of the site and horizon that is shown.
        choice: selection of modes and subset of snippets.
    """
    table = _table(
        f"{column.site}, {column.horizon_s:g} s, {choice.subset} targets, {choice.selection}\n"
        "differences of the variants to the recipe: MAE m / MSE m² / FDE m\n"
        "paired over snippets and seeds; FDE: [95 % interval over recordings]"
    )
    table.caption = (
        f"{SIGNIFICANT}\non validation: R² of ẑ, standard deviation and effective rank of z"
    )
    table.add_column("", no_wrap=True)
    for heading in ("less recipe", "FDE less DKM"):
        table.add_column(heading, no_wrap=True)
    for heading in ("R²", "std.", "rank"):
        table.add_column(heading, justify="right", no_wrap=True)
    lines = _lines(findings, [column], lambda key: key.view != "" and not key.chaining)
    with_variants = {line[:2] for line in lines if line.variant}
    for view, members in _by_view([line for line in lines if line[:2] in with_variants]).items():
        _section(table, view)
        predictors = [line.predictor for line in members]
        for line in sorted(members, key=lambda line: predictors.index(line.predictor)):
            key = _key(line, column)
            base = findings.base(key)
            to_recipe = Text("the recipe")
            if base is not None:
                to_recipe = _differences(findings.differences(key, base, choice))
            dkm = next((k for k in findings.references(key) if k.predictor == "dkm"), None)
            to_dkm = Text()
            if dkm is not None:
                to_dkm = _differences(findings.differences(key, dkm, choice), ("FDE",))
            table.add_row(_name(line), to_recipe, to_dkm, *_feature_cells(findings, key))
    return table


def training_table(
    findings: Findings, sites: Sequence[str], columns: Sequence[Key], budget: str
) -> Table:
    """Epochs and CPU time of the training, by view and predictor, site and horizon.

    Args:
        findings: results of the cells.
        sites: names of all sites.
        columns: one key of each site and horizon that is shown.
        budget: what the number of epochs follows from, in words.
    """
    table = _table(
        f"training, budget: {budget}\n"
        "prediction epochs + epochs of pre-training; mean CPU time of a seed"
    )
    table.caption = "with the runs for 3 s that runs for longer horizons start from"
    _add_columns(table, sites, columns)
    lines = _lines(findings, columns, lambda key: key in findings.training)
    for view, members in _by_view(lines).items():
        _section(table, view)
        for line in members:
            runs = [findings.training.get(_key(line, column), ()) for column in columns]
            table.add_row(_name(line), *(_training(each) for each in runs))
    return table


def _training(runs: Sequence[Training]) -> str:
    if not runs:
        return ""
    epochs = sorted({each.epochs for each in runs})
    text = str(epochs[0]) if len(epochs) == 1 else f"{epochs[0]} to {epochs[-1]}"
    text += f" + {runs[0].pretraining_epochs}" if runs[0].pretraining_epochs else ""
    times_s = [each.cpu_s for each in runs if each.cpu_s is not None]
    return f"{text}; {sum(times_s) / len(times_s):.0f} s" if times_s else text


def _table(title: str) -> Table:
    return Table(title=title, box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))


def _add_columns(table: Table, sites: Sequence[str], columns: Sequence[Key]) -> None:
    table.add_column("")
    for column in columns:
        site = sites.index(column.site)
        paper = f"\n(paper: {PAPER_DATA[site]})" if site < len(PAPER_DATA) else ""
        heading = f"{column.site}\n{column.horizon_s:g} s{paper}"
        table.add_column(heading, min_width=COLUMN_WIDTH - 1)


def _section(table: Table, view: str) -> None:
    if view:
        table.add_row(Text(view, style="bold"))


def _lines(
    findings: Findings, columns: Sequence[Key], is_shown: Callable[[Key], bool]
) -> list[Line]:
    """The lines that have results in any of the columns, in the order of the findings."""
    lines = (
        Line(key.view, key.predictor, key.recipe, key.variant, key.chaining)
        for key in findings.sums
        if any(_same_column(key, column) for column in columns) and is_shown(key)
    )
    return list(dict.fromkeys(lines))


def _by_view(lines: Sequence[Line]) -> dict[str, list[Line]]:
    by_view: dict[str, list[Line]] = {}
    for line in lines:
        by_view.setdefault(line.view, []).append(line)
    return by_view


def _key(line: Line, column: Key) -> Key:
    return column._replace(**line._asdict())


def _same_column(key: Key, column: Key) -> bool:
    return (key.site, key.horizon_s) == (column.site, column.horizon_s)


def _name(line: Line) -> str:
    parts = [_upper(line.predictor), line.recipe, line.variant, line.chaining]
    mark = f" {MARK}" if line.chaining == ORACLE else ""
    return " ".join(part for part in parts if part) + mark


def _upper(predictor: str) -> str:
    return predictor if predictor.startswith("constant") else predictor.upper()


def _means(means: Mapping[str, SeedMean]) -> Text:
    if not means:
        return Text()
    text = Text(" / ".join(f"{means[metric].estimate.value:.2f}" for metric in SHOWN))
    spread = means["FDE"].spread
    range_text = _interval(means["FDE"].estimate) + ("" if spread is None else f" ±{spread:.2f}")
    return text.append(f"\n{range_text.strip()}", style="dim") if range_text else text


def _shares(means: Mapping[str, SeedMean]) -> Text:
    """Shares in per cent, – where one does not apply."""
    if not means:
        return Text()
    shown = [means.get(violation) for violation in VIOLATIONS]
    text = Text(" / ".join("–" if m is None else f"{100 * m.estimate.value:.1f}" for m in shown))
    first = means.get(VIOLATIONS[0])
    if first is None or first.estimate.low is None or first.estimate.high is None:
        return text
    low, high = 100 * first.estimate.low, 100 * first.estimate.high
    return text.append(f"\n[{low:.1f}, {high:.1f}]", style="dim")


def _differences(means: Mapping[str, SeedMean], shown: Sequence[str] = SHOWN) -> Text:
    if not means:
        return Text()
    text = Text()
    for number, metric in enumerate(shown):
        estimate = means[metric].estimate
        significant = excludes_zero(estimate)
        style = ("green" if estimate.value < 0 else "red") if significant else ""
        text.append(" / " if number else "")
        text.append(f"{estimate.value:+.2f}{MARK if significant else ''}", style=style)
    interval = _interval(means["FDE"].estimate)
    return text.append(f"\n{interval}", style="dim") if interval else text


def _interval(estimate: Estimate) -> str:
    if estimate.low is None or estimate.high is None:
        return ""
    return f"[{estimate.low:.2f}, {estimate.high:.2f}]"


def _feature_cells(findings: Findings, key: Key) -> list[str]:
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
"""Width of the tables in both files, in characters."""

PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="UTF-8"><title>The paper's table</title>
<style>{stylesheet} body {{ color: {foreground}; background: {background}; }}
pre {{ font-family: ui-monospace, Menlo, Consolas, monospace; line-height: 1.25; }}</style></head>
<body><h1>The table of Janjoš et al. (2021) on other data</h1><pre>{code}</pre></body></html>
"""


def read_findings(
    jobs: Mapping[Cell, EvaluationJob], training: Mapping[Cell, Training] = MappingProxyType({})
) -> Findings:
    """Reads the results of the cells whose jobs are done.

    Args:
        jobs: the evaluations of the cells.
        training: the training of the cells.

    Raises:
        AspEnvError: cells of one site and horizon were evaluated on different snippets.
    """
    sums: dict[Key, dict[int, Sums]] = {}
    features: dict[Key, list[dict[str, float]]] = {}
    trainings: dict[Key, list[Training]] = {}
    for cell, job in jobs.items():
        if not job.done:
            continue
        seed = NO_SEED if cell.seed is None else cell.seed
        for chaining in ("", *job.chainings):
            path = errors_path(job.errors, chaining)
            if path.exists():
                sums.setdefault(Key.of(cell, chaining), {})[seed] = Sums.of(Errors.load(path))
        if job.run:
            features.setdefault(Key.of(cell), []).append(best_features(Path(job.run)))
        if cell in training:
            trainings.setdefault(Key.of(cell), []).append(training[cell])
    return Findings(sums=sums, features=features, training=trainings)


def tables(
    findings: Findings, sites: Sequence[Site], width: int, *, budget: str = "epochs"
) -> list[Table]:
    """All tables that have results.

    Args:
        findings: results of the cells.
        sites: all sites.
        width: width in characters. If a table with all columns is wider, there is one for each
            site.
        budget: what the number of epochs follows from, in words.
    """
    by_column = {(key.site, key.horizon_s): key for key in findings.sums}
    names = [site.name for site in sites]
    order = sorted(by_column, key=lambda column: (names.index(column[0]), column[1]))
    columns = [by_column[column] for column in order]
    if not columns:
        return []
    if table_width(len(columns)) <= width:
        groups = [columns]
    else:
        groups = [[column for column in columns if column.site == name] for name in names]
    shown = []
    for choice in CHOICES:
        for group in filter(None, groups):
            shown.append(main_table(findings, names, group, choice))
            shown.append(difference_table(findings, names, group, choice))
    if any(findings.violations(key, subset) for key in findings.sums for subset in SUBSETS):
        shown += [violation_table(findings, names, g, SUBSETS[0]) for g in groups if g]
    for column in columns:
        if any(key.variant and key.view and _same_column(key, column) for key in findings.sums):
            moving = (choice for choice in CHOICES if choice.subset == "moving")
            shown += [ablation_table(findings, column, choice) for choice in moving]
    if findings.training:
        shown += [training_table(findings, names, group, budget) for group in filter(None, groups)]
    return shown


def rows(findings: Findings, sites: Mapping[str, Site], recipe: str) -> list[Row]:
    """Lines of `metrics.csv`: means, deviations over seeds, differences, features, epochs.

    Args:
        findings: results of the cells.
        sites: sites by name.
        recipe: the table's recipe.
    """
    lines: list[Row] = []
    for key in findings.sums:
        site = sites[key.site]
        common: dict[str, Any] = {
            "data": site.evaluated_on,
            "predictor": key.predictor,
            "trained_on": site.data if key.view else "",
            "view": key.view,
            "recipe": _full_recipe(key, recipe),
            "chaining": key.chaining,
            "horizon_s": key.horizon_s,
        }
        base = findings.base(key)
        others = [(f" less {each.predictor}", each) for each in findings.references(key)]
        others += [] if base is None else [(" less the recipe", base)]
        for choice in CHOICES:
            lines += _rows(common, choice, findings.means(key, choice))
            for suffix, other in others:
                lines += _rows(common, choice, findings.differences(key, other, choice), suffix)
        for subset in SUBSETS:
            every_mode = Choice(selection="", subset=subset)
            lines += _rows(common, every_mode, findings.violations(key, subset))
        for name, values in _features_by_name(findings, key).items():
            value = sum(values) / len(values)
            lines.append(Row(**common, metric=name, value=value, n=len(values)))
        if runs := findings.training.get(key):
            for name, epochs in (
                ("prediction epochs", [each.epochs for each in runs]),
                ("epochs of pre-training", [each.pretraining_epochs for each in runs]),
            ):
                value = sum(epochs) / len(runs)
                lines.append(Row(**common, metric=name, value=value, n=len(runs)))
    return lines


def _rows(
    common: Mapping[str, Any], choice: Choice, means: Mapping[str, SeedMean], suffix: str = ""
) -> Iterator[Row]:
    for metric, (estimate, spread) in means.items():
        name = metric + suffix
        fields = {**common, **choice._asdict(), "n": estimate.n}
        low, high = estimate.low, estimate.high
        yield Row(**fields, metric=name, value=estimate.value, low=low, high=high)
        if spread is not None:
            yield Row(**fields, metric=f"{name}, deviation over seeds", value=spread)


def _features_by_name(findings: Findings, key: Key) -> dict[str, list[float]]:
    by_name: dict[str, list[float]] = {}
    for seed in findings.features.get(key, ()):
        for name, value in seed.items():
            by_name.setdefault(name, []).append(value)
    return by_name


def _full_recipe(key: Key, recipe: str) -> str:
    """Recipe and variant, as in checkpoints."""
    if not key.view:
        return key.variant
    return "+".join(part for part in (key.recipe or recipe, key.variant) if part)


def export(
    out: Path, lines: Sequence[Row], shown: Sequence[Table], manifest: Mapping[str, Any]
) -> None:
    """Replaces the result files in the folder of the table, each of them at once.

    Args:
        out: folder of the table.
        lines: lines of `metrics.csv`.
        shown: tables of `report.html` and `table.txt`.
        manifest: content of `manifest.json`.
    """
    page = page_console(PAGE_WIDTH)
    for table in shown:
        page.print(table, "")
    text = page.export_text(clear=False)
    html = page.export_html(theme=DEFAULT_TERMINAL_THEME, code_format=PAGE)
    write_metrics(out, lines)
    write_manifest(out, "table", **manifest)
    for name, content in ((TEXT, text), (REPORT, html)):
        with atomic_file(out / name) as partial:
            partial.write_text(content, encoding="utf-8")
