"""All open-loop metrics of one batch of forecasts."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from asp_env.evaluation.recorded import Recorded
from asp_env.metrics.calibration import brier, mixture_nll, nearest_modes
from asp_env.metrics.feasibility import infeasible_modes, off_road_points, overlapping_modes
from asp_env.metrics.masked import Masked
from asp_env.metrics.mode_choice import ModeRule
from asp_env.metrics.open_loop import (
    SELECTIONS,
    errors_over_time,
    open_loop_errors,
    select_mode,
)

ALL_MODES = ""
"""The selection of metrics that speak of all modes together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Said:
    """A forecast as it is judged: states cut to the horizon, and the state that it starts from."""

    states: Float[np.ndarray, "n m t 4"]
    log_probs: Float[np.ndarray, "n m"]
    now: Float[np.ndarray, "n 4"]


def forecast_errors(
    said: Said,
    truth: Recorded,
    best_by: ModeRule,
    on_road: Bool[np.ndarray, " n"],
    *,
    dt_s: float,
) -> dict[tuple[str, str], Masked]:
    """All metrics of a batch of forecasts, by (selection, metric).

    Args:
        said: the forecasts.
        truth: what was recorded.
        best_by: how the best mode is chosen.
        on_road: whom leaving the drivable area counts for: `keeps_to_road`.
        dt_s: the time step.
    """
    future, origin = truth.future, truth.present[:, None, :2]
    known = future.valid[:, -1]
    local = said.states[..., :2] - origin[:, None]
    true = future.states[..., :2] - origin
    nearest = nearest_modes(local[:, :, -1], true[:, -1])
    found = {
        (ALL_MODES, "NLL"): mixture_nll(local[:, :, -1], said.log_probs, true[:, -1], known),
        (ALL_MODES, "Brier"): brier(said.log_probs, nearest, known),
    }
    broken = _broken_rules(said, truth, on_road, dt_s=dt_s)
    for metric, (breaks, applies) in broken.items():
        found[ALL_MODES, metric] = Masked(value=breaks.mean(axis=1), valid=applies)
    for selection in SELECTIONS:
        shown = (local, said.log_probs, true, future.valid, selection, best_by)
        errors = open_loop_errors(*shown) | errors_over_time(*shown, dt_s=dt_s)
        found |= {(selection, metric): error for metric, error in errors.items()}
        chosen = select_mode(local, said.log_probs, true, selection, best_by)
        for metric, (breaks, applies) in broken.items():
            value = breaks[np.arange(len(breaks)), chosen].astype(np.float32)
            found[selection, metric] = Masked(value=value, valid=applies)
    return found


def _broken_rules(
    said: Said, truth: Recorded, on_road: Bool[np.ndarray, " n"], *, dt_s: float
) -> dict[str, tuple[Bool[np.ndarray, "n m"], Bool[np.ndarray, " n"]]]:
    """(which modes break it, which targets it applies to), by metric."""
    future = truth.future
    known = np.asarray(future.valid.all(axis=1))
    off_road, _ = off_road_points(truth.maps, truth.map_index, said.states[..., :2])
    overlap = overlapping_modes(
        said.states,
        future.states,
        truth.sizes,
        situation=truth.situation,
        slot=truth.slot,
        others=truth.others,
        others_valid=truth.others_valid,
        others_sizes=truth.others_sizes,
    )
    infeasible = infeasible_modes(said.now, said.states, dt_s=dt_s)
    return {
        "off-road": (off_road, on_road),
        "overlap": (overlap, known),
        "infeasible": (infeasible, np.ones(len(known), dtype=bool)),
    }


def keeps_to_road(truth: Recorded) -> Bool[np.ndarray, " n"]:
    """Whether there is a drivable area, and the target keeps to it from now to the horizon's end.

    Who leaves it, as on the way to a parking place, cannot be forecast well and stay on it.
    """
    way = truth.states[:, None, truth.now :, :2]
    off, known = off_road_points(truth.maps, truth.map_index, way)
    return known & ~off[:, 0] & truth.valid[:, truth.now :].all(axis=1)
