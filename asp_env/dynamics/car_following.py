"""Car following along a path: the intelligent driver model and pure-pursuit steering.

The law is that of Treiber, Hennecke and Helbing 2000, "Congested traffic states in empirical
observations and microscopic simulations", Physical Review E 62. The leader is found by sweeping the
vehicle's box along its path until it touches the present box of another agent. Planners and
traffic simulation share this module.

A path is an array of points 1 m apart, so that an arc length in metres is also an index.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.compiled import njit
from asp_env.dynamics.bicycle import (
    AXLE_SHARE_OF_LENGTH,
    MAX_ACCELERATION_MPS2,
    MAX_STEERING_RAD,
)
from asp_env.geometry import SEARCH_REACH_M, point_on_route, project, turned_overlaps

SIDE_MARGIN_M = 0.15
"""Margin to either side of the box that is swept along the path. Chosen by hand."""

BESIDE_PATH_M = 5.0
"""Agents are considered up to this distance beyond the reach of the sweep, since the path may lie
beside the vehicle. Chosen by hand."""

PURSUIT_S = 0.45
"""Look-ahead time of the steering. Chosen by hand."""

MIN_PURSUIT_M = 2.0
"""Shortest look-ahead distance of the steering. Chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IDM:
    """Parameters of the intelligent driver model.

    The defaults are Treiber's for city traffic, with stronger braking.
    """

    max_acceleration_mps2: float = 1.5
    comfortable_braking_mps2: float = 2.0
    time_gap_s: float = 1.2
    standstill_gap_m: float = 2.0
    max_lateral_acceleration_mps2: float = 2.5
    """Lateral acceleration that limits the speed in bends."""
    look_ahead_s: float = 5.0
    """The path is searched for a leader over the distance driven in this time."""
    min_look_ahead_m: float = 15.0
    """Smallest distance over which the path is searched for a leader."""

    def as_row(self) -> Float[np.ndarray, " 6"]:
        """The parameters as kernels take them.

        Returns:
            [maximum acceleration m/s², comfortable braking m/s², time gap s, standstill gap m,
            look-ahead s, minimum look-ahead m].
        """
        return np.array(
            [
                self.max_acceleration_mps2,
                self.comfortable_braking_mps2,
                self.time_gap_s,
                self.standstill_gap_m,
                self.look_ahead_s,
                self.min_look_ahead_m,
            ]
        )


def follow_paths(
    states: Float[np.ndarray, "b a 4"],
    sizes: Float[np.ndarray, "b a 2"],
    valid: Bool[np.ndarray, "b a"],
    driven: Bool[np.ndarray, "b a"],
    paths: Float[np.ndarray, "b a p 2"],
    counts: Int[np.ndarray, "b a"],
    limits: Float[np.ndarray, "b a p"],
    arcs: Float[np.ndarray, "b a"],
    idm: IDM,
) -> Float[np.ndarray, "b a 2"]:
    """Actions of agents that follow paths behind their leaders.

    Args:
        states: [x m, y m, heading rad, speed m/s] of all agents.
        sizes: length and width, m.
        valid: which agents are present.
        driven: which agents follow their path.
        paths: points 1 m apart.
        counts: number of valid points of each path; agents with fewer than 2 get zeros.
        limits: speed limit at each point, m/s (`speed_limits`).
        arcs: arc length of each agent along its path, m; updated in place.
        idm: the parameters.

    Returns:
        [acceleration m/s², steering rad]; zero for agents that are not driven.
    """
    actions = np.zeros((*valid.shape, 2), dtype=np.float32)
    step = np.diff(paths, axis=2, append=paths[:, :, -1:])
    norm = np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), 1e-6)
    directed = np.concatenate([paths, step / norm], axis=-1)
    radii = 0.5 * np.linalg.norm(sizes, axis=-1)
    _follow(
        states, sizes, radii, valid, driven, directed, counts, limits, arcs, idm.as_row(), actions
    )
    return actions


def speed_limits(
    path: Float[np.ndarray, "p 2"], desired_mps: float, idm: IDM, *, stop_m: float = math.inf
) -> Float[np.ndarray, " p"]:
    """Speed limit at each point of a path, m/s: the desired speed, lower in and before bends.

    Args:
        path: points 1 m apart.
        desired_mps: desired speed.
        idm: the parameters.
        stop_m: arc length from which on the limit is 0.
    """
    limits = np.zeros(len(path), dtype=np.float32)
    lateral, braking = idm.max_lateral_acceleration_mps2, idm.comfortable_braking_mps2
    limit_speeds(path, desired_mps, stop_m, lateral, braking, limits)
    return limits


@njit(cache=True, error_model="numpy")
@no_type_check
def limit_speeds(path, desired, stop_m, lateral, braking, limits):
    """The kernel of `speed_limits`.

    Args:
        path: (points, ≥ 2) points 1 m apart.
        desired: desired speed, m/s.
        stop_m: arc length from which on the limit is 0, m.
        lateral: maximum lateral acceleration, m/s².
        braking: deceleration before bends and the stop, m/s².
        limits: (points,) output, m/s.
    """
    count = len(path)
    turn = 0.0
    for i in range(count):
        limits[i] = desired
        # curvature at 2 m: the turn between chords of 4 m whose starts are up to 2 m apart
        middle = min(max(i - 2, 0), count - 5)
        if count >= 6:
            before, after = max(middle - 1, 0), min(middle + 1, count - 5)
            x, y = path[before + 4, 0] - path[before, 0], path[before + 4, 1] - path[before, 1]
            u, v = path[after + 4, 0] - path[after, 0], path[after + 4, 1] - path[after, 1]
            turn = abs(math.atan2(x * v - y * u, x * u + y * v)) / (after - before)
            limits[i] = min(desired, math.sqrt(lateral / max(turn, 1e-4)))
        if i >= stop_m:
            limits[i] = 0.0
    for i in range(count - 2, -1, -1):
        limits[i] = min(limits[i], math.sqrt(limits[i + 1] ** 2 + 2.0 * braking))


@njit(cache=True, error_model="numpy")
@no_type_check
def free_ahead(states, sizes, radii, is_obstacle, index, path, count, arc, reach_m):
    """Free distance along a path, and the speed of the leader at its end.

    The vehicle's box, wider by `SIDE_MARGIN_M` on either side, is swept along the path. The leader
    is the first agent touched whose centre is not behind the vehicle.

    Args:
        states: (agents, 4) [x m, y m, heading rad, speed m/s].
        sizes: (agents, 2) length and width, m.
        radii: (agents,) half the diagonals of the boxes, m.
        is_obstacle: (agents,) bool, agents that can be the leader.
        index: index of the vehicle.
        path: (points, 4) [x m, y m, cosine, sine of the heading] 1 m apart.
        count: number of valid points of the path.
        arc: arc length of the vehicle, m.
        reach_m: length of the path that is searched, m.

    Returns:
        Free distance m and the leader's speed along the path m/s; infinity and 0 without a leader.
    """
    length, width = sizes[index, 0], sizes[index, 1] + 2.0 * SIDE_MARGIN_M
    x, y = states[index, 0], states[index, 1]
    cos, sin = math.cos(states[index, 2]), math.sin(states[index, 2])
    first = int(arc) + 1
    last = min(count - 1, int(arc + reach_m) + 1)
    leader_speed, hit = 0.0, last
    for o in range(states.shape[0]):
        if o == index or not is_obstacle[o]:
            continue
        xo, yo = states[o, 0], states[o, 1]
        dx, dy = xo - x, yo - y
        touch = radii[index] + radii[o] + SIDE_MARGIN_M
        within = hit - arc + touch + BESIDE_PATH_M
        if dx * dx + dy * dy > within * within or dx * cos + dy * sin < 0.0:
            continue
        cos_o, sin_o = math.cos(states[o, 2]), math.sin(states[o, 2])
        j = first
        while j < hit:
            px, py = path[j, 0], path[j, 1]
            away = math.sqrt((xo - px) ** 2 + (yo - py) ** 2) - touch
            if away >= 1.0:  # points are 1 m apart: the next ones cannot touch either
                j += int(away)
                continue
            ux, uy = path[j, 2], path[j, 3]
            if turned_overlaps(
                px, py, ux, uy, length, width, xo, yo, cos_o, sin_o, sizes[o, 0], sizes[o, 1]
            ):
                hit = j
                leader_speed = max(states[o, 3] * (cos_o * ux + sin_o * uy), 0.0)
                break
            j += 1
    if hit == last:
        return np.inf, 0.0
    return max(hit - arc - 1.0, 0.0), leader_speed


@njit(cache=True, error_model="numpy")
@no_type_check
def idm_acceleration(speed, desired, gap, leader_speed, law):
    """Acceleration of the intelligent driver model, m/s², within the limits of actions.

    Args:
        speed: of the vehicle, m/s.
        desired: desired speed, m/s; at 0 or below the vehicle brakes comfortably.
        gap: free distance to the leader, m; infinite without a leader.
        leader_speed: speed of the leader along the path, m/s.
        law: (6,) parameters, `IDM.as_row`.
    """
    if desired <= 0.0:
        return law[1] if speed < 0.0 else -law[1]
    free = 1.0 - (speed / max(desired, 0.1)) ** 4
    interaction = 0.0
    if gap < np.inf:
        closing = speed * (speed - leader_speed) / (2.0 * math.sqrt(law[0] * law[1]))
        desired_gap = law[3] + max(0.0, speed * law[2] + closing)
        interaction = (desired_gap / max(gap, 0.1)) ** 2
    return min(max(law[0] * (free - interaction), -MAX_ACCELERATION_MPS2), law[0])


@njit(cache=True, error_model="numpy")
@no_type_check
def pursuit_steering(x, y, heading, speed, length, path, count, arc, offset_m):
    """Steering towards a point ahead on the path (pure pursuit), rad, within the limits of actions.

    Args:
        x: of the vehicle's centre, m.
        y: of the vehicle's centre, m.
        heading: of the vehicle, rad.
        speed: of the vehicle, m/s.
        length: of the vehicle, m.
        path: (points, ≥ 2) points 1 m apart.
        count: number of valid points, at least 2.
        arc: arc length of the vehicle, m.
        offset_m: lateral offset of the line to follow, left of the path, m.
    """
    ahead = max(MIN_PURSUIT_M, PURSUIT_S * abs(speed))
    px, py, _, _ = point_on_route(path, count, min(arc + ahead, count - 1.000001), offset_m)
    px, py = px - x, py - y
    left = math.cos(heading) * py - math.sin(heading) * px
    along = math.cos(heading) * px + math.sin(heading) * py
    distance = max(math.hypot(px, py), 1.0)
    axle = 2.0 * AXLE_SHARE_OF_LENGTH * length
    steering = math.atan(2.0 * axle * left / max(distance * distance + axle * along, 1.0))
    return min(max(steering, -MAX_STEERING_RAD), MAX_STEERING_RAD)


@njit(cache=True, error_model="numpy")
@no_type_check
def _follow(states, sizes, radii, valid, driven, paths, counts, limits, arcs, law, actions):
    """The kernel of `follow_paths`, whose arguments it shares unless stated here.

    Args:
        states: (b, a, 4).
        sizes: (b, a, 2).
        radii: (b, a) half the diagonals of the boxes, m.
        valid: (b, a) bool.
        driven: (b, a) bool.
        paths: (b, a, points, 4) [x m, y m, cosine, sine of the heading].
        counts: (b, a).
        limits: (b, a, points), m/s.
        arcs: (b, a), m; updated in place.
        law: (6,) parameters, `IDM.as_row`.
        actions: (b, a, 2) output.
    """
    for b in range(states.shape[0]):
        for a in range(states.shape[1]):
            if not driven[b, a] or not valid[b, a] or counts[b, a] < 2:
                continue
            x, y = states[b, a, 0], states[b, a, 1]
            heading, speed = states[b, a, 2], states[b, a, 3]
            path, count = paths[b, a], counts[b, a]
            arc, _, _ = project(path, count, x, y, max(arcs[b, a], 0.0), SEARCH_REACH_M)
            arcs[b, a] = arc
            reach = max(law[5], law[4] * speed)
            gap, leader_speed = free_ahead(
                states[b], sizes[b], radii[b], valid[b], a, path, count, arc, reach
            )
            desired = limits[b, a, min(max(int(arc + 0.5), 0), count - 1)]
            actions[b, a, 0] = idm_acceleration(speed, desired, gap, leader_speed, law)
            actions[b, a, 1] = pursuit_steering(
                x, y, heading, speed, sizes[b, a, 0], path, count, arc, 0.0
            )
