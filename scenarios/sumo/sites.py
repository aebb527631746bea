"""Sites: crossroads, T-junctions and roundabouts, drawn by seed, as input of netconvert.

Junctions have no signals; the main road has priority. Traffic in roundabouts circulates
counter-clockwise and has priority.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from asp_env.geometry import wrap_scalar
from scenarios.polylines import Polyline, bezier, clothoid_like, polar

SIDEWALK_M = 2.0
ARM_LENGTH_M = 130.0
"""Length of the roads; vehicles appear and disappear at their ends, outside the image."""

SIGHT_M = 40.0
"""Distance from which a vehicle that must yield sees the others."""

ENTRY_TILT_RAD = np.radians(8.0)
"""Angle of an entry from the radius towards the direction of travel in the ring."""

SWING_M = 0.8
"""Additional width of the lanes near the ring, where long vehicles swing out."""

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


def crossing_xml(node: str, edges: tuple[str, str]) -> str:
    """A zebra crossing over both directions of an arm."""
    return f'<crossing node="{node}" edges="{" ".join(edges)}" priority="true" width="3.0"/>'


def parking_lot(
    rng: np.random.Generator, line: Polyline, *, from_m: float, beside_m: float
) -> Float[np.ndarray, "4 2"]:
    """Corners of a row of parking spaces to the right of an outgoing arm.

    Args:
        rng: draws the number of spaces.
        line: the arm, points 2 m apart.
        from_m: distance from the centre along the arm.
        beside_m: distance from the line of the arm.
    """
    at = int(from_m / 2.0)
    ahead = line[at + 1] - line[at]
    ahead = ahead / np.hypot(*ahead)
    right = np.array([ahead[1], -ahead[0]])
    corner = line[at] + (beside_m + 0.4) * right
    long, deep = 2.6 * float(rng.integers(2, 5)), 5.2
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
    middle = np.zeros(2)
    radius_m = rng.uniform(7.0, 10.0)
    nodes = [node_xml("c", middle, type="priority", radius=f"{radius_m:.2f}")]
    edges, connections, arms, parking = [], [], [], []
    for i, angle in enumerate(angles_rad):
        line = clothoid_like(
            heading_rad=float(angle),
            curvature_per_m=rng.uniform(-0.005, 0.005),
            straight_m=28.0,
            length_m=ARM_LENGTH_M,
        )
        is_main = i in main
        speed = float(main_mps if is_main else side_mps)
        split = int(rng.integers(12, 15))
        near, far = line[: split + 1], line[split:]
        nodes += [node_xml(f"e{i}", line[-1]), node_xml(f"k{i}", line[split], type="priority")]
        others = [j for j in range(len(angles_rad)) if j != i]
        left = {j for j in others if right_turn_rad(angle, angles_rad[j]) < -LEFT_TURN_RAD}
        enter = 2 if left_lanes and is_main and left else 1
        road = {"priority": 4 if is_main else 1, "width_m": width_m, "speed_mps": speed}
        edges.append(edge_xml(f"in{i}", f"e{i}", f"k{i}", far[::-1], lanes=enter, **road))
        edges.append(edge_xml(f"app{i}", f"k{i}", "c", near[::-1], lanes=enter, **road))
        edges.append(edge_xml(f"exit{i}", "c", f"k{i}", near, lanes=1, **road))
        edges.append(edge_xml(f"out{i}", f"k{i}", f"e{i}", far, lanes=1, **road))
        connections += [
            connection_xml(f"app{i}", f"exit{j}", enter if j in left else 1, 1) for j in others
        ]
        connections += [connection_xml(f"in{i}", f"app{i}", 1 + lane) for lane in range(enter)]
        connections.append(connection_xml(f"exit{i}", f"out{i}"))
        if with_crossing[i]:
            connections.append(crossing_xml(f"k{i}", (f"in{i}", f"out{i}")))
        weight = rng.uniform(0.8, 1.2) * (main_weight if is_main else 1.0)
        arms.append(
            Arm(
                angle_rad=float(angle),
                enter=f"in{i}",
                leave=f"out{i}",
                lanes=enter,
                left_turns_only=enter > 1,
                weight=float(weight),
            )
        )
        parking.append(
            parking_lot(rng, line, from_m=rng.uniform(30.0, 42.0), beside_m=width_m + SIDEWALK_M)
        )
    return Site(
        kind=kind,
        nodes="".join(nodes),
        edges="".join(edges),
        connections="".join(connections),
        endpoint_shape=False,
        arms=tuple(arms),
        speed_limit_mps=float(main_mps),
        half_size_m=(68.0, 56.0),
        parking=np.stack(parking[: 1 + int(rng.integers(2))]),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ring:
    """The circulating lanes, and what all arms have in common."""

    inner_m: float
    lanes: int
    lane_m: float
    arm_lane_m: float
    speed_limit_mps: float
    angles_rad: np.ndarray
    leave_inside: bool = False
    """Whether wide arms have two lanes that leave the ring."""

    def wide(self, arm: int) -> bool:
        """Whether an arm enters the ring with two lanes."""
        return self.lanes == 2 and arm % 2 == 0

    def exits(self, arm: int) -> int:
        """Number of lanes that leave the ring at an arm."""
        return 2 if self.leave_inside and self.wide(arm) else 1

    @property
    def outer_m(self) -> float:
        return self.inner_m + self.lanes * self.lane_m

    @property
    def half_rad(self) -> float:
        """Half the angle that the junction with one arm takes of the ring."""
        gap_rad = 2.0 * np.pi / len(self.angles_rad)
        return min(9.5 / (self.inner_m + 0.5 * self.lane_m), 0.34 * gap_rad)


@dataclass(slots=True, kw_only=True)
class _Plan:
    """The parts of a site while it is built."""

    nodes: list[str] = field(default_factory=list)
    edges: list[str] = field(default_factory=list)
    connections: list[str] = field(default_factory=list)
    arms: list[Arm] = field(default_factory=list)
    parking: list[np.ndarray] = field(default_factory=list)


def roundabout(rng: np.random.Generator) -> Site:
    """One lane in the ring; three to five arms of one lane."""
    arms = int(rng.choice([3, 4, 4, 5]))
    ring = _Ring(
        inner_m=rng.uniform(11.5, 14.5) + (3.0 if arms == 5 else 0.0),
        lanes=1,
        lane_m=rng.uniform(5.2, 6.0),
        arm_lane_m=rng.uniform(3.5, 3.9),
        speed_limit_mps=float(rng.choice(LIMITS_MPS)),
        angles_rad=_angles(rng, arms, {3: 14.0, 4: 8.0, 5: 3.0}[arms]),
    )
    return _site(rng, "roundabout", ring)


def two_lane_roundabout(rng: np.random.Generator, *, leave_inside: bool = False) -> Site:
    """Two lanes in the ring; two opposite arms of the four enter with two lanes.

    Args:
        rng: draws the site.
        leave_inside: whether these two arms are also left with two lanes. There a vehicle on the
            inner lane may leave, and one on the outer lane may stay in the ring.
    """
    ring = _Ring(
        inner_m=rng.uniform(17.0, 21.0),
        lanes=2,
        lane_m=rng.uniform(4.9, 5.3),
        arm_lane_m=rng.uniform(3.5, 3.9),
        speed_limit_mps=float(rng.choice(LIMITS_MPS)),
        angles_rad=_angles(rng, 4, 8.0),
        leave_inside=leave_inside,
    )
    return _site(rng, "two-lane-roundabout", ring)


def _angles(rng: np.random.Generator, arms: int, jitter_deg: float) -> np.ndarray:
    even = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi / arms * np.arange(arms)
    return even + np.radians(rng.uniform(-jitter_deg, jitter_deg, arms))


def _site(rng: np.random.Generator, kind: str, ring: _Ring) -> Site:
    plan = _Plan()
    ring_mps = float(np.sqrt(rng.uniform(1.9, 2.4) * (ring.inner_m + 0.5 * ring.lane_m)))
    for i in range(len(ring.angles_rad)):
        _add_ring_part(plan, ring, i, ring_mps)
        _add_arm(rng, plan, ring, i)
    return Site(
        kind=kind,
        nodes="".join(plan.nodes),
        edges="".join(plan.edges),
        connections="".join(plan.connections),
        endpoint_shape=True,
        arms=tuple(plan.arms),
        speed_limit_mps=ring.speed_limit_mps,
        half_size_m=(72.0, 60.0),
        parking=np.stack(plan.parking[: 1 + int(rng.integers(2))]),
    )


def _add_ring_part(plan: _Plan, ring: _Ring, i: int, speed_mps: float) -> None:
    """Adds the ring from arm `i` to the next arm, and the connections past the arm."""
    arms = len(ring.angles_rad)
    angle, after = ring.angles_rad[i], ring.angles_rad[(i + 1) % arms]
    after = after + (2.0 * np.pi if i == arms - 1 else 0.0)
    sweep = np.linspace(angle + ring.half_rad, after - ring.half_rad, 13)
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
            speed_mps=speed_mps,
            change=True,
        )
    )
    before = f"ring{(i - 1) % arms}"
    plan.connections += [connection_xml(before, f"ring{i}", 1 + lane) for lane in range(ring.lanes)]
    plan.connections += [
        connection_xml(before, f"exit{i}", 1 + lane) for lane in range(ring.exits(i))
    ]


def _add_arm(rng: np.random.Generator, plan: _Plan, ring: _Ring, i: int) -> None:
    """Adds arm `i`: a road to a crossing, and entry and exit between the crossing and the ring."""
    angle, outer_m = float(ring.angles_rad[i]), ring.outer_m
    line = clothoid_like(
        heading_rad=angle,
        curvature_per_m=rng.uniform(-0.004, 0.004),
        straight_m=outer_m + 24.0,
        length_m=ARM_LENGTH_M,
    )
    split = round((outer_m + 17.0) / 2.0)
    far, near = line[split:], line[split]
    plan.nodes += [node_xml(f"k{i}", near, type="priority"), node_xml(f"e{i}", line[-1])]
    # The left border of the entry bends towards the direction of the ring, that of the exit away.
    mouth = [polar(outer_m + 3.0, angle + side * 2.0 / outer_m) for side in (1.0, -1.0)]
    into = bezier(near, angle + np.pi, mouth[0], angle + np.pi - ENTRY_TILT_RAD)
    away = bezier(mouth[1], angle + ENTRY_TILT_RAD, near, angle)
    double = ring.wide(i)
    enter, leave = 2 if double else 1, ring.exits(i)
    road = {"priority": 3, "width_m": ring.arm_lane_m, "speed_mps": ring.speed_limit_mps}
    close = {
        "priority": 3,
        "width_m": ring.arm_lane_m + SWING_M,
        "speed_mps": min(ring.speed_limit_mps, CLOSE_MPS),
    }
    plan.edges += [
        edge_xml(f"in{i}", f"e{i}", f"k{i}", far[::-1], lanes=enter, **road),
        edge_xml(f"app{i}", f"k{i}", f"r{i}", into, lanes=enter, **close),
        edge_xml(f"exit{i}", f"r{i}", f"k{i}", away, lanes=leave, **close),
        edge_xml(f"out{i}", f"k{i}", f"e{i}", far, lanes=leave, **road),
    ]
    for lane in range(1, 1 + enter):
        plan.connections.append(connection_xml(f"in{i}", f"app{i}", lane))
        plan.connections.append(connection_xml(f"app{i}", f"ring{i}", lane))
    for lane in range(1, 1 + leave):
        plan.connections.append(connection_xml(f"exit{i}", f"out{i}", lane))
    if rng.random() < 0.75:
        plan.connections.append(crossing_xml(f"k{i}", (f"in{i}", f"out{i}")))
    weight = float(rng.uniform(0.8, 1.3) * (1.6 if double else 1.0))
    plan.arms.append(
        Arm(angle_rad=angle, enter=f"in{i}", leave=f"out{i}", lanes=enter, weight=weight)
    )
    from_m, beside_m = outer_m + rng.uniform(22.0, 28.0), leave * ring.arm_lane_m + SIDEWALK_M
    plan.parking.append(parking_lot(rng, line, from_m=from_m, beside_m=beside_m))
