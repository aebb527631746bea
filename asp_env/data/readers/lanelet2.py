"""Lanelet2 maps (`.osm` in degrees, `.osm_xy` in local metres) in a recording's metric frame.

Reading is lenient: missing references, duplicate ids and swapped bounds are repaired and reported.

The direction of a lanelet follows from the roles of its bounds, as in Lanelet2 itself: seen along
the lanelet, the left bound is on the left. The order of a way's nodes does not matter, since
neighbours that share a way may run in opposite directions. A lanelet that meets its neighbours
head-on or tail to tail more often than in line has swapped bounds, and is reversed.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.readers.layout import shorten
from asp_env.data.readers.osm import Osm, Relation, Way, read_osm
from asp_env.data.readers.positions import Origin, complete_ways, locate_nodes
from asp_env.data.readers.tags import (
    boolean,
    limit_texts,
    sign_mps,
    speed_mps,
    two_way,
    vehicles_allowed,
)
from asp_env.data.road_map import LineType, Ragged, RoadMap
from asp_env.errors import DataError
from asp_env.geometry import arc_lengths, points_at
from asp_env.stored import brief

VEHICLE_SUBTYPES = frozenset(
    {"", "road", "highway", "bus_lane", "play_street", "emergency_lane", "exit", "entry"}
)
"""Subtypes of lanelets that vehicles drive along. A lanelet without a subtype is a road. Bicycle
lanes, walkways and rails are not included."""

CROSSED_SUBTYPES = frozenset({"crosswalk"})
"""Subtypes of lanelets that vehicles may drive over, but not along."""

OTHER_SUBTYPES = frozenset(
    {
        *("bicycle_lane", "bikelane", "bike_lane", "cycleway", "rail", "train", "tram"),
        *("walkway", "shared_walkway", "sidewalk", "footway", "pedestrian_lane", "stairs"),
    }
)
"""Subtypes of lanelets that are not for vehicles. Lanelets of any further subtype are roads if
vehicles drive along them."""

DRIVABLE_AREAS = frozenset({"freespace", "parking"})
"""Subtypes of multipolygons that are part of the drivable area."""

CURB_TYPES = frozenset(
    {"curbstone", "road_border", "guard_rail", "fence", "wall", "jersey_barrier", "rail"}
)
"""Types of ways that become curbs."""

MEETS_WITHIN_M = 0.5
"""Two lanelets that share no nodes are connected if both corners of their ends are within this
distance. Chosen by hand: above drawing errors, below a lane's width."""


Use = Literal["along", "over", "not", "unlisted"]
"""Whether vehicles drive along a lanelet, over it, or neither; `unlisted` if no tag decides it."""


@dataclass(slots=True, kw_only=True)
class Lanelet:
    """A lanelet whose bounds run in its direction of travel, the left one on the left.

    `start` and `end` are the left and the right corner at its two ends.
    """

    id: str
    subtype: str
    use: Use
    left: Float[np.ndarray, "n 2"]
    right: Float[np.ndarray, "m 2"]
    centre: Float[np.ndarray, "k 2"] | None
    way_ids: tuple[str, ...]
    two_way: bool
    limit_mps: float | None

    def reverse(self) -> None:
        self.left, self.right = self.right[::-1], self.left[::-1]
        self.centre = None if self.centre is None else self.centre[::-1]

    @property
    def start(self) -> Float[np.ndarray, "2 2"]:
        return np.stack([self.left[0], self.right[0]])

    @property
    def end(self) -> Float[np.ndarray, "2 2"]:
        return np.stack([self.left[-1], self.right[-1]])

    @property
    def course_rad(self) -> float:
        """Direction from the begin to the end."""
        x, y = (self.end - self.start).mean(axis=0).tolist()
        return math.atan2(y, x)

    @property
    def ring(self) -> Float[np.ndarray, "n 2"]:
        return np.concatenate([self.left, self.right[::-1]])


@dataclass(frozen=True, slots=True, kw_only=True)
class Lanelet2File:
    """The content of a map file, in a recording's frame."""

    path: Path
    osm: Osm
    ways: Mapping[str, Way]
    """Ways with at least two nodes, all of which have a position."""
    points: Mapping[str, Float[np.ndarray, " 2"]]
    """Positions of nodes, metres."""
    lanelets: tuple[Lanelet, ...]
    areas: tuple[Float[np.ndarray, "_ 2"], ...]
    """Outer rings of freespace and parking, metres."""
    repairs: tuple[str, ...]

    @property
    def unlisted(self) -> list[Lanelet]:
        """Lanelets of which no tag determines whether they are for vehicles."""
        return [lanelet for lanelet in self.lanelets if lanelet.use == "unlisted"]

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Smallest x and y, largest x and y of all lanelets for vehicles and areas, metres."""
        uses = ("along", "over", "unlisted")
        rings = [lanelet.ring for lanelet in self.lanelets if lanelet.use in uses]
        points = np.concatenate([*rings, *self.areas, np.zeros((0, 2))])
        if not len(points):
            return (0.0, 0.0, 0.0, 0.0)
        low, high = points.min(axis=0), points.max(axis=0)
        return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def parse_lanelet2(path: Path, origin: Origin) -> Lanelet2File:
    """Reads the lanelets and areas of a map file.

    Args:
        path: the map file.
        origin: the recording's frame.

    Raises:
        DataError: the file is not a map, has no lanelets, or lies at another location.
    """
    osm = read_osm(path)
    num_lanelets = sum(relation.tags.get("type") == "lanelet" for relation in osm.relations)
    if not num_lanelets:
        raise DataError(
            f"{path}: has no lanelets among its {len(osm.relations)} relations; "
            "expected a lanelet2 map: put the right file in its place"
        )
    repairs = list(osm.repairs)
    points = locate_nodes(osm, origin, repairs)
    ways = complete_ways(osm.ways.values(), points, repairs)
    lanelets = _lanelets(osm, ways, points, repairs)
    if not lanelets:
        raise DataError(
            f"{path}: none of its {num_lanelets} lanelets has both bounds; expected members with "
            "the roles 'left' and 'right', which are ways of the file: put the right file in its "
            "place"
        )
    return Lanelet2File(
        path=path,
        osm=osm,
        ways=ways,
        points=points,
        lanelets=tuple(lanelets),
        areas=tuple(_areas(osm, ways, points)),
        repairs=tuple(repairs),
    )


def make_road_map(
    content: Lanelet2File,
    *,
    region_m: tuple[float, float, float, float] | None = None,
    driven: Collection[str] = (),
) -> RoadMap:
    """Makes the map of a file, or of the part of it that lies in a region.

    `lines` are the bounds of vehicle lanelets and crosswalks, and all ways that are typed as a curb
    or barrier. A bound without a type is dashed if two vehicle lanelets share it, and virtual
    otherwise. `drivable` are vehicle lanelets, crosswalks, and the outer rings of freespace and
    parking; holes are not cut out. A lane's speed limit is that of its regulatory element
    (`speed_limit`), else of its tag `speed_limit` (Lanelet2), else of `maxspeed` (OSM).

    Args:
        content: the file's content.
        region_m: smallest x and y, largest x and y of the region. Lanelets, lines and areas
            outside of it are left out. None: everything is used.
        driven: ids of the lanelets of unlisted subtypes that are roads.

    Raises:
        DataError: no lanelet is for vehicles.
    """
    repairs = list(content.repairs)
    uses = {each.id: "along" if each.id in driven else each.use for each in content.lanelets}
    if "along" not in uses.values():
        raise DataError(
            f"{content.path}: none of its {len(content.lanelets)} lanelets is for vehicles; "
            "expected some of subtype 'road': put the right file in its place"
        )
    inside = [each for each in content.lanelets if _reaches(each.ring, region_m)]
    if len(inside) < len(content.lanelets):
        repairs.append(
            f"{len(content.lanelets) - len(inside)} of {len(content.lanelets)} lanelets left out, "
            "since they are far from all tracks"
        )
    _report_subtypes(content, driven, repairs)
    vehicle = [replace(lanelet) for lanelet in inside if uses[lanelet.id] == "along"]
    _reverse_swapped(vehicle, repairs)
    crossed = [lanelet for lanelet in inside if uses[lanelet.id] == "over"]
    areas = [ring for ring in content.areas if _reaches(ring, region_m)]
    lines, line_types = _lines(content, region_m, vehicle, crossed)
    return RoadMap(
        name=content.path.stem,
        lines=Ragged.pack(lines),
        line_types=np.array(line_types, dtype=np.int64),
        drivable=Ragged.pack([lanelet.ring for lanelet in vehicle + crossed] + areas),
        lanes=Ragged.pack([_centre_line(lanelet) for lanelet in vehicle]),
        successors=_successors(vehicle),
        areas=Ragged.pack([lanelet.ring for lanelet in vehicle]),
        two_way=np.array([lanelet.two_way for lanelet in vehicle], dtype=bool),
        limits_mps=np.array([lanelet.limit_mps or 0.0 for lanelet in vehicle], dtype=np.float64),
        limited=np.array([lanelet.limit_mps is not None for lanelet in vehicle], dtype=bool),
        region_m=region_m,
        repairs=tuple(repairs),
    )


def read_lanelet2(path: Path, origin: Origin) -> RoadMap:
    """Reads the whole map of a file into a recording's frame; see `make_road_map`.

    Args:
        path: the map file.
        origin: the recording's frame.

    Raises:
        DataError: the file is not a map, has no lanelets for vehicles, or lies at another location.
    """
    return make_road_map(parse_lanelet2(path, origin))


def _reaches(
    points: Float[np.ndarray, "n 2"], region_m: tuple[float, float, float, float] | None
) -> bool:
    """Whether the bounding box of points overlaps the region."""
    if region_m is None:
        return True
    low, high = points.min(axis=0), points.max(axis=0)
    return bool((high >= region_m[:2]).all() and (low <= region_m[2:]).all())


def _report_subtypes(content: Lanelet2File, driven: Collection[str], repairs: list[str]) -> None:
    for chosen, what in (
        (
            [each for each in content.unlisted if each.id in driven],
            "are roads, since vehicles drive along them",
        ),
        (
            [each for each in content.unlisted if each.id not in driven],
            "left out, since no vehicle drives along them",
        ),
    ):
        if chosen:
            names = shorten(sorted({each.subtype for each in chosen}))
            repairs.append(f"{len(chosen)} lanelets of unlisted subtypes ({names}) {what}")


def _polyline(way: Way, points: Mapping[str, np.ndarray]) -> Float[np.ndarray, "n 2"]:
    return np.stack([points[node] for node in way.nodes])


def _join(lines: Sequence[np.ndarray]) -> Float[np.ndarray, "n 2"]:
    """Joins polylines end to end, each in the order and direction that fits best."""
    rest = list(lines)
    joined = rest.pop(0)
    while rest:
        fits = [
            (math.dist(joined[-1], line[0]), math.dist(joined[0], line[-1]), number, reverse)
            for number, forward in enumerate(rest)
            for reverse, line in ((False, forward), (True, forward[::-1]))
        ]
        to_end, to_start, number, reverse = min(fits, key=lambda fit: min(fit[:2]))
        line = rest.pop(number)[:: -1 if reverse else 1]
        joined = np.concatenate([joined, line] if to_end <= to_start else [line, joined])
    distinct = np.concatenate([[True], np.hypot(*np.diff(joined, axis=0).T) > 0])
    return joined[distinct]


def _lanelets(
    osm: Osm, ways: Mapping[str, Way], points: Mapping[str, np.ndarray], repairs: list[str]
) -> list[Lanelet]:
    found: list[Lanelet] = []
    broken: list[str] = []
    rules = _SpeedRules(osm)
    unknown: dict[str, list[str]] = {}
    for relation in osm.relations:
        if relation.tags.get("type") != "lanelet":
            continue
        sides = {
            role: [way for name, way in relation.members if name == role]
            for role in ("left", "right", "centerline")
        }
        present = {
            role: [ways[way] for way in of_role if way in ways] for role, of_role in sides.items()
        }
        if not (present["left"] and present["right"]):
            broken.append(relation.id)
            continue
        found.append(_lanelet(relation, present, points, rules, unknown))
    if broken:
        repairs.append(
            f"{len(broken)} lanelets without a left or right bound left out: {shorten(broken)}"
        )
    for what, ids in unknown.items():
        repairs.append(f"{len(ids)} lanelets {what}: {shorten(ids)}")
    rules.report(repairs)
    return found


def _lanelet(
    relation: Relation,
    sides: Mapping[str, Sequence[Way]],
    points: Mapping[str, np.ndarray],
    rules: "_SpeedRules",
    unknown: dict[str, list[str]],
) -> Lanelet:
    left, right = (
        _join([_polyline(way, points) for way in sides[role]]) for role in ("left", "right")
    )
    if _end_distance(left, right[::-1]) < _end_distance(left, right):
        right = right[::-1]
    if _signed_area(np.concatenate([right, left[::-1]])) < 0:
        left, right = left[::-1], right[::-1]
    centre = None
    if sides["centerline"]:
        centre = _join([_polyline(way, points) for way in sides["centerline"]])
        if _end_distance(centre, left[::-1]) < _end_distance(centre, left):
            centre = centre[::-1]
    subtype = relation.tags.get("subtype", "").strip().lower()
    use = _use(relation, subtype, unknown)
    both_ways, understood = two_way(relation.tags)
    if not understood:
        unknown.setdefault("with an unknown value of one_way are one-way", []).append(relation.id)
    return Lanelet(
        id=relation.id,
        subtype=subtype,
        use=use,
        left=left,
        right=right,
        centre=centre,
        way_ids=tuple(way.id for role in ("left", "right") for way in sides[role]),
        two_way=both_ways,
        limit_mps=_limit_mps(relation, rules, unknown) if use in ("along", "unlisted") else None,
    )


def _use(relation: Relation, subtype: str, unknown: dict[str, list[str]]) -> Use:
    """How vehicles use a lanelet: by its participants, else by its subtype."""
    known: tuple[tuple[Use, frozenset[str]], ...] = (
        ("along", VEHICLE_SUBTYPES),
        ("over", CROSSED_SUBTYPES),
        ("not", OTHER_SUBTYPES),
    )
    of_subtype: Use = "unlisted"
    for use, subtypes in known:
        if subtype in subtypes:
            of_subtype = use
    allowed, are_all_known = vehicles_allowed(relation.tags)
    if not are_all_known:
        what = "with an unknown value of a participant, which is not used"
        unknown.setdefault(what, []).append(relation.id)
    shown = brief(repr(subtype or "road"))
    if allowed and of_subtype != "along":
        what = f"of subtype {shown} are roads, since a participant tag allows vehicles"
        unknown.setdefault(what, []).append(relation.id)
        return "along"
    if allowed is False and of_subtype in ("along", "unlisted"):
        what = f"of subtype {shown} left out, since no participant tag allows vehicles"
        unknown.setdefault(what, []).append(relation.id)
        return "not"
    return of_subtype


def _limit_mps(
    relation: Relation, rules: "_SpeedRules", unknown: dict[str, list[str]]
) -> float | None:
    limit = rules.limit_mps(relation)
    for text in () if limit is not None else limit_texts(relation.tags):
        limit = speed_mps(text)
        if limit is not None:
            break
        if text.strip().lower() != "none":
            what = f"with the unknown speed limit {brief(repr(text))}, which is not used"
            unknown.setdefault(what, []).append(relation.id)
    return limit


class _SpeedRules:
    """Speed limits that regulatory elements give to the lanelets that refer to them."""

    def __init__(self, osm: Osm) -> None:
        """Finds the elements of subtype `speed_limit` and the lanelets that they refer to."""
        self._rules: dict[str, float] = {}
        self._of_lanelet: dict[str, list[str]] = {}
        self._fallbacks: set[str] = set()
        self._unused: set[str] = set()
        self._unknown: list[str] = []
        self._dynamic: list[str] = []
        self._present = {relation.id for relation in osm.relations}
        self._missing: set[str] = set()
        tags_of = {way.id: way.tags for way in osm.ways.values()}
        for relation in osm.relations:
            kind = relation.tags.get("type"), relation.tags.get("subtype", "").lower()
            if kind != ("regulatory_element", "speed_limit"):
                continue
            if boolean(relation.tags.get("dynamic", "")):
                self._dynamic.append(relation.id)
                continue
            signs = [
                tags_of[way].get("subtype", "")
                for role, way in relation.members
                if role == "refers" and way in tags_of
            ]
            speeds = [sign_mps(text) for text in (*signs, relation.tags.get("sign_type", ""))]
            known = [speed for speed in speeds if speed is not None]
            if not known:
                sign = relation.tags.get("sign_type") or next(iter(signs), "")
                self._unknown.append(f"{relation.id} ({brief(repr(sign))})")
                continue
            self._rules[relation.id] = known[0]
            self._unused.add(relation.id)
            if boolean(relation.tags.get("fallback", "")):
                self._fallbacks.add(relation.id)
            for role, lanelet in relation.relations:
                if role == "refers":
                    self._of_lanelet.setdefault(lanelet, []).append(relation.id)

    def limit_mps(self, lanelet: Relation) -> float | None:
        """The limit of the first element of a lanelet that is no fallback, else of the first."""
        named = [rule for role, rule in lanelet.relations if role == "regulatory_element"]
        self._missing.update(rule for rule in named if rule not in self._present)
        rules = [
            rule for rule in (*named, *self._of_lanelet.get(lanelet.id, ())) if rule in self._rules
        ]
        self._unused.difference_update(rules)
        first = sorted(rules, key=lambda rule: rule in self._fallbacks)[:1]
        return self._rules[first[0]] if first else None

    def report(self, repairs: list[str]) -> None:
        """Adds the elements that are not used, or that lanelets refer to and the file lacks."""
        if self._missing:
            repairs.append(
                f"{len(self._missing)} regulatory elements that lanelets refer to are not in the "
                f"file: {shorten(sorted(self._missing))}"
            )
        for ids, why in (
            (self._unknown, "have no known speed"),
            (self._dynamic, "are dynamic"),
            (sorted(self._unused), "belong to no lanelet for vehicles"),
        ):
            if ids:
                repairs.append(
                    f"{len(ids)} regulatory elements for speed left out, since they {why}: "
                    f"{shorten(ids)}"
                )


def _end_distance(line: np.ndarray, other: np.ndarray) -> float:
    return math.dist(line[0], other[0]) + math.dist(line[-1], other[-1])


def _signed_area(ring: Float[np.ndarray, "n 2"]) -> float:
    """Signed area, positive for a ring that runs counter-clockwise."""
    following = np.roll(ring, -1, axis=0)
    return 0.5 * float((ring[:, 0] * following[:, 1] - ring[:, 1] * following[:, 0]).sum())


def _meets(edge: np.ndarray, edges: Float[np.ndarray, "n 2 2"]) -> np.ndarray:
    """Mask of the ends whose left and right corners coincide with those of `edge`."""
    return (np.hypot(*np.moveaxis(edges - edge, -1, 0)) <= MEETS_WITHIN_M).all(axis=-1)


def _reverse_swapped(lanelets: Sequence[Lanelet], repairs: list[str]) -> None:
    """Reverses lanelets with more contradictions than each neighbour that they contradict."""
    swapped: list[str] = []
    while len(swapped) < len(lanelets):
        excess, contradicts = _contradictions(lanelets)
        highest = np.where(contradicts, excess, -1).max(axis=1)
        wrong = np.flatnonzero((excess > 0) & (excess > highest))
        wrong = [number for number in wrong.tolist() if lanelets[number].id not in swapped]
        if not wrong:
            break
        worst = max(wrong, key=lambda number: int(excess[number]))
        lanelets[worst].reverse()
        swapped.append(lanelets[worst].id)
    if swapped:
        repairs.append(
            f"{len(swapped)} lanelets with swapped left and right bounds reversed: "
            f"{shorten(swapped)}"
        )


def _contradictions(
    lanelets: Sequence[Lanelet],
) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, "n n"]]:
    """Compares the directions of connected lanelets.

    Returns:
        For each lanelet, the number of neighbours that it meets head-on or tail to tail less those
        that it meets in line; and a mask of the former.
    """
    starts = np.array([lanelet.start for lanelet in lanelets]).reshape(-1, 2, 2)
    ends = np.array([lanelet.end for lanelet in lanelets]).reshape(-1, 2, 2)
    in_line, contradicts = (np.zeros((len(lanelets), len(lanelets)), dtype=bool) for _ in range(2))
    for number, lanelet in enumerate(lanelets):
        in_line[number] = _meets(lanelet.start, ends) | _meets(lanelet.end, starts)
        contradicts[number] = _meets(lanelet.start[::-1], starts) | _meets(lanelet.end[::-1], ends)
    return contradicts.sum(axis=1) - in_line.sum(axis=1), contradicts


def _centre_line(lanelet: Lanelet) -> Float[np.ndarray, "n 2"]:
    if lanelet.centre is not None:
        return lanelet.centre
    left_at, right_at = _arc_shares(lanelet.left), _arc_shares(lanelet.right)
    at = np.unique(np.concatenate([left_at, right_at]).round(6))
    left, right = points_at(lanelet.left, left_at, at), points_at(lanelet.right, right_at, at)
    return 0.5 * (left + right)


def _arc_shares(line: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    arc = arc_lengths(line)
    return arc / arc[-1] if arc[-1] > 0 else np.linspace(0.0, 1.0, len(line))


def _successors(lanelets: Sequence[Lanelet]) -> Int[np.ndarray, "edges 2"]:
    starts = np.array([lanelet.start for lanelet in lanelets]).reshape(-1, 2, 2)
    edges = [
        (number, int(follower))
        for number, lanelet in enumerate(lanelets)
        for follower in np.flatnonzero(_meets(lanelet.end, starts))
        if follower != number
    ]
    return np.array(edges, dtype=np.int64).reshape(-1, 2)


def _areas(osm: Osm, ways: Mapping[str, Way], points: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    rings = []
    for relation in osm.relations:
        if relation.tags.get("type") != "multipolygon":
            continue
        if relation.tags.get("subtype", "").lower() not in DRIVABLE_AREAS:
            continue
        outer = [ways[way] for role, way in relation.members if role == "outer" and way in ways]
        if outer:
            rings.append(_join([_polyline(way, points) for way in outer]))
    return rings


def _lines(
    content: Lanelet2File,
    region_m: tuple[float, float, float, float] | None,
    vehicle: Iterable[Lanelet],
    crossed: Iterable[Lanelet],
) -> tuple[list[np.ndarray], list[int]]:
    uses: dict[str, int] = {}
    for lanelet in vehicle:
        for way in lanelet.way_ids:
            uses[way] = uses.get(way, 0) + 1
    bounds = set(uses) | {way for lanelet in crossed for way in lanelet.way_ids}
    lines, types = [], []
    for way in content.ways.values():
        is_curb = way.tags.get("type") in CURB_TYPES
        if way.id not in bounds and not is_curb:
            continue
        line = _polyline(way, content.points)
        if way.id in bounds or _reaches(line, region_m):
            lines.append(line)
            types.append(int(_line_type(way, uses.get(way.id, 0))))
    return lines, types


def _line_type(way: Way, vehicle_uses: int) -> LineType:
    kind = way.tags.get("type", "").lower()
    if kind in CURB_TYPES:
        return LineType.CURB
    if kind.startswith("line_"):
        subtype = way.tags.get("subtype", "").lower()
        return LineType.DASHED if subtype.startswith("dashed") else LineType.SOLID
    if kind in ("pedestrian_marking", "zebra_marking", "bike_marking"):
        return LineType.DASHED
    if not kind and vehicle_uses > 1:
        return LineType.DASHED
    return LineType.VIRTUAL
