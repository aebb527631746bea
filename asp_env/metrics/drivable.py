"""Distances to the drivable area, looked up in a distance field that is drawn once per map."""

import math
from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.compiled import njit
from asp_env.data.bounded_cache import MapCache
from asp_env.data.road_map import RoadMap
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

TILE_CELLS = 16
"""Rows and columns of a tile, a power of two. Chosen by hand, by the memory of fields."""

FIELDS_BYTES = 384 * 2**20
"""Memory of the cached fields. Those of a roundabout have 2.6 MiB and take 30 ms; episodes side by
side on more maps than fit make fields anew at every tick. Chosen by hand: about 140 roundabouts."""

SIGNED_FIELDS_BYTES = 128 * 2**20
"""Memory of the cached signed fields, which only measures of realism use. Chosen by hand: about 30
roundabouts."""

_SUBPIXEL_BITS = 8
_TILE_BITS = TILE_CELLS.bit_length() - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivableField:
    """Distance to the drivable area on a grid, `MARGIN_M` outside the grid.

    The grid covers the drivable area, or the part of it in the map's region. It consists of square
    tiles; all tiles of one and the same value, far outside or inside, are stored once.
    """

    tiles: Float[np.ndarray, "tiles cells cells"]
    """Metres: 0 inside the drivable area, at most `MARGIN_M`; negative inside for a signed
    field."""
    tile_of: Int[np.ndarray, "tile_rows tile_columns"]
    """Index into `tiles` of each square of the grid."""
    origin_m: tuple[float, float]
    """Centre of cell (0, 0); rows increase along +y, columns along +x."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        rows, columns = self.tile_of.shape
        return (rows * TILE_CELLS, columns * TILE_CELLS)

    def drivable_m2(self) -> float:
        """The drivable area in the grid, square metres."""
        inside = (self.tiles <= 0).sum(axis=(1, 2))
        return float(inside[self.tile_of].sum()) * CELL_M**2

    def distance_m(self, points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        """Distance of points to the drivable area, metres, accurate to about one cell.

        Args:
            points: x and y, metres.
        """
        flat = np.ascontiguousarray(points.reshape(-1, 2))
        out = np.empty(len(flat), dtype=np.float32)
        _look_up(self.tiles, self.tile_of, self.origin_m[0], self.origin_m[1], flat, out)
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
        x_m, y_m = self.origin_m
        _write_outermost(self.tiles, self.tile_of, x_m, y_m, states, sizes, chosen, out)


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
    return _tiled(_outside_m(image), origin_m)


def _make_signed_field(road_map: RoadMap) -> DrivableField:
    image, origin_m = _draw_area(road_map)
    inside = cv2.distanceTransform(255 - image, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
    return _tiled((_outside_m(image) - inside).astype(np.float32), origin_m)


def _outside_m(image: np.ndarray) -> np.ndarray:
    """Distance (rows, columns) to the drivable area that `_draw_area` drew, metres."""
    outside = cv2.distanceTransform(image, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
    return np.minimum(outside, MARGIN_M).astype(np.float32)


def _tiled(grid: np.ndarray, origin_m: tuple[float, float]) -> DrivableField:
    """The field of a grid (rows, columns) float32 of distances."""
    rows, columns = (-(-count // TILE_CELLS) for count in grid.shape)
    whole = np.full((rows * TILE_CELLS, columns * TILE_CELLS), MARGIN_M, dtype=np.float32)
    whole[: grid.shape[0], : grid.shape[1]] = grid
    squares = whole.reshape(rows, TILE_CELLS, columns, TILE_CELLS).swapaxes(1, 2)
    low, high = squares.min(axis=(2, 3)), squares.max(axis=(2, 3))
    values, tile_of = np.unique(low, return_inverse=True)
    mixed = low != high
    tile_of = np.where(mixed, len(values) - 1 + np.cumsum(mixed).reshape(mixed.shape), tile_of)
    stored = [np.full((TILE_CELLS, TILE_CELLS), value, dtype=np.float32) for value in values]
    return DrivableField(
        tiles=np.concatenate([np.stack(stored), squares[mixed]]),
        tile_of=tile_of.astype(np.int32),
        origin_m=origin_m,
    )


_fields = MapCache(_make_field, FIELDS_BYTES)
_signed_fields = MapCache(_make_signed_field, SIGNED_FIELDS_BYTES)


@njit(cache=True, inline="always")
@no_type_check
def _distance_at(tiles, tile_of, x_0, y_0, x, y):
    """The value of the cell at (x, y), metres; the first cell is centred at x_0, y_0."""
    column = math.floor((x - x_0) / CELL_M + 0.5)
    row = math.floor((y - y_0) / CELL_M + 0.5)
    tile_row, tile_column = row >> _TILE_BITS, column >> _TILE_BITS
    if 0 <= tile_row < tile_of.shape[0] and 0 <= tile_column < tile_of.shape[1]:
        tile = tile_of[tile_row, tile_column]
        return tiles[tile, row & (TILE_CELLS - 1), column & (TILE_CELLS - 1)]
    return np.float32(MARGIN_M)


@njit(cache=True)
@no_type_check
def _look_up(tiles, tile_of, x_0, y_0, points, out):
    """Writes the distance of points (n, 2) to `out` (n,)."""
    for i in range(len(points)):
        out[i] = _distance_at(tiles, tile_of, x_0, y_0, points[i, 0], points[i, 1])


@njit(cache=True)
@no_type_check
def _write_outermost(tiles, tile_of, x_0, y_0, states, sizes, chosen, out):
    """Writes the distance of the outermost corner of each chosen box.

    Args:
        tiles: (tiles, cells, cells) float32, metres.
        tile_of: (tile rows, tile columns), indices into `tiles`.
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
            _distance_at(tiles, tile_of, x_0, y_0, x + ahead_x + left_x, y + ahead_y + left_y),
            _distance_at(tiles, tile_of, x_0, y_0, x + ahead_x - left_x, y + ahead_y - left_y),
        )
        rear = max(
            _distance_at(tiles, tile_of, x_0, y_0, x - ahead_x + left_x, y - ahead_y + left_y),
            _distance_at(tiles, tile_of, x_0, y_0, x - ahead_x - left_x, y - ahead_y - left_y),
        )
        out[i] = max(front, rear)
