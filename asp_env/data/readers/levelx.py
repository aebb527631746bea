"""The inD/rounD layout: which files make a recording, and which map and scale belong to it.

Per recording `XX`: `XX_recordingMeta.csv`, `XX_tracksMeta.csv`, `XX_tracks.csv` (or `.csv.gz`) and
perhaps `XX_background.png`, together in any folder below the one given. Metadata are read per
recording, never per location: the origin differs between recordings of one site.

MERGED: `XX_tracks.csv` and `XX_tracksMeta.csv` into one table of tracks.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.classes import FOOTPRINTS_M, VULNERABLE, parse_class
from asp_env.data.readers.folders import maps_in, natural, upwards, walk
from asp_env.data.readers.lanelet2 import Origin, project, read_osm, shorten
from asp_env.data.readers.tables import Kind, find_line, read_columns, read_table
from asp_env.errors import DataError
from asp_env.geometry import wrap_angle

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


MOVES_MPS = 0.3
"""Above this the direction of motion is a vulnerable road user's heading."""

_META: Mapping[str, Kind] = {
    "trackId": "whole",
    "initialFrame": "whole",
    "finalFrame": "whole",
    "width": "number",
    "length": "number",
    "class": "text",
}
_TRACKS: Mapping[str, Kind] = {
    "trackId": "whole",
    "frame": "whole",
    "xCenter": "number",
    "yCenter": "number",
    "heading": "number",
    "xVelocity": "number",
    "yVelocity": "number",
    "width": "number",
    "length": "number",
}
_MEASURED = ("xCenter", "yCenter", "heading", "xVelocity", "yVelocity")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackTable:
    """The columns of a `Recording` that come from its tracks, and what had to be mended."""

    track_ids: Int[np.ndarray, " tracks"]
    classes: Int[np.ndarray, " tracks"]
    sizes: Float[np.ndarray, "tracks 2"]
    first_frames: Int[np.ndarray, " tracks"]
    starts: Int[np.ndarray, " tracks+1"]
    states: Float[np.ndarray, "rows 4"]
    repairs: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rows:
    """Rows sorted by track, then frame."""

    track: Int[np.ndarray, " rows"]
    frame: Int[np.ndarray, " rows"]
    measured: Float[np.ndarray, "rows 5"]
    """x, y, heading in degrees, velocity along x and y."""
    sizes: Float[np.ndarray, "rows 2"]


def read_tracks(files: LevelxFiles) -> TrackTable:
    """Reads a recording's tracks.

    Vehicles keep the file's heading; their speed is the velocity's, negative when they back up.
    Vulnerable road users head where they move; below 0.3 m/s they keep the heading they had, and
    before they first move the file's. Their speed is the size of the velocity.
    A track with a gap in its frames is split there: what follows gets an id of its own.

    Raises:
        DataError: a file is damaged, or the two disagree on which tracks there are.
    """
    meta = read_table(files.tracks_meta, _META)
    ids = meta["trackId"]
    if len(np.unique(ids)) < len(ids):
        values, counts = np.unique(ids, return_counts=True)
        twice = int(values[counts > 1][0])
        line = find_line(files.tracks_meta, {"trackId": twice}, occurrence=2)
        raise DataError(
            f"{files.tracks_meta}, line {line}: track {twice} is listed twice, expected once; "
            "remove one of the two"
        )
    order = np.argsort(ids)
    classes = _classes(files, meta["class"])[order]
    rows = _read_rows(files)
    _check_ids(files, rows, ids[order])
    repairs: list[str] = []
    begins = np.flatnonzero(np.diff(rows.track, prepend=rows.track[0] - 1))
    _compare_frames(rows, begins, meta, order, repairs)
    sizes = _sizes(rows.sizes[begins], meta, order, classes)

    splits = np.flatnonzero((np.diff(rows.track) == 0) & (np.diff(rows.frame) > 1)) + 1
    starts = np.union1d(begins, splits)
    owner = np.searchsorted(ids[order], rows.track[starts])
    new_ids = ids[order][owner]
    fresh = np.isin(starts, splits)
    new_ids[fresh] = ids.max() + 1 + np.arange(fresh.sum())
    if len(splits):
        told = [f"{rows.track[at]} after frame {rows.frame[at - 1]}" for at in splits]
        repairs.append(f"{len(splits)} gaps in tracks' frames, split there: {shorten(told)}")
    by_id = np.argsort(new_ids, kind="stable")
    vulnerable = np.isin(classes, [int(kind) for kind in VULNERABLE])
    return _assemble(rows, starts, by_id, new_ids, owner, classes, sizes, vulnerable, repairs)


def _assemble(
    rows: _Rows,
    starts: Int[np.ndarray, " tracks"],
    by_id: Int[np.ndarray, " tracks"],
    new_ids: Int[np.ndarray, " tracks"],
    owner: Int[np.ndarray, " tracks"],
    classes: Int[np.ndarray, " metas"],
    sizes: Float[np.ndarray, "metas 2"],
    vulnerable: Bool[np.ndarray, " metas"],
    repairs: list[str],
) -> TrackTable:
    lengths = np.diff(starts, append=len(rows.track))
    states = states_of(
        rows.measured, np.repeat(starts, lengths), np.repeat(vulnerable[owner], lengths)
    )
    if (np.diff(by_id) < 0).any():
        ends = starts + lengths
        states = np.concatenate([states[starts[track] : ends[track]] for track in by_id])
    return TrackTable(
        track_ids=new_ids[by_id],
        classes=classes[owner][by_id],
        sizes=sizes[owner][by_id],
        first_frames=rows.frame[starts][by_id].astype(np.int64),
        starts=np.concatenate([[0], np.cumsum(lengths[by_id])]).astype(np.int64),
        states=states,
        repairs=tuple(repairs),
    )


def states_of(
    measured: Float[np.ndarray, "rows 5"],
    first_row: Int[np.ndarray, " rows"],
    vulnerable: Bool[np.ndarray, " rows"],
) -> Float[np.ndarray, "rows 4"]:
    """The states of a recording's rows.

    Vulnerable road users head where they move, from the past alone; vehicles' speeds have the
    sign of motion along the heading.

    Args:
        measured: x, y, heading in degrees, velocity along x and y.
        first_row: of each row, the first of its track.
        vulnerable: which rows are of vulnerable road users.
    """
    heading = np.radians(measured[:, 2])
    velocity_x, velocity_y = measured[:, 3], measured[:, 4]
    total = np.hypot(velocity_x, velocity_y)
    moves = vulnerable & (total > MOVES_MPS)
    row = np.arange(len(measured))
    last_moving = np.maximum.accumulate(np.where(moves, row, -1))
    known = vulnerable & (last_moving >= first_row)
    course = np.arctan2(velocity_y, velocity_x)
    heading = np.where(known, course[last_moving], heading)
    along = velocity_x * np.cos(heading) + velocity_y * np.sin(heading)
    # the bicycle's speed is that of the box's centre, which slips sideways in bends
    speed = np.where(vulnerable, total, np.copysign(total, along))
    states = np.stack([measured[:, 0], measured[:, 1], wrap_angle(heading), speed], axis=-1)
    return states.astype(np.float32)


def _classes(files: LevelxFiles, names: np.ndarray) -> Int[np.ndarray, " metas"]:
    numbers = {}
    for name in dict.fromkeys(names):
        try:
            numbers[name] = int(parse_class(str(name)))
        except DataError as error:
            line = find_line(files.tracks_meta, {"class": str(name)})
            raise DataError(f"{files.tracks_meta}, line {line}: {error}") from None
    return np.array([numbers[name] for name in names], dtype=np.int8)


def _read_rows(files: LevelxFiles) -> _Rows:
    track, frame, measured, sizes = [], [], [], []
    optional = frozenset({"width", "length"})
    for chunk in read_columns(files.tracks, _TRACKS, optional=optional):
        track.append(chunk["trackId"].astype(np.int32))
        frame.append(chunk["frame"].astype(np.int32))
        measured.append(np.stack([chunk[name] for name in _MEASURED], axis=-1).astype(np.float32))
        unknown = np.zeros(len(chunk["frame"]))
        both = [chunk.get("length", unknown), chunk.get("width", unknown)]
        sizes.append(np.stack(both, axis=-1).astype(np.float32))
    rows = _Rows(
        track=np.concatenate(track),
        frame=np.concatenate(frame),
        measured=np.concatenate(measured),
        sizes=np.concatenate(sizes),
    )
    return _sorted(files, rows)


def _sorted(files: LevelxFiles, rows: _Rows) -> _Rows:
    step, later = np.diff(rows.track), np.diff(rows.frame)
    if not ((step > 0) | ((step == 0) & (later > 0))).all():
        order = np.lexsort((rows.frame, rows.track))
        rows = _Rows(
            track=rows.track[order],
            frame=rows.frame[order],
            measured=rows.measured[order],
            sizes=rows.sizes[order],
        )
        same = (np.diff(rows.track) == 0) & (np.diff(rows.frame) == 0)
        if same.any():
            at = int(same.argmax())
            values = {"trackId": int(rows.track[at]), "frame": int(rows.frame[at])}
            line = find_line(files.tracks, values, occurrence=2)
            raise DataError(
                f"{files.tracks}, line {line}: a second row for track {values['trackId']} at frame "
                f"{values['frame']}, expected one; remove one of the two"
            )
    if rows.frame.min() < 0:
        first = int(rows.frame.min())
        line = find_line(files.tracks, {"frame": first})
        raise DataError(f"{files.tracks}, line {line}: frame is {first}, expected 0 or more")
    return rows


def _check_ids(files: LevelxFiles, rows: _Rows, ids: Int[np.ndarray, " metas"]) -> None:
    there = np.unique(rows.track)
    strangers = np.setdiff1d(there, ids)
    if len(strangers):
        line = find_line(files.tracks, {"trackId": int(strangers[0])})
        raise DataError(
            f"{files.tracks}, line {line}: track {strangers[0]} is not in "
            f"{files.tracks_meta.name}, expected each of its tracks there; "
            "the files are of different recordings or damaged"
        )
    absent = np.setdiff1d(ids, there)
    if len(absent):
        line = find_line(files.tracks_meta, {"trackId": int(absent[0])})
        raise DataError(
            f"{files.tracks}: has no row for {len(absent)} tracks of {files.tracks_meta.name}, "
            f"the first being {absent[0]} (line {line} there); the file is cut: copy it again"
        )


def _compare_frames(
    rows: _Rows,
    begins: Int[np.ndarray, " metas"],
    meta: Mapping[str, np.ndarray],
    order: Int[np.ndarray, " metas"],
    repairs: list[str],
) -> None:
    last = np.append(begins[1:], len(rows.frame)) - 1
    differ = (rows.frame[begins] != meta["initialFrame"][order]) | (
        rows.frame[last] != meta["finalFrame"][order]
    )
    if differ.any():
        told = [str(track) for track in rows.track[begins][differ]]
        repairs.append(
            f"{len(told)} tracks begin or end at another frame than tracksMeta says: "
            f"{shorten(told)}"
        )


def _sizes(
    in_rows: Float[np.ndarray, "metas 2"],
    meta: Mapping[str, np.ndarray],
    order: Int[np.ndarray, " metas"],
    classes: Int[np.ndarray, " metas"],
) -> Float[np.ndarray, "metas 2"]:
    """The rows' sizes, where they are zero the metadata's, where these are the class's."""
    in_meta = np.stack([meta["length"], meta["width"]], axis=-1)[order].astype(np.float32)
    sizes = np.where((in_rows > 0).all(axis=-1, keepdims=True), in_rows, in_meta)
    return np.where((sizes > 0).all(axis=-1, keepdims=True), sizes, FOOTPRINTS_M[classes])
