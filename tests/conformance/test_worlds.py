"""Laws of every world under every driver."""

import dataclasses

import numpy as np
import pytest

from asp_env import registry
from asp_env.sim.simulation import Simulation
from asp_env.sim.world import ReplayWorld, World
from tests.conformance.world_cases import WORLD_CASES, every_traffic, every_world
from tests.sim.worlds import DT_S, HISTORY


def _actions(number: int, steps: int = 26) -> np.ndarray:
    rng = np.random.default_rng(number)
    low, high = np.array([-2.0, -0.2]), np.array([2.0, 0.2])
    return rng.uniform(low, high, (steps, 2)).astype(np.float32)


def _step(simulation: Simulation, actions: np.ndarray) -> None:
    simulation.step(actions, np.ones(len(simulation.world), dtype=bool))


def _bits(simulation: Simulation, episode: int, agents: int) -> dict[str, bytes]:
    """The scene and the events of one episode as bytes, without padding."""
    scene, events = simulation.world.scene(), simulation.world.events()
    assert not scene.valid[episode, agents:].any()
    assert (scene.ids[episode, agents:] == -1).all()
    targets = scene.targets[scene.targets[:, 0] == episode, 1]
    route = scene.route[episode, scene.route_valid[episode]]
    bits = {"targets": targets.tobytes(), "route": route.tobytes()}
    for name in ("states", "actions", "valid", "sizes", "classes", "ids"):
        bits[name] = getattr(scene, name)[episode, :agents].tobytes()
    bits["tick"] = scene.tick[episode].tobytes()
    bits["map"] = scene.maps[int(scene.map_index[episode])].name.encode()
    bits["contacts"] = events.contacts[episode, :agents].tobytes()
    for field in dataclasses.fields(events):
        if field.name != "contacts":
            bits[field.name] = getattr(events, field.name)[episode].tobytes()
    return bits


def test_every_registered_world_and_the_replay_world_are_tested():
    assert {case.data for case in WORLD_CASES.values()} == {None, *registry.names("worlds")}
    for case in WORLD_CASES.values():
        expected = ReplayWorld if case.data is None else registry.find("worlds", case.data)
        assert case.world_class() is expected


@every_world
def test_is_a_world(case):
    world = case.world_class()(case.recordings(), num_episodes=1, dt_s=DT_S, history=HISTORY)
    assert world.traffic == case.traffics[0]
    assert isinstance(world, World)


@every_traffic
def test_episodes_side_by_side_equal_episodes_alone(case, traffic):
    """Bit for bit, in spite of padding and of episodes that are over."""
    scenarios = case.scenarios()
    together = case.simulate(scenarios, traffic)
    alone = [case.simulate(each, traffic) for each in scenarios]
    actions = np.stack([_actions(b) for b in range(len(scenarios))])
    for k in range(case.steps + 1):
        for b, single in enumerate(alone):
            agents = single.world.episodes.ids.shape[1]
            assert _bits(together, b, agents) == _bits(single, 0, agents), (k, b)
        if k < case.steps:
            _step(together, actions[:, k])
            for b, single in enumerate(alone):
                _step(single, actions[b : b + 1, k])
    over = together.world.events()
    assert (over.elapsed == over.length).sum() == 2


@every_world
def test_a_longer_history_adds_earlier_ticks_only(case):
    """The last 15 ticks equal those of a world that shows 15; some others precede the recording."""
    scenarios = case.scenarios()
    longer = min(each.start_tick for each in scenarios) + 5
    actions = np.stack([_actions(b) for b in range(len(scenarios))])
    scenes = []
    for history in (HISTORY, longer):
        simulation = case.simulate(scenarios, history=history)
        for k in range(4):
            _step(simulation, actions[:, k])
        scenes.append(simulation.world.scene())
    short, long = scenes
    np.testing.assert_array_equal(short.tick, long.tick)
    for b, slot in np.argwhere(short.ids >= 0):
        (at,) = np.flatnonzero(long.ids[b] == short.ids[b, slot])
        for name in ("states", "valid", "actions"):
            later = getattr(long, name)[b, at, longer - HISTORY :]
            np.testing.assert_array_equal(later, getattr(short, name)[b, slot], name)


@every_traffic
def test_a_reset_touches_only_the_chosen_rows(case, traffic):
    """Row 1 restarts with more agents and a longer scenario; rows 0 and 2 do not change."""
    scenarios = case.scenarios()
    first = [scenarios[2], scenarios[0], scenarios[1]]
    partly_reset, undisturbed = (case.simulate(first, traffic) for _ in range(2))
    sizes = [each.world.episodes.ids.shape[1] for each in map(case.simulate, first)]
    fresh = case.simulate(scenarios[3], traffic)
    agents = fresh.world.episodes.ids.shape[1]
    actions = np.stack([_actions(b) for b in range(3)])
    for k in range(12):
        if k == 5:
            reset_mask = np.array([False, True, False])
            rngs = [np.random.default_rng(9)] * 3
            partly_reset.reset([scenarios[0], scenarios[3], scenarios[0]], rngs, reset_mask)
            assert _bits(partly_reset, 1, agents) == _bits(fresh, 0, agents)
        for simulation in (partly_reset, undisturbed):
            _step(simulation, actions[:, k])
        if k >= 5:
            _step(fresh, actions[1:2, k])
            assert _bits(partly_reset, 1, agents) == _bits(fresh, 0, agents)
        for b in (0, 2):
            assert _bits(partly_reset, b, sizes[b]) == _bits(undisturbed, b, sizes[b])


@every_world
def test_restore_returns_to_a_snapshot(case):
    """States, scenarios and generators are those of the snapshot, bit for bit."""
    scenarios = case.scenarios()
    simulation = case.simulate(scenarios)
    actions = np.stack([_actions(b) for b in range(len(scenarios))])
    for k in range(4):
        _step(simulation, actions[:, k])
    world = simulation.world
    agents = world.episodes.ids.shape[1]
    snapshot = world.snapshot()
    drawn = [rng.random() for rng in world.rngs]
    runs = []
    for _ in range(2):
        for k in range(4, 12):
            _step(simulation, actions[:, k])
        runs.append([_bits(simulation, b, agents) for b in range(len(scenarios))])
        reset_mask = np.array([True, False, False, True])
        simulation.reset([scenarios[1]] * 4, [np.random.default_rng(5)] * 4, reset_mask)
        world.restore(snapshot)
        assert [rng.random() for rng in world.rngs] == drawn
    assert runs[0] == runs[1]
    assert world.scenarios == scenarios


@every_world
def test_a_snapshot_can_be_restored_twice(case):
    """Steps after a restore do not change the snapshot."""
    simulation = case.simulate(case.scenarios()[:2])
    world = simulation.world
    agents = world.episodes.ids.shape[1]
    before = _bits(simulation, 0, agents)
    snapshot = world.snapshot()
    for _ in range(2):
        _step(simulation, np.ones((2, 2), dtype=np.float32))
        world.restore(snapshot)
        assert _bits(simulation, 0, agents) == before


@every_traffic
def test_every_found_scenario_runs_to_its_end(case, traffic):
    """States stay finite; the egos are uncontrolled.

    They reach their goals where they replay, and where the world moves all other agents as well.
    """
    found = case.found()
    if traffic != case.traffics[0] and case.data is not None:
        found = found[::3]
    simulation = case.simulate(found, traffic)
    longest = max(each.length for each in found)
    uncontrolled = np.zeros(len(found), dtype=bool)
    for _ in range(longest):
        simulation.step(np.zeros((len(found), 2), dtype=np.float32), uncontrolled)
    events = simulation.world.events()
    assert events.elapsed.tolist() == [each.length for each in found]
    if case.data is None or traffic == case.traffics[0]:
        assert events.route_m == pytest.approx(events.goal_m, abs=0.05)
    assert np.isfinite(simulation.world.episodes.states).all()


@every_world
def test_every_episode_has_its_generator_and_the_world_draws_nothing(case):
    scenarios = case.scenarios()
    simulation = case.simulate(scenarios)
    states = [rng.bit_generator.state for rng in simulation.world.rngs]
    assert len({id(rng) for rng in simulation.world.rngs}) == len(scenarios)
    for _ in range(case.steps):
        _step(simulation, np.zeros((4, 2), dtype=np.float32))
    assert [rng.bit_generator.state for rng in simulation.world.rngs] == states
