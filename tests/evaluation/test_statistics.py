"""Bootstrap over recordings, compared with numbers by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.evaluation.statistics import (
    RESAMPLES,
    Difference,
    Estimate,
    average_runs,
    difference,
    from_sums,
    holm,
    interval,
    is_resolved,
    mean,
    ratio,
    ratio_over_runs,
    resampled_means,
    resampled_sums,
    samples_needed,
)


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


def test_runs_and_recordings_are_both_resampled():
    """Two runs with values 0 and 8 in both of two recordings, and with 0 and 4 in one of them.

    A resample has one of the runs, since R - 1 = 1 is drawn, and the mean of a run's recordings:
    the values 0, 8 and 0, 2, 4 occur, each outer one in at least a quarter of the resamples.
    """
    groups = np.array([0, 1])
    constant = interval(
        resampled_sums(np.array([[0.0, 0.0], [8.0, 8.0]]), groups)
        / resampled_sums(np.ones((1, 2)), groups),
        n=2,
    )
    assert constant == Estimate(value=4.0, low=0.0, high=8.0, n=2)
    draws = resampled_sums(np.array([[0.0, 0.0], [0.0, 4.0]]), groups)
    assert draws.shape == (1 + RESAMPLES,)
    assert draws[0] == 2.0
    assert set(draws[1:].tolist()) == {0.0, 4.0, 8.0}
    # a resample is 8 only with the second run (1/2) and the second recording twice (1/4)
    assert (draws[1:] == 8.0).mean() == pytest.approx(1 / 8, abs=0.03)


def test_a_ratio_over_runs_by_hand():
    """Runs whose values are 0 and 8 everywhere: one of them is drawn, so 0 and 8 are the bounds."""
    numerators = np.array([[0.0, 0.0], [8.0, 8.0]])
    estimate = ratio_over_runs(numerators, np.ones(2), np.array([0, 1]))
    assert estimate == Estimate(value=4.0, low=0.0, high=8.0, n=2)
    twice = ratio_over_runs(numerators, np.full((2, 2), 2.0), np.array([0, 1]))
    assert twice == Estimate(value=2.0, low=0.0, high=4.0, n=2)


def test_resamples_without_a_value_are_left_out_of_a_ratio_over_runs():
    """A quarter of the resamples has the recording without a value twice, 0 / 0."""
    estimate = ratio_over_runs(np.array([[3.0, 0.0]]), np.array([[1.0, 0.0]]), np.array(["a", "b"]))
    assert estimate == Estimate(value=3.0, low=3.0, high=3.0, n=2)


def test_a_ratio_over_runs_has_the_resamples_of_its_stream():
    """The interval is that of the quotients of `resampled_sums` with the same stream."""
    rng = np.random.default_rng(3)
    numerators, groups = rng.normal(size=(5, 12)), np.arange(12) % 6
    found = [ratio_over_runs(numerators, np.ones(12), groups, stream=k) for k in range(3)]
    for stream, estimate in enumerate(found):
        sums = resampled_sums(numerators, groups, stream=stream)
        draws = sums / resampled_sums(np.ones((1, 12)), groups)
        expected = interval(draws, n=12)
        assert (estimate.value, estimate.low, estimate.high) == pytest.approx(
            (expected.value, expected.low, expected.high)
        )
    assert found[0] == ratio_over_runs(numerators, np.ones(12), groups)
    assert len({estimate.low for estimate in found}) == 3


def test_the_variance_over_runs_is_unbiased():
    """Runs of 1, 2 and 6 have a sample variance of 7: the squared error of their mean is 7 / 3."""
    values = np.tile([1.0, 2.0, 6.0], (1 + RESAMPLES, 1))
    draws = average_runs(values)
    assert draws[0] == 3.0
    assert draws[1:].var() == pytest.approx(7 / 3, rel=0.07)  # 2 standard errors


def test_equal_runs_are_one_run():
    """Also bit for bit; the interval is that of one run."""
    rng = np.random.default_rng(0)
    values, groups = rng.normal(size=30), np.arange(30) % 5
    one = interval(resampled_sums(values[None], groups), n=30)
    three = interval(resampled_sums(np.tile(values, (3, 1)), groups), n=30)
    assert (three.value, three.low, three.high) == pytest.approx((one.value, one.low, one.high))


def test_runs_of_different_methods_are_independent():
    """With different streams; the variance of a difference is the sum of both variances."""
    values = np.tile([1.0, 2.0, 6.0], (1 + RESAMPLES, 1))
    one, other = average_runs(values, stream=1), average_runs(values, stream=2)
    assert (one[1:] - other[1:]).var() == pytest.approx(14 / 3, rel=0.07)
    assert (average_runs(values, stream=1) == one).all()


def test_one_recording_has_no_resamples():
    """Neither over recordings nor over runs."""
    draws = resampled_sums(np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([7, 7]))
    assert draws.tolist() == [5.0]
    found = difference(draws, n=2)
    assert (found.mde, found.p) == (None, None)
    assert not is_resolved(5.0, None, None, None)


def test_a_difference_by_hand():
    """Draws with a standard deviation of 1: MDE 2.8, and p of 1.96 is 5 %."""
    draws = np.concatenate([[1.959964], np.tile([0.0, 2.0], RESAMPLES // 2)])
    found = difference(draws, n=100)
    assert found.mde == pytest.approx(2.8, rel=1e-3)
    assert found.p == pytest.approx(0.05, rel=1e-2)
    assert found.estimate.n == 100


def test_a_difference_that_never_varies():
    """Equal methods have p = 1 and are not resolved; a constant difference is certain."""
    equal = difference(np.zeros(1 + RESAMPLES), n=9)
    assert (equal.mde, equal.p) == (0.0, 1.0)
    assert not is_resolved(0.0, 0.0, 0.0, 0.0)
    constant = difference(np.full(1 + RESAMPLES, 0.5), n=9)
    assert (constant.mde, constant.p) == (0.0, 0.0)
    assert is_resolved(0.5, 0.5, 0.5, 0.0)


def test_resolved_needs_both_the_interval_and_the_effect():
    assert is_resolved(0.03, 0.01, 0.05, 0.028)
    assert is_resolved(-0.03, -0.05, -0.01, 0.028)
    assert not is_resolved(0.03, 0.001, 0.06, 0.042)  # an interval above 0, less than the MDE
    assert not is_resolved(0.03, -0.001, 0.05, 0.028)  # the MDE, but 0 in the interval


def test_text_of_estimates_and_differences():
    estimate = Estimate(value=0.5, low=0.25, high=0.75, n=4)
    assert f"{estimate:.2f}" == "0.50 [0.25, 0.75]"
    assert f"{Estimate(value=0.5, low=None, high=None, n=4):+.1f}" == "+0.5"
    resolved = Difference(estimate=estimate, mde=0.4, p=0.01)
    assert f"{resolved:+.2f}" == "+0.50 [+0.25, +0.75]"
    assert f"{Difference(estimate=estimate, mde=0.6, p=0.04):+.1f}" == (
        "+0.5 [+0.2, +0.8], not resolved (smallest that could be seen 0.6)"
    )
    alone = Difference(estimate=Estimate(value=-1.0, low=None, high=None, n=1), mde=None, p=None)
    assert f"{alone:+.1f}" == "-1.0, not resolved"


def test_means_are_ratios_of_sums():
    values, groups = np.array([[1.0, 2.0, 6.0], [3.0, 2.0, 4.0]]), np.array([0, 0, 1])
    means = resampled_means(values, groups)
    assert means[0] == 3.0
    # Resamples draw both groups once, or one of the groups twice, with equal shares of the runs or
    # one run alone: all lie between the least and the largest group mean of a run.
    assert means.min() == 1.5
    assert means.max() == 6.0


def test_samples_needed_by_hand():
    """A difference of a third of the MDE needs nine times the samples; one of 0 has no number."""
    assert samples_needed(0.01, 0.03, 100) == 900
    assert samples_needed(-0.02, 0.03, 10) == 23
    assert samples_needed(0.0, 0.03, 10) is None


def test_needed_samples_resolve_the_difference():
    """With n recordings of unit variance, the MDE is 2.8 / sqrt(n): 0.28 needs 100 recordings."""
    rng = np.random.default_rng(5)
    values = rng.normal(size=25)
    values = (values - values.mean()) / values.std(ddof=1) + 0.28
    found = difference(resampled_sums(values[None], np.arange(25)) / 25, n=25)
    assert found.mde is not None
    needed = samples_needed(found.estimate.value, found.mde, 25)
    assert needed == pytest.approx(100, rel=0.1)


def test_holm_by_hand():
    """Of four tests, in order of size: 4 · 0.005, 3 · 0.01, 2 · 0.03, then at least as much."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([0.5, 0.125, 0.125]) == [0.5, 0.375, 0.375]  # equal values stay equal
    assert holm([]) == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
def test_holm_preserves_order_and_lies_between_p_and_bonferroni(p_values):
    adjusted = holm(p_values)
    for p, found in zip(p_values, adjusted, strict=True):
        assert p <= found <= min(1.0, p * len(p_values)) + 1e-12 or found == pytest.approx(
            max(min(1.0, q * len(p_values)) for q in p_values if q <= p)
        )
    order = np.argsort(p_values, kind="stable")
    assert (np.diff(np.array(adjusted)[order]) >= 0).all()
