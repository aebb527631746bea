"""Traffic signals: their stop lines and their states over time.

A recording has signals if its files contain them (`Recording.signals`). A scene shows their states
up to now (`Scene.signals`). What is not known is `UNKNOWN`, never guessed.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from asp_env.errors import DataError


class SignalState(IntEnum):
    """What a signal shows to the traffic at its stop line."""

    UNKNOWN = 0
    """Not recorded, or switched off."""
    RED = 1
    """Also red and amber together: traffic must wait."""
    AMBER = 2
    GREEN = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Signals:
    """The traffic signals of one recording. A signal belongs to one stop line.

    Signals that several lanes share are one signal with one line across these lanes.
    """

    stop_lines: Float[np.ndarray, "lines 2 2"]
    """End points of each stop line, [x m, y m] in the recording's frame; NaN where the files do not
    contain them. Scenes show signals with known stop lines only."""
    states: Int8[np.ndarray, "signals frames"]
    """`SignalState` of each signal at each frame of the recording."""

    def __post_init__(self) -> None:
        """Checks the stop lines and the states.

        Raises:
            DataError: their numbers differ, or a value is not possible.
        """
        if len(self.stop_lines) != len(self.states):
            raise DataError(
                f"{len(self.stop_lines)} stop lines but the states of {len(self.states)} signals: "
                "give one line for each signal"
            )
        unknown = np.isnan(self.stop_lines).all(axis=(1, 2), keepdims=True)
        if not (np.isfinite(self.stop_lines) | unknown).all():
            raise DataError(
                "stop lines of signals: expected finite positions in metres, or NaN for all"
            )
        if not np.isin(self.states, list(SignalState)).all():
            raise DataError(
                "states of signals: expected "
                + ", ".join(f"{state.value} ({state.name.lower()})" for state in SignalState)
            )

    @property
    def placed(self) -> Bool[np.ndarray, " signals"]:
        """Mask of the signals whose stop lines are known."""
        return np.asarray(np.isfinite(self.stop_lines).all(axis=(1, 2)))


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneSignals:
    """The signals of B situations, up to S each; missing ones have zeros and are `UNKNOWN`."""

    stop_lines: Float[np.ndarray, "b s 2 2"]
    """End points of each stop line, [x m, y m] in the recording's frame."""
    states: Int8[np.ndarray, "b s ticks"]
    """`SignalState` of each signal at the ticks of the scene; the last one is now."""

    def situation(self, index: int) -> "SceneSignals":
        """The signals of one of the situations, which becomes situation 0."""
        rows = slice(index, index + 1)
        return SceneSignals(stop_lines=self.stop_lines[rows], states=self.states[rows])

    def of_situations(self, rows: Int[np.ndarray, " n"]) -> "SceneSignals":
        """The signals of situations in another order; a situation may occur several times."""
        return SceneSignals(stop_lines=self.stop_lines[rows], states=self.states[rows])

    def before(self, ticks: int) -> "SceneSignals":
        """The signals as they were some ticks ago, with a history that much shorter."""
        return SceneSignals(stop_lines=self.stop_lines, states=self.states[..., :-ticks])
