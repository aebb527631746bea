"""Bootstrap over recordings, compared with numbers by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.evaluation.statistics import Estimate, from_sums, mean, ratio


def test_two_recordings_by_hand():
    """Recordings with means 1 (of 3 samples) and 5 (of 1 sample).

    A resample with the first one twice has the mean 1, with each once 2, with the second twice 5.
    The first and the last case have a probability of 1/4, so they are the outer quantiles.
    """
    estimate = mean(np.array([1.0, 1.0, 1.0, 5.0]), np.array([0, 0, 0, 1]))
    assert estimate == Estimate(value=2.0, low=1.0, high=5.0, n=4)


def test_a_paired_ratio_by_hand():
    """Half as large in every recording: the interval has no width, however recordings differ."""
    groups = np.array([0, 1, 2, 2])
    reference = np.array([1.0, 10.0, 100.0, 3.0])
    estimate = ratio(0.5 * reference, reference, groups)
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((0.5, 0.5, 0.5))


def test_a_ratio_is_of_sums():
    """(1 + 3) / (2 + 2) is 1; the interval lies between the ratios 1/2 and 3/2."""
    estimate = ratio(np.array([1.0, 3.0]), np.array([2.0, 2.0]), np.array([0, 1]))
    assert (estimate.value, estimate.low, estimate.high) == (1.0, 0.5, 1.5)


def test_any_function_of_sums():
    """The product of two sums: (1 + 2)(3 + 4) = 21; either one twice, 2 · 6 = 12 and 4 · 8 = 32."""
    parts = np.array([(1.0, 3.0), (2.0, 4.0)])
    estimate = from_sums(parts, np.array([0, 1]), lambda sums: sums[..., 0] * sums[..., 1])
    assert estimate == Estimate(value=21.0, low=12.0, high=32.0, n=2)


def test_one_recording_has_no_interval():
    estimate = mean(np.arange(1000.0), np.zeros(1000))
    assert estimate == Estimate(value=499.5, low=None, high=None, n=1000)


def test_groups_may_have_any_names():
    """Names instead of numbers, in any order, give the same."""
    values = np.array([1.0, 4.0, 2.0, 8.0])
    by_name = mean(values, np.array(["b", "a", "b", "c"]))
    assert by_name == mean(values, np.array([1, 0, 1, 2]))


@given(
    st.lists(st.floats(-100, 100), min_size=4, max_size=40),
    st.integers(2, 8),
)
def test_intervals_lie_within_the_group_means_and_repeat(values, groups):
    given_values = np.array(values)
    group = np.arange(len(values)) % groups
    estimate = mean(given_values, group)
    assert estimate == mean(given_values, group)
    means = [given_values[group == g].mean() for g in np.unique(group)]
    assert estimate.value == pytest.approx(given_values.mean(), abs=1e-9)
    assert estimate.low is not None
    assert estimate.high is not None
    assert min(means) - 1e-9 <= estimate.low <= estimate.high <= max(means) + 1e-9


def test_coverage_of_a_known_mean():
    """Twenty recordings of standard normal means: about 95 % of the intervals contain 0.

    With 20 groups, 92.4 % are expected for percentile intervals; the bounds are 4 standard errors
    of 500 repetitions away.
    """
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(500):
        estimate = mean(rng.normal(size=20), np.arange(20))
        assert estimate.low is not None
        assert estimate.high is not None
        covered += estimate.low <= 0 <= estimate.high
    assert 0.88 < covered / 500 < 0.97
