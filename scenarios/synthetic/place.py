"""A place: its roads as SUMO knows them, its map and its picture, in the recording's frame."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scenarios.lanelet2 import Area, Border, Lanelet, to_degrees, write_map
from scenarios.synthetic.junctions import crossroads, t_junction
from scenarios.synthetic.picture import draw, write_picture
from scenarios.synthetic.roundabouts import roundabout, two_lane_roundabout
from scenarios.synthetic.site import Site
from scenarios.synthetic.sumo import build_network
from scenarios.synthetic.surface import lanelets

SITES: dict[str, tuple[Callable[[np.random.Generator], Site], ...]] = {
    "intersection": (crossroads, t_junction),
    "roundabout": (roundabout, two_lane_roundabout),
}
"""Kinds of place of a site; locations take them in turn."""
JOIN_M = 0.06
"""So near to each other netconvert's lines end that are to meet."""

_NEAR_AACHEN_UTM_M = (294_000.0, 5_628_000.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Where recordings are made. The recording's frame has its origin top left, y up."""

    site: Site
    folder: Path
    """Holds `net.xml`."""
    shift_m: Float[np.ndarray, " 2"]
    """Add this to a point around the site's middle to get the recording's frame."""
    origin_utm_m: tuple[float, float]
    strips: list[Lanelet]
    corners: list[np.ndarray]
    parking: Float[np.ndarray, "lots 4 2"]
    trees: Float[np.ndarray, "trees 3"]

    @property
    def lat_lon_deg(self) -> tuple[float, float]:
        """Where in the world its middle is."""
        middle = self.shift_m[None] + np.array(self.origin_utm_m)
        lat, lon = to_degrees(middle)[0]
        return float(lat), float(lon)

    def write_picture(self, path: Path) -> None:
        """Writes the background image."""
        width, height = (2.0 * half for half in self.site.half_size_m)
        image = draw(self.strips, self.corners, self.parking, self.trees, size_m=(width, height))
        write_picture(path, image)

    def write_map(self, path: Path) -> None:
        """Writes the lanelet2 map."""
        lots = [np.concatenate([lot, lot[:1]]) for lot in self.parking]
        areas = [
            Area(subtype="parking", outer=(Border(line=lot, marking="virtual"),)) for lot in lots
        ]
        write_map(path, self.strips, areas, origin_utm_m=self.origin_utm_m, join_m=JOIN_M)


def make_place(rng: np.random.Generator, site: Site, folder: Path) -> Place:
    """Builds a site's roads in `folder` and lays them into a recording's frame."""
    folder.mkdir(parents=True)
    network = build_network(site, folder)
    shift = np.array([site.half_size_m[0], -site.half_size_m[1]])
    limit = site.speed_limit_mps
    strips = [_moved(strip, shift, limit) for strip in lanelets(network, site.half_size_m)]
    corners = [corner + shift for corner in network.corners]
    parking = site.parking + shift
    east, north = np.array(_NEAR_AACHEN_UTM_M) + np.round(rng.uniform(0.0, 3000.0, 2), 2)
    return Place(
        site=site,
        folder=folder,
        shift_m=shift,
        origin_utm_m=(float(east), float(north)),
        strips=strips,
        corners=corners,
        parking=parking,
        trees=_trees(rng, strips, parking, 2.0 * np.array(site.half_size_m)),
    )


def _moved(strip: Lanelet, shift: np.ndarray, speed_limit_mps: float) -> Lanelet:
    left, right = (
        tuple(Border(line=border.line + shift, marking=border.marking) for border in side)
        for side in (strip.left, strip.right)
    )
    limit = speed_limit_mps if strip.subtype == "road" else None
    return Lanelet(subtype=strip.subtype, left=left, right=right, speed_limit_mps=limit)


def _trees(
    rng: np.random.Generator, strips: list[Lanelet], parking: np.ndarray, size_m: np.ndarray
) -> Float[np.ndarray, "trees 3"]:
    """Trees [x, y, radius] on the grass, clear of roads, pavements and parking."""
    lots = [np.concatenate([lot, lot.mean(axis=0)[None]]) for lot in parking]
    taken = np.concatenate([*(strip.outline for strip in strips), *lots])
    spots = rng.uniform(0.0, 1.0, (60, 2)) * size_m * np.array([1.0, -1.0])
    radii = rng.uniform(1.2, 2.8, 60)
    gaps = np.hypot(*(spots[:, None] - taken[None]).transpose(2, 0, 1)).min(axis=1)
    clear = gaps > radii + 5.0
    return np.column_stack([spots, radii])[clear]
