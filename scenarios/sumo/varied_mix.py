"""Demand and drivers of varied traffic, drawn from the ranges in `ranges`."""

from functools import partial

import numpy as np

from scenarios.sumo.demand import DENSE_FAR_ROUND_LEFT, SHARES, Mix
from scenarios.sumo.drivers import dense_driver
from scenarios.sumo.motion import PathStyle
from scenarios.sumo.ranges import RANGES

_TRAFFIC = RANGES.traffic

LONG_VEHICLES = ("truck", "bus")

_SIDEWALK_OFFSET_M = 0.5
"""Largest distance of pedestrians from the middle of the sidewalk."""


def varied_mix(rng: np.random.Generator, *, narrowest_m: float, tight: bool) -> Mix:
    """Draws the mix of a location.

    Args:
        rng: draws the mix.
        narrowest_m: width of the location's narrowest lane, m.
        tight: whether there is no room for long vehicles.
    """
    low, high = np.log(_TRAFFIC.vehicles_per_hour)
    rate = float(np.exp(rng.uniform(low, high)))
    walking = 0.0
    if rng.random() >= _TRAFFIC.no_pedestrians:
        walking = float(rng.uniform(*_TRAFFIC.pedestrians_per_hour))
    factors = np.exp(rng.normal(0.0, _TRAFFIC.share_spread, len(SHARES)))
    shares = {
        kind: 0.0 if tight and kind in LONG_VEHICLES else share * float(factor)
        for (kind, share), factor in zip(SHARES.items(), factors, strict=True)
    }
    dense = bool(rng.random() < _TRAFFIC.dense_drivers)
    return Mix(
        vehicles_per_hour=(rate, rate),
        pedestrians_per_hour=(walking, walking),
        shares=shares,
        left_odds=float(rng.uniform(*_TRAFFIC.left_odds)),
        far_round_left=DENSE_FAR_ROUND_LEFT if dense else 0.9,
        impatient=dense,
        lenient=True,
        driver=partial(
            _driver,
            dense=dense,
            mean=float(rng.uniform(*_TRAFFIC.speed_mean)),
            spread=float(rng.uniform(*_TRAFFIC.speed_spread)),
            slow=float(rng.uniform(*_TRAFFIC.slow)),
            accel=float(rng.uniform(*_TRAFFIC.accel_factor)),
        ),
        stops=float(rng.uniform(*_TRAFFIC.stops)),
        stop_s=_TRAFFIC.stop_s,
        path_style=partial(_path_style, narrowest_m=narrowest_m),
    )


def _driver(
    rng: np.random.Generator,
    kind: str,
    *,
    dense: bool,
    mean: float,
    spread: float,
    slow: float,
    accel: float,
) -> dict[str, float]:
    """Attributes of SUMO's vehicle type that differ from those of normal traffic.

    Args:
        rng: draws the attributes.
        kind: class of the vehicle.
        dense: whether the driver has one of the temperaments of dense traffic.
        mean: mean desired speed, relative to the limit.
        spread: its standard deviation.
        slow: share of vehicles that are slow everywhere.
        accel: factor on the acceleration.
    """
    heavy = kind in (*LONG_VEHICLES, "bicycle")
    found = {"accel": float(rng.uniform(1.0, 1.5) if heavy else rng.uniform(1.5, 2.8))}
    if dense:
        found |= dense_driver(rng)
    found["accel"] *= accel
    found["speedFactor"] = float(np.clip(rng.normal(mean, spread), *_TRAFFIC.speed_factor))
    if kind == "bicycle":
        found["maxSpeed"] = float(rng.uniform(*_TRAFFIC.bicycle_mps))
    elif rng.random() < slow:
        found["maxSpeed"] = float(rng.uniform(*_TRAFFIC.slow_mps))
    return found


def _path_style(
    rng: np.random.Generator, kind: str, width_m: float, *, narrowest_m: float
) -> PathStyle:
    """How an agent deviates from the middle; bicycles ride on the right."""
    room = max(0.5 * (narrowest_m - width_m) - _TRAFFIC.beside_m, 0.0)
    if kind == "pedestrian":
        offset = rng.uniform(-_SIDEWALK_OFFSET_M, _SIDEWALK_OFFSET_M)
    elif kind == "bicycle":
        offset = -room * rng.uniform(0.0, 1.0)
    else:
        offset = min(room, _TRAFFIC.offset_m) * float(np.clip(rng.normal(0.0, 0.5), -1.0, 1.0))
    return PathStyle(
        offset_m=float(offset),
        wander_m=float(rng.uniform(*_TRAFFIC.wander_m)),
        wander_length_m=float(rng.uniform(*_TRAFFIC.wander_length_m)),
        phase_rad=float(rng.uniform(0.0, 2.0 * np.pi)),
        rounding=float(rng.uniform(*_TRAFFIC.rounding)),
    )
