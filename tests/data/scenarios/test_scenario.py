"""How tracks are cut into scenarios: by hand, and laws."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays

from asp_env.data.classes import AgentClass
from asp_env.data.scenarios.scenario import ScenarioSet, find_scenarios
from tests.builders import Drive, make_recording

CAR = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 5.0))


def found(
    *drives: Drive, duration_s: float, dt_s: float = 0.2, allowed: np.ndarray | None = None
) -> ScenarioSet:
    """The scenarios, with 3 s of history, of a recording of 10 Hz."""
    recording = make_recording(drives=drives, duration_s=duration_s, frame_rate_hz=10.0)
    return find_scenarios(
        [recording],
        source="made up",
        dt_s=dt_s,
        history=round(3 / dt_s),
        allowed=None if allowed is None else [allowed],
    )


def windows(scenarios: ScenarioSet) -> list[tuple[int, int]]:
    """(start tick, length) of each scenario."""
    return [(each.start_tick, each.length) for each in scenarios]


@pytest.mark.parametrize(
    ("duration_s", "expected"),
    [
        (7.0, [(15, 20)]),
        (18.0, [(15, 75)]),
        (20.0, [(15, 75)]),  # the remaining 2 s are too short
        (22.0, [(15, 75), (90, 20)]),
        (40.0, [(15, 75), (90, 75), (165, 35)]),
    ],
)
def test_windows(duration_s: float, expected: list[tuple[int, int]]) -> None:
    """Windows of 20 to 75 ticks from tick 15 on."""
    assert windows(found(CAR, duration_s=duration_s)) == expected


def test_windows_of_a_recording_that_is_too_short_for_the_usual_ones() -> None:
    """Up to tick 34: 19 ticks after 3 s of history, but 31 after 0.6 s of it, with a warning."""
    with pytest.warns(UserWarning, match=r"no recording lasts 4 s .* 2 s or more after 0\.6 s"):
        assert windows(found(CAR, duration_s=6.8)) == [(3, 31)]


def test_window_of_a_vehicle_that_appears_late() -> None:
    """From frame 31 on, the first whole tick is 16, and 15 ticks of history end at 31."""
    late = Drive(kind=AgentClass.CAR, start=CAR.start, appears_s=3.1, leaves_s=12.3)
    assert windows(found(late, duration_s=20.0)) == [(31, 30)]  # frame 123 is tick 61.5


@pytest.mark.parametrize(("speed", "count"), [(0.65, 0), (0.68, 1)])
def test_shortest_distance(speed: float, count: int) -> None:
    """15 s at 0.65 m/s are 9.75 m, at 0.68 m/s 10.2 m; at least 10 m are needed."""
    slow = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, speed))
    assert len(found(slow, duration_s=20.0)) == count


@pytest.mark.parametrize(
    ("dt_s", "expected"), [(0.3, (10, 50)), (0.1, (30, 150)), (0.7, (4, 21)), (1.0, (3, 15))]
)
def test_other_time_steps(dt_s: float, expected: tuple[int, int]) -> None:
    """At most 15 s and at least 4 s, also if these are no whole ticks."""
    assert windows(found(CAR, duration_s=19.0, dt_s=dt_s)) == [expected]


@pytest.mark.parametrize(
    ("first", "last", "expected"),
    [
        (20, 80, [(35, 45)]),
        (20, 55, [(35, 20)]),
        (20, 54, []),
        (0, 100, [(15, 75)]),
    ],
)
def test_allowed(first: int, last: int, expected: list[tuple[int, int]]) -> None:
    """The history starts at the first allowed tick, and the scenario ends at the last."""
    allowed = np.zeros(101, dtype=bool)
    allowed[first : last + 1] = True
    assert windows(found(CAR, duration_s=20.0, allowed=allowed)) == expected


@given(allowed=arrays(np.bool_, 8).map(lambda marks: np.repeat(marks, 40)))
def test_scenarios_use_allowed_ticks_and_do_not_overlap(allowed: np.ndarray) -> None:
    scenarios = found(CAR, duration_s=63.8, allowed=allowed)
    ends = -1
    for start, length in windows(scenarios):
        assert allowed[start - 15 : start + length + 1].all()
        assert 20 <= length <= 75
        assert start >= ends
        ends = start + length
    assert bool(len(scenarios)) == bool(allowed.any())


def test_egos_are_predicted_and_not_parked() -> None:
    """Seeds are numbered, and names are readable."""
    scenarios = found(
        Drive(kind=AgentClass.BICYCLE, start=CAR.start),
        CAR,
        Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 0.0)),
        Drive(kind=AgentClass.TRUCK, start=CAR.start),
        duration_s=20.0,
    )
    assert [each.ego_id for each in scenarios] == [2, 4]
    assert [each.seed for each in scenarios] == [0, 1]
    assert [each.name for each in scenarios] == ["00-2-15", "00-4-15"]
    assert scenarios[1].source == "made up"


@pytest.mark.parametrize(
    ("steering", "tags"),
    [(0.06, ("left",)), (-0.06, ("right",)), (0.01, ("straight",)), (-0.01, ("straight",))],
)
def test_turns(steering: float, tags: tuple[str, ...]) -> None:
    """A car of 4.5 m turns by 75·sin β/1.35 in 75 m: 1.67 or 0.28 rad; the threshold is 0.52."""
    turning = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 3.0, 5.0), phases=((60, 0, steering),))
    (scenario,) = found(turning, duration_s=18.0)
    assert scenario.tags == tags


def test_standing_start() -> None:
    """A vehicle that stands at the first tick has the tag, by which it can be selected."""
    starts = Drive(
        kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 0.0), phases=((3.0, 0.0, 0.0), (2.0, 1.0, 0.0))
    )
    scenarios = found(CAR, starts, duration_s=18.0)
    assert [each.tags for each in scenarios] == [("straight",), ("straight", "standing-start")]
    assert [each.ego_id for each in scenarios.tagged("standing-start")] == [2]
    assert len(scenarios.tagged("straight")) == 2
    assert len(scenarios.tagged("left")) == 0


def test_names_are_valid_file_names() -> None:
    """Without a slash, even if the recording's name has one."""
    scenario = found(CAR, duration_s=7.0)[0]
    assert dataclasses.replace(scenario, recording_name="k1/000", ego_id=7).name == "k1_000-7-15"


def test_several_recordings() -> None:
    recordings = [make_recording(name=name, drives=(CAR,)) for name in ("00", "01")]
    scenarios = find_scenarios(recordings, source="made up", dt_s=0.2, history=15)
    assert [(each.recording, each.recording_name) for each in scenarios] == [(0, "00"), (1, "01")]
