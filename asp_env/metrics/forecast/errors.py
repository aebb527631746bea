"""Which of several modes a truth speaks for: one rule for training and evaluation.

Written once for NumPy arrays and torch tensors. N targets, M modes, T ticks.

MERGED: Errors of forecasts against what happened. N targets, M modes, T ticks.
MERGED: What a target does around now, from its recorded past and future: one manoeuvre each.
"""

import math
from enum import IntEnum
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.scenarios.tags import TURN_RAD
from asp_env.geometry import namespace, wrap_angle
from asp_env.metrics.masked import Masked

ModeRule = Literal["fde", "ade", "paper"]
MODE_RULES: dict[ModeRule, str] = {
    "fde": "the lowest final error",
    "ade": "the lowest mean error",
    "paper": "the lowest mean error among those that end within 5° of the truth",
}
"""What each rule takes, in words."""

MAX_ANGLE_RAD = math.radians(5.0)
STANDING_M = 2.0


def best_mode(
    positions: Float[Any, "n m t 2"],
    truth: Float[Any, "n t 2"],
    rule: ModeRule,
    *,
    among: Bool[Any, "n m"] | None = None,
) -> Int[Any, " n"]:
    """(n,) index of the mode that fits the truth best; of equals the first.

    `fde` takes the lowest L2 distance at the last tick (Argoverse 2), `ade` the lowest mean of it.
    `paper` (Cui et al. 2019, Janjoš et al. 2021) takes the lowest mean among the modes whose last
    point lies within 5° of the truth's last point, seen from the target; where there is none the
    lowest mean of all, for which the published code draws a random mode. A truth that ends within
    2 m has no direction: the mean alone.

    Args:
        positions: of the modes, metres; the target now is at (0, 0), the axes may point anywhere.
        truth: what happened, in the same frame, known at all ticks.
        rule: see above.
        among: the modes that may be taken, at least one of each target; all without it.
    """
    xp = namespace(positions)
    away_m = xp.linalg.vector_norm(positions - truth[:, None], axis=-1)
    distance_m = away_m[..., -1] if rule == "fde" else away_m.mean(axis=-1)
    allowed = xp.ones_like(distance_m, dtype=bool) if among is None else among
    if rule == "paper":
        near = allowed & ends_in_true_direction(positions, truth)
        allowed = xp.where(near.any(axis=1)[:, None], near, allowed)
    return xp.where(allowed, distance_m, math.inf).argmin(axis=1)


def ends_in_true_direction(positions: Float[Any, "n m t 2"], truth: Float[Any, "n t 2"]) -> Bool[Any, "n m"]:
    """(n, m) whether a mode ends within 5° of where the truth ends, seen from (0, 0).

    All modes do where the truth ends within 2 m, and so has no direction.
    """
    xp = namespace(positions)
    end, true_end = positions[:, :, -1], truth[:, None, -1]
    cross = end[..., 0] * true_end[..., 1] - end[..., 1] * true_end[..., 0]
    dot = (end * true_end).sum(axis=-1)
    stands = xp.linalg.vector_norm(true_end, axis=-1) < STANDING_M
    return (xp.abs(xp.arctan2(cross, dot)) <= MAX_ANGLE_RAD) | stands


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


class Manoeuvre(IntEnum):
    """In the order of the rules of `manoeuvres`: the first that holds."""

    STANDING = 0
    STARTING = 1
    STOPPING = 2
    LEFT = 3
    RIGHT = 4
    STRAIGHT = 5


def manoeuvres(
    states: Float[np.ndarray, "n ticks 4"],
    valid: Bool[np.ndarray, "n ticks"],
    *,
    now: int,
) -> Int[np.ndarray, " n"]:
    """(n,) `Manoeuvre` of each target, the first whose rule holds.

    - `STANDING`: not in the subset `moving`, so at most 1 m/s now and never over 2 m away.
    - `STARTING`: at most 1 m/s now, so it will be over 2 m away.
    - `STOPPING`: over 1 m/s now, at most 1 m/s at the last tick.
    - `LEFT`, `RIGHT`: its heading turns by over 30° from the first tick of the past to the last one
      of the future, whole turns counted.
    - `STRAIGHT`: all others.

    Args:
        states: past, present and future.
        valid: ticks that are known. Turns between ticks of which one is not are not seen; an
            unknown last tick is no stop.
        now: the tick of the present.
    """
    speed = np.abs(states[:, :, 3])
    moves = moving(states[:, now], states[:, now + 1 :, :2], valid[:, now + 1 :])
    slow = speed[:, now] <= MOVING_MPS
    stops = valid[:, -1] & (speed[:, -1] <= MOVING_MPS)
    both = valid[:, 1:] & valid[:, :-1]
    turned = np.where(both, wrap_angle(np.diff(states[:, :, 2], axis=1)), 0).sum(axis=1)
    rules = [~moves, slow, stops, turned > TURN_RAD, turned < -TURN_RAD]
    return np.select(rules, [int(kind) for kind in Manoeuvre][:-1], int(Manoeuvre.STRAIGHT))
