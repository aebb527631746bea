"""Time to collision of the ego over whole episodes, compiled."""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.compiled import njit
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.geometry import overlaps
from asp_env.metrics.boxes import BEHIND_RAD

AHEAD_RAD = math.radians(30.0)
"""Agents within this angle to the ego's heading, seen from its rear axle, are ahead (nuPlan)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TtcRule:
    """How the time to collision is computed, and which one is too short."""

    futures: Literal["constant-velocity", "recorded"]
    """Motion of the other agents: straight on at their speed, or as in the rest of the episode."""
    step_s: float
    """Time between the tested instants."""
    horizon_s: float
    """The last tested instant."""
    min_ttc_s: float
    """A time to collision must be above this."""
    sector: bool
    """If true, only agents within 30° ahead count, and agents up to 150° where the sector is wide:
    where the ego is in several lanes, off the road or at a crossing (nuPlan). Otherwise all agents
    count whose centre is not behind the ego's rear bumper."""
    ignore_after_contact: bool
    """Whether an agent that has touched the ego is ignored for the rest of the episode (nuPlan), or
    only while it touches the ego."""
    standing_mps: float
    """An ego up to this speed has no time to collision."""


def time_to_collision(
    states: Float[np.ndarray, "b t a 4"],
    valid: Bool[np.ndarray, "b t a"],
    sizes: Float[np.ndarray, "b a 2"],
    *,
    contacts: Int[np.ndarray, "b t a"],
    ignored: Bool[np.ndarray, "b a"],
    wide_sector: Bool[np.ndarray, "b t"],
    num_ticks: Int[np.ndarray, " b"],
    rule: TtcRule,
    dt_s: float,
) -> Float[np.ndarray, "b t"]:
    """Time until the ego (slot 0), at constant velocity, overlaps another agent.

    Args:
        states: [x m, y m, heading rad, speed m/s] of A agents in B episodes of up to T ticks.
        valid: ticks at which each agent is present.
        sizes: length and width, metres.
        contacts: `Contact` of the ego with each agent.
        ignored: agents that never count, such as the ego's own trailer.
        wide_sector: ticks at which the rule's sector is wide.
        num_ticks: number of ticks of each episode; later ticks are ignored.
        rule: the definition to use.
        dt_s: seconds per tick.

    Returns:
        (b, t) seconds, a multiple of the rule's step; infinity where the ego stands, where there is
        no overlap within the rule's horizon, and after the end of an episode.
    """
    touching = contacts > 0
    skipped = np.maximum.accumulate(touching, axis=1) if rule.ignore_after_contact else touching
    parameters = _Parameters(
        recorded=rule.futures == "recorded",
        step_s=rule.step_s,
        num_steps=round(rule.horizon_s / rule.step_s),
        sector=rule.sector,
        standing_mps=rule.standing_mps,
        dt_s=dt_s,
    )
    out = np.full(states.shape[:2], np.inf)
    skipped = skipped | ignored[:, None]
    _write_ttc(states, valid, sizes, skipped, wide_sector, num_ticks, parameters, out)
    return out


class _Parameters(NamedTuple):
    """A `TtcRule` as kernels take it."""

    recorded: bool
    """Whether other agents move as recorded rather than at constant velocity."""
    step_s: float
    num_steps: int
    sector: bool
    standing_mps: float
    dt_s: float
    """Seconds per tick."""


@njit(cache=True)
@no_type_check
def _write_ttc(states, valid, sizes, skipped, wide_sector, num_ticks, parameters, out):
    """Writes the time to collision.

    Args:
        states: (episodes, ticks, agents, 4).
        valid: (episodes, ticks, agents).
        sizes: (episodes, agents, 2).
        skipped: (episodes, ticks, agents) agents that do not count.
        wide_sector: (episodes, ticks).
        num_ticks: (episodes,).
        parameters: `_Parameters`.
        out: (episodes, ticks) infinity, written.
    """
    for b in range(states.shape[0]):
        episode_states, episode_valid, episode_sizes = states[b], valid[b], sizes[b]
        last = num_ticks[b] - 1
        for k in range(num_ticks[b]):
            if not valid[b, k, 0] or abs(states[b, k, 0, 3]) <= parameters.standing_mps:
                continue
            x, y, heading = states[b, k, 0, 0], states[b, k, 0, 1], states[b, k, 0, 2]
            length = sizes[b, 0, 0]
            for a in range(1, states.shape[2]):
                if not valid[b, k, a] or skipped[b, k, a]:
                    continue
                x_o, y_o = states[b, k, a, 0], states[b, k, a, 1]
                wide = wide_sector[b, k]
                if not agent_counts(x, y, heading, length, x_o, y_o, parameters.sector, wide):
                    continue
                overlap_s = _first_overlap_s(
                    episode_states, episode_valid, episode_sizes, k, a, last, parameters, out[b, k]
                )
                out[b, k] = min(out[b, k], overlap_s)


@njit(cache=True)
@no_type_check
def agent_counts(x, y, heading, length, x_o, y_o, sector, wide):
    """Whether an agent with its centre at (x_o, y_o) m counts for a vehicle (m, rad): `TtcRule`."""
    cos, sin = math.cos(heading), math.sin(heading)
    if not sector:
        return cos * (x_o - x) + sin * (y_o - y) >= -0.5 * length
    dx = x_o - x + AXLE_SHARE_OF_LENGTH * length * cos
    dy = y_o - y + AXLE_SHARE_OF_LENGTH * length * sin
    min_cos = math.cos(BEHIND_RAD) if wide else math.cos(AHEAD_RAD)
    return cos * dx + sin * dy >= min_cos * math.hypot(dx, dy)


@njit(cache=True)
@no_type_check
def _first_overlap_s(states, valid, sizes, k, a, last, parameters, before_s):
    """The first sampled instant, earlier than `before_s`, at which the boxes overlap.

    Args:
        states: (ticks, agents, 4) of one episode; agent 0 is the ego.
        valid: (ticks, agents).
        sizes: (agents, 2).
        k: the tick from which time counts.
        a: slot of the other agent.
        last: the last tick of the episode.
        parameters: `_Parameters`.
        before_s: seconds; later instants are not tested.

    Returns:
        Seconds from tick `k`, infinity without an overlap.
    """
    x, y, heading, speed = states[k, 0, 0], states[k, 0, 1], states[k, 0, 2], states[k, 0, 3]
    vx, vy = speed * math.cos(heading), speed * math.sin(heading)
    x_o, y_o, heading_o = states[k, a, 0], states[k, a, 1], states[k, a, 2]
    vx_o, vy_o = states[k, a, 3] * math.cos(heading_o), states[k, a, 3] * math.sin(heading_o)
    x_t, y_t, heading_t = x_o, y_o, heading_o
    for n in range(1, parameters.num_steps + 1):
        t = n * parameters.step_s
        if t >= before_s:
            break
        if parameters.recorded:
            i = int(t / parameters.dt_s + 1e-6)
            share = max(t / parameters.dt_s - i, 0.0)
            j = i + 1 if share > 1e-6 else i
            if k + j > last:
                break
            if not (valid[k + i, a] and valid[k + j, a]):
                continue
            before, after = states[k + i, a], states[k + j, a]
            x_t = before[0] + share * (after[0] - before[0])
            y_t = before[1] + share * (after[1] - before[1])
            turn = after[2] - before[2]
            turn -= 2 * math.pi * math.floor(turn / (2 * math.pi) + 0.5)
            heading_t = before[2] + share * turn
        else:
            x_t, y_t = x_o + t * vx_o, y_o + t * vy_o
        if overlaps(
            x + t * vx, y + t * vy, heading, sizes[0, 0], sizes[0, 1],
            x_t, y_t, heading_t, sizes[a, 0], sizes[a, 1],
        ):  # fmt: skip
            return t
    return np.inf
