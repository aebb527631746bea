"""Opening a recording of any layout, from its files or from the cache."""

import functools
import hashlib
import struct
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.data import cache
from asp_env.data.readers import interaction, levelx
from asp_env.data.readers.caching import CacheEntry, cached
from asp_env.data.readers.compressed import unread_copies
from asp_env.data.readers.driven_area import driven_area
from asp_env.data.readers.found import FoundRecording
from asp_env.data.readers.interaction import InteractionFiles, InteractionMeta, read_interaction
from asp_env.data.readers.interaction_cases import CaseFiles, read_case
from asp_env.data.readers.lanelet2 import Lanelet2File, make_road_map, parse_lanelet2
from asp_env.data.readers.layout import TrackTable, shorten
from asp_env.data.readers.levelx import LevelxFiles, read_levelx
from asp_env.data.readers.levelx_meta import RecordingMeta, read_recording_meta
from asp_env.data.readers.measurements import derive_tracks
from asp_env.data.readers.placing import (
    Box,
    check_place,
    doubts,
    driven_lanelets,
    moving_vehicles,
    used_region,
)
from asp_env.data.readers.positions import Origin
from asp_env.data.readers.resampling import resample
from asp_env.data.recording import (
    DEFAULT_DT_S,
    PARKED_WITHIN_M,
    Background,
    Recording,
    rate_for_ticks,
)
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.data.signals import Signals
from asp_env.errors import DataError, RepairWarning

RecordingFiles = LevelxFiles | InteractionFiles | CaseFiles | FoundRecording
"""The files of one recording, of any layout."""

Meta = RecordingMeta | InteractionMeta
"""The metadata of one recording, of any layout."""

MapKey = tuple[Path, Origin, Box | None, tuple[str, ...]]
"""File, frame, region (None: all) and the lanelets of unlisted subtypes that are roads."""

_TRACK_COLUMNS = ("track_ids", "classes", "sizes", "first_frames", "starts", "states")
_MAP_PARTS = ("lines", "drivable", "lanes", "areas")
_MAP_COLUMNS = ("line_types", "successors", "two_way", "limits_mps", "limited")
_NO_MAP = RoadMap(
    name="",
    lines=Ragged.pack([]),
    line_types=np.zeros(0, dtype=np.int64),
    drivable=Ragged.pack([]),
    lanes=Ragged.pack([]),
    successors=np.zeros((0, 2), dtype=np.int64),
)
"""Stands for the map until the tracks are read, on which the map depends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReaderState:
    """Results shared by the recordings of one DATA: maps, and a search per folder.

    Keys of recordings are their names.
    """

    dt_s: float = DEFAULT_DT_S
    """Seconds per tick. Recordings whose rate does not fit are resampled."""
    quiet: bool = False
    """Whether repairs of maps are reported by the caller, not by a warning for each map."""
    recordings: dict[str, Recording] = field(default_factory=dict)
    maps: dict["MapKey | Path | str", RoadMap] = field(default_factory=dict)
    """By file, frame and part; by a table of cases, which have one map; or by a hash of their
    content."""
    places: dict[str, tuple[Meta, Path, tuple[str, ...]]] = field(default_factory=dict)
    """Metadata and path of the map of each recording, and lines about repairs and guesses."""
    hashes: dict[str, str] = field(default_factory=dict)
    tables: dict[Path, CacheEntry] = field(default_factory=dict)
    """Tables of several recordings."""
    maps_by_folder: dict[Path, list[Path]] = field(default_factory=dict)
    """Map files by folder. Without it, opening N recordings would list N² files."""
    unread: dict[Path, dict[str, list[str]]] = field(default_factory=dict)
    """By folder: names of files that are not read, by that of the file that is."""


def open_recording(files: RecordingFiles, state: ReaderState) -> Recording:
    """Opens a recording, unless `state` has it already.

    Args:
        files: the recording's files.
        state: results so far. The recording is added.

    Raises:
        DataError: its files are damaged.
        AspEnvError: its frames are too far apart for the tick.
    """
    if files.name not in state.recordings:
        unread = _unread(files, state)
        if isinstance(files, FoundRecording):
            recording = _open_found(files, state)
        else:
            meta, map_path, guesses = _place(files, state)
            recording = _recording(files, meta, state)
            road_map, lines = _road_map(files, recording, map_path, meta.origin, state)
            repairs = (*recording.repairs, *guesses, *lines)
            recording = replace(recording, road_map=road_map, repairs=repairs)
        if unread:
            recording = replace(recording, repairs=(*recording.repairs, *unread))
        state.recordings[files.name] = recording
    return state.recordings[files.name]


def _unread(files: RecordingFiles, state: ReaderState) -> list[str]:
    """A line for each other file of a recording's tables; for cases, only at the first one."""
    if isinstance(files, CaseFiles) and files.tracks in state.maps:
        return []
    lines = []
    for path in files.tables:
        if path.parent not in state.unread:
            state.unread[path.parent] = unread_copies(path.parent)
        if others := state.unread[path.parent].get(path.name):
            verb = "is" if len(others) == 1 else "are"
            lines.append(f"{shorten(others)} {verb} not read, since {path.name} is")
    return lines


def content_hash(files: RecordingFiles, state: ReaderState) -> str:
    """A hash of the content of a recording's tables and map, without its background image.

    Args:
        files: the recording's files.
        state: results so far. The hash is added.

    Raises:
        DataError: a file is missing.
    """
    if files.name not in state.hashes:
        sources = files.tables
        if not isinstance(files, FoundRecording):
            sources = (*sources, _place(files, state)[1])
        content = _files_hash(files.tracks, sources, state)
        if isinstance(files, CaseFiles):
            content = hashlib.sha256(f"{content} case {files.case}".encode()).hexdigest()
        state.hashes[files.name] = content
    return state.hashes[files.name]


def find_copies(found: Sequence[RecordingFiles]) -> dict[int, int]:
    """The recordings whose tables have the same content as those of an earlier one, byte for byte.

    Only tables of equal sizes are read, and the hashes of their content are cached.

    Returns:
        Index of the earliest recording with that content, by index of each later one.
    """
    by_size: dict[tuple[object, ...], list[int]] = {}
    for number, files in enumerate(found):
        about: object = files.case if isinstance(files, CaseFiles) else None
        if isinstance(files, FoundRecording):  # several recordings may be of one file
            about = id(files.read)
        sizes = _sizes(files.tables)
        if sizes and sizes[0]:
            by_size.setdefault((type(files), about, *sizes), []).append(number)
    copies: dict[int, int] = {}
    for numbers in by_size.values():
        first: dict[str, int] = {}
        for number in numbers if len(numbers) > 1 else ():
            files = found[number]
            try:
                content = _hash_of(files.tracks, files.tables, "hash of tables")
            except DataError:  # reported when the recording is opened
                continue
            if first.setdefault(content, number) != number:
                copies[number] = first[content]
    return dict(sorted(copies.items()))


def _sizes(paths: Sequence[Path]) -> tuple[int, ...] | None:
    """The sizes of files in bytes; None if one is missing."""
    try:
        return tuple(path.stat().st_size for path in paths)
    except OSError:
        return None


def _files_hash(path: Path, sources: tuple[Path, ...], state: ReaderState) -> str:
    key = " ".join(map(str, sources))
    if key not in state.hashes:
        state.hashes[key] = _hash_of(path, sources, "hash")
    return state.hashes[key]


def _hash_of(path: Path, sources: Sequence[Path], salt: str) -> str:
    """A hash of the content of files, from the cache if it is there; see `cached`."""

    def make() -> CacheEntry:
        digests = "".join(cache.digest(path) for path in sources)
        return {"hash": hashlib.sha256(digests.encode()).hexdigest()}, {}

    return str(cached(path, sources, make, salt)[0]["hash"])


def _place(
    files: LevelxFiles | InteractionFiles | CaseFiles, state: ReaderState
) -> tuple[Meta, Path, tuple[str, ...]]:
    if files.name not in state.places:
        if isinstance(files, CaseFiles):
            state.places[files.name] = (*files.place(state.maps_by_folder), ())
            return state.places[files.name]
        files.check_complete()
        if isinstance(files, LevelxFiles):
            meta = read_recording_meta(files.recording_meta)
            map_path, guesses = levelx.find_map(files, meta, state.maps_by_folder)
            guesses = (*meta.repairs, *guesses)
        else:
            meta = interaction.read_meta(files)
            map_path, guesses = interaction.find_map(files, meta, state.maps_by_folder), ()
        state.places[files.name] = (meta, map_path, guesses)
    return state.places[files.name]


def _recording(
    files: LevelxFiles | InteractionFiles | CaseFiles,
    meta: Meta,
    state: ReaderState,
) -> Recording:
    """A recording without its map."""
    sources = [*files.tables, *([files.background] if files.background else [])]
    if isinstance(files, CaseFiles):
        entry, salt = _entry(*read_case(files, state.tables), None), ("case", files.case)
    else:
        entry = cached(files.tracks, sources, lambda: _track_entry(files, meta), "tracks")
        salt = ("tracks",)
    facts, arrays = _fitted(files, entry, sources, salt, state.dt_s)
    scale = facts["metres_per_pixel"]
    columns: dict[str, Any] = arrays
    background = None
    if files.background is not None and scale is not None:
        background = Background(path=files.background, metres_per_pixel=scale)
    return Recording(
        name=files.name,
        location=str(meta.location),
        frame_rate_hz=facts["frame_rate_hz"],
        num_frames=facts["num_frames"],
        speed_limit_mps=meta.speed_limit_mps,
        road_map=_NO_MAP,
        background=background,
        repairs=tuple(facts["repairs"]),
        resampled_from_hz=facts["resampled_from_hz"],
        start_hour=meta.start_hour if isinstance(meta, RecordingMeta) else None,
        weekday=meta.weekday if isinstance(meta, RecordingMeta) else None,
        **columns,
    )


def _track_entry(files: LevelxFiles | InteractionFiles, meta: Meta) -> CacheEntry:
    if isinstance(files, InteractionFiles):
        return _entry(*read_interaction(files), None)
    assert isinstance(meta, RecordingMeta)
    table, scale = read_levelx(files, meta.frame_rate_hz), None
    if files.background is not None:
        scale = _scale(files, files.background, meta, table)
        if scale is None:
            line = f"{files.background.name} left out: its scale is unknown"
            table = replace(table, repairs=(*table.repairs, line))
    return _entry(table, meta.frame_rate_hz / table.frames_per_row, scale)


def _entry(table: TrackTable, rate_hz: float, metres_per_pixel: float | None) -> CacheEntry:
    last_frames = table.first_frames + np.diff(table.starts) - 1
    facts = {
        "frame_rate_hz": rate_hz,
        "resampled_from_hz": table.resampled_from_hz,
        "num_frames": int(last_frames.max()) + 1,
        "metres_per_pixel": metres_per_pixel,
        "repairs": list(table.repairs),
    }
    arrays = {name: getattr(table, name) for name in _TRACK_COLUMNS}
    if table.accelerations is not None:
        arrays["accelerations"] = table.accelerations
    return facts, arrays


def _fitted(
    files: RecordingFiles,
    measured: CacheEntry,
    sources: Sequence[Path],
    salt: tuple[object, ...],
    dt_s: float,
) -> CacheEntry:
    """The tracks at a frame rate of which a tick is a whole number.

    Args:
        files: the recording's files.
        measured: the tracks at the frames of the files.
        sources: all files that they follow from.
        salt: distinguishes them from others of the same files.
        dt_s: seconds per tick.

    Raises:
        AspEnvError: the frames are too far apart for the tick.
    """
    rate_hz = measured[0]["frame_rate_hz"]
    fitting_hz = rate_for_ticks(rate_hz, dt_s)
    if fitting_hz == rate_hz:
        return measured
    return cached(
        files.tracks,
        sources,
        lambda: _resampled(files, *measured, fitting_hz),
        (*salt, fitting_hz),
    )


def _resampled(
    files: RecordingFiles, facts: dict[str, Any], arrays: dict[str, Any], to_hz: float
) -> CacheEntry:
    measured = TrackTable(
        **arrays,
        repairs=tuple(facts["repairs"]),
        resampled_from_hz=facts["resampled_from_hz"],
    )
    table = resample(measured, facts["frame_rate_hz"], to_hz)
    if not len(table.track_ids):
        raise DataError(
            f"{files.tracks}: no track lasts a frame of {to_hz:g} Hz, expected longer tracks; copy "
            "it again or remove the recording"
        )
    return _entry(table, to_hz, facts["metres_per_pixel"])


def _open_found(files: FoundRecording, state: ReaderState) -> Recording:
    sources = list(files.tables)
    salt = ("found", files.name)
    about, parts = cached(files.tracks, sources, lambda: _found_entry(files), salt)
    measured = about["tracks"], {name: parts[name] for name in _TRACK_COLUMNS}
    facts, arrays = _fitted(files, measured, sources, salt, state.dt_s)
    columns: dict[str, Any] = arrays
    signals = None
    if "signal_states" in parts:
        frames = np.arange(facts["num_frames"]) * (about["rate_hz"] / facts["frame_rate_hz"])
        nearest = np.minimum(np.round(frames).astype(np.int64), parts["signal_states"].shape[1] - 1)
        states = parts["signal_states"][:, nearest]
        signals = Signals(stop_lines=parts["stop_lines"], states=states)
    key = about["map_hash"]
    if key not in state.maps:
        state.maps[key] = _map_of(about["map"], parts)
        if about["map_of_file"] and not state.quiet:
            _warn_of_repairs(about["map_of_file"], state.maps[key])
    return Recording(
        name=files.name,
        frame_rate_hz=facts["frame_rate_hz"],
        num_frames=facts["num_frames"],
        repairs=tuple(facts["repairs"]),
        resampled_from_hz=facts["resampled_from_hz"],
        road_map=state.maps[key],
        signals=signals,
        **about["properties"],
        **columns,
    )


def _found_entry(files: FoundRecording) -> CacheEntry:
    tables = files.read_tables()
    table, rate_hz = derive_tracks(tables.measurements, str(files.tracks))
    table = replace(table, repairs=(*tables.repairs, *table.repairs))
    of_file, road_map = None, tables.road_map
    if isinstance(road_map, Lanelet2File):
        of_file = road_map.path.name
        road_map, lines = _used_map(files, table, road_map)
        table = replace(table, repairs=(*table.repairs, *lines))
    road_map = road_map or driven_area(table, files.name)
    facts, arrays = _entry(table, rate_hz, None)
    map_facts, map_arrays = _map_arrays(road_map)
    content = hashlib.sha256(repr((road_map.name, map_facts)).encode())
    for array in map_arrays.values():
        content.update(np.ascontiguousarray(array).tobytes())
    if tables.signals is not None:
        first_ms = float(tables.measurements.time_ms.min())
        times_ms = first_ms + 1000.0 / rate_hz * np.arange(facts["num_frames"])
        arrays["signal_states"] = tables.signals.at(times_ms)
        arrays["stop_lines"] = tables.signals.stop_lines
    names = ("location", "speed_limit_mps", "start_hour", "weekday")
    about = {
        "tracks": facts,
        "rate_hz": rate_hz,
        "map": {"name": road_map.name, **map_facts},
        "map_of_file": of_file,
        "map_hash": content.hexdigest(),
        "properties": {name: getattr(tables, name) for name in names},
    }
    return about, arrays | map_arrays


def _scale(
    files: LevelxFiles, background: Path, meta: RecordingMeta, table: TrackTable
) -> float | None:
    size = _png_size(background)
    if size is None:
        return None
    xy = table.states[:, :2]
    from_start = np.hypot(*(xy - np.repeat(xy[table.starts[:-1]], np.diff(table.starts), axis=0)).T)
    moves = np.maximum.reduceat(from_start, table.starts[:-1]) >= PARKED_WITHIN_M
    return levelx.metres_per_pixel(files, meta, size, xy, np.repeat(moves, np.diff(table.starts)))


def _road_map(
    files: LevelxFiles | InteractionFiles | CaseFiles,
    recording: Recording,
    path: Path,
    origin: Origin,
    state: ReaderState,
) -> tuple[RoadMap, Sequence[str]]:
    """The map of a recording: what of the file its agents may reach; cases of a table share it.

    Returns:
        The map, and lines about what does not fit; of a table of cases for the first one only.

    Raises:
        DataError: the map is damaged, or of another place.
    """
    is_case = isinstance(files, CaseFiles)
    if is_case and files.tracks in state.maps:
        return state.maps[files.tracks], ()
    content = functools.cache(lambda: parse_lanelet2(path, origin))
    facts, survey = cached(path, [path], lambda: _survey_entry(content()), (origin, "survey"))
    of_tracks = ("place",) if is_case else ("place", recording.frame_rate_hz)
    if is_case:
        table = state.tables[files.tracks][1]
        tracks = table["classes"], table["starts"], table["states"]
    else:
        tracks = recording.classes, recording.starts, recording.states
    extent, places = cached(files.tracks, files.tables, lambda: _places_entry(*tracks), of_tracks)
    vehicles = places["vehicles"]
    region_m, driven = _part(tuple(extent["extent_m"]), vehicles, facts, survey)
    key = (path, origin, region_m, driven)
    if key not in state.maps:
        facts, arrays = cached(
            path,
            [path],
            lambda: _map_arrays(make_road_map(content(), region_m=region_m, driven=driven)),
            (origin, region_m, driven),
        )
        state.maps[key] = _map_of({"name": path.stem, **facts}, arrays)
        if not state.quiet:
            _warn_of_repairs(path.name, state.maps[key])

    def check() -> CacheEntry:
        name = files.tracks.name if is_case else files.name
        check_place(path, name, vehicles, state.maps[key], survey["lane_points"])
        return {"doubts": doubts(vehicles, state.maps[key])}, {}

    salt = (*of_tracks, origin, str(path))
    found, _ = cached(files.tracks, [*files.tables, path], check, salt)
    if is_case:
        state.maps[files.tracks] = state.maps[key]
    return state.maps[key], found["doubts"]


def _used_map(
    files: FoundRecording, table: TrackTable, content: Lanelet2File
) -> tuple[RoadMap, list[str]]:
    """What of a map file the agents of a recording may reach, and lines about what does not fit.

    Raises:
        DataError: the map is of another place.
    """
    extent, places = _places_entry(table.classes, table.starts, table.states)
    facts, survey = _survey_entry(content)
    region_m, driven = _part(extent["extent_m"], places["vehicles"], facts, survey)
    road_map = make_road_map(content, region_m=region_m, driven=driven)
    check_place(content.path, files.name, places["vehicles"], road_map, survey["lane_points"])
    return road_map, doubts(places["vehicles"], road_map)


def _part(
    extent_m: Box,
    vehicles: np.ndarray,
    facts: Mapping[str, Any],
    survey: Mapping[str, np.ndarray],
) -> tuple[Box | None, tuple[str, ...]]:
    """The region of a map that tracks use, and the lanelets of unlisted subtypes that are roads.

    Args:
        extent_m: bounding box of the tracks.
        vehicles: (n, 4) states of moving vehicles.
        facts: those of `_survey_entry`.
        survey: the arrays of `_survey_entry`.
    """
    rings = Ragged(points=survey["ring_points"], starts=survey["ring_starts"])
    numbers = driven_lanelets(vehicles, rings, survey["courses_rad"])
    driven = tuple(facts["ids"][number] for number in numbers)
    return used_region(extent_m, tuple(facts["extent_m"])), driven


def _places_entry(classes: np.ndarray, starts: np.ndarray, states: np.ndarray) -> CacheEntry:
    vehicles = moving_vehicles(classes, starts, states)
    low, high = states[:, :2].min(axis=0), states[:, :2].max(axis=0)
    return {"extent_m": tuple(map(float, (*low, *high)))}, {"vehicles": vehicles}


def _survey_entry(content: Lanelet2File) -> CacheEntry:
    """What has to be known of a map to choose the part of it that a recording uses."""
    unlisted = content.unlisted
    rings = Ragged.pack([lanelet.ring for lanelet in unlisted])
    lanes = [each.ring for each in content.lanelets if each.use in ("along", "unlisted")]
    facts = {"extent_m": content.extent_m, "ids": [lanelet.id for lanelet in unlisted]}
    return facts, {
        "ring_points": rings.points,
        "ring_starts": rings.starts,
        "courses_rad": np.array([lanelet.course_rad for lanelet in unlisted], dtype=np.float64),
        "lane_points": np.concatenate([*lanes, np.zeros((0, 2))]),
    }


def _warn_of_repairs(file_name: str, road_map: RoadMap) -> None:
    if road_map.repairs:
        warnings.warn(
            f"map {file_name}: {'; '.join(road_map.repairs)} (asp-env inspect lists all repairs)",
            RepairWarning,
            stacklevel=3,
        )


def _map_of(facts: dict[str, Any], arrays: dict[str, np.ndarray]) -> RoadMap:
    parts: dict[str, Any] = {name: arrays[name] for name in _MAP_COLUMNS}
    parts |= {
        name: Ragged(points=arrays[f"{name}_points"], starts=arrays[f"{name}_starts"])
        for name in _MAP_PARTS
    }
    region_m = None if facts["region_m"] is None else tuple(facts["region_m"])
    return RoadMap(name=facts["name"], region_m=region_m, repairs=tuple(facts["repairs"]), **parts)


def _map_arrays(road_map: RoadMap) -> CacheEntry:
    arrays = {name: getattr(road_map, name) for name in _MAP_COLUMNS}
    for name in _MAP_PARTS:
        ragged = getattr(road_map, name)
        arrays |= {f"{name}_points": ragged.points, f"{name}_starts": ragged.starts}
    return {"region_m": road_map.region_m, "repairs": list(road_map.repairs)}, arrays


def _png_size(path: Path) -> tuple[int, int] | None:
    """Width and height from the file's header; None if it is not a PNG file."""
    with path.open("rb") as file:
        head = file.read(24)
    if head[:8] != b"\x89PNG\r\n\x1a\n" or len(head) < 24:
        return None
    width, height = struct.unpack(">II", head[16:24])
    return int(width), int(height)
