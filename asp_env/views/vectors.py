"""The vector view: the agents and the lines around each target as numbers, without pixels.

After Gao et al., VectorNet (2020): what a raster shows, as polylines. Everything is in the target's
own frame now, x ahead and y to the left, in metres, radians (as cosine and sine) and m/s.

- Agents: the target first, then the agents nearest to it that are there now, nearest first, ties by
  id; each with its states over the last 15 ticks and the present one. An agent that is not there
  now is left out, and so are single ticks at which it was not seen.
- Lines: pieces of lane centre lines, curbs, solid and dashed lines, of 25 m at most, in the order
  of the map. They are chosen by the distance of their middles from a point 20 m ahead, across the
  target's heading counted 1.5-fold: that is 72 m by 48 m, most of it ahead, before all else.

What is not valid is all zeros. A target that is not there now sees nothing. Neither the order of
slots nor the other targets of a scene change anything. With `own_past` off, the target itself is
shown at present alone: what a network then knows of its past it is given as actions.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.classes import AgentClass
from asp_env.errors import AspEnvError
from asp_env.views.boundaries import MapCache
from asp_env.views.drawable import Drawable
from asp_env.views.lane_pieces import KINDS, POINTS, LanePieces, lane_pieces
from asp_env.views.neighbourhood import place_agents, place_lines, target_poses

GROUPS = {
    "car": (AgentClass.CAR, AgentClass.VAN),
    "heavy": (AgentClass.TRUCK, AgentClass.BUS, AgentClass.TRUCK_BUS, AgentClass.TRAILER),
    "two_wheeler": (AgentClass.MOTORCYCLE, AgentClass.BICYCLE),
    "pedestrian": (AgentClass.PEDESTRIAN,),
    "other": (AgentClass.ANIMAL, AgentClass.OTHER),
}
"""Classes that networks tell apart."""

AGENT_FIELDS = ("x", "y", "cos", "sin", "speed", "length", "width", *GROUPS)
LINE_FIELDS = ("x", "y", "cos", "sin", *KINDS)

_GROUP_OF_CLASS = np.array(
    [next(i for i, kinds in enumerate(GROUPS.values()) if kind in kinds) for kind in AgentClass]
)


class Vectors(NamedTuple):
    """What N targets see, each in its own frame now; zeros where not valid."""

    agents: Float[np.ndarray, "n agents ticks fields"]
    """float32, as `AGENT_FIELDS`; agent 0 is the target, the last tick is now."""
    agents_valid: Bool[np.ndarray, "n agents ticks"]
    lines: Float[np.ndarray, "n lines points line_fields"]
    """float32, as `LINE_FIELDS`."""
    lines_valid: Bool[np.ndarray, "n lines points"]


class VectorBounds(NamedTuple):
    """The least and the most of every number of what one target sees, float32; or nothing."""

    agents_low: Float[np.ndarray, " agent_numbers"]
    agents_high: Float[np.ndarray, " agent_numbers"]
    lines_low: Float[np.ndarray, " line_numbers"]
    lines_high: Float[np.ndarray, " line_numbers"]


BOUNDLESS = VectorBounds(*(np.empty(0, dtype=np.float32) for _ in range(4)))


@dataclass(frozen=True, slots=True, kw_only=True)
class VectorShape:
    """The sizes of `Vectors`, without the number of targets."""

    agents: int
    ticks: int
    agent_fields: int
    lines: int
    points: int
    line_fields: int


_OPTIONS = ("agents", "lines", "own_past")


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class VectorView:
    """Draws scenes as the module's documentation says. Equal when the configurations are."""

    agents: int = 16
    """The target and its nearest neighbours."""
    lines: int = 64
    own_past: bool = True
    """Whether the target's own states before now are shown."""
    _pieces: MapCache[LanePieces] = field(
        default_factory=lambda: MapCache(lane_pieces),
        init=False,
        repr=False,
        compare=False,
    )
    """About 60 kB for each map; batches come from many."""

    history: ClassVar[int] = 15
    """Past ticks that a scene must have."""

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            AspEnvError: there would be no target, or a number is negative.
        """
        if self.agents < 1 or self.lines < 0:
            raise AspEnvError(
                f"view {self.name!r} with {self.agents} agents and {self.lines} lines: give at "
                "least 1 agent, which is the target itself, and no fewer than 0 lines"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles carry the configuration, not the maps."""
        return (VectorView.from_config, (self.config(),))

    @property
    def name(self) -> str:
        """`vectors`, or `vectors-no-trail` where the target's own past is not shown."""
        return "vectors" if self.own_past else "vectors-no-trail"

    @property
    def shape(self) -> VectorShape:
        """Of what is drawn."""
        return VectorShape(
            agents=self.agents,
            ticks=self.history + 1,
            agent_fields=len(AGENT_FIELDS),
            lines=self.lines,
            points=POINTS,
            line_fields=len(LINE_FIELDS),
        )

    def config(self) -> dict[str, Any]:
        """Everything that decides what is drawn, ready for JSON."""
        return {"name": self.name, **{field: getattr(self, field) for field in _OPTIONS}}

    @classmethod
    def make(cls, pixels: tuple[int, int] | None = None, *, own_past: bool = True) -> "VectorView":
        """With the usual numbers of agents and lines.

        Raises:
            AspEnvError: pixels are given, and vectors have none.
        """
        if pixels is not None:
            raise AspEnvError(
                f"vectors of {pixels[0]}x{pixels[1]} pixels: this view draws no pictures, leave "
                "their size out"
            )
        return cls(own_past=own_past)

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> "VectorView":
        """The view that `config()` described.

        Raises:
            AspEnvError: the configuration is of another view, or a field is wrong.
        """
        fields = dict(config)
        name = fields.pop("name", None)
        unknown = sorted(set(fields) - set(_OPTIONS))
        if unknown:
            raise AspEnvError(
                f"view configuration with {', '.join(unknown)}: known are {', '.join(_OPTIONS)}"
            )
        view = cls(**fields)
        if name != view.name:
            raise AspEnvError(f"configuration of the view {name!r}, expected {view.name!r}")
        return view

    def draw(
        self, scene: Drawable, out: Vectors | None = None, within: VectorBounds = BOUNDLESS
    ) -> Vectors:
        """What each target sees, in the order of `scene.targets`.

        Args:
            scene: with at least 15 past ticks.
            out: memory to write into, whose former content does not matter; fresh memory where it
                is not given.
            within: what lies outside is moved to the bounds.

        Raises:
            AspEnvError: the history is too short, or `out` does not fit.
        """
        if scene.history < self.history:
            raise AspEnvError(
                f"view {self.name!r} needs {self.history} past ticks, the scene has "
                f"{scene.history}: take a longer history"
            )
        out = self._memory(len(scene.targets), out)
        states = np.ascontiguousarray(scene.states[:, :, -self.history - 1 :], dtype=np.float32)
        valid = np.ascontiguousarray(scene.valid[:, :, -self.history - 1 :])
        targets = np.ascontiguousarray(scene.targets, dtype=np.int64)
        poses, frames = np.empty((len(targets), 3)), np.empty((len(targets), 4))
        target_poses(states, valid, targets, poses)
        frames[:, :2] = poses[:, :2]
        np.cos(poses[:, 2], out=frames[:, 2])
        np.sin(poses[:, 2], out=frames[:, 3])
        place_agents(
            states,
            valid,
            np.ascontiguousarray(scene.sizes, dtype=np.float32),
            scene.classes,
            _GROUP_OF_CLASS,
            scene.ids,
            targets,
            frames,
            self.own_past,
            within.agents_low,
            within.agents_high,
            out.agents,
            out.agents_valid,
        )
        for index, road_map in enumerate(scene.maps):
            pieces = self._pieces(road_map)
            place_lines(
                pieces.middles,
                pieces.points,
                pieces.kinds,
                valid,
                targets,
                scene.map_index == index,
                frames,
                within.lines_low,
                within.lines_high,
                out.lines,
                out.lines_valid,
            )
        return out

    def _memory(self, count: int, out: Vectors | None) -> Vectors:
        """`out`, or fresh memory where there is none."""
        shapes = self._shapes(count)
        if out is None:
            kinds = (np.float32, np.bool_, np.float32, np.bool_)
            return Vectors(*(np.empty(*each) for each in zip(shapes, kinds, strict=True)))
        found = tuple(part.shape for part in out)
        if found != shapes or not all(part.flags.c_contiguous for part in out):
            raise AspEnvError(f"cannot draw into {found}: give C-contiguous arrays {shapes}")
        return out

    def _shapes(self, count: int) -> tuple[tuple[int, ...], ...]:
        """Of the arrays of `Vectors`."""
        agents, lines = (count, self.agents, self.history + 1), (count, self.lines, POINTS)
        return (*agents, len(AGENT_FIELDS)), agents, (*lines, len(LINE_FIELDS)), lines
