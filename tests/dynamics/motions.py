"""Generated states and actions for the laws of the bicycle model."""

from dataclasses import dataclass

import hypothesis.strategies as st
import numpy as np
from hypothesis.extra.numpy import arrays
from hypothesis.strategies import DrawFn, SearchStrategy
from jaxtyping import Float

ROWS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """States of some vehicles and their actions for one tick."""

    states: Float[np.ndarray, "n 4"]
    actions: Float[np.ndarray, "n 2"]
    lengths_m: Float[np.ndarray, " n"]
    dt_s: float


def between(low: float, high: float, *shape: int) -> SearchStrategy[np.ndarray]:
    """Arrays of numbers in [low, high]."""
    return arrays(np.float64, shape, elements=st.floats(low, high, allow_subnormal=False))


@st.composite
def motions(draw: DrawFn, *, forwards: bool = False) -> Motion:
    """Vehicles of 3.5 to 18 m that move at 1.5 to 28 m/s, half of them backwards.

    In a tick of at most 0.2 s none becomes slower than 0.5 m/s or turns by half a circle.
    """
    speeds = draw(between(1.5, 28, ROWS))
    if not forwards:
        speeds *= np.resize([1.0, -1.0], ROWS)
    headings = draw(between(-np.pi, np.pi, ROWS))
    xy = draw(between(-500, 500, ROWS, 2))
    steering = draw(between(-np.pi / 4, np.pi / 4, ROWS))
    return Motion(
        states=np.column_stack([xy, headings, speeds]),
        actions=np.column_stack([draw(between(-5, 5, ROWS)), steering]),
        lengths_m=draw(between(3.5, 18, ROWS)),
        dt_s=draw(st.sampled_from([0.04, 0.1, 0.2])),
    )


@st.composite
def extremes(draw: DrawFn) -> Motion:
    """Finite numbers up to a million, with zeros, full turns and steering beyond all limits."""
    special = st.sampled_from([0.0, -0.0, 1e-300, np.pi, -np.pi, np.pi / 2, 2 * np.pi, 0.5, 1e6])
    element = st.one_of(special, st.floats(-1e6, 1e6))
    return Motion(
        states=draw(arrays(np.float64, (ROWS, 4), elements=element)),
        actions=draw(arrays(np.float64, (ROWS, 2), elements=element)),
        lengths_m=draw(between(0.1, 100, ROWS)),
        dt_s=draw(st.sampled_from([0.001, 0.04, 0.2, 2.0])),
    )


def apart(states: np.ndarray, others: np.ndarray) -> float:
    """Largest difference between states; of headings, the chord of the angle between them."""
    delta = np.abs(states - others)
    turned = others[..., 2] - states[..., 2]
    delta[..., 2] = np.hypot(np.cos(turned) - 1, np.sin(turned))
    return float(delta.max(initial=0.0))
