"""Errors of forecasts against the ground truth, the choice of the scored mode, and manoeuvres.

Shapes: N targets, M modes, T ticks. `best_mode` works on NumPy arrays and on torch tensors, so that
training and evaluation choose modes by the same rules.
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
"""The mode that each rule chooses, in words."""

Selection = Literal["most-probable", "best-of-3"]
SELECTIONS: tuple[Selection, ...] = ("most-probable", "best-of-3")

MAX_ANGLE_RAD = math.radians(5.0)
"""Modes that end within this angle of the ground truth have its direction (Cui et al. 2019)."""

NO_DIRECTION_M = 2.0
"""A ground truth that ends within this distance has no direction. Chosen by hand."""

BEST_OF = 3
"""Number of most probable modes of which `best-of-3` chooses one (Janjoš et al. 2021)."""

MISS_M = 2.0
"""Final errors above this are misses (Argoverse 2)."""

MOVING_MPS = 1.0
"""Targets above this present speed are in the subset `moving`. Chosen by hand."""

MOVING_M = 2.0
"""So are targets that are ever further away than this in the future. Chosen by hand."""

_TIME_TOLERANCE_S = 1e-6


def best_mode(
    positions: Float[Any, "n m t 2"],
    truth: Float[Any, "n t 2"],
    rule: ModeRule,
    *,
    among: Bool[Any, "n m"] | None = None,
) -> Int[Any, " n"]:
    """Index of the mode that fits the ground truth best; the first of equal ones.

    `fde` takes the lowest L2 distance at the last tick (Argoverse 2), `ade` the lowest mean of it.
    `paper` (Cui et al. 2019, Janjoš et al. 2021) takes the lowest mean among the modes whose last
    point is within 5° of the last point of the ground truth, seen from the target. If there is no
    such mode it takes the lowest mean of all, where the published code draws a random mode. A
    ground truth that ends within 2 m has no direction, so that only the mean decides.

    Args:
        positions: of the modes, metres; the target's present position is (0, 0).
        truth: positions of the ground truth in the same frame, known at all ticks.
        rule: one of `MODE_RULES`.
        among: modes that may be chosen, at least one of each target; all modes if omitted.

    Returns:
        (n,) indices.
    """
    xp = namespace(positions)
    error_m = xp.linalg.vector_norm(positions - truth[:, None], axis=-1)
    criterion_m = error_m[..., -1] if rule == "fde" else error_m.mean(axis=-1)
    allowed = xp.ones_like(criterion_m, dtype=bool) if among is None else among
    if rule == "paper":
        near = allowed & ends_in_true_direction(positions, truth)
        allowed = xp.where(near.any(axis=1)[:, None], near, allowed)
    return xp.where(allowed, criterion_m, math.inf).argmin(axis=1)


def ends_in_true_direction(
    positions: Float[Any, "n m t 2"], truth: Float[Any, "n t 2"]
) -> Bool[Any, "n m"]:
    """Whether a mode ends within 5° of the end of the ground truth, seen from (0, 0).

    All modes do if the ground truth ends within 2 m.

    Args:
        positions: of the modes, metres; the target's present position is (0, 0).
        truth: positions of the ground truth in the same frame.

    Returns:
        (n, m) mask.
    """
    xp = namespace(positions)
    end, true_end = positions[:, :, -1], truth[:, None, -1]
    cross = end[..., 0] * true_end[..., 1] - end[..., 1] * true_end[..., 0]
    dot = (end * true_end).sum(axis=-1)
    no_direction = xp.linalg.vector_norm(true_end, axis=-1) < NO_DIRECTION_M
    return (xp.abs(xp.arctan2(cross, dot)) <= MAX_ANGLE_RAD) | no_direction


def select_mode(
    modes: Float[np.ndarray, "n m t 2"],
    log_probs: Float[np.ndarray, "n m"],
    truth: Float[np.ndarray, "n t 2"],
    selection: Selection,
    rule: ModeRule = "fde",
) -> Int[np.ndarray, " n"]:
    """Index of the mode that is scored.

    `most-probable` depends only on the probabilities. `best-of-3` takes the `best_mode` of the
    three most probable ones; with the rule `fde` (Argoverse 2) its ADE is that of the mode with the
    best end.

    Args:
        modes: positions, metres; seen from the target for the rule `paper`.
        log_probs: log-probabilities of the modes.
        truth: positions of the ground truth, valid at the ticks that the rule reads.
        selection: one of `SELECTIONS`.
        rule: one of `MODE_RULES`.

    Returns:
        (n,) indices.
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
    """Errors of the selected mode of each target, (n,) by name.

    `MAE` (m) and `MSE` (m²) are the means of |Δ| and Δ² over time and coordinate (Janjoš et al.
    2021), `ADE` and `FDE` (m) the mean and the last L2 distance (minADE and minFDE with
    `best-of-3`). `miss` is whether FDE exceeds 2 m, and `brier-FDE` (m) is FDE + (1 - p)²
    (Argoverse 2).

    Args:
        modes: positions, metres.
        log_probs: log-probabilities of the modes.
        truth: positions of the ground truth, metres.
        valid: ticks at which the ground truth is known; errors are valid if it is known at all.
        selection: one of `SELECTIONS`.
        rule: one of `MODE_RULES`.
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
    """L2 distance of the selected mode at each whole second: `L2@1s`, `L2@2s`, …, (n,) metres.

    Seconds that are no whole number of ticks are left out: with ticks of 0.3 s the first is
    `L2@3s`. The other arguments are those of `open_loop_errors`.

    Args:
        modes: positions, metres.
        log_probs: log-probabilities of the modes.
        truth: positions of the ground truth, metres.
        valid: ticks at which the ground truth is known.
        selection: one of `SELECTIONS`.
        rule: one of `MODE_RULES`.
        dt_s: seconds per tick.
    """
    chosen = select_mode(modes, log_probs, truth, selection, rule)
    distance = np.linalg.vector_norm(modes[np.arange(len(modes)), chosen] - truth, axis=-1)
    seconds = range(1, int(truth.shape[1] * dt_s + 1e-6) + 1)
    ticks = {second: round(second / dt_s) for second in seconds}
    return {
        f"L2@{second}s": Masked(value=distance[:, tick - 1], valid=valid[:, tick - 1])
        for second, tick in ticks.items()
        if abs(tick * dt_s - second) < _TIME_TOLERANCE_S
    }


def inconsistency(
    earlier: Float[np.ndarray, "n t 2"],
    later: Float[np.ndarray, "n t 2"],
    paired: Bool[np.ndarray, " n"],
    *,
    apart: int,
) -> Masked:
    """Mean L2 distance between two forecasts of the same target at the ticks they share, metres.

    Tick k of the later forecast is tick k + `apart` of the earlier one. Both are most probable
    modes, the forecasts that a planner receives; the best mode depends on the ground truth, which
    no planner has.

    Args:
        earlier: positions of the earlier forecast, metres.
        later: positions of the later forecast in the same frame.
        paired: targets with an earlier forecast; the value is missing elsewhere, and everywhere if
            the forecasts share no tick.
        apart: number of ticks between the forecasts.
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
    """Mask of the subset `moving`: over 1 m/s now, or over 2 m away at any valid future tick.

    Args:
        now: present states [x m, y m, heading rad, speed m/s].
        truth: positions of the ground truth, metres.
        valid: ticks at which the ground truth is known.
    """
    away = np.linalg.vector_norm(truth - now[:, None, :2], axis=-1)
    return (np.abs(now[:, 3]) > MOVING_MPS) | ((away > MOVING_M) & valid).any(axis=1)


class Manoeuvre(IntEnum):
    """Manoeuvres in the order of their rules in `manoeuvres`, of which the first applies."""

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
    """The `Manoeuvre` of each target, the first whose rule applies.

    - `STANDING`: not in the subset `moving`, so at most 1 m/s now and never over 2 m away.
    - `STARTING`: at most 1 m/s now, and therefore over 2 m away later.
    - `STOPPING`: over 1 m/s now, at most 1 m/s at the last tick.
    - `LEFT`, `RIGHT`: the heading turns by over 30° from the first tick of the past to the last
      tick of the future, including full turns.
    - `STRAIGHT`: all other targets.

    Args:
        states: past, present and future states [x m, y m, heading rad, speed m/s].
        valid: ticks that are known. Turns to and from unknown ticks are left out, and an unknown
            last tick is no stop.
        now: index of the present tick.

    Returns:
        (n,) values of `Manoeuvre`.
    """
    speed = np.abs(states[:, :, 3])
    moves = moving(states[:, now], states[:, now + 1 :, :2], valid[:, now + 1 :])
    slow = speed[:, now] <= MOVING_MPS
    stops = valid[:, -1] & (speed[:, -1] <= MOVING_MPS)
    both = valid[:, 1:] & valid[:, :-1]
    turn = np.where(both, wrap_angle(np.diff(states[:, :, 2], axis=1)), 0).sum(axis=1)
    conditions = [~moves, slow, stops, turn > TURN_RAD, turn < -TURN_RAD]
    return np.select(conditions, [int(kind) for kind in Manoeuvre][:-1], int(Manoeuvre.STRAIGHT))
