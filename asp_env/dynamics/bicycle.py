"""Kinematic bicycle model with the reference point at the centre of the vehicle's box.

A state is `[x, y, heading, speed]` in m, m, rad counter-clockwise from +x, and m/s signed along the
heading; an action is `[acceleration, steering]` in m/s² and rad, left positive. Both axles are 0.3
times the length from the centre. The equations are (bicycle) and (inv_bicycle) of Janjoš et al.
2021, with the missing time step restored and the slip angle's denominator read as l_f + l_r. All
functions take NumPy arrays or torch tensors, float32 or float64, with any leading batch axes.
"""

import math
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from asp_env.arguments import shown
from asp_env.errors import AspEnvError
from asp_env.geometry import namespace, wrap_angle

MAX_ACCELERATION_MPS2 = 5.0
"""Limit of accelerations in actions, in either direction, as in highway-env."""

MAX_STEERING_RAD = math.pi / 4
"""Limit of steering angles in actions, to either side, as in highway-env."""

Integrator = Literal["heun", "euler"]
"""Second order, or first order as in the paper and in highway-env."""

AXLE_SHARE_OF_LENGTH = 0.3
"""Distance from the centre of the box to each axle, as a share of the vehicle's length."""

MIN_STEERING_SPEED_MPS = 0.5
"""`inverse` returns no steering below this mean speed, since noise dominates changes of heading.
Chosen by hand."""

_MAX_SIN_SLIP = math.sin(math.atan(0.5 * math.tan(MAX_STEERING_RAD)))


def forward(
    states: Float[Any, "*batch 4"],
    actions: Float[Any, "*batch 2"],
    lengths_m: Float[Any, "*#batch"],
    dt_s: float,
    *,
    integrator: Integrator = "heun",
    reverse: bool = False,
) -> Float[Any, "*batch 4"]:
    """Advances states by one step.

    Args:
        states: present states.
        actions: actions, constant during the step.
        lengths_m: vehicle lengths, positive, broadcast against the states.
        dt_s: duration of the step.
        integrator: `heun` or `euler`.
        reverse: whether any speed may become negative; otherwise braking ends at speed 0, and a
            vehicle that drives backwards already goes on at its speed, brakes to 0 or drives on
            forwards, but gains no speed backwards.

    Returns:
        States after the step, with headings in [-π, π).
    """
    return _integrate(states, actions[..., None, :], lengths_m, dt_s, integrator, reverse)[
        ..., 0, :
    ]


def rollout(
    states: Float[Any, "*batch 4"],
    actions: Float[Any, "*batch steps 2"],
    lengths_m: Float[Any, "*#batch"],
    dt_s: float,
    *,
    integrator: Integrator = "heun",
    reverse: bool = False,
) -> Float[Any, "*batch steps 4"]:
    """Advances states by several steps, without a loop over them.

    The result equals repeated calls of `forward` up to rounding: the model is sequential only in
    cumulative sums (speed, then heading, then position) and in the running minimum that ends
    braking at speed 0.

    Args:
        states: present states.
        actions: actions of each step.
        lengths_m: as in `forward`.
        dt_s: as in `forward`.
        integrator: as in `forward`.
        reverse: as in `forward`.

    Returns:
        States after each step, with headings in [-π, π).
    """
    return _integrate(states, actions, lengths_m, dt_s, integrator, reverse)


def _integrate(
    states: Any, actions: Any, lengths_m: Any, dt_s: float, integrator: Integrator, reverse: bool
) -> Any:
    xp = namespace(states)
    rear_m = (AXLE_SHARE_OF_LENGTH * lengths_m)[..., None]
    slip = xp.arctan(0.5 * xp.tan(actions[..., 1]))
    speed_0 = states[..., 3:4]
    gained = actions[..., 0] * dt_s
    if reverse:
        speed_after = speed_0 + _running_sum(gained)
    else:
        speed_after = _speeds_without_reversal(speed_0, gained)
    speed_before = _before(speed_0, speed_after)

    turn = xp.sin(slip) / rear_m * dt_s  # heading change per unit of speed
    mean = speed_before if integrator == "euler" else 0.5 * (speed_before + speed_after)
    heading_0 = states[..., 2:3]
    heading_after = heading_0 + _running_sum(mean * turn)
    heading_before = _before(heading_0, heading_after)

    course = heading_before + slip
    velocity_x = speed_before * xp.cos(course)
    velocity_y = speed_before * xp.sin(course)
    share_s = dt_s
    if integrator == "heun":
        end_course = course + speed_before * turn
        velocity_x = velocity_x + speed_after * xp.cos(end_course)
        velocity_y = velocity_y + speed_after * xp.sin(end_course)
        share_s = 0.5 * dt_s
    x = states[..., 0:1] + _running_sum(velocity_x * share_s)
    y = states[..., 1:2] + _running_sum(velocity_y * share_s)
    return xp.stack([x, y, wrap_angle(heading_after), speed_after], axis=-1)


def _speeds_without_reversal(speed_0: Any, gained: Any) -> Any:
    """Speeds after each step if braking ends at 0 and no vehicle gains speed backwards.

    While a vehicle drives backwards only its positive gains count: v' = v + max(gain, 0). Once its
    speed is 0 or more, v' = max(v + gain, 0), which over all steps is the running sum less its
    running minimum below 0.

    Args:
        speed_0: (*batch, 1) speeds before the first step.
        gained: (*batch, steps) gains of speed of each step.
    """
    xp = namespace(speed_0)
    zero = xp.zeros_like(gained)
    # Tensors take the general way always: a branch on values would stop the device and the export.
    if xp is np and not (speed_0 < 0).any():
        speed_after = speed_0 + _running_sum(gained)
        return speed_after - _lowest_below_zero(speed_after)
    brakes_only = xp.where(gained > 0, gained, zero)
    backwards = _before(speed_0, speed_0 + _running_sum(brakes_only)) < 0
    speed_after = speed_0 + _running_sum(xp.where(backwards, brakes_only, gained))
    return speed_after - _lowest_below_zero(xp.where(backwards, zero, speed_after))


def _before(first: Any, after: Any) -> Any:
    """Values at the beginning of each step."""
    if after.shape[-1] == 1:
        return first
    return namespace(first).concatenate([first, after[..., :-1]], axis=-1)


def _running_sum(values: Any) -> Any:
    """Cumulative sum over the steps; the most frequent case, a single step, is a shortcut."""
    return values if values.shape[-1] == 1 else namespace(values).cumsum(values, axis=-1)


def _lowest_below_zero(values: Any) -> Any:
    """Running minimum of the values, at most 0."""
    xp = namespace(values)
    if xp is np:
        lowest = values if values.shape[-1] == 1 else np.minimum.accumulate(values, axis=-1)
        return np.minimum(lowest, 0.0)
    return xp.clamp(xp.cummin(values, dim=-1).values, max=0.0)


def inverse(
    states: Float[Any, "*batch 4"],
    next_states: Float[Any, "*batch 4"],
    lengths_m: Float[Any, "*#batch"],
    dt_s: float,
    *,
    integrator: Integrator = "heun",
) -> Float[Any, "*batch 2"]:
    """Infers the actions that lead from `states` to the headings and speeds of `next_states`.

    This inverts `forward` with the same integrator for steering within ±π/4, away from standstill.
    Positions are not used: the problem is overdetermined, and as in the paper headings and speeds
    decide. Below a mean speed of `MIN_STEERING_SPEED_MPS` the steering is 0; it is never NaN.

    Args:
        states: states before the step.
        next_states: states after the step.
        lengths_m: vehicle lengths, positive, broadcast against the states.
        dt_s: duration of the step.
        integrator: `heun` or `euler`.

    Returns:
        [acceleration m/s², steering rad]; the steering is limited to ±π/4, the acceleration is not.
    """
    xp = namespace(states)
    rear_m = AXLE_SHARE_OF_LENGTH * lengths_m
    speed, next_speed = states[..., 3], next_states[..., 3]
    acceleration = (next_speed - speed) / dt_s
    mean = speed if integrator == "euler" else 0.5 * (speed + next_speed)
    moves = xp.abs(mean) >= MIN_STEERING_SPEED_MPS
    safe_mean = xp.where(moves, mean, xp.ones_like(mean))
    turned = wrap_angle(next_states[..., 2] - states[..., 2])
    sin_slip = xp.clip(rear_m * turned / (safe_mean * dt_s), -_MAX_SIN_SLIP, _MAX_SIN_SLIP)
    steering = xp.arctan(2.0 * sin_slip / xp.sqrt(1.0 - sin_slip * sin_slip))
    return xp.stack([acceleration, xp.where(moves, steering, xp.zeros_like(steering))], axis=-1)


def clip_actions(actions: Float[Any, "*batch 2"]) -> Float[Any, "*batch 2"]:
    """Actions [acceleration m/s², steering rad], clipped to the limits of both."""
    xp = namespace(actions)
    acceleration = xp.clip(actions[..., 0], -MAX_ACCELERATION_MPS2, MAX_ACCELERATION_MPS2)
    steering = xp.clip(actions[..., 1], -MAX_STEERING_RAD, MAX_STEERING_RAD)
    return xp.stack([acceleration, steering], axis=-1)


_ACTION_LIMITS = (MAX_ACCELERATION_MPS2, MAX_STEERING_RAD)


def normalize_actions(actions: Float[Any, "*batch 2"]) -> Float[Any, "*batch 2"]:
    """Actions in the action space [-1, 1] of the environments, of the same type.

    Args:
        actions: [acceleration m/s², steering rad]. Actions beyond the limits are not clipped; the
            environments do that.
    """
    if namespace(actions) is np:
        actions = _action_array(actions)
        return (actions / np.array(_ACTION_LIMITS)).astype(actions.dtype)
    return actions / actions.new_tensor(_ACTION_LIMITS)


def denormalize_actions(actions: Float[Any, "*batch 2"]) -> Float[Any, "*batch 2"]:
    """Actions [acceleration m/s², steering rad]; the inverse of `normalize_actions`.

    Args:
        actions: in the action space [-1, 1] of the environments.
    """
    if namespace(actions) is np:
        actions = _action_array(actions)
        return actions * np.array(_ACTION_LIMITS, dtype=actions.dtype)
    return actions * actions.new_tensor(_ACTION_LIMITS)


def _action_array(actions: Any) -> Float[np.ndarray, "*batch 2"]:
    """The actions as an array of floats, which they mostly are already.

    Raises:
        AspEnvError: they are no numbers, or not two along the last axis.
    """
    is_array = isinstance(actions, np.ndarray) and actions.dtype.kind == "f"
    try:
        array = actions if is_array else np.asarray(actions, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape[-1:] != (2,):
        raise AspEnvError(
            f"actions {shown(actions)}: expected numbers (…, 2), acceleration and steering"
        )
    return array
