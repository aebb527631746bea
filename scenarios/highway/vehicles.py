"""highway-env's vehicles and roads with the same laws and results, without redundant work.

Checks of highway-env are limited to vehicles that they can affect. Two points lie at least as far
apart as their coordinates do, rounding included; where highway-env first tests whether a distance
is too large, a coordinate difference that is too large decides it.
`tests.benchmarks.highway_parts` measures what each shortcut saves.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, no_type_check

import numpy as np
from highway_env.road import regulation, road
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from jaxtyping import Float

from asp_env.dynamics import rollout

PREDICTED_S = np.arange(0.25, 3.0, 0.25)
"""Times at which highway-env's right of way checks for conflicts, s from now."""

_Road: Any = road.Road
_RegulatedRoad: Any = regulation.RegulatedRoad


Road = Any
"""highway-env's `Road` or `RegulatedRoad`, whose annotations name other vehicle classes."""

Pose = list[float]
"""[x m, y m, heading rad, speed m/s] in highway-env's axes."""

CACHED_POSITIONS = 256
"""Positions whose local coordinates are cached per lane."""

CELL_M = 4.0
"""Side of the squares by which lanes near a point are indexed."""


class TrafficVehicle(IDMVehicle):
    """A vehicle of highway-env's driver model, unless it is controlled.

    Decisions and motion are those of `IDMVehicle`. Left out are the copies of the whole road that
    predict a controlled vehicle, and repeated predictions of the same vehicle for each of the
    others.
    """

    track: int = -1
    """Number of the vehicle in its recording."""
    steered: bool = False
    """Whether the vehicle is controlled."""

    def __init__(self, *given: Any, **named: Any) -> None:
        """Creates a vehicle from the arguments of `IDMVehicle`."""
        super().__init__(*given, **named)
        self._coming: list[Pose] = []
        self._predicted: tuple[int, Any] = (-1, None)

    def steer(self, acceleration_mps2: float, steering_rad: float, poses: list[Pose]) -> None:
        """Controls the vehicle: sets its action and its pose after each coming sub-step.

        Args:
            acceleration_mps2: held during the sub-steps.
            steering_rad: held during the sub-steps, in highway-env's axes.
            poses: one for each sub-step.
        """
        self.steered = True
        self.action = {"acceleration": acceleration_mps2, "steering": steering_rad}
        self._coming = poses[::-1]

    def release(self) -> None:
        """Ends control; the vehicle plans a route from its position to its destination."""
        if self.steered:
            self.steered = False
            if self.route:
                self.plan_route_to(self.route[-1][1])

    def act(self, action: Any = None) -> None:
        """Chooses an action, unless the vehicle is controlled."""
        if not self.steered:
            super().act(action)

    def step(self, dt: float) -> None:
        """Moves by its own action, or to the given pose, which ignores impacts."""
        if not self.steered:
            super().step(dt)
            return
        x, y, self.heading, self.speed = self._coming.pop()
        self.position = np.array([x, y])
        self.impact = None
        self.timer += dt
        self.on_state_update()
        self.target_lane_index = self.lane_index

    def predict_trajectory_constant_speed(self, times: Any) -> Any:
        """Positions and headings that the right of way expects at some times.

        An uncontrolled vehicle follows its route, a controlled one its current curve. The result
        is stored for the rest of the step, since no vehicle moves meanwhile.

        Args:
            times: (n,) seconds from now.

        Returns:
            Positions (n, 2) and headings (n,) in highway-env's axes.
        """
        road: Road = self.road
        if self._predicted[0] != road.steps:
            along_route = super().predict_trajectory_constant_speed
            predicted = self._along_curve(times) if self.steered else along_route(times)
            self._predicted = road.steps, predicted
        return self._predicted[1]

    def _along_curve(self, times: Float[np.ndarray, " n"]) -> tuple[Any, Any]:
        step_s = float(times[0])
        assert np.allclose(np.diff(times), step_s), "steps of equal length"
        state = np.array([*self.position, self.heading, self.speed])
        actions = np.tile([0.0, self.action["steering"]], (len(times), 1))
        states = rollout(
            state, actions, np.array(self.LENGTH), step_s, integrator="euler", reverse=True
        )
        return states[:, :2], states[:, 2]


class IntersectionVehicle(TrafficVehicle):
    """Vehicle of the intersection, with the parameters that its environment sets."""

    DISTANCE_WANTED = 7
    COMFORT_ACC_MAX = 6
    COMFORT_ACC_MIN = -3


class RoundaboutVehicle(TrafficVehicle):
    """Vehicle of the roundabout, with the default parameters of highway-env's class."""

    DISTANCE_WANTED = 10.0
    COMFORT_ACC_MAX = 3.0
    COMFORT_ACC_MIN = -5.0


class Network(RoadNetwork):
    """A constant road network that finds the nearest lane without checking all lanes.

    The distance to a lane is at least the distance to its bounding box, so lanes are checked in
    the order of that distance until no other lane can be nearer.
    """

    def __init__(self, given: RoadNetwork) -> None:
        """Copies the lanes of a network."""
        super().__init__()
        self.graph = given.graph
        self.indices: list[Any] = [*self.lanes_dict()]
        """(from, to, number) of each lane, in the order of `lanes_list`."""
        self.roads: list[Any] = [*dict.fromkeys(index[:2] for index in self.indices)]
        self._lanes: list[Any] = self.lanes_list()
        self._boxes = np.array([_box(lane) for lane in self._lanes])
        self._reaches = dict(zip(self.indices, map(_reach, self._lanes), strict=True))
        for lane in self._lanes:
            lane.local_coordinates = _cached(lane.local_coordinates)
        self._near: dict[tuple[int, int], list[tuple[float, int]]] = {}

    def __deepcopy__(self, memo: dict[int, Any]) -> "Network":
        """Returns the object itself, since it is immutable."""
        del memo
        return self

    def get_closest_lane_index(
        self, position: Float[np.ndarray, " 2"], heading: float | None = None
    ) -> Any:
        """The result of `RoadNetwork`; the first of equally near lanes."""
        x, y = float(position[0]), float(position[1])
        cell = (math.floor(x / CELL_M), math.floor(y / CELL_M))
        near = self._near.get(cell)
        if near is None:
            near = self._near[cell] = self._order(cell)
        best, found = math.inf, 0
        for least, number in near:
            if least > best:
                break
            distance = float(self._lanes[number].distance_with_heading(position, heading))
            if distance < best or (distance == best and number < found):
                best, found = distance, number
        return self.indices[found]

    def near(self, index: Any, vehicles: list[TrafficVehicle]) -> list[TrafficVehicle]:
        """The vehicles that may be on a lane, in their order."""
        left, low, right, high = self._reaches[index]
        found = []
        for vehicle in vehicles:
            x, y = vehicle.position.tolist()
            if left <= x <= right and low <= y <= high:
                found.append(vehicle)
        return found

    def _order(self, cell: tuple[int, int]) -> list[tuple[float, int]]:
        low = np.array(cell) * CELL_M
        before, behind = self._boxes[:, :2] - (low + CELL_M), low - self._boxes[:, 2:]
        least = np.hypot(*np.maximum(0.0, np.maximum(before, behind)).T)
        return [(float(least[i]), int(i)) for i in np.argsort(least, kind="stable")]


def _cached(locate: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Caches a lane's local coordinates, which are requested repeatedly for the same position."""
    known: dict[bytes, Any] = {}

    @no_type_check  # called so often that checks in the tests would dominate
    def local_coordinates(position: Float[np.ndarray, " 2"]) -> tuple[float, float]:
        key = position.tobytes()
        found = known.get(key)
        if found is None:
            if len(known) >= CACHED_POSITIONS:
                known.clear()
            found = known[key] = locate(position)
        return found

    return local_coordinates


def _box(lane: Any) -> tuple[float, float, float, float]:
    """Bounding box of a lane's centre line."""
    return _around(lane, along_m=0.0, across_m=0.0)


def _reach(lane: Any) -> tuple[float, float, float, float]:
    """Bounding box of the positions that count as on a lane when neighbours are searched."""
    return _around(lane, along_m=float(lane.VEHICLE_LENGTH), across_m=lane.width / 2 + 1.0)


def _around(lane: Any, *, along_m: float, across_m: float) -> tuple[float, float, float, float]:
    """Bounding box of a lane with a margin.

    The margin covers what lies between the sampled points, and sine lanes, from which distances are
    measured as if they continued beyond their ends.
    """
    way = np.linspace(-along_m, lane.length + along_m, 200)
    points = np.array([lane.position(s, side) for s in way for side in (-across_m, across_m)])
    low, high = points.min(axis=0) - 1.0, points.max(axis=0) + 1.0
    return (*low.tolist(), *high.tolist())


class TrafficRoad(_Road):
    """A road with vehicles only, on a `Network`."""

    steps: int = 0

    def neighbour_vehicles(self, vehicle: TrafficVehicle, lane_index: Any = None) -> Any:
        """Checks only vehicles near the lane, since no other vehicle is on it."""
        vehicles = self.vehicles
        self.vehicles = self.network.near(lane_index or vehicle.lane_index, vehicles)
        try:
            return super().neighbour_vehicles(vehicle, lane_index)
        finally:
            self.vehicles = vehicles

    def step(self, dt: float) -> None:
        """Moves all vehicles and checks for collisions where they are near each other."""
        for vehicle in self.vehicles:
            vehicle.step(dt)
        for vehicle, other in self._close(dt):
            vehicle.handle_collisions(other, dt)

    def _close(self, dt: float) -> Iterator[tuple[TrafficVehicle, TrafficVehicle]]:
        """Pairs in highway-env's order, without those that are too far apart to collide."""
        places = [vehicle.position.tolist() for vehicle in self.vehicles]
        longest = max((float(vehicle.diagonal) for vehicle in self.vehicles), default=0.0)
        for i, vehicle in enumerate(self.vehicles):
            x, y = places[i]
            reach = (float(vehicle.diagonal) + longest) / 2 + float(vehicle.speed) * dt
            for j in range(i + 1, len(places)):
                if abs(places[j][0] - x) <= reach and abs(places[j][1] - y) <= reach:
                    yield vehicle, self.vehicles[j]


class RegulatedTrafficRoad(_RegulatedRoad, TrafficRoad):
    """A road with highway-env's right of way."""

    def enforce_road_rules(self) -> None:
        """Checks only pairs that are predicted near each other at the same time."""
        self._conflicts = self._find_conflicts()
        super().enforce_road_rules()

    def _find_conflicts(self) -> set[tuple[int, int]]:
        """Pairs, by their `id`, that are not too far apart at all predicted times."""
        if len(self.vehicles) < 2:
            return set()
        ways = np.array(
            [each.predict_trajectory_constant_speed(PREDICTED_S)[0] for each in self.vehicles]
        )
        apart = np.abs(ways[:, None] - ways).max(axis=-1).min(axis=-1)
        lengths = np.array([each.LENGTH for each in self.vehicles])
        pairs = np.argwhere(apart <= lengths[:, None]).tolist()
        return {(id(self.vehicles[i]), id(self.vehicles[j])) for i, j in pairs}

    def is_conflict_possible(self, v1: TrafficVehicle, v2: TrafficVehicle) -> bool:
        """The result of highway-env; False for pairs that stay apart."""
        return (id(v1), id(v2)) in self._conflicts and bool(super().is_conflict_possible(v1, v2))
