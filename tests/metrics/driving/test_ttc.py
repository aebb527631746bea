"""Time to collision, worked out by hand for each rule."""

import math
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.geometry import from_frame
from asp_env.metrics.boxes import Contact
from asp_env.metrics.driving.rules import NUPLAN, PDMS, STRICT
from asp_env.metrics.driving.ttc import TtcRule, time_to_collision

State = tuple[float, float, float, float]
CAR = (4.0, 2.0)
EGO: State = (0.0, 0.0, 0.0, 10.0)
DT_S = 0.2


def over_ticks(
    states: np.ndarray,
    rule: TtcRule,
    *,
    touching: np.ndarray | None = None,
    valid: np.ndarray | None = None,
    beside: bool = False,
    count: int | None = None,
) -> np.ndarray:
    """(t,) the times of one episode of cars, states (t, a, 4)."""
    ticks, agents = states.shape[:2]
    met = np.zeros((ticks, agents), dtype=bool) if touching is None else touching
    (found,) = time_to_collision(
        states[None],
        np.ones((1, ticks, agents), dtype=bool) if valid is None else valid[None],
        np.full((1, agents, 2), CAR),
        contacts=np.where(met, int(Contact.FRONT), 0).astype(np.int8)[None],
        ignored=np.zeros((1, agents), dtype=bool),
        beside=np.full((1, ticks), beside),
        count=np.array([ticks if count is None else count]),
        rule=rule,
        dt_s=DT_S,
    )
    return found


def seconds(
    *others: State,
    ego: State = EGO,
    touching: tuple[bool, ...] = (),
    rule: TtcRule = STRICT.ttc,
    beside: bool = False,
) -> float:
    """The time to collision of the ego with other cars at a single tick."""
    met = np.array([[False, *(touching or (False,) * len(others))]])
    return float(over_ticks(np.array([[ego, *others]]), rule, touching=met, beside=beside)[0])


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ((13.95, 0.0, 0.0, 0.0), 1.0),  # 9.95 m between bumpers at 10 m/s: 0.995 s
        ((13.95, 0.0, math.pi, 10.0), 0.5),  # the same, closing at 20 m/s: 0.4975 s
        ((13.95, 0.0, 0.0, 5.0), 2.0),  # closing at 5 m/s: 1.99 s
        ((13.95, 0.0, 0.0, 10.0), math.inf),  # equally fast
        ((33.95, 0.0, 0.0, 0.0), 3.0),  # 29.95 m: 2.995 s
        ((34.05, 0.0, 0.0, 0.0), math.inf),  # 30.05 m: beyond 3 s
        ((13.95, 2.05, 0.0, 0.0), math.inf),  # we pass it by 5 cm
        ((5.0, 4.95, -math.pi / 2, 5.0), 0.4),  # crosses: its nose 1.95 m from our way, 0.39 s
        ((-8.0, 0.0, 0.0, 30.0), math.inf),  # behind our rear bumper does not count
        ((-1.9, 5.95, -math.pi / 2, 10.0), math.inf),  # reaches us in 0.295 s, we are gone in 0.1 s
    ],
)
def test_straight_on(other: State, expected: float) -> None:
    """Rounded up to the next 0.1 s."""
    assert seconds(other) == pytest.approx(expected)


def test_from_the_side_of_a_slow_ego() -> None:
    """Its nose is 0.95 m above our side at 10 m/s: 0.095 s; with its centre behind us, never."""
    slow = (0.0, 0.0, 0.0, 1.0)
    assert seconds((-1.9, 3.95, -math.pi / 2, 10.0), ego=slow) == pytest.approx(0.1)
    assert seconds((-2.1, 3.95, -math.pi / 2, 10.0), ego=slow) == math.inf


def test_first_of_several() -> None:
    """The soonest counts, whatever the order."""
    near, far = (13.95, 0.0, 0.0, 0.0), (23.95, 0.0, 0.0, 0.0)
    assert seconds(near, far) == seconds(far, near) == pytest.approx(1.0)
    assert seconds(near, far, touching=(True, False)) == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("rule", "speed", "expected"),
    [
        (STRICT.ttc, 0.05, math.inf),
        (STRICT.ttc, 0.06, 0.9),
        (NUPLAN.ttc, 0.005, math.inf),
        (NUPLAN.ttc, 0.006, 0.9),
    ],
)
def test_standing_ego(rule: TtcRule, speed: float, expected: float) -> None:
    """A standing ego has no time to collision, even with one that comes at it.

    8.95 m at 10 m/s and a little take just under 0.895 s.
    """
    oncoming = (12.95, 0.0, math.pi, 10.0)
    assert seconds(oncoming, ego=(0.0, 0.0, 0.0, speed), rule=rule) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("angle_deg", "beside", "counts"),
    [
        (0, False, True),
        (29, False, True),
        (31, False, False),
        (31, True, True),
        (-29, False, True),
        (-31, False, False),
        (90, True, True),
        (149, True, True),
        (151, True, False),
        (-149, True, True),
        (180, True, False),
    ],
)
def test_sector(angle_deg: float, beside: bool, counts: bool) -> None:
    """NuPlan's 30° ahead, 150° where the ego is in several lanes or at a crossing.

    Angles are seen from the rear axle, 0.3 · 4 m behind the centre. A car 15 m off drives straight
    at where the ego, at 1 m/s, is in a second, at 15 m/s: so they meet in under 1.5 s.
    """
    angle = math.radians(angle_deg)
    x, y = 15 * math.cos(angle) - 1.2, 15 * math.sin(angle)
    towards = math.atan2(-y, 1.0 - x)
    found = seconds((x, y, towards, 15.0), ego=(0.0, 0.0, 0.0, 1.0), rule=NUPLAN.ttc, beside=beside)
    assert (found < 1.5) is counts


def test_who_has_touched_the_ego_never_counts_again() -> None:
    """In nuPlan; the strict rule forgets. At its second tick the other is 9.95 m ahead."""
    states = np.array([[EGO, (3.5, 0, 0, 0)], [EGO, (13.95, 0, 0, 0)], [EGO, (13.95, 0, 0, 0)]])
    touching = np.array([(False, True), (False, False), (False, False)])
    assert over_ticks(states, STRICT.ttc, touching=touching)[1:] == pytest.approx([1.0, 1.0])
    assert over_ticks(states, NUPLAN.ttc, touching=touching).tolist() == [math.inf] * 3
    before = touching[::-1]  # until it touches, it counts
    assert over_ticks(states[::-1], NUPLAN.ttc, touching=before)[:2] == pytest.approx([1.0, 1.0])


def braking(ticks: int = 8) -> np.ndarray:
    """The ego at 10 m/s, and one 11.05 m ahead that goes as fast and stands from 0.4 s on."""
    t = np.arange(ticks) * DT_S
    ego = np.stack([10 * t, 0 * t, 0 * t, 0 * t + 10], axis=-1)
    ahead = np.stack([11.05 + 10 * np.minimum(t, 0.4), 0 * t, 0 * t, np.where(t < 0.4, 10, 0)], -1)
    return np.stack([ego, ahead], axis=1)


def test_recorded_futures() -> None:
    """NAVSIM: 0.3, 0.6 and 0.9 s ahead along what the other does.

    Its tail stops at 13.05 m, where the ego's front, 2 m + 10 m/s · t, is at 1.105 s. That is
    0.905 s away at 0.2 s, too far; 0.705 at 0.4 s, so 0.9; 0.505 and 0.305 after that, so 0.6; and
    0.105 at 1 s, so 0.3.
    """
    found = over_ticks(braking(), PDMS.ttc)
    expected = [math.inf, math.inf, 0.9, 0.6, 0.6, 0.3]
    assert found[:6].tolist() == pytest.approx(expected, abs=1e-9)
    # at constant velocity the moving one is never met
    assert over_ticks(braking(), NUPLAN.ttc)[0] == math.inf


def test_recorded_futures_between_ticks() -> None:
    """Half-way between two ticks positions and headings are half-way, the short way round.

    The other swings from 175° to -175° within the tick from 0.2 to 0.4 s; at 0.3 s its heading is
    180°, and its nose, 4 m/2 from its centre at 7.05 m, is at 5.05 m, where our front has come to
    2 + 3 = 5 m. With a heading of 0° it would be the same; with 90° it would be 6.05 m. So their
    boxes overlap only if it sits 0.1 m nearer.
    """
    other = np.array(
        [(7.05, 0, math.radians(angle), 0.0) for angle in (175, 175, -175, -175, -175)]
    )
    ego = np.broadcast_to(np.array(EGO), other.shape)
    rule = replace(PDMS.ttc, horizon_s=0.3)
    assert over_ticks(np.stack([ego, other], axis=1), rule)[0] == math.inf
    other[:, 0] -= 0.1
    assert over_ticks(np.stack([ego, other], axis=1), rule)[0] == pytest.approx(0.3)


def test_what_is_not_known_meets_nobody() -> None:
    """Nobody is met at ticks at which it is not there, nor behind the end of the episode."""
    states = braking()
    gone = np.ones(states.shape[:2], dtype=bool)
    gone[3:, 1] = False
    assert over_ticks(states, PDMS.ttc, valid=gone).tolist() == [math.inf] * 8
    # from tick 3 it is met 0.6 s ahead, at tick 6, if that one still counts
    assert over_ticks(states, PDMS.ttc, count=7)[3] == pytest.approx(0.6)
    ended = over_ticks(states, PDMS.ttc, count=6)
    assert ended[3] == math.inf
    assert ended[6:].tolist() == [math.inf] * 2
    # straight on needs no future
    assert over_ticks(states, NUPLAN.ttc, count=6)[3] == pytest.approx(0.6)


@given(
    pose=st.tuples(st.floats(-500, 500), st.floats(-500, 500), st.floats(-3, 3)),
    seed=st.integers(0, 2**32 - 1),
    rule=st.sampled_from([STRICT.ttc, NUPLAN.ttc, PDMS.ttc]),
    beside=st.booleans(),
)
def test_laws(pose: tuple[float, float, float], seed: int, rule: TtcRule, beside: bool) -> None:
    """Neither the place, nor the others' order, nor padding, nor other episodes matter."""
    rng = np.random.default_rng(seed)
    low, high = np.array([-20, -20, -3, 0]), np.array([20, 20, 3, 12])
    states = np.cumsum(rng.normal(0, 0.3, (6, 4, 4)), axis=0) + rng.uniform(low, high, (4, 4))
    found = over_ticks(states, rule, beside=beside)
    order = [0, 3, 1, 2]
    assert over_ticks(states[:, order], rule, beside=beside).tolist() == found.tolist()
    moved = states.copy()
    moved[..., :2] = from_frame(states[..., :2], np.array(pose))
    moved[..., 2] += pose[2]
    # what just touches may do so here and not there, by rounding
    elsewhere = over_ticks(moved, rule, beside=beside)
    assert (elsewhere != found).sum() <= 1
    padded = np.concatenate([states, rng.uniform(low, high, (6, 2, 4))], axis=1)
    there = np.ones((6, 6), dtype=bool)
    there[:, 4:] = False
    assert over_ticks(padded, rule, valid=there, beside=beside).tolist() == found.tolist()
