"""Where a point lies along a route whose points are 1 m apart, compiled."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from asp_env.data.geometry import project


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
