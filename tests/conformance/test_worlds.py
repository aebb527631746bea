"""What holds of every world, whoever drives its traffic."""

import dataclasses

import numpy as np
import pytest

from asp_env import registry
from asp_env.sim.simulation import Simulation
from asp_env.sim.world import ReplayWorld, World
from tests.conformance.places import PLACES, every_traffic, everywhere
from tests.sim.worlds import DT_S, HISTORY


def _actions(number: int, steps: int = 26) -> np.ndarray:
    rng = np.random.default_rng(number)
    low, high = np.array([-2.0, -0.2]), np.array([2.0, 0.2])
    return rng.uniform(low, high, (steps, 2)).astype(np.float32)


def _step(simulation: Simulation, actions: np.ndarray, driven: np.ndarray | None = None) -> None:
    everybody = np.ones(len(simulation.world), dtype=bool)
    simulation.step(actions, everybody if driven is None else driven)


def _told(simulation: Simulation, episode: int, agents: int) -> dict[str, bytes]:
    """Everything that a world tells of one episode, without padding."""
    scene, events = simulation.world.scene(), simulation.world.events()
    assert not scene.valid[episode, agents:].any()
    assert (scene.ids[episode, agents:] == -1).all()
    mine = scene.targets[scene.targets[:, 0] == episode, 1]
    route = scene.route[episode, scene.route_valid[episode]]
    told = {"targets": mine.tobytes(), "route": route.tobytes()}
    for name in ("states", "actions", "valid", "sizes", "classes", "ids"):
        told[name] = getattr(scene, name)[episode, :agents].tobytes()
    told["tick"] = scene.tick[episode].tobytes()
    told["map"] = scene.maps[int(scene.map_index[episode])].name.encode()
    told["contacts"] = events.contacts[episode, :agents].tobytes()
    for field in dataclasses.fields(events):
        if field.name != "contacts":
            told[field.name] = getattr(events, field.name)[episode].tobytes()
    return told


def test_every_world_of_the_registry_is_here():
    """And the one that replays, which data have that no package registers a world for."""
    assert {place.data for place in PLACES.values()} == {None, *registry.names("worlds")}
    for place in PLACES.values():
        expected = ReplayWorld if place.data is None else registry.find("worlds", place.data)
        assert place.kind() is expected


@everywhere
def test_it_is_a_world(place):
    """The plug has all that the socket asks for; its first traffic is that of nobody else."""
    world = place.kind()(place.recordings(), num_episodes=1, dt_s=DT_S, history=HISTORY)
    assert world.traffic == place.traffics[0]
    assert isinstance(world, World)


@every_traffic
def test_episodes_side_by_side_equal_episodes_alone(place, traffic):
    """Four episodes at once are bit for bit the four on their own, over ends and padding."""
    scenarios = place.scenarios()
    together = place.simulate(scenarios, traffic)
    alone = [place.simulate(each, traffic) for each in scenarios]
    actions = np.stack([_actions(b) for b in range(len(scenarios))])
    for k in range(place.steps + 1):
        for b, single in enumerate(alone):
            agents = single.world.episodes.ids.shape[1]
            assert _told(together, b, agents) == _told(single, 0, agents), (k, b)
        if k < place.steps:
            _step(together, actions[:, k])
            for b, single in enumerate(alone):
                _step(single, actions[b : b + 1, k])
    over = together.world.events()
    assert (over.elapsed == over.length).sum() == 2


@every_traffic
def test_a_reset_touches_only_the_chosen_rows(place, traffic):
    """Row 1 begins anew with more agents and a longer scenario; rows 0 and 2 never notice."""
    scenarios = place.scenarios()
    first = [scenarios[2], scenarios[0], scenarios[1]]
    disturbed, left_alone = (place.simulate(first, traffic) for _ in range(2))
    sizes = [each.world.episodes.ids.shape[1] for each in map(place.simulate, first)]
    fresh = place.simulate(scenarios[3], traffic)
    agents = fresh.world.episodes.ids.shape[1]
    actions = np.stack([_actions(b) for b in range(3)])
    for k in range(12):
        if k == 5:
            where = np.array([False, True, False])
            rngs = [np.random.default_rng(9)] * 3
            disturbed.reset([scenarios[0], scenarios[3], scenarios[0]], rngs, where)
            assert _told(disturbed, 1, agents) == _told(fresh, 0, agents)
        for simulation in (disturbed, left_alone):
            _step(simulation, actions[:, k])
        if k >= 5:
            _step(fresh, actions[1:2, k])
            assert _told(disturbed, 1, agents) == _told(fresh, 0, agents)
        for b in (0, 2):
            assert _told(disturbed, b, sizes[b]) == _told(left_alone, b, sizes[b])


@everywhere
def test_a_snapshot_brings_everything_back(place):
    """States, scenarios and generators after restore are those of the snapshot, bit for bit."""
    scenarios = place.scenarios()
    simulation = place.simulate(scenarios)
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
        runs.append([_told(simulation, b, agents) for b in range(len(scenarios))])
        where = np.array([True, False, False, True])
        simulation.reset([scenarios[1]] * 4, [np.random.default_rng(5)] * 4, where)
        world.restore(snapshot)
        assert [rng.random() for rng in world.rngs] == drawn
    assert runs[0] == runs[1]
    assert world.scenarios == scenarios


@everywhere
def test_a_snapshot_can_be_restored_twice(place):
    """What happens after a restore does not write into the snapshot."""
    simulation = place.simulate(place.scenarios()[:2])
    world = simulation.world
    agents = world.episodes.ids.shape[1]
    told = _told(simulation, 0, agents)
    snapshot = world.snapshot()
    for _ in range(2):
        _step(simulation, np.ones((2, 2), dtype=np.float32))
        world.restore(snapshot)
        assert _told(simulation, 0, agents) == told


@every_traffic
def test_every_found_scenario_can_be_driven_to_its_end(place, traffic):
    """Whatever the table of scenarios offers starts, runs its length, and stays finite.

    Nobody drives the egos: where they are replayed or all is left to the world they end where
    their logs do.
    """
    found = place.found()
    if traffic != place.traffics[0] and place.data is not None:
        found = found[::3]
    simulation = place.simulate(found, traffic)
    longest = max(each.length for each in found)
    nobody = np.zeros(len(found), dtype=bool)
    for _ in range(longest):
        simulation.step(np.zeros((len(found), 2), dtype=np.float32), nobody)
    events = simulation.world.events()
    assert events.elapsed.tolist() == [each.length for each in found]
    if place.data is None or traffic == place.traffics[0]:
        assert events.route_m == pytest.approx(events.goal_m, abs=0.05)
    assert np.isfinite(simulation.world.episodes.states).all()


@everywhere
def test_a_generator_per_episode(place):
    """Each episode keeps the generator it was given; the world itself draws nothing."""
    scenarios = place.scenarios()
    simulation = place.simulate(scenarios)
    states = [rng.bit_generator.state for rng in simulation.world.rngs]
    assert len({id(rng) for rng in simulation.world.rngs}) == len(scenarios)
    for _ in range(place.steps):
        _step(simulation, np.zeros((4, 2), dtype=np.float32))
    assert [rng.bit_generator.state for rng in simulation.world.rngs] == states
