"""Frames, boxes and paths: the only definitions, for arrays with any leading axes."""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Shaped
from numba import njit

from asp_env.dynamics import wrap_angle


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
    kept = states[_got_on(np.array(states[:, :2])), :2]
    end = kept[-1]
    if len(kept) > 1:
        direction = (kept[-1] - kept[-2]) / np.hypot(*(kept[-1] - kept[-2]))
    else:
        direction = np.array([np.cos(states[-1, 2]), np.sin(states[-1, 2])])
    beyond = end + (beyond_m * direction).astype(states.dtype)
    return resample(np.concatenate([kept, beyond[None]]), 1.0)


@njit(cache=True)
@no_type_check
def _got_on(points):
    """(n,) the first point, and each that lies 0.5 m or more from the last one before it."""
    keep = np.zeros(len(points), dtype=np.bool_)
    keep[0] = True
    last = 0
    for i in range(1, len(points)):
        if math.hypot(points[i, 0] - points[last, 0], points[i, 1] - points[last, 1]) >= 0.5:
            keep[i] = True
            last = i
    return keep


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
    best, arc, side, at = np.inf, 0.0, 0.0, -1
    for i in range(first, last):
        ax, ay = route[i, 0], route[i, 1]
        sx, sy = route[i + 1, 0] - ax, route[i + 1, 1] - ay
        squared = sx * sx + sy * sy
        if squared < 1e-12:
            continue
        share = ((x - ax) * sx + (y - ay) * sy) / squared
        low = -np.inf if i == 0 else 0.0  # both ends go on straight
        high = np.inf if i == count - 2 else 1.0
        share = min(max(share, low), high)
        dx, dy = x - ax - share * sx, y - ay - share * sy
        distance = dx * dx + dy * dy
        if distance < best:
            best, arc, side, at = distance, i + share, sx * dy - sy * dx, i
    if at < 0:
        return 0.0, 0.0, 0.0
    heading = math.atan2(route[at + 1, 1] - route[at, 1], route[at + 1, 0] - route[at, 0])
    return arc, math.copysign(math.sqrt(best), side), heading
