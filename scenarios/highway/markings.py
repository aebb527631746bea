"""What is painted or built along the lanes' borders.

highway-env draws a continuous line along the outside of a road wherever its lanes have one, also
across the mouths of its roundabout's ways in and out. A continuous line is here

- a kerb where nothing else lies beyond it: that is the edge of the road,
- nothing (virtual) where other lanes lie both beyond it and within, since they lead across it,
- solid elsewhere, between two lanes side by side.
"""

import math
from itertools import pairwise

import numpy as np
from highway_env.road.lane import LineType
from jaxtyping import Bool, Float

from scenarios.highway.lanes import Strip
from scenarios.lanelet2 import Area, Border, Lanelet, Marking
from scenarios.polylines import Polyline

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
