"""The driver `hybrid`."""

import numpy as np
import pytest

from asp_env.sim.traffic.hybrid import HORIZON_S
from tests.builders import make_recording
from tests.sim.worlds import DT_S, car, drive, now, replay, scenario, simulate

PAIR = (car(-60, 8), car(-85, 8))
"""The ego, and a car 25 m behind it in the same lane."""

QUEUE = (*PAIR, car(-97, 8))


def _log(simulation, track_id: int) -> np.ndarray:
    episodes, tick = simulation.world.episodes, simulation.world.now[0]
    return episodes.log_states[0, tick, int(np.flatnonzero(episodes.ids[0] == track_id)[0])]


def test_all_vehicles_replay_while_the_ego_replays():
    """Bit for bit, also where tracks nearly touch."""
    simulation = simulate(make_recording(), scenario(1, length=60), "hybrid")
    replay(simulation, 60)
    episodes = simulation.world.episodes
    assert episodes.states.tobytes() == episodes.log_states.tobytes()


def test_a_follower_switches_when_its_track_conflicts_with_the_ego():
    """The ego brakes by 3 m/s² from 8 m/s: the track leads through it, the follower stops.

    The follower's front is 20.5 m behind the ego's rear. It switches when 2 s of its track at 8 m/s
    reach the ego, expected at its present speed v: the gap then is below 2·(8 - v).
    """
    simulation = simulate(
        make_recording(drives=PAIR, duration_s=18.0), scenario(1, length=60), "hybrid"
    )
    switched, gap, speed = False, 20.5, 8.0
    for _ in range(60):
        behind, ahead = now(simulation, 2), now(simulation, 1)
        assert behind is not None
        assert ahead is not None
        if not switched and behind.tobytes() != _log(simulation, 2).tobytes():
            switched = True
            assert gap < HORIZON_S * (8.0 - speed) + 0.1
        if not switched and gap < HORIZON_S * (8.0 - speed) - 0.1:
            pytest.fail("expected to switch at the tick before")
        gap, speed = ahead[0] - behind[0] - 4.5, ahead[3]
        drive(simulation, [(-3.0, 0.0)])
        assert not simulation.world.events().collision.any()
    assert switched
    final = now(simulation, 2)
    assert final is not None
    assert final[3] < 0.05


def test_switching_is_continuous():
    """At every tick the state changes as the bicycle model allows within 5 m/s²."""
    simulation = simulate(
        make_recording(drives=PAIR, duration_s=18.0), scenario(1, length=60), "hybrid"
    )
    before = now(simulation, 2)
    for _ in range(60):
        drive(simulation, [(-3.0, 0.0)])
        after = now(simulation, 2)
        assert before is not None
        assert after is not None
        assert abs(after[3] - before[3]) <= 5.0 * DT_S + 1e-3
        distance = np.hypot(*(after[:2] - before[:2]))
        assert distance == pytest.approx(0.5 * (before[3] + after[3]) * DT_S, abs=0.02)
        before = after


def test_vehicles_that_have_switched_make_others_switch():
    """The third car does not drive through the second, which has stopped behind the ego."""
    simulation = simulate(
        make_recording(drives=QUEUE, duration_s=18.0), scenario(1, length=60), "hybrid"
    )
    for _ in range(60):
        drive(simulation, [(-3.0, 0.0)])
        second, third = now(simulation, 2), now(simulation, 3)
        assert second is not None
        assert third is not None
        assert second[0] - third[0] > 4.5
    third = now(simulation, 3)
    assert third is not None
    assert third[3] < 0.05


def test_a_vehicle_does_not_switch_back():
    """The ego stops and drives off again; the follower continues under idm, behind its track."""
    simulation = simulate(
        make_recording(drives=PAIR, duration_s=30.0), scenario(1, length=75), "hybrid"
    )
    drive(simulation, [(-3.0, 0.0)] * 15)
    drive(simulation, [(3.0, 0.0)] * 20)
    behind = now(simulation, 2)
    assert behind is not None
    assert _log(simulation, 2)[0] - behind[0] > 5.0
    assert behind[3] > 1.0


def test_an_ego_off_its_route_is_expected_straight_ahead():
    """The ego leaves the lane to the right by 8 m and stops; the follower replays past it."""
    simulation = simulate(
        make_recording(drives=PAIR, duration_s=18.0), scenario(1, length=50), "hybrid"
    )
    drive(simulation, [(0.0, -0.35)] * 5 + [(0.0, 0.0)] * 4 + [(-4.0, 0.0)] * 30)
    follower, ego = now(simulation, 2), now(simulation, 1)
    assert follower is not None
    assert ego is not None
    assert ego[1] < -8.0
    assert follower.tobytes() == _log(simulation, 2).tobytes()
