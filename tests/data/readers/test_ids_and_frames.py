"""Ids of any size, and frames that count something else than rows."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.readers.tables import find_line, number_ids, read_table
from asp_env.data.recording import Recording
from asp_env.data.source import open_data
from asp_env.errors import DataError
from tests.data import interaction_files, levelx_files


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))


def some_tracks(frames: np.ndarray, rate_hz: float = 25.0) -> pd.DataFrame:
    """Two cars with rows at the same frames."""
    rows = [levelx_files.track_rows(track, frames, rate_hz) for track in (0, 1)]
    return pd.concat(rows, ignore_index=True)


def opened(folder: Path, tracks: pd.DataFrame, rate_hz: float = 25.0) -> Recording:
    """The recording of some rows."""
    levelx_files.write_recording(folder, rate_hz=rate_hz, classes=["car", "car"], tracks=tracks)
    levelx_files.write_map(folder)
    return open_data(folder)[0]


def test_ids_above_32_bits_are_stored(tmp_path: Path) -> None:
    tracks = some_tracks(np.arange(50))
    plain = opened(tmp_path / "a", tracks)
    tracks["trackId"] = tracks["trackId"].replace({0: 5, 1: 2**32 + 5})
    recording = opened(tmp_path / "b", tracks)
    assert recording.track_ids.tolist() == [5, 2**32 + 5]
    assert recording.repairs == ()
    np.testing.assert_array_equal(recording.states, plain.states)


@pytest.mark.parametrize("beyond", [2**53, 2**63, 10**19, 10**30])
def test_larger_ids_are_numbered_and_reported(tmp_path: Path, beyond: int) -> None:
    """The two ids are equal in double precision; the first rows belong to the larger one."""
    tracks = some_tracks(np.arange(50))
    plain = opened(tmp_path / "a", tracks)
    tracks["trackId"] = [beyond + 1 if track == 0 else beyond for track in tracks["trackId"]]
    recording = opened(tmp_path / "b", tracks)
    assert recording.track_ids.tolist() == [0, 1]
    np.testing.assert_array_equal(recording.track(1), plain.track(0))
    np.testing.assert_array_equal(recording.track(0), plain.track(1))
    (line,) = recording.repairs
    assert f"all 2 tracks are numbered in order of their ids, from {beyond} as 0" in line


def test_large_ids_of_the_interaction_layout(tmp_path: Path) -> None:
    """Vehicles are numbered, pedestrians get ids above."""
    vehicles = interaction_files.some_cars()
    names = {1: 10**19 + 1, 2: 10**19, 7: 3}
    vehicles["track_id"] = [names[track] for track in vehicles["track_id"]]
    walkers = interaction_files.walk("P1", (30.0, -18.0), (1.2, 0.0), 40)
    interaction_files.write_recording(tmp_path, vehicles=vehicles, pedestrians=walkers)
    interaction_files.write_map(tmp_path)
    recording = open_data(tmp_path)[0]
    assert sorted(recording.track_ids.tolist()) == [0, 1, 2, 3]
    assert any("from 3 as 0" in line for line in recording.repairs)


@given(ids=st.lists(st.integers(-(10**25), 10**25), min_size=1, max_size=20, unique=True))
def test_numbers_have_the_order_of_ids(ids: list[int]) -> None:
    """Equal ids have equal numbers in all columns, and `original` is the inverse."""
    numbered = number_ids(np.array(ids, dtype=object), np.array(sorted(ids), dtype=object))
    assert numbered.columns[1].tolist() == list(range(len(ids)))
    assert [numbered.original(number) for number in numbered.columns[0].tolist()] == ids


def test_a_line_is_found_by_an_id_of_20_digits(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text(f"id,x\n{10**19},0\n{10**19 + 1},0\n5.0,0\n1e20,0\n")
    assert find_line(path, {"id": 10**19 + 1}) == 3
    assert read_table(path, {"id": "id"})["id"].tolist() == [10**19, 10**19 + 1, 5, 10**20]


def test_large_ids_in_a_later_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the chunk with the large id is parsed again."""
    monkeypatch.setattr("asp_env.data.readers.tables.ROWS_PER_CHUNK", 3)
    path = tmp_path / "table.csv"
    ids = [1, 2, 3, 4, 2**60 + 1, 6, 7]
    path.write_text("id\n" + "".join(f"{each}\n" for each in ids))
    assert read_table(path, {"id": "id"})["id"].tolist() == ids


def test_frames_from_a_time_stamp_count_from_the_first(tmp_path: Path) -> None:
    plain = opened(tmp_path / "a", some_tracks(np.arange(50)))
    later = some_tracks(np.arange(50))
    later["frame"] += 3_000_000_000
    recording = opened(tmp_path / "b", later)
    assert (recording.num_frames, recording.first_frames.tolist()) == (50, [0, 0])
    assert recording.repairs == ("frames begin at 3000000000: counted from there",)
    np.testing.assert_array_equal(recording.states, plain.states)


@pytest.mark.parametrize("rate_hz", [25.0, 30.0])
def test_frames_in_milliseconds(tmp_path: Path, rate_hz: float) -> None:
    """30 Hz are steps of 33 and 34 ms. A gap of two frames remains one."""
    frames = np.array([*range(40), *range(42, 80)])
    plain = opened(tmp_path / "a", some_tracks(frames, rate_hz), rate_hz)
    stamped = some_tracks(frames, rate_hz)
    stamped["frame"] = (stamped["frame"] * 1000 / rate_hz).round().astype(int)
    recording = opened(tmp_path / "b", stamped, rate_hz)
    assert recording.first_frames.tolist() == plain.first_frames.tolist()
    np.testing.assert_array_equal(recording.states, plain.states)
    assert recording.repairs[0].startswith("frames count milliseconds")
    assert len(recording.repairs) == 2  # and the gaps


@pytest.mark.parametrize("unit", [5, 40_000])
def test_frames_that_most_rows_skip_are_refused(tmp_path: Path, unit: int) -> None:
    """Every fifth frame, from other frames on in each track, or microseconds."""
    tracks = some_tracks(np.arange(100) * unit)
    tracks.loc[tracks["trackId"] == 1, "frame"] += 2
    with pytest.raises(DataError, match=f"most rows are {unit:,} frames after the row before"):
        opened(tmp_path, tracks)


def test_every_fifth_frame(tmp_path: Path) -> None:
    """Frames 0, 5, 10, … at 25 Hz are a recording of 5 Hz."""
    tracks = some_tracks(np.arange(0, 250, 5))
    recording = opened(tmp_path, tracks)
    assert (recording.frame_rate_hz, recording.num_frames, len(recording)) == (5.0, 50, 2)
    assert recording.repairs == ("rows have one of 5 frames at 25 Hz: these are counted",)
    assert recording.resampled_from_hz is None
