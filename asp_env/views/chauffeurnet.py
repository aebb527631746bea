"""The ChauffeurNet view: road, ego and the other agents' past as 12 binary channels.

After Bansal et al., ChauffeurNet (2018), as Janjoš et al. (2021) use it. One picture for each
target of a scene, which is the *ego* of its picture, in its frame now: heading up, by default
360x240 pixels of 0.2 m with the ego's centre at row 288 (80 % from the top) and column 120, so
57.6 m ahead, 14.4 m behind and 24 m to either side are seen. Values are 0 and 255.

| channel | shows |
|---|---|
| `road_boundary` | curbs and solid lines of the map, 0.3 m wide; no dashed, no virtual lines |
| `ego_box` | the ego's box now |
| `ego_trail` | the way of the ego's centre over the last 15 ticks, 0.4 m wide |
| `agents_0` … `agents_8` | the boxes of all other agents at the states 0, 2, 4, 6, 8, 9, 11, 13 \
and 15 of the last 16: oldest first, 15 is now |

The ego is not among the agents: it has channels of its own. Agents of every class are drawn with
their footprint. What is not valid is not drawn; a target that is not valid now has an empty
picture. Lines are at least 1.5 pixels wide and boxes at least one, so nothing vanishes at coarse
scales. The picture does not depend on the order of slots, nor on the other targets of the scene.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar, final

import numpy as np
from jaxtyping import UInt8

from asp_env.data.scene import Scene
from asp_env.errors import AspEnvError
from asp_env.views.boundaries import BoundaryCache
from asp_env.views.draw import draw_agents, draw_pieces
from asp_env.views.view import View

SNAPSHOTS = (0, 2, 4, 6, 8, 9, 11, 13, 15)
"""States of the history at which the other agents are drawn; 15 is now."""

BOUNDARY_WIDTH_M = 0.3
TRAIL_WIDTH_M = 0.4
MIN_LINE_WIDTH_PX = 1.5
"""Narrower lines would have gaps."""


@final
@dataclass(frozen=True, slots=True)
class ChauffeurNet:
    """Draws scenes as the module's documentation says. Equal when the configurations are."""

    view: View = field(default_factory=View)
    _boundaries: BoundaryCache = field(
        default_factory=BoundaryCache, init=False, repr=False, compare=False
    )

    name: ClassVar[str] = "chauffeurnet"
    channels: ClassVar[tuple[str, ...]] = (
        "road_boundary",
        "ego_box",
        "ego_trail",
        *(f"agents_{i}" for i in range(len(SNAPSHOTS))),
    )
    history: ClassVar[int] = SNAPSHOTS[-1]
    """Past ticks that a scene must have."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles carry the configuration, not the drawn maps."""
        return (ChauffeurNet, (self.view,))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of one picture: channels, height, width."""
        return (len(self.channels), self.view.height_px, self.view.width_px)

    def config(self) -> dict[str, Any]:
        """Everything that decides the picture, ready for JSON."""
        return {"name": self.name, **self.view.config()}

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> "ChauffeurNet":
        """The view that `config()` described.

        Raises:
            AspEnvError: the configuration is of another view, or a field is wrong.
        """
        fields = dict(config)
        name = fields.pop("name", None)
        if name != cls.name:
            raise AspEnvError(f"configuration of the view {name!r}, expected {cls.name!r}")
        return cls(View.from_config(fields))

    def draw(self, scene: Scene, out: np.ndarray | None = None) -> UInt8[np.ndarray, "t 12 h w"]:
        """One picture per target, in the order of `scene.targets`.

        Args:
            scene: with at least 15 past ticks.
            out: memory to draw into, (targets, 12, height, width) uint8, C-contiguous; its former
                content does not matter. Fresh memory where it is not given.

        Returns:
            `out`, or the fresh memory: 0 or 255.

        Raises:
            AspEnvError: the history is too short, or `out` does not fit.
        """
        if scene.history < self.history:
            raise AspEnvError(
                f"view {self.name!r} needs {self.history} past ticks, the scene has "
                f"{scene.history}: take a longer history"
            )
        shape = (len(scene.targets), *self.shape)
        if out is None:
            out = np.empty(shape, dtype=np.uint8)
        elif out.shape != shape or out.dtype != np.uint8 or not out.flags.c_contiguous:
            raise AspEnvError(
                f"cannot draw into {out.dtype} {out.shape}: give C-contiguous uint8 {shape}"
            )
        states = np.ascontiguousarray(scene.states[:, :, -self.history - 1 :], dtype=np.float32)
        valid = np.ascontiguousarray(scene.valid[:, :, -self.history - 1 :])
        sizes = np.ascontiguousarray(scene.sizes, dtype=np.float32)
        targets = np.ascontiguousarray(scene.targets, dtype=np.int64)
        situation, slot = targets[:, 0], targets[:, 1]
        # What is not valid may hold anything, so no pose is made of it.
        known = valid[situation, slot, -1]
        poses = np.where(known[:, None], states[situation, slot, -1], 0)
        matrices = self.view.pixels_from_world(poses)
        pixels_per_metre = 1 / self.view.metres_per_pixel
        map_of_target = np.where(known, scene.map_index[situation], -1)
        half_width = 0.5 * max(BOUNDARY_WIDTH_M * pixels_per_metre, MIN_LINE_WIDTH_PX)
        out[:, 0] = 0
        for index, road_map in enumerate(scene.maps):
            pieces = self._boundaries(road_map)
            on_map = map_of_target == index
            draw_pieces(pieces, on_map, matrices, pixels_per_metre, half_width, out)
        half_width = 0.5 * max(TRAIL_WIDTH_M * pixels_per_metre, MIN_LINE_WIDTH_PX)
        draw_agents(
            states,
            valid,
            sizes,
            targets,
            SNAPSHOTS,
            matrices,
            pixels_per_metre,
            (float(self.view.anchor_column_px), float(self.view.anchor_row_px)),
            half_width,
            out,
        )
        return out
