"""Rank correlations and inversions, compared with numbers by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.errors import AspEnvError
from asp_env.evaluation.rank_agreement import Inversion, MetricColumn, rank_agreement

METHODS = ("a", "b", "c", "d")


def _column(name: str, values, groups=(0, 1), *, higher_is_better: bool = True) -> MetricColumn:
    """Each value is that of a method in both of two recordings, unless it is a row of its own."""
    table = np.array([np.broadcast_to(value, len(groups)) for value in values], dtype=float)
    return MetricColumn(
        name=name, higher_is_better=higher_is_better, values=table, groups=np.array(groups)
    )


def test_one_exchanged_pair_of_four():
    """Orders a b c d and a c b d: rho = 1 - 6 · 2 / (4 · 15) = 0.8, tau = (5 - 1) / 6 = 2/3."""
    (found,) = rank_agreement(
        METHODS,
        [_column("FDE", (1, 2, 3, 4), higher_is_better=False), _column("score", (9, 7, 8, 6))],
    )
    assert (found.first, found.second) == ("FDE", "score")
    assert found.spearman.value == pytest.approx(0.8)
    assert found.kendall.value == pytest.approx(2 / 3)
    assert found.inversions == (Inversion(better_by_first="b", better_by_second="c", share=1.0),)
    assert (found.spearman.low, found.spearman.high) == pytest.approx((0.8, 0.8))
    assert found.spearman.n == 4


def test_ties_share_a_rank():
    """Ranks 1, 2.5, 2.5, 4 and 1, 2, 3, 4: rho = 4.5 / sqrt(4.5 · 5), tau-b = 5 / sqrt(5 · 6)."""
    (found,) = rank_agreement(METHODS, [_column("x", (1, 2, 2, 3)), _column("y", (1, 2, 3, 4))])
    assert found.spearman.value == pytest.approx(4.5 / np.sqrt(4.5 * 5))
    assert found.kendall.value == pytest.approx(5 / np.sqrt(30))
    assert found.inversions == ()


def test_all_pairs_of_columns_are_compared():
    columns = [_column(name, (1, 2, 3, 4)) for name in ("x", "y", "z")]
    found = rank_agreement(METHODS, columns)
    assert [(each.first, each.second) for each in found] == [("x", "y"), ("x", "z"), ("y", "z")]
    assert all(each.spearman.value == each.kendall.value == 1.0 for each in found)


def test_inversions_that_depend_on_the_recording_have_a_share():
    """`b` leads `a` by 3 in one recording and trails it by 1 in the other.

    It is ahead unless a resample contains the second recording twice, one in four; the other metric
    always prefers `a`.
    """
    score = _column("score", [(0, 1), (3, 0)])
    (found,) = rank_agreement("ab", [_column("x", (2, 1)), score])
    (inversion,) = found.inversions
    assert (inversion.better_by_first, inversion.better_by_second) == ("a", "b")
    assert inversion.share == pytest.approx(0.75, abs=0.03)
    assert (found.kendall.low, found.kendall.high) == (-1.0, 1.0)


def test_columns_may_have_different_samples():
    """Snippets of three recordings and scenarios of two; undefined values do not count."""
    fde = _column("FDE", [(1, 1, np.nan, 1), (2, 9, 0, 2)], groups=("p", "q", "q", "r"),
                  higher_is_better=False)  # fmt: skip
    score = _column("score", [(5, 5), (4, 4)], groups=("q", "p"))
    (found,) = rank_agreement("ab", [fde, score])
    assert found.kendall.value == 1.0
    assert found.inversions == ()


def test_one_recording_has_no_interval():
    columns = [_column("x", (1, 2), groups=(0, 0)), _column("y", (2, 1), groups=(0, 0))]
    (found,) = rank_agreement("ab", columns)
    assert (found.kendall.value, found.kendall.low) == (-1.0, None)
    assert found.inversions[0].share is None


def test_too_little_to_rank_is_an_error():
    with pytest.raises(AspEnvError, match="1 methods: a rank correlation needs at least two"):
        rank_agreement("a", [_column("x", (1,))])
    with pytest.raises(AspEnvError, match="b has no value of x"):
        rank_agreement("ab", [_column("x", (1, np.nan)), _column("y", (1, 2))])


@given(st.lists(st.integers(0, 9), min_size=2, max_size=6), st.data())
def test_agreement_is_symmetric_and_independent_of_the_scale(values, data):
    """Exchanged columns and monotone transforms give the same; negating one negates it."""
    others = data.draw(st.lists(st.integers(0, 9), min_size=len(values), max_size=len(values)))
    names = [str(i) for i in range(len(values))]
    x, y = _column("x", values), _column("y", others)
    scaled = _column("y", [10.0 * value + 3 for value in others])
    lower = _column("y", others, higher_is_better=False)
    (one,) = rank_agreement(names, [x, y])
    for columns, sign in (([y, x], 1), ([x, scaled], 1), ([x, lower], -1)):
        (found,) = rank_agreement(names, columns)
        for name in ("spearman", "kendall"):
            expected = sign * getattr(one, name).value
            assert getattr(found, name).value == pytest.approx(expected, nan_ok=True)
