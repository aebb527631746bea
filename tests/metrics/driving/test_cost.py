"""Time lost, driving cost and the continuous measures of whole episodes, worked out by hand."""

import math
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.metrics.boxes import Contact
from asp_env.metrics.driving.cost import (
    DrivingCostWeights,
    driving_cost_s,
    log_route_m,
    severity,
    time_lost_s,
)
from asp_env.metrics.driving.rules import GRADED, PDMS
from tests.metrics.records import TICKS, at_tick, contact, record, values

DT_S = 0.2
STEADY_M = 2.0 * np.arange(11)
"""A logged ego at 10 m/s for 2 s."""
WAITS_M = np.array([0.0, 2, 4, 6, 6, 6, 6, 6, 8, 10, 12])
"""The same, but it waits from 0.6 to 1.4 s at 6 m."""


def lost(route: list[float], log: np.ndarray = STEADY_M) -> float:
    """The time lost in one episode."""
    ticks = np.array([len(route)])
    return float(
        time_lost_s(np.array([route]), ticks, log[None], np.array([len(log) - 1]), DT_S)[0]
    )


@pytest.mark.parametrize(
    ("route", "log", "expected"),
    [
        (STEADY_M.tolist(), STEADY_M, 0.0),
        (WAITS_M.tolist(), WAITS_M, 0.0),
        # the log is at 15 + 1 m after 1.6 s and the episode ends after 2 s
        ([*STEADY_M[:10].tolist(), 15.0], STEADY_M, 0.4),
        ([*STEADY_M[:10].tolist(), 19.1], STEADY_M, 0.0),  # within 1 m of the goal
        # at the goal after 1.6 s; the log is within 1 m of it after 1.9 s
        ([*STEADY_M[:8].tolist(), 20.0], STEADY_M, -0.3),
        ([*STEADY_M[:8].tolist(), 24.0], STEADY_M, -0.4),  # beyond it
        # ends after 0.6 s at 6 m, before the goal: the log is at 7 m after 0.7 s, and 1.3 s remain
        (STEADY_M[:4].tolist(), STEADY_M, 1.3),
        ([-3.0], STEADY_M, 2.0),  # has lost the whole scenario
        ([*WAITS_M[:10].tolist(), 5.5], WAITS_M, 0.55),  # has waited as well, but has not driven on
    ],
)
def test_time_lost(route: list[float], log: np.ndarray, expected: float) -> None:
    assert lost(route, log) == pytest.approx(expected)


def test_waiting_beside_the_waiting_log_loses_nothing() -> None:
    """The scenario ends while the log waits at 6 m; the ego stands 0.9 m before or behind it."""
    log = WAITS_M[:8]
    for place in (5.1, 6.0, 6.9):
        assert lost([*log[:7].tolist(), place], log) == pytest.approx(0.0)
    assert lost([*log[:7].tolist(), 4.0], log) == pytest.approx(1.4 - 0.5)  # 5 m after 0.5 s


def test_time_lost_is_missing_no_episode_and_ignores_what_follows() -> None:
    log = np.stack([STEADY_M, np.append(STEADY_M[:6], [1e3] * 5)])
    route = np.stack([STEADY_M, np.append(STEADY_M[:6], [-1e3] * 5)])
    steps = np.array([10, 5])
    assert time_lost_s(route, np.array([11, 6]), log, steps, DT_S).tolist() == [0.0, 0.0]
    assert time_lost_s(route, np.array([0, 0]), log, steps, DT_S).tolist() == [0.0, 0.0]


@given(
    speeds=st.lists(st.floats(0, 15), min_size=2, max_size=20),
    delay=st.integers(0, 10),
    back_m=st.floats(0, 5),
)
def test_being_further_back_never_loses_less(
    speeds: list[float], delay: int, back_m: float
) -> None:
    log = np.concatenate([[0.0], np.cumsum(np.array(speeds) * DT_S)])
    place = log[max(len(log) - 1 - delay, 0)]
    route = [0.0] * (len(log) - 1)
    assert lost([*route, place - back_m], log) >= lost([*route, place], log) - 1e-9
    assert lost([*route, place], log) <= delay * DT_S + 1e-9


def test_the_logged_ego_is_at_its_own_arc_length() -> None:
    """An L of 5 m and 5 m: the arc length goes on around the corner."""
    along, zero = np.arange(6.0), np.zeros(5)
    route = np.concatenate([np.stack([along, 0 * along], 1), np.stack([zero + 5, along[1:]], 1)])
    states = np.zeros((1, 11, 4))
    states[0, :, :2] = route
    valid = np.ones((1, 11), dtype=bool)
    found = log_route_m(route[None], valid, states)
    np.testing.assert_allclose(found, np.arange(11.0)[None])


def test_severity() -> None:
    assert severity(np.array([math.inf, 3.0, 1.5, 0.0])).tolist() == [0, 0, 0.25, 1]


def test_driving_cost_adds_seconds() -> None:
    """Two ticks at 1.5 s and one harsh tick of 0.2 s: 0.4·0.25·5 + 0.2, plus 3 s, plus a fault."""
    ttc_s = np.full((2, 10), 3.0)
    ttc_s[:, :2] = 1.5
    ttc_s[:, 9] = 0.0  # after the end
    harsh = np.zeros((2, 10), dtype=bool)
    harsh[:, [4, 9]] = True
    found = driving_cost_s(
        time_lost_s=np.array([-2.0, 3.0]),
        ttc_s=ttc_s,
        uncomfortable=harsh,
        fault=np.array([False, True]),
        active=np.tile(np.arange(10) < 9, (2, 1)),
        dt_s=0.2,
        weights=DrivingCostWeights(risk=5.0, discomfort=1.0, fault=60.0),
    )
    assert found.tolist() == pytest.approx([0.7, 63.7])


def test_a_perfect_episode_costs_nothing() -> None:
    found = values(record(log_route_m=[np.linspace(33, 40, TICKS)]))
    expected = {
        "no near miss": 1, "near misses": 0, "min TTC": 3, "required deceleration": 0,
        "safety margin": 1, "uncomfortable ticks": 0, "smoothness": 1, "time lost": 0,
        "driving cost": 0,
    }  # fmt: skip
    assert {name: found[name] for name in expected} == expected


def test_measures_over_the_ticks_of_an_episode() -> None:
    """One of eight ticks; values after the end are ignored."""
    changes: dict[str, Any] = {
        "near_miss": at_tick(3, 1).astype(bool),
        "bounded_ttc_s": at_tick(3, 1.2, 3.0),
        "required_mps2": at_tick(3, 4.5),
    }
    found = values(record(**changes))
    assert found["no near miss"] == 0
    assert found["near misses"] == 1 / 8
    assert found["min TTC"] == pytest.approx(1.2)
    assert found["required deceleration"] == 4.5
    assert found["safety margin"] == pytest.approx(1.2 / 1.9)
    before = values(record(**changes, active=3))
    assert (before["no near miss"], before["min TTC"], before["required deceleration"]) == (1, 3, 0)
    assert before["safety margin"] == 1
    assert math.isnan(before["smoothness"])  # the episode is shorter than the window
    assert math.isnan(before["uncomfortable ticks"])


@pytest.mark.parametrize(
    "fault", [{"contacts": contact(TICKS - 1, Contact.FRONT)}, {"off_road_m": at_tick(3, 1.0)}]
)
def test_a_fault_costs_30_s(fault: dict[str, Any]) -> None:
    at_log = [np.linspace(33, 40, TICKS)]
    assert values(record(**fault, log_route_m=at_log), PDMS)["driving cost"] == 30


@pytest.mark.parametrize(
    ("acceleration", "smoothness"),
    [(0.0, 1.0), (-2.0, 1.0), (-4.05, 0.5), (-5.0, 0.2654), (-6.1, 0.0), (1.8, 0.75), (2.4, 0.5)],
)
def test_smoothness(acceleration: float, smoothness: float) -> None:
    """1.5 less the share of the bound, -4.05 or 2.40 m/s², from 0 to 1."""
    states = record().states.copy()
    states[0, :, 3] = 15 + acceleration * 0.2 * np.arange(TICKS)
    assert values(record(states=states))["smoothness"] == pytest.approx(smoothness, abs=1e-4)


@pytest.mark.parametrize(("ttc_s", "margin"), [(3.0, 1), (1.9, 1), (0.95, 0.5), (0.1, 1 / 19)])
def test_safety_margin(ttc_s: float, margin: float) -> None:
    """Half at the bound of TTC."""
    assert values(record(bounded_ttc_s=at_tick(2, ttc_s, 3.0)))["safety margin"] == pytest.approx(
        margin
    )


def test_graded_rules_weigh_continuous_measures() -> None:
    """(5 · 0.8 + 5 margin + 2 smoothness) / 12, 0 with a fault."""
    states = record().states.copy()
    states[0, :, 3] = 15 - np.arange(TICKS)  # brakes at 5 m/s²
    braking = record(states=states, bounded_ttc_s=at_tick(3, 1.2, 3.0))
    found = values(braking, GRADED)
    assert found["comfort"] == 0
    assert found["smoothness"] == pytest.approx(1.5 - 5 / 4.05)
    assert found["score"] == pytest.approx((4 + 5 * 1.2 / 1.9 + 2 * (1.5 - 5 / 4.05)) / 12)
    assert values(record(ttc_s=0.1), GRADED)["score"] == pytest.approx(11 / 12)
    hit = record(contacts=contact(3, Contact.FRONT))
    assert values(hit, GRADED)["score"] == 0
