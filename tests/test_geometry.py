"""Angles, frames, boxes, polylines and routes: by hand, and laws on generated inputs."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis.extra.numpy import arrays

from asp_env.geometry import (
    arc_lengths,
    between_states,
    box_corners,
    boxes_overlap,
    from_frame,
    path_length,
    point_on_route,
    points_at,
    project,
    resample,
    route_along,
    states_to_frame,
    to_frame,
    wrap_angle,
    wrap_scalar,
)

NUMBERS = st.floats(-1e3, 1e3)


@given(angle=st.floats(-1e4, 1e4), dtype=st.sampled_from([np.float32, np.float64]))
def test_wrapped_angle_is_the_same_angle(angle: float, dtype: type) -> None:
    """Wrapping changes neither sine nor cosine, keeps the dtype, and ends within π of zero."""
    given_angle = np.array(angle, dtype=dtype)
    wrapped = wrap_angle(given_angle)
    assert wrapped.dtype == dtype
    assert abs(wrapped) <= dtype(math.pi)
    turned = float(wrapped) - float(given_angle)
    slack = 1e-2 if dtype is np.float32 else 1e-11
    assert abs(math.remainder(turned, 2 * math.pi)) < slack


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(0.0, 0.0), (math.pi, -math.pi), (-math.pi, -math.pi), (7.0, 7 - 2 * math.pi)],
)
def test_wrapped_angle_by_hand(angle: float, wrapped: float) -> None:
    """π becomes -π, 7 becomes 7 - 2π."""
    assert wrap_angle(angle) == pytest.approx(wrapped, abs=1e-12)
    assert wrap_scalar(angle) == pytest.approx(wrapped, abs=1e-12)


@given(angle=st.floats(-1e3, 1e3))
def test_compiled_wrap_agrees_with_that_of_arrays(angle: float) -> None:
    assert -math.pi <= wrap_scalar(angle) <= math.pi
    difference = wrap_scalar(angle) - float(wrap_angle(np.float64(angle)))
    assert abs(math.remainder(difference, 2 * math.pi)) < 1e-12


def test_frame_by_hand() -> None:
    """In a frame at (10, 5) that faces +y, the point (8, 9) is 4 m ahead and 2 m to the left."""
    pose = np.array([10.0, 5.0, math.pi / 2])
    np.testing.assert_allclose(to_frame(np.array([8.0, 9.0]), pose), [4, 2], atol=1e-12)
    np.testing.assert_allclose(from_frame(np.array([4.0, 2.0]), pose), [8, 9], atol=1e-12)


@given(points=arrays(np.float64, (5, 2), elements=NUMBERS), pose=st.tuples(*[NUMBERS] * 3))
def test_from_frame_inverts_to_frame(points: np.ndarray, pose: tuple[float, float, float]) -> None:
    """The round trip changes nothing; distances are the same in any frame."""
    frame = np.array(pose)
    local = to_frame(points, frame)
    np.testing.assert_allclose(from_frame(local, frame), points, atol=1e-9)
    distances, local_distances = (np.hypot(*(each[1:] - each[:-1]).T) for each in (points, local))
    np.testing.assert_allclose(local_distances, distances, atol=1e-9)


@given(points=arrays(np.float64, (5, 2), elements=NUMBERS), pose=st.tuples(*[NUMBERS] * 3))
def test_frames_of_tensors_equal_those_of_arrays(
    points: np.ndarray, pose: tuple[float, float, float]
) -> None:
    local = to_frame(torch.from_numpy(points), torch.tensor(pose, dtype=torch.float64))
    np.testing.assert_allclose(local.numpy(), to_frame(points, np.array(pose)), atol=1e-9)


def test_frames_broadcast() -> None:
    """Several points per frame and one point per frame are allowed; float32 stays float32."""
    points = np.arange(12, dtype=np.float32).reshape(2, 3, 2)
    poses = np.array([(0, 0, 0, 9), (1, 1, 0, 9)], dtype=np.float32)
    found = to_frame(points, poses[:, None])
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, points - np.array([0, 1])[:, None, None])


def test_states_to_frame() -> None:
    """Headings are relative and wrapped, speeds do not change: 3 rad relative to -3 is 6 - 2π."""
    states = np.array([(8.0, 9.0, math.pi, 7.0), (0.0, 0.0, 3.0, -1.0)])
    poses = np.array([(10.0, 5.0, math.pi / 2, 0.0), (0.0, 0.0, -3.0, 0.0)])
    expected = [(4, 2, math.pi / 2, 7), (0, 0, 6 - 2 * math.pi, -1)]
    np.testing.assert_allclose(states_to_frame(states, poses), expected, atol=1e-12)


def test_between_states() -> None:
    """From 3 rad to -3 rad the heading turns by 0.28 rad, not back by 6 rad."""
    before = np.array([(0, 8, 3, 4), (1, 1, 0.5, 0)], dtype=np.float32)
    after = np.array([(4, 0, -3, 8), (1, 1, 0.1, 0)], dtype=np.float32)
    found = between_states(before, after, 0.25)
    assert found.dtype == np.float32
    expected = [(1, 6, 3 + (2 * math.pi - 6) / 4, 5), (1, 1, 0.4, 0)]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert np.array_equal(between_states(before, after, 0.0), before)


def test_box_corners() -> None:
    """Front left first, then clockwise; the box of 4 m by 2 m faces +x, then +y."""
    states = np.array([(10.0, 5.0, 0.0, 0.0), (10.0, 5.0, math.pi / 2, 0.0)])
    expected = [
        [(12, 6), (12, 4), (8, 4), (8, 6)],
        [(9, 7), (11, 7), (11, 3), (9, 3)],
    ]
    np.testing.assert_allclose(box_corners(states, np.array([(4.0, 2.0)] * 2)), expected)


def test_boxes_overlap_by_hand() -> None:
    """Unit squares 0.9 apart overlap, 1.1 apart do not; one turned by 45° reaches 0.2 further."""
    square = np.array([[0.0, 0.0, 0.0, 1.0, 1.0]])
    cases = [(0.9, 0.0, True), (1.1, 0.0, False), (1.1, 45.0, True), (1.25, 45.0, False)]
    for x, degrees, expected in cases:
        other = np.array([[x, 0.0, math.radians(degrees), 1.0, 1.0]])
        assert boxes_overlap(square, other).tolist() == [expected]
        assert boxes_overlap(other, square).tolist() == [expected]


@pytest.mark.parametrize("place", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 1.0)])
def test_boxes_that_touch_do_not_overlap(place: tuple[float, float]) -> None:
    """Unit squares side by side have a common edge or corner; 1 mm nearer they overlap."""
    square = np.array([[0.0, 0.0, 0.0, 1.0, 1.0]])
    other = np.array([[*place, 0.0, 1.0, 1.0]])
    assert boxes_overlap(square, other).tolist() == [False]
    assert boxes_overlap(square, other * [0.999, 0.999, 1, 1, 1]).tolist() == [True]


def test_boxes_overlap_as_their_corners_do() -> None:
    """Boxes overlap unless an edge's direction separates the corners of one from the other's."""
    rng = np.random.default_rng(0)
    boxes, others = (
        np.concatenate(
            [rng.uniform(-6, 6, (5_000, 2)), rng.uniform(-4, 4, (5_000, 1)),
             rng.uniform(0.5, 10, (5_000, 1)), rng.uniform(0.5, 3, (5_000, 1))], axis=1,
        )
        for _ in range(2)
    )  # fmt: skip
    a, b = (box_corners(each[:, :3], each[:, 3:]) for each in (boxes, others))
    expected = np.ones(len(a), dtype=bool)
    for corners in (a, b):
        for axis in (corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1]):
            along_a, along_b = (np.einsum("nij,nj->ni", each, axis) for each in (a, b))
            expected &= along_a.min(axis=1) < along_b.max(axis=1)
            expected &= along_b.min(axis=1) < along_a.max(axis=1)
    assert 0.1 < expected.mean() < 0.9
    np.testing.assert_array_equal(boxes_overlap(boxes, others), expected)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_path_length(dtype: type) -> None:
    """A 3-4-5 triangle and 2 m make 7 m; repeated points add nothing; batches are allowed."""
    points = np.array([(0, 0), (3, 4), (3, 4), (3, 6)], dtype=dtype)
    assert path_length(points) == pytest.approx(7)
    both = np.stack([points, points[::-1] * 2])
    np.testing.assert_allclose(path_length(both), [7, 14])
    assert path_length(points[:1]) == 0


def test_points_at_arc_lengths() -> None:
    """Around a corner of 3 m and 4 m; beyond the ends they are the end points."""
    line = np.array([(0.0, 0.0), (3.0, 0.0), (3.0, 4.0)])
    arc_m = arc_lengths(line)
    np.testing.assert_allclose(arc_m, [0, 3, 7])
    found = points_at(line, arc_m, np.array([[-1.0, 1.5], [5.0, 9.0]]))
    np.testing.assert_allclose(found, [[(0, 0), (1.5, 0)], [(3, 2), (3, 4)]])


def test_resample() -> None:
    """2.5 m around a corner give points at 0, 1 and 2 m, with or without repeated points."""
    points = np.array([(0, 0), (0, 0), (1.5, 0), (1.5, 0), (1.5, 1)], dtype=np.float32)
    found = resample(points, 1.0)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, [(0, 0), (1, 0), (1.5, 0.5)], atol=1e-6)


def test_resample_ends() -> None:
    """The end is included where the spacing divides the length; one place gives one point."""
    straight = np.array([(0.0, 0.0), (3.0, 0.0)])
    np.testing.assert_allclose(resample(straight, 1.5), [(0, 0), (1.5, 0), (3, 0)])
    np.testing.assert_allclose(resample(np.array([(7.0, 7.0)] * 3), 1.0), [(7, 7)])


def test_route_along() -> None:
    """2 m along +x, then 3 m straight on are six points 1 m apart; jitter leaves no trace."""
    x = np.array([0.0, 0.0, 0.2, -0.1, 1.0, 2.0, 2.1, 1.9, 2.0])
    states = np.stack([x, 0 * x, 0 * x, 0 * x], axis=-1).astype(np.float32)
    route = route_along(states, beyond_m=3.0)
    np.testing.assert_allclose(route, [(k, 0) for k in range(6)], atol=1e-5)
    assert route.dtype == np.float32


def test_route_of_a_standing_agent_goes_straight_ahead() -> None:
    states = np.tile(np.array([5.0, 7.0, math.pi / 2, 0.0]), (4, 1))
    np.testing.assert_allclose(route_along(states, beyond_m=2.0), [(5, 7), (5, 8), (5, 9)])


def test_a_route_has_positions_from_half_a_metre_on() -> None:
    """0.5 m up and 3 m ahead; without the position at 0.5 m it would be a diagonal."""
    states = np.array([(0, 0, 0, 0), (0, 0.5, 0, 0), (3.5, 0.5, 0, 0)], dtype=np.float64)
    expected = [(0, 0), *((x + 0.5, 0.5) for x in range(5))]
    np.testing.assert_allclose(route_along(states, beyond_m=1.0), expected)


def test_lengths_of_long_lines_are_sums_in_double_precision() -> None:
    """10,000 steps of 0.1 m to and fro are 1000 m; sums in single precision would be 999.9 m."""
    points = np.zeros((10_001, 2), dtype=np.float32)
    points[1::2, 0] = 0.1
    exact = 10_000 * float(np.float32(0.1))
    assert path_length(points) == pytest.approx(exact, rel=1e-12)
    assert arc_lengths(points)[-1] == pytest.approx(exact, rel=1e-12)
    assert len(resample(points, 1.0)) == 1001


@given(radius=st.floats(5, 50), beyond_m=st.floats(1, 40))
def test_routes_have_equal_steps(radius: float, beyond_m: float) -> None:
    """Points are 1 m apart along the route; chords of a curve of 5 m are at most 1 % shorter."""
    angle = np.linspace(0, 3, 200)
    states = np.stack(
        [radius * np.sin(angle), radius * (1 - np.cos(angle)), angle, 0 * angle], axis=-1
    )
    steps = np.hypot(*np.diff(route_along(states, beyond_m=beyond_m), axis=0).T)
    assert (steps < 1 + 1e-9).all()
    assert (steps > 0.99).all()


@pytest.mark.parametrize("near_m", [5.0, 5.9])
@pytest.mark.parametrize(("x", "arc_m"), [(2.5, 3.0), (3.5, 3.5), (7.5, 7.5), (8.5, 8.0)])
def test_project_searches_whole_segments_within_reach(
    near_m: float, x: float, arc_m: float
) -> None:
    """Within 2 m of 5 or 5.9 m along the route are the five segments from 3 to 8 m."""
    route = np.arange(21.0)[:, None] * np.array([1.0, 0.0])
    assert project(route, len(route), x, 0.0, near_m, 2.0)[0] == pytest.approx(arc_m)


def test_points_beside_segments_that_are_shorter_than_1_m() -> None:
    """Half of a segment of 0.5 m is 0.25 m; 2 m to the left are 2 m. Of length 0 it is a point."""
    route = np.array([(0.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.5, 0.5)])
    assert point_on_route(route, 2, 0.5, 2.0) == pytest.approx((0.25, 2.0, 0.5, 0.0))
    assert point_on_route(route, 3, 1.5, 2.0) == pytest.approx((-1.5, 0.25, 0.0, 0.5))
    assert point_on_route(route, 4, 2.5, 2.0) == pytest.approx((0.5, 0.5, 0.0, 0.0))


@given(arc_m=st.floats(-10, 40), left_m=st.floats(-4, 4))
def test_project_inverts_point_on_route(arc_m: float, left_m: float) -> None:
    """On a straight route, also beyond both of its ends."""
    direction = np.array([math.cos(0.3), math.sin(0.3)])
    route = np.arange(31.0)[:, None] * direction
    x, y, dx, dy = point_on_route(route, len(route), arc_m, left_m)
    found = project(route, len(route), x, y, -1.0, 0.0)
    np.testing.assert_allclose(found, (arc_m, left_m, 0.3), atol=1e-9)
    np.testing.assert_allclose((dx, dy), direction, atol=1e-12)
