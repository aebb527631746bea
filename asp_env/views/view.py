"""Where a picture of a scene lies: its pixels, their size, and the vehicle it is drawn around.

MERGED: What a view reads of a scene.
MERGED: A scene as drawing needs it: contiguous arrays, and where the pictures of its targets lie.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int64, Shaped, UInt8

from asp_env.data.road_map import RoadMap
from asp_env.errors import AspEnvError

MIN_LINE_WIDTH_PX = 1.5
"""Narrower lines would have gaps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """A rectangle of square pixels around a vehicle that heads up.

    Pixel coordinates are (column, row), continuous: the pixel in row r and column c of the array
    covers [r, r + 1) by [c, c + 1), so its centre lies at (c + 0.5, r + 0.5). Row 0 is the top,
    which is far ahead; what is left of the vehicle is left in the picture.
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
        if self.height_px < 1 or self.width_px < 1:
            raise AspEnvError(
                f"a view of {self.height_px}x{self.width_px} pixels: both must be at least 1"
            )
        if not (math.isfinite(self.metres_per_pixel) and self.metres_per_pixel > 0):
            raise AspEnvError(
                f"a view of {self.metres_per_pixel} m per pixel: give a positive number"
            )
        inside = 0 <= self.anchor_row_px <= self.height_px
        if not (inside and 0 <= self.anchor_column_px <= self.width_px):
            raise AspEnvError(
                f"a view anchored at row {self.anchor_row_px}, column {self.anchor_column_px}: "
                f"the anchor must lie within its {self.height_px}x{self.width_px} pixels"
            )

    def scaled(self, pixels: tuple[int, int] | None) -> "View":
        """The same extent and anchor in another number of pixels, height and width.

        Without one it is the view itself.

        Raises:
            AspEnvError: the pixels would not be square.
        """
        if pixels is None:
            return self
        height_px, width_px = pixels
        if height_px < 1 or height_px * self.width_px != width_px * self.height_px:
            common = math.gcd(self.height_px, self.width_px)
            good = [
                f"{self.height_px // common * times}x{self.width_px // common * times}"
                for times in (common, common // 2, common // 4)
                if times
            ]
            scale = self.metres_per_pixel
            raise AspEnvError(
                f"a view of {height_px}x{width_px} pixels does not show {self.height_px * scale:g} "
                f"m x {self.width_px * scale:g} m in square pixels: give a height and a width "
                f"such as {', '.join(good)}"
            )
        scale = height_px / self.height_px
        return View(
            height_px=height_px,
            width_px=width_px,
            metres_per_pixel=self.metres_per_pixel / scale,
            anchor_row_px=self.anchor_row_px * scale,
            anchor_column_px=self.anchor_column_px * scale,
        )

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> "View":
        """The view that `config` describes, as `config()` wrote it.

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
        return cls(**config)

    def config(self) -> dict[str, Any]:
        """The fields, ready for JSON."""
        return dataclasses.asdict(self)

    def half_line_px(self, width_m: float) -> float:
        """Half the width of a line in pixels, of so many metres but wide enough to have no gaps."""
        return 0.5 * max(width_m / self.metres_per_pixel, MIN_LINE_WIDTH_PX)

    def pixels_from_world(
        self, poses: Shaped[np.ndarray, "*batch n"]
    ) -> Float[np.ndarray, "*batch 2 3"]:
        """Affine maps from world coordinates to pixel coordinates, around poses [x, y, heading, …].

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


@runtime_checkable
class Drawable(Protocol):
    """The fields of a `Scene` that views read, with its meaning and shapes; a `Scene` is one."""

    @property
    def states(self) -> Float[np.ndarray, "b a ticks 4"]:
        """[x m, y m, heading rad, speed m/s]; the last tick is now."""
        ...

    @property
    def valid(self) -> Bool[np.ndarray, "b a ticks"]:
        """Who is there at which tick."""
        ...

    @property
    def sizes(self) -> Float[np.ndarray, "b a 2"]:
        """Length and width, metres; of who was never there anything."""
        ...

    @property
    def classes(self) -> Int[np.ndarray, "b a"]:
        """`AgentClass`; of who was never there anything."""
        ...

    @property
    def ids(self) -> Int[np.ndarray, "b a"]:
        """Of who was never there anything."""
        ...

    @property
    def targets(self) -> Int[np.ndarray, "t 2"]:
        """(situation, slot) of those who see."""
        ...

    @property
    def maps(self) -> tuple[RoadMap, ...]:
        """Where the situations lie."""
        ...

    @property
    def map_index(self) -> Int[np.ndarray, " b"]:
        """Which of `maps` each situation lies on."""
        ...

    @property
    def history(self) -> int:
        """Past ticks."""
        ...


class Placed(NamedTuple):
    """The last ticks of a scene, and the frames of its targets now. Kernels take it as it is."""

    states: Float32[np.ndarray, "b a ticks 4"]
    valid: Bool[np.ndarray, "b a ticks"]
    sizes: Float32[np.ndarray, "b a 2"]
    targets: Int64[np.ndarray, "t 2"]
    pixels_from_world: Float[np.ndarray, "t 2 3"]
    """Of what is not valid now, those of the origin."""
    map_of_target: Int64[np.ndarray, " t"]
    """Which map is drawn, -1 for a target that is not valid now."""
    pixels_per_metre: float
    anchor: tuple[float, float]
    """(column, row) of the target's centre in its picture."""


def place(scene: Drawable, view: View, *, history: int, who: str) -> Placed:
    """What is drawn of a scene.

    Args:
        scene: to be drawn.
        view: around each of its targets.
        history: past ticks to draw; earlier ones are cut.
        who: needs them; the error names it.

    Raises:
        AspEnvError: the scene's history is too short.
    """
    if scene.history < history:
        raise AspEnvError(
            f"view {who!r} needs {history} past ticks, the scene has "
            f"{scene.history}: take a longer history"
        )
    targets = np.ascontiguousarray(scene.targets, dtype=np.int64)
    situation, slot = targets[:, 0], targets[:, 1]
    # What is not valid may hold anything, so no pose is made of it.
    known = scene.valid[situation, slot, -1]
    poses = np.where(known[:, None], scene.states[situation, slot, -1], 0)
    return Placed(
        states=np.ascontiguousarray(scene.states[:, :, -history - 1 :], dtype=np.float32),
        valid=np.ascontiguousarray(scene.valid[:, :, -history - 1 :]),
        sizes=np.ascontiguousarray(scene.sizes, dtype=np.float32),
        targets=targets,
        pixels_from_world=view.pixels_from_world(poses),
        map_of_target=np.where(known, scene.map_index[situation], -1).astype(np.int64),
        pixels_per_metre=1 / view.metres_per_pixel,
        anchor=(float(view.anchor_column_px), float(view.anchor_row_px)),
    )


def memory(
    shape: tuple[int, int, int, int], out: np.ndarray | None
) -> UInt8[np.ndarray, "t c h w"]:
    """`out`, or fresh memory where there is none.

    Raises:
        AspEnvError: `out` has another shape, type or order.
    """
    if out is None:
        return np.empty(shape, dtype=np.uint8)
    if out.shape != shape or out.dtype != np.uint8 or not out.flags.c_contiguous:
        raise AspEnvError(
            f"cannot draw into {out.dtype} {out.shape}: give C-contiguous uint8 {shape}"
        )
    return out
