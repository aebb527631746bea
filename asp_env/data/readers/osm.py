"""Elements of an OSM file: nodes, ways and relations with their tags."""

import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

import numpy as np
from jaxtyping import Float

from asp_env.data.readers.layout import check_content, shorten
from asp_env.errors import DataError
from asp_env.stored import brief

COORDINATES = ("lat", "lon", "x", "y", "local_x", "local_y")
"""What a node may have: degrees, metres, and metres in tags as Autoware writes them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """A polyline of nodes."""

    id: str
    nodes: tuple[str, ...]
    tags: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Relation:
    """A lanelet, an area or a rule that consists of ways and relations."""

    id: str
    members: tuple[tuple[str, str], ...]
    """(role, way id) of each member that is a way."""
    relations: tuple[tuple[str, str], ...]
    """(role, relation id) of each member that is a relation."""
    tags: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Osm:
    """The content of a file. Ways may refer to nodes that do not exist."""

    path: Path
    nodes: Mapping[str, int]
    """Row of each node in `coordinates`, by id."""
    coordinates: Float[np.ndarray, "nodes 6"]
    """`COORDINATES` of each node; NaN where it has none, or no number."""
    sample: str
    """The attributes of the first node, for messages."""
    ways: Mapping[str, Way]
    relations: tuple[Relation, ...]
    repairs: tuple[str, ...]


def read_osm(path: Path) -> Osm:
    """Reads a map file.

    Of several elements with the same id the first is used; deleted elements are ignored.

    Raises:
        DataError: the file is missing, not XML, in an encoding that XML parsers do not know, or
            declares entities.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # of codecs such as unicode_escape
            with path.open("rb") as file:
                check_content(path, file.read(1 << 10))
            _check_prolog(path)
            return _read(path)
    except (
        *(ElementTree.ParseError, expat.ExpatError, ValueError, LookupError),
        DeprecationWarning,
    ) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(
            f"{path}: is not XML ({brief(error)}); expected a lanelet2 map: copy the file again"
        ) from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error


def _check_prolog(path: Path) -> None:
    """Refuses entities, which no map needs: they may stand for gigabytes, or for other files."""
    started = []

    def start(*_: object) -> None:
        started.append(True)

    def refuse(name: str, *_: object) -> None:
        raise DataError(
            f"{path}: declares the XML entity {brief(repr(name))}; expected a lanelet2 map, which "
            "has none: put the right file in its place"
        )

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EntityDeclHandler = refuse
    with path.open("rb") as file:
        while not started and (chunk := file.read(1 << 14)):
            parser.Parse(chunk)


def _read(path: Path) -> Osm:
    nodes: dict[str, int] = {}
    coordinates: list[tuple[float, ...]] = []
    ways: dict[str, Way] = {}
    relations: dict[str, Relation] = {}
    doubles: list[str] = []
    sample = ""
    for _, element in ElementTree.iterparse(path):
        if element.tag not in ("node", "way", "relation"):
            continue
        number = element.get("id", "")
        elements = {"node": nodes, "way": ways, "relation": relations}[element.tag]
        if element.get("action") == "delete" or element.get("visible") == "false":
            pass
        elif number in elements:
            doubles.append(f"{element.tag} {number}")
        elif element.tag == "node":
            sample = sample or " ".join(f"{k}={v!r}" for k, v in element.items())[:200]
            nodes[number] = len(coordinates)
            coordinates.append(_coordinates(element))
        elif element.tag == "way":
            ways[number] = _way(number, element)
        else:
            relations[number] = _relation(number, element)
        element.clear()
    repairs = []
    if doubles:
        repairs.append(
            f"{len(doubles)} ids occur twice, the first element used: {shorten(doubles)}"
        )
    return Osm(
        path=path,
        nodes=nodes,
        coordinates=np.array(coordinates, dtype=np.float64).reshape(-1, len(COORDINATES)),
        sample=sample,
        ways=ways,
        relations=tuple(relations.values()),
        repairs=tuple(repairs),
    )


def _coordinates(element: ElementTree.Element) -> tuple[float, ...]:
    in_tags = _tags(element) if len(element) else {}
    texts = [element.get(name) or in_tags.get(name, "") for name in COORDINATES[:4]]
    texts += [in_tags.get(name, "") for name in COORDINATES[4:]]
    return tuple(_number(text) if text else np.nan for text in texts)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan


def _tags(element: ElementTree.Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iter("tag")}


def _way(number: str, element: ElementTree.Element) -> Way:
    references = tuple(reference.get("ref", "") for reference in element.iter("nd"))
    return Way(id=number, nodes=references, tags=_tags(element))


def _relation(number: str, element: ElementTree.Element) -> Relation:
    members = {
        kind: tuple(
            (member.get("role", ""), member.get("ref", ""))
            for member in element.iter("member")
            if member.get("type", "way") == kind
        )
        for kind in ("way", "relation")
    }
    return Relation(
        id=number, members=members["way"], relations=members["relation"], tags=_tags(element)
    )
