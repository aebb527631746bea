"""Scores of driven episodes: one number with a mask per episode and metric, by given rules."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.metrics.boxes import Contact
from asp_env.metrics.driving.comfort import (
    comfort_signals,
    share_of_bounds,
    window_ticks,
    within_bounds,
)
from asp_env.metrics.driving.cost import (
    DrivingCostWeights,
    driving_cost_s,
    time_lost_s,
)
from asp_env.metrics.driving.map_context import MapContext
from asp_env.metrics.driving.margins import BOUNDED_TTC
from asp_env.metrics.driving.rules import NUPLAN, Rules
from asp_env.metrics.forecast.feasibility import infeasible_ticks
from asp_env.metrics.masked import Masked

WRONG_WAY_M = 3.5
"""Further than this from every reachable lane is the wrong way (Waymax)."""

DIRECTION_WINDOW_S = 1.0
"""Window over which the distance against the traffic is summed (nuPlan)."""

COMPLIANT_M = 2.0
"""Up to this distance against the traffic within the window, `direction` is 1 (nuPlan)."""

VIOLATION_M = 6.0
"""Beyond this distance `direction` is 0 (nuPlan)."""

OVERSPEED_MPS = 2.23
"""At this mean overspeed the metric `speed` is 0 (nuPlan)."""

MIN_PROGRESS = 0.2
"""From this share of the log's progress on, the ego makes progress (nuPlan)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRecord:
    """Measurements of the ego in B driven episodes of up to T ticks."""

    states: Float[np.ndarray, "b t 4"]
    """[x m, y m, heading rad, speed m/s] of the ego."""
    log_states: Float[np.ndarray, "b t 4"]
    """States of the logged ego at the same ticks."""
    contacts: Int[np.ndarray, "b t a"]
    """`Contact` of the ego with each agent."""
    off_road_m: Float[np.ndarray, "b t"]
    """Distance to the drivable area beyond what the log allows: `beyond_log_m`."""
    ttc_s: Float[np.ndarray, "b t"]
    """Time to collision by the rules."""
    route_m: Float[np.ndarray, "b t"]
    """Arc length on the logged route."""
    route_offset_m: Float[np.ndarray, "b t"]
    """Lateral offset from the logged route."""
    goal_m: Float[np.ndarray, " b"]
    """Arc length of the logged ego at the end."""
    log_route_m: Float[np.ndarray, "b l"]
    """Arc length of the logged ego on its route at the ticks of the scenario, from the first on."""
    scenario_ticks: Int[np.ndarray, " b"]
    """Number of steps that each scenario provides."""
    near_miss: Bool[np.ndarray, "b t"]
    """Values of `near_misses`."""
    bounded_ttc_s: Float[np.ndarray, "b t"]
    """Values of `bounded_ttc_s`, the same under all rules."""
    required_mps2: Float[np.ndarray, "b t"]
    """Values of `required_deceleration`."""
    map_context: MapContext
    active: Bool[np.ndarray, "b t"]
    """Ticks that belong to each episode: the first ones."""
    dt_s: float
    """Seconds per tick."""


def driving_metrics(record: EpisodeRecord, rules: Rules) -> dict[str, Masked]:
    """All driving metrics (b,) by name; missing for episodes without a tick.

    - `no collision`, `no at-fault collision`, `no hit from behind`: 1 or 0. An agent that hits the
      ego from behind may be replayed and cannot react; such contacts are counted separately.
    - `on road`: 0 if a corner is ever further outside the drivable area than the rules allow. Where
      the logged ego is itself off the road, within 5 m along its route and 2 m beside it, that
      distance is allowed as well, since maps have gaps. `on mapped road` does not allow it.
    - `direction`: 1, 0.5 or 0 by the distance driven against the traffic within 1 s; missing on
      maps without areas of lanes.
    - `right way`: 0 if the ego is ever over 3.5 m from every lane reachable from its start.
    - `progress`: the share of the logged ego's progress, 0 to 1; `making progress`: 1 from 0.2 on.
    - `TTC`: 1 if the time to collision is always above the bound of the rules.
    - `speed`: max(0, 1 - mean overspeed / 2.23 m/s) over ticks with a known limit; missing without.
    - `comfort`: 1 if all of nuPlan's bounds hold; missing for episodes shorter than its window of
      about 1 s (`window_ticks`; 5 ticks of 0.2 s).
    - `feasible`: 0 if acceleration or curvature ever exceeds Waymax's bounds; missing for a single
      tick.
    - `log divergence`, `route deviation`: mean distance to the logged ego at the same ticks, and
      mean absolute offset from its route, m.
    - `no near miss`: 1 or 0; `near misses`: share of the ticks that are near misses.
    - `min TTC`: the smallest time to collision at constant velocity (`BOUNDED_TTC`), s, at most 3.
    - `required deceleration`: the largest over ticks, m/s², at most 8.
    - `safety margin`: the threshold of `TTC`, 0.95 s, widened to a ramp: min TTC / 1.9 s, up to 1.
    - `uncomfortable ticks`: share of the ticks beyond a comfort bound.
    - `smoothness`: the thresholds of `comfort` widened to a ramp: 1 up to half of every bound, 0.5
      at a bound, 0 from 1.5 times a bound on. Both are missing where `comfort` is.
    - `time lost`: against the log, s.
    - `driving cost`: `driving_cost_s` with `DrivingCostWeights`, s; faults are nuPlan's under all
      rules.
    - `score`: the product of the multipliers times the weighted mean of the rules; missing metrics
      are left out of both.

    Args:
        record: the driven episodes.
        rules: thresholds and definitions.
    """
    active = record.active
    count = active.sum(axis=1)
    has_ticks = np.asarray(count > 0)
    contacts = np.where(active[..., None], record.contacts, Contact.NONE)
    off_road = (record.off_road_m > rules.off_road_m) & active
    off_map = (record.map_context.outside_m > rules.off_road_m) & active
    short_ttc = (record.ttc_s <= rules.ttc.min_ttc_s) & active
    divergence = np.linalg.norm(record.states[..., :2] - record.log_states[..., :2], axis=-1)
    progress = _progress(record, rules)
    wrong_way = (record.map_context.distance_to_route_lanes_m > WRONG_WAY_M) & active
    values = {
        "no collision": 1.0 - (contacts > 0).any(axis=(1, 2)),
        "no at-fault collision": 1.0 - at_fault(record, rules).any(axis=1),
        "no hit from behind": 1.0 - (contacts == Contact.REAR).any(axis=(1, 2)),
        "on road": 1.0 - off_road.any(axis=1),
        "on mapped road": 1.0 - off_map.any(axis=1),
        "right way": 1.0 - wrong_way.any(axis=1),
        "progress": progress,
        "making progress": (progress >= MIN_PROGRESS).astype(np.float64),
        "TTC": 1.0 - short_ttc.any(axis=1),
        "log divergence": _mean_over_ticks(divergence, active),
        "route deviation": _mean_over_ticks(np.abs(record.route_offset_m), active),
    }
    uncomfortable, share_of_bound = _comfort_over_ticks(record)
    metrics = {name: Masked(value=value, valid=has_ticks) for name, value in values.items()}
    metrics |= {
        "direction": _direction(record),
        "speed": _speed(record),
        "comfort": Masked(
            value=np.asarray(1.0 - uncomfortable.any(axis=1)), valid=share_of_bound.valid
        ),
        "feasible": _feasible(record),
    }
    metrics |= _continuous(record, uncomfortable, share_of_bound)
    if rules.weights:
        metrics = {"score": _score(metrics, rules, has_ticks), **metrics}
    return metrics


def at_fault(record: EpisodeRecord, rules: Rules) -> Bool[np.ndarray, "b t"]:
    """Ticks at which a contact begins that is the ego's fault (nuPlan).

    These are contacts with a standing agent, at the ego's front, and at its side; the latter,
    unless the rules count any side, only while the ego is in several lanes or off the road.

    Args:
        record: the driven episodes.
        rules: thresholds and definitions.
    """
    contacts = record.contacts
    begins = (contacts > 0) & (np.diff(contacts, axis=1, prepend=0) != 0)
    always = np.isin(contacts, [int(Contact.OTHER_STANDS), int(Contact.FRONT)])
    off_lane = record.map_context.several_lanes | (record.off_road_m > rules.off_road_m)
    side = (contacts == Contact.SIDE) & (off_lane[..., None] | rules.any_side_is_fault)
    return (begins & (always | side)).any(axis=2) & record.active


def against_traffic_in_window_m(record: EpisodeRecord) -> Float[np.ndarray, "b t"]:
    """Distance that the ego drove against the traffic within the last second, metres."""
    against = record.map_context.against_traffic_m
    driven = np.cumsum(np.where(record.active, against.value, 0.0), axis=1)
    window = max(int(DIRECTION_WINDOW_S / record.dt_s + 1e-6), 1)
    before = np.pad(driven, ((0, 0), (window, 0)))[:, : driven.shape[1]]
    return driven - before


def overspeed_mps(record: EpisodeRecord) -> Masked:
    """(b, t) speed of the ego above the limit, at least 0; missing without a limit."""
    limits = record.map_context.speed_limits_mps
    over = np.maximum(np.abs(record.states[..., 3]) - limits.value, 0.0)
    return Masked(value=over, valid=limits.valid & record.active)


def _score(
    metrics: Mapping[str, Masked], rules: Rules, has_ticks: Bool[np.ndarray, " b"]
) -> Masked:
    count = len(has_ticks)
    product, total, weights = np.ones(count), np.zeros(count), np.zeros(count)
    for name in rules.multipliers:
        product = product * np.where(metrics[name].valid, metrics[name].value, 1.0)
    for name, weight in rules.weights.items():
        total += np.where(metrics[name].valid, weight * metrics[name].value, 0.0)
        weights += np.where(metrics[name].valid, weight, 0.0)
    return Masked(value=product * total / np.maximum(weights, 1.0), valid=has_ticks)


def _continuous(
    record: EpisodeRecord, uncomfortable: Bool[np.ndarray, "b t"], share_of_bound: Masked
) -> dict[str, Masked]:
    """The continuous measures, which do not depend on the rules.

    Args:
        record: the driven episodes.
        uncomfortable: see `_comfort_over_ticks`.
        share_of_bound: see `_comfort_over_ticks`.
    """
    active = record.active
    count = active.sum(axis=1)
    lost_s = time_lost_s(
        record.route_m, count, record.log_route_m, record.scenario_ticks, record.dt_s
    )
    off_road = (record.off_road_m > NUPLAN.off_road_m) & active
    cost_s = driving_cost_s(
        time_lost_s=lost_s,
        ttc_s=record.bounded_ttc_s,
        uncomfortable=uncomfortable,
        fault=np.asarray((at_fault(record, NUPLAN) | off_road).any(axis=1)),
        active=active,
        dt_s=record.dt_s,
        weights=DrivingCostWeights(),
    )
    near = record.near_miss & active
    min_ttc_s = np.where(active, record.bounded_ttc_s, BOUNDED_TTC.horizon_s).min(axis=1)
    braking = np.where(active, record.required_mps2, 0.0).max(axis=1)
    values = {
        "no near miss": 1.0 - near.any(axis=1),
        "near misses": _mean_over_ticks(near, active),
        "min TTC": min_ttc_s,
        "required deceleration": braking,
        "safety margin": np.minimum(0.5 * min_ttc_s / BOUNDED_TTC.min_ttc_s, 1.0),
        "time lost": lost_s,
        "driving cost": cost_s,
    }
    by_comfort = {
        "uncomfortable ticks": _mean_over_ticks(uncomfortable, active),
        "smoothness": np.asarray(np.clip(1.5 - share_of_bound.value, 0.0, 1.0)),
    }
    has_ticks = np.asarray(count > 0)
    return {name: Masked(value=value, valid=has_ticks) for name, value in values.items()} | {
        name: Masked(value=value, valid=share_of_bound.valid) for name, value in by_comfort.items()
    }


def _mean_over_ticks(
    values: Bool[np.ndarray, "b t"] | Float[np.ndarray, "b t"], active: Bool[np.ndarray, "b t"]
) -> Float[np.ndarray, " b"]:
    return np.where(active, values, 0).sum(axis=1) / np.maximum(active.sum(axis=1), 1)


def _progress(record: EpisodeRecord, rules: Rules) -> Float[np.ndarray, " b"]:
    last = np.maximum(record.active.sum(axis=1) - 1, 0)
    reached = record.route_m[np.arange(len(last)), last]
    driven = np.maximum(reached, rules.min_progress_m) if rules.lifts_ego else reached
    share = np.clip(driven / np.maximum(record.goal_m, rules.min_progress_m), 0, 1)
    return np.where(reached < 0, 0.0, share)


def _direction(record: EpisodeRecord) -> Masked:
    worst = against_traffic_in_window_m(record).max(axis=1)
    known = record.map_context.against_traffic_m.valid & record.active
    return Masked(
        value=np.select([worst <= COMPLIANT_M, worst <= VIOLATION_M], [1.0, 0.5], 0.0),
        valid=np.asarray(known.any(axis=1)),
    )


def _speed(record: EpisodeRecord) -> Masked:
    over = overspeed_mps(record)
    count = over.valid.sum(axis=1)
    mean = np.where(over.valid, over.value, 0.0).sum(axis=1) / np.maximum(count, 1)
    value = np.asarray(np.maximum(0.0, 1.0 - mean / OVERSPEED_MPS))
    return Masked(value=value, valid=np.asarray(count > 0))


def _comfort_over_ticks(record: EpisodeRecord) -> tuple[Bool[np.ndarray, "b t"], Masked]:
    """Ticks (b, t) beyond a comfort bound, and the largest share (b,) of any bound.

    For short episodes the ticks are false and the share is missing; ticks after the end are false.
    """
    ticks, needed = record.active.sum(axis=1), window_ticks(record.dt_s)
    beyond, share = np.zeros(record.active.shape, dtype=bool), np.zeros(len(ticks))
    for b in np.flatnonzero(ticks >= needed).tolist():
        signals = comfort_signals(record.states[b, : ticks[b]], record.dt_s)
        beyond[b, : ticks[b]] = ~within_bounds(signals)
        share[b] = share_of_bounds(signals).max()
    return beyond, Masked(value=share, valid=np.asarray(ticks >= needed))


def _feasible(record: EpisodeRecord) -> Masked:
    both = record.active[:, 1:] & record.active[:, :-1]
    beyond = infeasible_ticks(record.states, dt_s=record.dt_s) & both
    return Masked(value=np.asarray(1.0 - beyond.any(axis=1)), valid=np.asarray(both.any(axis=1)))
