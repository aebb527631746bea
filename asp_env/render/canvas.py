"""An image that covers an area of the world: subpixel drawing in metres, and translucent lines."""

from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8

from asp_env.compiled import njit

SHIFT = 4
"""OpenCV takes coordinates in units of 2**-SHIFT pixels."""

Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""

SHADE_COLOUR: Colour = (14, 17, 22)
FONT = cv2.FONT_HERSHEY_SIMPLEX
TEXT_SCALE = 0.55
REFERENCE_PX = 720
"""Lines and texts are sized for an image whose smaller side is this, and grow with larger ones."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Viewport:
    """The part of the world that an image shows."""

    left_m: float
    top_m: float
    pixels_per_metre: float
    width_px: int
    height_px: int

    def to_pixels(self, points: Shaped[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """(column, row) of points in metres; whole numbers are corners of pixels."""
        offset = np.asarray(points, dtype=np.float64) - (self.left_m, self.top_m)
        return offset * (self.pixels_per_metre, -self.pixels_per_metre)

    def to_fixed_point(self, points: Shaped[np.ndarray, "*batch 2"]) -> Int[np.ndarray, "*batch 2"]:
        """The coordinates that OpenCV takes, whose whole numbers are centres of pixels."""
        pixels = np.clip(self.to_pixels(points) - 0.5, -30_000, 30_000)
        return np.rint(pixels * (1 << SHIFT)).astype(np.int32)


class Canvas:
    """An RGB image to draw on.

    World coordinates are in metres. Widths, radii and the positions of texts and rectangles are in
    units of `unit` pixels, so that they look the same in images of every size.
    """

    def __init__(self, viewport: Viewport, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Draws on the image in place."""
        self.viewport = viewport
        self.image = image
        self.small_side_px = min(image.shape[:2])
        self.unit = max(1.0, self.small_side_px / REFERENCE_PX)
        self.height, self.width = (side / self.unit for side in image.shape[:2])
        self._mask = _new_mask(*image.shape[:2])

    def fill(self, polygon: Int[np.ndarray, "corners 2"], colour: Colour) -> None:
        """Fills a convex polygon given in fixed-point coordinates of the viewport."""
        cv2.fillConvexPoly(self.image, polygon, colour, cv2.LINE_AA, SHIFT)

    def outline(self, polygon: Int[np.ndarray, "corners 2"], colour: Colour) -> None:
        """Draws the edges of a polygon given in fixed-point coordinates, one unit wide."""
        thickness = round(self.unit)
        cv2.polylines(self.image, [polygon], True, colour, thickness, cv2.LINE_AA, SHIFT)

    def stroke(self, lines: Shaped[np.ndarray, "n points 2"], alpha: float, width: float) -> None:
        """Adds polylines in metres to the mask that `blend` colours; later ones are on top."""
        fixed = list(self.viewport.to_fixed_point(lines))
        thickness = max(1, round(width * self.unit))
        cv2.polylines(self._mask, fixed, False, round(255 * alpha), thickness, cv2.LINE_AA, SHIFT)

    def dot(self, point: Shaped[np.ndarray, " 2"], alpha: float, radius: float) -> None:
        """Adds a disc around a point in metres to the mask that `blend` colours."""
        column, row = self.viewport.to_fixed_point(point).tolist()
        size = round(radius * self.unit * (1 << SHIFT))
        cv2.circle(self._mask, (column, row), size, round(255 * alpha), -1, cv2.LINE_AA, SHIFT)

    def blend(self, colour: Colour) -> None:
        """Colours everything that was added to the mask since the last call."""
        self._blend(self._mask, 0, 0, colour)

    def _blend(self, mask: UInt8[np.ndarray, "h w"], top: int, left: int, colour: Colour) -> None:
        _mix(self.image, mask, mask.view(np.uint64), top, left, *colour)

    def rectangle(
        self, left: float, top: float, right: float, bottom: float, colour: Colour
    ) -> None:
        """Fills a rectangle whose edges are rounded to whole pixels."""
        x0, y0, x1, y1 = (max(round(edge * self.unit), 0) for edge in (left, top, right, bottom))
        self.image[y0:y1, x0:x1] = colour

    def text(
        self, text: str, left: float, base: float, colour: Colour, *, rim: bool = True
    ) -> None:
        """Draws a text.

        Args:
            text: A line of text.
            left: Where its base line starts.
            base: The height of its base line.
            colour: Its colour.
            rim: Whether a dark rim makes it legible on any background.
        """
        scale, thickness = TEXT_SCALE * self.unit, int(self.unit)
        (width, height), below = cv2.getTextSize(text, FONT, scale, thickness)
        edge = 4 * round(self.unit)
        x, y = round(left * self.unit) - edge, round(base * self.unit) - height - edge
        mask = _new_mask(height + below + 2 * edge, width + 2 * edge)
        origin = (edge, height + edge)
        cv2.putText(mask, text, origin, FONT, scale, 255, thickness, cv2.LINE_AA)
        if rim:
            kernel = np.ones((edge // 2 + 1, edge // 2 + 1), dtype=np.uint8)
            self._blend(cv2.dilate(mask, kernel) // 4 * 3, y, x, SHADE_COLOUR)
        self._blend(mask, y, x, colour)

    def text_width(self, text: str) -> float:
        """Width of a text in units."""
        (width, _), _ = cv2.getTextSize(text, FONT, TEXT_SCALE * self.unit, int(self.unit))
        return width / self.unit


def _new_mask(height: int, width: int) -> UInt8[np.ndarray, "h w"]:
    """An empty mask whose rows are multiples of 8 bytes."""
    return np.zeros((height, -(-width // 8) * 8), dtype=np.uint8)


@njit(cache=True, nogil=True)
@no_type_check
def _mix(image, mask, words, top, left, red, green, blue):
    """Mixes a colour into an image with the opacity of a mask, then clears the mask.

    Args:
        image: (H, W, 3) uint8, changed in place.
        mask: (h, w) uint8 opacity, w a multiple of 8; set to 0.
        words: (h, w / 8) uint64, a view of the mask; words that are 0 are skipped.
        top: Row of the image at which the mask starts; the mask may exceed the image.
        left: Column of the image at which the mask starts.
        red: 0 to 255.
        green: 0 to 255.
        blue: 0 to 255.
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
