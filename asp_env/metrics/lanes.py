"""Where a point lies along a route whose points are 1 m apart, compiled.

MERGED: Which lanes of a map points lie in, and what follows for whoever drives there.

Maps have gaps, and tracks lie off their maps by some decimetres. So a point that no lane covers
tells nothing: it is in no wrong lane and in no other one. Where lanes overlap, a vehicle is given
the one whose heading fits best. Leading axes of points and states are kept throughout.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from asp_env.data.road_map import MapCache, RoadMap
from asp_env.geometry import box_corners, path_length
from asp_env.metrics.masked import Masked

CROSSING_RAD = math.radians(30.0)
"""Lanes that overlap cross where their headings differ by more than this, and by less than its
complement to 180°: what is nearly opposite is one road drawn for either direction."""

GRID_M = 1.0
"""Overlaps are looked for at points this far apart, and kept per metre of a lane."""

BETWEEN_M = 10
"""Between two lanes that cross within this distance one is still at the crossing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneTable:
    """What is worked out once of a map's lanes."""

    boxes: Float[np.ndarray, "lanes 4"]
    """Smallest x, smallest y, largest x, largest y of each area."""
    chains: Float[np.ndarray, "chains lanes"]
    """1 for the members of every path of one, two or three lanes that follow each other."""
    crossed: Bool[np.ndarray, "lanes metres"]
    """Metres along each lane at which others cross it."""


@njit(cache=True)
@no_type_check
def _covers(points, rings, starts, boxes, out):
    for n in range(len(points)):
        x, y = points[n, 0], points[n, 1]
        for i in range(len(boxes)):
            out[n, i] = False
            if x < boxes[i, 0] or y < boxes[i, 1] or x > boxes[i, 2] or y > boxes[i, 3]:
                continue
            k = starts[i + 1] - 1  # the even-odd rule on edges from k to j
            for j in range(starts[i], starts[i + 1]):
                if (rings[j, 1] > y) != (rings[k, 1] > y):
                    share = (y - rings[j, 1]) / (rings[k, 1] - rings[j, 1])
                    if x < rings[j, 0] + share * (rings[k, 0] - rings[j, 0]):
                        out[n, i] = not out[n, i]
                k = j


@njit(cache=True)
@no_type_check
def _along(points, covers, lines, starts, heading, arc):
    for n in range(len(points)):
        for i in range(covers.shape[1]):
            if not covers[n, i]:
                continue
            best, gone = np.inf, 0.0
            for j in range(starts[i], starts[i + 1] - 1):
                sx, sy = lines[j + 1, 0] - lines[j, 0], lines[j + 1, 1] - lines[j, 1]
                length = math.hypot(sx, sy)
                if length == 0.0:
                    continue
                dx, dy = points[n, 0] - lines[j, 0], points[n, 1] - lines[j, 1]
                at = min(max((dx * sx + dy * sy) / length, 0.0), length)
                away = math.hypot(dx - at * sx / length, dy - at * sy / length)
                if away < best:
                    best = away
                    heading[n, i] = math.atan2(sy, sx)
                    arc[n, i] = gone + at
                gone += length


def covering_lanes(
    road_map: RoadMap, points: Float[np.ndarray, "*batch 2"]
) -> Bool[np.ndarray, "*batch lanes"]:
    """Which lanes' areas each point lies in; no lane at all on a map without areas."""
    return _covering(road_map, points, lane_table(road_map).boxes)


def _covering(
    road_map: RoadMap, points: Float[np.ndarray, "*batch 2"], boxes: Float[np.ndarray, "lanes 4"]
) -> Bool[np.ndarray, "*batch lanes"]:
    flat = np.ascontiguousarray(points.reshape(-1, 2), dtype=np.float64)
    out = np.zeros((len(flat), len(boxes)), dtype=bool)
    _covers(flat, road_map.areas.points, road_map.areas.starts, boxes, out)
    return out.reshape(*points.shape[:-1], len(boxes))


def lane_coordinates(
    road_map: RoadMap,
    points: Float[np.ndarray, "*batch 2"],
    covers: Bool[np.ndarray, "*batch lanes"],
) -> tuple[Float[np.ndarray, "*batch lanes"], Float[np.ndarray, "*batch lanes"]]:
    """Heading rad and arc length m of the nearest point of each covering lane's centre line."""
    flat = np.ascontiguousarray(points.reshape(-1, 2), dtype=np.float64)
    known = covers.reshape(len(flat), covers.shape[-1])
    heading, arc = np.zeros(known.shape), np.zeros(known.shape)
    _along(flat, known, road_map.lanes.points, road_map.lanes.starts, heading, arc)
    return heading.reshape(covers.shape), arc.reshape(covers.shape)


def _tabulate(road_map: RoadMap) -> LaneTable:
    rings = [road_map.areas[i] for i in range(len(road_map.areas))]
    boxes = np.array([[*ring.min(axis=0), *ring.max(axis=0)] for ring in rings]).reshape(-1, 4)
    return LaneTable(boxes=boxes, chains=_chains(road_map), crossed=_where_crossed(road_map, boxes))


lane_table = MapCache(_tabulate, 32)


def _chains(road_map: RoadMap) -> Float[np.ndarray, "chains lanes"]:
    count = len(road_map.areas)
    after: list[list[int]] = [[] for _ in range(count)]
    if count:
        for lane, follower in road_map.successors.tolist():
            after[lane].append(follower)
    one = [(lane,) for lane in range(count)]
    two = [(lane, second) for lane in range(count) for second in after[lane]]
    three = [(*pair, third) for pair in two for third in after[pair[1]]]
    chains = np.zeros((len(one) + len(two) + len(three), count), dtype=np.float32)
    for number, chain in enumerate((*one, *two, *three)):
        chains[number, list(chain)] = 1
    return chains


def _where_crossed(
    road_map: RoadMap, boxes: Float[np.ndarray, "lanes 4"]
) -> Bool[np.ndarray, "lanes metres"]:
    longest = max((path_length(road_map.lanes[i]) for i in range(len(boxes))), default=0.0)
    crossed = np.zeros((len(boxes), int(longest) + 1), dtype=bool)
    if not len(boxes):
        return crossed
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    columns = np.arange(low[0], high[0] + GRID_M, GRID_M)
    for y in np.arange(low[1], high[1] + GRID_M, GRID_M):
        points = np.stack([columns, np.full_like(columns, y)], axis=-1)
        covers = _covering(road_map, points, boxes)
        shared = covers.sum(axis=1) > 1
        points, covers = points[shared], covers[shared]
        heading, arc = lane_coordinates(road_map, points, covers)
        across = np.abs(np.sin(heading[:, :, None] - heading[:, None])) > math.sin(CROSSING_RAD)
        meets = (across & covers[:, :, None] & covers[:, None]).any(axis=2)
        crossed[np.nonzero(meets)[1], arc[meets].astype(np.int64)] = True
    for row in crossed:
        for here, there in pairwise(np.flatnonzero(row).tolist()):
            if there - here <= BETWEEN_M:
                row[here:there] = True
    return crossed


def in_several_lanes(
    road_map: RoadMap, states: Float[np.ndarray, "*batch 4"], sizes: Float[np.ndarray, "*batch 2"]
) -> Bool[np.ndarray, "*batch"]:
    """Whether no single lane, nor two or three that follow each other, have all corners of a box.

    As nuPlan's test of common or connected lanes, with one lanelet more, since lanelets are short.
    Corners that no lane covers do not count.
    """
    covers = covering_lanes(road_map, box_corners(states, sizes))
    held = covers.astype(np.float32) @ lane_table(road_map).chains.T > 0
    unknown = np.asarray(~covers.any(axis=-1))
    one = np.asarray((held | unknown[..., None]).all(axis=-2)).any(axis=-1)
    return np.asarray(~one & ~unknown.all(axis=-1))


def at_crossing(
    road_map: RoadMap, states: Float[np.ndarray, "*batch 4"], sizes: Float[np.ndarray, "*batch 2"]
) -> Bool[np.ndarray, "*batch"]:
    """Whether a corner or the centre is in a lane where another one crosses it, or between two.

    This stands for nuPlan's polygons of intersections, which these maps do not have.
    """
    points = np.concatenate([box_corners(states, sizes), states[..., None, :2]], axis=-2)
    covers = covering_lanes(road_map, points)
    _, arc = lane_coordinates(road_map, points, covers)
    crossed = lane_table(road_map).crossed
    there = crossed[np.arange(len(crossed)), arc.astype(np.int64)]
    return np.asarray((covers & there).any(axis=(-2, -1)))


def against_traffic_m(
    road_map: RoadMap, xy: Float[np.ndarray, "*batch t 2"]
) -> Float[np.ndarray, "*batch t"]:
    """How far each tick's motion, from the tick before, leads against the lane it ends in, metres.

    Of the lanes that cover the point the one counts whose heading fits the motion best. A point
    without a lane is neither right nor wrong, two-way lanes are never wrong, and before the first
    tick nothing has moved.
    """
    covers = covering_lanes(road_map, xy)
    heading, _ = lane_coordinates(road_map, xy, covers)
    step = np.diff(xy.astype(np.float64), axis=-2, prepend=xy[..., :1, :])
    along = step[..., 0, None] * np.cos(heading) + step[..., 1, None] * np.sin(heading)
    along = np.where(road_map.two_way, np.abs(along), along)
    best = np.where(covers, along, -np.inf).max(axis=-1, initial=-np.inf)
    return np.where(covers.any(axis=-1), np.maximum(-best, 0.0), 0.0)


def speed_limits(road_map: RoadMap, states: Float[np.ndarray, "*batch 4"]) -> Masked:
    """The limit in m/s where each state lies; missing where no limited lane covers it.

    Of several lanes those within 90° of the heading count, of these the highest limit.
    """
    covers = covering_lanes(road_map, states[..., :2])
    heading, _ = lane_coordinates(road_map, states[..., :2], covers)
    fits = covers & road_map.limited & (np.cos(heading - states[..., 2, None]) > 0)
    limits = np.where(fits, road_map.limits_mps, 0.0).max(axis=-1, initial=0.0)
    return Masked(value=limits, valid=np.asarray(fits.any(axis=-1)))
