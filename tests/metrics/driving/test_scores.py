"""Scores of episodes composed by hand, by the definitions that rules share or differ in."""

import dataclasses
import math

import numpy as np
import pytest

from asp_env.errors import AspEnvError
from asp_env.geometry import from_frame
from asp_env.metrics.boxes import Contact
from asp_env.metrics.driving.rules import (
    GRADED,
    NUPLAN,
    PDMS,
    RULES,
    STRICT,
    WAYMAX,
    Rules,
    find_rules,
)
from asp_env.metrics.driving.scores import driving_metrics
from tests.metrics.records import TICKS, at_tick, contact, joined, record, values


@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
def test_good_episode(rules: Rules) -> None:
    """PDMS (5·0.8 + 5·1 + 2·1)/12 = 11/12; nuPlan (5·0.8 + 5 + 4 + 2)/16 = 15/16; Waymax none."""
    perfect = {
        *("no collision", "no at-fault collision", "no hit from behind", "on road", "direction"),
        *("on mapped road", "right way", "making progress", "TTC", "speed", "comfort", "feasible"),
        *("no near miss", "safety margin", "smoothness"),
    }
    absent = ("near misses", "required deceleration", "uncomfortable ticks")
    scores = {"nuplan": 15 / 16, "pdms": 11 / 12, "strict": 11 / 12, "graded": 11 / 12}
    expected = dict.fromkeys(perfect, 1.0) | {
        **({"score": scores[rules.name]} if rules.name in scores else {}),
        "progress": 0.8,
        "log divergence": 0,
        "route deviation": 0,
        **dict.fromkeys(absent, 0.0),
        "min TTC": 3.0,
        "time lost": 1.4,  # all seven ticks: the log starts 10 m ahead
        "driving cost": 1.4,
    }
    assert values(record(), rules) == pytest.approx(expected)
    assert set(rules.shown) <= set(expected)


def test_no_score_is_above_one() -> None:
    """A perfect episode that continues beyond the goal has the score 1, not 1.5 or 16/12."""
    beyond = record(route_m=at_tick(TICKS - 1, 80.0))
    for rules in (NUPLAN, PDMS, STRICT, GRADED):
        found = values(beyond, rules)
        assert found["score"] == pytest.approx(1.0)
        in_seconds = {"min TTC", "time lost"}
        assert all(0 <= value <= 1 for name, value in found.items() if name not in in_seconds)


@pytest.mark.parametrize(
    ("kind", "several", "off_m", "faultless", "strictly"),
    [
        (Contact.EGO_STANDS, True, 0.0, 1, 1),
        (Contact.OTHER_STANDS, False, 0.0, 0, 0),
        (Contact.FRONT, False, 0.0, 0, 0),
        (Contact.REAR, True, 0.0, 1, 1),  # a replayed agent that hit the ego
        (Contact.SIDE, False, 0.0, 1, 0),  # in one lane a side contact is no fault
        (Contact.SIDE, True, 0.0, 0, 0),
        (Contact.SIDE, False, 0.3, 1, 0),
        (Contact.SIDE, False, 0.31, 0, 0),
    ],
)
def test_collision(
    kind: Contact, several: bool, off_m: float, faultless: int, strictly: int
) -> None:
    """Every contact is a collision; at the side the fault depends on lanes and road (nuPlan)."""
    hit = record(contacts=contact(3, kind), several_lanes=several, off_road_m=at_tick(3, off_m))
    for rules, no_fault in ((NUPLAN, faultless), (PDMS, faultless), (STRICT, strictly)):
        found = values(hit, rules)
        assert (found["no collision"], found["no at-fault collision"]) == (0, no_fault)
        assert found["no hit from behind"] == (kind != Contact.REAR)
        if off_m <= 0.3:
            assert found["score"] == pytest.approx(
                no_fault * (15 / 16 if rules is NUPLAN else 11 / 12)
            )


def test_fault_is_decided_when_a_contact_begins() -> None:
    """A side contact that begins in one lane is no fault later in several; a second one is."""
    lasting = contact(3, Contact.SIDE) + contact(4, Contact.SIDE)
    several = at_tick(4, 1).astype(bool)
    assert values(record(contacts=lasting, several_lanes=several), NUPLAN)["score"] > 0
    again = contact(2, Contact.SIDE) + contact(4, Contact.SIDE)
    assert values(record(contacts=again, several_lanes=several), NUPLAN)["score"] == 0


@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
def test_off_road_by_rules(rules: Rules) -> None:
    """The tolerance is 0.3 m (nuPlan) or 0 (Waymax); only `on road` allows what the log does."""
    tolerance = 0.0 if rules is WAYMAX else 0.3
    for outside_m in (tolerance, tolerance + 0.01):
        found = values(record(off_road_m=at_tick(5, outside_m)), rules)
        assert found["on road"] == (outside_m <= tolerance)
        assert found["on mapped road"] == 1
        found = values(record(outside_m=at_tick(5, outside_m)), rules)
        assert found["on road"] == 1
        assert found["on mapped road"] == (outside_m <= tolerance)
        if rules.weights:  # only the strict rules score `on mapped road`
            assert (found["score"] > 0) == (outside_m <= tolerance or rules is not STRICT)


@pytest.mark.parametrize(("ttc_s", "fine"), [(0.951, 1), (0.95, 0), (0.9, 0)])
def test_ttc(ttc_s: float, fine: int) -> None:
    """Must be above 0.95 s (nuPlan); a shorter time costs 5 of 12 and 5 of 16."""
    short = record(ttc_s=at_tick(0, ttc_s, math.inf))
    assert values(short)["TTC"] == fine
    assert values(short)["score"] == pytest.approx((4 + 5 * fine + 2) / 12)
    assert values(short, NUPLAN)["score"] == pytest.approx((4 + 5 * fine + 4 + 2) / 16)


@pytest.mark.parametrize(
    ("against_m", "direction"),
    [
        ([0, 2.0, 0, 0, 0, 0, 0, 0], 1.0),
        ([0, 2.01, 0, 0, 0, 0, 0, 0], 0.5),
        ([0, 6.0, 0, 0, 0, 0, 0, 0], 0.5),
        ([0, 6.01, 0, 0, 0, 0, 0, 0], 0.0),
        ([0, 1.5, 0, 0, 0, 1.0, 0, 0], 0.5),  # both within five ticks, 1 s
        ([0, 1.5, 0, 0, 0, 0, 1.0, 0], 1.0),  # not within 1 s
        ([0, 1.25] + [1.25] * 6, 0.0),  # five times 1.25 m
    ],
)
def test_direction(against_m: list[float], direction: float) -> None:
    """1 up to 2 m against the traffic in 1 s, 0 above 6 m, else 0.5; it scales nuPlan's score."""
    found = values(record(against_m=[against_m]), NUPLAN)
    assert found["direction"] == direction
    assert found["score"] == pytest.approx(direction * 15 / 16)
    assert values(record(against_m=[against_m]), PDMS)["score"] == pytest.approx(11 / 12)


@pytest.mark.parametrize(
    ("limits_mps", "speed"),
    [
        ([5.0] * 8, 1.0),
        ([4.0] * 8, 1 - 1 / 2.23),  # 1 m/s over the limit at all ticks
        ([4.0] * 4 + [9.0] * 4, 1 - 0.5 / 2.23),
        ([1.0] * 8, 0.0),  # 4 m/s over the limit would be -0.79
        ([4.0] * 2 + [math.nan] * 6, 1 - 1 / 2.23),  # ticks without a limit do not count
        ([2.77] * 8, 0.0),  # 2.23 m/s over the limit
    ],
)
def test_speed(limits_mps: list[float], speed: float) -> None:
    """max(0, 1 - ∫ overspeed / (2.23 T)) at 5 m/s; its weight is 4 of nuPlan's 16."""
    found = values(record(limit_mps=[limits_mps]), NUPLAN)
    assert found["speed"] == pytest.approx(speed, abs=1e-12)
    assert found["score"] == pytest.approx((4 + 5 + 4 * speed + 2) / 16)


def test_overspeed_when_reversing() -> None:
    """A speed of -5 m/s is 1 m/s over a limit of 4."""
    states = record().states.copy()
    states[0, :, 3] = -5.0
    assert values(record(states=states, limit_mps=4.0))["speed"] == pytest.approx(1 - 1 / 2.23)


def test_direction_and_speed_are_missing_without_lanes_and_limits() -> None:
    """(5·0.8 + 5 + 2)/12 remains of nuPlan's score."""
    found = values(record(against_m=None, limit_mps=None), NUPLAN)
    assert math.isnan(found["direction"])
    assert math.isnan(found["speed"])
    assert found["score"] == pytest.approx(11 / 12)


@pytest.mark.parametrize(
    ("reached_m", "goal_m", "progress", "making_progress"),
    [
        (10.0, 50.0, 0.2, True),
        (9.9, 50.0, 0.198, False),
        (60.0, 50.0, 1.0, True),
        (-0.1, 50.0, 0.0, False),
        (0.5, 50.0, 0.04, False),  # progress is at least 2 m: 2/50
        (0.0, 1.0, 1.0, True),  # 2/2
        (3.0, 8.0, 0.375, True),
    ],
)
def test_progress_by_nuplan(
    reached_m: float, goal_m: float, progress: float, making_progress: bool
) -> None:
    """max(ego, 2 m)/max(log, 2 m), 0 for reversing; the score is 0 under 0.2."""
    found = values(record(route_m=at_tick(TICKS - 1, reached_m), goal_m=[goal_m]), NUPLAN)
    assert found["progress"] == pytest.approx(progress)
    assert found["making progress"] == making_progress
    assert found["score"] == pytest.approx(making_progress * (5 * progress + 11) / 16)


@pytest.mark.parametrize(("away_m", "right"), [(3.5, 1), (3.51, 0)])
def test_right_way(away_m: float, right: int) -> None:
    """Over 3.5 m from every reachable lane is the wrong way (Waymax)."""
    assert (
        values(record(distance_to_route_lanes_m=at_tick(2, away_m)), WAYMAX)["right way"] == right
    )


@pytest.mark.parametrize(
    ("change", "feasible"),
    [
        ((3, 2.0), 1),  # 10 m/s²
        ((3, 2.09), 0),  # 10.45 m/s²
        ((2, 0.29), 1),  # a turn of 0.29 rad over 1 m
        ((2, 0.31), 0),
    ],
)
def test_feasible(change: tuple[int, float], feasible: int) -> None:
    """At most 10.4 m/s² and 0.3 1/m (Waymax); at 5 m/s the distance per tick is 1 m."""
    states = record().states.copy()
    field, amount = change
    states[0, 4:, field] += amount
    assert values(record(states=states), WAYMAX)["feasible"] == feasible
    # the change is after the end
    assert values(record(states=states, active=4), WAYMAX)["feasible"] == 1
    assert math.isnan(values(record(states=states, active=1), WAYMAX)["feasible"])


def test_comfort() -> None:
    """Braking from 15 m/s at 5 m/s² costs 2 of 12."""
    states = record().states.copy()
    states[0, :, 3] = 15 - np.arange(TICKS)
    found = values(record(states=states))
    assert found["comfort"] == 0
    assert found["score"] == pytest.approx(9 / 12)


def test_short_episode() -> None:
    """Under five ticks comfort is missing and the weights add up to 10: 36 of 50 m give 8.6/10.

    Values after the last tick are ignored.
    """
    found = values(
        record(
            active=4,
            contacts=contact(4, Contact.FRONT),
            off_road_m=at_tick(5, 9.0),
            ttc_s=at_tick(6, 0.0, math.inf),
        )
    )
    assert math.isnan(found["comfort"])
    assert found["progress"] == pytest.approx(0.72)
    for name in ("no collision", "no at-fault collision", "on road", "TTC"):
        assert found[name] == 1
    assert found["score"] == pytest.approx((5 * 0.72 + 5) / 10)


def test_comfort_needs_five_ticks() -> None:
    assert values(record(active=5))["comfort"] == 1


def test_short_episode_at_other_tick_length() -> None:
    """Eight ticks of 0.1 s are shorter than the window of eleven: (5·0.8 + 5)/10."""
    found = values(record(dt_s=0.1))
    assert math.isnan(found["comfort"])
    assert found["score"] == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("reached_m", "goal_m", "progress"),
    [(25.0, 50.0, 0.5), (60.0, 50.0, 1.0), (-3.0, 50.0, 0.0), (0.25, 0.0, 0.25), (0.0, 0.5, 0.0)],
)
def test_progress(reached_m: float, goal_m: float, progress: float) -> None:
    """A share from 0 to 1; goals nearer than 1 m count as 1 m."""
    found = values(record(route_m=at_tick(TICKS - 1, reached_m), goal_m=[goal_m]))
    assert found["progress"] == pytest.approx(progress)


def test_log_divergence() -> None:
    """Off by (3, 4) at two of four ticks is 5·2/4 = 2.5 m; later ticks are ignored."""
    log_states = record().states.copy()
    log_states[0, 2:, :2] += (3.0, 4.0)
    log_states[0, 4:] = math.nan
    assert values(record(log_states=log_states, active=4))["log divergence"] == pytest.approx(2.5)
    away = record().states + np.array([3.0, 4.0, 0.0, 0.0])
    assert values(record(log_states=away, active=1))["log divergence"] == pytest.approx(5)


def test_route_deviation() -> None:
    """2 m to either side at two of eight ticks is 0.5 m."""
    offset = at_tick(1, 2.0) + at_tick(5, -2.0)
    assert values(record(route_offset_m=offset))["route deviation"] == pytest.approx(0.5)


def test_without_a_tick_all_metrics_are_missing() -> None:
    assert all(math.isnan(value) for value in values(record(active=0)).values())


@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
def test_scores_do_not_depend_on_order_padding_and_pose(rules: Rules) -> None:
    episodes = [
        record(),
        record(contacts=contact(2, Contact.SIDE), several_lanes=True),
        record(active=3, ttc_s=0.5, limit_mps=4.0),
        record(off_road_m=0.4, against_m=1.0, route_offset_m=1.0),
    ]
    order = [2, 0, 3, 1]
    metrics, shuffled = (
        driving_metrics(joined(episodes), rules),
        joined([episodes[number] for number in order]),
    )

    def moved(states: np.ndarray) -> np.ndarray:
        xy = from_frame(states[..., :2], np.array([100.0, -50.0, 2.5]))
        return np.concatenate([xy, states[..., 2:3] + 2.5, states[..., 3:]], axis=-1)

    padding = np.zeros((4, TICKS, 5), dtype=np.int8)
    elsewhere = dataclasses.replace(
        shuffled,
        contacts=np.concatenate([shuffled.contacts[:, :, ::-1], padding], axis=2),
        states=moved(shuffled.states),
        log_states=moved(shuffled.log_states),
    )
    for name, metric in driving_metrics(elsewhere, rules).items():
        np.testing.assert_allclose(metric.value, metrics[name].value[order], atol=1e-9)
        np.testing.assert_array_equal(metric.valid, metrics[name].valid[order])


@pytest.mark.parametrize("rules", [NUPLAN, GRADED], ids=["nuplan", "graded"])
def test_metrics_of_a_batch_are_those_of_each_episode(rules: Rules) -> None:
    """Faults, delays, short episodes and missing limits of one leave the others as they are."""
    braking = record().states.copy()
    braking[0, :, 3] = 15 - np.arange(TICKS)
    episodes = [
        record(),
        record(contacts=contact(2, Contact.FRONT), near_miss=at_tick(2, 1).astype(bool)),
        record(active=3, off_road_m=0.4, bounded_ttc_s=at_tick(1, 1.2, 3.0)),
        record(states=braking, required_mps2=at_tick(4, 2.5), against_m=at_tick(3, 2.5)),
        record(limit_mps=4.0, distance_to_route_lanes_m=4.0, ttc_s=0.5, route_m=34.0),
        record(active=0),
    ]
    batch = driving_metrics(joined(episodes), rules)
    for number, episode in enumerate(episodes):
        for name, metric in driving_metrics(episode, rules).items():
            assert batch[name].valid[number] == metric.valid[0], name
            if metric.valid[0]:
                assert batch[name].value[number] == pytest.approx(metric.value[0], abs=1e-12), name


def test_rules_have_labels_and_name_metrics_that_exist() -> None:
    known = set(driving_metrics(record(), NUPLAN))
    assert [rules.label for rules in RULES.values()] == [
        *("nuplan 1", "pdms 1", "waymax 1", "strict 1", "graded 1")
    ]
    for rules in RULES.values():
        assert {*rules.multipliers, *rules.weights, *rules.shown} <= known
    assert find_rules("waymax") is WAYMAX
    with pytest.raises(AspEnvError, match=r"unknown rules 'nuplna' \(did you mean 'nuplan'"):
        find_rules("nuplna")
