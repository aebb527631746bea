"""Oriented boxes against each other, compiled: contacts of the ego, and of forecasts."""

import math
from enum import IntEnum
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from asp_env.data.classes import AgentClass
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.geometry import overlaps, turned_overlaps

AT_REST_MPS = 0.05
"""At or below this speed nuPlan calls a vehicle stopped."""

BEHIND_RAD = math.radians(150.0)
"""Beyond this angle to the ego's heading, seen from its rear axle, somebody is behind it."""


class Contact(IntEnum):
    """How the ego's box meets another one; of several that hold, the first, as in nuPlan.

    `REAR` is a contact with somebody behind (`is_behind`), `FRONT` one that reaches the line of the
    ego's front bumper, `SIDE` any other.
    """

    NONE = 0
    EGO_STANDS = 1
    OTHER_STANDS = 2
    REAR = 3
    FRONT = 4
    SIDE = 5


AT_FAULT = (Contact.OTHER_STANDS, Contact.FRONT, Contact.SIDE)
"""Contacts the ego may answer for. By nuPlan's rule a side contact is its fault only while it is in
several lanes or off the road; that is for a preset to say."""

TOWING_CLASSES = (
    *(AgentClass.CAR, AgentClass.VAN, AgentClass.TRUCK),
    *(AgentClass.BUS, AgentClass.TRUCK_BUS),
)
"""Classes that may have a trailer of their own."""


@njit(cache=True)
@no_type_check
def is_behind(x, y, heading, length, x_o, y_o):
    """Whether a centre lies over 150° off a vehicle's heading, seen from its rear axle (nuPlan)."""
    cos, sin = math.cos(heading), math.sin(heading)
    dx = x_o - x + AXLE_SHARE_OF_LENGTH * length * cos
    dy = y_o - y + AXLE_SHARE_OF_LENGTH * length * sin
    return cos * dx + sin * dy < math.cos(BEHIND_RAD) * math.hypot(dx, dy)


@njit(cache=True)
@no_type_check
def _kind(x, y, heading, speed, length, width, x_o, y_o, heading_o, speed_o, length_o, width_o):
    """The `Contact` of two boxes that overlap."""
    if abs(speed) <= AT_REST_MPS:
        return Contact.EGO_STANDS.value
    if abs(speed_o) <= AT_REST_MPS:
        return Contact.OTHER_STANDS.value
    if is_behind(x, y, heading, length, x_o, y_o):
        return Contact.REAR.value
    x_f, y_f = x + 0.5 * length * math.cos(heading), y + 0.5 * length * math.sin(heading)
    # a bumper is a box without depth
    if overlaps(x_f, y_f, heading, 0.0, width, x_o, y_o, heading_o, length_o, width_o):
        return Contact.FRONT.value
    return Contact.SIDE.value


@njit(cache=True)
@no_type_check
def _contacts(states, sizes, valid, before, out):
    for b in range(states.shape[0]):
        x, y, heading, speed = states[b, 0, 0], states[b, 0, 1], states[b, 0, 2], states[b, 0, 3]
        length, width = sizes[b, 0, 0], sizes[b, 0, 1]
        cos, sin, around = math.cos(heading), math.sin(heading), 0.5 * (length + width)
        for a in range(states.shape[1]):
            known, out[b, a] = before[b, a], 0
            if a == 0 or not (valid[b, 0] and valid[b, a]):
                continue
            x_o, y_o = states[b, a, 0], states[b, a, 1]
            dx, dy = x_o - x, y_o - y
            # no root for the many far away: two boxes reach no further than half their sides' sum
            length_o, width_o = sizes[b, a, 0], sizes[b, a, 1]
            reach = around + 0.5 * (length_o + width_o)
            if dx * dx + dy * dy >= reach * reach:
                continue
            heading_o, speed_o = states[b, a, 2], states[b, a, 3]
            cos_o, sin_o = math.cos(heading_o), math.sin(heading_o)
            if not turned_overlaps(
                x, y, cos, sin, length, width, x_o, y_o, cos_o, sin_o, length_o, width_o
            ):
                continue
            out[b, a] = known
            if known == 0:
                out[b, a] = _kind(
                    *(x, y, heading, speed, length, width),
                    *(x_o, y_o, heading_o, speed_o, length_o, width_o),
                )


def ego_contacts(
    states: Float[np.ndarray, "b a 4"],
    sizes: Float[np.ndarray, "b a 2"],
    valid: Bool[np.ndarray, "b a"],
    before: Int[np.ndarray, "b a"] | None = None,
) -> Int[np.ndarray, "b a"]:
    """`Contact` of the ego (slot 0) with every other agent; nuPlan's collision classes.

    One that lasts keeps the class that it had `before`, a tick ago: as in nuPlan, whose fault it is
    shows when it begins. Without `before` all begin now.
    """
    out = np.zeros(valid.shape, dtype=np.int8)
    _contacts(states, sizes, valid, out if before is None else before, out)
    return out


def touching_trailers(
    states: Float[np.ndarray, "b a 4"],
    sizes: Float[np.ndarray, "b a 2"],
    classes: Int[np.ndarray, "b a"],
    valid: Bool[np.ndarray, "b a"],
) -> Bool[np.ndarray, "b a"]:
    """Trailers whose box overlaps that of the ego (slot 0), if the ego's class may tow one."""
    trailers = (classes == AgentClass.TRAILER) & np.isin(classes[:, :1], TOWING_CLASSES)
    return trailers & (ego_contacts(states, sizes, valid) > 0)


@njit(cache=True, nogil=True)
@no_type_check
def _meets(path, size, track, valid, size_o):
    for t in range(len(path)):
        if valid[t] and overlaps(
            path[t, 0], path[t, 1], path[t, 2], size[0], size[1],
            track[t, 0], track[t, 1], track[t, 2], size_o[0], size_o[1],
        ):  # fmt: skip
            return True
    return False


@njit(cache=True, nogil=True)
@no_type_check
def _modes_meet(paths, sizes, situation, slot, others, valid, other_sizes, out):
    for n in range(len(paths)):
        b, size = situation[n], sizes[n]
        for a in range(others.shape[1]):
            track, there, size_o = others[b, a], valid[b, a], other_sizes[b, a]
            if a == slot[n] or _meets(paths[n, 0], size, track, there, size_o):
                continue
            for m in range(out.shape[1]):
                if not out[n, m]:
                    out[n, m] = _meets(paths[n, m + 1], size, track, there, size_o)


def overlapping_paths(
    paths: Float[np.ndarray, "n paths t 4"],
    sizes: Float[np.ndarray, "n 2"],
    situation: Int[np.ndarray, " n"],
    slot: Int[np.ndarray, " n"],
    others: Float[np.ndarray, "b a t 4"],
    valid: Bool[np.ndarray, "b a t"],
    other_sizes: Float[np.ndarray, "b a 2"],
) -> Bool[np.ndarray, "n paths-1"]:
    """(n, paths - 1) which paths but the first ever meet anybody of the situation at that tick.

    The slot of each target is left out, and whoever meets its first path, which is the truth.
    """
    out = np.zeros((len(paths), paths.shape[1] - 1), dtype=bool)
    _modes_meet(paths, sizes, situation, slot, others, valid, other_sizes, out)
    return out
