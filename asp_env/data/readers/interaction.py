"""The INTERACTION layout: which files make a recording, and which map and origin belong to it.

`vehicle_tracks_NNN.csv` and perhaps `pedestrian_tracks_NNN.csv` lie in a folder named after their
location, the location's map is `LOCATION.osm` or, in local metres, `LOCATION.osm_xy`: INTERACTION
has `recorded_trackfiles/LOCATION/` beside `maps/`, TAF-BW `LOCATION/` beside `maps/`. Positions
are metres from an origin: (0, 0) degrees, or what `meta_data.csv` beside the tracks says.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from asp_env.data.readers.folders import maps_in, natural, upwards, walk
from asp_env.data.readers.origin import Origin
from asp_env.data.readers.tables import Kind, find_line, read_columns
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
