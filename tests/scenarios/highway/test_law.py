"""The results of the world equal those of highway-env."""

import numpy as np
import pytest
from highway_env.envs import IntersectionEnv, RoundaboutEnv
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle

from asp_env.data.scenarios.scenario import Scenario, find_scenarios
from asp_env.geometry import wrap_angle
from asp_env.sim.world import world_class
from scenarios.highway.rounds import step_road
from scenarios.highway.sites import (
    SITES,
    STEPS_PER_S,
    network,
    populated_road,
    remove_exited,
    spawn_vehicle,
)
from tests.highway_folders import SITE_NAMES, highway_recordings, highway_scenarios
from tests.sim.worlds import DT_S, HISTORY

every_site = pytest.mark.parametrize("site", SITE_NAMES)


def warm_starts_from_3s(site: str, scenarios: list[Scenario], dt_s: float, history: int) -> int:
    """Leaves episodes to themselves and compares them with the log; how many states of it."""
    recordings, kind = highway_recordings(site), world_class("highway:")
    count = len(scenarios)
    world = kind(recordings, num_episodes=count, dt_s=dt_s, history=history)
    world.reset(scenarios, [np.random.default_rng(0)] * count)
    actions = np.zeros((*world.episodes.ids.shape, 2), dtype=np.float32)
    uncontrolled = np.zeros(world.episodes.ids.shape, dtype=bool)
    for _ in range(max(each.length for each in scenarios)):
        world.step(actions, uncontrolled)
    data, compared = world.episodes, 0
    for b, scenario in enumerate(scenarios):
        ticks = history + 1 + scenario.length
        there = data.log_valid[b, :ticks]
        assert np.array_equal(data.valid[b, :ticks], there)
        away = (data.states[b, :ticks] - data.log_states[b, :ticks])[there]
        away[:, 2] = wrap_angle(away[:, 2])
        assert np.abs(away).max() < 1e-4
        compared += len(away)
    return compared


@every_site
def test_without_control_episodes_continue_as_recorded(site):
    """Without control, presence equals the log's, and states agree within its rounding."""
    scenarios = list(highway_scenarios(site))[1 :: 8 if site == "intersection" else 2]
    assert warm_starts_from_3s(site, scenarios, DT_S, HISTORY) > 2000


@every_site
def test_a_tick_may_be_longer(site):
    """The same holds at 0.4 s, where vehicles appear and leave within a tick."""
    found = find_scenarios(highway_recordings(site), source=site, dt_s=0.4, history=5)
    assert warm_starts_from_3s(site, list(found)[::15], 0.4, 5) > 200


class _AsTraffic:
    """highway-env's ego as one of its uncontrolled vehicles."""

    vehicle_class = IDMVehicle


def _reference(site: str, seed: int, seconds: int) -> list[list[tuple]]:
    """Each step of an episode of highway-env's own environment without control."""
    kinds = {"intersection": IntersectionEnv, "roundabout": RoundaboutEnv}
    env = kinds[site](config={"destination": None} if site == "intersection" else {})
    env.np_random, env.action_type = np.random.default_rng(seed), _AsTraffic()
    env._reset()
    env.controlled_vehicles, observed = [], []
    for _ in range(seconds):
        for _ in range(STEPS_PER_S):
            env.road.act()
            env.road.step(1 / STEPS_PER_S)
            observed.append(_observed(env.road))
        if site == "intersection":
            env._clear_vehicles()
            env._spawn_vehicle(spawn_probability=env.config["spawn_probability"])
        else:  # where no vehicle is removed
            env.road.vehicles = [each for each in env.road.vehicles if not _at_the_end(each)]
        observed.append(_observed(env.road))
    return observed


def _at_the_end(vehicle: IDMVehicle) -> bool:
    along, _ = vehicle.lane.local_coordinates(vehicle.position)
    return vehicle.lane_index[1].endswith("xr") and along >= vehicle.lane.length - 20.0


def _own(site: str, seed: int, seconds: int) -> list[list[tuple]]:
    rng, observed = np.random.default_rng(seed), []
    road = populated_road(SITES[site], rng)
    for _ in range(seconds):
        for _ in range(STEPS_PER_S):
            step_road(road)
            observed.append(_observed(road))
        remove_exited(SITES[site], road)
        spawn_vehicle(SITES[site], road, rng)
        observed.append(_observed(road))
    return observed


def _observed(road) -> list[tuple]:
    """The states and intentions of all vehicles, exactly."""
    return [
        (
            *each.position.tolist(), float(each.heading), float(each.speed),
            float(each.action["steering"]), float(each.action["acceleration"]),
            each.lane_index, tuple(map(str, each.target_lane_index)), float(each.target_speed),
            float(each.timer), each.DELTA, str(each.route), each.crashed,
            getattr(each, "is_yielding", False),
        )
        for each in road.vehicles
    ]  # fmt: skip


@pytest.mark.parametrize(("site", "seed"), [("intersection", 5), ("roundabout", 8)])
def test_a_round_equals_highway_envs_episode(site, seed):
    """The bits are equal although lanes are found faster and predictions are stored.

    Vehicles give way at the intersection and crash at the roundabout meanwhile.
    """
    reference, own = _reference(site, seed, seconds=12), _own(site, seed, seconds=12)
    assert reference == own
    assert any(vehicle[-1 if site == "intersection" else -2] for step in own for vehicle in step)


@every_site
def test_the_nearest_lane_equals_that_of_a_full_search(site):
    """At 2000 poses, on lanes and beside, before and behind them."""
    fast, slow, rng = network(site), RoadNetwork(), np.random.default_rng(0)
    slow.graph, lanes = fast.graph, fast.lanes_list()
    for number in range(2000):
        lane = lanes[rng.integers(len(lanes))]
        if number % 3:
            place = lane.position(rng.uniform(-40, lane.length + 40), rng.normal(0, 3))
        else:
            place = rng.uniform(-200, 200, 2)
        heading = None if number % 10 == 0 else rng.uniform(-4, 4)
        expected = slow.get_closest_lane_index(place, heading)
        assert fast.get_closest_lane_index(place, heading) == expected


@every_site
def test_of_equally_near_lanes_the_first_is_chosen(site):
    """Poses where lanes begin or end together, and in the middle between two."""
    fast, slow = network(site), RoadNetwork()
    slow.graph, lanes, ties = fast.graph, fast.lanes_list(), 0
    for lane in lanes:
        for along in (0.0, lane.length):
            for aside in (0.0, -2.0, 2.0):
                place, heading = lane.position(along, aside), lane.heading_at(along)
                expected = slow.get_closest_lane_index(place, heading)
                assert fast.get_closest_lane_index(place, heading) == expected
                away = sorted(each.distance_with_heading(place, heading) for each in lanes)
                ties += away[0] == away[1]
    assert ties > 10
