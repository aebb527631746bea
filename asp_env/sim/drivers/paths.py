"""The logged ways of all tracks of some recordings, one after the other in flat arrays."""

import math
from collections.abc import Sequence
from typing import Any, no_type_check

import numpy as np
from numba import njit

from asp_env.data.geometry import MIN_STEP_M
from asp_env.data.recording import Recording
from asp_env.data.scenario_rules import STANDING_MPS
from asp_env.sim.beginning import BEYOND_M
from asp_env.sim.idm import IDM, limit_speeds

MIN_DESIRED_MPS = 3.0
"""Nobody wants to stand: a vehicle that the log shows waiting wants at least this speed."""


@njit(cache=True)
@no_type_check
def _thin(states, kept, arcs):
    """Kept positions, their number, and how far along them every state is."""
    count, length = 1, 0.0
    kept[0, 0], kept[0, 1], kept[0, 2] = states[0, 0], states[0, 1], 0.0
    arcs[0] = 0.0
    for i in range(1, len(states)):
        x, y = states[i, 0], states[i, 1]
        step = math.hypot(x - kept[count - 1, 0], y - kept[count - 1, 1])
        if step >= MIN_STEP_M:
            length += step
            kept[count, 0], kept[count, 1], kept[count, 2] = x, y, length
            count += 1
            step = 0.0
        arcs[i] = max(length + step, arcs[i - 1])
    if count > 1:
        step = kept[count - 1, 2] - kept[count - 2, 2]
        ahead_x = (kept[count - 1, 0] - kept[count - 2, 0]) / step
        ahead_y = (kept[count - 1, 1] - kept[count - 2, 1]) / step
    else:
        ahead_x, ahead_y = math.cos(states[-1, 2]), math.sin(states[-1, 2])
    kept[count, 0] = kept[count - 1, 0] + BEYOND_M * ahead_x
    kept[count, 1] = kept[count - 1, 1] + BEYOND_M * ahead_y
    kept[count, 2] = length + BEYOND_M
    return count + 1


@njit(cache=True)
@no_type_check
def _measure(states, starts, arcs, counts):
    kept = np.zeros((np.diff(starts).max() + 1, 3))
    for track in range(len(starts) - 1):
        rows = slice(starts[track], starts[track + 1])
        last = _thin(states[rows], kept, arcs[rows]) - 1
        counts[track] = int(kept[last, 2] + 1e-9) + 1


@njit(cache=True)
@no_type_check
def _lay(states, starts, arcs, firsts, points):
    kept = np.zeros((np.diff(starts).max() + 1, 3))
    for track in range(len(starts) - 1):
        rows = slice(starts[track], starts[track + 1])
        last = _thin(states[rows], kept, arcs[rows]) - 1
        k, row, end = 0, starts[track], starts[track + 1] - 1
        for i in range(firsts[track + 1] - firsts[track]):
            while kept[k + 1, 2] < i:
                k += 1
            share = (i - kept[k, 2]) / (kept[k + 1, 2] - kept[k, 2])
            point = points[firsts[track] + i]
            for axis in range(2):
                way = kept[k + 1, axis] - kept[k, axis]
                point[axis] = kept[k, axis] + share * way
            while row < end and arcs[row] < i:
                row += 1
            heading = states[row, 2]
            if i > kept[last - 1, 2]:
                dx, dy = kept[last, 0] - kept[last - 1, 0], kept[last, 1] - kept[last - 1, 1]
                heading = math.atan2(dy, dx)
            point[2], point[3] = math.cos(heading), math.sin(heading)


@njit(cache=True)
@no_type_check
def _limit(points, firsts, desired, stops, lateral, braking, limits):
    for track in range(len(firsts) - 1):
        rows = slice(firsts[track], firsts[track + 1])
        limit_speeds(points[rows], desired[track], stops[track], lateral, braking, limits[rows])


class Paths:
    """The logged ways of the tracks of those recordings that were asked for, with what they allow.

    Tracks of all recordings are numbered one after the other; a path's points are 1 m apart. It
    only ever grows, so that copies of a driver share it.
    """

    def __init__(self, idm: IDM) -> None:
        """No paths yet."""
        self._idm = idm
        self._recordings: dict[int, tuple[Recording, int]] = {}
        self.points = np.zeros((0, 4), dtype=np.float32)
        """[x m, y m, cosine, sine of the vehicle's heading there]: as logged, and straight on."""
        self.limits = np.zeros(0, dtype=np.float32)
        """Speed wanted at each point, m/s."""
        self.firsts = np.zeros(1, dtype=np.int64)
        """Path i has the points `firsts[i]:firsts[i + 1]`."""
        self.ends = np.zeros(0)
        """Arc length of the last recorded position, m."""
        self.halts = np.zeros(0, dtype=bool)
        """Whether the log ends with the vehicle standing."""
        self.sizes = np.zeros((0, 2), dtype=np.float32)
        self.arcs = np.zeros(0, dtype=np.float32)
        """How far along its path a track is at each recorded frame, m."""
        self.rows = np.zeros(1, dtype=np.int64)
        """Track i has the rows `rows[i]:rows[i + 1]` of `arcs`."""
        self.first_frames = np.zeros(0, dtype=np.int64)

    def __deepcopy__(self, memo: dict[int, Any]) -> "Paths":
        """Itself."""
        del memo
        return self

    def base(self, recordings: Sequence[Recording], number: int) -> int:
        """The number of a recording's first track; its paths are laid if they are not yet."""
        recording = recordings[number]
        known = self._recordings.get(number)
        if known is None or known[0] is not recording:
            known = recording, len(self.ends)
            self._recordings[number] = known
            self._lay(recording)
        return known[1]

    def _lay(self, recording: Recording) -> None:
        starts = np.asarray(recording.starts, dtype=np.int64)
        states = np.ascontiguousarray(recording.states)
        counts = np.zeros(len(recording), dtype=np.int64)
        arcs = np.zeros(len(states), dtype=np.float32)
        _measure(states, starts, arcs, counts)
        firsts = np.concatenate([[0], np.cumsum(counts)])
        points = np.zeros((firsts[-1], 4), dtype=np.float32)
        _lay(states, starts, arcs, firsts, points)
        speeds = np.abs(states[:, 3])
        halts = speeds[starts[1:] - 1] < STANDING_MPS
        ends = counts - 1 - BEYOND_M
        desired = np.maximum(np.maximum.reduceat(speeds, starts[:-1]), MIN_DESIRED_MPS)
        limits = np.zeros(len(points), dtype=np.float32)
        _limit(
            points, firsts, desired, np.where(halts, ends, np.inf),
            self._idm.max_lateral_acceleration_mps2, self._idm.comfortable_braking_mps2, limits,
        )  # fmt: skip
        self.firsts = np.concatenate([self.firsts, len(self.points) + firsts[1:]])
        self.rows = np.concatenate([self.rows, len(self.arcs) + starts[1:]])
        self.points = np.concatenate([self.points, points])
        self.limits = np.concatenate([self.limits, limits])
        self.arcs = np.concatenate([self.arcs, arcs])
        self.ends = np.concatenate([self.ends, ends])
        self.halts = np.concatenate([self.halts, halts])
        self.sizes = np.concatenate([self.sizes, recording.sizes.astype(np.float32)])
        frames = recording.first_frames.astype(np.int64)
        self.first_frames = np.concatenate([self.first_frames, frames])
