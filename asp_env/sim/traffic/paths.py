"""Paths of recorded tracks, and the zones in which two of them conflict.

A path is the polyline of a track, resampled to 1 m, with the speed that a vehicle desires at each
point. A zone is a stretch of two paths on which the boxes of their vehicles could touch. Both are
computed when they are first needed and then stored in flat arrays that all copies of a driver
share.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.compiled import njit
from asp_env.data.recording import Recording
from asp_env.data.scenarios.tags import MANOEUVRE_STANDING_MPS
from asp_env.dynamics.car_following import IDM, limit_speeds
from asp_env.geometry import MIN_STEP_M, turned_overlaps
from asp_env.sim.episodes import ROUTE_EXTENSION_M
from asp_env.sim.traffic.driver import resized

MIN_DESIRED_MPS = 3.0
"""Lower bound of a vehicle's desired speed, for vehicles that only wait in their track. Chosen by
hand."""

SAME_DIRECTION_COSINE = 0.7
"""Two paths have the same direction if the cosine of the angle between them is larger. Chosen by
hand: about 45°."""

ZONE_CLEARANCE_M = 0.3
"""Boxes that pass each other with less than half of this distance count as touching. Chosen by
hand."""

MAX_ZONES = 4
"""Maximum number of zones per pair of paths; later ones are left to looking ahead. Chosen by
hand."""

PAIR_KEY_BASE = 2**31
"""The key of a pair of paths is the smaller number times this, plus the larger number."""

ENTRY_A, EXIT_A, ENTRY_B, EXIT_B, SAME_DIRECTION, LEAD_B, A_FIRST = range(7)
"""Columns of a zone of paths a < b: the arc lengths m of the vehicles' centres, on path a and on
path b, between which their boxes can touch; whether the paths have the same direction at either
end; by how much the arc length on b exceeds that on a at the same point, m; whether the track of a
enters first."""

ZONE_COLUMNS = 7


class PathTable(NamedTuple):
    """T paths in flat arrays: path i is the track i over all recordings."""

    points: np.ndarray
    """(N, 4) float32 [x m, y m, cos, sin of the vehicle's heading] of points 1 m apart: the track,
    then `ROUTE_EXTENSION_M` straight ahead."""
    speed_limits: np.ndarray
    """(N,) float32: desired speed at each point, m/s."""
    point_starts: np.ndarray
    """(T + 1,) int64: path i has the points `point_starts[i]:point_starts[i + 1]`."""
    ends_m: np.ndarray
    """(T,) float64: arc length of the last recorded position."""
    halts: np.ndarray
    """(T,) bool: whether the vehicle stands when its track ends."""
    sizes: np.ndarray
    """(T, 2) float32: length and width, m."""
    log_arcs_m: np.ndarray
    """(R,) float32: arc length at each recorded frame; it never decreases along a track."""
    row_starts: np.ndarray
    """(T + 1,) int64: track i has the rows `row_starts[i]:row_starts[i + 1]` of `log_arcs_m`."""
    first_frames: np.ndarray
    """(T,) int64: first recorded frame of each track."""


class Paths:
    """The paths of all tracks of the recordings that were needed so far. Deep copies share it."""

    def __init__(self, idm: IDM) -> None:
        """Creates an empty table.

        Args:
            idm: limits the speeds before and in bends.
        """
        self._idm = idm
        self._recordings: dict[int, tuple[Recording, int]] = {}
        self.table = PathTable(
            points=np.zeros((0, 4), dtype=np.float32),
            speed_limits=np.zeros(0, dtype=np.float32),
            point_starts=np.zeros(1, dtype=np.int64),
            ends_m=np.zeros(0),
            halts=np.zeros(0, dtype=bool),
            sizes=np.zeros((0, 2), dtype=np.float32),
            log_arcs_m=np.zeros(0, dtype=np.float32),
            row_starts=np.zeros(1, dtype=np.int64),
            first_frames=np.zeros(0, dtype=np.int64),
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> "Paths":
        del memo
        return self

    def first_path(self, recordings: Sequence[Recording], number: int) -> int:
        """The path of a recording's first track; its paths are added if they are missing.

        Args:
            recordings: the recordings of a world.
            number: index of one of them.
        """
        recording = recordings[number]
        known = self._recordings.get(number)
        if known is None or known[0] is not recording:
            known = recording, len(self.table.ends_m)
            self._recordings[number] = known
            self._add(recording)
        return known[1]

    def _add(self, recording: Recording) -> None:
        starts = np.asarray(recording.starts, dtype=np.int64)
        states = np.ascontiguousarray(recording.states)
        counts = np.zeros(len(recording), dtype=np.int64)
        log_arcs = np.zeros(len(states), dtype=np.float32)
        _measure(states, starts, log_arcs, counts)
        point_starts = np.concatenate([[0], np.cumsum(counts)])
        points = np.zeros((point_starts[-1], 4), dtype=np.float32)
        _write_points(states, starts, log_arcs, point_starts, points)
        speeds = np.abs(states[:, 3])
        halts = speeds[starts[1:] - 1] < MANOEUVRE_STANDING_MPS
        ends = counts - 1 - ROUTE_EXTENSION_M
        desired = np.maximum(np.maximum.reduceat(speeds, starts[:-1]), MIN_DESIRED_MPS)
        limits = np.zeros(len(points), dtype=np.float32)
        _write_speed_limits(
            *(points, point_starts, desired, np.where(halts, ends, np.inf)),
            self._idm.max_lateral_acceleration_mps2,
            self._idm.comfortable_braking_mps2,
            limits,
        )
        table = self.table
        added = PathTable(
            points=points,
            speed_limits=limits,
            point_starts=len(table.points) + point_starts[1:],
            ends_m=ends,
            halts=halts,
            sizes=recording.sizes.astype(np.float32),
            log_arcs_m=log_arcs,
            row_starts=len(table.log_arcs_m) + starts[1:],
            first_frames=recording.first_frames.astype(np.int64),
        )
        self.table = PathTable(*map(np.concatenate, zip(table, added, strict=True)))


@njit(cache=True)
@no_type_check
def _thin_out(states, vertices, arcs):
    """Writes the vertices of one track's path, at least `MIN_STEP_M` apart, and its extension.

    Args:
        states: (R, 4) states [x m, y m, heading rad, speed m/s] of the track.
        vertices: (at least R + 1, 3) x m, y m and arc length m, written.
        arcs: (R,) arc length of each state along the vertices, m, written.

    Returns:
        The number of vertices.
    """
    count, length = 1, 0.0
    vertices[0, 0], vertices[0, 1], vertices[0, 2] = states[0, 0], states[0, 1], 0.0
    arcs[0] = 0.0
    for i in range(1, len(states)):
        x, y = states[i, 0], states[i, 1]
        step = math.hypot(x - vertices[count - 1, 0], y - vertices[count - 1, 1])
        if step >= MIN_STEP_M:
            length += step
            vertices[count, 0], vertices[count, 1], vertices[count, 2] = x, y, length
            count += 1
            step = 0.0
        arcs[i] = max(length + step, arcs[i - 1])
    if count > 1:
        step = vertices[count - 1, 2] - vertices[count - 2, 2]
        cos = (vertices[count - 1, 0] - vertices[count - 2, 0]) / step
        sin = (vertices[count - 1, 1] - vertices[count - 2, 1]) / step
    else:
        cos, sin = math.cos(states[-1, 2]), math.sin(states[-1, 2])
    vertices[count, 0] = vertices[count - 1, 0] + ROUTE_EXTENSION_M * cos
    vertices[count, 1] = vertices[count - 1, 1] + ROUTE_EXTENSION_M * sin
    vertices[count, 2] = length + ROUTE_EXTENSION_M
    return count + 1


@njit(cache=True)
@no_type_check
def _measure(states, starts, arcs, counts):
    """Writes the arc length m of each state (R,) and the number of points of each path (T,).

    States are (R, 4); track i has the rows `starts[i]:starts[i + 1]`.
    """
    vertices = np.zeros((np.diff(starts).max() + 1, 3))
    for track in range(len(starts) - 1):
        rows = slice(starts[track], starts[track + 1])
        last = _thin_out(states[rows], vertices, arcs[rows]) - 1
        counts[track] = int(vertices[last, 2] + 1e-9) + 1


@njit(cache=True)
@no_type_check
def _write_points(states, starts, arcs, point_starts, points):
    """Writes the points of all paths, with the meanings of `_measure` and `PathTable`."""
    vertices = np.zeros((np.diff(starts).max() + 1, 3))
    for track in range(len(starts) - 1):
        rows = slice(starts[track], starts[track + 1])
        last = _thin_out(states[rows], vertices, arcs[rows]) - 1
        k, row, end = 0, starts[track], starts[track + 1] - 1
        for i in range(point_starts[track + 1] - point_starts[track]):
            while vertices[k + 1, 2] < i:
                k += 1
            share = (i - vertices[k, 2]) / (vertices[k + 1, 2] - vertices[k, 2])
            point = points[point_starts[track] + i]
            for axis in range(2):
                step = vertices[k + 1, axis] - vertices[k, axis]
                point[axis] = vertices[k, axis] + share * step
            while row < end and arcs[row] < i:
                row += 1
            heading = states[row, 2]
            if i > vertices[last - 1, 2]:
                dx = vertices[last, 0] - vertices[last - 1, 0]
                dy = vertices[last, 1] - vertices[last - 1, 1]
                heading = math.atan2(dy, dx)
            point[2], point[3] = math.cos(heading), math.sin(heading)


@njit(cache=True)
@no_type_check
def _write_speed_limits(points, point_starts, desired, stops, lateral, braking, limits):
    """Applies `limit_speeds` to each path.

    Args:
        points: (N, 4) as in `PathTable`.
        point_starts: (T + 1,) likewise.
        desired: (T,) highest speed, m/s.
        stops: (T,) arc length from which on the limit is 0, m; infinite if there is none.
        lateral: maximum lateral acceleration, m/s².
        braking: comfortable braking, m/s².
        limits: (N,) m/s, written.
    """
    for track in range(len(point_starts) - 1):
        rows = slice(point_starts[track], point_starts[track + 1])
        limit_speeds(points[rows], desired[track], stops[track], lateral, braking, limits[rows])


class ZoneTable(NamedTuple):
    """The zones of P pairs of paths in flat arrays."""

    keys: np.ndarray
    """(P,) int64: keys of the pairs (`PAIR_KEY_BASE`), ascending."""
    starts: np.ndarray
    """(P,) int64: first zone of each pair."""
    counts: np.ndarray
    """(P,) int64: number of zones of each pair."""
    zones: np.ndarray
    """(Z, ZONE_COLUMNS) float32, described at `ENTRY_A`."""


class UpcomingConflicts(NamedTuple):
    """The zones ahead of each agent, in the order of the other agents' slots."""

    own_zones: np.ndarray
    """(B, A, M) int32: index of the zone, or -1 - index if the agent is on path b."""
    other_agents: np.ndarray
    """(B, A, M) int32: slot of the agent on the other path."""
    counts: np.ndarray
    """(B, A) int32: number of zones of each agent."""

    def resized(self, shape: tuple[int, ...], min_zones: int = 0) -> "UpcomingConflicts":
        """The same for shape (B, A), with room for at least `min_zones` zones per agent."""
        room = max(min_zones, self.own_zones.shape[2])
        return UpcomingConflicts(
            own_zones=resized(self.own_zones, (*shape, room)),
            other_agents=resized(self.other_agents, (*shape, room)),
            counts=resized(self.counts, shape),
        )


def no_conflicts() -> UpcomingConflicts:
    """Empty conflicts, for no agents."""
    return UpcomingConflicts(
        own_zones=np.zeros((0, 0, 0), dtype=np.int32),
        other_agents=np.zeros((0, 0, 0), dtype=np.int32),
        counts=np.zeros((0, 0), dtype=np.int32),
    )


class Conflicts:
    """The zones of all pairs of paths that were needed so far. Deep copies share it."""

    def __init__(self, paths: Paths) -> None:
        self._paths = paths
        self.table = ZoneTable(
            keys=np.zeros(0, dtype=np.int64),
            starts=np.zeros(0, dtype=np.int64),
            counts=np.zeros(0, dtype=np.int64),
            zones=np.zeros((0, ZONE_COLUMNS), dtype=np.float32),
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> "Conflicts":
        del memo
        return self

    def assign(
        self,
        paths: Int[np.ndarray, "b a"],
        agent_mask: Bool[np.ndarray, "b a"],
        arcs_m: Float[np.ndarray, "b a"],
        reset_mask: Bool[np.ndarray, " b"],
        upcoming: UpcomingConflicts,
    ) -> UpcomingConflicts:
        """Finds the zones ahead of agents.

        Args:
            paths: path of each agent, -1 for agents without one.
            agent_mask: mask of the agents that need their zones.
            arcs_m: arc length of each agent along its path.
            reset_mask: mask of the episodes to update.
            upcoming: the zones of the other episodes.

        Returns:
            `upcoming`, resized to the agents and updated in these episodes.
        """
        self._add_pairs(paths[reset_mask], agent_mask[reset_mask])
        episodes = np.flatnonzero(reset_mask)
        upcoming = upcoming.resized(paths.shape)
        _assign(paths, agent_mask, arcs_m, episodes, self.table, upcoming)
        most = int(upcoming.counts.max(initial=0))
        if most > upcoming.own_zones.shape[2]:
            upcoming = upcoming.resized(paths.shape, most)
            _assign(paths, agent_mask, arcs_m, episodes, self.table, upcoming)
        return upcoming

    def _add_pairs(
        self, paths: Int[np.ndarray, "b a"], agent_mask: Bool[np.ndarray, "b a"]
    ) -> None:
        first, second = np.triu_indices(paths.shape[1], k=1)
        a, b = paths[:, first], paths[:, second]
        needed = (a >= 0) & (b >= 0) & (agent_mask[:, first] | agent_mask[:, second])
        a, b = a[needed], b[needed]
        keys = np.unique(np.minimum(a, b) * PAIR_KEY_BASE + np.maximum(a, b))
        table = self.table
        new = np.setdiff1d(keys, table.keys, assume_unique=True)
        if not len(new):
            return
        pairs = np.stack([new // PAIR_KEY_BASE, new % PAIR_KEY_BASE], axis=-1)
        zones = np.zeros((len(pairs), MAX_ZONES, ZONE_COLUMNS), dtype=np.float32)
        counts = np.zeros(len(pairs), dtype=np.int64)
        _find_zones(pairs, self._paths.table, zones, counts)
        starts = len(table.zones) + np.concatenate([[0], np.cumsum(counts)[:-1]])
        keys = np.concatenate([table.keys, new])
        order = np.argsort(keys, kind="stable")
        self.table = ZoneTable(
            keys=keys[order],
            starts=np.concatenate([table.starts, starts])[order],
            counts=np.concatenate([table.counts, counts])[order],
            zones=np.concatenate([table.zones, zones[np.arange(MAX_ZONES) < counts[:, None]]]),
        )


@njit(cache=True)
@no_type_check
def _touching(path, size, i, path_o, size_o, last_o, touch):
    """Finds where a box at one point of a path touches a box on another path.

    Args:
        path: (P, 4) points of the path as in `PathTable`.
        size: (2,) length and width of its vehicle, m.
        i: index of the point.
        path_o: (Q, 4) points of the other path.
        size_o: (2,) length and width of the other vehicle, m.
        last_o: index of the last point of the other path to check.
        touch: distance of the centres beyond which the boxes cannot touch, m.

    Returns:
        Indices of the first and the last touching point, -1 if there is none; index of the nearest
        point; largest cosine between the headings at touching points; lower bound of the distance
        to touching, m.
    """
    x, y, ux, uy = path[i]
    first, last, cosine, clearance = -1, -1, -1.0, np.inf
    nearest, closest = 0, np.inf
    j, before, skipped = 0, np.inf, 0
    while j <= last_o:
        xo, yo, vx, vy = path_o[j]
        away = np.hypot(xo - x, yo - y) - touch
        if away < closest:
            nearest, closest = j, away
        # points are 1 m apart: a skipped one may be this close
        clearance = min(clearance, 0.5 * (away + before - skipped), away)
        before, skipped = away, max(1, int(away))
        if away >= 1.0:
            j += skipped
            continue
        width = size[1] + ZONE_CLEARANCE_M
        if turned_overlaps(x, y, ux, uy, size[0], width, xo, yo, vx, vy, size_o[0], size_o[1]):
            first = j if first < 0 else first
            last = j
            cosine = max(cosine, ux * vx + uy * vy)
        j += 1
    return first, last, nearest, cosine, min(clearance, before - skipped)


@njit(cache=True)
@no_type_check
def _find_pair_zones(path, size, last, path_o, size_o, last_o, zones):
    """Writes the zones of two paths, all columns but `A_FIRST`.

    Args:
        path: (P, 4) points of path a as in `PathTable`.
        size: (2,) length and width of its vehicle, m.
        last: index of the last point of path a to check.
        path_o: (Q, 4) points of path b.
        size_o: (2,) length and width of its vehicle, m.
        last_o: index of the last point of path b to check.
        zones: (MAX_ZONES, ZONE_COLUMNS), written.

    Returns:
        The number of zones.
    """
    touch = 0.5 * (np.hypot(size[0], size[1]) + np.hypot(size_o[0], size_o[1]))
    count, i, inside, exit_cosine = 0, 0, False, 0.0
    while i <= last and count < len(zones):
        first, final, nearest, cosine, clearance = _touching(
            path, size, i, path_o, size_o, last_o, touch
        )
        zone = zones[count]
        if first >= 0:
            if not inside:
                inside = True
                zone[ENTRY_A], zone[ENTRY_B], zone[EXIT_B] = i, first, final
                zone[SAME_DIRECTION] = cosine > SAME_DIRECTION_COSINE
            zone[EXIT_A], zone[LEAD_B] = i, nearest - i
            zone[ENTRY_B], zone[EXIT_B] = min(zone[ENTRY_B], first), max(zone[EXIT_B], final)
            exit_cosine = cosine
            i += 1
            continue
        if inside:
            zone[SAME_DIRECTION] = max(zone[SAME_DIRECTION], exit_cosine > SAME_DIRECTION_COSINE)
            inside = False
            count += 1
        i += max(1, int(clearance))
    if inside:
        zones[count, SAME_DIRECTION] = max(
            zones[count, SAME_DIRECTION], exit_cosine > SAME_DIRECTION_COSINE
        )
        count += 1
    return count


@njit(cache=True)
@no_type_check
def _first_row(arcs, begin, end, arc_m):
    """The first of the rows `begin:end` with at least this arc length; `arcs` never decrease."""
    while begin < end:
        middle = (begin + end) // 2
        if arcs[middle] >= arc_m:
            end = middle
        else:
            begin = middle + 1
    return begin


@njit(cache=True)
@no_type_check
def _find_zones(pairs, paths, zones, counts):
    """Writes the zones of pairs of paths.

    Args:
        pairs: (P, 2) paths a < b.
        paths: a `PathTable`.
        zones: (P, MAX_ZONES, ZONE_COLUMNS), written.
        counts: (P,) number of zones, written.
    """
    points, firsts, ends, sizes = paths.points, paths.point_starts, paths.ends_m, paths.sizes
    arcs, rows, frames = paths.log_arcs_m, paths.row_starts, paths.first_frames
    for n in range(len(pairs)):
        a, b = pairs[n]
        path_a, path_b = points[firsts[a] : firsts[a + 1]], points[firsts[b] : firsts[b + 1]]
        counts[n] = _find_pair_zones(
            path_a, sizes[a], int(ends[a]), path_b, sizes[b], int(ends[b]), zones[n]
        )
        for zone in zones[n, : counts[n]]:
            frame_a = _first_row(arcs, rows[a], rows[a + 1], zone[ENTRY_A]) - rows[a] + frames[a]
            frame_b = _first_row(arcs, rows[b], rows[b + 1], zone[ENTRY_B]) - rows[b] + frames[b]
            zone[A_FIRST] = frame_a <= frame_b


@njit(cache=True)
@no_type_check
def _append(zone, on_b, other, own_zones, other_agents, count):
    """Appends a zone to those of an agent, each (M,), if there is room; the new count."""
    if count < len(own_zones):
        own_zones[count], other_agents[count] = -1 - zone if on_b else zone, other
    return count + 1


@njit(cache=True)
@no_type_check
def _assign(paths, agent_mask, arcs, episodes, table, upcoming):
    """Writes the zones ahead of each agent; counts may exceed the room for zones.

    Args:
        paths: (B, A) path of each agent, -1 for none.
        agent_mask: (B, A) mask of the agents that need their zones.
        arcs: (B, A) arc length of each agent, m.
        episodes: (N,) indices of the episodes to update.
        table: a `ZoneTable` that has all pairs of these agents.
        upcoming: `UpcomingConflicts`, written.
    """
    own_zones, other_agents, counts = upcoming.own_zones, upcoming.other_agents, upcoming.counts
    zones = table.zones
    for b in episodes:
        counts[b] = 0
        for a in range(paths.shape[1]):
            for o in range(a + 1, paths.shape[1]):
                path, path_o = paths[b, a], paths[b, o]
                if path < 0 or path_o < 0 or not (agent_mask[b, a] or agent_mask[b, o]):
                    continue
                swapped = path > path_o
                key = path_o * PAIR_KEY_BASE + path if swapped else path * PAIR_KEY_BASE + path_o
                pair = np.searchsorted(table.keys, key)
                for z in range(table.starts[pair], table.starts[pair] + table.counts[pair]):
                    exit_a = zones[z, EXIT_B] if swapped else zones[z, EXIT_A]
                    exit_o = zones[z, EXIT_A] if swapped else zones[z, EXIT_B]
                    if arcs[b, a] > exit_a or arcs[b, o] > exit_o:
                        continue
                    if agent_mask[b, a]:
                        counts[b, a] = _append(
                            z, swapped, o, own_zones[b, a], other_agents[b, a], counts[b, a]
                        )
                    if agent_mask[b, o]:
                        counts[b, o] = _append(
                            z, not swapped, a, own_zones[b, o], other_agents[b, o], counts[b, o]
                        )
