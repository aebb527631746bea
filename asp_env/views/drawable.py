"""What a view reads of a scene."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.road_map import RoadMap


@runtime_checkable
class Drawable(Protocol):
    """The fields of a `Scene` that views read, with its meaning and shapes; a `Scene` is one."""

    @property
    def states(self) -> Float[np.ndarray, "b a ticks 4"]:
        """[x m, y m, heading rad, speed m/s]; the last tick is now."""
        ...

    @property
    def valid(self) -> Bool[np.ndarray, "b a ticks"]:
        """Who is there at which tick."""
        ...

    @property
    def sizes(self) -> Float[np.ndarray, "b a 2"]:
        """Length and width, metres; of who was never there anything."""
        ...

    @property
    def classes(self) -> Int[np.ndarray, "b a"]:
        """`AgentClass`; of who was never there anything."""
        ...

    @property
    def ids(self) -> Int[np.ndarray, "b a"]:
        """Of who was never there anything."""
        ...

    @property
    def targets(self) -> Int[np.ndarray, "t 2"]:
        """(situation, slot) of those who see."""
        ...

    @property
    def maps(self) -> tuple[RoadMap, ...]:
        """Where the situations lie."""
        ...

    @property
    def map_index(self) -> Int[np.ndarray, " b"]:
        """Which of `maps` each situation lies on."""
        ...

    @property
    def history(self) -> int:
        """Past ticks."""
        ...
