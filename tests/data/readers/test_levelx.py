"""The inD/rounD layout: tracks, sizes, headings, and which files belong together."""

import math
import struct
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pandas as pd
import pytest
from hypothesis import given

from asp_env.data.classes import FOOTPRINTS_M, AgentClass
from asp_env.data.readers import tables
from asp_env.data.readers.layout import TrackTable
from asp_env.data.readers.levelx import (
    LevelxFiles,
    find_map,
    find_recordings,
    metres_per_pixel,
    read_levelx,
)
from asp_env.data.readers.levelx_meta import RecordingMeta, read_recording_meta
from asp_env.data.source import open_data
from tests.data.levelx_files import track_rows, write_folder, write_map, write_recording


def read(folder: Path) -> TrackTable:
    """The tracks of a folder's only recording."""
    (files,) = find_recordings(folder)
    return read_levelx(files, read_recording_meta(files.recording_meta).frame_rate_hz)


def recordings_with_metadata(folder: Path) -> list[tuple[LevelxFiles, RecordingMeta]]:
    found = find_recordings(folder)
    return [(files, read_recording_meta(files.recording_meta)) for files in found]


def states_of_one_track(folder: Path, kind: str, **columns: list[float]) -> np.ndarray:
    """The states of a track of class `kind` with the given columns."""
    count = len(next(iter(columns.values())))
    rows = track_rows(7, np.arange(count), 25.0, kind)
    for name, values in columns.items():
        rows[name] = values
    write_recording(folder, classes=[kind], tracks=rows)
    return read(folder).states


def same(table: TrackTable, other: TrackTable) -> bool:
    """Whether two tables are equal bit for bit, except for repairs."""
    names = ("track_ids", "classes", "sizes", "first_frames", "starts", "states")
    return all(np.array_equal(getattr(table, name), getattr(other, name)) for name in names)


def test_metadata_of_a_recording(tmp_path: Path) -> None:
    """Frame rate, speed limit, location and origin."""
    write_recording(tmp_path, number=3, location=2, rate_hz=10.0)
    ((files, meta),) = recordings_with_metadata(tmp_path)
    assert files.name == "03"
    assert (meta.number, meta.location, meta.frame_rate_hz) == (3, 2, 10.0)
    assert meta.speed_limit_mps == pytest.approx(13.9)
    assert meta.origin.epsg == 32632


def test_tracks_and_rows(tmp_path: Path) -> None:
    """Track i begins at frame i, ends at 249, and its rows are consecutive."""
    write_recording(tmp_path, classes=("car", "Truck_Bus", "PEDESTRIAN"))
    table = read(tmp_path)
    assert table.track_ids.tolist() == [0, 1, 2]
    assert table.first_frames.tolist() == [0, 1, 2]
    assert table.starts.tolist() == [0, 250, 499, 747]
    kinds = [AgentClass.CAR, AgentClass.TRUCK_BUS, AgentClass.PEDESTRIAN]
    assert table.classes.tolist() == kinds
    assert table.states.dtype == np.float32
    assert table.repairs == ()


def test_speed_is_negative_against_the_heading(tmp_path: Path) -> None:
    """A car that heads north and moves south at 2 m/s has speed -2; north at 3 m/s, 3."""
    states = states_of_one_track(
        tmp_path, "car", heading=[90.0, 90.0], xVelocity=[0.0, 0.0], yVelocity=[-2.0, 3.0]
    )
    np.testing.assert_allclose(states[:, 2], math.pi / 2, atol=1e-6)
    np.testing.assert_allclose(states[:, 3], [-2.0, 3.0], atol=1e-6)


@pytest.mark.parametrize(("velocity_x", "speed"), [(3.0, 5.0), (-3.0, -5.0)])
def test_speed_is_the_norm_of_the_velocity(tmp_path: Path, velocity_x: float, speed: float) -> None:
    """A car that heads east and moves at (±3, 4) m/s has speed ±5."""
    states = states_of_one_track(
        tmp_path, "car", heading=[0.0], xVelocity=[velocity_x], yVelocity=[4.0]
    )
    assert states[0, 3] == pytest.approx(speed)


def test_heading_of_vulnerable_road_users(tmp_path: Path) -> None:
    """That of the file until the first motion, then the direction of motion, held at 0.2 m/s."""
    states = states_of_one_track(
        tmp_path,
        "pedestrian",
        heading=[30.0] * 5,
        xVelocity=[0.2, 0.0, 0.0, 0.1, -1.0],
        yVelocity=[0.0, 2.0, 0.0, 0.1, 0.0],
    )
    expected = np.radians([30.0, 90.0, 90.0, 90.0, -180.0])
    turned = np.abs(np.exp(1j * states[:, 2]) - np.exp(1j * expected))
    np.testing.assert_allclose(turned, 0.0, atol=1e-6)
    np.testing.assert_allclose(states[:, 3], [0.2, 2.0, 0.0, 0.1 * math.sqrt(2), 1.0], atol=1e-6)


def test_headings_do_not_continue_in_the_next_track(tmp_path: Path) -> None:
    first = track_rows(0, np.arange(3), 25.0, "pedestrian")
    second = track_rows(1, np.arange(3), 25.0, "pedestrian")
    second[["xVelocity", "yVelocity"]] = 0.0
    write_recording(tmp_path, classes=["pedestrian"] * 2, tracks=pd.concat([first, second]))
    assert (read(tmp_path).states[3:, 2] == 0.0).all()


@given(heading=st.floats(-720, 720), course=st.floats(-math.pi, math.pi), total=st.floats(0, 40))
def test_headings_are_wrapped(
    tmp_path_factory: pytest.TempPathFactory, heading: float, course: float, total: float
) -> None:
    """Headings lie in [-π, π]; the speed is the norm of the velocity, with a sign."""
    velocity = {"xVelocity": [total * math.cos(course)], "yVelocity": [total * math.sin(course)]}
    folder = tmp_path_factory.mktemp("wrapped")
    state = states_of_one_track(folder, "car", heading=[heading], **velocity)[0]
    assert abs(state[2]) <= np.float32(math.pi)
    assert abs(abs(state[3]) - total) < 1e-4
    along = total * math.cos(course - math.radians(heading))
    assert abs(along) < 1e-4 or math.copysign(1, state[3]) == math.copysign(1, along)


def test_sizes_in_rows_have_priority(tmp_path: Path) -> None:
    """Over those of the metadata; sizes of zero become the class's footprint."""
    data = write_recording(tmp_path, classes=("car", "pedestrian"))
    path = data / "00_tracksMeta.csv"
    meta = pd.read_csv(path)
    meta.loc[0, ["length", "width"]] = (9.0, 9.0)
    meta.to_csv(path, index=False)
    sizes = read(tmp_path).sizes
    np.testing.assert_allclose(sizes[0], (4.5, 1.8))
    np.testing.assert_allclose(sizes[1], FOOTPRINTS_M[AgentClass.PEDESTRIAN])


def test_sizes_in_the_metadata(tmp_path: Path) -> None:
    """Used if the rows have none."""
    rows = track_rows(0, np.arange(5), 25.0)
    data = write_recording(tmp_path, classes=["car"], tracks=rows)
    rows.drop(columns=["width", "length"]).to_csv(data / "00_tracks.csv", index=False)
    np.testing.assert_allclose(read(tmp_path).sizes, [(4.5, 1.8)])


@pytest.mark.parametrize("change", ["columns", "rows", ".gz", ".xz", "chunks", "crlf", "spaces"])
def test_equivalent_files_give_equal_tracks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    """Order of columns and rows, compression, chunk size, line ends and spaces."""
    plain = read(write_folder(tmp_path / "plain"))
    other = tmp_path / "other"
    path = write_recording(other, suffix=change if change.startswith(".") else "") / "00_tracks.csv"
    if change == "columns":
        rows = pd.read_csv(path)
        rows[rows.columns[::-1]].assign(note="a, b").to_csv(path, index=False)
    elif change == "rows":
        pd.read_csv(path).sample(frac=1, random_state=1).to_csv(path, index=False)
    elif change == "chunks":
        monkeypatch.setattr(tables, "ROWS_PER_CHUNK", 7)
    elif change == "crlf":
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n") + b"\r\n")
    elif change == "spaces":
        path.write_text(path.read_text().replace(",", ", ", 16).rstrip("\n"))
    assert same(read(other), plain)


def test_gaps_split_tracks(tmp_path: Path) -> None:
    """Frames 0-4 and 8-9 of track 0 become tracks 0 and 2, after track 1; a repair is reported."""
    frames = np.array([0, 1, 2, 3, 4, 8, 9])
    rows = [track_rows(0, frames, 25.0), track_rows(1, np.arange(10), 25.0)]
    write_recording(tmp_path, classes=["car", "van"], tracks=pd.concat(rows))
    table = read(tmp_path)
    assert table.track_ids.tolist() == [0, 1, 2]
    assert table.first_frames.tolist() == [0, 0, 8]
    assert np.diff(table.starts).tolist() == [5, 10, 2]
    assert table.classes.tolist() == [AgentClass.CAR, AgentClass.VAN, AgentClass.CAR]
    np.testing.assert_allclose(table.states[15:, 0], rows[0]["xCenter"][5:], atol=1e-5)
    assert table.repairs == ("1 gaps in tracks' frames, split there: 0 after frame 4",)


def test_frames_that_differ_from_the_metadata_are_reported(tmp_path: Path) -> None:
    """A track that begins later than in its metadata is read."""
    path = write_recording(tmp_path) / "00_tracks.csv"
    rows = pd.read_csv(path)
    rows[(rows["trackId"] != 1) | (rows["frame"] > 20)].to_csv(path, index=False)
    table = read(tmp_path)
    assert table.first_frames.tolist() == [0, 21, 2]
    assert len(table.repairs) == 1
    assert "than in tracksMeta: 1" in table.repairs[0]


def test_names_of_recordings(tmp_path: Path) -> None:
    """In natural order; preceded by the folder where two folders have the same id."""
    for number in (10, 2, 100):
        write_recording(tmp_path / "inD", number=number)
    assert [files.name for files in find_recordings(tmp_path)] == ["02", "10", "100"]
    write_recording(tmp_path / "rounD", number=2)
    names = [files.name for files in find_recordings(tmp_path)]
    assert names == ["10", "100", "inD/02", "rounD/02"]


def test_map_by_location(tmp_path: Path) -> None:
    """The map whose name ends in the location's id, of the recording's dataset."""
    for dataset in ("inD", "rounD"):
        for location in (1, 2, 12):
            write_map(tmp_path / dataset, location=location)
        write_recording(tmp_path / dataset, location=2)
    for files, meta in recordings_with_metadata(tmp_path):
        found, guesses = find_map(files, meta, {})
        assert guesses == ()
        assert found.name == "location2.osm"
        assert found.is_relative_to(tmp_path / files.name.split("/")[0])


def test_map_beside_the_data_folder(tmp_path: Path) -> None:
    """It is found if the folder `data` itself is opened."""
    path = write_map(tmp_path)
    write_recording(tmp_path)
    ((files, meta),) = recordings_with_metadata(tmp_path / "data")
    assert find_map(files, meta, {})[0] == path


def test_map_by_folder(tmp_path: Path) -> None:
    """A map with another name in a folder that begins with the location's id."""
    path = write_map(tmp_path, location=3)
    other = write_map(tmp_path, location=4)
    path, other = (each.rename(each.with_name("crossing.osm")) for each in (path, other))
    write_recording(tmp_path, location=4)
    ((files, meta),) = recordings_with_metadata(tmp_path)
    assert find_map(files, meta, {})[0] == other


def test_map_by_place(tmp_path: Path) -> None:
    """A map without a location in its name is used by recordings made near it."""
    path = tmp_path / "lanelets" / "heckstrasse.osm"
    path.parent.mkdir()
    path.write_bytes(write_map(tmp_path / "source").read_bytes())
    (tmp_path / "source" / "maps" / "lanelets" / "01_place" / "location1.osm").unlink()
    write_recording(tmp_path, location=3)
    ((files, meta),) = recordings_with_metadata(tmp_path)
    assert find_map(files, meta, {})[0] == path


@pytest.mark.parametrize(("number", "folder"), [(10, "01_site"), (11, "01_site_constuction")])
def test_construction_map(tmp_path: Path, number: int, folder: str) -> None:
    """Recordings 11 to 17 of inD's location 1 use the construction-site map, others do not."""
    for name in ("01_site", "01_site_constuction"):
        path = tmp_path / "maps" / "lanelets" / name / "location1.osm"
        path.parent.mkdir(parents=True)
        path.write_text("<osm />")
    write_recording(tmp_path, number=number)
    ((files, meta),) = recordings_with_metadata(tmp_path)
    assert find_map(files, meta, {})[0].parent.name == folder


@pytest.mark.parametrize(
    ("folder", "expected_m"),
    [
        ("inD-dataset-v1.0", 0.12),
        ("rounD", 0.10),
        ("exiD", 0.06),
        ("uniD", 0.02),
        ("industry", 0.02),
    ],
)
def test_background_scale(tmp_path: Path, folder: str, expected_m: float) -> None:
    """The dataset's factor if a folder has its name, otherwise the smallest factor that fits."""
    write_recording(tmp_path / folder)
    ((files, meta),) = recordings_with_metadata(tmp_path)
    xy = np.array([[0.0, -2.0], [18.0, -8.0], [10.0, -5.0]])
    scale = metres_per_pixel(files, meta, (1000, 500), xy, np.full(len(xy), True))
    assert scale == pytest.approx(expected_m)


def test_background_that_cannot_fit(tmp_path: Path) -> None:
    """Without a factor that fits there is no scale."""
    write_recording(tmp_path)
    ((files, meta),) = recordings_with_metadata(tmp_path)
    xy = np.array([[0.0, -2.0], [400.0, -8.0]])
    assert metres_per_pixel(files, meta, (1000, 500), xy, np.full(len(xy), True)) is None


def test_background_of_a_folder_named_like_a_dataset(tmp_path: Path) -> None:
    """A named factor that does not fit is not used: 110 m in 1,000 pixels need 12, not 10."""
    write_recording(tmp_path / "round-1")
    ((files, meta),) = recordings_with_metadata(tmp_path)
    xy = np.array([[0.0, -2.0], [110.0, -8.0]])
    scale = metres_per_pixel(files, meta, (1000, 500), xy, np.full(len(xy), True))
    assert scale == pytest.approx(0.12)


def test_background_beside_which_an_agent_stands(tmp_path: Path) -> None:
    """119.4 m in 1,000 pixels of 0.12 m hold the agents that move; one stands 1.2 m beside them."""
    write_recording(tmp_path)
    ((files, meta),) = recordings_with_metadata(tmp_path)
    xy = np.array([[0.0, -2.0], [119.4, -8.0], [121.2, -5.0]])
    moving = np.array([True, True, False])
    assert metres_per_pixel(files, meta, (1000, 500), xy, moving) == pytest.approx(0.12)
    assert metres_per_pixel(files, meta, (1000, 500), xy, ~moving) is None


def test_background_is_found(tmp_path: Path) -> None:
    data = write_recording(tmp_path)
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 1000, 500)
    (data / "00_background.png").write_bytes(head)
    (files,) = find_recordings(tmp_path)
    assert files.background == data / "00_background.png"


@pytest.mark.parametrize(
    ("text", "expected"),
    [("11", 11), ("11.5", 11.5), ("8:45", 8.75), ("08:45:30", 8.75), ("0", 0)]
    + [(each, None) for each in ("", "-1", "NaN", "morning", "24", "8:75")],
)
def test_start_times(tmp_path: Path, text: str, expected: float | None) -> None:
    """Hours as in inD, or a time of day; anything else counts as unknown."""
    path = write_recording(tmp_path) / "00_recordingMeta.csv"
    header, row = (line.split(",") for line in path.read_text().splitlines())
    row[header.index("startTime")] = text
    path.write_text(",".join(header) + "\n" + ",".join(row) + "\n")
    assert read_recording_meta(path).start_hour == expected


@pytest.mark.parametrize(
    ("column", "text", "expected"),
    [("startTime", text, f"startTime is {text!r}") for text in ("abc", "25:99", "24", "8:75")]
    + [("weekday", text, f"weekday is {text!r}") for text in ("abc", "3", "Montag")]
    + [("orthoPxToMeter", "1,5 cm", "orthoPxToMeter is '1,5 cm'")]
    + [("startTime", text, None) for text in ("", "NaN", "-1", "11:30")]
    + [("weekday", text, None) for text in ("", "NaN", "Mon", "TUESDAY", "thurs")]
    + [("orthoPxToMeter", text, None) for text in ("", "0", "-1", "NaN", "0.0126")],
)
def test_optional_metadata_that_cannot_be_read(
    tmp_path: Path, column: str, text: str, expected: str | None
) -> None:
    """They are reported; empty cells and the texts of unknown values are not."""
    data = write_recording(tmp_path)
    write_map(tmp_path)
    path = data / "00_recordingMeta.csv"
    pd.read_csv(path).assign(**{column: text}).to_csv(path, index=False)
    lines = open_data(tmp_path)[0].repairs
    assert [line.split(", expected")[0] for line in lines] == (
        [] if expected is None else [f"00_recordingMeta.csv: {expected}"]
    )


def test_without_start_time(tmp_path: Path) -> None:
    path = write_recording(tmp_path) / "00_recordingMeta.csv"
    header, row = (line.split(",") for line in path.read_text().splitlines())
    keep = [i for i, name in enumerate(header) if name not in ("startTime", "weekday")]
    path.write_text("\n".join(",".join(cells[i] for i in keep) for cells in (header, row)) + "\n")
    meta = read_recording_meta(path)
    assert (meta.start_hour, meta.weekday) == (None, None)
