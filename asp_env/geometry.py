"""Angles, frames, boxes, polylines and routes: the one definition of each.

Functions for arrays take any leading axes; those without "array" in their arguments are compiled
kernels for scalars, which other compiled kernels call. A route is a polyline whose points are 1 m
apart, so that an arc length in metres is also an index.
"""

import math
from types import ModuleType
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Shaped

from asp_env.compiled import njit

MIN_STEP_M = 0.5
"""`route_along` skips positions nearer than this to the last point of the route, so that standing
and measurement noise leave no trace. Chosen by hand."""

SEARCH_REACH_M = 15.0
"""`route_coordinates` searches this far around the arc length that it is given: further than a
vehicle moves in a tick, and short enough to tell the branches of a route that crosses itself apart.
Chosen by hand."""


def namespace(array: object) -> ModuleType:
    """The module whose functions take `array`: torch for tensors, else NumPy."""
    if type(array).__module__.partition(".")[0] == "torch":
        import torch

        return torch
    return np


def wrap_angle(angle_rad: Any) -> Any:
    """The equivalent angles in [-π, π), rad; rounding may give π itself.

    Angles within that range are returned unchanged, bit for bit.

    Args:
        angle_rad: a number, an array or a tensor of any shape.
    """
    turns = namespace(angle_rad).floor((angle_rad + math.pi) / (2 * math.pi))
    return angle_rad - 2 * math.pi * turns


@njit(cache=True)
@no_type_check
def wrap_scalar(angle_rad):
    """The equivalent angle in [-π, π), rad, of one number; rounding may change the last bit."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


def to_frame(
    points: Shaped[Any, "*batch 2"], poses: Shaped[Any, "*poses n"]
) -> Shaped[Any, "*out 2"]:
    """Points in the frames of poses: x ahead, y to the left.

    Args:
        points: NumPy array or tensor of points, m.
        poses: [x m, y m, heading rad, …], broadcast against the points.

    Returns:
        [ahead, left] of each point, m.
    """
    xp = namespace(points)
    offset = points - poses[..., :2]
    cos, sin = xp.cos(poses[..., 2]), xp.sin(poses[..., 2])
    ahead = cos * offset[..., 0] + sin * offset[..., 1]
    left = cos * offset[..., 1] - sin * offset[..., 0]
    return xp.stack([ahead, left], axis=-1)


def from_frame(
    points: Shaped[np.ndarray, "*batch 2"], poses: Shaped[np.ndarray, "*poses n"]
) -> Shaped[np.ndarray, "*out 2"]:
    """The inverse of `to_frame`, for NumPy arrays."""
    cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    x = poses[..., 0] + cos * points[..., 0] - sin * points[..., 1]
    y = poses[..., 1] + sin * points[..., 0] + cos * points[..., 1]
    return np.stack([x, y], axis=-1)


def states_to_frame(
    states: Shaped[np.ndarray, "*batch 4"], poses: Shaped[np.ndarray, "*poses n"]
) -> Shaped[np.ndarray, "*out 4"]:
    """States [x, y, heading, speed] in the frames of poses; speeds do not change."""
    heading = wrap_angle(states[..., 2] - poses[..., 2])
    speed = np.broadcast_to(states[..., 3], heading.shape)
    xy = to_frame(states[..., :2], poses)
    return np.concatenate([xy, heading[..., None], speed[..., None]], axis=-1)


def between_states(
    before: Shaped[np.ndarray, "*batch 4"], after: Shaped[np.ndarray, "*batch 4"], share: float
) -> Shaped[np.ndarray, "*batch 4"]:
    """Linear interpolation between states; headings turn through the smaller angle.

    Args:
        before: states [x, y, heading, speed] at share 0.
        after: states at share 1.
        share: position between both, 0 to 1.
    """
    step = after - before
    step[..., 2] = wrap_angle(step[..., 2])
    return before + share * step


def box_corners(
    states: Shaped[np.ndarray, "*batch n"], sizes: Shaped[np.ndarray, "*batch 2"]
) -> Shaped[np.ndarray, "*batch 4 2"]:
    """Corners of oriented boxes, m: front left first, then clockwise.

    Args:
        states: [x m, y m, heading rad, …] of the centres.
        sizes: length and width, m.
    """
    signs = np.array([(0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5)], dtype=states.dtype)
    return from_frame(sizes[..., None, :] * signs, states[..., None, :])


@njit(cache=True, inline="always")
@no_type_check
def _separated(
    dx, dy, cos, sin, half_length, half_width, cos_o, sin_o, half_length_o, half_width_o
):
    """Whether an axis of the first box separates the boxes; (dx, dy) leads to the second centre."""
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
    """`overlaps` of boxes whose headings are given by their cosine and sine."""
    dx, dy = x_o - x, y_o - y
    half, wide, half_o, wide_o = 0.5 * length, 0.5 * width, 0.5 * length_o, 0.5 * width_o
    if _separated(dx, dy, cos, sin, half, wide, cos_o, sin_o, half_o, wide_o):
        return False
    return not _separated(-dx, -dy, cos_o, sin_o, half_o, wide_o, cos, sin, half, wide)


@njit(cache=True)
@no_type_check
def overlaps(x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o):
    """Whether two oriented boxes intersect (separating axis theorem); touching is no overlap.

    Args:
        x: of the first box's centre, m.
        y: of the first box's centre, m.
        heading: of the first box, rad.
        length: of the first box along its heading, m.
        width: of the first box, m.
        x_o: of the second box's centre, m; the remaining arguments correspond.
        y_o: see `y`.
        heading_o: see `heading`.
        length_o: see `length`.
        width_o: see `width`.
    """
    dx, dy = x_o - x, y_o - y
    reach = 0.5 * (math.hypot(length, width) + math.hypot(length_o, width_o))
    if dx * dx + dy * dy >= reach * reach:
        return False
    c, s, co, so = math.cos(heading), math.sin(heading), math.cos(heading_o), math.sin(heading_o)
    return turned_overlaps(x, y, c, s, length, width, x_o, y_o, co, so, length_o, width_o)


@njit(cache=True)
@no_type_check
def _overlap_pairs(boxes, other_boxes, out):
    for i in range(len(out)):
        x, y, heading, length, width = boxes[i]
        x_o, y_o, heading_o, length_o, width_o = other_boxes[i]
        out[i] = overlaps(x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o)


def boxes_overlap(
    boxes: Float[np.ndarray, "n 5"], other_boxes: Float[np.ndarray, "n 5"]
) -> Bool[np.ndarray, " n"]:
    """Whether box i of one array overlaps box i of the other; touching is no overlap.

    Args:
        boxes: rows [x m, y m, heading rad, length m, width m].
        other_boxes: rows alike.
    """
    out = np.zeros(len(boxes), dtype=bool)
    _overlap_pairs(boxes, other_boxes, out)
    return out


def path_length(points: Shaped[np.ndarray, "*batch n 2"]) -> float | np.ndarray:
    """Lengths of polylines, m; repeated points add nothing."""
    return np.hypot(*np.moveaxis(np.diff(points, axis=-2), -1, 0)).sum(axis=-1, dtype=np.float64)


def arc_lengths(line: Shaped[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Distance of every point of a polyline from its first point, along the polyline, m."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps, dtype=np.float64)])


def points_at(
    line: Shaped[np.ndarray, "n 2"], arc_m: Float[np.ndarray, " n"], at_m: Float[np.ndarray, "*at"]
) -> Float[np.ndarray, "*at 2"]:
    """Points of a polyline at given arc lengths; beyond its ends they are the end points.

    Args:
        line: the points of the polyline, m.
        arc_m: arc length of each of them, increasing (`arc_lengths`).
        at_m: arc lengths of the points to interpolate.
    """
    return np.stack([np.interp(at_m, arc_m, line[:, axis]) for axis in (0, 1)], axis=-1)


def resample(points: Float[np.ndarray, "n 2"], spacing_m: float) -> Float[np.ndarray, "m 2"]:
    """Points `spacing_m` apart along a polyline, from its first point on, none beyond its end."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    moves = steps > 1e-6
    points, steps = points[np.concatenate([[True], moves])], steps[moves]
    arc_m = np.concatenate([[0.0], np.cumsum(steps, dtype=np.float64)])
    at_m = np.arange(0.0, arc_m[-1] + 1e-9, spacing_m)
    return points_at(points, arc_m, at_m).astype(points.dtype)


def route_along(states: Float[np.ndarray, "n 4"], *, beyond_m: float) -> Float[np.ndarray, "m 2"]:
    """The route of a track: its positions 1 m apart, then straight on for `beyond_m`.

    Args:
        states: [x m, y m, heading rad, speed m/s] of the track. Positions within `MIN_STEP_M` of
            the last one that was taken are skipped; a track without motion goes straight ahead.
        beyond_m: length of the straight extension behind the last position, m.
    """
    route = np.empty((len(states) + 1, 2), dtype=states.dtype)
    count = _skip_short_steps(np.ascontiguousarray(states[:, :2]), MIN_STEP_M, route)
    end = route[count - 1]
    if count > 1:
        direction = (end - route[count - 2]) / np.hypot(*(end - route[count - 2]))
    else:
        direction = np.array([np.cos(states[-1, 2]), np.sin(states[-1, 2])])
    route[count] = end + (beyond_m * direction).astype(states.dtype)
    return resample(route[: count + 1], 1.0)


@njit(cache=True)
@no_type_check
def _skip_short_steps(points, step_m, out):
    """Copies the points (n, 2) at least `step_m` from the last one copied; returns their number."""
    # Rows are copied number by number: assigning a row takes 2 s longer to compile.
    out[0, 0], out[0, 1] = points[0, 0], points[0, 1]
    count = 1
    for i in range(1, len(points)):
        dx, dy = points[i, 0] - out[count - 1, 0], points[i, 1] - out[count - 1, 1]
        if math.hypot(dx, dy) >= step_m:
            out[count, 0], out[count, 1] = points[i, 0], points[i, 1]
            count += 1
    return count


@njit(cache=True)
@no_type_check
def project(route, count, x, y, near_m, reach_m):
    """Projects a point onto a route, which continues straight beyond both of its ends.

    Args:
        route: (points, ≥ 2) points 1 m apart, of which the first `count` are valid.
        count: number of valid points, at least 2.
        x: of the point, m.
        y: of the point, m.
        near_m: arc length around which the nearest point is searched; negative for everywhere.
        reach_m: how far around `near_m`, to tell the branches of a self-crossing route apart.

    Returns:
        Arc length m, lateral offset m (left positive) and heading rad of the nearest point.
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
        if i > 0:  # the route continues straight at both ends
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


@njit(cache=True)
@no_type_check
def point_on_route(route, count, arc_m, left_m):
    """The inverse of `project`: the point at an arc length, `left_m` to the left of the route.

    Args:
        route: (points, ≥ 2) points 1 m apart, of which the first `count` are valid.
        count: number of valid points, at least 2.
        arc_m: arc length; below 0 and beyond the end the route continues straight.
        left_m: lateral offset, m, left positive.

    Returns:
        x m, y m, and the vector (dx, dy) m of the route's segment there.
    """
    i = max(0, min(int(arc_m), count - 2))
    dx, dy = route[i + 1, 0] - route[i, 0], route[i + 1, 1] - route[i, 1]
    norm = max(math.hypot(dx, dy), 1e-6)
    x = route[i, 0] + (arc_m - i) * dx - left_m * dy / norm
    y = route[i, 1] + (arc_m - i) * dy + left_m * dx / norm
    return x, y, dx, dy


@njit(cache=True)
@no_type_check
def _project_all(routes, counts, states, near_m, out):
    for b in range(len(routes)):
        out[b, 0], out[b, 1], out[b, 2] = project(
            routes[b], counts[b], states[b, 0], states[b, 1], near_m[b], SEARCH_REACH_M
        )


def route_coordinates(
    routes: Float[np.ndarray, "b p 2"],
    valid: Bool[np.ndarray, "b p"],
    states: Float[np.ndarray, "b 4"],
    near_m: Float[np.ndarray, " b"],
) -> Float[np.ndarray, "b 3"]:
    """Projects one state onto each route; routes continue straight beyond both of their ends.

    Args:
        routes: points 1 m apart.
        valid: which points exist; valid ones come first.
        states: [x m, y m, heading rad, speed m/s].
        near_m: arc length around which to search, within `SEARCH_REACH_M`; negative for everywhere.

    Returns:
        Arc length m, lateral offset m (left positive) and heading rad of each nearest point.
    """
    out = np.zeros((len(routes), 3), dtype=np.float64)
    _project_all(routes, valid.sum(axis=1), states, near_m, out)
    return out
