"""Frames and the frame rate from times in milliseconds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.readers.tables import Clock, read_clock
from asp_env.errors import DataError


def clock_of(*tracks: list[float]) -> Clock:
    """The clock of the times of some tracks."""
    numbers = np.repeat(np.arange(len(tracks)), [len(times) for times in tracks])
    times = np.concatenate([np.array(times, dtype=float) for times in tracks])
    return read_clock(
        numbers,
        times,
        lambda row, what: f"row {row}: " + what.format(track=numbers[row], time=times[row]),
    )


@given(
    rate=st.sampled_from([1, 5, 10, 12.5, 15, 24, 25, 29.97, 30, 50, 60, 100]),
    rounded=st.booleans(),
    begin=st.integers(-5_000, 10**7),
    frames=st.lists(st.integers(0, 3_000), min_size=1, max_size=40, unique=True),
)
def test_frames_are_recovered_from_times(
    rate: float, rounded: bool, begin: int, frames: list[int]
) -> None:
    """Whole milliseconds or not, with gaps, at any rate."""
    first = sorted(frames)
    steady = list(range(4_000, 5_500))
    times = [[begin + frame * 1000 / rate for frame in track] for track in (first, steady)]
    if rounded:
        times = [[float(round(time)) for time in track] for track in times]
    clock = clock_of(*times)
    since = np.array([*first, *steady]) - first[0]
    assert clock.frames.tolist() == since.tolist()
    assert clock.rate_hz == pytest.approx(rate, rel=2e-3)
    if rate == int(rate):
        assert clock.rate_hz == rate
    assert clock.step_s == 1 / clock.rate_hz


def test_tracks_may_have_times_of_their_own() -> None:
    """10 Hz; the second track lies between the frames of the first one and has a gap."""
    clock = clock_of([0, 100, 203, 300], [130, 230, 428, 530])
    assert clock.rate_hz == 10.0
    assert clock.frames.tolist() == [0, 1, 2, 3, 1, 2, 4, 5]
    assert clock.jittering is not None
    np.testing.assert_allclose(clock.jittering, [0, 1, 2.03, 3, 1.3, 2.3, 4.28, 5.3])


@pytest.mark.parametrize(
    ("tracks", "expected"),
    [
        ([[0], [100]], "row 0: no track has a second row, so there is no frame rate"),
        ([[0, 0.1, 0.2, 0.3]], "row 0: timestamp_ms of its rows and later rows are 0.1 apart"),
        ([[0, 1, 2, 3]], "makes 1000 Hz; expected 1 to 250 Hz"),
        ([[0, 5_000, 10_000]], "makes 0.2 Hz"),
        ([[0, 100, 200, 260, 360]], "row 3: timestamp_ms is 260.0, 60 ms after the previous time"),
        ([[0, 100, 101, 200]], "row 2: a second row of track 0 at 101.0 ms, less than a frame"),
        ([[0, 100, 200], [50, 190]], "row 3: timestamp_ms is 50.0, 50 ms after"),
        ([[0, 100, 200, 301.5 + 40, 400]], "expected multiples of 100 ms"),
    ],
)
def test_impossible_times_are_refused(tracks: list[list[float]], expected: str) -> None:
    """The error begins with the first wrong row."""
    with pytest.raises(DataError) as caught:
        clock_of(*tracks)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)
