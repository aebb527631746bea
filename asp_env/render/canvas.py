"""A picture with its place in the world: subpixel drawing, y up, and see-through lines."""

from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8
from numba import njit

SHIFT = 4
"""OpenCV takes coordinates in sixteenths of a pixel."""

Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """Where a picture lies: its upper left corner in the world, and its scale."""

    left_m: float
    top_m: float
    pixels_per_metre: float
    width_px: int
    height_px: int

    def pixels(self, points: Shaped[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """(column, row) of points; whole numbers are corners of pixels."""
        offset = np.asarray(points, dtype=np.float64) - (self.left_m, self.top_m)
        return offset * (self.pixels_per_metre, -self.pixels_per_metre)

    def fixed(self, points: Shaped[np.ndarray, "*batch 2"]) -> Int[np.ndarray, "*batch 2"]:
        """The points as OpenCV takes them: its whole numbers are centres of pixels."""
        pixels = np.clip(self.pixels(points) - 0.5, -30_000, 30_000)
        return np.rint(pixels * (1 << SHIFT)).astype(np.int32)


class Canvas:
    """An RGB picture that is drawn on."""

    def __init__(self, frame: Frame, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Takes the picture over; it is drawn on in place."""
        self.frame = frame
        self.image = image
        self._mask = np.zeros(image.shape[:2], dtype=np.uint8)

    def fill(self, polygon: Int[np.ndarray, "corners 2"], colour: Colour) -> None:
        """A convex polygon, in fixed coordinates of the frame."""
        cv2.fillConvexPoly(self.image, polygon, colour, cv2.LINE_AA, SHIFT)

    def outline(self, polygon: Int[np.ndarray, "corners 2"], colour: Colour) -> None:
        """The edges of a polygon, one pixel wide, in fixed coordinates of the frame."""
        cv2.polylines(self.image, [polygon], True, colour, 1, cv2.LINE_AA, SHIFT)

    def stroke(self, lines: Shaped[np.ndarray, "n points 2"], alpha: float, width_px: int) -> None:
        """Polylines in metres for `blend` to colour; the last one drawn is on top."""
        fixed = list(self.frame.fixed(lines))
        level = round(255 * alpha)
        cv2.polylines(self._mask, fixed, False, level, width_px, cv2.LINE_AA, SHIFT)

    def dot(self, point: Shaped[np.ndarray, " 2"], alpha: float, radius_px: float) -> None:
        """A disc about a point in metres for `blend` to colour."""
        column, row = self.frame.fixed(point).tolist()
        radius = round(radius_px * (1 << SHIFT))
        cv2.circle(self._mask, (column, row), radius, round(255 * alpha), -1, cv2.LINE_AA, SHIFT)

    def blend(self, colour: Colour) -> None:
        """Colours what was stroked since the last time."""
        _blend(self.image, self._mask, *colour)

    def text(self, words: str, column_px: int, row_px: int, colour: Colour) -> None:
        """Words whose base line starts at a pixel."""
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(self.image, words, (column_px, row_px), font, 0.5, colour, 1, cv2.LINE_AA)


@njit(cache=True, nogil=True)
@no_type_check
def _blend(image, mask, red, green, blue):
    """Mixes a colour into the picture where the mask is set, and clears the mask."""
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            level = np.int32(mask[row, column])
            if level == 0:
                continue
            mask[row, column] = 0
            rest = 255 - level
            pixel = image[row, column]
            pixel[0] = (pixel[0] * rest + red * level + 127) // 255
            pixel[1] = (pixel[1] * rest + green * level + 127) // 255
            pixel[2] = (pixel[2] * rest + blue * level + 127) // 255
