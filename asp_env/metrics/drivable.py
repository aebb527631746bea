"""How far outside the drivable area a point lies: a distance field drawn once per map."""

import math
from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from asp_env.data.road_map import MapCache, RoadMap
from asp_env.errors import DataError
from asp_env.geometry import route_coordinates

CELL_M = 0.1
MARGIN_M = 5.0
OFF_ROAD_M = 0.3
"""nuPlan's tolerance: a corner further outside than this is off the road."""

LOG_NEAR_M = 5.0
"""So far along its way the logged ego vouches for the road that it drives on."""

LOG_BESIDE_M = 2.0
"""And so far beside it."""

_SUBPIXEL_BITS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivableField:
    """Distance to the drivable area on a grid; beyond the grid it is the margin."""

    outside_m: Float[np.ndarray, "rows columns"]
    """0 inside the drivable area, at most the margin."""
    origin_m: tuple[float, float]
    """Centre of cell (0, 0); rows run along +y, columns along +x."""

    def distance_m(self, points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        """How far each point lies outside; accurate to about the cell of 0.1 m."""
        flat = np.ascontiguousarray(points.reshape(-1, 2))
        out = np.empty(len(flat), dtype=np.float32)
        _look_up(self.outside_m, self.origin_m[0], self.origin_m[1], flat, out)
        return out.reshape(points.shape[:-1])

    def corners_m(
        self,
        states: Float[np.ndarray, "n 4"],
        sizes: Float[np.ndarray, "n 2"],
        chosen: Bool[np.ndarray, " n"],
        out: Float[np.ndarray, " n"],
    ) -> None:
        """Writes how far the outermost corner of each chosen box lies outside, metres."""
        _outermost(self.outside_m, self.origin_m[0], self.origin_m[1], states, sizes, chosen, out)


@njit(cache=True, inline="always")
@no_type_check
def _at(grid, x_0, y_0, x, y):
    column = math.floor((x - x_0) / CELL_M + 0.5)
    row = math.floor((y - y_0) / CELL_M + 0.5)
    if 0 <= row < grid.shape[0] and 0 <= column < grid.shape[1]:
        return grid[row, column]
    return np.float32(MARGIN_M)


@njit(cache=True)
@no_type_check
def _look_up(grid, x_0, y_0, points, out):
    for i in range(len(points)):
        out[i] = _at(grid, x_0, y_0, points[i, 0], points[i, 1])


@njit(cache=True)
@no_type_check
def _outermost(grid, x_0, y_0, states, sizes, chosen, out):
    for i in range(len(states)):
        if not chosen[i]:
            continue
        x, y = states[i, 0], states[i, 1]
        cos, sin = 0.5 * math.cos(states[i, 2]), 0.5 * math.sin(states[i, 2])
        ahead_x, ahead_y = cos * sizes[i, 0], sin * sizes[i, 0]
        left_x, left_y = -sin * sizes[i, 1], cos * sizes[i, 1]
        front = max(
            _at(grid, x_0, y_0, x + ahead_x + left_x, y + ahead_y + left_y),
            _at(grid, x_0, y_0, x + ahead_x - left_x, y + ahead_y - left_y),
        )
        rear = max(
            _at(grid, x_0, y_0, x - ahead_x + left_x, y - ahead_y + left_y),
            _at(grid, x_0, y_0, x - ahead_x - left_x, y - ahead_y - left_y),
        )
        out[i] = max(front, rear)


def _image(road_map: RoadMap) -> tuple[np.ndarray, tuple[float, float]]:
    """0 where the road is, else 255, and the centre of the first cell."""
    points = road_map.drivable.points
    if not len(points):
        raise DataError(f"map {road_map.name}: no drivable area; expected one lanelet at least")
    low = points.min(axis=0) - MARGIN_M
    columns, rows = np.ceil((points.max(axis=0) + MARGIN_M - low) / CELL_M).astype(int) + 1
    image = np.full((rows, columns), 255, dtype=np.uint8)
    for i in range(len(road_map.drivable)):
        ring = (road_map.drivable[i] - low) / CELL_M * 2**_SUBPIXEL_BITS
        cv2.fillPoly(image, [np.round(ring).astype(np.int32)], 0, shift=_SUBPIXEL_BITS)
    return image, (float(low[0]), float(low[1]))


def _draw(road_map: RoadMap) -> DrivableField:
    image, origin_m = _image(road_map)
    outside = cv2.distanceTransform(image, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
    return DrivableField(
        outside_m=np.minimum(outside, MARGIN_M).astype(np.float32), origin_m=origin_m
    )


def _draw_signed(road_map: RoadMap) -> DrivableField:
    """The same with how far from the road's edge its inside is, below 0."""
    image, origin_m = _image(road_map)
    inside = cv2.distanceTransform(255 - image, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
    outside = drivable_field(road_map).outside_m
    return DrivableField(outside_m=(outside - inside).astype(np.float32), origin_m=origin_m)


_fields = MapCache(_draw, 32)
_signed_fields = MapCache(_draw_signed, 32)


def drivable_field(road_map: RoadMap) -> DrivableField:
    """The field of a map; the latest maps' fields are kept.

    Raises:
        DataError: the map has no drivable area.
    """
    return _fields(road_map)


def off_road_m(
    road_map: RoadMap,
    states: Float[np.ndarray, "*batch 4"],
    sizes: Float[np.ndarray, "*batch 2"],
) -> Float[np.ndarray, "*batch"]:
    """How far the outermost corner of each box lies outside the drivable area, metres."""
    return _of_boxes(drivable_field(road_map), states, sizes)


def road_edge_m(
    road_map: RoadMap,
    states: Float[np.ndarray, "*batch 4"],
    sizes: Float[np.ndarray, "*batch 2"],
) -> Float[np.ndarray, "*batch"]:
    """The same, but how far inside it is, below 0, where all corners are within the area."""
    return _of_boxes(_signed_fields(road_map), states, sizes)


def _of_boxes(
    grid: DrivableField, states: Float[np.ndarray, "*batch 4"], sizes: Float[np.ndarray, "*batch 2"]
) -> Float[np.ndarray, "*batch"]:
    flat = np.ascontiguousarray(states.reshape(-1, 4))
    out = np.empty(len(flat), dtype=np.float32)
    everybody = np.ones(len(flat), dtype=bool)
    grid.corners_m(flat, sizes.reshape(-1, 2), everybody, out)
    return out.reshape(states.shape[:-1])


def log_off_road_m(
    road_map: RoadMap,
    states: Float[np.ndarray, "t 4"],
    size: Float[np.ndarray, " 2"],
    route: Float[np.ndarray, "p 2"],
) -> Float[np.ndarray, " p"]:
    """How far off the road, by over 0.3 m, a log itself is within 5 m of each point of its route.

    Where it is, the map has a gap, or lies beside the tracks; elsewhere 0.
    """
    outside = off_road_m(road_map, states, np.broadcast_to(size, (len(states), 2)))
    off = np.flatnonzero(outside > OFF_ROAD_M)
    if not len(off):
        return np.zeros(len(route), dtype=np.float32)
    steps = np.hypot(*np.diff(states[:, :2], axis=0, prepend=states[:1, :2]).T)
    driven_m = np.cumsum(steps, dtype=np.float64)[off]
    routes = np.repeat(route[None], len(off), axis=0)
    arc = route_coordinates(routes, np.ones(routes.shape[:2], dtype=bool), states[off], driven_m)
    near = np.abs(arc[:, :1] - np.arange(len(route))) <= LOG_NEAR_M
    return np.where(near, outside[off, None], 0.0).max(axis=0).astype(np.float32)


def beyond_log_m(
    outside_m: Float[np.ndarray, " b"],
    on_route: Float[np.ndarray, "b 3"],
    log_off_road_m: Float[np.ndarray, "b p"],
) -> Float[np.ndarray, " b"]:
    """How far outside boxes are, less what the log is there, for those within 2 m of its way.

    Args:
        outside_m: how far each box lies outside the drivable area.
        on_route: its arc length and offset on the logged route, and the route's heading.
        log_off_road_m: of each of their logs.
    """
    points = np.clip(np.rint(on_route[:, 0]), 0, log_off_road_m.shape[1] - 1).astype(np.int64)
    excused = log_off_road_m[np.arange(len(points)), points]
    beside = np.abs(on_route[:, 1]) <= LOG_BESIDE_M
    return np.maximum(outside_m - np.where(beside, excused, 0), 0).astype(np.float32)
