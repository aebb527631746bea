"""Opening a recording of any layout, from its files or from the cache."""

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
from asp_env.data.readers.lanelet2 import Origin, read_lanelet2
from asp_env.data.readers.layout import TrackTable
from asp_env.data.readers.levelx import LevelxFiles, RecordingMeta, read_levelx
from asp_env.data.readers.resampling import resample
from asp_env.data.recording import DEFAULT_DT_S, Background, Recording, rate_for_ticks
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.errors import DataError

RecordingFiles = LevelxFiles | InteractionFiles
"""The files of one recording, of any layout."""

Meta = RecordingMeta | InteractionMeta
"""The metadata of one recording, of any layout."""

CacheEntry = tuple[dict[str, Any], dict[str, np.ndarray]]
"""Facts and arrays, the content of a cache file."""

_TRACK_COLUMNS = ("track_ids", "classes", "sizes", "first_frames", "starts", "states")
_MAP_PARTS = ("lines", "drivable", "lanes", "areas")
_MAP_COLUMNS = ("line_types", "successors", "two_way", "limits_mps", "limited")


@dataclass(frozen=True, slots=True, kw_only=True)
class ReaderState:
    """Results shared by the recordings of one DATA: a map per location and a search per folder.

    Keys of recordings are their names.
    """

    dt_s: float = DEFAULT_DT_S
    """Seconds per tick. Recordings whose rate does not fit are resampled."""
    recordings: dict[str, Recording] = field(default_factory=dict)
    maps: dict[tuple[Path, Origin], RoadMap] = field(default_factory=dict)
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
        place = (map_path, meta.origin)
        road_map = state.maps.get(place) or _road_map(*place)
        recording = _recording(files, meta, road_map, state.dt_s)
        state.maps[place] = recording.road_map
        state.recordings[files.name] = recording
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


def _road_map(path: Path, origin: Origin) -> RoadMap:
    facts, arrays = _cached(path, [path], lambda: _map_entry(path, origin), origin)
    parts: dict[str, Any] = {name: arrays[name] for name in _MAP_COLUMNS}
    parts |= {
        name: Ragged(points=arrays[f"{name}_points"], starts=arrays[f"{name}_starts"])
        for name in _MAP_PARTS
    }
    return RoadMap(
        name=path.stem,
        repairs=tuple(facts["repairs"]),
        **parts,
    )


def _map_entry(path: Path, origin: Origin) -> CacheEntry:
    road_map = read_lanelet2(path, origin)
    arrays = {name: getattr(road_map, name) for name in _MAP_COLUMNS}
    for name in _MAP_PARTS:
        ragged = getattr(road_map, name)
        arrays |= {f"{name}_points": ragged.points, f"{name}_starts": ragged.starts}
    return {"repairs": list(road_map.repairs)}, arrays


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
