"""What is near every agent of a scene: clearances and times to whoever drives ahead, compiled."""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from asp_env.metrics.boxes import overlaps

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
def _look_around(states, valid, sizes, asked, clearance_m, ahead_s):
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


def look_around(
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
    _look_around(states, valid, sizes, asked, clearance_m, ahead_s)
    return clearance_m, ahead_s
