"""Endings of episodes, and snapshots with the drivers' memory."""

import dataclasses

import numpy as np
import pytest

from asp_env.metrics.boxes import Contact
from asp_env.sim.simulation import ending
from asp_env.sim.world import Ending, Events
from tests.sim.worlds import HISTORY, TRAFFICS, car, on_road, replay, scenario, simulate

RUNNING = Events(
    contacts=np.zeros((1, 2), dtype=np.int8),
    off_road_m=np.zeros(1, dtype=np.float32),
    route_m=np.full(1, 10.0),
    route_offset_m=np.zeros(1),
    route_heading_rad=np.zeros(1),
    goal_m=np.full(1, 30.0),
    elapsed=np.full(1, 5),
    length=np.full(1, 20),
)
SIGNS = {
    Ending.COLLISION: {"contacts": np.array([[0, Contact.FRONT]], dtype=np.int8)},
    Ending.OFF_ROAD: {"off_road_m": np.full(1, 2.1, dtype=np.float32)},
    Ending.GOAL: {"route_m": np.full(1, 29.995)},
    Ending.OUT_OF_DATA: {"elapsed": np.full(1, 20)},
}


def test_an_episode_runs_while_no_ending_applies():
    """2 m off the road, a contact at the rear, one tick left and 2 cm to the goal end nothing."""
    almost = dataclasses.replace(
        RUNNING,
        contacts=np.array([[0, Contact.REAR]], dtype=np.int8),
        off_road_m=np.full(1, 2.0, dtype=np.float32),
        route_m=np.full(1, 29.98),
        elapsed=np.full(1, 19),
    )
    assert ending(RUNNING).tolist() == [Ending.RUNNING]
    assert ending(almost).tolist() == [Ending.RUNNING]


@pytest.mark.parametrize("kind", list(SIGNS), ids=lambda kind: kind.name)
def test_the_first_ending_in_order_applies(kind):
    """Of an ending and all after it in the enumeration, the first one is returned."""
    assert ending(dataclasses.replace(RUNNING, **SIGNS[kind])).tolist() == [kind]
    all_later = {}
    for later in reversed([each for each in SIGNS if each >= kind]):
        all_later |= SIGNS[later]
    assert ending(dataclasses.replace(RUNNING, **all_later)).tolist() == [kind]


@pytest.mark.parametrize("traffic", TRAFFICS)
def test_a_snapshot_restores_the_memory_of_drivers(traffic):
    """After a restore the same 10 steps yield the same bits."""
    recording = on_road(car(-60.0, 6.0), car(-40.0, 9.0, (3.0, -2.0, 0.0)), car(-90.0, 10.0))
    scenarios = [scenario(1), scenario(1, start=HISTORY + 6)]
    simulation = simulate(recording, scenarios, traffic=traffic)
    replay(simulation, 5)
    snapshot = simulation.snapshot()
    ends = []
    for _ in range(2):
        simulation.restore(snapshot)
        replay(simulation, 10)
        ends.append(simulation.world.episodes.states.copy())
        replay(simulation, 10)
        simulation.reset(scenarios[::-1], [np.random.default_rng(1)] * 2)
    np.testing.assert_array_equal(ends[0], ends[1])
