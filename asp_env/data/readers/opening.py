"""Opening a recording of any layout, from its files or from the cache."""

import hashlib
import struct
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.data import cache
from asp_env.data.readers import interaction, levelx
from asp_env.data.readers.caching import CacheEntry, cached
from asp_env.data.readers.driven_area import driven_area
from asp_env.data.readers.found import FoundRecording
from asp_env.data.readers.interaction import InteractionFiles, InteractionMeta, read_interaction
from asp_env.data.readers.interaction_cases import CaseFiles, read_case
from asp_env.data.readers.lanelet2 import Origin, read_lanelet2
from asp_env.data.readers.layout import TrackTable
from asp_env.data.readers.levelx import LevelxFiles, RecordingMeta, read_levelx
from asp_env.data.readers.measurements import derive_tracks
from asp_env.data.recording import Background, Recording
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.data.signals import Signals

RecordingFiles = LevelxFiles | InteractionFiles | CaseFiles | FoundRecording
"""The files of one recording, of any layout."""

Meta = RecordingMeta | InteractionMeta
"""The metadata of one recording, of any layout."""

_TRACK_COLUMNS = ("track_ids", "classes", "sizes", "first_frames", "starts", "states")
_MAP_PARTS = ("lines", "drivable", "lanes", "areas")
_MAP_COLUMNS = ("line_types", "successors", "two_way", "limits_mps", "limited")


@dataclass(frozen=True, slots=True, kw_only=True)
class ReaderState:
    """Results shared by the recordings of one DATA: a map per location and a search per folder.

    Keys of recordings are their names.
    """

    recordings: dict[str, Recording] = field(default_factory=dict)
    maps: dict[tuple[Path, Origin] | str, RoadMap] = field(default_factory=dict)
    """By file and frame, or by a hash of their content."""
    places: dict[str, tuple[Meta, Path]] = field(default_factory=dict)
    """Metadata and path of the map of each recording."""
    hashes: dict[str, str] = field(default_factory=dict)
    tables: dict[Path, CacheEntry] = field(default_factory=dict)
    """Tables of several recordings."""
    maps_by_folder: dict[Path, list[Path]] = field(default_factory=dict)
    """Map files by folder. Without it, opening N recordings would list N² files."""


def open_recording(files: RecordingFiles, state: ReaderState) -> Recording:
    """Opens a recording, unless `state` has it already.

    Args:
        files: the recording's files.
        state: results so far. The recording is added.

    Raises:
        DataError: its files are damaged.
    """
    if files.name not in state.recordings:
        if isinstance(files, FoundRecording):
            recording = _open_found(files, state)
        else:
            meta, map_path = _place(files, state)
            place = (map_path, meta.origin)
            road_map = state.maps.get(place) or _road_map(*place)
            recording = _recording(files, meta, road_map, state)
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
        sources = files.tables
        if not isinstance(files, FoundRecording):
            sources = (*sources, _place(files, state)[1])
        content = _files_hash(files.tracks, sources, state)
        if isinstance(files, CaseFiles):
            content = hashlib.sha256(f"{content} case {files.case}".encode()).hexdigest()
        state.hashes[files.name] = content
    return state.hashes[files.name]


def _files_hash(path: Path, sources: tuple[Path, ...], state: ReaderState) -> str:
    key = " ".join(map(str, sources))
    if key not in state.hashes:

        def make() -> CacheEntry:
            digests = "".join(cache.digest(path) for path in sources)
            return {"hash": hashlib.sha256(digests.encode()).hexdigest()}, {}

        facts, _ = cached(path, sources, make, "hash")
        state.hashes[key] = str(facts["hash"])
    return state.hashes[key]


def _place(
    files: LevelxFiles | InteractionFiles | CaseFiles, state: ReaderState
) -> tuple[Meta, Path]:
    if files.name not in state.places:
        if isinstance(files, CaseFiles):
            state.places[files.name] = files.place(state.maps_by_folder)
            return state.places[files.name]
        files.check_complete()
        if isinstance(files, LevelxFiles):
            meta = levelx.read_recording_meta(files.recording_meta)
            map_path = levelx.find_map(files, meta, state.maps_by_folder)
        else:
            meta = interaction.read_meta(files)
            map_path = interaction.find_map(files, meta, state.maps_by_folder)
        state.places[files.name] = (meta, map_path)
    return state.places[files.name]


def _recording(
    files: LevelxFiles | InteractionFiles | CaseFiles,
    meta: Meta,
    road_map: RoadMap,
    state: ReaderState,
) -> Recording:
    sources = [*files.tables, *([files.background] if files.background else [])]
    if isinstance(files, CaseFiles):
        facts, arrays = _entry(*read_case(files, state.tables), None)
    else:
        facts, arrays = cached(files.tracks, sources, lambda: _track_entry(files, meta), "tracks")
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
        start_hour=meta.start_hour if isinstance(meta, RecordingMeta) else None,
        weekday=meta.weekday if isinstance(meta, RecordingMeta) else None,
        **columns,
    )


def _track_entry(files: LevelxFiles | InteractionFiles, meta: Meta) -> CacheEntry:
    if isinstance(files, InteractionFiles):
        return _entry(*read_interaction(files), None)
    assert isinstance(meta, RecordingMeta)
    table, scale = read_levelx(files), None
    if files.background is not None:
        scale = _scale(files, files.background, meta, table)
        if scale is None:
            line = f"{files.background.name} left out: its scale is unknown"
            table = replace(table, repairs=(*table.repairs, line))
    return _entry(table, meta.frame_rate_hz, scale)


def _entry(table: TrackTable, rate_hz: float, metres_per_pixel: float | None) -> CacheEntry:
    last_frames = table.first_frames + np.diff(table.starts) - 1
    facts = {
        "frame_rate_hz": rate_hz,
        "num_frames": int(last_frames.max()) + 1,
        "metres_per_pixel": metres_per_pixel,
        "repairs": list(table.repairs),
    }
    arrays = {name: getattr(table, name) for name in _TRACK_COLUMNS}
    if table.accelerations is not None:
        arrays["accelerations"] = table.accelerations
    return facts, arrays


def _open_found(files: FoundRecording, state: ReaderState) -> Recording:
    sources = list(files.tables)
    about, parts = cached(files.tracks, sources, lambda: _found_entry(files), ("found", files.name))
    facts, arrays = about["tracks"], {name: parts[name] for name in _TRACK_COLUMNS}
    columns: dict[str, Any] = arrays
    signals = None
    if "signal_states" in parts:
        frames = np.arange(facts["num_frames"]) * (about["rate_hz"] / facts["frame_rate_hz"])
        nearest = np.minimum(np.round(frames).astype(np.int64), parts["signal_states"].shape[1] - 1)
        states = parts["signal_states"][:, nearest]
        signals = Signals(stop_lines=parts["stop_lines"], states=states)
    road_map = state.maps.setdefault(about["map_hash"], _map_of(about["map"], parts))
    return Recording(
        name=files.name,
        frame_rate_hz=facts["frame_rate_hz"],
        num_frames=facts["num_frames"],
        repairs=tuple(facts["repairs"]),
        road_map=road_map,
        signals=signals,
        **about["properties"],
        **columns,
    )


def _found_entry(files: FoundRecording) -> CacheEntry:
    tables = files.read_tables()
    table, rate_hz = derive_tracks(tables.measurements, str(files.tracks))
    table = replace(table, repairs=(*tables.repairs, *table.repairs))
    road_map = tables.road_map or driven_area(table, files.name)
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
        "map_hash": content.hexdigest(),
        "properties": {name: getattr(tables, name) for name in names},
    }
    return about, arrays | map_arrays


def _scale(
    files: LevelxFiles, background: Path, meta: RecordingMeta, table: TrackTable
) -> float | None:
    size = _png_size(background)
    return levelx.metres_per_pixel(files, meta, size, table.states[:, :2]) if size else None


def _road_map(path: Path, origin: Origin) -> RoadMap:
    facts, arrays = cached(path, [path], lambda: _map_arrays(read_lanelet2(path, origin)), origin)
    return _map_of({"name": path.stem, **facts}, arrays)


def _map_of(facts: dict[str, Any], arrays: dict[str, np.ndarray]) -> RoadMap:
    parts: dict[str, Any] = {name: arrays[name] for name in _MAP_COLUMNS}
    parts |= {
        name: Ragged(points=arrays[f"{name}_points"], starts=arrays[f"{name}_starts"])
        for name in _MAP_PARTS
    }
    return RoadMap(name=facts["name"], repairs=tuple(facts["repairs"]), **parts)


def _map_arrays(road_map: RoadMap) -> CacheEntry:
    arrays = {name: getattr(road_map, name) for name in _MAP_COLUMNS}
    for name in _MAP_PARTS:
        ragged = getattr(road_map, name)
        arrays |= {f"{name}_points": ragged.points, f"{name}_starts": ragged.starts}
    return {"repairs": list(road_map.repairs)}, arrays


def _png_size(path: Path) -> tuple[int, int] | None:
    """Width and height from the file's header; None if it is not a PNG file."""
    with path.open("rb") as file:
        head = file.read(24)
    if head[:8] != b"\x89PNG\r\n\x1a\n" or len(head) < 24:
        return None
    width, height = struct.unpack(">II", head[16:24])
    return int(width), int(height)
