"""Who may come: nobody is put into somebody else, nor where it could not stop behind them."""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Bool
from numba import njit

from asp_env.dynamics import MAX_ACCELERATION_MPS2
from asp_env.metrics.boxes import overlaps
from asp_env.sim.scenario_world import ScenarioWorld

SPARE_M = 0.5


@njit(cache=True)
@no_type_check
def _blocked(comer, size, states, sizes, valid, dt):
    """Whether the box, lengthened by what it needs to brake, holds anybody's at the next tick."""
    cos, sin = math.cos(comer[2]), math.sin(comer[2])
    for o in range(len(states)):
        if not valid[o]:
            continue
        other = states[o]
        x = other[0] + other[3] * dt * math.cos(other[2])
        y = other[1] + other[3] * dt * math.sin(other[2])
        along = max(other[3] * math.cos(other[2] - comer[2]), 0.0)
        needed = max(comer[3] ** 2 - along**2, 0.0) / (2.0 * MAX_ACCELERATION_MPS2) + SPARE_M
        if overlaps(
            comer[0] + 0.5 * needed * cos, comer[1] + 0.5 * needed * sin, comer[2],
            size[0] + needed, size[1], x, y, other[2], sizes[o, 0], sizes[o, 1],
        ):  # fmt: skip
            return True
    return False


@njit(cache=True)
@no_type_check
def _bar(states, valid, log_states, log_valid, sizes, mine, gone, now, dt, out):
    for b in range(len(now)):
        t = now[b]
        if t + 1 >= valid.shape[1]:
            continue
        for a in range(mine.shape[1]):
            comes = mine[b, a] and log_valid[b, t + 1, a] and not (valid[b, t, a] or gone[b, a])
            if comes:
                out[b, a] = _blocked(
                    log_states[b, t + 1, a], sizes[b, a], states[b, t], sizes[b], valid[b, t], dt
                )


def barred(world: ScenarioWorld, mine: Bool[np.ndarray, "b a"]) -> Bool[np.ndarray, "b a"]:
    """Whose logged place at the next tick, at which it would appear, is taken.

    So is it if somebody stands, or drives more slowly the same way, nearer than the vehicle could
    brake at 5 m/s². Whoever is barred never comes: later on its logged place lies amid the traffic.
    """
    episodes = world.episodes
    out = np.zeros(mine.shape, dtype=bool)
    _bar(
        episodes.states, episodes.valid, episodes.log_states, episodes.log_valid, episodes.sizes,
        mine, episodes.gone, world.now, world.dt_s, out,
    )  # fmt: skip
    return out
