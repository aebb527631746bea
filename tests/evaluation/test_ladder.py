"""Oracle share and headroom, compared with numbers by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.evaluation.ladder import (
    CONTROLS,
    headroom,
    is_under_test,
    isotonic,
    missing_controls,
    oracle_shares,
    rung,
)

SHARES = np.array([0.0, 0.25, 0.5, 0.75, 1.0])


def _share(score: float, *ladder: float) -> float:
    return float(oracle_shares(np.array([score]), np.array([ladder]), SHARES)[0])


def test_shares_between_rungs_are_interpolated():
    """Scores from 0.90 to 0.98 in equal steps: 0.93 is three eighths of the way."""
    ladder = (0.90, 0.92, 0.94, 0.96, 0.98)
    assert _share(0.93, *ladder) == pytest.approx(0.375)
    for share, score in zip(SHARES, ladder, strict=True):
        assert _share(score, *ladder) == pytest.approx(share)


def test_shares_end_at_the_ladder():
    """Below constant velocity it is 0, above the oracle 1."""
    ladder = (0.90, 0.92, 0.94, 0.96, 0.98)
    assert _share(0.5, *ladder) == 0.0
    assert _share(1.0, *ladder) == 1.0


def test_violations_are_pooled():
    """0.94 and 0.92 become 0.93 twice; a score of 0.93 has every share from 0.25 to 0.5."""
    assert isotonic(np.array([0.90, 0.94, 0.92, 0.96])) == pytest.approx([0.90, 0.93, 0.93, 0.96])
    ladder = (0.90, 0.94, 0.92, 0.96, 0.98)
    assert _share(0.93, *ladder) == pytest.approx(0.375)
    assert _share(0.915, *ladder) == pytest.approx(0.125)
    assert _share(0.945, *ladder) == pytest.approx(0.625)


def test_a_falling_ladder_is_one_level():
    """Its mean is 0.94: lower scores have the share 0, higher ones 1, equal ones the middle."""
    ladder = (0.98, 0.96, 0.94, 0.92, 0.90)
    assert isotonic(np.array(ladder)) == pytest.approx([0.94] * 5)
    assert (_share(0.93, *ladder), _share(0.95, *ladder)) == (0.0, 1.0)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=7))
def test_isotonic_regression_is_the_nearest_monotone_sequence(values):
    """The characterisation by residuals: partial sums from the left are never negative.

    At the end of every level they are 0, so that each level is the mean of its values.
    """
    given_values = np.array(values)
    fitted = isotonic(given_values)
    assert (np.diff(fitted) >= -1e-12).all()
    partial = np.cumsum(given_values - fitted)
    assert (partial >= -1e-9).all()
    ends = np.append(np.flatnonzero(np.diff(fitted) > 1e-9), len(values) - 1)
    assert partial[ends] == pytest.approx(np.zeros(len(ends)), abs=1e-9)


@given(st.lists(st.floats(0, 1), min_size=5, max_size=5), st.floats(0, 1), st.floats(0, 1))
def test_a_higher_score_has_no_lower_share(ladder, one, other):
    low, high = sorted((one, other))
    assert 0.0 <= _share(low, *ladder) <= _share(high, *ladder) <= 1.0


def test_draws_do_not_affect_each_other():
    """Each draw has its own ladder."""
    ladder = np.array([(0.90, 0.92, 0.94, 0.96, 0.98), (0.0, 0.1, 0.2, 0.3, 0.4)])
    assert oracle_shares(np.array([0.92, 0.35]), ladder, SHARES) == pytest.approx([0.25, 0.875])


def test_headroom_is_a_ratio_of_sums():
    """(0.94 - 0.92) / (0.96 - 0.92) is a half, in the sample and in every resample."""
    scores, baseline, oracle = (np.full(11, score) for score in (0.94, 0.92, 0.96))
    found = headroom(scores, baseline, oracle, n=7)
    assert (found.value, found.low, found.high, found.n) == pytest.approx((0.5, 0.5, 0.5, 7))


def test_headroom_is_not_resolved_where_the_oracle_gains_nothing():
    """The oracle's gain is 0.01, but -0.01 in a tenth of the resamples; one recording has none."""
    gains = np.array([0.01] * 10 + [-0.01])
    found = headroom(gains, np.zeros(11), gains, n=7)
    assert np.isnan(found.value)
    assert (found.low, found.high) == (None, None)
    assert np.isnan(headroom(gains[:1], np.zeros(1), gains[:1], n=7).value)


def test_rungs_are_known_by_name():
    names = (*CONTROLS, "blend:0.1", "blend:x", "blend:2", "ffw-asp:runs/0.5", "noisy-oracle:2")
    assert [rung(name) for name in names] == [
        None, 0.0, 0.25, 0.5, 0.75, 1.0, 0.1, None, None, None, None,
    ]  # fmt: skip


def test_missing_controls_are_added_once():
    assert missing_controls(["oracle", "blend:0.5", "mtp:a"]) == (
        "blind", "constant-velocity", "blend:0.25", "blend:0.75",
    )  # fmt: skip
    assert missing_controls(CONTROLS) == ()


def test_controls_and_privileged_predictors_are_not_under_test():
    assert is_under_test("mtp:a", privileged=False)
    assert not is_under_test("blind", privileged=False)
    assert not is_under_test("noisy-oracle:2", privileged=True)
    assert not is_under_test("", privileged=False)
