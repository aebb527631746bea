"""Sampled speeds and offsets along the route, weighed against every mode of the forecast."""

import itertools
import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from asp_env.data.predictor import Forecast
from asp_env.data.scene import EGO, Scene
from asp_env.dynamics import MAX_ACCELERATION_MPS2, forward
from asp_env.dynamics.car_following import IDM, pursuit_steering
from asp_env.geometry import overlaps, project, route_coordinates, wrap_angle
from asp_env.metrics.boxes import AT_REST_MPS, is_behind, touching_trailers
from asp_env.metrics.drivable import OFF_ROAD_M, off_road_m
from asp_env.planning.idm import RouteLimits
from asp_env.planning.planner import Plan


@dataclass(frozen=True, slots=True, kw_only=True)
class Weights:
    """What a candidate pays for. Costs are per plan; collision is the dearest by far."""

    collision: float = 100.0
    """Times the probability to touch anybody, more for an early touch."""
    closeness: float = 10.0
    """Times the probability to come within the safety margin."""
    progress: float = 1.0
    """Times the metres not gained."""
    comfort: float = 0.5
    """Times the mean square of acceleration and lateral acceleration, (m/s²)²."""
    change: float = 0.15
    """Times the square of the step in acceleration from the last tick, (m/s²)²."""
    off_road: float = 50.0
    """Where a corner leaves the road by more than nuPlan's tolerance."""
    offset: float = 3.0
    """Times the mean distance from the route, m."""


FIRST_MPS2 = (-5.0, -2.5, -1.0, 0.0, 0.7, 1.4)
THEN_MPS2 = (-5.0, -2.5, -1.0, 0.0, 1.5)
OFFSETS_M = (0.0, -0.8, 0.8)
SWITCH_S = 1.0
MARGIN_M = 0.4
"""Boxes are widened by this to every side when closeness is judged."""
HEADWAY_S = 0.5
"""And the ego's is lengthened ahead by this time at its speed."""

NEVER, EXCUSED = -1, -2
"""In place of the step of a touch."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ways:
    """C candidates for each of B egos over T ticks."""

    actions: Float[np.ndarray, "b c t 2"]
    states: Float[np.ndarray, "b c t 4"]
    gained_m: Float[np.ndarray, "b c"]
    """Arc length along the route from the first to the last action."""
    aside_m: Float[np.ndarray, "b c"]
    """Mean distance from the route."""


class SamplingPlanner:
    """The cheapest of 90 ways along the ego's route.

    A candidate accelerates one way for a second, another way after it, no faster than the limit of
    bends allows, and steers by pure pursuit of the route or of a line 0.8 m beside it; the bicycle
    model makes its states. Its danger is the probability, over the forecast's modes, to touch
    anybody: a touch counts with the probability of its mode, agents count as independent, and one
    who runs into the ego's rear, or into the standing ego, does not count. A trailer that the ego
    touches now is taken for its own.
    """

    name = "sampling"
    privileged = False
    uses_forecasts = True

    def __init__(self, weights: Weights | None = None) -> None:
        """A planner with the given weights, or the default ones."""
        self.weights = weights or Weights()
        self._limits = RouteLimits(IDM())
        profiles = itertools.product(FIRST_MPS2, THEN_MPS2, OFFSETS_M)
        self._profiles = np.array(list(profiles), dtype=np.float32)

    def plan(self, scene: Scene, forecast: Forecast) -> Plan:
        """The cheapest candidate of each situation; the first of equals."""
        steps = forecast.states.shape[2]
        limits, counts = self._limits.of(scene)
        ways = self._roll_out(scene, limits, counts, steps)
        touched, close = self._danger(scene, forecast, ways.states)
        best = self._cost(scene, ways, touched, close).argmin(axis=1)
        rows = np.arange(len(best))
        return Plan(actions=ways.actions[rows, best], states=ways.states[rows, best])

    def _roll_out(
        self,
        scene: Scene,
        limits: Float[np.ndarray, "b p"],
        counts: Int[np.ndarray, " b"],
        steps: int,
    ) -> _Ways:
        shape = (len(counts), len(self._profiles))
        egos = np.ascontiguousarray(scene.states[:, EGO, -1])
        lengths = np.maximum(scene.sizes[:, EGO, 0], 0.1)
        start = route_coordinates(scene.route, scene.route_valid, egos, np.full(shape[0], -1.0))
        state = np.repeat(egos[:, None], shape[1], axis=1)
        arc = np.repeat(start[:, :1], shape[1], axis=1)
        actions = np.zeros((*shape, steps, 2), dtype=np.float32)
        states = np.zeros((*shape, steps, 4), dtype=np.float32)
        offset, aside = np.zeros(shape), np.zeros(shape)
        switch = round(SWITCH_S / scene.dt_s)
        for k in range(steps):
            _control(
                state, arc, offset, lengths, self._profiles, k >= switch, scene.dt_s,
                scene.route, counts, limits, actions[:, :, k],
            )  # fmt: skip
            state = forward(state, actions[:, :, k], lengths[:, None], scene.dt_s)
            states[:, :, k] = state
            aside += np.abs(offset) / steps
        return _Ways(actions=actions, states=states, gained_m=arc - start[:, :1], aside_m=aside)

    def _danger(
        self, scene: Scene, forecast: Forecast, states: Float[np.ndarray, "b c t 4"]
    ) -> tuple[Float[np.ndarray, "b c"], Float[np.ndarray, "b c"]]:
        own = touching_trailers(
            np.ascontiguousarray(scene.states[:, :, -1]),
            scene.sizes,
            scene.classes,
            np.ascontiguousarray(scene.valid[:, :, -1]),
        )
        spoken = forecast.valid & ~own[forecast.targets[:, 0], forecast.targets[:, 1]]
        targets = forecast.targets[spoken]
        order = np.argsort(targets[:, 0], kind="stable")
        starts = np.searchsorted(targets[order, 0], np.arange(len(states) + 1))
        touched, close = np.zeros(states.shape[:2]), np.zeros(states.shape[:2])
        _weigh(
            states,
            scene.sizes[:, EGO],
            np.ascontiguousarray(forecast.states[spoken][order]),
            np.ascontiguousarray(forecast.probabilities[spoken][order]),
            scene.sizes[targets[order, 0], targets[order, 1]],
            starts,
            touched,
            close,
        )
        return touched, close

    def _cost(
        self,
        scene: Scene,
        ways: _Ways,
        touched: Float[np.ndarray, "b c"],
        close: Float[np.ndarray, "b c"],
    ) -> Float[np.ndarray, "b c"]:
        weights = self.weights
        before = scene.actions[:, EGO, -1, 0][:, None]
        speeds = ways.states[..., 3]
        turned = wrap_angle(np.diff(ways.states[..., 2], axis=-1))
        lateral = speeds[..., 1:] * turned / scene.dt_s
        strain = (ways.actions[..., 0] ** 2).mean(axis=-1) + (lateral**2).mean(axis=-1)
        outside = np.zeros(speeds.shape)
        for b, index in enumerate(scene.map_index):
            size = np.broadcast_to(scene.sizes[b, EGO], (*speeds.shape[1:], 2))
            outside[b] = off_road_m(scene.maps[int(index)], ways.states[b], size)
        # who is off the road already is not punished for staying there
        leaves = outside.max(axis=-1) > np.maximum(OFF_ROAD_M, outside[..., 0])
        return (
            weights.collision * touched
            + weights.closeness * close
            - weights.progress * ways.gained_m
            + weights.comfort * strain
            + weights.change * np.minimum((ways.actions[..., 0, 0] - before) ** 2, 25.0)
            + weights.off_road * leaves
            + weights.offset * ways.aside_m
        )


@njit(cache=True)
@no_type_check
def _control(state, arc, offset, lengths, profiles, later, dt_s, routes, counts, limits, actions):
    for b in range(state.shape[0]):
        for c in range(state.shape[1]):
            x, y, heading, speed = state[b, c]
            along, left, _ = project(routes[b], counts[b], x, y, max(arc[b, c], 0.0), 10.0)
            arc[b, c], offset[b, c] = along, left
            wanted = profiles[c, 1] if later else profiles[c, 0]
            at = min(max(int(along + 0.5), 0), counts[b] - 1)
            most = max((limits[b, at] - speed) / dt_s, -2.5)
            wanted = max(min(wanted, most), -MAX_ACCELERATION_MPS2)
            # stop, but not beyond standstill, so that comfort is judged by what happens
            actions[b, c, 0] = max(wanted, min(-speed / dt_s, 0.0))
            actions[b, c, 1] = pursuit_steering(
                x, y, heading, speed, lengths[b], routes[b], counts[b], along, profiles[c, 2]
            )


@njit(cache=True)
@no_type_check
def _first_touch(plan, size, other, other_size, margin):
    """The first step at which the boxes overlap, `NEVER`, or `EXCUSED`.

    Excused, as in nuPlan, is who is hit by somebody behind, or is hit while standing.
    """
    for t in range(len(plan)):
        x, y, heading, speed = plan[t]
        lead = HEADWAY_S * max(speed, 0.0) if margin > 0.0 else 0.0
        length = size[0] + 2.0 * margin + lead
        cx, cy = x + 0.5 * lead * math.cos(heading), y + 0.5 * lead * math.sin(heading)
        if overlaps(
            cx, cy, heading, length, size[1] + 2.0 * margin,
            other[t, 0], other[t, 1], other[t, 2], other_size[0], other_size[1],
        ):  # fmt: skip
            if is_behind(x, y, heading, size[0], other[t, 0], other[t, 1]):
                return EXCUSED
            if margin == 0.0 and abs(speed) <= AT_REST_MPS:
                return EXCUSED
            return t
    return NEVER


@njit(cache=True)
@no_type_check
def _weigh(plans, sizes, others, probabilities, other_sizes, starts, touched, close):
    steps = plans.shape[2]
    for b in range(plans.shape[0]):
        for c in range(plans.shape[1]):
            free, clear = 1.0, 1.0
            for n in range(starts[b], starts[b + 1]):
                hit, near = 0.0, 0.0
                for m in range(others.shape[1]):
                    p = probabilities[n, m]
                    at = _first_touch(plans[b, c], sizes[b], others[n, m], other_sizes[n], MARGIN_M)
                    if at == NEVER:
                        continue
                    if at >= 0:
                        near += p * (1.0 - 0.5 * at / steps)
                    at = _first_touch(plans[b, c], sizes[b], others[n, m], other_sizes[n], 0.0)
                    if at >= 0:
                        hit += p * (1.0 - 0.5 * at / steps)
                free *= 1.0 - min(hit, 1.0)
                clear *= 1.0 - min(near, 1.0)
            touched[b, c], close[b, c] = 1.0 - free, 1.0 - clear
