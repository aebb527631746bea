"""Roads without redundant work give the same results as highway-env's own."""

from typing import Any

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from scenarios.highway.sites import SITES, STEP_S, Site, empty_road, network
from scenarios.highway.vehicles import CACHED_POSITIONS, Network


class IntersectionCar(IDMVehicle):
    """highway-env's vehicle with the parameters of its intersection."""

    DISTANCE_WANTED = 7
    COMFORT_ACC_MAX = 6
    COMFORT_ACC_MIN = -3


def their_road(site: Site) -> Any:
    """highway-env's own road without vehicles."""
    kind = f"{site.vehicle.__module__}.{site.vehicle.__qualname__}"
    env: Any = site.environment(config={"other_vehicles_type": kind})
    env._make_road()
    return env.road


def fill(site: Site, road: Any, kind: type[IDMVehicle], seed: int) -> None:
    """Vehicles anywhere on the road, some beside their lane and changing into others."""
    rng = np.random.default_rng(seed)
    lanes = road.network.lanes_dict()
    exits = [end for start, end, _ in lanes if site.is_exit(start, end)]
    for number in rng.choice(len(lanes), size=25):
        index = [*lanes][number]
        lane: Any = lanes[index]
        along, across = rng.uniform(0.0, lane.length), rng.normal()
        heading = lane.heading_at(along) + rng.normal() * 0.3
        vehicle = kind(road, lane.position(along, across), heading, rng.uniform(0.0, 15.0))
        vehicle.plan_route_to(rng.choice(exits))
        vehicle.DELTA = rng.uniform(3.5, 4.5)
        road.vehicles.append(vehicle)


def observed(road: Any) -> list[tuple[Any, ...]]:
    """Everything in which the vehicles of a road may differ."""
    return [
        (*v.position.tolist(), v.heading, v.speed, v.crashed, v.target_lane_index, v.target_speed)
        for v in road.vehicles
    ]


@pytest.mark.parametrize("name", SITES)
@pytest.mark.parametrize("seed", range(3))
def test_dense_traffic_moves_as_on_highway_envs_road(name: str, seed: int) -> None:
    """The bits are equal through 3 s of giving way, lane changes and collisions."""
    site = SITES[name]
    own, reference = empty_road(site), their_road(site)
    fill(site, own, site.vehicle, seed)
    fill(site, reference, IntersectionCar if name == "intersection" else IDMVehicle, seed)
    assert observed(own) == observed(reference)
    before = observed(own)
    yielded = False
    for _ in range(45):
        for road in (own, reference):
            road.act()
            road.step(STEP_S)
        assert observed(own) == observed(reference)
        yielded |= any(vehicle.target_speed == 0 for vehicle in own.vehicles)
    changed = [a[5] != b[5] for a, b in zip(before, observed(own), strict=True)]
    assert any(changed), "a vehicle changes its target lane"
    assert any(vehicle.crashed for vehicle in own.vehicles), "two vehicles collide"
    assert yielded == (name == "intersection"), "a vehicle yields where there is right of way"


@pytest.mark.parametrize("name", SITES)
def test_vehicles_near_a_lane_include_all_on_it(name: str) -> None:
    """All vehicles that are on a lane by highway-env's definition are found, 1 m beside it, too."""
    road = empty_road(SITES[name])
    rng = np.random.default_rng(0)
    vehicle = SITES[name].vehicle
    road.vehicles = [
        vehicle(road, place, 0.0, 0.0) for place in rng.uniform(-60.0, 60.0, size=(200, 2))
    ]
    left_out = 0
    for index, lane in road.network.lanes_dict().items():
        on_it = [each for each in road.vehicles if lane.on_lane(each.position, margin=1)]
        near = road.network.near(index, road.vehicles)
        assert [each for each in near if each in on_it] == on_it
        left_out += len(road.vehicles) - len(near)
    assert left_out > 100 * len(road.network.indices)


def test_stored_coordinates_depend_on_the_position_not_the_array() -> None:
    """The array of a vehicle's position is changed in place."""
    known: Network = network("roundabout")
    lane: Any = known.get_lane(known.indices[0])
    fresh: Any = their_road(SITES["roundabout"]).network.get_lane(known.indices[0])
    place = np.array([10.0, 20.0])
    for _ in range(CACHED_POSITIONS + 2):
        assert lane.local_coordinates(place) == fresh.local_coordinates(place)
        place += 0.1
