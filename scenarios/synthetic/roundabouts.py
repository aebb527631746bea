"""Roundabouts of one and two lanes; traffic circulates counter-clockwise and has priority."""

import numpy as np

from scenarios.synthetic.polylines import bezier, clothoid_like, polar
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


def roundabout(rng: np.random.Generator) -> Site:
    """One lane in the ring, three to five arms of one lane."""
    arms = int(rng.choice([3, 4, 4, 5]))
    inner_m = rng.uniform(11.5, 14.5) + (3.0 if arms == 5 else 0.0)
    return _roundabout(
        rng, "roundabout", inner_m=inner_m, arms=arms, lanes=1, width_m=rng.uniform(5.2, 6.0)
    )


def two_lane_roundabout(rng: np.random.Generator) -> Site:
    """Two lanes in the ring; two opposite arms enter with two lanes."""
    return _roundabout(
        rng,
        "two-lane-roundabout",
        inner_m=rng.uniform(17.0, 21.0),
        arms=4,
        lanes=2,
        width_m=rng.uniform(4.9, 5.3),
    )


def _roundabout(
    rng: np.random.Generator,
    kind: str,
    *,
    inner_m: float,
    arms: int,
    lanes: int,
    width_m: float,
) -> Site:
    outer_m = inner_m + lanes * width_m
    gap_rad = 2.0 * np.pi / arms
    jitter = np.radians({3: 14.0, 4: 8.0, 5: 3.0}[arms])
    angles = rng.uniform(0.0, 2.0 * np.pi) + gap_rad * np.arange(arms)
    angles = angles + rng.uniform(-jitter, jitter, arms)
    half_rad = min(9.5 / (inner_m + 0.5 * width_m), 0.34 * gap_rad)
    ring_mps = float(np.sqrt(rng.uniform(1.9, 2.4) * (inner_m + 0.5 * width_m)))
    arm_width_m = rng.uniform(3.5, 3.9)
    speed_mps = float(rng.choice([11.11, 13.89]))
    nodes, edges, connections, made, parking = [], [], [], [], []
    for i, angle in enumerate(angles):
        after = angles[(i + 1) % arms] + (2.0 * np.pi if i == arms - 1 else 0.0)
        sweep = np.linspace(angle + half_rad, after - half_rad, 13)
        nodes.append(node_xml(f"r{i}", polar(outer_m, angle), type="priority"))
        edges.append(
            edge_xml(
                f"ring{i}", f"r{i}", f"r{(i + 1) % arms}", polar(inner_m, sweep),
                priority=9, lanes=lanes, width_m=width_m, speed_mps=ring_mps, change=True,
            )
        )  # fmt: skip
        line = clothoid_like(
            heading_rad=float(angle),
            curvature_per_m=rng.uniform(-0.004, 0.004),
            straight_m=outer_m + 24.0,
            length_m=ARM_LENGTH_M,
        )
        split = round((outer_m + 17.0) / 2.0)
        arm, near = line[split:], line[split]
        nodes.append(node_xml(f"k{i}", near, type="priority"))
        nodes.append(node_xml(f"e{i}", line[-1]))
        # The left border of the entry bends towards the direction of the ring, the exit's away.
        into = bezier(
            near,
            angle + np.pi,
            polar(outer_m + 3.0, angle + 2.0 / outer_m),
            angle + np.pi - ENTRY_TILT_RAD,
        )
        away = bezier(
            polar(outer_m + 3.0, angle - 2.0 / outer_m), angle + ENTRY_TILT_RAD, near, float(angle)
        )
        double = lanes == 2 and i % 2 == 0
        far = {"priority": 3, "width_m": arm_width_m, "speed_mps": speed_mps}
        # Wider near the ring, where long vehicles swing.
        wide_m = arm_width_m + 0.8
        close = {**far, "width_m": wide_m, "speed_mps": min(speed_mps, 9.5)}
        enter = 2 if double else 1
        edges.append(edge_xml(f"in{i}", f"e{i}", f"k{i}", arm[::-1], lanes=enter, **far))
        edges.append(edge_xml(f"app{i}", f"k{i}", f"r{i}", into, lanes=enter, **close))
        edges.append(edge_xml(f"exit{i}", f"r{i}", f"k{i}", away, lanes=1, **close))
        edges.append(edge_xml(f"out{i}", f"k{i}", f"e{i}", arm, lanes=1, **far))
        before = f"ring{(i - 1) % arms}"
        connections += [connection_xml(before, f"ring{i}", 1 + n) for n in range(lanes)]
        connections += [connection_xml(f"app{i}", f"ring{i}", 1 + n) for n in range(enter)]
        connections += [connection_xml(f"in{i}", f"app{i}", 1 + n) for n in range(enter)]
        connections.append(connection_xml(before, f"exit{i}"))
        connections.append(connection_xml(f"exit{i}", f"out{i}"))
        if rng.random() < 0.75:
            connections.append(crossing_xml(f"k{i}", (f"in{i}", f"out{i}")))
        made.append(
            Arm(
                angle_rad=float(angle),
                enter=f"in{i}",
                leave=f"out{i}",
                lanes=enter,
                weight=float(rng.uniform(0.8, 1.3) * (1.6 if double else 1.0)),
            )
        )
        parking.append(
            parking_lot(
                rng, line, from_m=outer_m + rng.uniform(22.0, 28.0),
                beside_m=arm_width_m + SIDEWALK_M,
            )
        )  # fmt: skip
    return Site(
        kind=kind,
        nodes="".join(nodes),
        edges="".join(edges),
        connections="".join(connections),
        endpoint_shape=True,
        arms=tuple(made),
        speed_limit_mps=speed_mps,
        half_size_m=(72.0, 60.0),
        parking=np.stack(parking[: 1 + int(rng.integers(2))]),
    )
