"""How near the ego of driven episodes comes to a collision: near misses and required deceleration.

Both are continuous counterparts of the contact, which is rare: two drives without a contact differ
in the distance and in the braking that would still have avoided one. The idea of counting near
misses in place of collisions is that of "What Truly Matters in Trajectory Prediction for Autonomous
Driving?" (Tran et al., NeurIPS 2023), whose buffer is 0.5 m on every side.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.compiled import njit
from asp_env.geometry import overlaps, wrap_angle
from asp_env.metrics.boxes import AT_FAULT, AT_REST_MPS, is_behind
from asp_env.metrics.driving.realism import clearance
from asp_env.metrics.driving.ttc import TtcRule, agent_counts, time_to_collision

NEAR_AHEAD_M = 0.5
"""A near miss extends the ego's box by this ahead (Tran et al., NeurIPS 2023), and in addition by
`NEAR_AHEAD_S` at its speed."""

NEAR_AHEAD_S = 0.2
"""Time at the ego's speed by which a near miss extends its box ahead. It balances overlaps ahead
against oncoming traffic in bends, which a longer extension would sweep. Chosen by hand."""

NEAR_SIDE_M = 0.3
"""A near miss extends the ego's box by this at each side. It is less than ahead, since vehicles
in adjacent lanes pass each other at as little as 0.2 m. Chosen by hand."""

MIN_CLOSING_MPS = 0.5
"""An agent within the margin is a near miss if the distance of the boxes decreases faster than
this, which is not so in parallel traffic, oncoming or not, nor in a queue. Chosen by hand."""

CLOSING_S = 0.1
"""Time at constant velocity over which the decrease is measured. Chosen by hand."""

BOUNDED_TTC = TtcRule(
    futures="constant-velocity",
    step_s=0.1,
    horizon_s=3.0,
    min_ttc_s=0.95,
    sector=True,
    ignore_after_contact=True,
    standing_mps=0.005,
)
"""The time to collision of the continuous measures, under all rules: that of nuPlan."""

MAX_BRAKING_MPS2 = 8.0
"""Required decelerations are clipped to this: full braking on a dry road. Chosen by hand."""

BRAKING_STEP_MPS2 = 0.5
"""Step of the tested decelerations; bisection follows. Chosen by hand."""

BISECTIONS = 6
"""Halvings of the step: the result is within 0.5 / 2⁶ = 0.008 m/s². Chosen by hand."""

MAX_CURVATURE_PER_M = 0.3
"""Curvatures are clipped to Waymax's bound, which measurement noise exceeds at low speed."""

MIN_CURVATURE_SPEED_MPS = 0.6
"""Below this speed the ego is taken to go straight on (Waymax has no curvature there either)."""


def near_misses(
    states: Float[np.ndarray, "b t a 4"],
    valid: Bool[np.ndarray, "b t a"],
    sizes: Float[np.ndarray, "b a 2"],
    *,
    ignored: Bool[np.ndarray, "b a"],
) -> Bool[np.ndarray, "b t"]:
    """Ticks at which an agent is within a margin of the ego's box (slot 0) and comes closer.

    The margin is 0.5 m and 0.2 s at the ego's speed ahead, 0.3 m at each side and nothing behind.
    The distance of the boxes must decrease by more than 0.5 m/s if both move at constant velocity,
    so that parallel traffic and queues do not count. As with contacts in nuPlan, agents behind the
    ego do not count, nor do any while the ego stands (0.05 m/s). Contacts are near misses as well.

    Args:
        states: [x m, y m, heading rad, speed m/s] of A agents in B episodes of up to T ticks.
        valid: ticks at which each agent is present.
        sizes: length and width, metres.
        ignored: agents that never count, such as the ego's own trailer.

    Returns:
        (b, t) mask.
    """
    out = np.zeros(valid.shape[:2], dtype=bool)
    _write_near(states, valid, sizes, ignored, out)
    return out


def bounded_ttc_s(
    states: Float[np.ndarray, "b t a 4"],
    valid: Bool[np.ndarray, "b t a"],
    sizes: Float[np.ndarray, "b a 2"],
    *,
    contacts: Int[np.ndarray, "b t a"],
    ignored: Bool[np.ndarray, "b a"],
    wide_sector: Bool[np.ndarray, "b t"],
    num_ticks: Int[np.ndarray, " b"],
    dt_s: float,
) -> Float[np.ndarray, "b t"]:
    """Time to collision by `BOUNDED_TTC`; 0 during contacts that may be the ego's fault.

    Args:
        states: [x m, y m, heading rad, speed m/s] of A agents in B episodes of up to T ticks.
        valid: ticks at which each agent is present.
        sizes: length and width, metres.
        contacts: `Contact` of the ego with each agent.
        ignored: agents that never count, such as the ego's own trailer.
        wide_sector: ticks at which nuPlan's sector is wide.
        num_ticks: number of ticks of each episode.
        dt_s: seconds per tick.

    Returns:
        (b, t) seconds, at most 3; 3 where there is no overlap and after the end of an episode.
    """
    found = time_to_collision(
        states,
        valid,
        sizes,
        contacts=contacts,
        ignored=ignored,
        wide_sector=wide_sector,
        num_ticks=num_ticks,
        rule=BOUNDED_TTC,
        dt_s=dt_s,
    )
    hit = _contact_at_fault(contacts, num_ticks)
    return np.where(hit, 0.0, np.minimum(found, BOUNDED_TTC.horizon_s))


def required_deceleration(
    states: Float[np.ndarray, "b t a 4"],
    valid: Bool[np.ndarray, "b t a"],
    sizes: Float[np.ndarray, "b a 2"],
    *,
    contacts: Int[np.ndarray, "b t a"],
    ignored: Bool[np.ndarray, "b a"],
    wide_sector: Bool[np.ndarray, "b t"],
    num_ticks: Int[np.ndarray, " b"],
    dt_s: float,
) -> Float[np.ndarray, "b t"]:
    """The smallest constant braking of the ego (slot 0) that avoids every overlap, m/s².

    An overlap counts if it is due within 3 s with an agent that counts for `BOUNDED_TTC`, if the
    ego continues at its speed and curvature and the agent at constant velocity. Each requires the
    smallest braking under which the ego does not overlap the agent within 6 s, and the largest
    of these is the result. The time is twice that of the overlap, since braking that just avoids a
    vehicle ahead, v² / (2 gap) for a standing one, takes 2 gap / v to end. An overlap that begins
    after the ego has stopped is not the ego's fault and does not count.

    Args:
        states: [x m, y m, heading rad, speed m/s] of A agents in B episodes of up to T ticks.
        valid: ticks at which each agent is present.
        sizes: length and width, metres.
        contacts: `Contact` of the ego with each agent.
        ignored: agents that never count, such as the ego's own trailer.
        wide_sector: ticks at which nuPlan's sector is wide.
        num_ticks: number of ticks of each episode; later ticks are ignored.
        dt_s: seconds per tick.

    Returns:
        (b, t) from 0 to `MAX_BRAKING_MPS2`, which is also the value where no braking suffices and
        during contacts that may be the ego's fault.
    """
    skipped = np.maximum.accumulate(contacts > 0, axis=1) | ignored[:, None]
    out = np.zeros(states.shape[:2])
    _write_required(
        states,
        valid,
        sizes,
        skipped,
        wide_sector,
        _curvature(states[:, :, 0], dt_s),
        num_ticks,
        _Trial(
            step_s=BOUNDED_TTC.step_s,
            steps=round(BOUNDED_TTC.horizon_s / BOUNDED_TTC.step_s),
            standing_mps=BOUNDED_TTC.standing_mps,
        ),
        out,
    )
    return np.where(_contact_at_fault(contacts, num_ticks), MAX_BRAKING_MPS2, out)


class _Trial(NamedTuple):
    """The instants at which boxes are compared, and which egos stand."""

    step_s: float
    steps: int
    """Number of steps within which a overlap counts; braking is tested over twice as many."""
    standing_mps: float
    """An ego up to this speed has no foreseeable overlap."""


def _contact_at_fault(
    contacts: Int[np.ndarray, "b t a"], num_ticks: Int[np.ndarray, " b"]
) -> Bool[np.ndarray, "b t"]:
    within = np.arange(contacts.shape[1]) < num_ticks[:, None]
    return np.isin(contacts, [int(kind) for kind in AT_FAULT]).any(axis=2) & within


def _curvature(egos: Float[np.ndarray, "b t 4"], dt_s: float) -> Float[np.ndarray, "b t"]:
    """Curvature 1/m of the motion from the previous tick to each, at the first tick to the next."""
    turned = wrap_angle(np.diff(egos[..., 2].astype(np.float64), axis=1))
    speed = 0.5 * (egos[:, 1:, 3] + egos[:, :-1, 3]).astype(np.float64)
    moves = np.abs(speed) >= MIN_CURVATURE_SPEED_MPS
    curvature = np.where(moves, turned / np.where(moves, speed * dt_s, 1.0), 0.0)
    curvature = np.clip(curvature, -MAX_CURVATURE_PER_M, MAX_CURVATURE_PER_M)
    out = np.zeros(egos.shape[:2])
    if egos.shape[1] > 1:
        out[:, 1:], out[:, 0] = curvature, curvature[:, 0]
    return out


@njit(cache=True)
@no_type_check
def _write_near(states, valid, sizes, ignored, out):
    """Writes `out` (episodes, ticks), which is false before; other arguments: `near_misses`."""
    for b in range(states.shape[0]):
        for k in range(states.shape[1]):
            if not valid[b, k, 0] or abs(states[b, k, 0, 3]) <= AT_REST_MPS:
                continue
            for a in range(1, states.shape[2]):
                if not valid[b, k, a] or ignored[b, a]:
                    continue
                if _is_near(states[b, k, 0], sizes[b, 0], states[b, k, a], sizes[b, a]):
                    out[b, k] = True
                    break


@njit(cache=True)
@no_type_check
def _is_near(ego, size, other, other_size):
    """Whether an agent is within the margin of the ego and comes closer; see `near_misses`.

    Args:
        ego: (4,) state.
        size: (2,) length and width, m.
        other: (4,) state of the other agent.
        other_size: (2,) its length and width, m.
    """
    x, y, heading, speed = ego[0], ego[1], ego[2], ego[3]
    x_o, y_o, heading_o, speed_o = other[0], other[1], other[2], other[3]
    length, width, length_o, width_o = size[0], size[1], other_size[0], other_size[1]
    cos, sin = math.cos(heading), math.sin(heading)
    ahead = NEAR_AHEAD_M + NEAR_AHEAD_S * max(speed, 0.0)
    if not overlaps(
        x + 0.5 * ahead * cos, y + 0.5 * ahead * sin, heading,
        length + ahead, width + 2.0 * NEAR_SIDE_M,
        x_o, y_o, heading_o, length_o, width_o,
    ) or is_behind(x, y, heading, length, x_o, y_o):  # fmt: skip
        return False
    now_m = clearance(x, y, heading, length, width, x_o, y_o, heading_o, length_o, width_o)
    if now_m <= 0.0:
        return True
    soon_m = clearance(
        x + CLOSING_S * speed * cos, y + CLOSING_S * speed * sin, heading, length, width,
        x_o + CLOSING_S * speed_o * math.cos(heading_o),
        y_o + CLOSING_S * speed_o * math.sin(heading_o),
        heading_o, length_o, width_o,
    )  # fmt: skip
    return now_m - soon_m > MIN_CLOSING_MPS * CLOSING_S


@njit(cache=True)
@no_type_check
def _write_required(states, valid, sizes, skipped, wide_sector, curvature, num_ticks, trial, out):
    """Writes required decelerations.

    Args:
        states: (episodes, ticks, agents, 4).
        valid: (episodes, ticks, agents).
        sizes: (episodes, agents, 2).
        skipped: (episodes, ticks, agents) agents that do not count.
        wide_sector: (episodes, ticks).
        curvature: (episodes, ticks) of the egos, 1/m.
        num_ticks: (episodes,).
        trial: `_Trial`.
        out: (episodes, ticks) zero, written.
    """
    for b in range(states.shape[0]):
        size = sizes[b, 0]
        for k in range(num_ticks[b]):
            ego = states[b, k, 0]
            if not valid[b, k, 0] or abs(ego[3]) <= trial.standing_mps:
                continue
            for a in range(1, states.shape[2]):
                if not valid[b, k, a] or skipped[b, k, a]:
                    continue
                other = states[b, k, a]
                if agent_counts(
                    ego[0], ego[1], ego[2], size[0], other[0], other[1], True, wide_sector[b, k]
                ):
                    braking = _smallest_braking(
                        ego, size, curvature[b, k], other, sizes[b, a], trial
                    )
                    out[b, k] = max(out[b, k], braking)


@njit(cache=True)
@no_type_check
def _smallest_braking(ego, size, curvature, other, other_size, trial):
    """The smallest braking m/s² that avoids one agent; 0 without a foreseeable overlap.

    Args:
        ego: (4,) state.
        size: (2,) length and width, m.
        curvature: of the ego's path, 1/m.
        other: (4,) state of the other agent.
        other_size: (2,) its length and width, m.
        trial: `_Trial`.
    """
    step_s, steps = trial.step_s, trial.steps
    if not _collides(ego, size, curvature, 0.0, other, other_size, step_s, steps):
        return 0.0
    low, high, clear = 0.0, 0.0, False
    while not clear and high < MAX_BRAKING_MPS2:
        low, high = high, high + BRAKING_STEP_MPS2
        clear = not _collides(ego, size, curvature, high, other, other_size, step_s, 2 * steps)
    if not clear:
        return MAX_BRAKING_MPS2
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if _collides(ego, size, curvature, middle, other, other_size, step_s, 2 * steps):
            low = middle
        else:
            high = middle
    return high


@njit(cache=True)
@no_type_check
def _collides(ego, size, curvature, braking, other, other_size, step_s, steps):
    """Whether the boxes overlap before the ego has stopped.

    Args:
        ego: (4,) state.
        size: (2,) length and width, m.
        curvature: of the ego's path, 1/m.
        braking: of the ego, m/s².
        other: (4,) state of the other agent, which moves at constant velocity.
        other_size: (2,) its length and width, m.
        step_s: seconds between the compared instants.
        steps: number of instants.
    """
    x, y, heading, speed = ego[0], ego[1], ego[2], abs(ego[3])
    direction = 1.0 if ego[3] >= 0.0 else -1.0
    vx, vy = other[3] * math.cos(other[2]), other[3] * math.sin(other[2])
    stop_s = speed / braking if braking > 0.0 else np.inf
    for n in range(1, steps + 1):
        t = n * step_s
        if t - step_s >= stop_s:
            return False
        s = direction * (speed * t - 0.5 * braking * t * t if t < stop_s else 0.5 * speed * stop_s)
        turned = heading + curvature * s
        if abs(curvature) < 1e-6:
            x_t, y_t = x + s * math.cos(heading), y + s * math.sin(heading)
        else:
            x_t = x + (math.sin(turned) - math.sin(heading)) / curvature
            y_t = y - (math.cos(turned) - math.cos(heading)) / curvature
        if overlaps(
            x_t, y_t, turned, size[0], size[1],
            other[0] + t * vx, other[1] + t * vy, other[2], other_size[0], other_size[1],
        ):  # fmt: skip
            return True
    return False
