"""The driving cost: what a drive costs in seconds of delay, risk and discomfort.

It rates driven episodes, not plans, and does not use a planner's own cost.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.geometry import route_coordinates
from asp_env.metrics.driving.margins import BOUNDED_TTC

SAME_PLACE_M = 1.0
"""Two positions on the route within this arc length count as the same place. Otherwise an ego that
stops 0.2 m before the position at which the logged ego waits would lose the whole wait. The price
is that delays below 1 m at the present speed are 0. Chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivingCostWeights:
    """Exchange rates of the driving cost. Delay counts 1 per second. Chosen by hand."""

    risk: float = 5.0
    """Seconds of delay per second at full severity. In PDMS a time to collision below its bound
    costs as much as a drive without progress, about 10 s; a foreseeable overlap lasts about 2 s."""
    discomfort: float = 1.0
    """Seconds of delay per second beyond nuPlan's comfort bounds: harsh motion is worth avoiding if
    the ego arrives later by no more than the harsh motion would have lasted."""
    fault: float = 30.0
    """Seconds of delay per episode with an at-fault collision or with an ego off the road, in
    addition to the rest of the scenario, which is lost. It is more than the largest cost of a drive
    without one, 21 s among 6,500 drives by the log and by the planner `sampling`. No gain in time,
    risk and comfort therefore outweighs a fault."""


def severity(ttc_s: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Severity of foreseeable overlaps: (1 - TTC / 3 s)², 0 from 3 s on and 1 at 0 s.

    It is quadratic, since times to collision of 2 to 3 s are ordinary: a severity of at most 1/9.

    Args:
        ttc_s: time to collision, seconds.
    """
    return (1.0 - np.clip(ttc_s / BOUNDED_TTC.horizon_s, 0.0, 1.0)) ** 2


def log_route_m(
    routes: Float[np.ndarray, "b p 2"],
    valid: Bool[np.ndarray, "b p"],
    log_states: Float[np.ndarray, "b l 4"],
) -> Float[np.ndarray, "b l"]:
    """Arc length of the logged egos along their routes at each tick, metres.

    Args:
        routes: points 1 m apart.
        valid: which points exist; valid ones come first.
        log_states: [x m, y m, heading rad, speed m/s] of the logged egos.
    """
    out = np.zeros(log_states.shape[:2])
    near_m = np.zeros(len(log_states))
    for k in range(log_states.shape[1]):
        near_m = route_coordinates(routes, valid, log_states[:, k], np.maximum(near_m, 0.0))[:, 0]
        out[:, k] = near_m
    return out


def time_lost_s(
    route_m: Float[np.ndarray, "b t"],
    num_ticks: Int[np.ndarray, " b"],
    log_route_m: Float[np.ndarray, "b l"],
    scenario_ticks: Int[np.ndarray, " b"],
    dt_s: float,
) -> Float[np.ndarray, " b"]:
    """Time that the ego lost against the log by the end of each episode; negative if it gained.

    It is the elapsed time less the time at which the logged ego was at the same place, within
    `SAME_PLACE_M` along the route; of the times while the logged ego stands there, the nearest
    counts. An ego that ends before the goal, by a collision or off the road, stands at its last
    place until the end of the scenario, so that the rest is lost as well.

    Args:
        route_m: arc length of the ego along the logged route at up to T ticks.
        num_ticks: number of ticks of each episode, the first one included.
        log_route_m: arc length of the logged ego at the ticks of the scenario from the first on.
        scenario_ticks: number of steps of each scenario; later values of `log_route_m` are ignored.
        dt_s: seconds per tick.

    Returns:
        Seconds.
    """
    out = np.zeros(len(route_m))
    for b, (count, steps) in enumerate(
        zip(num_ticks.tolist(), scenario_ticks.tolist(), strict=True)
    ):
        if not count:
            continue
        furthest = np.maximum.accumulate(log_route_m[b, : steps + 1])
        reached = route_m[b, count - 1]
        at_goal = reached >= furthest[-1] - SAME_PLACE_M
        elapsed = count - 1 if at_goal else steps
        first = _first_tick_at(furthest, reached - SAME_PLACE_M)
        last = _last_tick_at(furthest, reached + SAME_PLACE_M)
        out[b] = dt_s * (elapsed - min(max(elapsed, first), last))
    return out


def driving_cost_s(
    *,
    time_lost_s: Float[np.ndarray, " b"],
    ttc_s: Float[np.ndarray, "b t"],
    uncomfortable: Bool[np.ndarray, "b t"],
    fault: Bool[np.ndarray, " b"],
    active: Bool[np.ndarray, "b t"],
    dt_s: float,
    weights: DrivingCostWeights,
) -> Float[np.ndarray, " b"]:
    """Sum of the time lost, risk, discomfort and faults, seconds.

    Args:
        time_lost_s: seconds; gained time is not credited, since the log need not be overtaken.
        ttc_s: time to collision.
        uncomfortable: ticks beyond a comfort bound.
        fault: episodes with an at-fault collision or with an ego off the road.
        active: ticks that belong to each episode.
        dt_s: seconds per tick.
        weights: exchange rates.
    """
    at_risk_s = dt_s * np.where(active, severity(ttc_s), 0.0).sum(axis=1)
    harsh_s = dt_s * (uncomfortable & active).sum(axis=1)
    return (
        np.maximum(time_lost_s, 0.0)
        + weights.risk * at_risk_s
        + weights.discomfort * harsh_s
        + weights.fault * fault
    )


def _first_tick_at(furthest_m: Float[np.ndarray, " l"], arc_m: float) -> float:
    """The first time, in ticks and interpolated, at which an increasing arc length is reached."""
    after = int(np.searchsorted(furthest_m, arc_m, side="left"))
    return _between(furthest_m, after, arc_m)


def _last_tick_at(furthest_m: Float[np.ndarray, " l"], arc_m: float) -> float:
    """The last time, in ticks and interpolated, at which it is not yet exceeded."""
    after = int(np.searchsorted(furthest_m, arc_m, side="right"))
    return _between(furthest_m, after, arc_m)


def _between(furthest_m: Float[np.ndarray, " l"], after: int, arc_m: float) -> float:
    if after == 0:
        return 0.0
    if after == len(furthest_m):
        return len(furthest_m) - 1.0
    low, high = furthest_m[after - 1 : after + 1]
    return after - 1 + float((arc_m - low) / (high - low))
