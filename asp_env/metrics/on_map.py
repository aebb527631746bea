"""What a map says of B drives at each of T ticks, for all maps at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.road_map import RoadMap
from asp_env.metrics.drivable import off_road_m
from asp_env.metrics.lanes import against_traffic_m, at_crossing, in_several_lanes, speed_limits
from asp_env.metrics.masked import Masked
from asp_env.metrics.ways import off_ways_m


@dataclass(frozen=True, slots=True, kw_only=True)
class OnMap:
    """See the functions of `lanes` and `ways` of the same names. At every tick of the egos."""

    outside_m: Float[np.ndarray, "b t"]
    """How far the outermost corner lies outside the drivable area, whatever the log does."""
    several_lanes: Bool[np.ndarray, "b t"]
    at_crossing: Bool[np.ndarray, "b t"]
    against_traffic: Masked
    """Metres in each tick; missing on maps without areas of lanes."""
    limits: Masked
    """Speed limit, m/s."""
    off_ways_m: Float[np.ndarray, "b t"]


def on_map(
    maps: Sequence[RoadMap],
    map_index: Int[np.ndarray, " b"],
    states: Float[np.ndarray, "b t 4"],
    sizes: Float[np.ndarray, "b 2"],
    routes: Sequence[Float[np.ndarray, "_ 2"]],
    elsewhere: Masked,
) -> OnMap:
    """What the maps say of the egos.

    Args:
        maps: some maps.
        map_index: which of them each drive is on.
        states: of the egos.
        sizes: their lengths and widths.
        routes: their logged ways.
        elsewhere: the speed limit of each drive's recording (b,), where a lane tells none.
    """
    shape = states.shape[:2]
    several, crossing = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    known = np.zeros(shape, dtype=bool)
    outside = np.zeros(shape, dtype=np.float32)
    against, off_ways = np.zeros(shape), np.zeros(shape)
    limits = np.broadcast_to(elsewhere.value[:, None], shape).copy()
    limited = np.broadcast_to(elsewhere.valid[:, None], shape).copy()
    for number, road_map in enumerate(maps):
        mine = np.flatnonzero(map_index == number)
        here = states[mine]
        boxes = np.broadcast_to(sizes[mine, None], (*here.shape[:2], 2))
        outside[mine] = off_road_m(road_map, here, boxes)
        several[mine] = in_several_lanes(road_map, here, boxes)
        crossing[mine] = at_crossing(road_map, here, boxes)
        against[mine] = against_traffic_m(road_map, here[..., :2])
        known[mine] = len(road_map.areas) > 0
        told = speed_limits(road_map, here)
        limits[mine] = np.where(told.valid, told.value, limits[mine])
        limited[mine] |= told.valid
        for b in mine.tolist():
            off_ways[b] = off_ways_m(road_map, states[b], routes[b])
    return OnMap(
        outside_m=outside,
        several_lanes=several,
        at_crossing=crossing,
        against_traffic=Masked(value=against, valid=known),
        limits=Masked(value=limits, valid=limited),
        off_ways_m=off_ways,
    )
