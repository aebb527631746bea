"""Roundabouts of a map: rings of lanes that lead into one another around a common centre.

Lanes are of one ring where each can be reached from the other along successors. They make a
roundabout if nine tenths of their length turns about its middle, in one sense, within 35° of the
direction that a circle about it has there, and no point is over 100 m or over three times as far
from the middle as another.
"""

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.geometry import resample
from asp_env.data.road_map import RoadMap

MAX_RADIUS_M = 100.0
MAX_RADIUS_RATIO = 3.0
SHARE_ALONG = 0.9
ALONG_RAD = np.radians(35)


def ring_points(road_map: RoadMap) -> Float[np.ndarray, "points 3"]:
    """[x m, y m, direction rad] at most 1 m apart along the lanes of all roundabouts of a map."""
    found = [np.zeros((0, 3))]
    for ring in _rings(road_map):
        lanes = [_directed(road_map.lanes[int(lane)]) for lane in np.flatnonzero(ring)]
        points = np.concatenate(lanes)
        if _turns_about_its_middle(points):
            found.append(points)
    return np.concatenate(found)


def _rings(road_map: RoadMap) -> list[Bool[np.ndarray, " lanes"]]:
    """Which lanes each ring has: strongly connected parts of the graph of successors."""
    count = len(road_map.lanes)
    reach = np.zeros((count, count), dtype=bool)
    reach[road_map.successors[:, 0], road_map.successors[:, 1]] = True
    for _ in range(max(count, 1).bit_length()):
        reach |= (reach.astype(np.float32) @ reach.astype(np.float32)) > 0
    mutual = reach & reach.T
    rings, seen = [], np.zeros(count, dtype=bool)
    for lane in np.flatnonzero(mutual.diagonal()):
        if not seen[lane]:
            rings.append(mutual[lane])
            seen |= mutual[lane]
    return rings


def _directed(lane: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 3"]:
    """Points about 1 m apart with the direction to the next."""
    points = np.concatenate([resample(lane, 1.0), lane[-1:]])
    step = np.diff(points, axis=0)
    direction = np.arctan2(step[:, 1], step[:, 0])
    return np.column_stack([points[:-1], direction])


def _turns_about_its_middle(points: Float[np.ndarray, "n 3"]) -> bool:
    out = points[:, :2] - points[:, :2].mean(axis=0)
    radius = np.hypot(*out.T)
    if radius.max() > MAX_RADIUS_M or radius.max() > MAX_RADIUS_RATIO * radius.min():
        return False
    # sine of the angle from the way out to the direction: 1 where it turns left about the middle
    across = (out[:, 0] * np.sin(points[:, 2]) - out[:, 1] * np.cos(points[:, 2])) / radius
    limit = np.cos(ALONG_RAD)
    return bool(max((across >= limit).mean(), (across <= -limit).mean()) >= SHARE_ALONG)
