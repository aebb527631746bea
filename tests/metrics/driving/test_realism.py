"""Likelihoods of logged motion derived by hand, and of better and worse simulations."""

import math

import numpy as np
import pytest

from asp_env.geometry import from_frame
from asp_env.metrics.driving.realism import (
    REALISM_FEATURES,
    RealismFeature,
    feature_likelihood,
    realism,
    realism_features,
)
from asp_env.metrics.masked import Masked
from tests.metrics.streets import STREET, moved_map

DT_S = 0.2
SIZES = np.array([(4.0, 2.0)] * 3)
ALL = np.ones(3, dtype=bool)


def column(*values: float | None) -> Masked:
    """(t, 1) values of one agent; `None` is missing."""
    known = np.array([[value is not None] for value in values])
    return Masked(value=np.array([[value or 0.0] for value in values]), valid=known)


def traffic(*, speed_mps: float = 8.0, ticks: int = 20) -> np.ndarray:
    """(t, 3, 4) two agents on the eastbound lane, 20 m apart, and one on the lane beside."""
    states = np.zeros((ticks, 3, 4))
    states[..., 0] = 2 + speed_mps * DT_S * np.arange(ticks)[:, None] + [20, 0, 10]
    states[..., 1] = [0, 0, -4]
    states[..., 3] = speed_mps
    return states


def features_of(states: np.ndarray, evaluated: np.ndarray = ALL) -> dict[str, Masked]:
    """Features of traffic on the street."""
    return realism_features(
        states, np.ones(states.shape[:2], dtype=bool), SIZES, STREET, evaluated, DT_S
    )


def test_likelihood_by_hand() -> None:
    """Bins of 1 from 0 to 4; simulated values 0.5, 0.6, 1.5, and 9, which is in the last bin.

    With 0.1 added to each of the four bins: 2.1, 1.1, 0.1 and 1.1 of 4.4. The logged 0.1 and 2.5
    have the probabilities 2.1/4.4 and 0.1/4.4, whose geometric mean is the result; a missing value
    is left out.
    """
    feature = RealismFeature(weight=1.0, low=0.0, high=4.0, bins=4)
    simulated = [column(0.5, 0.6), column(1.5, 9.0, None)]
    found = feature_likelihood(column(0.1, None, 2.5), simulated, feature)
    assert found.value[0] == pytest.approx(math.sqrt(2.1 * 0.1) / 4.4)
    assert not feature_likelihood(column(None, None), simulated, feature).valid[0]
    assert not feature_likelihood(column(0.1), [column(None)], feature).valid[0]


def test_likelihood_of_collisions() -> None:
    """Of 32 simulations 8 collide: a logged collision has 8.1/32.2, none has 24.1/32.2."""
    simulated = [column(float(number < 8)) for number in range(32)]
    for logged, expected in ((1.0, 8.1 / 32.2), (0.0, 24.1 / 32.2)):
        found = feature_likelihood(column(logged), simulated, REALISM_FEATURES["collision"])
        assert found.value[0] == pytest.approx(expected)


def test_weights_are_those_of_wosac_2025() -> None:
    """They add up to 1 with the 0.05 of traffic lights."""
    assert {name: each.weight for name, each in REALISM_FEATURES.items()} == {
        **dict.fromkeys(("speed", "acceleration", "yaw rate", "yaw acceleration"), 0.05),
        **{"nearest": 0.1, "collision": 0.25, "TTC": 0.1, "road edge": 0.05, "off-road": 0.25},
    }
    assert sum(each.weight for each in REALISM_FEATURES.values()) == pytest.approx(0.95)


def test_features_by_hand() -> None:
    """Steady motion at 8 m/s has no rates and no time to collision.

    The nearest box of each agent is 10 m ahead or behind and 4 m aside, a gap of 6 and 2 m. The
    right corners of the third agent, at y = -5, are 1 m inside the road edge.
    """
    found = features_of(traffic())
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
    found = {name: each.value[:, 0] for name, each in features_of(states).items()}
    assert found["speed"][1:-1] == pytest.approx(2 + 3 * t[1:-1])
    assert found["acceleration"][2:-2] == pytest.approx(3.0)
    assert found["yaw rate"][1:-1] == pytest.approx(0.2 * t[1:-1], abs=1e-9)
    assert found["yaw acceleration"][2:-2] == pytest.approx(0.2)


def test_collision_and_off_road() -> None:
    """The third agent crosses the road edge, and the first stands in the way of the second."""
    states = traffic()
    states[:, 2, 1] = -6.0
    states[:, 0, 0] = 20.0
    found = features_of(states)
    assert found["off-road"].value.tolist() == [[0.0, 0.0, 1.0]]
    assert found["collision"].value.tolist() == [[1.0, 1.0, 0.0]]


def test_the_log_itself_has_the_highest_realism() -> None:
    """Faster traffic is worse, and traffic that collides is worse still."""
    logged = features_of(traffic())
    faster, colliding = features_of(traffic(speed_mps=12.0)), traffic()
    colliding[:, 0, 0] -= 17.0
    scores = [
        realism(logged, [each])["realism"].value[0]
        for each in (logged, faster, features_of(colliding))
    ]
    assert 1 > scores[0] > scores[1] > scores[2] > 0
    both = realism(logged, [logged, faster])["realism"].value[0]
    assert both > scores[1]  # smoothing has less weight on twice the samples


def test_without_evaluated_agents_realism_is_missing() -> None:
    found = features_of(traffic(), np.zeros(3, dtype=bool))
    assert not any(each.valid[0] for each in realism(found, [found]).values())


def test_realism_does_not_depend_on_padding_order_and_pose() -> None:
    rng = np.random.default_rng(5)
    logged = traffic() + np.cumsum(rng.normal(0, 0.05, (20, 3, 4)), axis=0)
    simulated = traffic() + np.cumsum(rng.normal(0, 0.05, (20, 3, 4)), axis=0)
    original = realism(features_of(logged), [features_of(simulated)])

    def padded(states: np.ndarray) -> dict[str, Masked]:
        order = [2, 0, 1]
        more = np.concatenate([states[:, order], np.zeros((20, 2, 4))], axis=1)
        valid = np.ones((20, 5), dtype=bool)
        valid[:, 3:] = False
        sizes = np.concatenate([SIZES, np.zeros((2, 2))])
        return realism_features(more, valid, sizes, STREET, np.ones(5, dtype=bool), DT_S)

    for name, each in realism(padded(logged), [padded(simulated)]).items():
        assert each.value[0] == pytest.approx(original[name].value[0], abs=1e-9), name

    pose = (
        70.0,
        -20.0,
        0.5 * np.pi,
    )  # a quarter turn leaves the grid of the distance field the same
    street = moved_map(STREET, pose)

    def moved(states: np.ndarray) -> dict[str, Masked]:
        xy = from_frame(states[..., :2], np.array(pose))
        elsewhere = np.concatenate([xy, states[..., 2:3] + pose[2], states[..., 3:]], axis=-1)
        return realism_features(elsewhere, np.ones((20, 3), dtype=bool), SIZES, street, ALL, DT_S)

    for name, each in realism(moved(logged), [moved(simulated)]).items():
        assert each.value[0] == pytest.approx(original[name].value[0], abs=0.02), name
