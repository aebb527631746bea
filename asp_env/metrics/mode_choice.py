"""Which of several modes a truth speaks for: one rule for training and evaluation.

Written once for NumPy arrays and torch tensors. N targets, M modes, T ticks.
"""

import math
from typing import Any, Literal

from jaxtyping import Bool, Float, Int

from asp_env.dynamics.limits import namespace

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
        near = allowed & ends_alike(positions, truth)
        allowed = xp.where(near.any(axis=1)[:, None], near, allowed)
    return xp.where(allowed, distance_m, math.inf).argmin(axis=1)


def ends_alike(positions: Float[Any, "n m t 2"], truth: Float[Any, "n t 2"]) -> Bool[Any, "n m"]:
    """(n, m) whether a mode ends within 5° of where the truth ends, seen from (0, 0).

    All modes do where the truth ends within 2 m, and so has no direction.
    """
    xp = namespace(positions)
    end, true_end = positions[:, :, -1], truth[:, None, -1]
    cross = end[..., 0] * true_end[..., 1] - end[..., 1] * true_end[..., 0]
    dot = (end * true_end).sum(axis=-1)
    stands = xp.linalg.vector_norm(true_end, axis=-1) < STANDING_M
    return (xp.abs(xp.arctan2(cross, dot)) <= MAX_ANGLE_RAD) | stands
