"""Opening a recording of any layout, from its files or from the cache."""

import functools
import hashlib
import struct
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.data import cache
from asp_env.data.readers import interaction, levelx
from asp_env.data.readers.interaction import InteractionFiles, InteractionMeta, read_interaction
from asp_env.data.readers.lanelet2 import Lanelet2File, make_road_map, parse_lanelet2
from asp_env.data.readers.layout import TrackTable
from asp_env.data.readers.levelx import LevelxFiles, RecordingMeta, read_levelx
from asp_env.data.readers.placing import (
    Box,
    check_place,
    driven_lanelets,
    moving_vehicles,
    used_region,
)
from asp_env.data.readers.positions import Origin
from asp_env.data.readers.resampling import resample
from asp_env.data.recording import DEFAULT_DT_S, Background, Recording, rate_for_ticks
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.errors import DataError, RepairWarning

RecordingFiles = LevelxFiles | InteractionFiles
"""The files of one recording, of any layout."""

Meta = RecordingMeta | InteractionMeta
"""The metadata of one recording, of any layout."""

CacheEntry = tuple[dict[str, Any], dict[str, np.ndarray]]
"""Facts and arrays, the content of a cache file."""

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
    recordings: dict[str, Recording] = field(default_factory=dict)
    maps: dict["MapKey", RoadMap] = field(default_factory=dict)
    places: dict[str, tuple[Meta, Path]] = field(default_factory=dict)
    """Metadata and path of the map of each recording."""
    hashes: dict[str, str] = field(default_factory=dict)
    maps_by_folder: dict[Path, list[Path]] = field(default_factory=dict)
    """Map files by folder. Without it, opening N recordings would list N² files."""


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
        meta, map_path = _place(files, state)
        recording = _recording(files, meta, _NO_MAP, state.dt_s)
        road_map = _road_map(files, recording, map_path, meta.origin, state)
        state.recordings[files.name] = replace(recording, road_map=road_map)
    return state.recordings[files.name]


def content_hash(files: RecordingFiles, state: ReaderState) -> str:
    """A hash of the content of a recording's tables and map, without its background image.

    Args:
        files: the recording's files.
        state: results so far. The hash is added.

    Raises:
        DataError: a file is missing.
    """
    if files.name not in state.hashes:
        _, map_path = _place(files, state)
        sources = (*files.tables, map_path)

        def make() -> CacheEntry:
            digests = "".join(cache.digest(path) for path in sources)
            return {"hash": hashlib.sha256(digests.encode()).hexdigest()}, {}

        facts, _ = _cached(files.tracks, sources, make, "hash")
        state.hashes[files.name] = str(facts["hash"])
    return state.hashes[files.name]


def _place(files: RecordingFiles, state: ReaderState) -> tuple[Meta, Path]:
    if files.name not in state.places:
        files.check_complete()
        if isinstance(files, LevelxFiles):
            meta = levelx.read_recording_meta(files.recording_meta)
            map_path = levelx.find_map(files, meta, state.maps_by_folder)
        else:
            meta = interaction.read_meta(files)
            map_path = interaction.find_map(files, meta, state.maps_by_folder)
        state.places[files.name] = (meta, map_path)
    return state.places[files.name]


def _recording(files: RecordingFiles, meta: Meta, road_map: RoadMap, dt_s: float) -> Recording:
    sources = [*files.tables, *([files.background] if files.background else [])]
    facts, arrays = _cached(files.tracks, sources, lambda: _track_entry(files, meta), "tracks")
    rate_hz = facts["frame_rate_hz"]
    fitting_hz = rate_for_ticks(rate_hz, dt_s)
    if fitting_hz != rate_hz:
        measured = facts, arrays
        facts, arrays = _cached(
            files.tracks,
            sources,
            lambda: _resampled(files, *measured, fitting_hz),
            ("tracks", fitting_hz),
        )
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
        road_map=road_map,
        background=background,
        repairs=tuple(facts["repairs"]),
        resampled_from_hz=facts["resampled_from_hz"],
        start_hour=meta.start_hour if isinstance(meta, RecordingMeta) else None,
        weekday=meta.weekday if isinstance(meta, RecordingMeta) else None,
        **columns,
    )


def _track_entry(files: RecordingFiles, meta: Meta) -> CacheEntry:
    if isinstance(files, InteractionFiles):
        table, rate_hz = read_interaction(files)
        return _entry(table, rate_hz, None)
    assert isinstance(meta, RecordingMeta)
    table, scale = read_levelx(files), None
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


def _scale(
    files: LevelxFiles, background: Path, meta: RecordingMeta, table: TrackTable
) -> float | None:
    size = _png_size(background)
    return levelx.metres_per_pixel(files, meta, size, table.states[:, :2]) if size else None


def _road_map(
    files: RecordingFiles, recording: Recording, path: Path, origin: Origin, state: ReaderState
) -> RoadMap:
    """The map of a recording: what of the file its agents may reach.

    Raises:
        DataError: the map is damaged, or of another place.
    """
    content = functools.cache(lambda: parse_lanelet2(path, origin))
    facts, survey = _cached(path, [path], lambda: _survey_entry(content()), (origin, "survey"))
    of_tracks = "place", recording.frame_rate_hz
    tracks, places = _cached(
        files.tracks, files.tables, lambda: _places_entry(recording), of_tracks
    )
    region_m = used_region(tuple(tracks["extent_m"]), tuple(facts["extent_m"]))
    rings = Ragged(points=survey["ring_points"], starts=survey["ring_starts"])
    numbers = driven_lanelets(places["vehicles"], rings, survey["courses_rad"])
    driven = tuple(facts["ids"][number] for number in numbers)
    key = (path, origin, region_m, driven)
    if key not in state.maps:
        state.maps[key] = _make_map(path, origin, region_m, driven, content)
        if repairs := state.maps[key].repairs:
            warnings.warn(
                f"map {path.name}: {'; '.join(repairs)} (asp-env inspect lists all repairs)",
                RepairWarning,
                stacklevel=2,
            )

    def check() -> CacheEntry:
        lanes = survey["lane_points"]
        check_place(path, files.name, places["vehicles"], state.maps[key], lanes)
        return {}, {}

    _cached(files.tracks, [*files.tables, path], check, (*of_tracks, origin, str(path)))
    return state.maps[key]


def _places_entry(recording: Recording) -> CacheEntry:
    vehicles = moving_vehicles(recording.classes, recording.starts, recording.states)
    return {"extent_m": list(recording.extent_m)}, {"vehicles": vehicles}


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


def _make_map(
    path: Path,
    origin: Origin,
    region_m: Box | None,
    driven: tuple[str, ...],
    content: Callable[[], Lanelet2File],
) -> RoadMap:
    def make() -> CacheEntry:
        road_map = make_road_map(content(), region_m=region_m, driven=driven)
        arrays = {name: getattr(road_map, name) for name in _MAP_COLUMNS}
        for name in _MAP_PARTS:
            ragged = getattr(road_map, name)
            arrays |= {f"{name}_points": ragged.points, f"{name}_starts": ragged.starts}
        return {"repairs": list(road_map.repairs)}, arrays

    facts, arrays = _cached(path, [path], make, (origin, region_m, driven))
    parts: dict[str, Any] = {name: arrays[name] for name in _MAP_COLUMNS}
    parts |= {
        name: Ragged(points=arrays[f"{name}_points"], starts=arrays[f"{name}_starts"])
        for name in _MAP_PARTS
    }
    return RoadMap(name=path.stem, region_m=region_m, repairs=tuple(facts["repairs"]), **parts)


def _cached(
    path: Path, sources: Sequence[Path], make: Callable[[], CacheEntry], salt: object
) -> CacheEntry:
    """The result of `make`, from the cache if it is stored there and no source has changed since.

    If the cache cannot be written, there is a warning, and `make` is called every time.
    """
    current = cache.stamp(sources)
    try:
        cached = cache.entry_path(cache.cache_folder(), path, salt)
    except DataError as error:
        warnings.warn(f"results are not cached: {error}", stacklevel=2)
        return _read_only(make())
    if (found := cache.load(cached, current)) is not None:
        return found
    made = make()
    try:
        cache.save(cached, current, *made)
    except OSError as error:
        warnings.warn(f"results are not cached: {cached}: {error.strerror}", stacklevel=2)
    return cache.load(cached, current) or _read_only(made)


def _read_only(made: CacheEntry) -> CacheEntry:
    for array in made[1].values():
        array.flags.writeable = False
    return made


def _png_size(path: Path) -> tuple[int, int] | None:
    """Width and height from the file's header; None if it is not a PNG file."""
    with path.open("rb") as file:
        head = file.read(24)
    if head[:8] != b"\x89PNG\r\n\x1a\n" or len(head) < 24:
        return None
    width, height = struct.unpack(">II", head[16:24])
    return int(width), int(height)
