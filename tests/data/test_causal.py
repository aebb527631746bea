"""Causal histories: no dependence on the future, bounded noise, and a delay known from theory."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float

from asp_env.data import cache, causal
from asp_env.data.causal import causal_histories, causal_states
from asp_env.data.classes import AgentClass
from asp_env.data.recording import Recording
from asp_env.data.scene import infer_actions
from asp_env.data.snippets import gather_future, gather_scene, index_snippets
from asp_env.errors import DataError
from asp_env.geometry import wrap_angle
from tests.builders import DRIVES, Drive, make_recording

REAR_M = 1.35
"""Rear axle of a car of 4.5 m."""


def filter_exact(
    measured: Float[np.ndarray, "n 3"], *, speed_mps: float, rate_hz: float = 25.0
) -> Float[np.ndarray, "n 4"]:
    """The vehicle filter on exact measurements."""
    states = np.empty((len(measured), 4), dtype=np.float32)
    causal.filter_vehicle(
        np.ascontiguousarray(measured, dtype=np.float64), speed_mps, REAR_M, 1 / rate_hz, states
    )
    return states.astype(np.float64)


def along_x(x_m: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Measurements of a vehicle with heading 0."""
    return np.stack([x_m, np.zeros_like(x_m), np.zeros_like(x_m)], axis=-1)


def standing_cars(count: int) -> Recording:
    """Cars that stand for 20 s."""
    drive = Drive(kind=AgentClass.CAR, start=(3.0, 4.0, 0.5, 0.0))
    return make_recording(drives=(drive,) * count)


def with_states(recording: Recording, states: Float[np.ndarray, "rows 4"]) -> Recording:
    """The same recording with other states."""
    return dataclasses.replace(recording, states=states.astype(np.float32))


@settings(max_examples=10)
@given(frame=st.integers(-1, 250), seed=st.integers(0, 99))
def test_states_do_not_depend_on_later_frames(frame: int, seed: int) -> None:
    """Changes after a frame change no bit of the states up to it."""
    recording = make_recording(duration_s=10.0)
    frames = np.concatenate(
        [first + np.arange(len(recording.track(i))) for i, first in
         enumerate(recording.first_frames)]
    )  # fmt: skip
    later = frames > frame
    other = recording.states.copy()
    other[later] += np.random.default_rng(seed).normal(0, 3, (later.sum(), 4))
    before, after = causal_states(recording), causal_states(with_states(recording, other))
    assert before[~later].tobytes() == after[~later].tobytes()
    assert (before[later] != after[later]).any() == later.any()


def test_tracks_are_independent() -> None:
    """A track's states are the same bits without the other tracks."""
    recording = make_recording()
    states = causal_states(recording)
    for i in range(len(recording)):
        alone = dataclasses.replace(
            recording,
            track_ids=recording.track_ids[i : i + 1],
            classes=recording.classes[i : i + 1],
            sizes=recording.sizes[i : i + 1],
            first_frames=recording.first_frames[i : i + 1],
            starts=np.array([0, len(recording.track(i))]),
            states=recording.track(i),
        )
        rows = slice(recording.starts[i], recording.starts[i + 1])
        assert causal_states(alone).tobytes() == states[rows].tobytes()


def test_noise_depends_on_names_and_track_ids() -> None:
    """The same recording gives the same bits; another name, location or track id other noise."""
    recording = make_recording()
    states = causal_states(recording)
    assert states.tobytes() == causal_states(make_recording()).tobytes()
    for change in (
        {"name": "01"},
        {"location": "elsewhere"},
        {"track_ids": recording.track_ids + 100},
    ):
        other = causal_states(dataclasses.replace(recording, **change))
        for i in range(len(recording)):
            rows = slice(recording.starts[i], recording.starts[i + 1])
            assert (states[rows] != other[rows]).any()


def test_measurements_have_the_documented_noise() -> None:
    """A track's first state is its first measurement: errors of 0.08 m and 1.5°."""
    recording = standing_cars(500)
    firsts = recording.starts[:-1]
    error = causal_states(recording)[firsts] - recording.states[firsts]
    assert error[:, :2].std() == pytest.approx(0.08, rel=0.08)
    assert np.degrees(error[:, 2].std()) == pytest.approx(1.5, rel=0.08)
    assert abs(error[:, :3].mean(axis=0)).max() < 0.01


@pytest.mark.parametrize("rate_hz", [10.0, 25.0, 30.0])
def test_the_speed_settles_on_a_straight_path(rate_hz: float) -> None:
    """At 10 m/s, with 9 measured, the error is below 0.12 m/s after 1 s and below 1e-3 after 5 s.

    Without noise the position is then right to 1 mm.
    """
    time_s = np.arange(0, 10, 1 / rate_hz)
    states = filter_exact(along_x(10 * time_s), speed_mps=9.0, rate_hz=rate_hz)
    error = abs(states[:, 3] - 10)
    assert error[0] == pytest.approx(1.0)
    assert error[time_s >= 1].max() < 0.12
    assert error[time_s >= 5].max() < 1e-3
    assert abs(states[time_s >= 5, 0] - 10 * time_s[time_s >= 5]).max() < 1e-3


@pytest.mark.parametrize("rate_hz", [10.0, 25.0, 30.0])
def test_delay_after_a_step_of_acceleration(rate_hz: float) -> None:
    """The speed lags behind a step of 2 m/s² as the theory of the third-order filter predicts.

    White jerk of density q = 2 σ² / τ = 2 · 1² / 2 and position noise of density r = 0.08² dt
    give poles of size w = (q / r)^(1/6), 3.97 rad/s at 25 Hz. The error of the speed is
    (s + 2w) / ((s + w)(s² + w s + w²)) times the step: at most 0.446 m/s, 0.39 s after it.
    """
    w = (1 / (0.08**2 / rate_hz)) ** (1 / 6)
    poles = np.array([-w, *(w * np.exp([2j * math.pi / 3, -2j * math.pi / 3]))])
    slopes = 3 * poles**2 + 4 * w * poles + 2 * w**2
    after_s = np.linspace(0, 3, 301)
    theory = 2 * ((poles + 2 * w) / slopes * np.exp(poles * after_s[:, None])).sum(axis=-1).real
    time_s = np.arange(0, 8, 1 / rate_hz)
    true = 8 + 2 * np.clip(time_s - 4, 0, None)
    distance = 8 * time_s + np.clip(time_s - 4, 0, None) ** 2
    lag = true - filter_exact(along_x(distance), speed_mps=8.0, rate_hz=rate_hz)[:, 3]
    assert lag[time_s > 4].max() == pytest.approx(theory.max(), rel=0.05)
    assert time_s[lag.argmax()] - 4 == pytest.approx(after_s[theory.argmax()], abs=0.11)
    if rate_hz == 25.0:
        assert theory.max() == pytest.approx(0.446, abs=1e-3)
    assert lag[time_s >= 6].max() < 0.15  # the filter assumes that acceleration decays


def test_the_steering_inferred_on_a_circle() -> None:
    """6 m/s on a circle of 12 m need atan(2 tan(asin(1.35 / 12))) = 0.2227 rad of steering."""
    time_s = np.arange(0, 20, 0.04)
    slip, heading = math.asin(REAR_M / 12), 0.5 * time_s
    measured = np.stack(
        [12 * np.sin(heading + slip), -12 * np.cos(heading + slip), heading], axis=-1
    )
    states = filter_exact(measured, speed_mps=6.0)[125::5]
    known = np.ones((1, len(states)), dtype=bool)
    actions = infer_actions(states[None], known, np.array([4.5]), 0.2)[0]
    np.testing.assert_allclose(actions[:, 1], 0.2227, atol=1e-3)
    np.testing.assert_allclose(actions[:, 0], 0, atol=0.01)
    assert abs(wrap_angle(states[:, 2] - heading[125::5])).max() < math.radians(0.6)


def test_standing_cars_do_not_steer() -> None:
    """Of 40 cars that stand for 20 s no steering is inferred, and little acceleration."""
    recording = standing_cars(40)
    states = causal_states(recording).reshape(40, -1, 4)[:, 25::5].astype(np.float64)
    known = np.ones(states.shape[:2], dtype=bool)
    actions = infer_actions(states, known, recording.sizes[:, 0].astype(np.float64), 0.2)
    assert (actions[..., 1] == 0).all()
    assert np.sqrt(np.mean(actions[..., 0] ** 2)) < 0.1
    assert abs(actions[..., 0]).max() < 1.5
    assert abs(states[..., 3]).max() < 0.4
    assert np.hypot(*(states[..., :2] - [3, 4]).T).max() < 0.25
    assert abs(states[..., 2] - 0.5).max() < math.radians(3)


def test_starts_and_stops() -> None:
    """1.5 m/s² from a stand: within 0.5 m/s after 0.5 s. A vehicle that stops stands after 1 s."""
    time_s = np.arange(0, 12, 0.04)
    start = filter_exact(along_x(0.75 * np.clip(time_s - 5, 0, None) ** 2), speed_mps=0.0)
    assert abs(start[time_s < 5, 3]).max() < 1e-6
    lag = 1.5 * np.clip(time_s - 5, 0, None) - start[:, 3]
    assert lag[time_s >= 5.5].max() < 0.5
    assert lag[time_s >= 6.5].max() < 0.15
    speed = np.clip(6 - 2 * np.clip(time_s - 4, 0, None), 0, None)
    stop = filter_exact(along_x(np.cumsum(speed) * 0.04), speed_mps=6.0)
    assert stop[:, 3].min() > -0.05
    assert abs(stop[time_s >= 8, 3]).max() < 1e-2


def test_driving_backwards_has_negative_speed() -> None:
    """A car that backs up at 2 m/s has speed -2 and the recorded heading."""
    time_s = np.arange(0, 10, 0.04)
    np.testing.assert_allclose(
        filter_exact(along_x(-2 * time_s), speed_mps=-2.0)[:, 3], -2, atol=1e-3
    )
    drive = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.3, 0.0))
    recording = make_recording(drives=(drive,), duration_s=10.0)
    states = recording.states.copy()
    states[:, 0] -= 2 * time_s[-1] / 10 * np.arange(len(states)) * 0.04 * math.cos(0.3)
    states[:, 1] -= 2 * time_s[-1] / 10 * np.arange(len(states)) * 0.04 * math.sin(0.3)
    states[:, 3] = -2 * time_s[-1] / 10
    filtered = causal_states(with_states(recording, states))
    assert abs(filtered[25:, 3] - states[25:, 3]).max() < 0.7
    assert filtered[25:, 3].mean() == pytest.approx(-2, abs=0.1)
    assert abs(filtered[25:, 2] - 0.3).max() < math.radians(4)


def test_a_reversed_heading_reverses_the_speed() -> None:
    """The recorded heading turns by 180° from one frame to the next."""
    time_s = np.arange(0, 10, 0.04)
    measured = along_x(5 * time_s)
    measured[125:, 2] = math.pi
    states = filter_exact(measured, speed_mps=5.0)
    np.testing.assert_allclose(states[:125, 3], 5, atol=1e-3)
    np.testing.assert_allclose(states[125:, 3], -5, atol=1e-3)
    np.testing.assert_allclose(abs(wrap_angle(states[125:, 2] - math.pi)), 0, atol=1e-3)


@pytest.mark.parametrize("rate_hz", [10.0, 25.0, 30.0])
def test_errors_are_small_at_any_frame_rate(rate_hz: float) -> None:
    """After 1 s: positions 0.12 m, speeds 0.4 m/s, headings of vehicles 2°."""
    recording = make_recording(frame_rate_hz=rate_hz)
    states = causal_states(recording).astype(np.float64)
    for i, drive in enumerate(DRIVES):
        rows = slice(recording.starts[i] + round(rate_hz), recording.starts[i + 1])
        error = states[rows] - recording.states[rows]
        rms = np.sqrt(np.mean(error**2, axis=0))
        assert np.hypot(rms[0], rms[1]) < 0.12
        assert rms[3] < 0.4
        if drive.kind not in (AgentClass.PEDESTRIAN, AgentClass.BICYCLE):
            turned = np.sqrt(np.mean(wrap_angle(error[:, 2]) ** 2))
            assert math.degrees(turned) < 2


def test_a_standing_pedestrian_has_a_constant_heading() -> None:
    """One that walks north and stops: north to 15°."""
    walk = Drive(
        kind=AgentClass.PEDESTRIAN,
        start=(0.0, 0.0, math.pi / 2, 1.4),
        phases=((5.0, 0.0, 0.0), (1.0, -1.4, 0.0), (14.0, 0.0, 0.0)),
    )
    recording = make_recording(drives=(walk,))
    states = causal_states(recording)
    assert abs(states[25:125, 2] - math.pi / 2).mean() < math.radians(6)
    assert abs(states[200:, 2] - states[200, 2]).max() == 0
    assert abs(states[200, 2] - math.pi / 2) < math.radians(15)


@given(
    st.lists(st.sampled_from([0.0, 0.01, 1.0, 1e4]), min_size=1, max_size=8),
    st.sampled_from(sorted(AgentClass)),
)
def test_states_are_finite_after_jumps(jumps_m: list[float], kind: AgentClass) -> None:
    """Jumps of any size, and tracks of one frame."""
    drive = Drive(kind=kind, start=(0.0, 0.0, 0.0, 3.0))
    recording = make_recording(drives=(drive,), duration_s=(len(jumps_m) - 1) / 25)
    states = recording.states.copy()
    states[:, 0] += jumps_m
    states[:, 2] = wrap_angle(states[:, 2] + np.array(jumps_m) * 7)
    filtered = causal_states(with_states(recording, states))
    assert np.isfinite(filtered).all()
    assert (abs(filtered[:, 2]) <= np.float32(math.pi)).all()


def test_only_states_change() -> None:
    """All other fields of a recording are the same objects."""
    recorded = [make_recording(), make_recording(name="01", seed=1)]
    histories = causal_histories(recorded)
    assert len(histories) == 2
    for before, after in zip(recorded, histories, strict=True):
        assert after.states.shape == before.states.shape
        assert (after.states != before.states).any()
        for field in dataclasses.fields(Recording):
            if field.name != "states":
                assert getattr(after, field.name) is getattr(before, field.name)
    assert histories[-1] is histories[1]
    assert [each.name for each in histories[1:]] == ["01"]
    with pytest.raises(IndexError):
        histories[2]


def test_scenes_of_causal_histories() -> None:
    """They differ from those of the recordings only in filtered states."""
    recorded = [make_recording()]
    index = index_snippets(recorded, dt_s=0.2, horizon_s=3.0)
    scene = gather_scene(recorded, index)
    known = gather_scene(causal_histories(recorded), index)
    for field in dataclasses.fields(scene):
        if field.name not in ("states", "actions", "maps"):
            np.testing.assert_array_equal(getattr(known, field.name), getattr(scene, field.name))
    assert known.maps[0] is scene.maps[0]
    apart = np.hypot(*(known.target_states - scene.target_states)[:, :2].T)
    assert 0.01 < np.sqrt(np.mean(apart**2)) < 0.12
    future = gather_future(recorded, index)
    assert np.hypot(*(future.states[:, 0] - known.target_states)[:, :2].T).max() < 3.5


def test_states_are_cached(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit and read-only; a damaged file is replaced."""
    recording = make_recording(name="cached")
    first = causal_histories([recording])[0].states
    folder = cache.cache_folder()
    (path,) = folder.glob(f"causal-{causal._digest(recording)[:20]}.bin")
    assert first.tobytes() == causal_states(recording).tobytes()
    assert not first.flags.writeable
    path.write_bytes(path.read_bytes()[:-100])
    assert causal_histories([recording])[0].states.tobytes() == causal_states(recording).tobytes()
    monkeypatch.setattr(causal, "causal_states", lambda _: pytest.fail("filtered again"))
    assert len(causal_histories([make_recording(name="cached")])[0].states) == len(first)


def test_recordings_are_opened_and_filtered_on_access() -> None:
    opened: list[int] = []

    class Lazy(list[Recording]):
        def __getitem__(self, index: Any) -> Any:
            opened.append(index)
            return super().__getitem__(index)

    histories = causal_histories(Lazy([make_recording(), make_recording(name="01")]))
    assert (len(histories), opened) == (2, [])
    assert histories[1].name == "01"
    assert histories[1].name == "01"
    assert opened == [1]


def test_without_a_cache_one_line_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The states are the same."""

    def refuse() -> None:
        raise DataError("cache folder x: no permission to write")

    recording = make_recording()
    monkeypatch.setattr(cache, "cache_folder", refuse)
    monkeypatch.setattr(cache, "_noted", set[str]())
    states = causal_histories([recording])[0].states
    assert caplog.messages == [
        "asp-env: results are not cached: cache folder x: no permission to write"
    ]
    assert states.tobytes() == causal_states(recording).tobytes()
