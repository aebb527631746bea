"""Tables for terminals, 80 columns wide; all intervals are in `metrics.csv` and the report."""

from collections.abc import Collection, Sequence

from rich import box
from rich.table import Table

from asp_env.evaluation.results import Row
from asp_env.evaluation.selection import short_names

OPEN_LOOP = {"FDE": "FDE m", "FDE / constant velocity": "FDE / const. vel."}
OPEN_LOOP_SHORT = {"ADE": "ADE m", "miss": "miss"}
MORE = {
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
DRIVING = {"score": "score"}
DRIVING_SHORT = {
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
}


ROOMY = 6
"""More metrics than this stand closer together."""

MARK = " *"
"""Stands behind who was handed the recorded future."""


def open_loop_tables(rows: Sequence[Row], privileged: Collection[str] = ()) -> list[Table]:
    """Predictor by metric for moving targets, or all if none moves; * knows the future.

    A table for either selection, and one of the other metrics.
    """
    subset = "moving" if any(row.subset == "moving" for row in rows) else "all"
    short = short_names([row.predictor for row in rows])
    groups: dict[str, dict[str, dict[str, Row]]] = {}
    more: dict[str, dict[str, Row]] = {}
    for row in rows:
        if row.subset != subset:
            continue
        name = short[row.predictor] + (MARK if row.predictor in privileged else "")
        if row.selection:
            members = groups.setdefault(row.selection, {})
            members.setdefault(name, {})[row.metric] = row
        heading = MORE.get((row.selection, row.metric))
        if heading is not None:
            more.setdefault(name, {})[heading] = row
    tables = []
    for selection, members in groups.items():
        table = _table(f"{subset} targets, {selection}, 95 % intervals over recordings")
        _fill(table, "predictor", members, OPEN_LOOP, OPEN_LOOP_SHORT)
        tables.append(table)
    if more:
        table = _table(f"{subset} targets, ₃: best of 3; from NLL on all modes together")
        _fill(table, "predictor", more, {}, {name: name for name in MORE.values()})
        tables.append(table)
    return tables


def driving_table(rows: Sequence[Row], privileged: Collection[str], shown: Sequence[str]) -> Table:
    """Driver by the shown metrics over all scenarios, and score, if there is one.

    The expert, which is the noise floor, stands first; * knows the future.
    """
    rules = " and ".join(dict.fromkeys(row.rules for row in rows))
    table = _table(f"driving by {rules}, mean per episode, 95 % interval over recordings")
    if len(shown) > ROOMY:
        table.padding = 0
    short = short_names([row.predictor for row in rows])
    members: dict[str, dict[str, Row]] = {}
    for row in rows:
        if row.subset != "all":
            continue
        name = " + ".join(part for part in (row.planner, short[row.predictor]) if part)
        mark = MARK if row.planner in privileged or row.predictor in privileged else ""
        members.setdefault(name + mark, {})[row.metric] = row
    scored = DRIVING if any(row.metric in DRIVING for row in rows) else {}
    _fill(table, "driver", members, scored, {name: DRIVING_SHORT[name] for name in shown})
    return table


def _table(title: str) -> Table:
    return Table(
        title=title,
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 1, 0, 0),
    )


def _fill(
    table: Table,
    who: str,
    members: dict[str, dict[str, Row]],
    with_interval: dict[str, str],
    without: dict[str, str],
) -> None:
    table.add_column(who, min_width=18)
    if any(name.endswith(MARK) for name in members):
        table.caption = f"{MARK.strip()} knows the recorded future"
    counted = ["n"] if with_interval else []
    for heading in (*with_interval.values(), *without.values(), *counted):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, metrics in members.items():
        wide = (_cell(metrics.get(metric), interval=True) for metric in with_interval)
        slim = (_cell(metrics.get(metric), interval=False) for metric in without)
        counts = [str(max(row.n for row in metrics.values()))] if with_interval else []
        table.add_row(name, *wide, *slim, *counts)


def _cell(row: Row | None, *, interval: bool) -> str:
    if row is None:
        return ""
    if not interval or row.low is None or row.high is None:
        return f"{row.value:.2f}"
    return f"{row.value:.2f} [{row.low:.2f}, {row.high:.2f}]"
