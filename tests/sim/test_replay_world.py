"""`ReplayWorld`, step by step."""

import math

import numpy as np
import pytest

from asp_env.data.classes import FOOTPRINTS_M, AgentClass
from asp_env.data.scenarios.scenario import find_scenarios
from asp_env.data.scene import EGO
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from asp_env.metrics.boxes import Contact
from tests.builders import Drive, make_recording
from tests.real_data import real_data
from tests.sim.worlds import (
    DT_S,
    HISTORY,
    car,
    drive,
    now,
    on_road,
    replay,
    scenario,
    simulate,
)


def test_uncontrolled_agents_replay_their_tracks_bit_for_bit():
    """Every state and its validity equal the track at that frame, for a whole episode."""
    recording = make_recording()
    simulation = simulate(recording, scenario(3, length=60))
    replay(simulation, 60)
    episodes = simulation.world.episodes
    for slot, track in enumerate(episodes.tracks[0].tolist()):
        for tick in range(HISTORY + 61):
            row = 5 * tick - recording.first_frames[track]
            present = 0 <= row < len(recording.track(track))
            assert episodes.valid[0, tick, slot] == present
            expected = recording.track(track)[row] if present else np.zeros(4)
            assert episodes.states[0, tick, slot].tobytes() == np.float32(expected).tobytes()


def test_slots_are_ordered_by_ego_then_first_appearance_then_id():
    """Ids 3, 1, 2 appear at 4 s, 0 s and 0 s; the ego is 3, so slots hold 3, 1, 2, 4."""
    recording = on_road(car(-50, 5), car(0, 5, appears_s=4.0), car(30, 5, appears_s=6.0))
    world = simulate(recording, scenario(3, start=40, length=20)).world
    assert world.episodes.ids.tolist() == [[3, 1, 2, 4]]
    assert world.scene().ids.tolist() == [[3, 1, 2, 4]]


def test_constant_acceleration_by_hand():
    """From 10 m/s with 1 m/s²: 10.2, 10.4, … m/s, and 10 t + t²/2 metres after t seconds."""
    simulation = simulate(
        make_recording(drives=(car(-90.0, 10.0),), duration_s=12.0), scenario(length=10)
    )
    start = now(simulation, 1)
    assert start is not None
    assert start.tolist() == pytest.approx([-60.0, -1.75, 0.0, 10.0], abs=1e-4)
    for step in range(1, 6):
        drive(simulation, [(1.0, 0.0)])
        t = DT_S * step
        expected = [-60 + 10 * t + 0.5 * t * t, -1.75, 0.0, 10 + t]
        assert now(simulation, 1) == pytest.approx(expected, abs=1e-4)


def test_steering_by_hand():
    """Sine of slip 0.27, 5 m/s, axle 1.35 m: 1 rad/s; each step is a chord of 0.995 m.

    Heun takes the mean of the velocities at both ends of a step, whose courses differ by 0.2 rad:
    length 5·0.2·cos(0.1) along the middle course.
    """
    simulation = simulate(
        make_recording(drives=(car(-90.0, 5.0),), duration_s=12.0), scenario(length=10)
    )
    slip = math.asin(0.27)
    x, y = -75.0, -1.75
    for step in range(5):
        drive(simulation, [(0.0, math.atan(2 * math.tan(slip)))])
        course = slip + 0.2 * step + 0.1
        x, y = x + math.cos(0.1) * math.cos(course), y + math.cos(0.1) * math.sin(course)
        expected = [x, y, 0.2 * (step + 1), 5.0]
        assert now(simulation, 1) == pytest.approx(expected, abs=1e-4)


def test_braking_ends_at_standstill():
    """1 m/s minus 5 m/s² for 0.2 s is 0, and it stays 0."""
    recording = make_recording(
        drives=(car(-90.0, 6.0, (3.0, -5 / 3, 0.0)), car(0.0, 0.0)), duration_s=12.0
    )
    simulation = simulate(recording, scenario(start=15, length=10))
    drive(simulation, [(-5.0, 0.0)] * 4)
    state = now(simulation, 1)
    assert state is not None
    assert state[3] == 0.0
    x = state[0]
    drive(simulation, [(-5.0, 0.3)] * 3)
    assert now(simulation, 1) == pytest.approx([x, -1.75, 0.0, 0.0], abs=1e-6)


def test_agents_that_left_stay_absent():
    """They are invalid and zero although their track continues."""
    simulation = simulate(on_road(car(-50, 5)), scenario(length=10))
    world = simulation.world
    uncontrolled = np.zeros((1, 2), dtype=bool)
    leaving = np.array([[False, True]])
    world.step(np.zeros((1, 2, 2), dtype=np.float32), uncontrolled, leaving)
    assert now(simulation, 2) is None
    world.step(np.zeros((1, 2, 2), dtype=np.float32), uncontrolled)
    assert now(simulation, 2) is None
    assert not world.episodes.states[0, world.now[0], 1].any()


def test_a_controlled_agent_does_not_appear():
    """Its track starts at 4 s, but an agent that is controlled before stays absent."""
    simulation = simulate(on_road(car(-50, 5, appears_s=4.0)), scenario(length=10))
    controlled = np.array([[False, True]])
    simulation.world.step(np.ones((1, 2, 2), dtype=np.float32), controlled)
    assert now(simulation, 2) is None


@pytest.mark.parametrize("traffic", ["log", "log-actions", "idm"])
def test_an_episode_that_is_over_does_not_change(traffic):
    """Steps after the end of the scenario change neither states nor events."""
    simulation = simulate(on_road(car(-50, 5)), scenario(length=4), traffic)
    drive(simulation, [(0.5, 0.0)] * 4)
    scene, events = simulation.world.scene(), simulation.world.events()
    assert events.elapsed.tolist() == [4]
    drive(simulation, [(0.5, 0.0)] * 3)
    assert simulation.world.scene().states.tobytes() == scene.states.tobytes()
    after = simulation.world.events()
    assert after.elapsed.tolist() == [4]
    assert after.route_m.tolist() == events.route_m.tolist()


@pytest.mark.parametrize(
    ("unfit", "message"),
    [
        (scenario(9), "has no track 9"),
        (scenario(1, start=2), "ticks -1 to"),
        (scenario(1, length=0), "are needed"),
        (scenario(1, start=90, length=11), "spans 0 to 100"),
    ],
    ids=["no such track", "before its track", "no length", "after its track"],
)
def test_a_scenario_that_does_not_fit_is_refused(unfit, message):
    """The message is one line; a 20 s track has ticks 0 to 100."""
    with pytest.raises(AspEnvError, match=message) as caught:
        simulate(on_road(), unfit)
    assert "\n" not in str(caught.value)


def test_a_history_of_over_3_s_suits_the_same_scenarios():
    """The ego's track and the recording begin 3 s before the start; the world shows 4 s.

    The ticks before are empty, all later ones are those of a world that shows 3 s.
    """
    scenes = []
    for history in (15, 20):
        simulation = simulate(on_road(car(-50, 5)), scenario(length=4), history=history)
        drive(simulation, [(1.0, 0.1)] * 2)
        scenes.append(simulation.world.scene())
    short, long = scenes
    assert long.valid[0, :, :3].tolist() == [[False] * 3] * 2
    for name in ("states", "valid"):
        later = getattr(long, name)[:, :, 5:]
        np.testing.assert_array_equal(later, getattr(short, name))
    np.testing.assert_array_equal(long.actions[:, :, 5:], short.actions)
    np.testing.assert_array_equal(long.tick, short.tick)


def test_a_refused_reset_changes_nothing():
    """A scenario that does not fit leaves all episodes unchanged, also those before it."""
    simulation = simulate(on_road(), [scenario(), scenario()])
    drive(simulation, [(1.0, 0.0)] * 3)
    before = simulation.world.scene()
    rngs = [np.random.default_rng(0)] * 2
    with pytest.raises(AspEnvError):
        simulation.reset([scenario(), scenario(9)], rngs)
    assert simulation.world.scene().states.tobytes() == before.states.tobytes()


def test_contact_with_a_standing_car_ahead_by_hand():
    """At 10 m/s the boxes of 4.5 m overlap once the centres are 4 m apart."""
    recording = make_recording(drives=(car(-90.0, 10.0), car(-52.0, 0.0)), duration_s=10.0)
    simulation = simulate(recording, scenario(length=20))
    contacts = []
    for _ in range(4):
        contacts.append(Contact(int(simulation.world.events().contacts[0, 1])))
        drive(simulation, [(0.0, 0.0)])
    # centres 8, 6, 4, 2 m apart
    assert contacts == [Contact.NONE, Contact.NONE, Contact.OTHER_STANDS, Contact.OTHER_STANDS]
    events = simulation.world.events()
    assert events.collision.tolist() == [True]
    assert events.at_fault.tolist() == [True]


def test_the_ego_is_not_at_fault_for_a_contact_at_its_rear():
    """A replayed follower at 10 m/s drives into the braking ego."""
    recording = make_recording(drives=(car(-80.0, 10.0), car(-90.0, 10.0)), duration_s=10.0)
    simulation = simulate(recording, scenario(length=20))
    drive(simulation, [(-5.0, 0.0)] * 8)  # 1.6 s: the gap of 5.5 m is lost after 1.48 s
    events = simulation.world.events()
    assert events.contacts[0].tolist() == [Contact.NONE, Contact.REAR]
    assert events.collision.tolist() == [True]
    assert events.at_fault.tolist() == [False]


def test_a_contact_keeps_the_class_of_its_first_tick():
    """A replayed car drives into the standing ego, which then moves off inside it.

    The later ticks on their own would be contacts of the ego's front. Once the ego is clear and
    stands again, the contact with the next car is a new one.
    """
    followers = (car(-95.0, 6.0), car(-120.0, 6.0))
    recording = make_recording(drives=(car(-84.0, 6.0), *followers), duration_s=14.0)
    simulation = simulate(recording, scenario(length=50))
    drive(simulation, [(-5.0, 0.0)] * 9)
    classes = []
    while not simulation.world.events().collision[0]:
        drive(simulation, [(0.0, 0.0)])
    while simulation.world.events().collision[0]:
        classes.append(int(simulation.world.events().contacts[0, 1]))
        assert not simulation.world.events().at_fault[0]
        drive(simulation, [(1.0, 0.0)])
    assert set(classes) == {Contact.EGO_STANDS}
    assert len(classes) > 5
    drive(simulation, [(-5.0, 0.0)] * 3)
    while not simulation.world.events().collision[0]:
        drive(simulation, [(0.0, 0.0)])
    assert simulation.world.events().contacts[0].tolist() == [0, 0, Contact.EGO_STANDS]


@pytest.mark.parametrize(
    ("kind", "gap_m", "own"),
    [
        (AgentClass.TRUCK, -0.5, True),
        (AgentClass.CAR, -0.5, True),
        (AgentClass.TRUCK, 0.5, False),
        (AgentClass.BICYCLE, -0.5, False),
    ],
)
def test_the_egos_trailer_is_no_contact(kind, gap_m, own):
    """A trailer of 7 m that overlaps the ego from the start never counts; a separate one does.

    The ego brakes to a stop, and the trailer, replayed at 5 m/s, drives through it within 4 s.
    """
    length_m = float(FOOTPRINTS_M[kind, 0])
    trailer_x_m = -60.0 - length_m / 2 - gap_m - 3.5
    drives = (
        car(-60.0, 5.0, kind=kind),
        car(trailer_x_m, 5.0, kind=AgentClass.TRAILER),
    )
    simulation = simulate(make_recording(drives=drives, duration_s=12.0), scenario(length=40))
    contacts = [bool(simulation.world.events().collision[0])]
    for _ in range(20):
        drive(simulation, [(-2.0, 0.0)])
        contacts.append(bool(simulation.world.events().collision[0]))
    assert simulation.world.episodes.own_trailer.tolist() == [[False, own]]
    assert any(contacts) is not own
    assert contacts[0] is (gap_m < 0 and not own)


def test_a_reset_discards_the_egos_trailer():
    """After a reset without a trailer the same slot can have contacts."""
    with_trailer = (car(-60.0, 5.0), car(-65.5, 5.0, kind=AgentClass.TRAILER))
    alone = (car(-90.0, 10.0), car(-52.0, 0.0))
    recordings = [make_recording(drives=each, duration_s=12.0) for each in (with_trailer, alone)]
    simulation = simulate(recordings, scenario(length=20))
    assert simulation.world.episodes.own_trailer.any()
    simulation.reset([scenario(length=20, recording=1)], [np.random.default_rng(0)])
    drive(simulation, [(0.0, 0.0)] * 4)
    assert simulation.world.events().contacts[0].tolist() == [0, Contact.OTHER_STANDS]


def test_off_road_by_hand():
    """Road edge at y = -3.5; a car of 1.8 m at y = -3.5 is 0.9 m outside, at -2.5 not at all.

    Where the recorded ego is outside, the map has a gap: that distance is subtracted within 2 m of
    its track.
    """
    cases = ((-2.5, -2.5, 0), (-2.5, -3.5, 0.9), (-3.5, -3.5, 0), (-3.5, -4.5, 1))
    for log_m, y_m, outside_m in cases:
        recording = make_recording(drives=(car(-90.0, 5.0, y_m=log_m),), duration_s=10.0)
        world = simulate(recording, scenario()).world
        world.episodes.states[0, world.history, EGO, 1] = y_m
        assert world.events().off_road_m[0] == pytest.approx(outside_m, abs=0.11)


def test_route_coordinates_by_hand():
    """5 m/s for 4 ticks of 0.2 s: 4 m along; the goal of 30 ticks lies at 30 m."""
    simulation = simulate(on_road(), scenario(length=30))
    events = simulation.world.events()
    assert events.route_m[0] == pytest.approx(0.0, abs=1e-3)
    assert events.goal_m[0] == pytest.approx(30.0, abs=1e-2)
    drive(simulation, [(0.0, 0.0)] * 4)
    events = simulation.world.events()
    assert events.route_m[0] == pytest.approx(4.0, abs=1e-2)
    assert events.route_offset_m[0] == pytest.approx(0.0, abs=1e-3)
    assert events.route_heading_rad[0] == pytest.approx(math.pi / 2, abs=1e-3)
    drive(simulation, [(0.0, 0.2)] * 5)
    assert simulation.world.events().route_offset_m[0] > 0.1


def test_the_route_continues_after_the_track():
    """Points 1 m apart: the rest of the track, and 60 m straight ahead."""
    scene = simulate(on_road(), scenario(length=30)).world.scene()
    route = scene.route[0, scene.route_valid[0]]
    assert np.hypot(*np.diff(route, axis=0).T) == pytest.approx(1.0, abs=1e-3)
    # 100 ticks in total, 85 after now, of 1 m each
    assert len(route) == 85 + 60 + 1


def test_a_loop_that_ends_at_its_start_is_not_cut_short():
    """Standing just before the start of a closed loop is progress of about 0, not of 94 m."""
    circle = Drive(
        kind=AgentClass.CAR, start=(40.0, 25.0, 0.0, 10.0), phases=((60.0, 0.0, 0.17989),)
    )
    recording = make_recording(drives=(circle,), duration_s=20.0)
    simulation = simulate(recording, scenario(length=46))
    episodes = simulation.world.episodes
    assert episodes.goal_m[0] == pytest.approx(92.0, abs=1.0)
    back = episodes.states[0, HISTORY, 0].copy()
    back[:2] -= 0.3 * np.array([np.cos(back[2]), np.sin(back[2])])
    back[3] = 0.0
    episodes.states[0, HISTORY, 0] = back
    for _ in range(3):
        drive(simulation, [(0.0, 0.0)])
        assert simulation.world.events().route_m[0] == pytest.approx(-0.3, abs=0.05)


@pytest.mark.data
def test_real_recordings_are_replayed_bit_for_bit():
    """Every scenario of the Karlsruhe recordings: states and validity are the recorded ones."""
    recordings = open_data(real_data("karlsruhe"))
    found = list(find_scenarios(recordings, source="", dt_s=DT_S, history=HISTORY))
    assert len(found) > 20
    simulation = simulate(list(recordings), found)
    replay(simulation, max(each.length for each in found))
    episodes = simulation.world.episodes
    assert np.array_equal(episodes.valid, episodes.log_valid)
    assert episodes.states.tobytes() == episodes.log_states.tobytes()
    events = simulation.world.events()
    assert events.route_m == pytest.approx(events.goal_m, abs=0.5)
