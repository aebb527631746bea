"""The driver `idm`: vehicles follow the paths of their tracks and react to each other.

Each vehicle accelerates by the intelligent driver model and steers by pure pursuit
(`asp_env.dynamics.car_following`). It follows what is ahead on its path, and gives way where its
path conflicts with another one (`asp_env.sim.traffic.paths`): the agent whose track entered the
zone first goes first.

The kernels are in one file because numba's cache watches only the file of the kernel that is called
from Python.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool

from asp_env.compiled import njit
from asp_env.data.recording import frames_per_tick
from asp_env.data.scene import EGO
from asp_env.dynamics import MAX_ACCELERATION_MPS2
from asp_env.dynamics.car_following import IDM, free_ahead, idm_acceleration, pursuit_steering
from asp_env.geometry import overlaps
from asp_env.sim.traffic.driver import (
    BaseDriver,
    Control,
    controllable_agents,
    no_control,
    resized,
)
from asp_env.sim.traffic.paths import (
    A_FIRST,
    ENTRY_A,
    ENTRY_B,
    EXIT_A,
    EXIT_B,
    LEAD_B,
    SAME_DIRECTION,
    Conflicts,
    Paths,
    no_conflicts,
)
from asp_env.sim.world import World

SPAWN_CLEARANCE_M = 0.5
"""A vehicle appears only if it can stop this far behind what is ahead of it. Chosen by hand."""

HALTED_M = 1.0
"""A vehicle whose track ends with it standing has arrived within this distance of the end. Chosen
by hand."""

WAITING_MPS = 0.2
"""Agents up to this speed count as standing before a zone. Chosen by hand."""

PATIENCE_S = 3.0
"""Others no longer wait for an agent that has stood before a zone for this long. Chosen by hand: it
resolves deadlocks."""

IN_TURN_GAP_S = 0.5
"""Time between an agent that leaves a zone and one that enters it afterwards. Chosen by hand."""

OUT_OF_TURN_GAP_S = 2.5
"""`IN_TURN_GAP_S` for an agent that goes first although it is not its turn. Chosen by hand."""

COMMITTED_MPS2 = 2.5
"""An agent that must brake harder than this to stop before a zone is expected to enter it. Chosen
by hand."""

YIELDING_MPS, YIELDING_MPS2 = 2.0, 0.5
"""The ego is expected to give way while it is slower than this, or brakes harder than this. Chosen
by hand."""

OFF_PATH_M = 1.5
"""An agent farther from its path is not expected to follow it. Chosen by hand."""

STRAY_HORIZON_S = 1.0
"""Agents off their path are also expected where they are after this time if they continue straight.
Chosen by hand."""

STOP, GO_OUT_OF_TURN, GO_IN_TURN, GO_CLEARED = range(4)
"""What an agent does at a zone: it stops before it; or it enters first, although it is not its turn
or because it is; or the other agent will have left the zone by then."""


class EpisodeArrays(NamedTuple):
    """The state of B episodes of A agents, as `follow_and_yield` reads it."""

    states: np.ndarray
    """(B, K, A, 4) float32 [x m, y m, heading rad, speed m/s]."""
    valid: np.ndarray
    """(B, K, A) bool: present agents."""
    sizes: np.ndarray
    """(B, A, 2) float32: length and width, m."""
    now: np.ndarray
    """(B,) int64: present tick on the axis K."""
    elapsed: np.ndarray
    """(B,) int64: ticks since the start."""
    running: np.ndarray
    """(B,) bool: episodes that are not over."""
    controlled: np.ndarray
    """(B, A) bool: present agents to control."""


class PathProgress(NamedTuple):
    """The path of each agent, and how far along it the agent is."""

    paths: np.ndarray
    """(B, A) int64: path of each agent, -1 for agents without one."""
    rows: np.ndarray
    """(B, A) int64: row at the start of the episode, relative to the first row of the track."""
    strides: np.ndarray
    """(B,) int64: frames per tick."""
    arcs_m: np.ndarray
    """(B, A) float64: arc length of each agent; negative until it is first computed."""


class IDMDriver(BaseDriver):
    """Vehicles follow the paths of their tracks, give way, and react to what is on their path.

    A vehicle desires the highest speed of its track. It leaves at the end of its path; a vehicle
    whose track ends with it standing stops there, and leaves when the track has ended. A vehicle
    appears where and when it was recorded, unless its position is blocked (`spawn_blocked`).
    """

    name = "idm"

    def __init__(self, idm: IDM | None = None) -> None:
        """Creates a driver without agents; `reset` assigns them.

        Args:
            idm: parameters of the model, by default `IDM()`.
        """
        self.idm = idm or IDM()
        self._paths = Paths(self.idm)
        self.conflicts = Conflicts(self._paths)
        self.upcoming = no_conflicts()
        self._agent_mask = np.zeros((0, 0), dtype=bool)
        self._progress = PathProgress(
            paths=np.zeros((0, 0), dtype=np.int64),
            rows=np.zeros((0, 0), dtype=np.int64),
            strides=np.zeros(0, dtype=np.int64),
            arcs_m=np.zeros((0, 0)),
        )

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Computes the paths of the new episodes' agents, and their conflicts."""
        self._agent_mask = controllable_agents(world) if agent_mask is None else agent_mask
        progress = self._progress = _resized(self._progress, self._agent_mask.shape)
        episodes = world.episodes
        for number in np.unique(episodes.recording[reset_mask]).tolist():
            recording = world.recordings[number]
            rows = reset_mask & (episodes.recording == number)
            first_path = self._paths.first_path(world.recordings, number)
            moves = (episodes.ids[rows] >= 0) & ~episodes.parked[rows]
            progress.paths[rows] = np.where(moves, first_path + episodes.tracks[rows], -1)
            progress.strides[rows] = frames_per_tick(recording.frame_rate_hz, world.dt_s)
        table, paths = self._paths.table, progress.paths[reset_mask]
        frames = (episodes.start_tick[reset_mask] * progress.strides[reset_mask])[:, None]
        progress.rows[reset_mask] = frames - table.first_frames[paths]
        row = table.row_starts[paths] + np.maximum(progress.rows[reset_mask], 0)
        row = np.minimum(row, table.row_starts[paths + 1] - 1)
        progress.arcs_m[reset_mask] = table.log_arcs_m[row]
        self.upcoming = self.conflicts.assign(
            progress.paths, self._agent_mask, progress.arcs_m, reset_mask, self.upcoming
        )
        progress.arcs_m[reset_mask] = -1.0

    def control(self, world: World) -> Control:
        """The actions of the model for the present states."""
        control = self.control_some(world, self._agent_mask)
        blocked = spawn_blocked(world, self._agent_mask)
        return Control(
            actions=control.actions,
            controlled=control.controlled,
            leaving=control.leaving | blocked,
        )

    def control_some(self, world: World, agent_mask: Bool[np.ndarray, "b a"]) -> Control:
        """The actions for some of the driver's agents, without agents that are yet to appear.

        Args:
            world: the world of the last `reset`.
            agent_mask: mask of the agents to control; another driver or the world moves the others.
        """
        episodes, rows, now = world.episodes, np.arange(len(world)), world.now
        table, progress = self._paths.table, self._progress
        control = no_control(self._agent_mask.shape)
        present = agent_mask & episodes.valid[rows, now]
        arrays = EpisodeArrays(
            states=episodes.states,
            valid=episodes.valid,
            sizes=episodes.sizes,
            now=now,
            elapsed=episodes.elapsed,
            running=episodes.elapsed < episodes.length,
            controlled=present,
        )
        zones = self.conflicts.table.zones
        follow_and_yield(
            *(arrays, progress, table, zones, self.upcoming),
            *(self.idm.as_row(), world.dt_s, control.actions),
        )
        ends = np.where(progress.paths >= 0, table.ends_m[progress.paths], np.inf)
        halts = table.halts[progress.paths]
        waits = halts & episodes.log_valid[rows, now]
        leaving = present & (progress.arcs_m >= ends - HALTED_M * halts) & ~waits
        return Control(actions=control.actions, controlled=present & ~leaving, leaving=leaving)


def _resized(progress: PathProgress, shape: tuple[int, ...]) -> PathProgress:
    return PathProgress(
        paths=resized(progress.paths, shape),
        rows=resized(progress.rows, shape),
        strides=resized(progress.strides, shape[:1]),
        arcs_m=resized(progress.arcs_m, shape),
    )


def spawn_blocked(world: World, agent_mask: Bool[np.ndarray, "b a"]) -> Bool[np.ndarray, "b a"]:
    """Mask of agents that would appear at the next tick, but whose recorded position is blocked.

    It is blocked if an agent is there, or if the vehicle could not stop behind a slower agent ahead
    with 5 m/s². Such a vehicle never appears: later its recorded positions are among the traffic.

    Args:
        world: the world with all episodes.
        agent_mask: mask of the agents to check.
    """
    episodes = world.episodes
    blocked = np.zeros(agent_mask.shape, dtype=bool)
    _spawn_blocked(
        *(episodes.states, episodes.valid, episodes.log_states, episodes.log_valid),
        *(episodes.sizes, agent_mask, episodes.departed, world.now, world.dt_s, blocked),
    )
    return blocked


@njit(cache=True)
@no_type_check
def _spawn_blocked(states, valid, log_states, log_valid, sizes, agent_mask, departed, now, dt, out):
    """Writes the mask of `spawn_blocked`.

    Args:
        states: (B, K, A, 4) simulated states [x m, y m, heading rad, speed m/s].
        valid: (B, K, A) mask of present agents.
        log_states: (B, K, A, 4) recorded states.
        log_valid: (B, K, A) mask of recorded agents.
        sizes: (B, A, 2) lengths and widths, m.
        agent_mask: (B, A) mask of the agents to check.
        departed: (B, A) mask of agents that have left.
        now: (B,) index of the present tick.
        dt: length of a tick, s.
        out: (B, A), written.
    """
    for b in range(len(now)):
        t = now[b]
        if t + 1 >= valid.shape[1]:
            continue
        for a in range(agent_mask.shape[1]):
            appears = agent_mask[b, a] and log_valid[b, t + 1, a]
            if appears and not (valid[b, t, a] or departed[b, a]):
                out[b, a] = _place_blocked(
                    log_states[b, t + 1, a], sizes[b, a], states[b, t], sizes[b], valid[b, t], dt
                )


@njit(cache=True)
@no_type_check
def _place_blocked(state, size, states, sizes, valid, dt):
    """Whether a box (state (4,), size (2,)), lengthened by its way to brake, overlaps any agent.

    The agents (states (A, 4), sizes (A, 2), valid (A,)) are expected where they are after `dt`.
    """
    cos, sin = math.cos(state[2]), math.sin(state[2])
    for o in range(len(states)):
        if not valid[o]:
            continue
        other = states[o]
        x = other[0] + other[3] * dt * math.cos(other[2])
        y = other[1] + other[3] * dt * math.sin(other[2])
        along = max(other[3] * math.cos(other[2] - state[2]), 0.0)
        needed = max(state[3] ** 2 - along**2, 0.0) / (2.0 * MAX_ACCELERATION_MPS2)
        needed += SPAWN_CLEARANCE_M
        if overlaps(
            state[0] + 0.5 * needed * cos, state[1] + 0.5 * needed * sin, state[2],
            size[0] + needed, size[1], x, y, other[2], sizes[o, 0], sizes[o, 1],
        ):  # fmt: skip
            return True
    return False


@njit(cache=True, error_model="numpy")
@no_type_check
def advance(path, arc, x, y):
    """Finds the nearest point of a path by walking along it.

    Args:
        path: (P, at least 2) x m, y m of points 1 m apart.
        arc: arc length to start from, m.
        x: of the position to project, m.
        y: of the position to project, m.

    Returns:
        Arc length of the nearest point and offset of the position to its left, m. Beyond its ends
        the path continues straight.
    """
    last = len(path) - 2
    i = min(max(int(arc), 0), last)
    direction = 0
    while True:
        sx, sy = path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1]
        dx, dy = x - path[i, 0], y - path[i, 1]
        square = max(sx * sx + sy * sy, 1e-9)
        share = (dx * sx + dy * sy) / square
        if share > 1.0 and i < last and direction >= 0:
            i, direction = i + 1, 1
        elif share < 0.0 and i > 0 and direction <= 0:
            i, direction = i - 1, -1
        else:
            break
    offset = (sx * dy - sy * dx) / math.sqrt(square)
    if 0 < i < last:
        share = min(max(share, 0.0), 1.0)
    return i + share, offset


@njit(cache=True, error_model="numpy")
@no_type_check
def arrival_s(distance, speed, desired, acceleration):
    """Time to cover a distance, s: accelerating up to the desired speed; 0 if it is behind.

    Args:
        distance: m.
        speed: present speed, m/s.
        desired: desired speed, m/s.
        acceleration: m/s², until the desired speed is reached.
    """
    if distance <= 0.0:
        return 0.0
    if speed >= desired:
        return distance / max(speed, 0.1)
    accelerating_s = (desired - speed) / acceleration
    covered = 0.5 * (desired + speed) * accelerating_s
    if distance <= covered:
        return (math.sqrt(speed * speed + 2.0 * acceleration * distance) - speed) / acceleration
    return accelerating_s + (distance - covered) / desired


@njit(cache=True, error_model="numpy")
@no_type_check
def _has_stood(states, valid, now, a, ticks):
    """Whether agent `a` of states (K, A, 4) and valid (K, A) stood for the last `ticks` ticks."""
    for t in range(now, max(now - ticks, -1), -1):
        if not valid[t, a] or abs(states[t, a, 3]) > WAITING_MPS:
            return False
    return True


@njit(cache=True, error_model="numpy")
@no_type_check
def _expect_strays(states, present, paths, follows, controlled, strays, expected):
    """Marks agents that do not follow their path, and writes where they are expected.

    Agents that the driver controls are no strays: they return to their path.

    Args:
        states: (A, 4) present states [x m, y m, heading rad, speed m/s].
        present: (A,) mask of present agents.
        paths: (A,) path of each agent, -1 for none.
        follows: (A,) mask of agents that are on their path.
        controlled: (A,) mask of the driver's agents.
        strays: (A,), written.
        expected: (A, 4), written if there is any stray: strays after `STRAY_HORIZON_S`, controlled
            agents at present.

    Returns:
        Whether there is any stray.
    """
    any_stray = False
    for a in range(len(strays)):
        strays[a] = present[a] and paths[a] >= 0 and not (follows[a] or controlled[a])
        if strays[a]:
            any_stray = True
            distance = states[a, 3] * STRAY_HORIZON_S
            expected[a, 0] = states[a, 0] + distance * math.cos(states[a, 2])
            expected[a, 1] = states[a, 1] + distance * math.sin(states[a, 2])
            expected[a, 2], expected[a, 3] = states[a, 2], states[a, 3]
    if any_stray:
        for a in range(len(strays)):
            if controlled[a]:
                expected[a] = states[a]
    return any_stray


class _Mover(NamedTuple):
    """An agent on its path."""

    arc: float
    """Arc length, m."""
    speed: float
    """Present speed, m/s."""
    desired: float
    """Desired speed, m/s."""


class _Zone(NamedTuple):
    """A zone from the view of one agent; arc lengths in m."""

    entry: float
    exit: float
    entry_o: float
    """Entry of the other agent, along its own path."""
    exit_o: float
    lead_o: float
    """By how much the other agent's arc length is larger at the same point."""
    first: bool
    """Whether it is the agent's turn."""


@njit(cache=True, error_model="numpy")
@no_type_check
def _zone_of(zones, index):
    """The zone (row of (Z, ZONE_COLUMNS)) with an index as in `UpcomingConflicts.own_zones`."""
    zone = zones[index] if index >= 0 else zones[-1 - index]
    if index >= 0:
        return _Zone(
            zone[ENTRY_A], zone[EXIT_A], zone[ENTRY_B], zone[EXIT_B], zone[LEAD_B],
            zone[A_FIRST] > 0,
        )  # fmt: skip
    return _Zone(
        zone[ENTRY_B], zone[EXIT_B], zone[ENTRY_A], zone[EXIT_A], -zone[LEAD_B],
        zone[A_FIRST] == 0,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
@no_type_check
def _same_direction(own, other, zone, half, idm, other_yields):
    """(gap m, speed m/s at its end) that keeps the order where two paths have the same direction.

    Args:
        own: `_Mover` of the agent.
        other: `_Mover` of the other agent.
        zone: `_Zone`.
        half: mean length of both agents, m.
        idm: (6,) row of the model's parameters, `IDM.as_row`.
        other_yields: whether the other agent is expected to give way if it is not its turn.
    """
    ahead = other.arc - zone.lead_o - own.arc
    if other.arc >= zone.entry_o:
        return (ahead - half, other.speed) if ahead > half else (zone.entry - own.arc, 0.0)
    to_entry_o = zone.entry_o - other.arc
    if zone.first and other_yields:
        committed = to_entry_o < other.speed * other.speed / (2.0 * COMMITTED_MPS2)
        return (ahead - half, other.speed) if committed and ahead > half else (np.inf, 0.0)
    if ahead > half:
        return ahead - half, other.speed
    to_entry = zone.entry - own.arc
    entry_s = arrival_s(to_entry, own.speed, own.desired, idm[0])
    entry_speed = min(
        math.sqrt(own.speed * own.speed + 2.0 * idm[0] * to_entry), max(own.desired, own.speed)
    )
    entry_o_s = arrival_s(to_entry_o, other.speed, other.desired, idm[0])
    between = (entry_o_s - entry_s) * max(other.speed, 1.0)
    needed = half + max(other.speed - entry_speed, 0.0) ** 2 / (2.0 * idm[0])
    needed += other.speed * (IN_TURN_GAP_S if zone.first else OUT_OF_TURN_GAP_S)
    if between > needed:
        return np.inf, 0.0
    return to_entry, 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def _crossing(own, other, zone, idm, other_yields):
    """What an agent does at a zone where paths cross; arguments as in `_same_direction`."""
    to_entry = zone.entry - own.arc
    entry_s = arrival_s(to_entry, own.speed, own.desired, idm[0])
    exit_o_s = (zone.exit_o - other.arc) / other.speed if other.speed > WAITING_MPS else np.inf
    if entry_s > exit_o_s + IN_TURN_GAP_S:
        return GO_CLEARED
    if other.arc >= zone.entry_o - 0.5:
        return STOP
    to_entry_o = zone.entry_o - other.arc
    if zone.first and other_yields:
        other_committed = to_entry_o < other.speed * other.speed / (2.0 * COMMITTED_MPS2)
        committed = to_entry < own.speed * own.speed / (2.0 * COMMITTED_MPS2)
        if committed or not other_committed:
            return GO_IN_TURN
    gap_s = IN_TURN_GAP_S if zone.first else OUT_OF_TURN_GAP_S
    entry_o_s = arrival_s(to_entry_o, other.speed, other.desired, idm[0])
    exit_s = arrival_s(zone.exit - own.arc, own.speed, own.desired, idm[0])
    return GO_OUT_OF_TURN if exit_s + gap_s < entry_o_s else STOP


class _Agents(NamedTuple):
    """The agents of one episode at one tick, for the kernels of right of way."""

    states: np.ndarray
    """(A, 4) [x m, y m, heading rad, speed m/s]."""
    sizes: np.ndarray
    """(A, 2) length and width, m."""
    arcs: np.ndarray
    """(A,) arc lengths, m."""
    desired: np.ndarray
    """(A,) desired speeds, m/s."""
    follows: np.ndarray
    """(A,) mask of agents on their path."""
    stood: np.ndarray
    """(A,) mask of agents that have stood for `PATIENCE_S`."""
    yields: np.ndarray
    """(A,) mask of agents that are expected to give way."""


@njit(cache=True, error_model="numpy")
@no_type_check
def _give_way(a, agents, zones, own_zones, other_agents, count, idm, obstacles):
    """What the zones ahead demand of agent `a`.

    Args:
        a: slot of the agent.
        agents: `_Agents`.
        zones: (Z, ZONE_COLUMNS) of `ZoneTable`.
        own_zones: (M,) of `UpcomingConflicts`.
        other_agents: (M,) likewise.
        count: number of zones.
        idm: (6,) `IDM.as_row`.
        obstacles: (A,) mask of agents to follow on the path; those that will have left a zone
            before the agent enters it are removed.

    Returns:
        Gap m to what must be followed or stopped for and the speed m/s at its end; distances m to
        the entry and the exit of the first zone to enter out of turn, which needs a free exit.
    """
    arc, speed = agents.arcs[a], max(agents.states[a, 3], 0.0)
    own = _Mover(arc, speed, agents.desired[a])
    lowest, best_gap, best_speed = idm[0], np.inf, 0.0
    clear_from, clear_to = np.inf, np.inf
    reach = max(idm[5], idm[4] * speed)
    for k in range(count):
        o, index = other_agents[k], own_zones[k]
        zone = _zone_of(zones, index)
        other = _Mover(agents.arcs[o], max(agents.states[o, 3], 0.0), agents.desired[o])
        ahead = 0.1 <= zone.entry - arc <= reach and other.arc <= zone.exit_o
        waits = agents.stood[o] and other.arc < zone.entry_o - 0.5
        if not (ahead and agents.follows[o]) or waits:
            continue
        gap, end_speed = np.inf, 0.0
        if zones[index if index >= 0 else -1 - index, SAME_DIRECTION]:
            half = 0.5 * (agents.sizes[a, 0] + agents.sizes[o, 0])
            gap, end_speed = _same_direction(own, other, zone, half, idm, agents.yields[o])
        else:
            decision = _crossing(own, other, zone, idm, agents.yields[o])
            obstacles[o] &= decision != GO_CLEARED
            gap = zone.entry - arc if decision == STOP else np.inf
            if decision == GO_OUT_OF_TURN and zone.entry - arc < clear_from:
                clear_from, clear_to = zone.entry - arc, zone.exit - arc
        if end_speed == 0.0 and gap < speed * speed / (2.0 * MAX_ACCELERATION_MPS2):
            continue  # too late to stop before the zone
        acceleration = idm_acceleration(speed, own.desired, gap, end_speed, idm)
        if acceleration < lowest:
            lowest, best_gap, best_speed = acceleration, gap, end_speed
    return best_gap, best_speed, clear_from, clear_to


@njit(cache=True, error_model="numpy")
@no_type_check
def follow_and_yield(episodes, progress, paths, zones, upcoming, idm, dt, actions):
    """Computes the actions of the controlled agents of all episodes.

    Args:
        episodes: `EpisodeArrays`.
        progress: `PathProgress`; its `arcs_m` are brought up to date.
        paths: `PathTable`.
        zones: (Z, ZONE_COLUMNS) of `ZoneTable`.
        upcoming: `UpcomingConflicts`.
        idm: (6,) row of the model's parameters, `IDM.as_row`.
        dt: length of a tick, s.
        actions: (B, A, 2) [acceleration m/s², steering rad], written for controlled agents.
    """
    points, firsts, row_starts = paths.points, paths.point_starts, paths.row_starts
    num_agents = progress.paths.shape[1]
    desired, radii = np.zeros(num_agents), np.zeros(num_agents)
    stood, follows = np.zeros(num_agents, np.bool_), np.zeros(num_agents, np.bool_)
    yields, obstacles = np.zeros(num_agents, np.bool_), np.zeros(num_agents, np.bool_)
    strays = np.zeros(num_agents, np.bool_)
    expected = np.zeros((num_agents, 4), episodes.states.dtype)
    patience = round(PATIENCE_S / dt)
    for b in range(len(episodes.now)):
        controlled = episodes.controlled[b]
        if not episodes.running[b] or not controlled.any():
            continue
        t = episodes.now[b]
        past, past_valid = episodes.states[b], episodes.valid[b]
        states, present, sizes = past[t], past_valid[t], episodes.sizes[b]
        own_paths, arcs = progress.paths[b], progress.arcs_m[b]
        for a in range(num_agents):
            follows[a], n = False, own_paths[a]
            if not present[a]:
                arcs[a] = -1.0
                continue
            radii[a] = 0.5 * math.sqrt(sizes[a, 0] ** 2 + sizes[a, 1] ** 2)
            if n < 0:
                continue
            path, arc = points[firsts[n] : firsts[n + 1]], arcs[a]
            row = row_starts[n] + progress.rows[b, a] + episodes.elapsed[b] * progress.strides[b]
            row = min(max(row, row_starts[n]), row_starts[n + 1] - 1)
            arc = paths.log_arcs_m[row] if arc < 0.0 else arc
            arc, offset = advance(path, arc, states[a, 0], states[a, 1])
            arcs[a] = max(arc, 0.0)
            follows[a] = abs(offset) < OFF_PATH_M
            desired[a] = paths.speed_limits[firsts[n] + min(int(arcs[a] + 0.5), len(path) - 1)]
            stood[a] = abs(states[a, 3]) <= WAITING_MPS and _has_stood(
                past, past_valid, t, a, patience
            )
        any_stray = _expect_strays(
            states, present, own_paths, follows, controlled, strays, expected
        )
        yields[:] = controlled
        ego_speed, before = states[EGO, 3], past[max(t - 1, 0), EGO, 3]
        yields[EGO] = ego_speed < YIELDING_MPS or ego_speed - before < -YIELDING_MPS2 * dt
        agents = _Agents(states, sizes, arcs, desired, follows, stood, yields)
        for a in range(num_agents):
            if not controlled[a]:
                continue
            n = own_paths[a]
            path, arc, speed = points[firsts[n] : firsts[n + 1]], arcs[a], states[a, 3]
            count = len(path)
            obstacles[:] = present
            gap, leader, clear_from, clear_to = _give_way(
                a, agents, zones, upcoming.own_zones[b, a], upcoming.other_agents[b, a],
                upcoming.counts[b, a], idm, obstacles,
            )  # fmt: skip
            acceleration = idm_acceleration(speed, desired[a], gap, leader, idm)
            reach = max(idm[5], idm[4] * speed)
            gap, leader = free_ahead(states, sizes, radii, obstacles, a, path, count, arc, reach)
            if clear_from < np.inf and gap < clear_to + 1.0 and leader < 1.0:
                gap, leader = min(gap, clear_from), 0.0
            acceleration = min(acceleration, idm_acceleration(speed, desired[a], gap, leader, idm))
            gap = np.inf
            if any_stray:
                gap, leader = free_ahead(expected, sizes, radii, strays, a, path, count, arc, reach)
            acceleration = min(acceleration, idm_acceleration(speed, desired[a], gap, leader, idm))
            actions[b, a, 0] = acceleration
            actions[b, a, 1] = pursuit_steering(
                states[a, 0], states[a, 1], states[a, 2], speed, sizes[a, 0], path, count, arc, 0.0
            )
