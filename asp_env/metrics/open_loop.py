"""Errors of forecasts against what happened. N targets, M modes, T ticks."""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.metrics.masked import Masked
from asp_env.metrics.mode_choice import ModeRule, best_mode

Selection = Literal["most-probable", "best-of-3"]
SELECTIONS: tuple[Selection, ...] = ("most-probable", "best-of-3")

BEST_OF = 3
MISS_M = 2.0
WHOLE_S = 1e-6
"""A time this close to a tick is that tick's."""
MOVING_MPS = 1.0
MOVING_M = 2.0


def displacement(
    modes: Float[np.ndarray, "n m t 2"], truth: Float[np.ndarray, "n t 2"]
) -> Float[np.ndarray, "n m t"]:
    """(n, m, t) L2 distance of every mode to the truth, metres."""
    return np.linalg.vector_norm(modes - truth[:, None], axis=-1)


def select_mode(
    modes: Float[np.ndarray, "n m t 2"],
    log_probs: Float[np.ndarray, "n m"],
    truth: Float[np.ndarray, "n t 2"],
    selection: Selection,
    rule: ModeRule = "fde",
) -> Int[np.ndarray, " n"]:
    """(n,) index of the mode that is scored.

    `most-probable` looks at the probabilities alone. `best-of-3` takes, of the three most
    probable, the one that `best_mode` names; under `fde`, Argoverse 2's choice, its ADE is that of
    the mode with the best end. For the rule `paper`, modes and truth are seen from the target. The
    truth must be valid at the ticks that the rule reads.
    """
    if selection == "most-probable":
        return log_probs.argmax(axis=1)
    rank = np.argsort(np.argsort(-log_probs, axis=1, kind="stable"), axis=1)
    return best_mode(modes, truth, rule, among=rank < BEST_OF)


def open_loop_errors(
    modes: Float[np.ndarray, "n m t 2"],
    log_probs: Float[np.ndarray, "n m"],
    truth: Float[np.ndarray, "n t 2"],
    valid: Bool[np.ndarray, "n t"],
    selection: Selection,
    rule: ModeRule = "fde",
) -> dict[str, Masked]:
    """Per target, metres unless said.

    MAE and MSE are means of |Δ| and Δ² over time and coordinate (Janjoš et al. 2021), ADE and FDE
    the mean and last L2 distance (minADE and minFDE under `best-of-3`), `miss` whether FDE exceeds
    2 m, `brier-FDE` is FDE + (1 - p)² (Argoverse 2). Valid where the truth is known throughout.
    """
    chosen = select_mode(modes, log_probs, truth, selection, rule)
    rows = np.arange(len(modes))
    delta = modes[rows, chosen] - truth
    distance = np.linalg.vector_norm(delta, axis=-1)
    probability = np.exp(log_probs[rows, chosen])
    values = {
        "MAE": np.abs(delta).mean(axis=(1, 2)),
        "MSE": (delta**2).mean(axis=(1, 2)),
        "ADE": distance.mean(axis=1),
        "FDE": distance[:, -1],
        "miss": (distance[:, -1] > MISS_M).astype(np.float32),
        "brier-FDE": distance[:, -1] + (1 - probability) ** 2,
    }
    known = np.asarray(valid.all(axis=1))
    return {name: Masked(value=value, valid=known) for name, value in values.items()}


def errors_over_time(
    modes: Float[np.ndarray, "n m t 2"],
    log_probs: Float[np.ndarray, "n m"],
    truth: Float[np.ndarray, "n t 2"],
    valid: Bool[np.ndarray, "n t"],
    selection: Selection,
    rule: ModeRule = "fde",
    *,
    dt_s: float,
) -> dict[str, Masked]:
    """Per target, `L2@1s`, `L2@2s` and so on: the chosen mode's distance to the truth then, m.

    Only seconds that are a whole number of ticks: with ticks of 0.3 s the first is `L2@3s`.
    """
    chosen = select_mode(modes, log_probs, truth, selection, rule)
    distance = np.linalg.vector_norm(modes[np.arange(len(modes)), chosen] - truth, axis=-1)
    whole = range(1, int(truth.shape[1] * dt_s + 1e-6) + 1)
    ticks = {second: round(second / dt_s) for second in whole}
    return {
        f"L2@{second}s": Masked(value=distance[:, tick - 1], valid=valid[:, tick - 1])
        for second, tick in ticks.items()
        if abs(tick * dt_s - second) < WHOLE_S
    }


def inconsistency(
    earlier: Float[np.ndarray, "n t 2"],
    later: Float[np.ndarray, "n t 2"],
    paired: Bool[np.ndarray, " n"],
    *,
    apart: int,
) -> Masked:
    """Per target, how far two forecasts of it disagree: mean L2 distance at shared times, m.

    The later one is made `apart` ticks after the earlier one, so its tick k is the earlier one's
    tick k + `apart`. Both are the most probable modes: what a planner is told first and then. A
    best mode is chosen by the truth, which no planner knows, so it is not asked.

    Args:
        earlier: positions of the earlier forecast, in the same frame as the later one's.
        later: positions of the later forecast.
        paired: where there is an earlier forecast of the target; elsewhere the value is missing,
            and everywhere if the forecasts share no tick.
        apart: ticks between them.
    """
    shared = max(later.shape[1] - apart, 0)
    if shared == 0:
        return Masked(value=np.zeros(len(later)), valid=np.zeros(len(later), dtype=bool))
    away = np.linalg.vector_norm(earlier[:, apart:] - later[:, :shared], axis=-1)
    return Masked(value=away.mean(axis=1), valid=paired)


def moving(
    now: Float[np.ndarray, "n 4"],
    truth: Float[np.ndarray, "n t 2"],
    valid: Bool[np.ndarray, "n t"],
) -> Bool[np.ndarray, " n"]:
    """(n,) the subset `moving`: over 1 m/s now, or over 2 m away at any valid tick to come."""
    away = np.linalg.vector_norm(truth - now[:, None, :2], axis=-1)
    return (np.abs(now[:, 3]) > MOVING_MPS) | ((away > MOVING_M) & valid).any(axis=1)
