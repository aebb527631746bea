"""The INTERACTION layout: recordings of one or two CSV tables each, and their maps.

`vehicle_tracks_NNN.csv` and optionally `pedestrian_tracks_NNN.csv` lie in a folder named after
their location; the location's map is `LOCATION.osm` or, in local metres, `LOCATION.osm_xy`.
INTERACTION has `recorded_trackfiles/LOCATION/` and `maps/` in one folder, TAF-BW `LOCATION/` and
`maps/`. Positions are metres from an origin: (0, 0) degrees, or that of the recording's row in
`meta_data.csv` in the tracks' folder.

Only positions and times are used as they are. Published velocities may be scaled or have the wrong
sign and headings may be folded into ±90°, so both are derived from the positions; velocities of
another size than the motion of the positions are reported. Frame ids are not
read: they may count frames that were left out.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from asp_env.data.readers.compressed import CSV, plain_name
from asp_env.data.readers.layout import (
    MAP_SUFFIXES,
    ClassNames,
    TrackTable,
    archive_hint,
    find_maps,
    map_suffix,
    natural_key,
    walk,
    with_parents,
)
from asp_env.data.readers.measurements import Measurements, derive_tracks
from asp_env.data.readers.positions import Origin
from asp_env.data.readers.ranges import (
    HEADING_RAD,
    HIGHEST_LIMIT_MPS,
    POSITION,
    SIZE,
    TIME_MS,
    Limit,
)
from asp_env.data.readers.tables import Kind, find_line, number_ids, read_columns, read_table
from asp_env.errors import DataError

META = "meta_data.csv"
KMH_PER_MPS = 3.6

_PART = re.compile(rf"^(vehicle|pedestrian)_tracks_([^.]+){CSV}$", re.IGNORECASE)
_META_COLUMNS: dict[str, Kind] = {
    "id": "text",
    "originLat": "number",
    "originLon": "number",
    "speedLimit_kmh": "number or empty",
    "locationId": "text",
}
_OPTIONAL_META = frozenset({"speedLimit_kmh", "locationId"})
TRACKS: Mapping[str, Kind] = {
    "track_id": "id",
    "timestamp_ms": "number",
    "agent_type": "text",
    "x": "number",
    "y": "number",
    "vx": "number or empty",
    "vy": "number or empty",
    "psi_rad": "number or empty",
    "length": "number or empty",
    "width": "number or empty",
}
OPTIONAL_TRACKS = frozenset({"vx", "vy", "psi_rad", "length", "width"})
LIMITS: Mapping[str, Limit] = {
    "timestamp_ms": TIME_MS,
    "x": POSITION,
    "y": POSITION,
    "psi_rad": HEADING_RAD,
    "length": SIZE,
    "width": SIZE,
    "speedLimit_kmh": Limit(largest=HIGHEST_LIMIT_MPS * KMH_PER_MPS, unit="km/h"),
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
                f"{archive_hint(self.tracks.parent)}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class InteractionMeta:
    """Properties of a recording besides its tracks."""

    location: str
    location_id: str
    """The location's name in `meta_data.csv`, else that of its folder."""
    speed_limit_mps: float | None
    origin: Origin


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
                parts.setdefault((folder, match[2]), {})[match[1].lower()] = folder / name
            elif plain_name(name) == META:
                metas[folder] = folder / name
    folders = Counter(folder.name for folder in {folder for folder, _ in parts})
    found = []
    for (folder, number), files in parts.items():
        location = folder.name
        if folders[location] > 1 and folder != root:
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
    table = read_table(files.meta, _META_COLUMNS, optional=_OPTIONAL_META, limits=LIMITS)
    rows = [i for i, number in enumerate(table["id"]) if _same_number(str(number), files.number)]
    if len(rows) != 1:
        raise DataError(
            f"{files.meta}: has {len(rows) or 'no'} row{'s' * (len(rows) > 1)} whose id is "
            f"{files.number}, expected one for {files.tracks.name}; mend the file or remove the "
            "recording"
        )
    limit_kmh = float(table["speedLimit_kmh"][rows[0]]) if "speedLimit_kmh" in table else 0
    latitude_deg, longitude_deg = (
        float(table[name][rows[0]]) for name in ("originLat", "originLon")
    )
    return InteractionMeta(
        location=files.location,
        location_id=str(table["locationId"][rows[0]]) if "locationId" in table else folder,
        speed_limit_mps=limit_kmh / KMH_PER_MPS if limit_kmh > 0 else None,
        origin=_origin(files.meta, latitude_deg, longitude_deg),
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
    names = [folder.name, meta.location_id]
    return find_site_map(folder, files.root, names, files.name, maps_by_folder)


def find_site_map(
    folder: Path,
    root: Path,
    locations: Sequence[str],
    recording: str,
    maps_by_folder: dict[Path, list[Path]],
) -> Path:
    """The map that is named after a location; see `find_map`.

    Args:
        folder: the folder of the recording's tables.
        root: the folder given as DATA.
        locations: names of the location; the first one is preferred.
        recording: the recording's name, for the error message.
        maps_by_folder: map files in and below the folders searched so far. Results are added.

    Raises:
        DataError: no map has one of these names.
    """
    names = [name.lower() for name in locations]
    inside = with_parents(folder, root)
    beside = [place / "maps" for place in (folder.parent, folder.parent.parent)]
    for place in (*inside, *(each for each in beside if each.is_dir())):
        fitting = [path for path in find_maps(place, maps_by_folder) if path.stem.lower() in names]
        if fitting:
            return min(
                fitting,
                key=lambda path: (
                    names.index(path.stem.lower()),
                    MAP_SUFFIXES.index(map_suffix(path)),
                    path,
                ),
            )
    raise DataError(
        f"{root}: no map for location {locations[0]} of recording {recording}; "
        f"expected a lanelet2 file maps/{locations[0]}.osm in it or beside it"
        f"{archive_hint(root)}"
    )


def read_interaction(files: InteractionFiles) -> tuple[TrackTable, float]:
    """Reads a recording's tracks and its frame rate; see `derive_tracks`.

    Raises:
        DataError: a file is damaged, or no frame rate fits its times.
    """
    names = ClassNames()
    vehicles = read_measurements(files.tracks, names, TRACKS)
    numbered = number_ids(vehicles["track_id"])
    vehicles["track_id"] = numbered.columns[0]
    sources: dict[int, tuple[Path, object]] = {
        number: (files.tracks, name) for number, name in enumerate(numbered.originals or ())
    }
    tables = [vehicles]
    if files.pedestrians:
        pedestrians = read_measurements(files.pedestrians, names, {**TRACKS, "track_id": "text"})
        codes, ids = pd.factorize(pedestrians["track_id"])
        first = int(vehicles["track_id"].max(initial=-1)) + 1
        sources |= {first + code: (files.pedestrians, name) for code, name in enumerate(ids)}
        tables.append({**pedestrians, "track_id": first + codes})
    columns = {name: np.concatenate([table[name] for table in tables]) for name in vehicles}
    if not len(columns["x"]):
        raise DataError(
            f"{files.tracks}: has a header but no rows; copy it again or remove the recording"
        )

    def located(track: int, time_ms: float, occurrence: int, what: str) -> str:
        path, name = sources.get(track, (files.tracks, track))
        cells = {"track_id": name, "timestamp_ms": time_ms}
        line = find_line(path, cells, occurrence=occurrence)
        return f"{path}, line {line}: " + what.format(track=name, time=f"{time_ms:g}")

    table, rate_hz = derive_tracks(measurements_of(columns), str(files.tracks), located)
    return replace(table, repairs=(*names.repairs(), *numbered.repairs, *table.repairs)), rate_hz


def read_measurements(
    path: Path,
    names: ClassNames,
    columns: Mapping[str, Kind],
    *,
    optional: frozenset[str] = OPTIONAL_TRACKS,
    limits: Mapping[str, Limit] | None = None,
) -> dict[str, np.ndarray]:
    """Columns of a file, with agent types as classes and missing columns as unknown values.

    Args:
        path: the file; it may have no rows.
        names: counts the unknown classes.
        columns: kind of the columns to read, `agent_type` and `track_id` among them.
        optional: those of `columns` that may be absent.
        limits: plausible ranges of columns in addition to `LIMITS`.

    Raises:
        DataError: the file is damaged.
    """
    limits = {**LIMITS, **(limits or {})}
    chunks: dict[str, list[np.ndarray]] = {name: [] for name in columns}
    for chunk in read_columns(path, columns, optional=optional, limits=limits, may_be_empty=True):
        chunk["agent_type"] = names.classes(chunk["agent_type"], chunk["track_id"])
        for name, cells in chunks.items():
            cells.append(chunk.get(name, np.full(len(chunk["x"]), np.nan)))
    return {
        name: np.concatenate(cells)
        if cells
        else np.zeros(0, dtype=np.int64 if columns[name] == "id" else np.float64)
        for name, cells in chunks.items()
    }


def measurements_of(columns: Mapping[str, np.ndarray]) -> Measurements:
    """Measurements of the columns of the layout's tables, all rows of which have numbers as ids."""
    sizes = np.stack([columns["length"], columns["width"]], axis=-1)
    with np.errstate(over="ignore"):  # velocities are only compared with the positions
        speed = np.hypot(columns["vx"], columns["vy"])
    return Measurements(
        track=columns["track_id"].astype(np.int64),
        time_ms=columns["timestamp_ms"],
        classes=columns["agent_type"].astype(np.int8),
        positions=np.stack([columns["x"], columns["y"]], axis=-1),
        heading=columns["psi_rad"],
        sizes=np.nan_to_num(sizes, nan=0.0),
        speed=speed,
    )


def _origin(path: Path, latitude_deg: float, longitude_deg: float) -> Origin:
    for name, value, limit in (("originLat", latitude_deg, 90), ("originLon", longitude_deg, 180)):
        if abs(value) > limit:
            line = find_line(path, {name: value})
            raise DataError(
                f"{path}, line {line}: {name} is {value:g}, expected {-limit} to {limit} degrees"
            )
    return Origin.at(latitude_deg=latitude_deg, longitude_deg=longitude_deg)


def _same_number(one: str, other: str) -> bool:
    """Whether two numbers of a recording are equal, such as 4, 004 and the 4.0 of spreadsheets."""
    return re.sub(r"\.0*$", "", one.strip()).lstrip("0") == other.lstrip("0")
