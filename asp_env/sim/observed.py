"""The kinds of observation, each with its spaces and the writing of its arrays.

Every value is finite and lies within the bounds of its space; what would lie beyond is moved there.
"""

import math
from typing import final, no_type_check

import numpy as np
from gymnasium import spaces
from numba import njit

from asp_env.data.scene import infer_actions
from asp_env.dynamics import MAX_STEERING_RAD, wrap_angle
from asp_env.sim.sight import Sight
from asp_env.sim.world import Events
from asp_env.views import PictureView
from asp_env.views.vectors import AGENT_FIELDS, LINE_FIELDS, Vectors, VectorView

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


@final
class PicturePart:
    """The picture that a view draws."""

    def __init__(self, name: str, view: PictureView) -> None:
        """A part of that name."""
        self._name, self._view = name, view
        self.history = view.history

    def spaces(self) -> dict[str, spaces.Box]:
        """uint8 (channels, height, width)."""
        return {self._name: spaces.Box(0, 255, self._view.shape, dtype=np.uint8)}

    def write(self, sight: Sight, events: Events, out: Arrays) -> None:
        """Draws into the memory itself."""
        del events
        self._view.draw(sight, out[self._name])


@final
class VectorsPart:
    """The agents and the lines around the ego, as `asp_env.views.vectors` tells them."""

    def __init__(self, view: VectorView) -> None:
        """Of that many agents and lines."""
        self._view = view
        self.history = view.history
        self._bounds = _field_bounds(AGENT_FIELDS), _field_bounds(LINE_FIELDS)

    def spaces(self) -> dict[str, spaces.Box]:
        """Tables of agents (time by time) and lines (point by point), with masks of 0 and 1."""
        shape = self._view.shape
        agents, lines = (shape.agents, shape.ticks), (shape.lines, shape.points)
        return {
            "agents": _box(self._bounds[0], agents),
            "agents_valid": spaces.Box(0, 1, agents, dtype=np.int8),
            "lines": _box(self._bounds[1], lines),
            "lines_valid": spaces.Box(0, 1, lines, dtype=np.int8),
        }

    def write(self, sight: Sight, events: Events, out: Arrays) -> None:
        """Writes into the memory itself."""
        del events
        agents, lines = out["agents"], out["lines"]
        masks = out["agents_valid"].view(np.bool_), out["lines_valid"].view(np.bool_)
        self._view.draw(sight, Vectors(agents, masks[0], lines, masks[1]))
        for part, bounds in zip((agents, lines), self._bounds, strict=True):
            _clip_fields(part.reshape(-1, part.shape[-1]), *bounds)


@final
class ActionsPart:
    """The inferred actions of the last ticks, oldest first."""

    def __init__(self, history: int) -> None:
        """Of that many ticks."""
        self.history = history
        self._limit = np.array([MAX_SEEN_ACCELERATION_MPS2, MAX_STEERING_RAD], dtype=np.float32)

    def spaces(self) -> dict[str, spaces.Box]:
        """(ticks, 2): acceleration m/s², steering rad."""
        return {"actions": _box((-self._limit, self._limit), (self.history,))}

    def write(self, sight: Sight, events: Events, out: Arrays) -> None:
        """Infers those of the targets alone."""
        del events
        np.clip(_actions(sight, self.history), -self._limit, self._limit, out=out["actions"])


@final
class StatePart:
    """How the ego moves and where it is on its route: `STATE_FIELDS`."""

    history = 1

    def __init__(self) -> None:
        """The bounds are those of the fields."""
        low, high = np.array(list(STATE_FIELDS.values()), dtype=np.float32).T
        self._bounds = low, high

    def spaces(self) -> dict[str, spaces.Box]:
        """(fields,)."""
        return {"state": _box(self._bounds, ())}

    def write(self, sight: Sight, events: Events, out: Arrays) -> None:
        """The fields in their order."""
        at = sight.targets[:, 0], sight.targets[:, 1]
        ego, action = sight.states[at][:, -1], _actions(sight, 1)[:, 0]
        columns = (
            ego[:, 3],
            action[:, 0],
            action[:, 1],
            events.route_offset_m,
            wrap_angle(ego[:, 2] - events.route_heading_rad),
            events.route_m / np.maximum(events.goal_m, 1.0),
            events.goal_m - events.route_m,
            sight.sizes[at][:, 0],
            sight.sizes[at][:, 1],
        )
        state = out["state"]
        for field, column in enumerate(columns):
            state[:, field] = column
        np.clip(state, *self._bounds, out=state)


@final
class RoutePart:
    """The way ahead from the place on the route that is nearest to the ego."""

    history = 0

    def __init__(self) -> None:
        """Of `ROUTE_POINTS` points."""
        high = np.full(2, FARTHEST_M, dtype=np.float32)
        self._bounds = -high, high

    def spaces(self) -> dict[str, spaces.Box]:
        """(points, 2): x ahead and y to the left of the ego, m."""
        return {"route": _box(self._bounds, (ROUTE_POINTS,))}

    def write(self, sight: Sight, events: Events, out: Arrays) -> None:
        """Points beyond the route's ends go on straight."""
        egos = sight.states[sight.targets[:, 0], sight.targets[:, 1], -1]
        counts = sight.route_valid.sum(axis=1)
        route = out["route"]
        _way_ahead(sight.routes, counts, events.route_m, egos, ROUTE_STEP_M, route)
        np.clip(route, *self._bounds, out=route)


def _field_bounds(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Of the fields of agents or lines; all but some lie between 0 and 1."""
    wide = {"x": FARTHEST_M, "y": FARTHEST_M, "cos": 1.0, "sin": 1.0, "speed": FASTEST_MPS}
    one_sided = {"length": STATE_FIELDS["length_m"][1], "width": STATE_FIELDS["width_m"][1]}
    low = [-wide.get(name, 0.0) for name in names]
    high = [wide.get(name, one_sided.get(name, 1.0)) for name in names]
    return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)


def _box(bounds: tuple[np.ndarray, np.ndarray], leading: tuple[int, ...]) -> spaces.Box:
    low, high = (np.broadcast_to(bound, (*leading, len(bound))).copy() for bound in bounds)
    return spaces.Box(low, high, dtype=np.float32)


def _actions(sight: Sight, ticks: int) -> np.ndarray:
    """The last inferred actions of the targets, (targets, ticks, 2)."""
    at = sight.targets[:, 0], sight.targets[:, 1]
    states, valid = sight.states[at][:, -ticks - 1 :], sight.valid[at][:, -ticks - 1 :]
    return infer_actions(states, valid, sight.sizes[at][:, 0], sight.dt_s)


@njit(cache=True)
@no_type_check
def _clip_fields(rows, low, high):
    """Moves every field of every row into its bounds."""
    for i in range(len(rows)):
        for field in range(len(low)):
            rows[i, field] = min(max(rows[i, field], low[field]), high[field])


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
