"""Likelihoods of logged motion, worked out by hand, and what a better simulation gets."""

import math

import numpy as np
import pytest

from asp_env.geometry import from_frame
from asp_env.metrics.driving.realism import REALISM_FEATURES, RealismFeature, realism_features, feature_likelihood, realism
from asp_env.metrics.masked import Masked
from tests.metrics.streets import STREET, moved_map

DT_S = 0.2
SIZES = np.array([(4.0, 2.0)] * 3)
ALL = np.ones(3, dtype=bool)


def column(*values: float | None) -> Masked:
    """(t, 1) values of one agent, `None` where missing."""
    known = np.array([[value is not None] for value in values])
    return Masked(value=np.array([[value or 0.0] for value in values]), valid=known)


def traffic(*, speed_mps: float = 8.0, ticks: int = 20) -> np.ndarray:
    """(t, 3, 4) two on the eastbound lane, 20 m apart, and one on the lane beside."""
    states = np.zeros((ticks, 3, 4))
    states[..., 0] = 2 + speed_mps * DT_S * np.arange(ticks)[:, None] + [20, 0, 10]
    states[..., 1] = [0, 0, -4]
    states[..., 3] = speed_mps
    return states


def found_in(states: np.ndarray, asked: np.ndarray = ALL) -> dict[str, Masked]:
    """Features of traffic on the street."""
    return realism_features(states, np.ones(states.shape[:2], dtype=bool), SIZES, STREET, asked, DT_S)


def test_likelihood_by_hand() -> None:
    """Bins of 1 from 0 to 4; simulated 0.5, 0.6, 1.5 and 9, which counts in the last.

    With 0.1 in each of the four bins: 2.1, 1.1, 0.1 and 1.1 of 4.4. Logged 0.1 and 2.5 have the
    shares 2.1/4.4 and 0.1/4.4; their geometric mean counts, and a missing one does not.
    """
    feature = RealismFeature(weight=1.0, low=0.0, high=4.0, bins=4)
    simulated = [column(0.5, 0.6), column(1.5, 9.0, None)]
    found = feature_likelihood(column(0.1, None, 2.5), simulated, feature)
    assert found.value[0] == pytest.approx(math.sqrt(2.1 * 0.1) / 4.4)
    assert not feature_likelihood(column(None, None), simulated, feature).valid[0]
    assert not feature_likelihood(column(0.1), [column(None)], feature).valid[0]


def test_what_is_asked_once() -> None:
    """Of 32 simulations 8 collide: a logged collision has (8 + 0.1)/32.2, none 24.1/32.2."""
    simulated = [column(float(number < 8)) for number in range(32)]
    collision = REALISM_FEATURES["collision"]
    assert feature_likelihood(column(1.0), simulated, collision).value[0] == pytest.approx(8.1 / 32.2)
    assert feature_likelihood(column(0.0), simulated, collision).value[0] == pytest.approx(24.1 / 32.2)


def test_weights_are_those_of_2025() -> None:
    """They add up to 1 with the 0.05 of traffic lights."""
    assert {name: each.weight for name, each in REALISM_FEATURES.items()} == {
        **dict.fromkeys(("speed", "acceleration", "yaw rate", "yaw acceleration"), 0.05),
        **{"nearest": 0.1, "collision": 0.25, "TTC": 0.1, "road edge": 0.05, "off-road": 0.25},
    }
    assert sum(each.weight for each in REALISM_FEATURES.values()) == pytest.approx(0.95)


def test_features_by_hand() -> None:
    """Even motion at 8 m/s: no rates, nobody who is caught up with.

    The nearest box of each is 10 m along and 4 m aside, so 6 and 2 m from its own. The third one's
    right corners, at y = -5, are 1 m from the road's edge.
    """
    found = found_in(traffic())
    inner = slice(1, -1)
    assert found["speed"].value[inner] == pytest.approx(8.0)
    assert found["speed"].valid[inner].all()
    assert not found["speed"].valid[[0, -1]].any()
    assert found["acceleration"].value[2:-2] == pytest.approx(0.0)
    assert found["acceleration"].valid.sum() == 16 * 3
    assert found["nearest"].value == pytest.approx(math.hypot(6, 2))
    assert found["TTC"].value == pytest.approx(5.0)
    assert found["road edge"].value[3, 2] == pytest.approx(-1.0, abs=0.15)
    assert found["collision"].value.tolist() == [[0.0] * 3]
    assert found["off-road"].value.tolist() == [[0.0] * 3]


def test_rates_by_hand() -> None:
    """Speed 2 + 3 t and heading 0.1 t²: 3 m/s², yaw rate 0.2 t, yaw acceleration 0.2 rad/s²."""
    t = np.arange(12) * DT_S
    states = traffic(ticks=12)
    states[:, 0, 0] = 20 + 2 * t + 1.5 * t**2
    states[:, 0, 2] = (0.1 * t**2 + 2 * np.pi) % (2 * np.pi)
    found = {name: each.value[:, 0] for name, each in found_in(states).items()}
    assert found["speed"][1:-1] == pytest.approx(2 + 3 * t[1:-1])
    assert found["acceleration"][2:-2] == pytest.approx(3.0)
    assert found["yaw rate"][1:-1] == pytest.approx(0.2 * t[1:-1], abs=1e-9)
    assert found["yaw acceleration"][2:-2] == pytest.approx(0.2)


def test_who_hits_somebody_and_leaves_the_road() -> None:
    """One that stands across the edge of the road, in whom the second one drives."""
    states = traffic()
    states[:, 2, 1] = -6.0
    states[:, 0, 0] = 20.0
    found = found_in(states)
    assert found["off-road"].value.tolist() == [[0.0, 0.0, 1.0]]
    assert found["collision"].value.tolist() == [[1.0, 1.0, 0.0]]


def test_a_simulation_like_the_log_is_more_real() -> None:
    """The log itself is the best; what is faster, or collides, is worse; none exceeds 1."""
    logged = found_in(traffic())
    faster, colliding = found_in(traffic(speed_mps=12.0)), traffic()
    colliding[:, 0, 0] -= 17.0
    scores = [
        realism(logged, [each])["realism"].value[0]
        for each in (logged, faster, found_in(colliding))
    ]
    assert 1 > scores[0] > scores[1] > scores[2] > 0
    both = realism(logged, [logged, faster])["realism"].value[0]
    assert both > scores[1]  # and not below the first: smoothing weighs less on twice the samples


def test_nobody_simulated_has_no_realism() -> None:
    """Missing, not 0; nor is any of its parts."""
    nobody = np.zeros(3, dtype=bool)
    found = found_in(traffic(), nobody)
    assert not any(each.valid[0] for each in realism(found, [found]).values())


def test_laws() -> None:
    """Neither padding, nor the order of agents, nor where the street lies matter."""
    rng = np.random.default_rng(5)
    logged = traffic() + np.cumsum(rng.normal(0, 0.05, (20, 3, 4)), axis=0)
    simulated = traffic() + np.cumsum(rng.normal(0, 0.05, (20, 3, 4)), axis=0)
    here = realism(found_in(logged), [found_in(simulated)])

    def padded(states: np.ndarray) -> dict[str, Masked]:
        order = [2, 0, 1]
        more = np.concatenate([states[:, order], np.zeros((20, 2, 4))], axis=1)
        valid = np.ones((20, 5), dtype=bool)
        valid[:, 3:] = False
        sizes = np.concatenate([SIZES, np.zeros((2, 2))])
        return realism_features(more, valid, sizes, STREET, np.ones(5, dtype=bool), DT_S)

    for name, each in realism(padded(logged), [padded(simulated)]).items():
        assert each.value[0] == pytest.approx(here[name].value[0], abs=1e-9), name

    pose = (70.0, -20.0, 0.5 * np.pi)  # a quarter turn, so that the grid of the road is the same
    street = moved_map(STREET, pose)

    def moved(states: np.ndarray) -> dict[str, Masked]:
        xy = from_frame(states[..., :2], np.array(pose))
        elsewhere = np.concatenate([xy, states[..., 2:3] + pose[2], states[..., 3:]], axis=-1)
        return realism_features(elsewhere, np.ones((20, 3), dtype=bool), SIZES, street, ALL, DT_S)

    for name, each in realism(moved(logged), [moved(simulated)]).items():
        assert each.value[0] == pytest.approx(here[name].value[0], abs=0.02), name
