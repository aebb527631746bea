"""Sites: crossroads, T-junctions and roundabouts, drawn by seed, as input of netconvert.

Junctions have no signals; the main road has priority. Traffic in roundabouts circulates
counter-clockwise and has priority.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from asp_env.geometry import wrap_scalar
from scenarios.polylines import Polyline, bezier, clothoid_like, offset, polar

Control = Literal["priority", "right_before_left", "traffic_light"]
"""Rule of the right of way at an intersection, named as in netconvert."""

SIDEWALK_M = 2.0
ARM_LENGTH_M = 130.0
"""Length of the roads; vehicles appear and disappear at their ends, outside the image."""

SIGHT_M = 40.0
"""Distance from which a vehicle that must yield sees the others."""

ENTRY_TILT_RAD = np.radians(8.0)
"""Angle of an entry from the radius towards the direction of travel in the ring."""

SWING_M = 0.8
"""Additional width of the lanes near the ring, where long vehicles swing out."""

TIGHT_RADIUS_M = 10.0
"""Rings of a smaller radius have no trucks and buses, which would leave the road. Chosen by
hand."""

LIMITS_MPS = (11.11, 13.89)

LEFT_TURN_RAD = np.radians(45.0)
"""Routes that bend to the left by more than this are left turns."""

CLOSE_MPS = 9.5
"""Speed limit between the crossing and the ring."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """A road that leads to a junction."""

    angle_rad: float
    """Direction from the centre."""
    enter: str
    """Edge on which vehicles enter."""
    leave: str
    """Edge on which vehicles leave."""
    lanes: int
    """Number of lanes that enter."""
    left_turns_only: bool = False
    """Whether the leftmost of several lanes is for left turns only."""
    weight: float
    """Share of the traffic, relative to the other arms."""
    enters: bool = True
    """Whether vehicles may enter; false for a one-way road that leaves the junction."""
    leaves: bool = True
    """Whether vehicles may leave; false for a one-way road that leads to the junction."""
    one_lane_leaves: bool = True
    """Whether vehicles leave on a single lane."""
    length_m: float
    """Length of the edges `enter` and `leave`."""
    starts: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Lanes that lead to the leaving edge of each other arm; empty without such a restriction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """A junction with its arms: plain XML for netconvert, and its dimensions."""

    kind: str
    """`crossroads`, `t-junction`, `roundabout` or `two-lane-roundabout`."""
    nodes: str
    edges: str
    connections: str
    endpoint_shape: bool
    """Whether junctions end exactly where the lines of the edges end."""
    arms: tuple[Arm, ...]
    speed_limit_mps: float
    half_size_m: tuple[float, float]
    """Half the width and half the height of the image."""
    parking: Float[np.ndarray, "lots 4 2"]
    """Corners of the parking lots, beside the pavement."""
    tight: bool = False
    """Whether there is no room for long vehicles."""


def lane_xml(
    index: int, width_m: float, speed_mps: float, *, pedestrian: bool = False, change: bool = False
) -> str:
    """A lane of an edge, for pedestrians or for all other agents.

    Lane changes to the left are not allowed; to the right only with `change`.
    """
    access = 'allow="pedestrian"' if pedestrian else 'disallow="pedestrian"'
    stay = 'changeLeft="emergency"' if change else 'changeLeft="emergency" changeRight="emergency"'
    return f'<lane index="{index}" {access} {stay} width="{width_m:.3f}" speed="{speed_mps:.3f}"/>'


def edge_xml(
    name: str,
    begin: str,
    end: str,
    line: Polyline,
    *,
    priority: int,
    lanes: int,
    width_m: float,
    speed_mps: float,
    change: bool = False,
) -> str:
    """One direction of a road whose left border is `line`, with a sidewalk on its right."""
    shape = " ".join(f"{x:.3f},{y:.3f}" for x, y in line)
    sidewalk = lane_xml(0, SIDEWALK_M, 2.0, pedestrian=True)
    drive = [lane_xml(1 + i, width_m, speed_mps, change=change) for i in range(lanes)]
    return (
        f'<edge id="{name}" from="{begin}" to="{end}" priority="{priority}" '
        f'numLanes="{1 + lanes}" speed="{speed_mps:.3f}" spreadType="right" '
        f'shape="{shape}">{"".join([sidewalk, *drive])}</edge>'
    )


def node_xml(name: str, point: np.ndarray, **attributes: str | float) -> str:
    """A node; further attributes are named as in netconvert."""
    more = "".join(f' {key}="{value}"' for key, value in attributes.items())
    return f'<node id="{name}" x="{point[0]:.3f}" y="{point[1]:.3f}"{more}/>'


def connection_xml(begin: str, end: str, lane: int = 1, to_lane: int | None = None) -> str:
    """A connection from a lane of one edge to a lane of the next, by default the same.

    Without a visibility distance SUMO's vehicles nearly stop before they check for others.
    """
    return (
        f'<connection from="{begin}" to="{end}" fromLane="{lane}" toLane="{to_lane or lane}" '
        f'visibility="{SIGHT_M}"/>'
    )


def crossing_xml(node: str, edges: tuple[str, ...]) -> str:
    """A zebra crossing over the directions of an arm."""
    return f'<crossing node="{node}" edges="{" ".join(edges)}" priority="true" width="3.0"/>'


def parking_lot(
    line: Polyline, *, from_m: float, beside_m: float, spaces: int
) -> Float[np.ndarray, "4 2"]:
    """Corners of a row of parking spaces to the right of an outgoing arm.

    Args:
        line: the arm, points 2 m apart.
        from_m: distance from the centre along the arm.
        beside_m: distance from the line of the arm.
        spaces: number of spaces.
    """
    at = int(from_m / 2.0)
    ahead = line[at + 1] - line[at]
    ahead = ahead / np.hypot(*ahead)
    right = np.array([ahead[1], -ahead[0]])
    corner = line[at] + (beside_m + 0.4) * right
    long, deep = 2.6 * spaces, 5.2
    return np.stack(
        [corner, corner + long * ahead, corner + long * ahead + deep * right, corner + deep * right]
    )


def right_turn_rad(begin_rad: float, end_rad: float) -> float:
    """Angle of the turn from one arm to another, given their directions, right positive, rad."""
    return float(wrap_scalar(begin_rad + np.pi - end_rad))


def crossroads(rng: np.random.Generator, *, left_lanes: bool = False) -> Site:
    """Four arms; the first and third are the main road.

    Args:
        rng: draws the site.
        left_lanes: whether vehicles that turn left from the main road have a lane of their own.
    """
    turn = rng.uniform(0.0, 0.5 * np.pi)
    angles = turn + 0.5 * np.pi * np.arange(4) + np.radians(rng.uniform(-14.0, 14.0, 4))
    return _junction(rng, "crossroads", angles, main=(0, 2), left_lanes=left_lanes)


def t_junction(rng: np.random.Generator, *, left_lanes: bool = False) -> Site:
    """Three arms; the first two are the main road, the third ends at it.

    Args:
        rng: draws the site.
        left_lanes: whether vehicles that turn left from the main road have a lane of their own.
    """
    turn = rng.uniform(0.0, 2.0 * np.pi)
    angles = turn + np.radians(
        np.array([0.0, 180.0 + rng.uniform(-14.0, 14.0), 270.0 + rng.uniform(-20.0, 20.0)])
    )
    return _junction(rng, "t-junction", angles, main=(0, 1), left_lanes=left_lanes)


def _junction(
    rng: np.random.Generator,
    kind: str,
    angles_rad: np.ndarray,
    *,
    main: tuple[int, int],
    left_lanes: bool,
) -> Site:
    main_weight = 2.2 if left_lanes else 1.5
    width_m = rng.uniform(3.4, 3.9)
    main_mps, side_mps = rng.choice([(13.89, 13.89), (13.89, 8.33), (11.11, 8.33)])
    with_crossing = rng.random(len(angles_rad)) < 0.6
    with_crossing[rng.integers(len(angles_rad))] = True
    radius_m = rng.uniform(7.0, 10.0)
    roads = []
    for i, angle in enumerate(angles_rad):
        line = clothoid_like(
            heading_rad=float(angle),
            curvature_per_m=rng.uniform(-0.005, 0.005),
            straight_m=28.0,
            length_m=ARM_LENGTH_M,
        )
        is_main = i in main
        left = any(
            right_turn_rad(angle, other) < -LEFT_TURN_RAD
            for j, other in enumerate(angles_rad)
            if j != i
        )
        pocket = left_lanes and is_main and left
        roads.append(
            Road(
                angle_rad=float(angle),
                line=line,
                split=int(rng.integers(12, 15)),
                priority=4 if is_main else 1,
                width_m=width_m,
                speed_mps=float(main_mps if is_main else side_mps),
                enter=2 if pocket else 1,
                leave=1,
                left_turns_only=pocket,
                crossing=bool(with_crossing[i]),
                weight=float(rng.uniform(0.8, 1.2) * (main_weight if is_main else 1.0)),
                parking_from_m=float(rng.uniform(30.0, 42.0)),
                parking_spaces=int(rng.integers(2, 5)),
            )
        )
    return junction(
        kind,
        roads,
        radius_m=radius_m,
        speed_limit_mps=float(main_mps),
        half_size_m=(68.0, 56.0),
        lots=tuple(range(1 + int(rng.integers(2)))),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Road:
    """The dimensions of one arm of a site."""

    angle_rad: float
    """Direction from the centre."""
    line: Polyline
    """Middle of the road from the centre outwards, points 2 m apart."""
    split: int
    """Point of the line at which the junction's surroundings end, with or without a crossing."""
    priority: int
    """Of two roads, the one of higher priority has the right of way."""
    width_m: float
    """Width of each lane."""
    speed_mps: float
    """Speed limit."""
    enter: int
    """Number of lanes that enter the junction; 0 for a one-way road that leaves it."""
    leave: int
    """Number of lanes that leave the junction; 0 for a one-way road that leads to it."""
    left_turns_only: bool = False
    """Whether the left one of two entering lanes is for left turns only."""
    median_m: float = 0.0
    """Distance between the two directions."""
    crossing: bool
    """Whether there is a zebra crossing."""
    weight: float
    """Share of the traffic, relative to the other arms."""
    parking_from_m: float
    """Distance of the parking lot from the centre, along the arm."""
    parking_spaces: int

    @property
    def half_width_m(self) -> float:
        """Distance from the line to the outer side of the wider direction's sidewalk."""
        lanes = max(self.enter, self.leave)
        return 0.5 * self.median_m + lanes * self.width_m + SIDEWALK_M

    @property
    def far_inward(self) -> Polyline:
        """Left border of the entering direction, from the outer end to the split."""
        return offset(self.line, 0.5 * self.median_m)[self.split :][::-1]

    @property
    def far_outward(self) -> Polyline:
        """Left border of the leaving direction, from the split to the outer end."""
        return offset(self.line, -0.5 * self.median_m)[self.split :]

    @property
    def near_inward(self) -> Polyline:
        """Left border of the entering direction, from the split to the centre."""
        return offset(self.line, 0.5 * self.median_m)[: self.split + 1][::-1]

    @property
    def near_outward(self) -> Polyline:
        """Left border of the leaving direction, from the centre to the split."""
        return offset(self.line, -0.5 * self.median_m)[: self.split + 1]

    def arm(self, number: int) -> Arm:
        """The arm with its edges `in…` and `out…`."""
        return Arm(
            angle_rad=self.angle_rad,
            enter=f"in{number}",
            leave=f"out{number}",
            lanes=self.enter,
            left_turns_only=self.left_turns_only,
            weight=self.weight,
            enters=self.enter > 0,
            leaves=self.leave > 0,
            one_lane_leaves=self.leave == 1,
            length_m=2.0 * (len(self.line) - 1 - self.split),
        )

    def parking(self) -> Float[np.ndarray, "4 2"]:
        """Corners of the parking lot beside the leaving direction."""
        return parking_lot(
            self.line,
            from_m=self.parking_from_m,
            beside_m=0.5 * self.median_m + self.leave * self.width_m + SIDEWALK_M,
            spaces=self.parking_spaces,
        )

    def lanes_to(self, other: "Road") -> tuple[int, ...]:
        """Lanes from which vehicles go to another arm.

        Left turns start on the leftmost lane, all others on the right one. A second lane that is
        not for left turns only also leads straight on, into an arm with a second lane.
        """
        angle = right_turn_rad(self.angle_rad, other.angle_rad)
        if angle < -LEFT_TURN_RAD:
            return (self.enter,)
        straight = self.enter == other.leave == 2 and angle <= LEFT_TURN_RAD
        return (1, 2) if straight and not self.left_turns_only else (1,)

    def crossing_xml(self, number: int) -> str:
        """The zebra crossing over the directions that the road has."""
        edges = [f"in{number}"] * (self.enter > 0) + [f"out{number}"] * (self.leave > 0)
        return crossing_xml(f"k{number}", tuple(edges))


def junction(
    kind: str,
    roads: list[Road],
    *,
    radius_m: float,
    speed_limit_mps: float,
    half_size_m: tuple[float, float],
    lots: tuple[int, ...],
    control: Control = "priority",
) -> Site:
    """An intersection of given dimensions.

    Args:
        kind: name of the site.
        roads: its arms, counter-clockwise.
        radius_m: radius of the corners.
        speed_limit_mps: written to the metadata.
        half_size_m: half the width and half the height of the image.
        lots: arms with a parking lot.
        control: rule of the right of way.
    """
    nodes = [node_xml("c", np.zeros(2), type=control, radius=f"{radius_m:.2f}")]
    edges, connections = [], []
    for i, road in enumerate(roads):
        near = road.line[road.split]
        nodes += [node_xml(f"e{i}", road.line[-1]), node_xml(f"k{i}", near, type="priority")]
        same = {
            "priority": road.priority, "width_m": road.width_m, "speed_mps": road.speed_mps
        }  # fmt: skip
        if road.enter:
            same["lanes"] = road.enter
            edges.append(edge_xml(f"in{i}", f"e{i}", f"k{i}", road.far_inward, **same))
            edges.append(edge_xml(f"app{i}", f"k{i}", "c", road.near_inward, **same))
        if road.leave:
            same["lanes"] = road.leave
            edges.append(edge_xml(f"exit{i}", "c", f"k{i}", road.near_outward, **same))
            edges.append(edge_xml(f"out{i}", f"k{i}", f"e{i}", road.far_outward, **same))
        connections += _turns(roads, i)
        lanes = range(1, 1 + road.enter)
        connections += [connection_xml(f"in{i}", f"app{i}", lane) for lane in lanes]
        lanes = range(1, 1 + road.leave)
        connections += [connection_xml(f"exit{i}", f"out{i}", lane) for lane in lanes]
        if road.crossing:
            connections.append(road.crossing_xml(i))
    parking = [roads[i].parking() for i in lots]
    return Site(
        kind=kind,
        nodes="".join(nodes),
        edges="".join(edges),
        connections="".join(connections),
        endpoint_shape=False,
        arms=tuple(_junction_arm(roads, i) for i in range(len(roads))),
        speed_limit_mps=speed_limit_mps,
        half_size_m=half_size_m,
        parking=np.stack(parking) if parking else np.zeros((0, 4, 2)),
    )


def _junction_arm(roads: list[Road], i: int) -> Arm:
    road = roads[i]
    if road.enter < 2 or road.left_turns_only:
        return road.arm(i)
    others = {f"out{j}": road.lanes_to(other) for j, other in enumerate(roads) if j != i}
    return replace(road.arm(i), starts=others)


def _turns(roads: list[Road], i: int) -> list[str]:
    """The connections from arm `i` across the junction."""
    road = roads[i]
    connections = []
    for j, other in enumerate(roads):
        if j == i or not road.enter or not other.leave:
            continue
        for lane in road.lanes_to(other):
            to_lane = min(lane, other.leave)
            connections.append(connection_xml(f"app{i}", f"exit{j}", lane, to_lane))
    return connections


@dataclass(frozen=True, slots=True, kw_only=True)
class Ring:
    """The circulating lanes, and what all arms have in common."""

    inner_m: float
    lanes: int
    lane_m: float
    speed_mps: float
    """Speed limit in the ring."""
    leave_inside: bool = False
    """Whether wide arms have two lanes that leave the ring."""
    entry_tilt_rad: float = ENTRY_TILT_RAD
    """Angle of an entry from the radius towards the direction of travel in the ring."""
    mouth_m: float = 2.0
    """Half the distance between entry and exit of an arm, at the ring."""
    swing_m: float = SWING_M
    """Additional width of the lanes near the ring."""

    def wide(self, arm: int) -> bool:
        """Whether an arm enters the ring with two lanes."""
        return self.lanes == 2 and arm % 2 == 0

    def exits(self, arm: int) -> int:
        """Number of lanes that leave the ring at an arm."""
        return 2 if self.leave_inside and self.wide(arm) else 1

    @property
    def outer_m(self) -> float:
        """Outer radius."""
        return self.inner_m + self.lanes * self.lane_m

    def half_rad(self, arms: int) -> float:
        """Half the angle that the junction with one of several arms takes of the ring."""
        gap_rad = 2.0 * np.pi / arms
        return min(9.5 / (self.inner_m + 0.5 * self.lane_m), 0.34 * gap_rad)


def roundabout(rng: np.random.Generator) -> Site:
    """One lane in the ring; three to five arms of one lane."""
    arms = int(rng.choice([3, 4, 4, 5]))
    inner_m = rng.uniform(11.5, 14.5) + (3.0 if arms == 5 else 0.0)
    lane_m = rng.uniform(5.2, 6.0)
    arm_lane_m = rng.uniform(3.5, 3.9)
    limit_mps = float(rng.choice(LIMITS_MPS))
    angles_rad = _angles(rng, arms, {3: 14.0, 4: 8.0, 5: 3.0}[arms])
    ring = Ring(inner_m=inner_m, lanes=1, lane_m=lane_m, speed_mps=_ring_mps(rng, inner_m, lane_m))
    return _round(rng, "roundabout", ring, angles_rad, arm_lane_m, limit_mps)


def two_lane_roundabout(rng: np.random.Generator, *, leave_inside: bool = False) -> Site:
    """Two lanes in the ring; two opposite arms of the four enter with two lanes.

    Args:
        rng: draws the site.
        leave_inside: whether these two arms are also left with two lanes. There a vehicle on the
            inner lane may leave, and one on the outer lane may stay in the ring.
    """
    inner_m = rng.uniform(17.0, 21.0)
    lane_m = rng.uniform(4.9, 5.3)
    arm_lane_m = rng.uniform(3.5, 3.9)
    limit_mps = float(rng.choice(LIMITS_MPS))
    angles_rad = _angles(rng, 4, 8.0)
    ring = Ring(
        inner_m=inner_m,
        lanes=2,
        lane_m=lane_m,
        speed_mps=_ring_mps(rng, inner_m, lane_m),
        leave_inside=leave_inside,
    )
    return _round(rng, "two-lane-roundabout", ring, angles_rad, arm_lane_m, limit_mps)


def _angles(rng: np.random.Generator, arms: int, jitter_deg: float) -> np.ndarray:
    even = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi / arms * np.arange(arms)
    return even + np.radians(rng.uniform(-jitter_deg, jitter_deg, arms))


def _ring_mps(rng: np.random.Generator, inner_m: float, lane_m: float) -> float:
    return float(np.sqrt(rng.uniform(1.9, 2.4) * (inner_m + 0.5 * lane_m)))


def _round(
    rng: np.random.Generator,
    kind: str,
    ring: Ring,
    angles_rad: np.ndarray,
    arm_lane_m: float,
    limit_mps: float,
) -> Site:
    roads = []
    for i, angle in enumerate(angles_rad):
        line = clothoid_like(
            heading_rad=float(angle),
            curvature_per_m=rng.uniform(-0.004, 0.004),
            straight_m=ring.outer_m + 24.0,
            length_m=ARM_LENGTH_M,
        )
        wide = ring.wide(i)
        roads.append(
            Road(
                angle_rad=float(angle),
                line=line,
                split=round((ring.outer_m + 17.0) / 2.0),
                priority=3,
                width_m=arm_lane_m,
                speed_mps=limit_mps,
                enter=2 if wide else 1,
                leave=ring.exits(i),
                crossing=bool(rng.random() < 0.75),
                weight=float(rng.uniform(0.8, 1.3) * (1.6 if wide else 1.0)),
                parking_from_m=ring.outer_m + rng.uniform(22.0, 28.0),
                parking_spaces=int(rng.integers(2, 5)),
            )
        )
    return round_site(
        kind,
        ring,
        roads,
        speed_limit_mps=limit_mps,
        half_size_m=(72.0, 60.0),
        lots=tuple(range(1 + int(rng.integers(2)))),
    )


@dataclass(slots=True, kw_only=True)
class _Plan:
    """The parts of a site while it is built."""

    nodes: list[str] = field(default_factory=list)
    edges: list[str] = field(default_factory=list)
    connections: list[str] = field(default_factory=list)


def round_site(
    kind: str,
    ring: Ring,
    roads: list[Road],
    *,
    speed_limit_mps: float,
    half_size_m: tuple[float, float],
    lots: tuple[int, ...],
) -> Site:
    """A roundabout of given dimensions.

    Args:
        kind: name of the site.
        ring: the circulating lanes.
        roads: its arms, counter-clockwise.
        speed_limit_mps: written to the metadata.
        half_size_m: half the width and half the height of the image.
        lots: arms with a parking lot.
    """
    plan = _Plan()
    for i in range(len(roads)):
        _add_ring_part(plan, ring, roads, i)
        _add_arm(plan, ring, roads[i], i)
    parking = [roads[i].parking() for i in lots]
    return Site(
        kind=kind,
        nodes="".join(plan.nodes),
        edges="".join(plan.edges),
        connections="".join(plan.connections),
        endpoint_shape=True,
        arms=tuple(road.arm(i) for i, road in enumerate(roads)),
        speed_limit_mps=speed_limit_mps,
        half_size_m=half_size_m,
        parking=np.stack(parking) if parking else np.zeros((0, 4, 2)),
        tight=ring.inner_m + 0.5 * ring.lanes * ring.lane_m < TIGHT_RADIUS_M,
    )


def _add_ring_part(plan: _Plan, ring: Ring, roads: list[Road], i: int) -> None:
    """Adds the ring from arm `i` to the next arm, and the connections past the arm."""
    arms = len(roads)
    half_rad = ring.half_rad(arms)
    angle, after = roads[i].angle_rad, roads[(i + 1) % arms].angle_rad
    after = after + (2.0 * np.pi if i == arms - 1 else 0.0)
    sweep = np.linspace(angle + half_rad, after - half_rad, 13)
    plan.nodes.append(node_xml(f"r{i}", polar(ring.outer_m, angle), type="priority"))
    plan.edges.append(
        edge_xml(
            f"ring{i}",
            f"r{i}",
            f"r{(i + 1) % arms}",
            polar(ring.inner_m, sweep),
            priority=9,
            lanes=ring.lanes,
            width_m=ring.lane_m,
            speed_mps=ring.speed_mps,
            change=True,
        )
    )
    before = f"ring{(i - 1) % arms}"
    plan.connections += [connection_xml(before, f"ring{i}", 1 + lane) for lane in range(ring.lanes)]
    plan.connections += [
        connection_xml(before, f"exit{i}", 1 + lane) for lane in range(roads[i].leave)
    ]


def _add_arm(plan: _Plan, ring: Ring, road: Road, i: int) -> None:
    """Adds arm `i`: a road to a crossing, and entry and exit between the crossing and the ring."""
    angle, outer_m = road.angle_rad, ring.outer_m
    near = road.line[road.split]
    plan.nodes += [node_xml(f"k{i}", near, type="priority"), node_xml(f"e{i}", road.line[-1])]
    # The left border of the entry bends towards the direction of the ring, that of the exit away.
    mouth = [polar(outer_m + 3.0, angle + side * ring.mouth_m / outer_m) for side in (1.0, -1.0)]
    same = {"priority": road.priority, "width_m": road.width_m, "speed_mps": road.speed_mps}
    close = {
        "priority": road.priority,
        "width_m": road.width_m + ring.swing_m,
        "speed_mps": min(road.speed_mps, CLOSE_MPS),
    }
    far_in, far_out = road.far_inward, road.far_outward
    if road.enter:
        into = bezier(far_in[-1], angle + np.pi, mouth[0], angle + np.pi - ring.entry_tilt_rad)
        plan.edges += [
            edge_xml(f"in{i}", f"e{i}", f"k{i}", far_in, lanes=road.enter, **same),
            edge_xml(f"app{i}", f"k{i}", f"r{i}", into, lanes=road.enter, **close),
        ]
    if road.leave:
        away = bezier(mouth[1], angle + ring.entry_tilt_rad, far_out[0], angle)
        plan.edges += [
            edge_xml(f"exit{i}", f"r{i}", f"k{i}", away, lanes=road.leave, **close),
            edge_xml(f"out{i}", f"k{i}", f"e{i}", far_out, lanes=road.leave, **same),
        ]
    for lane in range(1, 1 + road.enter):
        plan.connections.append(connection_xml(f"in{i}", f"app{i}", lane))
        plan.connections.append(connection_xml(f"app{i}", f"ring{i}", lane))
    for lane in range(1, 1 + road.leave):
        plan.connections.append(connection_xml(f"exit{i}", f"out{i}", lane))
    if road.crossing:
        plan.connections.append(road.crossing_xml(i))
