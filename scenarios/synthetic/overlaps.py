"""Who touches whom: SUMO watches over lanes, not over the corners of boxes that cut them."""

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.geometry import box_corners
from scenarios.synthetic.demand import RoadUser
from scenarios.synthetic.motion import Motion

EVERY_FRAMES = 5


def overlapping(motions: dict[str, Motion], users: dict[str, RoadUser]) -> set[tuple[str, str]]:
    """Pairs of names whose boxes overlap at some time; two pedestrians may.

    Args:
        motions: of all road users, by name.
        users: size and class of the same names.
    """
    names = [name for name in sorted(motions) if len(motions[name].xy)]
    rows: list[np.ndarray] = []
    for number, name in enumerate(names):
        motion, user = motions[name], users[name]
        first = -motion.first_frame % EVERY_FRAMES
        xy, heading = motion.xy[first::EVERY_FRAMES], motion.heading_rad[first::EVERY_FRAMES]
        table = np.empty((len(xy), 7))
        table[:, 0] = (motion.first_frame + first) // EVERY_FRAMES + np.arange(len(xy))
        table[:, 1] = number
        table[:, 2:4], table[:, 4] = xy, heading
        table[:, 5:] = user.length_m, user.width_m
        rows.append(table)
    if not rows:
        return set()
    table = np.concatenate(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    reach = 0.5 * np.hypot(table[:, 5], table[:, 6])
    crowd = int(np.unique(table[:, 0], return_counts=True)[1].max())
    pairs: list[np.ndarray] = []
    for apart in range(1, crowd):
        near = table[:-apart, 0] == table[apart:, 0]
        distance = np.hypot(*(table[apart:, 2:4] - table[:-apart, 2:4]).T)
        near &= distance < reach[:-apart] + reach[apart:]
        first = np.flatnonzero(near)
        pairs.append(np.column_stack([first, first + apart]))
    a, b = np.concatenate([np.empty((0, 2), dtype=np.int64), *pairs]).T
    corners = box_corners(table[:, 2:5], table[:, 5:])
    touching = boxes_overlap(corners[a], corners[b])
    found = {
        (names[int(one)], names[int(other)])
        for one, other in np.column_stack([table[a, 1], table[b, 1]])[touching]
    }
    feet = "pedestrian"
    return {(one, other) for one, other in found if {users[one].kind, users[other].kind} != {feet}}


def boxes_overlap(
    a: Float[np.ndarray, "n 4 2"], b: Float[np.ndarray, "n 4 2"]
) -> Bool[np.ndarray, " n"]:
    """Whether boxes given by their corners overlap, pair by pair (separating axes)."""
    overlap = np.ones(len(a), dtype=bool)
    for box in (a, b):
        for axis in (box[:, 1] - box[:, 0], box[:, 2] - box[:, 1]):
            along_a, along_b = (np.einsum("nij,nj->ni", corners, axis) for corners in (a, b))
            overlap &= along_a.min(axis=1) < along_b.max(axis=1)
            overlap &= along_b.min(axis=1) < along_a.max(axis=1)
    return overlap
