"""Frames, boxes and paths: the only definitions, for arrays with any leading axes."""

import math
from types import ModuleType
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Shaped
from numba import njit


def namespace(array: object) -> ModuleType:
    """The module whose functions take `array`: torch for tensors, else NumPy."""
    if type(array).__module__.partition(".")[0] == "torch":
        import torch

        return torch
    return np


def wrap_angle(angle_rad: Any) -> Any:
    """The same angle in [-π, π); π itself only where rounding says so.

    One that lies there already stays as it is, bit for bit.
    """
    turns = namespace(angle_rad).floor((angle_rad + math.pi) / (2 * math.pi))
    return angle_rad - 2 * math.pi * turns


MIN_STEP_M = 0.5
"""A way takes no point nearer to its last one than this."""


def to_frame(
    points: Shaped[np.ndarray, "*batch 2"], poses: Shaped[np.ndarray, "*poses n"]
) -> Shaped[np.ndarray, "*out 2"]:
    """Points seen from poses [x, y, heading, …] that broadcast against them: x ahead, y left."""
    offset = points - poses[..., :2]
    cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    ahead = cos * offset[..., 0] + sin * offset[..., 1]
    left = cos * offset[..., 1] - sin * offset[..., 0]
    return np.stack([ahead, left], axis=-1)


def from_frame(
    points: Shaped[np.ndarray, "*batch 2"], poses: Shaped[np.ndarray, "*poses n"]
) -> Shaped[np.ndarray, "*out 2"]:
    """The inverse of `to_frame`."""
    cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    x = poses[..., 0] + cos * points[..., 0] - sin * points[..., 1]
    y = poses[..., 1] + sin * points[..., 0] + cos * points[..., 1]
    return np.stack([x, y], axis=-1)


def states_to_frame(
    states: Shaped[np.ndarray, "*batch 4"], poses: Shaped[np.ndarray, "*poses n"]
) -> Shaped[np.ndarray, "*out 4"]:
    """States [x, y, heading, speed] seen from poses: positions and headings turn, speeds stay."""
    heading = wrap_angle(states[..., 2] - poses[..., 2])
    speed = np.broadcast_to(states[..., 3], heading.shape)
    xy = to_frame(states[..., :2], poses)
    return np.concatenate([xy, heading[..., None], speed[..., None]], axis=-1)


def between_states(
    before: Shaped[np.ndarray, "*batch 4"], after: Shaped[np.ndarray, "*batch 4"], share: float
) -> Shaped[np.ndarray, "*batch 4"]:
    """States a share of the way from one to another; headings turn the shorter way."""
    step = after - before
    step[..., 2] = wrap_angle(step[..., 2])
    return before + share * step


def box_corners(
    states: Shaped[np.ndarray, "*batch n"], sizes: Shaped[np.ndarray, "*batch 2"]
) -> Shaped[np.ndarray, "*batch 4 2"]:
    """Corners of boxes (length, width) centred at states: front left, then clockwise."""
    signs = np.array([(0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5)], dtype=states.dtype)
    return from_frame(sizes[..., None, :] * signs, states[..., None, :])


def path_length(points: Shaped[np.ndarray, "*batch n 2"]) -> float | np.ndarray:
    """Length of a polyline, metres; points without motion add nothing."""
    return np.hypot(*np.moveaxis(np.diff(points, axis=-2), -1, 0)).sum(axis=-1, dtype=np.float64)


def resample(points: Float[np.ndarray, "n 2"], spacing_m: float) -> Float[np.ndarray, "m 2"]:
    """Points `spacing_m` apart along a polyline, the first at its start, none beyond its end."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    keep = np.concatenate([[True], steps > 1e-6])
    points, steps = points[keep], steps[steps > 1e-6]
    arc = np.concatenate([[0.0], np.cumsum(steps, dtype=np.float64)])
    at = np.arange(0.0, arc[-1] + 1e-9, spacing_m)
    columns = [np.interp(at, arc, points[:, axis]) for axis in (0, 1)]
    return np.stack(columns, axis=-1).astype(points.dtype)


def route_along(states: Float[np.ndarray, "n 4"], *, beyond_m: float) -> Float[np.ndarray, "m 2"]:
    """The way of a track: its positions 1 m apart, then straight on for `beyond_m`.

    Points are taken only where the vehicle got on, so that standing and jitter leave no trace.
    """
    kept = np.empty((len(states) + 1, 2), dtype=states.dtype)
    count = _moved_on(np.ascontiguousarray(states[:, :2]), MIN_STEP_M, kept)
    end = kept[count - 1]
    if count > 1:
        direction = (end - kept[count - 2]) / np.hypot(*(end - kept[count - 2]))
    else:
        direction = np.array([np.cos(states[-1, 2]), np.sin(states[-1, 2])])
    kept[count] = end + (beyond_m * direction).astype(states.dtype)
    return resample(kept[: count + 1], 1.0)


@njit(cache=True)
@no_type_check
def _moved_on(points, step_m, out):
    """Writes the first point and each that is a step away from the last one; how many there are."""
    out[0] = points[0]
    count = 1
    for i in range(1, len(points)):
        dx, dy = points[i, 0] - out[count - 1, 0], points[i, 1] - out[count - 1, 1]
        if math.hypot(dx, dy) >= step_m:
            out[count] = points[i]
            count += 1
    return count


@njit(cache=True)
@no_type_check
def project(route, count, x, y, near_m, reach_m):
    """(arc length, lateral offset, heading) of the nearest point of a route.

    Args:
        route: (p, 2) points, the first `count` of them valid.
        count: number of valid points, at least 2.
        x: of the point, metres.
        y: of the point, metres.
        near_m: arc length around which to look; negative to look everywhere.
        reach_m: how far around it, so that a route that crosses itself is not confused.
    """
    first, last = 0, count - 1
    if near_m >= 0.0:
        first = min(max(0, int(near_m - reach_m)), count - 2)
        last = min(count - 1, max(first + 1, int(near_m + reach_m) + 1))
    nearest, arc, offset_x, offset_y, nearest_x, nearest_y = np.inf, 0.0, 0.0, 0.0, 1.0, 0.0
    for i in range(first, last):
        ax, ay = route[i, 0], route[i, 1]
        sx, sy = route[i + 1, 0] - ax, route[i + 1, 1] - ay
        square = sx * sx + sy * sy
        if square < 1e-12:
            continue
        share = ((x - ax) * sx + (y - ay) * sy) / square
        if i > 0:  # both ends go on straight
            share = max(share, 0.0)
        if i < count - 2:
            share = min(share, 1.0)
        dx, dy = x - ax - share * sx, y - ay - share * sy
        distance = dx * dx + dy * dy
        if distance < nearest:
            nearest, arc = distance, i + share
            offset_x, offset_y, nearest_x, nearest_y = dx, dy, sx, sy
    side = nearest_x * offset_y - nearest_y * offset_x
    offset = math.copysign(math.hypot(offset_x, offset_y), side)
    return arc, offset, math.atan2(nearest_y, nearest_x)


@njit(cache=True, inline="always")
@no_type_check
def _separated(
    dx, dy, cos, sin, half_length, half_width, cos_o, sin_o, half_length_o, half_width_o
):
    """Whether an axis of the first box keeps the boxes apart; (dx, dy) leads to the second."""
    ahead = abs(cos * dx + sin * dy)
    left = abs(cos * dy - sin * dx)
    along = abs(cos * cos_o + sin * sin_o)
    across = abs(cos * sin_o - sin * cos_o)
    if ahead >= half_length + along * half_length_o + across * half_width_o:
        return True
    return left >= half_width + across * half_length_o + along * half_width_o


@njit(cache=True)
@no_type_check
def turned_overlaps(x, y, cos, sin, length, width, x_o, y_o, cos_o, sin_o, length_o, width_o):
    """`overlaps` of boxes whose headings are given by cosine and sine."""
    dx, dy = x_o - x, y_o - y
    half, wide, half_o, wide_o = 0.5 * length, 0.5 * width, 0.5 * length_o, 0.5 * width_o
    if _separated(dx, dy, cos, sin, half, wide, cos_o, sin_o, half_o, wide_o):
        return False
    return not _separated(-dx, -dy, cos_o, sin_o, half_o, wide_o, cos, sin, half, wide)


@njit(cache=True)
@no_type_check
def overlaps(x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o):
    """Whether two oriented boxes intersect (separating axis theorem); touching is no overlap."""
    dx, dy = x_o - x, y_o - y
    reach = 0.5 * (math.hypot(length, width) + math.hypot(length_o, width_o))
    if dx * dx + dy * dy >= reach * reach:
        return False
    c, s, co, so = math.cos(heading), math.sin(heading), math.cos(heading_o), math.sin(heading_o)
    return turned_overlaps(x, y, c, s, length, width, x_o, y_o, co, so, length_o, width_o)


@njit(cache=True)
@no_type_check
def _project_all(routes, counts, states, near, out):
    for b in range(len(routes)):
        out[b, 0], out[b, 1], out[b, 2] = project(
            routes[b], counts[b], states[b, 0], states[b, 1], near[b], 15.0
        )


def route_coordinates(
    routes: Float[np.ndarray, "b p 2"],
    valid: Bool[np.ndarray, "b p"],
    states: Float[np.ndarray, "b 4"],
    near_m: Float[np.ndarray, " b"],
) -> Float[np.ndarray, "b 3"]:
    """Arc length m, lateral offset m (left positive) and heading rad of each route's nearest point.

    The search stays within 15 m of `near_m` where that is not negative. Before its first and
    behind its last point a route goes on straight.
    """
    out = np.zeros((len(routes), 3), dtype=np.float64)
    _project_all(routes, valid.sum(axis=1), states, near_m, out)
    return out
