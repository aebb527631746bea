"""Reward as named terms, weighted and summed."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

import numpy as np
from jaxtyping import Float

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
    goal = np.maximum(after.goal_m, MIN_GOAL_M)
    gained = np.clip(after.route_m, 0, goal) - np.clip(before.route_m, 0, goal)
    turned = np.angle(np.exp(1j * (states_after[:, 2] - states_before[:, 2]).astype(np.float64)))
    longitudinal = (states_after[:, 3] - states_before[:, 3]) / dt_s
    lateral = states_after[:, 3] * turned / dt_s
    strain = (longitudinal**2 + lateral**2) / (2 * MAX_ACCELERATION_MPS2**2)
    return {
        "progress": gained / goal,
        "comfort": -strain.astype(np.float64),
        "collision": -after.at_fault.astype(np.float64),
        "off_road": -dt_s * (after.off_road_m > OFF_ROAD_M),
    }


def weighted_sum(
    terms: dict[str, Float[np.ndarray, " b"]], weights: RewardWeights
) -> Float[np.ndarray, " b"]:
    """The reward, (B,)."""
    by_name = asdict(weights)
    return np.sum([by_name[name] * value for name, value in terms.items()], axis=0)
