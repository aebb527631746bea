"""Styles of maps in varied traffic: what a map shows of the same roads differs between locations.

Lanelets are joined or cut, opposite lanes become one, lines lose their markings, and the map is
moved against the tracks. The background image shows the roads as they are.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from asp_env.geometry import arc_lengths, points_at
from scenarios.lanelet2 import Border, Lanelet, Marking
from scenarios.polylines import Polyline, dense
from scenarios.sumo.ranges import RANGES

_MAP = RANGES.map

_MEETS_M = 0.3
"""Ends of lines that are nearer than this are the same point."""


_LEAST_M = 0.2
"""Lanelets with a shorter side, between roads that meet, are left out: both ends of the side would
be one point of the map."""


_DEVIATES_M = 0.25
"""Largest distance between a line and its resampled points. Chosen by hand: drawing errors of
maps."""


def draw_map(
    rng: np.random.Generator,
    lanelets: list[Lanelet],
    parking: Float[np.ndarray, "lots 4 2"],
    *,
    middle: Float[np.ndarray, " 2"],
) -> tuple[list[Lanelet], Float[np.ndarray, "lots 4 2"]]:
    """Draws a style and applies it.

    Args:
        rng: draws the style.
        lanelets: the roads as they are, with the limits of each lane.
        parking: corners of the parking lots.
        middle: about which the map is rotated.

    Returns:
        The lanelets and the parking lots that the map shows, in its place.
    """
    lanelets = [each for each in lanelets if _length_m(each) > _LEAST_M]
    roads = [each for each in lanelets if each.subtype == "road"]
    others = [each for each in lanelets if each.subtype != "road"]
    without = {
        subtype: bool(rng.random() < share)
        for subtype, share in (("walkway", _MAP.no_walkways), ("crosswalk", _MAP.no_crosswalks))
    }
    if rng.random() < _MAP.shared_lanes:
        roads = _with_shared_lanes(rng, roads)
    roads = _refragmented(rng, roads)
    roads = _with_limits(rng, roads)
    if rng.random() < _MAP.two_way_lanes:
        roads = [replace(each, one_way=False) for each in roads]
    shown = roads + [each for each in others if not without[each.subtype]]
    shown = _with_markings(rng, shown)
    spacing_m = rng.uniform(*_MAP.spacing_m)
    offset_m, turn_rad = _offset(rng)
    rotation = np.array(
        [[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]]
    )

    def place(line: np.ndarray) -> np.ndarray:
        return (line - middle) @ rotation.T + middle + offset_m

    lots = np.zeros((0, 4, 2)) if rng.random() < _MAP.no_areas else parking
    drawn = [_mapped(each, lambda line: place(_resampled(line, spacing_m))) for each in shown]
    return drawn, place(lots)


def _offset(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Offset, m, and rotation, rad, of the map."""
    away, towards = rng.uniform(0.0, _MAP.offset_m), rng.uniform(0.0, 2.0 * np.pi)
    turn = rng.uniform(-1.0, 1.0) * _MAP.rotation_rad
    if rng.random() < _MAP.exact:
        return np.zeros(2), 0.0
    return away * np.array([np.cos(towards), np.sin(towards)]), float(turn)


def _mapped(lanelet: Lanelet, change: Callable[[Polyline], Polyline]) -> Lanelet:
    left, right = (
        tuple(replace(border, line=change(border.line)) for border in side)
        for side in (lanelet.left, lanelet.right)
    )
    return replace(lanelet, left=left, right=right)


def _resampled(line: Polyline, spacing_m: float) -> Polyline:
    """A line with evenly spaced points, closer where it bends, so that it stays near the road."""
    arc = arc_lengths(line)
    while True:
        points = dense(line, spacing_m)
        along = arc_lengths(points)
        same = points_at(points, along, arc / arc[-1] * along[-1])
        if spacing_m < 1.0 or np.hypot(*(same - line).T).max() < _DEVIATES_M:
            return points
        spacing_m *= 0.5


def _length_m(lanelet: Lanelet) -> float:
    """Length of the shorter side."""
    return float(min(arc_lengths(line)[-1] for line in (lanelet.left_line, lanelet.right_line)))


def _meet(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.hypot(*(a - b)) < _MEETS_M)


def _with_shared_lanes(rng: np.random.Generator, roads: list[Lanelet]) -> list[Lanelet]:
    """Replaces pairs of opposite lanes by one lane for both directions.

    Only lanes whose right border is a curb are replaced, so that no further lane is beside them.
    """
    result: list[Lanelet] = []
    taken: set[int] = set()
    for i, lanelet in enumerate(roads):
        partners = [j for j in range(i + 1, len(roads)) if j not in taken]
        partners = [j for j in partners if _are_opposite(lanelet, roads[j])]
        if i in taken:
            continue
        if not partners or rng.random() >= _MAP.shared:
            result.append(lanelet)
            continue
        taken.add(partners[0])
        opposite = roads[partners[0]]
        left = tuple(replace(border, line=border.line[::-1]) for border in reversed(opposite.right))
        result.append(replace(lanelet, left=left, one_way=False))
    return result


def _are_opposite(a: Lanelet, b: Lanelet) -> bool:
    curbs = a.right[0].marking == b.right[0].marking == "curb"
    return curbs and (
        _meet(a.left_line[0], b.left_line[-1]) and _meet(a.left_line[-1], b.left_line[0])
    )


def _refragmented(rng: np.random.Generator, roads: list[Lanelet]) -> list[Lanelet]:
    """Joins consecutive lanelets, cuts them into short ones, or leaves them as they are."""
    chance = rng.random()
    piece_m = rng.uniform(*_MAP.piece_m)
    if chance < _MAP.long_lanes:
        return _joined(roads)
    if chance < _MAP.long_lanes + _MAP.short_lanes:
        return [piece for lanelet in roads for piece in _cut(lanelet, piece_m)]
    return roads


def _follows(a: Lanelet, b: Lanelet) -> bool:
    return _meet(a.left_line[-1], b.left_line[0]) and _meet(a.right_line[-1], b.right_line[0])


def _joined(roads: list[Lanelet]) -> list[Lanelet]:
    """Joins each lanelet with the one that follows, where neither forks nor merges."""
    after = [
        [j for j, other in enumerate(roads) if j != i and _follows(each, other)]
        for i, each in enumerate(roads)
    ]
    before = [[i for i, follow in enumerate(after) if j in follow] for j in range(len(roads))]
    only = {
        i: follow[0]
        for i, follow in enumerate(after)
        if len(follow) == 1 and len(before[follow[0]]) == 1
    }
    heads = [i for i in range(len(roads)) if i not in only.values()]
    result = []
    for head in heads:
        chain = [head]
        while chain[-1] in only and only[chain[-1]] not in chain:
            chain.append(only[chain[-1]])
        parts = [roads[i] for i in chain]
        left, right = (
            _one_line([side for part in parts for side in getattr(part, name)])
            for name in ("left", "right")
        )
        result.append(replace(parts[0], left=left, right=right))
    return result


def _one_line(borders: list[Border]) -> tuple[Border, ...]:
    """Consecutive sections with the same end points; the first of each two gives way."""
    sections = [borders[0]]
    for border in borders[1:]:
        line = np.concatenate([sections[-1].line[-1:], border.line[1:]])
        sections.append(replace(border, line=line))
    return tuple(sections)


def _cut(lanelet: Lanelet, piece_m: float) -> list[Lanelet]:
    """Cuts a lanelet into pieces of equal shares of both borders.

    Two opposite lanes with a common border are cut at the same points of it.
    """
    count = max(1, round(float(arc_lengths(lanelet.left_line)[-1]) / piece_m))
    if count == 1 or len(lanelet.left) != 1 or len(lanelet.right) != 1:
        return [lanelet]
    lefts, rights = _cut_line(lanelet.left[0], count), _cut_line(lanelet.right[0], count)
    return [
        replace(lanelet, left=(left,), right=(right,))
        for left, right in zip(lefts, rights, strict=True)
    ]


def _cut_line(border: Border, count: int) -> list[Border]:
    arc = arc_lengths(border.line)
    bounds = np.linspace(0.0, arc[-1], count + 1)
    cuts = points_at(border.line, arc, bounds)
    pieces = []
    for number in range(count):
        inside = (arc > bounds[number] + 1e-6) & (arc < bounds[number + 1] - 1e-6)
        line = np.concatenate([cuts[number][None], border.line[inside], cuts[number + 1][None]])
        pieces.append(replace(border, line=line))
    return pieces


def _with_limits(rng: np.random.Generator, roads: list[Lanelet]) -> list[Lanelet]:
    chance = rng.random()
    if chance < _MAP.no_limits:
        return [replace(each, speed_limit_mps=None) for each in roads]
    if chance < _MAP.no_limits + _MAP.one_limit:
        largest = max(each.speed_limit_mps or 0.0 for each in roads)
        return [replace(each, speed_limit_mps=largest) for each in roads]
    return roads


def _with_markings(rng: np.random.Generator, lanelets: list[Lanelet]) -> list[Lanelet]:
    """Replaces markings: none at all, no curbs, some missing, solid instead of dashed."""
    no_markings, no_curbs, solid = rng.random(3) < (
        _MAP.no_markings,
        _MAP.no_curbs,
        _MAP.solid,
    )
    missing = rng.uniform(*_MAP.missing) if rng.random() < _MAP.some_missing else 0.0
    changes: dict[Marking, Marking] = {}
    if solid:
        changes["dashed"] = "solid"
    if no_markings:
        changes["dashed"] = "virtual"
    if no_curbs:
        changes["curb"] = "virtual"
    lost: dict[tuple[float, ...], bool] = {}

    def marked(border: Border) -> Border:
        # The border that two lanelets share is lost for both.
        key = tuple(sorted(border.line[[0, -1]].round(1).ravel().tolist()))
        if key not in lost:
            lost[key] = bool(rng.random() < missing)
        if lost[key] and border.marking != "zebra":
            return replace(border, marking="virtual")
        return replace(border, marking=changes.get(border.marking, border.marking))

    return [
        replace(each, left=tuple(map(marked, each.left)), right=tuple(map(marked, each.right)))
        for each in lanelets
    ]
