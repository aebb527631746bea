"""`XX_recordingMeta.csv` of the inD/rounD layout: one row about the recording as a whole."""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from asp_env.data.readers.positions import Origin
from asp_env.data.readers.ranges import HIGHEST_LIMIT_MPS, POSITION, Limit
from asp_env.data.readers.tables import EMPTY, HIGHEST_HZ, LOWEST_HZ, read_table
from asp_env.errors import DataError
from asp_env.stored import brief

_TIME = re.compile(r"^(\d{1,2}(?:\.\d*)?)(?::([0-5]\d)(?::[0-5]\d)?)?$", re.ASCII)
_WEEKDAY = re.compile(
    r"^(mon|tue(s)?|wed(nes)?|thu(r)?(s)?|fri|sat(ur)?|sun)(day)?\.?$", re.IGNORECASE
)
_UNKNOWN = (*EMPTY, "-1", "-1.0")
"""Texts of optional cells for an unknown value."""
_TEXTS = ("orthoPxToMeter", "startTime", "weekday")
"""Optional columns of `XX_recordingMeta.csv` that may contain anything."""
_LIMITS: Mapping[str, Limit] = {
    "xUtmOrigin": POSITION,
    "yUtmOrigin": POSITION,
    "latLocation": Limit(largest=90.0, unit="degrees"),
    "lonLocation": Limit(largest=180.0, unit="degrees"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingMeta:
    """The content of `XX_recordingMeta.csv`."""

    number: int
    location: int
    frame_rate_hz: float
    speed_limit_mps: float | None
    metres_per_ortho_pixel: float | None
    origin: Origin
    start_hour: float | None = None
    """Time of day of the first frame, hours after midnight."""
    weekday: str | None = None
    repairs: tuple[str, ...] = ()
    """One line for each optional cell that cannot be read."""


def read_recording_meta(path: Path) -> RecordingMeta:
    """Reads `XX_recordingMeta.csv`.

    Raises:
        DataError: the file is damaged, or its frame rate is not positive.
    """
    needed = ("recordingId", "locationId", "frameRate", "xUtmOrigin", "yUtmOrigin")
    table = read_table(
        path,
        {
            **dict.fromkeys(needed[:2], "whole"),
            **dict.fromkeys(needed[2:], "number"),
            **dict.fromkeys(("latLocation", "lonLocation"), "number"),
            "speedLimit": "number or empty",
            **dict.fromkeys(_TEXTS, "text"),
        },
        optional=frozenset({"speedLimit", *_TEXTS}),
        limits=_LIMITS,
    )
    if len(table["frameRate"]) > 1:
        raise DataError(
            f"{path}, line 3: a second row (recordingId {table['recordingId'][1]}), expected one "
            "row, of one recording; remove the others"
        )
    rate = float(table["frameRate"][0])
    if not LOWEST_HZ <= rate <= HIGHEST_HZ:
        raise DataError(
            f"{path}, line 2: frameRate is {rate:g}, expected {LOWEST_HZ:g} to {HIGHEST_HZ:g} Hz"
        )
    cells = {name: str(table[name][0]).strip() for name in _TEXTS if name in table}
    texts = {name: "" if text in _UNKNOWN else text for name, text in cells.items()}
    scale, hour = texts.get("orthoPxToMeter", ""), texts.get("startTime", "")
    weekday = texts.get("weekday") or None
    return RecordingMeta(
        number=int(table["recordingId"][0]),
        location=int(table["locationId"][0]),
        frame_rate_hz=rate,
        speed_limit_mps=_speed_limit(path, table.get("speedLimit")),
        metres_per_ortho_pixel=_positive_or_none(scale),
        origin=Origin(
            x_m=float(table["xUtmOrigin"][0]),
            y_m=float(table["yUtmOrigin"][0]),
            longitude_deg=float(table["lonLocation"][0]),
            latitude_deg=float(table["latLocation"][0]),
        ),
        start_hour=_hour(hour),
        weekday=weekday,
        repairs=tuple(_unreadable(path.name, scale, hour, weekday)),
    )


def _positive_or_none(text: str) -> float | None:
    """The number in a cell. Files write nothing, 0, -1 or NaN for an unknown value."""
    value = _number(text)
    return value if 0 < value < math.inf else None


def _number(text: str) -> float:
    """The number of a text; NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _speed_limit(path: Path, cells: np.ndarray | None) -> float | None:
    """The cell of the optional column `speedLimit`, m/s.

    Raises:
        DataError: no limit is that high.
    """
    limit = math.nan if cells is None else float(cells[0])
    if limit > HIGHEST_LIMIT_MPS:
        raise DataError(
            f"{path}, line 2: speedLimit is {limit:g}, expected at most {HIGHEST_LIMIT_MPS:g} m/s, "
            "or -1 for none: convert the cell to m/s"
        )
    return limit if limit > 0 else None


def _unreadable(file_name: str, scale: str, hour: str, weekday: str | None) -> Iterator[str]:
    """A line for each optional cell that is not empty and cannot be read."""
    if scale and math.isnan(_number(scale)):
        yield (f"{file_name}: orthoPxToMeter is {brief(repr(scale))}, expected a number: left out")
    if hour and _hour(hour) is None:
        yield (
            f"{file_name}: startTime is {brief(repr(hour))}, expected a time of day such as 11, "
            "11.5 or 11:30: left out"
        )
    if weekday and not _WEEKDAY.match(weekday):
        yield (
            f"{file_name}: weekday is {brief(repr(weekday))}, expected the English name of a day "
            "such as monday: kept as it is"
        )


def _hour(text: str) -> float | None:
    """Hours after midnight of `11`, `11.5` or `11:30`; None for anything else."""
    match = _TIME.match(text)
    if match is None:
        return None
    hour = float(match[1]) + int(match[2] or 0) / 60
    return hour if hour < 24 else None
