"""How far from all ways that it may take a vehicle is: Waymax's test of the wrong way.

MERGED: What a map says of B drives at each of T ticks, for all maps at once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from asp_env.data.road_map import Ragged, RoadMap
from asp_env.metrics.drivable import off_road_m
from asp_env.metrics.lanes import (
    against_traffic_m,
    lane_coordinates,
    at_crossing,
    covering_lanes,
    in_several_lanes,
    speed_limits,
)
from asp_env.metrics.masked import Masked

WRONG_WAY_M = 3.5
"""Waymax: further than this from every way is the wrong way."""


@njit(cache=True)
@no_type_check
def _nearest(points, lines, starts, chosen, out):
    for n in range(len(points)):
        for i in range(len(chosen)):
            if not chosen[i]:
                continue
            for j in range(starts[i], starts[i + 1] - 1):
                sx, sy = lines[j + 1, 0] - lines[j, 0], lines[j + 1, 1] - lines[j, 1]
                dx, dy = points[n, 0] - lines[j, 0], points[n, 1] - lines[j, 1]
                square = sx * sx + sy * sy
                at = min(max((dx * sx + dy * sy) / square, 0.0), 1.0) if square > 0.0 else 0.0
                out[n] = min(out[n], math.hypot(dx - at * sx, dy - at * sy))


def reachable_lanes(road_map: RoadMap, start: Float[np.ndarray, " 4"]) -> Bool[np.ndarray, " lanes"]:
    """Lanes that lead on from a state: those it is in and heads along, and whatever follows."""
    covers = covering_lanes(road_map, start[:2])
    heading, _ = lane_coordinates(road_map, start[:2], covers)
    found = covers & (np.cos(heading - start[2]) > 0)
    for _ in range(len(found)):
        after = road_map.successors[found[road_map.successors[:, 0]], 1] if found.any() else []
        if found[after].all():
            break
        found[after] = True
    return found


def distance_to_route_lanes_m(
    road_map: RoadMap, states: Float[np.ndarray, "t 4"], route: Float[np.ndarray, "p 2"]
) -> Float[np.ndarray, " t"]:
    """Distance from each tick's centre to the nearest way that led on from the first tick, metres.

    Ways are the centre lines of `reachable_lanes` lanes, and the logged route, since maps have gaps.
    """
    points = np.ascontiguousarray(states[:, :2], dtype=np.float64)
    out = np.full(len(points), np.inf)
    logged = Ragged.pack([route])
    _nearest(points, logged.points, logged.starts, np.ones(1, dtype=bool), out)
    chosen = reachable_lanes(road_map, states[0])
    _nearest(points, road_map.lanes.points, road_map.lanes.starts, chosen, out)
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class MapContext:
    """See the functions of `lanes` and `ways` of the same names. At every tick of the egos."""

    outside_m: Float[np.ndarray, "b t"]
    """How far the outermost corner lies outside the drivable area, whatever the log does."""
    several_lanes: Bool[np.ndarray, "b t"]
    at_crossing: Bool[np.ndarray, "b t"]
    against_traffic: Masked
    """Metres in each tick; missing on maps without areas of lanes."""
    limits: Masked
    """Speed limit, m/s."""
    distance_to_route_lanes_m: Float[np.ndarray, "b t"]


def map_context(
    maps: Sequence[RoadMap],
    map_index: Int[np.ndarray, " b"],
    states: Float[np.ndarray, "b t 4"],
    sizes: Float[np.ndarray, "b 2"],
    routes: Sequence[Float[np.ndarray, "_ 2"]],
    elsewhere: Masked,
) -> MapContext:
    """What the maps say of the egos.

    Args:
        maps: some maps.
        map_index: which of them each drive is on.
        states: of the egos.
        sizes: their lengths and widths.
        routes: their logged ways.
        elsewhere: the speed limit of each drive's recording (b,), where a lane tells none.
    """
    shape = states.shape[:2]
    several, crossing = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    known = np.zeros(shape, dtype=bool)
    outside = np.zeros(shape, dtype=np.float32)
    against, off_ways = np.zeros(shape), np.zeros(shape)
    limits = np.broadcast_to(elsewhere.value[:, None], shape).copy()
    limited = np.broadcast_to(elsewhere.valid[:, None], shape).copy()
    for number, road_map in enumerate(maps):
        mine = np.flatnonzero(map_index == number)
        here = states[mine]
        boxes = np.broadcast_to(sizes[mine, None], (*here.shape[:2], 2))
        outside[mine] = off_road_m(road_map, here, boxes)
        several[mine] = in_several_lanes(road_map, here, boxes)
        crossing[mine] = at_crossing(road_map, here, boxes)
        against[mine] = against_traffic_m(road_map, here[..., :2])
        known[mine] = len(road_map.areas) > 0
        told = speed_limits(road_map, here)
        limits[mine] = np.where(told.valid, told.value, limits[mine])
        limited[mine] |= told.valid
        for b in mine.tolist():
            off_ways[b] = distance_to_route_lanes_m(road_map, states[b], routes[b])
    return MapContext(
        outside_m=outside,
        several_lanes=several,
        at_crossing=crossing,
        against_traffic=Masked(value=against, valid=known),
        limits=Masked(value=limits, valid=limited),
        distance_to_route_lanes_m=off_ways,
    )
