"""The lines of a road map as short polylines of equally many points, ready to be chosen from.

MERGED: Who and what is near each target of a scene: the compiled part of the vector view.

All kernels are in this one file because numba's cache watches only the file of the kernel that is
called from Python: another file's change would go unnoticed.
MERGED: The vector view: the agents and the lines around each target as numbers, without pixels.

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

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, final, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from asp_env.data.classes import AgentClass
from asp_env.data.road_map import LineType, MapCache, RoadMap
from asp_env.errors import AspEnvError
from asp_env.geometry import arc_lengths, points_at
from asp_env.views.view import Drawable

KINDS = ("lane", "curb", "solid", "dashed")
"""What a piece is: the centre line of a lane in its direction of travel, or a line that can be
seen. Virtual lines cannot, and the lanes between them are told by their centre lines."""

KIND_OF_LINE = {LineType.CURB: 1, LineType.SOLID: 2, LineType.DASHED: 3}

POINTS = 10
"""Of each piece: 2.8 m apart at most, so that arcs of 10 m radius are followed to 10 cm."""

PIECE_M = 25.0
"""Longer lines are cut into equal pieces of at most this length."""

TANGENT_M = 0.5
"""Directions are taken between the points of the line this far behind and before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LanePieces:
    """The pieces of one map, in its order: lanes first, then lines."""

    middles: Float[np.ndarray, "2 pieces"]
    """Halfway along each piece, metres; x of all, then y of all."""
    points: Float[np.ndarray, "pieces points 4"]
    """[x m, y m, direction cos, direction sin] at equal distances, both ends included."""
    kinds: Int[np.ndarray, " pieces"]
    """Index into `KINDS`."""


def lane_pieces(road_map: RoadMap) -> LanePieces:
    """Cuts the lanes and the visible lines of a map into pieces; lines without extent are none."""
    lines = [(0, road_map.lanes[lane]) for lane in range(len(road_map.lanes))]
    lines += [
        (KIND_OF_LINE[LineType(kind)], road_map.lines[line])
        for line, kind in enumerate(road_map.line_types)
        if kind in KIND_OF_LINE
    ]
    middles, points, kinds = [np.zeros((0, 2))], [np.zeros((0, POINTS, 4))], [np.zeros(0)]
    for kind, line in lines:
        middle, piece = _cut(line)
        middles.append(middle)
        points.append(piece)
        kinds.append(np.full(len(middle), kind))
    return LanePieces(
        middles=np.ascontiguousarray(np.concatenate(middles).T),
        points=np.concatenate(points),
        kinds=np.concatenate(kinds).astype(np.int64),
    )


def _cut(
    line: Float[np.ndarray, "n 2"],
) -> tuple[Float[np.ndarray, "pieces 2"], Float[np.ndarray, "pieces points 4"]]:
    """Middles and points of the pieces of one line."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    keep = np.concatenate([[True], steps > 0])
    line, arc = line[keep], arc_lengths(line)[keep]
    length = float(arc[-1])
    count = math.ceil(length / PIECE_M - 1e-9)
    share = np.arange(count)[:, None] + np.linspace(0, 1, POINTS)
    at = share * (length / max(count, 1))
    before, behind = np.maximum(at - TANGENT_M, 0), np.minimum(at + TANGENT_M, length)
    along = points_at(line, arc, behind) - points_at(line, arc, before)
    along /= np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-9)[..., None]
    middles = points_at(line, arc, 0.5 * (at[:, 0] + at[:, -1]))
    return middles, np.concatenate([points_at(line, arc, at), along], axis=-1)


AHEAD_M = 20.0
"""How far ahead of the target lies the point around which lines are chosen."""

SIDEWAYS = 1.5
"""What distances across the target's heading are multiplied by in that choice."""

FIRST_GROUP = 7
"""Fields of an agent before those that tell its class."""

FIRST_KIND = 4
"""Fields of a line before those that tell its kind."""


@njit(cache=True, nogil=True)
@no_type_check
def _keep_within(values, low, high):
    """Moves values into their bounds, NaN to the lower one; without bounds does nothing."""
    # In this form the compiler makes vectors of it, which takes a fifth of the time of `np.clip`.
    for i in range(len(low)):
        value, least, most = values[i], low[i], high[i]
        value = value if value >= least else least
        values[i] = value if value <= most else most


@njit(cache=True, nogil=True)
@no_type_check
def target_poses(states, valid, targets, poses):
    """Writes x, y and heading of every target now; of one that is not there, zeros.

    Args:
        states: (situations, slots, ticks, 4) float32, the last tick is now.
        valid: (situations, slots, ticks).
        targets: (targets, 2) situation and slot.
        poses: (targets, 3), written.
    """
    for t in range(len(targets)):
        b, ego = targets[t]
        there = valid[b, ego, -1]
        for column in range(3):  # what is not valid may hold anything
            poses[t, column] = states[b, ego, -1, column] if there else 0.0


@njit(cache=True, nogil=True)
@no_type_check
def place_agents(
    states,
    valid,
    sizes,
    classes,
    groups,
    ids,
    targets,
    frames,
    own_past,
    low,
    high,
    agents,
    agents_valid,
):
    """Writes the agents of every target.

    Args:
        states: (situations, slots, ticks, 4) float32, the last tick is now.
        valid: (situations, slots, ticks).
        sizes: (situations, slots, 2) lengths and widths.
        classes: (situations, slots).
        groups: (classes,) which of the last fields each class sets.
        ids: (situations, slots).
        targets: (targets, 2) situation and slot.
        frames: (targets, 4) x, y, cos and sin of the targets now, float64.
        own_past: whether the targets are shown before now.
        low: (agents · ticks · fields,) the least that is written, or nothing.
        high: (agents · ticks · fields,) the most.
        agents: (targets, agents, ticks, fields), written.
        agents_valid: (targets, agents, ticks), written.
    """
    num_ticks = states.shape[2]
    chosen = np.empty(agents.shape[1], dtype=np.int64)
    distances = np.empty(agents.shape[1])
    for t in range(len(targets)):
        b, ego = targets[t]
        if not valid[b, ego, num_ticks - 1]:
            agents[t], agents_valid[t] = 0.0, False
            continue
        x_0, y_0, cos_0, sin_0 = frames[t, 0], frames[t, 1], frames[t, 2], frames[t, 3]
        count = _choose_agents(
            states[b, :, -1], valid[b, :, -1], ids[b], ego, (x_0, y_0), chosen, distances
        )
        for i in range(count):
            a = chosen[i]
            group = FIRST_GROUP + groups[classes[b, a]]
            first = num_ticks - 1 if i == 0 and not own_past else 0
            for k in range(num_ticks):
                row = agents[t, i, k]
                seen = k >= first and valid[b, a, k]
                agents_valid[t, i, k] = seen
                if not seen:
                    row[:] = 0.0
                    continue
                dx, dy = states[b, a, k, 0] - x_0, states[b, a, k, 1] - y_0
                cos, sin = math.cos(states[b, a, k, 2]), math.sin(states[b, a, k, 2])
                row[0] = cos_0 * dx + sin_0 * dy
                row[1] = cos_0 * dy - sin_0 * dx
                row[2] = cos_0 * cos + sin_0 * sin
                row[3] = cos_0 * sin - sin_0 * cos
                row[4] = states[b, a, k, 3]
                row[5] = sizes[b, a, 0]
                row[6] = sizes[b, a, 1]
                row[FIRST_GROUP:] = 0.0
                row[group] = 1.0
        agents[t, count:], agents_valid[t, count:] = 0.0, False
        _keep_within(agents[t].reshape(-1), low, high)


@njit(cache=True, nogil=True)
@no_type_check
def _choose_agents(states, valid, ids, ego, origin, chosen, distances):
    """Writes the slots of the ego and then of those nearest to it; returns how many there are.

    Args:
        states: (slots, 4) now.
        valid: (slots,) now.
        ids: (slots,).
        ego: slot of the target.
        origin: where it is.
        chosen: (agents,) is written.
        distances: (agents,) is written, squared.
    """
    chosen[0], distances[0] = ego, -1.0
    count = 1
    for a in range(len(valid)):
        if a == ego or not valid[a]:
            continue
        away = (states[a, 0] - origin[0]) ** 2 + (states[a, 1] - origin[1]) ** 2
        # Sorted by insertion. The farthest falls off the end where there are too many.
        place = count
        while away < distances[place - 1] or (
            away == distances[place - 1] and ids[a] < ids[chosen[place - 1]]
        ):
            place -= 1
            if place + 1 < len(chosen):
                chosen[place + 1], distances[place + 1] = chosen[place], distances[place]
        if place < len(chosen):
            chosen[place], distances[place] = a, away
            count = min(count + 1, len(chosen))
    return count


@njit(cache=True, nogil=True)
@no_type_check
def place_lines(
    middles, points, kinds, valid, targets, here, frames, low, high, lines, lines_valid
):
    """Writes the lines of those targets that are on one map; of one that is not there, zeros.

    Args:
        middles: (2, pieces) of the map's pieces.
        points: (pieces, points, 4) x, y, cos, sin.
        kinds: (pieces,) indices into `KINDS`.
        valid: (situations, slots, ticks), the last tick is now.
        targets: (targets, 2) situation and slot.
        here: (situations,) whether it is on this map.
        frames: (targets, 4) x, y, cos and sin of the targets now, float64.
        low: (lines · points · fields,) the least that is written, or nothing.
        high: (lines · points · fields,) the most.
        lines: (targets, lines, points, fields); those of the targets here are written.
        lines_valid: (targets, lines, points), the same.
    """
    chosen = np.arange(min(lines.shape[1], len(kinds)))
    distances, scratch = np.empty(len(kinds)), np.empty(len(kinds))
    for t in range(len(targets)):
        b, ego = targets[t]
        if not here[b]:
            continue
        if not valid[b, ego, -1]:
            lines[t], lines_valid[t] = 0.0, False
            continue
        x_0, y_0, cos_0, sin_0 = frames[t, 0], frames[t, 1], frames[t, 2], frames[t, 3]
        if len(chosen) < len(kinds):
            _choose_pieces(middles, (x_0, y_0, cos_0, sin_0), chosen, distances, scratch)
        for i in range(len(chosen)):
            piece, kind = points[chosen[i]], FIRST_KIND + kinds[chosen[i]]
            for k in range(points.shape[1]):
                dx, dy = piece[k, 0] - x_0, piece[k, 1] - y_0
                row = lines[t, i, k]
                row[0] = cos_0 * dx + sin_0 * dy
                row[1] = cos_0 * dy - sin_0 * dx
                row[2] = cos_0 * piece[k, 2] + sin_0 * piece[k, 3]
                row[3] = cos_0 * piece[k, 3] - sin_0 * piece[k, 2]
                row[FIRST_KIND:] = 0.0
                row[kind] = 1.0
        lines[t, len(chosen) :] = 0.0
        _keep_within(lines[t].reshape(-1), low, high)
        lines_valid[t, : len(chosen)], lines_valid[t, len(chosen) :] = True, False


@njit(cache=True, nogil=True)
@no_type_check
def _choose_pieces(middles, frame, chosen, distances, scratch):
    """Writes the indices of the nearest pieces in their order; of equally near ones the first.

    Args:
        middles: (2, pieces).
        frame: x, y, cos and sin of the target now.
        chosen: (lines,) is written; fewer than there are pieces.
        distances: (pieces,) is written, squared.
        scratch: (pieces,) is written.
    """
    x_0, y_0, cos_0, sin_0 = frame
    most = len(chosen)
    if most == 0:
        return
    for p in range(len(distances)):
        dx, dy = middles[0, p] - x_0, middles[1, p] - y_0
        ahead = cos_0 * dx + sin_0 * dy - AHEAD_M
        left = SIDEWAYS * (cos_0 * dy - sin_0 * dx)
        distances[p] = ahead * ahead + left * left
    limit = _kth_smallest(distances, most - 1, scratch)
    ties = most
    for p in range(len(distances)):
        ties -= distances[p] < limit
    i = 0
    for p in range(len(distances)):
        if distances[p] < limit or (distances[p] == limit and ties > 0):
            ties -= distances[p] == limit
            chosen[i] = p
            i += 1


@njit(cache=True, nogil=True)
@no_type_check
def _kth_smallest(values, k, scratch):
    """The value that would be at index `k` if the values were sorted (Hoare's selection).

    `np.partition` gives the same and takes three times as long.
    """
    scratch[:] = values
    low, high = 0, len(scratch) - 1
    while low < high:
        pivot = scratch[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while scratch[i] < pivot:
                i += 1
            while scratch[j] > pivot:
                j -= 1
            if i <= j:
                scratch[i], scratch[j] = scratch[j], scratch[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return scratch[k]


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
