"""Files of an output folder: `metrics.csv` and `manifest.json`."""

import csv
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import Any

from asp_env.files import atomic_file

PACKAGES = ("asp-env", "numpy", "numba", "torch", "gymnasium", "eclipse-sumo")
"""Packages whose versions the manifest states, as far as they are installed."""

SCORE = "score"
"""Metric: the score of the driving rules."""

ORACLE_SHARE = "oracle share"
"""Metric: position of a method's score on the ladder from constant velocity (0) to the oracle (1),
see `asp_env.evaluation.ladder`."""

HEADROOM = "headroom"
"""Metric: gain of a method's score over constant velocity as a share of the oracle's gain."""

FALLBACK = "fallback"
"""Metric: share of the forecasts of targets that a guard has blended to constant velocity."""

FAULTY = "faulty"
"""Metric: share of the scenarios in which the predictor or the planner had a fault that was filled
in by constant velocity."""

ANSWER = "question"
"""Subset of the rows that answer a question of a study, of all its scenarios."""

_DIFFERENCE = " - "


def difference_name(metric: str, reference: str) -> str:
    """Name of the difference of a metric to that of a reference, paired by scenario."""
    return f"{metric}{_DIFFERENCE}{reference}"


def difference_of(metric: str) -> tuple[str, str] | None:
    """The metric and the reference of a difference, None if the name is not that of one."""
    name, separator, reference = metric.partition(_DIFFERENCE)
    return (name, reference) if separator else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """What all methods of a comparison have in common."""

    data: str
    """DATA as given."""
    traffic: str = ""
    """Drivers of the other agents; empty in open loop."""
    latency_ticks: int = 0
    """Ticks by which forecasts are late."""

    @property
    def details(self) -> tuple[str, ...]:
        """The traffic, and the latency if there is one, as text."""
        parts = [f"traffic {self.traffic}"] if self.traffic else []
        if self.latency_ticks:
            parts.append(f"latency {self.latency_ticks} tick{'s' * (self.latency_ticks > 1)}")
        return tuple(parts)

    @property
    def label(self) -> str:
        """All of it as text."""
        return " · ".join((self.data, *self.details))


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of `metrics.csv`, in long form. Fields that do not apply are empty."""

    data: str
    """DATA as given on the command line."""
    predictor: str = ""
    """Name of the predictor as given, with its run folder if it is trained."""
    trained_on: str = ""
    """Training data of the predictor."""
    view: str = ""
    """View of the predictor's network."""
    recipe: str = ""
    """Training recipe of the predictor and, after a plus sign, its variant."""
    chaining: str = ""
    """How the predictor chains segments for horizons beyond its own."""
    planner: str = ""
    """Name of the planner; empty in open loop."""
    traffic: str = ""
    """Drivers of the other agents, as given by `--traffic`."""
    latency_ticks: int | None = None
    """Delay of the plans in ticks."""
    horizon_s: float | None = None
    """Forecast horizon in seconds."""
    selection: str = ""
    """Which mode an error is of: `most-probable`, `best-of-3`, or empty for all modes together."""
    subset: str = "all"
    """Targets or scenarios that are averaged over, such as `moving` or a scenario tag."""
    metric: str
    """Name of the metric."""
    value: float
    """Mean, or ratio of means."""
    low: float | None = None
    """Lower bound of the 95 % interval."""
    high: float | None = None
    """Upper bound of the 95 % interval."""
    n: int
    """Number of snippets or scenarios."""
    rules: str = ""
    """Driving rules and their version, such as `nuplan 1`; empty in open loop."""
    runs: int | None = None
    """Number of training runs that are averaged; 1 for a predictor without training."""
    mde: float | None = None
    """Minimal detectable effect of a difference, in the unit of the metric."""
    p_holm: float | None = None
    """Two-sided p value of a difference, adjusted by Holm's method over all methods."""


def fallback_shares(rows: Sequence[Row]) -> dict[str, float]:
    """Share of the forecasts that were blended to constant velocity, by guarded predictor."""
    return {
        row.predictor: round(row.value, 4)
        for row in rows
        if row.metric == FALLBACK and row.subset == "all"
    }


def fallback_sentences(shares: Mapping[str, float], what: str) -> list[str]:
    """A sentence for each guarded predictor.

    Args:
        shares: as of `fallback_shares`.
        what: what the shares are of, in the plural.
    """
    return [
        f"{name}: {100 * share:.1f} % of the {what} are blended to constant velocity"
        for name, share in shares.items()
    ]


def write_metrics(folder: Path, rows: Sequence[Row]) -> None:
    """Writes `metrics.csv`; numbers have six significant digits.

    Args:
        folder: an existing folder.
        rows: the lines of the file, in order.
    """
    with (
        atomic_file(folder / "metrics.csv") as partial,
        partial.open("w", newline="") as file,
    ):
        writer = csv.DictWriter(file, [field.name for field in fields(Row)])
        writer.writeheader()
        for row in rows:
            writer.writerow({k: _cell(v) for k, v in asdict(row).items()})


def _cell(value: object) -> object:
    if isinstance(value, float):
        return f"{value:.6g}"
    return "" if value is None else value


def write_manifest(folder: Path, command: str, **content: Any) -> None:
    """Writes `manifest.json`, which contains no time and no machine, so that runs repeat exactly.

    Args:
        folder: an existing folder.
        command: name of the command.
        **content: configuration, data and seeds; values that JSON lacks become strings.
    """
    versions: dict[str, str] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    manifest: Mapping[str, Any] = {"command": command, **content, "versions": versions}
    with atomic_file(folder / "manifest.json") as partial:
        partial.write_text(json.dumps(manifest, indent=2, default=str) + "\n")
