"""Clearances and times to whoever drives ahead, by hand, and laws on generated boxes."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.geometry import box_corners, from_frame, overlaps
from asp_env.metrics.driving.realism import FAR_M, clearance, nearest_distance_and_ttc

CAR = (4.0, 2.0)
EGO = (0.0, 0.0, 0.0)
Box = tuple[float, float, float, float, float]


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ((10.0, 0.0, 0.0), 6.0),  # bumper to bumper
        ((10.0, 0.0, math.pi / 2), 7.0),  # its side ahead
        ((0.0, 5.0, 0.0), 3.0),
        ((7.0, 6.0, 0.0), 5.0),  # corners (2, 1) and (5, 5)
        ((2.0 + math.sqrt(5) + 1, 0.0, math.atan2(1, 2)), 1.0),  # its corner points at our front
        ((3.5, 0.0, 0.0), -0.5),  # half a metre into each other
        ((3.0, 1.5, 0.0), -0.5),  # sideways is the shorter way out
        ((0.0, 0.0, 0.0), -2.0),
    ],
)
def test_clearance(other: tuple[float, float, float], expected: float) -> None:
    """Of two cars of 4 by 2 m, the first at the origin along +x."""
    assert clearance(*EGO, *CAR, *other, *CAR) == pytest.approx(expected)
    assert clearance(*other, *CAR, *EGO, *CAR) == pytest.approx(expected)


def boxes() -> st.SearchStrategy[Box]:
    """x, y, heading, length, width near the origin."""
    return st.tuples(
        *[st.floats(-6, 6)] * 2, st.floats(-7, 7), st.floats(0.3, 8), st.floats(0.3, 3)
    )


@given(box=boxes(), other=boxes())
def test_clearance_against_points_on_the_edges(box: Box, other: Box) -> None:
    """Apart, it is the least distance of edge points, to their spacing; else it is below 0."""
    found = clearance(*box, *other)
    assert found == pytest.approx(clearance(*other, *box), abs=1e-9)
    assert (found < 0) == overlaps(*box, *other)
    if found >= 0:
        shares = np.linspace(0, 1, 65)[:, None]
        edges = []
        for each in (box, other):
            corners = box_corners(np.array(each[:3]), np.array(each[3:]))
            sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
            edges.append(np.concatenate([a + shares * (b - a) for a, b in sides]))
        least = np.hypot(*(edges[0][:, None] - edges[1]).transpose(2, 0, 1)).min()
        assert found - 1e-9 <= least <= found + 0.1


@given(
    box=boxes(),
    other=boxes(),
    pose=st.tuples(st.floats(-100, 100), st.floats(-100, 100), st.floats(-3, 3)),
)
def test_clearance_is_the_same_elsewhere(
    box: Box, other: Box, pose: tuple[float, float, float]
) -> None:
    """Turned and shifted boxes are as far apart."""
    moved = []
    for x, y, heading, length, width in (box, other):
        x_m, y_m = from_frame(np.array([x, y]), np.array(pose))
        moved.append((x_m, y_m, heading + pose[2], length, width))
    one, two = moved
    assert clearance(*one, *two) == pytest.approx(clearance(*box, *other), abs=1e-6)


@pytest.mark.parametrize(
    ("other", "seconds"),
    [
        ((14.0, 0.0, 0.0, 5.0), 2.0),  # a gap of 10 m that closes at 5 m/s
        ((14.0, 0.0, 0.0, 10.0), 5.0),  # it does not close
        ((14.0, 0.0, 0.0, 9.0), 5.0),  # 10 s, but no more than 5
        ((14.0, 0.0, math.pi, 5.0), 5.0),  # oncoming is not followed
        ((-14.0, 0.0, 0.0, 0.0), 5.0),  # behind
        ((14.0, 1.4, 0.0, 5.0), 2.0),  # shadows share 0.6 m
        ((14.0, 1.6, 0.0, 5.0), 2.0),  # 0.4 m, but headed alike
        ((14.0, 2.1, 0.0, 5.0), 5.0),  # beside our way
        # at 60°, length 4 m and width 2 m reach 0.5 (4 · 0.5 + 2 · 0.866) = 1.866 m ahead of its
        # centre: a gap of 14 - 2 - 1.866 m, closing at 10 - 5 · 0.5 m/s
        ((14.0, 0.0, math.pi / 3, 5.0), (12 - 1.8660254) / 7.5),
        ((14.0, 0.0, math.radians(76), 5.0), 5.0),
        # at 60° it reaches 0.5 (4 · 0.866 + 2 · 0.5) = 2.232 m aside: 3.232 - 2.8 m are slight
        ((14.0, 2.8, math.pi / 3, 5.0), 5.0),
        ((14.0, 2.7, math.pi / 3, 5.0), (12 - 1.8660254) / 7.5),
    ],
)
def test_whom_one_follows(other: tuple[float, float, float, float], seconds: float) -> None:
    """Behind another car at 10 m/s."""
    states = np.array([[(*EGO, 10.0), other]])
    every = np.ones((1, 2), dtype=bool)
    _, found = nearest_distance_and_ttc(states, every, np.array([CAR, CAR]), every[0])
    assert found[0, 0] == pytest.approx(seconds)


def test_who_is_asked_and_who_is_there() -> None:
    """The nearest of those that are there; alone, far from anybody; only those asked about."""
    states = np.zeros((2, 3, 4))
    states[:, 1, 0], states[:, 2, 0] = 10.0, 8.0
    valid = np.array([(True, True, False), (True, False, False)])
    asked = np.array([True, False, True])
    found, seconds = nearest_distance_and_ttc(states, valid, np.array([CAR] * 3), asked)
    assert found[:, 0].tolist() == [6.0, FAR_M]
    assert found[:, 1:].tolist() == [[FAR_M] * 2] * 2
    assert (seconds == 5.0).all()
