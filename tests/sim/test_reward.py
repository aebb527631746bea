"""The terms of the reward, by hand."""

import dataclasses

import numpy as np
import pytest

from asp_env.metrics.boxes import Contact
from asp_env.sim.reward import RewardWeights, reward_terms, weighted_sum
from asp_env.sim.world import Events
from tests.sim.test_simulation import RUNNING
from tests.sim.worlds import drive, on_road, replay, scenario, simulate

STRAIGHT = np.array([[0.0, 0.0, 0.0, 10.0]], dtype=np.float32)


def _terms(
    after: Events, *, before: Events = RUNNING, ended: np.ndarray = STRAIGHT
) -> dict[str, float]:
    terms = reward_terms(before, after, STRAIGHT, ended, 0.2)
    return {name: float(value[0]) for name, value in terms.items()}


def test_all_terms_are_zero_without_progress_or_events():
    """Constant speed straight ahead, on the road, without contact or progress."""
    names = ("progress", "comfort", "collision", "off_road", "goal", "standing", "route")
    assert _terms(RUNNING) == dict.fromkeys(names, 0.0)


def test_goal_standing_and_route_by_hand():
    """In 0.2 s; an offset of 1 m is a quarter of 2 m squared."""
    reached = dataclasses.replace(RUNNING, route_m=RUNNING.goal_m + 1.0)
    assert _terms(reached)["goal"] == 1.0
    assert _terms(reached, before=reached)["goal"] == 0.0
    beside = dataclasses.replace(RUNNING, route_offset_m=np.full(1, -1.0))
    assert _terms(beside)["route"] == pytest.approx(-0.05)
    far = dataclasses.replace(RUNNING, route_offset_m=np.full(1, 9.0))
    assert _terms(far)["route"] == pytest.approx(-0.2)
    against = dataclasses.replace(RUNNING, route_heading_rad=np.full(1, np.pi))
    assert _terms(against)["route"] == pytest.approx(-0.2)
    slow = np.array([[0.0, 0.0, 0.0, 0.4]], dtype=np.float32)
    assert _terms(RUNNING, ended=slow)["standing"] == pytest.approx(-0.2)


def test_progress_is_the_share_of_the_recorded_distance():
    """3 m of 30 m are 0.1; beyond the goal and before the start nothing is gained."""
    after = dataclasses.replace(RUNNING, route_m=np.full(1, 13.0))
    assert _terms(after)["progress"] == pytest.approx(0.1)
    beyond = dataclasses.replace(RUNNING, route_m=np.full(1, 50.0))
    assert _terms(beyond)["progress"] == pytest.approx(20 / 30)
    back = dataclasses.replace(RUNNING, route_m=np.full(1, -4.0))
    assert _terms(back)["progress"] == pytest.approx(-10 / 30)


def test_progress_sums_to_one_at_the_goal():
    """The replayed ego gains 1 in total; so does an ego that drives beyond the goal."""
    for step in (replay, lambda simulation, _: drive(simulation, [(1.5, 0.0)])):
        simulation = simulate(on_road(), scenario(length=30))
        world, total = simulation.world, 0.0
        for _ in range(30):
            before, states = world.events(), world.ego_states()
            step(simulation, 1)
            terms = reward_terms(before, world.events(), states, world.ego_states(), 0.2)
            total += float(terms["progress"][0])
        assert total == pytest.approx(1.0, abs=1e-5)


def test_comfort_by_hand():
    """2 m/s² ahead: -(4 + 0)/50. Turning by 0.1 rad in 0.2 s at 10 m/s: 5 m/s², so -25/50."""
    faster = np.array([[2.0, 0.0, 0.0, 10.4]], dtype=np.float32)
    assert _terms(RUNNING, ended=faster)["comfort"] == pytest.approx(-0.08, rel=1e-4)
    turned = np.array([[2.0, 0.0, 0.1, 10.0]], dtype=np.float32)
    assert _terms(RUNNING, ended=turned)["comfort"] == pytest.approx(-0.5, rel=1e-4)


def test_comfort_wraps_angles():
    """From heading π - 0.05 to -π + 0.05 is a turn of 0.1 rad, not of 6.2."""
    before, after = STRAIGHT.copy(), STRAIGHT.copy()
    before[0, 2], after[0, 2] = np.pi - 0.05, -np.pi + 0.05
    terms = reward_terms(RUNNING, RUNNING, before, after, 0.2)
    assert terms["comfort"][0] == pytest.approx(-0.5, rel=1e-3)


@pytest.mark.parametrize("kind", list(Contact), ids=lambda kind: kind.name)
def test_collision_costs_only_if_the_ego_is_at_fault(kind):
    """-1 for a standing agent, the ego's front and side; 0 for its rear and a standing ego."""
    after = dataclasses.replace(RUNNING, contacts=np.array([[0, kind]], dtype=np.int8))
    at_fault = kind in (Contact.OTHER_STANDS, Contact.FRONT, Contact.SIDE)
    assert _terms(after)["collision"] == (-1.0 if at_fault else 0.0)


def test_off_road_beyond_the_tolerance():
    """Up to 0.3 m outside costs nothing, more costs 1 per second: 0.2 in a tick of 0.2 s."""
    for outside_m, cost in ((0.0, 0.0), (0.3, 0.0), (0.31, -0.2), (4.0, -0.2)):
        after = dataclasses.replace(RUNNING, off_road_m=np.full(1, outside_m, dtype=np.float32))
        assert _terms(after)["off_road"] == cost


def test_the_sum_is_weighted():
    """0.5·0.2 + 0.1·(-0.3) + 2·(-1) + 3·(-1) = -4.93."""
    terms = {"progress": 0.2, "comfort": -0.3, "collision": -1.0, "off_road": -1.0}
    weights = RewardWeights(progress=0.5, comfort=0.1, collision=2.0, off_road=3.0)
    summed = weighted_sum({name: np.full(1, value) for name, value in terms.items()}, weights)
    assert summed == pytest.approx(-4.93)
