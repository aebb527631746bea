"""The reward: a weighted sum of named terms."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float

from asp_env.arguments import is_finite_number, shown
from asp_env.compiled import njit
from asp_env.dynamics import MAX_ACCELERATION_MPS2
from asp_env.errors import AspEnvError, unknown_name
from asp_env.metrics.drivable import OFF_ROAD_M
from asp_env.sim.world import Events

STANDING_MPS = 0.5
"""Below this speed the ego counts as standing. Chosen by hand."""

ROUTE_OFFSET_M = 2.0
"""Offset from the route at which the term `route` is -1 per second. Chosen by hand: half a lane."""

MIN_GOAL_M = 1.0
"""Progress is relative to at least this distance, so that it stays finite. Chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RewardWeights:
    """Weight of each term in the sum. Defaults are chosen by hand."""

    progress: float = 1.0
    """Share of the logged ego's distance gained in this step; sums to 1 at the goal."""
    comfort: float = 0.01
    """Minus the mean square of acceleration and lateral acceleration, over the limit of 5 m/s²."""
    collision: float = 1.0
    """-1 when the ego touches an agent and is at fault."""
    off_road: float = 1.0
    """-1 for every second in which a corner of the ego is over 0.3 m outside the drivable area."""
    goal: float = 0.0
    """1 in the step that reaches the goal."""
    standing: float = 0.0
    """-1 for every second at less than 0.5 m/s."""
    route: float = 0.0
    """Minus the square of the offset from the route over 2 m, at most 1, for every second; -1 for
    every second whose heading differs from the route's by over 90°."""


REWARD_TERMS = tuple(field.name for field in fields(RewardWeights))
"""Names of the terms, in the order of their weights."""


def weights_from(given: Mapping[str, float]) -> RewardWeights:
    """The default weights, some of them replaced.

    Args:
        given: weights by name of their term.

    Raises:
        AspEnvError: a name is unknown, or a value is not a finite number.
    """
    for name, value in given.items():
        if name not in REWARD_TERMS:
            raise unknown_name("reward weight", name, REWARD_TERMS)
        if not is_finite_number(value):
            raise AspEnvError(f"reward weight {name} {shown(value)}: expected a finite number")
    return RewardWeights(**{name: float(value) for name, value in given.items()})


def reward_terms(
    before: Events,
    after: Events,
    states_before: Float[np.ndarray, "b 4"],
    states_after: Float[np.ndarray, "b 4"],
    dt_s: float,
) -> dict[str, Float[np.ndarray, " b"]]:
    """The unweighted terms of one step, by the names of `RewardWeights`.

    Args:
        before: events before the step.
        after: events after it.
        states_before: the egos' states [x m, y m, heading rad, speed m/s] before the step.
        states_after: the same after it.
        dt_s: length of the step.
    """
    progress, comfort = np.empty(len(after.goal_m)), np.empty(len(after.goal_m))
    _write_progress(before.route_m, after.route_m, after.goal_m, progress)
    _write_comfort(states_before, states_after, dt_s, comfort)
    offset = np.minimum((after.route_offset_m / ROUTE_OFFSET_M) ** 2, 1.0)
    return {
        "progress": progress,
        "comfort": comfort,
        "collision": -after.at_fault.astype(np.float64),
        "off_road": -dt_s * (after.off_road_m > OFF_ROAD_M),
        "goal": (after.reached_goal & ~before.reached_goal).astype(np.float64),
        "standing": -dt_s * (np.abs(states_after[:, 3]) < STANDING_MPS),
        "route": -dt_s * np.where(_is_reversed(after, states_after), 1.0, offset),
    }


def _is_reversed(events: Events, states: Float[np.ndarray, "b 4"]) -> Bool[np.ndarray, " b"]:
    return np.cos(states[:, 2] - events.route_heading_rad) < 0.0


@njit(cache=True)
@no_type_check
def _write_progress(before, after, goals, out):
    """Gained arc lengths, clipped to 0 and the goal, as shares of the goals; all (B,), in m."""
    for b in range(len(out)):
        goal = max(goals[b], MIN_GOAL_M)
        out[b] = (min(max(after[b], 0.0), goal) - min(max(before[b], 0.0), goal)) / goal


@njit(cache=True)
@no_type_check
def _write_comfort(before, after, dt_s, out):
    """Minus the mean square of both accelerations over their limit (B,), from states (B, 4)."""
    for b in range(len(out)):
        turned = np.float64(after[b, 2]) - before[b, 2]
        turned -= 2.0 * math.pi * np.rint(turned / (2.0 * math.pi))
        longitudinal = (np.float64(after[b, 3]) - before[b, 3]) / dt_s
        lateral = after[b, 3] * turned / dt_s
        out[b] = -(longitudinal**2 + lateral**2) / (2.0 * MAX_ACCELERATION_MPS2**2)


def weighted_sum(
    terms: dict[str, Float[np.ndarray, " b"]], weights: RewardWeights
) -> Float[np.ndarray, " b"]:
    """The reward: the sum of all terms, each times its weight."""
    total = np.zeros(len(terms["progress"]))
    for name, value in terms.items():
        total += getattr(weights, name) * value
    return total
