"""A scene as drawing needs it: contiguous arrays, and where the pictures of its targets lie."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, UInt8

from asp_env.errors import AspEnvError
from asp_env.views.drawable import Drawable
from asp_env.views.view import View


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
