"""Tags and measures of scenarios, computed from the recording by exact rules.

Only the ticks of the scenario count, from the first observation to the last tick. The ego's route
is its recorded track until that ends, then straight on (`asp_env.geometry.route_along`). "Other
agents" are all except parked ones. An agent is *on the route* while its centre is nearer to the
route than half the sum of both widths. A *leader* is a vehicle or bicycle on the route ahead of the
ego that heads within 45° of the route or stands. An agent *enters the route from the side* at a
tick if it is on the route, was not on it one tick before, is ahead of the ego's front on the
recorded part of the route, and moves at 0.5 m/s or more at an angle of at least 20° to the route,
in either direction.

`left`, `right`, `straight`: the heading turns by more than 30° to the left in total, to the right,
    or by less; every scenario has one of these. Headings below 0.5 m/s are ignored.
`u-turn`: the heading turns by more than 150° in total, and the scenario is no `roundabout`.
`standing-start`: the ego is slower than 0.5 m/s at the first tick.
`stopping`: the ego stands, below 0.5 m/s, for at least 1 s without interruption, after it has
    driven at 2 m/s or more.
`following`: at more than half of the ticks at which the ego drives at 0.5 m/s or more, there is a
    leader, and the gap to it is at most 3 s at the ego's speed, or at most 5 m.
`yielding`: an agent enters the route from the side at most 20 m ahead of the ego's front, with no
    leader in between, and the ego's front reaches that point up to 5 s after the agent was last on
    the route at an angle of at least 20° to it. Between 3 s before the agent entered and the ego's
    arrival, the ego is slowest no later than 1 s after the agent was last on the route. Its speed
    is then below 0.5 m/s or at most 0.6 of its highest speed in the 5 s before, and it arrives at
    least 1 m/s faster than that.
`crossing-vru`: a pedestrian, bicycle or animal crosses the centre of the recorded route at most
    30 m ahead of the ego's front, at 0.5 m/s or more and at an angle of at least 30° to the route,
    in either direction.
`roundabout`: the ego drives at least 10 m along a roundabout of the map, within 2 m of the centre
    line of one of its lanes and heading within 45° of it.
`roundabout-entry`, `roundabout-exit`: a `roundabout` that the ego enters; that it leaves.
`interactive`: `pet_behind_s` is at most 5 s (`asp_env.data.scenarios.conflicts`): another agent
    crosses the ego's path or merges with it, and the ego is at that place up to 5 s later. It
    depends on the recording alone, so that it favours no predictor or planner.

Recordings have no traffic signals, so waiting at a signal while others cross is `yielding`, too.

A roundabout is a ring of lanes, each of which leads to the others along successors, around a common
centre. On at least nine tenths of its points the direction of travel, all clockwise or all
counter-clockwise, is within 35° of the tangent of a circle about the ring's centroid. No point is
more than 100 m from the centroid, or more than three times as far as another point.

All kernels that `describe` calls are in this file or `conflicts.py`, and none calls one of the
other file, because numba's cache checks only the file of the kernel that Python calls;
`asp_env.geometry` is the exception.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.compiled import njit
from asp_env.data.classes import PREDICTED, VULNERABLE, AgentClass
from asp_env.data.recording import Recording
from asp_env.data.road_map import RoadMap
from asp_env.data.scenarios.conflicts import measure_conflicts
from asp_env.geometry import project, resample, route_along, wrap_scalar

TAGS = (
    *("left", "right", "straight", "u-turn"),
    *("standing-start", "stopping", "following", "yielding", "crossing-vru"),
    *("roundabout", "roundabout-entry", "roundabout-exit"),
    "interactive",
)
"""Names of the tags, in the order of the columns of `describe`."""

COLUMNS = {
    "length_s": "how long the recording continues after the first observation",
    "distance_m": "distance that the ego drives",
    "max_speed_mps": "highest speed of the ego",
    "turn_deg": "total change of the ego's heading while it does not stand, left positive",
    "density": "number of other agents within 30 m of the ego, mean over the ticks",
    "agents": "number of other agents that are present at any tick",
    "max_density": "largest number of other agents within 30 m of the ego at any tick",
    "pet_s": "post-encroachment time: smallest time between the ego and another agent at the "
    "crossing or merging of their paths; infinite without one",
    "pet_behind_s": "the same of agents that are first; infinite without one",
    "dttcp_s": "smallest difference of the times to the conflict point at present speeds; infinite "
    "without a conflict",
}
"""Names of the measures with their descriptions, in the order of the columns of `describe`."""

# Thresholds of the rules above, chosen by hand. Those that appear in the rules have no other text.

TURN_RAD = math.pi / 6
"""A change of heading beyond this is a turn."""

U_TURN_RAD = math.radians(150)

MANOEUVRE_STANDING_MPS = 0.5
"""Agents slower than this stand, as far as tags are concerned; their headings are ignored."""

STOP_DURATION_S = 1.0
DRIVING_MPS = 2.0
LEADER_GAP_S = 3.0
LEADER_GAP_M = 5.0
SAME_DIRECTION_RAD = math.pi / 4
SIDE_ENTRY_RAD = math.radians(20)
CROSSING_RAD = math.radians(30)
YIELD_AHEAD_M = 20.0
YIELD_BEFORE_S = 3.0
YIELD_ARRIVAL_S = 5.0
YIELD_SLOWEST_S = 1.0
YIELD_SPEED_SHARE = 0.6
YIELD_SPEED_OVER_S = 5.0
YIELD_SPEED_GAIN_MPS = 1.0
CROSSING_AHEAD_M = 30.0
ROUNDABOUT_M = 10.0
ROUNDABOUT_HALF_WIDTH_M = 2.0
DENSITY_RADIUS_M = 30.0
INTERACTIVE_S = 5.0
MAX_RADIUS_M = 100.0
MAX_RADIUS_RATIO = 3.0
TANGENTIAL_SHARE = 0.9
TANGENTIAL_RAD = np.radians(35)

BEYOND_M = 60.0
"""The route continues straight for this far beyond the end of the track."""

_LEADER_BIT, _VULNERABLE_BIT, _PRESENT_BIT = 1, 2, 4

_NEAR_ROUTE_M = 8.0
"""Agents farther from the route than this are not projected onto it."""
_LOOK_AHEAD_M = 60
"""Agents are projected onto at least this length of the route ahead of the ego."""
_LONGEST_M = 25
"""Longest distance between a centre and a bumper, for both vehicles together."""
_LOOK_BACK_M = 10
"""Agents are projected onto this length of the route behind the ego."""
_COARSE_M = 4
"""Spacing of the points of the route of which the nearest is found before the exact projection."""
_ROUNDING = 1e-6

(
    _LEFT, _RIGHT, _STRAIGHT, _U_TURN, _STANDING_START, _STOPPING, _FOLLOWING, _YIELDING,
    _CROSSING_VRU, _ROUNDABOUT, _ENTRY, _EXIT, _INTERACTIVE,
) = range(13)  # fmt: skip
(
    _LENGTH, _DISTANCE, _MAX_SPEED, _TURN, _DENSITY, _AGENTS, _MAX_DENSITY, _PET, _PET_BEHIND,
    _DTTCP,
) = range(10)  # fmt: skip


def describe(
    recording: Recording,
    tracks: Int[np.ndarray, " n"],
    start_ticks: Int[np.ndarray, " n"],
    lengths: Int[np.ndarray, " n"],
    *,
    stride: int,
) -> tuple[Bool[np.ndarray, "n tags"], Float[np.ndarray, "n columns"]]:
    """Tags and measures of scenarios of one recording.

    Args:
        recording: the recording.
        tracks: indices of the egos' tracks.
        start_ticks: ticks of the first observations.
        lengths: lengths in ticks; all ticks must be within the egos' tracks.
        stride: frames per tick.

    Returns:
        Which of `TAGS` each scenario has, and its `COLUMNS`.
    """
    tags = np.zeros((len(tracks), len(TAGS)), dtype=bool)
    values = np.zeros((len(tracks), len(COLUMNS)))
    first = recording.first_frames.astype(np.int64)
    routes = [np.zeros((0, 2), dtype=np.float32)]
    for track, tick in zip(tracks.tolist(), start_ticks.tolist(), strict=True):
        ahead = recording.track(track)[tick * stride - first[track] :: stride]
        routes.append(route_along(ahead, beyond_m=BEYOND_M))
    table = _Tracks(
        states=np.array(recording.states),  # copies of read-only arrays: one compiled kernel
        starts=recording.starts.astype(np.int64),
        first=first,
        last=recording.last_frames.astype(np.int64),
        sizes=np.array(recording.sizes),
        roles=_roles(recording),
    )
    drives = _Drives(
        tracks=tracks.astype(np.int64),
        ticks=start_ticks.astype(np.int64),
        lengths=lengths.astype(np.int64),
        routes=np.concatenate(routes),
        route_starts=np.cumsum([len(route) for route in routes]),
    )
    dt_s = stride / recording.frame_rate_hz
    ring = roundabout_points(recording.road_map)
    _describe_all(table, drives, stride, dt_s, ring, tags, values)
    conflicts = np.full((len(tracks), 3), np.inf)
    measure_conflicts(table, drives, stride, dt_s, conflicts)
    values[:, [_PET, _PET_BEHIND, _DTTCP]] = conflicts
    tags[:, _INTERACTIVE] = values[:, _PET_BEHIND] <= INTERACTIVE_S
    return tags, values


def roundabout_points(road_map: RoadMap) -> Float[np.ndarray, "points 3"]:
    """Points at most 1 m apart on the lanes of all roundabouts of a map.

    Returns:
        [x m, y m, direction of travel rad].
    """
    found = [np.zeros((0, 3))]
    for ring in _rings(road_map):
        lanes = [_directed(road_map.lanes[int(lane)]) for lane in np.flatnonzero(ring)]
        points = np.concatenate(lanes)
        if _is_circular(points):
            found.append(points)
    return np.concatenate(found)


def _rings(road_map: RoadMap) -> list[Bool[np.ndarray, " lanes"]]:
    """Masks of the lanes of each ring: strongly connected components of the graph of successors."""
    count = len(road_map.lanes)
    reachable = np.zeros((count, count), dtype=bool)
    reachable[road_map.successors[:, 0], road_map.successors[:, 1]] = True
    for _ in range(max(count, 1).bit_length()):
        reachable |= (reachable.astype(np.float32) @ reachable.astype(np.float32)) > 0
    mutual = reachable & reachable.T
    rings, assigned = [], np.zeros(count, dtype=bool)
    for lane in np.flatnonzero(mutual.diagonal()):
        if not assigned[lane]:
            rings.append(mutual[lane])
            assigned |= mutual[lane]
    return rings


def _directed(lane: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 3"]:
    """Points about 1 m apart with the direction to the next point, rad."""
    points = np.concatenate([resample(lane, 1.0), lane[-1:]])
    step = np.diff(points, axis=0)
    direction = np.arctan2(step[:, 1], step[:, 0])
    return np.column_stack([points[:-1], direction])


def _is_circular(points: Float[np.ndarray, "n 3"]) -> bool:
    outward = points[:, :2] - points[:, :2].mean(axis=0)
    radius = np.hypot(*outward.T)
    if radius.max() > MAX_RADIUS_M or radius.max() > MAX_RADIUS_RATIO * radius.min():
        return False
    # sine of the angle from the outward vector to the direction: 1 on a counter-clockwise circle
    sine = (outward[:, 0] * np.sin(points[:, 2]) - outward[:, 1] * np.cos(points[:, 2])) / radius
    limit = np.cos(TANGENTIAL_RAD)
    return bool(max((sine >= limit).mean(), (sine <= -limit).mean()) >= TANGENTIAL_SHARE)


def _roles(recording: Recording) -> Int[np.ndarray, " tracks"]:
    """Bits for what each agent can be to an ego; 0 for parked agents."""
    leads = [int(kind) for kind in PREDICTED | {AgentClass.BICYCLE, AgentClass.TRAILER}]
    vulnerable = [int(kind) for kind in VULNERABLE]
    roles = np.full(len(recording), _PRESENT_BIT, dtype=np.int64)
    roles[np.isin(recording.classes, leads)] |= _LEADER_BIT
    roles[np.isin(recording.classes, vulnerable)] |= _VULNERABLE_BIT
    roles[recording.parked] = 0
    return roles


class _Tracks(NamedTuple):
    """The track table of a recording, as kernels use it."""

    states: np.ndarray
    """(rows, 4) [x m, y m, heading rad, speed m/s]."""
    starts: np.ndarray
    """(tracks + 1,) row of each track's first state."""
    first: np.ndarray
    """(tracks,) first frames."""
    last: np.ndarray
    """(tracks,) last frames."""
    sizes: np.ndarray
    """(tracks, 2) length and width, m."""
    roles: np.ndarray
    """(tracks,) bits; 0 for agents that are ignored."""


class _Drives(NamedTuple):
    """n scenarios of a recording."""

    tracks: np.ndarray
    """(n,) indices of the egos' tracks."""
    ticks: np.ndarray
    """(n,) ticks of the first observations."""
    lengths: np.ndarray
    """(n,) lengths in ticks."""
    routes: np.ndarray
    """(points, 2) all egos' routes, points 1 m apart, back to back."""
    route_starts: np.ndarray
    """(n + 1,) index of each route's first point."""


@njit(cache=True)
@no_type_check
def _describe_all(tracks, drives, stride, dt_s, ring, tags, values):
    """Computes the tags and measures of scenarios of one recording.

    Args:
        tracks: `_Tracks`.
        drives: `_Drives`.
        stride: frames per tick.
        dt_s: seconds per tick.
        ring: (points, 3) of roundabouts, [x m, y m, direction rad].
        tags: (n, tags) output.
        values: (n, columns) output.
    """
    for i in range(len(drives.tracks)):
        e, count, frame = drives.tracks[i], drives.lengths[i] + 1, drives.ticks[i] * stride
        row = tracks.starts[e] + frame - tracks.first[e]
        ego = tracks.states[row : row + (count - 1) * stride + 1 : stride]
        route = drives.routes[drives.route_starts[i] : drives.route_starts[i + 1]]
        arcs = np.empty(count)
        near = 0.0
        for t in range(count):
            if t > 0:
                near += math.hypot(ego[t, 0] - ego[t - 1, 0], ego[t, 1] - ego[t - 1, 1])
            arcs[t], _, _ = project(route, len(route), ego[t, 0], ego[t, 1], near, 15.0)
            near = max(arcs[t], 0.0)
        _tag_motion(ego, dt_s, tags[i], values[i])
        _tag_roundabout(ego, ring, tags[i])
        tags[i, _U_TURN] &= not tags[i, _ROUNDABOUT]
        end = frame + (count - 1) * stride
        others, num_others = np.empty(len(tracks.roles), dtype=np.int64), 0
        for o in range(len(tracks.roles)):
            present = tracks.first[o] <= end and tracks.last[o] >= frame
            if o != e and tracks.roles[o] > 0 and present:
                others[num_others] = o
                num_others += 1
        others = others[:num_others]
        placed = np.full((len(others), count, 4), np.nan)
        nearby = np.zeros(count)
        for k in range(len(others)):
            o = others[k]
            rows = tracks.states[tracks.starts[o] : tracks.starts[o + 1]]
            values[i, _AGENTS] += _place(
                rows, tracks.first[o], frame, stride, ego, arcs, route, placed[k], nearby
            )
        total, most = 0.0, 0.0
        for t in range(count):
            total, most = total + nearby[t], max(most, nearby[t])
        values[i, _DENSITY], values[i, _MAX_DENSITY] = total / count, most
        route_end = len(route) - 1 - BEYOND_M  # of the recorded part
        size, sizes, roles = tracks.sizes[e], tracks.sizes[others], tracks.roles[others]
        reach = 0.5 * (size[1] + sizes[:, 1])
        leader = _tag_following(ego, arcs, size, sizes, roles, placed, tags[i])
        for k in range(len(others)):
            vulnerable = (roles[k] & _VULNERABLE_BIT) > 0
            _tag_crossing(
                ego, arcs, 0.5 * size[0], route_end, reach[k], vulnerable, placed[k], leader,
                dt_s, tags[i],
            )  # fmt: skip


@njit(cache=True)
@no_type_check
def _tag_motion(ego, dt_s, tags, values):
    """Writes turns, standing, stopping, and the measures of the ego alone.

    Args:
        ego: (ticks, 4) states.
        dt_s: seconds per tick.
        tags: (tags,) output.
        values: (columns,) output.
    """
    count, turned, distance, max_speed = len(ego), 0.0, 0.0, 0.0
    has_driven, ticks_standing, heading = False, 0, math.nan
    for t in range(count):
        if t > 0:
            distance += math.hypot(ego[t, 0] - ego[t - 1, 0], ego[t, 1] - ego[t - 1, 1])
        speed = abs(ego[t, 3])
        if speed >= MANOEUVRE_STANDING_MPS:
            if not math.isnan(heading):
                turned += wrap_scalar(ego[t, 2] - heading)
            heading = ego[t, 2]
        max_speed = max(max_speed, speed)
        has_driven |= speed >= DRIVING_MPS
        ticks_standing = ticks_standing + 1 if speed < MANOEUVRE_STANDING_MPS else 0
        # n consecutive ticks span n - 1 steps
        stands = (ticks_standing - 1) * dt_s >= STOP_DURATION_S - _ROUNDING
        tags[_STOPPING] |= has_driven and stands
    tags[_LEFT], tags[_RIGHT] = turned > TURN_RAD, turned < -TURN_RAD
    tags[_STRAIGHT] = abs(turned) <= TURN_RAD
    tags[_U_TURN] = abs(turned) > U_TURN_RAD
    tags[_STANDING_START] = abs(ego[0, 3]) < MANOEUVRE_STANDING_MPS
    values[_LENGTH], values[_DISTANCE] = (count - 1) * dt_s, distance
    values[_MAX_SPEED], values[_TURN] = max_speed, math.degrees(turned)


@njit(cache=True)
@no_type_check
def _tag_roundabout(ego, ring, tags):
    """Tags roundabouts that the ego drives along, enters and leaves.

    Args:
        ego: (ticks, 4) states.
        ring: (points, 3) of roundabouts, [x m, y m, direction rad].
        tags: (tags,) output.
    """
    along_m, was_on, enters, leaves = 0.0, False, False, False
    for t in range(len(ego)):
        x, y, heading = ego[t, 0], ego[t, 1], ego[t, 2]
        on = False
        for j in range(len(ring)):
            dx, dy = ring[j, 0] - x, ring[j, 1] - y
            if dx * dx + dy * dy <= ROUNDABOUT_HALF_WIDTH_M * ROUNDABOUT_HALF_WIDTH_M:
                on |= abs(wrap_scalar(ring[j, 2] - heading)) <= SAME_DIRECTION_RAD
        if t > 0:
            enters |= on and not was_on
            leaves |= was_on and not on
            if on and was_on:
                along_m += math.hypot(x - ego[t - 1, 0], y - ego[t - 1, 1])
        was_on = on
    tags[_ROUNDABOUT] = along_m >= ROUNDABOUT_M
    tags[_ENTRY] = enters and along_m >= ROUNDABOUT_M
    tags[_EXIT] = leaves and along_m >= ROUNDABOUT_M


@njit(cache=True)
@no_type_check
def _place(rows, first, frame, stride, ego, arcs, route, placed, nearby):
    """Projects another agent onto the ego's route.

    Args:
        rows: (frames, 4) states of the other agent.
        first: its first frame.
        frame: the first frame of the scenario.
        stride: frames per tick.
        ego: (ticks, 4) states of the ego.
        arcs: (ticks,) arc length of the ego, m.
        route: (points, 2) of the ego, 1 m apart.
        placed: (ticks, 4) output: arc length m, offset m, angle to the route rad and speed m/s; NaN
            where the agent is absent, an infinite offset where it is far from the route.
        nearby: (ticks,) number of agents within `DENSITY_RADIUS_M` of the ego, increased.

    Returns:
        Whether the agent is present at any tick.
    """
    present = False
    for t in range(len(ego)):
        row = frame + t * stride - first
        if row < 0 or row >= len(rows):
            continue
        present = True
        x, y = rows[row, 0], rows[row, 1]
        nearby[t] += math.hypot(x - ego[t, 0], y - ego[t, 1]) <= DENSITY_RADIUS_M
        placed[t, 1] = np.inf
        nearest, best = 0, np.inf
        low = max(0, int(arcs[t]) - _LOOK_BACK_M)
        ahead = max(_LOOK_AHEAD_M, int(LEADER_GAP_S * ego[t, 3]) + _LONGEST_M)
        for j in range(low, min(len(route), int(arcs[t]) + ahead), _COARSE_M):
            dx, dy = route[j, 0] - x, route[j, 1] - y
            if dx * dx + dy * dy < best:
                nearest, best = j, dx * dx + dy * dy
        if best <= _NEAR_ROUTE_M * _NEAR_ROUTE_M:
            near = float(nearest)  # the type with which `project` is compiled above
            arc, offset, heading = project(route, len(route), x, y, near, 2.0 * _COARSE_M)
            placed[t, 0], placed[t, 1] = arc, offset
            placed[t, 2], placed[t, 3] = wrap_scalar(rows[row, 2] - heading), rows[row, 3]
    return present


@njit(cache=True)
@no_type_check
def _tag_following(ego, arcs, size, sizes, roles, placed, tags):
    """Tags a scenario in which the ego follows a leader.

    Args:
        ego: (ticks, 4) states.
        arcs: (ticks,) arc length of the ego, m.
        size: (2,) length and width of the ego, m.
        sizes: (agents, 2) of the other agents.
        roles: (agents,) bits of the other agents.
        placed: (agents, ticks, 4) output of `_place`.
        tags: (tags,) output.

    Returns:
        (ticks,) arc length of the nearest leader, m; infinite without a leader.
    """
    nearest = np.empty(len(ego))
    nearest[:] = np.inf
    ticks_moving, ticks_following = 0, 0
    for t in range(len(ego)):
        gap = np.inf
        for k in range(len(placed)):
            arc, offset, angle, speed = placed[k, t]
            on_route = abs(offset) < 0.5 * (size[1] + sizes[k, 1]) and arc > arcs[t]
            along = abs(angle) < SAME_DIRECTION_RAD or abs(speed) < MANOEUVRE_STANDING_MPS
            if on_route and along and roles[k] & _LEADER_BIT:
                nearest[t] = min(nearest[t], arc)
                gap = min(gap, arc - arcs[t] - 0.5 * (size[0] + sizes[k, 0]))
        if ego[t, 3] >= MANOEUVRE_STANDING_MPS:
            ticks_moving += 1
            ticks_following += gap <= max(LEADER_GAP_S * ego[t, 3], LEADER_GAP_M)
    tags[_FOLLOWING] = ticks_following * 2 > ticks_moving
    return nearest


@njit(cache=True)
@no_type_check
def _moves_across(placed, least_rad):
    """Whether an agent moves at an angle of at least `least_rad` to the route.

    Args:
        placed: (4,) one tick of the output of `_place`.
        least_rad: smallest angle to the route or against it.
    """
    angle, speed = abs(placed[2]), abs(placed[3])
    return least_rad <= angle <= math.pi - least_rad and speed >= MANOEUVRE_STANDING_MPS


@njit(cache=True)
@no_type_check
def _tag_crossing(ego, arcs, front, route_end, reach, vulnerable, placed, leader, dt_s, tags):
    """Tags crossing and yielding, for one other agent.

    Args:
        ego: (ticks, 4) states.
        arcs: (ticks,) arc length of the ego, m.
        front: distance from the ego's centre to its front, m.
        route_end: arc length of the end of the recorded route, m.
        reach: half the sum of both widths, m.
        vulnerable: whether the other agent is a vulnerable road user.
        placed: (ticks, 4) output of `_place`.
        leader: (ticks,) arc length of the nearest leader, m.
        dt_s: seconds per tick.
        tags: (tags,) output.
    """
    for t in range(1, len(ego)):
        arc, offset, before = placed[t, 0], placed[t, 1], placed[t - 1, 1]
        ahead = arc - arcs[t] - front
        if not (_moves_across(placed[t], SIDE_ENTRY_RAD) and ahead > 0.0 and arc <= route_end):
            continue
        # across the centre line, not from one side of a bend to the other
        crosses = before * offset <= 0.0 and abs(before - offset) <= _NEAR_ROUTE_M
        crosses &= _moves_across(placed[t], CROSSING_RAD) and ahead <= CROSSING_AHEAD_M
        tags[_CROSSING_VRU] |= vulnerable and crosses
        enters = abs(before) >= reach and abs(offset) < reach
        if enters and ahead <= YIELD_AHEAD_M and arc <= leader[t]:
            cleared = t
            while cleared + 1 < len(ego) and abs(placed[cleared + 1, 1]) < reach:
                if abs(placed[cleared + 1, 2]) < SIDE_ENTRY_RAD:
                    break
                cleared += 1
            tags[_YIELDING] |= _yields(ego[:, 3], arcs, arc - front, t, cleared, dt_s)


@njit(cache=True)
@no_type_check
def _yields(speeds, arcs, place_m, entered, cleared, dt_s):
    """Whether the ego slows down for an agent that crosses its route.

    Args:
        speeds: (ticks,) of the ego, m/s.
        arcs: (ticks,) arc length of the ego, m.
        place_m: arc length of the ego's centre when its front is at the point of the crossing.
        entered: tick at which the agent enters the route.
        cleared: tick at which the agent is last on the route.
        dt_s: seconds per tick.
    """
    arrival = entered
    while arrival < len(arcs) and arcs[arrival] < place_m:
        arrival += 1
    late_s = (arrival - cleared) * dt_s
    if arrival == len(arcs) or not 0.0 < late_s <= YIELD_ARRIVAL_S + _ROUNDING:
        return False
    slowest = max(0, entered - int(YIELD_BEFORE_S / dt_s + _ROUNDING))
    for t in range(slowest + 1, arrival + 1):
        if speeds[t] < speeds[slowest]:
            slowest = t
    slow = speeds[slowest]
    before = max(0, slowest - int(YIELD_SPEED_OVER_S / dt_s + _ROUNDING))
    highest = speeds[before]
    for t in range(before + 1, slowest + 1):
        highest = max(highest, speeds[t])
    slowed = slow < MANOEUVRE_STANDING_MPS or slow <= YIELD_SPEED_SHARE * highest
    in_time = (slowest - cleared) * dt_s <= YIELD_SLOWEST_S + _ROUNDING
    return slowed and in_time and speeds[arrival] >= slow + YIELD_SPEED_GAIN_MPS
