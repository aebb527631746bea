"""Memory for observations that is used again once nobody holds it."""

import sys

import numpy as np

from asp_env.sim.observation import Observation, Observer


def _references(held: list[Observation], number: int, name: str) -> int:
    """How many references there are to one array, this function's own among them."""
    return sys.getrefcount(held[number][name])


class Buffers:
    """Hands out arrays for observations; none again while anybody else holds it or a part of it.

    Fresh memory of large pictures costs as much time as drawing them, since the system has to find
    and clear it page by page. NumPy arrays and tensors that share an array's memory keep a
    reference to it, so an array that has no reference but this object's own is free.
    """

    _KEPT = 3
    """The caller often still holds the last observations while it asks for the next."""

    def __init__(self, observer: Observer, count: int) -> None:
        """Of that many observations each."""
        self._observer = observer
        self._count = count
        self._held: list[Observation] = []
        self._alone = _references([{"": np.empty(0)}], 0, "")

    def take(self) -> Observation:
        """Arrays whose content does not matter; the caller owns them while it holds them."""
        for number, arrays in enumerate(self._held):
            if all(_references(self._held, number, name) == self._alone for name in arrays):
                self._held.append(self._held.pop(number))
                return dict(arrays)
        fresh = self._observer.memory(self._count)
        self._held.append(fresh)
        del self._held[: -self._KEPT]
        return dict(fresh)
