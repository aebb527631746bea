"""What every output folder holds, and how it comes to be there whole or not at all."""

import csv
import json
import os
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import Any

from asp_env.errors import AspEnvError

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


@contextmanager
def output_folder(out: Path) -> Iterator[Path]:
    """A folder to write into that becomes `out` when all has gone well, and else disappears.

    Raises:
        AspEnvError: `out` exists and is not an empty folder, or cannot be written.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise AspEnvError(f"{out}: exists already; choose another --out or remove it")
    home = next(folder for folder in out.absolute().parents if folder.exists())
    aside = home / f".{out.name}.{os.getpid()}.partial"
    try:
        aside.mkdir()
    except OSError as error:
        raise AspEnvError(
            f"{out}: cannot be written ({error.strerror}); choose another --out"
        ) from error
    try:
        yield aside
        out.parent.mkdir(parents=True, exist_ok=True)
        if out.exists():
            out.rmdir()
        aside.replace(out)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def write_metrics(folder: Path, rows: Sequence[Row]) -> None:
    """`metrics.csv`."""
    with (folder / "metrics.csv").open("w", newline="") as file:
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
    (folder / "manifest.json").write_text(json.dumps(manifest, indent=2, default=str) + "\n")
