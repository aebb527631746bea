"""Conflicts of the ego's path with those of other agents: how little time lies between them.

A *conflict* is that another agent crosses the ego's path or merges with it, before the ego or after
it. The path is the strip as wide as the ego along its route. An agent is *in the path* while its
box, turned by its angle to the route, reaches into that strip. A conflict begins at a tick at which
an agent that moves at 0.5 m/s or more is in the path and was not one tick before, ahead of where
the ego's front is at the first tick, and either

- at an angle of 20° to 160° to the route (crossing, or merging from another road), or
- at less than 20°, after its box was at least 1 m beside the strip (merging from another lane).

It ends when the agent leaves the path or turns within 20° of the route or against it. An agent that
follows the ego or drives ahead of it in its lane, or comes towards it in another lane, is in no
conflict. Conflicts begin within the scenario; the ego may reach their place later, but those whose
place it never reaches do not count.

`pet_s`, the post-encroachment time (Allen, Shin and Cooper, 1978), is the smallest time between the
ego's box and the other's at the same place of the path, no matter which is first: over the ticks of
a conflict, the time from then to the period in which the ego's box reaches over the part of the
route that the other's box covers. It is 0 if they are there together. `pet_behind_s` is the same
over the ticks before that period begins, so that the other agent is first, and 0 likewise.

`dttcp_s` is the smallest |ΔTTCP|: the time to the conflict point at the present speed, the ego's
less the other's. The conflict point is where the other's centre is nearest to the route during the
conflict. Conflicts whose point the two pass at most 5 s apart count, and of those the ticks up to
3 s before the first of the two passes; a value counts if it is not exceeded for 0.6 s. Below
0.5 m/s the time is infinite.

Related is pred2plan's filter for interactive scenarios (arXiv 2505.05638): another agent passes a
point of the ego's path at most 5 s before the ego, and |ΔTTCP| is below 3 s at any of the six ticks
of 0.1 s before. There, leaders in the ego's lane pass such points, too.

Routes, and the agents that count, are those of `asp_env.data.scenarios.tags`. Times of the ego are
interpolated between ticks, those of the other agents are not.
"""

import math
from typing import no_type_check

import numpy as np

from asp_env.compiled import njit
from asp_env.geometry import project, wrap_scalar

# Thresholds of the rules above, chosen by hand except those of pred2plan.

CROSSES_FROM_RAD = math.radians(20)
MOVES_FROM_MPS = 0.5
MERGES_FROM_M = 1.0
PASSES_WITHIN_S = 5.0
CONFLICT_BEFORE_S = 3.0
SUSTAINED_S = 0.6

_NEAR_M = 12.0
"""Agents farther from the route than this are not in the path: half the ego's width and half the
diagonal of the longest agents together are less."""
_COARSE_M = 4
"""Spacing of the points of the route of which the nearest is found before the exact projection."""
_BEYOND_M = 25
"""Agents are projected onto the route up to this far beyond where the ego ends."""
_SEARCH_M = 15.0
"""The ego is projected within this distance of where it is expected, as for tags."""
_ROUNDING = 1e-6


@njit(cache=True)
@no_type_check
def measure_conflicts(tracks, drives, stride, dt_s, out):
    """Writes the smallest post-encroachment times and |ΔTTCP| of scenarios of one recording.

    Args:
        tracks: the track table, see `tags._Tracks`.
        drives: the scenarios, see `tags._Drives`.
        stride: frames per tick.
        dt_s: seconds per tick.
        out: (n, 3) `pet_s`, `pet_behind_s` and `dttcp_s`; on input infinite, which remains
            without a conflict.
    """
    for i in range(len(drives.tracks)):
        e, count, frame = drives.tracks[i], drives.lengths[i] + 1, drives.ticks[i] * stride
        row = tracks.starts[e] + frame - tracks.first[e]
        ego = tracks.states[row : tracks.starts[e + 1] : stride]  # also after the scenario
        route = drives.routes[drives.route_starts[i] : drives.route_starts[i + 1]]
        arcs = np.empty(len(ego))
        near = 0.0
        for t in range(len(ego)):
            if t > 0:
                near += math.hypot(ego[t, 0] - ego[t - 1, 0], ego[t, 1] - ego[t - 1, 1])
            arcs[t], _, _ = project(route, len(route), ego[t, 0], ego[t, 1], near, _SEARCH_M)
            near = max(arcs[t], 0.0)
        for o in range(len(tracks.first)):
            last = frame + (count - 1) * stride
            if o == e or tracks.roles[o] == 0 or tracks.first[o] > last or tracks.last[o] < frame:
                continue
            rows = tracks.states[tracks.starts[o] : tracks.starts[o + 1]]
            _with_agent(
                rows, frame - tracks.first[o], stride, count, ego, arcs, route,
                tracks.sizes[e], tracks.sizes[o], dt_s, out[i],
            )  # fmt: skip


@njit(cache=True)
@no_type_check
def _is_across(angle):
    """Whether an angle to the route, rad, is one of crossing."""
    return CROSSES_FROM_RAD <= abs(angle) <= math.pi - CROSSES_FROM_RAD


@njit(cache=True)
@no_type_check
def _meet(rows, first_row, stride, ego, arcs, route, size, size_o, met):
    """Projects another agent onto the part of the route that the ego drives in the scenario.

    Args:
        rows: (frames, 4) states of the other agent.
        first_row: row of the first tick of the scenario, which may be negative.
        stride: frames per tick.
        ego: (all ticks, 4) states of the ego, also after the scenario.
        arcs: (all ticks,) arc length of the ego, m.
        route: (points, 2) of the ego, 1 m apart.
        size: (2,) length and width of the ego, m.
        size_o: (2,) of the other agent.
        met: (ticks, 6) output: arc length m, offset m, angle to the route rad, speed m/s, distance
            from the agent's box to the strip as wide as the ego m (negative in the path), and half
            the length of the route that the box covers m; NaN where the agent is absent, an
            infinite distance where it is far from the route.

    Returns:
        Whether the agent is ever in the path.
    """
    ever = False
    low_x, high_x, low_y, high_y, farthest = ego[0, 0], ego[0, 0], ego[0, 1], ego[0, 1], arcs[0]
    for t in range(1, len(ego)):
        low_x, high_x = min(low_x, ego[t, 0]), max(high_x, ego[t, 0])
        low_y, high_y = min(low_y, ego[t, 1]), max(high_y, ego[t, 1])
        farthest = max(farthest, arcs[t])
    end = min(len(route), int(farthest) + _BEYOND_M)
    for t in range(len(met)):
        row = first_row + t * stride
        if row < 0 or row >= len(rows):
            continue
        x, y = rows[row, 0], rows[row, 1]
        met[t, 4] = np.inf
        if not (low_x - _NEAR_M < x < high_x + _NEAR_M and low_y - _NEAR_M < y < high_y + _NEAR_M):
            continue
        nearest, best = 0, np.inf
        for j in range(0, end, _COARSE_M):
            dx, dy = route[j, 0] - x, route[j, 1] - y
            if dx * dx + dy * dy < best:
                nearest, best = j, dx * dx + dy * dy
        if best > _NEAR_M * _NEAR_M:
            continue
        near = float(nearest)  # the type with which `project` is compiled already
        arc, offset, heading = project(route, len(route), x, y, near, 2.0 * _COARSE_M)
        angle = wrap_scalar(rows[row, 2] - heading)
        along, across = abs(math.cos(angle)), abs(math.sin(angle))
        width = size[1] + size_o[0] * across + size_o[1] * along
        met[t, 0], met[t, 1], met[t, 2], met[t, 3] = arc, offset, angle, rows[row, 3]
        met[t, 4] = abs(offset) - 0.5 * width
        met[t, 5] = 0.5 * (size_o[0] * along + size_o[1] * across)
        ever |= met[t, 4] < 0.0
    return ever


@njit(cache=True)
@no_type_check
def _with_agent(rows, first_row, stride, count, ego, arcs, route, size, size_o, dt_s, out):
    """Reduces times of a scenario to the smallest ones of the ego and another agent.

    Args:
        rows: (frames, 4) states of the other agent.
        first_row: row of the first tick of the scenario, which may be negative.
        stride: frames per tick.
        count: number of ticks of the scenario.
        ego: (all ticks, 4) states of the ego, also after the scenario.
        arcs: (all ticks,) arc length of the ego, m.
        route: (points, 2) of the ego, 1 m apart.
        size: (2,) length and width of the ego, m.
        size_o: (2,) of the other agent.
        dt_s: seconds per tick.
        out: (3,) `pet_s`, `pet_behind_s` and `dttcp_s`, updated.
    """
    met = np.empty((count, 6))
    met[:] = np.nan
    if not _meet(rows, first_row, stride, ego, arcs, route, size, size_o, met):
        return
    was_beside = False
    for t in range(1, count):
        before, now = met[t - 1, 4], met[t, 4]
        was_beside |= before >= MERGES_FROM_M
        if not (before >= 0.0 and now < 0.0):
            continue
        merges = was_beside and abs(met[t, 2]) < CROSSES_FROM_RAD
        was_beside = False
        ahead, moves = met[t, 0] >= 0.5 * size[0], abs(met[t, 3]) >= MOVES_FROM_MPS
        if not (ahead and moves and (merges or _is_across(met[t, 2]))):
            continue
        last = t
        while last + 1 < count and met[last + 1, 4] < 0.0 and _is_across(met[last + 1, 2]):
            last += 1
        nearest = t
        for k in range(t, last + 1):
            reach = met[k, 5] + 0.5 * size[0]
            arrives = _passing_tick(arcs, met[k, 0] - reach)
            if arrives == np.inf:
                continue
            leaves = _passing_tick(arcs, met[k, 0] + reach)
            out[0] = min(out[0], max(arrives - k, k - leaves, 0.0) * dt_s)
            if k <= leaves:
                out[1] = min(out[1], max(arrives - k, 0.0) * dt_s)
            if abs(met[k, 1]) < abs(met[nearest, 1]):
                nearest = k
        dttcp = _smallest_dttcp(rows, first_row, stride, ego, arcs, met, nearest, dt_s)
        out[2] = min(out[2], dttcp)


@njit(cache=True)
@no_type_check
def _passing_tick(arcs, arc):
    """When the ego reaches an arc length: a tick with its fraction, infinite if it does not.

    Args:
        arcs: (all ticks,) arc length of the ego, m.
        arc: arc length to reach, m.
    """
    for t in range(len(arcs)):
        if arcs[t] >= arc:
            if t == 0:
                return 0.0
            return t - (arcs[t] - arc) / (arcs[t] - arcs[t - 1])
    return np.inf


@njit(cache=True)
@no_type_check
def _smallest_dttcp(rows, first_row, stride, ego, arcs, met, tick, dt_s):
    """Smallest |ΔTTCP| before the ego and another agent pass a conflict point.

    Args:
        rows: (frames, 4) states of the other agent.
        first_row: row of the first tick of the scenario, which may be negative.
        stride: frames per tick.
        ego: (all ticks, 4) states of the ego, also after the scenario.
        arcs: (all ticks,) arc length of the ego, m.
        met: (ticks, 6) output of `_meet`.
        tick: at which the other agent passes the conflict point.
        dt_s: seconds per tick.

    Returns:
        The time, s; infinite if they pass too long apart or are not both moving before.
    """
    point = met[tick, 0]
    passes = _passing_tick(arcs, point)
    if not abs(passes - tick) * dt_s <= PASSES_WITHIN_S + _ROUNDING:
        return np.inf
    begin = min(int(passes), tick)  # the ticks before this one count
    window = int(CONFLICT_BEFORE_S / dt_s + _ROUNDING)
    sustained = max(1, int(SUSTAINED_S / dt_s + _ROUNDING))
    smallest, distance_o = np.inf, 0.0
    differences = np.empty(window)  # from the last tick backwards
    differences[:] = np.inf
    for t in range(tick - 1, max(0, begin - window) - 1, -1):
        row = first_row + t * stride
        if row < 0:
            break
        step_x = rows[row + stride, 0] - rows[row, 0]
        step_y = rows[row + stride, 1] - rows[row, 1]
        distance_o += math.hypot(step_x, step_y)
        speed, speed_o = abs(ego[t, 3]), abs(rows[row, 3])
        if t < begin and min(speed, speed_o) >= MOVES_FROM_MPS:
            ttcp, ttcp_o = (point - arcs[t]) / speed, distance_o / speed_o
            differences[begin - 1 - t] = abs(ttcp - ttcp_o)
    for k in range(window - sustained + 1):
        largest = differences[k]
        for t in range(k + 1, k + sustained):
            largest = max(largest, differences[t])
        smallest = min(smallest, largest)
    return smallest
