"""Every tag just within and just beyond its rule, in recordings made by hand.

The ego drives along +x from the origin, and its scenario begins at 3 s, tick 15.
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
    """Somebody who passes a place at a time, straight on."""
    back = speed * at_s
    start = (x - back * math.cos(heading), y - back * math.sin(heading), heading, speed)
    return Drive(kind=kind, start=start)


def scenarios_of(recording: Recording) -> ScenarioSet:
    """All of its scenarios with 3 s of history."""
    return find_scenarios([recording], source="made up", dt_s=0.2, history=15)


def first(*drives: Drive, duration_s: float = 20.0) -> ScenarioSet:
    """The first drive's scenario."""
    found = scenarios_of(make_recording(drives=drives, duration_s=duration_s, frame_rate_hz=10.0))
    return found.select(np.flatnonzero(found.ego_id == 1)[:1])


def has(tag: str, *drives: Drive) -> bool:
    """Whether the first drive's scenario has a tag."""
    return bool(first(*drives).has(tag)[0])


@pytest.mark.parametrize(("steering", "expected"), [(0.093, False), (0.095, True), (-0.095, True)])
def test_u_turn(steering: float, expected: bool) -> None:
    """75 m turn by 75·sin β/1.35 with tan β = tan δ/2: 148.3° and 151.4°, of which 150° decide."""
    turning = car(0, 0, 0, 5, ((60, 0, steering),))
    assert has("u-turn", turning) == expected
    assert has("left" if steering > 0 else "right", turning)


def test_headings_of_who_stands_do_not_count() -> None:
    """A box that spins while it waits has turned nowhere, one that turns while it creeps has."""
    waits = car(0, 0, 0, 5, ((6, 0, 0), (2.5, -2, 0), (4, 0, 0), (5, 2, 0)))
    recording = make_recording(drives=(waits,), duration_s=20.0, frame_rate_hz=10.0)
    states = recording.states.copy()
    still = states[:, 3] < 0.4
    states[still, 2] += np.linspace(0, 3.0, still.sum())
    spun = scenarios_of(dataclasses.replace(recording, states=states))
    assert spun.has("straight").all()
    assert spun.column("turn_deg") == pytest.approx([0.0], abs=1e-3)


@pytest.mark.parametrize(("speed", "expected"), [(0.49, True), (0.51, False)])
def test_standing_start(speed: float, expected: bool) -> None:
    """Below 0.5 m/s at tick 15."""
    assert has("standing-start", car(0, 0, 0, speed, ((3, 0, 0), (4, 1, 0)))) == expected


@pytest.mark.parametrize(("waits_s", "expected"), [(0.4, False), (0.6, True)])
def test_stopping(waits_s: float, expected: bool) -> None:
    """0.4 m/s at 7.8 s, 0 from 8 s on, 0.4 m/s 0.2 s after it goes: 0.8 s and 1 s below 0.5 m/s."""
    stops = car(0, 0, 0, 4, ((6, 0, 0), (2, -2, 0), (waits_s, 0, 0), (4, 2, 0)))
    assert has("stopping", stops) == expected


@pytest.mark.parametrize(("speed", "expected"), [(1.9, False), (2.0, True)])
def test_stopping_needs_to_have_driven(speed: float, expected: bool) -> None:
    """At 2 m/s or more before it stands; that it drives off later does not count."""
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
    """A leader as fast as the ego: at most 3 s or 5 m ahead, on the way."""
    assert has("following", car(0, 0, 0, speed), car(x, y, 0, speed)) == expected


@pytest.mark.parametrize(("leaves_s", "expected"), [(10.4, False), (10.6, True)])
def test_following_over_half_of_the_time(leaves_s: float, expected: bool) -> None:
    """The leader is there at 38 and 39 of 76 ticks."""
    assert has("following", car(0, 0, 0, 8), car(15, 0, 0, 8, leaves_s=leaves_s)) == expected


@pytest.mark.parametrize(
    ("kind", "heading", "expected"),
    [
        (AgentClass.TRUCK, 0.0, True),
        (AgentClass.BICYCLE, 0.0, True),
        (AgentClass.PEDESTRIAN, 0.0, False),
        (CAR, math.pi, False),  # backs away
    ],
)
def test_who_leads(kind: AgentClass, heading: float, expected: bool) -> None:
    """Vehicles and bicycles that head the same way."""
    leader = Drive(kind=kind, start=(17.0, 0.0, heading, 5.0 if heading == 0 else -5.0))
    assert has("following", car(0, 0, 0, 5), leader) == expected


CROSSES_S = 10.1
"""Between ticks 50 and 51; the ego of 5 m/s has its front at 53.25 m at tick 51."""


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
    """Over the middle of the way, ahead, moving, and at an angle."""
    walks = through(x, 0.0, CROSSES_S, math.radians(heading_deg), speed, kind)
    assert has("crossing-vru", car(0, 0, 0, 5), walks) == expected


@pytest.mark.parametrize(("x", "expected"), [(99.0, True), (101.0, False)])
def test_crossing_where_the_ego_goes(x: float, expected: bool) -> None:
    """The recorded way ends at 100 m; what goes on straight from there is nobody's way."""
    assert has("crossing-vru", car(0, 0, 0, 5), through(x, 0, 16.1, 1.5, 1.0, WALKER)) == expected


def test_turning_back_is_no_crossing() -> None:
    """Who comes to 0.5 m from the middle and backs off has crossed nothing."""
    walks = Drive(kind=WALKER, start=(70, -10.5, math.pi / 2, 1), phases=((9, 0, 0), (9, -0.5, 0)))
    assert not has("crossing-vru", car(0, 0, 0, 5), walks)


WAITS = car(-60, 0, 0, 8, ((4, 0, 0), (4, -2, 0), (4, 0, 0), (4, 2, 0)))
"""Stands from 8 s to 12 s with its front 9.75 m before x = 0, gets there at 15.2 s at 6.4 m/s."""


@pytest.mark.parametrize(("at_s", "expected"), [(9.8, False), (10.0, True), (15.0, False)])
def test_yielding(at_s: float, expected: bool) -> None:
    """At 8 m/s the other clears the way, 1.8 m wide, at 10 s and 10.2 s: 5.2 s and 5 s before.

    At 15 s both are there at once.
    """
    assert has("yielding", WAITS, through(0, 0, at_s, math.pi / 2, 8)) == expected


@pytest.mark.parametrize(
    ("heading_deg", "expected"), [(19, False), (21, True), (159, True), (161, False)]
)
def test_yielding_to_who_comes_from_the_side(heading_deg: float, expected: bool) -> None:
    """At 20° or more to the way."""
    assert has("yielding", WAITS, through(0, 0, 11, math.radians(heading_deg), 8)) == expected


@pytest.mark.parametrize(("x", "expected"), [(10.1, True), (10.4, False)])
def test_yielding_at_most_20_m_ahead(x: float, expected: bool) -> None:
    """From where its front waits, at x = -9.75; it is there at 17 s, and the other at 13 s."""
    assert has("yielding", WAITS, through(x, 0, 11.8, math.pi / 2, 8)) == expected


@pytest.mark.parametrize(("brakes_s", "expected"), [(1.5, False), (1.7, True)])
def test_yielding_by_slowing(brakes_s: float, expected: bool) -> None:
    """From 8 to 5 m/s is 0.625, to 4.6 m/s 0.575, of which 0.6 decide; then on at 2 m/s²."""
    slows = car(-52, 0, 0, 8, ((4, 0, 0), (brakes_s, -2, 0), (1, 0, 0), (2, 2, 0)))
    assert has("yielding", slows, through(0, 0, 5.8, math.pi / 2, 8)) == expected


@pytest.mark.parametrize(("gains", "expected"), [(0.9, False), (1.1, True)])
def test_yielding_goes_on(gains: float, expected: bool) -> None:
    """It is 1 m/s faster where the other crossed than where it was slowest, at 3.2 m/s."""
    slows = car(-52, 0, 0, 8, ((4, 0, 0), (2.4, -2, 0), (0.4, gains / 0.4, 0)))
    assert has("yielding", slows, through(0, 0, 6, math.pi / 2, 8)) == expected


def test_slowing_late_is_not_for_who_has_gone() -> None:
    """At its slowest 2.5 s after the other has cleared the way."""
    slows = car(-58, 0, 0, 8, ((4, 0, 0), (3, -2, 0), (0.5, 0, 0), (3, 2, 0)))
    assert has("yielding", slows, through(0, 0, 6, math.pi / 2, 8))
    assert not has("yielding", slows, through(0, 0, 4.5, math.pi / 2, 8))


def test_who_is_behind_a_leader_does_not_yield() -> None:
    """The first in a queue lets the other pass, and the second waits for the first."""
    leader = car(-7, 0, 0, 0, ((11, 0, 0), (9, 2, 0)))
    crossing = through(0, 0, 10, math.pi / 2, 8)
    assert has("yielding", leader, WAITS, crossing)
    assert not has("yielding", WAITS, leader, crossing)


@pytest.mark.parametrize(("y", "expected"), [(29.9, 2.0), (30.1, 1.0)])
def test_density(y: float, expected: float) -> None:
    """Who drives beside the ego all the time at 10 m and at 29.9 m; parked cars are nobody."""
    beside = (car(0, -10, 0, 5), car(0, y, 0, 5), car(20, 5, 0, 0))
    found = first(car(0, 0, 0, 5), *beside)
    assert found.column("density")[0] == expected
    assert found.column("agents")[0] == 2


def test_density_is_a_mean_over_ticks() -> None:
    """There at 19 of 76 ticks, from tick 15 to tick 33."""
    found = first(car(0, 0, 0, 5), car(0, 10, 0, 5, leaves_s=6.6))
    assert found.column("density")[0] == 19 / 76


def test_measures() -> None:
    """15 s at 5 m/s, then 2 s of braking by 1 m/s²: 3 to 18 s are 74.5 m, of 2 s more no part."""
    found = first(car(0, 0, 0, 5, ((17, 0, 0), (2, -1, 0))))
    assert found.column("length_s")[0] == pytest.approx(15.0)
    assert found.column("distance_m")[0] == pytest.approx(74.5, abs=1e-3)
    assert found.column("max_speed_mps")[0] == 5.0


def test_every_scenario_has_one_turn() -> None:
    """Left, right and straight are all there is, of the drives of the made-up crossing."""
    found = scenarios_of(make_recording())
    turns = np.stack([found.has(tag) for tag in ("left", "right", "straight")])
    assert (turns.sum(axis=0) == 1).all()
    assert set(found.counts()) == set(TAGS)


@pytest.mark.parametrize("dt_s", [0.1, 0.5, 1.0])
def test_other_time_steps(dt_s: float) -> None:
    """At 25 m/s a leader 2 s ahead is followed, and who crosses is seen, however long a tick is."""
    drives = (
        car(0, 0, 0, 25),
        car(54, 0, 0, 25),
        through(310, 0, 11.3, math.pi / 2, 2, AgentClass.BICYCLE),
    )
    recording = make_recording(drives=drives, duration_s=20.0, frame_rate_hz=10.0)
    found = find_scenarios([recording], source="", dt_s=dt_s, history=round(3 / dt_s))
    assert set(found[0].tags) == {"straight", "following", "crossing-vru"}
