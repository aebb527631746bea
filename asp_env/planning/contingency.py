"""The planner `contingency`: one first action, and the best continuation for each joint scenario.

A candidate has a first and a second phase. The first phase, which lasts `BRANCH_S`, is common to
all that may happen; the second one may depend on which modes of the forecasts come true, because
the ego observes them by then. The cost of a first phase is therefore the expectation, over joint
scenarios of the forecasts, of the cost of the best second phase in each (as in contingency planning
and branch model predictive control: Chen et al., "Interactive multi-modal motion planning with
branch model predictive control", 2022).
"""

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int

from asp_env.compiled import njit
from asp_env.data.predictor import Forecast
from asp_env.data.scene import EGO, Scene
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH, MAX_ACCELERATION_MPS2
from asp_env.dynamics.car_following import IDM, pursuit_steering
from asp_env.geometry import project, turned_overlaps, wrap_scalar
from asp_env.metrics.boxes import AT_REST_MPS, is_behind, touching_trailers
from asp_env.metrics.drivable import OFF_ROAD_M, off_road_m
from asp_env.planning.idm import RouteCache
from asp_env.planning.planner import Plan

BRANCH_S = 1.0
"""Duration of the first phase: the ego observes after this time which modes come true. Chosen by
hand."""

FIRST_MPS2 = (-5.0, -3.5, -2.5, -1.7, -1.0, -0.5, 0.0, 0.5, 1.0, 1.4, 1.8)
"""Accelerations that first phases approach. The first one is an emergency: it is reached at once.
Chosen by hand."""

SECOND_MPS2 = (-4.0, -2.0, -1.0, 0.0, 1.0, 1.8)
"""Accelerations that second phases approach. Chosen by hand."""

OFFSETS_M = (-0.7, 0.7)
"""Offsets to the left of the route that some candidates move to. Chosen by hand."""

EVADING_MPS2 = (-3.5, -1.7, 0.0, 1.0)
"""Accelerations that the first phases of these candidates approach. Chosen by hand: fewer than on
the route, since evasion is rare."""

LATERAL_S = 2.5
"""Duration of the move to an offset. Chosen by hand."""

MAX_JERK_MPS3 = 3.2
"""Jerk of all candidates but emergencies, below nuPlan's comfort bound of 4.13 m/s³."""

LIMIT_S = 0.8
"""Time constant with which candidates approach the speed limit. Chosen by hand."""

STOP_S = 0.4
"""Time constant with which candidates come to a standstill. Chosen by hand."""

TTC_S = (0.4, 0.8, 1.0)
"""A candidate is critical if the ego, going straight on at its speed, touches an agent after one of
these times, rounded to ticks: the bound of the driving rules is 0.95 s."""

MARGIN_M = 0.25
"""Margin on every side of the ego's box when closeness is rated. Chosen by hand."""

OFF_ROAD_ROUTE_M = 5.0
"""Where the route itself is off the road, up to this far beyond what candidates reach, the ego may
be off the road as far as the route is: as for the log in the driving rules."""

ROUTE_TOLERANCE_M = 0.3
"""It may be farther off than the route by this: the ego does not follow the route exactly."""

MAX_JOINT_AGENTS = 3
"""Number of agents whose modes are combined to joint scenarios; the modes of all others are
averaged. Chosen by hand: the cost grows with the power."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ContingencyWeights:
    """What a candidate costs, in metres of progress.

    They follow the proportions of PDMS over an episode of about 70 m: a collision loses all of it,
    a short time to collision five twelfths, discomfort two twelfths.
    """

    collision: float = 160.0
    """A contact at the ego's fault."""
    obstruction: float = 60.0
    """A contact while the ego stands in the way of an agent that is not behind it."""
    critical: float = 60.0
    """A time to collision within the bound."""
    closeness: float = 15.0
    """A contact with margins."""
    later: float = 0.9
    """Share by which these cost less at the end of the horizon than now."""
    progress: float = 1.0
    """Per metre gained along the route; subtracted."""
    speed: float = 1.0
    """Per m/s of speed at the end of the horizon; subtracted."""
    acceleration: float = 0.4
    """Per (m/s²)², mean over the horizon."""
    jerk: float = 0.3
    """Per (m/s³)², mean over the horizon."""
    lateral: float = 0.4
    """Per (m/s²)² of lateral acceleration, mean over the horizon."""
    emergency: float = 12.0
    """For braking beyond the limit of jerk."""
    off_road: float = 80.0
    """If a corner leaves the drivable area by more than nuPlan's tolerance."""
    offset: float = 3.0
    """Per metre of distance from the route, mean over the horizon."""
    evasion: float = 12.0
    """For moving to an offset beside the route."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BranchingCandidates:
    """F first phases with S second phases each, for each of B egos over T ticks."""

    actions: Float[np.ndarray, "b f s t 2"]
    """[acceleration m/s², steering rad]."""
    states: Float[np.ndarray, "b f s t 4"]
    """[x m, y m, heading rad, speed m/s] after each action."""
    fixed_costs: Float[np.ndarray, "b f s"]
    """The part of the costs that depends on no other agent."""


class ContingencyPlanner:
    """Chooses the first phase with the lowest expected cost of its best continuations.

    Candidates are limited in jerk, keep the speed limits of lanes and bends, and steer by pure
    pursuit of the route or of a line that moves beside it along a quintic polynomial. Since the
    first phase starts from the present acceleration, consecutive plans agree without a memory of
    the last one. Joint scenarios combine the modes of the agents whose modes change the costs most.
    Contacts with an agent behind the ego are excused; a trailer that the ego touches at present
    belongs to it and is ignored.
    """

    name = "contingency"
    privileged = False
    uses_forecasts = True

    def __init__(self, weights: ContingencyWeights | None = None) -> None:
        """Creates the planner.

        Args:
            weights: of the costs, by default `ContingencyWeights()`.
        """
        self.weights = weights or ContingencyWeights()
        self._cache = RouteCache(IDM(), map_limits=True)
        evading = itertools.product(EVADING_MPS2, OFFSETS_M)
        self._first = np.array([*((each, 0.0) for each in FIRST_MPS2), *evading])
        """(F, 2) acceleration m/s² and offset m."""
        self._second = np.array(SECOND_MPS2)

    def plan(self, scene: Scene, forecast: Forecast) -> Plan:
        """The best first phase of each situation with the continuation that is best on average."""
        steps = forecast.states.shape[2]
        candidates = self.candidates(scene, steps)
        costs, best_second = self._expected(scene, forecast, candidates)
        best = costs.argmin(axis=1)
        rows = np.arange(len(best))
        second = best_second[rows, best]
        return Plan(
            actions=candidates.actions[rows, best, second],
            states=candidates.states[rows, best, second],
        )

    def candidates(self, scene: Scene, steps: int) -> BranchingCandidates:
        """All candidates of each situation, which do not depend on forecasts.

        Args:
            scene: the present scene, with the routes of the egos.
            steps: number of ticks.
        """
        routes = self._cache.routes(scene)
        egos = scene.states[:, EGO, -1].astype(np.float64)
        shape = (len(egos), len(self._first), len(self._second))
        actions = np.zeros((*shape, steps, 2), dtype=np.float32)
        states = np.zeros((*shape, steps, 4), dtype=np.float32)
        motion = np.zeros((*shape, 6))
        before = np.clip(
            scene.actions[:, EGO, -1, 0], -MAX_ACCELERATION_MPS2, MAX_ACCELERATION_MPS2
        ).astype(np.float64)
        lengths = np.maximum(scene.sizes[:, EGO, 0], 0.1).astype(np.float64)
        switch = min(max(round(BRANCH_S / scene.dt_s), 1), steps)
        _roll_out(
            egos, before, lengths, routes, self._first, self._second, switch, scene.dt_s,
            actions, states, motion,
        )  # fmt: skip
        return BranchingCandidates(
            actions=actions, states=states, fixed_costs=self._fixed_costs(scene, states, motion)
        )

    def costs(
        self, scene: Scene, forecast: Forecast, candidates: BranchingCandidates
    ) -> Float[np.ndarray, "b f"]:
        """The expected cost of each first phase with its best continuations.

        Args:
            scene: the present scene.
            forecast: of all other agents that are present.
            candidates: the candidates of the scene over the horizon of the forecast.
        """
        return self._expected(scene, forecast, candidates)[0]

    def _fixed_costs(
        self,
        scene: Scene,
        states: Float[np.ndarray, "b f s t 4"],
        motion: Float[np.ndarray, "b f s 6"],
    ) -> Float[np.ndarray, "b f s"]:
        weights = self.weights
        gained, speed, acceleration, jerk, lateral, offset = np.moveaxis(motion, -1, 0)
        outside = np.zeros(states.shape[:-1])
        allowed = np.zeros(len(states))
        routes = self._cache.routes(scene)
        for b, index in enumerate(scene.map_index):
            size = np.broadcast_to(scene.sizes[b, EGO], (*states.shape[1:-1], 2))
            outside[b] = off_road_m(scene.maps[int(index)], states[b], size)
            reach_m = np.abs(routes.points[b] - scene.states[b, EGO, -1, :2]).max(axis=1)
            near = reach_m <= gained[b].max() + OFF_ROAD_ROUTE_M
            allowed[b] = (routes.off_road_m[b] * near)[: routes.counts[b]].max()
        # an ego that is off the road already, or whose route is, pays only for going farther
        allowed = np.maximum(OFF_ROAD_M, allowed + ROUTE_TOLERANCE_M * (allowed > OFF_ROAD_M))
        leaves_road = outside.max(axis=-1) > np.maximum(allowed[:, None, None], outside[..., 0])
        emergency = (self._first[:, 0] == FIRST_MPS2[0])[:, None]
        return (
            -weights.progress * gained
            - weights.speed * speed
            + weights.acceleration * acceleration
            + weights.jerk * np.where(emergency, 0.0, jerk)
            + weights.emergency * emergency
            + weights.lateral * lateral
            + weights.off_road * leaves_road
            + weights.offset * offset
            + weights.evasion * (self._first[:, 1:] != 0)
        )

    def _expected(
        self, scene: Scene, forecast: Forecast, candidates: BranchingCandidates
    ) -> tuple[Float[np.ndarray, "b f"], Int[np.ndarray, "b f"]]:
        """Expected cost of each first phase, and its second phase that is best on average."""
        weights, fixed = self.weights, candidates.fixed_costs
        agents = _rated_agents(scene, forecast)
        rates = _Rates(
            collision=weights.collision,
            obstruction=weights.obstruction,
            critical=weights.critical,
            closeness=weights.closeness,
            later=weights.later,
        )
        ticks = [max(round(time / scene.dt_s), 1) for time in TTC_S]
        times = np.array([(count, count * scene.dt_s) for count in ticks])
        total = np.zeros(fixed.shape[:2])
        second = np.zeros(fixed.shape[:2], dtype=np.int64)
        _expected_costs(
            candidates.states, scene.sizes[:, EGO].astype(np.float64), fixed, agents, rates,
            times, total, second,
        )  # fmt: skip
        return total, second


class _Rates(NamedTuple):
    """`ContingencyWeights` of contacts, as kernels take them."""

    collision: float
    obstruction: float
    critical: float
    closeness: float
    later: float


class _Agents(NamedTuple):
    """Forecasts of the agents that are rated, sorted by situation."""

    states: np.ndarray
    """(N, M, T, 4) [x m, y m, cosine, sine of the heading]."""
    probabilities: np.ndarray
    """(N, M)."""
    sizes: np.ndarray
    """(N, 2) lengths and widths, m."""
    starts: np.ndarray
    """(B + 1,) the agents of situation b are `starts[b]:starts[b + 1]`."""


def _rated_agents(scene: Scene, forecast: Forecast) -> _Agents:
    own_trailer = touching_trailers(
        np.ascontiguousarray(scene.states[:, :, -1]),
        scene.sizes,
        scene.classes,
        np.ascontiguousarray(scene.valid[:, :, -1]),
    )
    rated = forecast.valid & ~own_trailer[forecast.targets[:, 0], forecast.targets[:, 1]]
    targets = forecast.targets[rated]
    order = np.argsort(targets[:, 0], kind="stable")
    states = forecast.states[rated][order].astype(np.float64)
    heading = states[..., 2].copy()
    states[..., 2], states[..., 3] = np.cos(heading), np.sin(heading)
    return _Agents(
        states=states,
        probabilities=forecast.probabilities[rated][order].astype(np.float64),
        sizes=scene.sizes[targets[order, 0], targets[order, 1]].astype(np.float64),
        starts=np.searchsorted(targets[order, 0], np.arange(len(scene.tick) + 1)),
    )


@njit(cache=True)
@no_type_check
def _roll_out(egos, before, lengths, routes, first, second, switch, dt_s, actions, states, motion):
    """Writes the candidates of all situations.

    Args:
        egos: (B, 4) present states [x m, y m, heading rad, speed m/s].
        before: (B,) acceleration in the last tick, m/s².
        lengths: (B,) lengths of the egos, m.
        routes: `Routes`.
        first: (F, 2) acceleration m/s² and offset m of the first phases.
        second: (S,) acceleration of the second phases, m/s².
        switch: number of ticks of the first phase.
        dt_s: seconds per tick.
        actions: (B, F, S, T, 2), written.
        states: (B, F, S, T, 4), written.
        motion: (B, F, S, 6), written: metres gained along the route; final speed m/s; means of the
            squares of acceleration, jerk and lateral acceleration; mean distance from the route m.
    """
    steps = actions.shape[3]
    state = np.empty(10)
    branch = np.empty(10)
    for b in range(len(egos)):
        route, count, limits = routes.points[b], routes.counts[b], routes.speed_limits[b]
        arc_0, offset_0, _ = project(route, count, egos[b, 0], egos[b, 1], -1.0, 0.0)
        for f in range(len(first)):
            emergency = first[f, 0] <= -MAX_ACCELERATION_MPS2
            state[:4] = egos[b]
            state[4], state[5] = before[b], arc_0
            state[6:] = 0.0
            for k in range(switch):
                _advance(
                    state, route, count, limits, lengths[b], first[f, 0], emergency, offset_0,
                    first[f, 1], k, dt_s, actions[b, f, 0, k],
                )  # fmt: skip
                states[b, f, 0, k] = state[:4]
            for s in range(len(second)):
                if s > 0:
                    actions[b, f, s, :switch] = actions[b, f, 0, :switch]
                    states[b, f, s, :switch] = states[b, f, 0, :switch]
                branch[:] = state
                for k in range(switch, steps):
                    _advance(
                        branch, route, count, limits, lengths[b], second[s], False, offset_0,
                        first[f, 1], k, dt_s, actions[b, f, s, k],
                    )  # fmt: skip
                    states[b, f, s, k] = branch[:4]
                motion[b, f, s, 0] = branch[5] - arc_0
                motion[b, f, s, 1] = branch[3]
                motion[b, f, s, 2:] = branch[6:] / steps


@njit(cache=True)
@no_type_check
def _advance(
    state, route, count, limits, length, target, emergency, offset_0, offset_1, k, dt_s, action
):
    """Advances a candidate by one tick.

    Args:
        state: (10,) [x m, y m, heading rad, speed m/s, acceleration m/s², arc length m, and sums of
            the squares of acceleration, jerk and lateral acceleration, and of the distance from the
            route m], brought up to date.
        route: (P, 2) points 1 m apart.
        count: number of valid points.
        limits: (P,) speed limits, m/s.
        length: of the ego, m.
        target: acceleration to approach, m/s².
        emergency: whether it is reached at once.
        offset_0: present offset to the left of the route, m.
        offset_1: offset to move to, m.
        k: index of the tick.
        dt_s: seconds per tick.
        action: (2,) [acceleration m/s², steering rad], written.
    """
    x, y, heading, speed, before = state[0], state[1], state[2], state[3], state[4]
    arc = state[5]
    ahead = min(max(int(arc + speed * LIMIT_S + 0.5), 0), count - 1)
    here = min(max(int(arc + 0.5), 0), count - 1)
    limit = min(limits[here], limits[ahead])
    acceleration = min(target, max((limit - speed) / LIMIT_S, -2.5))
    if not emergency:
        acceleration = max(acceleration, -speed / STOP_S)
        most = MAX_JERK_MPS3 * dt_s
        acceleration = min(max(acceleration, before - most), before + most)
    acceleration = min(max(acceleration, -MAX_ACCELERATION_MPS2), MAX_ACCELERATION_MPS2)
    # to standstill at most; an ego that drives backwards brakes first
    acceleration = max(acceleration, min(-speed / dt_s, MAX_ACCELERATION_MPS2))
    share = min(((k + 1) * dt_s + 0.4) / LATERAL_S, 1.0)
    share = share * share * share * (10.0 + share * (6.0 * share - 15.0))
    offset = offset_0 + share * (offset_1 - offset_0)
    steering = pursuit_steering(x, y, heading, speed, length, route, count, arc, offset)
    slip = math.atan(0.5 * math.tan(steering))
    after = max(speed + acceleration * dt_s, min(speed, 0.0))
    turn = math.sin(slip) / (AXLE_SHARE_OF_LENGTH * length) * dt_s
    course = heading + slip
    end = course + speed * turn
    turned = 0.5 * (speed + after) * turn
    state[0] = x + 0.5 * dt_s * (speed * math.cos(course) + after * math.cos(end))
    state[1] = y + 0.5 * dt_s * (speed * math.sin(course) + after * math.sin(end))
    state[2] = wrap_scalar(heading + turned)
    state[3], state[4] = after, acceleration
    arc, left, _ = project(route, count, state[0], state[1], max(arc, 0.0), 5.0)
    state[5] = arc
    jerk, lateral = (acceleration - before) / dt_s, after * turned / dt_s
    state[6] += acceleration * acceleration
    state[7] += jerk * jerk
    state[8] += lateral * lateral
    state[9] += abs(left)
    action[0], action[1] = acceleration, steering


@njit(cache=True)
@no_type_check
def _expected_costs(plans, sizes, fixed, agents, rates, times, total, second):
    """Writes the expected cost of each first phase and its second phase that is best on average.

    Args:
        plans: (B, F, S, T, 4) states of the candidates [x m, y m, heading rad, speed m/s].
        sizes: (B, 2) lengths and widths of the egos, m.
        fixed: (B, F, S) costs that depend on no other agent.
        agents: `_Agents`.
        rates: `_Rates`.
        times: (times, 2) ticks and seconds after which the ego, going straight on, must not
            touch an agent.
        total: (B, F), written.
        second: (B, F), written.
    """
    modes = agents.states.shape[1]
    for b in range(len(plans)):
        first_agent, count = agents.starts[b], agents.starts[b + 1] - agents.starts[b]
        costs = np.zeros((plans.shape[1] * plans.shape[2], count, modes))
        _contact_costs(plans[b], sizes[b], agents, first_agent, rates, times, costs)
        probabilities = agents.probabilities[first_agent : first_agent + count]
        joint = _joint_agents(costs, probabilities)
        # agents outside the joint scenarios count with the mean over their modes
        mean = fixed[b].copy().reshape(-1)
        for n in range(count):
            if not (joint == n).any():
                _add_mean(costs, probabilities, n, mean)
        _average_over_scenarios(costs, probabilities, joint, mean, total[b])
        for n in joint:
            _add_mean(costs, probabilities, n, mean)
        for f in range(plans.shape[1]):
            second[b, f] = mean[f * plans.shape[2] : (f + 1) * plans.shape[2]].argmin()


@njit(cache=True)
@no_type_check
def _add_mean(costs, probabilities, n, mean):
    """Adds the mean over the modes of agent n of `costs` (C, N, M) to `mean` (C,)."""
    for c in range(len(mean)):
        for m in range(costs.shape[2]):
            mean[c] += probabilities[n, m] * costs[c, n, m]


@njit(cache=True)
@no_type_check
def _average_over_scenarios(costs, probabilities, joint, other, total):
    """Writes the expectation over joint scenarios of the cost of the best second phase.

    Args:
        costs: (F * S, N, M) of candidates by agent and mode.
        probabilities: (N, M).
        joint: (J,) agents whose modes form the M ** J scenarios.
        other: (F * S,) further costs of each candidate.
        total: (F,), written.
    """
    modes = costs.shape[2]
    num_second = len(other) // len(total)
    total[:] = 0.0
    sum_of_weights = 0.0
    chosen = np.zeros(len(joint), dtype=np.int64)
    for index in range(modes ** len(joint)):
        weight, rest = 1.0, index
        for i in range(len(joint)):
            chosen[i] = rest % modes
            rest //= modes
            weight *= probabilities[joint[i], chosen[i]]
        sum_of_weights += weight
        for f in range(len(total)):
            best = np.inf
            for c in range(f * num_second, (f + 1) * num_second):
                cost = other[c]
                for i in range(len(joint)):
                    cost += costs[c, joint[i], chosen[i]]
                best = min(best, cost)
            total[f] += weight * best
    total /= max(sum_of_weights, 1e-12)


@njit(cache=True)
@no_type_check
def _joint_agents(costs, probabilities):
    """Indices of the agents whose modes change the costs most, at most `MAX_JOINT_AGENTS`.

    Args:
        costs: (C, N, M) of candidates by agent and mode.
        probabilities: (N, M).
    """
    count, modes = probabilities.shape
    spread = np.zeros(count)
    for n in range(count):
        for c in range(len(costs)):
            mean, square = 0.0, 0.0
            for m in range(modes):
                mean += probabilities[n, m] * costs[c, n, m]
                square += probabilities[n, m] * costs[c, n, m] ** 2
            spread[n] = max(spread[n], square - mean * mean)
    order = np.argsort(-spread, kind="mergesort")[:MAX_JOINT_AGENTS]
    return order[spread[order] > 1e-6]


@njit(cache=True)
@no_type_check
def _contact_costs(plans, size, agents, first_agent, rates, times, costs):
    """Writes what contacts of each candidate with each mode of each agent cost.

    Args:
        plans: (F, S, T, 4) states of the candidates.
        size: (2,) length and width of the ego, m.
        agents: `_Agents`.
        first_agent: index of the first agent of this situation.
        rates: `_Rates`.
        times: (times, 2).
        costs: (F * S, N, M), written.
    """
    num_second, steps = plans.shape[1], plans.shape[2]
    radius = 0.5 * math.hypot(size[0], size[1]) + MARGIN_M
    cos, sin = np.cos(plans[..., 2]), np.sin(plans[..., 2])
    x_0, y_0 = plans[0, 0, 0, 0], plans[0, 0, 0, 1]
    within_m = np.zeros(steps)  # no candidate, or its extension, is farther from (x_0, y_0)
    for f in range(len(plans)):
        for s in range(num_second):
            for t in range(steps):
                away = math.hypot(plans[f, s, t, 0] - x_0, plans[f, s, t, 1] - y_0)
                within_m[t] = max(within_m[t], away + TTC_S[-1] * plans[f, s, t, 3])
    for n in range(costs.shape[1]):
        other_size = agents.sizes[first_agent + n]
        reach = radius + 0.5 * math.hypot(other_size[0], other_size[1])
        for m in range(costs.shape[2]):
            other = agents.states[first_agent + n, m]
            farthest, meets = 0.0, False
            for t in range(steps):
                farthest = max(farthest, within_m[t])
                away = math.hypot(other[t, 0] - x_0, other[t, 1] - y_0)
                meets = meets or away < farthest + reach
            if not meets:
                continue
            for c in range(len(costs)):
                f, s = c // num_second, c % num_second
                costs[c, n, m] = _contact_cost(
                    plans[f, s], cos[f, s], sin[f, s], size, other, other_size, reach, rates, times
                )


@njit(cache=True)
@no_type_check
def _contact_cost(plan, cos, sin, size, other, other_size, reach, rates, times):
    """What the contacts of one candidate with one mode of an agent cost.

    Args:
        plan: (T, 4) states of the ego [x m, y m, heading rad, speed m/s].
        cos: (T,) cosine of its heading.
        sin: (T,) sine of its heading.
        size: (2,) its length and width, m.
        other: (T, 4) [x m, y m, cosine, sine] of the other agent.
        other_size: (2,) its length and width, m.
        reach: boxes with margins cannot overlap beyond this distance of their centres, m.
        rates: `_Rates`.
        times: (times, 2).
    """
    steps = len(plan)
    critical, close = 0.0, 0.0
    for t in range(steps):
        x, y = plan[t, 0], plan[t, 1]
        share = 1.0 - rates.later * t / steps
        if _touches(x, y, cos[t], sin[t], size, MARGIN_M, other, t, other_size, reach):
            if is_behind(x, y, plan[t, 2], size[0], other[t, 0], other[t, 1]):
                return max(critical, close)  # what follows is excused as well
            close = max(close, rates.closeness * share)
            if _touches(x, y, cos[t], sin[t], size, 0.0, other, t, other_size, reach):
                standing = abs(plan[t, 3]) <= AT_REST_MPS
                cost = rates.obstruction if standing else rates.collision
                return max(cost * share, critical)
        if critical == 0.0 and _is_critical(
            plan, cos[t], sin[t], t, size, other, other_size, reach, times
        ):
            critical = rates.critical * share
    return max(critical, close)


@njit(cache=True)
@no_type_check
def _is_critical(plan, cos, sin, t, size, other, other_size, reach, times):
    """Whether the ego, going straight on from tick t, touches an agent that is not behind it.

    The arguments are those of `_contact_cost`, with the cosine and the sine at tick t.
    """
    x, y, speed = plan[t, 0], plan[t, 1], plan[t, 3]
    if speed <= AT_REST_MPS:
        return False
    for i in range(len(times)):
        later = t + int(times[i, 0])
        if later >= len(plan):
            break
        along = speed * times[i, 1]
        if _touches(
            x + along * cos, y + along * sin, cos, sin, size, 0.0, other, later, other_size, reach
        ):
            return not is_behind(x, y, plan[t, 2], size[0], other[t, 0], other[t, 1])
    return False


@njit(cache=True, inline="always")
@no_type_check
def _touches(x, y, cos, sin, size, margin, other, t, other_size, reach):
    """Whether the ego's box overlaps that of another agent.

    Args:
        x: of the ego, m.
        y: of the ego, m.
        cos: of its heading.
        sin: of its heading.
        size: (2,) its length and width, m.
        margin: added to every side of its box, m.
        other: (T, 4) [x m, y m, cosine, sine] of the other agent.
        t: tick of the other agent.
        other_size: (2,) its length and width, m.
        reach: boxes with margins cannot overlap beyond this distance of their centres, m.
    """
    dx, dy = other[t, 0] - x, other[t, 1] - y
    if dx * dx + dy * dy >= reach * reach:
        return False
    return turned_overlaps(
        x, y, cos, sin, size[0] + 2.0 * margin, size[1] + 2.0 * margin,
        other[t, 0], other[t, 1], other[t, 2], other[t, 3], other_size[0], other_size[1],
    )  # fmt: skip
