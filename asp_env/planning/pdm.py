"""The planner `pdm`: proposals of the intelligent driver model, scored against all forecast modes.

It is PDM-Closed of Dauner, Hallgarten, Geiger and Chitta 2023, "Parting with Misconceptions about
Learning-based Vehicle Motion Planning", Conference on Robot Learning. Taken from the paper:

- 15 proposals: the intelligent driver model (IDM) along the route at 5 target speeds, 20 % to 100 %
  of the speed limit, and 3 lateral offsets, -1 m, 0 m and 1 m, simulated by the bicycle model;
- their score: no at-fault collision times drivable area times the weighted mean of time to
  collision (TTC), progress and comfort, with the weights 5, 5 and 2 of nuPlan and NAVSIM. Progress
  is relative to that of the proposal that makes most of it without a collision and on the road;
- the proposal with the highest score is executed, or the ego brakes if that proposal collides
  within 2 s.

Different from the paper:

- The other agents move as they are forecast, not at constant velocity. The leader of the IDM is
  sought among the most probable modes at each tick of the rollout; the score is the expected one
  over all modes, where agents are independent.
- The horizon and the tick are those of the forecast, by default 3 s and 0.2 s instead of 4 s and
  0.1 s, and every tick has a new plan.
- Speed limits are lowered in and before bends, and the target speeds are shares of these.
- Proposals have a limited jerk, approach their offset at a limited rate, and brake for a target
  speed no harder than `TARGET_BRAKING_MPS2`.
- The driving direction is not scored; a proposal pays for its offset from the route instead.
- The comfort of a proposal includes the ego's past second.
- The ego brakes at any speed, not only up to 5 m/s as in the authors' code, tuplan_garage, unless a
  collision within 2 s would become more probable.
"""

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float

from asp_env.compiled import njit
from asp_env.data.predictor import Forecast
from asp_env.data.scene import EGO, Scene
from asp_env.dynamics import MAX_ACCELERATION_MPS2, forward
from asp_env.dynamics.car_following import (
    IDM,
    PURSUIT_S,
    free_ahead,
    idm_acceleration,
    pursuit_steering,
)
from asp_env.geometry import overlaps, point_on_route, project, route_coordinates
from asp_env.metrics.boxes import AT_REST_MPS, is_behind, touching_trailers
from asp_env.metrics.drivable import OFF_ROAD_M, off_road_m
from asp_env.metrics.driving.comfort import BOUNDS, comfort_signals, window_ticks
from asp_env.planning.idm import RouteCache, Routes
from asp_env.planning.planner import Plan

SPEED_SHARES = (1.0, 0.8, 0.6, 0.4, 0.2)
"""Target speeds of the proposals, as shares of the speed limit (Dauner et al.)."""

OFFSETS_M = (0.0, -1.0, 1.0)
"""Offsets of the proposals to the left of the route (Dauner et al.)."""

ACCELERATION_MPS2 = 2.0
"""Maximum acceleration of the intelligent driver model of the proposals. Balances progress against
nuPlan's comfort bound of 2.4 m/s²; `IDM` has 1.5 m/s². Chosen by hand."""

EMERGENCY_S = 2.0
"""The ego brakes if the best proposal collides within this time (Dauner et al.)."""

TARGET_BRAKING_MPS2 = 3.0
"""A proposal brakes by at most this much for its target speed, or harder for a leader. Balances
yielding early against comfort. Chosen by hand."""

LIMIT_AHEAD_S = 0.6
"""A proposal reaches a lower speed limit so far ahead within this time. Balances exceeding the
limit against braking too long, since the jerk is limited. Chosen by hand."""

JERK_MPS3 = 3.0
"""Largest change of a proposal's acceleration per second. Balances early braking against nuPlan's
comfort bound of 4.13 m/s³, which jerks of 3.5 m/s³ at the ends of an episode break, since the
parabola is extrapolated there. Chosen by hand."""

OFFSET_RATE_MPS = 0.5
"""Lateral speed at which a proposal approaches its offset. Balances evasion against comfort. Chosen
by hand."""

TTC_S = 0.95
"""A time to collision up to this counts as short (nuPlan, NAVSIM)."""

MIN_PROGRESS_M = 1.0
"""Progress is relative to this if no proposal makes more. Chosen by hand."""

STANDING_MPS = 0.005
"""An ego up to this speed has no time to collision (nuPlan)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PDMWeights:
    """Weights of the score of a proposal; those of TTC, progress and comfort are the paper's."""

    ttc: float = 5.0
    """Of the probability that the time to collision is never short."""
    progress: float = 5.0
    """Of the progress relative to the best proposal's."""
    comfort: float = 2.0
    """Of nuPlan's comfort bounds."""
    offset: float = 1.0
    """Times the mean distance from the route, m; subtracted. Outweighs the metres that the inside
    of a bend gains. Chosen by hand."""
    emergency: float = 0.5
    """The ego brakes if a collision within `EMERGENCY_S` is at least this probable. Chosen by
    hand."""


class _Agents(NamedTuple):
    """The forecast agents of all situations, sorted by situation and id."""

    states: np.ndarray
    """(N, M, T, 4) [x m, y m, heading rad, speed m/s]."""
    probabilities: np.ndarray
    """(N, M) of the modes."""
    leaders: np.ndarray
    """(N, T, 4) states of the most probable modes."""
    sizes: np.ndarray
    """(N, 2) length and width, m."""
    starts: np.ndarray
    """(B + 1,) the agents of situation b are `starts[b]:starts[b + 1]`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Proposals:
    """C proposals for each of B egos over T ticks; the last one is the emergency brake."""

    actions: Float[np.ndarray, "b c t 2"]
    states: Float[np.ndarray, "b c t 4"]
    gained_m: Float[np.ndarray, "b c"]
    """Arc length along the route from the present to the last action."""
    offset_m: Float[np.ndarray, "b c"]
    """Mean distance from the route."""


class PDMPlanner:
    """Executes the best of 15 proposals, scored against the forecast, or brakes in an emergency.

    The module's documentation defines proposals, score and emergency, and names what differs from
    PDM-Closed. A contact is excused with an agent behind the ego, and while the ego stands. A
    trailer that the ego touches at present belongs to it and is ignored.
    """

    name = "pdm"
    privileged = False
    uses_forecasts = True

    def __init__(self, weights: PDMWeights | None = None, idm: IDM | None = None) -> None:
        """Creates the planner.

        Args:
            weights: of the score, by default `PDMWeights()`.
            idm: parameters of the proposals, by default with `ACCELERATION_MPS2`.
        """
        self.weights = weights or PDMWeights()
        self._idm = idm or IDM(max_acceleration_mps2=ACCELERATION_MPS2)
        self._cache = RouteCache(self._idm, map_limits=True)
        pairs = [*itertools.product(SPEED_SHARES, OFFSETS_M), (0.0, 0.0)]
        self._profiles = np.array(pairs)
        """(C, 2) share of the speed limit, and offset m; the last one brakes."""

    def plan(self, scene: Scene, forecast: Forecast) -> Plan:
        """The proposal of each situation with the highest score, the first of equals, or a stop."""
        agents = _agents(scene, forecast)
        proposals = self._propose(scene, self._cache.routes(scene), agents)
        safe, no_short_ttc, no_emergency = _rate(scene, agents, proposals.states)
        scores = self._scores(scene, proposals, safe, no_short_ttc)
        chosen = scores[:, :-1].argmax(axis=1)
        rows = np.arange(len(chosen))
        danger = 1.0 - no_emergency[rows, chosen]
        not_worse = no_emergency[:, -1] >= no_emergency[rows, chosen]
        emergency = (danger >= self.weights.emergency) & not_worse
        chosen = np.where(emergency, scores.shape[1] - 1, chosen)
        return Plan(actions=proposals.actions[rows, chosen], states=proposals.states[rows, chosen])

    def _propose(self, scene: Scene, routes: Routes, agents: _Agents) -> _Proposals:
        shape, steps = (len(routes.counts), len(self._profiles)), agents.states.shape[2]
        egos = np.ascontiguousarray(scene.states[:, EGO, -1])
        sizes = np.ascontiguousarray(scene.sizes[:, EGO])  # `_act` is compiled for each layout
        lengths = np.maximum(sizes[:, 0], 0.1)
        search_everywhere = np.full(shape[0], -1.0)
        start = route_coordinates(scene.route, scene.route_valid, egos, search_everywhere)
        arcs = np.repeat(start[:, :1], shape[1], axis=1)
        before = np.clip(scene.actions[:, EGO, -1, 0], -MAX_ACCELERATION_MPS2, None)
        before = np.repeat(before[:, None], shape[1], axis=1)
        state = np.repeat(egos[:, None], shape[1], axis=1)
        actions = np.zeros((*shape, steps, 2), dtype=np.float32)
        states = np.zeros((*shape, steps, 4), dtype=np.float32)
        offset, mean_offset = np.zeros(shape), np.zeros(shape)
        paths = np.zeros((shape[0], len(OFFSETS_M), routes.points.shape[1], 4))
        _shift(routes.points, routes.counts, np.array(OFFSETS_M), paths)
        law = self._idm.as_row()
        for k in range(steps):
            _act(
                state, sizes, arcs, offset, before, self._profiles, scene.dt_s,
                routes, paths, agents, k, law, actions[:, :, k],
            )  # fmt: skip
            before = np.ascontiguousarray(actions[:, :, k, 0])
            state = forward(state, actions[:, :, k], lengths[:, None], scene.dt_s)
            states[:, :, k] = state
            mean_offset += np.abs(offset) / steps
        return _Proposals(
            actions=actions, states=states, gained_m=arcs - start[:, :1], offset_m=mean_offset
        )

    def _scores(
        self,
        scene: Scene,
        proposals: _Proposals,
        safe: Float[np.ndarray, "b c"],
        no_short_ttc: Float[np.ndarray, "b c"],
    ) -> Float[np.ndarray, "b c"]:
        """Expected scores.

        Args:
            scene: the scene.
            proposals: the proposals.
            safe: probability of no at-fault collision.
            no_short_ttc: probability of neither such a collision nor a short TTC.
        """
        weights = self.weights
        on_road = _stays_on_road(scene, proposals.states)
        gained = np.maximum(proposals.gained_m, 0.0)
        best = (gained * safe * on_road).max(axis=1, keepdims=True)
        progress = np.minimum(gained / np.maximum(best, MIN_PROGRESS_M), 1.0)
        certain = weights.progress * progress + weights.comfort * _comfortable(scene, proposals)
        total = weights.ttc + weights.progress + weights.comfort
        # whether the TTC is short depends on whether there is a collision, the rest does not
        score = on_road * (safe * certain + weights.ttc * no_short_ttc) / total
        return score - weights.offset * proposals.offset_m / total


def _agents(scene: Scene, forecast: Forecast) -> _Agents:
    """The agents with a forecast, without the ego's trailer."""
    own_trailer = touching_trailers(
        np.ascontiguousarray(scene.states[:, :, -1]),
        scene.sizes,
        scene.classes,
        np.ascontiguousarray(scene.valid[:, :, -1]),
    )
    rated = forecast.valid & ~own_trailer[forecast.targets[:, 0], forecast.targets[:, 1]]
    rows = np.flatnonzero(rated)
    # sorted by id, so that results do not depend on the order of slots
    rows = rows[np.lexsort((forecast.ids[rows], forecast.targets[rows, 0]))]
    situation, slot = forecast.targets[rows].T
    states = forecast.states[rows]
    return _Agents(
        states=states,
        probabilities=forecast.probabilities[rows],
        leaders=states[np.arange(len(rows)), forecast.most_probable[rows]],
        sizes=scene.sizes[situation, slot],
        starts=np.searchsorted(situation, np.arange(len(scene.tick) + 1)),
    )


def _rate(
    scene: Scene, agents: _Agents, states: Float[np.ndarray, "b c t 4"]
) -> tuple[Float[np.ndarray, "b c"], Float[np.ndarray, "b c"], Float[np.ndarray, "b c"]]:
    """Probabilities of no collision, of no short TTC either, and of no collision soon."""
    out = np.zeros((3, *states.shape[:2]))
    ttc_steps = math.ceil(TTC_S / scene.dt_s - 1e-6)
    soon = int(EMERGENCY_S / scene.dt_s + 1e-6)
    _write_probabilities(states, scene.sizes[:, EGO], agents, scene.dt_s, ttc_steps, soon, out)
    return out[0], out[1], out[2]


def _stays_on_road(scene: Scene, states: Float[np.ndarray, "b c t 4"]) -> Bool[np.ndarray, "b c"]:
    """Whether no corner leaves the drivable area, or none goes farther from it."""
    outside = np.zeros(states.shape[:3], dtype=np.float32)
    for number in np.unique(scene.map_index):
        rows = np.flatnonzero(scene.map_index == number)
        sizes = np.broadcast_to(scene.sizes[rows, None, None, EGO], (*states[rows].shape[:3], 2))
        outside[rows] = off_road_m(scene.maps[int(number)], states[rows], sizes)
    return outside.max(axis=-1) <= np.maximum(OFF_ROAD_M, outside[..., 0])


def _comfortable(scene: Scene, proposals: _Proposals) -> Bool[np.ndarray, "b c"]:
    """Whether nuPlan's comfort bounds hold from now on, with the past of the window's length."""
    states = proposals.states
    window = window_ticks(scene.dt_s)
    past = scene.states[:, EGO, -window:]
    # of the past, only heading and speed matter; where unknown, they are those of now
    past = np.where(scene.valid[:, EGO, -window:, None], past, past[:, -1:])
    past = np.repeat(past[:, None], states.shape[1], axis=1)
    motion = np.concatenate([past, states], axis=2)
    if motion.shape[2] < window:
        return np.ones(states.shape[:2], dtype=bool)
    within = np.ones(states.shape[:2], dtype=bool)
    for name, values in comfort_signals(motion, scene.dt_s).items():
        low, high = BOUNDS[name]
        coming = values[..., past.shape[2] :]
        within &= (coming >= low).all(axis=-1) & (coming <= high).all(axis=-1)
    return within


@njit(cache=True)
@no_type_check
def _shift(routes, counts, offsets, paths):
    """Writes routes that are shifted sideways.

    Args:
        routes: (B, P, 2) points 1 m apart.
        counts: (B,) number of valid points.
        offsets: (O,) metres to the left.
        paths: (B, O, P, 4) [x m, y m, cosine, sine of the heading], written.
    """
    for b in range(routes.shape[0]):
        for o in range(len(offsets)):
            for i in range(counts[b]):
                x, y, dx, dy = point_on_route(routes[b], counts[b], float(i), offsets[o])
                norm = max(math.hypot(dx, dy), 1e-6)
                paths[b, o, i, 0], paths[b, o, i, 1] = x, y
                paths[b, o, i, 2], paths[b, o, i, 3] = dx / norm, dy / norm


@njit(cache=True)
@no_type_check
def _act(
    states, sizes, arcs, offsets, before, profiles, dt_s, routes, paths, agents, k, law, actions
):
    """Writes the next action of each proposal.

    Args:
        states: (B, C, 4) present states [x m, y m, heading rad, speed m/s].
        sizes: (B, 2) lengths and widths of the egos, m.
        arcs: (B, C) arc length along the route, m, brought up to date.
        offsets: (B, C) offset to the left of the route, m, written.
        before: (B, C) acceleration of the previous tick, m/s².
        profiles: (C, 2) share of the speed limit and offset m; a share of 0 brakes.
        dt_s: length of a tick.
        routes: `Routes`.
        paths: (B, O, P, 4) routes shifted by the offset of profile c at c modulo O.
        agents: `_Agents`.
        k: the tick of the forecast at which leaders are sought.
        law: (6,) parameters, `IDM.as_row`.
        actions: (B, C, 2) [acceleration m/s², steering rad], written.
    """
    for b in range(states.shape[0]):
        route, count = routes.points[b], routes.counts[b]
        first, last = agents.starts[b], agents.starts[b + 1]
        around = np.empty((last - first + 1, 4))  # the ego, then the agents
        boxes = np.empty((last - first + 1, 2))
        boxes[0], boxes[1:] = sizes[b], agents.sizes[first:last]
        around[1:] = agents.leaders[first:last, k]
        radii = 0.5 * np.sqrt(boxes[:, 0] ** 2 + boxes[:, 1] ** 2)
        is_obstacle = np.ones(len(around), dtype=np.bool_)
        length = max(boxes[0, 0], 0.1)
        for c in range(states.shape[1]):
            x, y, heading, speed = states[b, c]
            arc, offset, _ = project(route, count, x, y, max(arcs[b, c], 0.0), 10.0)
            arcs[b, c], offsets[b, c] = arc, offset
            if profiles[c, 0] == 0.0:
                acceleration = -MAX_ACCELERATION_MPS2
            else:
                around[0] = states[b, c]
                reach = max(law[5], law[4] * speed)
                path = paths[b, c % paths.shape[1]]
                gap, leader_speed = free_ahead(
                    around, boxes, radii, is_obstacle, 0, path, count, arc, reach
                )
                limits = routes.speed_limits[b]
                desired = profiles[c, 0] * limits[min(max(int(arc + 0.5), 0), count - 1)]
                # at this speed the free term of the law is the hardest braking for a target speed
                lowest = speed / (1.0 + TARGET_BRAKING_MPS2 / law[0]) ** 0.25
                wanted = idm_acceleration(speed, max(desired, lowest), gap, leader_speed, law)
                # the law alone exceeds a falling limit
                ahead = arc + speed * LIMIT_AHEAD_S
                excess = limits[min(max(int(ahead + 0.5), 0), count - 1)] - speed
                wanted = min(wanted, max(excess / LIMIT_AHEAD_S, -TARGET_BRAKING_MPS2))
                change = JERK_MPS3 * dt_s
                acceleration = min(max(wanted, before[b, c] - change), before[b, c] + change)
                acceleration = min(max(acceleration, -MAX_ACCELERATION_MPS2), law[0])
            # to standstill at most, so that comfort rates what really happens; an ego that drives
            # backwards brakes first
            actions[b, c, 0] = max(acceleration, min(-speed / dt_s, MAX_ACCELERATION_MPS2))
            step = OFFSET_RATE_MPS * PURSUIT_S
            aim = min(max(profiles[c, 1], offset - step), offset + step)
            actions[b, c, 1] = pursuit_steering(
                x, y, heading, speed, length, route, count, arc, aim
            )


@njit(cache=True)
@no_type_check
def _write_probabilities(plans, sizes, agents, dt_s, ttc_steps, soon, out):
    """Writes what is probable for each proposal.

    Args:
        plans: (B, C, T, 4) states of the proposals [x m, y m, heading rad, speed m/s].
        sizes: (B, 2) lengths and widths of the egos, m.
        agents: `_Agents`.
        dt_s: length of a tick.
        ttc_steps: ticks over which the ego is continued straight for its TTC.
        soon: ticks within which a collision is an emergency.
        out: (3, B, C) probabilities of no at-fault collision, of neither such a collision nor a
            short TTC, and of no such collision within `soon` ticks; written.
    """
    for b in range(plans.shape[0]):
        for c in range(plans.shape[1]):
            safe, calm, safe_soon = 1.0, 1.0, 1.0
            for n in range(agents.starts[b], agents.starts[b + 1]):
                hit, near, hit_soon = 0.0, 0.0, 0.0
                for m in range(agents.states.shape[1]):
                    p = agents.probabilities[n, m]
                    contact, short_ttc = _conflict(
                        plans[b, c], sizes[b], agents.states[n, m], agents.sizes[n], dt_s, ttc_steps
                    )
                    hit += p * (contact >= 0)
                    near += p * (contact >= 0 or short_ttc)
                    hit_soon += p * (0 <= contact < soon)
                safe *= 1.0 - min(hit, 1.0)
                calm *= 1.0 - min(near, 1.0)
                safe_soon *= 1.0 - min(hit_soon, 1.0)
            out[0, b, c], out[1, b, c], out[2, b, c] = safe, calm, safe_soon


@njit(cache=True)
@no_type_check
def _conflict(plan, size, other, other_size, dt_s, ttc_steps):
    """The step of the first at-fault contact, or -1, and whether the TTC is short before.

    As in nuPlan, a contact with an agent behind the ego, or while the ego stands, is excused, and
    an agent that has touched the ego has no TTC. The ego is continued straight at its speed, the
    other agent as forecast.

    Args:
        plan: (T, 4) states of the ego [x m, y m, heading rad, speed m/s].
        size: (2,) its length and width, m.
        other: (T, 4) states of the other agent.
        other_size: (2,) its length and width, m.
        dt_s: length of a tick.
        ttc_steps: ticks over which the ego is continued.
    """
    short_ttc = False
    touch = 0.5 * (math.hypot(size[0], size[1]) + math.hypot(other_size[0], other_size[1]))
    for t in range(len(plan)):
        x, y, heading, speed = plan[t]
        dx, dy = other[t, 0] - x, other[t, 1] - y
        reach = touch + (abs(speed) + abs(other[t, 3])) * ttc_steps * dt_s
        if dx * dx + dy * dy > reach * reach:
            continue
        behind = is_behind(x, y, heading, size[0], other[t, 0], other[t, 1])
        if overlaps(
            x, y, heading, size[0], size[1],
            other[t, 0], other[t, 1], other[t, 2], other_size[0], other_size[1],
        ):  # fmt: skip
            if behind or abs(speed) <= AT_REST_MPS:
                return -1, short_ttc
            return t, short_ttc
        if short_ttc or behind or abs(speed) <= STANDING_MPS:
            continue
        vx, vy = speed * math.cos(heading) * dt_s, speed * math.sin(heading) * dt_s
        for j in range(1, min(ttc_steps, len(plan) - 1 - t) + 1):
            if overlaps(
                x + j * vx, y + j * vy, heading, size[0], size[1],
                other[t + j, 0], other[t + j, 1], other[t + j, 2], other_size[0], other_size[1],
            ):  # fmt: skip
                short_ttc = True
                break
    return -1, short_ttc
