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
    times = pd.to_datetime(pd.Series(table["Timestamp"]), format="ISO8601", errors="coerce")
    if times.isna().any():
        text = str(table["Timestamp"][int(times.isna().to_numpy().argmax())])
        line = find_line(path, {"Timestamp": text})
        raise DataError(
            f"{path}, line {line}: Timestamp is {brief(repr(text))}, expected such as "
            "2022-10-07 17:52:13.500"
        )
    names = ClassNames()
    classes = [
        CLASSES.get(re.sub(r"\.0*$", "", str(name).strip()), name)
        for name in table["Vehicle_Class"]
    ]
    positions = np.stack([table["Local_X"], table["Local_Y"]], axis=-1)
    origin = np.floor(positions.min(axis=0) / _ROUND_M) * _ROUND_M
    sizes = np.stack([table["Vehicle_Length"], table["Vehicle_Width"]], axis=-1)
    speed = table.get("Vehicle_Speed")
    first = times.min()
    named = _LOCATION.match(path.name)
    return RecordingTables(
        measurements=Measurements(
            track=track,
            time_ms=((times - first) / pd.Timedelta(milliseconds=1)).to_numpy(dtype=np.float64),
            classes=names.classes(np.array(classes, dtype=object), track),
            positions=positions - origin,
            heading=np.full(len(track), np.nan),
            sizes=np.nan_to_num(sizes, nan=0.0),
            speed=speed if speed is None else speed / KMH_PER_MPS,
        ),
        location=named[1] if named else path.parent.name,
        start_hour=first.hour + first.minute / 60 + first.second / 3600,
        weekday=first.day_name().lower(),
        repairs=(*names.repairs(), *numbered.repairs),
    )
