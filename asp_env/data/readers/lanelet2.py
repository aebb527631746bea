"""Lanelet2 maps (`.osm` in degrees, `.osm_xy` in local metres) in a recording's metric frame.

Reading is lenient: missing references, duplicate ids and swapped bounds are repaired and reported.

The direction of a lanelet follows from the roles of its bounds, as in Lanelet2 itself: seen along
the lanelet, the left bound is on the left. The order of a way's nodes does not matter, since
neighbours that share a way may run in opposite directions. A lanelet that meets its neighbours
head-on or tail to tail more often than in line has swapped bounds, and is reversed.
"""

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from pyproj import Transformer

from asp_env.data.readers.layout import shorten
from asp_env.data.road_map import LineType, Ragged, RoadMap
from asp_env.errors import DataError
from asp_env.geometry import arc_lengths, points_at

SPEED_UNITS = {"": 1 / 3.6, "km/h": 1 / 3.6, "kmh": 1 / 3.6, "m/s": 1.0, "mph": 0.44704}
"""Units of speed tags in m/s. A number without a unit is in km/h, in Lanelet2 as in OSM."""

VEHICLE_SUBTYPES = frozenset(
    {"", "road", "highway", "bus_lane", "play_street", "emergency_lane", "exit", "entry"}
)
"""Subtypes of lanelets that vehicles drive along. A lanelet without a subtype is a road. Bicycle
lanes, walkways and rails are not included."""

CROSSED_SUBTYPES = frozenset({"crosswalk"})
"""Subtypes of lanelets that vehicles may drive over, but not along."""

DRIVABLE_AREAS = frozenset({"freespace", "parking"})
"""Subtypes of multipolygons that are part of the drivable area."""

CURB_TYPES = frozenset(
    {"curbstone", "road_border", "guard_rail", "fence", "wall", "jersey_barrier", "rail"}
)
"""Types of ways that become curbs."""

FAR_M = 100_000.0
"""A map whose median node is farther than this from its recordings' origin belongs to another
location. Chosen by hand."""

MEETS_WITHIN_M = 0.5
"""Two lanelets that share no nodes are connected if both corners of their ends are within this
distance. Chosen by hand: above drawing errors, below a lane's width."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """A recording's metric frame: local = UTM(latitude, longitude) - (x, y)."""

    x_m: float
    y_m: float
    longitude_deg: float
    """Longitude of any point of the site. It determines the UTM zone."""
    latitude_deg: float
    """Latitude of any point of the site. It determines the hemisphere."""

    @property
    def epsg(self) -> int:
        """EPSG code of the UTM zone."""
        zone = int((self.longitude_deg + 180.0) // 6.0) % 60 + 1
        return (32600 if self.latitude_deg >= 0 else 32700) + zone

    @classmethod
    def at(cls, *, latitude_deg: float, longitude_deg: float) -> "Origin":
        """The frame whose origin is a point on the globe."""
        utm = cls(x_m=0.0, y_m=0.0, longitude_deg=longitude_deg, latitude_deg=latitude_deg)
        ((x_m, y_m),) = to_local(np.array([latitude_deg]), np.array([longitude_deg]), utm)
        return cls(
            x_m=float(x_m), y_m=float(y_m), longitude_deg=longitude_deg, latitude_deg=latitude_deg
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """A polyline of nodes."""

    id: str
    nodes: tuple[str, ...]
    tags: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Relation:
    """A lanelet, an area or a rule that consists of ways."""

    id: str
    members: tuple[tuple[str, str], ...]
    """(role, way id) of each member."""
    tags: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Osm:
    """The content of a file. Ways have at least two nodes, all of which exist."""

    nodes: Mapping[str, tuple[float, float]]
    """(latitude, longitude) in degrees by id, or (x, y) in metres if `local`."""
    local: bool
    ways: Mapping[str, Way]
    relations: tuple[Relation, ...]
    repairs: tuple[str, ...]


@dataclass(slots=True, kw_only=True)
class _Lanelet:
    """A lanelet whose bounds run in its direction of travel, the left one on the left.

    `start` and `end` are the left and the right corner at its two ends.
    """

    id: str
    subtype: str
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
    def ring(self) -> Float[np.ndarray, "n 2"]:
        return np.concatenate([self.left, self.right[::-1]])


def to_local(
    latitudes_deg: Float[np.ndarray, " n"], longitudes_deg: Float[np.ndarray, " n"], origin: Origin
) -> Float[np.ndarray, "n 2"]:
    """Converts latitudes and longitudes to positions (n, 2) in a local frame, metres."""
    utm = Transformer.from_crs(4326, origin.epsg, always_xy=True)
    x_m, y_m = utm.transform(longitudes_deg, latitudes_deg)
    return np.stack([np.asarray(x_m) - origin.x_m, np.asarray(y_m) - origin.y_m], axis=-1)


def speed_mps(text: str) -> float | None:
    """Parses the text of a speed tag, such as `50 km/h` or `30 mph`; None if it is not a speed."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([a-z/]*)", text.strip().lower())
    if match is None or match[2] not in SPEED_UNITS:
        return None
    return float(match[1]) * SPEED_UNITS[match[2]]


def read_osm(path: Path) -> Osm:
    """Reads a map file.

    Of several elements with the same id the first is used; deleted elements are ignored. Nodes of
    files whose names end in `.osm_xy` are in local metres instead of degrees.

    Raises:
        DataError: the file is missing or not XML.
    """
    nodes: dict[str, tuple[float, float]] = {}
    raw_ways: dict[str, Way] = {}
    relations: dict[str, Relation] = {}
    doubles: list[str] = []
    local = path.suffix.lower() == ".osm_xy"
    try:
        for _, element in ElementTree.iterparse(path):
            if element.tag not in ("node", "way", "relation"):
                continue
            number = element.get("id", "")
            elements = {"node": nodes, "way": raw_ways, "relation": relations}[element.tag]
            if element.get("action") == "delete" or element.get("visible") == "false":
                pass
            elif number in elements:
                doubles.append(f"{element.tag} {number}")
            elif element.tag == "node":
                _add_node(nodes, number, element, ("x", "y") if local else ("lat", "lon"))
            elif element.tag == "way":
                raw_ways[number] = _way(number, element)
            else:
                relations[number] = _relation(number, element)
            element.clear()
    except ElementTree.ParseError as error:
        raise DataError(
            f"{path}: is not XML ({error}); expected a lanelet2 map: copy the file again"
        ) from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    repairs = []
    if doubles:
        repairs.append(
            f"{len(doubles)} ids occur twice, the first element used: {shorten(doubles)}"
        )
    ways = _complete(raw_ways, nodes, repairs)
    return Osm(
        nodes=nodes,
        local=local,
        ways=ways,
        relations=tuple(relations.values()),
        repairs=tuple(repairs),
    )


def read_lanelet2(path: Path, origin: Origin) -> RoadMap:
    """Reads a map into a recording's frame.

    `lines` are the bounds of vehicle lanelets and crosswalks, and all ways that are typed as a curb
    or barrier. A bound without a type is dashed if two vehicle lanelets share it, and virtual
    otherwise. `drivable` are vehicle lanelets, crosswalks, and the outer rings of freespace and
    parking; holes are not cut out. A lane's speed limit is that of its tag `speed_limit` (Lanelet2)
    or `maxspeed` (OSM).

    Args:
        path: the map file.
        origin: the recording's frame.

    Raises:
        DataError: the file is not a map, has no lanelets, or lies at another location.
    """
    osm = read_osm(path)
    if not any(relation.tags.get("type") == "lanelet" for relation in osm.relations):
        raise DataError(
            f"{path}: has no lanelets among its {len(osm.relations)} relations; "
            "expected a lanelet2 map: put the right file in its place"
        )
    repairs = list(osm.repairs)
    points = _points(osm, origin)
    _check_near(path, osm, points, origin)
    lanelets = _lanelets(osm, points, repairs)
    vehicle = [lanelet for lanelet in lanelets if lanelet.subtype in VEHICLE_SUBTYPES]
    _reverse_swapped(vehicle, repairs)
    crossed = [lanelet for lanelet in lanelets if lanelet.subtype in CROSSED_SUBTYPES]
    rings = [lanelet.ring for lanelet in vehicle + crossed] + _areas(osm, points)
    lines, line_types = _lines(osm, points, vehicle, crossed)
    if not vehicle:
        raise DataError(
            f"{path}: none of its {len(lanelets)} lanelets is for vehicles; "
            "expected some of subtype 'road': put the right file in its place"
        )
    return RoadMap(
        name=path.stem,
        lines=Ragged.pack(lines),
        line_types=np.array(line_types, dtype=np.int64),
        drivable=Ragged.pack(rings),
        lanes=Ragged.pack([_centre_line(lanelet) for lanelet in vehicle]),
        successors=_successors(vehicle),
        areas=Ragged.pack([lanelet.ring for lanelet in vehicle]),
        two_way=np.array([lanelet.two_way for lanelet in vehicle]),
        limits_mps=np.array([lanelet.limit_mps or 0.0 for lanelet in vehicle]),
        limited=np.array([lanelet.limit_mps is not None for lanelet in vehicle]),
        repairs=tuple(repairs),
    )


def _add_node(
    nodes: dict[str, tuple[float, float]],
    number: str,
    element: ElementTree.Element,
    names: tuple[str, str],
) -> None:
    try:
        nodes[number] = (float(element.get(names[0], "")), float(element.get(names[1], "")))
    except ValueError:
        return  # a node without a position counts as missing, and is reported as such


def _tags(element: ElementTree.Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iter("tag")}


def _way(number: str, element: ElementTree.Element) -> Way:
    references = tuple(reference.get("ref", "") for reference in element.iter("nd"))
    return Way(id=number, nodes=references, tags=_tags(element))


def _relation(number: str, element: ElementTree.Element) -> Relation:
    members = tuple(
        (member.get("role", ""), member.get("ref", ""))
        for member in element.iter("member")
        if member.get("type", "way") == "way"
    )
    return Relation(id=number, members=members, tags=_tags(element))


def _complete(
    raw_ways: Mapping[str, Way], nodes: Mapping[str, tuple[float, float]], repairs: list[str]
) -> dict[str, Way]:
    ways: dict[str, Way] = {}
    patched: list[str] = []
    dropped: list[str] = []
    for way in raw_ways.values():
        present = tuple(node for node in way.nodes if node in nodes)
        distinct = tuple(node for i, node in enumerate(present) if i == 0 or node != present[i - 1])
        if len(distinct) < 2:
            dropped.append(way.id)
            continue
        if len(present) < len(way.nodes):
            patched.append(way.id)
        ways[way.id] = Way(id=way.id, nodes=distinct, tags=way.tags)
    if patched:
        repairs.append(f"{len(patched)} ways refer to missing nodes: {shorten(patched)}")
    if dropped:
        repairs.append(
            f"{len(dropped)} ways with fewer than two nodes left out: {shorten(dropped)}"
        )
    return ways


def _points(osm: Osm, origin: Origin) -> dict[str, np.ndarray]:
    nodes = np.array(list(osm.nodes.values()), dtype=np.float64).reshape(-1, 2)
    local = nodes if osm.local else to_local(nodes[:, 0], nodes[:, 1], origin)
    return dict(zip(osm.nodes, local, strict=True))


def _check_near(path: Path, osm: Osm, points: Mapping[str, np.ndarray], origin: Origin) -> None:
    if not points or math.hypot(*np.median(list(points.values()), axis=0)) < FAR_M:
        return
    middle = np.median(list(osm.nodes.values()), axis=0)
    raise DataError(
        f"{path}: lies at about {middle[0]:.4f}, {middle[1]:.4f}, expected it at its recordings' "
        f"origin {origin.latitude_deg:.4f}, {origin.longitude_deg:.4f} (degrees; from "
        "recordingMeta.csv, or meta_data.csv in the tracks' folder): put the right file in its "
        "place"
    )


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


def _lanelets(osm: Osm, points: Mapping[str, np.ndarray], repairs: list[str]) -> list[_Lanelet]:
    found: list[_Lanelet] = []
    broken: list[str] = []
    for relation in osm.relations:
        if relation.tags.get("type") != "lanelet":
            continue
        sides = {
            role: [way for name, way in relation.members if name == role]
            for role in ("left", "right", "centerline")
        }
        present = {
            role: [osm.ways[way] for way in ways if way in osm.ways] for role, ways in sides.items()
        }
        if not (present["left"] and present["right"]):
            broken.append(relation.id)
            continue
        found.append(_lanelet(relation, present, points))
    if broken:
        repairs.append(
            f"{len(broken)} lanelets without a left or right bound left out: {shorten(broken)}"
        )
    return found


def _lanelet(
    relation: Relation, sides: Mapping[str, Sequence[Way]], points: Mapping[str, np.ndarray]
) -> _Lanelet:
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
    return _Lanelet(
        id=relation.id,
        subtype=relation.tags.get("subtype", "").lower(),
        left=left,
        right=right,
        centre=centre,
        way_ids=tuple(way.id for role in ("left", "right") for way in sides[role]),
        two_way="no" in (relation.tags.get("one_way"), relation.tags.get("oneway")),
        limit_mps=speed_mps(relation.tags.get("speed_limit", relation.tags.get("maxspeed", ""))),
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


def _reverse_swapped(lanelets: Sequence[_Lanelet], repairs: list[str]) -> None:
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
    lanelets: Sequence[_Lanelet],
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


def _centre_line(lanelet: _Lanelet) -> Float[np.ndarray, "n 2"]:
    if lanelet.centre is not None:
        return lanelet.centre
    left_at, right_at = _arc_shares(lanelet.left), _arc_shares(lanelet.right)
    at = np.unique(np.concatenate([left_at, right_at]).round(6))
    left, right = points_at(lanelet.left, left_at, at), points_at(lanelet.right, right_at, at)
    return 0.5 * (left + right)


def _arc_shares(line: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    arc = arc_lengths(line)
    return arc / arc[-1] if arc[-1] > 0 else np.linspace(0.0, 1.0, len(line))


def _successors(lanelets: Sequence[_Lanelet]) -> Int[np.ndarray, "edges 2"]:
    starts = np.array([lanelet.start for lanelet in lanelets]).reshape(-1, 2, 2)
    edges = [
        (number, int(follower))
        for number, lanelet in enumerate(lanelets)
        for follower in np.flatnonzero(_meets(lanelet.end, starts))
        if follower != number
    ]
    return np.array(edges, dtype=np.int64).reshape(-1, 2)


def _areas(osm: Osm, points: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    rings = []
    for relation in osm.relations:
        if relation.tags.get("type") != "multipolygon":
            continue
        if relation.tags.get("subtype", "").lower() not in DRIVABLE_AREAS:
            continue
        outer = [
            osm.ways[way] for role, way in relation.members if role == "outer" and way in osm.ways
        ]
        if outer:
            rings.append(_join([_polyline(way, points) for way in outer]))
    return rings


def _lines(
    osm: Osm,
    points: Mapping[str, np.ndarray],
    vehicle: Iterable[_Lanelet],
    crossed: Iterable[_Lanelet],
) -> tuple[list[np.ndarray], list[int]]:
    uses: dict[str, int] = {}
    for lanelet in vehicle:
        for way in lanelet.way_ids:
            uses[way] = uses.get(way, 0) + 1
    bounds = set(uses) | {way for lanelet in crossed for way in lanelet.way_ids}
    lines, types = [], []
    for way in osm.ways.values():
        if way.id in bounds or way.tags.get("type") in CURB_TYPES:
            lines.append(_polyline(way, points))
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
