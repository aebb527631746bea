"""Recordings of every reader are resampled to the tick: tracks, signals and maps fit each other."""

from pathlib import Path

import numpy as np
import pytest

from asp_env.data.recording import frames_per_tick
from asp_env.data.signals import SignalState
from asp_env.data.source import open_data, open_readable
from asp_env.errors import AspEnvError, DataError, LeftOutWarning
from tests.data.interaction_files import attributes_in_degrees
from tests.data.levelx_files import two_lane_road, write_folder

SIND = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,yaw_rad,heading_rad,length,width"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty cache."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))


def write_sind(folder: Path, *, y_m: float = -21.75, subtype: str = "road") -> Path:
    """A car at 5 m/s along +x for 6 s at 9.99 Hz; a light turns green at frame 30 of the file."""
    place = folder / "Tianjin" / "8_2_1"
    place.mkdir(parents=True)
    step_ms = 1000 / 9.99
    lines = [
        f"1,{i},{i * step_ms:.3f},car,{10 + 5 * i / 9.99:.4f},{y_m},5,0,0,0,4,1.8"
        for i in range(60)
    ]
    (place / "Veh_smoothed_tracks.csv").write_text("\n".join([SIND, *lines]) + "\n")
    lights = f"RawFrameID,timestamp(ms),Traffic light 1\n0,0,0\n30,{30 * step_ms:.3f},1\n"
    (place / "Traffic_Lights.csv").write_text(lights)
    (place / "stop_lines.csv").write_text("signal,x1,y1,x2,y2\n1,40,-23.5,40,-20\n")
    text = two_lane_road(attributes_in_degrees()).replace("v='road'", f"v='{subtype}'")
    (folder / "Tianjin" / "map.osm").write_text(text)
    return folder


def write_geo_trax(folder: Path) -> Path:
    """A car at 10 m/s along +y for 5 s at 29.97 Hz, whose id needs more than 64 bits."""
    folder.mkdir(parents=True)
    columns = "Vehicle_ID,Timestamp,Local_X,Local_Y,Vehicle_Class,Vehicle_Length,Vehicle_Width"
    lines = [columns] + [
        f"{2**70},2022-10-07 17:52:{13.5 + i / 29.97:06.3f},170201,{532274 + 10 * i / 29.97:.4f},"
        "0,5.2,2.2"
        for i in range(150)
    ]
    (folder / "2022-10-07_A_PM1.csv").write_text("\n".join(lines) + "\n")
    return folder


def write_cases(folder: Path, *, subtype: str = "road") -> Path:
    """Two cases of INTERACTION 1.2 at 10 Hz: a car on the lower and one on the upper lane."""
    (folder / "maps").mkdir(parents=True)
    text = two_lane_road(attributes_in_degrees()).replace("v='road'", f"v='{subtype}'")
    (folder / "maps" / "Road.osm").write_text(text)
    lines = ["case_id,track_id,timestamp_ms,agent_type,x,y,psi_rad,length,width"] + [
        f"{case}.0,1,{100 * i},car,{x + speed * i / 10:.3f},{y},,4.5,1.8"
        for case, x, y, speed in ((1, 10, -21.75, 8), (2, 90, -18.25, -8))
        for i in range(1, 41)
    ]
    (folder / "Road_train.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize(("dt_s", "rate_hz"), [(0.2, 10.0), (0.12, 1 / 0.12), (0.1, 10.0)])
def test_sind_is_resampled_with_its_lights(tmp_path: Path, dt_s: float, rate_hz: float) -> None:
    """At each new frame the light is that of the nearest frame of the file."""
    (recording,) = open_data(write_sind(tmp_path / "sind"), dt_s=dt_s)
    assert recording.frame_rate_hz == pytest.approx(rate_hz, rel=1e-8)
    assert recording.resampled_from_hz == pytest.approx(9.99, abs=1e-3)
    assert frames_per_tick(recording.frame_rate_hz, dt_s) == round(dt_s * rate_hz)
    time_s = np.arange(recording.num_frames) / rate_hz
    np.testing.assert_allclose(recording.track(0)[:, 0], 10 + 5 * time_s, atol=0.01)
    assert recording.signals is not None
    of_file = np.round(time_s * 9.99)
    expected = np.where(of_file >= 30, SignalState.GREEN, SignalState.RED)
    assert recording.signals.states[0].tolist() == expected.tolist()
    assert any("resampled to" in line for line in recording.repairs)


def test_geo_trax_is_resampled_and_its_ids_are_numbered(tmp_path: Path) -> None:
    (recording,) = open_data(write_geo_trax(tmp_path / "songdo"))
    assert (recording.frame_rate_hz, recording.track_ids.tolist()) == (30.0, [0])
    assert recording.resampled_from_hz == pytest.approx(29.97, abs=1e-2)
    time_s = np.arange(recording.num_frames) / 30
    np.testing.assert_allclose(recording.states[:, 1], 74 + 10 * time_s, atol=0.02)
    assert any(str(2**70) in line for line in recording.repairs)


def test_cases_are_resampled_separately(tmp_path: Path) -> None:
    folder = write_cases(tmp_path / "cases")
    for _ in range(2):  # from the files, then from the cache
        first, second = open_data(folder, dt_s=0.12)
        assert first.frame_rate_hz == second.frame_rate_hz == pytest.approx(1 / 0.12)
        assert first.resampled_from_hz == second.resampled_from_hz == 10.0
        np.testing.assert_allclose(first.states[:, 1], -21.75, atol=0.01)
        np.testing.assert_allclose(second.states[:, 1], -18.25, atol=0.01)


def test_cases_share_a_map_whose_lanes_any_of_them_uses(tmp_path: Path) -> None:
    """Lanelets of an unlisted subtype are roads, since vehicles of one case or another use them."""
    folder = write_cases(tmp_path / "cases", subtype="own")
    first, second = open_data(folder)
    assert first.road_map is second.road_map
    assert len(first.road_map.lanes) == 2


def test_a_map_of_sind_has_the_lanes_that_vehicles_use(tmp_path: Path) -> None:
    (recording,) = open_data(write_sind(tmp_path / "sind", subtype="own"))
    assert len(recording.road_map.lanes) == 1
    assert any("vehicles drive along them" in line for line in recording.road_map.repairs)


def test_a_map_of_sind_of_another_place_is_refused(tmp_path: Path) -> None:
    folder = write_sind(tmp_path / "sind", y_m=900.0)
    with pytest.raises(DataError, match=r"map.osm: is the map of another place than recording"):
        open_data(folder)[0]


def test_positions_in_millimetres_are_refused(tmp_path: Path) -> None:
    folder = write_geo_trax(tmp_path / "songdo")
    path = next(folder.iterdir())
    lines = path.read_text().splitlines()
    lines[9] = lines[9].replace(",170201,", ",1702010,")
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match=r"track 0 at \d+ ms: x is .* from the median"):
        open_data(folder)[0]


def test_recordings_too_coarse_for_the_tick_are_left_out(tmp_path: Path) -> None:
    """10 Hz are too few frames for ticks of 0.04 s; 25 Hz are not."""
    folder = write_folder(tmp_path / "data")
    write_sind(folder / "sind")
    with pytest.warns(LeftOutWarning, match=r"1 of 2 recordings cannot be used .* too short"):
        recordings = open_readable(folder, dt_s=0.04)
    assert recordings.names == ("00",)
    assert recordings.dt_s == 0.04
    with pytest.raises(AspEnvError, match="too short"):
        open_readable(folder / "sind", dt_s=0.04)
