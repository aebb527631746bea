"""What does not move: the map and the picture of the place, drawn once and kept."""

from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from asp_env.data.recording import Background
from asp_env.data.road_map import LineType, Ragged, RoadMap
from asp_env.errors import DataError
from asp_env.geometry import arc_lengths, path_length, points_at
from asp_env.render.canvas import SHIFT, Colour, Frame

GROUND: Colour = (22, 26, 32)
ROAD: Colour = (58, 67, 81)
LINE_COLOURS: dict[int, Colour] = {
    LineType.CURB: (118, 130, 148),
    LineType.SOLID: (150, 160, 175),
    LineType.DASHED: (132, 142, 158),
}
"""Virtual lines mark nothing on the road and are not drawn."""
DASH_M = 1.5
MARKING_M = 0.1
"""Width of a marking where there is no photograph, if that is more than a pixel."""
MARGIN_M = 10.0
PHOTO_STRENGTH = 0.6
"""A photograph is darkened, so that what moves stands out."""
MAX_PIXELS = 24_000_000
"""A map that would be larger is drawn anew for each frame, as far as it shows."""
KEPT = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ground:
    frame: Frame
    image: UInt8[np.ndarray, "h w 3"]
    road_map: RoadMap
    """Held, so that its id is nobody else's as long as the picture is kept."""


_kept: OrderedDict[tuple[int, Background | None, float], _Ground] = OrderedDict()


def draw_ground(
    road_map: RoadMap,
    background: Background | None,
    centre_m: tuple[float, float],
    pixels_per_metre: float,
    size_px: tuple[int, int],
) -> tuple[Frame, UInt8[np.ndarray, "h w 3"]]:
    """A fresh picture of the ground about a point, and where it lies.

    Its pixels are those of one lattice per map and scale, so that the ground of a film moves by
    whole pixels and does not flicker.

    Raises:
        DataError: the background picture cannot be read.
    """
    left, low, right, high = road_map.extent_m
    whole = Frame(
        left_m=left - MARGIN_M,
        top_m=high + MARGIN_M,
        pixels_per_metre=pixels_per_metre,
        width_px=int((right - left + 2 * MARGIN_M) * pixels_per_metre) + 1,
        height_px=int((high - low + 2 * MARGIN_M) * pixels_per_metre) + 1,
    )
    width, height = size_px
    corner = whole.pixels(np.array(centre_m)) - (width / 2, height / 2)
    column, row = (round(at) for at in corner.tolist())
    window = Frame(
        left_m=whole.left_m + column / pixels_per_metre,
        top_m=whole.top_m - row / pixels_per_metre,
        pixels_per_metre=pixels_per_metre,
        width_px=width,
        height_px=height,
    )
    if whole.width_px * whole.height_px > MAX_PIXELS:
        return window, _draw(road_map, background, window)
    ground = _keep(road_map, background, whole)
    return window, _crop(ground.image, column, row, width, height)


def _crop(
    image: UInt8[np.ndarray, "h w 3"], column: int, row: int, width: int, height: int
) -> UInt8[np.ndarray, "height width 3"]:
    """A copy of a part of the picture, which may reach beyond it."""
    top, bottom = (int(np.clip(at, 0, image.shape[0])) for at in (row, row + height))
    left, right = (int(np.clip(at, 0, image.shape[1])) for at in (column, column + width))
    if top == bottom or left == right:
        return np.full((height, width, 3), GROUND, dtype=np.uint8)
    above, before = max(-row, 0), max(-column, 0)
    return cv2.copyMakeBorder(
        image[top:bottom, left:right],
        above,
        height - above - (bottom - top),
        before,
        width - before - (right - left),
        cv2.BORDER_CONSTANT,
        value=GROUND,
    ).astype(np.uint8, copy=False)


def _keep(road_map: RoadMap, background: Background | None, frame: Frame) -> _Ground:
    key = (id(road_map), background, frame.pixels_per_metre)
    if key not in _kept:
        image = _draw(road_map, background, frame)
        _kept[key] = _Ground(frame=frame, image=image, road_map=road_map)
        if len(_kept) > KEPT:
            _kept.popitem(last=False)
    _kept.move_to_end(key)
    return _kept[key]


def _draw(
    road_map: RoadMap, background: Background | None, frame: Frame
) -> UInt8[np.ndarray, "h w 3"]:
    image = np.empty((frame.height_px, frame.width_px, 3), dtype=np.uint8)
    image[:] = GROUND
    road = _coverage(road_map.drivable, frame)[..., None].astype(np.float32) / 255
    image[:] = np.rint(image * (1 - road) + np.array(ROAD, dtype=np.float32) * road)
    if background is not None:
        _draw_photo(background, frame, image)
    thickness = 1 if background else max(1, round(MARKING_M * frame.pixels_per_metre))
    for kind, colour in LINE_COLOURS.items():
        lines = [road_map.lines[int(i)] for i in np.flatnonzero(road_map.line_types == kind)]
        if kind == LineType.DASHED:
            lines = [dash for line in lines for dash in _dashes(line)]
        fixed = [frame.fixed(line) for line in lines]
        cv2.polylines(image, fixed, False, colour, thickness, cv2.LINE_AA, SHIFT)
    return image


def _coverage(rings: Ragged, frame: Frame) -> UInt8[np.ndarray, "h w"]:
    """How much of each pixel lies in any ring, 0 to 255.

    Drawn hard at twice the size, then averaged: soft edges each would leave seams between rings
    that touch.
    """
    twice = Frame(
        left_m=frame.left_m,
        top_m=frame.top_m,
        pixels_per_metre=2 * frame.pixels_per_metre,
        width_px=2 * frame.width_px,
        height_px=2 * frame.height_px,
    )
    mask = np.zeros((twice.height_px, twice.width_px), dtype=np.uint8)
    for number in range(len(rings)):
        cv2.fillPoly(mask, [twice.fixed(rings[number])], 255, cv2.LINE_8, SHIFT)
    size = (frame.width_px, frame.height_px)
    return cv2.resize(mask, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _draw_photo(background: Background, frame: Frame, image: UInt8[np.ndarray, "h w 3"]) -> None:
    photo = cv2.imread(str(background.path), cv2.IMREAD_COLOR)
    if photo is None:
        raise DataError(f"{background.path}: not a picture that can be read")
    photo = cv2.cvtColor(photo, cv2.COLOR_BGR2RGB)
    dark = (1 - PHOTO_STRENGTH) * np.array(GROUND)
    photo = np.rint(PHOTO_STRENGTH * photo + dark).astype(np.uint8)
    scale = background.metres_per_pixel * frame.pixels_per_metre
    if scale < 1:
        size = [max(1, round(side * scale)) for side in photo.shape[1::-1]]
        resized = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
        scale *= photo.shape[1] / resized.shape[1]
        photo = resized
    corner = frame.pixels(np.zeros(2))
    # Half a pixel each way: OpenCV counts from the centre of a pixel, the frame from its corner.
    shift = corner + 0.5 * (scale - 1)
    matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    size = (frame.width_px, frame.height_px)
    border = cv2.BORDER_TRANSPARENT
    cv2.warpAffine(photo, matrix, size, image, flags=cv2.INTER_LINEAR, borderMode=border)


def _dashes(line: np.ndarray) -> list[np.ndarray]:
    """Pieces of a polyline, `DASH_M` long and as far apart."""
    length = float(path_length(line))
    arc = arc_lengths(line)
    pieces = []
    for start in np.arange(0.0, length, 2 * DASH_M):
        end = min(start + DASH_M, length)
        inner = arc[(arc > start) & (arc < end)]
        at = np.concatenate([[start], inner, [end]])
        pieces.append(points_at(line, arc, at))
    return pieces
