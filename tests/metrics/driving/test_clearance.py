"""Clearances and times to the agent ahead: by hand, and laws on generated boxes."""

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
        ((2.0 + math.sqrt(5) + 1, 0.0, math.atan2(1, 2)), 1.0),  # a corner ahead of the front
        ((3.5, 0.0, 0.0), -0.5),  # overlapping by half a metre
        ((3.0, 1.5, 0.0), -0.5),  # separated sideways by the shortest motion
        ((0.0, 0.0, 0.0), -2.0),
    ],
)
def test_clearance(other: tuple[float, float, float], expected: float) -> None:
    """Two cars of 4 by 2 m, the first at the origin heading along +x."""
    assert clearance(*EGO, *CAR, *other, *CAR) == pytest.approx(expected)
    assert clearance(*other, *CAR, *EGO, *CAR) == pytest.approx(expected)


def boxes() -> st.SearchStrategy[Box]:
    """x, y, heading, length, width near the origin."""
    return st.tuples(
        *[st.floats(-6, 6)] * 2, st.floats(-7, 7), st.floats(0.3, 8), st.floats(0.3, 3)
    )


@given(box=boxes(), other=boxes())
def test_clearance_against_points_on_the_edges(box: Box, other: Box) -> None:
    """It is the smallest distance of edge points, up to their spacing, or negative."""
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
def test_clearance_does_not_depend_on_the_pose(
    box: Box, other: Box, pose: tuple[float, float, float]
) -> None:
    moved = []
    for x, y, heading, length, width in (box, other):
        x_m, y_m = from_frame(np.array([x, y]), np.array(pose))
        moved.append((x_m, y_m, heading + pose[2], length, width))
    one, two = moved
    assert clearance(*one, *two) == pytest.approx(clearance(*box, *other), abs=1e-6)


@pytest.mark.parametrize(
    ("other", "seconds"),
    [
        ((14.0, 0.0, 0.0, 5.0), 2.0),  # a gap of 10 m closes at 5 m/s
        ((14.0, 0.0, 0.0, 10.0), 5.0),  # the gap does not close
        ((14.0, 0.0, 0.0, 9.0), 5.0),  # 10 s, clipped to 5 s
        ((14.0, 0.0, math.pi, 5.0), 5.0),  # oncoming agents are not followed
        ((-14.0, 0.0, 0.0, 0.0), 5.0),  # behind
        ((14.0, 1.4, 0.0, 5.0), 2.0),  # a lateral overlap of 0.6 m
        ((14.0, 1.6, 0.0, 5.0), 2.0),  # an overlap of 0.4 m is enough if aligned
        ((14.0, 2.1, 0.0, 5.0), 5.0),  # no lateral overlap
        # at 60° the box extends 0.5 (4 · 0.5 + 2 · 0.866) = 1.866 m along the ego's heading: a gap
        # of 14 - 2 - 1.866 m that closes at 10 - 5 · 0.5 m/s
        ((14.0, 0.0, math.pi / 3, 5.0), (12 - 1.8660254) / 7.5),
        ((14.0, 0.0, math.radians(76), 5.0), 5.0),
        # at 60° it extends 0.5 (4 · 0.866 + 2 · 0.5) = 2.232 m aside: 3.232 - 2.8 m are too little
        ((14.0, 2.8, math.pi / 3, 5.0), 5.0),
        ((14.0, 2.7, math.pi / 3, 5.0), (12 - 1.8660254) / 7.5),
    ],
)
def test_time_to_the_agent_ahead(other: tuple[float, float, float, float], seconds: float) -> None:
    """The ego drives at 10 m/s."""
    states = np.array([[(*EGO, 10.0), other]])
    every = np.ones((1, 2), dtype=bool)
    _, found = nearest_distance_and_ttc(states, every, np.array([CAR, CAR]), every[0])
    assert found[0, 0] == pytest.approx(seconds)


def test_absent_agents_and_agents_that_are_not_evaluated() -> None:
    """Only present agents are measured to, and `FAR_M` is the clearance without any."""
    states = np.zeros((2, 3, 4))
    states[:, 1, 0], states[:, 2, 0] = 10.0, 8.0
    valid = np.array([(True, True, False), (True, False, False)])
    evaluated = np.array([True, False, True])
    found, seconds = nearest_distance_and_ttc(states, valid, np.array([CAR] * 3), evaluated)
    assert found[:, 0].tolist() == [6.0, FAR_M]
    assert found[:, 1:].tolist() == [[FAR_M] * 2] * 2
    assert (seconds == 5.0).all()
