"""Errors, calibration and consistency of the forecasts that are made while episodes are driven.

They are those of the states that a planner visits (dynamic errors); the forecasts of an expert's
drive are those of logged states (static errors). The ground truth is what happens in the episode
itself, so that it is simulated where traffic reacts. Measures are means over all ticks and moving
targets near the ego, and each is defined where the whole horizon lies within the episode.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.predictor import Forecast
from asp_env.evaluation.results import Row
from asp_env.metrics.forecast import (
    brier,
    inconsistency,
    moving,
    nearest_modes,
    open_loop_errors,
)
from asp_env.metrics.masked import Masked

FORECAST_METRICS = (
    *("forecast ADE", "forecast FDE", "forecast minADE", "forecast minFDE"),
    *("forecast Brier", "overconfidence", "forecast change"),
)
"""Names of the measures: errors of the most probable mode and of the best of 3, m; Brier score; the
probability of the most probable mode less the share in which it ends nearest to the truth; and the
mean distance of the most probable mode to that of the tick before, at the ticks that both share,
m."""


def forecast_quality(
    forecasts: Sequence[Forecast],
    states: Float[np.ndarray, "b ticks a 4"],
    valid: Bool[np.ndarray, "b ticks a"],
) -> dict[str, Masked]:
    """The measures of `FORECAST_METRICS` of B episodes.

    Args:
        forecasts: the forecast of each tick, from tick 0 on.
        states: [x m, y m, heading rad, speed m/s] of all agents at all ticks, from tick 0 on.
        valid: whether an agent is present; false after the end of an episode.

    Returns:
        Values (b,) by name; missing for episodes without a target whose whole horizon is known.
    """
    count, ticks, agents = valid.shape
    sums = {name: np.zeros(count) for name in FORECAST_METRICS}
    numbers = {name: np.zeros(count) for name in FORECAST_METRICS}
    before: tuple[np.ndarray, np.ndarray] | None = None
    for tick, forecast in enumerate(forecasts):
        steps = forecast.states.shape[2]
        episode, slot = forecast.targets.T
        positions = forecast.states[..., :2]
        probable = positions[np.arange(len(episode)), forecast.most_probable]
        names = episode * agents + slot
        if before is not None:
            change = _change(before, (names, probable))
            _add(sums, numbers, {"forecast change": change}, episode)
        before = (names, probable)
        if tick + steps >= ticks or not len(episode):
            continue
        window = slice(tick + 1, tick + 1 + steps)
        truth = states[episode, window, slot, :2]
        known = valid[episode, window, slot].all(axis=1)
        now = states[episode, tick, slot]
        rows = known & moving(now, truth, valid[episode, window, slot])
        if rows.any():
            found = _measures(positions[rows], forecast.log_probs[rows], truth[rows])
            _add(sums, numbers, found, episode[rows])
    return {
        name: Masked(value=sums[name] / np.maximum(numbers[name], 1), valid=numbers[name] > 0)
        for name in FORECAST_METRICS
    }


def _measures(
    positions: Float[np.ndarray, "n m t 2"],
    log_probs: Float[np.ndarray, "n m"],
    truth: Float[np.ndarray, "n t 2"],
) -> dict[str, Masked]:
    known = np.ones(truth.shape[:2], dtype=bool)
    errors = {
        "": open_loop_errors(positions, log_probs, truth, known, "most-probable"),
        "min": open_loop_errors(positions, log_probs, truth, known, "best-of-3"),
    }
    nearest = nearest_modes(positions[:, :, -1], truth[:, -1])
    top = log_probs.argmax(axis=1)
    rows = np.arange(len(top))
    several = np.full(len(top), log_probs.shape[1] > 1)
    return {
        **{
            f"forecast {prefix}{name}": each[name]
            for prefix, each in errors.items()
            for name in ("ADE", "FDE")
        },
        "forecast Brier": brier(log_probs, nearest, known[:, 0]),
        "overconfidence": Masked(
            value=np.exp(log_probs[rows, top]).astype(np.float64) - nearest[rows, top],
            valid=several,
        ),
    }


def _change(earlier: tuple[np.ndarray, np.ndarray], later: tuple[np.ndarray, np.ndarray]) -> Masked:
    """Distance of forecasts to those of the tick before, by the names of their targets."""
    names, positions = earlier
    order = np.argsort(names)
    at = np.searchsorted(names[order], later[0])
    at = order[np.minimum(at, len(order) - 1)] if len(order) else np.zeros_like(later[0])
    paired = names[at] == later[0] if len(order) else np.zeros(len(at), dtype=bool)
    matched = positions[at] if len(order) else later[1]
    return inconsistency(matched, later[1], paired, apart=1)


def _add(
    sums: Mapping[str, np.ndarray],
    numbers: Mapping[str, np.ndarray],
    found: Mapping[str, Masked],
    episode: np.ndarray,
) -> None:
    """Adds values of targets to the sums of their episodes."""
    for name, each in found.items():
        np.add.at(sums[name], episode[each.valid], each.value[each.valid])
        np.add.at(numbers[name], episode[each.valid], 1)


_OPEN_LOOP = {
    "forecast ADE": ("ADE", "most-probable"),
    "forecast FDE": ("FDE", "most-probable"),
    "forecast minADE": ("ADE", "best-of-3"),
    "forecast minFDE": ("FDE", "best-of-3"),
}
"""Names in open loop of errors that are measured while the expert is replayed."""


def open_loop_rows(rows: Sequence[Row]) -> list[Row]:
    """The rows of forecasts at logged states without latency, named as `asp-env evaluate` does.

    Args:
        rows: rows of the replayed expert with each predictor.
    """
    return [
        replace(
            row,
            planner="",
            traffic="",
            latency_ticks=None,
            rules="",
            metric=_OPEN_LOOP[row.metric][0],
            selection=_OPEN_LOOP[row.metric][1],
            subset="moving",
        )
        for row in rows
        if row.metric in _OPEN_LOOP and row.subset == "all" and not row.latency_ticks
    ]
