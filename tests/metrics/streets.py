"""A street map with lanes, built by hand."""

import numpy as np

from asp_env.data.road_map import Ragged, RoadMap

EAST, NEXT_EAST, WEST, ONWARDS, LEFT, NORTH = range(6)
"""Indices of the lanes of `STREET`."""


def strip(
    x_0: float, y_0: float, x_1: float, y_1: float, width_m: float = 4.0
) -> tuple[np.ndarray, np.ndarray]:
    """Centre line and ring of a straight lane."""
    line = np.array([(x_0, y_0), (x_1, y_1)])
    ahead = line[1] - line[0]
    left = 0.5 * width_m * np.array([-ahead[1], ahead[0]]) / np.hypot(*ahead)
    return line, np.concatenate([line + left, (line - left)[::-1]])


def street_map(*, two_way: tuple[int, ...] = (), without: tuple[int, ...] = ()) -> RoadMap:
    """Lanes 4 m wide with limits of 10 m/s, except `ONWARDS` (none) and `LEFT` (15 m/s).

    `EAST` runs from x = 0 to 100 at y = 0 and continues as `ONWARDS` to x = 200. `NEXT_EAST` at
    y = -4 and `WEST` at y = 4 run beside `EAST`. `LEFT` follows `EAST` too, at 45° from (100, 0).
    `NORTH` crosses all three at x = 50 from y = -30 to 30.

    Args:
        two_way: lanes that may be driven in both directions.
        without: lanes to leave out; the other lanes retain their order.
    """
    lanes = {
        EAST: strip(0, 0, 100, 0),
        NEXT_EAST: strip(0, -4, 100, -4),
        WEST: strip(100, 4, 0, 4),
        ONWARDS: strip(100, 0, 200, 0),
        LEFT: strip(100, 0, 130, 30),
        NORTH: strip(50, -30, 50, 30),
    }
    lanes[LEFT][1][[0, -1]] = (100, 2), (100, -2)  # begins at the end of `EAST`
    present = [lane for lane in lanes if lane not in without]
    index = {lane: number for number, lane in enumerate(present)}
    follows = [(EAST, ONWARDS), (EAST, LEFT)]
    edges = [(index[a], index[b]) for a, b in follows if a in index and b in index]
    limits = {ONWARDS: 0.0, LEFT: 15.0}
    rings = [lanes[lane][1] for lane in present]
    return RoadMap(
        name="street",
        lines=Ragged.pack([]),
        line_types=np.zeros(0, dtype=np.int64),
        drivable=Ragged.pack(rings),
        lanes=Ragged.pack([lanes[lane][0] for lane in present]),
        successors=np.array(edges, dtype=np.int64).reshape(-1, 2),
        areas=Ragged.pack(rings),
        two_way=np.array([lane in two_way for lane in present]),
        limits_mps=np.array([limits.get(lane, 10.0) for lane in present]),
        limited=np.array([lane != ONWARDS for lane in present]),
    )


STREET = street_map()
CAR = np.array([4.0, 2.0])


def moved_map(road_map: RoadMap, pose: tuple[float, float, float]) -> RoadMap:
    """The map rotated by an angle and then translated."""
    x, y, angle = pose
    turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])

    def moved(part: Ragged) -> Ragged:
        return Ragged(points=part.points @ turn + (x, y), starts=part.starts)

    return RoadMap(
        name=road_map.name,
        lines=moved(road_map.lines),
        line_types=road_map.line_types,
        drivable=moved(road_map.drivable),
        lanes=moved(road_map.lanes),
        successors=road_map.successors,
        areas=moved(road_map.areas),
        two_way=road_map.two_way,
        limits_mps=road_map.limits_mps,
        limited=road_map.limited,
    )
