"""What the egos of a world see now: its last ticks, without what an observation does not need.

MERGED: The kinds of observation, each with its spaces and the writing of its arrays.

Every value is finite and lies within the bounds of its space; what would lie beyond is moved there.
MERGED: What an agent is shown: pictures, vectors, action history, state and route, in any choice.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, final, no_type_check, runtime_checkable

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float, Int, Shaped
from numba import njit

from asp_env.data.road_map import RoadMap
from asp_env.data.scene import EGO, infer_actions
from asp_env.dynamics import MAX_STEERING_RAD
from asp_env.errors import AspEnvError, unknown_name
from asp_env.geometry import wrap_angle
from asp_env.sim.episodes import last_ticks
from asp_env.sim.world import Events, World
from asp_env.views import VIEWS, RasterView, make_raster_view
from asp_env.views.vectors import AGENT_FIELDS, LINE_FIELDS, VectorBounds, Vectors, VectorView


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationContext:
    """B situations, each seen by its targets: a `Scene` without actions, whose fields views read.

    Of agents that were not there at any tick, sizes, classes and ids mean nothing.
    """

    states: Float[np.ndarray, "b a ticks 4"]
    """Zeros where not valid."""
    valid: Bool[np.ndarray, "b a ticks"]
    sizes: Float[np.ndarray, "b a 2"]
    classes: Int[np.ndarray, "b a"]
    ids: Int[np.ndarray, "b a"]
    targets: Int[np.ndarray, "t 2"]
    """(situation, slot) of those who see."""
    routes: Float[np.ndarray, "t p 2"]
    """The way of each target, points 1 m apart."""
    route_valid: Bool[np.ndarray, "t p"]
    maps: tuple[RoadMap, ...]
    map_index: Int[np.ndarray, " b"]
    dt_s: float

    @property
    def history(self) -> int:
        """Past ticks."""
        return self.states.shape[2] - 1


def ego_context(world: World, rows: Int[np.ndarray, " n"] | None = None) -> ObservationContext:
    """What the egos of some episodes see, by default of all; situation i is episode `rows[i]`."""
    data = world.episodes
    maps, map_index = world.maps()
    everyone = rows is None
    rows = np.arange(len(world)) if rows is None else rows
    targets = np.full((len(rows), 2), EGO)
    targets[:, 0] = np.arange(len(rows))
    states, valid = last_ticks(data, world.now, rows, world.history)
    sizes, classes, ids, routes, route_valid = (
        column if everyone else column[rows]
        for column in (data.sizes, data.classes, data.ids, data.route, data.route_valid)
    )
    return ObservationContext(
        states=states,
        valid=valid,
        sizes=sizes,
        classes=classes,
        ids=ids,
        targets=targets,
        routes=routes,
        route_valid=route_valid,
        maps=maps,
        map_index=map_index if everyone else map_index[rows],
        dt_s=world.dt_s,
    )


FARTHEST_M = 1000.0
"""Positions in an ego's frame are shown up to here."""

FASTEST_MPS = 60.0

MAX_SEEN_ACCELERATION_MPS2 = 10.0
"""Inferred accelerations beyond this are shown as this, so that the space is bounded."""

STATE_FIELDS: dict[str, tuple[float, float]] = {
    "speed_mps": (-FASTEST_MPS, FASTEST_MPS),
    "acceleration_mps2": (-MAX_SEEN_ACCELERATION_MPS2, MAX_SEEN_ACCELERATION_MPS2),
    "steering_rad": (-MAX_STEERING_RAD, MAX_STEERING_RAD),
    "route_offset_m": (-50.0, 50.0),
    "route_heading_error_rad": (-float(np.pi), float(np.pi)),
    "route_done": (-1.0, 2.0),
    "to_goal_m": (-200.0, 1000.0),
    "length_m": (0.0, 30.0),
    "width_m": (0.0, 10.0),
}
"""Fields of the `state` observation in their order, with their bounds."""

ROUTE_POINTS = 30

ROUTE_STEP_M = 2.0
"""Between the points of the `route` observation; the first lies this far ahead of the ego."""

Arrays = dict[str, np.ndarray]
Spaces = dict[str, spaces.Box[Any]]


@final
class RasterComponent:
    """The picture that a view draws: uint8 (channels, height, width)."""

    def __init__(self, name: str, view: RasterView) -> None:
        """A part of that name."""
        self._name, self._view = name, view
        self.history = view.history
        self.spaces: Spaces = {name: spaces.Box(0, 255, view.shape, dtype=np.uint8)}

    def write(self, sight: ObservationContext, events: Events, out: Arrays) -> None:
        """Draws into the memory itself."""
        del events
        self._view.render(sight, out[self._name])


@final
class VectorsComponent:
    """The agents and the lines around the ego, as `asp_env.views.vectors` tells them.

    Tables of agents (time by time) and of lines (point by point), each with a mask of 0 and 1.
    """

    def __init__(self, view: VectorView) -> None:
        """Of that many agents and lines."""
        self._view = view
        self.history = view.history
        shape = view.shape
        agents, lines = (shape.agents, shape.ticks), (shape.lines, shape.points)
        self.spaces: Spaces = {
            "agents": _box(*_field_bounds(AGENT_FIELDS), agents),
            "agents_valid": spaces.Box(0, 1, agents, dtype=np.int8),
            "lines": _box(*_field_bounds(LINE_FIELDS), lines),
            "lines_valid": spaces.Box(0, 1, lines, dtype=np.int8),
        }
        bounds = (self.spaces["agents"], self.spaces["lines"])
        self._within = VectorBounds(
            *(bound.reshape(-1) for box in bounds for bound in (box.low, box.high))
        )

    def write(self, sight: ObservationContext, events: Events, out: Arrays) -> None:
        """Writes into the memory itself."""
        del events
        masks = out["agents_valid"].view(np.bool_), out["lines_valid"].view(np.bool_)
        memory = Vectors(out["agents"], masks[0], out["lines"], masks[1])
        self._view.render(sight, memory, self._within)


@final
class ActionsComponent:
    """The inferred actions of the last ticks, oldest first: (ticks, 2) of m/s² and rad."""

    def __init__(self, history: int) -> None:
        """Of that many ticks."""
        self.history = history
        limit = np.array([MAX_SEEN_ACCELERATION_MPS2, MAX_STEERING_RAD])
        self.spaces: Spaces = {"actions": _box(-limit, limit, (history,))}

    def write(self, sight: ObservationContext, events: Events, out: Arrays) -> None:
        """Infers those of the targets alone."""
        del events
        out["actions"][:] = _actions(sight, self.history)
        _clip_to(self.spaces["actions"], out["actions"])


@final
class StateComponent:
    """How the ego moves and where it is on its route: `STATE_FIELDS`."""

    history = 1

    def __init__(self) -> None:
        """The bounds are those of the fields."""
        low, high = np.array(list(STATE_FIELDS.values())).T
        self.spaces: Spaces = {"state": _box(low, high, ())}

    def write(self, sight: ObservationContext, events: Events, out: Arrays) -> None:
        """The fields in their order."""
        at = sight.targets[:, 0], sight.targets[:, 1]
        ego, action, size = sight.states[at][:, -1], _actions(sight, 1)[:, 0], sight.sizes[at]
        columns = (
            ego[:, 3],
            action[:, 0],
            action[:, 1],
            events.route_offset_m,
            wrap_angle(ego[:, 2] - events.route_heading_rad),
            events.route_m / np.maximum(events.goal_m, 1.0),
            events.goal_m - events.route_m,
            size[:, 0],
            size[:, 1],
        )
        for field, column in enumerate(columns):
            out["state"][:, field] = column
        _clip_to(self.spaces["state"], out["state"])


@final
class RouteComponent:
    """The way ahead from where the ego is on its route, as far as it is seen in its frame.

    (points, 2): x ahead and y to the left, m. Beyond the route's ends it goes on straight.
    """

    history = 0

    def __init__(self) -> None:
        """Of `ROUTE_POINTS` points."""
        high = np.full(2, FARTHEST_M)
        self.spaces: Spaces = {"route": _box(-high, high, (ROUTE_POINTS,))}

    def write(self, sight: ObservationContext, events: Events, out: Arrays) -> None:
        """Writes into the memory itself."""
        egos = sight.states[sight.targets[:, 0], sight.targets[:, 1], -1]
        counts = sight.route_valid.sum(axis=1)
        _way_ahead(sight.routes, counts, events.route_m, egos, ROUTE_STEP_M, out["route"])
        _clip_to(self.spaces["route"], out["route"])


def _field_bounds(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Of the fields of agents or lines; all but some lie between 0 and 1."""
    wide = {"x": FARTHEST_M, "y": FARTHEST_M, "cos": 1.0, "sin": 1.0, "speed": FASTEST_MPS}
    sizes = {"length": STATE_FIELDS["length_m"][1], "width": STATE_FIELDS["width_m"][1]}
    low = [-wide[name] if name in wide else 0.0 for name in names]
    return np.array(low), np.array([wide.get(name, sizes.get(name, 1.0)) for name in names])


def _box(low: np.ndarray, high: np.ndarray, leading: tuple[int, ...]) -> spaces.Box[Any]:
    """A table of float32 whose last axis has these bounds."""
    shape = (*leading, len(low))
    return spaces.Box(
        np.broadcast_to(low, shape).astype(np.float32),
        np.broadcast_to(high, shape).astype(np.float32),
        dtype=np.float32,
    )


def _clip_to(box: spaces.Box[Any], values: np.ndarray) -> None:
    """Moves what lies outside a space into it."""
    _clip(values.reshape(len(values), -1), box.low.reshape(-1), box.high.reshape(-1))


def _actions(sight: ObservationContext, ticks: int) -> np.ndarray:
    """The last inferred actions of the targets, (targets, ticks, 2)."""
    at = sight.targets[:, 0], sight.targets[:, 1]
    states, valid = sight.states[at][:, -ticks - 1 :], sight.valid[at][:, -ticks - 1 :]
    return infer_actions(states, valid, sight.sizes[at][:, 0], sight.dt_s)


@njit(cache=True)
@no_type_check
def _clip(rows, low, high):
    """Moves every number of every row into the bounds of its column, NaN to the lower one."""
    # In this form the compiler makes vectors of it: a fifth of the time of `np.clip`.
    for t in range(len(rows)):
        row = rows[t]
        for i in range(len(low)):
            value, least, most = row[i], low[i], high[i]
            value = value if value >= least else least
            row[i] = value if value <= most else most


@njit(cache=True)
@no_type_check
def _way_ahead(routes, counts, arcs, egos, step_m, out):
    """Points of each route ahead of an arc length, in the frame of each ego."""
    for t in range(len(out)):
        route, last = routes[t], counts[t] - 2
        cos, sin = math.cos(egos[t, 2]), math.sin(egos[t, 2])
        for k in range(out.shape[1]):
            arc = arcs[t] + (k + 1) * step_m
            i = min(max(math.floor(arc), 0), last)
            dx = route[i, 0] + (arc - i) * (route[i + 1, 0] - route[i, 0]) - egos[t, 0]
            dy = route[i, 1] + (arc - i) * (route[i + 1, 1] - route[i, 1]) - egos[t, 1]
            out[t, k, 0] = cos * dx + sin * dy
            out[t, k, 1] = cos * dy - sin * dx


PICTURES = tuple(name for name in VIEWS if not name.startswith("vectors"))
"""Views that can be asked for by name, beside the raster."""

KNOWN = ("raster", "vectors", "actions", "state", "route", *PICTURES)

Observation = dict[str, Shaped[np.ndarray, "t ..."]]
"""One array per part, with those who see first."""


@runtime_checkable
class ObservationComponent(Protocol):
    """One kind of observation, which fills one or several parts of the whole."""

    @property
    def history(self) -> int:
        """Past ticks that it needs."""
        ...

    @property
    def spaces(self) -> Spaces:
        """The space of each part, for one target."""
        ...

    def write(self, sight: ObservationContext, events: Events, out: Observation) -> None:
        """What each target sees, into the parts' arrays of `out`."""
        ...


class Observer:
    """Turns what is seen into observations; draws nothing that is not asked for."""

    def __init__(self, names: Sequence[str], raster: RasterView, history: int) -> None:
        """An observer of the named kinds of observation.

        Args:
            names: some of `KNOWN`.
            raster: what draws the part `raster`.
            history: past ticks of what will be seen.

        Raises:
            AspEnvError: a name is unknown or given twice, there is none, or the history is shorter
                than one of them needs.
        """
        if isinstance(names, str) or not len(names):
            given = f"observations {names!r}" if names else "no observation given"
            raise AspEnvError(f"{given}: expected some of {', '.join(KNOWN)}")
        self._parts: list[ObservationComponent] = []
        for name in names:
            if name not in KNOWN:
                raise unknown_name("observation", name, KNOWN)
            part = _make(name, raster, history)
            if part.history > history:
                raise AspEnvError(
                    f"observation {name!r} needs {part.history} past ticks, there are {history}: "
                    "choose a shorter time step"
                )
            self._parts.append(part)
        if len(set(names)) < len(names):
            raise AspEnvError(f"observations {', '.join(names)}: name each once")
        boxes = {name: box for part in self._parts for name, box in part.spaces.items()}
        self.space = spaces.Dict(list(boxes.items()))
        self._shapes = {name: (box.shape, box.dtype) for name, box in boxes.items()}

    def memory(self, count: int) -> Observation:
        """Fresh memory for what `count` targets see."""
        return {
            name: np.empty((count, *shape), dtype=dtype)
            for name, (shape, dtype) in self._shapes.items()
        }

    def observe(
        self, sight: ObservationContext, events: Events, out: Observation | None = None
    ) -> Observation:
        """What each target sees.

        Args:
            sight: of all targets.
            events: of the same targets, row by row.
            out: from `memory`, to write into; its former content does not matter. Fresh memory
                where it is not given.
        """
        out = self.memory(len(sight.targets)) if out is None else out
        for part in self._parts:
            part.write(sight, events, out)
        return out


def _make(name: str, raster: RasterView, history: int) -> ObservationComponent:
    if name == "raster":
        return RasterComponent(name, raster)
    if name == "vectors":
        return VectorsComponent(VectorView())
    if name == "actions":
        return ActionsComponent(history)
    if name == "state":
        return StateComponent()
    if name == "route":
        return RouteComponent()
    return RasterComponent(name, make_raster_view(name))
