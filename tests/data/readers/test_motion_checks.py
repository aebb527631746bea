"""Headings, velocities, sizes and positions of files in other conventions than their layout's."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.classes import FOOTPRINTS_M, AgentClass
from asp_env.data.readers.motion_checks import (
    check_headings,
    check_speeds,
    check_velocities,
    explaining,
    motion_of,
)
from asp_env.data.readers.sizes import with_footprints
from asp_env.data.recording import Recording
from asp_env.data.source import open_data
from asp_env.errors import DataError
from tests.data import interaction_files, levelx_files

RATE_HZ = 25.0
COURSES_RAD = np.radians([10.0, 100.0, 200.0, 290.0])
"""Directions of four cars, in all quadrants and on no axis."""


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))


def four_cars(speed: float = 8.0) -> pd.DataFrame:
    """4 s of four cars at constant speed, in the columns of inD."""
    time = np.arange(100) / RATE_HZ
    tables = []
    for track, course in enumerate(COURSES_RAD.tolist()):
        rows = levelx_files.track_rows(track, np.arange(100), RATE_HZ)
        rows["xCenter"] = 60.0 + speed * math.cos(course) * time
        rows["yCenter"] = -20.0 + speed * math.sin(course) * time
        rows["xVelocity"], rows["yVelocity"] = speed * math.cos(course), speed * math.sin(course)
        rows["heading"] = math.degrees(course)
        tables.append(rows)
    return pd.concat(tables, ignore_index=True)


def opened(folder: Path, tracks: pd.DataFrame) -> Recording:
    levelx_files.write_recording(folder, classes=["car"] * 4, tracks=tracks)
    levelx_files.write_map(folder)
    return open_data(folder)[0]


def of_tracks(recording: Recording) -> list[str]:
    """Repairs but those about the map: the cars cross a road along x."""
    return [line for line in recording.repairs if " the map " not in line]


def with_headings(change: Callable[[pd.Series], object]) -> pd.DataFrame:
    tracks = four_cars()
    tracks["heading"] = change(pd.Series(tracks["heading"]))
    return tracks


def test_four_cars_are_read_as_they_drive(tmp_path: Path) -> None:
    recording = opened(tmp_path, four_cars())
    assert of_tracks(recording) == []
    np.testing.assert_allclose(recording.states[:, 3], 8.0, atol=1e-4)
    headings = recording.states[recording.starts[:-1], 2]
    np.testing.assert_allclose(np.cos(headings - COURSES_RAD), 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "convention"),
    [
        (np.radians, "in radians;"),
        (lambda heading: -heading % 360, r"clockwise from \+x \(or y of the positions points"),
        (lambda heading: (90 - heading) % 360, r"clockwise from north \(\+y\);"),
        (lambda heading: (heading - 90) % 360, r"they are counter-clockwise from north"),
        (lambda heading: (heading + 180) % 360, "of the rear"),
        (lambda heading: (heading + 90) % 180 - 90, r"folded into ±90°"),
        (lambda heading: np.radians((90 - heading) % 360), "in radians and clockwise from north"),
    ],
)
def test_the_convention_of_headings_is_named(
    tmp_path: Path, change: Callable[[pd.Series], object], convention: str
) -> None:
    with pytest.raises(DataError, match=f"of 4 moving vehicles contradict .*{convention}"):
        opened(tmp_path, with_headings(change))


def test_headings_of_no_convention_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"headings of 3 of 4 moving vehicles .* motion; expected"):
        opened(tmp_path, with_headings(lambda heading: 0 * heading))


@pytest.mark.parametrize("turns", [-1, 2])
def test_whole_turns_are_no_contradiction(tmp_path: Path, turns: int) -> None:
    recording = opened(tmp_path, with_headings(lambda heading: heading + 360 * turns))
    assert of_tracks(recording) == []


def test_one_wrong_heading_of_four_is_reported(tmp_path: Path) -> None:
    """A tracker's fault of one vehicle is none of the file's convention."""
    tracks = four_cars()
    tracks.loc[tracks["trackId"] == 2, "heading"] = 100.0
    recording = opened(tmp_path, tracks)
    assert of_tracks(recording) == ["headings contradict the motion of 1 tracks: 2"]


@pytest.mark.parametrize(
    ("columns", "factor", "cause"),
    [
        (("xVelocity", "yVelocity"), 3.6, r"3\.6 times .*velocities in km/h"),
        (("xVelocity", "yVelocity"), 1 / 25, r"0\.04 times .*velocities in metres per frame"),
        (("xVelocity", "yVelocity"), 0.0, "0 times the motion"),
        (("xVelocity", "yVelocity"), 1.2, r"1\.2 times .*as at 30 Hz"),
        (("xCenter", "yCenter"), 3.28084, r"0\.305 times .*positions in feet"),
        (("xCenter", "yCenter"), 8.0, r"0\.125 times .*positions in pixels"),
    ],
)
def test_other_units_are_named(
    tmp_path: Path, columns: tuple[str, str], factor: float, cause: str
) -> None:
    tracks = four_cars()
    for column in columns:
        tracks[column] *= factor
    with pytest.raises(DataError, match=f"4 of 4 moving tracks are {cause}"):
        opened(tmp_path, tracks)


def test_positions_in_degrees_are_named(tmp_path: Path) -> None:
    tracks = four_cars()
    tracks["xCenter"] = 6.13 + tracks["xCenter"] / 70_400
    tracks["yCenter"] = 50.78 + tracks["yCenter"] / 111_200
    with pytest.raises(DataError, match="positions in degrees"):
        opened(tmp_path, tracks)


def test_absolute_positions_are_named(tmp_path: Path) -> None:
    tracks = four_cars()
    tracks["xCenter"] += levelx_files.ORIGIN_M[0]
    tracks["yCenter"] += levelx_files.ORIGIN_M[1]
    with pytest.raises(DataError, match=r"line 2: xCenter and yCenter are absolute, such as UTM"):
        opened(tmp_path, tracks)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda x, y: (-x, -y), "signs are reversed"),
        (lambda x, y: (y, x), "columns are exchanged"),
        (lambda x, y: (x, -y), "y points down"),
    ],
)
def test_velocities_along_other_axes_are_named(
    tmp_path: Path, change: Callable[..., tuple[pd.Series, pd.Series]], cause: str
) -> None:
    tracks = four_cars()
    tracks["xVelocity"], tracks["yVelocity"] = change(tracks["xVelocity"], tracks["yVelocity"])
    with pytest.raises(DataError, match=f"in another direction .*{cause}"):
        opened(tmp_path, tracks)


def test_a_wrong_frame_rate_is_found(tmp_path: Path) -> None:
    """Rows at 25 Hz and frameRate 10: the velocities would fit 25 Hz."""
    levelx_files.write_recording(tmp_path, classes=["car"] * 4, rate_hz=10.0, tracks=four_cars())
    levelx_files.write_map(tmp_path)
    with pytest.raises(DataError, match=r"2\.5 times .*as at 25 Hz.* frameRate \(10\)"):
        open_data(tmp_path)[0]


@given(
    speed=st.floats(3.5, 60.0), course=st.floats(-3.1, 3.1), rate_hz=st.sampled_from((5, 25, 60))
)
def test_uniform_motion_agrees_with_itself(speed: float, course: float, rate_hz: int) -> None:
    frames = np.arange(2 * rate_hz)
    velocity = speed * np.array([math.cos(course), math.sin(course)])
    velocities = np.tile(velocity, (len(frames), 1))
    positions = np.outer(frames / rate_hz, velocity)
    motion = motion_of(np.zeros_like(frames), frames, positions, float(rate_hz))
    np.testing.assert_allclose(motion.moved, velocities[motion.row], atol=1e-9)
    headings = np.full(len(frames), course)
    assert check_velocities(motion, velocities, float(rate_hz), "file", "meta") == []
    assert check_headings(motion, headings, "file", unit="degrees") == []
    assert check_speeds(motion, np.full(len(frames), speed), float(rate_hz), "file") == []


def test_several_conventions_may_explain_one_vehicle() -> None:
    """Driving along +y with heading 0: clockwise or counter-clockwise from north."""
    frames = np.arange(50)
    motion = motion_of(0 * frames, frames, np.outer(frames, [0.0, 0.4]), RATE_HZ)
    names = explaining(motion, np.zeros(50), unit="degrees", folded=True)
    assert names == ["clockwise from north (+y)", "counter-clockwise from north (+y)"]


def test_standing_cars_whose_positions_jump_are_not_compared(tmp_path: Path) -> None:
    """Jumps of 1.5 m to all sides and back, at 0 m/s and any heading."""
    tracks = four_cars(speed=0.0)
    for number, row in enumerate(range(10, len(tracks), 20)):
        tracks.loc[row, "xCenter"] += 1.5 * math.cos(2.0 * number)
        tracks.loc[row, "yCenter"] += 1.5 * math.sin(2.0 * number)
    assert of_tracks(opened(tmp_path, tracks)) == []


def test_gaps_are_not_spanned() -> None:
    """A gap of 50 frames between rows 24 and 25, and 0.4 s around each row."""
    frames = np.concatenate([np.arange(25), 75 + np.arange(25)])
    motion = motion_of(np.zeros(50, dtype=np.int64), frames, np.outer(frames, [1.0, 0.0]), RATE_HZ)
    assert motion.row.tolist() == [*range(5, 20), *range(30, 45)]


def crossing(**columns: Callable[[pd.DataFrame], object]) -> pd.DataFrame:
    """Four cars at 8 m/s in the columns of INTERACTION, of which some are changed."""
    tables = [
        interaction_files.rows(
            track, interaction_files.drive((20, -6.1, course, 8), [(4, 0, 0)], 10)
        )
        for track, course in enumerate(COURSES_RAD.tolist())
    ]
    table = pd.concat(tables, ignore_index=True)
    return table.assign(**{name: change(table) for name, change in columns.items()})


def opened_interaction(folder: Path, vehicles: pd.DataFrame) -> Recording:
    interaction_files.write_recording(folder, vehicles=vehicles)
    interaction_files.write_map(folder)
    return open_data(folder)[0]


@pytest.mark.parametrize(
    ("change", "convention"),
    [
        (lambda table: np.degrees(table["psi_rad"]), "in degrees"),
        (lambda table: -table["psi_rad"], r"clockwise from \+x"),
        (lambda table: math.pi / 2 - table["psi_rad"], "clockwise from north"),
    ],
)
def test_the_convention_of_psi_is_named(
    tmp_path: Path, change: Callable[[pd.DataFrame], object], convention: str
) -> None:
    with pytest.raises(DataError, match=f"{convention}.*expected radians"):
        opened_interaction(tmp_path, crossing(psi_rad=change))


def test_psi_of_no_convention_is_not_used(tmp_path: Path) -> None:
    """Headings of 60° to 70° beside the motion, of each vehicle another one."""
    offsets = np.radians([100.0, 70.0, -80.0, 80.0])
    table = crossing(psi_rad=lambda table: table["psi_rad"] + offsets[table["track_id"]])
    recording = opened_interaction(tmp_path, table)
    assert any("headings are not used" in line for line in recording.repairs)
    headings = recording.states[recording.starts[:-1], 2]
    np.testing.assert_allclose(np.cos(headings - COURSES_RAD), 1.0, atol=1e-3)


def test_positions_in_feet_are_reported_where_speeds_are_not_used(tmp_path: Path) -> None:
    table = crossing(x=lambda table: table["x"] / 0.3048, y=lambda table: table["y"] / 0.3048)
    recording = opened_interaction(tmp_path, table)
    (line,) = (line for line in recording.repairs if "speeds" in line)
    assert "4 of 4 moving tracks are 0.305 times the motion" in line
    assert "positions in feet" in line


def test_default_footprints_of_vehicles_are_reported() -> None:
    """A car with a size, a car of no length, a van without a width, and a pedestrian."""
    kinds = [AgentClass.CAR, AgentClass.CAR, AgentClass.VAN, AgentClass.PEDESTRIAN]
    classes = np.array([int(kind) for kind in kinds])
    sizes = np.array([(4.2, 1.7), (1e-30, 1.7), (5.0, np.nan), (0.0, 0.0)])
    repairs: list[str] = []
    found = with_footprints(sizes, classes, "file", repairs)
    expected = np.stack([np.array([4.2, 1.7], dtype=np.float32), *FOOTPRINTS_M[classes[1:]]])
    np.testing.assert_array_equal(found, expected)
    (line,) = repairs
    assert line.startswith("2 of 3 vehicles have no length or width")


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ([(1.8, 4.5), (1.9, 4.6), (4.4, 1.8)], "2 of 3 vehicles are wider than long"),
        ([(14.8, 5.9)] * 3, r"median width of 3 vehicles is 5\.9, expected 0\.4 to 5 metres"),
        ([(0.0045, 0.0018)] * 3, r"median length of 3 vehicles is 0\.0045"),
    ],
)
def test_sizes_that_cannot_be_right(sizes: list[tuple[float, float]], message: str) -> None:
    with pytest.raises(DataError, match=message):
        with_footprints(np.array(sizes), np.zeros(3, dtype=np.int64), "file", [])


@pytest.mark.parametrize("cell", ["50", "50 km/h"])
def test_a_speed_limit_in_kmh_is_an_error(tmp_path: Path, cell: str) -> None:
    """No road has a limit of 50 m/s, 180 km/h."""
    data = levelx_files.write_recording(tmp_path)
    levelx_files.write_map(tmp_path)
    path = data / "00_recordingMeta.csv"
    path.write_text(path.read_text().replace(",13.9,", f",{cell},"))
    with pytest.raises(DataError, match=f"speedLimit is '?{cell}"):
        open_data(tmp_path)[0]


def test_speeds_of_any_size_are_compared() -> None:
    """Numbers at the end of the range, of an agent that stands: no overflow, one line."""
    frames = np.arange(50)
    motion = motion_of(np.zeros(50, dtype=np.int64), frames, np.zeros((50, 2)), 10.0)
    (line,) = check_speeds(motion, np.full(50, 1e308), 10.0, "file")
    assert line.startswith("the speeds of 1 of 1 moving tracks are")
