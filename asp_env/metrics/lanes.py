"""The lanes of a map in which points and boxes lie, and what follows for the vehicle there.

Maps have gaps, and tracks are offset from their maps by some decimetres. A point that no lane
covers is therefore in no wrong lane and in no additional one. Where lanes overlap, the lane whose
heading fits best is taken. Leading axes of points and states are preserved.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float

from asp_env.compiled import njit
from asp_env.data.bounded_cache import MapCache
from asp_env.data.road_map import RoadMap
from asp_env.geometry import box_corners, path_length
from asp_env.metrics.masked import Masked

CROSSING_RAD = math.radians(30.0)
"""Overlapping lanes cross if their headings differ by more than this and by less than its
complement to 180°: nearly opposite lanes are one road drawn in both directions. Chosen by hand."""

GRID_M = 1.0
"""Spacing of the points at which overlaps of lanes are sought. Chosen by hand."""

MAX_CROSSING_GAP_M = 10
"""Stretches of a lane between two crossings closer than this belong to the crossing. Chosen by
hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneTable:
    """Quantities of the lanes of a map that are computed once."""

    boxes: Float[np.ndarray, "lanes 4"]
    """Smallest x, smallest y, largest x and largest y of each lane's area, metres."""
    chains: Float[np.ndarray, "chains lanes"]
    """1 for the members of every chain of one, two or three consecutive lanes."""
    crossed: Bool[np.ndarray, "lanes metres"]
    """Metres along each lane at which other lanes cross it."""


def covering_lanes(
    road_map: RoadMap, points: Float[np.ndarray, "*batch 2"]
) -> Bool[np.ndarray, "*batch lanes"]:
    """Mask of the lanes whose area contains each point; without lanes on a map without areas.

    Args:
        road_map: the map.
        points: x and y, metres.
    """
    return _covering_lanes(road_map, points, lane_table(road_map).boxes)


def lane_coordinates(
    road_map: RoadMap,
    points: Float[np.ndarray, "*batch 2"],
    covers: Bool[np.ndarray, "*batch lanes"],
) -> tuple[Float[np.ndarray, "*batch lanes"], Float[np.ndarray, "*batch lanes"]]:
    """The nearest point on the centre line of each lane that covers a point.

    Args:
        road_map: the map.
        points: x and y, metres.
        covers: the value of `covering_lanes`.

    Returns:
        Heading rad and arc length m of the nearest points; 0 for other lanes.
    """
    flat = np.ascontiguousarray(points.reshape(-1, 2), dtype=np.float64)
    flat_covers = covers.reshape(len(flat), covers.shape[-1])
    heading, arc = np.zeros(flat_covers.shape), np.zeros(flat_covers.shape)
    _project_on_lanes(flat, flat_covers, road_map.lanes.points, road_map.lanes.starts, heading, arc)
    return heading.reshape(covers.shape), arc.reshape(covers.shape)


def in_several_lanes(
    road_map: RoadMap, states: Float[np.ndarray, "*batch 4"], sizes: Float[np.ndarray, "*batch 2"]
) -> Bool[np.ndarray, "*batch"]:
    """Whether no chain of one, two or three consecutive lanes covers all corners of a box.

    This is nuPlan's test of common or connected lanes with one more lanelet, since lanelets are
    short. Corners that no lane covers do not count.

    Args:
        road_map: the map.
        states: [x m, y m, heading rad, speed m/s].
        sizes: length and width, metres.
    """
    covers = covering_lanes(road_map, box_corners(states, sizes))
    in_chain = covers.astype(np.float32) @ lane_table(road_map).chains.T > 0
    uncovered = np.asarray(~covers.any(axis=-1))
    in_one_chain = np.asarray((in_chain | uncovered[..., None]).all(axis=-2)).any(axis=-1)
    return np.asarray(~in_one_chain & ~uncovered.all(axis=-1))


def at_crossing(
    road_map: RoadMap, states: Float[np.ndarray, "*batch 4"], sizes: Float[np.ndarray, "*batch 2"]
) -> Bool[np.ndarray, "*batch"]:
    """Whether a corner or the centre of a box is in a lane where another lane crosses it.

    This replaces nuPlan's intersection polygons, which these maps do not have. The stretch between
    two crossings within 10 m counts as well.

    Args:
        road_map: the map.
        states: [x m, y m, heading rad, speed m/s].
        sizes: length and width, metres.
    """
    points = np.concatenate([box_corners(states, sizes), states[..., None, :2]], axis=-2)
    covers = covering_lanes(road_map, points)
    _, arc = lane_coordinates(road_map, points, covers)
    crossed = lane_table(road_map).crossed
    crossed_there = crossed[np.arange(len(crossed)), arc.astype(np.int64)]
    return np.asarray((covers & crossed_there).any(axis=(-2, -1)))


def against_traffic_m(
    road_map: RoadMap, xy: Float[np.ndarray, "*batch t 2"]
) -> Float[np.ndarray, "*batch t"]:
    """Distance driven against the direction of the lane since the previous tick, metres.

    The motion is projected on the lane in which it ends; of several lanes the one that fits the
    motion best is taken. The value is 0 at points without a lane, in two-way lanes and at the first
    tick.

    Args:
        road_map: the map.
        xy: positions at consecutive ticks, metres.
    """
    covers = covering_lanes(road_map, xy)
    heading, _ = lane_coordinates(road_map, xy, covers)
    step = np.diff(xy.astype(np.float64), axis=-2, prepend=xy[..., :1, :])
    along = step[..., 0, None] * np.cos(heading) + step[..., 1, None] * np.sin(heading)
    along = np.where(road_map.two_way, np.abs(along), along)
    best = np.where(covers, along, -np.inf).max(axis=-1, initial=-np.inf)
    return np.where(covers.any(axis=-1), np.maximum(-best, 0.0), 0.0)


def speed_limits(road_map: RoadMap, states: Float[np.ndarray, "*batch 4"]) -> Masked:
    """The speed limit at each state, m/s; missing where no lane with a limit covers it.

    Only lanes within 90° of the heading count; of several the highest limit is taken.

    Args:
        road_map: the map.
        states: [x m, y m, heading rad, speed m/s].
    """
    covers = covering_lanes(road_map, states[..., :2])
    heading, _ = lane_coordinates(road_map, states[..., :2], covers)
    fits = covers & road_map.limited & (np.cos(heading - states[..., 2, None]) > 0)
    limits = np.where(fits, road_map.limits_mps, 0.0).max(axis=-1, initial=0.0)
    return Masked(value=limits, valid=np.asarray(fits.any(axis=-1)))


def _build_lane_table(road_map: RoadMap) -> LaneTable:
    rings = [road_map.areas[i] for i in range(len(road_map.areas))]
    boxes = np.array([[*ring.min(axis=0), *ring.max(axis=0)] for ring in rings]).reshape(-1, 4)
    return LaneTable(boxes=boxes, chains=_chains(road_map), crossed=_crossed(road_map, boxes))


lane_table = MapCache(_build_lane_table)
"""The `LaneTable` of a map, cached for the latest maps."""


def _chains(road_map: RoadMap) -> Float[np.ndarray, "chains lanes"]:
    count = len(road_map.areas)
    successors: list[list[int]] = [[] for _ in range(count)]
    if count:
        for lane, successor in road_map.successors.tolist():
            successors[lane].append(successor)
    one = [(lane,) for lane in range(count)]
    two = [(lane, second) for lane in range(count) for second in successors[lane]]
    three = [(*pair, third) for pair in two for third in successors[pair[1]]]
    chains = np.zeros((len(one) + len(two) + len(three), count), dtype=np.float32)
    for number, chain in enumerate((*one, *two, *three)):
        chains[number, list(chain)] = 1
    return chains


def _crossed(
    road_map: RoadMap, boxes: Float[np.ndarray, "lanes 4"]
) -> Bool[np.ndarray, "lanes metres"]:
    longest = max((path_length(road_map.lanes[i]) for i in range(len(boxes))), default=0.0)
    crossed = np.zeros((len(boxes), int(longest) + 1), dtype=bool)
    if not len(boxes):
        return crossed
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    if road_map.region_m is not None:
        low, high = np.maximum(low, road_map.region_m[:2]), np.minimum(high, road_map.region_m[2:])
    columns = np.arange(low[0], high[0] + GRID_M, GRID_M)
    for y in np.arange(low[1], high[1] + GRID_M, GRID_M):
        points = np.stack([columns, np.full_like(columns, y)], axis=-1)
        covers = _covering_lanes(road_map, points, boxes)
        shared = covers.sum(axis=1) > 1
        points, covers = points[shared], covers[shared]
        heading, arc = lane_coordinates(road_map, points, covers)
        across = np.abs(np.sin(heading[:, :, None] - heading[:, None])) > math.sin(CROSSING_RAD)
        crosses = (across & covers[:, :, None] & covers[:, None]).any(axis=2)
        crossed[np.nonzero(crosses)[1], arc[crosses].astype(np.int64)] = True
    for row in crossed:
        for metre, next_metre in pairwise(np.flatnonzero(row).tolist()):
            if next_metre - metre <= MAX_CROSSING_GAP_M:
                row[metre:next_metre] = True
    return crossed


def _covering_lanes(
    road_map: RoadMap, points: Float[np.ndarray, "*batch 2"], boxes: Float[np.ndarray, "lanes 4"]
) -> Bool[np.ndarray, "*batch lanes"]:
    flat = np.ascontiguousarray(points.reshape(-1, 2), dtype=np.float64)
    out = np.zeros((len(flat), len(boxes)), dtype=bool)
    _write_containing_rings(flat, road_map.areas.points, road_map.areas.starts, boxes, out)
    return out.reshape(*points.shape[:-1], len(boxes))


@njit(cache=True)
@no_type_check
def _write_containing_rings(points, rings, starts, boxes, out):
    """Writes which rings contain each point, by the even-odd rule in float64.

    `cv2.pointPolygonTest` is no substitute: it takes single points and computes in float32.

    Args:
        points: (n, 2), metres.
        rings: (vertices, 2) vertices of all rings, metres.
        starts: (rings + 1,) ring i is rings[starts[i]:starts[i + 1]].
        boxes: (rings, 4) smallest x, smallest y, largest x and largest y of each ring.
        out: (n, rings) bool, written.
    """
    for n in range(len(points)):
        x, y = points[n, 0], points[n, 1]
        for i in range(len(boxes)):
            out[n, i] = False
            if x < boxes[i, 0] or y < boxes[i, 1] or x > boxes[i, 2] or y > boxes[i, 3]:
                continue
            k = starts[i + 1] - 1  # edges lead from k to j
            for j in range(starts[i], starts[i + 1]):
                if (rings[j, 1] > y) != (rings[k, 1] > y):
                    share = (y - rings[j, 1]) / (rings[k, 1] - rings[j, 1])
                    if x < rings[j, 0] + share * (rings[k, 0] - rings[j, 0]):
                        out[n, i] = not out[n, i]
                k = j


@njit(cache=True)
@no_type_check
def _project_on_lanes(points, covers, lines, starts, heading, arc):
    """Writes heading and arc length of the nearest point on each covering lane's centre line.

    Args:
        points: (n, 2), metres.
        covers: (n, lanes) lanes on which to project.
        lines: (vertices, 2) vertices of all centre lines, metres.
        starts: (lanes + 1,) line i is lines[starts[i]:starts[i + 1]].
        heading: (n, lanes) rad, written where `covers`.
        arc: (n, lanes) m, written where `covers`.
    """
    for n in range(len(points)):
        for i in range(covers.shape[1]):
            if not covers[n, i]:
                continue
            nearest, passed = np.inf, 0.0
            for j in range(starts[i], starts[i + 1] - 1):
                sx, sy = lines[j + 1, 0] - lines[j, 0], lines[j + 1, 1] - lines[j, 1]
                length = math.hypot(sx, sy)
                if length == 0.0:
                    continue
                dx, dy = points[n, 0] - lines[j, 0], points[n, 1] - lines[j, 1]
                along = min(max((dx * sx + dy * sy) / length, 0.0), length)
                away = math.hypot(dx - along * sx / length, dy - along * sy / length)
                if away < nearest:
                    nearest = away
                    heading[n, i] = math.atan2(sy, sx)
                    arc[n, i] = passed + along
                passed += length
