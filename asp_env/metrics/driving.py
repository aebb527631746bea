"""Scores of a drive: one number per episode and metric, with a mask.

The composite is PDMS of NAVSIM over a whole closed-loop episode, with nuPlan's tests inside.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.metrics.boxes import AT_FAULT
from asp_env.metrics.comfort import comfortable, window_ticks
from asp_env.metrics.drivable import OFF_ROAD_M
from asp_env.metrics.masked import Masked

MIN_TTC_S = 0.95
MIN_GOAL_M = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Drives:
    """What B episodes of up to T ticks looked like from the ego; `lasted` marks the first few."""

    states: Float[np.ndarray, "b t 4"]
    """The ego's."""
    log_states: Float[np.ndarray, "b t 4"]
    """The logged ego's at the same ticks."""
    contacts: Int[np.ndarray, "b t a"]
    off_road_m: Float[np.ndarray, "b t"]
    ttc_s: Float[np.ndarray, "b t"]
    route_m: Float[np.ndarray, "b t"]
    goal_m: Float[np.ndarray, " b"]
    lasted: Bool[np.ndarray, "b t"]
    dt_s: float


def driving_metrics(drives: Drives) -> dict[str, Masked]:
    """Per episode; missing where it has no tick.

    - `no collision`, `no at-fault collision`: 1 or 0 (nuPlan's classes of contact; hits from
      behind by replayed traffic are contacts but nobody's fault here).
    - `on road`: 0 when a corner is ever over 0.3 m outside the drivable area (nuPlan).
    - `progress`: the share of the logged ego's way, 0 to 1.
    - `TTC`: 1 when the time to collision never falls below 0.95 s (nuPlan).
    - `comfort`: 1 when all of nuPlan's bounds hold; missing for episodes shorter than its window of
      about 1 s (`window_ticks`; 5 ticks of 0.2 s).
    - `log divergence`: mean distance to the logged ego at the same ticks, m.
    - `score`: NC·DAC·(5·EP + 5·TTC + 2·C)/12 (PDMS); where comfort is missing, without it over 10.
    """
    lasted = drives.lasted
    count = lasted.sum(axis=1)
    touches = (drives.contacts > 0) & lasted[..., None]
    guilty = np.isin(drives.contacts, [int(kind) for kind in AT_FAULT]) & lasted[..., None]
    off_road = (drives.off_road_m > OFF_ROAD_M) & lasted
    short = (drives.ttc_s < MIN_TTC_S) & lasted
    reached = drives.route_m[np.arange(len(count)), count - 1]
    progress = np.clip(reached / np.maximum(drives.goal_m, MIN_GOAL_M), 0, 1)
    away = np.linalg.norm(drives.states[..., :2] - drives.log_states[..., :2], axis=-1)
    comfort = _comfort(drives)
    no_fault = 1.0 - guilty.any(axis=(1, 2))
    on_road = 1.0 - off_road.any(axis=1)
    ttc = 1.0 - short.any(axis=1)
    soft = 5 * progress + 5 * ttc + 2 * np.where(comfort.valid, comfort.value, 0)
    score = no_fault * on_road * soft / np.where(comfort.valid, 12, 10)
    values = {
        "score": score,
        "no collision": 1.0 - touches.any(axis=(1, 2)),
        "no at-fault collision": no_fault,
        "on road": on_road,
        "progress": progress,
        "TTC": ttc,
        "log divergence": np.where(lasted, away, 0).sum(axis=1) / np.maximum(count, 1),
    }
    metrics = {
        name: Masked(value=value, valid=np.asarray(count > 0)) for name, value in values.items()
    }
    return {**metrics, "comfort": comfort}


def _comfort(drives: Drives) -> Masked:
    ticks, needed = drives.lasted.sum(axis=1), window_ticks(drives.dt_s)
    value = np.zeros(len(ticks))
    for b, count in enumerate(ticks):
        if count >= needed:
            enough = np.ones((), dtype=bool)
            value[b] = comfortable(drives.states[b, :count], drives.dt_s, enough).value
    return Masked(value=value, valid=np.asarray(ticks >= needed))
