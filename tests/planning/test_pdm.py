"""The planner `pdm`."""

import dataclasses

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.metrics.driving.comfort import comfortable
from asp_env.planning.idm import DESIRED_MPS
from asp_env.planning.pdm import EMERGENCY_S, PDMPlanner, PDMWeights
from tests.builders import DRIVES, Drive, make_recording
from tests.planning.situations import (
    STEPS,
    approach,
    close_loop,
    straight_ahead,
    two_modes,
    wide_map,
)
from tests.sim.worlds import car, scenario, simulate

DT_S = 0.2


def _gain(states: np.ndarray) -> float:
    """Distance to the east that a plan covers, m."""
    return float(states[-1, 0] - states[0, 0])


def _is_comfortable(states: np.ndarray) -> bool:
    return bool(comfortable(states, DT_S, np.ones((), dtype=bool)).value)


def _lane_map(first_mps: float | None, then_mps: float | None) -> RoadMap:
    """The eastbound lane in two pieces, up to x = -20 and from there on, with speed limits."""
    ends = [(-150.0, -20.0), (-20.0, 200.0)]
    limits = (first_mps, then_mps)
    return dataclasses.replace(
        wide_map(),
        name="limited",
        lanes=Ragged.pack([np.array([(x, -1.75), (end, -1.75)]) for x, end in ends]),
        successors=np.array([(0, 1)]),
        areas=Ragged.pack(
            [np.array([(x, -3.5), (end, -3.5), (end, 0.0), (x, 0.0)]) for x, end in ends]
        ),
        two_way=np.zeros(2, dtype=bool),
        limits_mps=np.array([limit or 0.0 for limit in limits]),
        limited=np.array([limit is not None for limit in limits]),
    )


def test_reaches_the_desired_speed_on_an_empty_road():
    """From 8 m/s to within 1 m/s of 50 km/h in 8 s, in the lane, without any discomfort."""
    states = close_loop(PDMPlanner(), approach(speed_mps=8.0), 40)
    assert DESIRED_MPS - 1.0 < states[-1, 3] <= DESIRED_MPS
    assert states[:, 1] == pytest.approx(-1.75, abs=0.05)
    assert (np.diff(states[:, 3]) > 0).all()
    assert _is_comfortable(states)


def test_the_slowest_proposal_drives_a_fifth_of_the_limit():
    """If progress costs, it is chosen: 13.9 m/s / 5 = 2.8 m/s, slowed by 3 m/s² at most."""
    planner = PDMPlanner(PDMWeights(progress=-4.0))
    states = close_loop(planner, approach(), 50)
    assert states[-1, 3] == pytest.approx(0.2 * DESIRED_MPS, abs=0.1)
    assert (np.diff(states[:, 3]) / DT_S).min() == pytest.approx(-3.0, abs=0.05)
    assert _is_comfortable(states)


@pytest.mark.parametrize("limit_mps", [6.0, 20.0])
def test_drives_at_the_speed_limit_of_the_lane(limit_mps):
    """Where the map has one, it replaces 50 km/h."""
    simulation = approach(speed_mps=limit_mps - 1.0, road_map=_lane_map(limit_mps, limit_mps))
    states = close_loop(PDMPlanner(), simulation, 30)
    assert limit_mps - 0.6 < states[-1, 3] <= limit_mps


@pytest.mark.parametrize(("first_mps", "speed_mps"), [(50 / 3.6, 10.8), (None, 6.0)])
def test_slows_down_before_a_lower_limit(first_mps, speed_mps):
    """A limit of 6 m/s from x = -20 on: the ego arrives there with it, in comfort.

    It begins at x = -60 with 10 m/s. Braking by 2 m/s² from x = -40 on begins at √(6² + 2·2·20) =
    10.8 m/s; a lane without a limit has that of the next lane.
    """
    simulation = approach(road_map=_lane_map(first_mps, 6.0))
    states = close_loop(PDMPlanner(), simulation, 40)
    there = int((states[:, 0] > -20.0).argmax())
    assert states[there, 3] == pytest.approx(6.0, abs=0.5)
    middle = int((states[:, 0] > -40.0).argmax())
    assert speed_mps - 0.6 < states[middle, 3] < speed_mps + 0.1
    assert _is_comfortable(states)


def test_stops_for_a_standing_car_on_its_route():
    """From 10 m/s, 45 m before the car: at rest 2 m to 4 m behind it, in comfort."""
    simulation = approach(car(-15.0, 0.0))
    states = close_loop(PDMPlanner(), simulation, 60)
    assert states[-1, 3] < 0.3
    assert 1.9 < -15.0 - states[-1, 0] - 4.5 < 4.0
    assert not simulation.world.events().collision.any()
    assert _is_comfortable(states)


def test_brakes_hard_rather_than_colliding():
    """At 10 m/s with 12 m between the bumpers; 5 m/s² stops within 10 m."""
    simulation = approach(car(-60 + 4.5 + 12, 0.0))
    states = close_loop(PDMPlanner(), simulation, 25)
    assert states[-1, 3] < 0.5
    assert not simulation.world.events().collision.any()


@pytest.mark.parametrize(("probability", "brakes"), [(0.4, False), (0.6, True)])
def test_emergency_brake(probability, brakes):
    """A pedestrian that may stand 8 m before the bumper within a second: -5 m/s² from half on."""
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(-50.0, -9.0, np.pi / 2, 0.0), appears_s=0.2)
    scene = approach(walker).world.scene()
    blocked = np.tile(np.array([-50.0, -1.75, 1.57, 0.0], dtype=np.float32), (STEPS, 1))
    plan = PDMPlanner().plan(scene, two_modes(scene, blocked, probability))
    assert (plan.actions[0, :, 0] == -5.0).any() == brakes
    assert (plan.actions[0, 0, 0] == -5.0) == brakes


def test_no_emergency_beyond_two_seconds():
    """At 10 m/s with 21 m to the pedestrian the limited jerk suffices."""
    x_m = -60.0 + 2.25 + 10.0 * (EMERGENCY_S + 0.1)
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(x_m, -9.0, np.pi / 2, 0.0), appears_s=0.2)
    scene = approach(walker).world.scene()
    blocked = np.tile(np.array([x_m, -1.75, 1.57, 0.0], dtype=np.float32), (STEPS, 1))
    plan = PDMPlanner().plan(scene, two_modes(scene, blocked, 0.9))
    assert -1.0 < plan.actions[0, 0, 0] < 0.0


def test_the_leader_moves_as_forecast():
    """A car 15 m ahead that stands now: the plan goes on if it is forecast to leave at 12 m/s."""
    scene = approach(car(-40.0, 0.0)).world.scene()
    stands = straight_ahead(scene)
    leaves = dataclasses.replace(stands, states=stands.states.copy())
    leaves.states[0, 0, :, 0] += 12.0 * DT_S * np.arange(1, STEPS + 1)
    leaves.states[0, 0, :, 3] = 12.0
    planner = PDMPlanner()
    gains = [_gain(planner.plan(scene, each).states[0]) for each in (stands, leaves)]
    assert gains[0] < 16.0
    assert gains[1] > gains[0] + 8.0


@pytest.mark.parametrize("x_m", [-40.0, -30.0])
def test_probable_crossings_count_more(x_m):
    """A pedestrian that crosses with 90 % slows the ego; one that crosses with 1 % does not."""
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(x_m, -9.0, np.pi / 2, 0.0), appears_s=0.2)
    scene = approach(walker).world.scene()
    cross = np.zeros((STEPS, 4), dtype=np.float32)
    cross[:] = (x_m, -1.75, np.pi / 2, 0.0)
    planner = PDMPlanner()
    free = planner.plan(scene, straight_ahead(scene)).states[0]
    rare = planner.plan(scene, two_modes(scene, cross, 0.01)).states[0]
    likely = planner.plan(scene, two_modes(scene, cross, 0.9)).states[0]
    assert _gain(free) - _gain(rare) < 0.1
    assert _gain(likely) < _gain(free) - 3


def test_a_less_probable_mode_counts_beside_the_most_probable_one():
    """A crossing with 30 % is in no leader, but in the score: the ego slows down for it."""
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(-33.0, -9.0, np.pi / 2, 0.0), appears_s=0.2)
    scene = approach(walker).world.scene()
    cross = np.tile(np.array([-33.0, -1.75, 1.57, 0.0], dtype=np.float32), (STEPS, 1))
    planner = PDMPlanner()
    alone = planner.plan(scene, straight_ahead(scene)).states[0]
    both = planner.plan(scene, two_modes(scene, cross, 0.3)).states[0]
    assert both[-1, 3] < alone[-1, 3] - 2.0


def test_a_mode_without_probability_does_not_count():
    """A crossing mode with probability 0 does not change the bits of the plan."""
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(-30.0, -9.0, np.pi / 2, 0.0), appears_s=0.2)
    scene = approach(walker).world.scene()
    cross = np.tile(np.array([-30.0, -1.75, 1.57, 0.0], dtype=np.float32), (STEPS, 1))
    planner = PDMPlanner()
    with np.errstate(divide="ignore"):
        never = planner.plan(scene, two_modes(scene, cross, 0.0))
    assert never.states.tobytes() == planner.plan(scene, straight_ahead(scene)).states.tobytes()


def test_swerves_where_there_is_room_but_not_off_the_road():
    """A car that extends 0.4 m into its way: the ego passes it in a wide area, not over the curb.

    The ego's side is at y = -3.3, the curb at -3.5, the car reaches to y = -1.9.
    """
    lowest = {}
    for name, road_map in (("open", wide_map()), ("curb", None)):
        simulation = approach(car(-30.0, 0.0, y_m=-1.0), y_m=-2.4, road_map=road_map)
        states = close_loop(PDMPlanner(), simulation, 30)
        lowest[name] = float(states[:, 1].min())
        assert not simulation.world.events().collision.any()
        assert (states[-1, 0] > -25.0) == (name == "open")
    assert lowest["open"] < -2.6
    assert lowest["curb"] > -2.4 - 0.5


def test_a_faster_car_behind_changes_nothing():
    """The ego is not at fault for contacts at its rear."""
    empty = approach().world.scene()
    planner = PDMPlanner()
    alone = planner.plan(empty, straight_ahead(empty)).states
    followed = approach(car(-115.0, 14.0)).world.scene()
    assert followed.states[0, 1, -1, 0] < followed.states[0, 0, -1, 0] - 4.5
    assert planner.plan(followed, straight_ahead(followed)).states.tobytes() == alone.tobytes()


@pytest.mark.parametrize(("gap_m", "own"), [(-0.2, True), (0.2, False)])
def test_the_egos_trailer_is_ignored(gap_m, own):
    """A trailer of 7 m that touches the ego is ignored, wherever it is forecast.

    The ego is at x = -60, and the trailer is forecast to stand at -46 in its way: that changes the
    plan unless the trailer is the ego's.
    """
    planner = PDMPlanner()
    alone = approach().world.scene()
    expected = planner.plan(alone, straight_ahead(alone)).states
    behind = car(-90.0 - 2.25 - gap_m - 3.5, 10.0, kind=AgentClass.TRAILER)
    scene = approach(behind).world.scene()
    blocking = np.tile(np.array([-46.0, -1.75, 0.0, 0.0], dtype=np.float32), (STEPS, 1))
    states = planner.plan(scene, two_modes(scene, blocking, 0.9)).states
    assert (states.tobytes() == expected.tobytes()) is own


def test_waits_while_a_pedestrian_walks_into_it():
    """The contact is certain; a standing ego is not at fault, a moving one is."""
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(2.6, -6.0, np.pi / 2, 0.0), appears_s=0.2)
    queue = car(0.0, 0.0, (4.0, 0, 0), (10.0, 1.0, 0), appears_s=0.2)
    recording = make_recording(drives=(queue, walker), duration_s=16.0)
    scene = simulate(recording, scenario(1, start=17, length=60)).world.scene()
    planner = PDMPlanner()
    forecast = straight_ahead(scene)
    assert planner.plan(scene, forecast).actions[0, 0, 0] > 0.5
    along = np.linspace(-2.95, -1.5, STEPS, dtype=np.float32)
    forecast.states[0, 0, :, 0], forecast.states[0, 0, :, 1] = 2.0, along
    plan = planner.plan(scene, forecast)
    assert plan.actions[0, 0, 0] == 0.0
    assert not plan.states[0, :5, 3].any()


def test_slows_down_for_a_bend():
    """A quarter turn of 12 m radius: about √(2.5·12) = 5.5 m/s in it, within 0.6 m of the track."""
    recording = make_recording(drives=(DRIVES[2],), duration_s=20.0, road_map=wide_map())
    simulation = simulate(recording, scenario(1, length=60))
    states = close_loop(PDMPlanner(), simulation, 50)
    path = recording.track(0)[:, :2]
    on_log = states[:, 0] > path[:, 0].min()
    away = np.hypot(*(path[:, None] - states[None, on_log, :2]).transpose(2, 0, 1)).min(axis=0)
    assert away.max() < 0.6
    inside = (states[:, 2] > 1.9) & (states[:, 2] < 2.8)
    assert inside.sum() > 5
    assert states[inside, 3] == pytest.approx(5.5, abs=0.5)
