"""Post-encroachment time and ΔTTCP of constructed crossings, worked out by hand.

The ego drives along +x at 5 m/s and is 4.5 m by 1.8 m, as every other car. Its scenario lasts from
3 s, when it is at x = 15 m, to 18 s, at x = 90 m; its track ends at 20 s, at x = 100 m.
"""

import math

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.scenarios.scenario import ScenarioFilter
from tests.data.scenarios.test_scenario_tags import WAITS, car, first, through

EGO = car(0, 0, 0, 5)
UP = math.pi / 2


def conflict(*drives) -> tuple[float, float]:
    """(PET s, |ΔTTCP| s) of the first drive."""
    found = first(*drives)
    return float(found.column("pet_s")[0]), float(found.column("dttcp_s")[0])


@pytest.mark.parametrize(
    ("at_s", "pet_s", "dttcp_s"),
    [
        (7.4, 9.37 - 7.6, 2.6),  # in front of the ego
        (13.0, 12.8 - 10.63, 3.0),  # after it
        (9.8, 0.0, 0.2),  # both are there together
        (4.0, 9.37 - 4.2, math.inf),  # over 5 s apart
    ],
)
def test_crossing_at_a_right_angle(at_s: float, pet_s: float, dttcp_s: float) -> None:
    """At 9 m/s across x = 50 m, where the ego's box is at 9.37 to 10.63 s.

    The other's box is in the path for 0.35 s before and after the crossing, so at three ticks. Both
    speeds are constant, and so is ΔTTCP.
    """
    found = conflict(EGO, through(50, 0, at_s, UP, 9))
    assert found == pytest.approx((pet_s, dttcp_s), abs=1e-3)


@pytest.mark.parametrize(
    ("x", "pet_s"), [(103.1, 19.99 - 15.2), (103.3, math.inf), (17.9, 0.0), (17.0, math.inf)]
)
def test_the_ego_reaches_the_place(x: float, pet_s: float) -> None:
    """Its front is at x = 17.25 m at 3 s and at 102.25 m at 20 s; boxes are 0.9 m beside x."""
    at_s = 15.0 if x > 50 else 4.2
    found = conflict(EGO, through(x, 0, at_s, UP, 9))[0]
    assert found == pytest.approx(pet_s, abs=0.02)


@pytest.mark.parametrize(("at_s", "expected"), [(17.8, True), (18.4, False)])
def test_conflicts_begin_within_the_scenario(at_s: float, expected: bool) -> None:
    """The other's box is in the path from 17.6 s on or from 18.2 s on."""
    assert math.isfinite(conflict(EGO, through(95, 0, at_s, UP, 9))[0]) == expected


@pytest.mark.parametrize(
    "other",
    [
        car(-15, 0, 0, 5),  # follows
        car(12, 0, 0, 5),  # leads
        car(25, 3.5, 0, 5),  # in the next lane
        car(120, 3.5, math.pi, 6),  # comes towards the ego in the other lane
        car(50, 10, -UP, 5, ((1.0, 0, 0), (0.8, -6.25, 0))),  # stops 4 m beside the path
        car(50, 3.2, -UP, 0),  # is parked at the path
    ],
)
def test_no_conflict(other) -> None:
    assert conflict(EGO, other) == (math.inf, math.inf)


@pytest.mark.parametrize(
    ("heading_deg", "expected"), [(22, True), (18, False), (158, True), (162, False)]
)
def test_angle_of_crossings(heading_deg: float, expected: bool) -> None:
    """From 20° to 160°; the agent appears where its box is 0.4 m beside the strip."""
    turn = math.radians(heading_deg)
    beside_m = 0.9 + 0.5 * (4.5 * math.sin(turn) + 1.8 * abs(math.cos(turn))) + 0.4
    appears_s = round((9 - beside_m / (8 * math.sin(turn))) / 0.2) * 0.2
    x, y, *_ = through(50, 0, 9 - appears_s, turn, 8).start
    assert math.isfinite(conflict(EGO, car(x, y, turn, 8, appears_s=appears_s))[0]) == expected


@pytest.mark.parametrize(
    ("ahead", "y", "pet_s"), [(20, 5.0, 3.08), (15, 5.0, 2.08), (15, 4.5, math.inf)]
)
def test_merging_from_the_next_lane(ahead: float, y: float, pet_s: float) -> None:
    """At 0.1 rad to the route, as fast along it as the ego.

    At 3 s the box is 1.48 m or, from y = 4.5 m, 0.98 m beside the strip. It covers 2.33 m of the
    route on either side of its centre, the ego 2.25 m.
    """
    merges = car(ahead, y, -0.1, 5 / math.cos(0.1))
    assert conflict(EGO, merges)[0] == pytest.approx(pet_s, abs=0.01)


def test_yielding_is_a_conflict() -> None:
    """The ego stands until 12 s; the other's box leaves the path after 11.2 s, ego's enters it."""
    pet_s, dttcp_s = conflict(WAITS, through(0, 0, 11, UP, 8))
    # the ego's front at x = -9.75 m starts at 12 s with 2 m/s² and reaches x = -0.9 m 2.97 s later
    assert pet_s == pytest.approx(14.97 - 11.2, abs=0.06)
    # the ego stands during all of the 3 s before the other passes
    assert dttcp_s == math.inf


def test_noisy_speeds_at_single_ticks_do_not_count() -> None:
    """|ΔTTCP| must not be exceeded for 0.6 s, three ticks."""
    brakes = car(0, 0, 0, 5, ((6.0, 0, 0), (0.4, -9, 0), (0.4, 9, 0)))
    steady = conflict(EGO, through(50, 0, 6.8, UP, 9))[1]
    assert steady == pytest.approx(3.2, abs=1e-3)
    assert conflict(brakes, through(50, 0, 6.8, UP, 9))[1] >= steady


@pytest.mark.parametrize(
    ("at_s", "behind_s", "expected"),
    [(4.4, 9.37 - 4.6, True), (4.0, 9.37 - 4.2, False), (9.8, 0.0, True), (11.0, math.inf, False)],
)
def test_interactive(at_s: float, behind_s: float, expected: bool) -> None:
    """The ego follows within 5 s; an agent that is there 0.17 s after the ego does not count."""
    found = first(EGO, through(50, 0, at_s, UP, 9))
    assert found.column("pet_behind_s")[0] == pytest.approx(behind_s, abs=1e-3)
    assert found.has("interactive").tolist() == [expected]
    assert ScenarioFilter.parse("pet_behind<=5").matches(found).tolist() == [expected]


def test_pedestrians_count() -> None:
    walks = through(50, 0, 8.6, UP, 1.4, AgentClass.PEDESTRIAN)
    assert first(EGO, walks).has("interactive").all()


def test_scenarios_without_conflict_match_no_upper_bound() -> None:
    alone = first(EGO)
    assert not ScenarioFilter.parse("pet<1000|dttcp<1000").matches(alone).any()


def test_largest_density() -> None:
    """One car drives beside the ego, another one stays until 6.6 s."""
    found = first(EGO, car(0, 10, 0, 5), car(0, -10, 0, 5, leaves_s=6.6))
    assert found.column("max_density")[0] == 2
    assert found.column("density")[0] == pytest.approx(1 + 19 / 76)
    assert np.isinf(found.column("pet_s")).all()
