"""Coordinates along routes built by hand."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.geometry import route_coordinates

ANYWHERE = -1.0


def route_through(*corners: tuple[float, float]) -> np.ndarray:
    """Points 1 m apart through corners at integer distances along the axes."""
    points = [np.array(corners[0], dtype=np.float64)]
    for corner in corners[1:]:
        change = np.array(corner) - points[-1]
        steps = round(float(np.abs(change).sum()))
        points += [points[-1] + change / steps * (k + 1) for k in range(steps)]
    return np.stack(points)


STRAIGHT = route_through((0, 0), (10, 0))
LOOP = route_through((0, 0), (10, 0), (10, 5), (5, 5), (5, -5))
"""A route that crosses itself at (5, 0), after 5 m and after 25 m."""


def coordinates(
    route: np.ndarray, x: float, y: float, near_m: float = ANYWHERE, *, padding: int = 0
) -> list[float]:
    """Arc length m, lateral offset m and heading rad of one point on one route."""
    padded = np.concatenate([route, np.zeros((padding, 2))])
    valid = np.arange(len(padded)) < len(route)
    states = np.array([[x, y, 0.0, 0.0]])
    return route_coordinates(padded[None], valid[None], states, np.array([near_m]))[0].tolist()


@pytest.mark.parametrize("near_m", [ANYWHERE, 0.0, 5.0, 99.0])
@pytest.mark.parametrize("padding", [0, 7])
@pytest.mark.parametrize(
    ("x", "y", "arc", "offset"),
    [
        (0.0, 0.0, 0.0, 0.0),
        (3.3, 1.5, 3.3, 1.5),  # left
        (3.3, -1.5, 3.3, -1.5),  # right
        (9.0, 0.2, 9.0, 0.2),
    ],
)
def test_beside_a_straight_route(
    x: float, y: float, arc: float, offset: float, padding: int, near_m: float
) -> None:
    """Along +x the arc length is x and the offset y, with padding or without.

    Near 99 m only the last segment is searched, which does not extend backwards.
    """
    if near_m == 99.0:
        arc, offset = max(arc, 9.0), math.copysign(math.hypot(max(9 - x, 0), y), y)
    expected = [arc, offset, 0.0]
    np.testing.assert_allclose(coordinates(STRAIGHT, x, y, near_m, padding=padding), expected)


@pytest.mark.parametrize(("x", "y"), [(-2.0, -1.0), (-0.1, 3.0), (10.5, 0.5), (14.0, -2.0)])
def test_routes_continue_straight_beyond_their_ends(x: float, y: float) -> None:
    np.testing.assert_allclose(coordinates(STRAIGHT, x, y), [x, y, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("x", "y", "near_m", "expected"),
    [
        (5.0, 0.2, 5.0, (5.0, 0.2, 0.0)),
        (5.0, 0.2, 25.0, (24.8, 0.0, -math.pi / 2)),
        (5.0, 0.2, ANYWHERE, (24.8, 0.0, -math.pi / 2)),
        (5.3, 0.0, 5.0, (5.3, 0.0, 0.0)),
        (5.3, 0.0, 25.0, (25.0, 0.3, -math.pi / 2)),  # heading along -y, +x is to the left
        (9.0, 3.0, 12.0, (13.0, 1.0, math.pi / 2)),
        (7.0, 6.0, 17.0, (18.0, -1.0, math.pi)),
    ],
)
def test_route_that_crosses_itself(
    x: float, y: float, near_m: float, expected: tuple[float, float, float]
) -> None:
    """`near_m` decides between two passes."""
    np.testing.assert_allclose(coordinates(LOOP, x, y, near_m), expected, atol=1e-12)


def test_outside_of_a_corner() -> None:
    """The nearest point outside of the corner (10, 0) is the corner; the offset is to the right."""
    arc, offset, _ = coordinates(LOOP, 13.0, -4.0)
    assert (arc, offset) == (pytest.approx(10), pytest.approx(-5))


def test_segments_of_length_0_are_skipped() -> None:
    route = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 0.0), (2.0, 0.0)])
    np.testing.assert_allclose(coordinates(route, 0.5, 0.1), [0.5, 0.1, 0])
    np.testing.assert_allclose(coordinates(route, 1.5, 0.1), [2.5, 0.1, 0])


def test_rows_of_a_batch_are_independent() -> None:
    routes = np.stack([LOOP[:11], STRAIGHT[:, ::-1]])  # along +x, along +y
    states = np.array([[3.0, 1.0, 0.0, 0.0], [3.0, 1.0, 0.0, 0.0]])
    found = route_coordinates(routes, np.ones((2, 11), bool), states, np.array([ANYWHERE, 1.0]))
    np.testing.assert_allclose(found, [(3, 1, 0), (1, -3, math.pi / 2)])


@given(
    point=st.tuples(*[st.floats(-8, 16)] * 2),
    near_m=st.sampled_from([ANYWHERE, 3.0, 22.0]),
    turn=st.floats(-3, 3),
    shift=st.tuples(*[st.floats(-100, 100)] * 2),
)
def test_equivariance(
    point: tuple[float, float], near_m: float, turn: float, shift: tuple[float, float]
) -> None:
    """The size of the offset does not depend on the pose of the world.

    Signs are not compared: exactly ahead of a corner, left and right are both right.
    """
    cos, sin = math.cos(turn), math.sin(turn)
    spin = np.array([(cos, sin), (-sin, cos)])
    arc, offset, _ = coordinates(LOOP, *point, near_m)
    x, y = (np.array(point) @ spin + shift).tolist()
    _, moved_offset, _ = coordinates(LOOP @ spin + shift, x, y, near_m)
    assert abs(moved_offset) == pytest.approx(abs(offset), abs=1e-9)
    assert -8 <= arc <= 41
    padded = coordinates(LOOP, *point, near_m, padding=5)
    assert padded[:2] == [arc, offset]
