"""The CSV tables of geo-trax, the layout of the Songdo drone data.

One row for each vehicle and frame: `Vehicle_ID, Timestamp, Frame_Number, Local_X, Local_Y, …`. See
Fonod et al., "Advanced computer vision for extracting georeferenced vehicle trajectories from drone
imagery", Transportation Research Part C, 2025. A table has no headings and no lanelet2 map.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from asp_env.data.readers.compressed import CSV
from asp_env.data.readers.found import FoundRecording, RecordingTables
from asp_env.data.readers.interaction import KMH_PER_MPS
from asp_env.data.readers.layout import ClassNames, walk
from asp_env.data.readers.measurements import Measurements
from asp_env.data.readers.ranges import POSITION, SIZE, Limit
from asp_env.data.readers.tables import Kind, find_line, has_columns, number_ids, read_table
from asp_env.errors import DataError
from asp_env.stored import brief

CLASSES: Mapping[str, str] = {"0": "car", "1": "bus", "2": "truck", "3": "motorcycle"}
"""Class by its number; 0 includes vans."""

_COLUMNS: Mapping[str, Kind] = {
    "Vehicle_ID": "id",
    "Timestamp": "text",
    "Local_X": "number",
    "Local_Y": "number",
    "Vehicle_Class": "text",
    "Vehicle_Length": "number or empty",
    "Vehicle_Width": "number or empty",
}
_SPEED: Mapping[str, Kind] = {"Vehicle_Speed": "number or empty"}
_LIMITS: Mapping[str, Limit] = {
    "Local_X": POSITION,
    "Local_Y": POSITION,
    "Vehicle_Length": SIZE,
    "Vehicle_Width": SIZE,
}
_LOCATION = re.compile(r"^\d{4}-\d{2}-\d{2}_([A-Za-z0-9]+)_", re.ASCII)
_ROUND_M = 100.0
_FRAME = "Frame_Number"

RATES_HZ = (10.0, 12.5, 15.0, 20.0, 23.976, 24.0, 25.0, 29.97, 30.0, 50.0, 59.94, 60.0)
"""Frame rates of cameras, one of which is assumed where times are too coarse to measure it."""

LEAST_FRAMES = 200
"""Frames between two changes of a coarse time stamp from which on these give the rate to 0.5 %."""


def find_recordings(folder: Path) -> Iterator[FoundRecording]:
    """The tables in and below a folder; a recording is named after its file."""
    for place, names in walk(folder):
        for name in names:
            if re.search(rf"{CSV}$", name, re.IGNORECASE):
                path = place / name
                if has_columns(path, _COLUMNS):
                    title = (place.relative_to(folder) / name.split(".")[0]).as_posix()
                    yield FoundRecording(name=title, tables=(path,), read=read_geo_trax)


def read_geo_trax(paths: tuple[Path, ...]) -> RecordingTables:
    """Reads one table. Positions are relative to a multiple of 100 m below the smallest ones.

    Raises:
        DataError: the table is damaged.
    """
    (path,) = paths
    columns: Mapping[str, Kind] = {**_COLUMNS, **_SPEED}
    table = read_table(path, columns, optional=frozenset(_SPEED), limits=_LIMITS)
    numbered = number_ids(table["Vehicle_ID"])
    track = numbered.columns[0]
    try:
        times = pd.to_datetime(pd.Series(table["Timestamp"]), format="ISO8601", errors="coerce")
    except ValueError as error:
        raise DataError(
            f"{path}: Timestamp has several time zones, expected one or none: convert the column"
        ) from error
    if times.isna().any():
        text = str(table["Timestamp"][int(times.isna().to_numpy().argmax())])
        line = find_line(path, {"Timestamp": text})
        raise DataError(
            f"{path}, line {line}: Timestamp is {brief(repr(text))}, expected such as "
            "2022-10-07 17:52:13.500"
        )
    names = ClassNames()
    given = [
        CLASSES.get(re.sub(r"\.0*$", "", str(name).strip()), name)
        for name in table["Vehicle_Class"]
    ]
    classes = names.classes(np.array(given, dtype=object), track)
    positions = np.stack([table["Local_X"], table["Local_Y"]], axis=-1)
    origin = np.floor(positions.min(axis=0) / _ROUND_M) * _ROUND_M
    sizes = np.stack([table["Vehicle_Length"], table["Vehicle_Width"]], axis=-1)
    speed = table.get("Vehicle_Speed")
    first = times.min()
    repairs = [*names.repairs(), *numbered.repairs]
    time_ms = ((times - first) / pd.Timedelta(milliseconds=1)).to_numpy(dtype=np.float64)
    order = np.lexsort((time_ms, track))
    steps_ms = np.diff(time_ms[order])[np.diff(track[order]) == 0]
    if len(steps_ms) and np.median(steps_ms) == 0:
        time_ms = _times_of_frames(path, track, time_ms, repairs)
    named = _LOCATION.match(path.name)
    return RecordingTables(
        measurements=Measurements(
            track=track,
            time_ms=time_ms,
            classes=classes,
            positions=positions - origin,
            heading=np.full(len(track), np.nan),
            sizes=np.nan_to_num(sizes, nan=0.0),
            speed=speed if speed is None else speed / KMH_PER_MPS,
        ),
        location=named[1] if named else path.parent.name,
        start_hour=first.hour + first.minute / 60 + first.second / 3600,
        weekday=first.day_name().lower(),
        repairs=tuple(repairs),
    )


def _times_of_frames(
    path: Path,
    track: Int[np.ndarray, " rows"],
    stamps_ms: Float[np.ndarray, " rows"],
    repairs: list[str],
) -> Float[np.ndarray, " rows"]:
    """Times, ms, of rows of which most have the stamp of the row before, such as whole seconds.

    They follow from `Frame_Number`. The rate is that of `RATES_HZ` that is nearest to the frames
    from the first to the last change of the stamp, divided by the time between both. It has to
    explain all stamps to two frames.

    Raises:
        DataError: there are no frames, or no rate explains the stamps.
    """
    coarse = f"{path}: Timestamp has the same time in several rows of a track"
    if not has_columns(path, [_FRAME]):
        raise DataError(
            f"{coarse}, and there is no column {_FRAME}; expected fractions of seconds, or the "
            "number of the frame in that column: export the table with them"
        )
    frames = read_table(path, {_FRAME: "whole"})[_FRAME]
    rows = np.stack([track, frames], axis=-1)
    if len(np.unique(rows, axis=0)) < len(rows):
        raise DataError(
            f"{coarse}, and so has {_FRAME}; expected one row for each vehicle and frame: export "
            "the table again"
        )
    stamps, inverse = np.unique(stamps_ms, return_inverse=True)
    begins = np.full(len(stamps), np.iinfo(np.int64).max)
    np.minimum.at(begins, inverse, frames)
    num_frames = int(begins[-1] - begins[1]) if len(stamps) > 2 else 0
    if num_frames < LEAST_FRAMES:
        raise DataError(
            f"{coarse}, and lasts {num_frames} frames from its first to its last change; expected "
            f"at least {LEAST_FRAMES} to find the frame rate, or fractions of seconds: export the "
            "table with them"
        )
    measured_hz = 1000.0 * num_frames / float(stamps[-1] - stamps[1])
    rate_hz = min(RATES_HZ, key=lambda each: abs(each - measured_hz))
    time_ms = (frames - frames.min()) * (1000.0 / rate_hz)
    late_ms = time_ms - stamps_ms
    resolution_ms = float(np.median(np.diff(stamps)))
    if late_ms.max() - late_ms.min() > resolution_ms + 2000.0 / rate_hz:
        raise DataError(
            f"{coarse}, and with {_FRAME} makes {measured_hz:.2f} Hz, which is no camera's rate "
            f"({', '.join(f'{each:g}' for each in RATES_HZ)}); expected fractions of seconds: "
            "export the table with them"
        )
    repairs.append(
        f"Timestamp has the same time in several rows of a track: times follow from {_FRAME} at "
        f"{rate_hz:g} Hz, a guess from {num_frames:,} frames in "
        f"{(stamps[-1] - stamps[1]) / 1000:g} s ({measured_hz:.2f} Hz)"
    )
    return time_ms
