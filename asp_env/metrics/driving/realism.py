"""What is near every agent of a scene: clearances and times to whoever drives ahead, compiled.

MERGED: How likely the recorded motion is under the simulated one: the measure of WOSAC 2025.

The Waymo Open Sim Agents Challenge asks for 32 simulations of a scene. Any number serves here; a
driver without chance has a single one, whose ticks then are the histogram.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from asp_env.data.road_map import RoadMap
from asp_env.geometry import overlaps, wrap_angle
from asp_env.metrics.drivable import road_edge_m
from asp_env.metrics.masked import Masked

FAR_M = 1e3
"""Clearance of an agent that is alone."""

LONGEST_S = 5.0
"""Times to collision are no longer than this."""

ALONG_RAD = math.radians(75.0)
"""Somebody ahead is followed if it heads within this angle,"""

ALIKE_RAD = math.radians(10.0)
"""or within this one where the shadows of both overlap by less than the next."""

SLIGHT_M = 0.5


@njit(cache=True)
@no_type_check
def _corner(x, y, heading, length, width, number):
    ahead = 0.5 * length if number < 2 else -0.5 * length
    left = 0.5 * width if number % 2 == 0 else -0.5 * width
    cos, sin = math.cos(heading), math.sin(heading)
    return x + cos * ahead - sin * left, y + sin * ahead + cos * left


@njit(cache=True)
@no_type_check
def _depth(x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o):
    """How far the first box would have to go along one of its axes to be clear of the second."""
    turn = heading_o - heading
    along, across = abs(math.cos(turn)), abs(math.sin(turn))
    cos, sin = math.cos(heading), math.sin(heading)
    ahead = abs(cos * (x_o - x) + sin * (y_o - y))
    left = abs(cos * (y_o - y) - sin * (x_o - x))
    ahead = 0.5 * (length + along * length_o + across * width_o) - ahead
    left = 0.5 * (width + across * length_o + along * width_o) - left
    return min(ahead, left)


@njit(cache=True)
@no_type_check
def clearance(x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o):
    """Distance of two boxes; below 0 how deep they overlap."""
    if overlaps(x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o):
        one = _depth(x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o)
        other = _depth(x_o, y_o, heading_o, length_o, width_o, x, y, heading, length, width)
        return -min(one, other)
    best = np.inf
    for _ in range(2):  # of boxes apart, a corner of either is nearest
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
def _ahead_s(x, y, heading, speed, length, width, x_o, y_o, heading_o, speed_o, length_o, width_o):
    turn = heading_o - heading
    turn = abs(turn - 2 * math.pi * math.floor(turn / (2 * math.pi) + 0.5))
    cos, sin = math.cos(heading), math.sin(heading)
    along, across = abs(math.cos(turn)), abs(math.sin(turn))
    gap = cos * (x_o - x) + sin * (y_o - y)
    gap -= 0.5 * (length + along * length_o + across * width_o)
    shared = 0.5 * (width + across * length_o + along * width_o)
    shared -= abs(cos * (y_o - y) - sin * (x_o - x))
    closing = speed - speed_o * math.cos(turn)
    followed = turn <= ALIKE_RAD or (turn <= ALONG_RAD and shared >= SLIGHT_M)
    if gap <= 0.0 or shared <= 0.0 or closing <= 0.0 or not followed:
        return LONGEST_S
    return min(gap / closing, LONGEST_S)


@njit(cache=True)
@no_type_check
def _nearest_distance_and_ttc(states, valid, sizes, asked, clearance_m, ahead_s):
    for t in range(states.shape[0]):
        for a in range(states.shape[1]):
            clearance_m[t, a], ahead_s[t, a] = FAR_M, LONGEST_S
            if not (valid[t, a] and asked[a]):
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
                found = clearance(
                    x, y, heading, length, width,
                    states[t, o, 0], states[t, o, 1], states[t, o, 2], sizes[o, 0], sizes[o, 1],
                )  # fmt: skip
                clearance_m[t, a] = min(clearance_m[t, a], found)
                seconds = _ahead_s(
                    x, y, heading, speed, length, width,
                    states[t, o, 0], states[t, o, 1], states[t, o, 2], states[t, o, 3],
                    sizes[o, 0], sizes[o, 1],
                )  # fmt: skip
                ahead_s[t, a] = min(ahead_s[t, a], seconds)


def nearest_distance_and_ttc(
    states: Float[np.ndarray, "t a 4"],
    valid: Bool[np.ndarray, "t a"],
    sizes: Float[np.ndarray, "a 2"],
    asked: Bool[np.ndarray, " a"],
) -> tuple[Float[np.ndarray, "t a"], Float[np.ndarray, "t a"]]:
    """Clearance m to the nearest box, and seconds to whom one follows, of the agents asked about.

    Clearance is below 0 where boxes overlap. The time is the gap ahead over the speed at which it
    closes, at most 5 s, to agents in the way that head as one does: WOSAC's time to collision.
    """
    clearance_m, ahead_s = np.zeros(valid.shape), np.zeros(valid.shape)
    _nearest_distance_and_ttc(states, valid, sizes, asked, clearance_m, ahead_s)
    return clearance_m, ahead_s


SMOOTHING = 0.1
"""Added to the count of every bin."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RealismFeature:
    """Its weight in the whole, and the histogram of its values."""

    weight: float
    low: float
    high: float
    bins: int
    once: bool = False
    """Whether it is asked once per agent, if ever, rather than at every tick."""


REALISM_FEATURES = {
    "speed": RealismFeature(weight=0.05, low=0.0, high=25.0, bins=10),
    "acceleration": RealismFeature(weight=0.05, low=-12.0, high=12.0, bins=11),
    "yaw rate": RealismFeature(weight=0.05, low=-0.628, high=0.628, bins=11),
    "yaw acceleration": RealismFeature(weight=0.05, low=-3.14, high=3.14, bins=11),
    "nearest": RealismFeature(weight=0.10, low=-5.0, high=40.0, bins=10),
    "collision": RealismFeature(weight=0.25, low=-0.5, high=1.5, bins=2, once=True),
    "TTC": RealismFeature(weight=0.10, low=0.0, high=5.0, bins=10),
    "road edge": RealismFeature(weight=0.05, low=-20.0, high=40.0, bins=10),
    "off-road": RealismFeature(weight=0.25, low=-0.5, high=1.5, bins=2, once=True),
}
"""WOSAC's of 2025. Its 0.05 for traffic lights are left out, since recordings have none."""


def realism_features(
    states: Float[np.ndarray, "t a 4"],
    valid: Bool[np.ndarray, "t a"],
    sizes: Float[np.ndarray, "a 2"],
    road_map: RoadMap,
    asked: Bool[np.ndarray, " a"],
    dt_s: float,
) -> dict[str, Masked]:
    """Of everybody asked about: (t, a), or (1, a) for what is asked once.

    Rates are central differences of positions, headings and rates, m/s, m/s², rad/s, rad/s².
    `nearest` and `TTC` are as in `nearest_distance_and_ttc`; `road edge` is the distance of the outermost corner
    to the edge, m, below 0 inside. `collision` is whether `nearest` is ever below 0, `off-road`
    whether `road edge` is ever above it.
    """
    there = valid & asked
    moved, moves = _central(states[..., :2], there)
    speed = np.linalg.norm(moved, axis=-1) / dt_s
    turned, turns = _central(states[..., 2], there, angle=True)
    yaw_rate = turned / dt_s
    gained, gains = _central(speed, moves)
    twisted, twists = _central(yaw_rate, turns)
    clearance_m, ahead_s = nearest_distance_and_ttc(states, valid, sizes, asked)
    edge_m = road_edge_m(road_map, states, np.broadcast_to(sizes, (*valid.shape, 2)))
    edge_m = edge_m.astype(np.float64)
    ever = there.any(axis=0, keepdims=True)
    touched = ((clearance_m < 0) & there).any(axis=0, keepdims=True)
    left = ((edge_m > 0) & there).any(axis=0, keepdims=True)
    found = {
        "speed": (speed, moves),
        "acceleration": (gained / dt_s, gains),
        "yaw rate": (yaw_rate, turns),
        "yaw acceleration": (twisted / dt_s, twists),
        "nearest": (clearance_m, there),
        "collision": (touched.astype(np.float64), ever),
        "TTC": (ahead_s, there),
        "road edge": (edge_m, there),
        "off-road": (left.astype(np.float64), ever),
    }
    return {name: Masked(value=value, valid=known) for name, (value, known) in found.items()}


def _central(
    values: Float[np.ndarray, "t a *more"], valid: Bool[np.ndarray, "t a"], *, angle: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Half the change from the tick before to the tick after, and where both are known."""
    change = values[2:].astype(np.float64) - values[:-2]
    half = np.zeros(values.shape)
    half[1:-1] = 0.5 * (wrap_angle(change) if angle else change)
    known = np.zeros(valid.shape, dtype=bool)
    known[1:-1] = valid[2:] & valid[:-2]
    return half, known


def feature_likelihood(logged: Masked, simulated: list[Masked], feature: RealismFeature) -> Masked:
    """(1,) the geometric mean of the logged values' shares in each agent's simulated histogram.

    Values beyond the histogram count in its outermost bins. Agents without a simulated value are
    left out; without any, or a logged one, it is missing.
    """
    width = (feature.high - feature.low) / feature.bins

    def bins(values: np.ndarray) -> np.ndarray:
        return np.clip((values - feature.low) / width, 0, feature.bins - 1).astype(np.int64)

    agents = logged.value.shape[1]
    counts = np.zeros((agents, feature.bins))
    for each in simulated:
        tick, agent = np.nonzero(each.valid)
        np.add.at(counts, (agent, bins(each.value[tick, agent])), 1.0)
    some = counts.sum(axis=1) > 0
    shares = counts + SMOOTHING
    shares /= shares.sum(axis=1, keepdims=True)
    tick, agent = np.nonzero(logged.valid & some)
    if not len(tick):
        return Masked(value=np.zeros(1), valid=np.zeros(1, dtype=bool))
    found = np.log(shares[agent, bins(logged.value[tick, agent])]).mean()
    return Masked(value=np.exp(found)[None], valid=np.ones(1, dtype=bool))


def realism(logged: Mapping[str, Masked], simulated: list[dict[str, Masked]]) -> dict[str, Masked]:
    """`realism`, the weighted mean of the likelihoods of all features, and each of these.

    From 0 to 1, of one scene; it is no probability of the scene. What is missing is left out.

    Args:
        logged: `realism_features` of the recording, over the same ticks and agents.
        simulated: those of each simulation.
    """
    found = {
        name: feature_likelihood(logged[name], [each[name] for each in simulated], feature)
        for name, feature in REALISM_FEATURES.items()
    }
    weights = {name: REALISM_FEATURES[name].weight * float(each.valid[0]) for name, each in found.items()}
    total = sum(weights.values())
    mean = sum(weights[name] * each.value[0] for name, each in found.items()) / max(total, 1e-9)
    whole = Masked(value=np.array([mean]), valid=np.array([total > 0]))
    return {"realism": whole} | {f"realism: {name}": each for name, each in found.items()}
