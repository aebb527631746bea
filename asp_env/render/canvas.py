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

SHADE: Colour = (14, 17, 22)
FONT = cv2.FONT_HERSHEY_SIMPLEX
TEXT_SCALE = 0.55
REFERENCE_PX = 720
"""Lines and words are sized for a picture whose smaller side is this, and grow with larger ones."""


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
    """An RGB picture that is drawn on.

    Places in the world are in metres. Widths, radii and the places of words and fields are in
    units of `unit` pixels, so that they look the same in pictures of every size.
    """

    def __init__(self, frame: Frame, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Takes the picture over; it is drawn on in place."""
        self.frame = frame
        self.image = image
        self.small_side_px = min(image.shape[:2])
        self.unit = max(1.0, self.small_side_px / REFERENCE_PX)
        self.height, self.width = (side / self.unit for side in image.shape[:2])
        self._mask = _new_mask(*image.shape[:2])

    def fill(self, polygon: Int[np.ndarray, "corners 2"], colour: Colour) -> None:
        """A convex polygon, in fixed coordinates of the frame."""
        cv2.fillConvexPoly(self.image, polygon, colour, cv2.LINE_AA, SHIFT)

    def outline(self, polygon: Int[np.ndarray, "corners 2"], colour: Colour) -> None:
        """The edges of a polygon, one unit wide, in fixed coordinates of the frame."""
        thickness = round(self.unit)
        cv2.polylines(self.image, [polygon], True, colour, thickness, cv2.LINE_AA, SHIFT)

    def stroke(self, lines: Shaped[np.ndarray, "n points 2"], alpha: float, width: float) -> None:
        """Polylines in metres for `blend` to colour; the last one drawn is on top."""
        fixed, thickness = list(self.frame.fixed(lines)), max(1, round(width * self.unit))
        cv2.polylines(self._mask, fixed, False, round(255 * alpha), thickness, cv2.LINE_AA, SHIFT)

    def dot(self, point: Shaped[np.ndarray, " 2"], alpha: float, radius: float) -> None:
        """A disc about a point in metres for `blend` to colour."""
        column, row = self.frame.fixed(point).tolist()
        size = round(radius * self.unit * (1 << SHIFT))
        cv2.circle(self._mask, (column, row), size, round(255 * alpha), -1, cv2.LINE_AA, SHIFT)

    def blend(self, colour: Colour) -> None:
        """Colours what was stroked since the last time."""
        self._blend(self._mask, 0, 0, colour)

    def _blend(self, mask: UInt8[np.ndarray, "h w"], top: int, left: int, colour: Colour) -> None:
        _mix(self.image, mask, mask.view(np.uint64), top, left, *colour)

    def field(self, left: float, top: float, right: float, bottom: float, colour: Colour) -> None:
        """A rectangle with edges on whole pixels."""
        x0, y0, x1, y1 = (max(round(at * self.unit), 0) for at in (left, top, right, bottom))
        self.image[y0:y1, x0:x1] = colour

    def text(
        self, words: str, left: float, base: float, colour: Colour, *, rim: bool = True
    ) -> None:
        """Words whose base line starts at a point, with a dark rim to be read over anything."""
        scale, thickness = TEXT_SCALE * self.unit, int(self.unit)
        (width, height), below = cv2.getTextSize(words, FONT, scale, thickness)
        edge = 4 * round(self.unit)
        x, y = round(left * self.unit) - edge, round(base * self.unit) - height - edge
        mask = _new_mask(height + below + 2 * edge, width + 2 * edge)
        at = (edge, height + edge)
        cv2.putText(mask, words, at, FONT, scale, 255, thickness, cv2.LINE_AA)
        if rim:
            wide = np.ones((edge // 2 + 1, edge // 2 + 1), dtype=np.uint8)
            self._blend(cv2.dilate(mask, wide) // 4 * 3, y, x, SHADE)
        self._blend(mask, y, x, colour)

    def text_width(self, words: str) -> float:
        """How long words get."""
        (width, _), _ = cv2.getTextSize(words, FONT, TEXT_SCALE * self.unit, int(self.unit))
        return width / self.unit


def _new_mask(height: int, width: int) -> UInt8[np.ndarray, "h w"]:
    """An empty mask whose rows are whole words of 8 bytes."""
    return np.zeros((height, -(-width // 8) * 8), dtype=np.uint8)


@njit(cache=True, nogil=True)
@no_type_check
def _mix(image, mask, words, top, left, red, green, blue):
    """Mixes a colour into a picture as strongly as a mask says, and clears the mask.

    `words` is the mask seen as words of 8 bytes, most of which are empty; its upper left corner
    lies at (top, left) of the picture, which it may overlap.
    """
    for row in range(max(0, -top), min(len(mask), len(image) - top)):
        for word in range(words.shape[1]):
            if words[row, word] == 0:
                continue
            for column in range(8 * word, 8 * word + 8):
                level = np.int32(mask[row, column])
                if level == 0 or not 0 <= left + column < image.shape[1]:
                    continue
                rest = 255 - level
                pixel = image[top + row, left + column]
                pixel[0] = (pixel[0] * rest + red * level + 127) // 255
                pixel[1] = (pixel[1] * rest + green * level + 127) // 255
                pixel[2] = (pixel[2] * rest + blue * level + 127) // 255
            words[row, word] = 0
