"""The planner `sampling`: candidates along the route, rated against all modes of a forecast."""

import itertools
import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float

from asp_env.compiled import njit
from asp_env.data.predictor import Forecast
from asp_env.data.scene import EGO, Scene
from asp_env.dynamics import MAX_ACCELERATION_MPS2, forward
from asp_env.dynamics.car_following import IDM, pursuit_steering
from asp_env.geometry import overlaps, project, route_coordinates, wrap_angle
from asp_env.metrics.boxes import AT_REST_MPS, is_behind, touching_trailers
from asp_env.metrics.drivable import OFF_ROAD_M, off_road_m
from asp_env.planning.idm import RouteCache
from asp_env.planning.planner import Plan

FIRST_MPS2 = (-5.0, -2.5, -1.0, 0.0, 0.7, 1.4)
"""Accelerations of the candidates up to `SWITCH_S`. Chosen by hand."""

THEN_MPS2 = (-5.0, -2.5, -1.0, 0.0, 1.5)
"""Accelerations of the candidates after `SWITCH_S`. Chosen by hand."""

OFFSETS_M = (0.0, -0.8, 0.8)
"""Offsets of the candidates to the left of the route. Chosen by hand."""

SWITCH_S = 1.0
"""When a candidate changes its acceleration. Chosen by hand."""

BRAKING_FOR_LIMIT_MPS2 = 2.5
"""A candidate that exceeds the speed limit brakes by at most this much. Chosen by hand."""

MARGIN_M = 0.4
"""The ego's box is widened by this on every side when closeness is rated. Chosen by hand."""

HEADWAY_S = 0.5
"""In addition, it is extended ahead by this time at its speed. Chosen by hand."""

MAX_CHANGE_MPS2 = 5.0
"""A larger step in acceleration costs no more than this one. Chosen by hand."""

NO_CONTACT, EXCUSED = -1, -2
"""Values instead of the step of a contact: there is none, or it is not the ego's fault."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SamplingWeights:
    """What a candidate costs per plan. Chosen by hand; a collision costs by far the most."""

    collision: float = 100.0
    """Times the probability to touch an agent, which counts more for an early contact."""
    closeness: float = 10.0
    """Times the same with margins (`MARGIN_M`, `HEADWAY_S`) around the ego."""
    progress: float = 1.0
    """Times the metres gained along the route; subtracted."""
    comfort: float = 0.5
    """Times the sum of the mean squares of acceleration and lateral acceleration, (m/s²)²."""
    change: float = 0.15
    """Times the square of the step in acceleration from the last tick, (m/s²)²."""
    off_road: float = 50.0
    """If a corner leaves the drivable area by more than nuPlan's tolerance."""
    offset: float = 3.0
    """Times the mean distance from the route, m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RouteCandidates:
    """C candidates along the route for each of B egos over T ticks."""

    actions: Float[np.ndarray, "b c t 2"]
    """[acceleration m/s², steering rad]."""
    states: Float[np.ndarray, "b c t 4"]
    """[x m, y m, heading rad, speed m/s] after each action."""
    gained_m: Float[np.ndarray, "b c"]
    """Arc length along the route from the first to the last action."""
    offset_m: Float[np.ndarray, "b c"]
    """Mean distance from the route."""


class SamplingPlanner:
    """Chooses the cheapest of 90 candidates along the ego's route.

    A candidate has one acceleration for a second and another one after it, within the speed limit
    of bends, and steers by pure pursuit of the route or of a line 0.8 m beside it; the bicycle
    model yields its states. It is rated by the probability, over the modes of the forecast, to
    touch an agent: agents are independent, and contacts with an agent behind the ego, or while the
    ego stands, are excused. A trailer that the ego touches at present belongs to it and is ignored.
    """

    name = "sampling"
    privileged = False
    uses_forecasts = True

    def __init__(self, weights: SamplingWeights | None = None) -> None:
        """Creates the planner.

        Args:
            weights: of the costs, by default `SamplingWeights()`.
        """
        self.weights = weights or SamplingWeights()
        self._cache = RouteCache(IDM())
        profiles = itertools.product(FIRST_MPS2, THEN_MPS2, OFFSETS_M)
        self._profiles = np.array(list(profiles), dtype=np.float32)
        """(C, 3) first acceleration m/s², second acceleration m/s², offset m."""

    def plan(self, scene: Scene, forecast: Forecast) -> Plan:
        """The cheapest candidate of each situation, the first of equals."""
        steps = forecast.states.shape[2]
        candidates = self.candidates(scene, steps)
        costs = self.costs(scene, forecast, candidates)
        best = costs.argmin(axis=1)
        rows = np.arange(len(best))
        return Plan(actions=candidates.actions[rows, best], states=candidates.states[rows, best])

    def candidates(self, scene: Scene, steps: int) -> RouteCandidates:
        """The candidates for all situations over `steps` ticks.

        Raises:
            AspEnvError: the scene has no routes.
        """
        routes = self._cache.routes(scene)
        shape = (len(routes.counts), len(self._profiles))
        egos = np.ascontiguousarray(scene.states[:, EGO, -1])
        lengths = np.maximum(scene.sizes[:, EGO, 0], 0.1)
        search_everywhere = np.full(shape[0], -1.0)
        start = route_coordinates(scene.route, scene.route_valid, egos, search_everywhere)
        state = np.repeat(egos[:, None], shape[1], axis=1)
        arc = np.repeat(start[:, :1], shape[1], axis=1)
        actions = np.zeros((*shape, steps, 2), dtype=np.float32)
        states = np.zeros((*shape, steps, 4), dtype=np.float32)
        offset, mean_offset = np.zeros(shape), np.zeros(shape)
        first, then = self._profiles[:, [0, 2]], self._profiles[:, [1, 2]]
        switch = round(SWITCH_S / scene.dt_s)
        for k in range(steps):
            profiles = then if k >= switch else first
            _act(state, arc, offset, lengths, profiles, scene.dt_s, routes, actions[:, :, k])
            state = forward(state, actions[:, :, k], lengths[:, None], scene.dt_s)
            states[:, :, k] = state
            mean_offset += np.abs(offset) / steps
        return RouteCandidates(
            actions=actions, states=states, gained_m=arc - start[:, :1], offset_m=mean_offset
        )

    def costs(
        self, scene: Scene, forecast: Forecast, candidates: RouteCandidates
    ) -> Float[np.ndarray, "b c"]:
        """Costs of candidates, the sums of the terms of `SamplingWeights`."""
        weights = self.weights
        collision, closeness = _contact_probabilities(scene, forecast, candidates.states)
        before = scene.actions[:, EGO, -1, 0][:, None]
        speeds, accelerations = candidates.states[..., 3], candidates.actions[..., 0]
        turned = wrap_angle(np.diff(candidates.states[..., 2], axis=-1))
        lateral = speeds[..., 1:] * turned / scene.dt_s
        discomfort = (accelerations**2).mean(axis=-1) + (lateral**2).mean(axis=-1)
        outside = np.zeros(speeds.shape)
        for b, index in enumerate(scene.map_index):
            size = np.broadcast_to(scene.sizes[b, EGO], (*speeds.shape[1:], 2))
            outside[b] = off_road_m(scene.maps[int(index)], candidates.states[b], size)
        # an ego that is off the road already pays only for going farther
        leaves_road = outside.max(axis=-1) > np.maximum(OFF_ROAD_M, outside[..., 0])
        change = np.minimum((accelerations[..., 0] - before) ** 2, MAX_CHANGE_MPS2**2)
        return (
            weights.collision * collision
            + weights.closeness * closeness
            - weights.progress * candidates.gained_m
            + weights.comfort * discomfort
            + weights.change * change
            + weights.off_road * leaves_road
            + weights.offset * candidates.offset_m
        )


def _contact_probabilities(
    scene: Scene, forecast: Forecast, states: Float[np.ndarray, "b c t 4"]
) -> tuple[Float[np.ndarray, "b c"], Float[np.ndarray, "b c"]]:
    """Probabilities of candidates to touch an agent, without and with margins (`_rate`)."""
    own_trailer = touching_trailers(
        np.ascontiguousarray(scene.states[:, :, -1]),
        scene.sizes,
        scene.classes,
        np.ascontiguousarray(scene.valid[:, :, -1]),
    )
    rated = forecast.valid & ~own_trailer[forecast.targets[:, 0], forecast.targets[:, 1]]
    targets = forecast.targets[rated]
    order = np.argsort(targets[:, 0], kind="stable")
    starts = np.searchsorted(targets[order, 0], np.arange(len(states) + 1))
    collision, closeness = np.zeros(states.shape[:2]), np.zeros(states.shape[:2])
    _rate(
        states,
        scene.sizes[:, EGO],
        np.ascontiguousarray(forecast.states[rated][order]),
        np.ascontiguousarray(forecast.probabilities[rated][order]),
        scene.sizes[targets[order, 0], targets[order, 1]],
        starts,
        collision,
        closeness,
    )
    return collision, closeness


@njit(cache=True)
@no_type_check
def _act(states, arcs, offsets, lengths, profiles, dt_s, routes, actions):
    """Writes the next action of each candidate.

    Args:
        states: (B, C, 4) present states [x m, y m, heading rad, speed m/s].
        arcs: (B, C) arc length along the route, m, brought up to date.
        offsets: (B, C) offset to the left of the route, m, written.
        lengths: (B,) lengths of the egos, m.
        profiles: (C, 2) acceleration m/s² and offset m to follow.
        dt_s: length of a tick.
        routes: `Routes`.
        actions: (B, C, 2) [acceleration m/s², steering rad], written.
    """
    for b in range(states.shape[0]):
        route, count = routes.points[b], routes.counts[b]
        for c in range(states.shape[1]):
            x, y, heading, speed = states[b, c]
            arc, offset, _ = project(route, count, x, y, max(arcs[b, c], 0.0), 10.0)
            arcs[b, c], offsets[b, c] = arc, offset
            index = min(max(int(arc + 0.5), 0), count - 1)
            excess = (routes.speed_limits[b, index] - speed) / dt_s
            acceleration = min(profiles[c, 0], max(excess, -BRAKING_FOR_LIMIT_MPS2))
            acceleration = max(acceleration, -MAX_ACCELERATION_MPS2)
            # to standstill at most, so that comfort rates what really happens; an ego that drives
            # backwards brakes first
            actions[b, c, 0] = max(acceleration, min(-speed / dt_s, MAX_ACCELERATION_MPS2))
            actions[b, c, 1] = pursuit_steering(
                x, y, heading, speed, lengths[b], route, count, arc, profiles[c, 1]
            )


@njit(cache=True)
@no_type_check
def _first_contact(plan, size, other, other_size, margin):
    """The first step at which two boxes overlap, `NO_CONTACT` or `EXCUSED`.

    As in nuPlan, a contact with an agent behind the ego, or while the ego stands, is excused.

    Args:
        plan: (T, 4) states of the ego [x m, y m, heading rad, speed m/s].
        size: (2,) its length and width, m.
        other: (T, 4) states of the other agent.
        other_size: (2,) its length and width, m.
        margin: added to every side of the ego's box, m; if positive, the headway is added as well.
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
    return NO_CONTACT


@njit(cache=True)
@no_type_check
def _rate(plans, sizes, agents, probabilities, agent_sizes, starts, collision, closeness):
    """Writes the probability of each candidate to touch any agent, without and with margins.

    A contact at the last step counts half as much as one at the first.

    Args:
        plans: (B, C, T, 4) states of the candidates [x m, y m, heading rad, speed m/s].
        sizes: (B, 2) lengths and widths of the egos, m.
        agents: (N, M, T, 4) forecast states of the other agents, sorted by situation.
        probabilities: (N, M) of their modes.
        agent_sizes: (N, 2) their lengths and widths, m.
        starts: (B + 1,) the agents of situation b are `starts[b]:starts[b + 1]`.
        collision: (B, C), written.
        closeness: (B, C), written.
    """
    steps = plans.shape[2]
    for b in range(plans.shape[0]):
        for c in range(plans.shape[1]):
            no_collision, no_closeness = 1.0, 1.0
            for n in range(starts[b], starts[b + 1]):
                hit, near = 0.0, 0.0
                for m in range(agents.shape[1]):
                    p, other, size_o = probabilities[n, m], agents[n, m], agent_sizes[n]
                    step = _first_contact(plans[b, c], sizes[b], other, size_o, MARGIN_M)
                    if step == NO_CONTACT:
                        continue
                    if step >= 0:
                        near += p * (1.0 - 0.5 * step / steps)
                    step = _first_contact(plans[b, c], sizes[b], other, size_o, 0.0)
                    if step >= 0:
                        hit += p * (1.0 - 0.5 * step / steps)
                no_collision *= 1.0 - min(hit, 1.0)
                no_closeness *= 1.0 - min(near, 1.0)
            collision[b, c], closeness[b, c] = 1.0 - no_collision, 1.0 - no_closeness
