"""The INTERACTION layout: which files make a recording, and which map and origin belong to it.

`vehicle_tracks_NNN.csv` and perhaps `pedestrian_tracks_NNN.csv` lie in a folder named after their
location, the location's map is `LOCATION.osm` or, in local metres, `LOCATION.osm_xy`: INTERACTION
has `recorded_trackfiles/LOCATION/` beside `maps/`, TAF-BW `LOCATION/` beside `maps/`. Positions
are metres from an origin: (0, 0) degrees, or what `meta_data.csv` beside the tracks says.

MERGED: `vehicle_tracks_NNN.csv` and `pedestrian_tracks_NNN.csv` into one table of tracks.

Positions and times are trusted, and nothing else: published velocities may be scaled or of the
wrong sign and headings folded into ±90°, so both are derived from the positions. Frame ids are not
read: they may count frames that were left out.
"""

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from asp_env.data.classes import FOOTPRINTS_M, VULNERABLE, parse_class
from asp_env.data.readers.folders import maps_in, natural, upwards, walk
from asp_env.data.readers.lanelet2 import Origin, shorten
from asp_env.data.readers.levelx import TrackTable, states_of
from asp_env.data.readers.smoothing import JUMP_M, count_held, find_jumps, follow_heading, smooth
from asp_env.data.readers.tables import Clock, Kind, find_line, read_clock, read_columns
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.errors import DataError

MAP_SUFFIXES = (".osm", ".osm_xy")
"""In this order, where a map comes twice."""

META = "meta_data.csv"
KMH_PER_MPS = 3.6

_PART = re.compile(r"^(vehicle|pedestrian)_tracks_([^.]+)\.csv(?:\.gz)?$")
_META_COLUMNS: dict[str, Kind] = {
    "id": "text",
    "originLat": "number",
    "originLon": "number",
    "speedLimit_kmh": "number",
    "locationId": "text",
}
_OPTIONAL = frozenset({"speedLimit_kmh", "locationId"})


@dataclass(frozen=True, slots=True, kw_only=True)
class InteractionFiles:
    """Where one recording's files lie. A missing table of vehicles is named as it should be."""

    name: str
    root: Path
    """The folder that was given as DATA: maps are searched from the recording up to it."""
    location: str
    number: str
    """As in the files' names, such as `000`."""
    tracks: Path
    pedestrians: Path | None
    meta: Path | None

    @property
    def tables(self) -> tuple[Path, ...]:
        """All files that there should be but the map."""
        return tuple(path for path in (self.tracks, self.pedestrians, self.meta) if path)

    @property
    def background(self) -> None:
        """There is no picture."""
        return

    def check_complete(self) -> None:
        """Refuses pedestrians without vehicles.

        Raises:
            DataError: that is all there is.
        """
        if not self.tracks.is_file() and self.pedestrians:
            raise DataError(
                f"{self.tracks}: no such file, though {self.pedestrians.name} is there; "
                "copy it beside that or remove the recording"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class InteractionMeta:
    """What is known of a recording besides its tracks."""

    location: str
    location_id: str
    """The location as `meta_data.csv` calls it, else as the folder does."""
    speed_limit_mps: float | None
    origin: Origin


def find_recordings(root: Path) -> tuple[InteractionFiles, ...]:
    """The recordings below a folder, by name: `LOCATION/NNN`; incomplete ones too.

    Where folders of one name lie in several places, names carry these: `2020/LOCATION/NNN`.
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
    return tuple(sorted(found, key=lambda files: natural(files.name)))


def read_meta(files: InteractionFiles) -> InteractionMeta:
    """What `meta_data.csv` says of a recording; without one, the origin is (0, 0) degrees.

    Raises:
        DataError: it is damaged, or does not know the recording.
    """
    folder = files.tracks.parent.name
    if files.meta is None:
        origin = Origin.at(latitude_deg=0.0, longitude_deg=0.0)
        return InteractionMeta(
            location=files.location, location_id=folder, speed_limit_mps=None, origin=origin
        )
    for chunk in read_columns(files.meta, _META_COLUMNS, optional=_OPTIONAL):
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
    files: InteractionFiles, meta: InteractionMeta, maps_below: dict[Path, list[Path]]
) -> Path:
    """The map named after a recording's location: the nearest, going up from it to DATA.

    Where DATA is the location's own folder or the one that holds it, `maps/` may lie beside them.

    Args:
        files: the recording's files.
        meta: what is known of it.
        maps_below: the maps in and below folders, as far as these were searched; is added to.

    Raises:
        DataError: there is none.
    """
    folder = files.tracks.parent
    names = [name.lower() for name in (folder.name, meta.location_id)]
    inside = upwards(folder, files.root)
    beside = [place / "maps" for place in (folder.parent, folder.parent.parent)]
    for place in (*inside, *(each for each in beside if each.is_dir())):
        fitting = [path for path in maps_in(place, maps_below) if path.stem.lower() in names]
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


def _origin(path: Path, latitude_deg: float, longitude_deg: float) -> Origin:
    for name, value, most in (("originLat", latitude_deg, 90), ("originLon", longitude_deg, 180)):
        if abs(value) > most:
            line = find_line(path, {name: value})
            raise DataError(
                f"{path}, line {line}: {name} is {value:g}, expected {-most} to {most} degrees"
            )
    return Origin.at(latitude_deg=latitude_deg, longitude_deg=longitude_deg)


def _same_number(one: str, other: str) -> bool:
    return one.strip().lstrip("0") == other.lstrip("0")


LEAST_S = 0.5
"""What lasts less between two gaps or jumps is left out: no speed can be told of it."""

NOBODY_BACKS_MPS = 3.0
"""Whose heading points back at more than this has a wrong heading."""

MOST_WRONG = 0.01
"""If more of the fast vehicles' rows than this are so, headings are folded into ±90°."""

_COLUMNS: Mapping[str, Kind] = {
    "track_id": "whole",
    "timestamp_ms": "number",
    "agent_type": "text",
    "x": "number",
    "y": "number",
    "psi_rad": "number",
    "length": "number",
    "width": "number",
}
_OPTIONAL_COLUMNS = frozenset({"psi_rad", "length", "width"})


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rows:
    """Rows sorted by track, then time."""

    track: Int[np.ndarray, " rows"]
    time_ms: Float[np.ndarray, " rows"]
    kind: Int[np.ndarray, " rows"]
    positions: Float[np.ndarray, "rows 2"]
    heading: Float[np.ndarray, " rows"]
    """Radians as the file says, NaN where it does not."""
    sizes: Float[np.ndarray, "rows 2"]
    """Length and width as the file says, 0 where it does not."""
    names: Mapping[int, tuple[Path, object]]
    """Where tracks that got another id come from: the file and their id in it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Piece:
    """What lies between two gaps or jumps of a track, smoothed."""

    track: int
    rows: slice
    positions: Float[np.ndarray, "rows 2"]
    velocities: Float[np.ndarray, "rows 2"]


def read_interaction(files: InteractionFiles) -> tuple[TrackTable, float]:
    """Reads a recording's tracks and its frame rate.

    Tracks are cut at gaps and jumps, positions smoothed; speeds and headings follow from them.
    A vehicle's heading in the file says which end is its front, unless headings contradict fast
    motion, and how it stands if it never moves. Vulnerable road users head where they move, from
    the past alone; before they first move they have the file's heading, or 0.

    Returns:
        The tracks, and the frames per second.

    Raises:
        DataError: a file is damaged, or no frame rate fits its times.
    """
    rows = _read(files)
    clock = read_clock(rows.track, rows.time_ms, lambda at, what: _line(files, rows, at, what))
    repairs: list[str] = []
    pieces = _pieces(rows, clock, repairs)
    if not pieces:
        raise DataError(
            f"{files.tracks}: no track lasts {LEAST_S:g} s without a gap or jump; "
            "copy it again or remove the recording"
        )
    kinds, sizes = _per_track(rows, pieces, repairs)
    vulnerable = np.isin(kinds, [int(kind) for kind in VULNERABLE])
    folded = _folded(rows, pieces, vulnerable, repairs)
    measured = np.concatenate(
        [
            _measured(rows, piece, float(size[0]), clock.step_s, folded, bool(foot))
            for piece, size, foot in zip(pieces, sizes, vulnerable, strict=True)
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
    )
    return table, clock.rate_hz


def _read(files: InteractionFiles) -> _Rows:
    vehicles = _columns(files.tracks, _COLUMNS)
    names: dict[int, tuple[Path, object]] = {}
    tables = [vehicles]
    if files.pedestrians:
        walkers = _columns(files.pedestrians, {**_COLUMNS, "track_id": "text"})
        codes, ids = pd.factorize(walkers["track_id"])
        first = int(vehicles["track_id"].max()) + 1
        names = {first + code: (files.pedestrians, name) for code, name in enumerate(ids)}
        tables.append({**walkers, "track_id": first + codes})
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
        names=names,
    )
    same = (np.diff(rows.track) == 0) & (np.diff(rows.time_ms) == 0)
    if same.any():
        raise DataError(
            _line(files, rows, int(same.argmax()) + 1, "a second row of track {track} at {time} ms")
            + ", expected one; remove one of the two"
        )
    return rows


def _columns(path: Path, wanted: Mapping[str, Kind]) -> dict[str, np.ndarray]:
    """Columns of a file, agent types as classes, those that it lacks as if nothing were known."""
    chunks: dict[str, list[np.ndarray]] = {name: [] for name in wanted}
    for chunk in read_columns(path, wanted, optional=_OPTIONAL_COLUMNS):
        unknown = {"psi_rad": np.nan, "length": 0.0, "width": 0.0}
        chunk["agent_type"] = _classes(path, chunk["agent_type"])
        for name, cells in chunks.items():
            cells.append(chunk.get(name, np.full(len(chunk["x"]), unknown.get(name))))
    return {name: np.concatenate(cells) for name, cells in chunks.items()}


def _classes(path: Path, names: np.ndarray) -> Int[np.ndarray, " rows"]:
    codes, known = pd.factorize(names)
    numbers = []
    for name in known:
        try:
            numbers.append(int(parse_class(str(name))))
        except DataError as error:
            line = find_line(path, {"agent_type": str(name)})
            raise DataError(f"{path}, line {line}: {error}") from None
    return np.array(numbers, dtype=np.int8)[codes]


def _line(files: InteractionFiles, rows: _Rows, at: int, what: str) -> str:
    """Where a row came from, and what is wrong with it: `{track}` and `{time}` are filled in."""
    number = int(rows.track[at])
    path, name = rows.names.get(number, (files.tracks, number))
    cells = {"track_id": name, "timestamp_ms": float(rows.time_ms[at])}
    before = (rows.track[:at] == number) & (rows.time_ms[:at] == rows.time_ms[at])
    line = find_line(path, cells, occurrence=int(before.sum()) + 1)
    return f"{path}, line {line}: " + what.format(track=name, time=f"{rows.time_ms[at]:g}")


def _pieces(rows: _Rows, clock: Clock, repairs: list[str]) -> list[_Piece]:
    """Tracks between gaps and jumps; the first of a track keeps its id, others get new ones."""
    changes = np.diff(rows.track) != 0
    gaps = ~changes & (np.diff(clock.frames) > 1)
    jumps = np.zeros_like(gaps)
    for begin, end in _stretches(changes | gaps):
        jumps[begin : end - 1] = find_jumps(rows.positions[begin:end])
    _tell(rows, gaps, "gaps in tracks' times, split there", repairs)
    _tell(rows, jumps, f"jumps of over {JUMP_M:g} m in tracks, split there", repairs)

    fresh = int(rows.track.max()) + 1
    pieces: list[_Piece] = []
    later: list[_Piece] = []
    held, short = [], []
    for first, end in _stretches(changes | gaps | jumps):
        track = int(rows.track[first])
        begin = first + count_held(rows.positions[first:end], clock.step_s)
        if begin > first:
            held.append(track)
        if end - begin < max(round(LEAST_S * clock.rate_hz), 2):
            short.append(track)
            continue
        positions, velocities = smooth(rows.positions[begin:end], clock.step_s)
        known = bool(pieces) and pieces[-1].track == track
        piece = _Piece(
            track=fresh + len(later) if known else track,
            rows=slice(begin, end),
            positions=positions,
            velocities=velocities,
        )
        (later if known else pieces).append(piece)
    _count(held, "tracks whose first position is held, left out until they are followed", repairs)
    _count(short, f"tracks with pieces under {LEAST_S:g} s, these left out", repairs)
    return pieces + later


def _stretches(ends_after: Bool[np.ndarray, " steps"]) -> list[tuple[int, int]]:
    """First row and end of what lies between the steps that are marked."""
    bounds = [0, *(np.flatnonzero(ends_after) + 1).tolist(), len(ends_after) + 1]
    return list(itertools.pairwise(bounds))


def _count(tracks: Sequence[int], what: str, repairs: list[str]) -> None:
    if tracks:
        told = [str(track) for track in dict.fromkeys(tracks)]
        repairs.append(f"{len(told)} {what}: {shorten(told)}")


def _tell(rows: _Rows, after: Bool[np.ndarray, " steps"], what: str, repairs: list[str]) -> None:
    if after.any():
        at = np.flatnonzero(after)
        told = [f"{rows.track[row]} after {rows.time_ms[row]:g} ms" for row in at]
        repairs.append(f"{len(told)} {what}: {shorten(told)}")


def _per_track(
    rows: _Rows, pieces: Sequence[_Piece], repairs: list[str]
) -> tuple[Int[np.ndarray, " pieces"], Float[np.ndarray, "pieces 2"]]:
    """Each piece's class and size: those of its first row, and the median."""
    kinds = np.array([rows.kind[piece.rows.start] for piece in pieces], dtype=np.int8)
    sizes = np.array([np.median(rows.sizes[piece.rows], axis=0) for piece in pieces])
    differ = [
        piece.track
        for piece, kind in zip(pieces, kinds, strict=True)
        if (rows.kind[piece.rows] != kind).any()
    ]
    _count(differ, "tracks change their agent_type", repairs)
    known = (sizes > 0).all(axis=-1, keepdims=True)
    return kinds, np.where(known, sizes, FOOTPRINTS_M[kinds]).astype(np.float32)


def _folded(
    rows: _Rows,
    pieces: Sequence[_Piece],
    vulnerable: Bool[np.ndarray, " pieces"],
    repairs: list[str],
) -> bool:
    """Whether the file's headings do not tell a vehicle's front from its rear."""
    fast = wrong = 0
    for piece, foot in zip(pieces, vulnerable, strict=True):
        heading = rows.heading[piece.rows]
        if foot or np.isnan(heading).any():
            continue
        moves = np.hypot(*piece.velocities.T) > NOBODY_BACKS_MPS
        along = (piece.velocities * np.stack([np.cos(heading), np.sin(heading)], axis=-1)).sum(-1)
        fast += int(moves.sum())
        wrong += int((moves & (along < 0)).sum())
    if wrong <= MOST_WRONG * fast:
        return False
    share = 100 * wrong / fast
    repairs.append(
        f"{share:.0f} % of the headings of fast vehicles point backwards: "
        "which end is the front is told by motion alone"
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
