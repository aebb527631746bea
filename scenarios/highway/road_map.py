"""From highway-env's axes to ours and back: x is the same, y points down there and up here.

Each function is its own inverse.

MERGED: highway-env's lanes as strips between two borders, in our axes and in the direction of travel.

Seen along a lane, highway-env's lateral coordinate grows to the right: it grows to the left of the
heading where y points up, and there y points down. The first of its two line types is that at the
lesser coordinate, the left one.

highway-env tells of a road where its lanes lie and which nodes they join. Added is what those need
who follow the lanes:

- Where the road ends, highway-env's lanes hold for 5 m more (`AbstractLane.on_lane`). So long they
  go straight on.
- Where a lane ends metres short of its follower (all ways in and out of the roundabout do), a
  smooth curve closes the gap.
- Such a gap has a mouth. Vehicles steer towards the follower at once and cut the corner between
  both lanes with their right side; highway-env, which asks where their centres are, calls that on
  the road. The mouth is the ground to both sides of the curve with the corner rounded off.
MERGED: What is painted or built along the lanes' borders.

highway-env draws a continuous line along the outside of a road wherever its lanes have one, also
across the mouths of its roundabout's ways in and out. A continuous line is here

- a kerb where nothing else lies beyond it: that is the edge of the road,
- nothing (virtual) where other lanes lie both beyond it and within, since they lead across it,
- solid elsewhere, between two lanes side by side.
MERGED: The map of a highway-env road, as the readers of recordings want it.
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


def mirror_points(points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Points, or velocities, in the other axes: y changes its sign."""
    return points * np.array([1.0, -1.0], dtype=points.dtype)


def mirror_states(states: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """States [x, y, heading, speed]: y and heading change their signs.

    Headings come out in [-π, π). There is no +π, so that -π stays what it is.
    """
    mirrored = states * np.array([1.0, -1.0, -1.0, 1.0], dtype=states.dtype)
    mirrored[..., 2] = wrap_angle(mirrored[..., 2])
    return mirrored


def mirror_actions(actions: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Actions [acceleration, steering]: what steers to the left here does to the right there."""
    return actions * np.array([1.0, -1.0], dtype=actions.dtype)


LaneIndex = tuple[str, str, int]
"""Node at which a lane begins, node at which it ends, and its number among those between them."""

Link = tuple[LaneIndex, LaneIndex]

Lanes = dict[LaneIndex, AbstractLane]

Sides = Float[np.ndarray, "3 n 2"]
"""Left border, centre line and right border of a lane, as equally many points."""

STEP_RAD = math.radians(2.0)
"""Lanes turn by so much between two points, on average: a chord is then off by 4 mm on a ring of
26 m radius, and by 1 cm on the gentle bends before one."""

LOOK_M = 0.1
"""Headings of a lane are looked at so far apart, to see how much it turns."""

MEETS_M = 0.01
"""Borders that end nearer than this to where others begin need no curve between."""

MOUTH_M = 8.0
"""So far before and behind a gap its mouth begins and ends. At the roundabout, boxes of vehicles
were then never off the road; with 5 m by 0.4 m at most, with no mouths by 1.2 m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Strip:
    """One lane, in our axes and in the direction of travel."""

    left: Polyline
    centre: Polyline
    right: Polyline
    line_types: tuple[int, int]
    """highway-env's `LineType` on the left and on the right."""
    speed_limit_mps: float


def all_lanes(network: RoadNetwork) -> Lanes:
    """The lanes of a road, in the order in which its graph holds them."""
    return {
        (begin, end, number): lane
        for begin, roads in network.graph.items()
        for end, road in roads.items()
        for number, lane in enumerate(road)
    }


def links(network: RoadNetwork) -> list[Link]:
    """Which lane leads to which, where the graph lets one road follow another.

    highway-env knows followers of roads, and its vehicles take the lane that begins nearest. Here a
    lane leads to that one too, but only if no other lane of its road ends nearer to it, since the
    others get there by changing lanes. Nor does a lane lead back the way it came.
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
    """All lanes, in the order in which the graph holds them.

    Raises:
        AspEnvError: there is a gap between two lanes that both have other ways to go.
    """
    lanes = all_lanes(network)
    found = {}
    for index, (left, centre, right) in _grown(lanes, links(network)).items():
        told = lanes[index].to_config()["config"]
        left_is, right_is = told["line_types"]
        found[index] = Strip(
            left=left,
            centre=centre,
            right=right,
            line_types=(left_is, right_is),
            speed_limit_mps=float(told["speed_limit"]),
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
    """All lanes' sides with what closes gaps, or goes on for a while where the road ends."""
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
                f"lane {leader} ends short of {follower}, and both have other ways to go; expected "
                "one of them to have none, so that it can close the gap: use another road"
            )
    return grown


def _sides(lane: AbstractLane) -> Sides:
    looks = np.linspace(0.0, lane.length, 2 + int(lane.length / LOOK_M))
    headings = np.unwrap([_heading_rad(lane, at) for at in looks])
    count = max(1, math.ceil(np.abs(np.diff(headings)).sum() / STEP_RAD - 1e-6))
    stations = np.linspace(0.0, lane.length, count + 1)
    return np.stack([_section(lane, at) for at in stations], axis=1)


def _section(lane: AbstractLane, at_m: float) -> Float[np.ndarray, "3 2"]:
    """Points on left border, centre line and right border, so far along a lane."""
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
    """Smooth curves from so far along one lane to so far along another."""
    starts, ends = _section(leader, leader_at_m), _section(follower, follower_at_m)
    start_rad, end_rad = (
        _heading_rad(leader, leader_at_m),
        _heading_rad(follower, follower_at_m),
    )
    return np.stack(
        [bezier(start, start_rad, end, end_rad) for start, end in zip(starts, ends, strict=True)]
    )


PLAIN: dict[int, Marking] = {LineType.NONE: "virtual", LineType.STRIPED: "dashed"}
"""Types of lines that are one thing everywhere; the others are continuous."""

_KERBS = (LineType.CONTINUOUS, LineType.CONTINUOUS)

BESIDE_M = 0.05
"""What covers a point so far to a side of a border lies on that side."""

PART_M = 0.1
"""Where the marking of a border changes is found to within this."""


def lanelets(
    strips: list[Strip], mouths: list[tuple[Polyline, Polyline]]
) -> tuple[list[Lanelet], list[Area]]:
    """The lanes with their markings in the same order, and the mouths with kerbs around them."""
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
    """A border in parts; `outside` is 1 where the lane's outside lies to the left, else -1."""
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
        kept = corners.copy()
        kept[[first, last]] = True
        part = points[first : last + 1][kept[first : last + 1]]
        parts.append(Border(line=part, marking=markings[first]))
    return tuple(parts)


def _refined(line: Polyline) -> tuple[Polyline, Bool[np.ndarray, " points"]]:
    """The same line with more points in between, and which of them it had before."""
    points, corners = [line[:1]], [True]
    for start, end in pairwise(line):
        count = math.ceil(np.hypot(*(end - start)) / PART_M)
        share = np.arange(1, count + 1)[:, None] / count
        points.append(start + share * (end - start))
        corners += [False] * (count - 1) + [True]
    return np.concatenate(points), np.array(corners)


def _in_any(points: Float[np.ndarray, "n 2"], rings: list[np.ndarray]) -> Bool[np.ndarray, " n"]:
    """Which points any of the rings encloses, by the even-odd rule."""
    found = np.zeros(len(points), dtype=bool)
    for ring in rings:
        start, end = ring, np.roll(ring, -1, axis=0)
        starts_above, ends_above = (corner[:, 1] > points[:, None, 1] for corner in (start, end))
        along, offset = end - start, points[:, None] - start
        cross = along[:, 0] * offset[..., 1] - along[:, 1] * offset[..., 0]
        hits = (starts_above != ends_above) & ((cross > 0) == ends_above)
        found |= hits.sum(axis=1) % 2 == 1
    return found


ORIGIN_UTM_M = (294_000.0, 5_628_000.0)
"""Where highway-env's origin lies in UTM zone 32: a meadow near Aachen. highway-env's roads lie
nowhere, but lanelet2 maps are written in degrees."""

ORIGIN_LAT_LON_DEG = (50.767140, 6.078601)
"""The same in degrees, to a decimetre."""


def write_road_map(path: Path, network: RoadNetwork, *, origin_utm_m: tuple[float, float]) -> None:
    """Writes the lanelet2 map of a road; its frame is highway-env's with y upwards.

    Lanes are written in the order in which the network's graph holds them.

    Args:
        path: the `.osm` file to write.
        network: the road; straight, circular and sine lanes are known to work.
        origin_utm_m: where the frame's origin lies in UTM zone 32.

    Raises:
        AspEnvError: the road has a gap that no lane can close.
    """
    lanes, areas = lanelets(list(strips(network).values()), mouths(network))
    write_map(path, lanes, areas, origin_utm_m=origin_utm_m, join_m=MEETS_M)
