"""The results of a run as people read them: `metrics.csv` and what its metrics mean."""

import csv
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path, PurePath
from typing import Literal

from asp_env.errors import DataError
from asp_env.evaluation.results import (
    ANSWER,
    HEADROOM,
    ORACLE_SHARE,
    Condition,
    Row,
    difference_of,
)
from asp_env.evaluation.selection import split_name

SELECTIONS = ("most-probable", "best-of-3", "")
"""Selections of modes in the order of the tables; metrics of all modes together have none."""
SUBSETS = ("all", "moving")
"""The subsets of targets or episodes that come first."""
COLUMNS = tuple(field.name for field in fields(Row))
ADDED_COLUMNS = ("runs", "mde", "p_holm")
"""Columns that older run folders lack."""
RENAMED_COLUMNS = {"preset": "recipe"}
"""Columns of older run folders and their present names."""
DETAILS = ("trained_on", "view", "recipe", "chaining")
"""Columns that distinguish methods of the same name."""

Better = Literal["lower", "higher", "neither"]


@dataclass(frozen=True, slots=True, kw_only=True)
class MetricNote:
    """How a metric is named, explained and printed."""

    label: str
    unit: str
    """`m`, `m²`, `s`, `m/s²`, `%` (the value is a share of one), or empty."""
    better: Better
    text: str
    """Definition in a sentence; empty for an unknown metric."""
    decimals: int | None = None
    """None for one decimal of percentages, two of other numbers, three of small ones."""

    @property
    def unit_and_arrow(self) -> str:
        """The unit, then an arrow that shows which way is better."""
        arrow = {"lower": "↓", "higher": "↑", "neither": ""}[self.better]
        return " ".join(part for part in (self.unit, arrow) if part)

    def format(self, value: float) -> str:
        """The value as text, without its unit."""
        default = 1 if self.unit == "%" else 3 if 0 < abs(value) < 0.1 else 2
        decimals = default if self.decimals is None else self.decimals
        return f"{round(self.scale * value, decimals) + 0.0:.{decimals}f}"

    @property
    def scale(self) -> float:
        """Factor from a value to the printed number."""
        return 100.0 if self.unit == "%" else 1.0

    def signed(self, value: float) -> str:
        """The value of a difference with its sign, without its unit."""
        text = self.format(value)
        return text if text.startswith("-") else f"+{text}"


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodResult:
    """The method that a result belongs to: a row of a table, a colour in a plot."""

    planner: str
    predictor: str
    details: tuple[str, ...] = ()
    """Texts that distinguish methods of the same name."""
    privileged: bool = False
    """Whether its planner or predictor is given the recorded future."""

    @property
    def name(self) -> str:
        """The planner, the predictor without its folder, or both."""
        parts = [self.planner, split_name(self.predictor)[0]]
        return " + ".join(part for part in parts if part)

    @property
    def label(self) -> str:
        """The name with its details."""
        return " · ".join((self.name, *self.details))


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """One row of `metrics.csv`; a missing number is None."""

    method: MethodResult
    condition: Condition
    horizon_s: str
    fixed: tuple[str, ...]
    """Details that all results of the same kind share, such as the view."""
    selection: str
    subset: str
    metric: str
    at_s: float | None
    """Time ahead that the metric is evaluated at: 1.0 for `L2@1s`, whose `metric` is `L2`."""
    value: float | None
    low: float | None
    high: float | None
    n: float | None
    mde: float | None = None
    """Minimal detectable effect of a difference."""
    p_holm: float | None = None
    """Adjusted p value of a difference."""

    @property
    def is_comparison(self) -> bool:
        """Whether it compares the method with others: a difference, oracle share or headroom."""
        return self.metric in (ORACLE_SHARE, HEADROOM) or difference_of(self.metric) is not None


@dataclass(frozen=True, slots=True, kw_only=True)
class Results:
    """All results of a run."""

    open_loop: tuple[Result, ...]
    """Results of predictors without a planner."""
    driving: tuple[Result, ...]

    @property
    def conditions(self) -> list[Condition]:
        """The conditions of the drives, then those of forecasts on data without drives."""
        driven = dict.fromkeys(result.condition for result in self.driving)
        data = {condition.data for condition in driven}
        open_loop = [result.condition for result in self.open_loop]
        forecast = dict.fromkeys(each for each in open_loop if each.data not in data)
        return [*driven, *forecast]

    @property
    def predictors(self) -> list[str]:
        """Predictors that are not privileged, in the order of their first results."""
        methods = [result.method for result in (*self.open_loop, *self.driving)]
        return distinct(m.predictor for m in methods if m.predictor and not m.privileged)


def read_results(path: Path, *, privileged: Collection[str] = ()) -> Results:
    """Reads `metrics.csv`, without rows that answer a question of a study.

    Args:
        path: The file. Names of columns in older files are understood.
        privileged: Predictors and planners that were given the recorded future.

    Raises:
        DataError: The file is missing, lacks a column, or holds text for a number.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            columns = [RENAMED_COLUMNS.get(name, name) for name in reader.fieldnames or ()]
            reader.fieldnames = columns
            rows = list(reader)
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"{path}: not a table of metrics ({error})") from error
    missing = [name for name in COLUMNS if name not in columns]
    if cut := next((n for n, row in enumerate(rows, 2) if None in row or None in row.values()), 0):
        raise DataError(
            f"{path}, row {cut}: has another number of cells than the header, {len(columns)}; make "
            "the results again"
        )
    if set(missing) - set(ADDED_COLUMNS):
        raise DataError(f"{path}: no column {missing[0]!r}, expected {', '.join(COLUMNS)}")
    rows = [dict.fromkeys(missing, "") | row for row in rows if row.get("subset") != ANSWER]
    return Results(
        open_loop=_results(path, [row for row in rows if not row["planner"]], privileged),
        driving=_results(path, [row for row in rows if row["planner"]], privileged),
    )


def methods_of(results: Iterable[Result]) -> list[MethodResult]:
    """The methods of some results: the expert, then other privileged methods, then the rest."""
    methods = dict.fromkeys(result.method for result in results)
    return sorted(methods, key=lambda method: (not method.privileged, method.planner != "expert"))


def short_labels(methods: Sequence[MethodResult]) -> dict[MethodResult, str]:
    """The shortest distinct labels of methods.

    The planner is left out where all methods with a predictor have the same. Methods of the same
    name have the name of their run folder beside it, and all details if that is the same, too.
    """
    one_planner = len({method.planner for method in methods if method.predictor}) == 1
    names = {
        method: split_name(method.predictor)[0] if one_planner and method.predictor else method.name
        for method in methods
    }
    runs = {method: _with_run(name, method.predictor) for method, name in names.items()}
    once, distinct_runs = _unique(names.values()), _unique(runs.values())
    return {
        m: name if name in once else runs[m] if runs[m] in distinct_runs else m.label
        for m, name in names.items()
    }


def _with_run(name: str, predictor: str) -> str:
    """A name with the last folder of the predictor's run, such as `ssp-asp ours`."""
    folders = [part for part in split_name(predictor)[1].split("/") if part.strip("*.")]
    return " ".join((name, *folders[-1:]))


def _unique(names: Iterable[str]) -> set[str]:
    return {name for name, count in Counter(names).items() if count == 1}


def condition_labels(conditions: Sequence[Condition]) -> list[str]:
    """Labels of conditions: what differs between them; all of it for a single one."""
    return [" · ".join(parts) for parts in condition_parts(conditions)]


def condition_parts(conditions: Sequence[Condition]) -> list[tuple[str, ...]]:
    """What differs between conditions, of data, traffic and latency; all of a single one."""
    if len(conditions) == 1:
        return [(conditions[0].label,)]
    parts = [
        {condition: condition.data for condition in conditions},
        {condition: f"traffic {condition.traffic}" for condition in conditions},
        {condition: f"latency {condition.latency_ticks}" for condition in conditions},
    ]
    varying = [part for part in parts if len({*part.values()}) > 1]
    return [tuple(part[condition] for part in varying) for condition in conditions]


def read_condition(row: Mapping[str, str]) -> Condition:
    """The condition of a row of `metrics.csv` or `scenarios.csv`.

    Raises:
        ValueError: the latency is no whole number.
    """
    return Condition(
        data=row["data"], traffic=row["traffic"], latency_ticks=int(row["latency_ticks"] or 0)
    )


def best_result(results: Iterable[Result], *, better: str) -> Result | None:
    """The best result of a method that is not privileged, None if there is none."""
    comparable = [r for r in results if r.value is not None and not r.method.privileged]
    sign = 1 if better == "lower" else -1
    return min(comparable, key=lambda r: sign * (r.value or 0.0), default=None)


def distinct(values: Iterable[str], *, first: Sequence[str] = ()) -> list[str]:
    """Each value once, those of `first` in front, the others in the order of appearance."""
    rank = {value: position for position, value in enumerate(first)}
    return sorted(dict.fromkeys(values), key=lambda value: rank.get(value, len(rank)))


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
    folder = PurePath(split_name(row["predictor"])[1])
    details = ["/".join(folder.parts[-2:])] if folder.name else []
    details += [_detail(name, row[name]) for name in varying if row[name]]
    if row["runs"] not in ("", "1"):
        details.append(f"mean of {row['runs']} runs")
    metric = re.fullmatch(r"(.+)@([0-9.]+) ?s", row["metric"])
    try:
        condition = read_condition(row)
        numbers = {
            name: float(row[name]) if row[name] not in ("", "nan") else None
            for name in ("value", "low", "high", "n", "mde", "p_holm")
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
        condition=condition,
        horizon_s=row["horizon_s"],
        fixed=fixed,
        selection=row["selection"],
        subset=row["subset"],
        metric=metric[1] if metric else row["metric"],
        at_s=at_s,
        **numbers,
    )


def _detail(column: str, value: str) -> str:
    return f"{column.replace('_', ' ')} {value}"


def metric_note(metric: str) -> MetricNote:
    """The note of a metric; an unknown metric is named as in the file and is not ranked."""
    known = METRIC_NOTES.get(metric)
    if known is not None:
        return known
    difference = difference_of(metric)
    if difference is None:
        return _note(metric, "", "neither", "")
    base, reference = metric_note(difference[0]), difference[1]
    return _note(
        f"{base.label} - {reference}",
        base.unit,
        base.better,
        f"{base.label} less that of the same planner with {reference}, paired by scenario.",
        base.decimals,
    )


def _note(
    label: str, unit: str, better: Better, text: str, decimals: int | None = None
) -> MetricNote:
    return MetricNote(label=label, unit=unit, better=better, text=text, decimals=decimals)


METRIC_NOTES = {
    "FDE": _note(
        "FDE", "m", "lower", "Distance between the last forecast position and the true position."
    ),
    "FDE / constant velocity": _note(
        "FDE / CV",
        "",
        "lower",
        "FDE divided by that of constant velocity on the same targets; paired interval.",
    ),
    "ADE": _note(
        "ADE", "m", "lower", "Mean distance between forecast and true positions over all ticks."
    ),
    "L2": _note(
        "L2", "m", "lower", "Distance between forecast and true position at a given time ahead."
    ),
    "MAE": _note("MAE", "m", "lower", "Mean absolute error of x and y over all ticks."),
    "MSE": _note("MSE", "m²", "lower", "Mean squared error of x and y over all ticks."),
    "miss": _note(
        "Miss rate",
        "%",
        "lower",
        "Share of targets whose last forecast position is over 2 m from the true position.",
    ),
    "brier-FDE": _note(
        "Brier FDE",
        "m",
        "lower",
        "FDE plus (1 - p)², where p is the probability of the evaluated mode.",
    ),
    "NLL": _note(
        "NLL",
        "nats",
        "lower",
        "Negative log likelihood of the true last position under Gaussians of 1 m around the last "
        "positions of all modes.",
    ),
    "ECE": _note(
        "ECE",
        "",
        "lower",
        "Expected calibration error, in ten bins, of the modes' probabilities of ending nearest "
        "to the true last position.",
    ),
    "Brier": _note(
        "Brier",
        "",
        "lower",
        "Sum of the squared errors of the modes' probabilities of ending nearest to the true last "
        "position.",
    ),
    "off-road": _note(
        "Off road",
        "%",
        "lower",
        "Share of modes whose centre leaves the drivable area by over 0.3 m, for targets that "
        "stay inside it.",
    ),
    "overlap": _note(
        "Overlap",
        "%",
        "lower",
        "Share of modes whose box overlaps the recorded box of another agent, except pairs that "
        "overlap in the recording.",
    ),
    "infeasible": _note(
        "Infeasible",
        "%",
        "lower",
        "Share of modes with an acceleration over 10.4 m/s² or a curvature over 0.3 1/m.",
    ),
    "inconsistency": _note(
        "Inconsistency",
        "m",
        "lower",
        "Mean distance between most probable forecasts made 0.6 s apart, over the ticks that both "
        "cover.",
    ),
    "regret": _note(
        "Regret",
        "",
        "lower",
        "Planning regret: cost, by the recorded future, of the plan that the planner chooses with "
        "the forecast, less that of the plan it chooses with the recorded future. Mean over states "
        "of the logged ego; subsets are tags of their scenarios.",
    ),
    "log1p regret": _note(
        "ln(1 + regret)",
        "",
        "lower",
        "Mean of the logarithm of one plus the planning regret, on which few large regrets have "
        "less weight.",
    ),
    "regret removed": _note(
        "Regret removed",
        "%",
        "higher",
        "100 % minus the planning regret as a share of that with constant velocity at the same "
        "states; 100 % for the oracle. Paired interval.",
    ),
    "score": _note(
        "Score",
        "",
        "higher",
        "Score of the rules, from 0 to 1: the product of their multipliers times their weighted "
        "mean.",
        3,
    ),
    "score - constant-velocity": _note(
        "Score - CV",
        "",
        "higher",
        "Score less that of the same planner with constant velocity; paired interval.",
        3,
    ),
    ORACLE_SHARE: _note(
        "Oracle share",
        "%",
        "higher",
        "Share of the recorded future, mixed into constant velocity, with which the planner has "
        "the same score: 0 % is constant velocity or worse, 100 % the oracle or better.",
    ),
    HEADROOM: _note(
        "Headroom",
        "%",
        "higher",
        "Gain of the score over constant velocity as a share of the oracle's gain.",
    ),
    "no at-fault collision": _note(
        "No at-fault",
        "%",
        "higher",
        "Share of episodes without a collision that is the ego's fault under the rules: with a "
        "standing agent, at the ego's front, or at its side where the rules say so. Collisions "
        "from behind or while the ego stands do not count.",
    ),
    "no collision": _note(
        "No collision",
        "%",
        "higher",
        "Share of episodes in which the ego's box never overlaps that of another agent.",
    ),
    "on road": _note(
        "On road",
        "%",
        "higher",
        "Share of episodes in which no corner of the ego is further outside the drivable area "
        "than the rules allow; where the recorded ego is outside it, as much is allowed.",
    ),
    "on mapped road": _note(
        "On map",
        "%",
        "higher",
        "As on road, but without the allowance for positions where the recorded ego is outside.",
    ),
    "progress": _note(
        "Progress",
        "%",
        "higher",
        "Distance travelled along the route as a share of the recorded ego's, at most 100 %.",
    ),
    "making progress": _note(
        "Min. progress", "%", "higher", "Share of episodes with a progress of at least 20 %."
    ),
    "TTC": _note(
        "TTC",
        "%",
        "higher",
        "Share of episodes in which the time to collision is always over 0.95 s.",
    ),
    "direction": _note(
        "Direction",
        "%",
        "higher",
        "100 % if the ego drives at most 2 m against the traffic within any 1 s, 50 % up to 6 m, "
        "else 0 %.",
    ),
    "right way": _note(
        "Right way",
        "%",
        "higher",
        "Share of episodes in which the ego stays within 3.5 m of the lanes that continue from "
        "its start or of the recorded route.",
    ),
    "speed": _note(
        "Speed limit",
        "%",
        "higher",
        "100 % minus the mean overspeed as a share of 2.23 m/s, at least 0 %.",
    ),
    "feasible": _note(
        "Feasible",
        "%",
        "higher",
        "Share of episodes within Waymax's bounds on acceleration and curvature.",
    ),
    "no hit from behind": _note(
        "No rear hit",
        "%",
        "higher",
        "Share of episodes in which no agent collides with the ego from behind.",
    ),
    "comfort": _note(
        "Comfort",
        "%",
        "higher",
        "Share of episodes within nuPlan's bounds on acceleration, jerk, yaw rate and yaw "
        "acceleration.",
    ),
    "no near miss": _note(
        "No near miss",
        "%",
        "higher",
        "Share of episodes without a near miss: an agent within 0.5 m plus 0.2 s at the ego's "
        "speed ahead of its box, or 0.3 m beside it, that comes closer by over 0.5 m/s.",
    ),
    "near misses": _note(
        "Near misses", "%", "lower", "Share of the ticks of an episode that are near misses."
    ),
    "min TTC": _note(
        "Min. TTC",
        "s",
        "higher",
        "Smallest time to collision at constant velocity in an episode, at most 3 s; 0 s in a "
        "collision.",
    ),
    "required deceleration": _note(
        "Required braking",
        "m/s²",
        "lower",
        "Largest braking in an episode that the ego would have needed to avoid an agent at "
        "constant velocity, at most 8 m/s².",
    ),
    "safety margin": _note(
        "Safety margin",
        "%",
        "higher",
        "Smallest time to collision as a share of 1.9 s, at most 100 %: the threshold of TTC, "
        "0.95 s, widened to a ramp with 50 % in its middle.",
    ),
    "uncomfortable ticks": _note(
        "Uncomfortable",
        "%",
        "lower",
        "Share of the ticks of an episode at which one of nuPlan's comfort bounds is exceeded.",
    ),
    "smoothness": _note(
        "Smoothness",
        "%",
        "higher",
        "The bounds of comfort widened to a ramp: 100 % up to half of every bound, 50 % at a "
        "bound, 0 % from 1.5 times a bound on.",
    ),
    "time lost": _note(
        "Time lost",
        "s",
        "lower",
        "Elapsed time at the end of an episode less the time at which the recorded ego was at the "
        "same place, to the end of the scenario where the ego does not reach the goal; negative "
        "if the ego gained time.",
    ),
    "driving cost": _note(
        "Driving cost",
        "s",
        "lower",
        "Time lost, plus 5 s per second of overlap of full severity, which is (1 - TTC / 3 s)², "
        "plus the uncomfortable time, plus 30 s for an at-fault collision or for leaving the "
        "road.",
    ),
    "log divergence": _note(
        "Log distance",
        "m",
        "neither",
        "Mean distance between the ego and the recorded ego at the same ticks.",
    ),
    "realism": _note(
        "Realism",
        "%",
        "higher",
        "Likelihood of the recorded motion under the simulated traffic, with the weights of "
        "WOSAC 2025.",
    ),
    "route deviation": _note(
        "Route distance",
        "m",
        "neither",
        "Mean distance between the ego and the recorded ego's route.",
    ),
}
"""Notes by the name of the metric in `metrics.csv`."""
