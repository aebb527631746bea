"""Opening folders in the INTERACTION layout: names, maps and their frames, and the cache."""

import gzip
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from asp_env.cli import main
from asp_env.data.source import open_data
from asp_env.errors import DataError
from tests.data import levelx_files
from tests.data.interaction_files import (
    PLACE,
    some_cars,
    walk,
    write_folder,
    write_map,
    write_recording,
    write_taf_bw,
)


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def extent(lanes: np.ndarray) -> tuple[float, float, float, float]:
    """Smallest and largest x, smallest and largest y."""
    return (*lanes.min(axis=0)[:1], *lanes.max(axis=0)[:1], lanes[:, 1].min(), lanes[:, 1].max())


ROAD = (0.0, 120.0, -21.75, -18.25)
"""Extent of the lanes of `two_lane_road`."""


def test_recordings_and_maps_about_0_degrees(tmp_path: Path) -> None:
    """Names, locations, frame rate and lanes are as written."""
    recordings = open_data(write_folder(tmp_path / "data", recordings=2))
    assert recordings.names == (f"{PLACE}/000", f"{PLACE}/001")
    first, second = recordings
    assert (first.location, first.frame_rate_hz, first.num_frames) == (PLACE, 10.0, 96)
    assert (first.speed_limit_mps, first.background) == (None, None)
    assert first.road_map is second.road_map
    assert first.road_map.name == PLACE
    assert extent(first.road_map.lanes.points) == pytest.approx(ROAD, abs=1e-3)


def test_recordings_with_metadata(tmp_path: Path) -> None:
    """Origin and speed limit are those of `meta_data.csv`."""
    write_taf_bw(tmp_path / "data")
    (recording,) = open_data(tmp_path / "data")
    assert (recording.name, recording.location) == ("k1_2020/004", "k1_2020")
    assert recording.speed_limit_mps == pytest.approx(50 / 3.6)
    assert extent(recording.road_map.lanes.points) == pytest.approx(ROAD, abs=1e-3)


def test_a_map_in_local_metres(tmp_path: Path) -> None:
    """An `.osm_xy` file is used where there is no `.osm` file."""
    write_recording(tmp_path / "data")
    write_map(tmp_path / "data", suffix=".osm_xy")
    (recording,) = open_data(tmp_path / "data")
    assert extent(recording.road_map.lanes.points) == pytest.approx(ROAD, abs=1e-5)
    write_map(tmp_path / "data", suffix=".osm_xy", text="spoilt")
    write_map(tmp_path / "data")
    assert len(open_data(tmp_path / "data")[0].road_map.lanes) == 2


@pytest.mark.parametrize(
    "opened", [".", "recorded_trackfiles", f"recorded_trackfiles/{PLACE}", "../data/./maps/.."]
)
def test_maps_are_found_from_inner_folders(tmp_path: Path, opened: str) -> None:
    """The whole folder, its tracks, or those of one location."""
    write_folder(tmp_path / "data")
    (recording,) = open_data(tmp_path / "data" / opened)
    assert recording.name == f"{PLACE}/000"
    assert len(recording.road_map.lanes) == 2


def test_a_map_named_by_the_metadata(tmp_path: Path) -> None:
    """It is used where no map has the folder's name."""
    location = write_taf_bw(tmp_path / "data", locationId="K1")
    maps = tmp_path / "data" / "maps"
    (maps / f"{location.name}.osm").rename(maps / "k1.osm")
    assert open_data(tmp_path / "data")[0].road_map.name == "k1"


def test_locations_of_one_name_have_their_own_maps(tmp_path: Path) -> None:
    """The nearest map, and names that include the path."""
    for year in ("2019", "2020"):
        write_folder(tmp_path / "data" / year)
    later = some_cars().assign(timestamp_ms=lambda table: table["timestamp_ms"] + 100)
    write_recording(tmp_path / "data" / "2020", vehicles=later)
    write_map(
        tmp_path / "data" / "2019",
        text=levelx_files.two_lane_road(
            lambda points: [f"lat='{y * 9e-6}' lon='{x * 9e-6}'" for x, y in points]
        ),
    )
    recordings = open_data(tmp_path / "data")
    locations = [f"{year}/recorded_trackfiles/{PLACE}" for year in ("2019", "2020")]
    assert recordings.names == tuple(f"{location}/000" for location in locations)
    assert [recording.location for recording in recordings] == locations
    assert len({extent(recording.road_map.lanes.points) for recording in recordings}) == 2


def test_a_folder_of_both_layouts(tmp_path: Path) -> None:
    levelx_files.write_folder(tmp_path / "data" / "inD")
    write_folder(tmp_path / "data" / "INTERACTION")
    recordings = open_data(tmp_path / "data")
    assert recordings.names == ("00", f"{PLACE}/000")
    assert [recording.frame_rate_hz for recording in recordings] == [25.0, 10.0]
    assert len(set(recordings.hashes())) == 2


def test_two_recordings_of_one_name_are_refused(tmp_path: Path) -> None:
    for folder in ("x", "y"):
        levelx_files.write_folder(tmp_path / "data" / folder)
    write_recording(tmp_path, number="00", place="x")
    shutil.copy(
        tmp_path / "recorded_trackfiles" / "x" / "vehicle_tracks_00.csv", tmp_path / "data" / "x"
    )
    with pytest.raises(DataError, match="two recordings are called x/00"):
        open_data(tmp_path / "data")


def test_a_change_of_any_file_is_noticed(tmp_path: Path, cache_folder: Path) -> None:
    """Of tracks, pedestrians, origin or map: the hash and the recording change."""
    folder = tmp_path / "data"
    location = write_taf_bw(folder)
    hashes = {open_data(folder).data_hash()}
    assert len(open_data(folder)[0]) == 3
    entries = len(list(cache_folder.iterdir()))

    def after(change: Callable[[], object]) -> None:
        change()
        hashes.add(open_data(folder).data_hash())

    after(lambda: walk("P1", (0, 0), (0, 1), 20).to_csv(location / "pedestrian_tracks_004.csv"))
    assert len(open_data(folder)[0]) == 4
    tracks, meta = location / "vehicle_tracks_004.csv", location / "meta_data.csv"
    after(lambda: tracks.write_text(tracks.read_text().replace("car", "bus")))
    assert open_data(folder)[0].classes.tolist()[:3] == [3, 3, 3]
    after(lambda: meta.write_text(meta.read_text().replace("49.0053", "49.00531")))
    assert open_data(folder)[0].road_map.lanes.points[:, 1].max() == pytest.approx(-19.4, abs=0.1)
    path = folder / "maps" / "k1_2020.osm"
    after(lambda: path.write_text(path.read_text() + "\n"))
    assert len(hashes) == 5
    # of the second origin: the map, what is known of it, and that it is of the right place
    assert len(list(cache_folder.iterdir())) == entries + 3


def test_the_cache_returns_equal_read_only_arrays(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "data")
    before, after = open_data(folder)[0], open_data(folder)[0]
    for name in ("track_ids", "classes", "sizes", "first_frames", "starts", "states"):
        assert np.array_equal(getattr(before, name), getattr(after, name))
        assert not getattr(after, name).flags.writeable
    assert after.frame_rate_hz == before.frame_rate_hz


def test_commands_take_this_layout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`inspect`, `evaluate` and `drive`."""
    folder = str(write_folder(tmp_path / "data", recordings=2))
    assert main(["inspect", folder]) == 0
    output = capsys.readouterr().out
    assert f"{PLACE}/000" in output
    assert "Faults: none" in output
    evaluate = ["evaluate", folder, "--predictors", "constant-velocity", "--out"]
    assert main([*evaluate, str(tmp_path / "open")]) == 0
    drive = ["drive", folder, "--predictors", "constant-velocity", "--out"]
    assert main([*drive, str(tmp_path / "closed")]) == 0
    for out in ("open", "closed"):
        table = pd.read_csv(tmp_path / out / "metrics.csv")
        assert set(table["data"].dropna()) == {folder}
        assert table["n"].to_numpy().max() > 0


@pytest.mark.parametrize("number", ["4", "004", "4.0"])
@pytest.mark.parametrize(("limit", "expected"), [("50", 50 / 3.6), ("", None), ("-1", None)])
def test_rows_of_metadata(tmp_path: Path, number: str, limit: str, expected: float | None) -> None:
    """Numbers as spreadsheets write them, an empty speed limit, and a compressed file."""
    location = write_taf_bw(tmp_path / "data", id=number, speedLimit_kmh=limit)
    path = location / "meta_data.csv"
    path.with_name("meta_data.csv.gz").write_bytes(gzip.compress(path.read_bytes()))
    path.unlink()
    (recording,) = open_data(tmp_path / "data")
    assert recording.speed_limit_mps == (None if expected is None else pytest.approx(expected))


def test_an_implausible_speed_limit_in_metadata(tmp_path: Path) -> None:
    write_taf_bw(tmp_path / "data", speedLimit_kmh=300)
    with pytest.raises(DataError, match="speedLimit_kmh is '300', expected km/h from -162 to 162"):
        open_data(tmp_path / "data")[0]
