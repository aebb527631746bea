"""`scenarios.csv` of a run folder: the score of every method in every scenario."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from asp_env.errors import DataError
from asp_env.evaluation.ladder import is_under_test
from asp_env.evaluation.report.results import read_condition
from asp_env.evaluation.results import SCORE, Condition

CONDITION_COLUMNS = ("data", "traffic", "latency_ticks")
"""Columns of tables with several conditions; without them a table belongs to all conditions."""

SAME = 0.005
"""Scores that differ by less count as the same. Chosen by hand: half of the last printed digit of
two."""

LISTED = 4
"""Number of scenarios in each list of drives. Chosen by hand: three lists fit one screen."""

EXPERT = "expert"

Key = tuple[str, str]
"""Planner and predictor of a method."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioValues:
    """Scores of M methods in S scenarios of one condition, averaged over training runs."""

    names: tuple[str, ...]
    """Name of each scenario."""
    tags: tuple[str, ...]
    """Tags of each scenario, separated by blanks."""
    places: int
    """Number of locations."""
    scores: Mapping[Key, Float[np.ndarray, " scenarios"]]
    """Score in every scenario by method, NaN where it is not defined."""

    def differences(self, method: Key, reference: str) -> Float[np.ndarray, " scenarios"] | None:
        """Scores of a method less those of its planner with the reference, if both are known."""
        base = self.scores.get((method[0], reference))
        mine = self.scores.get(method)
        return None if base is None or mine is None else mine - base


@dataclass(frozen=True, slots=True, kw_only=True)
class ListedDrive:
    """A scenario that the page lists, with the two methods to be shown side by side."""

    name: str
    tags: str
    first: Key
    second: Key
    scores: tuple[float, float]
    """Scores of the two methods."""


def read_scenario_values(path: Path) -> dict[Condition | None, ScenarioValues]:
    """Reads `scenarios.csv`.

    Args:
        path: The file, which may be missing.

    Returns:
        The values by condition; by None where the table has no columns of conditions. Empty if
        there is no file.

    Raises:
        DataError: The file lacks a column, or holds text for a number.
    """
    if not path.is_file():
        return {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            columns = [*(reader.fieldnames or ())]
            rows = [*reader]
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"{path}: not a table of scenarios ({error})") from error
    needed = ("scenario", "location", "tags", "planner", "predictor")
    missing = [name for name in needed if name not in columns]
    if missing:
        raise DataError(f"{path}: no column {missing[0]!r}, expected {', '.join(needed)}")
    has_conditions = all(name in columns for name in CONDITION_COLUMNS)
    groups: dict[Condition | None, list[dict[str, str]]] = {}
    for row in rows:
        try:
            key = read_condition(row) if has_conditions else None
        except ValueError as error:
            raise DataError(f"{path}: latency_ticks: {error}") from error
        groups.setdefault(key, []).append(row)
    return {condition: _values(path, group) for condition, group in groups.items()}


def values_in(
    tables: Mapping[Condition | None, ScenarioValues], condition: Condition
) -> ScenarioValues | None:
    """The values of a condition, if there are any."""
    return tables.get(condition, tables.get(None))


def telling_drives(values: ScenarioValues, reference: str, privileged: Sequence[str]) -> tuple[
    list[ListedDrive], list[ListedDrive]
]:  # fmt: skip
    """The scenarios with the largest gains over the reference, and those with the largest losses.

    Every scenario is listed once, with the method under test that differs most.

    Args:
        values: The scores.
        reference: Name of the predictor that differences refer to.
        privileged: Names of privileged planners and predictors.
    """
    tested = {
        method: difference
        for method in values.scores
        if method[1] != reference
        and is_under_test(method[1], privileged=bool({*method} & {*privileged}))
        and (difference := values.differences(method, reference)) is not None
    }
    if not tested:
        return [], []
    methods = [*tested]
    table = np.nan_to_num(np.stack([*tested.values()]))
    lists = []
    for sign in (1, -1):
        best = (sign * table).argmax(axis=0)
        gains = (sign * table).max(axis=0)
        order = np.argsort(-gains, kind="stable")[:LISTED]
        lists.append(
            [
                _listed(values, i, methods[best[i]], (methods[best[i]][0], reference))
                for i in order.tolist()
                if gains[i] >= SAME
            ]
        )
    return lists[0], lists[1]


def worst_drives(values: ScenarioValues, method: Key, second: Key) -> list[ListedDrive]:
    """The scenarios with the lowest scores of a method.

    Args:
        values: The scores.
        method: The method.
        second: The method to show beside it.
    """
    scores = values.scores.get(method)
    if scores is None or second not in values.scores:
        return []
    order = np.argsort(np.nan_to_num(scores, nan=np.inf), kind="stable")[:LISTED]
    return [_listed(values, i, method, second) for i in order.tolist() if scores[i] < 1]


def _listed(values: ScenarioValues, number: int, first: Key, second: Key) -> ListedDrive:
    return ListedDrive(
        name=values.names[number],
        tags=" · ".join(values.tags[number].split()),
        first=first,
        second=second,
        scores=(float(values.scores[first][number]), float(values.scores[second][number])),
    )


def _values(path: Path, rows: Sequence[dict[str, str]]) -> ScenarioValues:
    first = {row["scenario"]: row for row in reversed(rows)}
    names = [*dict.fromkeys(row["scenario"] for row in rows)]
    number = {name: i for i, name in enumerate(names)}
    cells: dict[Key, list[list[float]]] = {}
    for row in rows:
        of_method = cells.setdefault((row["planner"], row["predictor"]), [[] for _ in names])
        text = row.get(SCORE)
        if text:
            try:
                of_method[number[row["scenario"]]].append(float(text))
            except ValueError as error:
                raise DataError(f"{path}: scenario {row['scenario']!r}: {error}") from error
    scores = {
        key: np.array([np.mean(each) if each else np.nan for each in lists])
        for key, lists in cells.items()
    }
    return ScenarioValues(
        names=tuple(names),
        tags=tuple(first[name]["tags"] for name in names),
        places=len({row["location"] for row in rows}),
        scores={key: each for key, each in scores.items() if np.isfinite(each).any()},
    )
