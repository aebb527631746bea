"""Scores of drives: one number per episode and metric, with a mask, by the rules of a preset."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.metrics.boxes import Contact
from asp_env.metrics.driving.comfort import comfortable, window_ticks
from asp_env.metrics.driving.map_context import WRONG_WAY_M, MapContext
from asp_env.metrics.driving.rules import Rules
from asp_env.metrics.forecast.feasibility import infeasible_ticks
from asp_env.metrics.masked import Masked

DIRECTION_WINDOW_S = 1.0
COMPLIANT_M = 2.0
VIOLATION_M = 6.0
"""nuPlan: as much against the traffic within 1 s is no fault, and more than this the whole one."""

OVERSPEED_MPS = 2.23
"""nuPlan: a mean overspeed of this much is no compliance at all."""

LEAST_PROGRESS = 0.2
"""nuPlan: with a smaller share of the logged way the ego makes no progress."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRecord:
    """What B episodes of up to T ticks looked like from the ego; `active` marks the first few."""

    states: Float[np.ndarray, "b t 4"]
    """The ego's."""
    log_states: Float[np.ndarray, "b t 4"]
    """The logged ego's at the same ticks."""
    contacts: Int[np.ndarray, "b t a"]
    off_road_m: Float[np.ndarray, "b t"]
    """Beyond what the logged ego is off the road there."""
    ttc_s: Float[np.ndarray, "b t"]
    """By the rule of the preset that judges."""
    route_m: Float[np.ndarray, "b t"]
    route_offset_m: Float[np.ndarray, "b t"]
    goal_m: Float[np.ndarray, " b"]
    on_map: MapContext
    active: Bool[np.ndarray, "b t"]
    dt_s: float


def at_fault(drives: EpisodeRecord, preset: Rules) -> Bool[np.ndarray, "b t"]:
    """Ticks at which a contact begins that is the ego's fault by the preset's rule (nuPlan).

    With somebody who stands, at the ego's front, or at its side; the latter, unless any side is,
    only while the ego is in several lanes or off the road.
    """
    kinds = drives.contacts
    begins = (kinds > 0) & (np.diff(kinds, axis=1, prepend=0) != 0)
    sure = np.isin(kinds, [int(Contact.OTHER_STANDS), int(Contact.FRONT)])
    astray = drives.on_map.several_lanes | (drives.off_road_m > preset.off_road_m)
    side = (kinds == Contact.SIDE) & (astray[..., None] | preset.any_side_is_fault)
    return (begins & (sure | side)).any(axis=2) & drives.active


def driving_metrics(drives: EpisodeRecord, preset: Rules) -> dict[str, Masked]:
    """Per episode; missing where it has no tick.

    - `no collision`, `no at-fault collision`, `no hit from behind`: 1 or 0. Who comes from behind
      may be a replayed agent that knows of no ego; such hits are counted apart.
    - `on road`: 0 when a corner is ever further outside the drivable area than the preset allows.
      Where the logged ego is itself off the road, within 5 m along its way and 2 m beside it, what
      it is outside is allowed too: maps have gaps. `on mapped road` allows none of that.
    - `direction`: 1, 0.5 or 0 by the way against the traffic within 1 s; missing without areas of
      lanes.
    - `right way`: 0 when the ego is ever over 3.5 m from every way that led on from its start.
    - `progress`: the share of the logged ego's way, 0 to 1; `making progress`: 1 from 0.2 on.
    - `TTC`: 1 when the time to collision is always above the preset's bound.
    - `speed`: max(0, 1 - mean overspeed / 2.23 m/s) over ticks with a known limit; missing without.
    - `comfort`: 1 when all of nuPlan's bounds hold; missing for episodes shorter than its window of
      about 1 s (`window_ticks`; 5 ticks of 0.2 s).
    - `feasible`: 0 when acceleration or curvature is ever beyond Waymax's bounds; missing for a
      single tick.
    - `log divergence`, `route deviation`: mean distance to the logged ego at the same ticks, and to
      its route, m.
    - `score`: the product of the preset's multipliers times the weighted mean; what is missing is
      left out of either.
    """
    active = drives.active
    count = active.sum(axis=1)
    some = np.asarray(count > 0)
    kinds = np.where(active[..., None], drives.contacts, Contact.NONE)
    off_road = (drives.off_road_m > preset.off_road_m) & active
    off_map = (drives.on_map.outside_m > preset.off_road_m) & active
    short = (drives.ttc_s <= preset.ttc.min_ttc_s) & active
    away = np.linalg.norm(drives.states[..., :2] - drives.log_states[..., :2], axis=-1)
    progress = _progress(drives, preset)
    astray = (drives.on_map.distance_to_route_lanes_m > WRONG_WAY_M) & active
    values = {
        "no collision": 1.0 - (kinds > 0).any(axis=(1, 2)),
        "no at-fault collision": 1.0 - at_fault(drives, preset).any(axis=1),
        "no hit from behind": 1.0 - (kinds == Contact.REAR).any(axis=(1, 2)),
        "on road": 1.0 - off_road.any(axis=1),
        "on mapped road": 1.0 - off_map.any(axis=1),
        "right way": 1.0 - astray.any(axis=1),
        "progress": progress,
        "making progress": (progress >= LEAST_PROGRESS).astype(np.float64),
        "TTC": 1.0 - short.any(axis=1),
        "log divergence": np.where(active, away, 0).sum(axis=1) / np.maximum(count, 1),
        "route deviation": np.where(active, np.abs(drives.route_offset_m), 0).sum(axis=1)
        / np.maximum(count, 1),
    }
    metrics = {name: Masked(value=value, valid=some) for name, value in values.items()}
    metrics |= {
        "direction": _direction(drives),
        "speed": _speed(drives),
        "comfort": _comfort(drives),
        "feasible": _feasible(drives),
    }
    if preset.weights:
        metrics = {"score": _score(metrics, preset, some), **metrics}
    return metrics


def _score(metrics: Mapping[str, Masked], preset: Rules, some: Bool[np.ndarray, " b"]) -> Masked:
    product, total, weights = np.ones(len(some)), np.zeros(len(some)), np.zeros(len(some))
    for name in preset.multipliers:
        product = product * np.where(metrics[name].valid, metrics[name].value, 1.0)
    for name, weight in preset.weights.items():
        total += np.where(metrics[name].valid, weight * metrics[name].value, 0.0)
        weights += np.where(metrics[name].valid, weight, 0.0)
    return Masked(value=product * total / np.maximum(weights, 1.0), valid=some)


def _progress(drives: EpisodeRecord, preset: Rules) -> Float[np.ndarray, " b"]:
    last = np.maximum(drives.active.sum(axis=1) - 1, 0)
    reached = drives.route_m[np.arange(len(last)), last]
    lifted = np.maximum(reached, preset.min_progress_m) if preset.lifts else reached
    share = np.clip(lifted / np.maximum(drives.goal_m, preset.min_progress_m), 0, 1)
    return np.where(reached < 0, 0.0, share)


def against_traffic_in_window_m(drives: EpisodeRecord) -> Float[np.ndarray, "b t"]:
    """How far against the traffic the ego drove within the last second."""
    against = drives.on_map.against_traffic
    driven = np.cumsum(np.where(drives.active, against.value, 0.0), axis=1)
    window = max(int(DIRECTION_WINDOW_S / drives.dt_s + 1e-6), 1)
    before = np.pad(driven, ((0, 0), (window, 0)))[:, : driven.shape[1]]
    return driven - before


def overspeed_mps(drives: EpisodeRecord) -> Masked:
    """How much the ego is over the limit at each tick; missing without one."""
    limits = drives.on_map.limits
    over = np.maximum(np.abs(drives.states[..., 3]) - limits.value, 0.0)
    return Masked(value=over, valid=limits.valid & drives.active)


def _direction(drives: EpisodeRecord) -> Masked:
    most = against_traffic_in_window_m(drives).max(axis=1, initial=0.0)
    known = drives.on_map.against_traffic.valid & drives.active
    return Masked(
        value=np.select([most <= COMPLIANT_M, most <= VIOLATION_M], [1.0, 0.5], 0.0),
        valid=np.asarray(known.any(axis=1)),
    )


def _speed(drives: EpisodeRecord) -> Masked:
    over = overspeed_mps(drives)
    count = over.valid.sum(axis=1)
    mean = np.where(over.valid, over.value, 0.0).sum(axis=1) / np.maximum(count, 1)
    value = np.asarray(np.maximum(0.0, 1.0 - mean / OVERSPEED_MPS))
    return Masked(value=value, valid=np.asarray(count > 0))


def _comfort(drives: EpisodeRecord) -> Masked:
    ticks, needed = drives.active.sum(axis=1), window_ticks(drives.dt_s)
    value = np.zeros(len(ticks))
    for b, count in enumerate(ticks):
        if count >= needed:
            enough = np.ones((), dtype=bool)
            value[b] = comfortable(drives.states[b, :count], drives.dt_s, enough).value
    return Masked(value=value, valid=np.asarray(ticks >= needed))


def _feasible(drives: EpisodeRecord) -> Masked:
    both = drives.active[:, 1:] & drives.active[:, :-1]
    beyond = infeasible_ticks(drives.states, dt_s=drives.dt_s) & both
    return Masked(value=np.asarray(1.0 - beyond.any(axis=1)), valid=np.asarray(both.any(axis=1)))
