"""Conflicts of paths, and which vehicle gives way under `idm`."""

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
"""By heading: the side that a car comes from, and the offset of its lane from the centre."""


def coming(
    heading: int, away_m: float, speed_mps: float, *phases: tuple[float, float, float]
) -> Drive:
    """A car that drives straight over the crossing and starts at a distance from its centre."""
    x, y, dx, dy = ARMS[heading]
    start = (x * away_m + dx, y * away_m + dy, heading * np.pi / 2, speed_mps)
    return Drive(kind=AgentClass.CAR, start=start, phases=phases)


def slowing(heading: int, away_m: float, to_mps: float) -> Drive:
    """Recorded at 12 m/s for 1 s, which is its desired speed under idm, then at `to_mps`."""
    return coming(heading, away_m, 12.0, (1.0, 0.0, 0.0), ((12.0 - to_mps) / 6.0, -6.0, 0.0))


def _touch(simulation, logged: bool = False) -> bool:
    episodes, tick = simulation.world.episodes, simulation.world.now[0]
    states = (episodes.log_states if logged else episodes.states)[0, tick]
    valid = (episodes.log_valid if logged else episodes.valid)[0, tick]
    present = 1 + np.flatnonzero(valid[1:])  # the ego replays and may touch others
    return any(
        overlaps(*states[i, :3], *episodes.sizes[0, i], *states[j, :3], *episodes.sizes[0, j])
        for i in present
        for j in present
        if i < j
    )


def _passed(simulation, track_id: int, heading: int) -> bool:
    state = now(simulation, track_id)
    if state is None:
        return True
    x, y, _, _ = ARMS[heading]
    return float(-x * state[0] - y * state[1]) > 6.0


def test_the_zone_of_two_crossing_paths_by_hand():
    """Boxes of 4.5 m by 1.8 m, the first one 0.3 m wider, points 1 m apart.

    The eastbound car starts at x = -50; its centre is within 2.25 + 0.9 = 3.15 m of 1.75 from
    -1.4 to 4.9: at its points 49 to 54. The northbound one starts at y = -40 and is within
    2.25 + 1.05 = 3.3 m of -1.75 from -5.05 to 1.55: at its points 35 to 41. At 8 m/s the first
    enters after 49/8 s, the second at 4 m/s after 35/4 s.
    """
    simulation = simulate(on_road(coming(EAST, 50, 8), coming(NORTH, 40, 4)), scenario(), "idm")
    driver = simulation.driver
    assert isinstance(driver, IDMDriver)
    zones, upcoming = driver.conflicts.table.zones, driver.upcoming
    index = upcoming.own_zones[0, 1, upcoming.other_agents[0, 1] == 2][0]
    zone = zones[index if index >= 0 else -1 - index]
    assert zone[[ENTRY_A, EXIT_A, ENTRY_B, EXIT_B]].tolist() == [49, 54, 35, 41]
    assert zone[SAME_DIRECTION] == 0
    assert zone[A_FIRST] == 1


@pytest.mark.parametrize(("first", "second"), [(NORTH, EAST), (EAST, SOUTH), (WEST, NORTH)])
def test_the_agent_that_was_recorded_first_goes_first(first, second):
    """Under idm both would reach the centre after about 8 s; the second in the recording waits.

    The first keeps its recorded 6 m/s; the second, which was recorded slower, desires 12 m/s and
    does not stop the first.
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
    headings=st.sampled_from([(EAST, NORTH), (NORTH, WEST), (SOUTH, EAST), (WEST, SOUTH)]),
    speeds=st.tuples(st.floats(3.0, 9.0), st.floats(3.0, 9.0)),
    away=st.tuples(st.floats(75.0, 95.0), st.floats(75.0, 95.0)),
)
def test_two_crossing_vehicles_never_touch_and_both_pass(headings, speeds, away):
    """For all pairs of tracks that do not touch and that pass in time."""
    drives = [slowing(*each) for each in zip(headings, away, speeds, strict=True)]
    simulation = simulate(on_road(*drives, duration_s=34.0), scenario(length=150), "idm")
    replayed = simulate(on_road(*drives, duration_s=34.0), scenario(length=150), "log")
    touched = False
    for _ in range(150):
        replay(replayed, 1)
        touched |= _touch(replayed)
    assume(not touched)
    assume(all(_passed(replayed, 2 + i, heading) for i, heading in enumerate(headings)))
    for _ in range(150):
        replay(simulation, 1)
        assert not _touch(simulation)
    assert all(_passed(simulation, 2 + i, heading) for i, heading in enumerate(headings))


def test_four_vehicles_from_all_arms_do_not_block_each_other():
    """Their tracks reach the centre 4 s apart; all desire 12 m/s."""
    drives = [slowing(heading, 80, to_mps) for heading, to_mps in enumerate((9.0, 5.6, 4.0, 3.2))]
    simulation = simulate(on_road(*drives, duration_s=34.0), scenario(length=150), "idm")
    for _ in range(100):
        replay(simulation, 1)
        assert not _touch(simulation)
    assert all(_passed(simulation, 2 + heading, heading) for heading in range(4))


def test_waits_for_a_crossing_pedestrian_and_continues():
    """The pedestrian walks at 1.2 m/s from the side; the car desires 12 m/s."""
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(0.0, -16.0, np.pi / 2, 1.2), appears_s=1.0)
    recording = on_road(walker, slowing(EAST, 90, 4.0), duration_s=34.0)
    simulation = simulate(recording, scenario(length=120), "idm")
    for _ in range(120):
        replay(simulation, 1)
        assert not _touch(simulation)
    assert _passed(simulation, 3, EAST)


def test_vehicles_do_not_wait_for_an_agent_that_stands():
    """The agent was recorded first over the crossing, but the caller keeps it standing."""
    recording = on_road(coming(NORTH, 64, 6.0), slowing(EAST, 95, 4.0), duration_s=34.0)
    simulation = simulate(recording, scenario(length=150), {"default": "idm", 2: "policy"})
    actions = np.zeros((1, 3, 2), dtype=np.float32)
    actions[0, 1, 0] = -4.0
    controlled = np.array([[False, True, False]])
    for _ in range(150):
        simulation.step_agents(actions, controlled)
        assert not _touch(simulation)
    assert now(simulation, 2) is not None
    assert _passed(simulation, 3, EAST)


@pytest.mark.parametrize(
    ("standing_x_m", "appears"), [(-52.0, False), (-45.0, False), (-38.0, True)]
)
def test_a_vehicle_appears_only_where_it_could_stop(standing_x_m, appears):
    """It would appear at x = -50 m with 8 m/s; it needs 6.4 m to stop, and its length."""
    recording = on_road(car(standing_x_m, 0, appears_s=1.0), car(-50, 8, appears_s=4.0))
    simulation = simulate(recording, scenario(length=30), "idm")
    replay(simulation, 5)
    assert (now(simulation, 3) is not None) == appears
    for _ in range(25):
        replay(simulation, 1)
        assert not _touch(simulation)
    assert (now(simulation, 3) is not None) == appears


@pytest.mark.parametrize(("speed_mps", "brakes"), [(6.0, True), (0.0, False)])
def test_an_ego_off_its_path_is_expected_straight_ahead(speed_mps, brakes):
    """The ego drives north at x = 8 m, 6 m beside its path, and is on the road in 1 s.

    Its front is at y = -5.75, the car's lane at -1.75: standing there, it blocks no path.
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
def test_advance_finds_the_nearest_point(angle, aside):
    """Arc length and offset on a circle of 20 m, `aside` to the left, from any start."""
    turn = np.arange(0, 1.6, 1 / 20)
    path = np.stack([20 * np.sin(turn), 20 * (1 - np.cos(turn))], axis=-1)
    radius = 20 - aside
    x, y = radius * np.sin(angle), 20 - radius * np.cos(angle)
    for start in (0.0, 15.0, 30.0):
        arc, offset = advance(path, start, x, y)
        assert arc == pytest.approx(20 * angle, abs=0.05)
        assert offset == pytest.approx(aside, abs=0.02)
