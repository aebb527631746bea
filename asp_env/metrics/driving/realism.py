"""Likelihood of the recorded motion of agents under simulated motion: the WOSAC 2025 metric.

The Waymo Open Sim Agents Challenge requires 32 simulations of a scene. Here any number is accepted;
a deterministic driver has a single one, whose ticks alone form the histograms. The kernels compute
clearances between boxes and the time to collision with the agent ahead.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float

from asp_env.compiled import njit
from asp_env.data.road_map import RoadMap
from asp_env.geometry import overlaps, wrap_angle
from asp_env.metrics.drivable import road_edge_m
from asp_env.metrics.masked import Masked

SMOOTHING = 0.1
"""Added to the count of every histogram bin (WOSAC)."""

FAR_M = 1e3
"""Clearance of an agent without other agents."""

MAX_TTC_S = 5.0
"""Times to collision are clipped to this (WOSAC)."""

FOLLOWING_RAD = math.radians(75.0)
"""An agent ahead is followed if the headings differ by at most this and the boxes overlap laterally
by at least `MIN_LATERAL_OVERLAP_M` (WOSAC)."""

ALIGNED_RAD = math.radians(10.0)
"""Within this heading difference any lateral overlap is enough (WOSAC)."""

MIN_LATERAL_OVERLAP_M = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class RealismFeature:
    """The weight of a feature and the histogram of its values."""

    weight: float
    low: float
    high: float
    bins: int


REALISM_FEATURES = {
    "speed": RealismFeature(weight=0.05, low=0.0, high=25.0, bins=10),
    "acceleration": RealismFeature(weight=0.05, low=-12.0, high=12.0, bins=11),
    "yaw rate": RealismFeature(weight=0.05, low=-0.628, high=0.628, bins=11),
    "yaw acceleration": RealismFeature(weight=0.05, low=-3.14, high=3.14, bins=11),
    "nearest": RealismFeature(weight=0.10, low=-5.0, high=40.0, bins=10),
    "collision": RealismFeature(weight=0.25, low=-0.5, high=1.5, bins=2),
    "TTC": RealismFeature(weight=0.10, low=0.0, high=5.0, bins=10),
    "road edge": RealismFeature(weight=0.05, low=-20.0, high=40.0, bins=10),
    "off-road": RealismFeature(weight=0.25, low=-0.5, high=1.5, bins=2),
}
"""The features of WOSAC 2025 except traffic lights (0.05), which recordings do not have."""


def realism(logged: Mapping[str, Masked], simulated: list[dict[str, Masked]]) -> dict[str, Masked]:
    """The realism of one scene and the likelihood of each feature, (1,) from 0 to 1.

    `realism` is the weighted mean of the feature likelihoods, without missing ones. It is not a
    probability of the scene.

    Args:
        logged: `realism_features` of the recording.
        simulated: `realism_features` of each simulation, over the same ticks and agents.

    Returns:
        `realism`, and `realism: NAME` of each feature.
    """
    likelihoods = {
        name: feature_likelihood(logged[name], [each[name] for each in simulated], feature)
        for name, feature in REALISM_FEATURES.items()
    }
    weights = {
        name: REALISM_FEATURES[name].weight * float(each.valid[0])
        for name, each in likelihoods.items()
    }
    total = sum(weights.values())
    mean = sum(weights[name] * each.value[0] for name, each in likelihoods.items())
    mean = mean / max(total, 1e-9)
    whole = Masked(value=np.array([mean]), valid=np.array([total > 0]))
    return {"realism": whole} | {f"realism: {name}": each for name, each in likelihoods.items()}


def realism_features(
    states: Float[np.ndarray, "t a 4"],
    valid: Bool[np.ndarray, "t a"],
    sizes: Float[np.ndarray, "a 2"],
    road_map: RoadMap,
    evaluated: Bool[np.ndarray, " a"],
    dt_s: float,
) -> dict[str, Masked]:
    """The values of `REALISM_FEATURES` of the evaluated agents.

    Rates are central differences of positions, headings and rates, in m/s, m/s², rad/s and rad/s².
    `nearest` and `TTC` are as in `nearest_distance_and_ttc`; `road edge` is the signed distance of
    the outermost corner to the road edge, m, negative inside. `collision` is whether `nearest` is
    ever below 0, `off-road` whether `road edge` is ever above 0.

    Args:
        states: [x m, y m, heading rad, speed m/s] of all agents.
        valid: ticks at which each agent is present.
        sizes: length and width, metres.
        road_map: the map.
        evaluated: agents whose features are computed.
        dt_s: seconds per tick.

    Returns:
        (t, a) for each name, or (1, a) for features with one value per episode.
    """
    present = valid & evaluated
    displacement, has_speed = _central_difference(states[..., :2], present)
    speed = np.linalg.norm(displacement, axis=-1) / dt_s
    turn, has_yaw_rate = _central_difference(states[..., 2], present, angle=True)
    yaw_rate = turn / dt_s
    speed_change, has_acceleration = _central_difference(speed, has_speed)
    yaw_rate_change, has_yaw_acceleration = _central_difference(yaw_rate, has_yaw_rate)
    clearance_m, ttc_s = nearest_distance_and_ttc(states, valid, sizes, evaluated)
    edge_m = road_edge_m(road_map, states, np.broadcast_to(sizes, (*valid.shape, 2)))
    edge_m = edge_m.astype(np.float64)
    ever = present.any(axis=0, keepdims=True)
    collides = ((clearance_m < 0) & present).any(axis=0, keepdims=True)
    leaves_road = ((edge_m > 0) & present).any(axis=0, keepdims=True)
    values = {
        "speed": (speed, has_speed),
        "acceleration": (speed_change / dt_s, has_acceleration),
        "yaw rate": (yaw_rate, has_yaw_rate),
        "yaw acceleration": (yaw_rate_change / dt_s, has_yaw_acceleration),
        "nearest": (clearance_m, present),
        "collision": (collides.astype(np.float64), ever),
        "TTC": (ttc_s, present),
        "road edge": (edge_m, present),
        "off-road": (leaves_road.astype(np.float64), ever),
    }
    return {name: Masked(value=value, valid=known) for name, (value, known) in values.items()}


def feature_likelihood(logged: Masked, simulated: list[Masked], feature: RealismFeature) -> Masked:
    """Geometric mean of the probabilities of the logged values in each agent's histogram.

    Values outside the histogram count in its outermost bins. Agents without a simulated value are
    left out; the result is missing without any agent or logged value.

    Args:
        logged: (t, a) values of the recording.
        simulated: (t, a) values of each simulation.
        feature: bins of the histogram.

    Returns:
        (1,) from 0 to 1.
    """
    width = (feature.high - feature.low) / feature.bins

    def bins(values: np.ndarray) -> np.ndarray:
        return np.clip((values - feature.low) / width, 0, feature.bins - 1).astype(np.int64)

    agents = logged.value.shape[1]
    counts = np.zeros((agents, feature.bins))
    for each in simulated:
        tick, agent = np.nonzero(each.valid)
        np.add.at(counts, (agent, bins(each.value[tick, agent])), 1.0)
    has_values = counts.sum(axis=1) > 0
    probabilities = counts + SMOOTHING
    probabilities /= probabilities.sum(axis=1, keepdims=True)
    tick, agent = np.nonzero(logged.valid & has_values)
    if not len(tick):
        return Masked(value=np.zeros(1), valid=np.zeros(1, dtype=bool))
    mean_log = np.log(probabilities[agent, bins(logged.value[tick, agent])]).mean()
    return Masked(value=np.exp(mean_log)[None], valid=np.ones(1, dtype=bool))


def nearest_distance_and_ttc(
    states: Float[np.ndarray, "t a 4"],
    valid: Bool[np.ndarray, "t a"],
    sizes: Float[np.ndarray, "a 2"],
    evaluated: Bool[np.ndarray, " a"],
) -> tuple[Float[np.ndarray, "t a"], Float[np.ndarray, "t a"]]:
    """Clearance to the nearest box and time to collision with the agent ahead (WOSAC).

    The time is the gap to a followed agent ahead over the speed at which the gap closes.

    Args:
        states: [x m, y m, heading rad, speed m/s] of all agents.
        valid: ticks at which each agent is present.
        sizes: length and width, metres.
        evaluated: agents for which both are computed.

    Returns:
        Clearance in metres, negative where boxes overlap and `FAR_M` without other agents, and time
        in seconds, at most `MAX_TTC_S`; `FAR_M` and `MAX_TTC_S` for other agents.
    """
    clearance_m, ttc_s = np.zeros(valid.shape), np.zeros(valid.shape)
    _write_nearest_distance_and_ttc(states, valid, sizes, evaluated, clearance_m, ttc_s)
    return clearance_m, ttc_s


def _central_difference(
    values: Float[np.ndarray, "t a *more"], valid: Bool[np.ndarray, "t a"], *, angle: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Half the change from the previous to the next tick, and where both are valid."""
    change = values[2:].astype(np.float64) - values[:-2]
    half = np.zeros(values.shape)
    half[1:-1] = 0.5 * (wrap_angle(change) if angle else change)
    known = np.zeros(valid.shape, dtype=bool)
    known[1:-1] = valid[2:] & valid[:-2]
    return half, known


@njit(cache=True)
@no_type_check
def _write_nearest_distance_and_ttc(states, valid, sizes, evaluated, clearance_m, ttc_s):
    """Writes clearances and times to collision.

    Args:
        states: (ticks, agents, 4).
        valid: (ticks, agents).
        sizes: (agents, 2).
        evaluated: (agents,).
        clearance_m: (ticks, agents), written.
        ttc_s: (ticks, agents), written.
    """
    for t in range(states.shape[0]):
        for a in range(states.shape[1]):
            clearance_m[t, a], ttc_s[t, a] = FAR_M, MAX_TTC_S
            if not (valid[t, a] and evaluated[a]):
                continue
            x, y, heading, speed = (
                states[t, a, 0],
                states[t, a, 1],
                states[t, a, 2],
                states[t, a, 3],
            )
            length, width = sizes[a, 0], sizes[a, 1]
            for o in range(states.shape[1]):
                if o == a or not valid[t, o]:
                    continue
                distance_m = clearance(
                    x, y, heading, length, width,
                    states[t, o, 0], states[t, o, 1], states[t, o, 2], sizes[o, 0], sizes[o, 1],
                )  # fmt: skip
                clearance_m[t, a] = min(clearance_m[t, a], distance_m)
                seconds = _ttc_ahead_s(
                    x, y, heading, speed, length, width,
                    states[t, o, 0], states[t, o, 1], states[t, o, 2], states[t, o, 3],
                    sizes[o, 0], sizes[o, 1],
                )  # fmt: skip
                ttc_s[t, a] = min(ttc_s[t, a], seconds)


@njit(cache=True)
@no_type_check
def clearance(x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o):
    """Distance of two boxes, metres; minus the depth of their overlap if they overlap.

    The boxes are given by centre (m), heading (rad), length and width (m), the second with `_o`.
    """
    if overlaps(x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o):
        first = _depth(x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o)
        second = _depth(x_o, y_o, heading_o, length_o, width_o, x, y, heading, length, width)
        return -min(first, second)
    best = np.inf
    for _ in range(2):  # the nearest point of separate boxes is a corner of one of them
        for number in range(4):
            px, py = _corner(x_o, y_o, heading_o, length_o, width_o, number)
            cos, sin = math.cos(heading), math.sin(heading)
            ahead = abs(cos * (px - x) + sin * (py - y)) - 0.5 * length
            left = abs(cos * (py - y) - sin * (px - x)) - 0.5 * width
            best = min(best, math.hypot(max(ahead, 0.0), max(left, 0.0)))
        x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o = (
            x_o, y_o, heading_o, length_o, width_o, x, y, heading, length, width,
        )  # fmt: skip
    return best


@njit(cache=True)
@no_type_check
def _ttc_ahead_s(
    x, y, heading, speed, length, width, x_o, y_o, heading_o, speed_o, length_o, width_o
):
    """Time to collision with another agent (`_o`) if it is ahead and followed, else `MAX_TTC_S`.

    Each is given by centre (m), heading (rad), speed (m/s), length and width (m).
    """
    turn = heading_o - heading
    turn = abs(turn - 2 * math.pi * math.floor(turn / (2 * math.pi) + 0.5))
    cos, sin = math.cos(heading), math.sin(heading)
    along, across = abs(math.cos(turn)), abs(math.sin(turn))
    gap = cos * (x_o - x) + sin * (y_o - y)
    gap -= 0.5 * (length + along * length_o + across * width_o)
    shared = 0.5 * (width + across * length_o + along * width_o)
    shared -= abs(cos * (y_o - y) - sin * (x_o - x))
    closing = speed - speed_o * math.cos(turn)
    wide_enough = turn <= FOLLOWING_RAD and shared >= MIN_LATERAL_OVERLAP_M
    followed = turn <= ALIGNED_RAD or wide_enough
    if gap <= 0.0 or shared <= 0.0 or closing <= 0.0 or not followed:
        return MAX_TTC_S
    return min(gap / closing, MAX_TTC_S)


@njit(cache=True)
@no_type_check
def _corner(x, y, heading, length, width, number):
    """One of the four corners of a box (m, rad), as (x, y)."""
    ahead = 0.5 * length if number < 2 else -0.5 * length
    left = 0.5 * width if number % 2 == 0 else -0.5 * width
    cos, sin = math.cos(heading), math.sin(heading)
    return x + cos * ahead - sin * left, y + sin * ahead + cos * left


@njit(cache=True)
@no_type_check
def _depth(x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o):
    """The shortest motion along an axis of the first box that separates it from the second."""
    turn = heading_o - heading
    along, across = abs(math.cos(turn)), abs(math.sin(turn))
    cos, sin = math.cos(heading), math.sin(heading)
    ahead = abs(cos * (x_o - x) + sin * (y_o - y))
    left = abs(cos * (y_o - y) - sin * (x_o - x))
    ahead = 0.5 * (length + along * length_o + across * width_o) - ahead
    left = 0.5 * (width + across * length_o + along * width_o) - left
    return min(ahead, left)
