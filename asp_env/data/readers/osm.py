"""OSM XML as it comes: nodes, ways and relations, with whatever had to be overlooked."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from asp_env.errors import DataError

SPEED_UNITS = {"": 1 / 3.6, "km/h": 1 / 3.6, "kmh": 1 / 3.6, "m/s": 1.0, "mph": 0.44704}
"""In m/s; a number without a unit is in km/h, in Lanelet2 as in OSM."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """A polyline of nodes."""

    id: str
    nodes: tuple[str, ...]
    tags: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Relation:
    """A lanelet, an area or a rule, made of ways."""

    id: str
    members: tuple[tuple[str, str], ...]
    """(role, id) of the member ways."""
    tags: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Osm:
    """What a file holds. Ways have at least two nodes, all of which exist."""

    nodes: Mapping[str, tuple[float, float]]
    """By id: (latitude, longitude) in degrees, or (x, y) in metres if `local`."""
    local: bool
    ways: Mapping[str, Way]
    relations: tuple[Relation, ...]
    repairs: tuple[str, ...]


def read_osm(path: Path) -> Osm:
    """Reads a map file. Of elements with the same id the first counts; deleted ones do not.

    Nodes of a file whose name ends in `.osm_xy` have local metres in place of degrees.

    Raises:
        DataError: the file is absent or no XML.
    """
    nodes: dict[str, tuple[float, float]] = {}
    raw_ways: dict[str, Way] = {}
    relations: dict[str, Relation] = {}
    doubles: list[str] = []
    local = path.suffix == ".osm_xy"
    try:
        for _, element in ElementTree.iterparse(path):
            if element.tag not in ("node", "way", "relation"):
                continue
            number = element.get("id", "")
            known = {"node": nodes, "way": raw_ways, "relation": relations}[element.tag]
            if element.get("action") == "delete" or element.get("visible") == "false":
                pass
            elif number in known:
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
            f"{path}: is no XML ({error}); expected a lanelet2 map: copy the file again"
        ) from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    repairs = []
    if doubles:
        repairs.append(f"{len(doubles)} ids given twice, the first kept: {shorten(doubles)}")
    ways = _complete(raw_ways, nodes, repairs)
    return Osm(
        nodes=nodes,
        local=local,
        ways=ways,
        relations=tuple(relations.values()),
        repairs=tuple(repairs),
    )


def shorten(names: list[str], limit: int = 5) -> str:
    """The first few of a list, and how many more there are."""
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more


def _add_node(
    nodes: dict[str, tuple[float, float]],
    number: str,
    element: ElementTree.Element,
    names: tuple[str, str],
) -> None:
    try:
        nodes[number] = (float(element.get(names[0], "")), float(element.get(names[1], "")))
    except ValueError:
        return  # a node without a position is a missing one, and reported as such


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


def speed_mps(text: str) -> float | None:
    """A speed as a tag tells it, such as `50 km/h` or `30 mph`; None if it tells none."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([a-z/]*)", text.strip().lower())
    if match is None or match[2] not in SPEED_UNITS:
        return None
    return float(match[1]) * SPEED_UNITS[match[2]]


def _complete(
    raw_ways: Mapping[str, Way], nodes: Mapping[str, tuple[float, float]], repairs: list[str]
) -> dict[str, Way]:
    ways: dict[str, Way] = {}
    patched: list[str] = []
    dropped: list[str] = []
    for way in raw_ways.values():
        there = tuple(node for node in way.nodes if node in nodes)
        kept = tuple(node for i, node in enumerate(there) if i == 0 or node != there[i - 1])
        if len(kept) < 2:
            dropped.append(way.id)
            continue
        if len(there) < len(way.nodes):
            patched.append(way.id)
        ways[way.id] = Way(id=way.id, nodes=kept, tags=way.tags)
    if patched:
        repairs.append(f"{len(patched)} ways name nodes that are missing: {shorten(patched)}")
    if dropped:
        repairs.append(f"{len(dropped)} ways left out, too few nodes: {shorten(dropped)}")
    return ways
