"""The intelligent driver model along the ego's route: reacts to what is there now."""

import numpy as np
from jaxtyping import Float, Int

from asp_env.data.predictor import Forecast
from asp_env.data.scene import EGO, Scene
from asp_env.dynamics import rollout
from asp_env.dynamics.car_following import IDM, follow_paths, speed_limits
from asp_env.errors import AspEnvError
from asp_env.geometry import route_coordinates
from asp_env.planning.planner import Plan

DESIRED_MPS = 50 / 3.6
"""The speed limit in towns."""


class RouteLimits:
    """Wanted speeds along routes, remembered while the routes stay the same."""

    def __init__(self, idm: IDM) -> None:
        """Limits under the given parameters."""
        self._idm = idm
        self._routes = np.zeros((0, 0, 2), dtype=np.float32)
        self._counts = np.zeros(0, dtype=np.int64)
        self._limits = np.zeros((0, 0), dtype=np.float32)

    def of(self, scene: Scene) -> tuple[Float[np.ndarray, "b p"], Int[np.ndarray, " b"]]:
        """(wanted speed m/s at each route point, number of points) of each situation.

        Raises:
            AspEnvError: a situation has no route.
        """
        counts = scene.route_valid.sum(axis=1)
        if (counts < 2).any():
            raise AspEnvError("a planner needs the ego's route: take the scene from a world")
        same = np.array_equal(self._routes, scene.route) and np.array_equal(self._counts, counts)
        if not same:
            limits = np.zeros(scene.route.shape[:2], dtype=np.float32)
            for b, count in enumerate(counts):
                path = scene.route[b, :count]
                limits[b, :count] = speed_limits(path, DESIRED_MPS, self._idm)
            self._routes, self._counts, self._limits = scene.route, counts, limits
        return self._limits, self._counts


class IDMPlanner:
    """Follows the route at the wanted speed behind whoever stands or drives on it now."""

    name = "idm"
    privileged = False
    uses_forecasts = False

    def __init__(self, idm: IDM | None = None) -> None:
        """A planner with the given parameters, or the default ones."""
        self._idm = idm or IDM()
        self._limits = RouteLimits(self._idm)

    def plan(self, scene: Scene, forecast: Forecast) -> Plan:
        """One action held for the forecast's horizon."""
        limits, counts = self._limits.of(scene)
        valid = np.ascontiguousarray(scene.valid[..., -1])
        states = np.ascontiguousarray(scene.states[..., -1, :])
        egos = np.zeros_like(valid)
        egos[:, EGO] = True
        shape = (*valid.shape, scene.route.shape[1])
        arcs = np.zeros(valid.shape)
        arcs[:, EGO] = _arc(scene)
        actions = follow_paths(
            states,
            scene.sizes,
            valid,
            egos,
            np.broadcast_to(scene.route[:, None], (*shape, 2)),
            np.broadcast_to(counts[:, None], valid.shape),
            np.broadcast_to(limits[:, None], shape),
            arcs,
            self._idm,
        )[:, EGO]
        held = np.repeat(actions[:, None], forecast.states.shape[2], axis=1)
        lengths = np.maximum(scene.sizes[:, EGO, 0], 0.1)
        return Plan(actions=held, states=rollout(states[:, EGO], held, lengths, scene.dt_s))


def _arc(scene: Scene) -> Float[np.ndarray, " b"]:
    """How far along its route each ego is; looked for everywhere."""
    everywhere = np.full(len(scene.tick), -1.0)
    egos = np.ascontiguousarray(scene.states[:, EGO, -1])
    return route_coordinates(scene.route, scene.route_valid, egos, everywhere)[:, 0]
