"""Derivatives of known motions, and each comfort bound from both sides."""

from collections.abc import Callable

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.metrics.driving.comfort import comfortable, slope, window_ticks

DT_S = 0.2
Values = float | np.ndarray
TIMES_S = np.arange(-2, 3) * DT_S
"""One window; derivatives at its five ticks are exact for parabolas."""


def is_comfortable(speed_mps: Values, heading_rad: Values, *, ticks: int = 5) -> bool | None:
    """Whether a motion is comfortable; None where this is missing."""
    states = np.zeros((ticks, 4))
    states[:, 2], states[:, 3] = heading_rad, speed_mps
    metric = comfortable(states, DT_S, np.ones((), dtype=bool))
    return bool(metric.value) if metric.valid else None


@given(
    coefficients=st.tuples(*[st.floats(-9, 9)] * 3),
    dt_s=st.sampled_from([0.04, 0.1, 0.2, 0.5]),
    ticks=st.integers(25, 40),
)
def test_slope_is_exact_for_parabolas(
    coefficients: tuple[float, float, float], dt_s: float, ticks: int
) -> None:
    """The slope of c + bt + at² is b + 2at at every tick, including the ends."""
    c, b, a = coefficients
    t = np.arange(ticks) * dt_s
    rows = np.stack([c + b * t + a * t**2, 0 * t])
    expected = np.stack([b + 2 * a * t, 0 * t])
    np.testing.assert_allclose(slope(rows, dt_s), expected, atol=1e-8)


@pytest.mark.parametrize(
    ("dt_s", "ticks"),
    [
        *((0.02, 51), (0.04, 25), (0.05, 21), (0.08, 13), (0.1, 11)),
        *((0.12, 9), (0.16, 7), (0.2, 5), (0.25, 5), (0.4, 5), (1.0, 5)),
    ],
)
def test_window(dt_s: float, ticks: int) -> None:
    """The largest odd number of ticks within 1 s, and at least five."""
    assert window_ticks(dt_s) == ticks


@pytest.mark.parametrize(("bump_mps", "expected"), [(0.1, True), (8.4, True), (9.0, False)])
def test_one_outlier_is_smoothed_over_one_second(bump_mps: float, expected: bool) -> None:
    """At 25 Hz the window is 25 ticks, k = -12 … 12 with Σk² = 1300; slope weights k/(1300 dt).

    An error b at one tick causes a jerk of b/(1300 dt²) = 0.481 b: 4.04 or 4.33 m/s³; the bound is
    4.13. Over five ticks it would be b/(10 dt²), 6.25 m/s³ for 0.1 m/s.
    """
    states = np.zeros((100, 4))
    states[:, 3] = 10.0
    states[50, 3] += bump_mps
    assert bool(comfortable(states, 0.04, np.ones((), dtype=bool)).value) is expected


def test_slope_by_hand() -> None:
    """Least squares over five ticks of t = -2 … 2: the slope of |t - 1| is Σt·v/10 = 2·-3/10.

    Values 3, 2, 1, 0, 1: Σt·v = -6 - 2 + 0 + 0 + 2 = -6, so -0.6 in the middle.
    """
    found = slope(np.array([3.0, 2.0, 1.0, 0.0, 1.0]), 1.0)
    assert found[2] == pytest.approx(-0.6)


BOUNDS: dict[str, tuple[Callable[[float], tuple[Values, Values]], float, float]] = {
    "accelerating": (lambda a: (5 + a * TIMES_S, 0.0), 2.39, 2.41),
    "braking": (lambda a: (20 + a * TIMES_S, 0.0), -4.04, -4.06),
    "braking backwards": (lambda a: (-5 + a * TIMES_S, 0.0), 2.39, 2.41),
    # 10 m/s times the yaw rate
    "sideways": (lambda rate: (10.0, rate * TIMES_S), 0.488, 0.490),
    "sideways to the right": (lambda rate: (10.0, rate * TIMES_S), -0.488, -0.490),
    "yaw rate": (lambda rate: (1.0, rate * TIMES_S), 0.94, 0.96),
    "yaw acceleration": (lambda a: (1.0, 0.5 * a * TIMES_S**2), 1.92, 1.94),
    "jerk ahead": (lambda j: (10 + 0.5 * j * TIMES_S**2, 0.0), 4.12, 4.14),
    "jerk ahead, braking": (lambda j: (10 + 0.5 * j * TIMES_S**2, 0.0), -4.12, -4.14),
    # 10 m/s times the yaw acceleration
    "jerk sideways": (lambda a: (10.0, 0.5 * a * TIMES_S**2), 0.836, 0.838),
}
"""A motion, a value within its bound and one beyond it; all other bounds hold by a margin."""


@pytest.mark.parametrize("bound", BOUNDS)
def test_bounds(bound: str) -> None:
    """NuPlan's numbers: -4.05 to 2.40, 4.89 m/s²; 0.95 rad/s, 1.93 rad/s²; 4.13, 8.37 m/s³."""
    motion, within, beyond = BOUNDS[bound]
    assert is_comfortable(*motion(within)) is True
    assert is_comfortable(*motion(beyond)) is False


def test_jerk_of_both_axes() -> None:
    """4.0 m/s³ ahead and 7.3 m/s³ sideways add up to 8.32 m/s³; with 7.5 to 8.5 m/s³."""
    ahead = 80 + 0.5 * 4.0 * TIMES_S**2
    for sideways, expected in ((7.3, True), (7.5, False)):
        # the speed is within 0.5 % of 80 m/s, and so is the sideways jerk of the given one
        heading = 0.5 * sideways / 80 * TIMES_S**2
        assert is_comfortable(ahead, heading) is expected


def test_headings_are_unwrapped() -> None:
    """A step from π to -π is no turn."""
    heading = (np.pi + 0.3 * TIMES_S + np.pi) % (2 * np.pi) - np.pi
    assert np.ptp(heading) > 6
    assert is_comfortable(5.0, heading) is True


def test_one_bad_tick_is_enough() -> None:
    """One second of braking in 12 s of steady motion is detected."""
    speed = np.full(60, 15.0)
    speed[30:] -= np.minimum(np.arange(30), 5) * 1.2
    assert is_comfortable(np.full(60, 15.0), 0.0, ticks=60) is True
    assert is_comfortable(speed, 0.0, ticks=60) is False


@pytest.mark.parametrize("ticks", [0, 1, 4])
def test_motions_shorter_than_one_window_are_missing(ticks: int) -> None:
    """One window is five ticks of 0.2 s or eleven of 0.1 s."""
    assert is_comfortable(5.0, 0.0, ticks=ticks) is None
    states, mask = np.zeros((ticks + 6, 4)), np.ones((), dtype=bool)
    assert not comfortable(states, 0.1, mask).valid
    assert comfortable(np.zeros((11, 4)), 0.1, mask).valid
    several = comfortable(np.zeros((2, 3, ticks, 4)), DT_S, np.ones((2, 3), dtype=bool))
    assert several.value.shape == several.valid.shape == (2, 3)
    assert not several.valid.any()


def test_the_given_mask_is_returned() -> None:
    states = np.zeros((2, 3, 8, 4))
    mask = np.array([(True, False, True), (False, True, True)])
    metric = comfortable(states, DT_S, mask)
    assert metric.value.shape == (2, 3)
    np.testing.assert_array_equal(metric.valid, mask)
