"""The INTERACTION layout: recordings of one or two CSV tables each, and their maps.

`vehicle_tracks_NNN.csv` and optionally `pedestrian_tracks_NNN.csv` lie in a folder named after
their location; the location's map is `LOCATION.osm` or, in local metres, `LOCATION.osm_xy`.
INTERACTION has `recorded_trackfiles/LOCATION/` and `maps/` in one folder, TAF-BW `LOCATION/` and
`maps/`. Positions are metres from an origin: (0, 0) degrees, or that of the recording's row in
`meta_data.csv` in the tracks' folder.

Only positions and times are used as they are. Published velocities may be scaled or have the wrong
sign and headings may be folded into ±90°, so both are derived from the positions. Frame ids are not
read: they may count frames that were left out.
"""

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from asp_env.data.classes import FOOTPRINTS_M, VULNERABLE
from asp_env.data.readers.layout import (
    MAP_SUFFIXES,
    TrackTable,
    classes_of,
    find_maps,
    natural_key,
    shorten,
    states_of,
    walk,
    with_parents,
)
from asp_env.data.readers.positions import Origin
from asp_env.data.readers.ranges import (
    HEADING_RAD,
    POSITION,
    SIZE,
    SPEED,
    TIME_MS,
    Limit,
    check_duration,
    check_extent,
)
from asp_env.data.readers.resampling import at_times, frames_within
from asp_env.data.readers.smoothing import (
    JUMP_M,
    count_held,
    find_jumps,
    follow_heading,
    smooth,
)
from asp_env.data.readers.tables import (
    Clock,
    Kind,
    find_line,
    number_ids,
    read_clock,
    read_columns,
)
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.errors import DataError

META = "meta_data.csv"
KMH_PER_MPS = 3.6

MIN_PIECE_S = 0.5
"""Pieces of tracks between gaps or jumps that are shorter than this are left out: they are too
short for an estimate of speed. Chosen by hand."""

FORWARD_ABOVE_MPS = 3.0
"""No vehicle drives backwards faster than this: above it, a heading against the motion is wrong.
Chosen by hand."""

MAX_WRONG_SHARE = 0.01
"""If more than this share of the headings of fast vehicles are wrong, the headings are taken to be
folded into ±90°. Chosen by hand: single tracker errors must not count."""

_PART = re.compile(r"^(vehicle|pedestrian)_tracks_([^.]+)\.csv(?:\.gz)?$")
_META_COLUMNS: dict[str, Kind] = {
    "id": "text",
    "originLat": "number",
    "originLon": "number",
    "speedLimit_kmh": "number",
    "locationId": "text",
}
_OPTIONAL_META = frozenset({"speedLimit_kmh", "locationId"})
_TRACKS: Mapping[str, Kind] = {
    "track_id": "id",
    "timestamp_ms": "number",
    "agent_type": "text",
    "x": "number",
    "y": "number",
    "psi_rad": "number",
    "length": "number",
    "width": "number",
}
_OPTIONAL_TRACKS = frozenset({"psi_rad", "length", "width"})
_LIMITS: Mapping[str, Limit] = {
    "timestamp_ms": TIME_MS,
    "x": POSITION,
    "y": POSITION,
    "psi_rad": HEADING_RAD,
    "length": SIZE,
    "width": SIZE,
    "speedLimit_kmh": Limit(largest=SPEED.largest * KMH_PER_MPS, unit="km/h"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class InteractionFiles:
    """The files of one recording. The path of a missing vehicle table is where it is expected."""

    name: str
    root: Path
    """The folder given as DATA. Maps are searched from the recording's folder up to it."""
    location: str
    number: str
    """The recording's number in the names of its files, such as `000`."""
    tracks: Path
    pedestrians: Path | None
    meta: Path | None

    @property
    def tables(self) -> tuple[Path, ...]:
        """The CSV files of the recording."""
        return tuple(path for path in (self.tracks, self.pedestrians, self.meta) if path)

    @property
    def background(self) -> None:
        """None: this layout has no background images."""
        return

    def check_complete(self) -> None:
        """Checks that the table of vehicles exists.

        Raises:
            DataError: there is a table of pedestrians only.
        """
        if not self.tracks.is_file() and self.pedestrians:
            raise DataError(
                f"{self.tracks}: no such file, though {self.pedestrians.name} exists; "
                "copy it to the same folder or remove the recording"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class InteractionMeta:
    """Properties of a recording besides its tracks."""

    location: str
    location_id: str
    """The location's name in `meta_data.csv`, else that of its folder."""
    speed_limit_mps: float | None
    origin: Origin


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rows:
    """Rows of both tables, sorted by track, then time."""

    track: Int[np.ndarray, " rows"]
    time_ms: Float[np.ndarray, " rows"]
    kind: Int[np.ndarray, " rows"]
    """`AgentClass` of the track."""
    positions: Float[np.ndarray, "rows 2"]
    heading: Float[np.ndarray, " rows"]
    """Radians; NaN where the file has none."""
    sizes: Float[np.ndarray, "rows 2"]
    """Length and width; 0 where the file has none."""
    sources: Mapping[int, tuple[Path, object]]
    """For tracks with new ids: their file and their id in it."""
    repairs: list[str]
    """A line if the ids of vehicles are new, too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Piece:
    """The smoothed part of a track between two gaps or jumps."""

    track: int
    rows: slice
    positions: Float[np.ndarray, "rows 2"]
    velocities: Float[np.ndarray, "rows 2"]


def find_recordings(root: Path) -> tuple[InteractionFiles, ...]:
    """The recordings in and below a folder, in natural order of names, incomplete ones included.

    A recording's name is `LOCATION/NNN`. Where several folders have the same name, it includes
    their path below `root`: `2020/LOCATION/NNN`.
    """
    parts: dict[tuple[Path, str], dict[str, Path]] = {}
    metas: dict[Path, Path] = {}
    for folder, names in walk(root):
        for name in names:
            if match := _PART.match(name):
                parts.setdefault((folder, match[2]), {})[match[1]] = folder / name
            elif name == META:
                metas[folder] = folder / name
    folders = [folder.name for folder in {folder for folder, _ in parts}]
    found = []
    for (folder, number), files in parts.items():
        location = folder.name
        if folders.count(location) > 1 and folder != root:
            location = folder.relative_to(root).as_posix()
        found.append(
            InteractionFiles(
                name=f"{location}/{number}",
                root=root,
                location=location,
                number=number,
                tracks=files.get("vehicle", folder / f"vehicle_tracks_{number}.csv"),
                pedestrians=files.get("pedestrian"),
                meta=metas.get(folder),
            )
        )
    return tuple(sorted(found, key=lambda files: natural_key(files.name)))


def read_meta(files: InteractionFiles) -> InteractionMeta:
    """Reads a recording's row of `meta_data.csv`. Without that file the origin is (0, 0) degrees.

    Raises:
        DataError: the file is damaged, or has no row for the recording.
    """
    folder = files.tracks.parent.name
    if files.meta is None:
        origin = Origin.at(latitude_deg=0.0, longitude_deg=0.0)
        return InteractionMeta(
            location=files.location, location_id=folder, speed_limit_mps=None, origin=origin
        )
    for chunk in read_columns(files.meta, _META_COLUMNS, optional=_OPTIONAL_META, limits=_LIMITS):
        for row, number in enumerate(chunk["id"]):
            if _same_number(str(number), files.number):
                limit_kmh = float(chunk["speedLimit_kmh"][row]) if "speedLimit_kmh" in chunk else 0
                return InteractionMeta(
                    location=files.location,
                    location_id=str(chunk["locationId"][row]) if "locationId" in chunk else folder,
                    speed_limit_mps=limit_kmh / KMH_PER_MPS if limit_kmh > 0 else None,
                    origin=_origin(
                        files.meta, float(chunk["originLat"][row]), float(chunk["originLon"][row])
                    ),
                )
    raise DataError(
        f"{files.meta}: has no row whose id is {files.number}, expected one for "
        f"{files.tracks.name}; copy it again or remove the recording"
    )


def find_map(
    files: InteractionFiles, meta: InteractionMeta, maps_by_folder: dict[Path, list[Path]]
) -> Path:
    """The map with the name of a recording's location: the nearest one in a parent folder.

    The folders `maps/` beside the recording's folder and beside its parent are searched too, even
    if they are outside of DATA.

    Args:
        files: the recording's files.
        meta: its metadata.
        maps_by_folder: map files in and below the folders searched so far. Results are added.

    Raises:
        DataError: no map has that name.
    """
    folder = files.tracks.parent
    names = [name.lower() for name in (folder.name, meta.location_id)]
    inside = with_parents(folder, files.root)
    beside = [place / "maps" for place in (folder.parent, folder.parent.parent)]
    for place in (*inside, *(each for each in beside if each.is_dir())):
        fitting = [path for path in find_maps(place, maps_by_folder) if path.stem.lower() in names]
        if fitting:
            return min(
                fitting,
                key=lambda path: (
                    names.index(path.stem.lower()),
                    MAP_SUFFIXES.index(path.suffix),
                    path,
                ),
            )
    raise DataError(
        f"{files.root}: no map for location {folder.name} of recording {files.name}; "
        f"expected a lanelet2 file maps/{folder.name}.osm in it or beside it"
    )


def read_interaction(files: InteractionFiles) -> tuple[TrackTable, float]:
    """Reads a recording's tracks and its frame rate.

    Tracks are split at gaps and jumps, positions are smoothed, and speeds and headings are derived
    from them. The heading in the file determines which end of a vehicle is its front, unless
    headings contradict fast motion, and the heading of a vehicle that never moves. The heading of a
    vulnerable road user is its direction of motion, of the past alone; before the first motion it
    is that of the file, or 0.

    Returns:
        The tracks, and the frames per second.

    Raises:
        DataError: a file is damaged, or no frame rate fits its times.
    """
    rows = _read(files)
    check_extent(rows.positions, ("x", "y"), lambda row: _located(files, rows, row, ""))
    clock = read_clock(rows.track, rows.time_ms, lambda row, what: _located(files, rows, row, what))
    check_duration(clock.frames, lambda row: _located(files, rows, row, ""))
    repairs = list(rows.repairs)
    resampled_from_hz = None
    if clock.jittering is not None:
        resampled_from_hz = clock.mean_hz
        rows, clock = _without_jitter(rows, clock, repairs)
    pieces = _pieces(rows, clock, repairs)
    if not pieces:
        raise DataError(
            f"{files.tracks}: no track lasts {MIN_PIECE_S:g} s without a gap or jump; "
            "copy it again or remove the recording"
        )
    kinds, sizes = _kinds_and_sizes(rows, pieces, repairs)
    vulnerable = np.isin(kinds, [int(kind) for kind in VULNERABLE])
    folded = _headings_are_folded(rows, pieces, vulnerable, repairs)
    measured = np.concatenate(
        [
            _measured(rows, piece, float(size[0]), clock.step_s, folded, bool(is_vulnerable))
            for piece, size, is_vulnerable in zip(pieces, sizes, vulnerable, strict=True)
        ]
    )
    lengths = np.array([len(piece.positions) for piece in pieces])
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    states = states_of(measured, np.repeat(starts[:-1], lengths), np.repeat(vulnerable, lengths))
    table = TrackTable(
        track_ids=np.array([piece.track for piece in pieces], dtype=np.int64),
        classes=kinds,
        sizes=sizes,
        first_frames=np.array([clock.frames[piece.rows.start] for piece in pieces]),
        starts=starts,
        states=states,
        repairs=tuple(repairs),
        resampled_from_hz=resampled_from_hz,
    )
    return table, clock.rate_hz


def _origin(path: Path, latitude_deg: float, longitude_deg: float) -> Origin:
    for name, value, limit in (("originLat", latitude_deg, 90), ("originLon", longitude_deg, 180)):
        if abs(value) > limit:
            line = find_line(path, {name: value})
            raise DataError(
                f"{path}, line {line}: {name} is {value:g}, expected {-limit} to {limit} degrees"
            )
    return Origin.at(latitude_deg=latitude_deg, longitude_deg=longitude_deg)


def _same_number(one: str, other: str) -> bool:
    return one.strip().lstrip("0") == other.lstrip("0")


def _read(files: InteractionFiles) -> _Rows:
    vehicles = _columns(files.tracks, _TRACKS)
    numbered = number_ids(vehicles["track_id"])
    vehicles["track_id"] = numbered.columns[0]
    sources: dict[int, tuple[Path, object]] = {
        number: (files.tracks, name) for number, name in enumerate(numbered.originals or ())
    }
    tables = [vehicles]
    if files.pedestrians:
        pedestrians = _columns(files.pedestrians, {**_TRACKS, "track_id": "text"})
        codes, ids = pd.factorize(pedestrians["track_id"])
        first = int(vehicles["track_id"].max()) + 1
        sources |= {first + code: (files.pedestrians, name) for code, name in enumerate(ids)}
        tables.append({**pedestrians, "track_id": first + codes})
    all_rows = {name: np.concatenate([table[name] for table in tables]) for name in vehicles}
    order = np.lexsort((all_rows["timestamp_ms"], all_rows["track_id"]))
    columns = {name: column[order] for name, column in all_rows.items()}
    rows = _Rows(
        track=columns["track_id"].astype(np.int64),
        time_ms=columns["timestamp_ms"],
        kind=columns["agent_type"],
        positions=np.stack([columns["x"], columns["y"]], axis=-1),
        heading=columns["psi_rad"],
        sizes=np.stack([columns["length"], columns["width"]], axis=-1),
        sources=sources,
        repairs=numbered.repairs,
    )
    same = (np.diff(rows.track) == 0) & (np.diff(rows.time_ms) == 0)
    if same.any():
        what = "a second row of track {track} at {time} ms"
        raise DataError(
            _located(files, rows, int(same.argmax()) + 1, what)
            + ", expected one; remove one of the two"
        )
    return rows


def _columns(path: Path, columns: Mapping[str, Kind]) -> dict[str, np.ndarray]:
    """Columns of a file, with agent types as classes and missing columns as unknown values."""
    chunks: dict[str, list[np.ndarray]] = {name: [] for name in columns}
    unknown = {"psi_rad": np.nan, "length": 0.0, "width": 0.0}
    for chunk in read_columns(path, columns, optional=_OPTIONAL_TRACKS, limits=_LIMITS):
        chunk["agent_type"] = classes_of(path, "agent_type", chunk["agent_type"])
        for name, cells in chunks.items():
            cells.append(chunk.get(name, np.full(len(chunk["x"]), unknown.get(name))))
    return {name: np.concatenate(cells) for name, cells in chunks.items()}


def _located(files: InteractionFiles, rows: _Rows, row: int, what: str) -> str:
    """A row's file and line, followed by `what` with `{track}` and `{time}` filled in."""
    number = int(rows.track[row])
    path, name = rows.sources.get(number, (files.tracks, number))
    cells = {"track_id": name, "timestamp_ms": float(rows.time_ms[row])}
    before = (rows.track[:row] == number) & (rows.time_ms[:row] == rows.time_ms[row])
    line = find_line(path, cells, occurrence=int(before.sum()) + 1)
    return f"{path}, line {line}: " + what.format(track=name, time=f"{rows.time_ms[row]:g}")


def _pieces(rows: _Rows, clock: Clock, repairs: list[str]) -> list[_Piece]:
    """Splits tracks at gaps and jumps. Later pieces of a track get new ids."""
    changes = np.diff(rows.track) != 0
    gaps = ~changes & (np.diff(clock.frames) > 1)
    jumps = np.zeros_like(gaps)
    for begin, end in _stretches(changes | gaps):
        jumps[begin : end - 1] = find_jumps(rows.positions[begin:end])
    _report_splits(rows, gaps, "gaps in tracks' times, split there", repairs)
    _report_splits(rows, jumps, f"jumps of over {JUMP_M:g} m in tracks, split there", repairs)

    new_id = int(rows.track.max()) + 1
    pieces: list[_Piece] = []
    later: list[_Piece] = []
    held, short = [], []
    for first, end in _stretches(changes | gaps | jumps):
        track = int(rows.track[first])
        begin = first + count_held(rows.positions[first:end], clock.step_s)
        if begin > first:
            held.append(track)
        if end - begin < max(round(MIN_PIECE_S * clock.rate_hz), 2):
            short.append(track)
            continue
        positions, velocities = smooth(rows.positions[begin:end], clock.step_s)
        is_later = bool(pieces) and pieces[-1].track == track
        piece = _Piece(
            track=new_id + len(later) if is_later else track,
            rows=slice(begin, end),
            positions=positions,
            velocities=velocities,
        )
        (later if is_later else pieces).append(piece)
    _report_tracks(held, "tracks repeat their first position, repeated rows left out", repairs)
    _report_tracks(short, f"tracks have pieces under {MIN_PIECE_S:g} s, these left out", repairs)
    return pieces + later


def _without_jitter(rows: _Rows, clock: Clock, repairs: list[str]) -> tuple[_Rows, Clock]:
    """Rows at whole frames, from rows whose times jitter; tracks have the same gaps as before."""
    assert clock.jittering is not None
    begin_ms = float(rows.time_ms.min())
    nearest, positions, frames = [], [], []
    after = (np.diff(rows.track) != 0) | (np.diff(clock.frames) > 1)
    for first, end in _stretches(after):
        times = clock.jittering[first:end]
        wanted = frames_within(times)
        frames.append(wanted)
        positions.append(at_times(rows.positions[first:end], times, wanted.astype(np.float64)))
        middles = 0.5 * (times[1:] + times[:-1])
        nearest.append(first + np.searchsorted(middles, wanted))
    row = np.concatenate(nearest)
    frame = np.concatenate(frames)
    off_ms = 1000.0 / clock.rate_hz * np.abs(clock.jittering - np.round(clock.jittering)).max()
    repairs.append(
        f"timestamp_ms is up to {off_ms:.3g} ms off frames of {clock.rate_hz:g} Hz: positions "
        "interpolated at these frames"
    )
    on_frames = replace(
        rows,
        track=rows.track[row],
        time_ms=begin_ms + frame * 1000.0 / clock.rate_hz,
        kind=rows.kind[row],
        positions=np.concatenate(positions),
        heading=rows.heading[row],
        sizes=rows.sizes[row],
    )
    return on_frames, replace(clock, frames=frame, jittering=None)


def _stretches(ends_after: Bool[np.ndarray, " steps"]) -> list[tuple[int, int]]:
    """First row and end of each stretch of rows between marked steps."""
    bounds = [0, *(np.flatnonzero(ends_after) + 1).tolist(), len(ends_after) + 1]
    return list(itertools.pairwise(bounds))


def _report_tracks(tracks: Sequence[int], what: str, repairs: list[str]) -> None:
    if tracks:
        names = [str(track) for track in dict.fromkeys(tracks)]
        repairs.append(f"{len(names)} {what}: {shorten(names)}")


def _report_splits(
    rows: _Rows, after: Bool[np.ndarray, " steps"], what: str, repairs: list[str]
) -> None:
    if after.any():
        splits = [
            f"{rows.track[row]} after {rows.time_ms[row]:g} ms" for row in np.flatnonzero(after)
        ]
        repairs.append(f"{len(splits)} {what}: {shorten(splits)}")


def _kinds_and_sizes(
    rows: _Rows, pieces: Sequence[_Piece], repairs: list[str]
) -> tuple[Int[np.ndarray, " pieces"], Float[np.ndarray, "pieces 2"]]:
    """Each piece's class, which is that of its first row, and its median size."""
    kinds = np.array([rows.kind[piece.rows.start] for piece in pieces], dtype=np.int8)
    sizes = np.array([np.median(rows.sizes[piece.rows], axis=0) for piece in pieces])
    differ = [
        piece.track
        for piece, kind in zip(pieces, kinds, strict=True)
        if (rows.kind[piece.rows] != kind).any()
    ]
    _report_tracks(differ, "tracks change their agent_type", repairs)
    known = (sizes > 0).all(axis=-1, keepdims=True)
    return kinds, np.where(known, sizes, FOOTPRINTS_M[kinds]).astype(np.float32)


def _headings_are_folded(
    rows: _Rows,
    pieces: Sequence[_Piece],
    vulnerable: Bool[np.ndarray, " pieces"],
    repairs: list[str],
) -> bool:
    """Whether the file's headings do not distinguish a vehicle's front from its rear."""
    fast = wrong = 0
    for piece, is_vulnerable in zip(pieces, vulnerable, strict=True):
        heading = rows.heading[piece.rows]
        if is_vulnerable or np.isnan(heading).any():
            continue
        moves = np.hypot(*piece.velocities.T) > FORWARD_ABOVE_MPS
        along = (piece.velocities * np.stack([np.cos(heading), np.sin(heading)], axis=-1)).sum(-1)
        fast += int(moves.sum())
        wrong += int((moves & (along < 0)).sum())
    if wrong <= MAX_WRONG_SHARE * fast:
        return False
    share = 100 * wrong / fast
    repairs.append(
        f"{share:.0f} % of the headings of fast vehicles point backwards: "
        "the front is determined from motion alone"
    )
    return True


def _measured(
    rows: _Rows, piece: _Piece, length_m: float, dt_s: float, folded: bool, vulnerable: bool
) -> Float[np.ndarray, "rows 5"]:
    """x, y, heading in degrees, velocity along x and y."""
    heading = rows.heading[piece.rows]
    if np.isnan(heading).any():
        heading = None
    if vulnerable:
        heading = np.zeros(len(piece.positions)) if heading is None else heading
    else:
        rear_m = AXLE_SHARE_OF_LENGTH * length_m
        heading = follow_heading(piece.positions, heading, rear_m, dt_s, folded=folded)
    return np.column_stack([piece.positions, np.degrees(heading), piece.velocities])
