"""The sites of highway-env, and the traffic that it creates there."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from highway_env.envs import IntersectionEnv, RoundaboutEnv
from highway_env.envs.common.abstract import AbstractEnv

from scenarios.highway.vehicles import (
    IntersectionVehicle,
    Network,
    RegulatedTrafficRoad,
    Road,
    RoundaboutVehicle,
    TrafficRoad,
    TrafficVehicle,
)

STEPS_PER_S = 15
"""highway-env's own rate."""

STEP_S = 1.0 / STEPS_PER_S

LEAVES_BEFORE_END_M = 20.0
"""Vehicles are removed this far before the end of the road, as at highway-env's intersection."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """One of highway-env's road networks with its traffic."""

    name: str
    environment: type[AbstractEnv]
    vehicle: type[TrafficVehicle]
    road: type[TrafficRoad]
    speed_limit_mps: float
    config: dict[str, Any]
    """Changes to the default configuration of the environment."""
    populate: Callable[[Any], None]
    """Puts the first vehicles on the road."""
    is_exit: Callable[[str, str], bool]
    """Whether the lanes from one node to another are exits."""
    spawn: Callable[[Any], None] | None
    """Called once a second; may add a vehicle."""


SITES = {
    site.name: site
    for site in (
        Site(
            name="intersection",
            environment=IntersectionEnv,
            vehicle=IntersectionVehicle,
            road=RegulatedTrafficRoad,
            speed_limit_mps=10.0,
            config={"destination": None},
            populate=lambda env: env._make_vehicles(env.config["initial_vehicle_count"]),
            is_exit=lambda start, end: start.startswith("il") and end.startswith("o"),
            spawn=lambda env: env._spawn_vehicle(spawn_probability=env.config["spawn_probability"]),
        ),
        Site(
            name="roundabout",
            environment=RoundaboutEnv,
            vehicle=RoundaboutVehicle,
            road=TrafficRoad,
            speed_limit_mps=20.0,
            config={},
            populate=lambda env: env._make_vehicles(),
            is_exit=lambda _, end: end.endswith("xr"),
            spawn=None,
        ),
    )
}


class _Ego:
    """Replaces an environment's action type: its ego becomes an ordinary vehicle."""

    def __init__(self, site: Site) -> None:
        self.vehicle_class = site.vehicle


@cache
def _environment(site_name: str) -> Any:
    """highway-env's own environment, which creates roads and vehicles.

    It is never stepped; its clock, spaces and copies are not used.
    """
    site = SITES[site_name]
    kind = f"{site.vehicle.__module__}.{site.vehicle.__qualname__}"
    env: Any = site.environment(config={"other_vehicles_type": kind, **site.config})
    env.action_type = _Ego(site)
    return env


@cache
def network(site_name: str) -> Network:
    """The road network of a site; it never changes."""
    env = _environment(site_name)
    env._make_road()
    road, env.road = env.road, None
    return Network(road.network)


def empty_road(site: Site, *, steps: int = 0) -> Road:
    """A road without vehicles.

    Args:
        site: the site.
        steps: step count of the road, by which the intersection times its right of way.
    """
    # A generator is passed because highway-env would otherwise create one, which is slow.
    road: Road = site.road(network(site.name), np_random=np.random.default_rng(0))
    road.steps, road.np_random = steps, None  # nothing is drawn while vehicles move
    return road


def populated_road(site: Site, rng: np.random.Generator) -> Road:
    """A road as at the start of highway-env's episodes, with the ego as an ordinary vehicle."""
    road = empty_road(site)
    _with(site, road, rng, site.populate)
    return road


def spawn_vehicle(site: Site, road: Road, rng: np.random.Generator) -> None:
    """Adds another vehicle with the site's probability, if there is room."""
    if site.spawn is not None:
        _with(site, road, rng, site.spawn)


def _with(site: Site, road: Road, rng: np.random.Generator, do: Callable[[Any], None]) -> None:
    env = _environment(site.name)
    env.road, env.np_random, road.np_random = road, rng, rng
    try:
        do(env)
    finally:
        env.road, env.controlled_vehicles, road.np_random = None, [], None


def remove_exited(site: Site, road: Road, *, ego: int | None = None) -> None:
    """Removes uncontrolled vehicles that are about to reach the end of the road.

    highway-env's roundabout removes no vehicle, so that they continue forever. The ego stays in
    any case, as in highway-env.

    Args:
        site: the site.
        road: the road.
        ego: track of the ego, if there is one.
    """
    road.vehicles = [
        each
        for each in road.vehicles
        if each.steered or each.track == ego or not _leaves(site, each)
    ]


def _leaves(site: Site, vehicle: TrafficVehicle) -> bool:
    if not site.is_exit(*vehicle.lane_index[:2]):
        return False
    along, _ = vehicle.lane.local_coordinates(vehicle.position)
    return bool(along >= vehicle.lane.length - LEAVES_BEFORE_END_M)
