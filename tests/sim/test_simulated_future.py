"""The simulated future is what happens, and simulating it changes nothing."""

import numpy as np
import pytest

from asp_env.sim.simulated_future import simulated_future
from asp_env.sim.simulation import Simulation
from asp_env.sim.world import recorded_future
from tests.conformance.world_cases import WORLD_CASES, every_traffic
from tests.sim.worlds import car, on_road, scenario, simulate

STEPS = 6


def actions_of(simulation: Simulation, steps: int) -> np.ndarray:
    """Moderate random actions (B, steps, 2)."""
    rng = np.random.default_rng(3)
    low, high = np.array([-2.0, -0.2]), np.array([2.0, 0.2])
    return rng.uniform(low, high, (len(simulation.world), steps, 2)).astype(np.float32)


def everyone(simulation: Simulation) -> np.ndarray:
    """Mask of all episodes."""
    return np.ones(len(simulation.world), dtype=bool)


@every_traffic
def test_it_is_what_happens_if_the_egos_execute_the_actions(case, traffic):
    """Bit for bit, also where modes are drawn at random; simulating it changes none of the bits."""
    simulation = case.simulate(case.scenarios(), traffic)
    undisturbed = case.simulate(case.scenarios(), traffic)
    actions = actions_of(simulation, 2 + STEPS)
    for k in range(2):
        for each in (simulation, undisturbed):
            each.step(actions[:, k], everyone(each))
    scene = simulation.world.scene()
    future = simulated_future(simulation, scene, actions[:, 2:], everyone(simulation))
    b, a = scene.targets.T
    for k in range(STEPS):
        for each in (simulation, undisturbed):
            each.step(actions[:, 2 + k], everyone(each))
        world, other = simulation.world, undisturbed.world
        assert world.episodes.states.tobytes() == other.episodes.states.tobytes()
        assert world.episodes.valid.tobytes() == other.episodes.valid.tobytes()
        rows = (world.episodes.elapsed == 3 + k)[b]  # scenarios that are not over
        np.testing.assert_array_equal(
            future.states[rows, k], world.episodes.states[b, world.now[b], a][rows]
        )
        np.testing.assert_array_equal(
            future.valid[rows, k], world.episodes.valid[b, world.now[b], a][rows]
        )
    assert future.valid.any()
    generators = zip(simulation.world.rngs, undisturbed.world.rngs, strict=True)
    assert all(one.random() == other.random() for one, other in generators)


def test_replayed_traffic_has_its_recorded_future():
    """Whatever the egos do; also if some driver is a table, in which agents are replayed alike."""
    case = WORLD_CASES["replay"]
    for traffic in ("log", "default=log"):
        simulation = case.simulate(case.scenarios(), traffic)
        scene = simulation.world.scene()
        actions = actions_of(simulation, 30)
        future = simulated_future(simulation, scene, actions, everyone(simulation))
        recorded = recorded_future(simulation.world, scene, 30)
        np.testing.assert_array_equal(future.states, recorded.states)
        np.testing.assert_array_equal(future.valid, recorded.valid)


@pytest.mark.parametrize("traffic", ["idm", "hybrid"])
def test_it_continues_beyond_the_end_of_a_scenario(traffic):
    """Five ticks before the end of one it equals that of the same scenario of twice the length."""
    recording = on_road(car(-60, 8), car(-80, 10), car(-95, 3))
    ends, continues = (simulate(recording, scenario(length=n), traffic) for n in (20, 40))
    for _ in range(15):
        for each in (ends, continues):
            each.step(np.zeros((1, 2), dtype=np.float32), everyone(each))
    actions = actions_of(ends, 15)
    one, other = (
        simulated_future(each, each.world.scene(), actions, everyone(each))
        for each in (ends, continues)
    )
    np.testing.assert_array_equal(one.states, other.states)
    assert one.valid.all()
    assert ends.world.episodes.length.tolist() == [20]


def test_episodes_that_have_ended_have_no_future():
    """The others are not affected."""
    recording = on_road(car(-60, 8), car(-80, 10))
    simulation = simulate(recording, [scenario(), scenario()], "idm")
    scene, actions = simulation.world.scene(), actions_of(simulation, 5)
    both, first = (
        simulated_future(simulation, scene, actions, np.array(running))
        for running in ([True, True], [True, False])
    )
    rows = scene.targets[:, 0] == 0
    np.testing.assert_array_equal(first.states[rows], both.states[rows])
    assert first.valid[rows].all()
    assert not first.valid[~rows].any()
    assert not first.states[~rows].any()


def test_a_vehicle_behind_brakes_for_the_ego_only_in_the_simulated_future():
    """The ego brakes to a standstill on the road; the recording has the follower drive on."""
    recording = on_road(car(-30, 10), car(-50, 10))
    simulation = simulate(recording, scenario(2), "idm")
    scene = simulation.world.scene()
    braking = np.full((1, 15, 2), [-5.0, 0.0], dtype=np.float32)
    follower = int(np.flatnonzero(scene.ids[scene.targets[:, 0], scene.targets[:, 1]] == 3)[0])
    future = simulated_future(simulation, scene, braking, everyone(simulation))
    recorded = recorded_future(simulation.world, scene, 15)
    assert recorded.states[follower, -1, 3] == pytest.approx(10.0, abs=0.1)
    assert future.states[follower, -1, 3] < 6.0
