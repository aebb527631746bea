"""Lanes as strips: sides, ends and successors."""

import math
from typing import Any

import numpy as np
import pytest
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import RoadNetwork

from asp_env.errors import AspEnvError
from asp_env.geometry import arc_lengths, wrap_angle
from scenarios.highway.road_map import Strip, all_lanes, links, mirror_points, mouths, strips
from tests.scenarios.highway.maps import Place


def straight(*lanes: tuple[str, str, list[float], list[float]]) -> RoadNetwork:
    """Lanes of 4 m width between points in highway-env's axes, dashed left, continuous right."""
    network = RoadNetwork()
    for begin, end, start_m, end_m in lanes:
        types: Any = (LineType.STRIPED, LineType.CONTINUOUS)
        network.add_lane(begin, end, StraightLane(start_m, end_m, line_types=types))
    return network


def turned_rad(strip: Strip) -> float:
    """Change of a lane's heading, left positive."""
    steps = np.diff(strip.centre, axis=0)
    return float(wrap_angle(np.diff(np.arctan2(steps[:, 1], steps[:, 0]))).sum())


def test_a_lane_alone() -> None:
    """10 m to the east: left is north (+y), right is south, and 5 m are added at both ends."""
    (strip,) = strips(straight(("a", "b", [0.0, 0.0], [10.0, 0.0]))).values()
    np.testing.assert_allclose(strip.left, [[-5, 2], [0, 2], [10, 2], [15, 2]])
    np.testing.assert_allclose(strip.centre[:, 1], 0)
    np.testing.assert_allclose(strip.right, [[-5, -2], [0, -2], [10, -2], [15, -2]])
    assert strip.line_types == (LineType.STRIPED, LineType.CONTINUOUS)
    assert strip.speed_limit_mps == 20.0


def test_left_borders_are_to_the_left(place: Place) -> None:
    """Seen along any lane, its left border lies to the left and its right border to the right."""
    for strip in strips(place.network).values():
        along = np.diff(strip.centre, axis=0)
        for side, sign in ((strip.left, 1.0), (strip.right, -1.0)):
            aside = (side - strip.centre)[:-1]
            assert (sign * (along[:, 0] * aside[:, 1] - along[:, 1] * aside[:, 0]) > 0).all()


def test_traffic_keeps_to_the_right(intersection: Place) -> None:
    """The southern entry leads north to the right of x = 0; the exit is to the left."""
    found = strips(intersection.network)
    way_in, way_out = found["o0", "ir0", 0], found["il0", "o0", 0]
    np.testing.assert_allclose(way_in.centre, [[2, -116], [2, -111], [2, -11]], atol=1e-9)
    np.testing.assert_allclose(way_out.centre, [[-2, -11], [-2, -111], [-2, -116]], atol=1e-9)
    # The road's middle is dashed and its outside continuous.
    assert way_in.line_types == (LineType.STRIPED, LineType.CONTINUOUS)


def test_turns_of_the_intersection(intersection: Place) -> None:
    """The left turn from the south has a radius of 13 m, the right turn one of 9 m."""
    found = strips(intersection.network)
    left, right = found["ir0", "il1", 0], found["ir0", "il3", 0]
    assert turned_rad(left) == pytest.approx(0.5 * np.pi, abs=math.radians(2.1))
    assert turned_rad(right) == pytest.approx(-0.5 * np.pi, abs=math.radians(2.1))
    assert arc_lengths(left.centre)[-1] == pytest.approx(13 * 0.5 * np.pi, abs=0.01)
    assert arc_lengths(right.centre)[-1] == pytest.approx(9 * 0.5 * np.pi, abs=0.01)
    np.testing.assert_allclose(left.centre[-1], [-11, 2], atol=1e-9)
    np.testing.assert_allclose(right.centre[-1], [11, -2], atol=1e-9)


def test_the_ring_runs_counter_clockwise(roundabout: Place) -> None:
    """Its lanes turn counter-clockwise, by one turn each."""
    ring = [f"{a}{b}" for a, b in ("se", "ex", "ee", "nx", "ne", "wx", "we", "sx")]
    found = strips(roundabout.network)
    for lane, radius in ((0, 20.0), (1, 24.0)):
        parts = [found[a, b, lane] for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)]
        length = sum(arc_lengths(part.centre)[-1] for part in parts)
        assert length == pytest.approx(2 * np.pi * radius, abs=0.03)
        assert min(turned_rad(part) for part in parts) > 0


def test_polylines_follow_the_lanes(place: Place) -> None:
    """No point of a border or a centre line is off by more than 1.5 cm, chords included."""
    worst = 0.0
    found = strips(place.network)
    for index, lane in all_lanes(place.network).items():
        strip = found[index]
        lines = (strip.left, strip.centre, strip.right)
        for line, lateral in zip(lines, (-2.0, 0.0, 2.0), strict=True):
            share = np.linspace(0, 1, 5)[:, None, None]
            points = line[:-1] + share * np.diff(line, axis=0)
            there = mirror_points(points.reshape(-1, 2))
            local = np.array([lane.local_coordinates(point) for point in there])
            own = (local[:, 0] > -1e-6) & (local[:, 0] < lane.length + 1e-6)
            assert own.sum() >= 5
            worst = max(worst, np.abs(local[own, 1] - lateral).max())
    assert worst < 0.015


def test_links_of_the_intersection(intersection: Place) -> None:
    """Each entry leads to three turns, each turn to one exit; no exit leads to an entry."""
    found = links(intersection.network)
    assert len(found) == len(set(found)) == 4 * 3 + 12
    assert (("o0", "ir0", 0), ("ir0", "il1", 0)) in found
    assert not any(leader[0].startswith("il") for leader, _ in found)


def test_links_of_the_roundabout(roundabout: Place) -> None:
    """Entries and exits join the outer lane of the ring only; its lanes lead to themselves."""
    found = links(roundabout.network)
    assert len(found) == len(set(found)) == 2 * 8 + 4 * 4
    assert (("ses", "se", 0), ("se", "ex", 1)) in found
    assert (("ses", "se", 0), ("se", "ex", 0)) not in found
    assert (("se", "ex", 1), ("ex", "exs", 0)) in found
    assert (("se", "ex", 0), ("ex", "exs", 0)) not in found
    assert (("se", "ex", 0), ("ex", "ee", 0)) in found


def test_lanes_meet(place: Place) -> None:
    """Where one lane leads to another, all three of its lines end where the other's begin."""
    found = strips(place.network)
    for leader, follower in links(place.network):
        a, b = found[leader], found[follower]
        for end, start in ((a.left, b.left), (a.centre, b.centre), (a.right, b.right)):
            np.testing.assert_allclose(end[-1], start[0], atol=1e-6)


def test_only_gaps_have_mouths(intersection: Place, roundabout: Place) -> None:
    """The intersection's lanes all meet; the roundabout's four entries and exits do not."""
    assert mouths(intersection.network) == []
    assert len(mouths(roundabout.network)) == 8


def test_a_gap_between_forks_is_refused() -> None:
    """Two lanes lead to a node and two start 3 m further: the gap cannot be assigned."""
    network = straight(
        ("a", "m", [0.0, 0.0], [10.0, 0.0]),
        ("b", "m", [0.0, 5.0], [10.0, 0.0]),
        ("m", "c", [13.0, 0.0], [20.0, 0.0]),
        ("m", "d", [13.0, 0.0], [20.0, 5.0]),
    )
    with pytest.raises(AspEnvError, match="ends short of"):
        strips(network)
