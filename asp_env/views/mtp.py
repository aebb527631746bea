"""The MTP view: road and road users as an RGB raster in which the past fades.

After Cui et al., Multimodal Trajectory Predictions (2019), in the colours of its implementation in
the nuScenes devkit. One raster is rendered for each target of a scene, in the target's present
frame with the heading up: by default 360x360 pixels of 0.2 m with the target's centre at row 288
(80 % from the top) and column 180, which shows 57.6 m ahead, 14.4 m behind and 36 m to either side.

Layers are painted in this order, later ones over earlier ones:

| layer | colour |
|---|---|
| ground | black (0, 0, 0) |
| drivable area | white (255, 255, 255) |
| dashed lines, 0.3 m wide, drawn as solid lines | light blue (0, 153, 255) |
| curbs and solid lines, 0.3 m wide | blue (0, 0, 255) |
| boxes of vehicles | yellow (255, 255, 0) |
| boxes of objects: agents of the class `other` | violet (204, 0, 204) |
| boxes of humans and animals: pedestrians, bicycles, animals | orange (255, 153, 51) |
| boxes of the target, of any class | red (255, 0, 0) |

Boxes are drawn at the last 11 states: those of the other agents tick by tick, oldest first, at each
tick vehicles before objects before humans; then those of the target. Brightness (the largest of the
three values, the V of HSV) increases in equal steps from 0.4 two seconds ago, at ticks of 0.2 s, to
that of the full colour now. With a shorter history fewer of these states are drawn, each in its
colour. Overlapping boxes of other agents therefore look the same in any order,
and the raster depends neither on the order of slots nor on the other targets of the scene.

The devkit counts bicycles among the vehicles. Here they are human: they have a rider, and some
recordings do not distinguish cyclists from pedestrians. Virtual lines are not drawn. States that
are not valid are not drawn; a target that is not valid now has a black raster. Lines are at least
1.5 pixels wide and boxes at least one pixel, so that both remain visible at coarse scales.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, final, no_type_check

import numpy as np
from jaxtyping import Int64, UInt8, UInt32

from asp_env.compiled import njit
from asp_env.data.bounded_cache import MapCache
from asp_env.data.classes import VULNERABLE, AgentClass
from asp_env.data.road_map import LineType, RoadMap
from asp_env.errors import AspEnvError
from asp_env.stored import check_fields
from asp_env.views.draw import draw_coloured_agents, draw_coloured_lines
from asp_env.views.map_layers import (
    BOUNDARY_WIDTH_M,
    Rings,
    drivable_rings,
    fill_rings,
    line_segments,
)
from asp_env.views.raster import Viewport, place_targets, raster_memory
from asp_env.views.view import RenderInput

DASHED_RGB = (0, 153, 255)
BOUNDARY_RGB = (0, 0, 255)
VEHICLE_RGB = (255, 255, 0)
OBJECT_RGB = (204, 0, 204)
HUMAN_RGB = (255, 153, 51)
TARGET_RGB = (255, 0, 0)

FADE_TICKS = 10
"""Past ticks that are drawn at most: 2 s at ticks of 0.2 s, as in the nuScenes devkit."""

OLDEST_VALUE = 0.4
"""Brightness (V of HSV) of the oldest boxes, as in the nuScenes devkit."""

_VIEWPORT = Viewport(
    height_px=360, width_px=360, metres_per_pixel=0.2, anchor_row_px=288.0, anchor_column_px=180.0
)

# Rasters are painted as colour indices in channel 0 and converted to colours at the end.
_ROAD, _DASHED, _BOUNDARY, _FIRST_BOX = 1, 2, 3, 4


def palette() -> UInt8[np.ndarray, "colours 3"]:
    """The RGB colours by index: ground, road, dashed lines, boundaries, then 11 per kind of box.

    The kinds of boxes are vehicles, objects, humans and the target, each from oldest to newest.
    """
    fixed = np.array([(0, 0, 0), (255, 255, 255), DASHED_RGB, BOUNDARY_RGB], dtype=np.float64)
    now = np.array([VEHICLE_RGB, OBJECT_RGB, HUMAN_RGB, TARGET_RGB], dtype=np.float64)
    value_now = now.max(axis=1) / 255
    value = np.linspace(OLDEST_VALUE, value_now, FADE_TICKS + 1, axis=1)
    faded = now[:, None] * (value / value_now[:, None])[..., None]
    return np.rint(np.concatenate([fixed, faded.reshape(-1, 3)])).astype(np.uint8)


def _oldest_colours() -> Int64[np.ndarray, " classes"]:
    """Colour index of the oldest box of each agent class."""
    kind = np.zeros(len(AgentClass), dtype=np.int64)
    kind[AgentClass.OTHER] = 1
    kind[[int(each) for each in VULNERABLE]] = 2
    return _FIRST_BOX + kind * (FADE_TICKS + 1)


def _as_words(colours: UInt8[np.ndarray, "colours 3"]) -> UInt32[np.ndarray, " colours"]:
    """Each colour as one number: red + 256 · green + 65536 · blue."""
    return (colours.astype(np.uint32) << np.array([0, 8, 16], dtype=np.uint32)).sum(
        axis=1, dtype=np.uint32
    )


_WORDS, _OLDEST = _as_words(palette()), _oldest_colours()
_OLDEST_OF_TARGET = _FIRST_BOX + 3 * (FADE_TICKS + 1)


@njit(cache=True, nogil=True)
@no_type_check
def _apply_palette(words, out):
    """Converts colour indices in channel 0 to red, green and blue.

    Args:
        words: (colours,) uint32 from `_as_words`.
        out: (targets, 3, height, width) uint8, read and written.
    """
    height, width = out.shape[2:]
    row_words = np.empty(width, np.uint32)
    for raster in out:
        for r in range(height):
            red, green, blue = raster[0, r], raster[1, r], raster[2, r]
            # four plain loops, each of which the compiler vectorises
            for i in range(width):
                row_words[i] = words[red[i]]
            for i in range(width):
                red[i] = np.uint8(row_words[i])
            for i in range(width):
                green[i] = np.uint8(row_words[i] >> np.uint32(8))
            for i in range(width):
                blue[i] = np.uint8(row_words[i] >> np.uint32(16))


class _Ground(NamedTuple):
    drivable: Rings
    dashed: np.ndarray
    boundaries: np.ndarray


def _ground(road_map: RoadMap) -> _Ground:
    return _Ground(
        drivable=drivable_rings(road_map),
        dashed=line_segments(road_map, (LineType.DASHED,)),
        boundaries=line_segments(road_map),
    )


def _ground_cache() -> MapCache[_Ground]:
    return MapCache(_ground)


@final
@dataclass(frozen=True, slots=True)
class MTP:
    """Renders scenes as described by the module. Views with equal configurations are equal."""

    viewport: Viewport = _VIEWPORT
    history: int = FADE_TICKS
    """Number of past ticks that are shown and that a scene must have, at most 10."""
    _grounds: MapCache[_Ground] = field(
        default_factory=_ground_cache, init=False, repr=False, compare=False
    )

    name: ClassVar[str] = "mtp"
    channels: ClassVar[tuple[str, ...]] = ("red", "green", "blue")
    """Names of the channels, whose values are 0 to 255."""

    def __post_init__(self) -> None:
        """Checks the number of past ticks.

        Raises:
            AspEnvError: it is not within 1 and 10.
        """
        if not 1 <= self.history <= FADE_TICKS:
            raise AspEnvError(f"view 'mtp': history is {self.history}, expected 1 to {FADE_TICKS}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles contain the configuration, not the cached maps."""
        return (MTP, (self.viewport, self.history))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, height and width of one raster."""
        return (len(self.channels), self.viewport.height_px, self.viewport.width_px)

    def config(self) -> dict[str, Any]:
        """The name and all options of the view, ready for JSON."""
        return {"name": self.name, "history": self.history, **self.viewport.config()}

    @classmethod
    def make(cls, pixels: tuple[int, int] | None = None) -> "MTP":
        """A view of the default extent, 72 m by 72 m.

        Args:
            pixels: height and width; 360x360 if omitted.

        Raises:
            AspEnvError: the pixels would not be square.
        """
        return cls(_VIEWPORT.scaled(pixels))

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> "MTP":
        """The view that `config()` describes.

        At most 10 past ticks are shown if `history` is longer; its default is 10.

        Raises:
            AspEnvError: the configuration is of another view, or a field is wrong.
        """
        fields = dict(config)
        name, history = fields.pop("name", None), fields.pop("history", FADE_TICKS)
        if name != cls.name:
            raise AspEnvError(f"configuration of the view {name!r}, expected {cls.name!r}")
        check_fields(cls, {"history": history})
        return cls(Viewport.from_config(fields), min(history, FADE_TICKS))

    def render(
        self, scene: RenderInput, out: np.ndarray | None = None
    ) -> UInt8[np.ndarray, "t 3 h w"]:
        """Renders one raster per target, in the order of `scene.targets`.

        Args:
            scene: a scene with at least `history` past ticks.
            out: array to render into, (targets, 3, height, width) uint8, C-contiguous, of any
                content; a new array is made if it is omitted.

        Returns:
            `out` or the new array: red, green and blue, 0 to 255.

        Raises:
            AspEnvError: the history is too short, or `out` does not fit.
        """
        placed = place_targets(scene, self.viewport, history=self.history, view_name=self.name)
        out = raster_memory((len(scene.targets), *self.shape), out)
        out[placed.map_of_target < 0, 0] = 0
        half_width = self.viewport.half_line_px(BOUNDARY_WIDTH_M)
        for index, road_map in enumerate(scene.maps):
            ground = self._grounds(road_map)
            fill_rings(ground.drivable, index, placed, _ROAD, out)
            draw_coloured_lines(ground.dashed, index, placed, half_width, _DASHED, out)
            draw_coloured_lines(ground.boundaries, index, placed, half_width, _BOUNDARY, out)
        # The classes of absent agents may be any number.
        classes = np.where(placed.valid.any(axis=2), scene.classes, AgentClass.CAR)
        skipped = FADE_TICKS - self.history
        colours = _OLDEST[classes] + skipped
        order = np.argsort(colours, axis=1, kind="stable")
        draw_coloured_agents(placed, colours, order, _OLDEST_OF_TARGET + skipped, out)
        _apply_palette(_WORDS, out)
        return out
