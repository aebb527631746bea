"""Errors of forecasts against values derived by hand."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.errors import AspEnvError
from asp_env.metrics.forecast.errors import (
    SELECTIONS,
    Selection,
    errors_over_time,
    inconsistency,
    moving,
    open_loop_errors,
    select_mode,
)
from asp_env.metrics.masked import Masked

ALONG_X = np.array([(1.0, 0.0), (2.0, 0.0), (3.0, 0.0), (4.0, 0.0)])
NAMES = {"MAE", "MSE", "ADE", "FDE", "miss", "brier-FDE"}


def errors_of(
    forecast: np.ndarray, truth: np.ndarray = ALONG_X, *, known: tuple[bool, ...] = (True,) * 4
) -> dict[str, Masked]:
    """The errors of a single mode of probability 1."""
    return open_loop_errors(
        forecast[None, None], np.zeros((1, 1)), truth[None], np.array([known]), "most-probable"
    )


def values(errors: dict[str, Masked]) -> dict[str, float]:
    """The values of one target, which must all be valid."""
    assert all(metric.valid.all() for metric in errors.values())
    return {name: float(metric.value[0]) for name, metric in errors.items()}


def test_stationary() -> None:
    """A standing forecast where 1, 2, 3, 4 m is right.

    MAE (1+2+3+4)/8, MSE (1+4+9+16)/8, ADE 10/4, FDE 4, which is over 2 m.
    """
    assert values(errors_of(0 * ALONG_X)) == pytest.approx(
        {"MAE": 1.25, "MSE": 3.75, "ADE": 2.5, "FDE": 4, "miss": 1, "brier-FDE": 4}
    )


def test_perfect_forecast_has_no_error() -> None:
    assert values(errors_of(ALONG_X)) == dict.fromkeys(NAMES, 0.0)


def test_diagonal() -> None:
    """Off by (3, 4)·k at tick k, 5k metres.

    MAE (3+4)·10/8, MSE (9+16)·30/8, ADE 5·10/4, FDE 5·4.
    """
    off = np.array([(3.0, 4.0)]) * np.arange(1, 5)[:, None]
    assert values(errors_of(ALONG_X + off)) == pytest.approx(
        {"MAE": 8.75, "MSE": 93.75, "ADE": 12.5, "FDE": 20, "miss": 1, "brier-FDE": 20}
    )


@pytest.mark.parametrize("known", [(True, False, True, True), (False,) * 4])
def test_errors_are_missing_with_an_unknown_tick(known: tuple[bool, ...]) -> None:
    errors = errors_of(ALONG_X, known=known)
    assert set(errors) == NAMES
    assert not any(metric.valid.any() for metric in errors.values())


@pytest.mark.parametrize(("end_m", "miss"), [(1.99, 0.0), (2.0, 0.0), (2.01, 1.0)])
def test_miss(end_m: float, miss: float) -> None:
    """A miss is over 2 m."""
    off = np.array([(0.0, 0.0)] * 3 + [(0.0, end_m)])
    assert values(errors_of(off, 0 * ALONG_X))["miss"] == miss


FOUR_MODES = ALONG_X + np.array([(0, 3), (0, 2), (0, 1), (0, 0)])[:, None]
"""Off by 3, 2, 1, 0 m at all ticks; the right mode is the least probable."""

FOUR_PROBABILITIES = np.array([0.4, 0.3, 0.2, 0.1])


@pytest.mark.parametrize(
    ("selection", "mode", "ade", "brier"),
    [("most-probable", 0, 3.0, 3 + 0.6**2), ("best-of-3", 2, 1.0, 1 + 0.8**2)],
)
def test_selection(selection: Selection, mode: int, ade: float, brier: float) -> None:
    """Best of 3 is the third of four modes: the fourth is right but not among the most probable."""
    log_probs, truth = np.log(FOUR_PROBABILITIES)[None], ALONG_X[None]
    assert select_mode(FOUR_MODES[None], log_probs, truth, selection) == [mode]
    known = np.ones((1, 4), dtype=bool)
    found = values(open_loop_errors(FOUR_MODES[None], log_probs, truth, known, selection))
    assert found["ADE"] == pytest.approx(ade)
    assert found["brier-FDE"] == pytest.approx(brier)


def test_best_by_final_error() -> None:
    """A mode that is off by 1 m but ends right is better than one that only ends 1 m off."""
    ends_right, ends_wrong = ALONG_X.copy(), ALONG_X.copy()
    ends_right[:3, 1] = 1
    ends_wrong[3, 1] = 1
    modes = np.stack([ends_wrong, ends_right])[None]
    log_probs = np.log([[0.5, 0.5]])
    assert select_mode(modes, log_probs, ALONG_X[None], "best-of-3") == [1]
    found = values(
        open_loop_errors(modes, log_probs, ALONG_X[None], np.ones((1, 4), bool), "best-of-3")
    )
    assert (found["ADE"], found["FDE"]) == (0.75, 0.0)


def test_best_by_mean_error() -> None:
    """By ADE the mode that ends wrong is the best, by FDE the other."""
    ends_right, ends_wrong = ALONG_X.copy(), ALONG_X.copy()
    ends_right[:3, 1] = 1
    ends_wrong[3, 1] = 1
    forecast = (np.stack([ends_right, ends_wrong])[None], np.log([[0.5, 0.5]]), ALONG_X[None])
    known = np.ones((1, 4), bool)
    found = values(open_loop_errors(*forecast, known, "best-of-3", "ade"))
    assert (found["ADE"], found["FDE"]) == (0.25, 1.0)
    over_time = errors_over_time(*forecast, known, "best-of-3", "ade", dt_s=0.25)
    assert over_time["L2@1s"].value.tolist() == [1.0]


def test_inconsistency() -> None:
    """Forecasts of 4 ticks made one tick apart share 3, off by 0, 1 and 5 m, mean 2.

    The earlier one is at 2, 3 and 4 m at the ticks 1, 2 and 3 of the later one.
    """
    later = np.array([(2.0, 0.0), (3.0, 1.0), (4.0, 5.0), (9.0, 9.0)])
    pair = np.stack([ALONG_X] * 2), np.stack([later] * 2)
    found = inconsistency(*pair, np.array([True, False]), apart=1)
    assert found.value[0] == pytest.approx(2.0)
    assert found.valid.tolist() == [True, False]
    assert not inconsistency(*pair, np.array([True, True]), apart=4).valid.any()


def test_of_equally_probable_modes_the_first_is_the_most_probable() -> None:
    log_probs = np.log([[0.25, 0.25, 0.25, 0.25]])
    modes, truth = FOUR_MODES[None], ALONG_X[None]
    assert select_mode(modes, log_probs, truth, "most-probable") == [0]
    assert select_mode(modes, log_probs, truth, "best-of-3") == [2]


@pytest.mark.parametrize("selection", SELECTIONS)
@given(
    seed=st.integers(0, 10**6), turn=st.floats(-4, 4), shift=st.tuples(*[st.floats(-99, 99)] * 2)
)
def test_errors_do_not_depend_on_order_and_pose(
    selection: Selection, seed: int, turn: float, shift: tuple[float, float]
) -> None:
    """The order of modes and of targets and the pose of the scene do not matter.

    MAE is measured along the axes and therefore changes if the scene is rotated.
    """
    rng = np.random.default_rng(seed)
    modes, truth = rng.normal(size=(6, 5, 7, 2)), rng.normal(size=(6, 7, 2))
    log_probs = np.log(rng.dirichlet(np.ones(5), size=6))
    known = rng.random((6, 7)) > 0.05
    errors = open_loop_errors(modes, log_probs, truth, known, selection)
    some, other = rng.permutation(6), rng.permutation(5)
    shuffled = open_loop_errors(
        modes[some][:, other], log_probs[some][:, other], truth[some], known[some], selection
    )
    cos, sin = math.cos(turn), math.sin(turn)
    spin = np.array([(cos, sin), (-sin, cos)])
    moved = open_loop_errors(
        modes @ spin + shift, log_probs, truth @ spin + shift, known, selection
    )
    for name, metric in errors.items():
        np.testing.assert_array_equal(shuffled[name].valid, metric.valid[some])
        np.testing.assert_allclose(shuffled[name].value, metric.value[some], atol=1e-12)
        if name != "MAE":
            np.testing.assert_allclose(moved[name].value, metric.value, atol=1e-9)


@pytest.mark.parametrize(
    ("speed", "distance_m", "known", "expected"),
    [
        (0.0, 0.0, True, False),
        (1.0, 0.0, True, False),
        (1.01, 0.0, True, True),
        (-1.01, 0.0, True, True),
        (0.0, 2.0, True, False),
        (0.0, 2.01, True, True),
        (0.0, 2.01, False, False),
    ],
)
def test_moving(speed: float, distance_m: float, known: bool, expected: bool) -> None:
    """Over 1 m/s in either direction, or over 2 m away at a known tick."""
    now = np.array([(5.0, 5.0, 0.3, speed)])
    truth = np.array([[(5.0, 5.0), (5.0, 5.0 + distance_m)]])
    assert moving(now, truth, np.array([[True, known]])) == [expected]


@pytest.mark.parametrize(
    ("dt_s", "ticks", "expected"),
    [
        (0.2, 15, {1: 5, 2: 10, 3: 15}),
        (0.04, 50, {1: 25, 2: 50}),
        (0.1, 9, {}),
        (0.3, 9, {}),
        (0.3, 20, {3: 10, 6: 20}),
        (0.4, 12, {2: 5, 4: 10}),
    ],
)
def test_errors_over_time(dt_s: float, ticks: int, expected: dict[int, int]) -> None:
    """The error at tick k is k metres; seconds that are no whole number of ticks are left out.

    The truth is known up to the tick before the last.
    """
    modes = np.zeros((1, 1, ticks, 2))
    modes[0, 0, :, 1] = np.arange(1, ticks + 1)
    truth, known = np.zeros((1, ticks, 2)), np.arange(ticks)[None] < ticks - 1
    found = errors_over_time(modes, np.zeros((1, 1)), truth, known, "most-probable", dt_s=dt_s)
    assert set(found) == {f"L2@{second}s" for second in expected}
    for second, tick in expected.items():
        assert found[f"L2@{second}s"].value.tolist() == [tick]
        assert found[f"L2@{second}s"].valid.tolist() == [tick < ticks]


@pytest.mark.parametrize(("selection", "away_m"), [("most-probable", 3.0), ("best-of-3", 1.0)])
def test_errors_over_time_are_those_of_the_selected_mode(
    selection: Selection, away_m: float
) -> None:
    """The most probable of the four modes is off by 3 m, the best of the first three by 1 m."""
    forecast = (FOUR_MODES[None], np.log(FOUR_PROBABILITIES)[None], ALONG_X[None])
    found = errors_over_time(*forecast, np.ones((1, 4), bool), selection, dt_s=0.5)
    assert {name: error.value.tolist() for name, error in found.items()} == {
        "L2@1s": [away_m],
        "L2@2s": [away_m],
    }


def test_without_targets_errors_are_empty() -> None:
    errors = open_loop_errors(
        np.zeros((0, 3, 4, 2)), np.zeros((0, 3)), np.zeros((0, 4, 2)), np.zeros((0, 4), bool),
        "best-of-3",
    )  # fmt: skip
    assert all(metric.value.shape == (0,) for metric in errors.values())


def test_only_valid_values_must_be_finite() -> None:
    value = np.array([1.0, math.nan])
    Masked(value=value, valid=np.array([True, False]))
    with pytest.raises(AspEnvError, match="not finite"):
        Masked(value=value, valid=np.array([True, True]))
