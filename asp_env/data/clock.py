"""Ticks: an integer number of a recording's frames."""

import math

from asp_env.errors import AspEnvError

DEFAULT_DT_S = 0.2


def frames_per_tick(frame_rate_hz: float, dt_s: float = DEFAULT_DT_S) -> int:
    """How many frames one tick of `dt_s` spans.

    Raises:
        AspEnvError: `dt_s` is no whole number of frames; those near it that are get listed.
    """
    if not (math.isfinite(frame_rate_hz) and frame_rate_hz > 0):
        raise AspEnvError(f"frame rate {frame_rate_hz} Hz: expected a positive number")
    if not (math.isfinite(dt_s) and dt_s > 0):
        raise AspEnvError(f"time step {dt_s} s: expected a positive number")
    frames = dt_s * frame_rate_hz
    whole = round(frames)
    if whole < 1 or abs(frames - whole) > 1e-4 * frames:
        around = range(max(1, int(frames) - 1), int(frames) + 4)
        possible = ", ".join(f"{count / frame_rate_hz:.6g}" for count in around)
        raise AspEnvError(
            f"time step {dt_s:g} s does not divide recordings of {frame_rate_hz:g} Hz: "
            f"choose one of {possible}, … s"
        )
    return whole


def ticks(duration_s: float, dt_s: float) -> int:
    """How many ticks a duration spans.

    Raises:
        AspEnvError: the duration is no whole, positive number of ticks.
    """
    for what, value_s in (("time step", dt_s), ("duration", duration_s)):
        if not (math.isfinite(value_s) and value_s > 0):
            raise AspEnvError(f"{what} {value_s} s: expected a positive number")
    count = round(duration_s / dt_s)
    if count < 1 or abs(count * dt_s - duration_s) > 1e-6:
        raise AspEnvError(f"{duration_s:g} s is no whole number of ticks of {dt_s:g} s")
    return count
