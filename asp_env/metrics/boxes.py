"""Oriented boxes against each other, compiled: contacts of the ego, and overlaps of forecasts."""

import math
from enum import IntEnum
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.compiled import njit
from asp_env.data.classes import AgentClass
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.geometry import overlaps, turned_overlaps

AT_REST_MPS = 0.05
"""Vehicles up to this speed count as stopped (nuPlan)."""

BEHIND_RAD = math.radians(150.0)
"""Agents over this angle off the ego's heading, seen from its rear axle, are behind it (nuPlan)."""


class Contact(IntEnum):
    """How the ego's box meets that of another agent: the first kind that applies, as in nuPlan.

    `REAR` is a contact with an agent behind the ego (`is_behind`), `FRONT` one with a box that
    reaches the line of the ego's front bumper, `SIDE` any other contact.
    """

    NONE = 0
    EGO_STANDS = 1
    OTHER_STANDS = 2
    REAR = 3
    FRONT = 4
    SIDE = 5


AT_FAULT = (Contact.OTHER_STANDS, Contact.FRONT, Contact.SIDE)
"""Contacts that may be the ego's fault. A side contact is in nuPlan its fault only while the ego is
in several lanes or off the road; the rules decide this (`Rules.any_side_is_fault`)."""

TOWING_CLASSES = (
    *(AgentClass.CAR, AgentClass.VAN, AgentClass.TRUCK),
    *(AgentClass.BUS, AgentClass.TRUCK_BUS),
)
"""Classes of agents that may tow a trailer."""


def ego_contacts(
    states: Float[np.ndarray, "b a 4"],
    sizes: Float[np.ndarray, "b a 2"],
    valid: Bool[np.ndarray, "b a"],
    previous: Int[np.ndarray, "b a"] | None = None,
) -> Int[np.ndarray, "b a"]:
    """The contact of the ego (slot 0) with every other agent, in nuPlan's collision classes.

    A lasting contact retains the class with which it began, since that decides whose fault it is
    (nuPlan).

    Args:
        states: [x m, y m, heading rad, speed m/s] of B situations with A agents.
        sizes: length and width, metres.
        valid: agents that are present.
        previous: contacts one tick earlier; all contacts begin now if it is omitted.

    Returns:
        (b, a) int8 of `Contact`.
    """
    out = np.zeros(valid.shape, dtype=np.int8)
    _write_contacts(states, sizes, valid, out if previous is None else previous, out)
    return out


def touching_trailers(
    states: Float[np.ndarray, "b a 4"],
    sizes: Float[np.ndarray, "b a 2"],
    classes: Int[np.ndarray, "b a"],
    valid: Bool[np.ndarray, "b a"],
) -> Bool[np.ndarray, "b a"]:
    """Mask of trailers whose box overlaps that of the ego (slot 0), if its class may tow one.

    Args:
        states: [x m, y m, heading rad, speed m/s].
        sizes: length and width, metres.
        classes: `AgentClass`.
        valid: agents that are present.
    """
    trailers = (classes == AgentClass.TRAILER) & np.isin(classes[:, :1], TOWING_CLASSES)
    return trailers & (ego_contacts(states, sizes, valid) > 0)


def overlapping_paths(
    paths: Float[np.ndarray, "n paths t 4"],
    sizes: Float[np.ndarray, "n 2"],
    situation: Int[np.ndarray, " n"],
    slot: Int[np.ndarray, " n"],
    tracks: Float[np.ndarray, "b a t 4"],
    valid: Bool[np.ndarray, "b a t"],
    track_sizes: Float[np.ndarray, "b a 2"],
) -> Bool[np.ndarray, "n paths-1"]:
    """Which paths of a target, except the first, ever overlap a track of its situation.

    Boxes are compared tick by tick. The track of the target itself is left out, and so is every
    track that overlaps the target's first path, the ground truth.

    Args:
        paths: states of N targets, of which the first path is the ground truth.
        sizes: length and width of the targets, metres.
        situation: index of each target's situation.
        slot: index of each target's own track in its situation, or -1.
        tracks: recorded states of all agents of B situations.
        valid: ticks at which each track is recorded.
        track_sizes: length and width of the recorded agents, metres.

    Returns:
        (n, paths - 1) mask.
    """
    out = np.zeros((len(paths), paths.shape[1] - 1), dtype=bool)
    _write_overlapping_paths(paths, sizes, situation, slot, tracks, valid, track_sizes, out)
    return out


@njit(cache=True)
@no_type_check
def is_behind(x, y, heading, length, x_o, y_o):
    """Whether a point lies over 150° off a vehicle's heading, seen from its rear axle (nuPlan).

    Args:
        x: centre of the vehicle, metres.
        y: centre of the vehicle, metres.
        heading: of the vehicle, rad.
        length: of the vehicle, metres.
        x_o: the point, usually the centre of another agent, metres.
        y_o: the point, metres.
    """
    cos, sin = math.cos(heading), math.sin(heading)
    dx = x_o - x + AXLE_SHARE_OF_LENGTH * length * cos
    dy = y_o - y + AXLE_SHARE_OF_LENGTH * length * sin
    return cos * dx + sin * dy < math.cos(BEHIND_RAD) * math.hypot(dx, dy)


@njit(cache=True)
@no_type_check
def _contact_kind(
    x, y, heading, speed, length, width, x_o, y_o, heading_o, speed_o, length_o, width_o
):
    """The `Contact` of two overlapping boxes: the ego's, then (`_o`) the other agent's.

    Each is given by its centre (m), heading (rad), speed (m/s), length and width (m).
    """
    if abs(speed) <= AT_REST_MPS:
        return Contact.EGO_STANDS.value
    if abs(speed_o) <= AT_REST_MPS:
        return Contact.OTHER_STANDS.value
    if is_behind(x, y, heading, length, x_o, y_o):
        return Contact.REAR.value
    x_f, y_f = x + 0.5 * length * math.cos(heading), y + 0.5 * length * math.sin(heading)
    # the bumper is a box of length 0
    if overlaps(x_f, y_f, heading, 0.0, width, x_o, y_o, heading_o, length_o, width_o):
        return Contact.FRONT.value
    return Contact.SIDE.value


@njit(cache=True)
@no_type_check
def _write_contacts(states, sizes, valid, previous, out):
    """Writes the contacts of the ego.

    Args:
        states: (situations, agents, 4).
        sizes: (situations, agents, 2).
        valid: (situations, agents).
        previous: (situations, agents) contacts one tick earlier; may be `out` itself.
        out: (situations, agents) int8, written.
    """
    for b in range(states.shape[0]):
        x, y, heading, speed = states[b, 0, 0], states[b, 0, 1], states[b, 0, 2], states[b, 0, 3]
        length, width = sizes[b, 0, 0], sizes[b, 0, 1]
        cos, sin, half_extent = math.cos(heading), math.sin(heading), 0.5 * (length + width)
        for a in range(states.shape[1]):
            kind, out[b, a] = previous[b, a], 0
            if a == 0 or not (valid[b, 0] and valid[b, a]):
                continue
            x_o, y_o = states[b, a, 0], states[b, a, 1]
            dx, dy = x_o - x, y_o - y
            # distant agents need no square root: a box extends at most half the sum of its sides
            length_o, width_o = sizes[b, a, 0], sizes[b, a, 1]
            reach = half_extent + 0.5 * (length_o + width_o)
            if dx * dx + dy * dy >= reach * reach:
                continue
            heading_o, speed_o = states[b, a, 2], states[b, a, 3]
            cos_o, sin_o = math.cos(heading_o), math.sin(heading_o)
            if not turned_overlaps(
                x, y, cos, sin, length, width, x_o, y_o, cos_o, sin_o, length_o, width_o
            ):
                continue
            out[b, a] = kind
            if kind == 0:
                out[b, a] = _contact_kind(
                    *(x, y, heading, speed, length, width),
                    *(x_o, y_o, heading_o, speed_o, length_o, width_o),
                )


@njit(cache=True, nogil=True)
@no_type_check
def _tracks_overlap(path, size, track, valid, track_size):
    """Whether two boxes along paths (ticks, 4) overlap at any valid tick."""
    for t in range(len(path)):
        if valid[t] and overlaps(
            path[t, 0], path[t, 1], path[t, 2], size[0], size[1],
            track[t, 0], track[t, 1], track[t, 2], track_size[0], track_size[1],
        ):  # fmt: skip
            return True
    return False


@njit(cache=True, nogil=True)
@no_type_check
def _write_overlapping_paths(paths, sizes, situation, slot, tracks, valid, track_sizes, out):
    """Writes `out` (n, paths - 1), which is false before; other arguments: `overlapping_paths`."""
    for n in range(len(paths)):
        b, size = situation[n], sizes[n]
        for a in range(tracks.shape[1]):
            track, present, track_size = tracks[b, a], valid[b, a], track_sizes[b, a]
            if a == slot[n] or _tracks_overlap(paths[n, 0], size, track, present, track_size):
                continue
            for m in range(out.shape[1]):
                if not out[n, m]:
                    out[n, m] = _tracks_overlap(paths[n, m + 1], size, track, present, track_size)
