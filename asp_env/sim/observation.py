"""Observations: rasters, vectors, actions, state, route and nearest agents, in any combination.

An `Observer` consists of one `ObservationComponent` per name; each writes one or several arrays.
They read an `ObservationContext`: the last ticks of some episodes from the view of their egos.
Every value is finite and within the bounds of its space; values beyond the bounds are clipped.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, final, no_type_check, runtime_checkable

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float, Int, Shaped

from asp_env.compiled import njit
from asp_env.data.road_map import RoadMap
from asp_env.data.scene import EGO, infer_actions
from asp_env.data.signals import SceneSignals
from asp_env.dynamics import MAX_STEERING_RAD
from asp_env.errors import AspEnvError, unknown_name
from asp_env.geometry import wrap_angle
from asp_env.sim.episodes import last_ticks
from asp_env.sim.world import Events, World
from asp_env.views import RasterView, make_raster_view, raster_view_names, view_names
from asp_env.views.vectors import AGENT_FIELDS, LINE_FIELDS, VectorBounds, Vectors, VectorView

COMPONENT_NAMES = ("raster", "vectors", "actions", "state", "route", "nearest")
"""Observations besides the views that render rasters, which are observations by their names."""

MAX_OBSERVED_POSITION_M = 1000.0
"""Bound of coordinates in the ego's frame. Chosen by hand."""

MAX_OBSERVED_SPEED_MPS = 60.0
"""Bound of speeds. Chosen by hand."""

MAX_OBSERVED_ACCELERATION_MPS2 = 10.0
"""Bound of inferred accelerations, which may exceed the limit of actions. Chosen by hand."""

STATE_FIELDS: dict[str, tuple[float, float]] = {
    "speed_mps": (-MAX_OBSERVED_SPEED_MPS, MAX_OBSERVED_SPEED_MPS),
    "acceleration_mps2": (-MAX_OBSERVED_ACCELERATION_MPS2, MAX_OBSERVED_ACCELERATION_MPS2),
    "steering_rad": (-MAX_STEERING_RAD, MAX_STEERING_RAD),
    "route_offset_m": (-50.0, 50.0),
    "route_heading_error_rad": (-float(np.pi), float(np.pi)),
    "route_done": (-1.0, 2.0),
    "to_goal_m": (-200.0, 1000.0),
    "length_m": (0.0, 30.0),
    "width_m": (0.0, 10.0),
}
"""Fields of the `state` observation in their order, with their bounds."""

NEAREST_AGENTS = 8
"""Number of agents of the `nearest` observation. Chosen by hand."""

NEAREST_FIELDS = (*AGENT_FIELDS, "present")
"""Fields of the `nearest` observation: `AGENT_FIELDS`, and 1 where there is an agent."""

ROUTE_POINTS = 30
"""Number of points of the `route` observation."""

ROUTE_STEP_M = 2.0
"""Distance between the points of the `route` observation, and from the ego to the first."""

Observation = dict[str, Shaped[np.ndarray, "t ..."]]
"""One array per part; the first axis is the targets."""

Spaces = dict[str, spaces.Box]
"""The space of each part, for one target."""


def observation_names() -> tuple[str, ...]:
    """The names of all observations: `COMPONENT_NAMES` and the views that render rasters."""
    return (*COMPONENT_NAMES, *raster_view_names())


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationContext:
    """B situations as seen by T targets: the fields of a `Scene` that views read, and routes.

    It has no actions: the components that need them infer those of the targets only. Sizes,
    classes and ids of agents that are valid at no tick are undefined.
    """

    states: Float[np.ndarray, "b a ticks 4"]
    """[x m, y m, heading rad, speed m/s]; zero where not valid. The last tick is now."""
    valid: Bool[np.ndarray, "b a ticks"]
    sizes: Float[np.ndarray, "b a 2"]
    """Length and width, m."""
    classes: Int[np.ndarray, "b a"]
    ids: Int[np.ndarray, "b a"]
    targets: Int[np.ndarray, "t 2"]
    """(situation, slot) of the agents that observe."""
    routes: Float[np.ndarray, "t p 2"]
    """The route of each target: x m, y m of points 1 m apart."""
    route_valid: Bool[np.ndarray, "t p"]
    maps: tuple[RoadMap, ...]
    map_index: Int[np.ndarray, " b"]
    """Index of each situation's map in `maps`."""
    dt_s: float
    signals: SceneSignals | None = None
    """Traffic signals up to now; None if no recording of the situations has any."""

    @property
    def history(self) -> int:
        """The number of past ticks."""
        return self.states.shape[2] - 1


def ego_context(world: World, rows: Int[np.ndarray, " n"] | None = None) -> ObservationContext:
    """The context of the egos of some episodes.

    Args:
        world: the world with the episodes.
        rows: indices of the episodes, by default all; situation i is episode `rows[i]`.
    """
    episodes = world.episodes
    maps, map_index = world.maps()
    every_row = rows is None
    rows = np.arange(len(world)) if rows is None else rows
    targets = np.full((len(rows), 2), EGO)
    targets[:, 0] = np.arange(len(rows))
    states, valid = last_ticks(episodes, world.now, rows, world.history)
    sizes, classes, ids, routes, route_valid = (
        column if every_row else column[rows]
        for column in (
            episodes.sizes,
            episodes.classes,
            episodes.ids,
            episodes.route,
            episodes.route_valid,
        )
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
        map_index=map_index if every_row else map_index[rows],
        dt_s=world.dt_s,
        signals=world.signals(rows),
    )


@runtime_checkable
class ObservationComponent(Protocol):
    """One kind of observation, which consists of one or several parts."""

    @property
    def history(self) -> int:
        """The number of past ticks that it needs."""
        ...

    @property
    def spaces(self) -> Spaces:
        """The space of each part, for one target."""
        ...

    def write(self, context: ObservationContext, events: Events, out: Observation) -> None:
        """Writes its parts.

        Args:
            context: what the T targets see.
            events: the events of the same targets, row by row.
            out: arrays of all parts; those of this component are overwritten.
        """
        ...


@final
class RasterComponent:
    """The raster of a view: uint8 (channels, height, width)."""

    def __init__(self, name: str, view: RasterView) -> None:
        self._name, self._view = name, view
        self.history = view.history
        self.spaces: Spaces = {name: spaces.Box(0, 255, view.shape, dtype=np.uint8)}

    def write(self, context: ObservationContext, events: Events, out: Observation) -> None:
        """Draws the rasters."""
        del events
        self._view.render(context, out[self._name])


@final
class VectorsComponent:
    """The agents and lines around the ego as tables, described in `asp_env.views.vectors`.

    Parts: `agents` (agents, ticks, fields) and `lines` (lines, points, fields), each with an int8
    mask of 0 and 1 without the last axis.
    """

    def __init__(self, view: VectorView) -> None:
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
        self._bounds = VectorBounds(
            *(bound.reshape(-1) for box in bounds for bound in (box.low, box.high))
        )

    def write(self, context: ObservationContext, events: Events, out: Observation) -> None:
        """Writes the tables and their masks."""
        del events
        masks = out["agents_valid"].view(np.bool_), out["lines_valid"].view(np.bool_)
        vectors = Vectors(out["agents"], masks[0], out["lines"], masks[1])
        self._view.render(context, vectors, self._bounds)


@final
class ActionsComponent:
    """The inferred actions [m/s², rad] of the last ticks, oldest first: float32 (ticks, 2)."""

    def __init__(self, history: int) -> None:
        self.history = history
        limit = np.array([MAX_OBSERVED_ACCELERATION_MPS2, MAX_STEERING_RAD])
        self.spaces: Spaces = {"actions": _box(-limit, limit, (history,))}

    def write(self, context: ObservationContext, events: Events, out: Observation) -> None:
        """Infers the actions of the targets."""
        del events
        out["actions"][:] = _infer_target_actions(context, self.history)
        _clip_to(self.spaces["actions"], out["actions"])


@final
class StateComponent:
    """The ego's motion and its position on its route: float32, the fields of `STATE_FIELDS`."""

    history = 1

    def __init__(self) -> None:
        low, high = np.array(list(STATE_FIELDS.values())).T
        self.spaces: Spaces = {"state": _box(low, high, ())}

    def write(self, context: ObservationContext, events: Events, out: Observation) -> None:
        """Writes the fields in their order."""
        index = context.targets[:, 0], context.targets[:, 1]
        ego, size = context.states[index][:, -1], context.sizes[index]
        action = _infer_target_actions(context, 1)[:, 0]
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
    """Points of the route ahead of the ego in its frame: float32 (points, 2), x ahead, y left, m.

    Beyond its ends the route continues straight.
    """

    history = 0

    def __init__(self) -> None:
        high = np.full(2, MAX_OBSERVED_POSITION_M)
        self.spaces: Spaces = {"route": _box(-high, high, (ROUTE_POINTS,))}

    def write(self, context: ObservationContext, events: Events, out: Observation) -> None:
        """Writes the points."""
        egos = context.states[context.targets[:, 0], context.targets[:, 1], -1]
        counts = context.route_valid.sum(axis=1)
        _route_ahead(context.routes, counts, events.route_m, egos, ROUTE_STEP_M, out["route"])
        _clip_to(self.spaces["route"], out["route"])


@final
class NearestComponent:
    """The agents nearest to the ego at the present tick: float32 (agents, `NEAREST_FIELDS`).

    They are those of the view `vectors` without the ego: the nearest comes first, ties are ordered
    by id, and rows without an agent are zero.
    """

    history = 1

    def __init__(self) -> None:
        self._view = VectorView(agents=NEAREST_AGENTS + 1, lines=0, history=self.history)
        low, high = _field_bounds(NEAREST_FIELDS)
        self.spaces: Spaces = {"nearest": _box(low, high, (NEAREST_AGENTS,))}

    def write(self, context: ObservationContext, events: Events, out: Observation) -> None:
        """Writes the fields of the nearest agents."""
        del events
        vectors = self._view.render(context)
        out["nearest"][..., :-1] = vectors.agents[:, 1:, -1]
        out["nearest"][..., -1] = vectors.agents_valid[:, 1:, -1]
        _clip_to(self.spaces["nearest"], out["nearest"])


class Observer:
    """Writes the observations of the chosen components, and computes nothing else."""

    def __init__(self, names: Sequence[str], raster: RasterView, history: int) -> None:
        """Creates the components.

        Args:
            names: some of `observation_names()`.
            raster: the view of the component `raster`.
            history: past ticks of the contexts to come.

        Raises:
            AspEnvError: a name is unknown or repeated, there is none, or a component needs a
                longer history.
        """
        if isinstance(names, str) or not len(names):
            given = f"observations {names!r}" if names else "no observation given"
            raise AspEnvError(f"{given}: expected some of {', '.join(observation_names())}")
        self._components: list[ObservationComponent] = []
        for name in names:
            if name not in (*COMPONENT_NAMES, *view_names()):
                raise unknown_name("observation", name, observation_names())
            component = _make_component(name, raster, history)
            if component.history > history:
                raise AspEnvError(
                    f"observation {name!r} needs {component.history} past ticks, there are "
                    f"{history}: choose a shorter time step"
                )
            self._components.append(component)
        if len(set(names)) < len(names):
            raise AspEnvError(f"observations {', '.join(names)}: name each once")
        boxes = {name: box for each in self._components for name, box in each.spaces.items()}
        self.space = spaces.Dict(list(boxes.items()))
        self._shapes = {name: (box.shape, box.dtype) for name, box in boxes.items()}

    def allocate(self, count: int) -> Observation:
        """Uninitialized arrays for the observations of `count` targets."""
        return {
            name: np.empty((count, *shape), dtype=dtype)
            for name, (shape, dtype) in self._shapes.items()
        }

    def observe(
        self, context: ObservationContext, events: Events, out: Observation | None = None
    ) -> Observation:
        """The observations of all targets.

        Args:
            context: what the T targets see.
            events: the events of the same targets, row by row.
            out: arrays of `allocate` to overwrite; new ones by default.
        """
        out = self.allocate(len(context.targets)) if out is None else out
        for component in self._components:
            component.write(context, events, out)
        return out


def _make_component(name: str, raster: RasterView, history: int) -> ObservationComponent:
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
    if name == "nearest":
        return NearestComponent()
    return RasterComponent(name, make_raster_view(name))


def _field_bounds(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the fields of agents or lines; those without a unit are between 0 and 1."""
    signed = {
        "x": MAX_OBSERVED_POSITION_M,
        "y": MAX_OBSERVED_POSITION_M,
        "cos": 1.0,
        "sin": 1.0,
        "speed": MAX_OBSERVED_SPEED_MPS,
    }
    sizes = {"length": STATE_FIELDS["length_m"][1], "width": STATE_FIELDS["width_m"][1]}
    low = [-signed[name] if name in signed else 0.0 for name in names]
    return np.array(low), np.array([signed.get(name, sizes.get(name, 1.0)) for name in names])


def _box(low: np.ndarray, high: np.ndarray, leading: tuple[int, ...]) -> spaces.Box:
    """A float32 space of shape (*leading, fields) with the given bounds of the fields."""
    shape = (*leading, len(low))
    return spaces.Box(
        np.broadcast_to(low, shape).astype(np.float32),
        np.broadcast_to(high, shape).astype(np.float32),
        dtype=np.float32,
    )


def _clip_to(box: spaces.Box, values: np.ndarray) -> None:
    _clip(values.reshape(len(values), -1), box.low.reshape(-1), box.high.reshape(-1))


def _infer_target_actions(context: ObservationContext, ticks: int) -> np.ndarray:
    """The last inferred actions [m/s², rad] of the targets: (targets, ticks, 2)."""
    index = context.targets[:, 0], context.targets[:, 1]
    states = context.states[index][:, -ticks - 1 :]
    valid = context.valid[index][:, -ticks - 1 :]
    return infer_actions(states, valid, context.sizes[index][:, 0], context.dt_s)


@njit(cache=True)
@no_type_check
def _clip(rows, low, high):
    """Clips rows (N, M) to bounds (M,) in place; NaN becomes the lower bound."""
    # The compiler vectorizes this form: a fifth of the time of `np.clip`.
    for t in range(len(rows)):
        row = rows[t]
        for i in range(len(low)):
            value, least, most = row[i], low[i], high[i]
            value = value if value >= least else least
            row[i] = value if value <= most else most


@njit(cache=True)
@no_type_check
def _route_ahead(routes, counts, arcs, egos, step_m, out):
    """Writes points of each route ahead of an arc length, in the frame of each ego.

    Args:
        routes: (T, P, 2) x m, y m of points 1 m apart.
        counts: (T,) number of valid points of each route, at least 2.
        arcs: (T,) arc length of each ego along its route, m.
        egos: (T, 4) states [x m, y m, heading rad, speed m/s].
        step_m: distance between the points to write.
        out: (T, N, 2) x ahead and y to the left, m, written.
    """
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
