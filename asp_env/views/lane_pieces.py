"""The lines of a road map as short polylines of equally many points, ready to be chosen from."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from asp_env.data.road_map import LineType, RoadMap

KINDS = ("lane", "curb", "solid", "dashed")
"""What a piece is: the centre line of a lane in its direction of travel, or a line that can be
seen. Virtual lines cannot, and the lanes between them are told by their centre lines."""

KIND_OF_LINE = {LineType.CURB: 1, LineType.SOLID: 2, LineType.DASHED: 3}

POINTS = 10
"""Of each piece: 2.8 m apart at most, so that arcs of 10 m radius are followed to 10 cm."""

PIECE_M = 25.0
"""Longer lines are cut into equal pieces of at most this length."""

TANGENT_M = 0.5
"""Directions are taken between the points of the line this far behind and before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LanePieces:
    """The pieces of one map, in its order: lanes first, then lines."""

    middles: Float[np.ndarray, "2 pieces"]
    """Halfway along each piece, metres; x of all, then y of all."""
    points: Float[np.ndarray, "pieces points 4"]
    """[x m, y m, direction cos, direction sin] at equal distances, both ends included."""
    kinds: Int[np.ndarray, " pieces"]
    """Index into `KINDS`."""


def lane_pieces(road_map: RoadMap) -> LanePieces:
    """Cuts the lanes and the visible lines of a map into pieces; lines without extent are none."""
    lines = [(0, road_map.lanes[lane]) for lane in range(len(road_map.lanes))]
    lines += [
        (KIND_OF_LINE[LineType(kind)], road_map.lines[line])
        for line, kind in enumerate(road_map.line_types)
        if kind in KIND_OF_LINE
    ]
    middles, points, kinds = [np.zeros((0, 2))], [np.zeros((0, POINTS, 4))], [np.zeros(0)]
    for kind, line in lines:
        middle, piece = _cut(line)
        middles.append(middle)
        points.append(piece)
        kinds.append(np.full(len(middle), kind))
    return LanePieces(
        middles=np.ascontiguousarray(np.concatenate(middles).T),
        points=np.concatenate(points),
        kinds=np.concatenate(kinds).astype(np.int64),
    )


def _cut(
    line: Float[np.ndarray, "n 2"],
) -> tuple[Float[np.ndarray, "pieces 2"], Float[np.ndarray, "pieces points 4"]]:
    """Middles and points of the pieces of one line."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    keep = np.concatenate([[True], steps > 0])
    line, arc = line[keep], np.concatenate([[0.0], np.cumsum(steps)])[keep]
    length = float(arc[-1])
    count = math.ceil(length / PIECE_M - 1e-9)
    share = np.arange(count)[:, None] + np.linspace(0, 1, POINTS)
    at = share * (length / max(count, 1))
    before, behind = np.maximum(at - TANGENT_M, 0), np.minimum(at + TANGENT_M, length)
    along = _at(line, arc, behind) - _at(line, arc, before)
    along /= np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-9)[..., None]
    middles = _at(line, arc, 0.5 * (at[:, 0] + at[:, -1]))
    return middles, np.concatenate([_at(line, arc, at), along], axis=-1)


def _at(line: np.ndarray, arc: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, arc, line[:, axis]) for axis in (0, 1)], axis=-1)
