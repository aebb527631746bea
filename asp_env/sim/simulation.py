"""A world and the drivers of its traffic, stepped together by what the egos do."""

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.recording import Recording
from asp_env.data.scenarios.scenario import Scenario
from asp_env.data.scene import EGO
from asp_env.sim.traffic import Driver
from asp_env.sim.world import Ending, Events, ReplayWorld, World

OFF_ROAD_END_M = 2.0
"""An episode ends this far outside the drivable area; less may be a gap in the map."""

GOAL_TOLERANCE_M = 0.01


class Simulation:
    """B episodes in which slot 0 is the caller's and everybody else has the same driver."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        driver: Driver,
        *,
        num_episodes: int,
        dt_s: float,
        history: int,
        kind: type[World] = ReplayWorld,
    ) -> None:
        """Episodes begin with `reset`.

        Args:
            recordings: of the scenarios to come.
            driver: of the traffic.
            num_episodes: B.
            dt_s: length of a tick.
            history: past ticks that scenes show.
            kind: of the world, see `asp_env.sim.world.world_of`.
        """
        self.world = kind(recordings, num_episodes=num_episodes, dt_s=dt_s, history=history)
        self.driver = driver

    def reset(
        self,
        scenarios: Sequence[Scenario],
        rngs: Sequence[np.random.Generator],
        reset_mask: Bool[np.ndarray, " b"] | None = None,
    ) -> None:
        """Starts the episodes at `reset_mask`, by default all."""
        chosen = np.ones(len(self.world), dtype=bool) if reset_mask is None else reset_mask
        self.world.reset(scenarios, rngs, chosen)
        self.driver.reset(self.world, chosen)

    def step(
        self, ego_actions: Float[np.ndarray, "b 2"], ego_driven: Bool[np.ndarray, " b"]
    ) -> None:
        """One tick. Egos that are not driven are the world's: they replay, or drive themselves."""
        control = self.driver.control(self.world)
        actions, driven = control.actions.copy(), control.driven.copy()
        actions[:, EGO], driven[:, EGO] = ego_actions, ego_driven
        self.world.step(actions, driven, control.leaving)

    def step_agents(
        self, actions: Float[np.ndarray, "b a 2"], driven: Bool[np.ndarray, "b a"]
    ) -> None:
        """One tick in which the caller drives any agents; the traffic's driver moves the others.

        The ego is never the traffic's: one that is not driven is the world's.
        """
        control = self.driver.control(self.world)
        theirs = control.driven & ~driven
        theirs[:, EGO] = False
        self.world.step(
            np.where(driven[..., None], actions, control.actions),
            driven | theirs,
            control.leaving & ~driven,
        )

    def snapshot(self) -> tuple[Any, Driver]:
        """The whole state, the driver's memory included, to be handed to `restore`."""
        return self.world.snapshot(), copy.deepcopy(self.driver)

    def restore(self, snapshot: tuple[Any, Driver]) -> None:
        """Goes back to a snapshot, bit for bit."""
        world, driver = snapshot
        self.world.restore(world)
        self.driver = copy.deepcopy(driver)


def ending(events: Events) -> Int[np.ndarray, " b"]:
    """`Ending` of each episode; of several that hold, the first in the enumeration's order."""
    out = np.full(len(events.elapsed), int(Ending.RUNNING), dtype=np.int64)
    holds = (
        (Ending.OUT_OF_DATA, events.elapsed >= events.length),
        (Ending.GOAL, events.route_m >= events.goal_m - GOAL_TOLERANCE_M),
        (Ending.OFF_ROAD, events.off_road_m > OFF_ROAD_END_M),
        (Ending.COLLISION, events.at_fault),
    )
    for kind, mask in holds:
        out[mask] = int(kind)
    return out
