"""States from positions alone, for files whose velocities and headings are not to be relied on.

Positions are smoothed forward and backward in time under Singer's model (1970) of acceleration,
by a Kalman filter and the smoother of Bryson and Frazier (1963). How noisy a row is, is estimated
from the third differences of the rows around it, so that clean tracks are left as they are.

A vehicle's heading follows the path of its box's centre as in `asp_env.dynamics`: the rear axle
does not slip sideways, which makes its path a tractrix. A standing vehicle keeps its heading, and
so does one that moves against it, which is backing up.
"""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from asp_env.geometry import wrap_scalar

ACCELERATION_SIGMA_MPS2 = 1.5
ACCELERATION_FADES_S = 1.0

LEAST_SIGMA_M = 0.02
"""No position is taken to be more exact than this."""

NOISE_WITHIN_S = 1.0
"""The rows before and after of which a row's noise is estimated."""

JUMP_M = 1.5
"""A step that differs by more from the steps before and from those after is a jump."""

HELD_S = 1.0
"""Trackers hold a position for at most this long until they begin to follow it."""

SETS_OFF_MPS2 = 15.0
"""No vehicle goes from standing to a step's speed as fast as this."""

STANDS_MPS = 0.2
"""Below this a vehicle keeps its heading."""

SETS_OFF_M = 1.0
"""The way to where a vehicle is this far from its start tells its first heading."""

_STEPS_AROUND = 5
_SPEED_SIGMA_MPS = 20.0
_START_SIGMA_M = 100.0


def find_jumps(positions: Float[np.ndarray, "rows 2"]) -> Bool[np.ndarray, " steps"]:
    """Whether each step from one row to the next is a jump.

    A step is held against the median of the five before and of the five after, where there are
    two at least, and is a jump only if it differs from both.
    """
    found = np.zeros(max(len(positions) - 1, 0), dtype=np.bool_)
    if len(found) > _STEPS_AROUND // 2:
        _mark_jumps(np.diff(positions, axis=0), JUMP_M, found)
    return found


def count_held(positions: Float[np.ndarray, "rows 2"], dt_s: float) -> int:
    """How many of a track's first rows repeat its first position without it having stood there.

    That is so if it lasts no longer than 1 s and ends in a step that no vehicle makes. The last
    of the rows that are alike is not counted.
    """
    way = np.hypot(*np.diff(positions, axis=0).T)
    held = int((way > 0).argmax()) if (way > 0).any() else 0
    sets_off = way[held] > SETS_OFF_MPS2 * dt_s**2 if len(way) else False
    return held if sets_off and held * dt_s <= HELD_S else 0


def smooth(
    positions: Float[np.ndarray, "rows 2"], dt_s: float
) -> tuple[Float[np.ndarray, "rows 2"], Float[np.ndarray, "rows 2"]]:
    """Smoothed positions and velocities of one road user at consecutive frames.

    Args:
        positions: as measured, metres.
        dt_s: seconds between frames.
    """
    transition, process = _singer(dt_s)
    variances = _variances(positions, max(round(NOISE_WITHIN_S / dt_s), 1))
    rows = len(positions)
    means, spreads, smoothed = (
        np.zeros((rows + 1, 3, 2)),
        np.zeros((rows + 1, 3, 3)),
        np.empty((rows, 4)),
    )
    means[0, 0] = positions[0]
    spreads[0] = np.diag([_START_SIGMA_M, _SPEED_SIGMA_MPS, ACCELERATION_SIGMA_MPS2]) ** 2
    _smooth(
        np.ascontiguousarray(positions),
        variances,
        transition,
        process,
        means,
        spreads,
        np.zeros((3, 2)),
        smoothed,
    )
    return smoothed[:, :2], smoothed[:, 2:]


def follow_heading(
    positions: Float[np.ndarray, "rows 2"],
    measured_rad: Float[np.ndarray, " rows"] | None,
    rear_m: float,
    dt_s: float,
    *,
    folded: bool = False,
) -> Float[np.ndarray, " rows"]:
    """A vehicle's headings, radians.

    Which of its ends is the front, the measured headings tell; without them, or if they are
    folded, it drives forward most of its way. One that never sets off has the mean of them, or 0.

    Args:
        positions: smoothed ones of the box's centre, metres.
        measured_rad: what the file says, or None if it says nothing.
        rear_m: distance from the box's centre to the rear axle.
        dt_s: seconds between frames.
        folded: whether the measured headings may be of either end.
    """
    steps = np.diff(positions, axis=0)
    way = np.hypot(*steps.T)
    away = np.hypot(*(positions - positions[0]).T) >= SETS_OFF_M
    if not away.any():
        if measured_rad is None:
            return np.zeros(len(positions))
        times = 2 if folded else 1
        sine, cosine = np.sin(times * measured_rad).mean(), np.cos(times * measured_rad).mean()
        return np.full(len(positions), math.atan2(sine, cosine) / times)
    course = np.arctan2(steps[:, 1], steps[:, 0])
    off = positions[int(away.argmax())] - positions[0]
    headings = np.empty(len(positions))
    _pull(math.atan2(off[1], off[0]), course, way, rear_m, STANDS_MPS * dt_s, headings)
    moves = way > STANDS_MPS * dt_s
    along = course if measured_rad is None or folded else measured_rad[1:]
    forward = (way * np.cos(along - headings[1:]))[moves].sum()
    return headings if forward >= 0 else headings + math.pi


def _singer(dt_s: float) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """Transition and noise of [position, velocity, acceleration] along one axis."""
    fades = ACCELERATION_FADES_S

    def response(after_s: np.ndarray) -> np.ndarray:
        kept = np.exp(-after_s / fades)
        return np.stack([fades**2 * (kept - 1 + after_s / fades), fades * (1 - kept), kept])

    transition = np.eye(3)
    transition[0, 1] = dt_s
    transition[:, 2] = response(np.array([dt_s]))[:, 0]
    nodes, weights = np.polynomial.legendre.leggauss(8)
    gains = response(0.5 * dt_s * (nodes + 1))
    density = 2 * ACCELERATION_SIGMA_MPS2**2 / fades
    return transition, density * 0.5 * dt_s * (gains * weights) @ gains.T


def _variances(positions: Float[np.ndarray, "rows 2"], reach: int) -> Float[np.ndarray, " rows"]:
    """Of each row's noise along one axis, m²: the third difference of white noise has 20 times."""
    rows = len(positions)
    if rows < 4:
        return np.full(rows, LEAST_SIGMA_M**2)
    squares = (np.diff(positions, n=3, axis=0) ** 2).mean(axis=-1) / 20.0
    sums = np.concatenate([[0.0], np.cumsum(squares)])
    middle = np.arange(rows) - 1
    low = np.clip(middle - reach, 0, len(squares) - 1)
    high = np.clip(middle + reach + 1, 1, len(squares))
    return (sums[high] - sums[low]) / (high - low) + LEAST_SIGMA_M**2


@njit(cache=True, nogil=True)
@no_type_check
def _median(values, first, last, axis, room):
    """Of rows first to last (exclusive) of values, along one axis; room takes them sorted."""
    count = last - first
    for i in range(count):
        value, at = values[first + i, axis], i
        while at > 0 and room[at - 1] > value:
            room[at] = room[at - 1]
            at -= 1
        room[at] = value
    return 0.5 * (room[(count - 1) // 2] + room[count // 2])


@njit(cache=True, nogil=True)
@no_type_check
def _mark_jumps(steps, limit, found):
    room = np.empty(_STEPS_AROUND)
    for i in range(len(steps)):
        apart = np.inf
        for side in range(2):
            first = i + 1 if side else max(i - _STEPS_AROUND, 0)
            last = min(i + 1 + _STEPS_AROUND, len(steps)) if side else i
            if last - first >= 2:
                x = steps[i, 0] - _median(steps, first, last, 0, room)
                y = steps[i, 1] - _median(steps, first, last, 1, room)
                apart = min(apart, math.sqrt(x * x + y * y))
        found[i] = limit < apart < np.inf


@njit(cache=True, nogil=True)
@no_type_check
def _filter(place, variance, mean, spread, transition, process, next_mean, next_spread):
    """Takes in one position and writes what is expected of the next."""
    total = spread[0, 0] + variance
    between = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for n in range(3):
                kept = spread[n, j] - spread[n, 0] * spread[0, j] / total
                between[i, j] += transition[i, n] * kept
    for i in range(3):
        for n in range(3):
            for axis in range(2):
                off = (place[axis] - mean[0, axis]) / total
                next_mean[i, axis] += transition[i, n] * (mean[n, axis] + spread[n, 0] * off)
        for j in range(3):
            next_spread[i, j] = process[i, j]
            for n in range(3):
                next_spread[i, j] += between[i, n] * transition[j, n]


@njit(cache=True, nogil=True)
@no_type_check
def _look_back(place, variance, mean, spread, transition, adjoint, smoothed):
    """Smooths one row by what came after it; `adjoint` (3, 2) carries that on to the one before."""
    for axis in range(2):
        off = place[axis] - mean[0, axis]
        for n in range(3):
            off += spread[0, n] * adjoint[n, axis]
        adjoint[0, axis] -= off / (spread[0, 0] + variance)
        a, b, c = adjoint[0, axis], adjoint[1, axis], adjoint[2, axis]
        for i in range(2):
            weighed = spread[i, 0] * a + spread[i, 1] * b + spread[i, 2] * c
            smoothed[2 * i + axis] = mean[i, axis] - weighed
        for i in range(3):
            adjoint[i, axis] = transition[0, i] * a + transition[1, i] * b + transition[2, i] * c


@njit(cache=True, nogil=True)
@no_type_check
def _smooth(positions, variances, transition, process, means, spreads, adjoint, smoothed):
    """Receives positions and velocities of both axes, whose gains are the same, in `smoothed`.

    Args:
        positions: (rows, 2).
        variances: (rows,).
        transition: (3, 3) of [position, velocity, acceleration].
        process: (3, 3), noise that a frame adds.
        means: (rows + 1, 3, 2), what is expected of each row: that of the first, else zeros.
        spreads: (rows + 1, 3, 3), its covariance: that of the first, else room.
        adjoint: zeros (3, 2).
        smoothed: (rows, 4).
    """
    rows = len(positions)
    for k in range(rows):
        _filter(
            positions[k],
            variances[k],
            means[k],
            spreads[k],
            transition,
            process,
            means[k + 1],
            spreads[k + 1],
        )
    for k in range(rows - 1, -1, -1):
        _look_back(
            positions[k], variances[k], means[k], spreads[k], transition, adjoint, smoothed[k]
        )


@njit(cache=True, nogil=True)
@no_type_check
def _pull(heading, course, way, rear, least, headings):
    """Pulls the rear axle along; on a straight step the tractrix is known in closed form."""
    headings[0] = heading
    for k in range(len(way)):
        off = wrap_scalar(heading - course[k])
        if way[k] > least and abs(off) < 0.5 * math.pi:
            heading = course[k] + 2.0 * math.atan(math.tan(0.5 * off) * math.exp(-way[k] / rear))
        headings[k + 1] = heading
