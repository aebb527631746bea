"""The MTP view: road and road users in the colours of an RGB picture, their past fading.

After Cui et al., Multimodal Trajectory Predictions (2019), in the colours of its implementation in
the nuScenes devkit. One picture for each target of a scene, in the target's frame now: heading up,
by default 360x360 pixels of 0.2 m with the target's centre at row 288 (80 % from the top) and
column 180, so 57.6 m ahead, 14.4 m behind and 36 m to either side are seen.

Painted in this order, what comes later over what came before:

| what | colour |
|---|---|
| ground | black (0, 0, 0) |
| drivable area | white (255, 255, 255) |
| dashed lines, 0.3 m wide, drawn through | light blue (0, 153, 255) |
| curbs and solid lines, 0.3 m wide | blue (0, 0, 255) |
| boxes of vehicles | yellow (255, 255, 0) |
| boxes of objects: agents of the class `other` | violet (204, 0, 204) |
| boxes of humans and animals: pedestrians, bicycles, animals | orange (255, 153, 51) |
| boxes of the target, of whatever class | red (255, 0, 0) |

Boxes are drawn at the last 11 states: those of the others tick by tick, oldest first, at each tick
vehicles before objects before humans; then those of the target. Brightness (the largest of the
three values, as the V of HSV) rises in equal steps from 0.4 two seconds ago, at ticks of 0.2 s, to
the colour's own now. So overlapping boxes of the others look the same whoever comes first, and the
picture does not depend on the order of slots, nor on the other targets of the scene.

The devkit counts bicycles among the vehicles. Here they are human: they have a rider, and some
recordings do not tell cyclists from pedestrians. Virtual lines are not drawn. What is not valid is
not drawn; a target that is not valid now has a black picture. Lines are at least 1.5 pixels wide
and boxes at least one, so neither vanishes at coarse scales.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, final, no_type_check

import numpy as np
from jaxtyping import Int64, UInt8, UInt32
from numba import njit

from asp_env.data.classes import VULNERABLE, AgentClass
from asp_env.data.road_map import LineType, MapCache, RoadMap
from asp_env.errors import AspEnvError
from asp_env.views.draw import draw_coloured_agents, draw_coloured_lines
from asp_env.views.map_layers import (
    BOUNDARY_WIDTH_M,
    Rings,
    boundary_pieces,
    drivable_rings,
    fill_rings,
)
from asp_env.views.view import Drawable, View, memory, place

DASHED_RGB = (0, 153, 255)
BOUNDARY_RGB = (0, 0, 255)
VEHICLE_RGB = (255, 255, 0)
OBJECT_RGB = (204, 0, 204)
HUMAN_RGB = (255, 153, 51)
TARGET_RGB = (255, 0, 0)

FADE_TICKS = 10
"""Past ticks that are drawn: 2 s at ticks of 0.2 s."""
OLDEST_VALUE = 0.4
"""Brightness of the oldest boxes."""

_VIEW = View(
    height_px=360, width_px=360, metres_per_pixel=0.2, anchor_row_px=288.0, anchor_column_px=180.0
)


# Pictures are painted in numbers of colours, in one plane, and coloured at the end.
_ROAD, _DASHED, _BOUNDARY, _AGENTS = 1, 2, 3, 4


def palette() -> UInt8[np.ndarray, "colours 3"]:
    """The colours by number: ground, road, dashed lines, boundaries, then 11 for each kind of box.

    The kinds are vehicles, objects, humans and the target; their colours go from old to new.
    """
    still = np.array([(0, 0, 0), (255, 255, 255), DASHED_RGB, BOUNDARY_RGB], dtype=np.float64)
    now = np.array([VEHICLE_RGB, OBJECT_RGB, HUMAN_RGB, TARGET_RGB], dtype=np.float64)
    value_now = now.max(axis=1) / 255
    value = np.linspace(OLDEST_VALUE, value_now, FADE_TICKS + 1, axis=1)
    faded = now[:, None] * (value / value_now[:, None])[..., None]
    return np.rint(np.concatenate([still, faded.reshape(-1, 3)])).astype(np.uint8)


def _oldest_colours() -> Int64[np.ndarray, " classes"]:
    """The number of the oldest colour of each class of agents."""
    kind = np.zeros(len(AgentClass), dtype=np.int64)
    kind[AgentClass.OTHER] = 1
    kind[[int(one) for one in VULNERABLE]] = 2
    return _AGENTS + kind * (FADE_TICKS + 1)


def _as_words(colours: UInt8[np.ndarray, "colours 3"]) -> UInt32[np.ndarray, " colours"]:
    """Red, green and blue of each colour in one number: red + 256 · green + 65536 · blue."""
    return (colours.astype(np.uint32) << np.array([0, 8, 16], dtype=np.uint32)).sum(
        axis=1, dtype=np.uint32
    )


_WORDS, _OLDEST = _as_words(palette()), _oldest_colours()
_OLDEST_OF_TARGET = _AGENTS + 3 * (FADE_TICKS + 1)


@njit(cache=True, nogil=True)
@no_type_check
def _colour(words, out):
    """Turns numbers of colours in channel 0 of (pictures, 3, height, width) into red, green, blue.

    Four plain loops, because the compiler makes vectors of each.
    """
    height, width = out.shape[2:]
    found = np.empty(width, np.uint32)
    for picture in out:
        for r in range(height):
            red, green, blue = picture[0, r], picture[1, r], picture[2, r]
            for i in range(width):
                found[i] = words[red[i]]
            for i in range(width):
                red[i] = np.uint8(found[i])
            for i in range(width):
                green[i] = np.uint8(found[i] >> np.uint32(8))
            for i in range(width):
                blue[i] = np.uint8(found[i] >> np.uint32(16))


class _Ground(NamedTuple):
    """What is drawn of a map."""

    drivable: Rings
    dashed: np.ndarray
    boundaries: np.ndarray


def _ground(road_map: RoadMap) -> _Ground:
    return _Ground(
        drivable=drivable_rings(road_map),
        dashed=boundary_pieces(road_map, (LineType.DASHED,)),
        boundaries=boundary_pieces(road_map),
    )


def _cache() -> MapCache[_Ground]:
    return MapCache(_ground)


@final
@dataclass(frozen=True, slots=True)
class MTP:
    """Draws scenes as the module's documentation says. Equal when the configurations are."""

    view: View = _VIEW
    _grounds: MapCache[_Ground] = field(
        default_factory=_cache, init=False, repr=False, compare=False
    )

    name: ClassVar[str] = "mtp"
    channels: ClassVar[tuple[str, ...]] = ("red", "green", "blue")
    """Values are colours, not 0 and 255 alone."""
    history: ClassVar[int] = FADE_TICKS
    """Past ticks that a scene must have."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles carry the configuration, not the drawn maps."""
        return (MTP, (self.view,))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of one picture: channels, height, width."""
        return (len(self.channels), self.view.height_px, self.view.width_px)

    def config(self) -> dict[str, Any]:
        """Everything that decides the picture, ready for JSON."""
        return {"name": self.name, **self.view.config()}

    @classmethod
    def make(cls, pixels: tuple[int, int] | None = None) -> "MTP":
        """Of the usual 72 m x 72 m, in so many pixels (height, width).

        Raises:
            AspEnvError: the pixels would not be square.
        """
        return cls(_VIEW.scaled(pixels))

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> "MTP":
        """The view that `config()` described.

        Raises:
            AspEnvError: the configuration is of another view, or a field is wrong.
        """
        fields = dict(config)
        name = fields.pop("name", None)
        if name != cls.name:
            raise AspEnvError(f"configuration of the view {name!r}, expected {cls.name!r}")
        return cls(View.from_config(fields))

    def draw(self, scene: Drawable, out: np.ndarray | None = None) -> UInt8[np.ndarray, "t 3 h w"]:
        """One picture per target, in the order of `scene.targets`.

        Args:
            scene: with at least 10 past ticks.
            out: memory to draw into, (targets, 3, height, width) uint8, C-contiguous; its former
                content does not matter. Fresh memory where it is not given.

        Returns:
            `out`, or the fresh memory: red, green and blue, 0 to 255.

        Raises:
            AspEnvError: the history is too short, or `out` does not fit.
        """
        placed = place(scene, self.view, history=self.history, who=self.name)
        out = memory((len(scene.targets), *self.shape), out)
        out[placed.map_of_target < 0, 0] = 0
        half_width = self.view.half_line_px(BOUNDARY_WIDTH_M)
        for index, road_map in enumerate(scene.maps):
            ground = self._grounds(road_map)
            fill_rings(ground.drivable, index, placed, _ROAD, out)
            draw_coloured_lines(ground.dashed, index, placed, half_width, _DASHED, out)
            draw_coloured_lines(ground.boundaries, index, placed, half_width, _BOUNDARY, out)
        # Absent agents may be of any class, even of none.
        classes = np.where(placed.valid.any(axis=2), scene.classes, AgentClass.CAR)
        colours = _OLDEST[classes]
        order = np.argsort(colours, axis=1, kind="stable")
        draw_coloured_agents(placed, colours, order, _OLDEST_OF_TARGET, out)
        _colour(_WORDS, out)
        return out
