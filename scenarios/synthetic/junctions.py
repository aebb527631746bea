"""Crossroads and T-junctions without signals; the main road has priority."""

import numpy as np

from scenarios.polylines import clothoid_like
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


def crossroads(rng: np.random.Generator) -> Site:
    """Four arms; the first and third are the main road."""
    turn = rng.uniform(0.0, 0.5 * np.pi)
    angles = turn + 0.5 * np.pi * np.arange(4) + np.radians(rng.uniform(-14.0, 14.0, 4))
    return _junction(rng, "crossroads", angles, main=(0, 2))


def t_junction(rng: np.random.Generator) -> Site:
    """Three arms; the first two are the main road, the third ends at it."""
    turn = rng.uniform(0.0, 2.0 * np.pi)
    angles = turn + np.radians(
        np.array([0.0, 180.0 + rng.uniform(-14.0, 14.0), 270.0 + rng.uniform(-20.0, 20.0)])
    )
    return _junction(rng, "t-junction", angles, main=(0, 1))


def _junction(
    rng: np.random.Generator, kind: str, angles_rad: np.ndarray, *, main: tuple[int, int]
) -> Site:
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
        road = {"priority": 4 if is_main else 1, "lanes": 1, "width_m": width_m, "speed_mps": speed}
        edges.append(edge_xml(f"in{i}", f"e{i}", f"k{i}", far[::-1], **road))
        edges.append(edge_xml(f"app{i}", f"k{i}", "c", near[::-1], **road))
        edges.append(edge_xml(f"exit{i}", "c", f"k{i}", near, **road))
        edges.append(edge_xml(f"out{i}", f"k{i}", f"e{i}", far, **road))
        others = [j for j in range(len(angles_rad)) if j != i]
        connections += [connection_xml(f"app{i}", f"exit{j}") for j in others]
        connections.append(connection_xml(f"in{i}", f"app{i}"))
        connections.append(connection_xml(f"exit{i}", f"out{i}"))
        if with_crossing[i]:
            connections.append(crossing_xml(f"k{i}", (f"in{i}", f"out{i}")))
        weight = rng.uniform(0.8, 1.2) * (1.5 if is_main else 1.0)
        arms.append(
            Arm(
                angle_rad=float(angle),
                enter=f"in{i}",
                leave=f"out{i}",
                lanes=1,
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
