"""Lanes under points and boxes, on a street built by hand."""

import math
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.data.road_map import Ragged, RoadMap
from asp_env.geometry import box_corners, from_frame
from asp_env.metrics.driving.map_context import distance_to_route_lanes_m, reachable_lanes
from asp_env.metrics.lanes import (
    against_traffic_m,
    at_crossing,
    covering_lanes,
    in_several_lanes,
    lane_coordinates,
    lane_table,
    speed_limits,
)
from tests.metrics.streets import (
    CAR,
    EAST,
    LEFT,
    NEXT_EAST,
    NORTH,
    ONWARDS,
    STREET,
    WEST,
    moved_map,
    street_map,
    strip,
)

Pose = tuple[float, float, float]
BARE = replace(
    STREET,
    areas=Ragged.pack([]),
    two_way=np.zeros(0, dtype=bool),
    limits_mps=np.zeros(0),
    limited=np.zeros(0, dtype=bool),
)
"""The street with centre lines only."""


def at(x: float, y: float, heading: float = 0.0, speed: float = 5.0) -> np.ndarray:
    """(1, 4) one state."""
    return np.array([[x, y, heading, speed]])


@pytest.mark.parametrize(
    ("x", "y", "lanes"),
    [
        (10.0, 1.9, {EAST}),
        (10.0, 2.1, {WEST}),
        (10.0, -2.1, {NEXT_EAST}),
        (10.0, 6.1, set()),
        (50.0, 0.0, {EAST, NORTH}),
        (50.0, 29.0, {NORTH}),
        (99.0, 0.0, {EAST}),
        (101.0, 0.0, {ONWARDS, LEFT}),
        (110.0, 10.0, {LEFT}),
        (-0.1, 0.0, set()),
    ],
)
def test_covering(x: float, y: float, lanes: set[int]) -> None:
    assert set(np.flatnonzero(covering_lanes(STREET, np.array([x, y])))) == lanes


def map_of(*lanes: tuple[np.ndarray, np.ndarray]) -> RoadMap:
    """A map of lanes (centre line, ring) without limits and successors."""
    count = len(lanes)
    return replace(
        STREET,
        lanes=Ragged.pack([line for line, _ in lanes]),
        areas=Ragged.pack([ring for _, ring in lanes]),
        successors=np.zeros((0, 2), dtype=np.int64),
        two_way=np.zeros(count, dtype=bool),
        limits_mps=np.zeros(count),
        limited=np.zeros(count, dtype=bool),
    )


@pytest.mark.parametrize(
    ("x", "y", "heading", "arc_m"),
    [
        (4.0, 1.0, 0.0, 4.0),
        (-3.0, 1.0, 0.0, 0.0),  # before its beginning
        (9.0, 5.0, math.pi / 2, 15.0),
        (11.0, 12.0, math.pi / 2, 20.0),  # beyond its end
        (11.0, -1.0, 0.0, 10.0),  # equally near to both segments: the first
    ],
)
def test_coordinates_on_a_lane_with_a_corner(
    x: float, y: float, heading: float, arc_m: float
) -> None:
    """10 m to the east, a repeated point, and 10 m to the north; 0 in a lane that is not asked."""
    line = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 0.0), (10.0, 10.0)])
    _, ring = strip(0, 0, 10, 0)
    bent = map_of((line, ring), (line[::-1], ring))
    found = lane_coordinates(bent, np.array([x, y]), np.array([True, False]))
    np.testing.assert_allclose(found, [(heading, 0), (arc_m, 0)])


@pytest.mark.parametrize(("other_x", "crossing"), [(60.0, True), (68.0, False)])
def test_between_two_crossings_within_10_m_is_at_a_crossing(other_x: float, crossing: bool) -> None:
    """Lanes 4 m wide cross at 50 m and at 60 or 68 m: the gap is 6 or 14 m."""
    crossed = map_of(strip(0, 0, 100, 0), strip(50, -30, 50, 30), strip(other_x, -30, other_x, 30))
    middle = at((50 + other_x) / 2, 0)
    small = np.array([[1.0, 1.0]])
    assert at_crossing(crossed, middle, small).tolist() == [crossing]
    for x, expected in ((45.0, False), (50.0, True), (other_x, True), (other_x + 5, False)):
        assert at_crossing(crossed, at(x, 0), small).tolist() == [expected]


@pytest.mark.parametrize(
    ("region_m", "crossing"), [((30.0, -9.0, 70.0, 9.0), True), ((0.0, -9.0, 30.0, 9.0), False)]
)
def test_crossings_are_sought_where_agents_are(
    region_m: tuple[float, float, float, float], crossing: bool
) -> None:
    inside = replace(STREET, region_m=region_m)
    assert at_crossing(inside, at(50, 0), CAR[None]).tolist() == [crossing]


@pytest.mark.parametrize(
    ("state", "several"),
    [
        (at(20, 0), False),
        (at(20, 0.9), False),  # its left side is at 1.9 m
        (at(20, 1.1), True),  # two corners over the line to the westbound lane
        (at(20, -2.0), True),
        (at(100, 0), False),  # its rear is in one lane, its front in the next
        (at(101, 0.6, math.pi / 4), False),  # turning: its rear is in the previous lane
        (at(100, -2.0), True),  # its rear right is in the lane beside
        (at(50, 0), False),  # at the crossing one lane covers all corners
        (at(50, 0, math.pi / 2), False),
        (at(20, -6.5), False),  # half of it is outside the map and does not count
        (at(20, 40), False),
    ],
)
def test_several_lanes(state: np.ndarray, several: bool) -> None:
    """A car of 4 by 2 m against lanes of 4 m."""
    assert in_several_lanes(STREET, state, CAR[None]).tolist() == [several]


def test_three_consecutive_lanes_count_as_one() -> None:
    """Four do not."""
    chained = street_map()
    assert len(lane_table(chained).chains) == 6 + 2  # six lanes, and two pairs
    bus = np.array([[18.0, 2.5]])
    short = replace(
        chained,
        lanes=Ragged.pack([np.array([(x, 0), (x + 5, 0)]) for x in (0, 5, 10, 15)]),
        areas=Ragged.pack(
            [np.array([(x, 2), (x + 5, 2), (x + 5, -2), (x, -2)]) for x in (0, 5, 10, 15)]
        ),
        successors=np.array([(0, 1), (1, 2), (2, 3)]),
        two_way=np.zeros(4, dtype=bool),
        limits_mps=np.zeros(4),
        limited=np.zeros(4, dtype=bool),
    )
    assert in_several_lanes(short, at(10, 0), bus).tolist() == [True]
    assert in_several_lanes(short, at(10, 0), np.array([[9.0, 2.5]])).tolist() == [False]


@pytest.mark.parametrize(
    ("state", "crossing"),
    [
        (at(50, 0), True),
        (at(46.5, 0), True),  # its front is at 48.5 m, the crossing lane begins at 48 m
        (at(45, 0), False),
        (at(55, 0), False),  # its rear is at 53 m, the crossing lane ends at 52 m
        (at(50, -20, math.pi / 2), False),  # in the crossing lane, before the first other lane
        (at(50, -4, math.pi / 2), True),
        (at(20, 0), False),  # beside parallel and opposite lanes
        (at(104, 1.5, math.pi / 4), True),  # where `LEFT` leaves `ONWARDS` at 45°
        (at(150, 0), False),
    ],
)
def test_crossing(state: np.ndarray, crossing: bool) -> None:
    """At and between the metres at which another lane crosses, accurate to 1 m."""
    assert at_crossing(STREET, state, CAR[None]).tolist() == [crossing]


def test_against_the_traffic() -> None:
    """Each motion is projected on the lane in which it ends; only motion against it counts.

    Eastwards in the westbound lane is 3 m, 1 m back with the lane nothing. 3 m north and 4 m west
    in the eastbound lane are 4 m. Eastwards on the crossing is right for one of the lanes, 48 m
    west is not. 2 m west to a point without a lane and 5 m to another one are nothing.
    """
    xy = np.array([(10, 4), (13, 4), (12, 4), (8, 1), (49, 1), (1, 1), (-1, 1), (-6, 1)])
    found = against_traffic_m(STREET, xy.astype(float))
    np.testing.assert_allclose(found, [0, 3, 0, 4, 0, 48, 0, 0])


def test_of_overlapping_lanes_the_best_counts() -> None:
    """On the crossing east and north are right."""
    for step, metres in (((1, 0), 0), ((0, 1), 0), ((0, -1), 0), ((-1, 0), 0), ((-1, -2), 1)):
        # southwards is perpendicular to the eastbound lane and therefore not against it
        xy = np.array([(50, 0), np.array((50, 0)) + step], dtype=float)
        assert against_traffic_m(STREET, xy)[1] == pytest.approx(metres)


def test_two_way_lanes_and_gaps_have_no_wrong_direction() -> None:
    xy = np.array([(10.0, 4.0), (20.0, 4.0)])
    assert against_traffic_m(street_map(two_way=(WEST,)), xy).tolist() == [0, 0]
    assert against_traffic_m(street_map(without=(WEST,)), xy).tolist() == [0, 0]
    assert against_traffic_m(STREET, xy).tolist() == [0, 10]


@pytest.mark.parametrize(
    ("state", "limit"),
    [
        (at(10, 0), 10.0),
        (at(110, 10, math.pi / 4), 15.0),
        (at(150, 0), None),  # a lane without a limit
        (at(102, 0), 15.0),  # `ONWARDS` has no limit, `LEFT` has
        (at(10, 40), None),
        (at(10, 4), None),  # heading against the lane
        (at(10, 4, math.pi), 10.0),
    ],
)
def test_speed_limit(state: np.ndarray, limit: float | None) -> None:
    """The highest limit of the lanes that fit the heading."""
    found = speed_limits(STREET, state)
    assert (found.value[0] if found.valid[0] else None) == limit


def test_a_speed_limit_below_walking_pace_is_returned_as_it_is() -> None:
    slow = replace(STREET, limits_mps=np.full(6, 0.5))
    assert speed_limits(slow, at(10, 0)).value.tolist() == [0.5]


def test_reachable_lanes() -> None:
    """From `EAST` its successors; nothing from a point without a lane or heading against it."""
    assert set(np.flatnonzero(reachable_lanes(STREET, at(10, 0)[0]))) == {EAST, ONWARDS, LEFT}
    assert set(np.flatnonzero(reachable_lanes(STREET, at(10, 0, math.pi)[0]))) == set()
    assert set(np.flatnonzero(reachable_lanes(STREET, at(10, 4, math.pi)[0]))) == {WEST}
    assert set(np.flatnonzero(reachable_lanes(STREET, at(10, 40)[0]))) == set()


def test_distance_to_route_lanes() -> None:
    """4 m beside the lane is 1 m from the logged route; (120, 20) is on `LEFT`."""
    route = np.array([(0.0, 3.0), (120.0, 3.0)])
    states = np.concatenate([at(10, 0), at(20, 4), at(120, 20), at(10, -6)])
    np.testing.assert_allclose(distance_to_route_lanes_m(STREET, states, route), [0, 1, 0, 6])
    beside = street_map(without=(EAST,))  # the logged route replaces a missing lane
    np.testing.assert_allclose(distance_to_route_lanes_m(beside, states, route)[:2], [3, 1])


def test_maps_of_centre_lines_have_no_lane_areas() -> None:
    """Nothing is in several lanes, at a crossing, against the traffic or limited there."""
    state = at(20, 2)
    assert covering_lanes(BARE, state[:, :2]).shape == (1, 0)
    assert not in_several_lanes(BARE, state, CAR[None]).any()
    assert not at_crossing(BARE, state, CAR[None]).any()
    assert not against_traffic_m(BARE, np.array([(20.0, 4.0), (30.0, 4.0)])).any()
    assert not speed_limits(BARE, state).valid.any()
    assert distance_to_route_lanes_m(BARE, state, np.array([(0.0, 0.0), (50.0, 0.0)])).tolist() == [
        2.0
    ]


@given(
    pose=st.tuples(st.floats(-200, 200), st.floats(-200, 200), st.floats(-3, 3)),
    x=st.floats(1, 120),
    y=st.floats(-7, 7),
    heading=st.floats(-3, 3),
)
def test_lanes_do_not_depend_on_the_pose_of_the_street(
    pose: Pose, x: float, y: float, heading: float
) -> None:
    """Boxes with points on borders are left out, since rounding decides them."""
    elsewhere = moved_map(STREET, pose)
    state = at(x, y, heading)
    x_m, y_m = from_frame(state[0, :2], np.array(pose))
    moved = at(x_m, y_m, heading + pose[2])
    ahead = state[0, :2] + (1, 0)
    two = [
        np.stack([state[0, :2], ahead]),
        np.stack([moved[0, :2], from_frame(ahead, np.array(pose))]),
    ]
    borders = _distance_to_borders(STREET, state, two[0])
    if borders < 1e-6:
        return
    for one, other in (
        (in_several_lanes(STREET, state, CAR[None]), in_several_lanes(elsewhere, moved, CAR[None])),
        (covering_lanes(STREET, two[0]), covering_lanes(elsewhere, two[1])),
    ):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(
        against_traffic_m(STREET, two[0]), against_traffic_m(elsewhere, two[1]), atol=1e-6
    )


def _distance_to_borders(road_map: RoadMap, state: np.ndarray, points: np.ndarray) -> float:
    points = np.concatenate([box_corners(state, CAR[None])[0], points])
    away = np.inf
    for i in range(len(road_map.areas)):
        ring = road_map.areas[i]
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            away = min(away, np.hypot(*(points - a - share[:, None] * (b - a)).T).min())
    return float(away)
