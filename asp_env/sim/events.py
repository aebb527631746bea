"""What holds at one tick of B episodes, and how it is found."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.road_map import RoadMap
from asp_env.metrics.boxes import AT_FAULT, Contact
from asp_env.metrics.drivable import beyond_log_m, drivable_field

_AT_FAULT = np.array([kind in AT_FAULT for kind in Contact])
"""By the number of the contact."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Events:
    """What holds now in each of B episodes."""

    contacts: Int[np.ndarray, "b a"]
    """`Contact` of the ego with each agent; one that lasts keeps the class of its first tick.

    With a trailer that touches the ego at the first tick, its own, there is none.
    """
    off_road_m: Float[np.ndarray, " b"]
    """How far the ego's outermost corner lies outside the drivable area.

    Less what the logged ego lies outside there, if it is off the road itself: maps have gaps.
    """
    route_m: Float[np.ndarray, " b"]
    """The ego's arc length along its route, which starts at its first position."""
    route_offset_m: Float[np.ndarray, " b"]
    """How far left of its route the ego is."""
    route_heading_rad: Float[np.ndarray, " b"]
    """The route's heading there."""
    goal_m: Float[np.ndarray, " b"]
    """The arc length that the logged ego reached at the end of the scenario."""
    elapsed: Int[np.ndarray, " b"]
    """Ticks since the first observation."""
    length: Int[np.ndarray, " b"]
    """Ticks that the recording provides."""

    @property
    def collision(self) -> Bool[np.ndarray, " b"]:
        """Whether the ego touches anybody."""
        return np.asarray((self.contacts > 0).any(axis=1))

    @property
    def at_fault(self) -> Bool[np.ndarray, " b"]:
        """Whether the ego touches somebody in a way that it answers for."""
        return np.asarray(_AT_FAULT[self.contacts].any(axis=1))


def outside_now_m(
    maps: Sequence[RoadMap],
    map_index: Int[np.ndarray, " b"],
    egos: Float[np.ndarray, "b 4"],
    sizes: Float[np.ndarray, "b 2"],
    on_route: Float[np.ndarray, "b 3"],
    log_off_road_m: Float[np.ndarray, "b p"],
) -> Float[np.ndarray, " b"]:
    """How far each ego's outermost corner lies outside its map's drivable area, beyond its log."""
    outside = np.zeros(len(egos), dtype=np.float32)
    for number, road_map in enumerate(maps):
        drivable_field(road_map).corners_m(egos, sizes, map_index == number, outside)
    return beyond_log_m(outside, on_route, log_off_road_m)
