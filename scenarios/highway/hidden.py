"""What highway-env's vehicles know besides how they move, as rows of a table.

With it a road is brought back exactly: the same vehicles in the same order go on as they did.
"""

from typing import Any

import numpy as np
from jaxtyping import Shaped

from scenarios.highway.vehicles import Network, Road, TrafficVehicle

LONGEST_ROUTE = 16
"""Roads; a way through the roundabout has at most 11."""

ANY_LANE = -1
"""In a route, in place of a lane of the road."""

HIDDEN = np.dtype(
    [
        ("track", np.int32),
        ("x", np.float64),
        ("y", np.float64),
        ("heading", np.float64),
        ("speed", np.float64),
        ("target_lane", np.int16),
        ("target_speed", np.float64),
        ("timer", np.float64),
        ("delta", np.float64),
        ("route", np.int16, (LONGEST_ROUTE, 2)),
        ("route_length", np.int16),
        ("crashed", np.bool_),
        ("pushed", np.bool_),
        ("impact", np.float64, (2,)),
        ("yielding", np.bool_),
        ("yield_timer", np.int32),
        ("steered", np.bool_),
    ]
)
"""Of a vehicle: number in the recording; m, m, rad, m/s in highway-env's axes; the lane that it
makes for; the speed it wants, m/s; seconds since it thought of changing lanes; the exponent of its
law; (road, lane) of the rest of its route; whether it crashed, and by how much it is pushed at the
next step, m; whether it gives way, and since how many checks; whether somebody else steers it."""

Rows = Shaped[np.ndarray, " _"]
"""Of `HIDDEN`, in the order of the road's vehicles."""


def read_vehicles(road: Road) -> Rows:
    """The hidden state of all vehicles on a road."""
    rows = np.zeros(len(road.vehicles), dtype=HIDDEN)
    for row, vehicle in zip(rows, road.vehicles, strict=True):
        _read(row, vehicle, road.network)
    return rows


def _read(row: Any, vehicle: Any, network: Network) -> None:
    row["track"] = vehicle.track
    row["x"], row["y"] = vehicle.position
    row["heading"], row["speed"] = vehicle.heading, vehicle.speed
    start, end, number = vehicle.target_lane_index
    row["target_lane"] = network.indices.index((start, end, int(number)))
    row["target_speed"], row["timer"], row["delta"] = (
        vehicle.target_speed,
        vehicle.timer,
        vehicle.DELTA,
    )
    route = vehicle.route or []
    row["route_length"] = len(route)
    for k, (start, end, lane) in enumerate(route):
        row["route"][k] = network.roads.index((start, end)), ANY_LANE if lane is None else lane
    row["crashed"] = vehicle.crashed
    if vehicle.impact is not None:
        row["pushed"], row["impact"] = True, vehicle.impact
    row["yielding"] = getattr(vehicle, "is_yielding", False)
    row["yield_timer"] = getattr(vehicle, "yield_timer", 0)
    row["steered"] = vehicle.steered


def revive(rows: Rows, road: Road, kind: type[TrafficVehicle]) -> list[TrafficVehicle]:
    """The vehicles of some rows, not yet on the road."""
    return [_revive(row, road, kind) for row in rows]


def _revive(row: Any, road: Road, kind: type[TrafficVehicle]) -> TrafficVehicle:
    network: Network = road.network
    vehicle: Any = kind(
        road, [float(row["x"]), float(row["y"])], float(row["heading"]), float(row["speed"])
    )
    vehicle.track = int(row["track"])
    vehicle.target_lane_index = network.indices[int(row["target_lane"])]
    # set afterwards, since the constructor takes zeros for nothing
    vehicle.target_speed = float(row["target_speed"])
    vehicle.timer = float(row["timer"])
    vehicle.DELTA = float(row["delta"])
    vehicle.route = [
        (*network.roads[int(road_number)], None if lane == ANY_LANE else int(lane))
        for road_number, lane in row["route"][: int(row["route_length"])]
    ]
    vehicle.crashed = bool(row["crashed"])
    vehicle.impact = row["impact"].copy() if row["pushed"] else None
    if row["yielding"]:
        vehicle.is_yielding, vehicle.color = True, None
    vehicle.yield_timer = int(row["yield_timer"])
    vehicle.steered = bool(row["steered"])
    return vehicle
