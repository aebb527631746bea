"""Metrics of forecasts: errors, calibration and feasibility."""

from asp_env.metrics.forecast.calibration import (
    brier,
    calibration_error,
    calibration_sums,
    mixture_nll,
    nearest_modes,
)
from asp_env.metrics.forecast.errors import (
    MODE_RULES,
    SELECTIONS,
    Manoeuvre,
    ModeRule,
    Selection,
    best_mode,
    ends_in_true_direction,
    errors_over_time,
    inconsistency,
    manoeuvres,
    moving,
    open_loop_errors,
    select_mode,
)
from asp_env.metrics.forecast.feasibility import (
    infeasible_modes,
    infeasible_ticks,
    off_road_modes,
    overlapping_modes,
)

__all__ = [
    "MODE_RULES",
    "SELECTIONS",
    "Manoeuvre",
    "ModeRule",
    "Selection",
    "best_mode",
    "brier",
    "calibration_error",
    "calibration_sums",
    "ends_in_true_direction",
    "errors_over_time",
    "inconsistency",
    "infeasible_modes",
    "infeasible_ticks",
    "manoeuvres",
    "mixture_nll",
    "moving",
    "nearest_modes",
    "off_road_modes",
    "open_loop_errors",
    "overlapping_modes",
    "select_mode",
]
