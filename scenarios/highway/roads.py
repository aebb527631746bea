"""highway-env's roads, without the work that cannot change anything.

What happens on them is the same bit for bit: the laws are highway-env's own, which are asked only
about those whom they may concern. Two points lie at least as far apart as their coordinates do,
rounding included, so where highway-env asks first whether a distance is too large, a coordinate
that is too large answers it.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from highway_env.road import regulation, road

from scenarios.highway.vehicles import TrafficVehicle

FORESEEN_S = np.arange(0.25, 3.0, 0.25)
"""When highway-env's rules look for conflicts."""

_Road: Any = road.Road
_RegulatedRoad: Any = regulation.RegulatedRoad


class TrafficRoad(_Road):
    """A road of vehicles and of nothing else, with a `Network`."""

    steps: int = 0

    def neighbour_vehicles(self, vehicle: TrafficVehicle, lane_index: Any = None) -> Any:
        """Asks those near the lane: the others are not on it, so in front of nobody there."""
        everybody = self.vehicles
        self.vehicles = self.network.near(lane_index or vehicle.lane_index, everybody)
        try:
            return super().neighbour_vehicles(vehicle, lane_index)
        finally:
            self.vehicles = everybody

    def step(self, dt: float) -> None:
        """Moves everybody, and looks for collisions where a distance asks for a closer look."""
        for vehicle in self.vehicles:
            vehicle.step(dt)
        for vehicle, other in self._close(dt):
            vehicle.handle_collisions(other, dt)

    def _close(self, dt: float) -> Iterator[tuple[TrafficVehicle, TrafficVehicle]]:
        """Pairs in highway-env's order, without those that it finds too far apart to collide."""
        places = [vehicle.position.tolist() for vehicle in self.vehicles]
        longest = max((float(vehicle.diagonal) for vehicle in self.vehicles), default=0.0)
        for i, vehicle in enumerate(self.vehicles):
            x, y = places[i]
            reach = (float(vehicle.diagonal) + longest) / 2 + float(vehicle.speed) * dt
            for j in range(i + 1, len(places)):
                if abs(places[j][0] - x) <= reach and abs(places[j][1] - y) <= reach:
                    yield vehicle, self.vehicles[j]


class RegulatedTrafficRoad(_RegulatedRoad, TrafficRoad):
    """With highway-env's rules of who gives way."""

    def enforce_road_rules(self) -> None:
        """Looks closer only at those who are foreseen near each other at the same time."""
        self._meeting = self._foresee()
        super().enforce_road_rules()

    def _foresee(self) -> set[tuple[int, int]]:
        """Pairs, by their `id`, that highway-env does not find too far apart at all times."""
        if len(self.vehicles) < 2:
            return set()
        ways = np.array(
            [each.predict_trajectory_constant_speed(FORESEEN_S)[0] for each in self.vehicles]
        )
        apart = np.abs(ways[:, None] - ways).max(axis=-1).min(axis=-1)
        lengths = np.array([each.LENGTH for each in self.vehicles])
        pairs = np.argwhere(apart <= lengths[:, None]).tolist()
        return {(id(self.vehicles[i]), id(self.vehicles[j])) for i, j in pairs}

    def is_conflict_possible(self, v1: TrafficVehicle, v2: TrafficVehicle) -> bool:
        """What highway-env finds; nothing, of those who stay apart."""
        return (id(v1), id(v2)) in self._meeting and bool(super().is_conflict_possible(v1, v2))
