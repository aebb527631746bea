"""Tests of dense traffic, its NumPy reference, and the command `asp-env bench`."""

from pathlib import Path

import numpy as np
import pytest

from asp_env.cli import main
from asp_env.data.classes import AgentClass
from asp_env.data.source import Recordings
from asp_env.errors import AspEnvError
from asp_env.evaluation.bench import bench, stepping, timing
from asp_env.evaluation.bench.stepping import make_dense_recording, make_dense_scenarios
from asp_env.geometry import box_corners
from asp_env.metrics.boxes import ego_contacts
from tests.builders import Drive, make_recording


def test_dense_traffic_has_a_constant_number_of_vehicles(recordings: Recordings) -> None:
    """There are 7 vehicles at each of 300 frames, with states of the original recording."""
    duration_s = 300 / recordings[0].frame_rate_hz
    dense = make_dense_recording(recordings[0], agents=7, duration_s=duration_s)
    starts, _ = dense.frame_index
    assert np.diff(starts).tolist() == [7] * 300
    original = {tuple(state) for state in recordings[0].states.tolist()}
    assert {tuple(state) for state in dense.states.tolist()} <= original


def test_egos_of_dense_traffic_are_present_throughout_their_scenarios(
    recordings: Recordings,
) -> None:
    dense = make_dense_recording(recordings[0], agents=7, duration_s=12.0)
    for scenario in make_dense_scenarios(dense, count=9, start_tick=15, length=10, stride=5):
        ego = dense.track_ids.tolist().index(scenario.ego_id)
        assert dense.first_frames[ego] == 0
        assert dense.last_frames[ego] >= 125


def test_dense_traffic_needs_a_track_of_4_seconds() -> None:
    recording = make_recording(
        drives=(Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 5.0)),), duration_s=2.0
    )
    with pytest.raises(AspEnvError, match="no vehicle seen for 4 s"):
        make_dense_recording(recording, agents=2, duration_s=2.0)


def test_the_numpy_reference_finds_the_same_contacts() -> None:
    """On random boxes it agrees with `ego_contacts` for every pair."""
    rng = np.random.default_rng(0)
    states = rng.uniform(-5, 5, (50, 8, 4)).astype(np.float32)
    sizes = rng.uniform(1, 5, (50, 8, 2)).astype(np.float32)
    overlaps = stepping.overlaps_first(states, box_corners(states, sizes))
    expected = ego_contacts(states, sizes, np.ones((50, 8), dtype=bool)) > 0
    assert 0.2 < expected[:, 1:].mean() < 0.9
    np.testing.assert_array_equal(overlaps[:, 1:], expected[:, 1:])


@pytest.fixture
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduces sizes and repetitions."""
    monkeypatch.setattr(timing, "COPY_BYTES", 2**20)
    monkeypatch.setattr(timing, "REPEATS", 1)
    monkeypatch.setattr(bench, "RASTER_SIZES_PX", ((90, 60),))
    monkeypatch.setattr(bench, "SCALING_EPISODES", (1, 2))
    monkeypatch.setattr(bench, "SCALING_AGENTS", (2, 3))


@pytest.mark.usefixtures("_small")
def test_bench_prints_every_section(crossings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["bench", str(crossings), "--episodes", "2", "--agents", "3", "--envs", "2"]
    assert main(args) == 0
    output = capsys.readouterr().out
    for expected in ("raster 12x90x60", "plain NumPy, 2", "gym.make_vec of 2, vectors"):
        assert expected in output
    assert output.count("2 episodes, 3 agents") == len(stepping.TRAFFIC)


@pytest.mark.usefixtures("_small")
def test_old_names_of_sections_work_with_a_warning(
    crossings: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", str(crossings), "--sections", "drawing"]) == 0
    captured = capsys.readouterr()
    assert captured.err == "asp-env: section drawing is deprecated; use rasters\n"
    assert "raster 12x90x60" in captured.out


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--episodes", "0"], "--episodes 0: expected 1 to 65,536"),
        (["--agents", "-1"], "--agents -1: expected 1 to 1,024"),
        (["--envs", "99999999999"], "--envs 99999999999: expected 1 to 65,536"),
        (["--sections"], "--sections: none given; expected some of rasters, stepping"),
        (["--sections", "raster"], "did you mean 'rasters'"),
    ],
)
def test_bench_refuses_bad_options(
    args: list[str], message: str, crossings: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The error is one line that is printed before anything is measured."""
    assert main(["bench", str(crossings), *args]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.out == ""
