"""The drivers `log-actions` and `idm`, and the intelligent driver model."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.classes import AgentClass
from asp_env.dynamics.car_following import IDM, idm_acceleration, pursuit_steering, speed_limits
from tests.builders import DRIVES, Drive, make_recording
from tests.sim.worlds import car, now, on_road, replay, scenario, simulate

PARAMETERS = IDM().as_row()
CAR_M = 4.5


def _state(simulation, track_id: int) -> np.ndarray:
    state = now(simulation, track_id)
    assert state is not None
    return state


def test_recorded_actions_lead_along_the_track():
    """Tracks of the bicycle model at 0.2 s are reproduced within 1 mm over 6 s.

    Vehicles drive straight, brake, accelerate and turn both ways; none stops.
    """
    drives = tuple(each for each in DRIVES if each.start[3] > 4.5 and each.kind != AgentClass.TRUCK)
    recording = make_recording(frame_rate_hz=5.0, drives=drives)
    simulation = simulate(recording, scenario(1, start=25, length=30), "log-actions")
    replay(simulation, 30)
    world = simulation.world
    both = world.episodes.valid[0] & world.episodes.log_valid[0]
    away = world.episodes.states[0, ..., :2] - world.episodes.log_states[0, ..., :2]
    assert both[-1].sum() >= 4
    assert np.linalg.norm(away[both], axis=-1).max() < 1e-3


def test_recorded_actions_are_executed_from_any_state():
    """The same actions from a state 1 m beside the track end 1 m beside the track."""
    simulation = simulate(on_road(car(-50, 8)), scenario(length=20), "log-actions")
    episodes = simulation.world.episodes
    episodes.states[0, simulation.world.now[0], 1, 1] += 1.0
    replay(simulation, 20)
    beside = np.array([0.0, 1.0, 0.0, 0.0])
    log = episodes.log_states[0, simulation.world.now[0], 1]
    assert _state(simulation, 2) == pytest.approx(log + beside, abs=1e-3)


def test_a_vehicle_under_log_actions_leaves_when_its_track_ends():
    """A track from 0 to 5 s: present at tick 25, absent at tick 26."""
    leaver = Drive(kind=AgentClass.CAR, start=(-50.0, -1.75, 0.0, 8.0), leaves_s=5.0)
    simulation = simulate(on_road(leaver), scenario(length=20), "log-actions")
    replay(simulation, 10)
    assert now(simulation, 2) is not None
    replay(simulation, 1)
    assert now(simulation, 2) is None


@pytest.mark.parametrize("traffic", ["log-actions", "idm"])
def test_pedestrians_and_parked_cars_are_replayed(traffic):
    """Their states are the recorded bits; so are those of the ego, which replays here."""
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(-12.0, -10.0, 1.0, 1.2))
    parked = car(25, 0.0, y_m=-6.0)
    simulation = simulate(on_road(walker, parked, car(-80, 8)), scenario(length=20), traffic)
    replay(simulation, 20)
    episodes, tick = simulation.world.episodes, simulation.world.now[0]
    for slot in range(3):
        state, log = episodes.states[0, tick, slot], episodes.log_states[0, tick, slot]
        assert state.tobytes() == log.tobytes()


def test_vehicles_appear_where_and_when_they_were_recorded():
    """Under idm, a track that starts at 4 s: absent at 3.8 s, at its recorded place at 4 s."""
    simulation = simulate(on_road(car(-50, 8, appears_s=4.0)), scenario(length=20), "idm")
    replay(simulation, 4)
    assert now(simulation, 2) is None
    replay(simulation, 1)
    assert _state(simulation, 2) == pytest.approx([-50, -1.75, 0, 8], abs=1e-4)
    replay(simulation, 5)
    assert _state(simulation, 2)[0] == pytest.approx(-42, abs=0.1)


def test_a_vehicle_on_a_free_road_reaches_the_highest_speed_of_its_track():
    """Recorded at 10 m/s before the scenario and at 4 m/s at its start."""
    slow = car(-95, 10.0, (1.0, 0, 0), (1.5, -4.0, 0))
    recording = on_road(slow, duration_s=30.0)
    simulation = simulate(recording, scenario(start=20, length=79), "idm")
    assert _state(simulation, 2)[3] == pytest.approx(4.0, abs=0.2)
    replay(simulation, 45)
    assert _state(simulation, 2)[3] == pytest.approx(10.0, abs=0.2)


@pytest.mark.parametrize("appears_s", [0.0, 1.0], ids=["parked", "waiting"])
def test_stops_behind_a_standing_car_at_the_standstill_gap(appears_s):
    """2 m to 3 m between the bumpers, since gaps are searched in steps of 1 m."""
    recording = on_road(car(-90, 10), car(-12, 0, appears_s=appears_s))
    simulation = simulate(recording, scenario(length=80), "idm")
    replay(simulation, 80)
    follower = _state(simulation, 2)
    assert follower[3] == pytest.approx(0.0, abs=0.02)
    assert 1.9 < -12 - follower[0] - CAR_M < 3.1


def test_keeps_the_path_of_the_ego_clear():
    """A car that stands at x = 10 m leaves no room for another one behind the crossing.

    The ego comes up the road at x = 1.75 m: the car stops at least 1 m before the ego's side.
    """
    recording = on_road(car(-90, 10), car(10, 0, appears_s=1.0))
    simulation = simulate(recording, scenario(length=70), "idm")
    replay(simulation, 70)
    follower = _state(simulation, 2)
    assert follower[3] == pytest.approx(0.0, abs=0.02)
    assert -7.0 < follower[0] + CAR_M / 2 < 0.85 - 1.0


def test_a_vehicle_that_stands_in_its_track_stands_under_idm():
    recording = on_road(car(0, 0, appears_s=1.0))
    simulation = simulate(recording, scenario(length=80), "idm")
    replay(simulation, 80)
    assert _state(simulation, 2) == pytest.approx([0, -1.75, 0, 0], abs=1e-3)


def test_a_vehicle_whose_track_ends_standing_stops_there():
    """The track ends at x = 2.5 m; on a free road the car stops within 1.5 m of that and stays."""
    stopping = car(-90, 10, (8.0, 0, 0), (2.5, -4.0, 0))
    simulation = simulate(on_road(stopping), scenario(length=80), "idm")
    replay(simulation, 80)
    assert _state(simulation, 2)[3] == 0.0
    assert _state(simulation, 2)[0] == pytest.approx(2.5, abs=1.5)


def test_a_vehicle_leaves_at_the_end_of_its_path():
    """A track of 5 s at 8 m/s ends after 40 m; there the vehicle leaves for good."""
    leaver = Drive(kind=AgentClass.CAR, start=(-50.0, -1.75, 0.0, 8.0), leaves_s=5.0)
    simulation = simulate(on_road(leaver), scenario(length=30), "idm")
    replay(simulation, 9)
    assert now(simulation, 2) is not None
    replay(simulation, 3)
    assert now(simulation, 2) is None
    replay(simulation, 10)
    assert now(simulation, 2) is None


@given(
    gap_m=st.floats(12.0, 40.0),
    speed_mps=st.floats(3.0, 14.0),
    braking_mps2=st.floats(0.5, 4.0),
    after_s=st.floats(0.0, 3.0),
)
def test_never_touches_a_leader_that_brakes(gap_m, speed_mps, braking_mps2, after_s):
    """Equal speeds on a straight road, at least 0.8 s and 7.5 m behind a leader that stops."""
    distance_m = max(gap_m, CAR_M + 3.0 + 0.8 * speed_mps)
    phases = ((3.0 + after_s, 0.0, 0.0), (speed_mps / braking_mps2, -braking_mps2, 0.0))
    leader = car(-95 + distance_m, speed_mps, *phases)
    recording = on_road(car(-95, speed_mps), leader, duration_s=16.0)
    simulation = simulate(recording, scenario(length=60), "idm")
    for _ in range(60):
        follower, ahead = now(simulation, 2), now(simulation, 3)
        if follower is None or ahead is None:
            break
        assert follower[3] >= 0
        assert ahead[0] - follower[0] > CAR_M
        replay(simulation, 1)


def test_follows_a_curve_within_half_a_metre():
    """A left turn of 12 m radius, recorded at 6 m/s."""
    simulation = simulate(make_recording(drives=DRIVES[:3]), scenario(1, length=60), "idm")
    world = simulation.world
    path = world.recordings[0].track(2)[:, :2]
    turned = []
    for _ in range(60):
        replay(simulation, 1)
        state = now(simulation, 3)
        if state is None:
            break
        turned.append(state[2])
        assert np.hypot(*(path - state[:2]).T).min() < 0.5
        assert state[3] >= 0
    assert np.ptp(np.unwrap(turned)) > 1.2


def test_idm_stops_behind_the_ego():
    """The ego brakes to a stop ahead of a car whose track leads through it."""
    recording = make_recording(drives=(car(-60, 8), car(-85, 8)), duration_s=18.0)
    simulation = simulate(recording, scenario(1, length=60), "idm")
    controlled = np.ones(1, dtype=bool)
    for _ in range(60):
        simulation.step(np.array([[-3.0, 0.0]], dtype=np.float32), controlled)
        assert not simulation.world.events().collision.any()
    assert _state(simulation, 2)[3] < 0.05


def test_free_road_law_by_hand():
    """1.5 m/s² from standstill, 0 at the desired speed, 1.5·(1 - 1/16) at half of it."""
    assert idm_acceleration(0.0, 10.0, np.inf, 0.0, PARAMETERS) == 1.5
    assert idm_acceleration(10.0, 10.0, np.inf, 0.0, PARAMETERS) == 0.0
    assert idm_acceleration(5.0, 10.0, np.inf, 0.0, PARAMETERS) == pytest.approx(1.40625)


def test_interaction_law_by_hand():
    """At 10 of 20 m/s, 14 m behind an equally fast leader: s* = 2 + 12 = 14, so 1.5·(15/16 - 1)."""
    assert idm_acceleration(10.0, 20.0, 14.0, 10.0, PARAMETERS) == pytest.approx(-0.09375)
    # standing leader: closing term 100 / (2·√3)
    desired = 14 + 100 / (2 * math.sqrt(3))
    expected = 1.5 * (15 / 16 - (desired / 40) ** 2)
    assert idm_acceleration(10.0, 20.0, 40.0, 0.0, PARAMETERS) == pytest.approx(expected)


@given(
    speed=st.floats(0, 40),
    desired=st.floats(0, 40),
    gap=st.floats(0, 200) | st.just(math.inf),
    leader=st.floats(0, 40),
)
def test_accelerations_stay_within_limits(speed, desired, gap, leader):
    """Between -5 m/s² and the maximum acceleration, never NaN."""
    assert -5.0 <= idm_acceleration(speed, desired, gap, leader, PARAMETERS) <= 1.5


def test_speed_limits_by_hand():
    """Straight: as desired. On a circle of 10 m: √(2.5·10) = 5 m/s. Before: braking at 2 m/s²."""
    straight = np.stack([np.arange(40.0), np.zeros(40)], axis=-1)
    assert speed_limits(straight, 12.0, IDM()) == pytest.approx(np.full(40, 12.0))
    angle = np.arange(0.1, 1.5, 0.1)
    bend = np.stack([39 + 10 * np.sin(angle), 10 * (1 - np.cos(angle))], axis=-1)
    limits = speed_limits(np.concatenate([straight, bend]), 12.0, IDM())
    assert limits[45:] == pytest.approx(5.0, rel=0.02)
    # 20 m before the bend: √(25 + 2·2·20) = 10.2
    assert limits[20] == pytest.approx(math.sqrt(25 + 80), abs=0.4)
    assert limits[0] == 12.0
    stopped = speed_limits(straight, 12.0, IDM(), stop_m=30.0)
    assert (stopped[30:] == 0).all()
    assert stopped[21] == pytest.approx(math.sqrt(2 * 2 * 9))


def test_steering_follows_a_circle():
    """On a circle to the left of radius 20 m pure pursuit steers its constant angle.

    Sine of slip is axle 1.35 m over 20 m, steering atan(2·tan(slip)) = 0.134 rad.
    """
    angle = np.arange(0, 3, 1 / 20)
    path = np.stack([20 * np.sin(angle), 20 * (1 - np.cos(angle))], axis=-1)
    slip = math.asin(1.35 / 20)
    # the heading of the box is the course minus the slip
    steering = pursuit_steering(0.0, 0.0, -slip, 6.0, 4.5, path, len(path), 0.0, 0.0)
    assert steering == pytest.approx(math.atan(2 * math.tan(slip)), rel=0.03)
    mirrored = path * [1, -1]
    other = pursuit_steering(0.0, 0.0, slip, 6.0, 4.5, mirrored, len(path), 0.0, 0.0)
    assert other == pytest.approx(-steering)
