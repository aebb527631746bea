"""Where two logged paths get in each other's way, and who was first there in the log."""

from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from asp_env.metrics.boxes import turned_overlaps
from asp_env.sim.drivers.driver import resized
from asp_env.sim.drivers.paths import Paths

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
        where: Bool[np.ndarray, " b"],
        into: "Ahead",
    ) -> None:
        """Finds the zones that lie ahead of the agents that decide, in the episodes at `where`.

        Args:
            numbers: of the agents' paths, -1 for those without one.
            deciding: who is to be told of its zones.
            arcs: how far along their paths they begin, m.
            where: the episodes.
            into: what is filled in there.
        """
        self._learn(numbers[where], deciding[where])
        into.fit(numbers.shape)
        episodes = np.flatnonzero(where)
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
