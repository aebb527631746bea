"""Whether modes can be driven: on the road, clear of other agents, and within physical bounds.

Shapes: N targets, M modes, T ticks.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.road_map import RoadMap
from asp_env.geometry import wrap_angle
from asp_env.metrics.boxes import overlapping_paths
from asp_env.metrics.drivable import OFF_ROAD_M, drivable_field

MAX_ACCELERATION_MPS2 = 10.4
"""Bound on the acceleration (Waymax)."""

MAX_CURVATURE_PER_M = 0.3
"""Bound on the curvature (Waymax)."""

TOLERANCE = 1e-3
"""Added to both bounds (Waymax)."""

MIN_SPEED_MPS = 0.6
"""Below this speed no curvature is computed (inverse bicycle model of Waymax)."""


def off_road_modes(
    maps: tuple[RoadMap, ...],
    map_index: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "n m t 2"],
) -> tuple[Bool[np.ndarray, "n m"], Bool[np.ndarray, " n"]]:
    """Which modes are ever over 0.3 m outside the drivable area.

    Centres of boxes are tested, as in nuScenes' off-road rate: corners of recorded vehicles
    overhang curbs in tight turns, and some predictors forecast only positions. The tolerance is
    nuPlan's and exceeds the accuracy of the distance field, 0.1 m.

    Args:
        maps: the maps.
        map_index: index into `maps` of each target.
        points: positions of the modes, metres.

    Returns:
        (n, m) mask of the modes that leave the area, and (n,) mask of the targets on a map with a
        drivable area.
    """
    off = np.zeros(points.shape[:2], dtype=bool)
    known = np.zeros(len(points), dtype=bool)
    for number, road_map in enumerate(maps):
        on_map = map_index == number
        if on_map.any() and len(road_map.drivable):
            outside_m = drivable_field(road_map).distance_m(points[on_map])
            off[on_map] = (outside_m > OFF_ROAD_M).any(axis=-1)
            known |= on_map
    return off, known


def infeasible_modes(
    now: Float[np.ndarray, "n 4"], modes: Float[np.ndarray, "n m t 4"], *, dt_s: float
) -> Bool[np.ndarray, "n m"]:
    """Which modes are ever infeasible between two states, the present one included.

    Args:
        now: present states [x m, y m, heading rad, speed m/s].
        modes: states of the modes.
        dt_s: seconds per tick.

    Returns:
        (n, m) mask by `infeasible_ticks`.
    """
    start = np.broadcast_to(now[:, None, None], (*modes.shape[:2], 1, 4))
    beyond = infeasible_ticks(np.concatenate([start, modes], axis=2), dt_s=dt_s)
    return np.asarray(beyond.any(axis=2))


def infeasible_ticks(
    states: Float[np.ndarray, "*batch t 4"], *, dt_s: float
) -> Bool[np.ndarray, "*batch t-1"]:
    """Whether |acceleration| exceeds 10.4 m/s² or |curvature| 0.3 1/m between two states (Waymax).

    The acceleration is Δv / Δt, and the curvature is Δheading over the distance at the mean speed.
    Ticks that begin or end below 0.6 m/s have no curvature.

    Args:
        states: [x m, y m, heading rad, speed m/s] at consecutive ticks.
        dt_s: seconds per tick.
    """
    states = states.astype(np.float64)
    speed = states[..., 3]
    acceleration = np.diff(speed, axis=-1) / dt_s
    slow = np.minimum(np.abs(speed[..., 1:]), np.abs(speed[..., :-1])) < MIN_SPEED_MPS
    distance_m = 0.5 * (speed[..., 1:] + speed[..., :-1]) * dt_s
    turn = wrap_angle(np.diff(states[..., 2], axis=-1))
    # where the direction of travel reverses the distance is about 0; the acceleration decides
    curvature = turn / np.where(slow | (np.abs(distance_m) < TOLERANCE), np.inf, distance_m)
    hard = np.abs(acceleration) > MAX_ACCELERATION_MPS2 + TOLERANCE
    return hard | (np.abs(curvature) > MAX_CURVATURE_PER_M + TOLERANCE)


def overlapping_modes(
    modes: Float[np.ndarray, "n m t 4"],
    truth: Float[np.ndarray, "n t 4"],
    sizes: Float[np.ndarray, "n 2"],
    *,
    situation: Int[np.ndarray, " n"],
    slot: Int[np.ndarray, " n"],
    others: Float[np.ndarray, "b a t 4"],
    others_valid: Bool[np.ndarray, "b a t"],
    others_sizes: Float[np.ndarray, "b a 2"],
) -> Bool[np.ndarray, "n m"]:
    """Which modes ever overlap the recorded box of another agent at the same tick.

    All agents recorded at a tick count, of every class and whether or not they were observed
    before. Agents that overlap the target in the recording at any tick are left out: trailers, and
    tracks so close that noise makes them overlap. The recorded future therefore never overlaps.

    Args:
        modes: states of the modes.
        truth: states of the targets' recorded future.
        sizes: length and width of the targets, metres.
        situation: index of each target's situation.
        slot: index of each target's own track in its situation, or -1.
        others: recorded states of all agents of B situations.
        others_valid: ticks at which each agent is recorded.
        others_sizes: length and width of the agents, metres.

    Returns:
        (n, m) mask.
    """
    paths = np.concatenate([truth[:, None], modes], axis=1)
    return overlapping_paths(paths, sizes, situation, slot, others, others_valid, others_sizes)
