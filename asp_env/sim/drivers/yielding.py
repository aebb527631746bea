"""What the vehicles of one tick do about those ahead of them and those whose paths cross theirs."""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from asp_env.dynamics import MAX_ACCELERATION_MPS2
from asp_env.sim.drivers.conflicts import A_FIRST, AHEAD_B, IN_A, IN_B, IN_FILE, OUT_A, OUT_B
from asp_env.sim.idm import free_ahead, idm_acceleration, pursuit_steering
from asp_env.sim.world import EGO

STANDING_MPS = 0.2
PATIENCE_S = 3.0
"""Whoever has stood for so long before a zone is no longer waited for."""
MARGIN_S = 0.5
"""Between one who leaves a zone and another who enters it."""
EARLY_S = 2.5
"""The same for one who goes first although the log says otherwise."""
BINDING_MPS2 = 2.5
"""Whoever needs more than this to stop before a zone is taken to drive into it."""
SLOW_MPS, SLOWS_MPS2 = 2.0, 0.5
"""The ego is trusted to give way where it should while it is slow, or slows down by so much."""
OFF_PATH_M = 1.5
"""Further from its path nobody is taken to follow it."""
SOON_S = 1.0
"""Those who do not are also looked for where they will be by then if they go straight on."""


STOPS, AHEAD, IN_TURN, GONE = range(4)
"""One stops before a zone; or it drives in first, although it is not its turn; or because it is; or
since the other one will have left it."""


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
@no_type_check
def _has_stood(states, valid, now, a, ticks):
    for t in range(now, max(now - ticks, -1), -1):
        if not valid[t, a] or abs(states[t, a, 3]) > STANDING_MPS:
            return False
    return True


@njit(cache=True, error_model="numpy")
@no_type_check
def _slows(speed, before, dt):
    """Whether the ego looks as if it gave way: who drives it, and how, is not known."""
    return speed < SLOW_MPS or speed - before < -SLOWS_MPS2 * dt


@njit(cache=True, error_model="numpy")
@no_type_check
def _stray(here, present, numbers, follows, driven, strays, soon):
    """Marks those who drive elsewhere than on their path, and says where they will be soon."""
    found = False
    for a in range(len(strays)):
        # whoever is driven here is on its way back
        strays[a] = present[a] and numbers[a] >= 0 and not (follows[a] or driven[a])
        if strays[a]:
            found = True
            way = here[a, 3] * SOON_S
            soon[a, 0] = here[a, 0] + way * math.cos(here[a, 2])
            soon[a, 1] = here[a, 1] + way * math.sin(here[a, 2])
            soon[a, 2], soon[a, 3] = here[a, 2], here[a, 3]
    # those who look ahead do so from where they are
    if found:
        for a in range(len(strays)):
            if driven[a]:
                soon[a] = here[a]
    return found


@njit(cache=True, error_model="numpy")
@no_type_check
def _in_file(x, v, wanted, half, law, enters, s, u, wanted_o, enters_o, ahead, first, trusts):
    """(gap, speed of what ends it) that keeps the order where two paths lead the same way.

    The other one is `ahead` by so much along the own path.
    """
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


@njit(cache=True, error_model="numpy")
@no_type_check
def _crossing(x, v, wanted, law, enters, leaves, s, u, wanted_o, enters_o, leaves_o, first, trusts):
    """How one stands to a zone that another one crosses."""
    enters_s = arrival_s(enters - x, v, wanted, law[0])
    out_s = (leaves_o - s) / u if u > STANDING_MPS else np.inf
    if enters_s > out_s + MARGIN_S:
        return GONE
    if s >= enters_o - 0.5:
        return STOPS
    if first and trusts:
        binding = enters_o - s < u * u / (2.0 * BINDING_MPS2)
        mine = enters - x < v * v / (2.0 * BINDING_MPS2)
        if mine or not binding:
            return IN_TURN
    margin = MARGIN_S if first else EARLY_S
    enters_o_s = arrival_s(enters_o - s, u, wanted_o, law[0])
    clear = arrival_s(leaves - x, v, wanted, law[0]) + margin < enters_o_s
    return AHEAD if clear else STOPS


@njit(cache=True, error_model="numpy")
@no_type_check
def _limits(zones, z):
    """(enters, leaves) of the agent and of the other one, its arc's lead, whether one is first."""
    zone = zones[z] if z >= 0 else zones[-1 - z]
    if z >= 0:
        return zone[IN_A], zone[OUT_A], zone[IN_B], zone[OUT_B], zone[AHEAD_B], zone[A_FIRST] > 0
    return zone[IN_B], zone[OUT_B], zone[IN_A], zone[OUT_A], -zone[AHEAD_B], zone[A_FIRST] == 0


@njit(cache=True, error_model="numpy")
@no_type_check
def _zones(
    me, states, sizes, arcs, wanted, counts_for, follows, stood, decides, zones, mine, others,
    count, law,
):  # fmt: skip
    """(gap to what is to be followed or stopped for, its speed, gap that must be clear, until).

    Those whom the agent will find gone from a zone no longer count for anything.
    """
    x, v = arcs[me], max(states[me, 3], 0.0)
    most, best_gap, best_speed = law[0], np.inf, 0.0
    clear_from, clear_to = np.inf, np.inf
    reach = max(law[5], law[4] * v)
    for k in range(count):
        o = others[k]
        z = mine[k]
        enters, leaves, enters_o, leaves_o, lead, first = _limits(zones, z)
        s, u = arcs[o], max(states[o, 3], 0.0)
        ahead = 0.1 <= enters - x <= reach and s <= leaves_o
        if not (ahead and follows[o]) or (stood[o] and s < enters_o - 0.5):
            continue
        gap, speed = np.inf, 0.0
        if zones[z if z >= 0 else -1 - z, IN_FILE]:
            half = 0.5 * (sizes[me, 0] + sizes[o, 0])
            gap, speed = _in_file(
                x, v, wanted[me], half, law, enters, s, u, wanted[o], enters_o, s - lead - x, first,
                decides[o],
            )  # fmt: skip
        else:
            how = _crossing(
                x, v, wanted[me], law, enters, leaves, s, u, wanted[o], enters_o, leaves_o, first,
                decides[o],
            )  # fmt: skip
            counts_for[o] &= how != GONE
            gap = enters - x if how == STOPS else np.inf
            if how == AHEAD and enters - x < clear_from:
                clear_from, clear_to = enters - x, leaves - x
        if speed == 0.0 and gap < v * v / (2.0 * MAX_ACCELERATION_MPS2):
            continue  # too late to stop before the zone
        acceleration = idm_acceleration(v, wanted[me], gap, speed, law)
        if acceleration < most:
            most, best_gap, best_speed = acceleration, gap, speed
    return best_gap, best_speed, clear_from, clear_to


@njit(cache=True, error_model="numpy")
@no_type_check
def follow_and_yield(
    states, valid, sizes, now, running, driven, numbers, log_rows, strides, elapsed, arcs,
    points, limits, firsts, log_arcs, rows, zones, mine, others, counts, law, dt, actions,
):  # fmt: skip
    """Actions of the driven agents of all episodes; `arcs`, metres gone, are brought up to now."""
    agents = numbers.shape[1]
    wanted, stood = np.zeros(agents), np.zeros(agents, np.bool_)
    follows, counts_for = np.zeros(agents, np.bool_), np.zeros(agents, np.bool_)
    decides, radii = np.zeros(agents, np.bool_), np.zeros(agents)
    strays, soon = np.zeros(agents, np.bool_), np.zeros((agents, 4), states.dtype)
    patience = round(PATIENCE_S / dt)
    for b in range(len(now)):
        if not running[b] or not driven[b].any():
            continue
        t = now[b]
        past, there, box, gone_m = states[b], valid[b], sizes[b], arcs[b]
        here, present = past[t], there[t]
        for a in range(agents):
            follows[a], n = False, numbers[b, a]
            if not present[a]:
                gone_m[a] = -1.0
                continue
            radii[a] = 0.5 * math.sqrt(box[a, 0] ** 2 + box[a, 1] ** 2)
            if n < 0:
                continue
            path, arc = points[firsts[n] : firsts[n + 1]], gone_m[a]
            row = rows[n] + log_rows[b, a] + elapsed[b] * strides[b]
            row = min(max(row, rows[n]), rows[n + 1] - 1)
            arc = log_arcs[row] if arc < 0.0 else arc
            arc, offset = advance(path, arc, here[a, 0], here[a, 1])
            gone_m[a] = max(arc, 0.0)
            follows[a] = abs(offset) < OFF_PATH_M
            wanted[a] = limits[firsts[n] + min(int(gone_m[a] + 0.5), len(path) - 1)]
            stood[a] = abs(here[a, 3]) <= STANDING_MPS and _has_stood(past, there, t, a, patience)
        some_stray = _stray(here, present, numbers[b], follows, driven[b], strays, soon)
        decides[:] = driven[b]
        decides[EGO] = _slows(here[EGO, 3], past[max(t - 1, 0), EGO, 3], dt)
        for a in range(agents):
            if not driven[b, a]:
                continue
            n = numbers[b, a]
            path, arc, speed = points[firsts[n] : firsts[n + 1]], gone_m[a], here[a, 3]
            counts_for[:] = present
            gap, leader, clear_from, clear_to = _zones(
                a, here, box, gone_m, wanted, counts_for, follows, stood, decides, zones,
                mine[b, a], others[b, a], counts[b, a], law,
            )  # fmt: skip
            acceleration = idm_acceleration(speed, wanted[a], gap, leader, law)
            reach = max(law[5], law[4] * speed)
            gap, leader = free_ahead(here, box, radii, counts_for, a, path, len(path), arc, reach)
            if clear_from < np.inf and gap < clear_to + 1.0 and leader < 1.0:
                gap, leader = min(gap, clear_from), 0.0
            acceleration = min(acceleration, idm_acceleration(speed, wanted[a], gap, leader, law))
            gap = np.inf
            if some_stray:
                gap, leader = free_ahead(soon, box, radii, strays, a, path, len(path), arc, reach)
            acceleration = min(acceleration, idm_acceleration(speed, wanted[a], gap, leader, law))
            actions[b, a, 0] = acceleration
            actions[b, a, 1] = pursuit_steering(
                here[a, 0], here[a, 1], here[a, 2], speed, box[a, 0], path, len(path), arc, 0.0
            )
