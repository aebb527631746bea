"""Conflicts of logged paths, and who gives way under idm."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from asp_env.data.classes import AgentClass
from asp_env.geometry import overlaps
from asp_env.sim.traffic.idm import IDMDriver, advance, arrival_s
from asp_env.sim.traffic.paths import A_FIRST, ENTRY_A, ENTRY_B, EXIT_A, EXIT_B, SAME_DIRECTION
from tests.builders import Drive
from tests.sim.worlds import car, now, on_road, replay, scenario, simulate

EAST, NORTH, WEST, SOUTH = range(4)
ARMS = {
    EAST: (-1.0, 0.0, 0.0, -1.75),
    NORTH: (0.0, -1.0, 1.75, 0.0),
    WEST: (1.0, 0.0, 0.0, 1.75),
    SOUTH: (0.0, 1.0, -1.75, 0.0),
}
"""By heading: where a car comes from, and how far its lane lies from the centre."""


def coming(way: int, away_m: float, speed_mps: float, *phases: tuple[float, float, float]) -> Drive:
    """A car that drives straight over the crossing and starts so far from its centre."""
    x, y, dx, dy = ARMS[way]
    start = (x * away_m + dx, y * away_m + dy, way * np.pi / 2, speed_mps)
    return Drive(kind=AgentClass.CAR, start=start, phases=phases)


def slowing(way: int, away_m: float, to_mps: float) -> Drive:
    """At 12 m/s for a second, which it wants again under idm, then so slow by the log."""
    return coming(way, away_m, 12.0, (1.0, 0.0, 0.0), ((12.0 - to_mps) / 6.0, -6.0, 0.0))


def _touch(simulation, logged: bool = False) -> bool:
    episodes, tick = simulation.world.episodes, simulation.world.now[0]
    states = (episodes.log_states if logged else episodes.states)[0, tick]
    valid = (episodes.log_valid if logged else episodes.valid)[0, tick]
    there = 1 + np.flatnonzero(valid[1:])  # the ego replays, come what may
    return any(
        overlaps(*states[i, :3], *episodes.sizes[0, i], *states[j, :3], *episodes.sizes[0, j])
        for i in there
        for j in there
        if i < j
    )


def _passed(simulation, track_id: int, way: int) -> bool:
    state = now(simulation, track_id)
    if state is None:
        return True
    x, y, _, _ = ARMS[way]
    return float(-x * state[0] - y * state[1]) > 6.0


def test_the_zone_of_two_crossing_paths_by_hand():
    """Boxes of 4.5 by 1.8 m, the first one 0.3 m wider, points 1 m apart.

    The eastbound car starts at x = -50; its centre is within 2.25 + 0.9 = 3.15 m of 1.75 from
    -1.4 to 4.9: at its points 49 to 54. The northbound one starts at y = -40 and is within
    2.25 + 1.05 = 3.3 m of -1.75 from -5.05 to 1.55: at its points 35 to 41. At 8 m/s the first is
    there after 49/8 s, the second at 4 m/s after 35/4 s.
    """
    simulation = simulate(on_road(coming(EAST, 50, 8), coming(NORTH, 40, 4)), scenario(), "idm")
    driver = simulation.driver
    assert isinstance(driver, IDMDriver)
    zones, dealt = driver.conflicts.zones, driver.ahead
    found = [
        zones[z if z >= 0 else -1 - z]
        for z, other in zip(dealt.zones[0, 1], dealt.others[0, 1], strict=True)
        if other == 2
    ]
    zone = found[0]
    assert zone[[ENTRY_A, EXIT_A, ENTRY_B, EXIT_B]].tolist() == [49, 54, 35, 41]
    assert zone[SAME_DIRECTION] == 0
    assert zone[A_FIRST] == 1


@pytest.mark.parametrize(("first", "second"), [(NORTH, EAST), (EAST, SOUTH), (WEST, NORTH)])
def test_who_was_first_in_the_log_goes_first(first, second):
    """Under idm both would be at the centre after some 8 s; the second in the log waits.

    The first keeps its logged 6 m/s and arrives with its log; the second, slow in its log, wants
    12 m/s again, and does not halt the first.
    """
    early = coming(first, 64, 6.0)
    recording = on_road(early, slowing(second, 95, 4.0), duration_s=30.0)
    simulation = simulate(recording, scenario(length=78), "idm")
    for _ in range(78):
        replay(simulation, 1)
        assert not _touch(simulation)
        state = now(simulation, 2)
        if state is not None:
            assert state[3] > 5.5
            assert _passed(simulation, 2, first) or not _passed(simulation, 3, second)
    assert _passed(simulation, 3, second)


@given(
    ways=st.sampled_from([(EAST, NORTH), (NORTH, WEST), (SOUTH, EAST), (WEST, SOUTH)]),
    speeds=st.tuples(st.floats(3.0, 9.0), st.floats(3.0, 9.0)),
    away=st.tuples(st.floats(75.0, 95.0), st.floats(75.0, 95.0)),
)
def test_two_that_cross_never_touch_and_both_get_over(ways, speeds, away):
    """Whatever their logs, in which they do not touch, as long as those get over in time."""
    drives = [slowing(*each) for each in zip(ways, away, speeds, strict=True)]
    simulation = simulate(on_road(*drives, duration_s=34.0), scenario(length=150), "idm")
    logs = simulate(on_road(*drives, duration_s=34.0), scenario(length=150), "log")
    touched = False
    for _ in range(150):
        replay(logs, 1)
        touched |= _touch(logs)
    assume(not touched)
    assume(all(_passed(logs, 2 + i, way) for i, way in enumerate(ways)))
    for _ in range(150):
        replay(simulation, 1)
        assert not _touch(simulation)
    assert all(_passed(simulation, 2 + i, way) for i, way in enumerate(ways))


def test_four_at_once_do_not_block_each_other():
    """All four arms, 12 m/s wanted, logs that reach the centre 4 s apart: nobody waits for ever."""
    drives = [slowing(way, 80, to_mps) for way, to_mps in enumerate((9.0, 5.6, 4.0, 3.2))]
    simulation = simulate(on_road(*drives, duration_s=34.0), scenario(length=150), "idm")
    for _ in range(100):
        replay(simulation, 1)
        assert not _touch(simulation)
    assert all(_passed(simulation, 2 + way, way) for way in range(4))


def test_waits_for_a_pedestrian_that_crosses_and_goes_on():
    """Somebody walks over the road at 1.2 m/s from the side; the car wants 12 m/s."""
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(0.0, -16.0, np.pi / 2, 1.2), appears_s=1.0)
    recording = on_road(walker, slowing(EAST, 90, 4.0), duration_s=34.0)
    simulation = simulate(recording, scenario(length=120), "idm")
    for _ in range(120):
        replay(simulation, 1)
        assert not _touch(simulation)
    assert _passed(simulation, 3, EAST)


def test_one_that_stands_for_ever_is_not_waited_for():
    """Logged first over the crossing, it does nothing under the caller: after 3 s others go."""
    recording = on_road(coming(NORTH, 64, 6.0), slowing(EAST, 95, 4.0), duration_s=34.0)
    simulation = simulate(recording, scenario(length=150), {"default": "idm", 2: "policy"})
    actions = np.zeros((1, 3, 2), dtype=np.float32)
    actions[0, 1, 0] = -4.0
    driven = np.array([[False, True, False]])
    for _ in range(150):
        simulation.step_agents(actions, driven)
        assert not _touch(simulation)
    assert now(simulation, 2) is not None
    assert _passed(simulation, 3, EAST)


@pytest.mark.parametrize(("standing_x_m", "comes"), [(-52.0, False), (-45.0, False), (-38.0, True)])
def test_nobody_comes_where_it_could_not_stop(standing_x_m, comes):
    """One appears at x = -50 m with 8 m/s; it needs 6.4 m to halt, and its length."""
    recording = on_road(car(standing_x_m, 0, appears_s=1.0), car(-50, 8, appears_s=4.0))
    simulation = simulate(recording, scenario(length=30), "idm")
    replay(simulation, 5)
    assert (now(simulation, 3) is not None) == comes
    for _ in range(25):
        replay(simulation, 1)
        assert not _touch(simulation)
    assert (now(simulation, 3) is not None) == comes


@pytest.mark.parametrize(("speed_mps", "brakes"), [(6.0, True), (0.0, False)])
def test_an_ego_off_its_way_is_looked_for_where_it_will_be(speed_mps, brakes):
    """It drives north at x = 8 m, 6 m beside its path; in a second it will be on the road.

    The road begins 0.85 m above its front, which is 3.4 m below the car's lane: standing there it
    is in nobody's way.
    """
    simulation = simulate(on_road(car(-60, 8)), scenario(length=60), "idm")
    replay(simulation, 10)
    episodes, tick = simulation.world.episodes, simulation.world.now[0]
    episodes.states[0, tick, 0] = 8.0, -8.0, np.pi / 2, speed_mps
    episodes.states[0, tick, 1, 0] = -12.0
    control = simulation.driver.control(simulation.world)
    assert (control.actions[0, 1, 0] < -0.5) == brakes


def test_arrival_by_hand():
    """From 4 m/s at 2 m/s² to 10: 3 s and 21 m; 16 m take √(16 + 64) - 4 over 2, then 10 m/s."""
    assert arrival_s(21.0, 4.0, 10.0, 2.0) == pytest.approx(3.0)
    assert arrival_s(16.0, 4.0, 10.0, 2.0) == pytest.approx((np.sqrt(80) - 4) / 2)
    assert arrival_s(41.0, 4.0, 10.0, 2.0) == pytest.approx(5.0)
    assert arrival_s(30.0, 15.0, 10.0, 2.0) == pytest.approx(2.0)
    assert arrival_s(-1.0, 4.0, 10.0, 2.0) == 0.0


@given(angle=st.floats(0.0, 1.4), aside=st.floats(-2.0, 2.0))
def test_walking_along_a_path_finds_the_nearest_point(angle, aside):
    """On a circle of 20 m, `aside` to the left: arc length and offset, wherever one starts."""
    turn = np.arange(0, 1.6, 1 / 20)
    path = np.stack([20 * np.sin(turn), 20 * (1 - np.cos(turn))], axis=-1)
    radius = 20 - aside
    x, y = radius * np.sin(angle), 20 - radius * np.cos(angle)
    for start in (0.0, 15.0, 30.0):
        arc, offset = advance(path, start, x, y)
        assert arc == pytest.approx(20 * angle, abs=0.05)
        assert offset == pytest.approx(aside, abs=0.02)
