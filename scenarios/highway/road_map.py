"""The map of a highway-env road network: lanes as strips, markings, and conversion of axes.

In highway-env's axes x is the same and y points down; `mirror_points`, `mirror_states` and
`mirror_actions` convert to the axes of this package and back (each is its own inverse). Along a
lane, highway-env's lateral coordinate therefore grows to the right, and the first of its two line
types is the left one.

highway-env defines where lanes lie and which nodes they join. The map adds what agents that follow
lanes need:

- Where the road ends, highway-env's lanes hold for another 5 m (`AbstractLane.on_lane`); strips are
  extended straight by that length.
- Where a lane ends metres short of its follower (all entries and exits of the roundabout do), a
smooth
  curve closes the gap.
- Each gap has a mouth. Vehicles steer towards the follower at once and cut the corner between both
lanes
  with their right side; highway-env, which checks centres only, counts that as on the road. The
  mouth is the area on both sides of the curve with the corner rounded off.

highway-env draws a continuous line along the outside of a road wherever its lanes have one, also
across the mouths of its roundabout. Here a continuous line is

- a kerb where no other lane lies beyond it: the edge of the road,
- virtual where other lanes lie both beyond it and within, since they lead across it,
- solid elsewhere, between two lanes side by side.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from highway_env.road.lane import AbstractLane, LineType
from highway_env.road.road import RoadNetwork
from jaxtyping import Bool, Float

from asp_env.errors import AspEnvError
from asp_env.geometry import wrap_angle
from scenarios.lanelet2 import Area, Border, Lanelet, Marking, write_map
from scenarios.polylines import Polyline, bezier, polar

LaneIndex = tuple[str, str, int]
"""Start node, end node, and index among the lanes between them."""

Link = tuple[LaneIndex, LaneIndex]

Lanes = dict[LaneIndex, AbstractLane]

Sides = Float[np.ndarray, "3 n 2"]
"""Left border, centre line and right border of a lane, with n points each."""

STEP_RAD = math.radians(2.0)
"""Mean turn between two points of a lane: the chord deviates by 4 mm on a ring of 26 m radius, and
by 1 cm on the gentle bends before it."""

LOOK_M = 0.1
"""Distance between the headings that are sampled to determine how much a lane turns."""

MEETS_M = 0.01
"""Borders whose ends are nearer than this to the start of others need no curve between."""

MOUTH_M = 8.0
"""Distance of the ends of a mouth from its gap. Measured at the roundabout: with 8 m no box is off
the road, with 5 m boxes are off by up to 0.4 m, without mouths by up to 1.2 m."""

PLAIN: dict[int, Marking] = {LineType.NONE: "virtual", LineType.STRIPED: "dashed"}
"""Markings of the line types that are not continuous."""

_KERBS = (LineType.CONTINUOUS, LineType.CONTINUOUS)

BESIDE_M = 0.05
"""Distance from a border of the points that decide which lanes lie on either side."""

PART_M = 0.1
"""Resolution of the positions at which the marking of a border changes."""

ORIGIN_UTM_M = (294_000.0, 5_628_000.0)
"""UTM zone 32 coordinates given to highway-env's origin (near Aachen). highway-env's roads have no
location, but lanelet2 maps are written in degrees."""

ORIGIN_LAT_LON_DEG = (50.767140, 6.078601)
"""`ORIGIN_UTM_M` as latitude and longitude in degrees."""


def mirror_points(points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Mirrors points or velocities (..., 2): the sign of y changes."""
    return points * np.array([1.0, -1.0], dtype=points.dtype)


def mirror_states(states: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """Mirrors states [x, y, heading, speed] (..., 4): the signs of y and heading change.

    Headings are wrapped to [-π, π), so that -π is its own mirror image.
    """
    mirrored = states * np.array([1.0, -1.0, -1.0, 1.0], dtype=states.dtype)
    mirrored[..., 2] = wrap_angle(mirrored[..., 2])
    return mirrored


def mirror_actions(actions: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Mirrors actions [acceleration, steering] (..., 2): the sign of the steering changes."""
    return actions * np.array([1.0, -1.0], dtype=actions.dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class Strip:
    """A lane in the axes of this package, in the direction of travel."""

    left: Polyline
    centre: Polyline
    right: Polyline
    line_types: tuple[int, int]
    """highway-env's `LineType` of the left and of the right border."""
    speed_limit_mps: float


def all_lanes(network: RoadNetwork) -> Lanes:
    """The lanes of a road network, in the order of its graph."""
    return {
        (begin, end, number): lane
        for begin, roads in network.graph.items()
        for end, road in roads.items()
        for number, lane in enumerate(road)
    }


def links(network: RoadNetwork) -> list[Link]:
    """Pairs of lanes of which the first leads to the second, where the graph connects their roads.

    highway-env stores the followers of roads, and its vehicles take the lane that begins nearest.
    Here a lane leads to that lane too, but only if no other lane of its road ends nearer to it,
    since the others reach it by changing lanes. No lane leads back in the opposite direction.
    """
    found = []
    for begin, roads in network.graph.items():
        for node, lanes in roads.items():
            for end, following in network.graph.get(node, {}).items():
                ends = np.array([_section(lane, lane.length)[1] for lane in lanes])
                starts = np.array([_section(lane, 0.0)[1] for lane in following])
                gaps = np.hypot(*np.moveaxis(ends[:, None] - starts, -1, 0))
                for i, j in enumerate(gaps.argmin(axis=1).tolist()):
                    turn = _heading_rad(following[j], 0.0) - _heading_rad(lanes[i], lanes[i].length)
                    if gaps[:, j].argmin() == i and math.cos(turn) > 0.0:
                        found.append(((begin, node, i), (node, end, j)))
    return found


def strips(network: RoadNetwork) -> dict[LaneIndex, Strip]:
    """All lanes as strips, in the order of the graph.

    Raises:
        AspEnvError: there is a gap between two lanes that both have other connections.
    """
    lanes = all_lanes(network)
    found = {}
    for index, (left, centre, right) in _grown(lanes, links(network)).items():
        config = lanes[index].to_config()["config"]
        left_is, right_is = config["line_types"]
        found[index] = Strip(
            left=left,
            centre=centre,
            right=right,
            line_types=(left_is, right_is),
            speed_limit_mps=float(config["speed_limit"]),
        )
    return found


def mouths(network: RoadNetwork) -> list[tuple[Polyline, Polyline]]:
    """Left and right side of the mouth of each gap, in the direction of travel."""
    lanes = all_lanes(network)
    found = []
    for leader, follower in links(network):
        before, behind = lanes[leader], lanes[follower]
        if not _meet(before, behind):
            begin_m, end_m = max(before.length - MOUTH_M, 0.0), min(MOUTH_M, behind.length)
            left, _, right = _across(before, begin_m, behind, end_m)
            found.append((left, right))
    return found


def _grown(lanes: Lanes, joined: list[Link]) -> dict[LaneIndex, Sides]:
    """The sides of all lanes with the curves that close gaps, or extended where the road ends."""
    leads, follows = ({link[end] for link in joined} for end in (0, 1))
    beyond_m = float(AbstractLane.VEHICLE_LENGTH)
    grown = {index: _sides(lane) for index, lane in lanes.items()}
    for index, lane in lanes.items():
        before, behind = np.zeros((3, 0, 2)), np.zeros((3, 0, 2))
        if index not in follows:
            before = grown[index][:, :1] - polar(beyond_m, _heading_rad(lane, 0.0))
        if index not in leads:
            behind = grown[index][:, -1:] + polar(beyond_m, _heading_rad(lane, lane.length))
        grown[index] = np.concatenate([before, grown[index], behind], axis=1)
    for leader, follower in joined:
        if _meet(lanes[leader], lanes[follower]):
            continue
        curve = _across(lanes[leader], lanes[leader].length, lanes[follower], 0.0)
        if sum(link[0] == leader for link in joined) == 1:
            grown[leader] = np.concatenate([grown[leader], curve[:, 1:]], axis=1)
        elif sum(link[1] == follower for link in joined) == 1:
            grown[follower] = np.concatenate([curve[:, :-1], grown[follower]], axis=1)
        else:
            raise AspEnvError(
                f"lane {leader} ends short of {follower}, and both have other connections; "
                "expected one of them to have none, so that it can close the gap: use another road"
            )
    return grown


def _sides(lane: AbstractLane) -> Sides:
    looks = np.linspace(0.0, lane.length, 2 + int(lane.length / LOOK_M))
    headings = np.unwrap([_heading_rad(lane, at) for at in looks])
    count = max(1, math.ceil(np.abs(np.diff(headings)).sum() / STEP_RAD - 1e-6))
    stations = np.linspace(0.0, lane.length, count + 1)
    return np.stack([_section(lane, at) for at in stations], axis=1)


def _section(lane: AbstractLane, at_m: float) -> Float[np.ndarray, "3 2"]:
    """Points on left border, centre line and right border at a distance along a lane."""
    width_m = lane.width_at(at_m)
    return mirror_points(
        np.array([lane.position(at_m, side * width_m) for side in (-0.5, 0.0, 0.5)])
    )


def _heading_rad(lane: AbstractLane, at_m: float) -> float:
    return -float(lane.heading_at(at_m))


def _meet(leader: AbstractLane, follower: AbstractLane) -> bool:
    gaps = _section(follower, 0.0) - _section(leader, leader.length)
    return float(np.hypot(*gaps.T).max()) < MEETS_M


def _across(
    leader: AbstractLane, leader_at_m: float, follower: AbstractLane, follower_at_m: float
) -> Sides:
    """Smooth curves from a position along one lane to a position along another."""
    starts, ends = _section(leader, leader_at_m), _section(follower, follower_at_m)
    start_rad, end_rad = (
        _heading_rad(leader, leader_at_m),
        _heading_rad(follower, follower_at_m),
    )
    return np.stack(
        [bezier(start, start_rad, end, end_rad) for start, end in zip(starts, ends, strict=True)]
    )


def lanelets(
    strips: list[Strip], mouths: list[tuple[Polyline, Polyline]]
) -> tuple[list[Lanelet], list[Area]]:
    """The lanes with their markings, in the same order, and the mouths with kerbs around them.

    Args:
        strips: the lanes.
        mouths: left and right side of each mouth.

    Returns:
        One lanelet per lane, and one area per mouth.
    """
    sides = [(strip.left, strip.right) for strip in strips] + mouths
    types = [strip.line_types for strip in strips] + [_KERBS] * len(mouths)
    rings = [np.concatenate([left, right[::-1]]) for left, right in sides]
    borders = []
    for number, ((left, right), (left_is, right_is)) in enumerate(zip(sides, types, strict=True)):
        others = rings[:number] + rings[number + 1 :]
        borders.append(
            (_borders(left, left_is, 1.0, others), _borders(right, right_is, -1.0, others))
        )
    lanes = [
        Lanelet(
            subtype="road",
            left=left,
            right=right,
            centre=strip.centre,
            speed_limit_mps=strip.speed_limit_mps,
        )
        for strip, (left, right) in zip(strips, borders, strict=False)
    ]
    return lanes, [_mouth(left, right) for left, right in borders[len(strips) :]]


def _mouth(left: tuple[Border, ...], right: tuple[Border, ...]) -> Area:
    begin, end = (
        Border(line=np.stack([left[i].line[i], right[i].line[i]]), marking="virtual")
        for i in (0, -1)
    )
    return Area(subtype="freespace", outer=(begin, *left, end, *right))


def _borders(
    line: Polyline, line_type: int, outside: float, others: list[np.ndarray]
) -> tuple[Border, ...]:
    """Sections of a border by marking; `outside` is 1 if the outside lies to the left, else -1."""
    if line_type in PLAIN:
        return (Border(line=line, marking=PLAIN[line_type]),)
    points, corners = _refined(line)
    along = np.diff(points, axis=0)
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
    middles = 0.5 * (points[1:] + points[:-1])
    step = outside * BESIDE_M * normals
    markings: list[Marking] = [
        "curb" if not beyond else "virtual" if within else "solid"
        for beyond, within in zip(
            _in_any(middles + step, others), _in_any(middles - step, others), strict=True
        )
    ]
    changes = [i for i in range(1, len(markings)) if markings[i] != markings[i - 1]]
    parts = []
    for first, last in pairwise([0, *changes, len(markings)]):
        selected = corners.copy()
        selected[[first, last]] = True
        part = points[first : last + 1][selected[first : last + 1]]
        parts.append(Border(line=part, marking=markings[first]))
    return tuple(parts)


def _refined(line: Polyline) -> tuple[Polyline, Bool[np.ndarray, " points"]]:
    """The line with additional points, and a mask of the original points."""
    points, corners = [line[:1]], [True]
    for start, end in pairwise(line):
        count = math.ceil(np.hypot(*(end - start)) / PART_M)
        share = np.arange(1, count + 1)[:, None] / count
        points.append(start + share * (end - start))
        corners += [False] * (count - 1) + [True]
    return np.concatenate(points), np.array(corners)


def _in_any(points: Float[np.ndarray, "n 2"], rings: list[np.ndarray]) -> Bool[np.ndarray, " n"]:
    """Mask of the points that any ring encloses (even-odd rule)."""
    found = np.zeros(len(points), dtype=bool)
    for ring in rings:
        start, end = ring, np.roll(ring, -1, axis=0)
        starts_above, ends_above = (corner[:, 1] > points[:, None, 1] for corner in (start, end))
        along, offset = end - start, points[:, None] - start
        cross = along[:, 0] * offset[..., 1] - along[:, 1] * offset[..., 0]
        hits = (starts_above != ends_above) & ((cross > 0) == ends_above)
        found |= hits.sum(axis=1) % 2 == 1
    return found


def write_road_map(path: Path, network: RoadNetwork, *, origin_utm_m: tuple[float, float]) -> None:
    """Writes the lanelet2 map of a road network, in highway-env's frame with y upwards.

    Lanes are written in the order of the network's graph.

    Args:
        path: the `.osm` file to write.
        network: the road network; straight, circular and sine lanes are supported.
        origin_utm_m: coordinates of the frame's origin in UTM zone 32.

    Raises:
        AspEnvError: the road has a gap that no lane can close.
    """
    lanes, areas = lanelets(list(strips(network).values()), mouths(network))
    write_map(path, lanes, areas, origin_utm_m=origin_utm_m, join_m=MEETS_M)
