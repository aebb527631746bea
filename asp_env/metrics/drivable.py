"""How far outside the drivable area a point lies: a distance field drawn once per map."""

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float
from numba import njit

from asp_env.data.geometry import box_corners
from asp_env.data.road_map import RoadMap
from asp_env.errors import DataError

CELL_M = 0.1
MARGIN_M = 5.0
OFF_ROAD_M = 0.3
"""nuPlan's tolerance: a corner further outside than this is off the road."""

_KEPT = 32
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


@njit(cache=True)
@no_type_check
def _look_up(grid, x_0, y_0, points, out):
    for i in range(len(points)):
        column = math.floor((points[i, 0] - x_0) / CELL_M + 0.5)
        row = math.floor((points[i, 1] - y_0) / CELL_M + 0.5)
        if 0 <= row < grid.shape[0] and 0 <= column < grid.shape[1]:
            out[i] = grid[row, column]
        else:
            out[i] = MARGIN_M


_fields: OrderedDict[int, tuple[RoadMap, DrivableField]] = OrderedDict()


def drivable_field(road_map: RoadMap) -> DrivableField:
    """The field of a map; the latest maps' fields are kept.

    Raises:
        DataError: the map has no drivable area.
    """
    key = id(road_map)
    if key not in _fields:
        _fields[key] = (road_map, _draw(road_map))
        while len(_fields) > _KEPT:
            _fields.popitem(last=False)
    _fields.move_to_end(key)
    return _fields[key][1]


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


def off_road_m(
    road_map: RoadMap,
    states: Float[np.ndarray, "*batch 4"],
    sizes: Float[np.ndarray, "*batch 2"],
) -> Float[np.ndarray, "*batch"]:
    """How far the outermost corner of each box lies outside the drivable area, metres."""
    return drivable_field(road_map).distance_m(box_corners(states, sizes)).max(axis=-1)
