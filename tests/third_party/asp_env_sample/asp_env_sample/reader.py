"""A reader: tables `NAME.sample.csv` with the columns agent, time_s, east_m and north_m."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from asp_env.data.readers import (
    ClassNames,
    FoundRecording,
    Measurements,
    RecordingTables,
    has_columns,
    read_table,
)
from asp_env.data.readers.tables import Kind

COLUMNS: Mapping[str, Kind] = {
    "agent": "whole",
    "time_s": "number",
    "east_m": "number",
    "north_m": "number",
}


def find_recordings(folder: Path) -> Iterator[FoundRecording]:
    """The tables in and below a folder."""
    for path in sorted(folder.rglob("*.sample.csv")):
        if has_columns(path, COLUMNS):
            name = path.name.removesuffix(".sample.csv")
            yield FoundRecording(name=name, tables=(path,), read=read_recording)


def read_recording(paths: tuple[Path, ...]) -> RecordingTables:
    """Positions of cars over time."""
    table = read_table(paths[0], COLUMNS)
    rows = len(table["agent"])
    names = ClassNames()
    return RecordingTables(
        measurements=Measurements(
            track=table["agent"],
            time_ms=1000.0 * table["time_s"],
            classes=names.classes(np.full(rows, "car", dtype=object), table["agent"]),
            positions=np.stack([table["east_m"], table["north_m"]], axis=-1),
            heading=np.full(rows, np.nan),
            sizes=np.zeros((rows, 2)),
        ),
        location=paths[0].parent.name,
        repairs=("all agents are taken for cars",),
    )
