"""The inD/rounD layout: which files make a recording, and which map and scale belong to it.

Per recording `XX`: `XX_recordingMeta.csv`, `XX_tracksMeta.csv`, `XX_tracks.csv` (or `.csv.gz`) and
perhaps `XX_background.png`, together in any folder below the one given. Metadata are read per
recording, never per location: the origin differs between recordings of one site.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from asp_env.data.readers.folders import maps_in, natural, upwards, walk
from asp_env.data.readers.origin import Origin, project
from asp_env.data.readers.osm import read_osm
from asp_env.data.readers.tables import read_table
from asp_env.errors import DataError

CONSTRUCTION_RECORDINGS = frozenset(range(11, 18))
"""Recordings of inD's location 1 made while its site was under construction."""

NEAR_M = 1_000.0
"""A map that does not name its location belongs to a recording this near."""

DOWNSCALE = {"ind": 12, "round": 10, "exid": 6, "unid": 2}
"""By how much the published background images are smaller than `orthoPxToMeter` says."""

SCALES = (1, 2, 6, 10, 12)
MARGIN_PX = 5.0
"""So far outside its image a position may lie by the rounding of scales and smoothing."""

_PART = re.compile(r"^(.+)_(recordingMeta\.csv|tracksMeta\.csv|tracks\.csv(?:\.gz)?)$")


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelxFiles:
    """Where one recording's files lie. Those that are missing are named as they should be."""

    name: str
    root: Path
    """The folder that was given as DATA: maps are searched from the recording up to it."""
    recording_meta: Path
    tracks_meta: Path
    tracks: Path
    background: Path | None

    @property
    def tables(self) -> tuple[Path, Path, Path]:
        """The three files that every recording has."""
        return (self.recording_meta, self.tracks_meta, self.tracks)

    def check_complete(self) -> None:
        """Refuses a recording that lacks one of its tables.

        Raises:
            DataError: it does.
        """
        there = [path.name for path in self.tables if path.is_file()]
        for path in self.tables:
            if path.name not in there:
                raise DataError(
                    f"{path}: no such file, though {', '.join(there)} is there; "
                    "copy it beside the others or remove the recording"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingMeta:
    """What `XX_recordingMeta.csv` says."""

    number: int
    location: int
    frame_rate_hz: float
    speed_limit_mps: float | None
    metres_per_ortho_pixel: float | None
    origin: Origin


def find_recordings(root: Path) -> tuple[LevelxFiles, ...]:
    """The recordings below a folder, by name; incomplete ones too, so that they can be reported.

    Where one id occurs in several folders, names carry the folder: `rounD/00`.
    """
    parts: dict[tuple[Path, str], dict[str, Path]] = {}
    for folder, names in walk(root):
        for name in names:
            if match := _PART.match(name):
                kind = match[2].split(".")[0]
                parts.setdefault((folder, match[1]), {})[kind] = folder / name
    ids = [prefix for _, prefix in parts]
    found = []
    for (folder, prefix), files in parts.items():
        background = folder / f"{prefix}_background.png"
        place = folder.parent if folder.name == "data" else folder
        inside = place.relative_to(root) if place.is_relative_to(root) else Path()
        found.append(
            LevelxFiles(
                name=prefix if ids.count(prefix) == 1 else (inside / prefix).as_posix(),
                root=root,
                recording_meta=files.get("recordingMeta", folder / f"{prefix}_recordingMeta.csv"),
                tracks_meta=files.get("tracksMeta", folder / f"{prefix}_tracksMeta.csv"),
                tracks=files.get("tracks", folder / f"{prefix}_tracks.csv"),
                background=background if background.is_file() else None,
            )
        )
    return tuple(sorted(found, key=lambda files: natural(files.name)))


def read_recording_meta(path: Path) -> RecordingMeta:
    """Reads `XX_recordingMeta.csv`.

    Raises:
        DataError: it is damaged, or its frame rate is no positive number.
    """
    needed = ("recordingId", "locationId", "frameRate", "xUtmOrigin", "yUtmOrigin")
    table = read_table(
        path,
        {
            **dict.fromkeys(needed[:2], "whole"),
            **dict.fromkeys(needed[2:], "number"),
            **dict.fromkeys(("latLocation", "lonLocation"), "number"),
        },
    )
    rate = float(table["frameRate"][0])
    if rate <= 0:
        raise DataError(f"{path}, line 2: frameRate is {rate:g}, expected a positive number of Hz")
    return RecordingMeta(
        number=int(table["recordingId"][0]),
        location=int(table["locationId"][0]),
        frame_rate_hz=rate,
        speed_limit_mps=_positive(path, "speedLimit"),
        metres_per_ortho_pixel=_positive(path, "orthoPxToMeter"),
        origin=Origin(
            x_m=float(table["xUtmOrigin"][0]),
            y_m=float(table["yUtmOrigin"][0]),
            longitude_deg=float(table["lonLocation"][0]),
            latitude_deg=float(table["latLocation"][0]),
        ),
    )


def find_map(files: LevelxFiles, meta: RecordingMeta, maps_below: dict[Path, list[Path]]) -> Path:
    """The lanelet2 map of a recording: the nearest, going up from it, that fits its location.

    A map fits if its own name ends in the location's id (`location1.osm`), or its folder's name
    begins with it (`01_bendplatz`). Of several, inD's construction map serves the recordings made
    then and no others. Without a name that fits, the map within 1 km of the recording serves.

    Args:
        files: the recording's files.
        meta: its metadata.
        maps_below: the maps in and below folders, as far as these were searched; is added to.

    Raises:
        DataError: there is none.
    """
    top = files.root.parent if files.root.name == "data" else files.root
    for folder in upwards(files.recording_meta.parent, top):
        maps = [path for path in maps_in(folder, maps_below) if path.suffix == ".osm"]
        fitting = [path for path in maps if _names_location(path, meta.location)]
        under_construction = meta.location == 1 and meta.number in CONSTRUCTION_RECORDINGS
        preferred = [path for path in fitting if _is_construction(path) == under_construction]
        chosen = preferred or fitting or _near(maps, meta.origin)
        if chosen:
            return chosen[0]
    raise DataError(
        f"{files.root}: no map for location {meta.location} of recording {files.name}; "
        f"expected a lanelet2 file location{meta.location}.osm in it or below"
    )


def metres_per_pixel(
    files: LevelxFiles, meta: RecordingMeta, size_px: tuple[int, int], xy: np.ndarray
) -> float | None:
    """The scale of a background image.

    `orthoPxToMeter` is that of the original image; the published one is smaller by a factor that
    no file tells. It is the dataset's where a folder carries its name (inD 12, rounD 10, exiD 6,
    uniD 2), else the smallest of 1, 2, 6, 10, 12; in either case all positions must lie in the
    image, as they do where they were seen in it.

    Args:
        files: the recording's files.
        meta: its metadata.
        size_px: width and height of the image.
        xy: positions (n, 2) of the recording's road users, metres.

    Returns:
        Metres per pixel; None without `orthoPxToMeter`, or if no factor fits.
    """
    if meta.metres_per_ortho_pixel is None:
        return None
    folders = [part.lower() for part in files.recording_meta.resolve().parts[:-1]]
    named = [
        factor
        for name, factor in DOWNSCALE.items()
        if any(re.match(rf"{name}(?![a-z])", folder) for folder in folders)
    ]
    low, high = xy.min(axis=0), xy.max(axis=0)
    for factor in (*named, *SCALES):
        scale = factor * meta.metres_per_ortho_pixel
        margin = MARGIN_PX * scale
        right, bottom = size_px[0] * scale, size_px[1] * scale
        if (
            min(low[0], -high[1]) > -margin
            and high[0] - right < margin
            and -low[1] - bottom < margin
        ):
            return scale
    return None


def _names_location(path: Path, location: int) -> bool:
    own = re.search(r"location[_-]?0*(\d+)$", path.stem, re.IGNORECASE)
    if own:
        return int(own[1]) == location
    folder = re.match(r"0*(\d+)[_-]", path.parent.name)
    return bool(folder) and int(folder[1]) == location


def _is_construction(path: Path) -> bool:
    return "const" in f"{path.parent.name}/{path.stem}".lower()


def _near(maps: list[Path], origin: Origin) -> list[Path]:
    found = []
    for path in maps:
        try:
            degrees = np.array(list(read_osm(path).nodes.values())).reshape(-1, 2)
        except DataError:
            continue
        if not len(degrees):
            continue
        xy = np.median(project(degrees[:, 0], degrees[:, 1], origin), axis=0)
        distance = math.hypot(*xy)
        if distance < NEAR_M:
            found.append((distance, path))
    return [path for _, path in sorted(found)]


def _positive(path: Path, column: str) -> float | None:
    """An optional cell; files write nothing, 0, -1 or NaN for what is not known."""
    try:
        value = float(read_table(path, {column: "number"})[column][0])
    except DataError:
        return None
    return value if value > 0 else None
