"""The keyboard mapping of `gymnasium.utils.play`."""

import itertools

import numpy as np
from jaxtyping import Float

KEYS: dict[str | int, tuple[float, float]] = {
    **{"w": (0.4, 0.0), "s": (-0.8, 0.0), "a": (0.0, 0.2), "d": (0.0, -0.2)},
    **{1073741906: (0.4, 0.0), 1073741905: (-0.8, 0.0)},
    **{1073741904: (0.0, 0.2), 1073741903: (0.0, -0.2)},
}
"""Acceleration and steering of each key, in [-1, 1]: letters, and SDL's key codes of the arrows up,
down, left and right. Chosen by hand: 2 m/s², -4 m/s² and 9° can be driven with keys that are either
pressed or not."""


def keyboard_actions() -> dict[str | tuple[str | int, ...], Float[np.ndarray, " 2"]]:
    """Returns the action (2,) of every combination of keys.

    The action is the sum of those of the keys, at most those of one key in each direction. The
    empty text is the combination of no key: `play` does not accept an empty tuple, and would pass
    its default `noop=0`, which is no action of this environment.
    """
    actions: dict[str | tuple[str | int, ...], Float[np.ndarray, " 2"]] = {}
    for count in range(len(KEYS) + 1):
        for keys in itertools.combinations(KEYS, count):
            pressed = {KEYS[key] for key in keys}
            actions[keys or ""] = np.array(
                [sum(each[0] for each in pressed), sum(each[1] for each in pressed)],
                dtype=np.float32,
            )
    return actions
