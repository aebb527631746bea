"""Resampling: tracks at the frames of another rate, for recordings whose rate fits no tick.

Frames are counted from the recording's begin, so frame k of the new rate is at k / rate seconds.
Positions follow a piecewise cubic polynomial through the rows (Hermite's), whose slope at a row is
that of the parabola through the row and its neighbours (Bessel's), or at the ends of a track
through the last three rows. It is exact for constant acceleration; on a circle of radius 20 m at
10 m/s and 10 Hz the error is below 0.1 mm. Headings, unwrapped, and speeds are interpolated
linearly. Where the heading changes by over 90° between two rows, both are those of the nearer row.

Nothing is extrapolated: a track has the new frames between its first and its last row. Gaps remain
gaps, since tracks are split there before.
"""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from asp_env.data.readers.layout import TrackTable, shorten
from asp_env.geometry import wrap_angle

TURN_RAD = 0.5 * math.pi
"""A change of heading between two rows above which it is no rotation. Chosen by hand."""

_SAME_TIME = 1e-6
"""Share of a frame within which times are equal."""


def at_times(
    values: Float[np.ndarray, "rows columns"],
    times: Float[np.ndarray, " rows"],
    wanted: Float[np.ndarray, " wanted"],
) -> Float[np.ndarray, "wanted columns"]:
    """Values at other times, by the cubic polynomials that the module describes.

    Args:
        values: values of each row.
        times: time of each row, increasing, at any spacing.
        wanted: times between the first and the last row.
    """
    if len(times) == 1:
        return np.repeat(values, len(wanted), axis=0)
    width = np.diff(times)[:, None]
    slope = np.diff(values, axis=0) / width
    slopes = np.repeat(slope[:1], len(times), axis=0)
    if len(times) > 2:
        inner = (width[1:] * slope[:-1] + width[:-1] * slope[1:]) / (width[1:] + width[:-1])
        slopes[1:-1] = inner
        slopes[0] = 2 * slope[0] - inner[0]
        slopes[-1] = 2 * slope[-1] - inner[-1]
    row, share = _between(times, wanted)
    s, left, right = share[:, None], values[row], values[row + 1]
    bend = width[row] * (s * (1 - s) ** 2 * slopes[row] - s**2 * (1 - s) * slopes[row + 1])
    rise = s**2 * (3 - 2 * s)
    return (1 - rise) * left + rise * right + bend


def resample(table: TrackTable, from_hz: float, to_hz: float) -> TrackTable:
    """The tracks at the frames of another rate.

    Args:
        table: the tracks.
        from_hz: frames per second of the table.
        to_hz: frames per second of the result.

    Returns:
        The tracks, with a line about them among the repairs. Tracks between two new frames are
        left out.
    """
    ratio = to_hz / from_hz
    states, accelerations, first_frames, kept = [], [], [], []
    for track, (start, end) in enumerate(zip(table.starts[:-1], table.starts[1:], strict=True)):
        times = (table.first_frames[track] + np.arange(end - start)) * ratio
        wanted = frames_within(times)
        if not len(wanted):
            continue
        kept.append(track)
        first_frames.append(wanted[0])
        states.append(_states(table.states[start:end].astype(np.float64), times, wanted))
        if table.accelerations is not None:
            along = np.interp(wanted, times, table.accelerations[start:end])
            accelerations.append(along.astype(np.float32))
    repairs = [f"{from_hz:g} Hz resampled to {to_hz:g} Hz"]
    if left_out := np.setdiff1d(table.track_ids, table.track_ids[kept]).tolist():
        names = shorten([str(name) for name in left_out])
        repairs.append(f"{len(left_out)} tracks between two frames of {to_hz:g} Hz: {names}")
    lengths = [len(each) for each in states]
    return replace(
        table,
        track_ids=table.track_ids[kept],
        classes=table.classes[kept],
        sizes=table.sizes[kept],
        first_frames=np.array(first_frames, dtype=np.int64),
        starts=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        states=np.concatenate([np.zeros((0, 4), dtype=np.float32), *states]),
        accelerations=None
        if table.accelerations is None
        else np.concatenate([np.zeros(0, dtype=np.float32), *accelerations]),
        repairs=(*table.repairs, *repairs),
        resampled_from_hz=table.resampled_from_hz or from_hz,
    )


def frames_within(times: Float[np.ndarray, " rows"]) -> Int[np.ndarray, " frames"]:
    """The whole frames between the first and the last of some increasing times in frames."""
    first, last = math.ceil(times[0] - _SAME_TIME), math.floor(times[-1] + _SAME_TIME)
    return np.arange(first, last + 1)


def _between(
    times: Float[np.ndarray, " rows"], wanted: Float[np.ndarray, " wanted"]
) -> tuple[Int[np.ndarray, " wanted"], Float[np.ndarray, " wanted"]]:
    """The row before each wanted time, and the share of the way to the row after it."""
    row = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, max(len(times) - 2, 0))
    if len(times) == 1:
        return row, np.zeros(len(wanted))
    share = (wanted - times[row]) / (times[row + 1] - times[row])
    share[share < _SAME_TIME] = 0.0
    share[share > 1.0 - _SAME_TIME] = 1.0
    return row, share


def _states(
    states: Float[np.ndarray, "rows 4"],
    times: Float[np.ndarray, " rows"],
    wanted: Int[np.ndarray, " wanted"],
) -> Float[np.ndarray, "wanted 4"]:
    at = wanted.astype(np.float64)
    found = np.empty((len(at), 4))
    found[:, :2] = at_times(states[:, :2], times, at)
    row, share = _between(times, at)
    after = np.minimum(row + 1, len(states) - 1)
    turn = wrap_angle(states[after, 2] - states[row, 2])
    share = np.where(np.abs(turn) > TURN_RAD, np.round(share), share)
    found[:, 2] = np.where(share == 1.0, states[after, 2], states[row, 2] + share * turn)
    found[:, 3] = (1.0 - share) * states[row, 3] + share * states[after, 3]
    found[:, 2] = wrap_angle(found[:, 2])
    return found.astype(np.float32)
