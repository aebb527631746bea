"""Tables for terminals."""

from collections.abc import Sequence

from rich.table import Table

from asp_env.evaluation.output import Row

OPEN_LOOP = ("FDE", "FDE / constant velocity", "ADE", "MAE", "MSE", "miss")
DRIVING = (
    "score",
    "no at-fault collision",
    "no collision",
    "on road",
    "TTC",
    "progress",
    "comfort",
    "log divergence",
)


def open_loop_table(rows: Sequence[Row]) -> Table:
    """Predictor by metric, for every subset and selection."""
    table = Table(title="open loop: errors in m, [95 % interval over recordings]")
    for name in ("subset", "selection", "predictor", *OPEN_LOOP, "n"):
        table.add_column(name)
    groups: dict[tuple[str, str, str], dict[str, Row]] = {}
    for row in rows:
        groups.setdefault((row.subset, row.selection, row.predictor), {})[row.metric] = row
    section = None
    for key in sorted(groups, key=lambda key: (key[0], key[1] != "most-probable")):
        if section not in (None, key[:2]):
            table.add_section()
        section = key[:2]
        metrics = groups[key]
        table.add_row(*key, *(_cell(metrics.get(name)) for name in OPEN_LOOP), _count(metrics))
    return table


def driving_table(rows: Sequence[Row]) -> Table:
    """Driver by metric; the expert, which is the noise floor, first."""
    table = Table(title="closed loop: mean per episode, [95 % interval over recordings]")
    for name in ("planner", "predictor", *DRIVING, "episodes"):
        table.add_column(name)
    groups: dict[tuple[str, str], dict[str, Row]] = {}
    for row in rows:
        groups.setdefault((row.planner, row.predictor), {})[row.metric] = row
    for key, metrics in groups.items():
        table.add_row(*key, *(_cell(metrics.get(name)) for name in DRIVING), _count(metrics))
    return table


def _cell(row: Row | None) -> str:
    if row is None:
        return "-"
    if row.low is None or row.high is None:
        return f"{row.value:.2f}"
    return f"{row.value:.2f} [{row.low:.2f}, {row.high:.2f}]"


def _count(metrics: dict[str, Row]) -> str:
    return str(max(row.n for row in metrics.values()))
