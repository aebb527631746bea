"""Time to collision, derived by hand for each rule."""

import math
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.geometry import from_frame
from asp_env.metrics.boxes import Contact
from asp_env.metrics.driving.rules import NUPLAN, PDMS, STRICT
from asp_env.metrics.driving.ttc import TtcRule, agent_counts, time_to_collision

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
    wide_sector: bool = False,
    num_ticks: int | None = None,
    dt_s: float = DT_S,
) -> np.ndarray:
    """(t,) the times to collision in one episode of cars with states (t, a, 4)."""
    ticks, agents = states.shape[:2]
    contact = np.zeros((ticks, agents), dtype=bool) if touching is None else touching
    (found,) = time_to_collision(
        states[None],
        np.ones((1, ticks, agents), dtype=bool) if valid is None else valid[None],
        np.full((1, agents, 2), CAR),
        contacts=np.where(contact, int(Contact.FRONT), 0).astype(np.int8)[None],
        ignored=np.zeros((1, agents), dtype=bool),
        wide_sector=np.full((1, ticks), wide_sector),
        num_ticks=np.array([ticks if num_ticks is None else num_ticks]),
        rule=rule,
        dt_s=dt_s,
    )
    return found


def seconds(
    *others: State,
    ego: State = EGO,
    touching: tuple[bool, ...] = (),
    rule: TtcRule = STRICT.ttc,
    wide_sector: bool = False,
) -> float:
    """The time to collision of the ego with other cars at a single tick."""
    contact = np.array([[False, *(touching or (False,) * len(others))]])
    states = np.array([[ego, *others]])
    return float(over_ticks(states, rule, touching=contact, wide_sector=wide_sector)[0])


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ((13.95, 0.0, 0.0, 0.0), 1.0),  # 9.95 m between bumpers at 10 m/s: 0.995 s
        ((13.95, 0.0, math.pi, 10.0), 0.5),  # the same, closing at 20 m/s: 0.4975 s
        ((13.95, 0.0, 0.0, 5.0), 2.0),  # closing at 5 m/s: 1.99 s
        ((13.95, 0.0, 0.0, 10.0), math.inf),  # equally fast
        ((33.95, 0.0, 0.0, 0.0), 3.0),  # 29.95 m: 2.995 s
        ((34.05, 0.0, 0.0, 0.0), math.inf),  # 30.05 m: beyond 3 s
        ((13.95, 2.05, 0.0, 0.0), math.inf),  # the ego passes it at 5 cm
        ((5.0, 4.95, -math.pi / 2, 5.0), 0.4),  # crosses, 1.95 m from the ego's path: 0.39 s
        ((-8.0, 0.0, 0.0, 30.0), math.inf),  # agents behind the rear bumper do not count
        ((-1.9, 5.95, -math.pi / 2, 10.0), math.inf),  # arrives after the ego has passed
    ],
)
def test_constant_velocity(other: State, expected: float) -> None:
    """Times are rounded up to the next 0.1 s."""
    assert seconds(other) == pytest.approx(expected)


def test_from_the_side_of_a_slow_ego() -> None:
    """Its front is 0.95 m from the ego's side, 0.095 s; with its centre behind the ego, never."""
    slow = (0.0, 0.0, 0.0, 1.0)
    assert seconds((-1.9, 3.95, -math.pi / 2, 10.0), ego=slow) == pytest.approx(0.1)
    assert seconds((-2.1, 3.95, -math.pi / 2, 10.0), ego=slow) == math.inf


def test_the_shortest_time_of_several_agents() -> None:
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
    """A standing ego has no time to collision, even with an oncoming agent.

    8.95 m at slightly over 10 m/s take just under 0.895 s.
    """
    oncoming = (12.95, 0.0, math.pi, 10.0)
    assert seconds(oncoming, ego=(0.0, 0.0, 0.0, speed), rule=rule) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("angle_deg", "wide_sector", "counts"),
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
def test_sector(angle_deg: float, wide_sector: bool, counts: bool) -> None:
    """Within 30° ahead, or within 150° where the sector is wide (nuPlan).

    Angles are seen from the rear axle, 0.3 · 4 m behind the centre. A car 15 m away drives at
    15 m/s towards the position of the ego, at 1 m/s, in one second: they meet in under 1.5 s.
    """
    angle = math.radians(angle_deg)
    x, y = 15 * math.cos(angle) - 1.2, 15 * math.sin(angle)
    towards = math.atan2(-y, 1.0 - x)
    found = seconds(
        (x, y, towards, 15.0), ego=(0.0, 0.0, 0.0, 1.0), rule=NUPLAN.ttc, wide_sector=wide_sector
    )
    assert (found < 1.5) is counts


@pytest.mark.parametrize("heading", [0.0, 1.0, 2.5, -2.0])
@pytest.mark.parametrize(
    ("angle_deg", "narrow", "wide"),
    [(29, True, True), (-31, False, True), (149, False, True), (-151, False, False)],
)
def test_sectors_turn_with_the_vehicle(
    heading: float, angle_deg: float, narrow: bool, wide: bool
) -> None:
    """Seen from the rear axle, 1.2 m behind the centre at (7, -3), in any heading."""
    angle = heading + math.radians(angle_deg)
    x = 7 - 1.2 * math.cos(heading) + 2 * math.cos(angle)
    y = -3 - 1.2 * math.sin(heading) + 2 * math.sin(angle)
    assert agent_counts(7.0, -3.0, heading, 4.0, x, y, True, False) == narrow
    assert agent_counts(7.0, -3.0, heading, 4.0, x, y, True, True) == wide


@pytest.mark.parametrize("heading", [0.0, 1.0, 2.5, -2.0])
@pytest.mark.parametrize(("ahead_m", "counts"), [(-1.9, True), (-2.1, False)])
def test_without_a_sector_agents_count_from_the_rear_bumper_on(
    heading: float, ahead_m: float, counts: bool
) -> None:
    """The rear bumper is 2 m behind the centre; 5 m to the left changes nothing."""
    cos, sin = math.cos(heading), math.sin(heading)
    x, y = 7 + ahead_m * cos - 5 * sin, -3 + ahead_m * sin + 5 * cos
    assert agent_counts(7.0, -3.0, heading, 4.0, x, y, False, False) == counts


def test_agents_that_have_touched_the_ego_are_ignored() -> None:
    """By nuPlan for the rest of the episode, by the strict rules only during the contact."""
    states = np.array([[EGO, (3.5, 0, 0, 0)], [EGO, (13.95, 0, 0, 0)], [EGO, (13.95, 0, 0, 0)]])
    touching = np.array([(False, True), (False, False), (False, False)])
    assert over_ticks(states, STRICT.ttc, touching=touching)[1:] == pytest.approx([1.0, 1.0])
    assert over_ticks(states, NUPLAN.ttc, touching=touching).tolist() == [math.inf] * 3
    before = touching[::-1]  # the agent counts until the contact
    assert over_ticks(states[::-1], NUPLAN.ttc, touching=before)[:2] == pytest.approx([1.0, 1.0])


def braking(ticks: int = 8) -> np.ndarray:
    """The ego at 10 m/s and an agent 11.05 m ahead, as fast, that stands from 0.4 s on."""
    t = np.arange(ticks) * DT_S
    ego = np.stack([10 * t, 0 * t, 0 * t, 0 * t + 10], axis=-1)
    ahead = np.stack([11.05 + 10 * np.minimum(t, 0.4), 0 * t, 0 * t, np.where(t < 0.4, 10, 0)], -1)
    return np.stack([ego, ahead], axis=1)


def test_recorded_futures() -> None:
    """0.3, 0.6 and 0.9 s ahead along the recorded motion of the other agent (NAVSIM).

    Its rear stops at 13.05 m, which the ego's front, at 2 m + 10 m/s · t, reaches at 1.105 s. At
    0.2 s this is 0.905 s away, too far; at 0.4 s 0.705 s, so 0.9; then 0.505 and 0.305 s, so 0.6;
    and at 1 s 0.105 s, so 0.3.
    """
    found = over_ticks(braking(), PDMS.ttc)
    expected = [math.inf, math.inf, 0.9, 0.6, 0.6, 0.3]
    assert found[:6].tolist() == pytest.approx(expected, abs=1e-9)
    # at constant velocity there is no collision with the moving agent
    assert over_ticks(braking(), NUPLAN.ttc)[0] == math.inf


def test_recorded_futures_between_ticks() -> None:
    """Positions and headings are interpolated between ticks, headings along the shorter arc.

    The heading of the other agent changes from 175° to -175° between 0.2 and 0.4 s. At 0.3 s it is
    180°, and its front, 2 m from its centre at 7.05 m, is at 5.05 m, while the ego's front is at
    2 + 3 = 5 m. With a heading of 0° its rear would be there; with 90° its side would be at 6.05 m.
    The boxes therefore overlap only if it is 0.1 m nearer.
    """
    other = np.array(
        [(7.05, 0, math.radians(angle), 0.0) for angle in (175, 175, -175, -175, -175)]
    )
    ego = np.broadcast_to(np.array(EGO), other.shape)
    rule = replace(PDMS.ttc, horizon_s=0.3)
    assert over_ticks(np.stack([ego, other], axis=1), rule)[0] == math.inf
    other[:, 0] -= 0.1
    assert over_ticks(np.stack([ego, other], axis=1), rule)[0] == pytest.approx(0.3)


@pytest.mark.parametrize(("y_m", "expected"), [(3.9, 0.3), (4.1, math.inf)])
def test_recorded_futures_to_the_side(y_m: float, expected: float) -> None:
    """A car 3 m ahead moves sideways from y to 0 between 0.2 and 0.4 s, so it is at y / 2 at 0.3 s.

    The ego is 3 m ahead then, and the boxes overlap if their centres are less than 2 m apart.
    """
    other = np.array([(3.0, y, 0.0, 0.0) for y in (y_m, y_m, 0, 0, 0)])
    ego = np.broadcast_to(np.array(EGO), other.shape)
    for side in (1, -1):
        both = np.stack([ego, other * [1, side, 1, 1]], axis=1)
        found = over_ticks(both, replace(PDMS.ttc, horizon_s=0.3), wide_sector=True)
        assert found[0] == pytest.approx(expected)


@pytest.mark.parametrize(("y_m", "expected"), [(1.9, 0.3), (2.1, math.inf)])
def test_recorded_headings_that_do_not_change(y_m: float, expected: float) -> None:
    """At three quarters of a tick of 0.4 s a car beside the ego is not turned: 2 m are free."""
    other = np.array([(3.0, y_m, 0.0, 10.0)] * 3)
    ego = np.broadcast_to(np.array(EGO), other.shape)
    found = over_ticks(np.stack([ego, other], axis=1), replace(PDMS.ttc, horizon_s=0.3), dt_s=0.4)
    assert found[0] == pytest.approx(expected)


def test_absent_agents_and_ticks_after_the_end_are_ignored() -> None:
    states = braking()
    valid = np.ones(states.shape[:2], dtype=bool)
    valid[3:, 1] = False
    assert over_ticks(states, PDMS.ttc, valid=valid).tolist() == [math.inf] * 8
    # at tick 3 there is a collision 0.6 s ahead, at tick 6, if that tick belongs to the episode
    assert over_ticks(states, PDMS.ttc, num_ticks=7)[3] == pytest.approx(0.6)
    ended = over_ticks(states, PDMS.ttc, num_ticks=6)
    assert ended[3] == math.inf
    assert ended[6:].tolist() == [math.inf] * 2
    # constant velocity needs no future ticks
    assert over_ticks(states, NUPLAN.ttc, num_ticks=6)[3] == pytest.approx(0.6)


@given(
    pose=st.tuples(st.floats(-500, 500), st.floats(-500, 500), st.floats(-3, 3)),
    seed=st.integers(0, 2**32 - 1),
    rule=st.sampled_from([STRICT.ttc, NUPLAN.ttc, PDMS.ttc]),
    wide_sector=st.booleans(),
)
def test_ttc_does_not_depend_on_pose_order_and_padding(
    pose: tuple[float, float, float], seed: int, rule: TtcRule, wide_sector: bool
) -> None:
    rng = np.random.default_rng(seed)
    low, high = np.array([-20, -20, -3, 0]), np.array([20, 20, 3, 12])
    states = np.cumsum(rng.normal(0, 0.3, (6, 4, 4)), axis=0) + rng.uniform(low, high, (4, 4))
    found = over_ticks(states, rule, wide_sector=wide_sector)
    order = [0, 3, 1, 2]
    assert over_ticks(states[:, order], rule, wide_sector=wide_sector).tolist() == found.tolist()
    moved = states.copy()
    moved[..., :2] = from_frame(states[..., :2], np.array(pose))
    moved[..., 2] += pose[2]
    # rounding decides boxes that just touch
    elsewhere = over_ticks(moved, rule, wide_sector=wide_sector)
    assert (elsewhere != found).sum() <= 1
    padded = np.concatenate([states, rng.uniform(low, high, (6, 2, 4))], axis=1)
    present = np.ones((6, 6), dtype=bool)
    present[:, 4:] = False
    assert (
        over_ticks(padded, rule, valid=present, wide_sector=wide_sector).tolist() == found.tolist()
    )
