"""What a place looks like before anybody drives: roads for netconvert, arms, parking."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scenarios.polylines import Polyline

SIDEWALK_M = 2.0
ARM_LENGTH_M = 130.0
"""How far the roads reach; vehicles begin and end there, out of the picture."""

SIGHT_M = 40.0
"""From where a driver who must yield sees the others."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """One road that leads to the place."""

    angle_rad: float
    """Direction from the middle in which it leaves."""
    enter: str
    """Edge on which vehicles come."""
    leave: str
    """Edge on which they go."""
    lanes: int
    """How many lanes enter."""
    weight: float
    """How much traffic it has, relative to the others."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """One place: plain XML for netconvert and what the other files need to know."""

    kind: str
    """`crossroads`, `t-junction`, `roundabout` or `two-lane-roundabout`."""
    nodes: str
    edges: str
    connections: str
    endpoint_shape: bool
    """Whether the junctions end exactly where the edges' lines do."""
    arms: tuple[Arm, ...]
    speed_limit_mps: float
    half_size_m: tuple[float, float]
    """Half the width and half the height of the picture."""
    parking: Float[np.ndarray, "lots 4 2"]
    """Corners of the places for parked cars, beside the pavement."""


def lane_xml(
    index: int, width_m: float, speed_mps: float, *, feet: bool = False, change: bool = False
) -> str:
    """One lane of an edge, for pedestrians or for everybody else.

    Nobody changes to the left; to the right only where `change` says so.
    """
    who = 'allow="pedestrian"' if feet else 'disallow="pedestrian"'
    stay = 'changeLeft="emergency"' if change else 'changeLeft="emergency" changeRight="emergency"'
    return f'<lane index="{index}" {who} {stay} width="{width_m:.3f}" speed="{speed_mps:.3f}"/>'


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
    feet = lane_xml(0, SIDEWALK_M, 2.0, feet=True)
    drive = [lane_xml(1 + i, width_m, speed_mps, change=change) for i in range(lanes)]
    return (
        f'<edge id="{name}" from="{begin}" to="{end}" priority="{priority}" '
        f'numLanes="{1 + lanes}" speed="{speed_mps:.3f}" spreadType="right" '
        f'shape="{shape}">{"".join([feet, *drive])}</edge>'
    )


def node_xml(name: str, point: np.ndarray, **attributes: str | float) -> str:
    """One node; further attributes as netconvert names them."""
    more = "".join(f' {key}="{value}"' for key, value in attributes.items())
    return f'<node id="{name}" x="{point[0]:.3f}" y="{point[1]:.3f}"{more}/>'


def connection_xml(begin: str, end: str, lane: int = 1) -> str:
    """A way from a lane of one edge to the same lane of the next.

    Without a distance of sight SUMO's drivers all but stop before they look for others.
    """
    return (
        f'<connection from="{begin}" to="{end}" fromLane="{lane}" toLane="{lane}" '
        f'visibility="{SIGHT_M}"/>'
    )


def crossing_xml(node: str, edges: tuple[str, str]) -> str:
    """A zebra crossing over both directions of an arm."""
    return f'<crossing node="{node}" edges="{" ".join(edges)}" priority="true" width="3.0"/>'


def parking_lot(
    rng: np.random.Generator, line: Polyline, *, from_m: float, beside_m: float
) -> Float[np.ndarray, "4 2"]:
    """A row of parking places right of an outgoing arm, `beside_m` from its middle."""
    at = int(from_m / 2.0)
    ahead = line[at + 1] - line[at]
    ahead = ahead / np.hypot(*ahead)
    right = np.array([ahead[1], -ahead[0]])
    corner = line[at] + (beside_m + 0.4) * right
    long, deep = 2.6 * float(rng.integers(2, 5)), 5.2
    return np.stack(
        [corner, corner + long * ahead, corner + long * ahead + deep * right, corner + deep * right]
    )
