"""The planner `idm`: the intelligent driver model along the ego's route, without forecasts."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from asp_env.data.predictor import Forecast
from asp_env.data.road_map import RoadMap
from asp_env.data.scene import EGO, Scene
from asp_env.dynamics import rollout
from asp_env.dynamics.car_following import IDM, follow_paths, speed_limits
from asp_env.errors import AspEnvError
from asp_env.geometry import route_coordinates
from asp_env.metrics import lanes
from asp_env.metrics.drivable import off_road_m
from asp_env.planning.planner import Plan

DESIRED_MPS = 50 / 3.6
"""Desired speed: the German speed limit in towns."""


class Routes(NamedTuple):
    """The routes of B egos, with points 1 m apart."""

    points: np.ndarray
    """(B, P, 2) x m, y m."""
    counts: np.ndarray
    """(B,) number of valid points."""
    speed_limits: np.ndarray
    """(B, P) desired speed at each point, m/s."""
    off_road_m: np.ndarray
    """(B, P) distance of the outermost corner of the ego at each point to the drivable area, m. It
    is positive where the map has a gap, or is offset from the recording of the route."""


class RouteCache:
    """Computes the desired speeds along routes, and stores them while the routes stay the same."""

    def __init__(self, idm: IDM, *, map_limits: bool = False) -> None:
        """Creates an empty cache.

        Args:
            idm: limits the speeds before and in bends.
            map_limits: whether the speed limits of lanes apply, where the map has them.
        """
        self._idm = idm
        self._map_limits = map_limits
        self._routes = Routes(
            points=np.zeros((0, 0, 2), dtype=np.float32),
            counts=np.zeros(0, dtype=np.int64),
            speed_limits=np.zeros((0, 0), dtype=np.float32),
            off_road_m=np.zeros((0, 0), dtype=np.float32),
        )

    def routes(self, scene: Scene) -> Routes:
        """The routes of a scene.

        Raises:
            AspEnvError: a situation has no route.
        """
        counts = scene.route_valid.sum(axis=1)
        if (counts < 2).any():
            raise AspEnvError("a planner needs the ego's route: take the scene from a world")
        known = self._routes
        if not (np.array_equal(known.points, scene.route) and np.array_equal(known.counts, counts)):
            limits = np.zeros(scene.route.shape[:2], dtype=np.float32)
            outside = np.zeros(scene.route.shape[:2], dtype=np.float32)
            for b, count in enumerate(counts):
                route = scene.route[b, :count]
                road_map = scene.maps[int(scene.map_index[b])]
                size = np.broadcast_to(scene.sizes[b, EGO], (count, 2))
                outside[b, :count] = off_road_m(road_map, _states_on(route), size)
                limits[b, :count] = speed_limits(route, DESIRED_MPS, self._idm)
                if self._map_limits:
                    limits[b, :count] = _with_map_limits(route, road_map, self._idm)
            self._routes = Routes(
                points=scene.route, counts=counts, speed_limits=limits, off_road_m=outside
            )
        return self._routes


class IDMPlanner:
    """Follows the route at the desired speed, and what is on the route at present."""

    name = "idm"
    privileged = False
    uses_forecasts = False

    def __init__(self, idm: IDM | None = None) -> None:
        """Creates the planner.

        Args:
            idm: parameters of the model, by default `IDM()`.
        """
        self._idm = idm or IDM()
        self._cache = RouteCache(self._idm)

    def plan(self, scene: Scene, forecast: Forecast) -> Plan:
        """One action, held for the horizon of the forecast."""
        routes = self._cache.routes(scene)
        valid = np.ascontiguousarray(scene.valid[..., -1])
        states = np.ascontiguousarray(scene.states[..., -1, :])
        egos = np.zeros_like(valid)
        egos[:, EGO] = True
        shape = (*valid.shape, scene.route.shape[1])
        arcs = np.zeros(valid.shape)
        arcs[:, EGO] = _route_arcs(scene)
        actions = follow_paths(
            states,
            scene.sizes,
            valid,
            egos,
            np.broadcast_to(scene.route[:, None], (*shape, 2)),
            np.broadcast_to(routes.counts[:, None], valid.shape),
            np.broadcast_to(routes.speed_limits[:, None], shape),
            arcs,
            self._idm,
        )[:, EGO]
        held = np.repeat(actions[:, None], forecast.states.shape[2], axis=1)
        lengths = np.maximum(scene.sizes[:, EGO, 0], 0.1)
        return Plan(actions=held, states=rollout(states[:, EGO], held, lengths, scene.dt_s))


def _with_map_limits(
    route: Float[np.ndarray, "p 2"], road_map: RoadMap, idm: IDM
) -> Float[np.ndarray, " p"]:
    """Desired speed at each point of a route: the speed limit, lower in and before bends.

    A point without a known limit has that of the last known one before it, else of the first one
    after it. Without any, the desired speed is `DESIRED_MPS`.
    """
    known = lanes.speed_limits(road_map, _states_on(route))
    if not known.valid.any():
        return speed_limits(route, DESIRED_MPS, idm)
    points = np.arange(len(route))
    latest = np.maximum.accumulate(np.where(known.valid, points, known.valid.argmax()))
    by_lane = known.value[latest]
    limits = np.minimum(speed_limits(route, float(by_lane.max()), idm), by_lane)
    # braking to the limit of a point j ahead is possible from v² = limit[j]² + 2 b (j - i)
    falling = 2.0 * idm.comfortable_braking_mps2 * points
    square = np.minimum.accumulate((limits**2 + falling)[::-1])[::-1] - falling
    return np.sqrt(square)


def _states_on(route: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, "p 4"]:
    """States [x m, y m, heading rad, speed 0] along a route."""
    step = np.gradient(route, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    return np.concatenate([route, heading[:, None], np.zeros((len(route), 1))], axis=1)


def _route_arcs(scene: Scene) -> Float[np.ndarray, " b"]:
    """Arc length of each ego along its route, m."""
    search_everywhere = np.full(len(scene.tick), -1.0)
    egos = np.ascontiguousarray(scene.states[:, EGO, -1])
    return route_coordinates(scene.route, scene.route_valid, egos, search_everywhere)[:, 0]
