"""The map of a road after writing and reading."""

import math

import numpy as np
import pytest
from highway_env.envs import RoundaboutEnv

from asp_env.geometry import resample
from asp_env.metrics.drivable import OFF_ROAD_M, drivable_field, off_road_m
from scenarios.highway.road_map import (
    ORIGIN_LAT_LON_DEG,
    ORIGIN_UTM_M,
    all_lanes,
    links,
    mirror_states,
    strips,
)
from scenarios.lanelet2 import to_degrees
from tests.scenarios.highway.maps import Place


def test_both_forms_of_the_origin_agree() -> None:
    """Degrees and UTM agree to a decimetre."""
    degrees = to_degrees(np.array([ORIGIN_UTM_M]))[0]
    np.testing.assert_allclose(degrees, ORIGIN_LAT_LON_DEG, atol=1e-6)


def test_every_lane_is_there(place: Place) -> None:
    """The lanes are equal, in the same order, to a centimetre, one-way and without repairs."""
    road_map, found = place.road_map, strips(place.network)
    assert road_map.repairs == ()
    assert len(road_map.lanes) == len(found) == len(all_lanes(place.network))
    assert not road_map.two_way.any()
    for number, strip in enumerate(found.values()):
        np.testing.assert_allclose(road_map.lanes[number], strip.centre, atol=0.01)
        low, high = road_map.areas[number].min(axis=0), road_map.areas[number].max(axis=0)
        both = np.concatenate([strip.left, strip.right])
        np.testing.assert_allclose([low, high], [both.min(axis=0), both.max(axis=0)], atol=0.01)


def test_successors_are_those_of_the_road(place: Place) -> None:
    """The reader finds by the lanes' ends the successors in the graph."""
    number = {index: i for i, index in enumerate(all_lanes(place.network))}
    wanted = {(number[leader], number[follower]) for leader, follower in links(place.network)}
    assert {(a, b) for a, b in place.road_map.successors.tolist()} == wanted
    for leader, follower in wanted:
        gap = place.road_map.lanes[follower][0] - place.road_map.lanes[leader][-1]
        assert math.hypot(*gap) < 0.01


def test_limits(intersection: Place, roundabout: Place) -> None:
    """10 m/s at the intersection, 20 m/s at the roundabout, on every lane."""
    for place, limit in ((intersection, 10.0), (roundabout, 20.0)):
        assert place.road_map.limited.all()
        np.testing.assert_allclose(place.road_map.limits_mps, limit)


def test_lanes_lie_on_the_road(place: Place) -> None:
    """Every point of each centre line is on the road, and a car anywhere on the line as well."""
    field = drivable_field(place.road_map)
    for number in range(len(place.road_map.lanes)):
        assert field.distance_m(resample(place.road_map.lanes[number], 0.2)).max() == 0.0
    for lane in all_lanes(place.network).values():
        at = np.linspace(0.0, lane.length, 100)
        states = [[*lane.position(s, 0.0), lane.heading_at(s), 0.0] for s in at]
        sizes = np.broadcast_to([5.0, 2.0], (100, 2))
        assert off_road_m(place.road_map, mirror_states(np.array(states)), sizes).max() < 0.1


def test_beside_the_road(intersection: Place, roundabout: Place) -> None:
    """3 m beside an entry, 3 m beyond a road's end (5 m from the lane's), and on the island."""
    field = drivable_field(intersection.road_map)
    points = np.array([[4.0 + 3.0, -60.0], [2.0, -111.0 - 5.0 - 3.0]])
    np.testing.assert_allclose(field.distance_m(points), 3.0, atol=0.15)
    island, between = np.array([[0.0, -16.0], [0.0, -30.0]])
    field = drivable_field(roundabout.road_map)
    assert field.distance_m(island) == pytest.approx(2.0, abs=0.15)
    assert field.distance_m(between) > 0.5


def test_the_intersection_has_no_hole(intersection: Place) -> None:
    """Its middle is a square of 22 m without four quarter discs of 7 m radius."""
    at = np.arange(-11.0, 11.0, 0.1) + 0.05
    points = np.stack(np.meshgrid(at, at), axis=-1)
    covered = drivable_field(intersection.road_map).distance_m(points) == 0.0
    assert covered.sum() * 0.01 == pytest.approx(22.0**2 - np.pi * 7.0**2, rel=0.01)


def test_traffic_of_the_roundabout_stays_on_the_road(roundabout: Place) -> None:
    """Boxes of highway-env's vehicles, up to the ends of their lanes; some leave the ring."""
    states, sizes, left = [], [], 0
    env = RoundaboutEnv(config={"policy_frequency": 5})
    for seed in (0, 1, 2):
        env.reset(seed=seed)
        for _ in range(60):
            env.step(1)
            for vehicle in env.road.vehicles:
                if np.abs(vehicle.position).max() < 165.0 and not vehicle.crashed:
                    states.append([*vehicle.position, vehicle.heading, vehicle.speed])
                    sizes.append([vehicle.LENGTH, vehicle.WIDTH])
                    left += vehicle.lane_index[0] in ("sx", "ex", "nx", "wx")
    assert left > 100
    outside = off_road_m(roundabout.road_map, mirror_states(np.array(states)), np.array(sizes))
    assert outside.max() < OFF_ROAD_M
