"""Roundabouts of one and two lanes; traffic circulates counter-clockwise and has priority."""

from dataclasses import dataclass, field

import numpy as np

from scenarios.polylines import bezier, clothoid_like, polar
from scenarios.synthetic.site import (
    ARM_LENGTH_M,
    SIDEWALK_M,
    Arm,
    Site,
    connection_xml,
    crossing_xml,
    edge_xml,
    node_xml,
    parking_lot,
)

ENTRY_TILT_RAD = np.radians(8.0)
"""How far an entry is turned from the radius towards the direction of travel in the ring."""


SWING_M = 0.8
"""How much wider the lanes are near the ring, where long vehicles swing."""
LIMITS_MPS = (11.11, 13.89)
CLOSE_MPS = 9.5
"""How fast one drives between the crossing and the ring, at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ring:
    """The circulating lanes and what all arms have in common."""

    inner_m: float
    lanes: int
    lane_m: float
    arm_lane_m: float
    speed_limit_mps: float
    angles_rad: np.ndarray

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
    """The parts of a site, as they are drawn."""

    nodes: list[str] = field(default_factory=list)
    edges: list[str] = field(default_factory=list)
    connections: list[str] = field(default_factory=list)
    arms: list[Arm] = field(default_factory=list)
    parking: list[np.ndarray] = field(default_factory=list)


def roundabout(rng: np.random.Generator) -> Site:
    """One lane in the ring, three to five arms of one lane."""
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


def two_lane_roundabout(rng: np.random.Generator) -> Site:
    """Two lanes in the ring; two opposite ones of the four arms enter with two lanes."""
    ring = _Ring(
        inner_m=rng.uniform(17.0, 21.0),
        lanes=2,
        lane_m=rng.uniform(4.9, 5.3),
        arm_lane_m=rng.uniform(3.5, 3.9),
        speed_limit_mps=float(rng.choice(LIMITS_MPS)),
        angles_rad=_angles(rng, 4, 8.0),
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
    """The ring from arm `i` to the next, and the ways past the arm."""
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
    plan.connections.append(connection_xml(before, f"exit{i}"))


def _add_arm(rng: np.random.Generator, plan: _Plan, ring: _Ring, i: int) -> None:
    """Arm `i`: a road to a crossing, and entry and exit between that and the ring."""
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
    # The left border of the entry bends towards the direction of the ring, the exit's away.
    mouth = [polar(outer_m + 3.0, angle + side * 2.0 / outer_m) for side in (1.0, -1.0)]
    into = bezier(near, angle + np.pi, mouth[0], angle + np.pi - ENTRY_TILT_RAD)
    away = bezier(mouth[1], angle + ENTRY_TILT_RAD, near, angle)
    double = ring.lanes == 2 and i % 2 == 0
    enter = 2 if double else 1
    road = {"priority": 3, "width_m": ring.arm_lane_m, "speed_mps": ring.speed_limit_mps}
    close = {
        "priority": 3,
        "width_m": ring.arm_lane_m + SWING_M,
        "speed_mps": min(ring.speed_limit_mps, CLOSE_MPS),
    }
    plan.edges += [
        edge_xml(f"in{i}", f"e{i}", f"k{i}", far[::-1], lanes=enter, **road),
        edge_xml(f"app{i}", f"k{i}", f"r{i}", into, lanes=enter, **close),
        edge_xml(f"exit{i}", f"r{i}", f"k{i}", away, lanes=1, **close),
        edge_xml(f"out{i}", f"k{i}", f"e{i}", far, lanes=1, **road),
    ]
    for lane in range(1, 1 + enter):
        plan.connections.append(connection_xml(f"in{i}", f"app{i}", lane))
        plan.connections.append(connection_xml(f"app{i}", f"ring{i}", lane))
    plan.connections.append(connection_xml(f"exit{i}", f"out{i}"))
    if rng.random() < 0.75:
        plan.connections.append(crossing_xml(f"k{i}", (f"in{i}", f"out{i}")))
    weight = float(rng.uniform(0.8, 1.3) * (1.6 if double else 1.0))
    plan.arms.append(
        Arm(angle_rad=angle, enter=f"in{i}", leave=f"out{i}", lanes=enter, weight=weight)
    )
    from_m, beside_m = outer_m + rng.uniform(22.0, 28.0), ring.arm_lane_m + SIDEWALK_M
    plan.parking.append(parking_lot(rng, line, from_m=from_m, beside_m=beside_m))
