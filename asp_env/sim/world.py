"""The socket for worlds: B episodes at once, on arrays."""

from collections.abc import Sequence
from enum import IntEnum
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.scenario import Scenario
from asp_env.data.scene import Scene
from asp_env.sim.events import Events

EGO = 0
"""The slot of the ego."""


class Ending(IntEnum):
    """Why an episode is over."""

    RUNNING = 0
    COLLISION = 1
    OFF_ROAD = 2
    GOAL = 3
    OUT_OF_DATA = 4


@runtime_checkable
class World(Protocol):
    """B episodes that are stepped together. Slot 0 of each is the ego."""

    dt_s: float

    def reset(
        self,
        scenarios: Sequence[Scenario],
        rngs: Sequence[np.random.Generator],
        where: Bool[np.ndarray, " b"] | None = None,
    ) -> None:
        """Starts the episodes at `where` (all by default); the others' entries are not read."""
        ...

    def step(
        self,
        actions: Float[np.ndarray, "b a 2"],
        driven: Bool[np.ndarray, "b a"],
        leaving: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """One tick: `driven` agents obey, `leaving` ones vanish, the world moves the rest."""
        ...

    def scene(self) -> Scene:
        """All that may be known now; targets are all present agents but the ego."""
        ...

    def events(self) -> Events:
        """What holds now."""
        ...

    def snapshot(self) -> Any:
        """The whole state, to be handed to `restore`."""
        ...

    def restore(self, snapshot: Any) -> None:
        """Goes back to a snapshot, bit for bit."""
        ...
