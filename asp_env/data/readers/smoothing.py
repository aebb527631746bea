"""States from positions alone, for files with unreliable velocities and headings.

Positions are smoothed forward and backward in time under Singer's model of acceleration (1970), by
a Kalman filter and the smoother of Bryson and Frazier (1963). The noise of each row is estimated
from the third differences of the rows around it, so that exact tracks remain unchanged.

A vehicle's heading follows the path of its box's centre as in `asp_env.dynamics`: the rear axle
does not slip sideways, so its path is a tractrix. The heading is constant while a vehicle stands
or moves against its heading, which is driving backwards.
"""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float

from asp_env.compiled import njit
from asp_env.geometry import wrap_scalar

ACCELERATION_SIGMA_MPS2 = 1.5
"""Standard deviation of acceleration in Singer's model. Chosen by hand: more follows braking
sooner, less removes more noise."""

ACCELERATION_FADES_S = 1.0
"""Correlation time of acceleration in Singer's model. Chosen by hand."""

MIN_SIGMA_M = 0.02
"""Lower limit of the standard deviation of a measured coordinate. Chosen by hand."""

NOISE_WITHIN_S = 1.0
"""The noise of a row is estimated from the rows within this time before and after it. Chosen by
hand: balances the estimate's variance against changes of the noise along a track."""

JUMP_M = 1.5
"""A step that differs by more than this from the steps before and after it is a jump. Chosen by
hand: above what braking and noise do in one step, below the distance between two vehicles."""

HELD_S = 1.0
"""Longest time for which a tracker repeats a position before it follows it. Chosen by hand."""

SETS_OFF_MPS2 = 15.0
"""Acceleration from a stand above which the preceding positions were repeated by the tracker, not
measured. Chosen by hand: no vehicle reaches it."""

HEADING_HELD_MPS = 0.2
"""Speed below which a vehicle's heading is constant. Chosen by hand: above the drift of smoothed
positions of standing vehicles."""

SETS_OFF_M = 1.0
"""The direction to the first position this far from a track's first one is the first heading.
Chosen by hand: above the noise of positions."""

_STEPS_AROUND = 5
_SPEED_SIGMA_MPS = 20.0
_START_SIGMA_M = 100.0


def find_jumps(positions: Float[np.ndarray, "rows 2"]) -> Bool[np.ndarray, " steps"]:
    """Finds jumps of the tracker.

    A step from one row to the next is a jump if it differs from the medians of the five steps
    before and of the five steps after it. A side with fewer than two steps is ignored.

    Args:
        positions: positions at consecutive frames, metres.

    Returns:
        A mask of the steps that are jumps.
    """
    jumps = np.zeros(max(len(positions) - 1, 0), dtype=np.bool_)
    if len(jumps) > _STEPS_AROUND // 2:
        _mark_jumps(np.diff(positions, axis=0), JUMP_M, jumps)
    return jumps


def count_held(positions: Float[np.ndarray, "rows 2"], dt_s: float) -> int:
    """Counts the first rows of a track that the tracker filled with its first position.

    Equal positions count if they last no longer than 1 s and end with a step that no vehicle makes
    from a stand. The last of the equal rows is not counted.

    Args:
        positions: positions at consecutive frames, metres.
        dt_s: seconds between frames.
    """
    step_m = np.hypot(*np.diff(positions, axis=0).T)
    held = int((step_m > 0).argmax()) if (step_m > 0).any() else 0
    sets_off = step_m[held] > SETS_OFF_MPS2 * dt_s**2 if len(step_m) else False
    return held if sets_off and held * dt_s <= HELD_S else 0


def smooth(
    positions: Float[np.ndarray, "rows 2"], dt_s: float
) -> tuple[Float[np.ndarray, "rows 2"], Float[np.ndarray, "rows 2"]]:
    """Smooths the positions of one agent and estimates its velocities.

    Args:
        positions: measured positions at consecutive frames, metres.
        dt_s: seconds between frames.

    Returns:
        Smoothed positions in metres, and velocities in m/s.
    """
    transition, process = _singer(dt_s)
    variances = _variances(positions, max(round(NOISE_WITHIN_S / dt_s), 1))
    rows = len(positions)
    means, covariances = np.zeros((rows + 1, 3, 2)), np.zeros((rows + 1, 3, 3))
    smoothed = np.empty((rows, 4))
    means[0, 0] = positions[0]
    covariances[0] = np.diag([_START_SIGMA_M, _SPEED_SIGMA_MPS, ACCELERATION_SIGMA_MPS2]) ** 2
    _smooth(
        np.ascontiguousarray(positions),
        variances,
        transition,
        process,
        means,
        covariances,
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
    """Derives the headings of a vehicle from its positions.

    The measured headings determine which end is the front. Without them, or if they are folded, the
    vehicle drives forward for most of its path. A vehicle that never moves has the mean of the
    measured headings, or 0.

    Args:
        positions: smoothed positions of the box's centre at consecutive frames, metres.
        measured_rad: headings in the file, or None if it has none.
        rear_m: distance from the box's centre to the rear axle, metres.
        dt_s: seconds between frames.
        folded: whether the measured headings may be those of either end.

    Returns:
        Headings in radians, not wrapped.
    """
    steps = np.diff(positions, axis=0)
    step_m = np.hypot(*steps.T)
    away = np.hypot(*(positions - positions[0]).T) >= SETS_OFF_M
    if not away.any():
        if measured_rad is None:
            return np.zeros(len(positions))
        factor = 2 if folded else 1
        sine, cosine = np.sin(factor * measured_rad).mean(), np.cos(factor * measured_rad).mean()
        return np.full(len(positions), math.atan2(sine, cosine) / factor)
    course = np.arctan2(steps[:, 1], steps[:, 0])
    start = positions[int(away.argmax())] - positions[0]
    headings = np.empty(len(positions))
    _pull(math.atan2(start[1], start[0]), course, step_m, rear_m, HEADING_HELD_MPS * dt_s, headings)
    moves = step_m > HEADING_HELD_MPS * dt_s
    expected = course if measured_rad is None or folded else measured_rad[1:]
    forward = (step_m * np.cos(expected - headings[1:]))[moves].sum()
    return headings if forward >= 0 else headings + math.pi


def _singer(dt_s: float) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """Transition and process noise of [position, velocity, acceleration] along one axis."""
    fades = ACCELERATION_FADES_S

    def response(after_s: np.ndarray) -> np.ndarray:
        share = np.exp(-after_s / fades)
        return np.stack([fades**2 * (share - 1 + after_s / fades), fades * (1 - share), share])

    transition = np.eye(3)
    transition[0, 1] = dt_s
    transition[:, 2] = response(np.array([dt_s]))[:, 0]
    nodes, weights = np.polynomial.legendre.leggauss(8)
    gains = response(0.5 * dt_s * (nodes + 1))
    density = 2 * ACCELERATION_SIGMA_MPS2**2 / fades
    return transition, density * 0.5 * dt_s * (gains * weights) @ gains.T


def _variances(positions: Float[np.ndarray, "rows 2"], reach: int) -> Float[np.ndarray, " rows"]:
    """Variance of each row's noise along one axis, m².

    The third difference of white noise has 20 times its variance.

    Args:
        positions: measured positions, metres.
        reach: number of rows before and after each row to use.
    """
    rows = len(positions)
    if rows < 4:
        return np.full(rows, MIN_SIGMA_M**2)
    squares = (np.diff(positions, n=3, axis=0) ** 2).mean(axis=-1) / 20.0
    sums = np.concatenate([[0.0], np.cumsum(squares)])
    middle = np.arange(rows) - 1
    low = np.clip(middle - reach, 0, len(squares) - 1)
    high = np.clip(middle + reach + 1, 1, len(squares))
    return (sums[high] - sums[low]) / (high - low) + MIN_SIGMA_M**2


@njit(cache=True, nogil=True)
@no_type_check
def _median(values, first, end, axis, buffer):
    """Median of values[first:end, axis]; `buffer` receives the sorted values."""
    count = end - first
    for i in range(count):
        value, slot = values[first + i, axis], i
        while slot > 0 and buffer[slot - 1] > value:
            buffer[slot] = buffer[slot - 1]
            slot -= 1
        buffer[slot] = value
    return 0.5 * (buffer[(count - 1) // 2] + buffer[count // 2])


@njit(cache=True, nogil=True)
@no_type_check
def _mark_jumps(steps, limit_m, jumps):
    """Writes the mask of `find_jumps`.

    Args:
        steps: (n, 2) differences of consecutive positions, metres.
        limit_m: smallest difference of a jump.
        jumps: (n,) bool, receives the mask.
    """
    buffer = np.empty(_STEPS_AROUND)
    for i in range(len(steps)):
        difference_m = np.inf
        for side in range(2):
            first = i + 1 if side else max(i - _STEPS_AROUND, 0)
            end = min(i + 1 + _STEPS_AROUND, len(steps)) if side else i
            if end - first >= 2:
                x = steps[i, 0] - _median(steps, first, end, 0, buffer)
                y = steps[i, 1] - _median(steps, first, end, 1, buffer)
                difference_m = min(difference_m, math.sqrt(x * x + y * y))
        jumps[i] = limit_m < difference_m < np.inf


@njit(cache=True, nogil=True)
@no_type_check
def _filter(position, variance, mean, covariance, transition, process, next_mean, next_covariance):
    """Kalman filter: updates a row's prediction by its position and predicts the next row.

    Args:
        position: (2,) measured position, metres.
        variance: of the measured coordinates, m².
        mean: (3, 2) predicted position, velocity and acceleration along x and y.
        covariance: (3, 3) of `mean` along either axis.
        transition: (3, 3).
        process: (3, 3) process noise of one frame.
        next_mean: (3, 2) zeros, receives the prediction of the next row.
        next_covariance: (3, 3), receives its covariance.
    """
    total = covariance[0, 0] + variance
    between = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for n in range(3):
                updated = covariance[n, j] - covariance[n, 0] * covariance[0, j] / total
                between[i, j] += transition[i, n] * updated
    for i in range(3):
        for n in range(3):
            for axis in range(2):
                gain = (position[axis] - mean[0, axis]) / total
                next_mean[i, axis] += transition[i, n] * (mean[n, axis] + covariance[n, 0] * gain)
        for j in range(3):
            next_covariance[i, j] = process[i, j]
            for n in range(3):
                next_covariance[i, j] += between[i, n] * transition[j, n]


@njit(cache=True, nogil=True)
@no_type_check
def _smooth_row(position, variance, mean, covariance, transition, adjoint, smoothed):
    """Smooths one row by the rows after it; `adjoint` (3, 2) passes these to the row before.

    Args:
        position: (2,) measured position, metres.
        variance: of the measured coordinates, m².
        mean: (3, 2) as predicted by `_filter`.
        covariance: (3, 3) as predicted by `_filter`.
        transition: (3, 3).
        adjoint: (3, 2), updated in place.
        smoothed: (4,), receives [x, y, velocity x, velocity y].
    """
    for axis in range(2):
        gain = position[axis] - mean[0, axis]
        for n in range(3):
            gain += covariance[0, n] * adjoint[n, axis]
        adjoint[0, axis] -= gain / (covariance[0, 0] + variance)
        a, b, c = adjoint[0, axis], adjoint[1, axis], adjoint[2, axis]
        for i in range(2):
            correction = covariance[i, 0] * a + covariance[i, 1] * b + covariance[i, 2] * c
            smoothed[2 * i + axis] = mean[i, axis] - correction
        for i in range(3):
            adjoint[i, axis] = transition[0, i] * a + transition[1, i] * b + transition[2, i] * c


@njit(cache=True, nogil=True)
@no_type_check
def _smooth(positions, variances, transition, process, means, covariances, adjoint, smoothed):
    """Filters forward and smooths backward; both axes have the same gains.

    Args:
        positions: (rows, 2) measured positions, metres.
        variances: (rows,) of the measured coordinates, m².
        transition: (3, 3) of [position, velocity, acceleration].
        process: (3, 3) process noise of one frame.
        means: (rows + 1, 3, 2), the prediction of each row: that of the first, then zeros.
        covariances: (rows + 1, 3, 3), its covariance: that of the first, then anything.
        adjoint: (3, 2) zeros.
        smoothed: (rows, 4), receives positions and velocities.
    """
    rows = len(positions)
    for k in range(rows):
        _filter(
            positions[k],
            variances[k],
            means[k],
            covariances[k],
            transition,
            process,
            means[k + 1],
            covariances[k + 1],
        )
    for k in range(rows - 1, -1, -1):
        _smooth_row(
            positions[k], variances[k], means[k], covariances[k], transition, adjoint, smoothed[k]
        )


@njit(cache=True, nogil=True)
@no_type_check
def _pull(heading, course, step_m, rear_m, min_step_m, headings):
    """Pulls the rear axle along a path; on a straight step the tractrix has a closed form.

    Args:
        heading: at the first position, rad.
        course: (n,) direction of each step, rad.
        step_m: (n,) length of each step.
        rear_m: distance from the box's centre to the rear axle.
        min_step_m: the heading is constant in steps that are no longer than this.
        headings: (n + 1,), receives the heading at each position, rad.
    """
    headings[0] = heading
    for k in range(len(step_m)):
        angle = wrap_scalar(heading - course[k])
        if step_m[k] > min_step_m and abs(angle) < 0.5 * math.pi:
            pulled = math.tan(0.5 * angle) * math.exp(-step_m[k] / rear_m)
            heading = course[k] + 2.0 * math.atan(pulled)
        headings[k + 1] = heading
