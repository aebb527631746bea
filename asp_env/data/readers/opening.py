"""From a recording's files to a `Recording`, through the cache."""

import hashlib
import struct
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.data import cache
from asp_env.data.readers import interaction, levelx
from asp_env.data.readers.interaction import InteractionFiles, InteractionMeta, read_interaction
from asp_env.data.readers.lanelet2 import Origin, read_lanelet2
from asp_env.data.readers.levelx import LevelxFiles, RecordingMeta, TrackTable, read_tracks
from asp_env.data.recording import Background, Recording
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.errors import DataError

RecordingFiles = LevelxFiles | InteractionFiles
"""Where one recording's files lie, of any layout."""

Meta = RecordingMeta | InteractionMeta

Entry = tuple[dict[str, Any], dict[str, np.ndarray]]
"""Facts and arrays, as the cache keeps them."""

_TRACK_COLUMNS = ("track_ids", "classes", "sizes", "first_frames", "starts", "states")
_MAP_PARTS = ("lines", "drivable", "lanes", "areas")
_MAP_COLUMNS = ("line_types", "successors", "two_way", "limits_mps", "limited")


@dataclass(frozen=True, slots=True, kw_only=True)
class Opened:
    """What is known already, so that one place has one map and no folder is searched twice."""

    recordings: dict[str, Recording] = field(default_factory=dict)
    maps: dict[tuple[Path, Origin], RoadMap] = field(default_factory=dict)
    places: dict[str, tuple[Meta, Path]] = field(default_factory=dict)
    """Of each recording: its metadata, and where its map lies."""
    hashes: dict[str, str] = field(default_factory=dict)
    maps_below: dict[Path, list[Path]] = field(default_factory=dict)
    """By folder; without it, finding the maps of N recordings would look at N² files."""


def open_recording(files: RecordingFiles, opened: Opened) -> Recording:
    """The recording, read now unless it is open, and kept in `opened`.

    Raises:
        DataError: its files are damaged.
    """
    if files.name not in opened.recordings:
        meta, map_path = _place(files, opened)
        place = (map_path, meta.origin)
        recording = _recording(files, meta, opened.maps.get(place) or _road_map(*place))
        opened.maps[place] = recording.road_map
        opened.recordings[files.name] = recording
    return opened.recordings[files.name]


def content_hash(files: RecordingFiles, opened: Opened) -> str:
    """A hash of the content of a recording's tables and map; the picture does not count.

    Raises:
        DataError: a file is missing.
    """
    if files.name not in opened.hashes:
        _, map_path = _place(files, opened)
        sources = (*files.tables, map_path)

        def make() -> Entry:
            digests = "".join(cache.digest(path) for path in sources)
            return {"hash": hashlib.sha256(digests.encode()).hexdigest()}, {}

        facts, _ = _cached(files.tracks, sources, make, "hash")
        opened.hashes[files.name] = str(facts["hash"])
    return opened.hashes[files.name]


def _place(files: RecordingFiles, opened: Opened) -> tuple[Meta, Path]:
    if files.name not in opened.places:
        files.check_complete()
        if isinstance(files, LevelxFiles):
            meta = levelx.read_recording_meta(files.recording_meta)
            map_path = levelx.find_map(files, meta, opened.maps_below)
        else:
            meta = interaction.read_meta(files)
            map_path = interaction.find_map(files, meta, opened.maps_below)
        opened.places[files.name] = (meta, map_path)
    return opened.places[files.name]


def _recording(files: RecordingFiles, meta: Meta, road_map: RoadMap) -> Recording:
    sources = [*files.tables, *([files.background] if files.background else [])]
    facts, arrays = _cached(files.tracks, sources, lambda: _track_entry(files, meta), "tracks")
    scale = facts["metres_per_pixel"]
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
        **arrays,
    )


def _track_entry(files: RecordingFiles, meta: Meta) -> Entry:
    scale = None
    if isinstance(files, InteractionFiles):
        table, rate_hz = read_interaction(files)
        repairs = list(table.repairs)
    else:
        assert isinstance(meta, RecordingMeta)
        table, rate_hz = read_tracks(files), meta.frame_rate_hz
        repairs = list(table.repairs)
        if files.background is not None:
            scale = _scale(files, files.background, meta, table)
            if scale is None:
                repairs.append(f"{files.background.name} left out: its scale cannot be told")
    last_frames = table.first_frames + np.diff(table.starts) - 1
    facts = {
        "frame_rate_hz": rate_hz,
        "num_frames": int(last_frames.max()) + 1,
        "metres_per_pixel": scale,
        "repairs": repairs,
    }
    return facts, {name: getattr(table, name) for name in _TRACK_COLUMNS}


def _scale(
    files: LevelxFiles, picture: Path, meta: RecordingMeta, table: TrackTable
) -> float | None:
    size = _png_size(picture)
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


def _map_entry(path: Path, origin: Origin) -> Entry:
    road_map = read_lanelet2(path, origin)
    arrays = {name: getattr(road_map, name) for name in _MAP_COLUMNS}
    for name in _MAP_PARTS:
        ragged = getattr(road_map, name)
        arrays |= {f"{name}_points": ragged.points, f"{name}_starts": ragged.starts}
    return {"repairs": list(road_map.repairs)}, arrays


def _cached(path: Path, sources: Sequence[Path], make: Callable[[], Entry], salt: object) -> Entry:
    """What `make` returns, from the cache if the sources are as they were.

    Where the cache cannot be written to, files are read anew each time, and a warning says so.
    """
    current = cache.stamp(sources)
    try:
        kept = cache.entry_path(cache.cache_folder(), path, salt)
    except DataError as error:
        warnings.warn(f"nothing is kept for next time: {error}", stacklevel=2)
        return _read_only(make())
    if (found := cache.load(kept, current)) is not None:
        return found
    made = make()
    try:
        cache.save(kept, current, *made)
    except OSError as error:
        warnings.warn(f"nothing is kept for next time: {kept}: {error.strerror}", stacklevel=2)
    return cache.load(kept, current) or _read_only(made)


def _read_only(made: Entry) -> Entry:
    for array in made[1].values():
        array.flags.writeable = False
    return made


def _png_size(path: Path) -> tuple[int, int] | None:
    """Width and height from the file's header; None if it is no PNG."""
    with path.open("rb") as file:
        head = file.read(24)
    if head[:8] != b"\x89PNG\r\n\x1a\n" or len(head) < 24:
        return None
    width, height = struct.unpack(">II", head[16:24])
    return int(width), int(height)
