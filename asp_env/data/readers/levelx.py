"""The inD/rounD layout: recordings of three CSV tables each, their maps, and background images.

Recording `XX` consists of `XX_recordingMeta.csv`, `XX_tracksMeta.csv`, `XX_tracks.csv` (or
`.csv.gz`, `.csv.xz`) and optionally `XX_background.png`, all in one folder, at any depth. Metadata
are read for each recording, not for each location: the origin differs between recordings of one
location.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.classes import VULNERABLE
from asp_env.data.readers.compressed import CSV
from asp_env.data.readers.layout import (
    COURSE_ABOVE_MPS,
    ClassNames,
    TrackTable,
    archive_hint,
    find_maps,
    map_suffix,
    natural_key,
    shorten,
    states_of,
    walk,
    with_parents,
)
from asp_env.data.readers.levelx_meta import RecordingMeta
from asp_env.data.readers.motion_checks import check_headings, check_velocities, motion_of
from asp_env.data.readers.osm import read_osm
from asp_env.data.readers.positions import Origin, locate_nodes
from asp_env.data.readers.ranges import (
    ACCELERATION,
    HEADING_DEG,
    MAX_FRAMES,
    POSITION,
    SIZE,
    SPEED,
    Limit,
    check_duration,
    check_extent,
)
from asp_env.data.readers.sizes import with_footprints
from asp_env.data.readers.tables import (
    LOWEST_HZ,
    Kind,
    NumberedIds,
    find_line,
    number_ids,
    read_columns,
    read_table,
)
from asp_env.errors import DataError

CONSTRUCTION_RECORDINGS = frozenset(range(11, 18))
"""Recordings of inD's location 1 that were made while its site was under construction."""

NEAR_M = 1_000.0
"""A map whose name gives no location belongs to recordings within this distance. Chosen by hand:
more than a site's extent, less than the distance between sites."""

DOWNSCALE = {"ind": 12, "round": 10, "exid": 6, "unid": 2}
"""Factor by which each dataset's published background images are smaller than the images that
`orthoPxToMeter` refers to."""

SCALES = (1, 2, 6, 10, 12)
"""Factors to try for a dataset that is not in `DOWNSCALE`."""

MARGIN_PX = 5.0
"""Distance by which positions may lie outside the image, for rounded scales and smoothed positions.
Chosen by hand."""

_PART = re.compile(
    rf"^(.+)_(recordingMeta\.csv|tracksMeta\.csv|tracks{CSV}|background\.png)$",
    re.IGNORECASE,
)
_OWN_LOCATION = re.compile(r"location[_-]?0*(\d+)$", re.IGNORECASE | re.ASCII)
_META: Mapping[str, Kind] = {
    "trackId": "id",
    "initialFrame": "whole",
    "finalFrame": "whole",
    "width": "number or empty",
    "length": "number or empty",
    "class": "text",
}
_TRACKS: Mapping[str, Kind] = {
    "trackId": "id",
    "frame": "whole",
    "xCenter": "number",
    "yCenter": "number",
    "heading": "number",
    "xVelocity": "number",
    "yVelocity": "number",
    "width": "number or empty",
    "length": "number or empty",
}
_VULNERABLE = [int(kind) for kind in VULNERABLE]
_ACCELERATIONS = ("xAcceleration", "yAcceleration", "lonAcceleration")
_MEASURED = ("xCenter", "yCenter", "heading", "xVelocity", "yVelocity")
_LIMITS: Mapping[str, Limit] = {
    "xCenter": POSITION,
    "yCenter": POSITION,
    "heading": HEADING_DEG,
    "xVelocity": SPEED,
    "yVelocity": SPEED,
    "width": SIZE,
    "length": SIZE,
    **dict.fromkeys(_ACCELERATIONS, ACCELERATION),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelxFiles:
    """The files of one recording. Paths of missing files are those where they are expected."""

    name: str
    root: Path
    """The folder given as DATA. Maps are searched from the recording's folder up to it."""
    recording_meta: Path
    tracks_meta: Path
    tracks: Path
    background: Path | None

    @property
    def tables(self) -> tuple[Path, Path, Path]:
        """The three CSV files that every recording has."""
        return (self.recording_meta, self.tracks_meta, self.tracks)

    def check_complete(self) -> None:
        """Checks that all tables exist.

        Raises:
            DataError: a table is missing.
        """
        present = [path.name for path in self.tables if path.is_file()]
        for path in self.tables:
            if path.name in present:
                continue
            if path.is_symlink():
                raise DataError(
                    f"{path}: is a link to a file that does not exist; fetch that file, such as by "
                    "`git annex get`, or remove the recording"
                )
            raise DataError(
                f"{path}: no such file, though {', '.join(present)} exists; "
                "copy it to the same folder or remove the recording"
                f"{archive_hint(path.parent)}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rows:
    """Rows of `XX_tracks.csv`, sorted by track, then frame."""

    track: Int[np.ndarray, " rows"]
    frame: Int[np.ndarray, " rows"]
    measured: Float[np.ndarray, "rows 5"]
    """x, y, heading in degrees, velocity along x and y."""
    sizes: Float[np.ndarray, "rows 2"]
    accelerations: Float[np.ndarray, "rows 3"] | None
    """Along x, along y and along the heading, NaN where the file lacks one of these columns; None
    if it lacks all of them."""


def find_recordings(root: Path) -> tuple[LevelxFiles, ...]:
    """The recordings in and below a folder, in natural order of names, incomplete ones included.

    A recording's name is its id, preceded by its folder where several folders have the same id:
    `rounD/00`.
    """
    parts: dict[tuple[Path, str], dict[str, Path]] = {}
    for folder, names in walk(root):
        for name in names:
            if match := _PART.match(name):
                kind = match[2].split(".")[0].lower()
                parts.setdefault((folder, match[1]), {})[kind] = folder / name
    parts = {key: files for key, files in parts.items() if set(files) != {"background"}}
    ids = Counter(prefix for _, prefix in parts)
    found = []
    for (folder, prefix), files in parts.items():
        place = folder.parent if folder.name == "data" else folder
        inside = place.relative_to(root) if place.is_relative_to(root) else Path()
        found.append(
            LevelxFiles(
                name=prefix if ids[prefix] == 1 else (inside / prefix).as_posix(),
                root=root,
                recording_meta=files.get("recordingmeta", folder / f"{prefix}_recordingMeta.csv"),
                tracks_meta=files.get("tracksmeta", folder / f"{prefix}_tracksMeta.csv"),
                tracks=files.get("tracks", folder / f"{prefix}_tracks.csv"),
                background=files.get("background"),
            )
        )
    return tuple(sorted(found, key=lambda files: natural_key(files.name)))


def find_map(
    files: LevelxFiles, meta: RecordingMeta, maps_by_folder: dict[Path, list[Path]]
) -> tuple[Path, tuple[str, ...]]:
    """The lanelet2 map of a recording: the nearest matching one in a parent folder.

    A map matches a location if its name ends in the location's id (`location1.osm`), or its
    folder's name begins with it (`01_bendplatz`). inD's construction-site map is for the recordings
    made during construction only, where another one matches as well. If no name matches, a map
    within 1 km of the recording is used.

    Args:
        files: the recording's files.
        meta: its metadata.
        maps_by_folder: map files in and below the folders searched so far. Results are added.

    Returns:
        The map, and a line for a report where several match or none is named after the location.

    Raises:
        DataError: no map matches.
    """
    top = files.root.parent if files.root.name == "data" else files.root
    for folder in with_parents(files.recording_meta.parent, top):
        maps = [path for path in find_maps(folder, maps_by_folder) if map_suffix(path) == ".osm"]
        fitting = [path for path in maps if _names_location(path, meta.location)]
        under_construction = meta.location == 1 and meta.number in CONSTRUCTION_RECORDINGS
        preferred = [path for path in fitting if _is_construction(path) == under_construction]
        chosen = preferred or fitting or _maps_near(maps, meta.origin)
        if chosen:
            if fitting:  # `location1.osm` before other names in the folder `01_bendplatz`
                chosen = sorted(chosen, key=lambda path: not _OWN_LOCATION.search(path.stem))
            return chosen[0], _guess(chosen, folder, meta.location, named=bool(fitting))
    raise DataError(
        f"{files.root}: no map for location {meta.location} of recording {files.name}; "
        f"expected a lanelet2 file location{meta.location}.osm in it or below"
        f"{archive_hint(files.root)}"
    )


def metres_per_pixel(
    files: LevelxFiles,
    meta: RecordingMeta,
    size_px: tuple[int, int],
    xy: Float[np.ndarray, "rows 2"],
    moving: Bool[np.ndarray, " rows"],
) -> float | None:
    """The scale of a background image.

    `orthoPxToMeter` is the scale of the original image. The published image is smaller by a factor
    that no file contains. It is the dataset's factor if a folder has the dataset's name (inD 12,
    rounD 10, exiD 6, uniD 2), otherwise the smallest of 1, 2, 6, 10 and 12. A factor is used only
    if all positions then lie in the image. If none fits, the largest is used if the positions of
    agents that ever move lie in the image: an agent may stand beside it throughout.

    Args:
        files: the recording's files.
        meta: its metadata.
        size_px: width and height of the image.
        xy: positions of the recording's agents, metres.
        moving: whether the agent of each row ever moves.

    Returns:
        Metres per pixel. None without `orthoPxToMeter`, or if no factor fits.
    """
    if meta.metres_per_ortho_pixel is None:
        return None
    folders = [part.lower() for part in files.recording_meta.resolve().parts[:-1]]
    named = [
        factor
        for name, factor in DOWNSCALE.items()
        if any(re.match(rf"{name}(?![a-z])", folder) for folder in folders)
    ]
    scales = [factor * meta.metres_per_ortho_pixel for factor in (*named, *SCALES)]
    for scale in scales:
        if _lie_in_image(xy, size_px, scale):
            return scale
    largest = max(scales)
    return largest if moving.any() and _lie_in_image(xy[moving], size_px, largest) else None


def _lie_in_image(xy: Float[np.ndarray, "rows 2"], size_px: tuple[int, int], scale: float) -> bool:
    """Whether positions (metres) lie in an image of a scale (metres per pixel)."""
    low_px, high_px = xy.min(axis=0) / scale, xy.max(axis=0) / scale
    return bool(
        min(low_px[0], -high_px[1]) > -MARGIN_PX
        and high_px[0] - size_px[0] < MARGIN_PX
        and -low_px[1] - size_px[1] < MARGIN_PX
    )


def read_levelx(files: LevelxFiles, frame_rate_hz: float) -> TrackTable:
    """Reads a recording's tracks.

    The heading of a vehicle is that of the file; its speed is the norm of the velocity, negative if
    the vehicle moves backwards. The heading of a vulnerable road user is its direction of motion;
    below 0.3 m/s the previous heading is held, and before the first motion it is that of the file.
    Accelerations are those of the file along the velocity, or along the heading below 0.3 m/s or
    without the columns `xAcceleration` and `yAcceleration`. A track with a gap in its frames is
    split there, and the later part gets a new id.

    Args:
        files: the recording's files.
        frame_rate_hz: the frame rate in its metadata.

    Raises:
        DataError: a file is damaged, or the two tables list different tracks.
    """
    meta = read_table(files.tracks_meta, _META, limits=_LIMITS)
    rows, numbered = _read_rows(files, meta["trackId"])
    ids_in_meta = numbered.columns[1]
    _check_unique(files, ids_in_meta, numbered)
    order = np.argsort(ids_in_meta)
    ids = ids_in_meta[order]
    names = ClassNames()
    classes = names.classes(meta["class"], ids_in_meta)[order]
    _check_same_tracks(files, rows, ids, numbered)
    check_extent(
        rows.measured[:, :2], ("xCenter", "yCenter"), lambda row: _line(files, rows, row, numbered)
    )
    repairs = [*names.repairs(), *numbered.repairs]
    rows, step = _count_frames(files, rows, meta, numbered, frame_rate_hz, repairs)
    begins = np.flatnonzero(np.diff(rows.track, prepend=rows.track[0] - 1))
    _compare_frames(rows, begins, meta, order, repairs)
    sizes = _sizes(files, rows.sizes[begins], meta, order, classes, repairs)
    is_vulnerable = np.isin(classes, _VULNERABLE)
    _check_motion(files, rows, frame_rate_hz / step, is_vulnerable=is_vulnerable, repairs=repairs)

    starts, new_ids = _split_at_gaps(rows, begins, ids, repairs)
    lengths = np.diff(starts, append=len(rows.track))
    owner = np.searchsorted(ids, rows.track[starts])
    vulnerable = np.isin(classes[owner], _VULNERABLE)
    states = states_of(rows.measured, np.repeat(starts, lengths), np.repeat(vulnerable, lengths))
    accelerations = _along_motion(rows, states)
    by_id = np.argsort(new_ids, kind="stable")
    if (np.diff(by_id) < 0).any():
        ends = starts + lengths
        pieces = [slice(starts[track], ends[track]) for track in by_id]
        states = np.concatenate([states[piece] for piece in pieces])
        if accelerations is not None:
            accelerations = np.concatenate([accelerations[piece] for piece in pieces])
    return TrackTable(
        track_ids=new_ids[by_id],
        classes=classes[owner][by_id],
        sizes=sizes[owner][by_id],
        first_frames=rows.frame[starts][by_id].astype(np.int64),
        starts=np.concatenate([[0], np.cumsum(lengths[by_id])]).astype(np.int64),
        states=states,
        accelerations=accelerations,
        frames_per_row=step,
        repairs=tuple(repairs),
    )


def _along_motion(
    rows: _Rows, states: Float[np.ndarray, "rows 4"]
) -> Float[np.ndarray, " rows"] | None:
    """Accelerations along the direction of motion, signed as the speed of the states."""
    if rows.accelerations is None:
        return None
    along_x, along_y, along_heading = rows.accelerations.T
    velocity_x, velocity_y = rows.measured[:, 3], rows.measured[:, 4]
    speed = np.hypot(velocity_x, velocity_y)
    backwards = states[:, 3] < 0
    course = np.arctan2(velocity_y, velocity_x) + np.where(backwards, np.pi, 0)
    course = np.where(speed > COURSE_ABOVE_MPS, course, states[:, 2])
    along_course = along_x * np.cos(course) + along_y * np.sin(course)
    found = np.where(np.isnan(along_course), along_heading, along_course)
    return None if np.isnan(found).any() else found.astype(np.float32)


def _names_location(path: Path, location: int) -> bool:
    if own := _OWN_LOCATION.search(path.stem):
        return int(own[1]) == location
    folder = re.match(r"0*([0-9]+)[_-]", path.parent.name)
    return bool(folder) and int(folder[1]) == location


def _guess(maps: list[Path], folder: Path, location: int, *, named: bool) -> tuple[str, ...]:
    """A line about the choice of the first of some maps, unless nothing was to be chosen."""
    first, *others = [path.relative_to(folder).as_posix() for path in maps]
    if named and not others:
        return ()
    why = "the first one" if named else f"the nearest one, since no name has location {location}"
    more = f", not {shorten(others)}" if others else ""
    return (f"map {first} is used, {why}{more}",)


def _is_construction(path: Path) -> bool:
    return "const" in f"{path.parent.name}/{path.stem}".lower()


def _maps_near(maps: list[Path], origin: Origin) -> list[Path]:
    found = []
    for path in maps:
        try:
            points = locate_nodes(read_osm(path), origin, [])
        except DataError:
            continue
        if not points:
            continue
        xy = np.median(list(points.values()), axis=0)
        distance = math.hypot(*xy)
        if distance < NEAR_M:
            found.append((distance, path))
    return [path for _, path in sorted(found)]


def _check_unique(
    files: LevelxFiles, ids: Int[np.ndarray, " metas"], numbered: NumberedIds
) -> None:
    values, counts = np.unique(ids, return_counts=True)
    if len(values) < len(ids):
        double = numbered.original(int(values[counts > 1][0]))
        line = find_line(files.tracks_meta, {"trackId": double}, occurrence=2)
        raise DataError(
            f"{files.tracks_meta}, line {line}: track {double} is listed twice, expected once; "
            "remove one of the two lines"
        )


def _read_rows(files: LevelxFiles, ids_in_meta: np.ndarray) -> tuple[_Rows, NumberedIds]:
    """The rows, and the ids of tracks; the second column of the ids is `ids_in_meta`."""
    track, frame, measured, sizes, accelerations = [], [], [], [], []
    columns: dict[str, Kind] = {**_TRACKS, **dict.fromkeys(_ACCELERATIONS, "number")}
    optional = frozenset({"width", "length", *_ACCELERATIONS})
    for chunk in read_columns(files.tracks, columns, optional=optional, limits=_LIMITS):
        track.append(chunk["trackId"])
        frame.append(chunk["frame"])
        measured.append(np.stack([chunk[name] for name in _MEASURED], axis=-1).astype(np.float32))
        unknown = np.zeros(len(chunk["frame"]))
        size = [chunk.get("length", unknown), chunk.get("width", unknown)]
        sizes.append(np.stack(size, axis=-1).astype(np.float32))
        if any(name in chunk for name in _ACCELERATIONS):
            missing = np.full(len(chunk["frame"]), np.nan)
            found = [chunk.get(name, missing) for name in _ACCELERATIONS]
            accelerations.append(np.stack(found, axis=-1).astype(np.float32))
    numbered = number_ids(np.concatenate(track), ids_in_meta)
    rows = _Rows(
        track=numbered.columns[0],
        frame=np.concatenate(frame),
        measured=np.concatenate(measured),
        sizes=np.concatenate(sizes),
        accelerations=np.concatenate(accelerations) if accelerations else None,
    )
    return _sorted(files, rows, numbered), numbered


def _sorted(files: LevelxFiles, rows: _Rows, numbered: NumberedIds) -> _Rows:
    step, later = np.diff(rows.track), np.diff(rows.frame)
    if not ((step > 0) | ((step == 0) & (later > 0))).all():
        order = np.lexsort((rows.frame, rows.track))
        rows = _Rows(
            track=rows.track[order],
            frame=rows.frame[order],
            measured=rows.measured[order],
            sizes=rows.sizes[order],
            accelerations=None if rows.accelerations is None else rows.accelerations[order],
        )
        same = (np.diff(rows.track) == 0) & (np.diff(rows.frame) == 0)
        if same.any():
            row = int(same.argmax())
            raise DataError(
                f"{_line(files, rows, row, numbered, occurrence=2)}: a second row for track "
                f"{numbered.original(int(rows.track[row]))} at frame {rows.frame[row]}, expected "
                "one; remove one of the two"
            )
    if rows.frame.min() < 0:
        first = int(rows.frame.min())
        line = find_line(files.tracks, {"frame": first})
        raise DataError(f"{files.tracks}, line {line}: frame is {first}, expected 0 or more")
    return rows


def _line(
    files: LevelxFiles, rows: _Rows, row: int, numbered: NumberedIds, *, occurrence: int = 1
) -> str:
    """File and line of a row, with frames as in the file."""
    cells = {"trackId": numbered.original(int(rows.track[row])), "frame": int(rows.frame[row])}
    return f"{files.tracks}, line {find_line(files.tracks, cells, occurrence=occurrence)}"


def _count_frames(
    files: LevelxFiles,
    rows: _Rows,
    meta: dict[str, np.ndarray],
    numbered: NumberedIds,
    rate_hz: float,
    repairs: list[str],
) -> tuple[_Rows, int]:
    """Rows with frames that count rows of a track, and the frames of the file per row.

    Frames beyond `MAX_FRAMES`, such as time stamps, count from the first row. Frames in
    milliseconds are converted by the frame rate. Where all tracks have only every n-th frame, these
    are counted. The frames in `meta` are converted likewise.
    """
    names = ("initialFrame", "finalFrame")
    frames = {"frame": rows.frame, **{name: meta[name] for name in names}}
    first = int(rows.frame.min())
    if int(rows.frame.max()) >= MAX_FRAMES:
        check_duration(rows.frame, lambda row: _line(files, rows, row, numbered))
        frames = {name: column - first for name, column in frames.items()}
        repairs.append(f"frames begin at {first}: counted from there")
    steps = np.diff(rows.frame)[np.diff(rows.track) == 0]
    usual = int(np.median(steps)) if len(steps) else 1
    step = 1
    if usual > 1:
        if abs(usual - 1000.0 / rate_hz) <= 1.0:
            frames = {
                name: np.round(column * (rate_hz / 1000.0)).astype(np.int64)
                for name, column in frames.items()
            }
            repairs.append(f"frames count milliseconds: converted to frames of {rate_hz:g} Hz")
        elif not ((rows.frame - first) % usual).any() and rate_hz / usual >= LOWEST_HZ:
            step = usual
            frames = {name: column // step for name, column in frames.items()}
            repairs.append(f"rows have one of {step} frames at {rate_hz:g} Hz: these are counted")
        else:
            raise DataError(
                f"{files.tracks}: most rows are {usual:,} frames after the row before of their "
                "track; expected every frame, milliseconds, or every n-th frame with the same n "
                f"and the same first frame in all tracks, at {LOWEST_HZ:g} Hz or more: number the "
                "rows of all tracks by the frames that they have in common"
            )
    meta |= {name: frames[name] for name in names}
    same = (np.diff(rows.track) == 0) & (np.diff(frames["frame"]) == 0)
    if same.any():
        row = int(same.argmax()) + 1
        raise DataError(
            f"{_line(files, rows, row, numbered)}: frame is {rows.frame[row]}, less than a frame "
            "after the row before; expected steps as between most rows: remove one of the two"
        )
    return replace(rows, frame=frames["frame"]), step


def _check_same_tracks(
    files: LevelxFiles, rows: _Rows, ids: Int[np.ndarray, " metas"], numbered: NumberedIds
) -> None:
    present = np.unique(rows.track)
    unlisted = np.setdiff1d(present, ids)
    if len(unlisted):
        track = numbered.original(int(unlisted[0]))
        line = find_line(files.tracks, {"trackId": track})
        raise DataError(
            f"{files.tracks}, line {line}: track {track} is not in "
            f"{files.tracks_meta.name}, expected all tracks there; "
            "the files belong to different recordings or are damaged"
        )
    absent = np.setdiff1d(ids, present)
    if len(absent):
        track = numbered.original(int(absent[0]))
        line = find_line(files.tracks_meta, {"trackId": track})
        raise DataError(
            f"{files.tracks}: has no row for {len(absent)} tracks of {files.tracks_meta.name}, "
            f"the first of which is {track} (line {line} there); the file is truncated: "
            "copy it again"
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
        tracks = [str(track) for track in rows.track[begins][differ]]
        repairs.append(
            f"{len(tracks)} tracks begin or end at another frame than in tracksMeta: "
            f"{shorten(tracks)}"
        )


def _sizes(
    files: LevelxFiles,
    in_rows: Float[np.ndarray, "metas 2"],
    meta: Mapping[str, np.ndarray],
    order: Int[np.ndarray, " metas"],
    classes: Int[np.ndarray, " metas"],
    repairs: list[str],
) -> Float[np.ndarray, "metas 2"]:
    """The sizes in the rows, where these are unknown those in the metadata, else the class's."""
    in_meta = np.stack([meta["length"], meta["width"]], axis=-1)[order].astype(np.float32)
    sizes = np.where((in_rows > 0).all(axis=-1, keepdims=True), in_rows, in_meta)
    return with_footprints(sizes, classes, str(files.tracks), repairs)


def _check_motion(
    files: LevelxFiles,
    rows: _Rows,
    rate_hz: float,
    *,
    is_vulnerable: Bool[np.ndarray, " metas"],
    repairs: list[str],
) -> None:
    """Checks that velocities, frame rate and headings of vehicles agree with the positions.

    Args:
        files: the recording's files.
        rows: the rows, whose frames count rows.
        rate_hz: rows of a track per second.
        is_vulnerable: whether each track, in the order of `rows`, is that of a vulnerable road
            user, whose heading is not used.
        repairs: lines about single tracks are added.

    Raises:
        DataError: those of most moving tracks do not agree.
    """
    motion = motion_of(rows.track, rows.frame, rows.measured[:, :2], rate_hz)
    repairs += check_velocities(
        motion, rows.measured[:, 3:], rate_hz, str(files.tracks), files.recording_meta.name
    )
    of_track = np.cumsum(np.diff(rows.track, prepend=rows.track[:1]) != 0)
    headings = np.radians(rows.measured[:, 2].astype(np.float64))
    headings[is_vulnerable[of_track]] = np.nan
    repairs += check_headings(motion, headings, str(files.tracks), unit="degrees")


def _split_at_gaps(
    rows: _Rows,
    begins: Int[np.ndarray, " metas"],
    ids: Int[np.ndarray, " metas"],
    repairs: list[str],
) -> tuple[Int[np.ndarray, " tracks"], Int[np.ndarray, " tracks"]]:
    """First row and id of each track after tracks are split where frames are missing."""
    splits = np.flatnonzero((np.diff(rows.track) == 0) & (np.diff(rows.frame) > 1)) + 1
    starts = np.union1d(begins, splits)
    new_ids = ids[np.searchsorted(ids, rows.track[starts])]
    is_new = np.isin(starts, splits)
    new_ids[is_new] = ids.max() + 1 + np.arange(is_new.sum())
    if len(splits):
        gaps = [f"{rows.track[row]} after frame {rows.frame[row - 1]}" for row in splits]
        repairs.append(f"{len(splits)} gaps in tracks' frames, split there: {shorten(gaps)}")
    return starts, new_ids
