"""A location: the roads of a site in a recording's frame, with its map and its background image."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from asp_env.errors import AspEnvError
from scenarios.lanelet2 import Area, Border, Lanelet, to_degrees, write_map
from scenarios.polylines import Polyline, dense
from scenarios.sumo.demand import Mix, Traffic, usual_mix
from scenarios.sumo.network import build_network, is_sound, lanelets, narrowest_lane_m
from scenarios.sumo.sites import (
    Site,
    crossroads,
    roundabout,
    t_junction,
    two_lane_roundabout,
)
from scenarios.sumo.varied_map import draw_map
from scenarios.sumo.varied_mix import varied_mix
from scenarios.sumo.varied_sites import varied_intersection, varied_roundabout

METRES_PER_ORTHO_PIXEL = 0.01
DOWNSCALE = 12
"""The image is coarser by this factor than the orthophoto that the metadata describe."""
METRES_PER_PIXEL = METRES_PER_ORTHO_PIXEL * DOWNSCALE

_GRASS, _PAVEMENT, _KERB = (104, 148, 118), (176, 178, 180), (205, 207, 208)
_ASPHALT, _PAINT, _LOT = (98, 94, 92), (235, 238, 238), (128, 124, 122)
_SUBPIXEL_BITS = 4
_SHADES = 8

SITES: dict[str, tuple[Callable[[np.random.Generator], Site], ...]] = {
    "intersection": (crossroads, t_junction),
    "roundabout": (roundabout, two_lane_roundabout),
}
"""Kinds of junction of a site; locations use them in turn."""

DENSE_SITES = {
    "intersection": (partial(crossroads, left_lanes=True), partial(t_junction, left_lanes=True)),
    "roundabout": (roundabout, partial(two_lane_roundabout, leave_inside=True)),
}
"""The same for dense traffic."""

VARIED_SITES = {"intersection": (varied_intersection,), "roundabout": (varied_roundabout,)}
"""The same for varied traffic."""

_SITES_OF: dict[Traffic, dict[str, tuple[Callable[[np.random.Generator], Site], ...]]] = {
    "normal": SITES,
    "dense": DENSE_SITES,
    "varied": VARIED_SITES,
}


def draw_site(
    rng: np.random.Generator, name: str, traffic: Traffic, location: int, scratch: Path
) -> Site:
    """The junction of a location; the kinds of a site take turns.

    Args:
        rng: draws the junction.
        name: `intersection` or `roundabout`.
        traffic: `normal`, `dense` or `varied`. Varied junctions are drawn until one is sound.
        location: number of the location.
        scratch: folder in which junctions are tried.

    Raises:
        AspEnvError: no sound junction was found.
    """
    kinds = _SITES_OF[traffic][name]
    draw = kinds[location % len(kinds)]
    if traffic != "varied":
        return draw(rng)
    for attempt in range(_MOST_ATTEMPTS):
        site, folder = draw(rng), scratch / f"attempt{attempt}"
        folder.mkdir(parents=True)
        if is_sound(build_network(site, folder)):
            return site
    raise AspEnvError(
        f"location {location}: none of {_MOST_ATTEMPTS} junctions drawn has roads without kinks; "
        "choose another seed"
    )


_MOST_ATTEMPTS = 50

JOIN_M = 0.06
"""Ends of netconvert's lines that are nearer than this belong together."""

_NEAR_AACHEN_UTM_M = (294_000.0, 5_628_000.0)


def _pixels(line: np.ndarray) -> np.ndarray:
    scaled = line * np.array([1.0, -1.0]) / METRES_PER_PIXEL * 2**_SUBPIXEL_BITS
    return np.round(scaled).astype(np.int32)


def draw(
    lanelets: list[Lanelet],
    corners: list[Polyline],
    parking: np.ndarray,
    trees: np.ndarray,
    *,
    size_m: tuple[float, float],
) -> UInt8[np.ndarray, "h w 3"]:
    """Renders the background image: grass, pavements, kerbs, asphalt and markings.

    Args:
        lanelets: of the location.
        corners: outlines of the pavement at junctions.
        parking: (lots, 4, 2) corners of parking lots, m.
        trees: (trees, 3) [x, y, radius], m.
        size_m: (width, height).

    Returns:
        (h, w, 3) image, BGR; the origin of the frame is the top left corner.
    """
    width, height = (round(side / METRES_PER_PIXEL) for side in size_m)
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[:] = _GRASS
    walkways = [lanelet.outline for lanelet in lanelets if lanelet.subtype == "walkway"]
    roads = [lanelet.outline for lanelet in lanelets if lanelet.subtype == "road"]
    for lot in parking:
        _fill(image, lot, _LOT)
        middle = lot.mean(axis=0)
        _fill(image, middle + 1.0 * (lot - middle), _LOT)
    for outline in [*walkways, *corners]:
        _fill(image, outline, _PAVEMENT)
    for outline in roads:
        _stroke(image, np.concatenate([outline, outline[:1]]), _KERB, 4)
    for outline in roads:
        _fill(image, outline, _ASPHALT)
    for lanelet in lanelets:
        if lanelet.subtype == "crosswalk":
            _zebra(image, lanelet)
        if lanelet.subtype == "road" and lanelet.left[0].marking == "dashed":
            _dashes(image, lanelet.left_line)
    for x, y, radius in trees:
        centre = _pixels(np.array([x, y]))
        size = round(radius / METRES_PER_PIXEL * 2**_SUBPIXEL_BITS)
        for share, colour in ((1.0, (72, 112, 84)), (0.7, (80, 124, 92)), (0.35, (90, 134, 102))):
            at = (int(centre[0]), int(centre[1]))
            cv2.circle(image, at, int(share * size), colour, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    return image


def _fill(image: np.ndarray, outline: Polyline, colour: tuple[int, int, int]) -> None:
    cv2.fillPoly(image, [_pixels(outline)], colour, cv2.LINE_AA, _SUBPIXEL_BITS)


def _stroke(
    image: np.ndarray, line: Polyline, colour: tuple[int, int, int], thickness: int
) -> None:
    cv2.polylines(image, [_pixels(line)], False, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def _dashes(image: np.ndarray, line: Polyline) -> None:
    points = dense(line, 0.5)
    for start in range(0, len(points) - 6, 18):
        _stroke(image, points[start : start + 7], _PAINT, 1)


def _zebra(image: np.ndarray, lanelet: Lanelet) -> None:
    left, right = dense(lanelet.left_line, 0.5), dense(lanelet.right_line, 0.5)
    count = min(len(left), len(right)) - 1
    for i in range(0, count, 2):
        stripe = np.stack([left[i], left[i + 1], right[i + 1], right[i]])
        _fill(image, stripe, _PAINT)


def write_picture(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Writes a small PNG: the number of shades is reduced."""
    settings = (cv2.IMWRITE_PNG_COMPRESSION, 9, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE)
    strategy = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_FILTERED)
    encoded = cv2.imencode(".png", image // _SHADES * _SHADES, [*settings, *strategy])[1]
    path.write_bytes(encoded.tobytes())


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A location with its roads. The recording's frame has its origin top left, y up."""

    site: Site
    folder: Path
    """Holds `net.xml`."""
    shift_m: Float[np.ndarray, " 2"]
    """Offset from coordinates around the site's centre to the recording's frame."""
    origin_utm_m: tuple[float, float]
    strips: list[Lanelet]
    """The lanelets of the roads as they are."""
    mapped: list[Lanelet]
    """The lanelets as the map shows them."""
    mapped_parking: Float[np.ndarray, "lots 4 2"]
    mix: Mix
    """From what the agents are drawn."""
    corners: list[np.ndarray]
    parking: Float[np.ndarray, "lots 4 2"]
    trees: Float[np.ndarray, "trees 3"]

    @property
    def lat_lon_deg(self) -> tuple[float, float]:
        """Latitude and longitude of the centre."""
        middle = self.shift_m[None] + np.array(self.origin_utm_m)
        lat, lon = to_degrees(middle)[0]
        return float(lat), float(lon)

    def write_picture(self, path: Path) -> None:
        width, height = (2.0 * half for half in self.site.half_size_m)
        image = draw(self.strips, self.corners, self.parking, self.trees, size_m=(width, height))
        write_picture(path, image)

    def write_map(self, path: Path) -> None:
        lots = [np.concatenate([lot, lot[:1]]) for lot in self.mapped_parking]
        areas = [
            Area(subtype="parking", outer=(Border(line=lot, marking="virtual"),)) for lot in lots
        ]
        write_map(path, self.mapped, areas, origin_utm_m=self.origin_utm_m, join_m=JOIN_M)


def make_place(
    rng: np.random.Generator, site: Site, folder: Path, *, traffic: Traffic = "normal"
) -> Place:
    """Builds the roads of a site in `folder` and converts them to a recording's frame.

    Args:
        rng: draws the UTM origin and the trees; in varied traffic also mix and style of the map.
        site: the site.
        folder: folder to create.
        traffic: `normal`, `dense` or `varied`.
    """
    folder.mkdir(parents=True)
    network = build_network(site, folder)
    shift = np.array([site.half_size_m[0], -site.half_size_m[1]])
    built = lanelets(network, site.half_size_m)
    strips = [_moved(strip, shift, site.speed_limit_mps) for strip in built]
    corners = [corner + shift for corner in network.corners]
    parking = site.parking + shift
    east, north = np.array(_NEAR_AACHEN_UTM_M) + np.round(rng.uniform(0.0, 3000.0, 2), 2)
    trees = _trees(rng, strips, parking, 2.0 * np.array(site.half_size_m))
    mapped, mapped_parking, mix = strips, parking, None
    if traffic == "varied":
        mix = varied_mix(rng, narrowest_m=narrowest_lane_m(network), tight=site.tight)
        own_limits = [_moved(strip, shift, strip.speed_limit_mps) for strip in built]
        mapped, mapped_parking = draw_map(rng, own_limits, parking, middle=shift)
    return Place(
        site=site,
        folder=folder,
        shift_m=shift,
        origin_utm_m=(float(east), float(north)),
        strips=strips,
        mapped=mapped,
        mapped_parking=mapped_parking,
        mix=mix or usual_mix(site.kind, traffic),
        corners=corners,
        parking=parking,
        trees=trees,
    )


def _moved(strip: Lanelet, shift: np.ndarray, speed_limit_mps: float | None) -> Lanelet:
    left, right = (
        tuple(Border(line=border.line + shift, marking=border.marking) for border in side)
        for side in (strip.left, strip.right)
    )
    limit = speed_limit_mps if strip.subtype == "road" else None
    return Lanelet(subtype=strip.subtype, left=left, right=right, speed_limit_mps=limit)


def _trees(
    rng: np.random.Generator, strips: list[Lanelet], parking: np.ndarray, size_m: np.ndarray
) -> Float[np.ndarray, "trees 3"]:
    """Trees [x, y, radius] on the grass, clear of roads, pavements and parking lots."""
    lots = [np.concatenate([lot, lot.mean(axis=0)[None]]) for lot in parking]
    taken = np.concatenate([*(strip.outline for strip in strips), *lots])
    spots = rng.uniform(0.0, 1.0, (60, 2)) * size_m * np.array([1.0, -1.0])
    radii = rng.uniform(1.2, 2.8, 60)
    gaps = np.hypot(*(spots[:, None] - taken[None]).transpose(2, 0, 1)).min(axis=1)
    clear = gaps > radii + 5.0
    return np.column_stack([spots, radii])[clear]
