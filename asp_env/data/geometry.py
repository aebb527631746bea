"""Frames, boxes and paths: the only definitions, for arrays with any leading axes."""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Shaped
from numba import njit

from asp_env.dynamics import wrap_angle

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
