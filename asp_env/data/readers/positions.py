"""Positions of a map's nodes in the metric frame of a recording.

Nodes have degrees, or metres in that frame: in files called `.osm_xy`, or in the tags `local_x` and
`local_y`. Nodes without a position, or far from all others, are left out and reported.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from pyproj import Transformer

from asp_env.data.readers.layout import shorten
from asp_env.data.readers.osm import Osm, Way
from asp_env.errors import DataError

FAR_M = 100_000.0
"""A map whose median node is farther than this from its recordings' origin belongs to another
location, and a node farther than this from the median node is wrong. Chosen by hand."""

ALONE_M = 200.0
"""A node without any other node within this distance, at another position, is wrong: the bounds of
a lane lie some metres apart. Chosen by hand."""

SYSTEMS: Mapping[str, tuple[int, int]] = {"degrees": (0, 1), "x, y": (2, 3), "local": (4, 5)}
"""Columns of `osm.COORDINATES` that make a position."""

_NAMES = {
    "degrees": "lat and lon",
    "x, y": "x and y in metres",
    "local": "the tags local_x and local_y",
}


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


def to_local(
    latitudes_deg: Float[np.ndarray, " n"], longitudes_deg: Float[np.ndarray, " n"], origin: Origin
) -> Float[np.ndarray, "n 2"]:
    """Converts latitudes and longitudes to positions (n, 2) in a local frame, metres."""
    utm = Transformer.from_crs(4326, origin.epsg, always_xy=True)
    x_m, y_m = utm.transform(longitudes_deg, latitudes_deg)
    return np.stack([np.asarray(x_m) - origin.x_m, np.asarray(y_m) - origin.y_m], axis=-1)


def locate_nodes(osm: Osm, origin: Origin, repairs: list[str]) -> dict[str, np.ndarray]:
    """The position of each node that a way uses, metres.

    Args:
        osm: the file's content.
        origin: the recording's frame.
        repairs: what is left out or guessed is added.

    Raises:
        DataError: most nodes have no position, or the map lies at another location.
    """
    used = {node for way in osm.ways.values() for node in way.nodes}
    names = [node for node in osm.nodes if node in used]
    if not names:
        return {}
    coordinates = osm.coordinates[[osm.nodes[name] for name in names]]
    local = osm.path.suffix.lower() == ".osm_xy"
    usual = "x, y" if local else "degrees"
    found = {
        system: positions
        for system in (usual, *(each for each in SYSTEMS if each != usual))
        if _is_usable(positions := _positions(coordinates, system, origin))
    }
    if not found:
        raise DataError(
            f"{osm.path}: its {len(names)} nodes have no positions (the first has {osm.sample}); "
            "expected lat and lon in degrees with a decimal point, at different places, or the "
            "tags local_x and local_y in metres: put the right file in its place"
        )
    system = next(iter(found))
    if system == "degrees" and "local" in found and _median_m(found["degrees"]) >= FAR_M:
        system = "local" if _median_m(found["local"]) < FAR_M else system
    positions = found[system]
    if system != usual:
        repairs.append(f"{len(names)} nodes are at {_NAMES[system]}, not at {_NAMES[usual]}")
    present = np.asarray(np.isfinite(positions).all(axis=1))
    if not present.all():
        _leave_out(repairs, names, ~present, "without a valid position")
    if _median_m(positions) >= FAR_M:
        raise _another_place(osm, coordinates, system, origin)
    alone = present & _alone(positions)
    if alone.any():
        _leave_out(repairs, names, alone, f"farther than {ALONE_M:g} m from all others")
    chosen = np.flatnonzero(present & ~alone)
    return {names[row]: positions[row] for row in chosen.tolist()}


def complete_ways(
    ways: Iterable[Way], points: Mapping[str, np.ndarray], repairs: list[str]
) -> dict[str, Way]:
    """Ways by id without the nodes that have no position; ways with fewer than two are left out.

    Args:
        ways: the ways of the file.
        points: positions of nodes.
        repairs: what is left out is added.
    """
    complete: dict[str, Way] = {}
    patched: list[str] = []
    dropped: list[str] = []
    for way in ways:
        present = tuple(node for node in way.nodes if node in points)
        distinct = tuple(node for i, node in enumerate(present) if i == 0 or node != present[i - 1])
        if len(distinct) < 2:
            dropped.append(way.id)
            continue
        if len(present) < len(way.nodes):
            patched.append(way.id)
        complete[way.id] = Way(id=way.id, nodes=distinct, tags=way.tags)
    if patched:
        repairs.append(f"{len(patched)} ways refer to missing nodes: {shorten(patched)}")
    if dropped:
        repairs.append(
            f"{len(dropped)} ways with fewer than two nodes left out: {shorten(dropped)}"
        )
    return complete


def _positions(
    coordinates: Float[np.ndarray, "n 6"], system: str, origin: Origin
) -> Float[np.ndarray, "n 2"]:
    """Positions in the frame, metres; NaN for nodes without one."""
    first, second = coordinates[:, SYSTEMS[system]].T
    if system != "degrees":
        positions = np.stack([first, second], axis=-1)
    else:
        possible = (np.abs(first) <= 90) & (np.abs(second) <= 180)
        if possible.any() and np.hypot(*np.median(coordinates[possible, :2], axis=0)) > 1.0:
            possible &= (first != 0) & (second != 0)  # zeros stand for missing values
        positions = np.full((len(first), 2), np.nan)
        if possible.any():
            positions[possible] = to_local(first[possible], second[possible], origin)
    positions[~np.isfinite(positions).all(axis=1)] = np.nan
    return positions


def _is_usable(positions: Float[np.ndarray, "n 2"]) -> bool:
    """Whether at least half of the nodes have positions, and not all the same."""
    present = positions[np.isfinite(positions).all(axis=1)]
    return 2 * len(present) >= len(positions) and len(np.unique(present, axis=0)) > 1


def _median_m(positions: Float[np.ndarray, "n 2"]) -> float:
    return math.hypot(*np.nanmedian(positions, axis=0))


def _alone(positions: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Mask of the nodes far from all others; none if this holds for half of them."""
    offsets = positions - np.nanmedian(positions, axis=0)
    far = np.isfinite(offsets).all(axis=1) & (np.hypot(*offsets.T) > FAR_M)
    near = np.isfinite(offsets).all(axis=1) & ~far
    places, place = np.unique(offsets[near], axis=0, return_inverse=True)
    cells = np.floor(places / ALONE_M).astype(np.int64)
    keys = cells[:, 0] * (1 << 20) + cells[:, 1]
    occupied, counts = np.unique(keys, return_counts=True)
    around = np.zeros(len(keys), dtype=np.int64)
    for step in (row * (1 << 20) + column for row in (-1, 0, 1) for column in (-1, 0, 1)):
        at = np.minimum(np.searchsorted(occupied, keys + step), len(occupied) - 1)
        around += np.where(occupied[at] == keys + step, counts[at], 0)
    alone = far
    alone[near] = around[place.ravel()] == 1
    return alone if 2 * alone.sum() < len(positions) else np.zeros_like(alone)


def _leave_out(
    repairs: list[str], names: list[str], chosen: Bool[np.ndarray, " n"], why: str
) -> None:
    ids = [names[row] for row in np.flatnonzero(chosen).tolist()]
    repairs.append(f"{len(ids)} nodes {why} left out: {shorten(ids)}")


def _another_place(
    osm: Osm, coordinates: Float[np.ndarray, "n 6"], system: str, origin: Origin
) -> DataError:
    middle = np.nanmedian(coordinates[:, SYSTEMS[system]], axis=0)
    unit = "" if system == "degrees" else " (metres)"
    longitude_deg, latitude_deg = Transformer.from_crs(origin.epsg, 4326, always_xy=True).transform(
        origin.x_m, origin.y_m
    )
    return DataError(
        f"{osm.path}: lies at about {middle[0]:.4f}, {middle[1]:.4f}{unit}, expected it at its "
        f"recordings' origin, which is at {latitude_deg:.4f}, {longitude_deg:.4f} (degrees; "
        f"x {origin.x_m:,.0f} m, y {origin.y_m:,.0f} m in the UTM zone of "
        f"{origin.latitude_deg:.4f}, {origin.longitude_deg:.4f}, from recordingMeta.csv, or "
        "meta_data.csv in the tracks' folder): correct the origin, or put the right file in its "
        "place"
    )
