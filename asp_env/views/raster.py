"""What raster views share: the viewport around a target, and the inputs of the drawing kernels."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, Shaped, UInt8

from asp_env.errors import AspEnvError
from asp_env.stored import check_fields
from asp_env.views.view import RenderInput

MIN_METRES_PER_PIXEL = 1e-3
"""Smallest scale; its inverse is the largest one. Chosen by hand: lines stay within single
precision."""

MAX_SIDE_PX = 4_096
"""Largest height and width, which bounds the memory. Chosen by hand."""

MIN_LINE_WIDTH_PX = 1.5
"""Narrower lines would have gaps at some angles."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Viewport:
    """A rectangle of square pixels around a vehicle whose heading points up.

    Pixel coordinates are (column, row) and continuous: the pixel in row r and column c of the array
    covers [r, r + 1) by [c, c + 1), so its centre is (c + 0.5, r + 0.5). Row 0 is the top, far
    ahead of the vehicle; the left of the vehicle is on the left of the raster.
    """

    height_px: int = 360
    width_px: int = 240
    metres_per_pixel: float = 0.2
    anchor_row_px: float = 288.0
    """Row coordinate of the vehicle's centre, from the top."""
    anchor_column_px: float = 120.0
    """Column coordinate of the vehicle's centre, from the left."""

    def __post_init__(self) -> None:
        """Checks sizes, scale and anchor.

        Raises:
            AspEnvError: a value is not possible.
        """
        if not (1 <= self.height_px <= MAX_SIDE_PX and 1 <= self.width_px <= MAX_SIDE_PX):
            raise AspEnvError(
                f"a view of {self.height_px}x{self.width_px} pixels: both must be at least 1 and "
                f"at most {MAX_SIDE_PX:,}"
            )
        if not MIN_METRES_PER_PIXEL <= self.metres_per_pixel <= 1 / MIN_METRES_PER_PIXEL:
            raise AspEnvError(
                f"a view of {self.metres_per_pixel} m per pixel: give a positive number from "
                f"{MIN_METRES_PER_PIXEL:g} to {1 / MIN_METRES_PER_PIXEL:g}"
            )
        inside = 0 <= self.anchor_row_px <= self.height_px
        if not (inside and 0 <= self.anchor_column_px <= self.width_px):
            raise AspEnvError(
                f"a view anchored at row {self.anchor_row_px}, column {self.anchor_column_px}: "
                f"the anchor must lie within its {self.height_px}x{self.width_px} pixels"
            )

    def scaled(self, pixels: tuple[int, int] | None) -> "Viewport":
        """The same extent and anchor in another resolution, or the square around it.

        A square raster of a viewport that is not square shows a larger extent: the shorter side is
        extended by the same length at both ends.

        Args:
            pixels: height and width; `None` returns the viewport unchanged.

        Raises:
            AspEnvError: the pixels would not be square.
        """
        if pixels is None:
            return self
        height_px, width_px = pixels
        if height_px == width_px >= 1 and self.height_px != self.width_px:
            return self._square().scaled(pixels)
        if height_px < 1 or height_px * self.width_px != width_px * self.height_px:
            common = math.gcd(self.height_px, self.width_px)
            suggestions = [
                f"{self.height_px // common * times}x{self.width_px // common * times}"
                for times in (common, common // 2, common // 4)
                if times
            ]
            scale = self.metres_per_pixel
            raise AspEnvError(
                f"a view of {height_px}x{width_px} pixels does not show {self.height_px * scale:g} "
                f"m x {self.width_px * scale:g} m in square pixels: give a height and a width "
                f"such as {', '.join(suggestions)}"
            )
        scale = height_px / self.height_px
        return Viewport(
            height_px=height_px,
            width_px=width_px,
            metres_per_pixel=self.metres_per_pixel / scale,
            anchor_row_px=self.anchor_row_px * scale,
            anchor_column_px=self.anchor_column_px * scale,
        )

    def _square(self) -> "Viewport":
        side_px = max(self.height_px, self.width_px)
        return Viewport(
            height_px=side_px,
            width_px=side_px,
            metres_per_pixel=self.metres_per_pixel,
            anchor_row_px=self.anchor_row_px + (side_px - self.height_px) / 2,
            anchor_column_px=self.anchor_column_px + (side_px - self.width_px) / 2,
        )

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> "Viewport":
        """The viewport that `config()` describes.

        Raises:
            AspEnvError: a field is unknown or missing, or its value is not possible.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        unknown = sorted(set(config) - set(known))
        if unknown:
            raise AspEnvError(
                f"view configuration with {', '.join(unknown)}: known are {', '.join(known)}"
            )
        missing = [name for name in known if name not in config]
        if missing:
            raise AspEnvError(
                f"view configuration without {', '.join(missing)}: give all of {', '.join(known)}"
            )
        check_fields(cls, config)
        return cls(**config)

    def config(self) -> dict[str, Any]:
        """The fields, ready for JSON."""
        return dataclasses.asdict(self)

    def half_line_px(self, width_m: float) -> float:
        """Half the width in pixels of a line `width_m` wide, at least half `MIN_LINE_WIDTH_PX`."""
        return 0.5 * max(width_m / self.metres_per_pixel, MIN_LINE_WIDTH_PX)

    def pixels_from_world(
        self, poses: Shaped[np.ndarray, "*batch n"]
    ) -> Float[np.ndarray, "*batch 2 3"]:
        """Affine maps from world coordinates to pixel coordinates.

        Args:
            poses: [x m, y m, heading rad, …] of the vehicle around which the viewport lies.

        Returns:
            float64 matrices M such that M @ [x, y, 1] is (column, row).
        """
        x, y, heading = (poses[..., i].astype(np.float64) for i in range(3))
        scale = 1 / self.metres_per_pixel
        cos, sin = np.cos(heading) * scale, np.sin(heading) * scale
        matrices = np.empty((*heading.shape, 2, 3))
        # left = -sin·dx + cos·dy and ahead = cos·dx + sin·dy; columns grow to the right, rows back
        matrices[..., 0, 0], matrices[..., 0, 1] = sin, -cos
        matrices[..., 1, 0], matrices[..., 1, 1] = -cos, -sin
        matrices[..., 0, 2] = self.anchor_column_px - sin * x + cos * y
        matrices[..., 1, 2] = self.anchor_row_px + cos * x + sin * y
        return matrices


class PlacedScene(NamedTuple):
    """The last ticks of a scene and the viewports of its targets, as kernels take them."""

    states: Float32[np.ndarray, "b a ticks 4"]
    """[x m, y m, heading rad, speed m/s]; the last tick is the present."""
    valid: Bool[np.ndarray, "b a ticks"]
    sizes: Float32[np.ndarray, "b a 2"]
    """Length and width, metres."""
    targets: Int64[np.ndarray, "t 2"]
    """(situation, slot)."""
    pixels_from_world: Float[np.ndarray, "t 2 3"]
    """Affine maps around the present poses; around the origin for targets that are not valid."""
    map_of_target: Int64[np.ndarray, " t"]
    """Index of the map of each target, -1 for a target that is not valid now."""
    pixels_per_metre: float
    anchor: tuple[float, float]
    """(column, row) of the target's centre in its raster."""


def place_targets(
    scene: RenderInput, viewport: Viewport, *, history: int, view_name: str
) -> PlacedScene:
    """Places a viewport around each target of a scene.

    Args:
        scene: the scene to render.
        viewport: extent and resolution of the rasters.
        history: number of past ticks to render; earlier ticks are cut.
        view_name: name of the view, for the error message.

    Raises:
        AspEnvError: the history of the scene is too short.
    """
    if scene.history < history:
        raise AspEnvError(
            f"view {view_name!r} needs {history} past ticks, the scene has "
            f"{scene.history}: take a longer history"
        )
    targets = np.ascontiguousarray(scene.targets, dtype=np.int64)
    situation, slot = targets[:, 0], targets[:, 1]
    # States that are not valid may contain any number, so no pose is computed from them.
    present = scene.valid[situation, slot, -1]
    poses = np.where(present[:, None], scene.states[situation, slot, -1], 0)
    return PlacedScene(
        states=np.ascontiguousarray(scene.states[:, :, -history - 1 :], dtype=np.float32),
        valid=np.ascontiguousarray(scene.valid[:, :, -history - 1 :]),
        sizes=np.ascontiguousarray(scene.sizes, dtype=np.float32),
        targets=targets,
        pixels_from_world=viewport.pixels_from_world(poses),
        map_of_target=np.where(present, scene.map_index[situation], -1).astype(np.int64),
        pixels_per_metre=1 / viewport.metres_per_pixel,
        anchor=(float(viewport.anchor_column_px), float(viewport.anchor_row_px)),
    )


def raster_memory(
    shape: tuple[int, int, int, int], out: np.ndarray | None
) -> UInt8[np.ndarray, "t c h w"]:
    """Returns `out` after checking it, or a new uninitialised array of the given shape.

    Raises:
        AspEnvError: `out` has another shape, type or memory order.
    """
    if out is None:
        return np.empty(shape, dtype=np.uint8)
    if out.shape != shape or out.dtype != np.uint8 or not out.flags.c_contiguous:
        raise AspEnvError(
            f"cannot render into {out.dtype} {out.shape}: give C-contiguous uint8 {shape}"
        )
    return out
