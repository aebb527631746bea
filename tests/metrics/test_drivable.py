"""Distances to the drivable area on maps built by hand."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays

from asp_env.data.road_map import Ragged, RoadMap
from asp_env.errors import DataError
from asp_env.metrics.drivable import (
    OFF_ROAD_M,
    beyond_log_m,
    drivable_field,
    log_off_road_m,
    off_road_m,
)


def map_of(*rings: list[tuple[float, float]]) -> RoadMap:
    """A map that contains only drivable rings."""
    return RoadMap(
        name="by hand",
        lines=Ragged.pack([]),
        line_types=np.zeros(0, dtype=np.int64),
        drivable=Ragged.pack([np.array(ring) for ring in rings]),
        lanes=Ragged.pack([]),
        successors=np.zeros((0, 2), dtype=np.int64),
    )


SQUARE = map_of([(0, 0), (20, 0), (20, 20), (0, 20)])
CAR = np.array([4.0, 2.0])


def outside_m(x: float, y: float, heading: float = 0.0, road_map: RoadMap = SQUARE) -> float:
    """Distance of a car's outermost corner to the drivable area."""
    return float(off_road_m(road_map, np.array([[x, y, heading, 5.0]]), CAR[None])[0])


@pytest.mark.parametrize(
    ("x", "y", "heading", "expected"),
    [
        (10.0, 10.0, 0.7, 0.0),
        (17.9, 10.0, 0.0, 0.0),  # its front at 19.9 m
        (18.5, 10.0, 0.0, 0.5),
        (18.5, 10.0, math.pi, 0.5),  # its rear instead
        (10.0, 18.5, math.pi / 2, 0.5),
        (18.5, 10.0, math.pi / 2, 0.0),  # its side at 19.5 m
        (19.5, 10.0, -math.pi / 2, 0.5),
        (10.0, -1.0, 0.0, 2.0),
        (-1.0, -1.0, 0.0, math.hypot(3, 2)),  # the corner (-3, -2) from the corner (0, 0)
        (40.0, 10.0, 0.0, 5.0),  # distances are clipped to the margin of 5 m
        (1e6, -1e6, 0.0, 5.0),
    ],
)
def test_outermost_corner(x: float, y: float, heading: float, expected: float) -> None:
    """A car of 4 by 2 m on a square of 20 m, accurate to the cell of 0.1 m."""
    assert outside_m(x, y, heading) == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(("over_m", "off"), [(0.0, False), (0.2, False), (0.4, True), (0.6, True)])
def test_tolerance(over_m: float, off: bool) -> None:
    """0.2 m over the edge is on the road, 0.4 m is off it: nuPlan's 0.3 m to one cell."""
    assert OFF_ROAD_M == 0.3
    assert (outside_m(18 + over_m, 10.0) > OFF_ROAD_M) == off


@given(points=arrays(np.float64, (64, 2), elements=st.floats(-4.9, 24.9)))
def test_distance_to_a_square(points: np.ndarray) -> None:
    """Within 0.1 m of the exact distance, clipped to the margin of 5 m; 0 inside."""
    exact = np.minimum(np.hypot(*np.maximum(np.maximum(-points, points - 20), 0).T), 5)
    found = drivable_field(SQUARE).distance_m(points)
    assert np.abs(found - exact).max() < 0.1
    within = ((points > 0) & (points < 20)).all(axis=1)
    assert (found[within] == 0).all()


def test_the_area_is_the_union_of_overlapping_rings() -> None:
    cross = map_of(
        [(-20, -3), (20, -3), (20, 3), (-20, 3)], [(-3, -20), (3, -20), (3, 20), (-3, 20)]
    )
    assert outside_m(0.0, 0.0, road_map=cross) == 0
    assert outside_m(15.0, 0.0, road_map=cross) == 0
    assert outside_m(5.0, 5.0, road_map=cross) == pytest.approx(3.0, abs=0.1)  # corner (7, 6)


def test_leading_axes_of_points_are_preserved() -> None:
    points = np.array([[(10.0, 10.0), (21.0, 10.0)], [(10.0, 22.0), (10.0, -3.0)]])
    found = drivable_field(SQUARE).distance_m(points)
    np.testing.assert_allclose(found, [(0, 1), (2, 3)], atol=0.1)


def test_fields_are_cached_by_map() -> None:
    assert drivable_field(SQUARE) is drivable_field(SQUARE)
    moved = map_of([(100, 0), (120, 0), (120, 20), (100, 20)])
    assert outside_m(110.0, 10.0, road_map=moved) == 0
    assert outside_m(10.0, 10.0, road_map=moved) == 5


def test_maps_without_drivable_area_are_rejected() -> None:
    with pytest.raises(DataError, match="map by hand: no drivable area"):
        outside_m(0.0, 0.0, road_map=map_of())


def straight(y_m: float) -> np.ndarray:
    """(31, 4) a log from x = 2 to 32 at y; edges of the square are at x = 20 and y = 0."""
    states = np.zeros((31, 4))
    states[:, 0], states[:, 1], states[:, 3] = 2 + np.arange(31), y_m, 5.0
    return states


def test_where_a_log_is_off_the_road() -> None:
    """The log leaves the square: its front passes 20.3 m at x = 18.3, first at the tick x = 19.

    This is 17 m along its route, so an allowance begins at 12 m: the largest distance within 5 m.
    At 12 m it is that of the tick at 17 m, 21 - 20 m; at 14 m that of the tick at 19 m, 3 m.
    """
    log = straight(10.0)
    found = log_off_road_m(SQUARE, log, CAR, log[:, :2])
    np.testing.assert_allclose(found[[0, 11, 12, 14]], [0, 0, 1, 3], atol=0.1)
    assert found[30] == 5  # the margin
    on_road = straight(10.0)[:15]
    assert not log_off_road_m(SQUARE, on_road, CAR, on_road[:, :2]).any()


def test_a_log_within_the_tolerance_allows_nothing() -> None:
    for y_m, allowed in ((0.9, 0.0), (0.4, 0.6)):  # its side is 0.1 or 0.6 m outside
        log = straight(y_m)[:10]
        found = log_off_road_m(SQUARE, log, CAR, log[:, :2])
        assert found.max() == pytest.approx(allowed, abs=0.1)


@pytest.mark.parametrize(
    ("outside_m", "arc_m", "offset_m", "expected"),
    [
        (2.0, 1.0, 0.0, 2.0),  # nothing is allowed there
        (2.0, 2.0, 0.0, 0.5),
        (2.0, 1.6, 0.0, 0.5),  # the nearest point of the route is at 2 m
        (1.0, 2.0, 0.0, 0.0),
        (2.0, 2.0, 2.0, 0.5),
        (2.0, 2.0, -2.1, 2.0),  # too far beside the route
        (2.0, -9.0, 0.0, 2.0),
        (2.0, 99.0, 0.0, 1.0),  # after the end as at the end
    ],
)
def test_beyond_the_log(outside_m: float, arc_m: float, offset_m: float, expected: float) -> None:
    """The log is 1.5 m off the road at 2 m and 1 m at the end of the route, 3 m."""
    found = beyond_log_m(
        np.array([outside_m]),
        np.array([[arc_m, offset_m, 0.0]]),
        np.array([[0.0, 0.0, 1.5, 1.0]]),
    )
    assert found[0] == pytest.approx(expected)
