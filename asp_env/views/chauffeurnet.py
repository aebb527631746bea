"""The ChauffeurNet view: road, ego and the past of the other agents as 12 binary channels.

After Bansal et al., ChauffeurNet (2018), as Janjoš et al. (2021) use it. One raster is rendered for
each target of a scene. The target is the *ego* of its raster, which lies in the target's present
frame with the heading up: by default 360x240 pixels of 0.2 m with the ego's centre at row 288 (80 %
from the top) and column 120, which shows 57.6 m ahead, 14.4 m behind and 24 m to either side.
Values are 0 and 255.

| channel | shows |
|---|---|
| `road_boundary` | curbs and solid lines of the map, 0.3 m wide; no dashed or virtual lines |
| `ego_box` | the ego's box now |
| `ego_trail` | the path of the ego's centre over the last ticks (`history`, 15 by default), 0.4 m \
wide |
| `agents_0` … `agents_8` | the boxes of all other agents at the states 0, 2, 4, 6, 8, 9, 11, 13 \
and 15 of the last 16: oldest first, 15 is the present |

The nine snapshots are 15 / 8 = 1.875 ticks apart (0.375 s at ticks of 0.2 s), "at regular
time-intervals" as in the paper, rounded to whole ticks, halves to even. The steps between them are
therefore 2, 2, 2, 2, 1, 2, 2 and 2 ticks: 7.5 becomes 8, and 9.375 becomes 9. With another history
the nine states are again at equal intervals, each rounded to a tick; with fewer than nine states
some channels are equal.

The ego has channels of its own and is not among the agents. Agents of every class are drawn with
their footprint. States that are not valid are not drawn; a target that is not valid now has an
empty raster. Lines are at least 1.5 pixels wide and boxes at least one pixel, so that both remain
visible at coarse scales. The raster depends neither on the order of slots nor on the other targets.

In the variant without the ego trail (`chauffeurnet-no-trail`, for ablations) that channel is empty.
A network that is also trained on rasters of the future could read the ego's future path off the
trail.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar, final

import numpy as np
from jaxtyping import UInt8

from asp_env.data.bounded_cache import MapCache
from asp_env.errors import AspEnvError
from asp_env.stored import check_fields
from asp_env.views.draw import draw_agents, draw_boundaries
from asp_env.views.map_layers import BOUNDARY_WIDTH_M, line_segments
from asp_env.views.raster import Viewport, place_targets, raster_memory
from asp_env.views.view import RenderInput

SNAPSHOT_TICKS = (0, 2, 4, 6, 8, 9, 11, 13, 15)
"""Ticks of a history of 15 at which the other agents are drawn; 15 is the present. Nine regular
intervals, rounded to whole ticks; the paper gives no numbers."""

TRAIL_WIDTH_M = 0.4
"""Chosen by hand: two pixels at full resolution."""


def snapshot_ticks(history: int) -> tuple[int, ...]:
    """Ticks of a history at which the other agents are drawn; the last one is the present."""
    return tuple(np.rint(np.linspace(0, history, len(SNAPSHOT_TICKS))).astype(int).tolist())


MAX_HISTORY = 1_000
"""Largest number of past ticks. Chosen by hand."""

NAME_BY_EGO_TRAIL = {True: "chauffeurnet", False: "chauffeurnet-no-trail"}
"""Name of the view with and without the ego trail."""


def _segment_cache() -> MapCache[np.ndarray]:
    return MapCache(line_segments)


@final
@dataclass(frozen=True, slots=True)
class ChauffeurNet:
    """Renders scenes as described by the module. Views with equal configurations are equal."""

    viewport: Viewport = field(default_factory=Viewport)
    ego_trail: bool = True
    """Whether the channel `ego_trail` is drawn."""
    history: int = SNAPSHOT_TICKS[-1]
    """Number of past ticks that are shown and that a scene must have."""
    _boundaries: MapCache[np.ndarray] = field(
        default_factory=_segment_cache, init=False, repr=False, compare=False
    )

    channels: ClassVar[tuple[str, ...]] = (
        "road_boundary",
        "ego_box",
        "ego_trail",
        *(f"agents_{i}" for i in range(len(SNAPSHOT_TICKS))),
    )
    """Names of the channels, whose values are 0 or 255."""

    def __post_init__(self) -> None:
        """Checks the number of past ticks.

        Raises:
            AspEnvError: it is not positive.
        """
        if not 1 <= self.history <= MAX_HISTORY:
            raise AspEnvError(
                f"view {self.name!r}: history is {self.history}, expected 1 or more and at most "
                f"{MAX_HISTORY:,}"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles contain the configuration, not the cached maps."""
        return (ChauffeurNet, (self.viewport, self.ego_trail, self.history))

    @property
    def name(self) -> str:
        """The name under which `make_view` makes the view."""
        return NAME_BY_EGO_TRAIL[self.ego_trail]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, height and width of one raster."""
        return (len(self.channels), self.viewport.height_px, self.viewport.width_px)

    def config(self) -> dict[str, Any]:
        """The name and all options of the view, ready for JSON."""
        options = {"ego_trail": self.ego_trail, "history": self.history}
        return {"name": self.name, **options, **self.viewport.config()}

    @classmethod
    def make(
        cls, pixels: tuple[int, int] | None = None, *, ego_trail: bool = True
    ) -> "ChauffeurNet":
        """A view of the default extent, 72 m by 48 m.

        Args:
            pixels: height and width; 360x240 if omitted.
            ego_trail: whether the channel `ego_trail` is drawn.

        Raises:
            AspEnvError: the pixels would not be square.
        """
        return cls(Viewport().scaled(pixels), ego_trail)

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> "ChauffeurNet":
        """The view that `config()` describes; `ego_trail` defaults to true, `history` to 15.

        Raises:
            AspEnvError: the configuration is of another view, or a field is wrong.
        """
        fields = dict(config)
        name, ego_trail = fields.pop("name", None), fields.pop("ego_trail", True)
        history = fields.pop("history", SNAPSHOT_TICKS[-1])
        names = NAME_BY_EGO_TRAIL.values()
        if name not in names:
            raise AspEnvError(f"configuration of the view {name!r}, expected {' or '.join(names)}")
        if ego_trail is not (name == NAME_BY_EGO_TRAIL[True]):
            raise AspEnvError(
                f"configuration of the view {name!r} with ego_trail {ego_trail!r}: "
                f"expected {name == NAME_BY_EGO_TRAIL[True]}"
            )
        check_fields(cls, {"history": history})
        return cls(Viewport.from_config(fields), name == NAME_BY_EGO_TRAIL[True], history)

    def render(
        self, scene: RenderInput, out: np.ndarray | None = None
    ) -> UInt8[np.ndarray, "t 12 h w"]:
        """Renders one raster per target, in the order of `scene.targets`.

        Args:
            scene: a scene with at least `history` past ticks.
            out: array to render into, (targets, 12, height, width) uint8, C-contiguous, of any
                content; a new array is made if it is omitted.

        Returns:
            `out` or the new array, with values 0 and 255.

        Raises:
            AspEnvError: the history is too short, or `out` does not fit.
        """
        out = raster_memory((len(scene.targets), *self.shape), out)
        self._render(scene, np.empty((0, 0), dtype=np.uint8), out)
        return out

    def render_packed(self, scene: RenderInput) -> UInt8[np.ndarray, "t 12 h bytes"]:
        """The rasters of `render` packed along rows, as by `np.packbits` but faster.

        Args:
            scene: a scene with at least `history` past ticks.

        Returns:
            Rows of ⌈width / 8⌉ bytes; the first pixel is the highest bit of the first byte.

        Raises:
            AspEnvError: the history is too short.
        """
        channels, height_px, width_px = self.shape
        out = raster_memory((len(scene.targets), channels, height_px, -(-width_px // 8)), None)
        self._render(scene, np.empty((height_px, width_px), dtype=np.uint8), out)
        return out

    def _render(self, scene: RenderInput, plane: np.ndarray, out: np.ndarray) -> None:
        """Renders into `out`, through the buffer `plane` if that is not empty."""
        placed = place_targets(scene, self.viewport, history=self.history, view_name=self.name)
        half_width = self.viewport.half_line_px(BOUNDARY_WIDTH_M)
        out[placed.map_of_target < 0, 0] = 0
        for index, road_map in enumerate(scene.maps):
            draw_boundaries(self._boundaries(road_map), index, placed, half_width, plane, out)
        trail = self.viewport.half_line_px(TRAIL_WIDTH_M) if self.ego_trail else 0.0
        draw_agents(placed, snapshot_ticks(self.history), trail, plane, out)
