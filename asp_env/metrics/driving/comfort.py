"""nuPlan's comfort bounds on the motion of a vehicle, from its states at consecutive ticks."""

from collections.abc import Mapping

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
"""Lowest and highest comfortable value of each signal (nuPlan)."""

WINDOW_S = 1.0
"""Duration of the window over which a parabola is fitted for each derivative. Chosen by hand."""

MIN_WINDOW_TICKS = 5
"""Minimum length of the window, which smooths at ticks over 0.25 s as well. Chosen by hand."""


def window_ticks(dt_s: float) -> int:
    """Number of ticks in the window: odd, at most 1 s from first to last, at least 5.

    Args:
        dt_s: seconds per tick.
    """
    # half the window and a little more, so that rounding removes no tick
    return max(2 * int(0.5 * WINDOW_S / dt_s + 1e-6) + 1, MIN_WINDOW_TICKS)


def slope(values: Float[np.ndarray, "*batch t"], dt_s: float) -> Float[np.ndarray, "*batch t"]:
    """Derivative by a least-squares parabola over a sliding window.

    This is a Savitzky-Golay filter, as nuPlan uses it, and exact for parabolas. The values at both
    ends are those of the first and the last window.

    Args:
        values: at least `window_ticks` ticks.
        dt_s: seconds per tick.

    Returns:
        The derivative per second at every tick.
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
    """The signals that are bounded, by the names of `BOUNDS`.

    Args:
        states: [x m, y m, heading rad, speed m/s] at at least `window_ticks` ticks.
        dt_s: seconds per tick.

    Returns:
        (*batch, t) for each name.
    """
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


def within_bounds(signals: Mapping[str, Float[np.ndarray, "*shape"]]) -> Bool[np.ndarray, "*shape"]:
    """Where every signal is within its bounds.

    Args:
        signals: `comfort_signals`.
    """
    inside = [(v >= BOUNDS[name][0]) & (v <= BOUNDS[name][1]) for name, v in signals.items()]
    return np.logical_and.reduce(inside)


def share_of_bounds(
    signals: Mapping[str, Float[np.ndarray, "*shape"]],
) -> Float[np.ndarray, "*shape"]:
    """The largest of the signals as shares of their bounds: 1 at a bound, 0 without any motion.

    Args:
        signals: `comfort_signals`.
    """
    shares = []
    for name, value in signals.items():
        low, high = BOUNDS[name]
        shares.append(np.where(value < 0, value / (low or -high), value / high))
    return np.maximum.reduce(shares)


def comfortable(
    states: Float[np.ndarray, "*batch t 4"], dt_s: float, long_enough: Bool[np.ndarray, "*batch"]
) -> Masked:
    """1 if every bound holds at every tick, else 0.

    Args:
        states: [x m, y m, heading rad, speed m/s].
        dt_s: seconds per tick.
        long_enough: mask of the result; all are invalid for fewer than `window_ticks` ticks.
    """
    if states.shape[-2] < window_ticks(dt_s):
        return Masked(
            value=np.zeros(states.shape[:-2]), valid=np.zeros(states.shape[:-2], dtype=bool)
        )
    within = within_bounds(comfort_signals(states, dt_s))
    return Masked(value=np.asarray(within.all(axis=-1), dtype=np.float64), valid=long_enough)
