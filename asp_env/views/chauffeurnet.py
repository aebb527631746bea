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

Without the ego trail (`chauffeurnet-no-trail`) its channel stays, empty: an ablation. A network
that is also shown pictures of the future could read the way there off the trail.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar, final

import numpy as np
from jaxtyping import UInt8

from asp_env.data.road_map import MapCache
from asp_env.errors import AspEnvError
from asp_env.views.draw import draw_agents, draw_boundaries
from asp_env.views.map_layers import BOUNDARY_WIDTH_M, boundary_pieces
from asp_env.views.view import Drawable, View, memory, place

SNAPSHOTS = (0, 2, 4, 6, 8, 9, 11, 13, 15)
"""States of the history at which the other agents are drawn; 15 is now."""

TRAIL_WIDTH_M = 0.4

NAMES = {True: "chauffeurnet", False: "chauffeurnet-no-trail"}
"""By whether there is an ego trail."""


def _cache() -> MapCache[np.ndarray]:
    return MapCache(boundary_pieces)


@final
@dataclass(frozen=True, slots=True)
class ChauffeurNet:
    """Draws scenes as the module's documentation says. Equal when the configurations are."""

    view: View = field(default_factory=View)
    ego_trail: bool = True
    """Whether the channel `ego_trail` shows something."""
    _boundaries: MapCache[np.ndarray] = field(
        default_factory=_cache, init=False, repr=False, compare=False
    )

    channels: ClassVar[tuple[str, ...]] = (
        "road_boundary",
        "ego_box",
        "ego_trail",
        *(f"agents_{i}" for i in range(len(SNAPSHOTS))),
    )
    """Every value is 0 or 255."""
    history: ClassVar[int] = SNAPSHOTS[-1]
    """Past ticks that a scene must have."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles carry the configuration, not the drawn maps."""
        return (ChauffeurNet, (self.view, self.ego_trail))

    @property
    def name(self) -> str:
        """By which `make_view` knows it."""
        return NAMES[self.ego_trail]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of one picture: channels, height, width."""
        return (len(self.channels), self.view.height_px, self.view.width_px)

    def config(self) -> dict[str, Any]:
        """Everything that decides the picture, ready for JSON."""
        return {"name": self.name, "ego_trail": self.ego_trail, **self.view.config()}

    @classmethod
    def make(
        cls, pixels: tuple[int, int] | None = None, *, ego_trail: bool = True
    ) -> "ChauffeurNet":
        """Of the usual 72 m x 48 m, in so many pixels (height, width).

        Raises:
            AspEnvError: the pixels would not be square.
        """
        return cls(View().scaled(pixels), ego_trail)

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> "ChauffeurNet":
        """The view that `config()` described; one without `ego_trail` has the trail.

        Raises:
            AspEnvError: the configuration is of another view, or a field is wrong.
        """
        fields = dict(config)
        name, ego_trail = fields.pop("name", None), fields.pop("ego_trail", True)
        if name not in NAMES.values():
            raise AspEnvError(
                f"configuration of the view {name!r}, expected {' or '.join(NAMES.values())}"
            )
        if ego_trail is not (name == NAMES[True]):
            raise AspEnvError(
                f"configuration of the view {name!r} with ego_trail {ego_trail!r}: "
                f"expected {name == NAMES[True]}"
            )
        return cls(View.from_config(fields), name == NAMES[True])

    def draw(self, scene: Drawable, out: np.ndarray | None = None) -> UInt8[np.ndarray, "t 12 h w"]:
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
        out = memory((len(scene.targets), *self.shape), out)
        self._draw(scene, np.empty((0, 0), dtype=np.uint8), out)
        return out

    def draw_packed(self, scene: Drawable) -> UInt8[np.ndarray, "t 12 h bytes"]:
        """What `draw` gives, packed to bits as `asp_env.views.draw` does, and sooner.

        Raises:
            AspEnvError: the history is too short.
        """
        channels, height_px, width_px = self.shape
        out = memory((len(scene.targets), channels, height_px, -(-width_px // 8)), None)
        self._draw(scene, np.empty((height_px, width_px), dtype=np.uint8), out)
        return out

    def _draw(self, scene: Drawable, plane: np.ndarray, out: np.ndarray) -> None:
        """Into `out`, by way of `plane` if that is not empty."""
        placed = place(scene, self.view, history=self.history, who=self.name)
        half_width = self.view.half_line_px(BOUNDARY_WIDTH_M)
        out[placed.map_of_target < 0, 0] = 0
        for index, road_map in enumerate(scene.maps):
            draw_boundaries(self._boundaries(road_map), index, placed, half_width, plane, out)
        trail = self.view.half_line_px(TRAIL_WIDTH_M) if self.ego_trail else 0.0
        draw_agents(placed, SNAPSHOTS, trail, plane, out)
