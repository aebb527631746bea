"""Who may come: nobody is put into somebody else, nor where it could not stop behind them.

MERGED: What the vehicles of one tick do about those ahead of them and those whose paths cross theirs.
MERGED: Vehicles that follow their logged path, give way, and react to whoever is on it.
"""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Bool
from numba import njit

from asp_env.data.recording import frames_per_tick
from asp_env.data.scene import EGO
from asp_env.dynamics import MAX_ACCELERATION_MPS2
from asp_env.dynamics.car_following import IDM, free_ahead, idm_acceleration, pursuit_steering
from asp_env.geometry import overlaps
from asp_env.sim.traffic.driver import BaseDriver, Control, no_control, resized, vehicles
from asp_env.sim.traffic.paths import (
    A_FIRST,
    AHEAD_B,
    IN_A,
    IN_B,
    IN_FILE,
    OUT_A,
    OUT_B,
    Ahead,
    Conflicts,
    Paths,
)
from asp_env.sim.world import World

SPARE_M = 0.5


@njit(cache=True)
@no_type_check
def _blocked(comer, size, states, sizes, valid, dt):
    """Whether the box, lengthened by what it needs to brake, holds anybody's at the next tick."""
    cos, sin = math.cos(comer[2]), math.sin(comer[2])
    for o in range(len(states)):
        if not valid[o]:
            continue
        other = states[o]
        x = other[0] + other[3] * dt * math.cos(other[2])
        y = other[1] + other[3] * dt * math.sin(other[2])
        along = max(other[3] * math.cos(other[2] - comer[2]), 0.0)
        needed = max(comer[3] ** 2 - along**2, 0.0) / (2.0 * MAX_ACCELERATION_MPS2) + SPARE_M
        if overlaps(
            comer[0] + 0.5 * needed * cos, comer[1] + 0.5 * needed * sin, comer[2],
            size[0] + needed, size[1], x, y, other[2], sizes[o, 0], sizes[o, 1],
        ):  # fmt: skip
            return True
    return False


@njit(cache=True)
@no_type_check
def _block_spawns(states, valid, log_states, log_valid, sizes, agent_mask, gone, now, dt, out):
    for b in range(len(now)):
        t = now[b]
        if t + 1 >= valid.shape[1]:
            continue
        for a in range(agent_mask.shape[1]):
            comes = (
                agent_mask[b, a] and log_valid[b, t + 1, a] and not (valid[b, t, a] or gone[b, a])
            )
            if comes:
                out[b, a] = _blocked(
                    log_states[b, t + 1, a], sizes[b, a], states[b, t], sizes[b], valid[b, t], dt
                )


def spawn_blocked(world: World, agent_mask: Bool[np.ndarray, "b a"]) -> Bool[np.ndarray, "b a"]:
    """Whose logged place at the next tick, at which it would appear, is taken.

    So is it if somebody stands, or drives more slowly the same way, nearer than the vehicle could
    brake at 5 m/s². Whoever is barred never comes: later on its logged place lies amid the traffic.
    """
    episodes = world.episodes
    out = np.zeros(agent_mask.shape, dtype=bool)
    _block_spawns(
        episodes.states, episodes.valid, episodes.log_states, episodes.log_valid, episodes.sizes,
        agent_mask, episodes.gone, world.now, world.dt_s, out,
    )  # fmt: skip
    return out


YIELD_STANDING_MPS = 0.2
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
        if not valid[t, a] or abs(states[t, a, 3]) > YIELD_STANDING_MPS:
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
    out_s = (leaves_o - s) / u if u > YIELD_STANDING_MPS else np.inf
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
            stood[a] = abs(here[a, 3]) <= YIELD_STANDING_MPS and _has_stood(
                past, there, t, a, patience
            )
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


HALTED_M = 1.0
"""A vehicle that is to halt has done so within this distance of the place."""


class IDMDriver(BaseDriver):
    """Vehicles follow their logged path, give way, and react to whoever is on it; others replay.

    A vehicle wants the highest speed that it had in its log. It leaves behind the path's end; one
    whose log ends with it standing comes to stand there, and leaves when the log has ended.
    """

    name = "idm"

    def __init__(self, idm: IDM | None = None) -> None:
        """A driver with the given parameters, or the default ones."""
        self.idm = idm or IDM()
        self._paths = Paths(self.idm)
        self.conflicts = Conflicts(self._paths)
        self.ahead = Ahead()
        self._agent_mask = np.zeros((0, 0), dtype=bool)
        self._numbers = np.zeros((0, 0), dtype=np.int64)
        """Of the agents' paths; -1 for those without."""
        self._rows = np.zeros((0, 0), dtype=np.int64)
        """Of each track's recorded frames, the one at the first tick."""
        self._strides = np.zeros(0, dtype=np.int64)
        self._arcs = np.zeros((0, 0))
        """How far along its path each agent is; negative where that is to be looked up."""

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Takes the paths of the new episodes' agents from their recordings."""
        self._agent_mask = vehicles(world) if agent_mask is None else agent_mask
        self._fit()
        episodes, paths = world.episodes, self._paths
        for number in np.unique(episodes.recording[reset_mask]).tolist():
            recording = world.recordings[number]
            here = reset_mask & (episodes.recording == number)
            base = paths.base(world.recordings, number)
            moves = (episodes.ids[here] >= 0) & ~episodes.parked[here]
            self._numbers[here] = np.where(moves, base + episodes.tracks[here], -1)
            self._strides[here] = frames_per_tick(recording.frame_rate_hz, world.dt_s)
        numbers = self._numbers[reset_mask]
        frames = (episodes.start_tick[reset_mask] * self._strides[reset_mask])[:, None]
        self._rows[reset_mask] = frames - paths.first_frames[numbers]
        at = paths.rows[numbers] + np.maximum(self._rows[reset_mask], 0)
        self._arcs[reset_mask] = paths.arcs[np.minimum(at, paths.rows[numbers + 1] - 1)]
        self.conflicts.deal(self._numbers, self._agent_mask, self._arcs, reset_mask, self.ahead)
        self._arcs[reset_mask] = -1.0

    def control(self, world: World) -> Control:
        """What the law says for the present states."""
        control = self.drive(world, self._agent_mask)
        stays_away = spawn_blocked(world, self._agent_mask)
        return Control(
            actions=control.actions, driven=control.driven, leaving=control.leaving | stays_away
        )

    def drive(self, world: World, some: Bool[np.ndarray, "b a"]) -> Control:
        """The same for some of its agents, while the others are moved by somebody else."""
        episodes, paths, ahead = world.episodes, self._paths, self.ahead
        rows, now = np.arange(len(world)), world.now
        out = no_control(self._agent_mask.shape)
        driven = some & episodes.valid[rows, now]
        follow_and_yield(
            episodes.states, episodes.valid, episodes.sizes, now,
            episodes.elapsed < episodes.length, driven, self._numbers, self._rows, self._strides,
            episodes.elapsed, self._arcs, paths.points, paths.limits, paths.firsts, paths.arcs,
            paths.rows, self.conflicts.zones, ahead.zones, ahead.others, ahead.counts,
            self.idm.as_row(), world.dt_s, out.actions,
        )  # fmt: skip
        ends = np.where(self._numbers >= 0, paths.ends[self._numbers], np.inf)
        halts = paths.halts[self._numbers]
        waits = halts & episodes.log_valid[rows, now]
        leaving = driven & (self._arcs >= ends - HALTED_M * halts) & ~waits
        return Control(actions=out.actions, driven=driven & ~leaving, leaving=leaving)

    def _fit(self) -> None:
        shape = self._agent_mask.shape
        self._strides = resized(self._strides, shape[:1])
        for name in ("_numbers", "_rows", "_arcs"):
            setattr(self, name, resized(getattr(self, name), shape))
