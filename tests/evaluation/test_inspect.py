"""`asp-env inspect`: the drift of inferred actions, tables and faults."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from asp_env.cli import main
from asp_env.data.classes import AgentClass
from asp_env.data.recording import Recording
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.data.scenarios.tags import COLUMNS
from asp_env.errors import DataError
from asp_env.evaluation.inspect import Inspect, drift_m
from tests.data.levelx_files import write_folder

RATE_HZ, DT_S = 25.0, 0.2


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three recordings of 10 s with two cars and a pedestrian each, and a new cache."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))
    return write_folder(tmp_path / "folder", recordings=3)


def recording(*tracks: np.ndarray) -> Recording:
    """Cars with these states (n, 4) at 25 Hz, all from frame 0."""
    nothing = Ragged.pack([])
    lengths = [len(track) for track in tracks]
    return Recording(
        name="00",
        location="1",
        frame_rate_hz=RATE_HZ,
        num_frames=max(lengths),
        speed_limit_mps=None,
        track_ids=np.arange(len(tracks)),
        classes=np.full(len(tracks), int(AgentClass.CAR)),
        sizes=np.tile(np.array([[4.5, 1.8]], dtype=np.float32), (len(tracks), 1)),
        first_frames=np.zeros(len(tracks), dtype=np.int64),
        starts=np.concatenate([[0], np.cumsum(lengths)]),
        states=np.concatenate(tracks).astype(np.float32),
        road_map=RoadMap(
            name="empty",
            lines=nothing,
            line_types=np.zeros(0, dtype=np.int64),
            drivable=nothing,
            lanes=nothing,
            successors=np.zeros((0, 2), dtype=np.int64),
        ),
    )


def straight(speed_mps: float, sideways_mps: float = 0.0) -> np.ndarray:
    """20 s along +x, with a speed to the left that heading and speed do not show."""
    time = np.arange(500) / RATE_HZ
    full = np.full_like(time, speed_mps)
    return np.stack([speed_mps * time, sideways_mps * time, np.zeros_like(time), full], axis=-1)


def test_straight_tracks_do_not_drift() -> None:
    """Constant speed, also backwards and zero, is reproduced to a millimetre."""
    cars = recording(straight(8.0), straight(-2.0), straight(0.0))
    metres, moves = drift_m(cars, np.arange(3), np.full(3, 15), dt_s=DT_S, horizon=30)
    np.testing.assert_allclose(metres, 0.0, atol=1e-3)
    assert moves.tolist() == [True, True, False]


def test_euler_lags_behind() -> None:
    """At 1 m/s² each tick of 0.2 s is 0.5 · 1 · 0.2² = 0.02 m short: 0.3 m after 15 ticks."""
    time = np.arange(500) / RATE_HZ
    zeros = np.zeros_like(time)
    cars = recording(np.stack([5 * time + 0.5 * time**2, zeros, zeros, 5 + time], axis=-1))
    for integrator, expected_m in (("heun", 0.0), ("euler", 0.3)):
        method: Any = integrator
        metres, _ = drift_m(
            cars, np.zeros(1, int), np.full(1, 15), dt_s=DT_S, horizon=15, integrator=method
        )
        assert metres[0] == pytest.approx(expected_m, abs=1e-3)


def test_lateral_speed_is_drift() -> None:
    """1 m/s to the side is 3 m after 3 s and 6 m after 6 s."""
    cars = recording(straight(8.0, sideways_mps=1.0))
    for horizon, expected_m in ((15, 3.0), (30, 6.0)):
        metres, _ = drift_m(cars, np.zeros(1, int), np.full(1, 15), dt_s=DT_S, horizon=horizon)
        assert metres[0] == pytest.approx(expected_m, abs=1e-3)


def test_a_car_without_slip_drifts_by_centimetres() -> None:
    """The rear axle, 1.35 m behind the centre, follows a circle of 15 m: under 5 cm in 6 s.

    Heading and speed are those of the rear axle, as for any car that does not skid.
    """
    angle = 5.0 / 15.0 * np.arange(500) / RATE_HZ
    rear = 15.0 * np.stack([np.sin(angle), -np.cos(angle)], axis=-1)
    ahead = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    slip = math.atan(1.35 / 15.0)
    centre = rear + 1.35 * ahead
    speed = np.full_like(angle, 5.0 / math.cos(slip))
    heading = (angle + math.pi) % (2 * math.pi) - math.pi
    cars = recording(np.column_stack([centre, heading, speed]))
    metres, moves = drift_m(cars, np.zeros(1, int), np.full(1, 15), dt_s=DT_S, horizon=30)
    assert metres[0] < 0.05
    assert moves.all()


def test_no_snippets() -> None:
    none = np.zeros(0, dtype=np.int64)
    metres, moves = drift_m(recording(straight(1.0)), none, none, dt_s=DT_S, horizon=15)
    assert len(metres) == len(moves) == 0


def test_tables(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Rows, classes, snippets, lanes and drivable area, without faults.

    In 250 frames (50 ticks) the cars have ticks 0-49 and 1-49. Snippets are at every third tick:
    15, 18, … 33 (7) and 18, … 33 (6) for 3+3 s; 15, 18 and 18 for 3+6 s.
    """
    assert main(["inspect", str(folder)]) == 0
    out = capsys.readouterr().out
    row = next(line for line in out.splitlines() if line.startswith("│ 00"))
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells[:3] == ["00", "1", "Mon 8:00"]
    assert cells[3:9] == ["25", "10.0", "747", "3", "2 car, 1 pedestrian", "0"]
    assert cells[9:] == ["100", "13", "3", "no"]
    row = next(line for line in out.splitlines() if line.startswith("│ location1"))
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells[:4] == ["location1", "2", "0", "3"]
    assert float(cells[4]) == pytest.approx(120 * 7, rel=0.02)
    assert "Repairs: none" in out
    assert "Faults: none" in out


def test_scenarios_by_tag(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Both cars of each recording drive from 3 s or 3.2 s to 9.8 s, with two other agents."""
    assert main(["inspect", str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split("│")[1].strip(): line.split("│")[2:-1] for line in lines if "│" in line}
    cells = {name: [cell.strip() for cell in row] for name, row in rows.items()}
    assert cells["all"][:2] == ["6", "6.7"]  # medians of 6.8 and 6.6 s
    assert cells["all"][5:8] == ["2.0", "2.0", "2.0"]  # density, agents, max_density
    assert cells["straight"] == cells["all"]
    assert cells["standing-start"] == ["0", *"-" * len(COLUMNS)]


def test_repairs_are_listed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "data" / "01_tracks.csv"
    rows = pd.read_csv(path)
    rows[(rows["trackId"] != 1) | (rows["frame"] != 100)].to_csv(path, index=False)
    Inspect(data=str(folder)).run()
    out = capsys.readouterr().out
    assert "Repairs: 1" in out
    assert "recording 01: 1 gaps in tracks' frames, split there: 1 after frame 99" in out


def test_all_faults_are_listed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two of three recordings are bad: the row of the good one, both faults, one error line."""
    (folder / "data" / "00_tracks.csv").write_text("")
    (folder / "data" / "02_recordingMeta.csv").unlink()
    with pytest.raises(DataError, match=r"2 of 3 recordings cannot be read \(00, 02\)"):
        Inspect(data=str(folder)).run()
    out = capsys.readouterr().out
    assert "│ 01" in out
    assert "Faults: 2" in out
    assert "00_tracks.csv: is empty" in out
    assert "02_recordingMeta.csv: no such file" in out


def test_a_bad_map_is_a_fault_of_all_its_recordings(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The faults are listed, and the command ends with status 2."""
    next(folder.rglob("*.osm")).write_text("<osm/>")
    assert main(["inspect", str(folder)]) == 2
    printed = capsys.readouterr()
    assert "Faults: 3" in printed.out
    assert printed.err.count("\n") == 1
