"""Following a path behind whoever is on it: the intelligent driver model and pure pursuit.

Treiber, Hennecke and Helbing 2000, along a given path; what is ahead is found by sweeping the
vehicle's own box along that path until it would touch another box as it stands now.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.geometry import project, turned_overlaps


@dataclass(frozen=True, slots=True, kw_only=True)
class IDM:
    """Parameters of the law; defaults are Treiber's for cities, with a firmer brake."""

    max_acceleration_mps2: float = 1.5
    comfortable_braking_mps2: float = 2.0
    time_gap_s: float = 1.2
    standstill_gap_m: float = 2.0
    max_lateral_acceleration_mps2: float = 2.5
    look_ahead_s: float = 5.0
    min_look_ahead_m: float = 15.0

    def as_row(self) -> Float[np.ndarray, " 6"]:
        """What the compiled law reads, in its order."""
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


@njit(cache=True, error_model="numpy")
@no_type_check
def limit_speeds(path, desired, stop_m, lateral, braking, limits):
    """Fills in `speed_limits` of one path."""
    count = len(path)
    turn = 0.0
    for i in range(count):
        limits[i] = desired
        # the turn from the 4 m before to the 4 m behind is that of 2 m: steps of 4 m, 1 m apart
        at = min(max(i - 2, 0), count - 5)
        if count >= 6:
            before, after = max(at - 1, 0), min(at + 1, count - 5)
            x, y = path[before + 4, 0] - path[before, 0], path[before + 4, 1] - path[before, 1]
            u, v = path[after + 4, 0] - path[after, 0], path[after + 4, 1] - path[after, 1]
            turn = abs(math.atan2(x * v - y * u, x * u + y * v)) / (after - before)
            limits[i] = min(desired, math.sqrt(lateral / max(turn, 1e-4)))
        if i >= stop_m:
            limits[i] = 0.0
    for i in range(count - 2, -1, -1):
        limits[i] = min(limits[i], math.sqrt(limits[i + 1] ** 2 + 2.0 * braking))


def speed_limits(
    path: Float[np.ndarray, "p 2"], desired_mps: float, idm: IDM, *, stop_m: float = math.inf
) -> Float[np.ndarray, " p"]:
    """Speed wanted at each point of a path (1 m apart): as desired, slower in and before bends.

    From `stop_m` metres on it is 0.
    """
    limits = np.zeros(len(path), dtype=np.float32)
    lateral, braking = idm.max_lateral_acceleration_mps2, idm.comfortable_braking_mps2
    limit_speeds(path, desired_mps, stop_m, lateral, braking, limits)
    return limits


@njit(cache=True, error_model="numpy")
@no_type_check
def free_ahead(states, sizes, radii, counts_for, me, path, count, arc, reach_m):
    """(free metres ahead, speed along the path of what ends them); infinite if nothing does.

    A path's points are [x, y, cosine, sine of the box's heading]; `radii` are half the diagonals of
    boxes. Whoever `counts_for` something and whose centre is not behind ends it where the own box,
    swept along the path with 15 cm to either side, would touch theirs.
    """
    length, width = sizes[me, 0], sizes[me, 1] + 0.3
    x, y = states[me, 0], states[me, 1]
    cos_me, sin_me = math.cos(states[me, 2]), math.sin(states[me, 2])
    first = int(arc) + 1
    last = min(count - 1, int(arc + reach_m) + 1)
    leader_speed, hit = 0.0, last
    for o in range(states.shape[0]):
        if o == me or not counts_for[o]:
            continue
        xo, yo = states[o, 0], states[o, 1]
        dx, dy = xo - x, yo - y
        touch = radii[me] + radii[o] + 0.15
        within = hit - arc + touch + 5.0  # the path may lie beside the vehicle
        if dx * dx + dy * dy > within * within or dx * cos_me + dy * sin_me < 0.0:
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
def idm_acceleration(speed, wanted, gap, leader_speed, law):
    """m/s² of the intelligent driver model, within the limits of actions."""
    if wanted <= 0.0:
        return -law[1]
    free = 1.0 - (speed / max(wanted, 0.1)) ** 4
    interaction = 0.0
    if gap < np.inf:
        closing = speed * (speed - leader_speed) / (2.0 * math.sqrt(law[0] * law[1]))
        desired = law[3] + max(0.0, speed * law[2] + closing)
        interaction = (desired / max(gap, 0.1)) ** 2
    return min(max(law[0] * (free - interaction), -MAX_ACCELERATION_MPS2), law[0])


@njit(cache=True, error_model="numpy")
@no_type_check
def pursuit_steering(x, y, heading, speed, length, path, count, arc, offset_m):
    """Steering, rad, that leads the centre to a point of the path ahead (pure pursuit).

    `offset_m` moves the followed line to the left of the path.
    """
    ahead = max(2.0, 0.45 * abs(speed))
    at = min(arc + ahead, count - 1.000001)
    i = max(0, min(int(at), count - 2))
    dx, dy = path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1]
    norm = max(math.hypot(dx, dy), 1e-6)
    px = path[i, 0] + (at - i) * dx - offset_m * dy / norm - x
    py = path[i, 1] + (at - i) * dy + offset_m * dx / norm - y
    left = math.cos(heading) * py - math.sin(heading) * px
    along = math.cos(heading) * px + math.sin(heading) * py
    distance = max(math.hypot(px, py), 1.0)
    axle = 2.0 * AXLE_SHARE_OF_LENGTH * length
    steering = math.atan(2.0 * axle * left / max(distance * distance + axle * along, 1.0))
    return min(max(steering, -MAX_STEERING_RAD), MAX_STEERING_RAD)


@njit(cache=True, error_model="numpy")
@no_type_check
def _follow(states, sizes, radii, valid, driven, paths, counts, limits, arcs, law, actions):
    for b in range(states.shape[0]):
        for a in range(states.shape[1]):
            if not driven[b, a] or not valid[b, a] or counts[b, a] < 2:
                continue
            x, y = states[b, a, 0], states[b, a, 1]
            heading, speed = states[b, a, 2], states[b, a, 3]
            path, count = paths[b, a], counts[b, a]
            arc, _, _ = project(path, count, x, y, max(arcs[b, a], 0.0), 15.0)
            arcs[b, a] = arc
            reach = max(law[5], law[4] * speed)
            gap, leader = free_ahead(
                states[b], sizes[b], radii[b], valid[b], a, path, count, arc, reach
            )
            wanted = limits[b, a, min(max(int(arc + 0.5), 0), count - 1)]
            actions[b, a, 0] = idm_acceleration(speed, wanted, gap, leader, law)
            actions[b, a, 1] = pursuit_steering(
                x, y, heading, speed, sizes[b, a, 0], path, count, arc, 0.0
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
    """Actions of the driven agents along their paths; `arcs` (metres gone) is brought up to now."""
    actions = np.zeros((*valid.shape, 2), dtype=np.float32)
    step = np.diff(paths, axis=2, append=paths[:, :, -1:])
    norm = np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), 1e-6)
    turned = np.concatenate([paths, step / norm], axis=-1)
    radii = 0.5 * np.linalg.norm(sizes, axis=-1)
    _follow(
        states, sizes, radii, valid, driven, turned, counts, limits, arcs, idm.as_row(), actions
    )
    return actions
