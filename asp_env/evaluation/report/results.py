"""The long table of metrics, read and put in order for people."""

import csv
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path, PurePath

from asp_env.errors import DataError
from asp_env.evaluation.output import Row

COLUMNS = tuple(field.name for field in fields(Row))
DETAILS = ("trained_on", "view", "preset", "chaining", "traffic", "latency_ticks")
"""Columns that tell rows of one predictor or planner apart, where they differ."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entrant:
    """Who was measured: a row of a table, a colour in a plot."""

    planner: str
    predictor: str
    details: tuple[str, ...] = ()
    """What tells it from others of the same name."""
    privileged: bool = False
    """Whether it knew the recorded future."""

    @property
    def name(self) -> str:
        """The planner, the predictor without its folder, or both."""
        parts = [self.planner, self.predictor.partition(":")[0]]
        return " + ".join(part for part in parts if part)

    @property
    def label(self) -> str:
        """The name with its details."""
        return " · ".join((self.name, *self.details))


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """One number of the table; None where it is missing."""

    entrant: Entrant
    data: str
    horizon_s: str
    fixed: tuple[str, ...]
    """What is equal for all rows of the same kind, such as the traffic."""
    selection: str
    subset: str
    metric: str
    at_s: float | None
    """The time that the metric speaks of, for one such as `L2@1s`, whose `metric` is `L2`."""
    value: float | None
    low: float | None
    high: float | None
    n: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Results:
    """What a run measured."""

    open_loop: tuple[Result, ...]
    """About predictors alone."""
    driving: tuple[Result, ...]

    @property
    def predictors(self) -> list[str]:
        """All predictors that do not know the future, by appearance."""
        every = [result.entrant for result in (*self.open_loop, *self.driving)]
        return distinct(e.predictor for e in every if e.predictor and not e.privileged)


def read_results(path: Path, *, privileged: Collection[str] = ()) -> Results:
    """The table of metrics.

    Args:
        path: of the file.
        privileged: predictors and planners that were handed the recorded future.

    Raises:
        DataError: the file is missing, lacks a column, or holds text for a number.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
            names = reader.fieldnames or ()
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"{path}: not a table of metrics ({error})") from error
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise DataError(f"{path}: no column {missing[0]!r}, expected {', '.join(COLUMNS)}")
    return Results(
        open_loop=_results(path, [row for row in rows if not row["planner"]], privileged),
        driving=_results(path, [row for row in rows if row["planner"]], privileged),
    )


def _results(
    path: Path, rows: Sequence[dict[str, str]], privileged: Collection[str]
) -> tuple[Result, ...]:
    values = {name: {row[name] for row in rows} - {""} for name in DETAILS}
    varying = [name for name in DETAILS if len(values[name]) > 1]
    fixed = tuple(_detail(n, *values[n]) for n in DETAILS if len(values[n]) == 1)
    return tuple(_result(path, row, varying, fixed, privileged) for row in rows)


def _result(
    path: Path,
    row: dict[str, str],
    varying: Sequence[str],
    fixed: tuple[str, ...],
    privileged: Collection[str],
) -> Result:
    folder = PurePath(row["predictor"].partition(":")[2])
    details = ["/".join(folder.parts[-2:])] if folder.name else []
    details += [_detail(name, row[name]) for name in varying if row[name]]
    metric = re.fullmatch(r"(.+)@([0-9.]+) ?s", row["metric"])
    try:
        numbers = {
            name: float(row[name]) if row[name] not in ("", "nan") else None
            for name in ("value", "low", "high", "n")
        }
        at_s = float(metric[2]) if metric else None
    except ValueError as error:
        raise DataError(f"{path}: metric {row['metric']!r}: {error}") from error
    return Result(
        entrant=Entrant(
            planner=row["planner"],
            predictor=row["predictor"],
            details=tuple(details),
            privileged=row["planner"] in privileged or row["predictor"] in privileged,
        ),
        data=row["data"],
        horizon_s=row["horizon_s"],
        fixed=fixed,
        selection=row["selection"],
        subset=row["subset"],
        metric=metric[1] if metric else row["metric"],
        at_s=at_s,
        **numbers,
    )


def _detail(column: str, value: str) -> str:
    if column == "latency_ticks":
        return f"forecasts {value} ticks late"
    return f"{column.replace('_', ' ')} {value}"


def entrants(results: Iterable[Result]) -> list[Entrant]:
    """Those of some results: first the expert, then others who knew the future, then the rest."""
    found = dict.fromkeys(result.entrant for result in results)
    return sorted(found, key=lambda entrant: (not entrant.privileged, entrant.planner != "expert"))


def distinct(values: Iterable[str], *, first: Sequence[str] = ()) -> list[str]:
    """Each value once, by appearance, those of `first` in front."""
    found = dict.fromkeys(values)
    rank = {value: position for position, value in enumerate(first)}
    return sorted(found, key=lambda value: rank.get(value, len(rank)))


def best(results: Iterable[Result], *, better: str) -> Result | None:
    """The best of those who did not know the future, None if there is none."""
    fair = [r for r in results if r.value is not None and not r.entrant.privileged]
    sign = 1 if better == "lower" else -1
    return min(fair, key=lambda r: sign * (r.value or 0.0), default=None)
