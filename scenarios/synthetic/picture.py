"""A view of the place from above, drawn from the same strips as the map."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from scenarios.lanelet2 import Lanelet
from scenarios.polylines import Polyline, dense

METRES_PER_ORTHO_PIXEL = 0.01
DOWNSCALE = 12
"""The picture is this much coarser than the orthophoto that the metadata speak of."""
METRES_PER_PIXEL = METRES_PER_ORTHO_PIXEL * DOWNSCALE

_GRASS, _PAVEMENT, _KERB = (104, 148, 118), (176, 178, 180), (205, 207, 208)
_ASPHALT, _PAINT, _LOT = (98, 94, 92), (235, 238, 238), (128, 124, 122)
_SUBPIXEL_BITS = 4
_SHADES = 8


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
    """Grass, pavements, kerbs, asphalt and paint; the origin is the top left corner."""
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
    """Writes a small PNG: smoothed edges have few shades, which nobody sees."""
    settings = (cv2.IMWRITE_PNG_COMPRESSION, 9)
    strategy = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT)
    encoded = cv2.imencode(".png", image // _SHADES * _SHADES, [*settings, *strategy])[1]
    path.write_bytes(encoded.tobytes())
