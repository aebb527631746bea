"""The temperature of logits whose temperature is known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from predictors.inference.calibration import (
    LIMITS,
    cross_entropy,
    fit_logistic,
    fit_temperature,
)


def samples(scale: float, count: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    """Logits that are `scale` times too large, and modes drawn with the true probabilities."""
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 1.5, (count, 3))
    best = (logits + rng.gumbel(size=logits.shape)).argmax(axis=1)
    return (scale * logits).astype(np.float32), best


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_temperature_is_the_scale_of_the_logits(scale: float) -> None:
    assert fit_temperature(*samples(scale)) == pytest.approx(scale, rel=0.025)


@given(shift=st.floats(-5, 5), temperature=st.floats(*LIMITS))
def test_no_other_temperature_has_a_lower_cross_entropy(shift: float, temperature: float) -> None:
    """The fitted temperature is the best, also after a shift of all logits."""
    logits, best = samples(2.0, count=200)
    fitted = fit_temperature(logits, best)
    lowest = cross_entropy(logits + np.float32(shift), best, fitted)
    assert lowest <= cross_entropy(logits, best, temperature) + 1e-6


def test_cross_entropy_by_hand() -> None:
    """Logits 2 ln 3 and 0 at temperature 2 give 3/4 and 1/4: (ln 4/3 + ln 4) / 2."""
    logits = np.array([[2 * math.log(3), 0.0]] * 2)
    expected = (math.log(4 / 3) + math.log(4)) / 2
    assert cross_entropy(logits, np.array([0, 1]), 2.0) == pytest.approx(expected)


def test_degenerate_logits() -> None:
    """Without samples or with one mode: 1. Always right or always wrong: the limits."""
    assert fit_temperature(np.zeros((0, 3)), np.zeros(0, dtype=np.int64)) == 1
    assert fit_temperature(np.zeros((4, 1)), np.zeros(4, dtype=np.int64)) == 1
    logits = np.array([[3.0, 0.0]] * 4)
    assert LIMITS[0] <= fit_temperature(logits, np.zeros(4, dtype=np.int64)) < 0.1
    assert fit_temperature(logits, np.ones(4, dtype=np.int64)) == pytest.approx(20, rel=1e-3)


@pytest.mark.parametrize(("slope", "shift"), [(1.0, 0.0), (0.5, 1.0), (2.0, -1.0)])
def test_logistic_fit_finds_the_slope_and_the_shift(slope: float, shift: float) -> None:
    """Outcomes drawn with the probabilities of slope · logit + shift."""
    rng = np.random.default_rng(1)
    logits = rng.normal(0, 2, 20_000)
    outcomes = rng.random(20_000) < 1 / (1 + np.exp(-(slope * logits + shift)))
    assert fit_logistic(logits, outcomes) == pytest.approx((slope, shift), abs=0.06)


def test_logistic_fit_of_few_samples_stays_near_the_identity() -> None:
    """Without samples it is the identity; separable outcomes do not let it diverge."""
    assert fit_logistic(np.zeros(0), np.zeros(0, dtype=bool)) == (1.0, 0.0)
    slope, shift = fit_logistic(np.array([-4.0, 5.0]), np.array([False, True]))
    assert 1.0 <= slope < 1.2
    assert abs(shift) < 0.1
