"""The planner `sampling`."""

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.planning.idm import DESIRED_MPS
from asp_env.planning.sampling import SamplingPlanner, SamplingWeights
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


def _gain(states: np.ndarray) -> float:
    """Distance to the east that a plan covers, m."""
    return float(states[-1, 0] - states[0, 0])


def test_reaches_the_desired_speed_on_an_empty_road():
    """From 8 m/s to 13.9 m/s within 7 s, in the lane, and never beyond it."""
    states = close_loop(SamplingPlanner(), approach(speed_mps=8.0), 35)
    assert states[-1, 3] == pytest.approx(DESIRED_MPS, abs=0.5)
    assert states[:, 3].max() < DESIRED_MPS + 0.3
    assert states[:, 1] == pytest.approx(-1.75, abs=0.1)
    assert (np.diff(states[:, 3]) / 0.2).max() < 1.5


def test_stops_for_a_standing_car_on_its_route():
    """From 10 m/s, 45 m before the car: comes to rest behind it without contact."""
    simulation = approach(car(-15.0, 0.0))
    states = close_loop(SamplingPlanner(), simulation, 60)
    assert states[-1, 3] < 0.3
    assert 4.5 < -15.0 - states[-1, 0] < 16.0
    assert not simulation.world.events().collision.any()


def test_brakes_hard_rather_than_colliding():
    """At 10 m/s with 15 m between the bumpers; 5 m/s² stops within 10 m."""
    simulation = approach(car(-60 + 4.5 + 15, 0.0))
    states = close_loop(SamplingPlanner(), simulation, 25)
    assert states[-1, 3] < 0.5
    assert not simulation.world.events().collision.any()


@pytest.mark.parametrize("x_m", [-40.0, -30.0])
def test_probable_crossings_count_more(x_m):
    """A pedestrian that crosses with 90 % slows the ego; one that crosses with 1 % hardly does.

    In the other mode the pedestrian stands beside the road.
    """
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(x_m, -9.0, np.pi / 2, 0.0), appears_s=0.2)
    scene = approach(walker).world.scene()
    cross = np.zeros((STEPS, 4), dtype=np.float32)
    cross[:] = (x_m, -1.75, np.pi / 2, 0.0)
    planner = SamplingPlanner()
    free = planner.plan(scene, straight_ahead(scene)).states[0]
    rare = planner.plan(scene, two_modes(scene, cross, 0.01)).states[0]
    likely = planner.plan(scene, two_modes(scene, cross, 0.9)).states[0]
    assert _gain(free) - _gain(rare) < 0.3 * (_gain(free) - _gain(likely))
    assert _gain(likely) < _gain(free) - 3


def test_a_mode_without_probability_does_not_count():
    """A crossing mode with probability 0 does not change the bits of the plan."""
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(-30.0, -9.0, np.pi / 2, 0.0), appears_s=0.2)
    scene = approach(walker).world.scene()
    cross = np.tile(np.array([-30.0, -1.75, 1.57, 0.0], dtype=np.float32), (STEPS, 1))
    planner = SamplingPlanner()
    with np.errstate(divide="ignore"):
        never = planner.plan(scene, two_modes(scene, cross, 0.0))
    assert never.states.tobytes() == planner.plan(scene, straight_ahead(scene)).states.tobytes()


def test_swerves_where_there_is_room_but_not_off_the_road():
    """A car that extends 0.4 m into its way: the ego passes it in a wide area, not over the curb.

    The ego's side is at y = -3.3, the curb at -3.5, the car reaches to y = -1.9.
    """
    lanes = {}
    for name, road_map in (("open", wide_map()), ("curb", None)):
        simulation = approach(car(-35.0, 0.0, y_m=-1.0), y_m=-2.4, road_map=road_map)
        scene = simulation.world.scene()
        plan = SamplingPlanner().plan(scene, straight_ahead(scene))
        lanes[name] = float(plan.states[0, :, 1].min())
    assert lanes["open"] < -2.8
    assert lanes["curb"] > -2.4 - 0.5


def test_a_faster_car_behind_changes_nothing():
    """The ego is not at fault for contacts at its rear."""
    empty = approach().world.scene()
    planner = SamplingPlanner()
    alone = planner.plan(empty, straight_ahead(empty)).states
    followed = approach(car(-115.0, 14.0)).world.scene()
    assert followed.states[0, 1, -1, 0] < followed.states[0, 0, -1, 0] - 4.5
    assert planner.plan(followed, straight_ahead(followed)).states.tobytes() == alone.tobytes()


def test_gives_way_to_a_car_that_cuts_in_from_behind():
    """A car beside the ego's rear counts: it would touch a side. One straight behind does not.

    Boxes of 4.5 m by 1.8 m, rear axle at -1.35 m: 3 m back and 1.7 m aside is 134° off the heading,
    without the 1.7 m it is 180°.
    """
    scene = approach(car(-95.0, 10.0, y_m=1.75)).world.scene()
    planner = SamplingPlanner()
    alone = planner.plan(scene, straight_ahead(scene)).states
    plans = {}
    for aside_m in (0.0, 1.7):
        cut = alone[0] - np.array([3.0, -aside_m, 0.0, 0.0], dtype=np.float32)
        cut[:5] = straight_ahead(scene).states[0, 0, :5]
        plans[aside_m] = planner.plan(scene, two_modes(scene, cut, 0.9)).states
    assert plans[0.0].tobytes() == alone.tobytes()
    assert plans[1.7][0, -1, 1] < alone[0, -1, 1] - 0.3


@pytest.mark.parametrize(("gap_m", "own"), [(-0.2, True), (0.2, False)])
def test_the_egos_trailer_is_ignored(gap_m, own):
    """A trailer of 7 m that touches the ego is ignored, wherever it is forecast.

    The ego is at x = -60, and the trailer is forecast to stand at -46 in its way: that changes the
    plan unless the trailer is the ego's.
    """
    planner = SamplingPlanner()
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
    forecast = straight_ahead(scene)
    planner = SamplingPlanner()
    assert planner.plan(scene, forecast).actions[0, 0, 0] > 0.5
    along = np.linspace(-2.95, -1.5, STEPS, dtype=np.float32)
    forecast.states[0, 0, :, 0], forecast.states[0, 0, :, 1] = 2.0, along
    plan = planner.plan(scene, forecast)
    assert plan.actions[0, 0, 0] == 0.0
    assert not plan.states[0, :5, 3].any()


def test_does_not_move_into_the_car_it_stands_behind():
    """A gap of 0.3 m is within the margin from the start, but a contact still counts."""
    queue = (car(0.0, 0.0, (5.0, 0, 0), (9.0, 1.0, 0), appears_s=0.2), car(4.8, 0.0))
    recording = make_recording(drives=queue, duration_s=16.0)
    scene = simulate(recording, scenario(1, start=17, length=60)).world.scene()
    plan = SamplingPlanner().plan(scene, straight_ahead(scene))
    assert plan.states[0, -1, 0] < 0.3


def test_slows_down_for_a_bend():
    """A quarter turn of 12 m radius: about √(2.5·12) = 5.5 m/s in it.

    It stays within 1.3 m of the track: 0.8 m is the offset of some candidates, and pure pursuit
    cuts the bend.
    """
    recording = make_recording(drives=(DRIVES[2],), duration_s=20.0, road_map=wide_map())
    simulation = simulate(recording, scenario(1, length=60))
    states = close_loop(SamplingPlanner(), simulation, 50)
    path = recording.track(0)[:, :2]
    on_log = states[:, 0] > path[:, 0].min()
    away = np.hypot(*(path[:, None] - states[None, on_log, :2]).transpose(2, 0, 1)).min(axis=0)
    assert away.max() < 1.3
    inside = (states[:, 2] > 1.9) & (states[:, 2] < 2.8)
    assert inside.sum() > 5
    assert states[inside, 3] == pytest.approx(5.5, abs=0.4)


def test_plans_depend_on_the_weights():
    """Without weights for collision and closeness the ego drives into a standing car."""
    scene = approach(car(-40.0, 0.0)).world.scene()
    forecast = straight_ahead(scene)
    careless = SamplingPlanner(SamplingWeights(collision=0.0, closeness=0.0))
    assert _gain(careless.plan(scene, forecast).states[0]) > 25
    assert _gain(SamplingPlanner().plan(scene, forecast).states[0]) < 20
