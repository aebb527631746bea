"""How far outside the drivable area a point lies: a distance field drawn once per map."""

import math
from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from asp_env.data.road_map import RoadMap
from asp_env.errors import DataError
from asp_env.metrics.per_map import PerMap

CELL_M = 0.1
MARGIN_M = 5.0
OFF_ROAD_M = 0.3
"""nuPlan's tolerance: a corner further outside than this is off the road."""

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


def _draw(road_map: RoadMap) -> DrivableField:
    points = road_map.drivable.points
    if not len(points):
        raise DataError(f"map {road_map.name}: no drivable area; expected one lanelet at least")
    low = points.min(axis=0) - MARGIN_M
    columns, rows = np.ceil((points.max(axis=0) + MARGIN_M - low) / CELL_M).astype(int) + 1
    image = np.full((rows, columns), 255, dtype=np.uint8)
    for i in range(len(road_map.drivable)):
        ring = (road_map.drivable[i] - low) / CELL_M * 2**_SUBPIXEL_BITS
        cv2.fillPoly(image, [np.round(ring).astype(np.int32)], 0, shift=_SUBPIXEL_BITS)
    outside = cv2.distanceTransform(image, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
    return DrivableField(
        outside_m=np.minimum(outside, MARGIN_M).astype(np.float32),
        origin_m=(float(low[0]), float(low[1])),
    )


_fields = PerMap(_draw)


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
    flat = np.ascontiguousarray(states.reshape(-1, 4))
    out = np.empty(len(flat), dtype=np.float32)
    everybody = np.ones(len(flat), dtype=bool)
    drivable_field(road_map).corners_m(flat, sizes.reshape(-1, 2), everybody, out)
    return out.reshape(states.shape[:-1])
