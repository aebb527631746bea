"""Lanelets and areas, and a writer of lanelet2 maps.

Maps are OSM XML with enough digits to reproduce UTM coordinates exactly.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pyproj

from scenarios.polylines import Polyline

Marking = Literal["curb", "solid", "dashed", "zebra", "virtual"]
Subtype = Literal["road", "crosswalk", "walkway"]

UTM_ZONE_32 = "EPSG:32632"
_TAGS: dict[Marking, dict[str, str]] = {
    "curb": {"type": "curbstone", "subtype": "high"},
    "solid": {"type": "line_thin", "subtype": "solid"},
    "dashed": {"type": "line_thin", "subtype": "dashed"},
    "zebra": {"type": "line_thick", "subtype": "dashed"},
    "virtual": {"type": "virtual"},
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Border:
    """One side of a lanelet, or a section of it with one marking."""

    line: Polyline
    marking: Marking


@dataclass(frozen=True, slots=True, kw_only=True)
class Lanelet:
    """A section of a lane, crossing or walkway in the direction of travel."""

    subtype: Subtype
    left: tuple[Border, ...]
    """Consecutive sections; each starts at the end of the one before."""
    right: tuple[Border, ...]
    centre: Polyline | None = None
    """Centre line; None for the middle between the sides."""
    speed_limit_mps: float | None = None
    """Written in whole km/h; None for no limit."""
    one_way: bool = True
    """Whether a road may be driven in its own direction only; other lanelets have both."""

    @property
    def left_line(self) -> Polyline:
        return _joined(self.left)

    @property
    def right_line(self) -> Polyline:
        return _joined(self.right)

    @property
    def outline(self) -> Polyline:
        """Corners of the closed outline."""
        return np.concatenate([self.left_line, self.right_line[::-1]])


@dataclass(frozen=True, slots=True, kw_only=True)
class Area:
    """A drivable area without a lane."""

    subtype: Literal["parking", "freespace"]
    outer: tuple[Border, ...]
    """Sections of the closed ring around it, each in either direction."""


def _joined(borders: tuple[Border, ...]) -> Polyline:
    first, *others = (border.line for border in borders)
    return np.concatenate([first, *(line[1:] for line in others)])


def to_degrees(points_utm: Polyline) -> Polyline:
    """Converts points (n, 2) in UTM zone 32, m, to (latitude, longitude), degrees."""
    transform = pyproj.Transformer.from_crs(UTM_ZONE_32, "EPSG:4326", always_xy=True)
    lon, lat = transform.transform(points_utm[:, 0], points_utm[:, 1])
    return np.stack([lat, lon], axis=1)


def _tag_lines(tags: dict[str, str]) -> str:
    return "".join(f'    <tag k="{key}" v="{value}"/>\n' for key, value in tags.items())


class _Elements:
    """Nodes and ways with shared end points, numbered in the order of creation."""

    def __init__(self, join_m: float) -> None:
        self.join_m = join_m
        self.points: list[np.ndarray] = []
        self._cells: dict[tuple[int, int], list[int]] = {}
        self.ways: dict[tuple[int, ...], tuple[int, Marking]] = {}

    def node(self, point: np.ndarray) -> int:
        column, row = (int(value) for value in np.floor(point / 0.1))
        for near in ((column + i, row + j) for i in (-1, 0, 1) for j in (-1, 0, 1)):
            for number in self._cells.get(near, []):
                if np.hypot(*(self.points[number] - point)) < self.join_m:
                    return number
        self.points.append(point)
        self._cells.setdefault((column, row), []).append(len(self.points) - 1)
        return len(self.points) - 1

    def members(self, lanelet: Lanelet) -> list[tuple[str, int]]:
        """(role, number) of the ways of a lanelet."""
        centre = () if lanelet.centre is None else (Border(line=lanelet.centre, marking="virtual"),)
        roles = {"left": lanelet.left, "right": lanelet.right, "centerline": centre}
        return [(role, self.way(border)) for role, borders in roles.items() for border in borders]

    def way(self, border: Border) -> int:
        """The number of the way along a border; both directions of a line share one way.

        A marking of either direction replaces a virtual line.
        """
        numbers = [self.node(point) for point in border.line]
        key = tuple(n for i, n in enumerate(numbers) if i == 0 or n != numbers[i - 1])
        for direction in (key, key[::-1]):
            if direction in self.ways:
                number, marking = self.ways[direction]
                if marking == "virtual":
                    self.ways[direction] = (number, border.marking)
                return number
        self.ways[key] = (len(self.ways), border.marking)
        return len(self.ways) - 1


def write_map(
    path: Path,
    lanelets: list[Lanelet],
    areas: list[Area],
    *,
    origin_utm_m: tuple[float, float],
    join_m: float,
) -> None:
    """Writes a lanelet2 map.

    Args:
        path: the `.osm` file to write.
        lanelets: in the recording's frame, in the order in which they are written.
        areas: in the same frame.
        origin_utm_m: UTM coordinates of the frame's origin.
        join_m: points closer than this, at most 0.1 m, become one node.
    """
    elements = _Elements(join_m)
    ways = [elements.members(lanelet) for lanelet in lanelets]
    rings = [[elements.way(border) for border in area.outer] for area in areas]
    first_way = len(elements.points) + 1
    first_relation = first_way + len(elements.ways)
    degrees = to_degrees(np.stack(elements.points) + np.array(origin_utm_m))
    parts = ['<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6" generator="asp-env">\n']
    parts += [
        f'  <node id="{number}" lat="{lat:.11f}" lon="{lon:.11f}" version="1"/>\n'
        for number, (lat, lon) in enumerate(degrees, start=1)
    ]
    for key, (number, marking) in elements.ways.items():
        refs = "".join(f'    <nd ref="{node + 1}"/>\n' for node in key)
        tags = _tag_lines(_TAGS[marking])
        parts.append(f'  <way id="{first_way + number}" version="1">\n{refs}{tags}  </way>\n')
    for number, (lanelet, roles) in enumerate(zip(lanelets, ways, strict=True)):
        members = [(role, first_way + way) for role, way in roles]
        tags = {
            "type": "lanelet",
            "subtype": lanelet.subtype,
            "location": "urban",
            "one_way": "yes" if lanelet.subtype == "road" and lanelet.one_way else "no",
        }
        if lanelet.speed_limit_mps is not None:
            tags["speed_limit"] = f"{lanelet.speed_limit_mps * 3.6:.0f} km/h"
        parts.append(_relation(first_relation + number, members, tags))
    first_area = first_relation + len(lanelets)
    for number, (area, ring) in enumerate(zip(areas, rings, strict=True), start=first_area):
        members = [("outer", first_way + way) for way in ring]
        tags = {"type": "multipolygon", "subtype": area.subtype}
        parts.append(_relation(number, members, tags))
    path.write_text("".join([*parts, "</osm>\n"]), encoding="utf-8")


def _relation(number: int, members: list[tuple[str, int]], tags: dict[str, str]) -> str:
    lines = "".join(
        f'    <member type="way" ref="{way}" role="{role}"/>\n' for role, way in members
    )
    return f'  <relation id="{number}" version="1">\n{lines}{_tag_lines(tags)}  </relation>\n'
