"""Ticks as whole numbers of frames, and durations as whole numbers of ticks."""

import math
import re

import hypothesis.strategies as st
import pytest
from hypothesis import given

from asp_env.data.recording import DEFAULT_DT_S, frames_per_tick, rate_for_ticks, ticks
from asp_env.errors import AspEnvError


@pytest.mark.parametrize(("rate_hz", "frames"), [(25.0, 5), (10.0, 2), (30.0, 6), (15.0, 3)])
def test_default_tick(rate_hz: float, frames: int) -> None:
    assert DEFAULT_DT_S == 0.2
    assert frames_per_tick(rate_hz) == frames


@pytest.mark.parametrize(
    ("rate_hz", "dt_s", "frames"), [(25.0, 0.04, 1), (10.0, 1.0, 10), (29.97, 1001 / 5000, 6)]
)
def test_other_ticks(rate_hz: float, dt_s: float, frames: int) -> None:
    assert frames_per_tick(rate_hz, dt_s) == frames


@pytest.mark.parametrize(
    ("rate_hz", "dt_s", "choose"),
    [
        (25.0, 0.1, "choose one of 0.04, 0.12, 0.2, 0.6 s, or open the data by "),
        (10.0, 0.05, "choose one of 0.1, 0.2, 0.3, 0.6 s"),  # half a frame: no resampling
        (29.97, 0.2, "open the data by open_data(…, dt_s=0.2), which resamples them"),
    ],
)
def test_other_time_steps_are_rejected_with_suggestions(
    rate_hz: float, dt_s: float, choose: str
) -> None:
    """3 s of history and snippets 0.6 s apart are whole numbers of the suggested time steps."""
    with pytest.raises(AspEnvError) as caught:
        frames_per_tick(rate_hz, dt_s)
    given = f"time step {dt_s:g} s does not divide recordings of {rate_hz:g} Hz: "
    assert str(caught.value).startswith(given + choose)
    assert ("open_data" in str(caught.value)) == (rate_hz != 10.0)


@given(rate_hz=st.floats(1, 240), dt_s=st.floats(0.01, 2))
def test_suggested_time_steps_work(rate_hz: float, dt_s: float) -> None:
    """Every remedy of the error is tried: time steps, and a rate that fits."""
    try:
        frames = frames_per_tick(rate_hz, dt_s)
    except AspEnvError as error:
        for step in re.findall(r"[\d.]+(?=[, ])", str(error).partition("choose one of")[2]):
            assert frames_per_tick(rate_hz, float(step)) >= 1
            assert ticks(3.0, float(step)) * float(step) == pytest.approx(3.0)
            assert ticks(0.6, float(step)) >= 1
        if "open_data" in str(error):
            assert frames_per_tick(rate_for_ticks(rate_hz, dt_s), dt_s) >= 1
    else:
        assert frames / rate_hz == pytest.approx(dt_s, rel=2e-4)
        assert rate_for_ticks(rate_hz, dt_s) == rate_hz


@pytest.mark.parametrize(
    ("rate_hz", "dt_s", "expected_hz"),
    [
        *((25.0, 0.2, 25.0), (29.97, 0.2, 30.0), (9.99, 0.2, 10.0), (59.94, 0.2, 60.0)),
        *((12.0, 0.2, 10.0), (12.5, 0.2, 15.0), (24.0, 0.2, 25.0), (24.0, 0.25, 24.0)),
        *((119.88, 0.2, 120.0), (5.0, 0.2, 5.0), (6.0, 0.2, 5.0), (4.0, 0.2, 5.0)),
        *((25.0, 0.1, 30.0), (29.97, 0.1, 30.0), (10.0, 0.12, 8.333333333)),
    ],
)
def test_the_nearest_rate_that_fits(rate_hz: float, dt_s: float, expected_hz: float) -> None:
    """Of two equally near ones the higher: 25 Hz lies between 20 and 30 Hz for ticks of 0.1 s."""
    assert rate_for_ticks(rate_hz, dt_s) == expected_hz


@given(rate_hz=st.floats(5, 120))
def test_every_rate_from_5_to_120_hz_fits(rate_hz: float) -> None:
    """The rate changes by at most half of 5 Hz, the distance of two rates that fit."""
    fitting_hz = rate_for_ticks(rate_hz, DEFAULT_DT_S)
    assert frames_per_tick(fitting_hz) >= 1
    assert abs(fitting_hz - rate_hz) <= 2.5 + 1e-9


@pytest.mark.parametrize(
    ("rate_hz", "dt_s", "choose"),
    [(10.0, 0.04, "0.075, 0.1, 0.12, 0.15, 0.2 s"), (1.0, 0.2, "at least 0.75 s")],
)
def test_ticks_far_shorter_than_frames_are_refused(
    rate_hz: float, dt_s: float, choose: str
) -> None:
    with pytest.raises(AspEnvError, match=f"too short for recordings of {rate_hz:g} Hz: choose .*"):
        rate_for_ticks(rate_hz, dt_s)
    with pytest.raises(AspEnvError, match=re.escape(choose)):
        rate_for_ticks(rate_hz, dt_s)
    assert rate_for_ticks(rate_hz, 0.75 / rate_hz) == pytest.approx(rate_hz / 0.75)


@pytest.mark.parametrize(
    ("duration_s", "dt_s", "choose"),
    [
        (3.0, 0.2002, "a time step of 0.1, 0.12, 0.15, 0.2, 0.3 s"),
        (0.5, 0.2, "0.4 or 0.6 s instead"),
    ],
)
def test_partial_ticks_are_rejected_with_suggestions(
    duration_s: float, dt_s: float, choose: str
) -> None:
    with pytest.raises(AspEnvError) as caught:
        ticks(duration_s, dt_s)
    assert str(caught.value).endswith(f"choose {choose}")


@pytest.mark.parametrize("bad", [0.0, -0.2, math.nan, math.inf])
def test_rates_and_time_steps_must_be_positive_numbers(bad: float) -> None:
    with pytest.raises(AspEnvError, match=r"time step .* expected a positive number"):
        frames_per_tick(25.0, bad)
    with pytest.raises(AspEnvError, match=r"frame rate .* expected a positive number"):
        frames_per_tick(bad)


@pytest.mark.parametrize(
    ("duration_s", "dt_s", "count"), [(3.0, 0.2, 15), (6.0, 0.2, 30), (0.6, 0.2, 3), (3.0, 0.1, 30)]
)
def test_ticks_of_a_duration(duration_s: float, dt_s: float, count: int) -> None:
    """3 s are 15 ticks of 0.2 s, although 0.2 · 15 is not exactly 3 in binary."""
    assert ticks(duration_s, dt_s) == count


@pytest.mark.parametrize(("duration_s", "dt_s"), [(0.5, 0.2), (0.1, 0.2)])
def test_partial_ticks_are_rejected(duration_s: float, dt_s: float) -> None:
    with pytest.raises(AspEnvError, match=r"no whole number of ticks of 0\.2 s"):
        ticks(duration_s, dt_s)


@pytest.mark.parametrize("bad_s", [0.0, -0.2, math.nan, math.inf])
def test_durations_must_be_positive_numbers(bad_s: float) -> None:
    with pytest.raises(AspEnvError, match="expected a positive number"):
        ticks(bad_s, 0.2)
    with pytest.raises(AspEnvError, match="expected a positive number"):
        ticks(3.0, bad_s)
