"""Where a point lies along a route whose points are 1 m apart, compiled."""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import njit


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
