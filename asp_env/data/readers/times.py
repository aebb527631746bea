"""From the times of rows to frames and their rate."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from asp_env.errors import DataError

LOWEST_HZ = 1.0
HIGHEST_HZ = 250.0

ROUNDING_MS = 1.0
"""Times may be off by this, since they are whole milliseconds."""

JITTER = 0.1
"""And by this share of a frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """The frame of each row, and how fast they follow one another."""

    frames: Int[np.ndarray, " rows"]
    """The earliest row is at frame 0."""
    rate_hz: float

    @property
    def step_s(self) -> float:
        """From one frame to the next."""
        return 1.0 / self.rate_hz


def read_clock(
    tracks: Int[np.ndarray, " rows"],
    times_ms: Float[np.ndarray, " rows"],
    where: Callable[[int, str], str],
) -> Clock:
    """The clock that rows were taken by.

    A frame lasts as long as most steps of tracks do. The rate is a whole number if one explains
    all times to the millisecond, since 30 Hz are steps of 33 and 34 ms.

    Args:
        tracks: of each row; rows are sorted by track, then time.
        times_ms: of each row, one of a track at a time.
        where: starts the message on what is wrong with a row; is given its number, and a text in
            which `{track}` and `{time}` are filled in.

    Raises:
        DataError: there is no step in any track, the rate is impossible, or a row lies between
            frames.
    """
    steps_ms = np.diff(times_ms)[np.diff(tracks) == 0]
    if not len(steps_ms):
        raise DataError(
            where(0, "no track has a second row")
            + ", so that no frame rate can be told; copy the file again or remove the recording"
        )
    step_ms = float(np.median(steps_ms))
    if not LOWEST_HZ <= 1000.0 / step_ms <= HIGHEST_HZ:
        raise DataError(
            where(0, "timestamp_ms of its rows")
            + f" and those after are {step_ms:g} apart, which makes {1000.0 / step_ms:g} Hz; "
            f"expected {LOWEST_HZ:g} to {HIGHEST_HZ:g} Hz, so times in milliseconds"
        )
    known_ms, at_time = np.unique(times_ms, return_inverse=True)
    since_ms = known_ms - known_ms[0]
    single = np.abs(steps_ms - step_ms) <= ROUNDING_MS + JITTER * step_ms
    step_ms = float(steps_ms[single].mean())
    whole_hz = round(1000.0 / step_ms)
    frames = np.round(since_ms * whole_hz / 1000.0)
    if np.abs(since_ms - frames * 1000.0 / whole_hz).max() <= min(ROUNDING_MS, 0.25 * step_ms):
        clock = Clock(frames=frames.astype(np.int64)[at_time], rate_hz=float(whole_hz))
        again = (np.diff(tracks) == 0) & (np.diff(clock.frames) == 0)
        if again.any():
            raise DataError(
                where(int(again.argmax()) + 1, "a second row of track {track} at {time} ms")
                + f", less than a frame of {step_ms:g} ms after the first; remove one of the two"
            )
        return clock

    apart = np.diff(known_ms) / step_ms
    counts = np.round(apart)
    off = (counts < 1) | (np.abs(apart - counts) > JITTER + ROUNDING_MS / step_ms)
    if off.any():
        late = int(np.flatnonzero(times_ms == known_ms[int(off.argmax()) + 1])[0])
        raise DataError(
            where(late, "timestamp_ms is {time}")
            + f", {np.diff(known_ms)[int(off.argmax())]:g} ms after the one before; expected "
            f"multiples of {step_ms:g} ms as between most rows: mend the line or remove it"
        )
    frames = np.concatenate([[0], np.cumsum(counts)])
    rate_hz = 1000.0 * float(frames[-1] / since_ms[-1])
    return Clock(frames=frames.astype(np.int64)[at_time], rate_hz=rate_hz)
