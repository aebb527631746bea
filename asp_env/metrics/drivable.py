"""Distances to the drivable area, looked up in a distance field that is drawn once per map."""

import math
from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float

from asp_env.compiled import njit
from asp_env.data.road_map import MapCache, RoadMap
from asp_env.errors import DataError
from asp_env.geometry import route_coordinates

CELL_M = 0.1
"""Cell size of the field. Chosen by hand: accuracy against the memory of the field."""

MARGIN_M = 5.0
"""The field ends this far outside the map and clips distances to it. Chosen by hand."""

OFF_ROAD_M = 0.3
"""A box is off the road if a corner is further outside the drivable area than this (nuPlan)."""

LOG_ALONG_ROUTE_M = 5.0
"""Where the logged ego is off the road, this is allowed up to this far along its route. Chosen by
hand."""

LOG_BESIDE_ROUTE_M = 2.0
"""It is allowed up to this far beside its route. Chosen by hand."""

_SUBPIXEL_BITS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivableField:
    """Distance to the drivable area on a grid, `MARGIN_M` outside the grid.

    The grid covers the drivable area, or the part of it in the map's region.
    """

    outside_m: Float[np.ndarray, "rows columns"]
    """0 inside the drivable area, at most `MARGIN_M`; negative inside for a signed field."""
    origin_m: tuple[float, float]
    """Centre of cell (0, 0); rows increase along +y, columns along +x."""

    def distance_m(self, points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        """Distance of points to the drivable area, metres, accurate to about one cell.

        Args:
            points: x and y, metres.
        """
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
        """Writes the distance of the outermost corner of each chosen box, metres.

        Args:
            states: [x m, y m, heading rad, speed m/s].
            sizes: length and width, metres.
            chosen: boxes whose distance is written; others are left unchanged.
            out: written.
        """
        _write_outermost(
            self.outside_m, self.origin_m[0], self.origin_m[1], states, sizes, chosen, out
        )


def drivable_field(road_map: RoadMap) -> DrivableField:
    """The distance field of a map, cached for the latest maps.

    Raises:
        DataError: the map has no drivable area.
    """
    return _fields(road_map)


def off_road_m(
    road_map: RoadMap,
    states: Float[np.ndarray, "*batch 4"],
    sizes: Float[np.ndarray, "*batch 2"],
) -> Float[np.ndarray, "*batch"]:
    """Distance of the outermost corner of each box to the drivable area, metres; 0 inside.

    Args:
        road_map: the map.
        states: [x m, y m, heading rad, speed m/s].
        sizes: length and width, metres.

    Raises:
        DataError: the map has no drivable area.
    """
    return _outermost_m(drivable_field(road_map), states, sizes)


def road_edge_m(
    road_map: RoadMap,
    states: Float[np.ndarray, "*batch 4"],
    sizes: Float[np.ndarray, "*batch 2"],
) -> Float[np.ndarray, "*batch"]:
    """Signed distance of the outermost corner of each box to the road edge, metres.

    It is positive outside the drivable area and negative inside; otherwise as `off_road_m`.
    """
    return _outermost_m(_signed_fields(road_map), states, sizes)


def log_off_road_m(
    road_map: RoadMap,
    states: Float[np.ndarray, "t 4"],
    size: Float[np.ndarray, " 2"],
    route: Float[np.ndarray, "p 2"],
) -> Float[np.ndarray, " p"]:
    """How far the logged ego itself is off the road near each point of its route, metres.

    For each point of the route this is the largest distance above 0.3 m within 5 m along the route,
    or 0. Where it is positive the map has a gap or is offset from the tracks.

    Args:
        road_map: the map.
        states: [x m, y m, heading rad, speed m/s] of the logged ego.
        size: length and width of the ego, metres.
        route: points 1 m apart, metres.
    """
    outside = off_road_m(road_map, states, np.broadcast_to(size, (len(states), 2)))
    off = np.flatnonzero(outside > OFF_ROAD_M)
    if not len(off):
        return np.zeros(len(route), dtype=np.float32)
    steps = np.hypot(*np.diff(states[:, :2], axis=0, prepend=states[:1, :2]).T)
    driven_m = np.cumsum(steps, dtype=np.float64)[off]
    routes = np.repeat(route[None], len(off), axis=0)
    arc = route_coordinates(routes, np.ones(routes.shape[:2], dtype=bool), states[off], driven_m)
    near = np.abs(arc[:, :1] - np.arange(len(route))) <= LOG_ALONG_ROUTE_M
    return np.where(near, outside[off, None], 0.0).max(axis=0).astype(np.float32)


def beyond_log_m(
    outside_m: Float[np.ndarray, " b"],
    on_route: Float[np.ndarray, "b 3"],
    log_off_road_m: Float[np.ndarray, "b p"],
) -> Float[np.ndarray, " b"]:
    """Distance to the drivable area less what is allowed because the logged ego is off it too.

    The allowance applies within 2 m beside the logged route.

    Args:
        outside_m: distance of each box to the drivable area, metres.
        on_route: its arc length m and lateral offset m on the logged route, and the route's
            heading rad.
        log_off_road_m: the value of `log_off_road_m` for the log of each box, metres.

    Returns:
        (b,) metres, at least 0.
    """
    points = np.clip(np.rint(on_route[:, 0]), 0, log_off_road_m.shape[1] - 1).astype(np.int64)
    allowed = log_off_road_m[np.arange(len(points)), points]
    beside = np.abs(on_route[:, 1]) <= LOG_BESIDE_ROUTE_M
    return np.maximum(outside_m - np.where(beside, allowed, 0), 0).astype(np.float32)


def _outermost_m(
    field: DrivableField,
    states: Float[np.ndarray, "*batch 4"],
    sizes: Float[np.ndarray, "*batch 2"],
) -> Float[np.ndarray, "*batch"]:
    flat = np.ascontiguousarray(states.reshape(-1, 4))
    out = np.empty(len(flat), dtype=np.float32)
    # A copy of sizes that are broadcast or read-only: the kernel is compiled for one kind of array.
    boxes = np.array(sizes.reshape(-1, 2), order="C")
    field.corners_m(flat, boxes, np.ones(len(flat), dtype=bool), out)
    return out.reshape(states.shape[:-1])


def _draw_area(road_map: RoadMap) -> tuple[np.ndarray, tuple[float, float]]:
    """Image (rows, columns) of the drivable area, 0 inside and 255 outside, and its origin m."""
    points = road_map.drivable.points
    if not len(points):
        raise DataError(f"map {road_map.name}: no drivable area; expected one lanelet at least")
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    if road_map.region_m is not None:
        corner = np.array(road_map.region_m[:2])
        low = corner + np.maximum(np.floor((low - corner) / CELL_M), 0.0) * CELL_M
        high = np.minimum(high, road_map.region_m[2:])
    columns, rows = np.ceil((high - low) / CELL_M).astype(int) + 1
    image = np.full((rows, columns), 255, dtype=np.uint8)
    for i in range(len(road_map.drivable)):
        ring = (road_map.drivable[i] - low) / CELL_M * 2**_SUBPIXEL_BITS
        cv2.fillPoly(image, [np.round(ring).astype(np.int32)], 0, shift=_SUBPIXEL_BITS)
    return image, (float(low[0]), float(low[1]))


def _make_field(road_map: RoadMap) -> DrivableField:
    image, origin_m = _draw_area(road_map)
    outside = cv2.distanceTransform(image, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
    return DrivableField(
        outside_m=np.minimum(outside, MARGIN_M).astype(np.float32), origin_m=origin_m
    )


def _make_signed_field(road_map: RoadMap) -> DrivableField:
    image, origin_m = _draw_area(road_map)
    inside = cv2.distanceTransform(255 - image, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
    outside = drivable_field(road_map).outside_m
    return DrivableField(outside_m=(outside - inside).astype(np.float32), origin_m=origin_m)


_MAX_FIELDS = 128
"""Largest number of cached fields. Those of a roundabout have 12 MB and take 30 ms; episodes side
by side on more maps than this make fields anew at every tick. Chosen by hand: it covers the 72
places of a suite."""

_fields = MapCache(_make_field, _MAX_FIELDS)
_signed_fields = MapCache(_make_signed_field, 32)


@njit(cache=True, inline="always")
@no_type_check
def _distance_at(grid, x_0, y_0, x, y):
    """The value of the cell (x, y), metres, of a grid whose first cell is centred at x_0, y_0."""
    column = math.floor((x - x_0) / CELL_M + 0.5)
    row = math.floor((y - y_0) / CELL_M + 0.5)
    if 0 <= row < grid.shape[0] and 0 <= column < grid.shape[1]:
        return grid[row, column]
    return np.float32(MARGIN_M)


@njit(cache=True)
@no_type_check
def _look_up(grid, x_0, y_0, points, out):
    """Writes the distance of points (n, 2) to `out` (n,)."""
    for i in range(len(points)):
        out[i] = _distance_at(grid, x_0, y_0, points[i, 0], points[i, 1])


@njit(cache=True)
@no_type_check
def _write_outermost(grid, x_0, y_0, states, sizes, chosen, out):
    """Writes the distance of the outermost corner of each chosen box.

    Args:
        grid: (rows, columns) float32, metres.
        x_0: centre of the first cell, metres.
        y_0: centre of the first cell, metres.
        states: (n, 4).
        sizes: (n, 2).
        chosen: (n,) bool.
        out: (n,), written where chosen.
    """
    for i in range(len(states)):
        if not chosen[i]:
            continue
        x, y = states[i, 0], states[i, 1]
        cos, sin = 0.5 * math.cos(states[i, 2]), 0.5 * math.sin(states[i, 2])
        ahead_x, ahead_y = cos * sizes[i, 0], sin * sizes[i, 0]
        left_x, left_y = -sin * sizes[i, 1], cos * sizes[i, 1]
        front = max(
            _distance_at(grid, x_0, y_0, x + ahead_x + left_x, y + ahead_y + left_y),
            _distance_at(grid, x_0, y_0, x + ahead_x - left_x, y + ahead_y - left_y),
        )
        rear = max(
            _distance_at(grid, x_0, y_0, x - ahead_x + left_x, y - ahead_y + left_y),
            _distance_at(grid, x_0, y_0, x - ahead_x - left_x, y - ahead_y - left_y),
        )
        out[i] = max(front, rear)
