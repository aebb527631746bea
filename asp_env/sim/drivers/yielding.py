"""What the vehicles of one tick do about those ahead of them and those whose paths cross theirs."""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from asp_env.dynamics import MAX_ACCELERATION_MPS2
from asp_env.sim.drivers.conflicts import A_FIRST, IN_A, IN_B, IN_FILE, OUT_A, OUT_B
from asp_env.sim.idm import free_ahead, idm_acceleration, pursuit_steering

STANDING_MPS = 0.2
PATIENCE_S = 3.0
"""Whoever has stood for so long before a zone is no longer waited for."""
MARGIN_S = 0.5
"""Between one who leaves a zone and another who enters it."""
EARLY_S = 2.5
"""The same for one who goes first although the log says otherwise."""
BINDING_MPS2 = 2.5
"""Whoever needs more than this to stop before a zone is taken to drive into it."""
OFF_PATH_M = 1.5
"""Further from its path nobody is taken to follow it."""


@njit(cache=True)
@no_type_check
def advance(path, arc, x, y):
    """(arc length, offset to the left) of the nearest point of a path, walking from `arc`."""
    last = len(path) - 2
    i = min(max(int(arc), 0), last)
    way = 0
    while True:
        sx, sy = path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1]
        dx, dy = x - path[i, 0], y - path[i, 1]
        square = max(sx * sx + sy * sy, 1e-9)
        share = (dx * sx + dy * sy) / square
        if share > 1.0 and i < last and way >= 0:
            i, way = i + 1, 1
        elif share < 0.0 and i > 0 and way <= 0:
            i, way = i - 1, -1
        else:
            break
    offset = (sx * dy - sy * dx) / math.sqrt(square)
    if 0 < i < last:
        share = min(max(share, 0.0), 1.0)
    return i + share, offset


@njit(cache=True)
@no_type_check
def arrival_s(distance, speed, wanted, acceleration):
    """Time to cover a distance, picking up speed until the wanted one; never less than 0."""
    if distance <= 0.0:
        return 0.0
    if speed >= wanted:
        return distance / max(speed, 0.1)
    picking_up = (wanted - speed) / acceleration
    covered = 0.5 * (wanted + speed) * picking_up
    if distance <= covered:
        return (math.sqrt(speed * speed + 2.0 * acceleration * distance) - speed) / acceleration
    return picking_up + (distance - covered) / wanted


@njit(cache=True)
@no_type_check
def _has_stood(states, valid, now, a, ticks):
    for t in range(now, max(now - ticks, -1), -1):
        if not valid[t, a] or abs(states[t, a, 3]) > STANDING_MPS:
            return False
    return True


@njit(cache=True)
@no_type_check
def _in_file(x, v, wanted, half, law, enters, s, u, wanted_o, enters_o, first, trusts):
    """(gap, speed of what ends it) that keeps the order where two paths lead the same way."""
    ahead = enters + s - enters_o - x  # how far ahead the other one is, seen along my path
    if s >= enters_o:
        return (ahead - half, u) if ahead > half else (enters - x, 0.0)
    to_o = enters_o - s
    if first and trusts:
        binding = to_o < u * u / (2.0 * BINDING_MPS2)
        return (ahead - half, u) if binding and ahead > half else (np.inf, 0.0)
    if ahead > half:
        return ahead - half, u
    mine_s = arrival_s(enters - x, v, wanted, law[0])
    speed = min(math.sqrt(v * v + 2.0 * law[0] * (enters - x)), max(wanted, v))
    between = (arrival_s(to_o, u, wanted_o, law[0]) - mine_s) * max(u, 1.0)
    needed = half + max(u - speed, 0.0) ** 2 / (2.0 * law[0])
    needed += u * (MARGIN_S if first else EARLY_S)
    if between > needed:
        return np.inf, 0.0
    return enters - x, 0.0


@njit(cache=True)
@no_type_check
def _crossing(x, v, wanted, law, enters, leaves, s, u, wanted_o, enters_o, leaves_o, first, trusts):
    """How one stands to a zone that another one crosses.

    0: it stops before it, 1: it drives in first, 2: in its turn, 3: when the other one is out.
    """
    enters_s = arrival_s(enters - x, v, wanted, law[0])
    out_s = (leaves_o - s) / u if u > STANDING_MPS else np.inf
    if enters_s > out_s + MARGIN_S:
        return 3
    if s >= enters_o - 0.5:
        return 0
    if first and trusts:
        binding = enters_o - s < u * u / (2.0 * BINDING_MPS2)
        mine = enters - x < v * v / (2.0 * BINDING_MPS2)
        if mine or not binding:
            return 2
    margin = MARGIN_S if first else EARLY_S
    enters_o_s = arrival_s(enters_o - s, u, wanted_o, law[0])
    clear = arrival_s(leaves - x, v, wanted, law[0]) + margin < enters_o_s
    return 1 if clear else 0


@njit(cache=True)
@no_type_check
def _zones(
    me, states, sizes, arcs, wanted, counts_for, follows, stood, decides, zones, mine, others, law
):
    """(gap to what is to be followed or stopped for, its speed, gap that must be clear, until)."""
    x, v = arcs[me], max(states[me, 3], 0.0)
    best, best_gap, best_speed = law[0], np.inf, 0.0
    clear_from, clear_to = np.inf, np.inf
    reach = max(law[5], law[4] * v)
    for k in range(len(mine)):
        z, o = mine[k], others[k]
        if not follows[o]:
            continue
        if z >= 0:
            enters, leaves = zones[z, IN_A], zones[z, OUT_A]
            enters_o, leaves_o = zones[z, IN_B], zones[z, OUT_B]
        else:
            z = -1 - z
            enters, leaves = zones[z, IN_B], zones[z, OUT_B]
            enters_o, leaves_o = zones[z, IN_A], zones[z, OUT_A]
        s = arcs[o]
        if x >= enters - 0.1 or s > leaves_o or enters - x > reach:
            continue
        first = (zones[z, A_FIRST] > 0) == (mine[k] >= 0)
        u = max(states[o, 3], 0.0)
        if stood[o] and s < enters_o - 0.5:
            continue
        gap, speed = np.inf, 0.0
        if zones[z, IN_FILE]:
            half = 0.5 * (sizes[me, 0] + sizes[o, 0])
            gap, speed = _in_file(
                x, v, wanted[me], half, law, enters, s, u, wanted[o], enters_o, first, decides[o]
            )
        else:
            how = _crossing(
                x,
                v,
                wanted[me],
                law,
                enters,
                leaves,
                s,
                u,
                wanted[o],
                enters_o,
                leaves_o,
                first,
                decides[o],
            )
            if how == 0:
                gap = enters - x
            elif how == 1 and enters - x < clear_from:
                clear_from, clear_to = enters - x, leaves - x
            elif how == 3:
                counts_for[o] = False
        if speed == 0.0 and gap < v * v / (2.0 * MAX_ACCELERATION_MPS2):
            continue  # too late to stop before the zone
        if gap < np.inf:
            acceleration = idm_acceleration(v, wanted[me], gap, speed, law)
            if acceleration < best:
                best, best_gap, best_speed = acceleration, gap, speed
    return best_gap, best_speed, clear_from, clear_to


@njit(cache=True)
@no_type_check
def follow_and_yield(
    states, valid, sizes, now, running, driven, numbers, log_rows, strides, elapsed, arcs,
    points, limits, firsts, log_arcs, rows, zones, mine, others, counts, law, dt, actions,
):  # fmt: skip
    """Actions of the driven agents of all episodes; `arcs`, metres gone, are brought up to now."""
    agents = numbers.shape[1]
    wanted, stood = np.zeros(agents), np.zeros(agents, np.bool_)
    follows, counts_for = np.zeros(agents, np.bool_), np.zeros(agents, np.bool_)
    patience = int(round(PATIENCE_S / dt))
    for b in range(len(now)):
        if not running[b] or not driven[b].any():
            continue
        t = now[b]
        here = states[b, t]
        for a in range(agents):
            follows[a] = False
            n = numbers[b, a]
            if not valid[b, t, a]:
                arcs[b, a] = -1.0
                continue
            if n < 0:
                continue
            path = points[firsts[n] : firsts[n + 1]]
            arc = arcs[b, a]
            if arc < 0.0:
                row = rows[n] + log_rows[b, a] + elapsed[b] * strides[b]
                arc = log_arcs[min(max(row, rows[n]), rows[n + 1] - 1)]
            arc, offset = advance(path, arc, here[a, 0], here[a, 1])
            arcs[b, a] = max(arc, 0.0)
            follows[a] = abs(offset) < OFF_PATH_M
            wanted[a] = limits[firsts[n] + min(int(arcs[b, a] + 0.5), len(path) - 1)]
            stood[a] = _has_stood(states[b], valid[b], t, a, patience)
        for a in range(agents):
            if not driven[b, a]:
                continue
            n = numbers[b, a]
            path, arc = points[firsts[n] : firsts[n + 1]], arcs[b, a]
            counts_for[:] = valid[b, t]
            gap, leader, clear_from, clear_to = _zones(
                a, here, sizes[b], arcs[b], wanted, counts_for, follows, stood, driven[b],
                zones, mine[b, a, : counts[b, a]], others[b, a], law,
            )  # fmt: skip
            speed = here[a, 3]
            acceleration = idm_acceleration(speed, wanted[a], gap, leader, law)
            reach = max(law[5], law[4] * speed)
            gap, leader = free_ahead(here, sizes[b], counts_for, a, path, len(path), arc, reach)
            if gap < clear_to + 1.0 and leader < 1.0:
                gap, leader = min(gap, clear_from), 0.0
            acceleration = min(acceleration, idm_acceleration(speed, wanted[a], gap, leader, law))
            actions[b, a, 0] = acceleration
            actions[b, a, 1] = pursuit_steering(
                here[a, 0], here[a, 1], here[a, 2], speed, sizes[b, a, 0], path, len(path), arc, 0.0
            )
