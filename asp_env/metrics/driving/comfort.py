"""nuPlan's comfort bounds on the motion of one vehicle, from its states at the ticks."""

import numpy as np
from jaxtyping import Bool, Float

from asp_env.metrics.masked import Masked

BOUNDS = {
    "longitudinal acceleration m/s²": (-4.05, 2.40),
    "lateral acceleration m/s²": (-4.89, 4.89),
    "yaw rate rad/s": (-0.95, 0.95),
    "yaw acceleration rad/s²": (-1.93, 1.93),
    "longitudinal jerk m/s³": (-4.13, 4.13),
    "jerk m/s³": (0.0, 8.37),
}
"""nuPlan's lowest and highest value of each quantity."""

WINDOW_S = 1.0
"""Derivatives are slopes of a parabola fitted over the ticks within this time."""

LEAST_TICKS = 5
"""The window has at least so many ticks, so that it smooths where ticks are over 0.25 s."""


def window_ticks(dt_s: float) -> int:
    """How many ticks the window has: odd, no more than 1 s from first to last, at least 5."""
    # a little more than half the window, so that rounding takes no tick away
    return max(2 * int(0.5 * WINDOW_S / dt_s + 1e-6) + 1, LEAST_TICKS)


def slope(values: Float[np.ndarray, "*batch t"], dt_s: float) -> Float[np.ndarray, "*batch t"]:
    """Derivative by a least-squares parabola over a sliding window; at the ends, that window's.

    A Savitzky-Golay filter as nuPlan uses; exact for parabolas. Needs `window_ticks` ticks.
    """
    ticks = window_ticks(dt_s)
    half = ticks // 2
    offsets = np.arange(ticks) - half
    powers = np.vander(offsets * dt_s, 3, increasing=True)
    fit = np.linalg.pinv(powers)  # (3, window): constant, slope, curvature / 2 at the middle
    windows = np.lib.stride_tricks.sliding_window_view(values, ticks, axis=-1)
    _, linear, square = np.moveaxis(windows @ fit.T, -1, 0)
    lead = offsets[:half] * dt_s
    head = linear[..., :1] + 2 * square[..., :1] * lead
    tail = linear[..., -1:] - 2 * square[..., -1:] * lead[::-1]
    return np.concatenate([head, linear, tail], axis=-1)


def comfort_signals(states: Float[np.ndarray, "*batch t 4"], dt_s: float) -> dict[str, np.ndarray]:
    """What is bounded, (*batch, t) by the names of `BOUNDS`. Needs `window_ticks` ticks."""
    heading = np.unwrap(states[..., 2].astype(np.float64), axis=-1)
    speed = states[..., 3].astype(np.float64)
    yaw_rate = slope(heading, dt_s)
    longitudinal, lateral = slope(speed, dt_s), speed * yaw_rate
    jerk = slope(longitudinal, dt_s)
    values = (
        *(longitudinal, lateral, yaw_rate, slope(yaw_rate, dt_s)),
        *(jerk, np.hypot(jerk, slope(lateral, dt_s))),
    )
    return dict(zip(BOUNDS, values, strict=True))


def comfortable(
    states: Float[np.ndarray, "*batch t 4"], dt_s: float, long_enough: Bool[np.ndarray, "*batch"]
) -> Masked:
    """1 where every bound holds at every tick, else 0; invalid for motions under one window."""
    if states.shape[-2] < window_ticks(dt_s):
        return Masked(
            value=np.zeros(states.shape[:-2]), valid=np.zeros(states.shape[:-2], dtype=bool)
        )
    fine = np.ones(states.shape[:-1], dtype=bool)
    for name, value in comfort_signals(states, dt_s).items():
        low, high = BOUNDS[name]
        fine &= (value >= low) & (value <= high)
    return Masked(value=np.asarray(fine.all(axis=-1), dtype=np.float64), valid=long_enough)
