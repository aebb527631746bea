"""A world and the drivers of its traffic, stepped together."""

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.recording import Recording
from asp_env.data.scenarios.scenario import Scenario
from asp_env.data.scene import EGO
from asp_env.sim.traffic.driver import Driver
from asp_env.sim.world import Ending, Events, ReplayWorld, World

OFF_ROAD_END_M = 2.0
"""An episode ends this far outside the drivable area. Chosen by hand: smaller distances may be a
gap in the map."""


class Simulation:
    """B episodes in which the caller controls the egos and a driver controls the other agents."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        driver: Driver,
        *,
        num_episodes: int,
        dt_s: float,
        history: int,
        world_class: type[World] = ReplayWorld,
    ) -> None:
        """Creates a simulation without episodes; `reset` starts them.

        Args:
            recordings: the recordings that scenarios refer to by index.
            driver: controls the agents other than the egos.
            num_episodes: B.
            dt_s: length of a tick.
            history: past ticks that scenes show.
            world_class: the world to create; `asp_env.sim.world.world_class` finds the one for
                DATA.
        """
        self.world = world_class(recordings, num_episodes=num_episodes, dt_s=dt_s, history=history)
        self.driver = driver

    def reset(
        self,
        scenarios: Sequence[Scenario],
        rngs: Sequence[np.random.Generator],
        reset_mask: Bool[np.ndarray, " b"] | None = None,
    ) -> None:
        """Starts episodes.

        Args:
            scenarios: the scenario of each episode; entries outside `reset_mask` are not read.
            rngs: the random generator of each episode, likewise.
            reset_mask: mask of the episodes to start, all by default.

        Raises:
            AspEnvError: a scenario does not fit its recording, or the driver does not fit the
                world.
        """
        started = np.ones(len(self.world), dtype=bool) if reset_mask is None else reset_mask
        self.world.reset(scenarios, rngs, started)
        self.driver.reset(self.world, started)

    def step(
        self, ego_actions: Float[np.ndarray, "b 2"], ego_controlled: Bool[np.ndarray, " b"]
    ) -> None:
        """Advances all episodes by one tick.

        Args:
            ego_actions: [acceleration m/s², steering rad] of the egos.
            ego_controlled: mask of the egos that execute their action; the world moves the others.
        """
        control = self.driver.control(self.world)
        actions, controlled = control.actions.copy(), control.controlled.copy()
        actions[:, EGO], controlled[:, EGO] = ego_actions, ego_controlled
        euler = None if control.euler is None else control.euler.copy()
        if euler is not None:
            euler[:, EGO] = False
        self.world.step(actions, controlled, control.leaving, euler)

    def step_agents(
        self, actions: Float[np.ndarray, "b a 2"], controlled: Bool[np.ndarray, "b a"]
    ) -> None:
        """Advances all episodes by one tick in which the caller controls any agents.

        Args:
            actions: [acceleration m/s², steering rad] of all agents.
            controlled: mask of the agents that execute their action in `actions`. The driver
                controls the others, except egos, which the world moves.
        """
        control = self.driver.control(self.world)
        by_driver = control.controlled & ~controlled
        by_driver[:, EGO] = False
        self.world.step(
            np.where(controlled[..., None], actions, control.actions),
            controlled | by_driver,
            control.leaving & ~controlled,
            None if control.euler is None else control.euler & by_driver,
        )

    def snapshot(self) -> tuple[Any, Driver]:
        """A copy of the whole state, the driver's memory included, for `restore`."""
        return self.world.snapshot(), copy.deepcopy(self.driver)

    def restore(self, snapshot: tuple[Any, Driver]) -> None:
        """Returns to the state of a snapshot, bit for bit."""
        world, driver = snapshot
        self.world.restore(world)
        self.driver = copy.deepcopy(driver)


def ending(events: Events) -> Int[np.ndarray, " b"]:
    """`Ending` of each episode; of several that apply, the first in the order of `Ending`."""
    endings = np.full(len(events.elapsed), int(Ending.RUNNING), dtype=np.int64)
    masks = (
        (Ending.OUT_OF_DATA, events.elapsed >= events.length),
        (Ending.GOAL, events.reached_goal),
        (Ending.OFF_ROAD, events.off_road_m > OFF_ROAD_END_M),
        (Ending.COLLISION, events.at_fault),
    )
    for kind, mask in masks:
        endings[mask] = int(kind)
    return endings
