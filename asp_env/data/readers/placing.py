"""How tracks and map lie to each other: what of a map is used, and whether it is the right map."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.classes import is_predicted
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.errors import DataError

WHOLE_MAP_M2 = 250_000.0
"""A map whose bounding box is not larger than this is used as a whole. Chosen by hand: more than
the sites of published recordings, and 100 MB of a field with cells of 0.1 m."""

REGION_MARGIN_M = 100.0
"""Of a larger map only what lies this near to the tracks' bounding box is used. Chosen by hand:
more than what predictors and planners look ahead."""

REGION_STEP_M = 50.0
"""Regions begin and end at multiples of this distance from the map's corner, so that recordings of
one location often share a region. Chosen by hand."""

MIN_ON_ROAD = 0.02
"""A map on which a smaller share of the positions of vehicles lies is of another place. Chosen by
hand: in published recordings, 90 to 100 % lie on the map."""

USUAL_ON_ROAD = 0.5
"""A smaller share of the positions of vehicles on the map is reported. Chosen by hand."""

NUM_PLACED = 500
"""Largest number of states of which the direction is compared with that of lanes."""

NUM_STATES = 10_000
"""Largest number of states of vehicles that are examined."""

ALONG_RAD = math.radians(45.0)
"""A vehicle within a lanelet drives along it if its heading is within this of the lanelet's
direction, in either sense. Chosen by hand."""

DRIVES_ABOVE_MPS = 1.0
"""A slower vehicle stands, parks or manoeuvres. Chosen by hand."""

Box = tuple[float, float, float, float]
"""Smallest x and y, largest x and y, metres."""


def used_region(tracks: Box, road_map: Box) -> Box | None:
    """The region of a map that a recording uses; None for the whole map.

    Args:
        tracks: bounding box of the recording's positions.
        road_map: bounding box of the map.
    """
    corner, opposite = np.array(road_map[:2]), np.array(road_map[2:])
    if np.prod(opposite - corner) <= WHOLE_MAP_M2:
        return None
    first = np.floor((np.array(tracks[:2]) - REGION_MARGIN_M - corner) / REGION_STEP_M)
    last = np.ceil((np.array(tracks[2:]) + REGION_MARGIN_M - corner) / REGION_STEP_M)
    begin, end = corner + first * REGION_STEP_M, corner + last * REGION_STEP_M
    if (begin <= corner).all() and (end >= opposite).all():
        return None
    return (float(begin[0]), float(begin[1]), float(end[0]), float(end[1]))


def moving_vehicles(
    classes: Int[np.ndarray, " tracks"],
    starts: Int[np.ndarray, " tracks+1"],
    states: Float[np.ndarray, "rows 4"],
) -> Float[np.ndarray, "n 4"]:
    """States of vehicles that move, evenly chosen from those of a track table."""
    vehicle = np.repeat(is_predicted(classes), np.diff(starts))
    rows = np.flatnonzero(vehicle & (np.abs(states[:, 3]) > DRIVES_ABOVE_MPS))
    return states[rows[:: -(-len(rows) // NUM_STATES) or 1]]


def driven_lanelets(
    vehicles: Float[np.ndarray, "n 4"], rings: Ragged, courses_rad: Float[np.ndarray, " lanelets"]
) -> list[int]:
    """Numbers of the lanelets that vehicles drive along.

    Args:
        vehicles: states of moving vehicles.
        rings: the area of each lanelet.
        courses_rad: direction of each lanelet from its begin to its end.
    """
    driven = []
    for number, course in enumerate(courses_rad.tolist()):
        within = vehicles[_in_ring(vehicles[:, :2], rings[number])]
        if (np.abs(np.cos(within[:, 2] - course)) > math.cos(ALONG_RAD)).any():
            driven.append(number)
    return driven


def share_on_road(vehicles: Float[np.ndarray, "n 4"], drivable: Ragged) -> float:
    """Share of the positions of vehicles that lie in any ring of the drivable area."""
    points = vehicles[:: -(-len(vehicles) // 500) or 1, :2]
    on_road = np.zeros(len(points), dtype=bool)
    for number in range(len(drivable)):
        on_road |= _in_ring(points, drivable[number])
    return float(on_road.mean())


def check_place(
    path: Path,
    name: str,
    vehicles: Float[np.ndarray, "n 4"],
    road_map: RoadMap,
    lanes: Float[np.ndarray, "points 2"],
) -> None:
    """Checks that vehicles drive on a map.

    Args:
        path: the map file.
        name: the recording.
        vehicles: states of moving vehicles; without any there is no check.
        road_map: the map, or the part of it that the recording uses.
        lanes: points of lanes of the whole map, metres.

    Raises:
        DataError: the share of the positions of vehicles on the map is below `MIN_ON_ROAD`.
    """
    if not len(vehicles) or (share := share_on_road(vehicles, road_map.drivable)) >= MIN_ON_ROAD:
        return
    middle = np.median(vehicles[:, :2].astype(np.float64), axis=0)
    distance_m = np.hypot(*(lanes - middle).T).min(initial=np.inf)
    raise DataError(
        f"{path}: is the map of another place than recording {name}: {100 * share:.1f} % of the "
        f"positions of its vehicles lie on the map, whose nearest lane is {distance_m:,.0f} m from "
        "the middle of the tracks; expected a map that vehicles drive on: put the right file in "
        "its place, or correct the origin in the recording's metadata"
    )


def doubts(vehicles: Float[np.ndarray, "n 4"], road_map: RoadMap) -> list[str]:
    """What speaks against the units, the axes or the map, for a report.

    Args:
        vehicles: states of moving vehicles; without any there are no doubts.
        road_map: the map, or the part of it that the recording uses.
    """
    if not len(vehicles):
        return []
    found = []
    if (share := share_on_road(vehicles, road_map.drivable)) < USUAL_ON_ROAD:
        found.append(
            f"only {100 * share:.0f} % of the positions of moving vehicles lie on the map "
            f"{road_map.name}: check units, origin and map"
        )
    chosen = vehicles[:: -(-len(vehicles) // NUM_PLACED) or 1]
    along, against = _driven_directions(chosen, road_map)
    if 2 * against.sum() > (along | against).sum():
        found.append(
            f"{100 * against.sum() / (along | against).sum():.0f} % of the positions of moving "
            f"vehicles on one-way lanes of the map {road_map.name} are against their direction: "
            "check whether y points up, and which bounds of lanelets are left and right"
        )
    return found


def _driven_directions(
    vehicles: Float[np.ndarray, "n 4"], road_map: RoadMap
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Masks of the vehicles that drive along a lane they are on, and of those only against it."""
    along, against = (np.zeros(len(vehicles), dtype=bool) for _ in range(2))
    for number in range(len(road_map.areas)):
        rows = np.flatnonzero(_in_ring(vehicles[:, :2], road_map.areas[number]))
        lane = road_map.lanes[number]
        if not len(rows) or len(lane) < 2:
            continue
        steps = np.diff(lane, axis=0)
        away = vehicles[rows, None, :2] - 0.5 * (lane[1:] + lane[:-1])
        nearest = steps[(away**2).sum(axis=-1).argmin(axis=1)]
        course = vehicles[rows, 2] + np.where(vehicles[rows, 3] < 0, np.pi, 0.0)
        cosine = np.cos(course - np.arctan2(nearest[:, 1], nearest[:, 0]))
        is_along = cosine > math.cos(ALONG_RAD)
        is_against = cosine < -math.cos(ALONG_RAD)
        along[rows] |= is_along | (is_against & bool(road_map.two_way[number]))
        against[rows] |= is_against
    return along, against & ~along


def _in_ring(
    points: Float[np.ndarray, "n 2"], ring: Float[np.ndarray, "m 2"]
) -> Bool[np.ndarray, " n"]:
    """Mask of the points inside a ring, by the even-odd rule."""
    inside = ((points >= ring.min(axis=0)) & (points <= ring.max(axis=0))).all(axis=1)
    x, y = points[inside].astype(np.float64).T[..., None]
    x_0, y_0 = ring.T
    x_1, y_1 = np.roll(ring, -1, axis=0).T
    spans = (y_0 > y) != (y_1 > y)
    rise = np.where(y_1 == y_0, 1.0, y_1 - y_0)
    left = x < x_0 + (y - y_0) / rise * (x_1 - x_0)
    inside[inside] = (spans & left).sum(axis=1) % 2 == 1
    return inside
