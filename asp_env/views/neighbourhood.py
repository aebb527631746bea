"""Who and what is near each target of a scene: the compiled part of the vector view.

All kernels are in this one file because numba's cache watches only the file of the kernel that is
called from Python: another file's change would go unnoticed.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

AHEAD_M = 20.0
"""How far ahead of the target lies the point around which lines are chosen."""

SIDEWAYS = 1.5
"""What distances across the target's heading are multiplied by in that choice."""

FIRST_GROUP = 7
"""Fields of an agent before those that tell its class."""

FIRST_KIND = 4
"""Fields of a line before those that tell its kind."""


@njit(cache=True, nogil=True)
@no_type_check
def _keep_within(values, low, high):
    """Moves values into their bounds, NaN to the lower one; without bounds does nothing."""
    # In this form the compiler makes vectors of it, which takes a fifth of the time of `np.clip`.
    for i in range(len(low)):
        value, least, most = values[i], low[i], high[i]
        value = value if value >= least else least
        values[i] = value if value <= most else most


@njit(cache=True, nogil=True)
@no_type_check
def target_poses(states, valid, targets, poses):
    """Writes x, y and heading of every target now; of one that is not there, zeros.

    Args:
        states: (situations, slots, ticks, 4) float32, the last tick is now.
        valid: (situations, slots, ticks).
        targets: (targets, 2) situation and slot.
        poses: (targets, 3), written.
    """
    for t in range(len(targets)):
        b, ego = targets[t]
        there = valid[b, ego, -1]
        for field in range(3):  # what is not valid may hold anything
            poses[t, field] = states[b, ego, -1, field] if there else 0.0


@njit(cache=True, nogil=True)
@no_type_check
def place_agents(
    states,
    valid,
    sizes,
    classes,
    groups,
    ids,
    targets,
    frames,
    own_past,
    low,
    high,
    agents,
    agents_valid,
):
    """Writes the agents of every target.

    Args:
        states: (situations, slots, ticks, 4) float32, the last tick is now.
        valid: (situations, slots, ticks).
        sizes: (situations, slots, 2) lengths and widths.
        classes: (situations, slots).
        groups: (classes,) which of the last fields each class sets.
        ids: (situations, slots).
        targets: (targets, 2) situation and slot.
        frames: (targets, 4) x, y, cos and sin of the targets now, float64.
        own_past: whether the targets are shown before now.
        low: (agents · ticks · fields,) the least that is written, or nothing.
        high: (agents · ticks · fields,) the most.
        agents: (targets, agents, ticks, fields), written.
        agents_valid: (targets, agents, ticks), written.
    """
    num_ticks = states.shape[2]
    chosen = np.empty(agents.shape[1], dtype=np.int64)
    distances = np.empty(agents.shape[1])
    for t in range(len(targets)):
        b, ego = targets[t]
        if not valid[b, ego, num_ticks - 1]:
            agents[t], agents_valid[t] = 0.0, False
            continue
        x_0, y_0, cos_0, sin_0 = frames[t, 0], frames[t, 1], frames[t, 2], frames[t, 3]
        count = _choose_agents(
            states[b, :, -1], valid[b, :, -1], ids[b], ego, (x_0, y_0), chosen, distances
        )
        for i in range(count):
            a = chosen[i]
            group = FIRST_GROUP + groups[classes[b, a]]
            first = num_ticks - 1 if i == 0 and not own_past else 0
            for k in range(num_ticks):
                row = agents[t, i, k]
                seen = k >= first and valid[b, a, k]
                agents_valid[t, i, k] = seen
                if not seen:
                    row[:] = 0.0
                    continue
                dx, dy = states[b, a, k, 0] - x_0, states[b, a, k, 1] - y_0
                cos, sin = math.cos(states[b, a, k, 2]), math.sin(states[b, a, k, 2])
                row[0] = cos_0 * dx + sin_0 * dy
                row[1] = cos_0 * dy - sin_0 * dx
                row[2] = cos_0 * cos + sin_0 * sin
                row[3] = cos_0 * sin - sin_0 * cos
                row[4] = states[b, a, k, 3]
                row[5] = sizes[b, a, 0]
                row[6] = sizes[b, a, 1]
                row[FIRST_GROUP:] = 0.0
                row[group] = 1.0
        agents[t, count:], agents_valid[t, count:] = 0.0, False
        _keep_within(agents[t].reshape(-1), low, high)


@njit(cache=True, nogil=True)
@no_type_check
def _choose_agents(states, valid, ids, ego, origin, chosen, distances):
    """Writes the slots of the ego and then of those nearest to it; returns how many there are.

    Args:
        states: (slots, 4) now.
        valid: (slots,) now.
        ids: (slots,).
        ego: slot of the target.
        origin: where it is.
        chosen: (agents,) is written.
        distances: (agents,) is written, squared.
    """
    chosen[0], distances[0] = ego, -1.0
    count = 1
    for a in range(len(valid)):
        if a == ego or not valid[a]:
            continue
        away = (states[a, 0] - origin[0]) ** 2 + (states[a, 1] - origin[1]) ** 2
        # Sorted by insertion. The farthest falls off the end where there are too many.
        place = count
        while away < distances[place - 1] or (
            away == distances[place - 1] and ids[a] < ids[chosen[place - 1]]
        ):
            place -= 1
            if place + 1 < len(chosen):
                chosen[place + 1], distances[place + 1] = chosen[place], distances[place]
        if place < len(chosen):
            chosen[place], distances[place] = a, away
            count = min(count + 1, len(chosen))
    return count


@njit(cache=True, nogil=True)
@no_type_check
def place_lines(
    middles, points, kinds, valid, targets, here, frames, low, high, lines, lines_valid
):
    """Writes the lines of those targets that are on one map; of one that is not there, zeros.

    Args:
        middles: (2, pieces) of the map's pieces.
        points: (pieces, points, 4) x, y, cos, sin.
        kinds: (pieces,) indices into `KINDS`.
        valid: (situations, slots, ticks), the last tick is now.
        targets: (targets, 2) situation and slot.
        here: (situations,) whether it is on this map.
        frames: (targets, 4) x, y, cos and sin of the targets now, float64.
        low: (lines · points · fields,) the least that is written, or nothing.
        high: (lines · points · fields,) the most.
        lines: (targets, lines, points, fields); those of the targets here are written.
        lines_valid: (targets, lines, points), the same.
    """
    chosen = np.arange(min(lines.shape[1], len(kinds)))
    distances, scratch = np.empty(len(kinds)), np.empty(len(kinds))
    for t in range(len(targets)):
        b, ego = targets[t]
        if not here[b]:
            continue
        if not valid[b, ego, -1]:
            lines[t], lines_valid[t] = 0.0, False
            continue
        x_0, y_0, cos_0, sin_0 = frames[t, 0], frames[t, 1], frames[t, 2], frames[t, 3]
        if len(chosen) < len(kinds):
            _choose_pieces(middles, (x_0, y_0, cos_0, sin_0), chosen, distances, scratch)
        for i in range(len(chosen)):
            piece, kind = points[chosen[i]], FIRST_KIND + kinds[chosen[i]]
            for k in range(points.shape[1]):
                dx, dy = piece[k, 0] - x_0, piece[k, 1] - y_0
                row = lines[t, i, k]
                row[0] = cos_0 * dx + sin_0 * dy
                row[1] = cos_0 * dy - sin_0 * dx
                row[2] = cos_0 * piece[k, 2] + sin_0 * piece[k, 3]
                row[3] = cos_0 * piece[k, 3] - sin_0 * piece[k, 2]
                row[FIRST_KIND:] = 0.0
                row[kind] = 1.0
        lines[t, len(chosen) :] = 0.0
        _keep_within(lines[t].reshape(-1), low, high)
        lines_valid[t, : len(chosen)], lines_valid[t, len(chosen) :] = True, False


@njit(cache=True, nogil=True)
@no_type_check
def _choose_pieces(middles, frame, chosen, distances, scratch):
    """Writes the indices of the nearest pieces in their order; of equally near ones the first.

    Args:
        middles: (2, pieces).
        frame: x, y, cos and sin of the target now.
        chosen: (lines,) is written; fewer than there are pieces.
        distances: (pieces,) is written, squared.
        scratch: (pieces,) is written.
    """
    x_0, y_0, cos_0, sin_0 = frame
    most = len(chosen)
    if most == 0:
        return
    for p in range(len(distances)):
        dx, dy = middles[0, p] - x_0, middles[1, p] - y_0
        ahead = cos_0 * dx + sin_0 * dy - AHEAD_M
        left = SIDEWAYS * (cos_0 * dy - sin_0 * dx)
        distances[p] = ahead * ahead + left * left
    limit = _kth_smallest(distances, most - 1, scratch)
    ties = most
    for p in range(len(distances)):
        ties -= distances[p] < limit
    i = 0
    for p in range(len(distances)):
        if distances[p] < limit or (distances[p] == limit and ties > 0):
            ties -= distances[p] == limit
            chosen[i] = p
            i += 1


@njit(cache=True, nogil=True)
@no_type_check
def _kth_smallest(values, k, scratch):
    """The value that would be at index `k` if the values were sorted (Hoare's selection).

    `np.partition` gives the same and takes three times as long.
    """
    scratch[:] = values
    low, high = 0, len(scratch) - 1
    while low < high:
        pivot = scratch[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while scratch[i] < pivot:
                i += 1
            while scratch[j] > pivot:
                j -= 1
            if i <= j:
                scratch[i], scratch[j] = scratch[j], scratch[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return scratch[k]
