"""Frames, boxes and paths by hand; round trips on generated poses."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays

from asp_env.geometry import (
    between_states,
    box_corners,
    from_frame,
    path_length,
    resample,
    route_along,
    states_to_frame,
    to_frame,
)

NUMBERS = st.floats(-1e3, 1e3)


def test_frame_by_hand() -> None:
    """Facing +y at (10, 5), the point (8, 9) lies 4 m ahead and 2 m to the left."""
    pose = np.array([10.0, 5.0, math.pi / 2])
    np.testing.assert_allclose(to_frame(np.array([8.0, 9.0]), pose), [4, 2], atol=1e-12)
    np.testing.assert_allclose(from_frame(np.array([4.0, 2.0]), pose), [8, 9], atol=1e-12)


@given(points=arrays(np.float64, (5, 2), elements=NUMBERS), pose=st.tuples(*[NUMBERS] * 3))
def test_there_and_back(points: np.ndarray, pose: tuple[float, float, float]) -> None:
    """Into a frame and out of it changes nothing; lengths never change."""
    frame = np.array(pose)
    inside = to_frame(points, frame)
    np.testing.assert_allclose(from_frame(inside, frame), points, atol=1e-9)
    apart, still_apart = (np.hypot(*(each[1:] - each[:-1]).T) for each in (points, inside))
    np.testing.assert_allclose(still_apart, apart, atol=1e-9)


def test_frames_broadcast() -> None:
    """Many points in one frame, and each point in its own, keep float32."""
    points = np.arange(12, dtype=np.float32).reshape(2, 3, 2)
    poses = np.array([(0, 0, 0, 9), (1, 1, 0, 9)], dtype=np.float32)
    found = to_frame(points, poses[:, None])
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, points - np.array([0, 1])[:, None, None])


def test_states_to_frame() -> None:
    """Headings turn along and are wrapped, speeds stay: 3 seen from -3 is 6 - 2π."""
    states = np.array([(8.0, 9.0, math.pi, 7.0), (0.0, 0.0, 3.0, -1.0)])
    poses = np.array([(10.0, 5.0, math.pi / 2, 0.0), (0.0, 0.0, -3.0, 0.0)])
    expected = [(4, 2, math.pi / 2, 7), (0, 0, 6 - 2 * math.pi, -1)]
    np.testing.assert_allclose(states_to_frame(states, poses), expected, atol=1e-12)


def test_between_states() -> None:
    """A quarter of the way; from 3 rad to -3 rad it turns on by 0.28, not back by 6."""
    before = np.array([(0, 8, 3, 4), (1, 1, 0.5, 0)], dtype=np.float32)
    after = np.array([(4, 0, -3, 8), (1, 1, 0.1, 0)], dtype=np.float32)
    found = between_states(before, after, 0.25)
    assert found.dtype == np.float32
    expected = [(1, 6, 3 + (2 * math.pi - 6) / 4, 5), (1, 1, 0.4, 0)]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert np.array_equal(between_states(before, after, 0.0), before)


def test_box_corners() -> None:
    """Front left first, then clockwise: 4 by 2 m, facing +x and facing +y."""
    states = np.array([(10.0, 5.0, 0.0, 0.0), (10.0, 5.0, math.pi / 2, 0.0)])
    expected = [
        [(12, 6), (12, 4), (8, 4), (8, 6)],
        [(9, 7), (11, 7), (11, 3), (9, 3)],
    ]
    np.testing.assert_allclose(box_corners(states, np.array([(4.0, 2.0)] * 2)), expected)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_path_length(dtype: type) -> None:
    """3-4-5 and 2 m make 7 m; standing adds nothing; a batch gives one length each."""
    points = np.array([(0, 0), (3, 4), (3, 4), (3, 6)], dtype=dtype)
    assert path_length(points) == pytest.approx(7)
    both = np.stack([points, points[::-1] * 2])
    np.testing.assert_allclose(path_length(both), [7, 14])
    assert path_length(points[:1]) == 0


def test_resample() -> None:
    """2.5 m around a corner give points at 0, 1 and 2 m, repeated points or not."""
    points = np.array([(0, 0), (0, 0), (1.5, 0), (1.5, 0), (1.5, 1)], dtype=np.float32)
    found = resample(points, 1.0)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, [(0, 0), (1, 0), (1.5, 0.5)], atol=1e-6)


def test_resample_ends() -> None:
    """The end belongs to it where the spacing divides; a single place stays one point."""
    straight = np.array([(0.0, 0.0), (3.0, 0.0)])
    np.testing.assert_allclose(resample(straight, 1.5), [(0, 0), (1.5, 0), (3, 0)])
    np.testing.assert_allclose(resample(np.array([(7.0, 7.0)] * 3), 1.0), [(7, 7)])


def test_route_along() -> None:
    """2 m along +x, then 3 m straight on: six points 1 m apart, jitter and rest left out."""
    x = np.array([0.0, 0.0, 0.2, -0.1, 1.0, 2.0, 2.1, 1.9, 2.0])
    states = np.stack([x, 0 * x, 0 * x, 0 * x], axis=-1).astype(np.float32)
    route = route_along(states, beyond_m=3.0)
    np.testing.assert_allclose(route, [(k, 0) for k in range(6)], atol=1e-5)
    assert route.dtype == np.float32


def test_route_of_one_who_stands() -> None:
    """Who never moves goes straight ahead."""
    states = np.tile(np.array([5.0, 5.0, math.pi / 2, 0.0]), (4, 1))
    np.testing.assert_allclose(route_along(states, beyond_m=2.0), [(5, 5), (5, 6), (5, 7)])


@given(radius=st.floats(5, 50), beyond_m=st.floats(1, 40))
def test_routes_have_equal_steps(radius: float, beyond_m: float) -> None:
    """Points are 1 m apart along the way; a chord of a curve of 5 m is at most 1 % shorter."""
    angle = np.linspace(0, 3, 200)
    states = np.stack(
        [radius * np.sin(angle), radius * (1 - np.cos(angle)), angle, 0 * angle], axis=-1
    )
    steps = np.hypot(*np.diff(route_along(states, beyond_m=beyond_m), axis=0).T)
    assert (steps < 1 + 1e-9).all()
    assert (steps > 0.99).all()
