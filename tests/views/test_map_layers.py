"""Filled areas and the segments of lines."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.road_map import LineType
from asp_env.views.map_layers import drivable_rings, fill_rings, line_segments
from asp_env.views.raster import Viewport, place_targets
from tests.views.scenes import make_map, make_scene, standing

HEIGHT, WIDTH = 20, 30
VIEWPORT = Viewport(
    height_px=HEIGHT, width_px=WIDTH, metres_per_pixel=1.0, anchor_row_px=20.0, anchor_column_px=0.0
)
"""Around an agent at the origin that heads north, columns are x and rows are 20 - y."""

Ring = Sequence[tuple[float, float]]


def fill(*rings: Ring) -> np.ndarray:
    """Mask of the pixels that rings of (column, row) set."""
    turned = [[(column, HEIGHT - row) for column, row in ring] for ring in rings]
    road_map = make_map(drivable=turned)
    scene = make_scene(standing([(0.0, 0.0, 0.5 * math.pi)]), maps=(road_map,))
    out = np.full((1, 3, HEIGHT, WIDTH), 77, dtype=np.uint8)
    placed = place_targets(scene, VIEWPORT, history=0, view_name="a test")
    fill_rings(drivable_rings(road_map), 0, placed, 5, out)
    assert set(np.unique(out[0, 0])) <= {0, 5}
    assert (out[0, 1:] == 77).all()
    return out[0, 0] > 0


def around(column: float, row: float, radii: Sequence[float], turn: float) -> Ring:
    """A star of points around a centre, at equal angles."""
    angles = [turn + 2 * math.pi * i / len(radii) for i in range(len(radii))]
    return [
        (column + r * math.cos(a), row + r * math.sin(a))
        for r, a in zip(radii, angles, strict=True)
    ]


STARS = st.builds(
    around,
    column=st.floats(-5, WIDTH + 5),
    row=st.floats(-5, HEIGHT + 5),
    radii=st.lists(st.floats(0.5, 20), min_size=3, max_size=12),
    turn=st.floats(-3, 3),
)


def test_rectangle_by_hand() -> None:
    """Columns 3.2 to 7.2 and rows 4.8 to 6.8 contain the centres of 4 by 2 pixels."""
    expected = np.zeros((HEIGHT, WIDTH), dtype=bool)
    expected[5:7, 3:7] = True
    np.testing.assert_array_equal(fill([(3.2, 4.8), (7.2, 4.8), (7.2, 6.8), (3.2, 6.8)]), expected)


def test_triangle_by_hand() -> None:
    """The diagonal of 4 by 4 pixels leaves 0, 1, 2 and 3 pixel centres in its rows."""
    drawn = fill([(10, 2.1), (10, 6.1), (14, 6.1)])
    assert drawn.sum(axis=1)[2:6].tolist() == [0, 1, 2, 3]
    assert drawn[5].nonzero()[0].tolist() == [10, 11, 12]


def test_a_concave_ring_leaves_its_notch_out() -> None:
    """A U-shaped ring consists of two legs and a floor."""
    ring = [(2, 2), (4, 2), (4, 8), (8, 8), (8, 2), (10, 2), (10, 10), (2, 10)]
    expected = np.zeros((HEIGHT, WIDTH), dtype=bool)
    expected[2:10, 2:10] = True
    expected[2:8, 4:8] = False
    np.testing.assert_array_equal(fill(ring), expected)


@pytest.mark.parametrize("ring", [[(3, 3), (9, 9)], [(3, 3)], [(3, 5), (9, 5), (6, 5)]])
def test_rings_without_an_inside_are_empty(ring: Ring) -> None:
    assert not fill(ring).any()


def test_without_rings_the_raster_is_cleared() -> None:
    assert not fill().any()


@given(ring=STARS)
def test_pixels_whose_centre_is_inside_are_set(ring: Ring) -> None:
    """As OpenCV decides for each pixel centre that is not on the edge."""
    contour = np.array(ring, dtype=np.float32)
    depth = np.array(
        [
            [cv2.pointPolygonTest(contour, (c + 0.5, r + 0.5), True) for c in range(WIDTH)]
            for r in range(HEIGHT)
        ]
    )
    decided = abs(depth) > 1e-3
    np.testing.assert_array_equal(fill(ring)[decided], (depth > 0)[decided])


@given(rings=st.lists(STARS, max_size=4))
def test_several_rings_fill_their_union_in_any_order(rings: list[Ring]) -> None:
    expected = np.zeros((HEIGHT, WIDTH), dtype=bool)
    for ring in rings:
        expected |= fill(ring)
    np.testing.assert_array_equal(fill(*rings), expected)
    np.testing.assert_array_equal(fill(*rings[::-1]), expected)


@given(
    radii=st.lists(st.floats(2, 15), min_size=5, max_size=9),
    turn=st.floats(-3, 3),
    centre=st.tuples(st.floats(0, WIDTH), st.floats(0, HEIGHT)),
)
def test_adjacent_rings_share_no_pixel_and_leave_none_out(
    radii: list[float], turn: float, centre: tuple[float, float]
) -> None:
    """Of a star cut into triangles at its centre, each pixel belongs to exactly one triangle."""
    ring = around(*centre, radii, turn)
    parts = [
        fill([centre, one, other]) for one, other in zip(ring, [*ring[1:], ring[0]], strict=True)
    ]
    np.testing.assert_array_equal(np.sum(parts, axis=0), fill(ring).astype(int))


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
