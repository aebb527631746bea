"""Snippets: counts by hand, and laws on generated recordings."""

from dataclasses import dataclass

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.strategies import DrawFn

from asp_env.data.classes import AgentClass
from asp_env.data.recording import Recording
from asp_env.data.snippets import (
    find_snippets,
    gather_future,
    gather_scene,
    gather_window,
    index_snippets,
)
from asp_env.errors import AspEnvError
from tests.builders import Drive, make_recording

CAR = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 5.0))


def spanning(first: int, last: int, *, kind: AgentClass = AgentClass.CAR) -> Drive:
    """An agent that is present from one frame to another of a recording at 10 Hz."""
    start = (0.0, 0.0, 0.0, 5.0)
    return Drive(kind=kind, start=start, appears_s=first / 10, leaves_s=last / 10)


@dataclass(frozen=True, slots=True, kw_only=True)
class Traffic:
    """Agents that appear and leave in a recording of 20 s."""

    rate_hz: float
    drives: tuple[Drive, ...]

    def recording(self) -> Recording:
        return make_recording(drives=self.drives, frame_rate_hz=self.rate_hz)


@st.composite
def generated_traffic(draw: DrawFn) -> Traffic:
    """Up to five agents, some of them not predicted or parked, at any usual frame rate."""
    kinds = st.sampled_from([AgentClass.CAR, AgentClass.OTHER, AgentClass.BICYCLE])
    rate_hz = draw(st.sampled_from([10.0, 15.0, 25.0, 30.0]))
    drives = []
    for _ in range(draw(st.integers(1, 5))):
        first = draw(st.integers(0, round(18 * rate_hz)))
        last = draw(st.integers(first + 1, round(20 * rate_hz)))
        drives.append(
            Drive(
                kind=draw(kinds),
                start=(0.0, 0.0, 0.0, draw(st.sampled_from([0.0, 5.0]))),
                appears_s=first / rate_hz,
                leaves_s=last / rate_hz,
            )
        )
    return Traffic(rate_hz=rate_hz, drives=tuple(drives))


def test_counted_by_hand() -> None:
    """20 s are ticks 0 to 100, of which 15, 18, …, 84 have 15 ticks before and after: 24.

    Six vehicles are always present. The motorcycle is present from tick 20 to 70 and has snippets
    at 36, 39, …, 54: 7. The pedestrian, the bicycle and the parked car have none.
    """
    index = index_snippets([make_recording()], dt_s=0.2, horizon_s=3.0)
    assert len(index) == 6 * 24 + 7
    counts = np.bincount(index.track, minlength=10)
    assert counts.tolist() == [24, 24, 24, 24, 24, 24, 7, 0, 0, 0]
    assert index.tick[index.track == 6].tolist() == [36, 39, 42, 45, 48, 51, 54]


def test_counted_by_hand_with_a_horizon_of_6_s() -> None:
    """The last tick is 69: 19 snippets per vehicle; the motorcycle has those at 36 and 39."""
    index = index_snippets([make_recording()], dt_s=0.2, horizon_s=6.0)
    assert np.bincount(index.track, minlength=10).tolist() == [19] * 6 + [2, 0, 0, 0]


@pytest.mark.parametrize(
    ("first", "last", "ticks"),
    [
        (0, 60, [15]),
        (0, 59, []),  # one frame short of tick 30
        (1, 60, []),  # the first whole tick is 1, and 15 is not 15 ticks later
        (1, 68, [18]),  # 16 to 19
        (6, 66, [18]),
        (0, 66, [15, 18]),
    ],
)
def test_partial_ticks_at_both_ends_do_not_count(first: int, last: int, ticks: list[int]) -> None:
    """At 10 Hz tick k is frame 2k."""
    recording = make_recording(drives=(spanning(first, last), CAR), frame_rate_hz=10.0)
    track, tick = find_snippets(recording, dt_s=0.2, history=15, horizon_ticks=15, interval_ticks=3)
    assert tick[track == 0].tolist() == ticks


def test_snippets_are_sorted_by_recording_tick_and_track() -> None:
    index = index_snippets([make_recording(), make_recording()], dt_s=0.2, horizon_s=3.0)
    keys = np.stack([index.recording, index.tick, index.track], axis=-1).tolist()
    assert keys == sorted(keys)
    assert (index.history, index.horizon_ticks, index.dt_s) == (15, 15, 0.2)


@settings(max_examples=20)
@given(traffic=generated_traffic(), horizon_s=st.sampled_from([1.0, 3.0, 6.0]))
def test_targets_are_present_at_all_ticks_and_predicted(traffic: Traffic, horizon_s: float) -> None:
    recording = traffic.recording()
    index = index_snippets([recording], dt_s=0.2, horizon_s=horizon_s)
    assert (index.tick % 3 == 0).all()
    assert recording.predicted[index.track].all()
    scene, future = gather_scene([recording], index), gather_future([recording], index)
    assert scene.predictable.all()
    assert future.valid.all()
    assert future.states.shape == (len(index), round(horizon_s * 5), 4)


@settings(max_examples=20)
@given(traffic=generated_traffic())
def test_no_snippet_is_left_out(traffic: Traffic) -> None:
    """Every third tick for which a target is present from 5 ticks before to 5 ticks after."""
    recording = traffic.recording()
    track, tick = find_snippets(recording, dt_s=0.2, history=5, horizon_ticks=5, interval_ticks=3)
    stride = round(recording.frame_rate_hz / 5)
    expected = [
        (now, number)
        for now in range(0, 100, 3)
        for number in np.flatnonzero(recording.predicted)
        if recording.first_frames[number] <= (now - 5) * stride
        and recording.last_frames[number] >= (now + 5) * stride
    ]
    assert list(zip(tick.tolist(), track.tolist(), strict=True)) == expected


def test_select_by_rows_and_by_mask() -> None:
    index = index_snippets([make_recording()], dt_s=0.2, horizon_s=3.0)
    some = index.select(np.array([5, 2]))
    assert some.tick.tolist() == index.tick[[5, 2]].tolist()
    assert some.track.tolist() == index.track[[5, 2]].tolist()
    mask = index.track == 6
    assert len(index.select(mask)) == mask.sum()
    assert (some.history, some.horizon_ticks, some.dt_s) == (15, 15, 0.2)


def test_window() -> None:
    """Ticks -1, 0 and 1 of cars that appear at frames 0 and 2 of 10 Hz."""
    recording = make_recording(drives=(CAR, spanning(2, 50)), frame_rate_hz=10.0, duration_s=5.0)
    states, valid = gather_window(recording, np.array([0, 1]), first_tick=-1, num_ticks=3, stride=2)
    assert valid.tolist() == [[False, True, True], [False, False, True]]
    np.testing.assert_allclose(states[0, :, 0], [0, 0, 1], atol=1e-6)  # 5 m/s · 0.2 s
    np.testing.assert_allclose(states[:, :, 3], [[0, 5, 5], [0, 0, 5]], atol=1e-6)


def test_future_starts_one_tick_ahead() -> None:
    """At tick 15 of a car at 5 m/s, step 0 is at 16 m and step 14 at 30 m."""
    recording = make_recording(drives=(CAR,), frame_rate_hz=10.0)
    index = index_snippets([recording], dt_s=0.2, horizon_s=3.0).select(np.array([0]))
    future = gather_future([recording], index)
    np.testing.assert_allclose(future.states[0, :, 0], np.arange(16, 31), atol=1e-4)


def test_no_snippets() -> None:
    """Recordings without snippets, and no recordings at all, give an empty index."""
    parked = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 0.0))
    for recordings in ([make_recording(drives=(parked,))], []):
        index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
        assert len(index) == 0
        assert len(gather_scene(recordings, index).targets) == 0
        assert len(gather_future(recordings, index).states) == 0


def test_unsuitable_time_steps_are_rejected() -> None:
    """Ticks must be whole frames, and the history and the interval whole ticks."""
    recording = make_recording(frame_rate_hz=10.0, duration_s=8.0)
    with pytest.raises(AspEnvError, match="does not divide recordings of 10 Hz"):
        index_snippets([recording], dt_s=0.25, horizon_s=3.0, interval_s=0.5)
    with pytest.raises(AspEnvError, match=r"0\.6 s is no whole number of ticks of 0\.5 s"):
        index_snippets([recording], dt_s=0.5, horizon_s=3.0)


def test_parked_agents_are_targets_if_asked_for() -> None:
    """The parked car is there for ticks 0 to 100: it has a snippet at each of 15, 18, …, 84."""
    recordings = [make_recording()]
    (parked,) = np.flatnonzero(recordings[0].parked)
    without = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    both = index_snippets(recordings, dt_s=0.2, horizon_s=3.0, parked=True)
    rows = both.track == parked
    assert both.tick[rows].tolist() == list(range(15, 86, 3))
    for column in ("recording", "track", "tick"):
        np.testing.assert_array_equal(getattr(both, column)[~rows], getattr(without, column))
    assert gather_scene(recordings, both).predictable.all()
