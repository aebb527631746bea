"""The lines of a map as straight segments."""

import math

import numpy as np

from asp_env.data.road_map import LineType, MapCache
from asp_env.views.map_layers import line_segments
from tests.views.scenes import make_map


def test_segments_by_hand() -> None:
    """An L of 6 m and 8 m is two segments: middles, directions and half lengths."""
    road_map = make_map([(LineType.CURB, [(0, 0), (6, 0), (6, 8)])])
    expected = [[3, 0, 1, 0, 3], [6, 4, 0, 1, 4]]
    np.testing.assert_allclose(line_segments(road_map), expected, atol=1e-12)


def test_straight_lines_become_one_segment() -> None:
    """Points 1 m apart on a slope of 3 to 4, at most 2 cm off, are one segment of 50 m."""
    at = np.arange(51.0)
    wobble = 0.02 * np.sin(at) * np.sin(math.pi * at / 50)
    points = np.stack([0.8 * at - 0.6 * wobble, 0.6 * at + 0.8 * wobble], axis=1)
    segments = line_segments(make_map([(LineType.SOLID, points.tolist())]))
    np.testing.assert_allclose(segments, [[20, 15, 0.8, 0.6, 25]], atol=1e-12)


def test_closed_lines_remain_closed() -> None:
    """The segments of a closed circle of 10 m radius remain within 5 cm of the circle."""
    angle = np.linspace(0, 2 * math.pi, 361)
    points = 10 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points[-1] = points[0]
    segments = line_segments(make_map([(LineType.CURB, points.tolist())]))
    assert 2 * segments[:, 4].sum() > 2 * math.pi * 10 * 0.99
    assert (np.hypot(segments[:, 0], segments[:, 1]) > 9.95).all()
    assert len(segments) < 90


def test_repeated_and_single_points_are_left_out() -> None:
    lines = [(LineType.CURB, [(1, 1)]), (LineType.CURB, [(2, 2), (2, 2), (5, 2), (5, 2)])]
    segments = line_segments(make_map(lines))
    np.testing.assert_allclose(segments, [[3.5, 2, 1, 0, 1.5]])


def test_segments_are_cached_by_map() -> None:
    cache = MapCache(line_segments, 2)
    maps = [make_map([(LineType.CURB, [(0, 0), (i, 1)])]) for i in range(4)]
    first = cache(maps[0])
    assert cache(maps[0]) is first
    for road_map in maps:
        np.testing.assert_array_equal(cache(road_map), line_segments(road_map))
    assert cache(maps[0]) is not first
