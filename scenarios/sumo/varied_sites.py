"""Intersections and roundabouts of varied traffic, drawn from the ranges in `ranges`."""

from dataclasses import replace

import numpy as np

from scenarios.polylines import Polyline, bent
from scenarios.sumo.ranges import RANGES
from scenarios.sumo.sites import (
    ARM_LENGTH_M,
    Ring,
    Road,
    Site,
    junction,
    right_turn_rad,
    round_site,
)

_SITE = RANGES.site

_MOST_ATTEMPTS = 200

_RAMP_M = 12.0
"""Length over which the curvature of a bend grows and shrinks."""

_CLEAR_M = 22.0
"""Least distance between the middles of two arms outside the surroundings of the centre."""

_LEAST_SWEEP_RAD = 0.15
"""Least angle of the ring between the junctions with two arms."""

_MAIN_WEIGHT = 1.8
"""Traffic of a main road, relative to a side road."""


def varied_intersection(rng: np.random.Generator) -> Site:
    """An intersection of three to five arms; see `SiteRanges`."""
    half_size_m = _half_size_m(rng)
    arms = int(rng.choice(_SITE.arms))
    angles_rad = _intersection_angles(rng, arms)
    split = round(rng.uniform(*_SITE.split_m) / 2.0)
    lines = _lines(rng, angles_rad, half_size_m, clear_from_m=2.0 * split)
    main = _most_opposite(angles_rad)
    controls, shares = zip(*_SITE.controls, strict=True)
    control = str(rng.choice(controls, p=shares))
    roads = _roads(rng, angles_rad, lines, split=split, main=main)
    roads = _with_lanes(rng, roads)
    return junction(
        "varied-intersection",
        roads,
        radius_m=rng.uniform(*_SITE.corner_m),
        speed_limit_mps=max(road.speed_mps for road in roads),
        half_size_m=half_size_m,
        lots=_lots(rng, roads, half_size_m),
        control=control,  # pyright: ignore[reportArgumentType]  # one of the ranges' controls
    )


def varied_roundabout(rng: np.random.Generator) -> Site:
    """A roundabout of three to five arms, from a mini roundabout to a large one."""
    half_size_m = _half_size_m(rng)
    arms = int(rng.choice(_SITE.arms))
    low, high = np.log(_SITE.ring_radius_m)
    radius_m = float(np.exp(rng.uniform(low, high)))
    if arms == 5:
        radius_m = max(radius_m, 14.0)  # five arms need room for five mouths
    wide = radius_m >= _SITE.wide_radius_m and rng.random() < _SITE.two_ring_lanes
    lane_m = rng.uniform(_SITE.ring_lane_m[0], min(_SITE.ring_lane_m[1], 5.3 if wide else 6.5))
    lanes = 2 if wide else 1
    ring = Ring(
        inner_m=radius_m - 0.5 * lanes * lane_m,
        lanes=lanes,
        lane_m=lane_m,
        speed_mps=float(np.sqrt(rng.uniform(*_SITE.ring_acceleration_mps2) * radius_m)),
        leave_inside=bool(rng.random() < 0.5),
        entry_tilt_rad=rng.uniform(*_SITE.entry_tilt_rad),
        mouth_m=rng.uniform(*_SITE.mouth_m),
        swing_m=rng.uniform(*_SITE.swing_m),
    )
    angles_rad = _ring_angles(rng, arms, 2.0 * ring.half_rad(arms) + _LEAST_SWEEP_RAD)
    from_m = ring.outer_m + rng.uniform(*_SITE.approach_m)
    lines = _lines(rng, angles_rad, half_size_m, clear_from_m=from_m, straight_m=from_m)
    roads = _roads(rng, angles_rad, lines, split=round(from_m / 2.0), main=())
    roads = [
        replace(
            road,
            priority=3,
            enter=road.enter * (2 if ring.wide(i) else 1),
            leave=road.leave * ring.exits(i),
        )
        for i, road in enumerate(roads)
    ]
    return round_site(
        "varied-roundabout",
        ring,
        roads,
        speed_limit_mps=max(road.speed_mps for road in roads),
        half_size_m=half_size_m,
        lots=_lots(rng, roads, half_size_m),
    )


def _half_size_m(rng: np.random.Generator) -> tuple[float, float]:
    width = round(float(rng.uniform(*_SITE.half_size_m)))
    return float(width), float(round(width * rng.uniform(0.75, 1.0)))


def _intersection_angles(rng: np.random.Generator, arms: int) -> np.ndarray:
    """Directions of the arms, ascending: even spacing or a T, skewed."""
    even = 2.0 * np.pi / arms * np.arange(arms)
    if arms == 3 and rng.random() < 0.7:
        even = np.array([0.0, 0.5 * np.pi, np.pi])
    return _skewed(rng, even, _SITE.skew_rad, _SITE.least_gap_rad)


def _ring_angles(rng: np.random.Generator, arms: int, least_gap_rad: float) -> np.ndarray:
    even = 2.0 * np.pi / arms * np.arange(arms)
    return _skewed(rng, even, _SITE.skew_rad, least_gap_rad)


def _skewed(
    rng: np.random.Generator, even_rad: np.ndarray, skew_rad: float, least_gap_rad: float
) -> np.ndarray:
    """Directions with random deviations and a random rotation; neighbours stay apart."""
    turn = rng.uniform(0.0, 2.0 * np.pi)
    for attempt in range(_MOST_ATTEMPTS):
        largest = skew_rad * (1.0 - attempt / _MOST_ATTEMPTS)
        angles = even_rad + rng.uniform(-largest, largest, len(even_rad))
        gaps = np.diff(angles, append=angles[0] + 2.0 * np.pi)
        if gaps.min() >= least_gap_rad:
            return turn + angles
    return turn + even_rad


def _lines(
    rng: np.random.Generator,
    angles_rad: np.ndarray,
    half_size_m: tuple[float, float],
    *,
    clear_from_m: float,
    straight_m: float = 0.0,
) -> list[Polyline]:
    """A line for each arm that leaves the image and stays clear of the arms before it.

    Args:
        rng: draws the bends.
        angles_rad: directions at the centre.
        half_size_m: half the size of the image.
        clear_from_m: distance along an arm from which it stays clear of the others.
        straight_m: distance along an arm up to which it is straight.
    """
    lines: list[Polyline] = []
    for angle in angles_rad:
        for attempt in range(_MOST_ATTEMPTS):
            scale = 1.0 - attempt / _MOST_ATTEMPTS
            line = _bent_line(rng, float(angle), straight_m, scale)
            outside = np.any(np.abs(line[-1]) > np.array(half_size_m) + 12.0)
            if outside and all(_are_clear(line, other, clear_from_m) for other in lines):
                break
        else:
            line = _bent_line(rng, float(angle), straight_m, 0.0)
        lines.append(line)
    return lines


def _bent_line(
    rng: np.random.Generator, angle_rad: float, straight_m: float, scale: float
) -> Polyline:
    """A line with one or two bends, whose curvature and angle are multiplied by `scale`."""
    at = np.arange(0.0, ARM_LENGTH_M + 1e-9, 2.0)
    curvature = np.zeros(len(at))
    begin, side = straight_m, float(rng.choice([-1.0, 1.0]))
    for _ in range(2 if rng.random() < _SITE.second_bend else 1):
        begin += rng.uniform(*_SITE.bend_from_m)
        per_m = scale * rng.uniform(*_SITE.bend_per_m)
        length = max(rng.uniform(*_SITE.bend_turn_rad) * scale / max(per_m, 1e-3), _RAMP_M)
        grows = np.clip((at - begin) / _RAMP_M, 0.0, 1.0)
        shrinks = np.clip((at - begin - length) / _RAMP_M, 0.0, 1.0)
        curvature += side * per_m * (grows - shrinks)
        begin, side = begin + length + _RAMP_M, -side
    return bent(angle_rad, curvature)


def _are_clear(line: Polyline, other: Polyline, from_m: float) -> bool:
    first = int(from_m / 2.0)
    near = np.hypot(*(line[first:, None] - other[None, first:]).transpose(2, 0, 1)).min()
    centre = min(np.hypot(*each[first:].T).min() for each in (line, other))
    return bool(near > _CLEAR_M and centre > 0.8 * from_m)


def _lots(
    rng: np.random.Generator, roads: list[Road], half_size_m: tuple[float, float]
) -> tuple[int, ...]:
    """Up to two arms with a parking lot inside the image and clear of all roads."""
    free = []
    for i, road in enumerate(roads):
        lot = road.parking()
        points = np.concatenate([lot, 0.5 * (lot + np.roll(lot, 1, axis=0))])
        gaps = [
            np.hypot(*(points[:, None] - other.line[None]).transpose(2, 0, 1)).min()
            - other.half_width_m
            for other in roads
        ]
        if road.leave and np.all(np.abs(lot) < np.array(half_size_m) - 2.0) and min(gaps) > 0.0:
            free.append(i)
    return tuple(free[: int(rng.integers(3))])


def _most_opposite(angles_rad: np.ndarray) -> tuple[int, int]:
    """The two arms that form the straightest road."""
    pairs = [(a, b) for a in range(len(angles_rad)) for b in range(a)]
    bends = [abs(right_turn_rad(angles_rad[a], angles_rad[b])) for a, b in pairs]
    return pairs[int(np.argmin(bends))]


def _roads(
    rng: np.random.Generator,
    angles_rad: np.ndarray,
    lines: list[Polyline],
    *,
    split: int,
    main: tuple[int, ...],
) -> list[Road]:
    """One-lane roads with their widths, limits and crossings; some are one-way."""
    lane_m, limit_kmh = rng.uniform(*_SITE.lane_m), float(rng.choice(_SITE.limits_kmh))
    crossing = rng.random(len(lines)) < rng.uniform(*_SITE.crossing)
    one_way = rng.random(len(lines)) < _SITE.one_way
    both = rng.permutation(len(lines))[:2]
    one_way[both] = False  # a way in and a way out remain for all
    crossing[both[0]] = True
    roads = []
    for i, line in enumerate(lines):
        differs_kmh = 10.0 * np.round(0.1 * rng.uniform(-1.0, 1.0) * _SITE.limit_differs_kmh)
        limit = np.clip(limit_kmh + differs_kmh, min(_SITE.limits_kmh), max(_SITE.limits_kmh))
        width_m = lane_m + rng.uniform(-1.0, 1.0) * _SITE.lane_differs_m
        into = bool(rng.random() < 0.5)
        has_median = rng.random() < _SITE.median
        median_m = rng.uniform(*_SITE.median_m)
        roads.append(
            Road(
                angle_rad=float(angles_rad[i]),
                line=line,
                split=split,
                priority=4 if i in main else 1,
                width_m=float(np.clip(width_m, *_SITE.lane_m)),
                speed_mps=float(limit) / 3.6,
                enter=1 if not one_way[i] or into else 0,
                leave=1 if not one_way[i] or not into else 0,
                median_m=median_m if has_median and not one_way[i] else 0.0,
                crossing=bool(crossing[i]) and not one_way[i],
                weight=float(rng.uniform(0.3, 1.3) * (_MAIN_WEIGHT if i in main else 1.0)),
                parking_from_m=2.0 * split + rng.uniform(4.0, 16.0),
                parking_spaces=int(rng.integers(2, 5)),
            )
        )
    return roads


def _with_lanes(rng: np.random.Generator, roads: list[Road]) -> list[Road]:
    """The roads of an intersection, some with two lanes, as far as both lanes lead somewhere."""
    wider = [
        replace(road, leave=2) if road.leave and rng.random() < _SITE.two_lanes else road
        for road in roads
    ]
    result = []
    for i, road in enumerate(wider):
        two, pocket = rng.random() < _SITE.two_lanes, rng.random() < _SITE.pocket
        if road.enter and two:
            both = replace(road, enter=2, left_turns_only=bool(pocket))
            used = [both.lanes_to(o) for j, o in enumerate(wider) if j != i and o.leave]
            if {lane for lanes in used for lane in lanes} == {1, 2}:
                road = both
        result.append(road)
    return result
