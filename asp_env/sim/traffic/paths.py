"""The logged ways of all tracks of some recordings, one after the other in flat arrays.

MERGED: Where two logged paths get in each other's way, and who was first there in the log.
"""

import math
from collections.abc import Sequence
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from asp_env.data.recording import Recording
from asp_env.data.scenarios.tags import MANOEUVRE_STANDING_MPS
from asp_env.dynamics.car_following import IDM, limit_speeds
from asp_env.geometry import MIN_STEP_M, turned_overlaps
from asp_env.sim.episodes import BEYOND_M
from asp_env.sim.traffic.driver import resized

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
        halts = speeds[starts[1:] - 1] < MANOEUVRE_STANDING_MPS
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


ALONG = 0.7
"""Paths that lead the same way at either end of a zone, to this cosine, are driven in file."""

SPARE_M = 0.3
"""Boxes that pass each other by less than half of this touch."""

MOST_ZONES = 4
"""Of one pair of paths; what comes behind them is left to looking ahead."""

SHIFT = 2**31
"""The key of a pair of paths is the smaller number times this, plus the larger one."""

IN_A, OUT_A, IN_B, OUT_B, IN_FILE, AHEAD_B, A_FIRST = range(7)
"""Columns of a zone: arc lengths of the centres on either path, m, between which the boxes can
touch; whether the paths then lead the same way, and by how much the second's arc length then is the
larger one at the same place; whether the first was there first in the log."""

COLUMNS = 7


@njit(cache=True)
@no_type_check
def _touching(path, size, i, other, size_o, last_o, touch):
    """(first, last) touching point of the other path, the nearest one, cosine, least clearance."""
    x, y, ux, uy = path[i]
    first, last, along, nearest = -1, -1, -1.0, np.inf
    beside, closest = 0, np.inf
    j, before, skipped = 0, np.inf, 0
    while j <= last_o:
        xo, yo, vx, vy = other[j]
        away = np.hypot(xo - x, yo - y) - touch
        if away < closest:
            beside, closest = j, away
        # points are 1 m apart: so near may one of those have been that were skipped
        nearest = min(nearest, 0.5 * (away + before - skipped), away)
        before, skipped = away, max(1, int(away))
        if away >= 1.0:
            j += skipped
            continue
        width = size[1] + SPARE_M
        if turned_overlaps(x, y, ux, uy, size[0], width, xo, yo, vx, vy, size_o[0], size_o[1]):
            first = j if first < 0 else first
            last = j
            along = max(along, ux * vx + uy * vy)
        j += 1
    return first, last, beside, along, min(nearest, before - skipped)


@njit(cache=True)
@no_type_check
def _meet(path, size, last_a, other, size_o, last_o, zones):
    """Fills in the zones of two paths, and says how many there are."""
    touch = 0.5 * (np.hypot(size[0], size[1]) + np.hypot(size_o[0], size_o[1]))
    count, i, inside, at_end = 0, 0, False, 0.0
    while i <= last_a and count < len(zones):
        first, last, beside, along, nearest = _touching(path, size, i, other, size_o, last_o, touch)
        zone = zones[count]
        if first >= 0:
            if not inside:
                inside = True
                zone[IN_A], zone[IN_B], zone[OUT_B] = i, first, last
                zone[IN_FILE] = along > ALONG
            zone[OUT_A], zone[AHEAD_B] = i, beside - i
            zone[IN_B], zone[OUT_B] = min(zone[IN_B], first), max(zone[OUT_B], last)
            at_end = along
            i += 1
            continue
        if inside:
            zone[IN_FILE] = max(zone[IN_FILE], at_end > ALONG)
            inside = False
            count += 1
        i += max(1, int(nearest))
    if inside:
        zones[count, IN_FILE] = max(zones[count, IN_FILE], at_end > ALONG)
        count += 1
    return count


@njit(cache=True)
@no_type_check
def _first_row(arcs, begin, end, arc_m):
    """The first row at which a track has come as far; arcs never fall."""
    while begin < end:
        middle = (begin + end) // 2
        if arcs[middle] >= arc_m:
            end = middle
        else:
            begin = middle + 1
    return begin


@njit(cache=True)
@no_type_check
def _find(pairs, points, firsts, ends, sizes, arcs, rows, frames, zones, counts):
    for n in range(len(pairs)):
        a, b = pairs[n]
        path, other = points[firsts[a] : firsts[a + 1]], points[firsts[b] : firsts[b + 1]]
        counts[n] = _meet(path, sizes[a], int(ends[a]), other, sizes[b], int(ends[b]), zones[n])
        for zone in zones[n, : counts[n]]:
            reached_a = _first_row(arcs, rows[a], rows[a + 1], zone[IN_A]) - rows[a] + frames[a]
            reached_b = _first_row(arcs, rows[b], rows[b + 1], zone[IN_B]) - rows[b] + frames[b]
            zone[A_FIRST] = reached_a <= reached_b


@njit(cache=True)
@no_type_check
def _tell(zone, turned, you, mine, others, k):
    """Notes a zone down if there is room; how many there are now."""
    if k < len(mine):
        mine[k], others[k] = -1 - zone if turned else zone, you
    return k + 1


@njit(cache=True)
@no_type_check
def _deal(
    numbers, deciding, arcs, keys, firsts, found, zones, episodes, mine, others, counts
):  # fmt: skip
    """Gives each deciding agent of some episodes the zones that lie ahead, in the slots' order."""
    for b in episodes:
        counts[b] = 0
        for a in range(numbers.shape[1]):
            for o in range(a + 1, numbers.shape[1]):
                one, two = numbers[b, a], numbers[b, o]
                if one < 0 or two < 0 or not (deciding[b, a] or deciding[b, o]):
                    continue
                swapped = one > two
                key = two * SHIFT + one if swapped else one * SHIFT + two
                at = np.searchsorted(keys, key)
                for z in range(firsts[at], firsts[at] + found[at]):
                    out_a = zones[z, OUT_B] if swapped else zones[z, OUT_A]
                    out_o = zones[z, OUT_A] if swapped else zones[z, OUT_B]
                    if arcs[b, a] > out_a or arcs[b, o] > out_o:
                        continue
                    if deciding[b, a]:
                        counts[b, a] = _tell(z, swapped, o, mine[b, a], others[b, a], counts[b, a])
                    if deciding[b, o]:
                        counts[b, o] = _tell(
                            z, not swapped, a, mine[b, o], others[b, o], counts[b, o]
                        )


class Conflicts:
    """Zones of the pairs of paths that were asked for; it only grows, and copies share it."""

    def __init__(self, paths: Paths) -> None:
        """No zones yet."""
        self._paths = paths
        self._keys = np.zeros(0, dtype=np.int64)
        self._firsts = np.zeros(0, dtype=np.int64)
        self._counts = np.zeros(0, dtype=np.int64)
        """The pair of `_keys[i]`, which rises, has so many zones from `_firsts[i]` on."""
        self.zones = np.zeros((0, COLUMNS), dtype=np.float32)

    def __deepcopy__(self, memo: dict[int, Any]) -> "Conflicts":
        """Itself."""
        del memo
        return self

    def deal(
        self,
        numbers: Int[np.ndarray, "b a"],
        deciding: Bool[np.ndarray, "b a"],
        arcs: Float[np.ndarray, "b a"],
        reset_mask: Bool[np.ndarray, " b"],
        into: "Ahead",
    ) -> None:
        """Finds the zones that lie ahead of the agents that decide, in the episodes at `reset_mask`.

        Args:
            numbers: of the agents' paths, -1 for those without one.
            deciding: who is to be told of its zones.
            arcs: how far along their paths they begin, m.
            reset_mask: the episodes.
            into: what is filled in there.
        """
        self._learn(numbers[reset_mask], deciding[reset_mask])
        into.fit(numbers.shape)
        episodes = np.flatnonzero(reset_mask)
        known = self._keys, self._firsts, self._counts, self.zones
        _deal(numbers, deciding, arcs, *known, episodes, into.zones, into.others, into.counts)
        if into.counts.max(initial=0) > into.zones.shape[2]:
            into.fit(numbers.shape, int(into.counts.max()))
            _deal(numbers, deciding, arcs, *known, episodes, into.zones, into.others, into.counts)

    def _learn(self, numbers: Int[np.ndarray, "b a"], deciding: Bool[np.ndarray, "b a"]) -> None:
        first, second = np.triu_indices(numbers.shape[1], k=1)
        one, two = numbers[:, first], numbers[:, second]
        asked = (one >= 0) & (two >= 0) & (deciding[:, first] | deciding[:, second])
        one, two = one[asked], two[asked]
        wanted = np.unique(np.minimum(one, two) * SHIFT + np.maximum(one, two))
        new = np.setdiff1d(wanted, self._keys, assume_unique=True)
        if not len(new):
            return
        pairs = np.stack([new // SHIFT, new % SHIFT], axis=-1)
        zones = np.zeros((len(pairs), MOST_ZONES, COLUMNS), dtype=np.float32)
        counts = np.zeros(len(pairs), dtype=np.int64)
        paths = self._paths
        _find(
            pairs, paths.points, paths.firsts, paths.ends, paths.sizes, paths.arcs, paths.rows,
            paths.first_frames, zones, counts,
        )  # fmt: skip
        firsts = len(self.zones) + np.concatenate([[0], np.cumsum(counts)[:-1]])
        self.zones = np.concatenate([self.zones, zones[np.arange(MOST_ZONES) < counts[:, None]]])
        keys = np.concatenate([self._keys, new])
        order = np.argsort(keys, kind="stable")
        self._keys = keys[order]
        self._firsts = np.concatenate([self._firsts, firsts])[order]
        self._counts = np.concatenate([self._counts, counts])[order]


class Ahead:
    """Which zones lie ahead of each agent of each episode, and whom it shares them with."""

    def __init__(self) -> None:
        """None yet."""
        self.zones = np.zeros((0, 0, 0), dtype=np.int32)
        """Rows of `Conflicts.zones`; -1 - row where the agent is the second of its pair."""
        self.others = np.zeros((0, 0, 0), dtype=np.int32)
        """The other's slot."""
        self.counts = np.zeros((0, 0), dtype=np.int32)

    def fit(self, shape: tuple[int, ...], most: int = 0) -> None:
        """Takes on the sizes of the world's arrays, with room for so many zones at least."""
        room = max(most, self.zones.shape[2])
        self.zones = resized(self.zones, (*shape, room))
        self.others = resized(self.others, (*shape, room))
        self.counts = resized(self.counts, shape)
