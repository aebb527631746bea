"""Readers of geo-trax and SinD, and readers of other packages."""

import gzip
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from asp_env import registry
from asp_env.data.classes import AgentClass
from asp_env.data.readers.driven_area import driven_area
from asp_env.data.readers.found import FoundRecording, RecordingTables, SignalChanges
from asp_env.data.readers.layout import TrackTable
from asp_env.data.readers.measurements import Measurements
from asp_env.data.signals import SignalState
from asp_env.data.snippets import gather_signals
from asp_env.data.source import open_data
from asp_env.errors import DataError
from asp_env.metrics.drivable import drivable_field
from tests.data.interaction_files import attributes_in_degrees
from tests.data.levelx_files import two_lane_road
from tests.real_data import real_data

GEO_TRAX = (
    "Vehicle_ID,Timestamp,Frame_Number,Ortho_X,Ortho_Y,Local_X,Local_Y,Latitude,Longitude,"
    "Vehicle_Length,Vehicle_Width,Vehicle_Class,Vehicle_Speed,Vehicle_Acceleration,Road_Section,"
    "Lane_Number,Visibility"
)
SIND = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,yaw_rad,heading_rad,length,width"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty cache."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))


def write_geo_trax(folder: Path, *, seconds: float = 5.0) -> Path:
    """A bus at 10 m/s along +y and a car that stands, at 29.97 Hz, with empty speeds."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [GEO_TRAX]
    for frame in range(round(29.97 * seconds)):
        time_s = frame / 29.97
        clock = f"2022-10-07 17:52:{13.5 + time_s:06.3f}"
        for car, x, y, kind in (
            (1, 170201.0, 532274.0 + 10 * time_s, 1),
            (2, 170190.0, 532280.0, 0),
        ):
            lines.append(f"{car},{clock},{frame},1,2,{x},{y:.4f},37,126,5.2,2.2,{kind},,,1_2,5,1")
    path = folder / "2022-10-07_A_PM1.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_geo_trax_is_read(tmp_path: Path) -> None:
    """29.97 Hz; 10 m/s towards +y; positions from the multiple of 100 m below; no lanes."""
    write_geo_trax(tmp_path / "songdo")
    (recording,) = open_data(tmp_path / "songdo")
    assert (recording.name, recording.location) == ("2022-10-07_A_PM1", "A")
    assert recording.classes.tolist() == [AgentClass.BUS, AgentClass.CAR]
    bus = recording.track(0)
    np.testing.assert_allclose(bus[0, :2], (101.0, 74.0), atol=0.01)
    np.testing.assert_allclose(bus[:, 2], np.pi / 2, atol=1e-3)
    np.testing.assert_allclose(bus[:, 3], 10.0, atol=0.05)
    assert recording.start_hour == pytest.approx(17 + 52 / 60 + 13 / 3600)
    assert recording.weekday == "friday"
    assert len(recording.road_map.lanes) == 0
    assert any("no map" in line for line in recording.road_map.repairs)


def test_a_bad_time_names_its_line(tmp_path: Path) -> None:
    path = write_geo_trax(tmp_path / "songdo")
    path.write_text(path.read_text().replace("17:52:13.500,0,1,2,170190", "noon,0,1,2,170190"))
    with pytest.raises(DataError, match=r"line 3: Timestamp is '2022-10-07 noon'"):
        open_data(tmp_path / "songdo")[0]


def test_unknown_classes_and_time_zones(tmp_path: Path) -> None:
    """Unknown numbers become `other` and are counted; several time zones are an error."""
    path = write_geo_trax(tmp_path / "songdo")
    table = pd.read_csv(path).assign(Vehicle_Class=-1)
    table.to_csv(path, index=False)
    recording = open_data(tmp_path / "songdo")[0]
    assert recording.classes.tolist() == [AgentClass.OTHER] * 2
    assert "2 tracks of the unknown class '-1' are read as 'other'" in recording.repairs
    table.loc[::2, "Timestamp"] += "+09:00"
    table.loc[1::2, "Timestamp"] += "Z"
    table.to_csv(path, index=False)
    with pytest.raises(DataError, match="Timestamp has several time zones, expected one or none"):
        open_data(tmp_path / "songdo")[0]


def coarse_times(path: Path, digits: int, columns: Sequence[str]) -> None:
    """Cuts the fractions of the seconds of time stamps, and keeps some columns."""
    table = pd.read_csv(path)
    width = len("2022-10-07 17:52:13") + (digits and digits + 1)
    table["Timestamp"] = table["Timestamp"].str[:width]
    table[list(columns)].to_csv(path, index=False)


@pytest.mark.parametrize(("digits", "seconds"), [(0, 45.0), (1, 45.0), (0, 11.0)])
def test_times_of_whole_seconds_follow_from_frames(
    tmp_path: Path, digits: int, seconds: float
) -> None:
    """10 m/s and 29.97 Hz, or 30 Hz within 11 s, which differs by 0.1 %; the guess is reported."""
    path = write_geo_trax(tmp_path / "songdo", seconds=seconds)
    exact = open_data(tmp_path / "songdo")[0]
    coarse_times(path, digits, GEO_TRAX.split(","))
    (recording,) = open_data(tmp_path / "songdo")
    rate_hz = 29.97 if seconds > 40 else 30.0
    (line,) = [line for line in recording.repairs if "a guess" in line]
    assert f"at {rate_hz:g} Hz, a guess from " in line
    np.testing.assert_allclose(recording.track(0)[:, 3], 10.0, atol=0.06)
    np.testing.assert_allclose(recording.track(0)[-1], exact.track(0)[-1], atol=0.12)
    assert len(recording.track(0)) == pytest.approx(len(exact.track(0)), abs=1)


@pytest.mark.parametrize(
    ("seconds", "without", "change", "expected"),
    [
        (20.0, "Frame_Number", {}, "and there is no column Frame_Number; expected fractions of"),
        (5.0, "", {}, r"lasts 120 frames from .* to its last change; expected at least 200"),
        (20.0, "", {"Frame_Number": 0}, "and so has Frame_Number; expected one row for each"),
    ],
)
def test_times_of_whole_seconds_without_a_rate(
    tmp_path: Path, seconds: float, without: str, change: dict[str, int], expected: str
) -> None:
    path = write_geo_trax(tmp_path / "songdo", seconds=seconds)
    coarse_times(path, 0, [name for name in GEO_TRAX.split(",") if name != without])
    pd.read_csv(path).assign(**change).to_csv(path, index=False)
    with pytest.raises(DataError, match=f"same time in several rows of a track, .*{expected}"):
        open_data(tmp_path / "songdo")[0]


def test_times_of_whole_seconds_that_no_camera_has(tmp_path: Path) -> None:
    """Every frame counts as seven: 210 Hz."""
    path = write_geo_trax(tmp_path / "songdo", seconds=20.0)
    coarse_times(path, 0, GEO_TRAX.split(","))
    table = pd.read_csv(path)
    table.assign(Frame_Number=7 * table["Frame_Number"]).to_csv(path, index=False)
    with pytest.raises(DataError, match=r"makes 210\.00 Hz, which is no camera's rate"):
        open_data(tmp_path / "songdo")[0]


@pytest.mark.data
def test_the_published_sample_of_geo_trax_is_read() -> None:
    """144 vehicles at 29.97 Hz, of which one is too short."""
    (recording,) = open_data(real_data("geo_trax"))
    assert recording.num_frames / recording.frame_rate_hz == pytest.approx(5.0, abs=0.05)
    assert len(np.unique(recording.track_ids)) >= 143
    assert 0 < np.median(np.abs(recording.states[:, 3])) < 20


def test_the_driven_area_covers_paths_and_not_what_they_surround() -> None:
    """A car on a circle of radius 20 m: the ring within 2 m of it, not the island."""
    angle = np.linspace(0, 2 * np.pi, 400)
    xy = 20 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    states = np.concatenate([xy, np.zeros((400, 2))], axis=-1).astype(np.float32)
    table = TrackTable(
        track_ids=np.array([1]),
        classes=np.array([0], dtype=np.int8),
        sizes=np.array([[4.5, 1.8]], dtype=np.float32),
        first_frames=np.array([0]),
        starts=np.array([0, 400]),
        states=states,
        repairs=(),
    )
    field = drivable_field(driven_area(table, "circle"))
    inside = field.distance_m(np.array([(20.0, 0.0), (0.0, -21.2), (13.3, 13.3)])) <= 0
    outside = field.distance_m(np.array([(0.0, 0.0), (24.0, 0.0), (0.0, 16.5)])) <= 0
    assert inside.tolist() == [True] * 3
    assert outside.tolist() == [False] * 3


def write_sind(folder: Path, *, stop_lines: bool) -> Path:
    """A tricycle and a pedestrian for 6 s at 9.99 Hz, two lights, and a map above."""
    place = folder / "Tianjin" / "8_2_1"
    place.mkdir(parents=True)
    step = 1000 / 9.99
    rows = [
        f"1,{i},{i * step:.3f},tricycle,{10 + 0.5 * i:.3f},-21.75,5,0,0,0,3,1.4" for i in range(60)
    ]
    (place / "Veh_smoothed_tracks.csv").write_text("\n".join([SIND, *rows]) + "\n")
    rows = [f"P1,{i},{i * step:.3f},pedestrian,{50 - 0.1 * i:.3f},-18,-1,0" for i in range(60)]
    head = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy"
    (place / "Ped_smoothed_tracks.csv").write_text("\n".join([head, *rows]) + "\n")
    lights = "RawFrameID,timestamp(ms),Traffic light 1,Traffic light 2"
    changes = ["-9,-300,0,1", "60,2002.0,0,3", "90,3003.0,1,0"]
    (place / "Traffic_Lights.csv").write_text("\n".join([lights, *changes]) + "\n")
    (folder / "Tianjin" / "map.osm").write_text(two_lane_road(attributes_in_degrees()))
    if stop_lines:
        (place / "stop_lines.csv").write_text("signal,x1,y1,x2,y2\n2,40,-23.5,40,-20\n")
    return folder


def test_sind_with_compressed_tables_and_several_files_of_lights(tmp_path: Path) -> None:
    """The states are those of the plain tables; the file of lights that is not read is named."""
    folder = write_sind(tmp_path / "sind", stop_lines=False)
    plain = open_data(folder)[0]
    place = folder / "Tianjin" / "8_2_1"
    for path in list(place.glob("*_smoothed_tracks.csv")):
        path.with_name(f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    (place / "Traffic_Lights_2.csv").write_bytes((place / "Traffic_Lights.csv").read_bytes())
    (recording,) = open_data(folder)
    np.testing.assert_array_equal(recording.states, plain.states)
    assert "1 other files of lights not read: Traffic_Lights_2.csv" in recording.repairs


def test_two_stop_lines_of_one_signal(tmp_path: Path) -> None:
    folder = write_sind(tmp_path / "sind", stop_lines=True)
    path = folder / "Tianjin" / "8_2_1" / "stop_lines.csv"
    path.write_text(path.read_text() + "2,50,-23.5,50,-20\n")
    with pytest.raises(DataError, match=r"line 3: a second stop line of signal 2, expected one"):
        open_data(folder)[0]


@pytest.mark.parametrize("stop_lines", [False, True])
def test_sind_is_read_with_its_lights(tmp_path: Path, stop_lines: bool) -> None:
    """Light 2 is green for 2.0 s, amber for 1.0 s, then red: frames 0 to 19, 20 to 29, 30 on."""
    (recording,) = open_data(write_sind(tmp_path / "sind", stop_lines=stop_lines))
    assert (recording.name, recording.location) == ("Tianjin/8_2_1", "Tianjin")
    assert recording.frame_rate_hz == 10.0
    assert recording.resampled_from_hz == pytest.approx(9.99, abs=0.001)
    assert recording.classes.tolist() == [AgentClass.OTHER, AgentClass.PEDESTRIAN]
    assert "1 tracks of the unknown class 'tricycle' are read as 'other'" in recording.repairs
    assert len(recording.road_map.lanes) == 2
    signals = recording.signals
    assert signals is not None
    green, amber, red = SignalState.GREEN, SignalState.AMBER, SignalState.RED
    assert signals.states[1].tolist() == [green] * 20 + [amber] * 10 + [red] * 30
    assert signals.states[0].tolist() == [red] * 30 + [green] * 30
    unplaced = 1 if stop_lines else 2
    assert any(f"{unplaced} of 2 lights have no stop line" in line for line in recording.repairs)
    assert signals.placed.tolist() == [False, stop_lines]
    scene = gather_signals([recording], np.array([25]), history=0, dt_s=1 / recording.frame_rate_hz)
    if stop_lines:
        assert scene is not None
        assert scene.states[0, :, 0].tolist() == [amber]
        np.testing.assert_array_equal(scene.stop_lines[0, 0], [(40, -23.5), (40, -20)])
    else:
        assert scene is None


def test_lights_as_in_the_release_of_sind(tmp_path: Path) -> None:
    """A first row without a time, at 29.97 frames per second: frame -60 is at -2002 ms.

    Light 2 is green from then until 2002 ms. The lights of pedestrians are left out.
    """
    folder = write_sind(tmp_path / "sind", stop_lines=False)
    place = folder / "Tianjin" / "8_2_1"
    (place / "Traffic_Lights.csv").rename(place / "TrafficLight_8_2_1.csv")
    head = "RawFrameID,timestamp(ms),Vehicle Traffic light 1,Vehicle Traffic light 2"
    rows = ["-60,,0,1,1", "60,2002.002,0,3,1", "90,3003.003,1,0,0"]
    text = "\n".join([f"{head},Pedestrian Traffic light 1", *rows]) + "\n"
    (place / "TrafficLight_8_2_1.csv").write_text(text)
    maps = folder / "Tianjin" / "Maps"
    maps.mkdir()
    (folder / "Tianjin" / "map.osm").rename(maps / "Tianjin.osm")
    (recording,) = open_data(folder)
    assert recording.signals is not None
    assert recording.signals.states[1, :20].tolist() == [SignalState.GREEN] * 20
    assert len(recording.signals.states) == 2
    assert len(recording.road_map.lanes) == 2
    for line in ("1 lights of pedestrians are left out", "have no time, which follows from"):
        assert any(line in each for each in recording.repairs)


def test_lights_that_cannot_be_read_do_not_stop_the_reading(tmp_path: Path) -> None:
    folder = write_sind(tmp_path / "sind", stop_lines=True)
    path = folder / "Tianjin" / "8_2_1" / "Traffic_Lights.csv"
    path.write_text(path.read_text().replace(",", ";"))
    (recording,) = open_data(folder)
    assert recording.signals is None
    assert any("the lights are left out" in line for line in recording.repairs)


def test_states_of_signals_hold_until_the_next_change() -> None:
    changes = SignalChanges(
        stop_lines=np.zeros((1, 2, 2)),
        time_ms=np.array([100.0, 300.0]),
        states=np.array([[1, 3]], dtype=np.int8),
    )
    assert changes.at(np.array([0.0, 99.9, 100.0, 299.0, 300.0, 900.0])).tolist() == [
        [0, 0, 1, 1, 3, 3]
    ]


def read_own(paths: tuple[Path, ...]) -> RecordingTables:
    """A car at 5 m/s along +x for 4 s at 20 Hz, whatever is in the file; `fail` fails."""
    if paths[0].read_text() == "fail":
        raise KeyError("speed")
    count = 80
    x = np.arange(count) * 0.25
    return RecordingTables(
        measurements=Measurements(
            track=np.zeros(count, dtype=np.int64),
            time_ms=np.arange(count) * 50.0,
            classes=np.zeros(count, dtype=np.int8),
            positions=np.stack([x, np.zeros(count)], axis=-1),
            heading=np.full(count, np.nan),
            sizes=np.zeros((count, 2)),
        ),
        location="here",
    )


def find_own(folder: Path) -> Iterator[FoundRecording]:
    for path in sorted(folder.glob("*.own")):
        yield FoundRecording(name=path.stem, tables=(path,), read=read_own)


def test_a_reader_of_another_package_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its exceptions are faults of its recordings; a changed file is read again."""
    monkeypatch.setattr(registry, "names", lambda _: ("levelx", "own"))
    find = registry.find
    monkeypatch.setattr(registry, "find", lambda g, n: find_own if n == "own" else find(g, n))
    monkeypatch.setattr("asp_env.data.source._FIRST", ("levelx",))
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "a.own").write_text("fail")
    (folder / "b.own").write_text("good")
    first, second = open_data(folder).files
    assert (first.name, second.name) == ("a", "b")
    recordings = open_data(folder)
    np.testing.assert_allclose(recordings[1].states[:, 3], 5.0, atol=1e-3)
    with pytest.raises(DataError, match=r"a.own: the reader .* failed \(KeyError: 'speed'\)"):
        recordings[0]
    hashes = recordings[1:].hashes()
    (folder / "b.own").write_text("other")
    assert open_data(folder)[1:].hashes() != hashes


def test_a_reader_that_fails_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_folder: Path) -> list[FoundRecording]:
        raise RuntimeError("no licence")

    write_geo_trax(tmp_path / "songdo")
    find = registry.find
    monkeypatch.setattr(registry, "find", lambda g, n: broken if n == "sind" else find(g, n))
    with pytest.warns(UserWarning, match="reader 'sind' is left out: RuntimeError: no licence"):
        assert len(open_data(tmp_path / "songdo")) == 1
