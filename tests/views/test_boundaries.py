"""Boundaries: which pieces a map's lines become."""

import math

import numpy as np

from asp_env.data.road_map import LineType, MapCache
from asp_env.views.map_layers import boundary_pieces
from tests.views.scenes import make_map


def test_pieces_by_hand() -> None:
    """An L of 6 m and 8 m: two pieces, their middles, directions and half lengths."""
    road_map = make_map([(LineType.CURB, [(0, 0), (6, 0), (6, 8)])])
    expected = [[3, 0, 1, 0, 3], [6, 4, 0, 1, 4]]
    np.testing.assert_allclose(boundary_pieces(road_map), expected, atol=1e-12)


def test_straight_lines_become_one_piece() -> None:
    """Points 1 m apart on a slope of 3 to 4, off by 2 cm at most: one piece of 50 m."""
    at = np.arange(51.0)
    wobble = 0.02 * np.sin(at) * np.sin(math.pi * at / 50)
    points = np.stack([0.8 * at - 0.6 * wobble, 0.6 * at + 0.8 * wobble], axis=1)
    pieces = boundary_pieces(make_map([(LineType.SOLID, points.tolist())]))
    np.testing.assert_allclose(pieces, [[20, 15, 0.8, 0.6, 25]], atol=1e-12)


def test_rings_stay_rings() -> None:
    """A circle of 10 m that ends where it began stays within 5 cm of the circle."""
    angle = np.linspace(0, 2 * math.pi, 361)
    points = 10 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points[-1] = points[0]
    pieces = boundary_pieces(make_map([(LineType.CURB, points.tolist())]))
    assert 2 * pieces[:, 4].sum() > 2 * math.pi * 10 * 0.99
    assert (np.hypot(pieces[:, 0], pieces[:, 1]) > 9.95).all()
    assert len(pieces) < 90


def test_repeated_and_single_points_are_no_pieces() -> None:
    """Points without extent draw nothing; the rest of the line stays."""
    lines = [(LineType.CURB, [(1, 1)]), (LineType.CURB, [(2, 2), (2, 2), (5, 2), (5, 2)])]
    pieces = boundary_pieces(make_map(lines))
    np.testing.assert_allclose(pieces, [[3.5, 2, 1, 0, 1.5]])


def test_each_map_is_worked_out_once() -> None:
    """The same map gives the same array, another map another one."""
    cache = MapCache(boundary_pieces, 2)
    maps = [make_map([(LineType.CURB, [(0, 0), (i, 1)])]) for i in range(4)]
    first = cache(maps[0])
    assert cache(maps[0]) is first
    for road_map in maps:
        np.testing.assert_array_equal(cache(road_map), boundary_pieces(road_map))
    assert cache(maps[0]) is not first
