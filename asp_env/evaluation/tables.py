"""Result tables for terminals of 80 columns. All intervals are in `metrics.csv` and the report."""

from collections.abc import Collection, Iterator, Mapping, Sequence

from rich import box
from rich.table import Table

from asp_env.evaluation.ladder import is_under_test
from asp_env.evaluation.results import ORACLE_SHARE, SCORE, Row, difference_of
from asp_env.evaluation.selection import short_names
from asp_env.evaluation.verdicts import headline, share_text, verdict_text

Headings = Mapping[str, str]
"""Column headings by metric."""

FORECAST_INTERVALS: Headings = {"FDE": "FDE m", "FDE / constant velocity": "FDE / const. vel."}
FORECAST_VALUES: Headings = {"ADE": "ADE m", "miss": "miss"}
FORECAST_MORE = {
    ("most-probable", "MAE"): "MAE",
    ("most-probable", "MSE"): "MSE",
    ("best-of-3", "MAE"): "MAE₃",
    ("best-of-3", "MSE"): "MSE₃",
    ("", "NLL"): "NLL",
    ("", "ECE"): "ECE",
    ("", "off-road"): "off",
    ("", "overlap"): "over",
    ("", "infeasible"): "infeas",
}
"""Headings of the last open-loop table, by selection and metric."""

REGRET_INTERVALS: Headings = {"regret": "regret", "regret removed": "removed"}
REGRET_VALUES: Headings = {"log1p regret": "log1p"}
DRIVING_INTERVALS: Headings = {SCORE: "score"}
DRIVING_VALUES: Headings = {
    "no collision": "no coll.",
    "no at-fault collision": "no fault",
    "on road": "road",
    "on mapped road": "road",
    "direction": "dir.",
    "right way": "way",
    "feasible": "feas.",
    "TTC": "TTC",
    "progress": "prog",
    "speed": "speed",
    "comfort": "comf",
    "log divergence": "to log m",
    "no near miss": "no near",
    "near misses": "near",
    "min TTC": "TTC s",
    "required deceleration": "brake",
    "safety margin": "margin",
    "uncomfortable ticks": "harsh",
    "smoothness": "smooth",
    "time lost": "lost s",
    "driving cost": "cost s",
}

SUBSETS = ("all", "interactive")
"""Subsets of scenarios that are printed, as far as they occur."""

MAX_PADDED_COLUMNS = 5
"""With more metrics than this, columns have no padding, so that a table fits 80 columns."""

MARK = " *"
"""Follows the name of a privileged predictor or planner."""


def open_loop_tables(rows: Sequence[Row], privileged: Collection[str] = ()) -> list[Table]:
    """A table for each selection of modes and one of the other metrics, by predictor.

    The tables are of the moving targets, or of all targets if none moves.

    Args:
        rows: open-loop rows of `metrics.csv`.
        privileged: full names of the privileged predictors, which are marked.
    """
    subset = "moving" if any(row.subset == "moving" for row in rows) else "all"
    short = short_names([row.predictor for row in rows])
    by_selection: dict[str, dict[str, dict[str, Row]]] = {}
    more: dict[str, dict[str, Row]] = {}
    for row in rows:
        if row.subset != subset:
            continue
        name = short[row.predictor] + _runs(row) + (MARK if row.predictor in privileged else "")
        if row.selection:
            lines = by_selection.setdefault(row.selection, {})
            lines.setdefault(name, {})[row.metric] = row
        heading = FORECAST_MORE.get((row.selection, row.metric))
        if heading is not None:
            more.setdefault(name, {})[heading] = row
    tables = []
    for selection, lines in by_selection.items():
        table = _table(f"{subset} targets, {selection} mode, 95 % intervals over recordings")
        _fill(table, "predictor", lines, FORECAST_INTERVALS, FORECAST_VALUES)
        tables.append(table)
    if more:
        table = _table(f"{subset} targets; ₃: best of 3 modes; NLL and later columns: all modes")
        _fill(table, "predictor", more, {}, {name: name for name in FORECAST_MORE.values()})
        tables.append(table)
    return tables


def regret_tables(
    rows: Sequence[Row], privileged: Collection[str] = (), *, planner: str
) -> list[Table]:
    """Planning regret by predictor, a table for each of `SUBSETS` that occurs.

    Args:
        rows: open-loop rows of `metrics.csv`.
        privileged: full names of the privileged predictors, which are marked.
        planner: name of the planner.
    """
    shown = {*REGRET_INTERVALS, *REGRET_VALUES}
    short = short_names([row.predictor for row in rows])
    tables = []
    for subset in SUBSETS:
        lines: dict[str, dict[str, Row]] = {}
        for row in rows:
            if row.subset == subset and row.metric in shown:
                name = (
                    short[row.predictor]
                    + _runs(row)
                    + (MARK if row.predictor in privileged else "")
                )
                lines.setdefault(name, {})[row.metric] = row
        if lines:
            title = f"planning regret, {planner}, {subset} scenarios"
            tables.append(_table(title))
            _fill(tables[-1], "predictor", lines, REGRET_INTERVALS, REGRET_VALUES)
    return tables


def driving_tables(
    rows: Sequence[Row], privileged: Collection[str], shown: Sequence[str]
) -> list[Table]:
    """For each of `SUBSETS`, the differences to the reference and the driving metrics, by method.

    If all scenarios are interactive, they are shown once.

    Args:
        rows: closed-loop rows of `metrics.csv`.
        privileged: names of the privileged planners and predictors, which are marked.
        shown: metrics to show after the score.
    """
    tables = []
    for subset in _different_subsets(rows):
        chosen = [row for row in rows if row.subset == subset]
        tables += _difference_tables(chosen, privileged)
        tables.append(driving_table(chosen, privileged, shown, subset=subset))
    return tables


def _different_subsets(rows: Sequence[Row]) -> list[str]:
    """Those of `SUBSETS` that occur; of subsets of all the same scenarios, the last."""
    counts = {name: max((r.n for r in rows if r.subset == name), default=0) for name in SUBSETS}
    last = {count: name for name, count in counts.items() if count > 0}
    return [*last.values()]


def headlines(rows: Sequence[Row], privileged: Collection[str]) -> list[str]:
    """A sentence for each predictor under test, of the last of `SUBSETS` that occurs.

    Args:
        rows: closed-loop rows of `metrics.csv`.
        privileged: names of the privileged planners and predictors.
    """
    subset = next((name for name in reversed(SUBSETS) if any(r.subset == name for r in rows)), "")
    chosen = [row for row in rows if row.subset == subset]
    shares = {(row.planner, row.predictor): row for row in chosen if row.metric == ORACLE_SHARE}
    return [
        f"{_scenarios(subset, row.n)}: ".capitalize()
        + headline(name, pair[1], _signed(row), row, shares.get((row.planner, row.predictor)))
        for name, row in _by_method(chosen, privileged, with_planner=False)
        if (pair := difference_of(row.metric)) is not None
        and pair[0] == SCORE
        and is_under_test(row.predictor, privileged=row.predictor in privileged)
    ]


def driving_table(
    rows: Sequence[Row],
    privileged: Collection[str],
    shown: Sequence[str],
    *,
    subset: str = "all",
) -> Table:
    """Driving metrics over the scenarios of a subset, by method.

    Args:
        rows: closed-loop rows of `metrics.csv`.
        privileged: names of the privileged planners and predictors, which are marked.
        shown: metrics to show after the score.
        subset: `all` or a tag.
    """
    rules = " and ".join(dict.fromkeys(row.rules for row in rows))
    count = max((row.n for row in rows if row.subset == subset), default=0)
    table = _table(f"{_scenarios(subset, count)}: driving by {rules}, mean [95 % interval]")
    if len(shown) > MAX_PADDED_COLUMNS:
        table.padding = 0
    lines: dict[str, dict[str, Row]] = {}
    for name, row in _by_method(rows, privileged):
        if row.subset == subset:
            lines.setdefault(name, {})[row.metric] = row
    scored = DRIVING_INTERVALS if any(row.metric in DRIVING_INTERVALS for row in rows) else {}
    _fill(table, "method", lines, scored, {name: DRIVING_VALUES[name] for name in shown})
    return table


def _difference_tables(rows: Sequence[Row], privileged: Collection[str]) -> list[Table]:
    """The differences of the score to the reference; none without a score or a reference."""
    planners = list(dict.fromkeys(row.planner for row in rows if row.predictor))
    lines: dict[str, dict[str, Row]] = {}
    for name, row in _by_method(rows, privileged, with_planner=len(planners) > 1):
        lines.setdefault(name, {})[row.metric] = row
    differences = {
        row.metric: (pair[1], row)
        for row in rows
        if (pair := difference_of(row.metric)) is not None and pair[0] == SCORE
    }
    return [
        _difference_table(
            f"{_scenarios(row.subset, row.n)}, {' and '.join(planners)}: "
            f"score less that of {reference}",
            metric,
            lines,
        )
        for metric, (reference, row) in differences.items()
    ]


def _difference_table(title: str, metric: str, lines: Mapping[str, Mapping[str, Row]]) -> Table:
    table = _table(title)
    has_shares = any(ORACLE_SHARE in metrics for metrics in lines.values())
    table.add_column("predictor", min_width=16)
    table.add_column("difference", justify="right", no_wrap=True)
    table.add_column("MDE", justify="right", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    if has_shares:
        table.add_column("oracle share", justify="right", no_wrap=True)
    for name, metrics in lines.items():
        row = metrics.get(metric)
        if row is None:
            continue
        share = metrics.get(ORACLE_SHARE)
        table.add_row(
            name,
            _signed(row),
            "" if row.mde is None else f"{row.mde:.3f}",
            verdict_text(row).replace(" (", "\n").replace(" needed)", "").rstrip(")"),
            *([share_text(share) if share else ""] if has_shares else []),
        )
    table.caption = "MDE: smallest difference that these scenarios resolve with 80 % power"
    return table


def _signed(row: Row) -> str:
    if row.low is None or row.high is None:
        return f"{row.value:+.3f}"
    return f"{row.value:+.3f} [{row.low:.3f}, {row.high:.3f}]"


def _scenarios(subset: str, count: int) -> str:
    return f"all {count} scenarios" if subset == "all" else f"{count} {subset} scenarios"


def _by_method(
    rows: Sequence[Row], privileged: Collection[str], *, with_planner: bool = True
) -> Iterator[tuple[str, Row]]:
    """Every row with the name of its method, its number of runs and its mark."""
    short = short_names([row.predictor for row in rows])
    for row in rows:
        parts = [row.planner, short[row.predictor]]
        name = " + ".join(part for part in parts if part)
        if not with_planner and row.predictor:
            name = short[row.predictor]
        mark = MARK if row.planner in privileged or row.predictor in privileged else ""
        yield f"{name}{_runs(row)}{mark}", row


def _runs(row: Row) -> str:
    return f" ({row.runs} runs)" if row.runs is not None and row.runs > 1 else ""


def _table(title: str) -> Table:
    return Table(
        title=title,
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 1, 0, 0),
    )


def _fill(
    table: Table,
    first_heading: str,
    lines: Mapping[str, Mapping[str, Row]],
    with_interval: Headings,
    without_interval: Headings,
) -> None:
    """Adds columns and lines.

    Args:
        table: an empty table.
        first_heading: heading of the names.
        lines: rows by name and metric.
        with_interval: metrics shown with their intervals; they are followed by the count n.
        without_interval: metrics shown without.
    """
    table.add_column(first_heading, min_width=18)
    if any(name.endswith(MARK) for name in lines):
        table.caption = f"{MARK.strip()} uses the recorded future"
    count_heading = ["n"] if with_interval else []
    for heading in (*with_interval.values(), *without_interval.values(), *count_heading):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, metrics in lines.items():
        wide = (_cell(metrics.get(metric), interval=True) for metric in with_interval)
        narrow = (_cell(metrics.get(metric), interval=False) for metric in without_interval)
        count = [str(max(row.n for row in metrics.values()))] if with_interval else []
        table.add_row(name, *wide, *narrow, *count)


def _cell(row: Row | None, *, interval: bool) -> str:
    if row is None:
        return ""
    if not interval or row.low is None or row.high is None:
        return f"{row.value:.2f}"
    return f"{row.value:.2f} [{row.low:.2f}, {row.high:.2f}]"
