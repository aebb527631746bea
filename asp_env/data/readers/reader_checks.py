"""Checks of what readers return, which other packages may have written."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from asp_env.data.classes import AgentClass
from asp_env.data.readers.lanelet2 import Lanelet2File
from asp_env.data.readers.measurements import Measurements
from asp_env.data.readers.ranges import (
    HEADING_RAD,
    HIGHEST_LIMIT_MPS,
    POSITION,
    SIZE,
    TIME_MS,
    Limit,
)
from asp_env.data.road_map import RoadMap

_FLOATS: dict[str, tuple[int | None, Limit, bool]] = {
    "time_ms": (None, TIME_MS, False),
    "positions": (2, POSITION, False),
    "heading": (None, HEADING_RAD, True),
    "sizes": (2, SIZE, True),
}
"""Columns of `Measurements`: number of components, plausible range, and whether NaN is allowed."""


def checked_measurements(given: object) -> Measurements:
    """The rows with columns of the documented types and shapes.

    Args:
        given: what a reader returned as `Measurements`.

    Raises:
        ValueError: a column has another shape or kind, or is implausible. The message names it.
    """
    if not isinstance(given, Measurements):
        raise ValueError(f"measurements: {type(given).__name__}, expected Measurements")
    track = _whole("track", given.track, None)
    rows = len(track)
    classes = _whole("classes", given.classes, rows)
    if rows and not (int(classes.min()) >= 0 and int(classes.max()) < len(AgentClass)):
        raise ValueError(f"classes: {int(classes.min())} to {int(classes.max())}, expected classes")
    columns = {
        name: _floats(name, getattr(given, name), rows, *about) for name, about in _FLOATS.items()
    }
    sizes = np.nan_to_num(columns.pop("sizes"), nan=0.0)
    speed = given.speed
    if speed is not None:
        speed = _floats("speed", speed, rows, None, None, may_be_nan=True)
    return replace(
        given, track=track, classes=classes.astype(np.int8), sizes=sizes, speed=speed, **columns
    )


def check_properties(tables: Any) -> None:
    """Checks the other fields of `RecordingTables`.

    Raises:
        ValueError: one has another type or is implausible. The message names it.
    """
    for name, kind in (("location", str), ("weekday", str | None)):
        if not isinstance(getattr(tables, name), kind):
            raise ValueError(f"{name}: {getattr(tables, name)!r}, expected a text")
    hour, limit = tables.start_hour, tables.speed_limit_mps
    if hour is not None and not (_is_number(hour) and 0 <= hour < 24):
        raise ValueError(f"start_hour: {hour!r}, expected hours from 0 to 24, or None")
    if limit is not None and not (_is_number(limit) and 0 < limit <= HIGHEST_LIMIT_MPS):
        raise ValueError(
            f"speed_limit_mps: {limit!r}, expected at most {HIGHEST_LIMIT_MPS:g} m/s, or None"
        )
    if not isinstance(tables.road_map, RoadMap | Lanelet2File | None):
        raise ValueError(f"road_map: {type(tables.road_map).__name__}, expected a map")
    if isinstance(tables.repairs, str) or not all(isinstance(each, str) for each in tables.repairs):
        raise ValueError("repairs: expected a tuple of texts")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _whole(name: str, given: Any, rows: int | None) -> np.ndarray:
    values = np.asarray(given)
    if values.ndim != 1 or (rows is not None and len(values) != rows):
        raise ValueError(f"{name}: shape {values.shape}, expected {_shape(rows, None)}")
    if values.dtype.kind not in "iu":
        raise ValueError(f"{name}: {values.dtype}, expected whole numbers; number_ids has some")
    return values.astype(np.int64)


def _floats(
    name: str, given: Any, rows: int, parts: int | None, limit: Limit | None, may_be_nan: bool
) -> np.ndarray:
    values = np.asarray(given)
    shape = (rows,) if parts is None else (rows, parts)
    if values.shape != shape:
        raise ValueError(f"{name}: shape {values.shape}, expected {_shape(rows, parts)}")
    if values.dtype.kind not in "iuf":
        raise ValueError(f"{name}: {values.dtype}, expected numbers")
    values = values.astype(np.float64)
    known = values[~np.isnan(values)]
    if len(known) < values.size and not may_be_nan:
        raise ValueError(f"{name}: {values.size - len(known):,} values are NaN, expected numbers")
    if limit is not None and (np.abs(known) > limit.largest).any():
        raise ValueError(f"{name}: {known[np.abs(known).argmax()]:g}, expected {limit}")
    return values


def _shape(rows: int | None, parts: int | None) -> str:
    return f"({'rows' if rows is None else rows}{',' if parts is None else f', {parts}'})"
