"""Actions of the logged driver: exact on tracks of the bicycle model, and back to the track."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.dynamics import MAX_STEERING_RAD, forward
from asp_env.errors import AspEnvError
from asp_env.sim.log_following import following_actions, logged_actions
from asp_env.sim.simulation import Simulation
from asp_env.sim.world import ReplayWorld
from tests.builders import make_recording
from tests.sim.worlds import DT_S, HISTORY, car, scenario, simulate

LENGTH_M = np.array([5.0])


def act(state: list[float], logged: list[float], logged_next: list[float]) -> list[float]:
    """The action of one vehicle of 5 m at ticks of 0.2 s."""
    rows = np.array([[state], [logged], [logged_next]], dtype=np.float64)
    return following_actions(rows[0], rows[1], rows[2], LENGTH_M, DT_S)[0].tolist()


@given(
    heading=st.floats(-3.1, 3.1),
    speed=st.floats(1.5, 20.0),
    acceleration=st.floats(-5.0, 5.0),
    steering=st.floats(-0.7, 0.7),
)
def test_actions_on_a_track_of_the_bicycle_model_are_exact(
    heading: float, speed: float, acceleration: float, steering: float
) -> None:
    now, action = np.array([[3.0, -2.0, heading, speed]]), np.array([[acceleration, steering]])
    after = forward(now, action, LENGTH_M, DT_S)
    np.testing.assert_allclose(
        following_actions(now, now, after, LENGTH_M, DT_S), action, atol=1e-9
    )


def test_an_ego_behind_the_log_accelerates() -> None:
    """1 m behind at 10 m/s: the aim is 11 m/s after 0.2 s, 5 m/s²."""
    assert act([0, 0, 0, 10], [1, 0, 0, 10], [3, 0, 0, 10]) == pytest.approx([5.0, 0.0])


def test_an_ego_beside_the_log_steers_towards_it() -> None:
    """1 m to the right at 10 m/s: the aim is a heading of atan(1/10) after 0.2 s.

    The axles are 1.5 m from the centre, so the sine of the slip angle is 1.5 · 0.09967 / 2.
    """
    slip = math.asin(1.5 * math.atan(0.1) / 2)
    expected = [0.0, math.atan(2 * math.tan(slip))]
    assert act([0, -1, 0, 10], [0, 0, 0, 10], [2, 0, 0, 10]) == pytest.approx(expected)
    # a slow vehicle aims 5 m ahead
    slip = math.asin(1.5 * math.atan(0.2) / 0.8)
    expected = [0.0, math.atan(2 * math.tan(slip))]
    assert act([0, -1, 0, 4], [0, 0, 0, 4], [0.8, 0, 0, 4]) == pytest.approx(expected)


def test_the_aim_does_not_drive_backwards() -> None:
    """20 m ahead of a log at 1 m/s: it brakes to 0; a log that drives backwards is followed."""
    assert act([20, 0, 0, 1], [0, 0, 0, 1], [0.2, 0, 0, 1]) == pytest.approx([-5.0, 0.0])
    assert act([20, 0, 0, -1], [0, 0, 0, -1], [-0.2, 0, 0, -1]) == pytest.approx([0.0, 0.0])


@given(ahead_m=st.floats(-2.0, 2.0), left_m=st.floats(-2.0, 2.0), speed=st.floats(5.0, 15.0))
def test_an_ego_beside_a_straight_track_returns(
    ahead_m: float, left_m: float, speed: float
) -> None:
    """After 6 s the distance is at most 5 % of that at the start."""
    state = np.array([[ahead_m, left_m, 0.0, speed]])
    for tick in range(30):
        logged = np.array([[tick * DT_S * speed, 0.0, 0.0, speed]])
        logged_next = np.array([[(tick + 1) * DT_S * speed, 0.0, 0.0, speed]])
        actions = following_actions(state, logged, logged_next, LENGTH_M, DT_S)
        state = forward(state, actions, LENGTH_M, DT_S)
    distance_m = math.hypot(state[0, 0] - 30 * DT_S * speed, state[0, 1])
    assert distance_m <= 0.05 * math.hypot(ahead_m, left_m) + 1e-9


def braking(deceleration_mps2: float) -> Simulation:
    """An episode whose logged ego brakes after 1 s from 12 m/s."""
    phases = (4.0, 0.0, 0.0), (1.0, -deceleration_mps2, 0.0)
    return simulate(make_recording(drives=(car(-95.0, 12.0, *phases),)), scenario(length=12))


def test_actions_beyond_the_limits_are_clipped_and_marked() -> None:
    """Braking with 8 m/s² is clipped to 5 m/s²; that with 4 m/s² is not. Both end with the log."""
    for deceleration_mps2, expected in ((8.0, -5.0), (4.0, -4.0)):
        simulation = braking(deceleration_mps2)
        for tick in range(7):
            actions, clipped = logged_actions(simulation.world)
            assert actions.dtype == np.float32
            assert clipped.tolist() == [tick >= 5 and deceleration_mps2 > 5]
            value = expected if tick >= 5 else 0.0
            np.testing.assert_allclose(actions, [[value, 0.0]], atol=1e-3)
            simulation.step(actions, np.ones(1, dtype=bool))


def test_steering_at_its_limit_is_marked() -> None:
    """A track that is steered with 1.2 rad from 1 s on; the limit is π/4."""
    drives = (car(-80.0, 6.0, (4.0, 0.0, 0.0), (1.0, 0.0, 1.2)),)
    simulation = simulate(make_recording(drives=drives), scenario(length=8))
    for tick in range(7):
        actions, clipped = logged_actions(simulation.world)
        assert clipped.tolist() == [tick >= 5]
        assert actions[0, 1] == pytest.approx(MAX_STEERING_RAD if tick >= 5 else 0.0, abs=1e-3)
        simulation.step(actions, np.ones(1, dtype=bool))


def test_actions_are_zero_once_the_log_has_ended() -> None:
    simulation = braking(4.0)
    for _ in range(12):
        simulation.step(logged_actions(simulation.world)[0], np.ones(1, dtype=bool))
    actions, clipped = logged_actions(simulation.world)
    assert actions.tolist() == [[0.0, 0.0]]
    assert clipped.tolist() == [False]


def test_worlds_whose_traffic_reacts_have_no_logged_driver() -> None:
    class Reacting(ReplayWorld):
        """A world like highway-env's."""

        traffic = "own"

    world = Reacting([make_recording()], num_episodes=1, dt_s=DT_S, history=HISTORY)
    with pytest.raises(AspEnvError, match=r"'own', which has no logged driver; use recordings"):
        logged_actions(world)
