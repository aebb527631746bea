"""What every output folder holds."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of `metrics.csv`: the long form. Fields that do not apply stay empty."""

    data: str
    predictor: str = ""
    trained_on: str = ""
    view: str = ""
    recipe: str = ""
    chaining: str = ""
    planner: str = ""
    traffic: str = ""
    latency_ticks: int | None = None
    horizon_s: float | None = None
    selection: str = ""
    subset: str = "all"
    metric: str
    value: float
    low: float | None = None
    high: float | None = None
    n: int
    rules: str = ""
    """By which preset of metrics, and which version of it, drives were judged."""


def write_metrics(folder: Path, rows: Sequence[Row]) -> None:
    """`metrics.csv`."""
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


def write_manifest(folder: Path, command: str, **what: Any) -> None:
    """`manifest.json`: configuration, data, seeds and versions; no time, no machine."""
    versions: dict[str, str] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    manifest: Mapping[str, Any] = {"command": command, **what, "versions": versions}
    with atomic_file(folder / "manifest.json") as partial:
        partial.write_text(json.dumps(manifest, indent=2, default=str) + "\n")
