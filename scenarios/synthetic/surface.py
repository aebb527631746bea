"""The road surface as lanelets: strips between a left and a right border, from a network."""

from collections.abc import Callable

import numpy as np

from scenarios.lanelet2 import Border, Lanelet, Marking, Subtype
from scenarios.polylines import Polyline, arc_lengths, dense, offset
from scenarios.synthetic.sumo import Lane, Network, Turn

WIDENING_M = 1.3
"""How much wider than its lane a right-angled turn is in its middle, on either side."""
_MEETS_M = 0.3


def lanelets(network: Network, half_size_m: tuple[float, float]) -> list[Lanelet]:
    """All strips of a network that reach into the picture, or little beyond it."""
    reach = np.array(half_size_m) + 14.0
    kept = {
        name: lane
        for name, lane in network.lanes.items()
        if np.any(np.all(np.abs(lane.shape) < reach, axis=1))
    }
    strips = {name: _lane_strip(lane, network.lanes, reach) for name, lane in kept.items()}
    turns = [
        _turn_strip(turn, network, strips)
        for turn in network.turns
        if turn.begin in strips and turn.end in strips and arc_lengths(turn.shape)[-1] > 0.1
    ]
    crossings = [_crossing_strip(line, width) for line, width in network.crossings]
    return [*strips.values(), *turns, *crossings]


def _lane_strip(lane: Lane, lanes: dict[str, Lane], reach: np.ndarray) -> Lanelet:
    half = 0.5 * lane.width_m
    left, right = offset(lane.shape, half), offset(lane.shape, -half)
    inside = np.flatnonzero(np.all(np.abs(lane.shape) < reach, axis=1))
    part = slice(max(0, inside[0] - 1), inside[-1] + 2)
    same_edge = [other for other in lanes.values() if other.edge == lane.edge and not other.feet]
    if lane.feet:
        left_is, right_is = "curb", "virtual"
        subtype: Subtype = "walkway"
    else:
        subtype = "road"
        outermost = lane.index == min(other.index for other in same_edge)
        innermost = lane.index == max(other.index for other in same_edge)
        right_is = "curb" if outermost else "dashed"
        left_is = "curb" if innermost and not _faces_traffic(lane, left, lanes) else "dashed"
    return Lanelet(
        subtype=subtype,
        left=(Border(line=left[part], marking=left_is),),
        right=(Border(line=right[part], marking=right_is),),
    )


def _faces_traffic(lane: Lane, left: Polyline, lanes: dict[str, Lane]) -> bool:
    """Whether the lane's left border is also that of a lane of the other direction."""
    for other in lanes.values():
        if other.edge == lane.edge or other.feet or len(other.shape) != len(lane.shape):
            continue
        facing = offset(other.shape, 0.5 * other.width_m)[::-1]
        if np.hypot(*(facing - left)[1:-1].T).max(initial=0.0) < _MEETS_M and (
            np.hypot(*(facing - left)[[0, -1]].T).min() < _MEETS_M
        ):
            return True
    return False


def _right_turn_rad(turn: Turn) -> float:
    first, last = np.diff(turn.shape[:2], axis=0)[0], np.diff(turn.shape[-2:], axis=0)[0]
    cross = first[0] * last[1] - first[1] * last[0]
    return -float(np.arctan2(cross, first @ last))


def _turn_strip(turn: Turn, network: Network, strips: dict[str, Lanelet]) -> Lanelet:
    begin, end = strips[turn.begin], strips[turn.end]
    angle = _right_turn_rad(turn)
    left_is = _side(turn, network, strips, lambda lanelet: lanelet.left[0], -1.0)
    right_is = _side(turn, network, strips, lambda lanelet: lanelet.right[0], 1.0)
    line = dense(turn.shape, 1.0)
    arc = arc_lengths(line)
    share = arc / arc[-1]
    extra = WIDENING_M * min(abs(angle) / (0.5 * np.pi), 1.0) * np.sin(np.pi * share) ** 2
    before, after = network.lanes[turn.begin].width_m, network.lanes[turn.end].width_m
    half = 0.5 * (before + (after - before) * share)
    left = offset(line, half + (0.0 if left_is == "curb" else extra))
    right = offset(line, -half - extra)
    left[0], right[0] = begin.left_line[-1], begin.right_line[-1]
    left[-1], right[-1] = end.left_line[0], end.right_line[0]
    return Lanelet(
        subtype="road",
        left=(Border(line=left, marking=left_is),),
        right=(Border(line=right, marking=right_is),),
    )


def _side(
    turn: Turn,
    network: Network,
    strips: dict[str, Lanelet],
    border: Callable[[Lanelet], Border],
    sign: float,
) -> Marking:
    """A kerb goes on across a junction along the outermost of the ways that touch it."""
    both = border(strips[turn.begin]).marking, border(strips[turn.end]).marking
    rivals = [t for t in network.turns if t.begin == turn.begin or t.end == turn.end]
    outermost = all(
        sign * _right_turn_rad(turn) >= sign * _right_turn_rad(rival) - 1e-9
        if rival.begin == turn.begin
        else _starts_inside(turn, rival, sign)
        for rival in rivals
    )
    return "curb" if both == ("curb", "curb") and outermost else "virtual"


def _starts_inside(turn: Turn, rival: Turn, sign: float) -> bool:
    """Whether another way to the same lane comes from the inner side."""
    along = turn.shape[-1] - turn.shape[-2]
    offset_m = rival.shape[0] - turn.shape[0]
    cross = along[0] * offset_m[1] - along[1] * offset_m[0]
    return bool(sign * cross >= 0.0)


def _crossing_strip(line: Polyline, width_m: float) -> Lanelet:
    return Lanelet(
        subtype="crosswalk",
        left=(Border(line=offset(line, 0.5 * width_m), marking="zebra"),),
        right=(Border(line=offset(line, -0.5 * width_m), marking="zebra"),),
    )
