"""SinD: signalised crossings in China; tables of vehicles, pedestrians and changes of the lights.

A recording is a folder with `Veh_smoothed_tracks.csv`, optionally `Ped_smoothed_tracks.csv` and
`Traffic_Lights.csv` (or `TrafficLight_NAME.csv`); the location's lanelet2 map, `.osm`, lies in this
folder or in one above, or in `maps` there. Positions and the map are in metres from 0° N 0° E. The
format is described in https://github.com/SOTIF-AVLab/SinD/blob/main/Format.md.

Columns of lights are called `Traffic light N` or `Vehicle Traffic light N`; those of lights for
pedestrians are left out. No file of the release contains where the stop lines are. A file of one's
own, `stop_lines.csv` beside the lights, may give them, with the columns `signal, x1, y1, x2, y2`:
the number of the light's column and two points, m. A recording is read without it, and without
lights that cannot be read.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int8

from asp_env.data.readers.compressed import plain_name
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
from asp_env.data.readers.tables import Kind, header_of, number_texts, read_table
from asp_env.data.signals import SignalState
from asp_env.errors import DataError

VEHICLES = "veh_smoothed_tracks.csv"
PEDESTRIANS = "ped_smoothed_tracks.csv"
STOP_LINES = "stop_lines.csv"
MAPS = "maps"

STATES: Mapping[float, SignalState] = {
    0: SignalState.RED,
    1: SignalState.GREEN,
    3: SignalState.AMBER,
}
"""State of a light by its number in the files."""

_LIGHTS = re.compile(r"^traff?ic_?lights?.*\.csv$", re.IGNORECASE)
_LIGHT = re.compile(r"light\s*([0-9]+)$", re.IGNORECASE)
_PEDESTRIAN = re.compile(r"^ped", re.IGNORECASE)
_TIME = "timestamp(ms)"
_FRAME = "RawFrameID"
_TRACKS: Mapping[str, Kind] = {
    "track_id": "text",
    "timestamp_ms": "number",
    "agent_type": "text",
    "x": "number",
    "y": "number",
    "vx": "number or empty",
    "vy": "number or empty",
    "yaw_rad": "number or empty",
    "length": "number or empty",
    "width": "number or empty",
}
_LIMITS = {"yaw_rad": HEADING_RAD}
_OF_VEHICLES = frozenset({"vx", "vy", "yaw_rad", "length", "width"})


def find_recordings(folder: Path) -> Iterator[FoundRecording]:
    """The recordings in and below a folder, named `LOCATION/NAME` after their folders."""
    for place, names in walk(folder):
        by_name = {plain_name(name): place / name for name in names}
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
    by_name = {plain_name(path.name): path for path in paths}
    names = ClassNames()
    vehicles = _tracks(by_name[VEHICLES], names)
    ids = [vehicles["track_id"]]
    tables = [vehicles]
    if PEDESTRIANS in by_name:
        tables.append(_tracks(by_name[PEDESTRIANS], names))
        ids.append(np.array([f"pedestrian {name}" for name in tables[1]["track_id"]], dtype=object))
    columns = {name: np.concatenate([table[name] for table in tables]) for name in vehicles}
    numbered = number_texts(np.concatenate(ids))
    columns["track_id"] = numbered.numbers
    repairs = [*names.repairs(), *numbered.repairs]
    lights = next((path for name, path in by_name.items() if _LIGHTS.match(name)), None)
    signals = None
    if lights is not None:
        try:
            changes = _changes(lights, repairs)
        except DataError as error:
            repairs.append(f"the lights are left out: {error}")
        else:
            signals = _placed(lights, *changes, by_name.get(STOP_LINES), repairs)
        of_lights = sorted(
            path.name
            for path in lights.parent.iterdir()
            if _LIGHTS.match(plain_name(path.name)) and plain_name(path.name) not in by_name
        )
        if of_lights:
            repairs.append(f"{len(of_lights)} other files of lights not read: {shorten(of_lights)}")
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
        inside = [each for each in folder.iterdir() if each.name.lower() == MAPS and each.is_dir()]
        maps = sorted(
            path
            for each in (folder, *inside)
            for path in each.iterdir()
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


def _changes(
    lights: Path, repairs: list[str]
) -> tuple[Float[np.ndarray, " changes"], dict[int, Int8[np.ndarray, " changes"]]]:
    """When the lights of vehicles change, ms, and their states from then on, by number.

    Raises:
        DataError: the file is damaged, or has no such lights.
    """
    names = [name for name in header_of(lights) if _LIGHT.search(name)]
    columns = {int(_LIGHT.findall(n)[0]): n for n in names if not _PEDESTRIAN.match(n)}
    if not columns:
        raise DataError(f"{lights}: has no column such as 'Traffic light 1'; copy it again")
    if len(columns) < len(names):
        repairs.append(f"{len(names) - len(columns)} lights of pedestrians are left out")
    kinds: dict[str, Kind] = {
        **{_TIME: "number or empty", _FRAME: "number or empty"},
        **dict.fromkeys(columns.values(), "number"),
    }
    table = read_table(lights, kinds, optional=frozenset({_FRAME}))
    times_ms = _complete_times(lights, table, repairs)
    known = np.flatnonzero(np.isfinite(times_ms))
    order = known[np.argsort(times_ms[known], kind="stable")]
    codes = np.stack([table[name][order] for name in columns.values()])
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
    return times_ms[order], dict(zip(columns, states, strict=True))


def _complete_times(
    lights: Path, table: Mapping[str, np.ndarray], repairs: list[str]
) -> Float[np.ndarray, " rows"]:
    """The times of all rows, ms: where one is empty it follows from the frame, else it is NaN.

    Frames and times are those of one video, so that the times are a line over the frames.
    """
    times_ms, frames = table[_TIME].copy(), table.get(_FRAME)
    missing = ~np.isfinite(times_ms)
    if not missing.any():
        return times_ms
    usable = None if frames is None else ~missing & np.isfinite(frames)
    if frames is not None and usable is not None and len(np.unique(frames[usable])) > 1:
        rate, offset = np.polyfit(frames[usable], times_ms[usable], 1)
        times_ms[missing] = offset + rate * frames[missing]
    left_out = int((~np.isfinite(times_ms)).sum())
    if found := int(missing.sum()) - left_out:
        repairs.append(f"{found} rows of {lights.name} have no time, which follows from {_FRAME}")
    if left_out:
        repairs.append(f"{left_out} rows of {lights.name} have no time and are left out")
    return times_ms


def _placed(
    lights: Path,
    times_ms: Float[np.ndarray, " changes"],
    states: Mapping[int, Int8[np.ndarray, " changes"]],
    stop_lines: Path | None,
    repairs: list[str],
) -> SignalChanges:
    """The lights with the stop lines that the user's own file gives.

    Raises:
        DataError: that file is damaged.
    """
    numbers = list(states)
    lines = np.full((len(numbers), 2, 2), np.nan)
    if stop_lines is not None:
        kinds: dict[str, Kind] = dict.fromkeys(("x1", "y1", "x2", "y2"), "number")
        given = read_table(stop_lines, {"signal": "whole", **kinds})
        for row, number in enumerate(given["signal"].tolist()):
            if number not in numbers:
                raise DataError(
                    f"{stop_lines}, line {row + 2}: signal is {number}, expected one of "
                    f"{', '.join(map(str, numbers))} as in {lights.name}"
                )
            ends = [float(given[name][row]) for name in kinds]
            if number in given["signal"][:row]:
                raise DataError(
                    f"{stop_lines}, line {row + 2}: a second stop line of signal {number}, "
                    "expected one; remove one of the two"
                )
            lines[numbers.index(number)] = np.reshape(ends, (2, 2))
    unknown = int(np.isnan(lines[:, 0, 0]).sum())
    if unknown:
        repairs.append(
            f"{unknown} of {len(numbers)} lights have no stop line, so that scenes do not show "
            f"them: give the lines in {STOP_LINES}"
        )
    return SignalChanges(stop_lines=lines, time_ms=times_ms, states=np.stack([*states.values()]))
