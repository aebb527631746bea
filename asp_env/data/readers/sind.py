"""SinD: signalised crossings in China; tables of vehicles, pedestrians and changes of the lights.

A recording is a folder with `Veh_smoothed_tracks.csv`, optionally `Ped_smoothed_tracks.csv` and
`Traffic_Lights.csv` (or `TrafficLight_NAME.csv`); the location's lanelet2 map, `.osm`, lies in this
folder or in one above. Positions and the map are in metres from 0° N 0° E. The format is described
in https://github.com/SOTIF-AVLab/SinD/blob/main/Format.md.

No file contains where the lights' stop lines are. `stop_lines.csv` beside the lights gives them,
with the columns `signal, x1, y1, x2, y2`: the number of the light's column and two points, m.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from asp_env.data.readers.found import FoundRecording, RecordingTables, SignalChanges
from asp_env.data.readers.interaction import measurements_of, read_measurements
from asp_env.data.readers.lanelet2 import parse_lanelet2
from asp_env.data.readers.layout import (
    ClassNames,
    is_hidden,
    map_suffix,
    may_be_read,
    shorten,
    walk,
    with_parents,
)
from asp_env.data.readers.positions import Origin
from asp_env.data.readers.ranges import HEADING_RAD
from asp_env.data.readers.tables import Kind, header_of, read_table
from asp_env.data.signals import SignalState
from asp_env.errors import DataError

VEHICLES = "veh_smoothed_tracks.csv"
PEDESTRIANS = "ped_smoothed_tracks.csv"
STOP_LINES = "stop_lines.csv"

STATES: Mapping[float, SignalState] = {
    0: SignalState.RED,
    1: SignalState.GREEN,
    3: SignalState.AMBER,
}
"""State of a light by its number in the files."""

_LIGHTS = re.compile(r"^traffic_?lights?.*\.csv$", re.IGNORECASE)
_LIGHT = re.compile(r"light\s*([0-9]+)$", re.IGNORECASE)
_TIME = "timestamp(ms)"
_TRACKS: Mapping[str, Kind] = {
    "track_id": "text",
    "timestamp_ms": "number",
    "agent_type": "text",
    "x": "number",
    "y": "number",
    "yaw_rad": "number or empty",
    "length": "number or empty",
    "width": "number or empty",
}
_LIMITS = {"yaw_rad": HEADING_RAD}
_OF_VEHICLES = frozenset({"yaw_rad", "length", "width"})


def find_recordings(folder: Path) -> Iterator[FoundRecording]:
    """The recordings in and below a folder, named `LOCATION/NAME` after their folders."""
    for place, names in walk(folder):
        by_name = {name.lower(): place / name for name in names}
        if VEHICLES not in by_name:
            continue
        lights = [path for name, path in by_name.items() if _LIGHTS.match(name)]
        files = (
            by_name.get(PEDESTRIANS),
            *lights[:1],
            by_name.get(STOP_LINES),
            _map(place, folder),
        )
        yield FoundRecording(
            name=f"{place.parent.name}/{place.name}",
            tables=(by_name[VEHICLES], *(path for path in files if path is not None)),
            read=read_sind,
        )


def read_sind(paths: tuple[Path, ...]) -> RecordingTables:
    """Reads one recording.

    Raises:
        DataError: a file is damaged.
    """
    by_name = {path.name.lower(): path for path in paths}
    names = ClassNames()
    vehicles = _tracks(by_name[VEHICLES], names)
    ids = [vehicles["track_id"]]
    tables = [vehicles]
    if PEDESTRIANS in by_name:
        tables.append(_tracks(by_name[PEDESTRIANS], names))
        ids.append(np.array([f"pedestrian {name}" for name in tables[1]["track_id"]], dtype=object))
    columns = {name: np.concatenate([table[name] for table in tables]) for name in vehicles}
    columns["track_id"] = _numbers(*ids)
    repairs = names.repairs()
    lights = next((path for name, path in by_name.items() if _LIGHTS.match(name)), None)
    signals = None
    if lights is not None:
        signals = _signals(lights, by_name.get(STOP_LINES), repairs)
    found = next((path for path in paths if map_suffix(path) == ".osm"), None)
    origin = Origin.at(latitude_deg=0.0, longitude_deg=0.0)
    return RecordingTables(
        measurements=measurements_of(columns),
        location=paths[0].parent.parent.name,
        road_map=None if found is None else parse_lanelet2(found, origin),
        signals=signals,
        repairs=tuple(repairs),
    )


def _map(place: Path, root: Path) -> Path | None:
    """The lanelet2 map of a recording's folder: in the nearest folder with one, up to `root`."""
    for folder in with_parents(place, root):
        maps = sorted(
            path
            for path in folder.iterdir()
            if map_suffix(path) == ".osm" and not is_hidden(path.name) and may_be_read(path)
        )
        if maps:
            location = place.parent.name.lower()
            return min(maps, key=lambda path: (location not in path.stem.lower(), path))
    return None


def _tracks(path: Path, names: ClassNames) -> dict[str, np.ndarray]:
    columns = read_measurements(path, names, _TRACKS, optional=_OF_VEHICLES, limits=_LIMITS)
    columns["psi_rad"] = columns.pop("yaw_rad")
    return columns


def _numbers(vehicles: np.ndarray, pedestrians: np.ndarray | None = None) -> np.ndarray:
    """Ids as numbers: those of vehicles as in the file if they are whole, then pedestrians'."""
    codes, known = pd.factorize(vehicles)
    numbers = np.array(pd.to_numeric(pd.Series(known), errors="coerce"), dtype=np.float64)
    is_plain = np.isfinite(numbers) & (numbers == np.floor(numbers)) & (np.abs(numbers) < 2**53)
    if not is_plain.all():
        numbers = np.arange(len(known), dtype=np.float64)
    first = int(numbers.max(initial=-1)) + 1
    parts = [numbers[codes]]
    if pedestrians is not None:
        parts.append(first + pd.factorize(pedestrians)[0])
    return np.concatenate(parts)


def _signals(lights: Path, stop_lines: Path | None, repairs: list[str]) -> SignalChanges:
    columns = [name for name in header_of(lights) if _LIGHT.search(name)]
    if not columns:
        raise DataError(f"{lights}: has no column such as 'Traffic light 1'; copy it again")
    table = read_table(lights, {_TIME: "number", **dict.fromkeys(columns, "number")})
    order = np.argsort(table[_TIME], kind="stable")
    codes = np.stack([table[name][order] for name in columns])
    states = np.full(codes.shape, SignalState.UNKNOWN, dtype=np.int8)
    for code, state in STATES.items():
        states[codes == code] = state
    odd = np.unique(codes[~np.isin(codes, list(STATES))])
    if len(odd):
        count = int((~np.isin(codes, list(STATES))).sum())
        repairs.append(
            f"{count} states of lights have unknown numbers ({shorten([f'{o:g}' for o in odd])}), "
            "expected 0, 1 or 3: read as unknown"
        )
    lines = np.full((len(columns), 2, 2), np.nan)
    if stop_lines is not None:
        kinds: dict[str, Kind] = dict.fromkeys(("x1", "y1", "x2", "y2"), "number")
        given = read_table(stop_lines, {"signal": "whole", **kinds})
        numbers = [int(_LIGHT.findall(name)[0]) for name in columns]
        for row, number in enumerate(given["signal"].tolist()):
            if number not in numbers:
                raise DataError(
                    f"{stop_lines}, line {row + 2}: signal is {number}, expected one of "
                    f"{', '.join(map(str, numbers))} as in {lights.name}"
                )
            ends = [float(given[name][row]) for name in kinds]
            lines[numbers.index(number)] = np.reshape(ends, (2, 2))
    unknown = int(np.isnan(lines[:, 0, 0]).sum())
    if unknown:
        repairs.append(
            f"{unknown} of {len(columns)} lights have no stop line, so that scenes do not show "
            f"them: give the lines in {STOP_LINES}"
        )
    return SignalChanges(stop_lines=lines, time_ms=table[_TIME][order], states=states)
