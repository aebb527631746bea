"""Calibration metrics against numbers derived by hand, and laws."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.metrics.forecast import calibration
from asp_env.metrics.forecast.calibration import (
    brier,
    calibration_error,
    calibration_sums,
    mixture_nll,
    nearest_modes,
)

ORIGIN = np.zeros((1, 2))
KNOWN = np.ones(1, dtype=bool)
LOG_2PI = math.log(2 * math.pi)


def nll(ends: list[tuple[float, float]], probabilities: list[float]) -> float:
    """The NLL of one target that ends at the origin."""
    found = mixture_nll(np.array([ends]), np.log([probabilities]), ORIGIN, KNOWN)
    assert found.valid.all()
    return float(found.value[0])


@pytest.mark.parametrize(
    ("ends", "probabilities", "expected"),
    [
        ([(0.0, 0.0)], [1.0], LOG_2PI),
        ([(3.0, 4.0)], [1.0], LOG_2PI + 12.5),
        ([(0.0, 0.0), (50.0, 0.0)], [0.25, 0.75], LOG_2PI + math.log(4)),
        ([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)], [0.5, 0.3, 0.2], LOG_2PI + 0.5),
        ([(2.0, 0.0), (0.0, 0.0)], [0.5, 0.5], LOG_2PI - math.log(0.5 + 0.5 * math.exp(-2))),
        ([(300.0, 0.0)], [1.0], LOG_2PI + 45_000),
    ],
    ids=["right", "5 m off", "a quarter right", "all 1 m off", "half right", "300 m off"],
)
def test_nll(ends: list[tuple[float, float]], probabilities: list[float], expected: float) -> None:
    """-log of the density of Gaussians of 1 m, without underflow far from them."""
    assert nll(ends, probabilities) == pytest.approx(expected)


def test_nll_of_a_target_does_not_depend_on_the_others() -> None:
    """A target that is 300 m off has 300² / 2 nats more than one that is right, side by side."""
    ends = np.array([[(0.0, 0.0)], [(300.0, 0.0)]])
    found = mixture_nll(ends, np.zeros((2, 1)), np.zeros((2, 2)), np.ones(2, dtype=bool))
    assert found.value == pytest.approx([LOG_2PI, LOG_2PI + 45_000])


@pytest.mark.parametrize("sigma_m", [1.0, 0.5])
def test_nll_is_a_density(sigma_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """exp(-NLL) over a grid of 0.25 m that covers both modes adds up to one."""
    monkeypatch.setattr(calibration, "NLL_SIGMA_M", sigma_m)
    side = np.arange(-8, 8, 0.25)
    truth = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    ends = np.tile([[(-1.0, 0.5), (2.0, -1.0)]], (len(truth), 1, 1))
    log_probs = np.tile(np.log([[0.3, 0.7]]), (len(truth), 1))
    found = mixture_nll(ends, log_probs, truth, np.ones(len(truth), dtype=bool))
    assert np.exp(-found.value).sum() * 0.25**2 == pytest.approx(1, abs=1e-6)


def test_nearest_modes_share_ties() -> None:
    ends = np.array([[(3.0, 0.0), (0.0, 1.0), (0.0, 2.0)], [(1.0, 0.0), (0.0, 1.0), (5.0, 5.0)]])
    expected = [[0, 1, 0], [0.5, 0.5, 0]]
    assert nearest_modes(ends, np.zeros((2, 2))).tolist() == expected


def test_brier() -> None:
    """0.7² + (0.2 - 1)² + 0.1² = 1.14; certain and right 0; certain and wrong 2."""
    probabilities = np.array([[0.7, 0.2, 0.1], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    nearest = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    with np.errstate(divide="ignore"):
        found = brier(np.log(probabilities), nearest, np.array([True, True, True]))
    assert found.value == pytest.approx([1.14, 0, 2])
    assert found.valid.all()


def test_brier_is_missing_for_a_single_mode() -> None:
    assert not brier(np.zeros((4, 1)), np.ones((4, 1)), np.ones(4, dtype=bool)).valid.any()


def test_metrics_are_missing_where_the_true_end_is_unknown() -> None:
    unknown = np.zeros(1, dtype=bool)
    assert not mixture_nll(np.zeros((1, 2, 2)), np.log([[0.5, 0.5]]), ORIGIN, unknown).valid.any()
    assert not brier(np.log([[0.5, 0.5]]), np.array([[1.0, 0.0]]), unknown).valid.any()


def ece(probabilities: np.ndarray, nearest: np.ndarray) -> float:
    """The calibration error of all targets together."""
    return float(calibration_error(calibration_sums(probabilities, nearest).sum(axis=0)))


def test_ece_by_hand() -> None:
    """Two targets with (0.85, 0.15), one of them right: both bins are off by 0.35.

    A third target with (0.5, 0.5) is off by (1 - 1) / 2 = 0 in its bin and has a third of the
    weight: 0.35 · 4 / 6.
    """
    probabilities = np.array([(0.85, 0.15), (0.85, 0.15)])
    nearest = np.array([(1.0, 0.0), (0.0, 1.0)])
    assert ece(probabilities, nearest) == pytest.approx(0.35)
    more = np.concatenate([probabilities, [(0.5, 0.5)]]), np.concatenate([nearest, [(0.0, 1.0)]])
    assert ece(*more) == pytest.approx(0.35 * 4 / 6)


@pytest.mark.parametrize(("right", "expected"), [(1.0, 0.0), (0.0, 1.0)])
def test_ece_of_certain_forecasts(right: float, expected: float) -> None:
    """Certain and right 0, certain and wrong 1; the last bin contains the probability 1."""
    assert ece(np.array([[1.0, 0.0]]), np.array([[right, 1 - right]])) == expected


def test_ece_without_modes_is_nan_without_a_warning() -> None:
    assert math.isnan(ece(np.zeros((0, 3)), np.zeros((0, 3))))


def test_ece_of_calibrated_and_overconfident_forecasts() -> None:
    """20,000 targets whose nearest mode is drawn with the forecast probabilities: under 0.01.

    With sharper probabilities than those drawn with it is over 0.1.
    """
    rng = np.random.default_rng(0)
    probabilities = rng.dirichlet([1.0, 1.0, 1.0], size=20_000)
    drawn = (rng.random((20_000, 1)) > probabilities.cumsum(axis=1)).sum(axis=1)
    nearest = np.eye(3)[drawn]
    assert ece(probabilities, nearest) < 0.01
    sharp = probabilities**4 / (probabilities**4).sum(axis=1, keepdims=True)
    assert ece(sharp, nearest) > 0.1


@given(seed=st.integers(0, 10**6), count=st.integers(1, 30), modes=st.integers(1, 6))
def test_bounds(seed: int, count: int, modes: int) -> None:
    """ECE is within [0, 1] and Brier within [0, 2], regardless of the order of modes."""
    rng = np.random.default_rng(seed)
    probabilities = rng.dirichlet(np.full(modes, 0.3), size=count) * (1 - 1e-9) + 1e-12
    ends = rng.normal(size=(count, modes, 2))
    nearest = nearest_modes(ends, np.zeros((count, 2)))
    assert nearest.sum(axis=1) == pytest.approx(1)
    assert 0 <= ece(probabilities, nearest) <= 1 + 1e-9
    found = brier(np.log(probabilities), nearest, np.ones(count, dtype=bool)).value
    assert ((found >= 0) & (found <= 2 + 1e-9)).all()
    order = rng.permutation(modes)
    assert ece(probabilities[:, order], nearest[:, order]) == pytest.approx(
        ece(probabilities, nearest)
    )
