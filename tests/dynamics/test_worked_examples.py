"""The bicycle model against numbers computed by hand."""

import math
from typing import Literal

import numpy as np
import pytest

from asp_env.dynamics import forward, inverse, rollout

LENGTH_M = np.array(4.0)  # both axles 1.2 m from the centre


def drive(
    start: tuple[float, float, float, float],
    actions: list[tuple[float, float]],
    *,
    dt_s: float = 0.2,
    integrator: Literal["heun", "euler"] = "heun",
    reverse: bool = False,
) -> np.ndarray:
    """The states after each action."""
    return rollout(
        np.array(start), np.array(actions), LENGTH_M, dt_s, integrator=integrator, reverse=reverse
    )


def test_straight() -> None:
    """10 m/s along +y for 0.2 s are 2 m; an acceleration of 1 m/s² adds 0.02 m."""
    ahead, faster = (
        drive((3.0, 4.0, math.pi / 2, 10.0), [(acceleration, 0.0)])[0]
        for acceleration in (0.0, 1.0)
    )
    np.testing.assert_allclose(ahead, [3, 6, math.pi / 2, 10], atol=1e-12)
    np.testing.assert_allclose(faster, [3, 6.02, math.pi / 2, 10.2], atol=1e-12)


def test_one_euler_step() -> None:
    """For tan δ = 0.5 the slip is atan(0.25): 2 m are (4, 1)·2/√17, the turn 2/1.2/√17."""
    (state,) = drive((0.0, 0.0, 0.0, 10.0), [(2.0, math.atan(0.5))], integrator="euler")
    root = math.sqrt(17)
    np.testing.assert_allclose(state, [8 / root, 2 / root, 2 / 1.2 / root, 10.4], atol=1e-12)


def test_one_heun_step() -> None:
    """Mean of both ends of the step: 10 m/s at course β, and 10.4 m/s turned by Euler's step."""
    (state,) = drive((0.0, 0.0, 0.0, 10.0), [(2.0, math.atan(0.5))])
    root = math.sqrt(17)
    slip, turned = math.atan(0.25), 2 / 1.2 / root
    x = 0.1 * (10 * math.cos(slip) + 10.4 * math.cos(slip + turned))
    y = 0.1 * (10 * math.sin(slip) + 10.4 * math.sin(slip + turned))
    np.testing.assert_allclose(state, [x, y, 10.2 * 0.2 / 1.2 / root, 10.4], atol=1e-12)


def test_left_is_positive() -> None:
    """Steering left increases the heading and y; steering right is the mirror image."""
    left, right = (drive((0.0, 0.0, 0.0, 5.0), [(0.0, steering)])[0] for steering in (0.2, -0.2))
    assert left[1] > 0
    assert left[2] > 0
    np.testing.assert_allclose(left * [1, -1, -1, 1], right, atol=1e-12)


def test_circle() -> None:
    """Sin β = 0.1 turns on a radius of 1.2 / 0.1 = 12 m and closes after 2π·12 m.

    Each of 100 steps at 6 m/s turns by 0.02π and, by the trapezoidal rule, moves by the mean of
    its two ends: the points are on a circle of radius 0.12π·tan(0.01π)⁻¹ = 11.996 m.
    """
    steering = math.atan(2 * 0.1 / math.sqrt(1 - 0.01))
    dt_s = 2 * math.pi * 12 / 6 / 100
    states = drive((0.0, 0.0, 0.0, 6.0), [(0.0, steering)] * 100, dt_s=dt_s)
    np.testing.assert_allclose(states[-1], [0, 0, 0, 6], atol=1e-9)
    diameter = np.hypot(*states[49, :2])
    assert diameter == pytest.approx(2 * 0.12 * math.pi / math.tan(0.01 * math.pi), abs=1e-9)
    assert diameter == pytest.approx(24, abs=0.01)


@pytest.mark.parametrize(
    ("integrator", "x"),
    [
        ("heun", [0.16, 0.24, 0.26, 0.26, 0.28]),  # means of the speeds at both ends times 0.2
        ("euler", [0.20, 0.32, 0.36, 0.36, 0.36]),  # speeds before the step times 0.2
    ],
)
def test_braking(integrator: Literal["heun", "euler"], x: list[float]) -> None:
    """1 m/s less 0.4 m/s per tick is 0.6, 0.2, 0, 0; excess braking has no effect later."""
    actions = [(-2.0, 0.0)] * 4 + [(1.0, 0.0)]
    states = drive((0.0, 0.0, 0.0, 1.0), actions, integrator=integrator)
    np.testing.assert_allclose(states[:, 3], [0.6, 0.2, 0, 0, 0.2], atol=1e-12)
    np.testing.assert_allclose(states[:, 0], x, atol=1e-12)


def test_driving_backwards() -> None:
    """With `reverse` the speed continues to -0.2 and -0.6 m/s."""
    states = drive((0.0, 0.0, 0.0, 1.0), [(-2.0, 0.0)] * 4, reverse=True)
    np.testing.assert_allclose(states[:, 3], [0.6, 0.2, -0.2, -0.6], atol=1e-12)
    np.testing.assert_allclose(states[:, 0], [0.16, 0.24, 0.24, 0.16], atol=1e-12)


def test_a_vehicle_that_drives_backwards() -> None:
    """From -1 m/s: on at -1, no faster under -2 m/s², -0.6 and -0.2 under 2, then forwards 0.2.

    By Heun's method it is at -0.2, -0.4, -0.56, -0.64 and -0.64 m. Braking then ends at rest.
    """
    actions = [(0.0, 0.0), (-2.0, 0.0), (2.0, 0.0), (2.0, 0.0), (2.0, 0.0), (-2.0, 0.0)]
    states = drive((0.0, 0.0, 0.0, -1.0), actions)
    assert states[:, 3] == pytest.approx([-1.0, -1.0, -0.6, -0.2, 0.2, 0.0], abs=1e-12)
    assert states[:, 0] == pytest.approx([-0.2, -0.4, -0.56, -0.64, -0.64, -0.62], abs=1e-12)


def test_inverse_has_the_time_step_that_the_paper_lacks() -> None:
    """At 8 m/s and 0.1 rad the paper's formula gives 0.020 rad instead of 0.100 rad."""
    start = np.array([0.0, 0.0, 0.0, 8.0])
    after = forward(start, np.array([0.0, 0.1]), LENGTH_M, 0.2, integrator="euler")
    found = inverse(start, after, LENGTH_M, 0.2, integrator="euler")
    np.testing.assert_allclose(found, [0, 0.1], atol=1e-12)
    literal = math.atan(2.4 / math.sqrt((8 / after[2]) ** 2 - 1.2**2))
    assert round(literal, 3) == 0.020


def test_inverse_of_euler_steps_has_the_initial_speed() -> None:
    """With the paper's mean speed, 0.400 rad would become 0.366 rad."""
    start = np.array([0.0, 0.0, 0.0, 1.0])
    action = np.array([1.0, 0.4])
    after = forward(start, action, LENGTH_M, 0.2, integrator="euler")
    exact = inverse(start, after, LENGTH_M, 0.2, integrator="euler")
    np.testing.assert_allclose(exact, action, atol=1e-12)
    with_mean_speed = inverse(start, after, LENGTH_M, 0.2, integrator="heun")
    assert round(float(with_mean_speed[1]), 3) == 0.366


def test_standstill() -> None:
    """Below a mean speed of 0.5 m/s, forwards or backwards, the steering is 0."""
    start = np.array([[0.0, 0.0, 0.0, speed] for speed in (0.0, 0.49, 0.51, -0.49, -0.51)])
    after = start + np.array([0.0, 0.0, 0.01, 0.0])
    steering = inverse(start, after, np.full(5, 4.0), 0.2)[:, 1]
    # sin β = 1.2·0.01 / (0.51·0.2) = 2/17, so tan δ = 2·2/√(17² - 2²)
    expected = math.atan(4 / math.sqrt(285))
    np.testing.assert_allclose(steering, [0, 0, expected, 0, -expected], atol=1e-12)


def test_inverse_across_the_wrap() -> None:
    """From π - 0.01 to -π + 0.01 is a left turn of 0.02 rad, not a right turn of almost 2π."""
    start = np.array([0.0, 0.0, math.pi - 0.01, 6.0])
    after = np.array([0.0, 0.0, -math.pi + 0.01, 6.0])
    # sin β = 1.2·0.02 / (6·0.2) = 0.02
    expected = math.atan(0.04 / math.sqrt(1 - 0.0004))
    np.testing.assert_allclose(inverse(start, after, LENGTH_M, 0.2), [0, expected], atol=1e-12)


def test_inverse_limits_steering_but_not_acceleration() -> None:
    start = np.array([0.0, 0.0, 0.0, 1.0])
    after = np.array([0.0, 0.0, -1.0, 5.0])
    np.testing.assert_allclose(inverse(start, after, LENGTH_M, 0.2), [20, -math.pi / 4], atol=1e-12)
