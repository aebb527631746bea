"""How far from all ways that it may take a vehicle is: Waymax's test of the wrong way."""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from asp_env.data.road_map import Ragged, RoadMap
from asp_env.metrics.lanes import along_lanes, covering

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


def reachable(road_map: RoadMap, start: Float[np.ndarray, " 4"]) -> Bool[np.ndarray, " lanes"]:
    """Lanes that lead on from a state: those it is in and heads along, and whatever follows."""
    covers = covering(road_map, start[:2])
    heading, _ = along_lanes(road_map, start[:2], covers)
    found = covers & (np.cos(heading - start[2]) > 0)
    for _ in range(len(found)):
        after = road_map.successors[found[road_map.successors[:, 0]], 1] if found.any() else []
        if found[after].all():
            break
        found[after] = True
    return found


def off_ways_m(
    road_map: RoadMap, states: Float[np.ndarray, "t 4"], route: Float[np.ndarray, "p 2"]
) -> Float[np.ndarray, " t"]:
    """Distance from each tick's centre to the nearest way that led on from the first tick, metres.

    Ways are the centre lines of `reachable` lanes, and the logged route, since maps have gaps.
    """
    points = np.ascontiguousarray(states[:, :2], dtype=np.float64)
    out = np.full(len(points), np.inf)
    logged = Ragged.pack([route])
    _nearest(points, logged.points, logged.starts, np.ones(1, dtype=bool), out)
    chosen = reachable(road_map, states[0])
    _nearest(points, road_map.lanes.points, road_map.lanes.starts, chosen, out)
    return out
