"""Ticks as whole numbers of frames, and durations as whole numbers of ticks."""

import math
import re

import hypothesis.strategies as st
import pytest
from hypothesis import given

from asp_env.data.recording import DEFAULT_DT_S, frames_per_tick, ticks
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
    ("rate_hz", "dt_s", "nearby"),
    [
        (24.0, 0.2, "0.125, 0.166667, 0.208333, 0.25, 0.291667"),  # 4.8 frames: 3 to 7 of them
        (25.0, 0.1, "0.04, 0.08, 0.12, 0.16, 0.2"),  # 2.5 frames: 1 to 5 of them
        (10.0, 0.05, "0.1, 0.2, 0.3"),  # half a frame: 1 to 3 of them
    ],
)
def test_other_time_steps_are_rejected_with_suggestions(
    rate_hz: float, dt_s: float, nearby: str
) -> None:
    with pytest.raises(AspEnvError) as caught:
        frames_per_tick(rate_hz, dt_s)
    assert str(caught.value) == (
        f"time step {dt_s:g} s does not divide recordings of {rate_hz:g} Hz: "
        f"choose one of {nearby}, … s"
    )


@given(rate_hz=st.floats(1, 240), dt_s=st.floats(0.01, 2))
def test_suggested_time_steps_are_accepted(rate_hz: float, dt_s: float) -> None:
    try:
        frames = frames_per_tick(rate_hz, dt_s)
    except AspEnvError as error:
        listed = re.findall(r"[\d.]+(?=,)", str(error).partition("choose one of")[2])
        assert len(listed) >= 3
        counts = [frames_per_tick(rate_hz, float(step)) for step in listed]
        assert counts == list(range(counts[0], counts[0] + len(counts)))
    else:
        assert frames / rate_hz == pytest.approx(dt_s, rel=2e-4)


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
