"""The planner `idm`."""

import numpy as np
import pytest

from asp_env.planning.idm import DESIRED_MPS, IDMPlanner
from tests.builders import DRIVES, make_recording
from tests.planning.situations import approach, close_loop, straight_ahead, wide_map
from tests.sim.worlds import car, scenario, simulate


def test_reaches_the_desired_speed_on_an_empty_road():
    """From 8 m/s to within 1 m/s of the desired speed in 8 s, and never beyond it."""
    states = close_loop(IDMPlanner(), approach(speed_mps=8.0), 40)
    assert DESIRED_MPS - 1.0 < states[-1, 3] <= DESIRED_MPS
    assert (np.diff(states[:, 3]) > 0).all()


def test_stops_behind_a_standing_car():
    """At rest with 2 m to 3 m between the bumpers."""
    states = close_loop(IDMPlanner(), approach(car(-10.0, 0.0)), 70)
    assert states[-1, 3] == pytest.approx(0.0, abs=0.05)
    assert 1.9 < -10.0 - states[-1, 0] - 4.5 < 3.1


def test_follows_a_bend_within_half_a_metre():
    """A recorded left turn of 12 m radius, with lateral accelerations of about 2.5 m/s²."""
    recording = make_recording(drives=(DRIVES[2],), road_map=wide_map())
    simulation = simulate(recording, scenario(1, length=60))
    states = close_loop(IDMPlanner(), simulation, 50)
    path = recording.track(0)[:, :2]
    on_log = states[:, 0] > path[:, 0].min()
    away = np.hypot(*(path[:, None] - states[None, on_log, :2]).transpose(2, 0, 1)).min(axis=0)
    assert away.max() < 0.5
    lateral = states[1:, 3] * np.diff(np.unwrap(states[:, 2])) / 0.2
    assert 1.5 < np.abs(lateral).max() < 3.2


def test_one_action_is_held():
    """The plan repeats its first action for the horizon of the forecast."""
    scene = approach(car(-30.0, 2.0)).world.scene()
    actions = IDMPlanner().plan(scene, straight_ahead(scene)).actions
    assert (actions == actions[:, :1]).all()
