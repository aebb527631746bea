"""Sources of data, and the recordings that they open lazily."""

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asp_env import registry
from asp_env.data import cache
from asp_env.data.readers import layout, levelx, levelx_meta, opening
from asp_env.data.recording import Recording
from asp_env.data.source import Recordings, join_data, load, open_data
from asp_env.errors import AspEnvError, DataError
from tests.data.levelx_files import write_folder, write_map, write_recording


@pytest.fixture
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder for one test."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def folder(tmp_path: Path, cache_folder: Path) -> Path:
    """A folder of three recordings at one place, with an empty cache."""
    assert not cache_folder.exists()
    return write_folder(tmp_path / "folder", recordings=3)


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The files that are read instead of their cache entries, in order."""
    names: list[str] = []
    read_levelx, parse_lanelet2 = opening.read_levelx, opening.parse_lanelet2

    def tracks(files, frame_rate_hz):
        names.append(files.tracks.name)
        return read_levelx(files, frame_rate_hz)

    def lanelets(path, origin):
        names.append(path.name)
        return parse_lanelet2(path, origin)

    monkeypatch.setattr(opening, "read_levelx", tracks)
    monkeypatch.setattr(opening, "parse_lanelet2", lanelets)
    return names


def equal(recording: Recording, other: Recording) -> bool:
    """Whether two recordings have equal tracks and maps."""
    return all(
        np.array_equal(getattr(recording, name), getattr(other, name))
        for name in ("track_ids", "classes", "sizes", "first_frames", "starts", "states")
    ) and all(
        np.array_equal(
            getattr(recording.road_map, name).points, getattr(other.road_map, name).points
        )
        for name in ("lines", "drivable", "lanes")
    )


def test_recordings_and_maps_are_read_at_first_access(folder: Path, reads: list[str]) -> None:
    recordings = open_data(folder)
    assert (len(recordings), recordings.names) == (3, ("00", "01", "02"))
    assert recordings.source == str(folder)
    assert reads == []
    first = recordings[1]
    assert first.name == "01"
    assert reads == ["01_tracks.csv", "location1.osm"]
    assert recordings[1] is first
    assert recordings[-2] is first
    assert recordings[0].road_map is first.road_map
    assert reads == ["01_tracks.csv", "location1.osm", "00_tracks.csv"]
    with pytest.raises(IndexError):
        recordings[3]


def test_metadata_are_read_once_for_each_opening(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the cache, and with it."""
    reads: list[str] = []

    def table(path: Path, *args: Any, **options: Any) -> dict[str, np.ndarray]:
        reads.append(path.name)
        return read_table(path, *args, **options)

    read_table = levelx.read_table
    for module in (levelx, levelx_meta):
        monkeypatch.setattr(module, "read_table", table)
    recordings = open_data(folder)
    assert len(recordings[0]) == 3
    recordings.hashes()
    assert [name for name in reads if name.startswith("00")] == [
        "00_recordingMeta.csv",
        "00_tracksMeta.csv",
    ]
    del reads[:]
    open_data(folder)[0]
    assert reads == ["00_recordingMeta.csv"]


def test_second_time_comes_from_the_cache(
    folder: Path, cache_folder: Path, reads: list[str]
) -> None:
    """The arrays are equal and read-only, and smaller on disk than the files."""
    before = open_data(folder)[0]
    del reads[:]
    after = open_data(folder)[0]
    assert reads == []
    assert equal(before, after)
    assert (after.num_frames, after.frame_rate_hz, after.location) == (250, 25.0, "1")
    for array in (after.states, after.starts, after.road_map.lanes.points):
        assert not array.flags.writeable
    sources = [path for path in folder.rglob("*") if path.is_file() and path.name[:2] not in "0102"]
    assert sum(path.stat().st_size for path in cache_folder.iterdir()) < sum(
        path.stat().st_size for path in sources
    )


def test_load_is_deprecated(folder: Path) -> None:
    with pytest.warns(DeprecationWarning, match=r"use asp_env\.open_data"):
        recordings = load(folder)
    assert recordings.names == open_data(folder).names


@pytest.mark.parametrize(
    ("name", "read_again"),
    [
        ("00_tracks.csv", ["00_tracks.csv"]),
        ("00_tracksMeta.csv", ["00_tracks.csv"]),
        ("00_recordingMeta.csv", ["00_tracks.csv"]),
        ("01_tracks.csv", []),
        ("location1.osm", ["location1.osm"]),
    ],
)
def test_changed_files_are_read_again(
    folder: Path, cache_folder: Path, reads: list[str], name: str, read_again: list[str]
) -> None:
    """The cache entries are replaced."""
    open_data(folder)[0]
    entries = sorted(cache_folder.iterdir())
    del reads[:]
    (path,) = folder.rglob(name)
    os.utime(path, ns=(1, 1))
    open_data(folder)[0]
    assert reads == read_again
    assert sorted(cache_folder.iterdir()) == entries


def test_changed_content_is_read(folder: Path) -> None:
    before = open_data(folder)[0].states[0, 0]
    path = folder / "data" / "00_tracks.csv"
    path.write_text(path.read_text().replace(",5.0,", ",6.5,", 1))
    assert open_data(folder)[0].states[0, 0] == before + 1.5


def test_damaged_cache_entries_are_replaced(
    folder: Path, cache_folder: Path, reads: list[str]
) -> None:
    """Without a warning."""
    before = open_data(folder)[0]
    states = before.states.copy()
    for path in cache_folder.iterdir():
        content = path.read_bytes()
        path.unlink()  # so that the mapping of the old file remains valid
        path.write_bytes(content[: len(content) // 2])
    del reads[:]
    assert np.array_equal(open_data(folder)[0].states, states)
    assert reads == ["00_tracks.csv", "location1.osm"]


def test_without_a_cache(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    reads: list[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """If nothing can be cached, one line is logged and recordings are read anyway."""
    monkeypatch.setattr(cache, "_noted", set[str]())
    before = open_data(folder)[0]
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "file" / "below"))
    del reads[:]
    after = open_data(folder)[0]
    (line,) = caplog.messages
    assert line.startswith("asp-env: results are not cached: cache folder")
    assert line.endswith("set ASP_ENV_CACHE to a folder that can be written to")
    assert reads == ["00_tracks.csv", "location1.osm"]
    assert equal(before, after)
    assert not after.states.flags.writeable


def test_full_disk(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A recording opens even if its cache entry cannot be written."""

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(opening.cache, "save", refuse)
    monkeypatch.setattr(cache, "_noted", set[str]())
    assert len(open_data(folder)[0]) == 3
    (line,) = caplog.messages
    assert line.endswith("No space left on device")


def test_damaged_recording_does_not_affect_the_others(folder: Path) -> None:
    (folder / "data" / "01_tracks.csv").write_text("")
    recordings = open_data(folder)
    assert [recordings[number].name for number in (0, 2)] == ["00", "02"]
    with pytest.raises(DataError, match=r"01_tracks\.csv: is empty"):
        recordings[1]


def test_subset(folder: Path, reads: list[str]) -> None:
    """A subset has the given order and shares open recordings."""
    recordings = open_data(folder)
    first = recordings[2]
    some = recordings.subset([2, 0])
    assert isinstance(some, Recordings)
    assert some.names == ("02", "00")
    assert some.source == recordings.source
    assert some[0] is first
    assert recordings[:2].names == ("00", "01")
    assert [each.name for each in recordings] == ["00", "01", "02"]
    assert reads.count("02_tracks.csv") == 1
    assert some.hashes() == (recordings.hashes()[2], recordings.hashes()[0])


def test_recordings_with_another_origin_have_a_map_of_their_own(folder: Path) -> None:
    path = folder / "data" / "01_recordingMeta.csv"
    path.write_text(path.read_text().replace("300000.0", "300010.0"))
    maps = [recording.road_map for recording in open_data(folder)]
    assert maps[0] is maps[2]
    shift = maps[0].lanes.points - maps[1].lanes.points
    np.testing.assert_allclose(shift, np.broadcast_to((10.0, 0.0), shift.shape), atol=1e-6)


def test_background(folder: Path) -> None:
    """The scale is inferred: 120 m of road in 2,100 pixels need 0.06 m/px."""
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 2_100, 900)
    (folder / "data" / "00_background.png").write_bytes(head)
    (folder / "data" / "01_background.png").write_bytes(b"no image")
    recordings = open_data(folder)
    background = recordings[0].background
    assert background is not None
    assert background.path.name == "00_background.png"
    assert background.metres_per_pixel == pytest.approx(0.06)
    assert recordings[1].background is None
    assert recordings[1].repairs == ("01_background.png left out: its scale is unknown",)
    assert recordings[2].background is None


def test_hashes_depend_on_content_alone(folder: Path, tmp_path: Path) -> None:
    """Not on the folder; recordings differ, and every file counts."""
    recordings = open_data(folder)
    assert len(set(recordings.hashes())) == 3
    moved = tmp_path / "elsewhere"
    write_folder(moved, recordings=3)
    assert open_data(moved).data_hash() == recordings.data_hash()
    hashes = {recordings.data_hash()}
    for name in ("02_tracks.csv", "02_tracksMeta.csv", "02_recordingMeta.csv", "location1.osm"):
        (path,) = moved.rglob(name)
        path.write_text(path.read_text() + "\n")
        hashes.add(open_data(moved).data_hash())
    assert len(hashes) == 5
    assert open_data(moved).hashes()[0] != recordings.hashes()[0]


def test_hashes_are_cached(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = open_data(folder).data_hash()

    def refuse(path: Path) -> str:
        raise AssertionError(path)

    monkeypatch.setattr(opening.cache, "digest", refuse)
    assert open_data(folder).data_hash() == expected


def test_folders_are_searched_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Opening and hashing three recordings searches no folder more often than opening one."""
    searched: list[Path] = []
    walk = os.walk

    def counted(root: Path, *, followlinks: bool) -> Any:
        searched.append(root)
        return walk(root, followlinks=followlinks)

    monkeypatch.setattr(layout.os, "walk", counted)
    recordings = open_data(folder)
    assert recordings[0].road_map is recordings[1].road_map
    once = len(searched)
    assert len(list(recordings)) == len(recordings.hashes()) == 3
    recordings.data_hash()
    assert recordings.subset([1]).hashes() == recordings.hashes()[1:2]
    assert len(searched) == once


def test_registered_source(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The registered function is called with the text behind the colon."""
    arguments: list[str] = []

    def source(argument: str) -> Path:
        arguments.append(argument)
        return folder

    names, find = registry.names, registry.find
    monkeypatch.setattr(
        registry, "names", lambda group: ("made-up",) if group == "sources" else names(group)
    )
    monkeypatch.setattr(
        registry, "find", lambda group, name: source if group == "sources" else find(group, name)
    )
    recordings = open_data("made-up:place:7")
    assert arguments == ["place:7"]
    assert recordings.source == "made-up:place:7"
    assert len(recordings) == 3


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ("nowhere", "nowhere does not exist"),
        ("syntetic:roundabout", "unknown source 'syntetic' (did you mean 'synthetic'?)"),
        ("sample:square", "unknown sample 'square'"),
        ("empty", "no recordings found; expected XX_recordingMeta.csv"),
        ("empty", "or LOCATION/vehicle_tracks_NNN.csv"),
        ("file", "is a file; expected a folder"),
    ],
)
def test_unusable_data_are_rejected(
    tmp_path: Path, cache_folder: Path, monkeypatch: pytest.MonkeyPatch, data: str, expected: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(AspEnvError) as caught:
        open_data(data)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not cache_folder.exists()


def test_existing_folder_whose_name_looks_like_a_scheme(
    tmp_path: Path, cache_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path / "run:1")
    write_map(tmp_path / "run:1")
    assert open_data("run:1")[0].name == "00"
    assert cache_folder.exists()


def test_from_inside_the_data_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In `data`, `.` stands for the recordings there, with the maps beside it."""
    monkeypatch.chdir(folder / "data")
    recordings = open_data(".")
    assert recordings.source == "."
    assert len(recordings[0].road_map.lanes) == 2


def test_joined_data_are_the_recordings_of_each(folder: Path, tmp_path: Path) -> None:
    """In order, with the number of their data set before equal names, and the same content."""
    other = write_folder(tmp_path / "other", recordings=4)
    parts = [open_data(folder), open_data(other)[3:]]
    joined = join_data(parts)
    assert joined.names == ("1-00", "1-01", "1-02", "2-03")
    assert joined.hashes() == (*parts[0].hashes(), *parts[1].hashes())
    assert joined.source == f"{folder}, {other}"
    for one, same in zip(joined, [*parts[0], *parts[1]], strict=True):
        assert equal(one, same)
    assert join_data(parts[:1]) is parts[0]


def test_recording_in_two_data_sets_is_refused(folder: Path, tmp_path: Path) -> None:
    """By content, under whatever name the folder has."""
    copy = write_folder(tmp_path / "copy", recordings=1)
    with pytest.raises(DataError, match=f"recording 00 of '{copy}' is in '{folder}' too"):
        join_data([open_data(folder), open_data(copy)])
