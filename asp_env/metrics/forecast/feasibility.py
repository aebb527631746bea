"""Whether modes could be driven: on the road, clear of others, within physics.

Each function says of every mode whether it breaks the rule at any tick, and of every target whether
the question applies. N targets, M modes, T ticks.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.road_map import RoadMap
from asp_env.geometry import wrap_angle
from asp_env.metrics.boxes import overlapping_paths
from asp_env.metrics.drivable import OFF_ROAD_M, drivable_field

MAX_ACCELERATION_MPS2 = 10.4
MAX_CURVATURE_PER_M = 0.3
SLACK = 1e-3
"""Added to both bounds, as in Waymax."""
MIN_SPEED_MPS = 0.6
"""Below this speed Waymax's inverse bicycle reads no curvature."""


def off_road_modes(
    maps: tuple[RoadMap, ...],
    map_index: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "n m t 2"],
) -> tuple[Bool[np.ndarray, "n m"], Bool[np.ndarray, " n"]]:
    """(n, m) whether any point lies over 0.3 m outside the drivable area; (n,) where there is one.

    The points are centres of boxes, as in nuScenes' off-road rate: corners of recorded vehicles
    overhang curbs in tight turns, and heading is not what a forecast of positions is asked for. The
    tolerance is nuPlan's, and covers the accuracy of the field of 0.1 m.
    """
    off = np.zeros(points.shape[:2], dtype=bool)
    known = np.zeros(len(points), dtype=bool)
    for number, road_map in enumerate(maps):
        mine = map_index == number
        if mine.any() and len(road_map.drivable):
            outside_m = drivable_field(road_map).distance_m(points[mine])
            off[mine] = (outside_m > OFF_ROAD_M).any(axis=-1)
            known |= mine
    return off, known


def infeasible_modes(
    now: Float[np.ndarray, "n 4"], modes: Float[np.ndarray, "n m t 4"], *, dt_s: float
) -> Bool[np.ndarray, "n m"]:
    """(n, m) whether |acceleration| ever exceeds 10.4 m/s² or |curvature| 0.3 1/m (Waymax).

    Between consecutive states, the first being `now`, as in `infeasible_ticks`.
    """
    start = np.broadcast_to(now[:, None, None], (*modes.shape[:2], 1, 4))
    beyond = infeasible_ticks(np.concatenate([start, modes], axis=2), dt_s=dt_s)
    return np.asarray(beyond.any(axis=2))


def infeasible_ticks(
    states: Float[np.ndarray, "*batch t 4"], *, dt_s: float
) -> Bool[np.ndarray, "*batch t-1"]:
    """Whether |acceleration| exceeds 10.4 m/s² or |curvature| 0.3 1/m from a state to the next.

    The acceleration is Δv / Δt and the curvature Δheading over the way at the mean speed. A tick
    that begins or ends below 0.6 m/s shows none.
    """
    states = states.astype(np.float64)
    speed = states[..., 3]
    acceleration = np.diff(speed, axis=-1) / dt_s
    slow = np.minimum(np.abs(speed[..., 1:]), np.abs(speed[..., :-1])) < MIN_SPEED_MPS
    way_m = 0.5 * (speed[..., 1:] + speed[..., :-1]) * dt_s
    turned = wrap_angle(np.diff(states[..., 2], axis=-1))
    # reversing between two ticks: no way, and the acceleration is what tells
    curvature = turned / np.where(slow | (np.abs(way_m) < SLACK), np.inf, way_m)
    hard = np.abs(acceleration) > MAX_ACCELERATION_MPS2 + SLACK
    return hard | (np.abs(curvature) > MAX_CURVATURE_PER_M + SLACK)


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
    """(n, m) whether the mode's box ever meets the recorded box of somebody else at that tick.

    Everybody counts who is recorded then, whatever their class and whether they were seen before.
    Pairs whose recorded boxes meet at any of the ticks are left out: a car and its trailer, and
    tracks so close that noise makes them touch. The recorded future thus has no overlap.

    Args:
        modes: states of the modes.
        truth: states of the targets' recorded future.
        sizes: lengths and widths of the targets.
        situation: of each target.
        slot: of each target in its situation, which is not compared with itself.
        others: recorded states of everybody in each situation.
        others_valid: when they are there.
        others_sizes: their lengths and widths.
    """
    paths = np.concatenate([truth[:, None], modes], axis=1)
    return overlapping_paths(paths, sizes, situation, slot, others, others_valid, others_sizes)
