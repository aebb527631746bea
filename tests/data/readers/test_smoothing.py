"""States from positions: exact tracks are unchanged, noise is removed, headings follow."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.readers.smoothing import count_held, find_jumps, follow_heading, smooth
from asp_env.geometry import wrap_angle
from tests.data.interaction_files import LENGTH_M, drive

REAR_M = 0.3 * LENGTH_M
DT_S = 0.1


def heading_errors_deg(headings: np.ndarray, states: np.ndarray) -> np.ndarray:
    return np.degrees(np.abs(wrap_angle(headings - states[:, 2])))


def test_constant_acceleration_is_unchanged() -> None:
    """2 t + t² m: at 1 s 3 m and 4 m/s, to millimetres, without a measured speed."""
    time = np.arange(31) * DT_S
    positions = np.stack([2 * time + time**2, np.zeros(31)], axis=-1)
    smoothed, velocities = smooth(positions, DT_S)
    np.testing.assert_allclose(smoothed, positions, atol=0.01)
    assert smoothed[10, 0] == pytest.approx(3.0, abs=0.002)
    assert velocities[10, 0] == pytest.approx(4.0, abs=0.02)
    assert (velocities[:, 1] == 0).all()


def test_equal_positions_are_unchanged() -> None:
    """Their speed is zero."""
    smoothed, velocities = smooth(np.full((40, 2), 7.0), DT_S)
    np.testing.assert_allclose(smoothed, 7.0, atol=1e-9)
    np.testing.assert_allclose(velocities, 0.0, atol=1e-9)


def test_noise_is_reduced() -> None:
    """Of 0.3 m of white noise at 12 m/s a third remains; speeds are right to 0.4 m/s (rms)."""
    rng = np.random.default_rng(3)
    states = drive((0, 0, 0.4, 12), [(6, 0, 0), (4, -2, 0.05)], 10)
    noise = 0.3 * rng.standard_normal((len(states), 2))
    smoothed, velocities = smooth(states[:, :2] + noise, DT_S)
    left = np.sqrt(((smoothed - states[:, :2]) ** 2).mean())
    assert left < 0.1
    assert np.sqrt(((np.hypot(*velocities.T) - states[:, 3]) ** 2).mean()) < 0.4


@given(
    shift=st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)),
    turn=st.floats(-math.pi, math.pi),
    seed=st.integers(0, 99),
    rows=st.integers(2, 60),
)
def test_smoothing_commutes_with_rigid_motion(
    shift: tuple[float, float], turn: float, seed: int, rows: int
) -> None:
    """Translated and rotated tracks give translated and rotated results."""
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.normal((1, 0), 0.2, (rows, 2)), axis=0)
    cosine, sine = math.cos(turn), math.sin(turn)
    matrix = np.array([[cosine, sine], [-sine, cosine]])
    smoothed, velocities = smooth(positions, DT_S)
    turned, turned_velocities = smooth(positions @ matrix + shift, DT_S)
    np.testing.assert_allclose(turned, smoothed @ matrix + shift, atol=1e-5)
    np.testing.assert_allclose(turned_velocities, velocities @ matrix, atol=1e-4)


def test_the_slip_angle_in_a_bend() -> None:
    """On a circle of 10 m the box's centre moves at asin(1.35 / 10) = 7.76° to its heading."""
    angles = np.arange(200) * 0.05
    positions = 10 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    headings = follow_heading(positions, None, REAR_M, DT_S)
    course = wrap_angle(angles + math.pi / 2)
    slip = np.degrees(wrap_angle(course - headings))
    np.testing.assert_allclose(slip[50:], math.degrees(math.asin(0.135)), atol=0.1)


def test_the_heading_is_constant_while_standing() -> None:
    """A bend, a stand of 5 s with a jitter of 1 mm, another bend: right to 1°."""
    states = drive((0, 0, 1, 6), [(3, 0, 0.2), (2, -3, 0.2), (5, 0, 0), (3, 1.5, -0.1)], 10)
    jitter = 0.001 * np.random.default_rng(1).standard_normal((len(states), 2))
    headings = follow_heading(states[:, :2] + jitter, None, REAR_M, DT_S)
    assert heading_errors_deg(headings, states)[5:].max() < 1.0
    standing = states[:, 3] < 0.01
    assert np.ptp(headings[standing]) == 0


def test_the_first_motion_gives_the_first_heading() -> None:
    """The measured heading only determines the front."""
    states = drive((0, 0, -2, 0), [(3, 0, 0), (4, 1, 0)], 10)
    headings = follow_heading(states[:, :2], np.full(len(states), -1.0), REAR_M, DT_S)
    assert heading_errors_deg(headings, states).max() < 0.01


def test_a_vehicle_that_never_moves() -> None:
    """The circular mean of the measured headings, or 0; folded headings have no front."""
    positions = np.zeros((4, 2))
    measured = np.array([3.1, -3.1, 3.1, -3.1])
    assert np.abs(follow_heading(positions, measured, REAR_M, DT_S)) == pytest.approx(math.pi)
    assert (follow_heading(positions, None, REAR_M, DT_S) == 0).all()
    across = np.array([1.55, -1.55, 1.55, -1.55])
    found = follow_heading(positions, across, REAR_M, DT_S, folded=True)
    assert np.abs(found) == pytest.approx(math.pi / 2)


def test_driving_backwards() -> None:
    """Forward, back, forward: a constant heading. With a measured heading, all may be backwards."""
    forward = np.linspace(0, 10, 51)
    there_and_back = np.concatenate([forward, forward[:-1][::-1][:30], forward[20:]])
    positions = np.stack([there_and_back, np.zeros_like(there_and_back)], axis=-1)
    assert (follow_heading(positions, None, REAR_M, DT_S) == 0).all()
    backwards = positions[:51][::-1]
    measured = np.zeros(51)
    assert np.abs(wrap_angle(follow_heading(backwards, measured, REAR_M, DT_S))).max() < 1e-9
    assert np.abs(follow_heading(backwards, None, REAR_M, DT_S)).min() == pytest.approx(math.pi)


def test_jumps() -> None:
    """A displaced end of a track, a displaced row, also at either end; hard braking is no jump."""
    time = np.arange(40) * DT_S
    straight = np.stack([8 * time, np.zeros(40)], axis=-1)
    assert not find_jumps(straight).any()
    shifted = straight.copy()
    shifted[20:, 1] += 1.6
    assert np.flatnonzero(find_jumps(shifted)).tolist() == [19]
    for row, steps in ((20, [19, 20]), (0, [0]), (39, [38])):
        single = straight.copy()
        single[row] += (0.0, 2.0)
        assert np.flatnonzero(find_jumps(single)).tolist() == steps
    braking = drive((0, 0, 0, 20), [(1, 0, 0), (3, -9, 0)], 10)
    assert not find_jumps(braking[:, :2]).any()
    assert find_jumps(straight[:1]).shape == (0,)
    assert not find_jumps(np.array([[0.0, 0.0], [9.0, 0.0]])).any()


def test_repeated_first_positions() -> None:
    """Three equal rows, then 10 m/s: repeated. Equal for 1.2 s, or followed by 1 m/s²: a stand."""
    moving = np.stack([np.arange(10.0), np.zeros(10)], axis=-1)
    held = np.repeat(moving[:1], 3, axis=0)
    assert count_held(np.concatenate([held, moving]), DT_S) == 3
    assert count_held(np.concatenate([np.repeat(held, 4, axis=0), moving]), DT_S) == 0
    assert count_held(drive((0, 0, 0, 0), [(0.5, 0, 0), (3, 1, 0)], 10)[:, :2], DT_S) == 0
    assert count_held(moving, DT_S) == 0
    assert count_held(held, DT_S) == count_held(held[:1], DT_S) == 0
