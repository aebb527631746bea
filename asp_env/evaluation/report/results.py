"""What each metric says, in a line, and which way is better.

MERGED: The long table of metrics, read and put in order for people.
"""

import csv
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path, PurePath
from typing import Literal

from asp_env.errors import DataError
from asp_env.evaluation.results import Row

Better = Literal["lower", "higher", "neither"]


@dataclass(frozen=True, slots=True, kw_only=True)
class MetricNote:
    """How a metric is printed and read."""

    label: str
    unit: str
    """`m`, `m²`, `%` (the value is a share of one), … or nothing."""
    better: Better
    text: str

    @property
    def unit_and_arrow(self) -> str:
        """The unit, then an arrow that shows which way is better."""
        arrow = {"lower": "↓", "higher": "↑", "neither": ""}[self.better]
        return " ".join(part for part in (self.unit, arrow) if part)

    def format(self, value: float) -> str:
        """The value as text, without its unit."""
        if self.unit == "%":
            return f"{100 * value:.1f}"
        return f"{value:.3f}" if 0 < abs(value) < 0.1 else f"{value:.2f}"


def _note(label: str, unit: str, better: Better, text: str) -> MetricNote:
    return MetricNote(label=label, unit=unit, better=better, text=text)


NOTES = {
    "FDE": _note("FDE", "m", "lower", "Distance from the forecast's last position to the truth."),
    "FDE / constant velocity": _note(
        "FDE / CV",
        "",
        "lower",
        "FDE over constant velocity's on the same targets; paired interval.",
    ),
    "ADE": _note("ADE", "m", "lower", "Distance to the truth, averaged over the forecast's ticks."),
    "L2": _note("L2", "m", "lower", "Distance to the truth so many seconds ahead."),
    "MAE": _note("MAE", "m", "lower", "Mean absolute error of x and y over all ticks."),
    "MSE": _note("MSE", "m²", "lower", "Mean squared error of x and y over all ticks."),
    "miss": _note("Miss", "%", "lower", "Share of targets whose last position is over 2 m off."),
    "brier-FDE": _note(
        "Brier FDE", "m", "lower", "FDE plus (1 - p)², p being the judged mode's probability."
    ),
    "NLL": _note(
        "NLL",
        "nats",
        "lower",
        "Negative log density of the true end under Gaussians of 1 m around the modes' ends.",
    ),
    "ECE": _note(
        "ECE",
        "",
        "lower",
        "Expected calibration error of the modes' probabilities of ending nearest, in ten bins.",
    ),
    "Brier": _note(
        "Brier", "", "lower", "Squared error of the modes' probabilities of ending nearest, summed."
    ),
    "off-road": _note(
        "Off road",
        "%",
        "lower",
        "Share of modes whose centre leaves the drivable area by over 0.3 m; of targets that keep "
        "to it.",
    ),
    "overlap": _note(
        "Overlap",
        "%",
        "lower",
        "Share of modes whose box meets that of another road user where the two were recorded "
        "apart.",
    ),
    "infeasible": _note(
        "Infeasible",
        "%",
        "lower",
        "Share of modes that accelerate by over 10.4 m/s² or curve by over 0.3 1/m.",
    ),
    "inconsistency": _note(
        "Inconsistency",
        "m",
        "lower",
        "Distance between most probable forecasts made 0.6 s apart, where they speak of one time.",
    ),
    "score": _note(
        "Score",
        "%",
        "higher",
        "The score of the preset that judged: its multipliers times its weighted mean, 0 to 100 %.",
    ),
    "score - constant-velocity": _note(
        "Score - CV",
        "%",
        "higher",
        "Score less that of the same planner with constant velocity; paired interval.",
    ),
    "no at-fault collision": _note(
        "No fault",
        "%",
        "higher",
        "Drives in which the ego hit nobody standing, nobody at its front and nobody at its side, "
        "by the preset's rule; being hit from behind, or while standing, is no fault.",
    ),
    "no collision": _note(
        "No contact", "%", "higher", "Drives in which the ego's box met nobody else's at all."
    ),
    "on road": _note(
        "On road",
        "%",
        "higher",
        "Drives without a corner further outside the drivable area than preset and log allow.",
    ),
    "on mapped road": _note(
        "On the map", "%", "higher", "The same where the log's own way off the map excuses nothing."
    ),
    "progress": _note(
        "Progress", "%", "higher", "Way made good, as a share of the recorded ego's."
    ),
    "making progress": _note(
        "Makes way", "%", "higher", "Drives over at least a fifth of the recorded ego's way."
    ),
    "TTC": _note(
        "TTC", "%", "higher", "Drives that always kept their time to any collision above 0.95 s."
    ),
    "direction": _note(
        "Direction", "%", "higher", "100 % up to 2 m against the traffic within 1 s, 0 above 6 m."
    ),
    "right way": _note(
        "Right way", "%", "higher", "Drives that stayed within 3.5 m of a way on from their start."
    ),
    "speed": _note(
        "Speed limit", "%", "higher", "1 less the mean overspeed over 2.23 m/s, at least 0."
    ),
    "feasible": _note(
        "Feasible", "%", "higher", "Drives within Waymax's bounds of acceleration and curvature."
    ),
    "no hit from behind": _note(
        "No rear hit", "%", "higher", "Drives in which nobody ran into the ego from behind."
    ),
    "comfort": _note(
        "Comfort", "%", "higher", "Drives within nuPlan's bounds of acceleration, jerk and yaw."
    ),
    "log divergence": _note(
        "Off the log", "m", "neither", "Mean distance between the ego and the recorded one."
    ),
    "realism": _note(
        "Realism",
        "%",
        "higher",
        "How likely the recorded traffic is under the simulated one, by the weights of WOSAC 2025.",
    ),
    "route deviation": _note(
        "Off the route", "m", "neither", "Mean distance to the way that the recorded ego took."
    ),
}
"""By name in `metrics.csv`."""


def metric_note(metric: str) -> MetricNote:
    """The note of a metric; an unknown one keeps its name and is ranked neither way."""
    return NOTES.get(metric) or _note(metric, "", "neither", "")


SELECTIONS = ("most-probable", "best-of-3", "")
"""A metric without a selection speaks of all modes together."""
SUBSETS = ("all", "moving")
COLUMNS = tuple(field.name for field in fields(Row))
DETAILS = ("trained_on", "view", "recipe", "chaining", "traffic", "latency_ticks")
"""Columns that tell rows of one predictor or planner apart, where they differ."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodResult:
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

    method: MethodResult
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
        every = [result.method for result in (*self.open_loop, *self.driving)]
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
        method=MethodResult(
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


def methods_of(results: Iterable[Result]) -> list[MethodResult]:
    """Those of some results: first the expert, then others who knew the future, then the rest."""
    found = dict.fromkeys(result.method for result in results)
    return sorted(found, key=lambda method: (not method.privileged, method.planner != "expert"))


def distinct(values: Iterable[str], *, first: Sequence[str] = ()) -> list[str]:
    """Each value once, by appearance, those of `first` in front."""
    found = dict.fromkeys(values)
    rank = {value: position for position, value in enumerate(first)}
    return sorted(found, key=lambda value: rank.get(value, len(rank)))


def best_result(results: Iterable[Result], *, better: str) -> Result | None:
    """The best of those who did not know the future, None if there is none."""
    fair = [r for r in results if r.value is not None and not r.method.privileged]
    sign = 1 if better == "lower" else -1
    return min(fair, key=lambda r: sign * (r.value or 0.0), default=None)
