"""Every tag just within and just beyond its thresholds, in constructed recordings.

The ego drives along +x from the origin, and its scenario starts at 3 s, tick 15.
"""

import dataclasses
import math

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.recording import Recording
from asp_env.data.scenarios.scenario import ScenarioSet, find_scenarios
from asp_env.data.scenarios.tags import TAGS
from tests.builders import Drive, make_recording

CAR, WALKER = AgentClass.CAR, AgentClass.PEDESTRIAN
Phases = tuple[tuple[float, float, float], ...]


def car(x: float, y: float, heading: float, speed: float, phases: Phases = (), **more: float):
    """A car of 4.5 m by 1.8 m."""
    return Drive(kind=CAR, start=(x, y, heading, speed), phases=phases, **more)


def through(
    x: float, y: float, at_s: float, heading: float, speed: float, kind: AgentClass = CAR
) -> Drive:
    """An agent that moves straight and is at a place at a given time."""
    back = speed * at_s
    start = (x - back * math.cos(heading), y - back * math.sin(heading), heading, speed)
    return Drive(kind=kind, start=start)


def scenarios_of(recording: Recording) -> ScenarioSet:
    """All scenarios of a recording, with 3 s of history."""
    return find_scenarios([recording], source="made up", dt_s=0.2, history=15)


def first(*drives: Drive, duration_s: float = 20.0) -> ScenarioSet:
    """The scenario of the first drive."""
    found = scenarios_of(make_recording(drives=drives, duration_s=duration_s, frame_rate_hz=10.0))
    return found.select(np.flatnonzero(found.ego_id == 1)[:1])


def has(tag: str, *drives: Drive) -> bool:
    """Whether the scenario of the first drive has a tag."""
    return bool(first(*drives).has(tag)[0])


@pytest.mark.parametrize(("steering", "expected"), [(0.093, False), (0.095, True), (-0.095, True)])
def test_u_turn(steering: float, expected: bool) -> None:
    """75 m turn by 75·sin β/1.35 with tan β = tan δ/2: 148.3° or 151.4°; the threshold is 150°."""
    turning = car(0, 0, 0, 5, ((60, 0, steering),))
    assert has("u-turn", turning) == expected
    assert has("left" if steering > 0 else "right", turning)


def test_headings_of_standing_vehicles_are_ignored() -> None:
    """A box that rotates while it stands is straight."""
    waits = car(0, 0, 0, 5, ((6, 0, 0), (2.5, -2, 0), (4, 0, 0), (5, 2, 0)))
    recording = make_recording(drives=(waits,), duration_s=20.0, frame_rate_hz=10.0)
    states = recording.states.copy()
    stands = states[:, 3] < 0.4
    states[stands, 2] += np.linspace(0, 3.0, stands.sum())
    rotated = scenarios_of(dataclasses.replace(recording, states=states))
    assert rotated.has("straight").all()
    assert rotated.column("turn_deg") == pytest.approx([0.0], abs=1e-3)


@pytest.mark.parametrize(("speed", "expected"), [(0.49, True), (0.51, False)])
def test_standing_start(speed: float, expected: bool) -> None:
    """Below 0.5 m/s at tick 15."""
    assert has("standing-start", car(0, 0, 0, speed, ((3, 0, 0), (4, 1, 0)))) == expected


@pytest.mark.parametrize(("waits_s", "expected"), [(0.4, False), (0.6, True)])
def test_stopping(waits_s: float, expected: bool) -> None:
    """0.4 m/s at 7.8 s, 0 from 8 s on, 0.4 m/s 0.2 s after the start: 0.8 or 1 s below 0.5 m/s."""
    stops = car(0, 0, 0, 4, ((6, 0, 0), (2, -2, 0), (waits_s, 0, 0), (4, 2, 0)))
    assert has("stopping", stops) == expected


@pytest.mark.parametrize(("speed", "expected"), [(1.9, False), (2.0, True)])
def test_stopping_requires_driving_before(speed: float, expected: bool) -> None:
    """At 2 m/s or more; driving afterwards does not count."""
    stops = car(0, 0, 0, speed, ((6, 0, 0), (2, -2, 0), (2, 0, 0), (4, 2, 0)))
    assert has("stopping", stops) == expected


@pytest.mark.parametrize(
    ("x", "y", "speed", "expected"),
    [
        (34.4, 0.0, 10.0, True),  # a gap of 29.9 m, 2.99 s
        (34.6, 0.0, 10.0, False),
        (20.0, 1.79, 10.0, True),  # half of both widths are 1.8 m
        (20.0, 1.81, 10.0, False),
        (20.0, -1.79, 10.0, True),
        (-20.0, 0.0, 10.0, False),
        (94.4, 0.0, 30.0, True),  # 89.9 m at 30 m/s
        (94.6, 0.0, 30.0, False),
        (9.4, 0.0, 1.0, True),  # 4.9 m, although 3 s are 3 m
        (9.6, 0.0, 1.0, False),
    ],
)
def test_following(x: float, y: float, speed: float, expected: bool) -> None:
    """A leader as fast as the ego, on the route, at most 3 s or 5 m ahead."""
    assert has("following", car(0, 0, 0, speed), car(x, y, 0, speed)) == expected


@pytest.mark.parametrize(("leaves_s", "expected"), [(10.4, False), (10.6, True)])
def test_following_over_half_of_the_time(leaves_s: float, expected: bool) -> None:
    """The leader is present at 38 or 39 of 76 ticks."""
    assert has("following", car(0, 0, 0, 8), car(15, 0, 0, 8, leaves_s=leaves_s)) == expected


@pytest.mark.parametrize(
    ("kind", "heading", "expected"),
    [
        (AgentClass.TRUCK, 0.0, True),
        (AgentClass.BICYCLE, 0.0, True),
        (AgentClass.PEDESTRIAN, 0.0, False),
        (CAR, math.pi, False),  # drives backwards
    ],
)
def test_possible_leaders(kind: AgentClass, heading: float, expected: bool) -> None:
    """Vehicles and bicycles with the heading of the route."""
    leader = Drive(kind=kind, start=(17.0, 0.0, heading, 5.0 if heading == 0 else -5.0))
    assert has("following", car(0, 0, 0, 5), leader) == expected


CROSSES_S = 10.1
"""Between ticks 50 and 51; at 5 m/s the ego's front is at 53.25 m at tick 51."""


@pytest.mark.parametrize(
    ("x", "heading_deg", "speed", "kind", "expected"),
    [
        (83.2, 90, 1.0, WALKER, True),  # 29.95 m ahead
        (83.3, 90, 1.0, WALKER, False),
        (53.3, 90, 1.0, WALKER, True),
        (53.2, 90, 1.0, WALKER, False),  # beside the ego's front
        (70.0, 31, 1.0, WALKER, True),
        (70.0, 29, 1.0, WALKER, False),
        (70.0, -149, 1.0, WALKER, True),
        (70.0, -151, 1.0, WALKER, False),
        (70.0, 90, 0.51, WALKER, True),
        (70.0, 90, 0.49, WALKER, False),
        (70.0, 90, 5.0, AgentClass.BICYCLE, True),
        (70.0, 90, 5.0, CAR, False),
    ],
)
def test_crossing_vru(
    x: float, heading_deg: float, speed: float, kind: AgentClass, expected: bool
) -> None:
    """Across the centre of the route, ahead, moving, and at an angle."""
    walks = through(x, 0.0, CROSSES_S, math.radians(heading_deg), speed, kind)
    assert has("crossing-vru", car(0, 0, 0, 5), walks) == expected


@pytest.mark.parametrize(("x", "expected"), [(99.0, True), (101.0, False)])
def test_crossing_counts_on_the_recorded_route_only(x: float, expected: bool) -> None:
    """It ends at 100 m."""
    assert has("crossing-vru", car(0, 0, 0, 5), through(x, 0, 16.1, 1.5, 1.0, WALKER)) == expected


def test_turning_back_is_no_crossing() -> None:
    """The pedestrian comes within 0.5 m of the centre and goes back."""
    walks = Drive(kind=WALKER, start=(70, -10.5, math.pi / 2, 1), phases=((9, 0, 0), (9, -0.5, 0)))
    assert not has("crossing-vru", car(0, 0, 0, 5), walks)


WAITS = car(-60, 0, 0, 8, ((4, 0, 0), (4, -2, 0), (4, 0, 0), (4, 2, 0)))
"""Stands from 8 s to 12 s with its front 9.75 m before x = 0, which it reaches at 15.2 s."""


@pytest.mark.parametrize(("at_s", "expected"), [(9.8, False), (10.0, True), (15.0, False)])
def test_yielding(at_s: float, expected: bool) -> None:
    """At 8 m/s the other car leaves the route at 10 s or 10.2 s: 5.2 s or 5 s before the ego.

    At 15 s both arrive together.
    """
    assert has("yielding", WAITS, through(0, 0, at_s, math.pi / 2, 8)) == expected


@pytest.mark.parametrize(
    ("heading_deg", "expected"), [(19, False), (21, True), (159, True), (161, False)]
)
def test_yielding_to_agents_from_the_side(heading_deg: float, expected: bool) -> None:
    """At 20° or more to the route."""
    assert has("yielding", WAITS, through(0, 0, 11, math.radians(heading_deg), 8)) == expected


@pytest.mark.parametrize(("x", "expected"), [(10.1, True), (10.4, False)])
def test_yielding_at_most_20_m_ahead(x: float, expected: bool) -> None:
    """From its front at x = -9.75; the ego arrives at 17 s, and the other car at 13 s."""
    assert has("yielding", WAITS, through(x, 0, 11.8, math.pi / 2, 8)) == expected


@pytest.mark.parametrize(("brakes_s", "expected"), [(1.5, False), (1.7, True)])
def test_yielding_by_slowing(brakes_s: float, expected: bool) -> None:
    """From 8 to 5 m/s is a share of 0.625, to 4.6 m/s of 0.575; the threshold is 0.6."""
    slows = car(-52, 0, 0, 8, ((4, 0, 0), (brakes_s, -2, 0), (1, 0, 0), (2, 2, 0)))
    assert has("yielding", slows, through(0, 0, 5.8, math.pi / 2, 8)) == expected


@pytest.mark.parametrize(("gains", "expected"), [(0.9, False), (1.1, True)])
def test_yielding_requires_acceleration_afterwards(gains: float, expected: bool) -> None:
    """It arrives 1 m/s faster than its lowest speed, 3.2 m/s."""
    slows = car(-52, 0, 0, 8, ((4, 0, 0), (2.4, -2, 0), (0.4, gains / 0.4, 0)))
    assert has("yielding", slows, through(0, 0, 6, math.pi / 2, 8)) == expected


def test_slowing_down_late_is_not_yielding() -> None:
    """The ego is slowest 2.5 s after the other car has left the route."""
    slows = car(-58, 0, 0, 8, ((4, 0, 0), (3, -2, 0), (0.5, 0, 0), (3, 2, 0)))
    assert has("yielding", slows, through(0, 0, 6, math.pi / 2, 8))
    assert not has("yielding", slows, through(0, 0, 4.5, math.pi / 2, 8))


def test_only_the_first_vehicle_of_a_queue_yields() -> None:
    leader = car(-7, 0, 0, 0, ((11, 0, 0), (9, 2, 0)))
    crossing = through(0, 0, 10, math.pi / 2, 8)
    assert has("yielding", leader, WAITS, crossing)
    assert not has("yielding", WAITS, leader, crossing)


@pytest.mark.parametrize(("y", "expected"), [(29.9, 2.0), (30.1, 1.0)])
def test_density(y: float, expected: float) -> None:
    """Cars that drive beside the ego at 10 m and at 29.9 m; parked cars do not count."""
    beside = (car(0, -10, 0, 5), car(0, y, 0, 5), car(20, 5, 0, 0))
    found = first(car(0, 0, 0, 5), *beside)
    assert found.column("density")[0] == expected
    assert found.column("agents")[0] == 2


def test_density_is_a_mean_over_ticks() -> None:
    """The other car is present at 19 of 76 ticks, from tick 15 to tick 33."""
    found = first(car(0, 0, 0, 5), car(0, 10, 0, 5, leaves_s=6.6))
    assert found.column("density")[0] == 19 / 76


def test_measures() -> None:
    """The scenario is 3 to 18 s: 14 s at 5 m/s and 1 s of braking by 1 m/s² are 74.5 m."""
    found = first(car(0, 0, 0, 5, ((17, 0, 0), (2, -1, 0))))
    assert found.column("length_s")[0] == pytest.approx(15.0)
    assert found.column("distance_m")[0] == pytest.approx(74.5, abs=1e-3)
    assert found.column("max_speed_mps")[0] == 5.0


def test_every_scenario_has_one_turn() -> None:
    """Left, right or straight."""
    found = scenarios_of(make_recording())
    turns = np.stack([found.has(tag) for tag in ("left", "right", "straight")])
    assert (turns.sum(axis=0) == 1).all()
    assert set(found.counts()) == set(TAGS)


@pytest.mark.parametrize("dt_s", [0.1, 0.5, 1.0])
def test_other_time_steps(dt_s: float) -> None:
    """A leader 2 s ahead at 25 m/s, and a bicycle that crosses 1.1 s before the ego arrives."""
    drives = (
        car(0, 0, 0, 25),
        car(54, 0, 0, 25),
        through(310, 0, 11.3, math.pi / 2, 2, AgentClass.BICYCLE),
    )
    recording = make_recording(drives=drives, duration_s=20.0, frame_rate_hz=10.0)
    found = find_scenarios([recording], source="", dt_s=dt_s, history=round(3 / dt_s))
    assert set(found[0].tags) == {"straight", "following", "crossing-vru", "interactive"}
