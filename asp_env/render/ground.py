"""The static part of a frame: the map and the background image, drawn once and cached."""

from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from asp_env.data.recording import Background
from asp_env.data.road_map import LineType, Ragged, RoadMap
from asp_env.errors import DataError
from asp_env.geometry import arc_lengths, path_length, points_at
from asp_env.render.canvas import SHIFT, Colour, Viewport

GROUND_COLOUR: Colour = (22, 26, 32)
ROAD_COLOUR: Colour = (58, 67, 81)
LINE_COLOURS: dict[int, Colour] = {
    LineType.CURB: (118, 130, 148),
    LineType.SOLID: (150, 160, 175),
    LineType.DASHED: (132, 142, 158),
}
"""Virtual lines are not painted on the road and are not drawn."""
DASH_M = 1.5
MARKING_M = 0.1
"""Width of a marking where there is no background image, at least a pixel."""
MARGIN_M = 10.0
"""Width of the bare ground around a map."""
PHOTO_STRENGTH = 0.6
"""Weight of the background image against the colour of the ground, which darkens the image so that
agents stand out. Chosen by hand."""
MAX_PIXELS = 24_000_000
"""Size above which a map is not cached: its visible part is drawn for every frame. Limits the
cache to about 300 MB."""
CACHE_SIZE = 4
"""Number of maps and scales whose images are cached."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ground:
    viewport: Viewport
    image: UInt8[np.ndarray, "h w 3"]
    road_map: RoadMap
    """A reference that prevents another map from taking the id in the key of the cache."""


_cache: OrderedDict[tuple[int, Background | None, float], _Ground] = OrderedDict()


def draw_ground(
    road_map: RoadMap,
    background: Background | None,
    centre_m: tuple[float, float],
    pixels_per_metre: float,
    size_px: tuple[int, int],
) -> tuple[Viewport, UInt8[np.ndarray, "h w 3"]]:
    """Draws the ground around a point.

    All images of one map and scale lie on the same pixel grid: the ground of a video moves by whole
    pixels and does not flicker.

    Args:
        road_map: The map.
        background: A photograph that covers the drivable area.
        centre_m: The point in the middle, metres.
        pixels_per_metre: The scale.
        size_px: Width and height.

    Returns:
        The viewport, and a new image of it.

    Raises:
        DataError: The background image cannot be read.
    """
    left, low, right, high = road_map.extent_m
    whole = Viewport(
        left_m=left - MARGIN_M,
        top_m=high + MARGIN_M,
        pixels_per_metre=pixels_per_metre,
        width_px=int((right - left + 2 * MARGIN_M) * pixels_per_metre) + 1,
        height_px=int((high - low + 2 * MARGIN_M) * pixels_per_metre) + 1,
    )
    width, height = size_px
    corner = whole.to_pixels(np.array(centre_m)) - (width / 2, height / 2)
    column, row = (round(value) for value in corner.tolist())
    viewport = Viewport(
        left_m=whole.left_m + column / pixels_per_metre,
        top_m=whole.top_m - row / pixels_per_metre,
        pixels_per_metre=pixels_per_metre,
        width_px=width,
        height_px=height,
    )
    if whole.width_px * whole.height_px > MAX_PIXELS:
        return viewport, _draw(road_map, background, viewport)
    ground = _cached_ground(road_map, background, whole)
    return viewport, _crop(ground.image, column, row, width, height)


def _crop(
    image: UInt8[np.ndarray, "h w 3"], column: int, row: int, width: int, height: int
) -> UInt8[np.ndarray, "height width 3"]:
    """A copy of a part that may extend beyond the image."""
    top, bottom = (int(np.clip(edge, 0, image.shape[0])) for edge in (row, row + height))
    left, right = (int(np.clip(edge, 0, image.shape[1])) for edge in (column, column + width))
    if top == bottom or left == right:
        return np.full((height, width, 3), GROUND_COLOUR, dtype=np.uint8)
    above, before = max(-row, 0), max(-column, 0)
    return cv2.copyMakeBorder(
        image[top:bottom, left:right],
        above,
        height - above - (bottom - top),
        before,
        width - before - (right - left),
        cv2.BORDER_CONSTANT,
        value=GROUND_COLOUR,
    ).astype(np.uint8, copy=False)


def _cached_ground(road_map: RoadMap, background: Background | None, viewport: Viewport) -> _Ground:
    key = (id(road_map), background, viewport.pixels_per_metre)
    if key not in _cache:
        image = _draw(road_map, background, viewport)
        _cache[key] = _Ground(viewport=viewport, image=image, road_map=road_map)
        if len(_cache) > CACHE_SIZE:
            _cache.popitem(last=False)
    _cache.move_to_end(key)
    return _cache[key]


def _draw(
    road_map: RoadMap, background: Background | None, viewport: Viewport
) -> UInt8[np.ndarray, "h w 3"]:
    image = np.empty((viewport.height_px, viewport.width_px, 3), dtype=np.uint8)
    image[:] = GROUND_COLOUR
    road = _coverage(road_map.drivable, viewport)[..., None].astype(np.float32) / 255
    image[:] = np.rint(image * (1 - road) + np.array(ROAD_COLOUR, dtype=np.float32) * road)
    if background is not None:
        _draw_photo(background, viewport, image)
    thickness = 1 if background else max(1, round(MARKING_M * viewport.pixels_per_metre))
    for kind, colour in LINE_COLOURS.items():
        lines = [road_map.lines[int(i)] for i in np.flatnonzero(road_map.line_types == kind)]
        if kind == LineType.DASHED:
            lines = [dash for line in lines for dash in _dashes(line)]
        fixed = [viewport.to_fixed_point(line) for line in lines]
        cv2.polylines(image, fixed, False, colour, thickness, cv2.LINE_AA, SHIFT)
    return image


def _coverage(rings: Ragged, viewport: Viewport) -> UInt8[np.ndarray, "h w"]:
    """Share of each pixel that lies in any ring, 0 to 255.

    The rings are drawn without antialiasing at twice the size, then averaged: antialiasing each
    ring would leave seams between rings that touch.
    """
    twice = Viewport(
        left_m=viewport.left_m,
        top_m=viewport.top_m,
        pixels_per_metre=2 * viewport.pixels_per_metre,
        width_px=2 * viewport.width_px,
        height_px=2 * viewport.height_px,
    )
    mask = np.zeros((twice.height_px, twice.width_px), dtype=np.uint8)
    for number in range(len(rings)):
        cv2.fillPoly(mask, [twice.to_fixed_point(rings[number])], 255, cv2.LINE_8, SHIFT)
    size = (viewport.width_px, viewport.height_px)
    return cv2.resize(mask, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _draw_photo(
    background: Background, viewport: Viewport, image: UInt8[np.ndarray, "h w 3"]
) -> None:
    try:
        photo = cv2.imread(str(background.path), cv2.IMREAD_COLOR)
    except cv2.error:  # a header that claims more pixels than OpenCV reads
        photo = None
    if photo is None:
        raise DataError(
            f"{background.path}: not an image that can be read; copy it again or remove it"
        )
    photo = cv2.cvtColor(photo, cv2.COLOR_BGR2RGB)
    dark = (1 - PHOTO_STRENGTH) * np.array(GROUND_COLOUR)
    photo = np.rint(PHOTO_STRENGTH * photo + dark).astype(np.uint8)
    scale = background.metres_per_pixel * viewport.pixels_per_metre
    if scale < 1:
        size = [max(1, round(side * scale)) for side in photo.shape[1::-1]]
        resized = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
        scale *= photo.shape[1] / resized.shape[1]
        photo = resized
    corner = viewport.to_pixels(np.zeros(2))
    # Whole numbers are centres of pixels in OpenCV, and corners of pixels in the viewport.
    shift = corner + 0.5 * (scale - 1)
    matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    size = (viewport.width_px, viewport.height_px)
    border = cv2.BORDER_TRANSPARENT
    cv2.warpAffine(photo, matrix, size, image, flags=cv2.INTER_LINEAR, borderMode=border)


def _dashes(line: np.ndarray) -> list[np.ndarray]:
    """Pieces of a polyline of `DASH_M`, with gaps of the same length."""
    length = float(path_length(line))
    arc = arc_lengths(line)
    pieces = []
    for start in np.arange(0.0, length, 2 * DASH_M):
        end = min(start + DASH_M, length)
        inner = arc[(arc > start) & (arc < end)]
        stops = np.concatenate([[start], inner, [end]])
        pieces.append(points_at(line, arc, stops))
    return pieces
