"""Near misses, foreseeable overlaps and required decelerations, derived by hand and by law."""

import math
from random import Random

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.geometry import from_frame
from asp_env.metrics.boxes import Contact
from asp_env.metrics.driving.margins import (
    MAX_BRAKING_MPS2,
    _curvature,
    bounded_ttc_s,
    near_misses,
    required_deceleration,
)

State = tuple[float, float, float, float]
CAR = (4.0, 2.0)
EGO: State = (0.0, 0.0, 0.0, 10.0)
DT_S = 0.2


def scene(*others: State, ego: State = EGO, ticks: int = 1) -> np.ndarray:
    """(1, ticks, agents, 4): cars at one tick, or standing still in these states at several."""
    return np.repeat(np.array([[[ego, *others]]]), ticks, axis=1)


def measures(
    states: np.ndarray,
    *,
    valid: np.ndarray | None = None,
    contacts: np.ndarray | None = None,
    ignored: bool = False,
    wide_sector: bool = False,
    num_ticks: int | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(t,) near misses, bounded times to collision and required decelerations of one episode."""
    _, ticks, agents, _ = states.shape
    present = np.ones((1, ticks, agents), dtype=bool) if valid is None else valid
    sizes = np.full((1, agents, 2), CAR)
    skip = np.full((1, agents), ignored)
    no_contact = np.zeros((1, ticks, agents), dtype=np.int8)
    options = {
        "contacts": no_contact if contacts is None else contacts,
        "ignored": skip,
        "wide_sector": np.full((1, ticks), wide_sector),
        "num_ticks": np.array([ticks if num_ticks is None else num_ticks]),
        "dt_s": DT_S,
    }
    return (
        near_misses(states, present, sizes, ignored=skip)[0],
        bounded_ttc_s(states, present, sizes, **options)[0],
        required_deceleration(states, present, sizes, **options)[0],
    )


def is_near(*others: State, ego: State = EGO) -> bool:
    """Whether a single tick is a near miss."""
    return bool(measures(scene(*others, ego=ego))[0][0])


def braking(*others: State, ego: State = EGO, wide_sector: bool = True) -> float:
    """The required deceleration at a single tick."""
    return float(measures(scene(*others, ego=ego), wide_sector=wide_sector)[2][0])


@pytest.mark.parametrize(
    ("other", "ego", "near"),
    [
        ((6.45, 0.0, 0.0, 0.0), EGO, True),  # 2.45 m ahead of a margin of 0.5 + 0.2 · 10 m
        ((6.55, 0.0, 0.0, 0.0), EGO, False),  # 2.55 m
        ((6.45, 0.0, 0.0, 9.4), EGO, True),  # the gap closes at 0.6 m/s
        ((6.45, 0.0, 0.0, 9.6), EGO, False),  # at 0.4 m/s
        ((6.45, 0.0, 0.0, 10.0), EGO, False),  # follows at the same speed
        ((4.6, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.6), True),  # 0.6 m; the margin is 0.62 m
        ((4.6, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.4), False),  # creeps in a queue
        ((0.0, 2.2, math.pi, 10.0), EGO, False),  # an oncoming car passes at 0.2 m
        ((0.0, 2.2, 0.0, 12.0), EGO, False),  # an adjacent car overtakes at 0.2 m
        ((0.0, 2.2, -0.1, 10.0), EGO, True),  # it approaches at 10 sin 0.1 = 1 m/s
        ((0.0, 2.2, 0.1, 10.0), EGO, False),  # it moves away
        ((0.0, 2.5, -0.1, 10.0), EGO, False),  # 1.5 - cos 0.1 - 2 sin 0.1 = 0.305 m
        ((-4.2, 0.0, 0.0, 20.0), EGO, False),  # tailgates
        ((3.9, 0.0, 0.0, 10.0), EGO, True),  # a contact
        ((4.1, 0.0, math.pi, 10.0), (0.0, 0.0, 0.0, 0.05), False),  # the ego stands
    ],
)
def test_near_misses(other: State, ego: State, near: bool) -> None:
    """Within 0.5 m + 0.2 s ahead or 0.3 m beside, and closing by over 0.5 m/s."""
    assert is_near(other, ego=ego) is near


def test_agents_that_are_absent_or_ignored_are_no_near_miss() -> None:
    states = scene((4.5, 0.0, 0.0, 0.0))
    assert measures(states)[0].all()
    assert not measures(states, ignored=True)[0].any()
    assert not measures(states, valid=np.array([[[True, False]]]))[0].any()


def test_bounded_ttc_is_clipped_and_0_in_a_contact() -> None:
    """9.95 m at 10 m/s are 1 s; without a overlap it is 3 s; in a contact at fault 0 s."""
    states = scene((13.95, 0.0, 0.0, 0.0), ticks=3)
    contacts = np.zeros((1, 3, 2), dtype=np.int8)
    contacts[0, 1, 1] = Contact.OTHER_STANDS
    _, times, decelerations = measures(states, contacts=contacts)
    assert times.tolist() == pytest.approx([1.0, 0.0, 3.0])  # after a contact it is ignored
    assert decelerations[0] < MAX_BRAKING_MPS2
    assert decelerations[1:].tolist() == [MAX_BRAKING_MPS2, 0.0]
    contacts[0, 1, 1] = Contact.REAR  # is not the ego's fault
    assert measures(states, contacts=contacts)[1].tolist() == pytest.approx([1.0, 3.0, 3.0])
    _, times, decelerations = measures(states, num_ticks=2)
    assert times.tolist() == pytest.approx([1.0, 1.0, 3.0])
    assert decelerations[2] == 0


@pytest.mark.parametrize(
    ("gap_m", "speed_mps", "other_mps", "expected"),
    [
        (10.0, 10.0, 0.0, 5.0),  # v² / (2 gap)
        (20.0, 10.0, 0.0, 2.5),
        (25.0, 10.0, 0.0, 2.0),
        (30.1, 10.0, 0.0, 0.0),  # no foreseeable overlap within 3 s
        (10.0, 10.0, 5.0, 1.25),  # (v - w)² / (2 gap)
        (8.0, 14.0, 6.0, 4.0),
        (6.0, 10.0, 0.0, 8.0),  # 8.33 m/s², more than the largest
        (10.0, 5.0, 6.0, 0.0),  # the other is faster
    ],
)
def test_required_deceleration_behind_a_car(
    gap_m: float, speed_mps: float, other_mps: float, expected: float
) -> None:
    """Within 0.03 m/s²: bisection to 0.008, and instants 0.1 s apart."""
    ego = (0.0, 0.0, 0.0, speed_mps)
    found = braking((4.0 + gap_m, 0.0, 0.0, other_mps), ego=ego)
    assert found == pytest.approx(expected, abs=0.03)


def test_required_deceleration_for_a_crossing_car() -> None:
    """It clears the ego's path, 2 m wide, after (2 + 1 + 5.95) m / 5 m/s = 1.79 s.

    The gap of 9.95 m must then be left: 10 · 1.79 - a 1.79² / 2 = 9.95 gives 4.96 m/s².
    """
    found = braking((12.95, 5.95, -math.pi / 2, 5.0))
    assert found == pytest.approx(4.96, abs=0.25)  # the instants before and after 1.79 s


def test_required_deceleration_has_the_sector_of_nuplan() -> None:
    """A car from the side, 48° off the heading seen from the rear axle, counts if it is wide."""
    crossing, slow = (6.0, 8.0, -math.pi / 2, 5.0), (0.0, 0.0, 0.0, 5.0)
    assert braking(crossing, ego=slow, wide_sector=True) > 0
    assert braking(crossing, ego=slow, wide_sector=False) == 0


def test_an_agent_that_hits_the_standing_ego_requires_nothing_more() -> None:
    """Head on, braking to a stop is all that the ego can do: v² / 2 a ≤ its share of the gap.

    Both close at 5 m/s over 12 m. The other needs 2.4 s; the ego stops within t = 5 / a after
    2.5 t and they must not have met by then: 2.5 t + 5 t = 12, t = 1.6 s, a = 3.125 m/s².
    """
    found = braking((16.0, 0.0, math.pi, 5.0), ego=(0.0, 0.0, 0.0, 5.0))
    assert found == pytest.approx(3.125, abs=0.25)


def test_the_ego_continues_along_its_curvature() -> None:
    """On a circle of 20 m the ego passes a car that stands straight ahead, 20 m away."""
    angle = np.arange(5) * 10 * DT_S / 20
    circle = np.stack([20 * np.sin(angle), 20 - 20 * np.cos(angle), angle, 10 + 0 * angle], axis=-1)
    straight = np.stack([10 * DT_S * np.arange(5), 0 * angle, 0 * angle, 10 + 0 * angle], axis=-1)
    other = np.tile([24.0, 0.0, 0.0, 0.0], (5, 1))
    on_circle = np.stack([circle, other], axis=1)[None]
    on_line = np.stack([straight, other], axis=1)[None]
    assert measures(on_circle)[2].max() == 0
    assert measures(on_line)[2][0] == pytest.approx(2.5, abs=0.03)
    assert measures(on_circle)[1][0] < 3  # the time to collision extrapolates straight on


def test_curvature_by_hand() -> None:
    """Turns of 0.09, 0.14, 0.24 and -0.4 rad over 1.8, 1.4, 1 and 0.6 m, which is clipped.

    At a mean speed of 0.5 m/s there is none. The headings pass π.
    """
    egos = np.zeros((1, 6, 4))
    egos[0, :, 2] = (3.1 + np.cumsum([0, 0.09, 0.14, 0.24, -0.4, 1]) + np.pi) % (2 * np.pi) - np.pi
    egos[0, :, 3] = [10, 8, 6, 4, 2, -1]
    np.testing.assert_allclose(_curvature(egos, DT_S), [[0.05, 0.05, 0.1, 0.24, -0.3, 0]])
    assert _curvature(egos[:, :1], DT_S).tolist() == [[0.0]]


@pytest.mark.parametrize("side", [1, -1])
def test_the_ego_brakes_for_a_car_on_its_circle(side: int) -> None:
    """A car stands 20 m further along a circle of 20 m, to the left or the right: 10² / (2 · 16).

    On the other side it is not in the way.
    """
    angle = np.arange(5) * 10 * DT_S / 20
    path = np.stack([20 * np.sin(angle), 20 - 20 * np.cos(angle), angle, 10 + 0 * angle], axis=-1)
    ahead = np.tile([20 * math.sin(1), 20 - 20 * math.cos(1), 1.0, 0.0], (5, 1))
    mirror = np.array([1, side, side, 1])
    inside = np.stack([path * mirror, ahead * mirror], axis=1)[None]
    outside = np.stack([path * mirror, ahead * mirror * [1, -1, -1, 1]], axis=1)[None]
    assert measures(inside, wide_sector=True)[2][0] == pytest.approx(100 / 32, abs=0.1)
    assert measures(outside, wide_sector=True)[2][0] == 0


states = st.tuples(
    st.floats(-20, 40), st.floats(-15, 15), st.floats(-math.pi, math.pi), st.floats(0, 12)
)
traffic = st.lists(states, min_size=1, max_size=5)


@given(others=traffic, turn=st.floats(-3, 3), shift=st.tuples(*[st.floats(-200, 200)] * 2))
def test_rigid_motion_changes_nothing(
    others: list[State], turn: float, shift: tuple[float, float]
) -> None:
    """The others are displaced by odd amounts, so that no boxes touch exactly."""
    here = scene(*others)
    here[:, :, 1:] += (0.0137, 0.0071, 0.0003, 0.0011)
    there = here.copy()
    there[..., :2] = from_frame(here[..., :2], np.array([*shift, turn]))
    there[..., 2] += turn
    near, times, decelerations = measures(here)
    near_there, times_there, decelerations_there = measures(there)
    assert near_there.tolist() == near.tolist()
    assert times_there.tolist() == times.tolist()
    np.testing.assert_allclose(decelerations_there, decelerations, atol=0.02)


@given(others=traffic, wide=st.booleans())
def test_another_agent_never_makes_it_safer(others: list[State], wide: bool) -> None:
    with_all = measures(scene(*others), wide_sector=wide)
    without_last = measures(scene(*others[:-1]), wide_sector=wide)
    assert with_all[0] >= without_last[0]
    assert with_all[1] <= without_last[1]
    assert with_all[2] >= without_last[2]


@given(others=traffic, order=st.randoms(use_true_random=False))
def test_the_order_of_agents_changes_nothing(others: list[State], order: Random) -> None:
    shuffled = list(others)
    order.shuffle(shuffled)
    for first, second in zip(measures(scene(*others)), measures(scene(*shuffled)), strict=True):
        np.testing.assert_array_equal(first, second)


@given(
    gap_m=st.floats(0.1, 40),
    more_m=st.floats(0, 20),
    speed_mps=st.floats(1, 15),
    other_mps=st.floats(0, 10),
)
def test_more_distance_to_the_car_ahead_is_never_less_safe(
    gap_m: float, more_m: float, speed_mps: float, other_mps: float
) -> None:
    ego = (0.0, 0.0, 0.0, speed_mps)
    near, times, decelerations = measures(scene((4 + gap_m, 0.0, 0.0, other_mps), ego=ego))
    further = measures(scene((4 + gap_m + more_m, 0.0, 0.0, other_mps), ego=ego))
    assert further[0] <= near
    assert further[1] >= times
    assert further[2] <= decelerations + 0.01


@given(gap_m=st.floats(1, 28), speed_mps=st.floats(2, 14))
def test_the_required_deceleration_suffices(gap_m: float, speed_mps: float) -> None:
    """v² / (2 gap) for a standing car within the bounds, and 0 beyond 3 s."""
    expected = speed_mps**2 / (2 * gap_m) if gap_m < 3 * speed_mps - 0.01 else 0.0
    found = braking((4 + gap_m, 0.0, 0.0, 0.0), ego=(0.0, 0.0, 0.0, speed_mps))
    if abs(gap_m - 3 * speed_mps) > 0.02:
        assert found == pytest.approx(min(expected, MAX_BRAKING_MPS2), abs=0.06)
