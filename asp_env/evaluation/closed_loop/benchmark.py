"""`asp-env benchmark`: one row per method on frozen scenarios, to be put beside others' rows.

A row is comparable with another if both have the same hash of scenarios, rules, traffic and
horizon. The hash covers the content of the recordings, and the ego, start, length and seed of every
scenario.
"""

import csv
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from importlib import metadata
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich import box
from rich.table import Table

from asp_env import registry
from asp_env.arguments import check_jobs, check_max_scenarios
from asp_env.console import text_console
from asp_env.data.cache import digest
from asp_env.data.scenarios.selection import save_scenarios
from asp_env.data.source import open_data, source_folder
from asp_env.errors import AspEnvError, unknown_name
from asp_env.evaluation.closed_loop.comparison import EXPERT
from asp_env.evaluation.closed_loop.drive import ClosedLoopResult, Drive, drive, save_rollouts
from asp_env.evaluation.closed_loop.scenario_table import write_scenario_table
from asp_env.evaluation.closed_loop.tidy_table import check_parquet_possible, write_tidy_table
from asp_env.evaluation.ladder import BASELINE, ORACLE
from asp_env.evaluation.report import check_report_possible, write_report
from asp_env.evaluation.results import (
    FALLBACK,
    HEADROOM,
    ORACLE_SHARE,
    SCORE,
    Row,
    difference_name,
    fallback_sentences,
    write_manifest,
    write_metrics,
)
from asp_env.evaluation.selection import short_names, with_fallback
from asp_env.evaluation.statistics import is_resolved
from asp_env.evaluation.verdicts import share_text
from asp_env.files import atomic_file, atomic_folder
from asp_env.metrics.driving.rules import DEFAULT_RULES, find_rules
from asp_env.planning.planner import load_planner

SUITE = "intersection-v1"
"""The suite by default."""

PLANNER = "contingency"
"""Planner of a method that is named by its predictor alone."""

FROZEN = "scenarios.json"
"""List of scenarios in the folder of the data, which is used by default."""

ESTIMATES = ("score", "difference", "oracle_share", "headroom", "fallback")
"""Fields of a row that have an interval."""

HASH_DIGITS = 12
"""Digits of hashes that are printed; the files have all of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Benchmark:
    """Drive the frozen scenarios of a suite: one row per method, comparable with others' rows."""

    methods: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="METHOD …")]
    """PLANNER+PREDICTOR, such as 'pdm+ffw-asp:runs/0', a predictor alone,
    which drives with contingency, or a planner without forecasts."""
    out: Path
    """Folder to write; it must not exist, or be empty."""
    suite: str | None = None
    """Suite by name: intersection-v1, roundabout-v1 or highway-v1.
    The default is intersection-v1."""
    data: str | None = None
    """Data of your own instead of a suite, as for asp-env drive."""
    scenarios: Annotated[str, tyro.conf.arg(metavar="FILTER|FILE")] = ""
    """scenarios.json of a run, or a filter such as interactive.
    The default is the scenarios.json in the folder of the data."""
    controls: bool = True
    """Drive the whole ladder of controls, which the oracle share needs;
    otherwise constant velocity and the oracle alone."""
    max_scenarios: int | None = None
    """Largest number of scenarios, at even spacing; the hash is then another."""
    rules: str = DEFAULT_RULES
    """Driving rules: nuplan, pdms, waymax, strict or graded."""
    fallback: bool = False
    """Guard every trained predictor: where a scene lies outside
    of what it learned, its forecast is blended to constant
    velocity. As naming it guarded:NAME:RUN."""
    parquet: bool = False
    """Also write scenarios.parquet, with a row per scenario, method, run and
    metric; needs the extra parquet."""
    jobs: int = 1
    """Number of processes that drive. The results do not depend on it."""

    def run(self) -> None:
        """Drives, writes the folder and prints the rows.

        Raises:
            AspEnvError: an option or the data are bad, or a package is missing.
        """
        check_report_possible()
        if self.parquet:
            check_parquet_possible()
        with atomic_folder(self.out) as folder:
            rows, privileged = _write(self, folder)
        console = text_console()
        console.print(benchmark_table(rows, privileged))
        first = rows[0]
        console.print(
            f"{first.data}: {first.n} scenarios of {first.places} locations, hash "
            f"{first.scenarios_hash[:HASH_DIGITS]}; rules {first.rules}, traffic {first.traffic}, "
            f"horizon {first.horizon_s:g} s, asp-env {first.version}"
        )
        for row in rows:
            if row.fallback is not None:
                shares = {row.predictor: row.fallback.value}
                console.print(*fallback_sentences(shares, "forecasts"))
        console.print(f"wrote {self.out}/benchmark.csv and report.html")


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchmarkRow:
    """One line of `benchmark.csv`: a method on a set of scenarios. Undefined cells are empty."""

    data: str
    """`suite:NAME`, or the data as given."""
    scenarios_hash: str
    """SHA-256 of the list of scenarios, which names the content of their recordings."""
    method: str
    """The method as given."""
    planner: str
    predictor: str
    runs: int | None
    """Number of training runs that are averaged."""
    score: Row | None
    """The score of the rules."""
    difference: Row | None
    """Score less that of constant velocity with the same planner, paired by scenario."""
    oracle_share: Row | None
    headroom: Row | None
    fallback: Row | None
    """Share of the forecasts that a guard has blended to constant velocity."""
    n: int
    """Number of scenarios."""
    places: int
    """Number of locations of these scenarios."""
    rules: str
    traffic: str
    horizon_s: float
    dt_s: float
    version: str
    """Version of asp-env."""


def parse_method(name: str) -> tuple[str, str]:
    """The planner and the predictor of a method.

    Args:
        name: `PLANNER+PREDICTOR`, a predictor, or a planner without forecasts.

    Returns:
        The name of the planner, and that of the predictor, which is empty for a planner alone.

    Raises:
        AspEnvError: nothing is named, the planner is unknown, or the part after the plus sign is
            missing.
    """
    planners = registry.names("planners")
    head, plus, predictor = name.partition("+")
    plug = head.partition(":")[0]
    if not plug:
        raise AspEnvError(f"method {name!r}: expected PLANNER+PREDICTOR, a predictor or a planner")
    if plus and plug not in (*planners, *registry.names("predictors")):
        raise unknown_name("planner", plug, planners)
    if plus and plug in planners:
        if not predictor:
            raise AspEnvError(f"method {name!r}: expected PLANNER+PREDICTOR, such as {head}+oracle")
        return head, predictor
    if name.partition(":")[0] in planners and name not in registry.names("predictors"):
        return name, ""
    return PLANNER, name


def benchmark(config: Benchmark) -> tuple[list[BenchmarkRow], list[ClosedLoopResult]]:
    """Drives all methods; writes nothing.

    Args:
        config: the options; its `out` is not used.

    Returns:
        A row for each method, without the hash of the scenarios, in the order of the methods; and
        the result of every planner.

    Raises:
        AspEnvError: an option or the data are bad, or a worker process ended.
    """
    if not config.methods:
        raise AspEnvError("no METHOD: expected at least one, such as constant-velocity")
    # The traffic of a suite takes minutes to make; what is bad is refused before.
    find_rules(config.rules)
    check_jobs(config.jobs)
    check_max_scenarios(config.max_scenarios)
    data = _data(config)
    parsed = {name: parse_method(name) for name in config.methods}
    if config.fallback:
        parsed = {
            name: (planner, predictor and with_fallback([predictor])[0])
            for name, (planner, predictor) in parsed.items()
        }
    for planner, predictor in parsed.values():
        needs = load_planner(planner).uses_forecasts
        if needs != bool(predictor):
            wanted = f"{planner}+PREDICTOR" if needs else f"{planner} alone"
            raise AspEnvError(f"planner {planner}: expected the method {wanted}")
    scenarios = config.scenarios or _frozen(data)
    results: dict[str, ClosedLoopResult] = {}
    for planner in dict.fromkeys(planner for planner, _ in parsed.values()):
        named = [predictor for each, predictor in parsed.values() if each == planner and predictor]
        rungs = [name for name in (BASELINE, ORACLE) if name not in named] if named else []
        results[planner] = drive(
            Drive(
                data=data,
                out=config.out,
                planner=planner,
                predictors=(*named, *rungs) or (BASELINE,),
                controls=config.controls and bool(named),
                scenarios=scenarios,
                max_scenarios=config.max_scenarios,
                rules=config.rules,
                jobs=config.jobs,
            )
        )
    rows = [
        _row(name, planner, predictor, results[planner])
        for name, (planner, predictor) in parsed.items()
    ]
    return rows, [*results.values()]


def _data(config: Benchmark) -> str:
    if config.data is not None and config.suite is not None:
        raise AspEnvError(
            f"--suite {config.suite} and --data {config.data}: give one of them; a suite brings "
            "its own data"
        )
    if config.data is not None:
        return config.data
    return f"suite:{SUITE if config.suite is None else config.suite}"


def _frozen(data: str) -> str:
    path = source_folder(data) / FROZEN
    if not path.is_file():
        open_data(data)  # raises an error if there are no recordings at all
        raise AspEnvError(
            f"{data} has no frozen scenarios: {path} is missing; give the {FROZEN} of a run by "
            "--scenarios FILE, or a filter such as --scenarios interactive"
        )
    return str(path)


def _row(name: str, planner: str, predictor: str, result: ClosedLoopResult) -> BenchmarkRow:
    mine = {
        row.metric: row
        for row in result.rows
        if row.subset == "all" and row.planner == planner and row.predictor == predictor
    }
    first = next(iter(mine.values()))
    scenarios = result.scenarios
    return BenchmarkRow(
        data=first.data,
        scenarios_hash="",
        method=name,
        planner=planner,
        predictor=predictor,
        runs=first.runs,
        score=mine.get(SCORE),
        difference=mine.get(difference_name(SCORE, BASELINE)),
        oracle_share=mine.get(ORACLE_SHARE),
        headroom=mine.get(HEADROOM),
        fallback=mine.get(FALLBACK),
        n=len(scenarios),
        places=len({scenarios.locations[i] for i in np.unique(scenarios.recording).tolist()}),
        rules=first.rules,
        traffic=first.traffic,
        horizon_s=first.horizon_s or 0.0,
        dt_s=scenarios.dt_s,
        version=metadata.version("asp-env"),
    )


def _write(config: Benchmark, folder: Path) -> tuple[list[BenchmarkRow], list[str]]:
    """Drives and writes all files; returns the rows and the names of privileged methods."""
    rows, results = benchmark(config)
    first, *others = results
    # The expert drives beside every planner; its first scores are written.
    others = [
        replace(
            each,
            rows=[row for row in each.rows if row.planner != EXPERT],
            methods=[method for method in each.methods if method.planner != EXPERT],
            rollouts={label: drives for label, drives in each.rollouts.items() if label != EXPERT},
        )
        for each in others
    ]
    written = [first, *others]
    write_metrics(folder, [row for each in written for row in each.rows])
    save_scenarios(folder / FROZEN, first.scenarios, first.recordings)
    rows = [replace(row, scenarios_hash=digest(folder / FROZEN)) for row in rows]
    write_rows(folder / "benchmark.csv", rows)
    privileged = list(
        dict.fromkeys(name for each in results for name in each.manifest["privileged"])
    )
    write_manifest(
        folder,
        "benchmark",
        methods=list(config.methods),
        scenarios_hash=rows[0].scenarios_hash,
        privileged=privileged,
        drives={each.manifest["planner"]: each.manifest for each in results},
    )
    write_scenario_table(folder, [each.driven for each in written])
    if config.parquet:
        write_tidy_table(folder, [each.driven for each in written])
    for each in written:
        save_rollouts(folder, each)
    maps = {name: road_map for each in results for name, road_map in each.maps.items()}
    write_report(folder, title=f"Benchmark on {rows[0].data}", maps=maps)
    return rows, privileged


def write_rows(path: Path, rows: Sequence[BenchmarkRow]) -> None:
    """Writes `benchmark.csv`; an estimate is three columns: its value, `_low` and `_high`.

    Numbers have six significant digits.

    Args:
        path: the file.
        rows: the rows, one per method.
    """
    lines = [_cells(row) for row in rows]
    with atomic_file(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)


def _cells(row: BenchmarkRow) -> dict[str, object]:
    cells: dict[str, object] = {}
    for field in fields(BenchmarkRow):
        value = getattr(row, field.name)
        if field.name in ESTIMATES:
            low, high = (value.low, value.high) if value else (None, None)
            cells |= {field.name: value and value.value}
            cells |= {f"{field.name}_low": low, f"{field.name}_high": high}
        else:
            cells[field.name] = value
        if field.name == "difference":
            cells["mde"] = value.mde if value else None
    return {name: _text(value) for name, value in cells.items()}


def _text(value: object) -> object:
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return ""
    return f"{value:.6g}" if isinstance(value, float) else value


def benchmark_table(rows: Sequence[BenchmarkRow], privileged: Collection[str]) -> Table:
    """The rows for a terminal of 80 columns.

    Args:
        rows: the rows.
        privileged: names of the planners and predictors that are given the recorded future.
    """
    planners = {row.planner for row in rows}
    one_planner = len(planners) == 1 and all(row.predictor for row in rows)
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    table.title = f"planner {rows[0].planner}" if one_planner else None
    table.add_column("predictor" if one_planner else "method", overflow="fold")
    for heading in ("score", f"less {BASELINE}", "oracle share"):
        table.add_column(heading, justify="right", no_wrap=True)
    short = short_names([row.predictor for row in rows])
    notes = set[str]()
    for row in rows:
        star = row.planner in privileged or row.predictor in privileged
        notes |= {"* uses the recorded future"} if star else set()
        difference = _difference_text(row.difference)
        notes |= {"~ not resolved"} if difference.endswith("~") else set()
        named = (row.planner, short[row.predictor])
        table.add_row(
            " + ".join(part for part in named[one_planner:] if part) + " *" * star,
            _interval_text(row.score),
            difference,
            share_text(row.oracle_share) if row.oracle_share else "",
        )
    table.caption = "; ".join(sorted(notes))
    return table


def _interval_text(row: Row | None) -> str:
    if row is None:
        return ""
    if row.low is None or row.high is None:
        return f"{row.value:.3f}"
    return f"{row.value:.3f} [{row.low:.3f}, {row.high:.3f}]"


def _difference_text(row: Row | None) -> str:
    if row is None:
        return ""
    text = f"{row.value:+.3f}"
    if row.low is not None and row.high is not None:
        text += f" [{row.low:.3f}, {row.high:.3f}]"
    return text + (" " if is_resolved(row.value, row.low, row.high, row.mde) else "~")
