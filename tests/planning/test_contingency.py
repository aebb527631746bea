"""The planner `contingency`."""

import dataclasses

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.road_map import Ragged
from asp_env.metrics.driving.comfort import comfortable
from asp_env.planning.contingency import (
    FIRST_MPS2,
    MAX_JERK_MPS3,
    ContingencyPlanner,
    ContingencyWeights,
)
from asp_env.planning.idm import DESIRED_MPS
from tests.builders import DRIVES, Drive, make_map, make_recording
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


def test_reaches_the_desired_speed_on_an_empty_road_comfortably():
    """From 8 m/s to 13.9 m/s, never beyond it, within nuPlan's bounds of comfort."""
    states = close_loop(ContingencyPlanner(), approach(speed_mps=8.0), 45)
    assert states[-1, 3] == pytest.approx(DESIRED_MPS, abs=0.7)
    assert states[:, 3].max() < DESIRED_MPS + 0.05
    assert states[:, 1] == pytest.approx(-1.75, abs=0.1)
    assert comfortable(states, 0.2, np.ones((), dtype=bool)).value == 1.0


def test_stops_for_a_standing_car_comfortably():
    """From 10 m/s, 70 m before the car: comes to rest behind it without contact."""
    simulation = approach(car(10.0, 0.0))
    states = close_loop(ContingencyPlanner(), simulation, 74)
    assert states[-1, 3] < 0.5
    assert 4.5 < 10.0 - states[-1, 0] < 12.0
    assert not simulation.world.events().collision.any()
    assert comfortable(states, 0.2, np.ones((), dtype=bool)).value == 1.0


def test_all_candidates_but_emergencies_are_limited_in_jerk():
    """Within 5 m/s² the acceleration changes by at most 3.2 m/s³ · 0.2 s per tick."""
    scene = approach(speed_mps=10.0).world.scene()
    actions = ContingencyPlanner().candidates(scene, STEPS).actions[0, ..., 0]
    steps = np.abs(np.diff(actions, axis=-1, prepend=scene.actions[0, 0, -1, 0]))
    emergency = np.arange(len(actions)) == FIRST_MPS2.index(-5.0)
    assert steps[~emergency].max() <= MAX_JERK_MPS3 * 0.2 + 1e-5
    assert (actions[emergency, :, 0] == -5.0).all()


def test_candidates_share_their_first_phase():
    """All second phases of a first one have the same states in the first second, 5 ticks."""
    scene = approach(car(-60.0, 5.0)).world.scene()
    states = ContingencyPlanner().candidates(scene, STEPS).states
    assert (states[:, :, :, :5] == states[:, :, :1, :5]).all()
    assert (states[:, :, :, -1] != states[:, :, :1, -1]).any()


def _crossing(x_m: float) -> np.ndarray:
    """States of an agent that stands at x on the ego's lane."""
    return np.tile(np.array([x_m, -1.75, np.pi / 2, 0.0], dtype=np.float32), (STEPS, 1))


def _walker(x_m: float) -> Drive:
    return Drive(kind=AgentClass.PEDESTRIAN, start=(x_m, -9.0, np.pi / 2, 0.0), appears_s=0.2)


@pytest.mark.parametrize("x_m", [-40.0, -30.0])
def test_probable_crossings_count_more(x_m):
    """The further the more probable the crossing is: 90 % against 1 % and none."""
    scene = approach(_walker(x_m)).world.scene()
    planner = ContingencyPlanner()
    free = planner.plan(scene, straight_ahead(scene)).states[0]
    rare = planner.plan(scene, two_modes(scene, _crossing(x_m), 0.01)).states[0]
    likely = planner.plan(scene, two_modes(scene, _crossing(x_m), 0.9)).states[0]
    assert _gain(free) - _gain(rare) < 0.3 * (_gain(free) - _gain(likely))
    assert _gain(likely) < _gain(free) - 3


def test_costs_are_the_expectation_of_the_best_continuations():
    """With one uncertain agent: p · min cost if it crosses + (1 - p) · min cost if it does not.

    Each minimum is over the second phases, so it is the cost under a forecast with that mode alone.
    """
    scene = approach(_walker(-32.0)).world.scene()
    planner = ContingencyPlanner()
    candidates = planner.candidates(scene, STEPS)
    with np.errstate(divide="ignore"):
        only = [planner.costs(scene, two_modes(scene, _crossing(-32.0), p), candidates)
                for p in (0.0, 1.0)]  # fmt: skip
        mixed = planner.costs(scene, two_modes(scene, _crossing(-32.0), 0.3), candidates)
    np.testing.assert_allclose(mixed, 0.7 * only[0] + 0.3 * only[1], rtol=1e-5, atol=1e-3)
    assert (only[1] >= only[0] - 1e-3).all()
    assert (only[1] > only[0] + 1).any()


def test_a_mode_without_probability_does_not_count():
    """A crossing mode with probability 0 does not change the bits of the plan."""
    scene = approach(_walker(-30.0)).world.scene()
    planner = ContingencyPlanner()
    with np.errstate(divide="ignore"):
        never = planner.plan(scene, two_modes(scene, _crossing(-30.0), 0.0))
    assert never.states.tobytes() == planner.plan(scene, straight_ahead(scene)).states.tobytes()


def test_a_faster_car_behind_changes_nothing():
    """The ego is not at fault for contacts at its rear."""
    empty = approach().world.scene()
    planner = ContingencyPlanner()
    alone = planner.plan(empty, straight_ahead(empty)).states
    followed = approach(car(-115.0, 14.0)).world.scene()
    assert planner.plan(followed, straight_ahead(followed)).states.tobytes() == alone.tobytes()


@pytest.mark.parametrize(("gap_m", "own"), [(-0.2, True), (0.2, False)])
def test_the_egos_trailer_is_ignored(gap_m, own):
    """A trailer that touches the ego is ignored, even if it is forecast in the ego's way."""
    planner = ContingencyPlanner()
    alone = approach().world.scene()
    expected = planner.plan(alone, straight_ahead(alone)).states
    behind = car(-90.0 - 2.25 - gap_m - 3.5, 10.0, kind=AgentClass.TRAILER)
    scene = approach(behind).world.scene()
    blocking = np.tile(np.array([-46.0, -1.75, 0.0, 0.0], dtype=np.float32), (STEPS, 1))
    states = planner.plan(scene, two_modes(scene, blocking, 0.9)).states
    assert (states.tobytes() == expected.tobytes()) is own


def test_slows_down_for_a_bend():
    """A quarter turn of 12 m radius: about √(2.5·12) = 5.5 m/s in it, within 1 m of the track."""
    recording = make_recording(drives=(DRIVES[2],), duration_s=20.0, road_map=wide_map())
    simulation = simulate(recording, scenario(1, length=60))
    states = close_loop(ContingencyPlanner(), simulation, 50)
    path = recording.track(0)[:, :2]
    on_log = states[:, 0] > path[:, 0].min()
    away = np.hypot(*(path[:, None] - states[None, on_log, :2]).transpose(2, 0, 1)).min(axis=0)
    assert away.max() < 1.0
    inside = (states[:, 2] > 1.9) & (states[:, 2] < 2.8)
    assert inside.sum() > 5
    assert states[inside, 3] == pytest.approx(5.5, abs=0.6)


def test_follows_a_route_that_is_off_the_mapped_road():
    """Maps have gaps and offsets: the ego of a route 1 m beside the mapped road drives off.

    The road ends at y = -0.75, and the ego's right side is at y = -1.75 - 0.9. On a road that it is
    on, the same ego does not leave it by as much.
    """
    square = np.array([(-150.0, -0.75), (200.0, -0.75), (200.0, 150.0), (-150.0, 150.0)])
    beside = dataclasses.replace(make_map(), name="beside", drivable=Ragged.pack([square]))
    scene = approach(speed_mps=3.0, road_map=beside).world.scene()
    planner = ContingencyPlanner()
    assert _gain(planner.plan(scene, straight_ahead(scene)).states[0]) > 8
    candidates = planner.candidates(scene, STEPS)
    right_m = candidates.states[0, ..., 1].min(axis=-1)
    leaves = candidates.fixed_costs[0] >= ContingencyWeights().off_road - 40
    assert not leaves[right_m > -1.9].any()
    assert leaves[right_m < -2.2].all()


def test_plans_depend_on_the_weights():
    """Without weights for contacts the ego drives into a standing car."""
    scene = approach(car(-40.0, 0.0)).world.scene()
    forecast = straight_ahead(scene)
    careless = ContingencyPlanner(ContingencyWeights(collision=0.0, critical=0.0, closeness=0.0))
    assert _gain(careless.plan(scene, forecast).states[0]) > 25
    assert _gain(ContingencyPlanner().plan(scene, forecast).states[0]) < 20
