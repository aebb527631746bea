"""From highway-env's axes to ours and back: x is the same, y points down there and up here.

Each function is its own inverse.
"""

import numpy as np
from jaxtyping import Float

from asp_env.dynamics import wrap_angle


def mirror_points(points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Points, or velocities, in the other axes: y changes its sign."""
    return points * np.array([1.0, -1.0], dtype=points.dtype)


def mirror_states(states: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """States [x, y, heading, speed]: y and heading change their signs.

    Headings come out in [-π, π). There is no +π, so that -π stays what it is.
    """
    mirrored = states * np.array([1.0, -1.0, -1.0, 1.0], dtype=states.dtype)
    mirrored[..., 2] = wrap_angle(mirrored[..., 2])
    return mirrored


def mirror_actions(actions: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Actions [acceleration, steering]: what steers to the left here does to the right there."""
    return actions * np.array([1.0, -1.0], dtype=actions.dtype)
