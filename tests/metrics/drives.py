"""Drives composed by hand, a tick at a time."""

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


def drive(*, active: int = TICKS, dt_s: float = DT_S, **changes: object) -> EpisodeRecord:
    """One episode at 5 m/s that is perfect but for its progress of 40 m out of 50 m.

    Fields of `EpisodeRecord` and `MapContext` are given as values for all ticks, or as arrays; `limit_mps` is
    `None` where none is known, and `against_m` where the map has no lanes.
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
    on_map = MapContext(
        outside_m=fields.pop("outside_m"),
        several_lanes=fields.pop("several_lanes"),
        at_crossing=fields.pop("at_crossing"),
        against_traffic=Masked(value=fields.pop("against_m"), valid=no | known["against_m"]),
        limits=Masked(value=np.where(limited, fields.pop("limit_mps"), 0), valid=limited),
        distance_to_route_lanes_m=fields.pop("distance_to_route_lanes_m"),
    )
    lasts = np.arange(TICKS)[None] < active
    return EpisodeRecord(**fields, on_map=on_map, active=lasts, dt_s=dt_s)


def at_tick(tick: int, value: float, otherwise: float = 0.0) -> np.ndarray:
    """(1, ticks) with one value at one tick."""
    return np.where(np.arange(TICKS) == tick, value, otherwise)[None]


def contact(tick: int, kind: Contact) -> np.ndarray:
    """(1, ticks, 3) with one contact at one tick, with the third agent."""
    found = np.zeros((1, TICKS, 3), dtype=np.int8)
    found[0, tick, 2] = kind
    return found


def values(drives: EpisodeRecord, preset: Rules = STRICT) -> dict[str, float]:
    """The metrics of one episode; NaN where missing."""
    return {
        name: float(metric.value[0]) if metric.valid[0] else math.nan
        for name, metric in driving_metrics(drives, preset).items()
    }


def joined(episodes: list[EpisodeRecord]) -> EpisodeRecord:
    """Several drives side by side."""

    def side_by_side(kind: type, parts: list) -> dict:
        found = {}
        for field in dataclasses.fields(kind):
            values = [getattr(part, field.name) for part in parts]
            if isinstance(values[0], MapContext | Masked):
                found[field.name] = type(values[0])(**side_by_side(type(values[0]), values))
            else:
                whole = isinstance(values[0], float)
                found[field.name] = values[0] if whole else np.concatenate(values)
        return found

    return EpisodeRecord(**side_by_side(EpisodeRecord, episodes))
