"""Where the egos of driven episodes are on their maps, at every tick and for all maps at once."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.compiled import njit
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.metrics.drivable import off_road_m
from asp_env.metrics.lanes import (
    against_traffic_m,
    at_crossing,
    covering_lanes,
    in_several_lanes,
    lane_coordinates,
    speed_limits,
)
from asp_env.metrics.masked import Masked


@dataclass(frozen=True, slots=True, kw_only=True)
class MapContext:
    """The egos of B episodes on their maps at each of T ticks."""

    outside_m: Float[np.ndarray, "b t"]
    """Distance of the outermost corner to the drivable area, without the log's allowance."""
    several_lanes: Bool[np.ndarray, "b t"]
    """Values of `in_several_lanes`."""
    at_crossing: Bool[np.ndarray, "b t"]
    """Values of `at_crossing`."""
    against_traffic_m: Masked
    """Values (b, t) of `against_traffic_m`; missing on maps without areas of lanes."""
    speed_limits_mps: Masked
    """Values (b, t) of `speed_limits`."""
    distance_to_route_lanes_m: Float[np.ndarray, "b t"]
    """Values of `distance_to_route_lanes_m`."""


def map_context(
    maps: Sequence[RoadMap],
    map_index: Int[np.ndarray, " b"],
    states: Float[np.ndarray, "b t 4"],
    sizes: Float[np.ndarray, "b 2"],
    routes: Sequence[Float[np.ndarray, "_ 2"]],
    default_limits_mps: Masked,
) -> MapContext:
    """Locates the egos of B episodes on their maps.

    Args:
        maps: the maps.
        map_index: index into `maps` of each episode.
        states: [x m, y m, heading rad, speed m/s] of the egos.
        sizes: length and width of the egos, metres.
        routes: points of the logged route of each episode, metres.
        default_limits_mps: (b,) speed limit of each episode's recording, for lanes without a limit.
    """
    shape = states.shape[:2]
    several_lanes, crossing = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    has_areas = np.zeros(shape, dtype=bool)
    outside_m = np.zeros(shape, dtype=np.float32)
    against_m, route_lanes_m = np.zeros(shape), np.zeros(shape)
    limits = np.broadcast_to(default_limits_mps.value[:, None], shape).copy()
    limited = np.broadcast_to(default_limits_mps.valid[:, None], shape).copy()
    for number, road_map in enumerate(maps):
        episodes = np.flatnonzero(map_index == number)
        egos = states[episodes]
        boxes = np.broadcast_to(sizes[episodes, None], (*egos.shape[:2], 2))
        outside_m[episodes] = off_road_m(road_map, egos, boxes)
        several_lanes[episodes] = in_several_lanes(road_map, egos, boxes)
        crossing[episodes] = at_crossing(road_map, egos, boxes)
        against_m[episodes] = against_traffic_m(road_map, egos[..., :2])
        has_areas[episodes] = len(road_map.areas) > 0
        lane_limits = speed_limits(road_map, egos)
        limits[episodes] = np.where(lane_limits.valid, lane_limits.value, limits[episodes])
        limited[episodes] |= lane_limits.valid
        for b in episodes.tolist():
            route_lanes_m[b] = distance_to_route_lanes_m(road_map, states[b], routes[b])
    return MapContext(
        outside_m=outside_m,
        several_lanes=several_lanes,
        at_crossing=crossing,
        against_traffic_m=Masked(value=against_m, valid=has_areas),
        speed_limits_mps=Masked(value=limits, valid=limited),
        distance_to_route_lanes_m=route_lanes_m,
    )


def distance_to_route_lanes_m(
    road_map: RoadMap, states: Float[np.ndarray, "t 4"], route: Float[np.ndarray, "p 2"]
) -> Float[np.ndarray, " t"]:
    """Distance of the centre at each tick to the nearest lane or route from the first tick, metres.

    This is the distance of Waymax's wrong-way metric. It is measured to the centre lines of the
    `reachable_lanes` and, since maps have gaps, to the logged route.

    Args:
        road_map: the map.
        states: [x m, y m, heading rad, speed m/s] of one vehicle.
        route: points of its logged route, metres.
    """
    points = np.ascontiguousarray(states[:, :2], dtype=np.float64)
    out = np.full(len(points), np.inf)
    logged = Ragged.pack([route])
    _write_nearest_distance(points, logged.points, logged.starts, np.ones(1, dtype=bool), out)
    chosen = reachable_lanes(road_map, states[0])
    _write_nearest_distance(points, road_map.lanes.points, road_map.lanes.starts, chosen, out)
    return out


def reachable_lanes(
    road_map: RoadMap, state: Float[np.ndarray, " 4"]
) -> Bool[np.ndarray, " lanes"]:
    """Mask of the lanes that a vehicle is in, within 90° of its heading, and all their successors.

    Args:
        road_map: the map.
        state: [x m, y m, heading rad, speed m/s].
    """
    covers = covering_lanes(road_map, state[:2])
    heading, _ = lane_coordinates(road_map, state[:2], covers)
    reached = covers & (np.cos(heading - state[2]) > 0)
    for _ in range(len(reached)):
        after = road_map.successors[reached[road_map.successors[:, 0]], 1] if reached.any() else []
        if reached[after].all():
            break
        reached[after] = True
    return reached


@njit(cache=True)
@no_type_check
def _write_nearest_distance(points, lines, starts, chosen, out):
    """Writes the distance of points to the nearest of some polylines, where it is less than `out`.

    Args:
        points: (n, 2), metres.
        lines: (vertices, 2) vertices of all polylines, metres.
        starts: (lines + 1,) polyline i is lines[starts[i]:starts[i + 1]].
        chosen: (lines,) polylines to consider.
        out: (n,) m, read and written.
    """
    for n in range(len(points)):
        for i in range(len(chosen)):
            if not chosen[i]:
                continue
            for j in range(starts[i], starts[i + 1] - 1):
                sx, sy = lines[j + 1, 0] - lines[j, 0], lines[j + 1, 1] - lines[j, 1]
                dx, dy = points[n, 0] - lines[j, 0], points[n, 1] - lines[j, 1]
                square = sx * sx + sy * sy
                share = min(max((dx * sx + dy * sy) / square, 0.0), 1.0) if square > 0.0 else 0.0
                out[n] = min(out[n], math.hypot(dx - share * sx, dy - share * sy))
