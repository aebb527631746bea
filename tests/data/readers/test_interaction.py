"""The INTERACTION layout: what is read from its tables, and what is derived."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from asp_env.data.classes import FOOTPRINTS_M, AgentClass
from asp_env.data.readers.interaction import find_recordings, read_interaction
from asp_env.data.readers.layout import TrackTable
from asp_env.geometry import wrap_angle
from tests.data.interaction_files import (
    LENGTH_M,
    WIDTH_M,
    drive,
    rows,
    some_cars,
    walk,
    write_recording,
)

STRAIGHT = drive((5, -21.75, 0, 8), [(6, 0, 0)], 10)


def read(
    folder: Path, vehicles: pd.DataFrame, pedestrians: pd.DataFrame | None = None
) -> tuple[TrackTable, float]:
    """Writes one recording's rows and reads them."""
    write_recording(folder, vehicles=vehicles, pedestrians=pedestrians)
    (files,) = find_recordings(folder)
    return read_interaction(files)


def track(table: TrackTable, number: int) -> np.ndarray:
    """The states of the track with an id."""
    index = table.track_ids.tolist().index(number)
    return table.states[table.starts[index] : table.starts[index + 1]]


def same(table: TrackTable, other: TrackTable) -> bool:
    """Whether two tables are equal bit for bit, except for repairs."""
    columns = ("track_ids", "classes", "sizes", "first_frames", "starts", "states")
    return all(np.array_equal(getattr(table, name), getattr(other, name)) for name in columns)


SIDEWAYS_MPS2 = 5.0
DRIVES = st.lists(
    st.tuples(st.floats(0.5, 4), st.floats(-3, 2.5), st.floats(-0.25, 0.25)),
    min_size=2,
    max_size=5,
)


def drive_within_limits(
    start: tuple[float, float, float, float],
    parts: list[tuple[float, float, float]],
    rate_hz: float,
) -> np.ndarray:
    """Like `drive`, with steering limited to 5 m/s² of lateral acceleration."""
    fastest = start[3] + sum(seconds * max(gain, 0.0) for seconds, gain, _ in parts)
    limit = SIDEWAYS_MPS2 * 0.6 * LENGTH_M / max(fastest, 1.0) ** 2
    return drive(
        start, [(*part[:2], float(np.clip(part[2], -limit, limit))) for part in parts], rate_hz
    )


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    drives=st.lists(st.tuples(st.floats(-3, 3), st.floats(0, 15), DRIVES), min_size=1, max_size=4),
    rate_hz=st.sampled_from([10.0, 25.0]),
    first=st.integers(0, 500),
)
def test_vehicles_are_recovered_from_positions_alone(
    tmp_path: Path,
    drives: list[tuple[float, float, list[tuple[float, float, float]]]],
    rate_hz: float,
    first: int,
) -> None:
    """Vehicles that move as the bicycle model are read with small errors.

    Their actions change from one frame to the next, which no smoothing can follow: positions are
    right to 12 cm, speeds to 0.6 m/s, and to 0.2 m/s (rms). If a track begins in a bend, its first
    heading is unknown: headings are right to 17°, after 5 m to 5°. (Of 3,000 random drives with
    extreme actions the worst had 10 cm, 0.43 m/s, 0.19 m/s, 15° and 4.1°.)
    """
    truth = {
        number: drive_within_limits((20.0 * number, 0.0, heading, speed), parts, rate_hz)
        for number, (heading, speed, parts) in enumerate(drives)
    }
    vehicles = pd.concat(
        [
            rows(number, states, first_frame=first + 3 * number, rate_hz=rate_hz)
            for number, states in truth.items()
        ]
    )
    vehicles["vx"] *= -0.5
    table, rate = read(tmp_path, vehicles)
    assert rate == rate_hz
    assert table.track_ids.tolist() == list(truth)
    assert table.first_frames.tolist() == [3 * number for number in truth]
    assert all("the motion of the positions" in line for line in table.repairs)
    for number, states in truth.items():
        found = track(table, number).astype(float)
        assert len(found) == len(states)
        assert np.hypot(*(found - states)[:, :2].T).max() < 0.12
        apart = np.abs(found[:, 3] - states[:, 3])
        assert apart.max() < 0.6
        assert np.sqrt((apart**2).mean()) < 0.2
        distance = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(states[:, :2], axis=0).T))])
        off = np.degrees(np.abs(wrap_angle(found[:, 2] - states[:, 2])))
        assert off[0] < 17
        assert off[distance > 5].max(initial=0) < 5


def test_columns_are_found_by_name(tmp_path: Path) -> None:
    """Another order, an additional column and absent optional columns change nothing."""
    cars = some_cars()
    expected, _ = read(tmp_path / "a", cars)
    first = ["track_id", "vx", "vy", "psi_rad", "length", "width", "timestamp_ms"]
    other = pd.DataFrame(cars[first])
    other["time"] = "2022-03-16 11:21:31.598"
    other[["x", "agent_type", "y"]] = cars[["x", "agent_type", "y"]]
    assert same(read(tmp_path / "b", other)[0], expected)
    few = pd.DataFrame(cars.drop(columns=["frame_id", "vx", "vy"]))
    assert same(read(tmp_path / "c", few)[0], expected)
    by_time = cars.iloc[np.argsort(cars["timestamp_ms"].to_numpy(), kind="stable")]
    assert same(read(tmp_path / "d", by_time)[0], expected)


def test_wrong_velocities_change_nothing(tmp_path: Path) -> None:
    """Scaled, of the wrong sign, or zero."""
    cars = some_cars()
    expected, _ = read(tmp_path / "a", cars)
    cars["vx"] *= -0.4
    cars["vy"] = 0.0
    assert same(read(tmp_path / "b", cars)[0], expected)


def test_folded_headings_are_detected(tmp_path: Path) -> None:
    """Headings folded into ±90° reverse no vehicle; a repair is reported."""
    parked = drive((90, -25, 1.55, 0), [(9, 0, 0)], 10)
    cars = pd.concat([some_cars(), rows(9, parked)])
    expected, _ = read(tmp_path / "a", cars)
    folded = (cars["psi_rad"] + np.pi / 2) % np.pi - np.pi / 2
    assert (np.abs(folded - cars["psi_rad"]) > 3).any()
    found, _ = read(tmp_path / "b", cars.assign(psi_rad=folded))
    assert same(found, expected)
    assert expected.repairs == ()
    assert track(found, 9)[:, 2] == pytest.approx(1.55)
    (repair,) = found.repairs
    assert "% of the headings of fast vehicles point backwards: the front is" in repair


def test_a_vehicle_that_backs_up_has_negative_speed(tmp_path: Path) -> None:
    """It drives backwards at 1 m/s and then forward, and its heading does not change."""
    place = np.concatenate([np.linspace(0, -4, 41), -4 + 0.05 * np.arange(1, 60) ** 1.5])
    states = np.zeros((len(place), 4))
    states[:, 0] = place
    table, _ = read(tmp_path, pd.concat([rows(3, STRAIGHT), rows(4, states)]))
    found = track(table, 4)
    assert np.abs(found[:, 2]).max() < 1e-6
    np.testing.assert_allclose(found[5:30, 3], -1.0, atol=0.1)
    assert found[-1, 3] > 5


def test_pedestrians_have_new_ids(tmp_path: Path) -> None:
    """Ids above the vehicles', the class's footprint, and the direction of motion as heading."""
    people = pd.concat(
        [walk("P1", (0, 0), (0.0, 1.2), 40), walk("P10", (5, 0), (0.0, 0.0), 20)],
    )
    table, rate = read(tmp_path, rows(7, STRAIGHT), people)
    assert rate == 10
    assert table.track_ids.tolist() == [7, 8, 9]
    assert table.classes.tolist() == [AgentClass.CAR, AgentClass.BICYCLE, AgentClass.BICYCLE]
    assert table.sizes[0].tolist() == pytest.approx([LENGTH_M, WIDTH_M])
    assert (table.sizes[1:] == FOOTPRINTS_M[AgentClass.BICYCLE]).all()
    np.testing.assert_allclose(track(table, 8)[:, 2:], [[np.pi / 2, 1.2]] * 40, atol=0.02)
    assert (track(table, 9)[:, 2:] == 0).all()


def test_both_files_have_one_clock(tmp_path: Path) -> None:
    """Frame 0 is the earliest row of either file."""
    people = walk("P1", (0, 0), (0, 1), 20)
    table, _ = read(
        tmp_path,
        rows(7, STRAIGHT, first_frame=12),
        people.assign(timestamp_ms=people["timestamp_ms"] + 300),
    )
    assert dict(zip(table.track_ids.tolist(), table.first_frames.tolist(), strict=True)) == {
        7: 9,
        8: 0,
    }


def test_gaps_and_jumps_split_tracks(tmp_path: Path) -> None:
    """Later pieces have new ids; pieces that are too short are left out."""
    cars = pd.concat([rows(3, STRAIGHT), rows(5, STRAIGHT)]).reset_index(drop=True)
    second = cars["track_id"] == 5
    cars.loc[second & (cars["timestamp_ms"] >= 4_000), "y"] += 3.0
    removed = ~second & cars["timestamp_ms"].between(2_000, 2_400)
    early = second & cars["timestamp_ms"].between(300, 400)
    table, _ = read(tmp_path, pd.DataFrame(cars[~removed & ~early]))
    assert table.track_ids.tolist() == [3, 5, 6, 7]
    assert table.first_frames.tolist() == [0, 5, 25, 40]
    assert np.diff(table.starts).tolist() == [20, 35, 36, 21]
    np.testing.assert_allclose(table.states[:, 3], 8.0, atol=0.05)
    assert table.repairs == (
        "2 gaps in tracks' times, split there: 3 after 1900 ms, 5 after 200 ms",
        "1 jumps of over 1.5 m in tracks, split there: 5 after 3900 ms",
        "1 tracks have pieces under 0.5 s, these left out: 5",
    )


def test_repeated_first_positions_are_left_out(tmp_path: Path) -> None:
    """All but the last of them."""
    states = np.concatenate([np.repeat(STRAIGHT[:1], 3, axis=0), STRAIGHT])
    table, _ = read(tmp_path, pd.concat([rows(1, states), rows(2, STRAIGHT)]))
    assert table.first_frames.tolist() == [3, 0]
    assert np.array_equal(track(table, 1), track(table, 2))
    assert table.repairs == ("1 tracks repeat their first position, repeated rows left out: 1",)


def test_headings_and_sizes_are_optional(tmp_path: Path) -> None:
    """Without them vehicles drive forward and have the size of their class."""
    cars = some_cars()
    expected, _ = read(tmp_path / "a", cars)
    found, _ = read(tmp_path / "b", cars.drop(columns=["psi_rad", "length", "width"]))
    assert np.array_equal(found.states, expected.states)
    assert (found.sizes == FOOTPRINTS_M[AgentClass.CAR]).all()


def test_agent_types_in_any_case(tmp_path: Path) -> None:
    """A track whose type changes has its first type, and a repair is reported."""
    kinds = ["Car", "TRUCK", "Bike", "motorcycle", "Pedestrian", "bus", "van"]
    cars = pd.concat([rows(number, STRAIGHT, kind=kind) for number, kind in enumerate(kinds)])
    cars.loc[(cars["track_id"] == 0) & (cars["timestamp_ms"] > 3_000), "agent_type"] = "truck"
    table, _ = read(tmp_path, cars)
    names = ["CAR", "TRUCK", "BICYCLE", "MOTORCYCLE", "PEDESTRIAN", "BUS", "VAN"]
    assert [AgentClass(kind).name for kind in table.classes] == names
    assert table.repairs == ("1 tracks change their agent_type: 0",)
