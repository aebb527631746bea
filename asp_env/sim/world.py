"""The socket for worlds: B episodes at once, on arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.scenario import Scenario
from asp_env.data.scene import Scene
from asp_env.metrics.boxes import AT_FAULT

EGO = 0
"""The slot of the ego."""


class Ending(IntEnum):
    """Why an episode is over."""

    RUNNING = 0
    COLLISION = 1
    OFF_ROAD = 2
    GOAL = 3
    OUT_OF_DATA = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Events:
    """What holds now in each of B episodes."""

    contacts: Int[np.ndarray, "b a"]
    """`Contact` of the ego with each agent; one that lasts keeps the class of its first tick.

    With a trailer that touches the ego at the first tick, its own, there is none.
    """
    off_road_m: Float[np.ndarray, " b"]
    """How far the ego's outermost corner lies outside the drivable area."""
    route_m: Float[np.ndarray, " b"]
    """The ego's arc length along its route, which starts at its first position."""
    route_offset_m: Float[np.ndarray, " b"]
    """How far left of its route the ego is."""
    route_heading_rad: Float[np.ndarray, " b"]
    """The route's heading there."""
    goal_m: Float[np.ndarray, " b"]
    """The arc length that the logged ego reached at the end of the scenario."""
    elapsed: Int[np.ndarray, " b"]
    """Ticks since the first observation."""
    length: Int[np.ndarray, " b"]
    """Ticks that the recording provides."""

    @property
    def collision(self) -> Bool[np.ndarray, " b"]:
        """Whether the ego touches anybody."""
        return np.asarray((self.contacts > 0).any(axis=1))

    @property
    def at_fault(self) -> Bool[np.ndarray, " b"]:
        """Whether the ego touches somebody in a way that it answers for."""
        return np.asarray(np.isin(self.contacts, [int(kind) for kind in AT_FAULT]).any(axis=1))


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
        """One tick: `driven` agents obey their actions, `leaving` ones vanish, the rest replay."""
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
