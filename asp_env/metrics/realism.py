"""How likely the recorded motion is under the simulated one: the measure of WOSAC 2025.

The Waymo Open Sim Agents Challenge asks for 32 simulations of a scene. Any number serves here; a
driver without chance has a single one, whose ticks then are the histogram.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.road_map import RoadMap
from asp_env.dynamics import wrap_angle
from asp_env.metrics.drivable import road_edge_m
from asp_env.metrics.masked import Masked
from asp_env.metrics.surroundings import look_around

SMOOTHING = 0.1
"""Added to the count of every bin."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Feature:
    """Its weight in the whole, and the histogram of its values."""

    weight: float
    low: float
    high: float
    bins: int
    once: bool = False
    """Whether it is asked once per agent, if ever, rather than at every tick."""


FEATURES = {
    "speed": Feature(weight=0.05, low=0.0, high=25.0, bins=10),
    "acceleration": Feature(weight=0.05, low=-12.0, high=12.0, bins=11),
    "yaw rate": Feature(weight=0.05, low=-0.628, high=0.628, bins=11),
    "yaw acceleration": Feature(weight=0.05, low=-3.14, high=3.14, bins=11),
    "nearest": Feature(weight=0.10, low=-5.0, high=40.0, bins=10),
    "collision": Feature(weight=0.25, low=-0.5, high=1.5, bins=2, once=True),
    "TTC": Feature(weight=0.10, low=0.0, high=5.0, bins=10),
    "road edge": Feature(weight=0.05, low=-20.0, high=40.0, bins=10),
    "off-road": Feature(weight=0.25, low=-0.5, high=1.5, bins=2, once=True),
}
"""WOSAC's of 2025. Its 0.05 for traffic lights are left out, since recordings have none."""


def features(
    states: Float[np.ndarray, "t a 4"],
    valid: Bool[np.ndarray, "t a"],
    sizes: Float[np.ndarray, "a 2"],
    road_map: RoadMap,
    asked: Bool[np.ndarray, " a"],
    dt_s: float,
) -> dict[str, Masked]:
    """Of everybody asked about: (t, a), or (1, a) for what is asked once.

    Rates are central differences of positions, headings and rates, m/s, m/s², rad/s, rad/s².
    `nearest` and `TTC` are as in `look_around`; `road edge` is the distance of the outermost corner
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
    clearance_m, ahead_s = look_around(states, valid, sizes, asked)
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


def likelihood(logged: Masked, simulated: list[Masked], feature: Feature) -> Masked:
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
        logged: `features` of the recording, over the same ticks and agents.
        simulated: those of each simulation.
    """
    found = {
        name: likelihood(logged[name], [each[name] for each in simulated], feature)
        for name, feature in FEATURES.items()
    }
    weights = {name: FEATURES[name].weight * float(each.valid[0]) for name, each in found.items()}
    total = sum(weights.values())
    mean = sum(weights[name] * each.value[0] for name, each in found.items()) / max(total, 1e-9)
    whole = Masked(value=np.array([mean]), valid=np.array([total > 0]))
    return {"realism": whole} | {f"realism: {name}": each for name, each in found.items()}
