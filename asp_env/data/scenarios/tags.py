"""Roundabouts of a map: rings of lanes that lead into one another around a common centre.

Lanes are of one ring where each can be reached from the other along successors. They make a
roundabout if nine tenths of their length turns about its middle, in one sense, within 35° of the
direction that a circle about it has there, and no point is over 100 m or over three times as far
from the middle as another.

MERGED: The rules of `asp_env.data.scenarios.tags`, compiled, with their thresholds.

All kernels of one file, because numba's cache watches only the file of the kernel that is called
from Python; `project` alone is everybody's.
MERGED: What happens in a scenario, as the recording shows it: tags and measures, by exact rules.

All rules look at the ticks of the drive alone, the first observation and the last tick included.
The ego's way is where it went until its track ends, then straight on (`route_along`). Others are
road users that are not parked. One is on the way while its centre is nearer to it than half of both
widths together, and a leader if it is a vehicle or bicycle on the way ahead that heads within 45°
of it or stands. One comes onto the way from the side if it was not on it one tick before and is
now, ahead of the ego's front, where the way is a recorded one, at 0.5 m/s or more and at an angle
of at least 20° to it, in either sense.

`left`, `right`, `straight`: the heading turns by over 30° in all to the left, to the right, or by
    less; every scenario has one of them. Headings below 0.5 m/s do not count.
`u-turn`: it turns by over 150° in all, and the scenario is no `roundabout`.
`standing-start`: below 0.5 m/s at the first tick.
`stopping`: stands, below 0.5 m/s, for at least 1 s in a row after having driven at 2 m/s or more.
`following`: at over half of the ticks at which the ego drives at 0.5 m/s or more there is a leader,
    and the gap to it is at most 3 s at the ego's speed, or at most 5 m.
`yielding`: somebody comes onto the way from the side at most 20 m ahead of the ego's front, with no
    leader in between, and the ego's front gets to that place within 5 s after the other was last on
    the way at an angle of at least 20° to it. From 3 s before the other came until it gets there
    the ego is slowest no later than 1 s after that, below 0.5 m/s or at 0.6 or less of its highest
    speed in the 5 s before, and it gets there at least 1 m/s faster.
`crossing-vru`: a pedestrian, bicycle or animal passes over the middle of the way at most 30 m ahead
    of the ego's front, where the way is a recorded one, at 0.5 m/s or more and at an angle of at
    least 30° to it, in either sense.
`roundabout`: drives at least 10 m along a ring of the map (`asp_env.data.scenarios.tags`), within
    2 m of the middle of one of its lanes and heading within 45° of it.
`roundabout-entry`, `roundabout-exit`: a `roundabout` in which it comes onto the ring; leaves it.

Signals are in no recording, so who waits at one while others cross is `yielding`, too.
"""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from asp_env.data.classes import PREDICTED, VULNERABLE, AgentClass
from asp_env.data.recording import Recording
from asp_env.data.road_map import RoadMap
from asp_env.geometry import project, resample, route_along

MAX_RADIUS_M = 100.0
MAX_RADIUS_RATIO = 3.0
SHARE_ALONG = 0.9
RING_ALONG_RAD = np.radians(35)


def ring_points(road_map: RoadMap) -> Float[np.ndarray, "points 3"]:
    """[x m, y m, direction rad] at most 1 m apart along the lanes of all roundabouts of a map."""
    found = [np.zeros((0, 3))]
    for ring in _rings(road_map):
        lanes = [_directed(road_map.lanes[int(lane)]) for lane in np.flatnonzero(ring)]
        points = np.concatenate(lanes)
        if _turns_about_its_middle(points):
            found.append(points)
    return np.concatenate(found)


def _rings(road_map: RoadMap) -> list[Bool[np.ndarray, " lanes"]]:
    """Which lanes each ring has: strongly connected parts of the graph of successors."""
    count = len(road_map.lanes)
    reach = np.zeros((count, count), dtype=bool)
    reach[road_map.successors[:, 0], road_map.successors[:, 1]] = True
    for _ in range(max(count, 1).bit_length()):
        reach |= (reach.astype(np.float32) @ reach.astype(np.float32)) > 0
    mutual = reach & reach.T
    rings, seen = [], np.zeros(count, dtype=bool)
    for lane in np.flatnonzero(mutual.diagonal()):
        if not seen[lane]:
            rings.append(mutual[lane])
            seen |= mutual[lane]
    return rings


def _directed(lane: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 3"]:
    """Points about 1 m apart with the direction to the next."""
    points = np.concatenate([resample(lane, 1.0), lane[-1:]])
    step = np.diff(points, axis=0)
    direction = np.arctan2(step[:, 1], step[:, 0])
    return np.column_stack([points[:-1], direction])


def _turns_about_its_middle(points: Float[np.ndarray, "n 3"]) -> bool:
    out = points[:, :2] - points[:, :2].mean(axis=0)
    radius = np.hypot(*out.T)
    if radius.max() > MAX_RADIUS_M or radius.max() > MAX_RADIUS_RATIO * radius.min():
        return False
    # sine of the angle from the way out to the direction: 1 where it turns left about the middle
    across = (out[:, 0] * np.sin(points[:, 2]) - out[:, 1] * np.cos(points[:, 2])) / radius
    limit = np.cos(RING_ALONG_RAD)
    return bool(max((across >= limit).mean(), (across <= -limit).mean()) >= SHARE_ALONG)


TURN_RAD = math.pi / 6
U_TURN_RAD = math.radians(150)
STANDING_MPS = 0.5
STANDS_FOR_S = 1.0
DRIVEN_MPS = 2.0
LEADER_S = 3.0
LEADER_M = 5.0
ALONG_RAD = math.pi / 4
FROM_SIDE_RAD = math.radians(20)
ACROSS_RAD = math.radians(30)
YIELDS_WITHIN_M = 20.0
YIELDS_BEFORE_S = 3.0
YIELDS_AFTER_S = 5.0
SLOWEST_AFTER_S = 1.0
SLOWED_SHARE = 0.6
SLOWED_OVER_S = 5.0
GOES_ON_MPS = 1.0
CROSSES_WITHIN_M = 30.0
RING_M = 10.0
RING_HALF_WIDTH_M = 2.0
DENSE_WITHIN_M = 30.0

BEYOND_M = 60.0
"""The way goes on straight for this far where the track ends."""
LEADER_BIT, VULNERABLE_BIT, PRESENT_BIT = 1, 2, 4
"""What a track may be to an ego, as bits."""

_NEAR_WAY_M = 8.0
"""Whoever is further from the way than this is no more than off it."""
_LOOK_AHEAD_M = 60
_LONGEST_M = 25
"""Centres are further apart than bumpers by this at most."""
_LOOK_BACK_M = 10
_COARSE_M = 4
"""Who is near the way is told from every fourth of its points, and where by all."""
_ROUNDING = 1e-6

(
    _LEFT, _RIGHT, _STRAIGHT, _U_TURN, _STANDING_START, _STOPPING, _FOLLOWING, _YIELDING,
    _CROSSING_VRU, _ROUNDABOUT, _ENTRY, _EXIT,
) = range(12)  # fmt: skip
_LENGTH, _DISTANCE, _FASTEST, _TURN, _DENSITY, _AGENTS = range(6)


@njit(cache=True)
@no_type_check
def describe_all(
    states, starts, first, last, sizes, roles, tracks, ticks, lengths, stride, dt_s,
    ways, way_starts, ring, tags, values,
):  # fmt: skip
    """Fills tags and values of some drives in one recording.

    Args:
        states: (rows, 4) of all tracks.
        starts: (tracks + 1,) row of each track's first state.
        first: (tracks,) first frames.
        last: (tracks,) last frames.
        sizes: (tracks, 2) length and width, m.
        roles: (tracks,) bits; 0 for who is left out.
        tracks: (n,) of the egos.
        ticks: (n,) of the first observations.
        lengths: (n,) in ticks.
        stride: frames per tick.
        dt_s: seconds per tick.
        ways: points of all egos' ways, 1 m apart, back to back.
        way_starts: (n + 1,) where each begins.
        ring: (points, 3) of roundabouts, [x, y, direction].
        tags: (n, tags) receives.
        values: (n, columns) receives.
    """
    for i in range(len(tracks)):
        e, count, frame = tracks[i], lengths[i] + 1, ticks[i] * stride
        row = starts[e] + frame - first[e]
        ego = states[row : row + (count - 1) * stride + 1 : stride]
        way = ways[way_starts[i] : way_starts[i + 1]]
        arcs = np.empty(count)
        near = 0.0
        for t in range(count):
            if t > 0:
                near += math.hypot(ego[t, 0] - ego[t - 1, 0], ego[t, 1] - ego[t - 1, 1])
            arcs[t], _, _ = project(way, len(way), ego[t, 0], ego[t, 1], near, 15.0)
            near = max(arcs[t], 0.0)
        _alone(ego, dt_s, tags[i], values[i])
        _on_rings(ego, ring, tags[i])
        tags[i, _U_TURN] &= not tags[i, _ROUNDABOUT]
        end = frame + (count - 1) * stride
        others = np.flatnonzero((roles > 0) & (first <= end) & (last >= frame))
        others = others[others != e]
        placed = np.full((len(others), count, 4), np.nan)
        within = 0
        for k in range(len(others)):
            o = others[k]
            rows = states[starts[o] : starts[o + 1]]
            seen, close = _place(rows, first[o], frame, stride, ego, arcs, way, placed[k])
            values[i, _AGENTS] += seen
            within += close
        values[i, _DENSITY] = within / count
        # the way as it was recorded ends where the straight piece begins
        way_end = len(way) - 1 - BEYOND_M
        widths = 0.5 * (sizes[e, 1] + sizes[others, 1])
        leader = _leaders(ego, arcs, sizes[e], sizes[others], roles[others], placed, tags[i])
        for k in range(len(others)):
            vulnerable = (roles[others[k]] & VULNERABLE_BIT) > 0
            _crossings(
                ego, arcs, 0.5 * sizes[e, 0], way_end, widths[k], vulnerable, placed[k], leader,
                dt_s, tags[i],
            )  # fmt: skip


@njit(cache=True)
@no_type_check
def _wrap(angle):
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True)
@no_type_check
def _alone(ego, dt_s, tags, values):
    """Turns, standing, stopping, and measures."""
    count, turned, distance, fastest = len(ego), 0.0, 0.0, 0.0
    driven, stood, heading = False, 0, math.nan
    for t in range(count):
        if t > 0:
            distance += math.hypot(ego[t, 0] - ego[t - 1, 0], ego[t, 1] - ego[t - 1, 1])
        speed = abs(ego[t, 3])
        if speed >= STANDING_MPS:
            if not math.isnan(heading):
                turned += _wrap(ego[t, 2] - heading)
            heading = ego[t, 2]
        fastest = max(fastest, speed)
        driven |= speed >= DRIVEN_MPS
        stood = stood + 1 if speed < STANDING_MPS else 0
        # n ticks in a row span n - 1 steps
        tags[_STOPPING] |= driven and (stood - 1) * dt_s >= STANDS_FOR_S - _ROUNDING
    tags[_LEFT], tags[_RIGHT] = turned > TURN_RAD, turned < -TURN_RAD
    tags[_STRAIGHT] = abs(turned) <= TURN_RAD
    tags[_U_TURN] = abs(turned) > U_TURN_RAD
    tags[_STANDING_START] = abs(ego[0, 3]) < STANDING_MPS
    values[_LENGTH], values[_DISTANCE] = (count - 1) * dt_s, distance
    values[_FASTEST], values[_TURN] = fastest, math.degrees(turned)


@njit(cache=True)
@no_type_check
def _on_rings(ego, ring, tags):
    """Roundabouts: where it drives along their lanes."""
    along_m, was_on, enters, leaves = 0.0, False, False, False
    for t in range(len(ego)):
        x, y, heading = ego[t, 0], ego[t, 1], ego[t, 2]
        on = False
        for j in range(len(ring)):
            dx, dy = ring[j, 0] - x, ring[j, 1] - y
            if dx * dx + dy * dy <= RING_HALF_WIDTH_M * RING_HALF_WIDTH_M:
                on |= abs(_wrap(ring[j, 2] - heading)) <= ALONG_RAD
        if t > 0:
            enters |= on and not was_on
            leaves |= was_on and not on
            if on and was_on:
                along_m += math.hypot(x - ego[t - 1, 0], y - ego[t - 1, 1])
        was_on = on
    tags[_ROUNDABOUT] = along_m >= RING_M
    tags[_ENTRY] = enters and along_m >= RING_M
    tags[_EXIT] = leaves and along_m >= RING_M


@njit(cache=True)
@no_type_check
def _place(rows, first, frame, stride, ego, arcs, way, placed):
    """Where another is along the ego's way; (whether it is there at all, at how many ticks near).

    `placed` (ticks, 4) receives arc length, offset, angle to the way and speed: not a number where
    it is not there, an infinite offset where it is far from the way.
    """
    seen, close = False, 0
    for t in range(len(ego)):
        at = frame + t * stride - first
        if at < 0 or at >= len(rows):
            continue
        seen = True
        x, y = rows[at, 0], rows[at, 1]
        close += math.hypot(x - ego[t, 0], y - ego[t, 1]) <= DENSE_WITHIN_M
        placed[t, 1] = np.inf
        nearest, best = 0, np.inf
        low = max(0, int(arcs[t]) - _LOOK_BACK_M)
        ahead = max(_LOOK_AHEAD_M, int(LEADER_S * ego[t, 3]) + _LONGEST_M)
        for j in range(low, min(len(way), int(arcs[t]) + ahead), _COARSE_M):
            dx, dy = way[j, 0] - x, way[j, 1] - y
            if dx * dx + dy * dy < best:
                nearest, best = j, dx * dx + dy * dy
        if best <= _NEAR_WAY_M * _NEAR_WAY_M:
            arc, offset, heading = project(way, len(way), x, y, nearest, 2.0 * _COARSE_M)
            placed[t, 0], placed[t, 1] = arc, offset
            placed[t, 2], placed[t, 3] = _wrap(rows[at, 2] - heading), rows[at, 3]
    return seen, close


@njit(cache=True)
@no_type_check
def _leaders(ego, arcs, size, sizes, roles, placed, tags):
    """Following; (ticks,) arc length of the nearest leader, infinite where nobody leads."""
    nearest = np.full(len(ego), np.inf)
    moves, follows = 0, 0
    for t in range(len(ego)):
        gap = np.inf
        for k in range(len(placed)):
            arc, offset, angle, speed = placed[k, t]
            on_way = abs(offset) < 0.5 * (size[1] + sizes[k, 1]) and arc > arcs[t]
            along = abs(angle) < ALONG_RAD or abs(speed) < STANDING_MPS
            if on_way and along and roles[k] & LEADER_BIT:
                nearest[t] = min(nearest[t], arc)
                gap = min(gap, arc - arcs[t] - 0.5 * (size[0] + sizes[k, 0]))
        if ego[t, 3] >= STANDING_MPS:
            moves += 1
            follows += gap <= max(LEADER_S * ego[t, 3], LEADER_M)
    tags[_FOLLOWING] = follows * 2 > moves
    return nearest


@njit(cache=True)
@no_type_check
def _moves_off(placed, least):
    """Whether it moves at an angle to the way, neither along nor against it."""
    return least <= abs(placed[2]) <= math.pi - least and abs(placed[3]) >= STANDING_MPS


@njit(cache=True)
@no_type_check
def _crossings(ego, arcs, front, way_end, reach, vulnerable, placed, leader, dt_s, tags):
    """Crossing and yielding: one other road user, which is on the way within `reach` of it."""
    for t in range(1, len(ego)):
        arc, offset, before = placed[t, 0], placed[t, 1], placed[t - 1, 1]
        ahead = arc - arcs[t] - front
        if not (_moves_off(placed[t], FROM_SIDE_RAD) and ahead > 0.0 and arc <= way_end):
            continue
        # over the middle, not from one side of a bend to the other
        over = before * offset <= 0.0 and abs(before - offset) <= _NEAR_WAY_M
        over &= _moves_off(placed[t], ACROSS_RAD) and ahead <= CROSSES_WITHIN_M
        tags[_CROSSING_VRU] |= vulnerable and over
        comes = abs(before) >= reach and abs(offset) < reach
        if comes and ahead <= YIELDS_WITHIN_M and arc <= leader[t]:
            cleared = t
            while cleared + 1 < len(ego) and abs(placed[cleared + 1, 1]) < reach:
                if abs(placed[cleared + 1, 2]) < FROM_SIDE_RAD:
                    break
                cleared += 1
            tags[_YIELDING] |= _yields(ego[:, 3], arcs, arc - front, t, cleared, dt_s)


@njit(cache=True)
@no_type_check
def _yields(speeds, arcs, place_m, came, cleared, dt_s):
    """Whether the ego slows for who came at one tick and was last on its way at another."""
    there = came
    while there < len(arcs) and arcs[there] < place_m:
        there += 1
    late = (there - cleared) * dt_s
    if there == len(arcs) or not 0.0 < late <= YIELDS_AFTER_S + _ROUNDING:
        return False
    slowest = max(0, came - int(YIELDS_BEFORE_S / dt_s + _ROUNDING))
    slowest += np.argmin(speeds[slowest : there + 1])
    slow = speeds[slowest]
    before = max(0, slowest - int(SLOWED_OVER_S / dt_s + _ROUNDING))
    slowed = slow < STANDING_MPS or slow <= SLOWED_SHARE * speeds[before : slowest + 1].max()
    in_time = (slowest - cleared) * dt_s <= SLOWEST_AFTER_S + _ROUNDING
    return slowed and in_time and speeds[there] >= slow + GOES_ON_MPS


TAGS = (
    *("left", "right", "straight", "u-turn"),
    *("standing-start", "stopping", "following", "yielding", "crossing-vru"),
    *("roundabout", "roundabout-entry", "roundabout-exit"),
)
"""In the order of the rules' columns."""

COLUMNS = {
    "length_s": "how long the recording goes on after the first observation",
    "distance_m": "how far the ego goes",
    "max_speed_mps": "its highest speed",
    "turn_deg": "by how much its heading turns in all while it does not stand, left positive",
    "density": "how many others are within 30 m of it, on average over the ticks",
    "agents": "how many others are there at any tick",
}
"""Measures and what they are, in the order of the rules' columns."""


def describe(
    recording: Recording,
    tracks: Int[np.ndarray, " n"],
    start_ticks: Int[np.ndarray, " n"],
    lengths: Int[np.ndarray, " n"],
    *,
    stride: int,
) -> tuple[Bool[np.ndarray, "n tags"], Float[np.ndarray, "n columns"]]:
    """(n, `TAGS`) and (n, `COLUMNS`) of some drives of a recording.

    Args:
        recording: where they are.
        tracks: indices of the egos' tracks.
        start_ticks: of the first observations.
        lengths: in ticks; all of these must be within the egos' tracks.
        stride: frames per tick.
    """
    tags = np.zeros((len(tracks), len(TAGS)), dtype=bool)
    values = np.zeros((len(tracks), len(COLUMNS)))
    first = recording.first_frames.astype(np.int64)
    ways = [np.zeros((0, 2), dtype=np.float32)]
    for track, tick in zip(tracks.tolist(), start_ticks.tolist(), strict=True):
        ahead = recording.track(track)[tick * stride - first[track] :: stride]
        ways.append(route_along(ahead, beyond_m=BEYOND_M))
    describe_all(
        np.array(recording.states),  # copies of what may be read-only: one kernel for all
        recording.starts.astype(np.int64),
        first,
        recording.last_frames.astype(np.int64),
        np.array(recording.sizes),
        _roles(recording),
        tracks.astype(np.int64),
        start_ticks.astype(np.int64),
        lengths.astype(np.int64),
        stride,
        stride / recording.frame_rate_hz,
        np.concatenate(ways),
        np.cumsum([len(way) for way in ways]),
        ring_points(recording.road_map),
        tags,
        values,
    )
    return tags, values


def _roles(recording: Recording) -> Int[np.ndarray, " tracks"]:
    """What each track may be to an ego, as bits; 0 for parked vehicles."""
    leads = [int(kind) for kind in PREDICTED | {AgentClass.BICYCLE, AgentClass.TRAILER}]
    vulnerable = [int(kind) for kind in VULNERABLE]
    roles = np.full(len(recording), PRESENT_BIT, dtype=np.int64)
    roles[np.isin(recording.classes, leads)] |= LEADER_BIT
    roles[np.isin(recording.classes, vulnerable)] |= VULNERABLE_BIT
    roles[recording.parked] = 0
    return roles
