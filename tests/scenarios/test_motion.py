"""Reconstruction of the motion of two axles from a point."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from scenarios.noise import measure, savitzky_golay
from scenarios.sumo.motion import ease_lane_changes, gaussian, reconstruct


def straight(speeds: np.ndarray, *, heading: float = 0.0) -> np.ndarray:
    """Positions every 0.1 s on a line through the origin."""
    arc = np.concatenate([[0.0], np.cumsum(speeds * 0.1)])
    return arc[:, None] * np.array([np.cos(heading), np.sin(heading)])


def test_a_circle_is_followed_with_the_rear_axle_inside() -> None:
    """On a circle of radius R the body lags the front axle's path by asin(wheelbase / R)."""
    radius, length = 20.0, 5.0
    angle = np.arange(0.0, 4.0 * np.pi, 0.03)
    way = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    motion = reconstruct(np.arange(len(way)) * 0.1, way, kind="car", length_m=length)
    assert motion is not None
    middle = motion.xy[len(motion.xy) * 3 // 4]
    heading = motion.heading_rad[len(motion.xy) * 3 // 4]
    front = middle + 1.5 * np.array([np.cos(heading), np.sin(heading)])
    course = np.arctan2(front[1], front[0]) + 0.5 * np.pi
    lag = (course - heading + np.pi) % (2 * np.pi) - np.pi
    assert np.isclose(lag, np.arcsin(3.0 / radius), atol=0.002)
    rear = middle - 1.5 * np.array([np.cos(heading), np.sin(heading)])
    assert np.isclose(np.hypot(*rear), np.sqrt(np.hypot(*front) ** 2 - 9.0), atol=0.01)


def test_a_straight_line_stays_one() -> None:
    """At 10 m/s on a line the middle is half a length behind the bumper and headings agree."""
    points = straight(np.full(80, 10.0), heading=0.5)
    motion = reconstruct(np.arange(81) * 0.1, points, kind="truck", length_m=8.0)
    assert motion is not None
    assert np.allclose(motion.heading_rad, 0.5, atol=1e-9)
    inside = slice(25, -25)
    arc = 10.0 * (motion.first_frame + np.arange(len(motion.xy))) / 25.0
    expected = (arc - 4.0)[:, None] * np.array([np.cos(0.5), np.sin(0.5)])
    assert np.abs(motion.xy[inside] - expected[inside]).max() < 1e-6


@given(st.lists(st.floats(0.0, 15.0), min_size=30, max_size=60), st.integers(10, 20))
def test_progress_never_goes_back_and_stops_stay(speeds: list[float], stop_at: int) -> None:
    """For any speeds, no agent moves backwards, and 4 s of standing include 2 s at one point."""
    plan = np.concatenate([speeds[:stop_at], np.zeros(40), speeds[stop_at:], [15.0] * 5])
    motion = reconstruct(np.arange(len(plan) + 1) * 0.1, straight(plan), kind="car", length_m=4.5)
    assert motion is not None
    steps = np.diff(motion.xy[:, 0])
    assert steps.min() >= -1e-9
    middle = round((stop_at * 0.1 + 2.0) * 25) - motion.first_frame
    assert np.abs(steps[middle - 25 : middle + 25]).max() < 1e-9


def test_a_lane_change_is_spread_over_the_path() -> None:
    """A jump of 3.5 m becomes a bend without steps that ends in the new lane."""
    points = straight(np.full(100, 10.0))
    points[40:, 1] += 3.5
    eased = ease_lane_changes(points)
    assert np.abs(np.diff(eased[:, 1])).max() < 0.3
    assert np.abs(eased[:40] - points[:40]).max() == 0.0
    assert np.abs(eased[68:] - points[68:]).max() < 1e-9


def test_opposite_lane_changes_while_standing_cancel() -> None:
    """Two opposite jumps at one position cancel."""
    points = straight(np.concatenate([np.full(30, 10.0), np.zeros(20), np.full(30, 10.0)]))
    points[40:45, 1] += 3.5
    assert np.abs(ease_lane_changes(points)[45:] - points[45:]).max() < 1e-9
    assert np.abs(ease_lane_changes(points)[:, 1]).max() < 1e-9


def test_smoothing_keeps_lines_and_cubics() -> None:
    """The Gaussian leaves a straight line, Savitzky-Golay of order 3 leaves a cubic."""
    at = np.linspace(-1.0, 1.0, 60)[:, None]
    assert np.allclose(gaussian(3.0 * at + 1.0, 4.0), 3.0 * at + 1.0)
    cubic = np.concatenate([at**3 - at, 2.0 * at**2], axis=1)
    assert np.allclose(savitzky_golay(cubic), cubic)


def test_measurement_errors_shrink_but_stay() -> None:
    """8 cm of white noise are smoothed to 2-5 cm without bias."""
    rng = np.random.default_rng(0)
    truth = np.stack([np.linspace(0.0, 80.0, 2000), np.zeros(2000)], axis=1)
    xy, heading = measure(rng, truth, np.zeros(2000))
    errors = xy - truth
    assert 0.02 < errors.std() < 0.05
    assert np.abs(errors.mean(axis=0)).max() < 0.01
    assert heading.std() < np.radians(1.5)


def test_an_agent_that_never_moves_has_no_motion() -> None:
    """A vehicle that stays where it was inserted is left out."""
    points = np.zeros((50, 2))
    assert reconstruct(np.arange(50) * 0.1, points, kind="car", length_m=4.5) is None
