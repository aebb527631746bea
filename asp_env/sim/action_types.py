"""Action types: what the two numbers of an action in [-1, 1] mean.

| type | first number | second number |
|---|---|---|
| `direct` | acceleration, ±5 m/s² | steering, ±π/4 |
| `jerk` | change of the acceleration, ±2 m/s² per tick of 0.2 s (±10 m/s³) | change of the \
steering, ±0.2 rad per tick of 0.2 s (±1 rad/s) |
| `route` | acceleration, ±5 m/s² | correction, ±0.15 rad, of the steering along the route |

The ego's last action, to which `jerk` adds, is inferred from its states; so no type has a memory.
The steering that follows the route is pure pursuit (`asp_env.dynamics.car_following`). Commanded
accelerations and steering angles are limited as in `direct`.
"""

from typing import Literal, get_args, no_type_check

import numpy as np
from jaxtyping import Bool, Float

from asp_env.compiled import njit
from asp_env.dynamics import (
    MAX_ACCELERATION_MPS2,
    clip_actions,
    denormalize_actions,
    normalize_actions,
)
from asp_env.dynamics.car_following import pursuit_steering
from asp_env.errors import unknown_name

ActionType = Literal["direct", "jerk", "route"]

ACTION_TYPES: tuple[str, ...] = get_args(ActionType)

MAX_JERK_MPS3 = 10.0
"""Largest jerk of the type `jerk`. Chosen by hand: full braking after half a second."""

MAX_STEERING_RATE_RADPS = 1.0
"""Largest steering rate of the type `jerk`. Chosen by hand."""

MAX_CORRECTION_RAD = 0.15
"""Largest correction of the type `route`. Chosen by hand: half a lane beside the route after 2 s
at 5 m/s."""


def check_action_type(name: str) -> None:
    """Checks the name of an action type.

    Raises:
        AspEnvError: the name is unknown.
    """
    if name not in ACTION_TYPES:
        raise unknown_name("action type", name, ACTION_TYPES)


def to_physical(
    kind: str,
    actions: Float[np.ndarray, "b 2"],
    last: Float[np.ndarray, "b 2"],
    following_rad: Float[np.ndarray, " b"],
    dt_s: float,
) -> Float[np.ndarray, "b 2"]:
    """Converts actions of a type to accelerations and steering angles.

    Args:
        kind: one of `ACTION_TYPES`.
        actions: actions in [-1, 1].
        last: [acceleration m/s², steering rad] of the egos in the last tick; read by `jerk`.
        following_rad: steering that follows the route; read by `route`.
        dt_s: length of a tick.

    Returns:
        [acceleration m/s², steering rad] within the limits of actions, float32.
    """
    if kind == "direct":
        return denormalize_actions(actions)
    if kind == "jerk":
        rates = np.array([MAX_JERK_MPS3, MAX_STEERING_RATE_RADPS]) * dt_s
        physical = clip_actions(last) + actions * rates
    else:
        steering = following_rad + MAX_CORRECTION_RAD * actions[:, 1]
        physical = np.stack([MAX_ACCELERATION_MPS2 * actions[:, 0], steering], axis=1)
    return clip_actions(physical).astype(np.float32)


def from_physical(
    kind: str,
    physical: Float[np.ndarray, "b 2"],
    last: Float[np.ndarray, "b 2"],
    following_rad: Float[np.ndarray, " b"],
    dt_s: float,
) -> Float[np.ndarray, "b 2"]:
    """Converts accelerations and steering angles to actions of a type: inverts `to_physical`.

    Args:
        kind: one of `ACTION_TYPES`.
        physical: [acceleration m/s², steering rad].
        last: as in `to_physical`, like the following arguments.
        following_rad: steering that follows the route.
        dt_s: length of a tick.

    Returns:
        Actions, float32; beyond [-1, 1] where the type cannot command the physical action.
    """
    if kind == "direct":
        actions = normalize_actions(physical)
    elif kind == "jerk":
        rates = np.array([MAX_JERK_MPS3, MAX_STEERING_RATE_RADPS]) * dt_s
        actions = (physical - clip_actions(last)) / rates
    else:
        correction = (physical[:, 1] - following_rad) / MAX_CORRECTION_RAD
        actions = np.stack([physical[:, 0] / MAX_ACCELERATION_MPS2, correction], axis=1)
    return np.asarray(actions, dtype=np.float32)


def following_steering(
    states: Float[np.ndarray, "b 4"],
    lengths_m: Float[np.ndarray, " b"],
    routes: Float[np.ndarray, "b p 2"],
    route_valid: Bool[np.ndarray, "b p"],
    arcs_m: Float[np.ndarray, " b"],
) -> Float[np.ndarray, " b"]:
    """Steering angles that follow the routes, by pure pursuit, rad.

    Args:
        states: [x m, y m, heading rad, speed m/s] of the egos.
        lengths_m: of the egos.
        routes: x m, y m of points 1 m apart.
        route_valid: which points exist; these come first.
        arcs_m: arc length of each ego along its route.
    """
    steering = np.zeros(len(states))
    _follow(
        states.astype(np.float64),
        lengths_m.astype(np.float64),
        np.ascontiguousarray(routes),
        route_valid.sum(axis=1),
        arcs_m.astype(np.float64),
        steering,
    )
    return steering


@njit(cache=True)
@no_type_check
def _follow(states, lengths, routes, counts, arcs, out):
    """The kernel of `following_steering`; `out` is (B,) rad, and 0 for routes of one point."""
    for b in range(len(out)):
        if counts[b] >= 2:
            x, y, heading, speed = states[b]
            out[b] = pursuit_steering(
                x, y, heading, speed, lengths[b], routes[b], counts[b], arcs[b], 0.0
            )
