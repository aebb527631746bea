"""highway-env's roads, without the work that cannot change anything.

What happens on them is the same bit for bit: the laws are highway-env's own, which are asked only
about those whom they may concern. Two points lie at least as far apart as their coordinates do,
rounding included, so where highway-env asks first whether a distance is too large, a coordinate
that is too large answers it.

MERGED: highway-env's vehicles and roads as needed here: the same laws, without the faults.
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

FORESEEN_S = np.arange(0.25, 3.0, 0.25)
"""When highway-env's rules look for conflicts."""

_Road: Any = road.Road
_RegulatedRoad: Any = regulation.RegulatedRoad


Road = Any
"""highway-env's `Road` or `RegulatedRoad`, whose own annotations tell of other vehicles."""

Pose = list[float]
"""[x m, y m, heading rad, speed m/s] in highway-env's axes."""

REMEMBERED = 256
"""Places of which a lane remembers where along it they lie."""

CELL_M = 4.0
"""Lanes near a point are looked up by squares of this size."""


class TrafficVehicle(IDMVehicle):
    """Drives itself by highway-env's laws, unless somebody else steers it.

    What is kept of `IDMVehicle`: its decisions and its motion. What is not: copying the whole road
    to foresee where a steered vehicle goes, and foreseeing the same vehicle once for every other
    one.
    """

    track: int = -1
    """Number in its recording."""
    steered: bool = False
    """Whether somebody else decides what it does."""

    def __init__(self, *given: Any, **named: Any) -> None:
        """As of `IDMVehicle`."""
        super().__init__(*given, **named)
        self._coming: list[Pose] = []
        self._foreseen: tuple[int, Any] = (-1, None)

    def steer(self, acceleration_mps2: float, steering_rad: float, poses: list[Pose]) -> None:
        """Hands over what somebody else made it do: where it is after each coming sub-step.

        Args:
            acceleration_mps2: held through them.
            steering_rad: likewise, in highway-env's axes.
            poses: one for each sub-step.
        """
        self.steered = True
        self.action = {"acceleration": acceleration_mps2, "steering": steering_rad}
        self._coming = poses[::-1]

    def release(self) -> None:
        """Leaves it to itself again; it looks for a way from where it is to where it was going."""
        if self.steered:
            self.steered = False
            if self.route:
                self.plan_route_to(self.route[-1][1])

    def act(self, action: Any = None) -> None:
        """Decides what to do, unless that is somebody else's business."""
        if not self.steered:
            super().act(action)

    def step(self, dt: float) -> None:
        """Moves by its own decision, or to where it was steered; that knows no push by others."""
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
        """Where the traffic rules expect it: on its route, or, steered, straight on in its curve.

        Once for each time that the rules are enforced, since nobody moves meanwhile.
        """
        road: Road = self.road
        moment = road.steps
        if self._foreseen[0] != moment:
            there = super().predict_trajectory_constant_speed
            self._foreseen = moment, self._in_its_curve(times) if self.steered else there(times)
        return self._foreseen[1]

    def _in_its_curve(self, times: Float[np.ndarray, " n"]) -> tuple[Any, Any]:
        step_s = float(times[0])
        assert np.allclose(np.diff(times), step_s), "steps of equal length"
        state = np.array([*self.position, self.heading, self.speed])
        actions = np.tile([0.0, self.action["steering"]], (len(times), 1))
        states = rollout(
            state, actions, np.array(self.LENGTH), step_s, integrator="euler", reverse=True
        )
        return states[:, :2], states[:, 2]


class IntersectionVehicle(TrafficVehicle):
    """Of the intersection, which sets these for the class of its vehicles: now that is its own."""

    DISTANCE_WANTED = 7
    COMFORT_ACC_MAX = 6
    COMFORT_ACC_MIN = -3


class RoundaboutVehicle(TrafficVehicle):
    """Of the roundabout, with what highway-env's class says before its intersection changes it."""

    DISTANCE_WANTED = 10.0
    COMFORT_ACC_MAX = 3.0
    COMFORT_ACC_MIN = -5.0


class Network(RoadNetwork):
    """A network that never changes, in which the nearest lane is found without asking all lanes.

    The distance to a lane is at least that to the rectangle around it, so lanes are asked in the
    order of those until no other can be nearer.
    """

    def __init__(self, given: RoadNetwork) -> None:
        """The same lanes."""
        super().__init__()
        self.graph = given.graph
        self.indices: list[Any] = [*self.lanes_dict()]
        """(from, to, number) of each lane, in the order of `lanes_list`."""
        self.roads: list[Any] = [*dict.fromkeys(index[:2] for index in self.indices)]
        self._lanes: list[Any] = self.lanes_list()
        self._boxes = np.array([_box(lane) for lane in self._lanes])
        self._reaches = dict(zip(self.indices, map(_reach, self._lanes), strict=True))
        for lane in self._lanes:
            lane.local_coordinates = _remembering(lane.local_coordinates)
        self._near: dict[tuple[int, int], list[tuple[float, int]]] = {}

    def __deepcopy__(self, memo: dict[int, Any]) -> "Network":
        """Itself."""
        del memo
        return self

    def get_closest_lane_index(
        self, position: Float[np.ndarray, " 2"], heading: float | None = None
    ) -> Any:
        """What `RoadNetwork` finds by asking all lanes; of equally near ones the first."""
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
        """Of some vehicles those who may be on a lane, in their order."""
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


def _remembering(locate: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The same function; vehicles ask it again and again while nobody moves."""
    known: dict[bytes, Any] = {}

    @no_type_check  # asked so often that checks in the tests would take longer than all the rest
    def local_coordinates(position: Float[np.ndarray, " 2"]) -> tuple[float, float]:
        key = position.tobytes()
        found = known.get(key)
        if found is None:
            if len(known) >= REMEMBERED:
                known.clear()
            found = known[key] = locate(position)
        return found

    return local_coordinates


def _box(lane: Any) -> tuple[float, float, float, float]:
    """A rectangle around a lane's centre line."""
    return _around(lane, along_m=0.0, across_m=0.0)


def _reach(lane: Any) -> tuple[float, float, float, float]:
    """A rectangle around all that highway-env takes for on a lane when it looks for neighbours."""
    return _around(lane, along_m=float(lane.VEHICLE_LENGTH), across_m=lane.width / 2 + 1.0)


def _around(lane: Any, *, along_m: float, across_m: float) -> tuple[float, float, float, float]:
    """With a margin for what lies between its points.

    And for sine lanes, from which distances are measured as if they went on beyond their ends.
    """
    way = np.linspace(-along_m, lane.length + along_m, 200)
    points = np.array([lane.position(s, side) for s in way for side in (-across_m, across_m)])
    low, high = points.min(axis=0) - 1.0, points.max(axis=0) + 1.0
    return (*low.tolist(), *high.tolist())


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
