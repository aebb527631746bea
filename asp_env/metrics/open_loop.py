"""Errors of forecasts against what happened. N targets, M modes, T ticks."""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.metrics.masked import Masked

Selection = Literal["most-probable", "best-of-3"]
SELECTIONS: tuple[Selection, ...] = ("most-probable", "best-of-3")

MISS_M = 2.0
WHOLE_S = 1e-6
"""A time this close to a tick is that tick's."""
MOVING_MPS = 1.0
MOVING_M = 2.0


def displacement(
    modes: Float[np.ndarray, "n m t 2"], truth: Float[np.ndarray, "n t 2"]
) -> Float[np.ndarray, "n m t"]:
    """(n, m, t) L2 distance of every mode to the truth, metres."""
    return np.linalg.norm(modes - truth[:, None], axis=-1)


def select_mode(
    modes: Float[np.ndarray, "n m t 2"],
    log_probs: Float[np.ndarray, "n m"],
    truth: Float[np.ndarray, "n t 2"],
    selection: Selection,
) -> Int[np.ndarray, " n"]:
    """(n,) index of the mode that is scored.

    `most-probable` looks at the probabilities alone. `best-of-3` takes, of the three most
    probable, the one with the lowest final error (Argoverse 2's choice), so its ADE is that of the
    mode with the best end. The truth must be valid at the last tick.
    """
    if selection == "most-probable":
        return log_probs.argmax(axis=1)
    final = displacement(modes, truth)[..., -1]
    rank = np.argsort(np.argsort(-log_probs, axis=1, kind="stable"), axis=1)
    return np.where(rank < 3, final, np.inf).argmin(axis=1)


def open_loop_errors(
    modes: Float[np.ndarray, "n m t 2"],
    log_probs: Float[np.ndarray, "n m"],
    truth: Float[np.ndarray, "n t 2"],
    valid: Bool[np.ndarray, "n t"],
    selection: Selection,
) -> dict[str, Masked]:
    """Per target, metres unless said.

    MAE and MSE are means of |Δ| and Δ² over time and coordinate (Janjoš et al. 2021), ADE and FDE
    the mean and last L2 distance (minADE and minFDE under `best-of-3`), `miss` whether FDE exceeds
    2 m, `brier-FDE` is FDE + (1 - p)² (Argoverse 2). Valid where the truth is known throughout.
    """
    chosen = select_mode(modes, log_probs, truth, selection)
    rows = np.arange(len(modes))
    delta = modes[rows, chosen] - truth
    distance = np.linalg.norm(delta, axis=-1)
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
    *,
    dt_s: float,
) -> dict[str, Masked]:
    """Per target, `L2@1s`, `L2@2s` and so on: the chosen mode's distance to the truth then, m.

    Only seconds that are a whole number of ticks: with ticks of 0.3 s the first is `L2@3s`.
    """
    chosen = select_mode(modes, log_probs, truth, selection)
    distance = np.linalg.norm(modes[np.arange(len(modes)), chosen] - truth, axis=-1)
    whole = range(1, int(truth.shape[1] * dt_s + 1e-6) + 1)
    ticks = {second: round(second / dt_s) for second in whole}
    return {
        f"L2@{second}s": Masked(value=distance[:, tick - 1], valid=valid[:, tick - 1])
        for second, tick in ticks.items()
        if abs(tick * dt_s - second) < WHOLE_S
    }


def moving(
    now: Float[np.ndarray, "n 4"],
    truth: Float[np.ndarray, "n t 2"],
    valid: Bool[np.ndarray, "n t"],
) -> Bool[np.ndarray, " n"]:
    """(n,) the subset `moving`: over 1 m/s now, or over 2 m away at any valid tick to come."""
    away = np.linalg.norm(truth - now[:, None, :2], axis=-1)
    return (np.abs(now[:, 3]) > MOVING_MPS) | ((away > MOVING_M) & valid).any(axis=1)
