"""Time to collision of the ego over whole episodes, compiled. B episodes, T ticks, A agents."""

import math
from dataclasses import dataclass
from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.geometry import overlaps
from asp_env.metrics.boxes import BEHIND_RAD

AHEAD_RAD = math.radians(30.0)
"""Within this angle to the ego's heading, seen from its rear axle, somebody is ahead (nuPlan)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TtcRule:
    """Whose paths are followed how far, and what is too short."""

    futures: Literal["constant-velocity", "recorded"]
    """How others go on: straight at their speed, or as they do until the episode ends."""
    step_s: float
    horizon_s: float
    min_ttc_s: float
    """A time to collision has to be above this."""
    sector: bool
    """Whether, as in nuPlan, only those within 30° ahead count, and those beside (up to 150°) only
    where the ego is in several lanes, off the road or at a crossing. Otherwise all count whose
    centre is not behind the ego's rear bumper."""
    ignore_after_contact: bool
    """Whether somebody counts again who touched the ego earlier and touches it no more."""
    standing_mps: float
    """At or below this speed the ego has no time to collision."""


@njit(cache=True)
@no_type_check
def _counts(x, y, heading, length, x_o, y_o, sector, beside):
    cos, sin = math.cos(heading), math.sin(heading)
    if not sector:
        return cos * (x_o - x) + sin * (y_o - y) >= -0.5 * length
    dx = x_o - x + AXLE_SHARE_OF_LENGTH * length * cos
    dy = y_o - y + AXLE_SHARE_OF_LENGTH * length * sin
    least = math.cos(BEHIND_RAD) if beside else math.cos(AHEAD_RAD)
    return cos * dx + sin * dy >= least * math.hypot(dx, dy)


@njit(cache=True)
@no_type_check
def _first_overlap(
    states, valid, sizes, b, k, a, last, recorded, step_s, steps, before_s, dt_s
):  # fmt: skip
    """The first time of the steps, earlier than `before_s`, at which the boxes overlap."""
    x, y, heading, speed = (
        states[b, k, 0, 0],
        states[b, k, 0, 1],
        states[b, k, 0, 2],
        states[b, k, 0, 3],
    )
    vx, vy = speed * math.cos(heading), speed * math.sin(heading)
    x_o, y_o, heading_o = states[b, k, a, 0], states[b, k, a, 1], states[b, k, a, 2]
    vx_o, vy_o = states[b, k, a, 3] * math.cos(heading_o), states[b, k, a, 3] * math.sin(heading_o)
    x_k, y_k, heading_k = x_o, y_o, heading_o
    for n in range(1, steps + 1):
        t = n * step_s
        if t >= before_s:
            break
        if recorded:
            i = int(t / dt_s + 1e-6)
            share = max(t / dt_s - i, 0.0)
            j = i + 1 if share > 1e-6 else i
            if k + j > last:
                break
            if not (valid[b, k + i, a] and valid[b, k + j, a]):
                continue
            here, there = states[b, k + i, a], states[b, k + j, a]
            x_k = here[0] + share * (there[0] - here[0])
            y_k = here[1] + share * (there[1] - here[1])
            turned = there[2] - here[2]
            turned -= 2 * math.pi * math.floor(turned / (2 * math.pi) + 0.5)
            heading_k = here[2] + share * turned
        else:
            x_k, y_k = x_o + t * vx_o, y_o + t * vy_o
        if overlaps(
            x + t * vx, y + t * vy, heading, sizes[b, 0, 0], sizes[b, 0, 1],
            x_k, y_k, heading_k, sizes[b, a, 0], sizes[b, a, 1],
        ):  # fmt: skip
            return t
    return np.inf


@njit(cache=True)
@no_type_check
def _ttc(
    states, valid, sizes, skipped, beside, count,
    recorded, step_s, steps, sector, standing_mps, dt_s, out,
):  # fmt: skip
    for b in range(states.shape[0]):
        for k in range(count[b]):
            if not valid[b, k, 0] or abs(states[b, k, 0, 3]) <= standing_mps:
                continue
            x, y, heading = states[b, k, 0, 0], states[b, k, 0, 1], states[b, k, 0, 2]
            length = sizes[b, 0, 0]
            for a in range(1, states.shape[2]):
                if not valid[b, k, a] or skipped[b, k, a]:
                    continue
                x_o, y_o = states[b, k, a, 0], states[b, k, a, 1]
                if not _counts(x, y, heading, length, x_o, y_o, sector, beside[b, k]):
                    continue
                found = _first_overlap(
                    states, valid, sizes, b, k, a, count[b] - 1,
                    recorded, step_s, steps, out[b, k], dt_s,
                )  # fmt: skip
                out[b, k] = min(out[b, k], found)


def time_to_collision(
    states: Float[np.ndarray, "b t a 4"],
    valid: Bool[np.ndarray, "b t a"],
    sizes: Float[np.ndarray, "b a 2"],
    *,
    contacts: Int[np.ndarray, "b t a"],
    ignored: Bool[np.ndarray, "b a"],
    beside: Bool[np.ndarray, "b t"],
    count: Int[np.ndarray, " b"],
    rule: TtcRule,
    dt_s: float,
) -> Float[np.ndarray, "b t"]:
    """Seconds until the ego (slot 0), keeping heading and speed, meets anybody; else infinity.

    Whoever touches the ego is left out, by nuPlan's rule from then on. A standing ego has no time
    to collision.

    Args:
        states: of all agents.
        valid: when they are there.
        sizes: their lengths and widths.
        contacts: `Contact` of the ego with each of them.
        ignored: agents that never count, such as the ego's own trailer.
        beside: where the rule's sector is wide.
        count: ticks of each episode that count; later ones are not looked at and stay infinite.
        rule: see there.
        dt_s: seconds per tick.
    """
    touching = contacts > 0
    skipped = touching if rule.ignore_after_contact else np.maximum.accumulate(touching, axis=1)
    out = np.full(states.shape[:2], np.inf)
    _ttc(
        states, valid, sizes, skipped | ignored[:, None], beside, count,
        rule.futures == "recorded", rule.step_s, round(rule.horizon_s / rule.step_s),
        rule.sector, rule.standing_mps, dt_s, out,
    )  # fmt: skip
    return out
