"""Resampling of recordings whose frame rate fits no tick, against known motions."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.readers.layout import TrackTable
from asp_env.data.readers.resampling import at_times, resample
from asp_env.data.source import open_data
from asp_env.envs.replay import ReplayEnv
from asp_env.errors import AspEnvError
from asp_env.evaluation.open_loop.evaluate import Evaluate, evaluate
from tests.data import interaction_files, levelx_files
from tests.real_data import real_data

RATES_HZ = (29.97, 12.0, 12.5, 9.99, 24.0, 59.94, 119.88, 7.0)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))


def table_of(*tracks: np.ndarray, first_frames: tuple[int, ...] | None = None) -> TrackTable:
    """A table of tracks with these states, without accelerations."""
    lengths = [len(track) for track in tracks]
    return TrackTable(
        track_ids=np.arange(len(tracks)),
        classes=np.zeros(len(tracks), dtype=np.int8),
        sizes=np.ones((len(tracks), 2), dtype=np.float32),
        first_frames=np.array(first_frames or [0] * len(tracks)),
        starts=np.concatenate([[0], np.cumsum(lengths)]),
        states=np.concatenate(tracks).astype(np.float32),
        repairs=(),
    )


def braking(time_s: np.ndarray) -> np.ndarray:
    """States at 12 m/s and -1.5 m/s² in the direction 0.3 rad."""
    along = 12.0 * time_s - 0.75 * time_s**2
    x, y = along * np.cos(0.3), along * np.sin(0.3)
    return np.stack([x, y, np.full_like(x, 0.3), 12.0 - 1.5 * time_s], axis=-1)


def circling(time_s: np.ndarray) -> np.ndarray:
    """States at 10 m/s on a circle of 20 m, 0.5 rad/s, beginning at 3 rad: the heading wraps."""
    angle = 3.0 + 0.5 * time_s
    x, y = 20.0 * np.sin(angle), -20.0 * np.cos(angle)
    heading = np.arctan2(np.sin(angle), np.cos(angle))
    return np.stack([x, y, heading, np.full_like(x, 10.0)], axis=-1)


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize("first", [0, 7])
def test_constant_acceleration_is_exact(rate_hz: float, first: int) -> None:
    """All but single precision: positions to 0.01 mm, headings and speeds to 1e-6."""
    frames = first + np.arange(int(5 * rate_hz))
    table = table_of(braking(frames / rate_hz), first_frames=(first,))
    found = resample(table, rate_hz, 20.0)
    times_s = (found.first_frames[0] + np.arange(len(found.states))) / 20.0
    assert times_s[0] - 1 / 20 < frames[0] / rate_hz <= times_s[0] + 1e-9
    assert times_s[-1] - 1e-9 <= frames[-1] / rate_hz < times_s[-1] + 1 / 20
    np.testing.assert_allclose(found.states[:, :2], braking(times_s)[:, :2], atol=1e-5)
    np.testing.assert_allclose(found.states[:, 2:], braking(times_s)[:, 2:], atol=3e-6)


@pytest.mark.parametrize(("rate_hz", "within_m"), [(9.99, 1e-4), (29.97, 1e-5), (59.94, 1e-5)])
def test_a_circle(rate_hz: float, within_m: float) -> None:
    """The error of positions falls with the cube of the frame; headings stay on the short way."""
    found = resample(table_of(circling(np.arange(int(9 * rate_hz)) / rate_hz)), rate_hz, 25.0)
    expected = circling(np.arange(len(found.states)) / 25.0)
    inner = slice(3, -3)
    error_m = np.hypot(*(found.states[inner, :2] - expected[inner, :2]).T)
    assert error_m.max() < within_m
    turned = np.angle(np.exp(1j * (found.states[:, 2] - expected[:, 2])))
    assert np.abs(turned).max() < 1e-6
    assert (found.states[:, 3] == 10.0).all()


@given(
    steps=st.lists(st.floats(0.6, 1.4), min_size=2, max_size=20),
    acceleration=st.floats(-3, 3),
    shares=st.lists(st.floats(0, 1), min_size=1, max_size=10),
)
def test_polynomials_of_degree_2_are_exact_at_any_spacing(
    steps: list[float], acceleration: float, shares: list[float]
) -> None:
    """Also between the first and the last two rows; a row itself is found to the last bit.

    A time that is within a millionth of a row is that of the row.
    """
    times = np.concatenate([[0.0], np.cumsum(steps)])
    values = (1.0 + 2.0 * times + 0.5 * acceleration * times**2)[:, None]
    wanted = np.sort(np.array(shares)) * times[-1]
    expected = 1.0 + 2.0 * wanted + 0.5 * acceleration * wanted**2
    np.testing.assert_allclose(at_times(values, times, wanted)[:, 0], expected, atol=1e-5)
    np.testing.assert_array_equal(at_times(values, times, times), values)


def test_frames_that_coincide_are_unchanged() -> None:
    """12.5 to 25 Hz: every second frame is a row of the file, to the last bit."""
    states = np.random.default_rng(0).normal(size=(40, 4)).astype(np.float32)
    states[:, 2] = np.clip(states[:, 2], -3, 3)
    found = resample(table_of(states), 12.5, 25.0)
    assert len(found.states) == 79
    np.testing.assert_array_equal(found.states[::2, [0, 1, 3]], states[:, [0, 1, 3]])
    np.testing.assert_allclose(found.states[::2, 2], states[:, 2], atol=3e-7)


def test_a_reversed_heading_is_no_rotation() -> None:
    """A heading that jumps by 180° with the sign of the speed is that of the nearer row."""
    states = np.array([[0, 0, 0.1, 2], [1, 0, 0.1 - np.pi, -2], [2, 0, 0.1 - np.pi, -2]])
    found = resample(table_of(states), 5.0, 20.0)
    np.testing.assert_allclose(found.states[:3, 3], [2, 2, 2])
    np.testing.assert_allclose(found.states[3:, 3], -2)
    np.testing.assert_allclose(found.states[:, 0], np.arange(9) / 4, atol=1e-6)


def test_tracks_between_two_frames_are_left_out_and_reported() -> None:
    """At 12 Hz row 1 is at 83 ms, between the frames of 10 Hz at 0 and 100 ms."""
    found = resample(table_of(np.zeros((9, 4)), np.zeros((1, 4)), first_frames=(0, 1)), 12.0, 10.0)
    assert found.track_ids.tolist() == [0]
    assert found.repairs == (
        "12 Hz resampled to 10 Hz",
        "1 tracks between two frames of 10 Hz: 1",
    )


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_recordings_of_any_rate_can_be_opened(tmp_path: Path, rate_hz: float) -> None:
    """The sine of `track_rows` is followed, accelerations too, and the frame rates are stated."""
    frames = np.arange(int(6 * rate_hz))
    levelx_files.write_recording(
        tmp_path,
        rate_hz=rate_hz,
        classes=["car"],
        tracks=levelx_files.track_rows(0, frames, rate_hz),
    )
    levelx_files.write_map(tmp_path)
    recordings = open_data(tmp_path)
    recording = recordings[0]
    assert recording.frame_rate_hz % 5 == 0
    assert recording.resampled_from_hz == rate_hz
    assert recordings.resampled() == {"00": {"from_hz": rate_hz, "to_hz": recording.frame_rate_hz}}
    assert f"{rate_hz:g} Hz resampled to {recording.frame_rate_hz:g} Hz" in recording.repairs
    assert recording.duration_s == pytest.approx(6.0, abs=2 / min(rate_hz, 10))
    times = np.arange(len(recording.states)) / recording.frame_rate_hz
    y, speed_y = -20.0 + np.sin(0.4 * times), 0.4 * np.cos(0.4 * times)
    np.testing.assert_allclose(recording.states[:, 0], 5.0 + 4.0 * times, atol=1e-4)
    np.testing.assert_allclose(recording.states[:, 1], y, atol=1e-4)
    np.testing.assert_allclose(recording.states[:, 3], np.hypot(4.0, speed_y), atol=1e-4)
    along = -0.16 * np.sin(0.4 * times) * speed_y / np.hypot(4.0, speed_y)
    assert recording.accelerations is not None
    np.testing.assert_allclose(recording.accelerations, along, atol=2e-4)


def test_commands_and_environments_use_any_tick(tmp_path: Path) -> None:
    """Cars at 29.97 Hz: an environment with ticks of 0.1 s, and the manifest of `evaluate`."""
    frames = np.arange(int(10 * 29.97))
    rows = levelx_files.track_rows(0, frames, 29.97)
    data = tmp_path / "data"
    levelx_files.write_recording(data, rate_hz=29.97, classes=["car"], tracks=rows)
    levelx_files.write_map(data)
    env = ReplayEnv(str(data), dt_s=0.1)
    env.reset(seed=0)
    rewards = [env.step(np.zeros(2, dtype=np.float32))[1] for _ in range(3)]
    assert np.isfinite(rewards).all()
    result = evaluate(
        Evaluate(
            data=str(data), out=tmp_path / "out", predictors=("constant-velocity",), planner="none"
        )
    )
    assert result.manifest["resampled"] == {"00": {"from_hz": 29.97, "to_hz": 30.0}}


def test_recordings_that_fit_are_not_resampled(tmp_path: Path) -> None:
    """25 Hz with ticks of 0.2 and 0.04 s; with ticks of 0.1 s it is read at 30 Hz."""
    levelx_files.write_folder(tmp_path)
    recorded, fine, other = (open_data(tmp_path, dt_s=dt_s) for dt_s in (0.2, 0.04, 0.1))
    assert (recorded[0].frame_rate_hz, recorded[0].resampled_from_hz) == (25.0, None)
    np.testing.assert_array_equal(recorded[0].states, fine[0].states)
    assert recorded.resampled() == {}
    assert (other[0].frame_rate_hz, other[0].resampled_from_hz) == (30.0, 25.0)
    assert other.subset([0])[0] is other[0]
    with pytest.raises(AspEnvError, match=r"0\.025 s is too short for recordings of 25 Hz: choose"):
        open_data(tmp_path, dt_s=0.025)[0]
    assert recorded.data_hash() == other.data_hash()
    coinciding = other[0].track(0)[::6], recorded[0].track(0)[::5]  # every 0.2 s
    np.testing.assert_array_equal(coinciding[0][:, :2], coinciding[1][:, :2])


def test_gaps_stay_gaps(tmp_path: Path) -> None:
    """Ten frames are missing at 29.97 Hz: 334 ms in which neither part has a frame."""
    frames = np.array([*range(60), *range(70, 150)])
    levelx_files.write_recording(
        tmp_path, rate_hz=29.97, classes=["car"], tracks=levelx_files.track_rows(4, frames, 29.97)
    )
    levelx_files.write_map(tmp_path)
    recording = open_data(tmp_path)[0]
    assert len(recording) == 2
    assert recording.last_frames[0] / 30 <= 59 / 29.97
    assert recording.first_frames[1] / 30 >= 70 / 29.97
    assert recording.first_frames[1] - recording.last_frames[0] == 12


def jittering(
    off_ms: float, *, seconds: float, step_ms: float = 100.0
) -> tuple[np.ndarray, np.ndarray]:
    """Times in ms with uniform jitter, and the states of `braking` from (10, -21.75) along x."""
    rng = np.random.default_rng(1)
    times_ms = np.arange(0.0, 1000.0 * seconds, step_ms)
    times_ms[1:] += rng.uniform(-off_ms, off_ms, len(times_ms) - 1)
    states = braking(times_ms / 1000)
    states[:, 0] = 10.0 + np.hypot(*states[:, :2].T)
    states[:, 1], states[:, 2] = -21.75, 0.0
    return times_ms, states


@pytest.mark.parametrize(
    ("off_ms", "step_ms", "to_hz"), [(3.0, 100.0, 10.0), (12.0, 100.0, 10.0), (4.0, 33.37, 30.0)]
)
def test_jittering_times(tmp_path: Path, off_ms: float, step_ms: float, to_hz: float) -> None:
    """Positions are those at the whole frames: 3 ms at 12 m/s would be an error of 36 mm.

    Up to 3 mm and 0.05 m/s are the smoother's at the ends of a braking track, without jitter too.
    """
    times_ms, states = jittering(off_ms, seconds=6.0, step_ms=step_ms)
    vehicles = interaction_files.rows(1, states)
    vehicles["timestamp_ms"] = times_ms
    interaction_files.write_recording(tmp_path, vehicles=vehicles)
    interaction_files.write_map(tmp_path)
    recording = open_data(tmp_path)[0]
    assert recording.frame_rate_hz == to_hz
    assert recording.resampled_from_hz == pytest.approx(1000 / step_ms, rel=2e-3)
    assert any("ms off frames of" in line for line in recording.repairs)
    times = (recording.first_frames[0] + np.arange(len(recording.states))) / to_hz
    expected = 10.0 + 12.0 * times - 0.75 * times**2
    np.testing.assert_allclose(recording.states[:, 0], expected, atol=4e-3)
    np.testing.assert_allclose(recording.states[:, 3], 12.0 - 1.5 * times, atol=0.05)


def test_tracks_with_times_of_their_own(tmp_path: Path) -> None:
    """Each has its phase and jitter, 5 m/s: all positions are those at the common frames."""
    rng = np.random.default_rng(2)
    tables = []
    for track, phase_ms in enumerate((0.0, 31.0, 66.0)):
        times_ms = phase_ms + 100.0 * np.arange(60) + rng.uniform(-4, 4, 60) * (track > 0)
        table = interaction_files.rows(track, np.zeros((60, 4)))
        table["timestamp_ms"], table["y"], table["vx"] = times_ms, -21.75, 5.0
        table["x"] = 5.0 + 20.0 * track + 5.0 * times_ms / 1000
        tables.append(table)
    interaction_files.write_recording(tmp_path, vehicles=pd.concat(tables))
    interaction_files.write_map(tmp_path)
    recording = open_data(tmp_path)[0]
    assert (recording.frame_rate_hz, len(recording)) == (10.0, 3)
    assert any("ms off frames of 10 Hz" in line for line in recording.repairs)
    for track in range(3):
        states = recording.track(track)
        times = (recording.first_frames[track] + np.arange(len(states))) / 10
        np.testing.assert_allclose(states[:, 0], 5.0 + 20.0 * track + 5.0 * times, atol=1e-3)
        np.testing.assert_allclose(states[:, 3], 5.0, atol=1e-2)


def test_9_99_hz_without_jitter(tmp_path: Path) -> None:
    """Times of 100.1 ms are no jitter of 10 Hz: 100 frames later they are 10 ms late."""
    times_ms = np.arange(200) * 1000 / 9.99
    vehicles = interaction_files.rows(1, np.zeros((200, 4)))
    vehicles["timestamp_ms"] = times_ms
    vehicles["x"], vehicles["y"], vehicles["vx"] = 5.0 + 5.0 * times_ms / 1000, -21.75, 5.0
    interaction_files.write_recording(tmp_path, vehicles=vehicles)
    interaction_files.write_map(tmp_path)
    recording = open_data(tmp_path)[0]
    assert recording.frame_rate_hz == 10.0
    assert recording.resampled_from_hz == pytest.approx(9.99)
    assert recording.repairs == ("9.99 Hz resampled to 10 Hz",)
    expected = 5.0 + 0.5 * np.arange(len(recording.states))
    np.testing.assert_allclose(recording.states[:, 0], expected, atol=1e-4)


def test_a_real_recording_at_half_its_rate() -> None:
    """Every second frame at 5 Hz, resampled to 10 Hz, is near the recorded frames."""
    recorded = open_data(real_data("karlsruhe"))[0]
    track = int(np.diff(recorded.starts).argmax())
    states = recorded.track(track)
    found = resample(table_of(states[::2]), 5.0, 10.0).states
    error_m = np.hypot(*(found[:, :2] - states[: len(found), :2]).T)
    assert np.median(error_m) < 0.01
    assert np.quantile(error_m, 0.99) < 0.1


def test_a_recording_without_a_track_that_lasts_a_frame(tmp_path: Path) -> None:
    """The only row is at 83 ms, between the frames at 0 and 100 ms."""
    rows = levelx_files.track_rows(0, np.array([1]), 12.0)
    levelx_files.write_recording(tmp_path, rate_hz=12.0, classes=["car"], tracks=rows)
    levelx_files.write_map(tmp_path)
    with pytest.raises(ValueError, match=r"00_tracks.csv: no track lasts a frame of 10 Hz"):
        open_data(tmp_path)[0]
