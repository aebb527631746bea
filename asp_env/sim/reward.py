"""Reward as named terms, weighted and summed."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from asp_env.dynamics import MAX_ACCELERATION_MPS2
from asp_env.errors import AspEnvError, unknown_name
from asp_env.metrics.drivable import OFF_ROAD_M
from asp_env.sim.world import Events

MIN_GOAL_M = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RewardWeights:
    """Weight of each term in the sum."""

    progress: float = 1.0
    """Share of the logged ego's way gained in this step; sums to 1 at the goal."""
    comfort: float = 0.01
    """Minus the mean square of acceleration and lateral acceleration, over the limit of 5 m/s²."""
    collision: float = 1.0
    """-1 when the ego touches anybody in a way that it answers for."""
    off_road: float = 1.0
    """-1 for every second in which a corner of the ego is over 0.3 m outside the drivable area."""


def weights_from(given: Mapping[str, float]) -> RewardWeights:
    """The default weights with some replaced.

    Raises:
        AspEnvError: a name is unknown, or a value is no finite number.
    """
    known = [field.name for field in fields(RewardWeights)]
    for name, value in given.items():
        if name not in known:
            raise unknown_name("reward weight", name, known)
        if not (isinstance(value, int | float) and math.isfinite(value)):
            raise AspEnvError(f"reward weight {name} {value}: expected a finite number")
    return RewardWeights(**{name: float(value) for name, value in given.items()})


def reward_terms(
    before: Events,
    after: Events,
    states_before: Float[np.ndarray, "b 4"],
    states_after: Float[np.ndarray, "b 4"],
    dt_s: float,
) -> dict[str, Float[np.ndarray, " b"]]:
    """Unweighted terms of one step, each (B,)."""
    progress, comfort = np.empty(len(after.goal_m)), np.empty(len(after.goal_m))
    _gains(before.route_m, after.route_m, after.goal_m, progress)
    _strains(states_before, states_after, dt_s, comfort)
    return {
        "progress": progress,
        "comfort": comfort,
        "collision": -after.at_fault.astype(np.float64),
        "off_road": -dt_s * (after.off_road_m > OFF_ROAD_M),
    }


@njit(cache=True)
@no_type_check
def _gains(before, after, goals, out):
    """Shares of the ways to the goals that were gained; only what lies on a way counts."""
    for b in range(len(out)):
        goal = max(goals[b], MIN_GOAL_M)
        out[b] = (min(max(after[b], 0.0), goal) - min(max(before[b], 0.0), goal)) / goal


@njit(cache=True)
@no_type_check
def _strains(before, after, dt_s, out):
    """Minus the mean squares of both accelerations, as shares of the limit."""
    for b in range(len(out)):
        turned = np.float64(after[b, 2]) - before[b, 2]
        turned -= 2.0 * math.pi * np.rint(turned / (2.0 * math.pi))
        longitudinal = (np.float64(after[b, 3]) - before[b, 3]) / dt_s
        lateral = after[b, 3] * turned / dt_s
        out[b] = -(longitudinal**2 + lateral**2) / (2.0 * MAX_ACCELERATION_MPS2**2)


def weighted_sum(
    terms: dict[str, Float[np.ndarray, " b"]], weights: RewardWeights
) -> Float[np.ndarray, " b"]:
    """The reward, (B,)."""
    total = np.zeros(len(terms["progress"]))
    for name, value in terms.items():
        total += getattr(weights, name) * value
    return total
