"""What a target does around now, from its recorded past and future: one manoeuvre each."""

from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.scenario_rules import TURN_RAD
from asp_env.dynamics import wrap_angle
from asp_env.metrics.open_loop import MOVING_MPS, moving


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
