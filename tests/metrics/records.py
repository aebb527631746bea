"""Records of episodes composed by hand, tick by tick."""

import dataclasses
import math

import numpy as np

from asp_env.metrics.boxes import Contact
from asp_env.metrics.driving.map_context import MapContext
from asp_env.metrics.driving.rules import STRICT, Rules
from asp_env.metrics.driving.scores import EpisodeRecord, driving_metrics
from asp_env.metrics.masked import Masked

TICKS = 8
DT_S = 0.2


def record(*, active: int = TICKS, dt_s: float = DT_S, **changes: object) -> EpisodeRecord:
    """One episode at 5 m/s that is perfect except for its progress of 40 m out of 50 m.

    The logged ego is 10 m ahead at every tick, from 43 to 50 m.

    Fields of `EpisodeRecord` and `MapContext` are given as one value for all ticks or as arrays.
    `limit_mps` is `None` without a speed limit, `against_m` on maps without lanes.
    """
    states = np.zeros((1, TICKS, 4))
    states[0, :, 0] = np.arange(TICKS)
    states[0, :, 3] = 5.0
    no, zeros = np.zeros((1, TICKS), dtype=bool), np.zeros((1, TICKS))
    fields = {
        "states": states,
        "log_states": states,
        "contacts": np.zeros((1, TICKS, 3), dtype=np.int8),
        "off_road_m": zeros,
        "ttc_s": np.full((1, TICKS), math.inf),
        "route_m": np.linspace(33, 40, TICKS)[None],
        "route_offset_m": zeros,
        "goal_m": np.array([50.0]),
        "log_route_m": np.linspace(43, 50, TICKS)[None],
        "scenario_ticks": np.array([TICKS - 1]),
        "near_miss": no,
        "bounded_ttc_s": np.full((1, TICKS), 3.0),
        "required_mps2": zeros,
        "outside_m": zeros,
        "several_lanes": no,
        "at_crossing": no,
        "against_m": zeros,
        "limit_mps": np.full((1, TICKS), 10.0),
        "distance_to_route_lanes_m": zeros,
    }
    known = {name: changes.get(name, 0) is not None for name in ("against_m", "limit_mps")}
    for name, change in changes.items():
        if change is not None:
            fields[name] = np.broadcast_to(np.asarray(change), fields[name].shape)
    limited = np.isfinite(fields["limit_mps"]) & known["limit_mps"]
    context = MapContext(
        outside_m=fields.pop("outside_m"),
        several_lanes=fields.pop("several_lanes"),
        at_crossing=fields.pop("at_crossing"),
        against_traffic_m=Masked(value=fields.pop("against_m"), valid=no | known["against_m"]),
        speed_limits_mps=Masked(value=np.where(limited, fields.pop("limit_mps"), 0), valid=limited),
        distance_to_route_lanes_m=fields.pop("distance_to_route_lanes_m"),
    )
    is_active = np.arange(TICKS)[None] < active
    return EpisodeRecord(**fields, map_context=context, active=is_active, dt_s=dt_s)


def at_tick(tick: int, value: float, otherwise: float = 0.0) -> np.ndarray:
    """(1, ticks) with one value at one tick and another elsewhere."""
    return np.where(np.arange(TICKS) == tick, value, otherwise)[None]


def contact(tick: int, kind: Contact) -> np.ndarray:
    """(1, ticks, 3) with one contact at one tick, with the third agent."""
    contacts = np.zeros((1, TICKS, 3), dtype=np.int8)
    contacts[0, tick, 2] = kind
    return contacts


def values(episodes: EpisodeRecord, rules: Rules = STRICT) -> dict[str, float]:
    """The metrics of one episode; NaN where missing."""
    return {
        name: float(metric.value[0]) if metric.valid[0] else math.nan
        for name, metric in driving_metrics(episodes, rules).items()
    }


def joined(episodes: list[EpisodeRecord]) -> EpisodeRecord:
    """Several episodes as one batch."""

    def batched(kind: type, parts: list) -> dict:
        fields = {}
        for field in dataclasses.fields(kind):
            values = [getattr(part, field.name) for part in parts]
            if isinstance(values[0], MapContext | Masked):
                fields[field.name] = type(values[0])(**batched(type(values[0]), values))
            else:
                is_scalar = isinstance(values[0], float)
                fields[field.name] = values[0] if is_scalar else np.concatenate(values)
        return fields

    return EpisodeRecord(**batched(EpisodeRecord, episodes))
