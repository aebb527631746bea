"""Agents of the caller."""

import numpy as np
from jaxtyping import Bool

from asp_env.sim.drivers.driver import (
    Control,
    Plain,
    areas,
    idle,
    outside,
    resized,
    vehicles,
)
from asp_env.sim.scenario_world import ScenarioWorld


class PolicyDriver(Plain):
    """The caller moves its agents by `Simulation.step_agents`.

    At a tick at which the caller does not, an agent goes on as it is: no acceleration, no steering.
    One that comes 10 m beyond all recorded positions then leaves.
    """

    name = "policy"

    def __init__(self) -> None:
        """A driver without agents; `reset` gives it some."""
        self._mine = np.zeros((0, 0), dtype=bool)
        self._areas = np.zeros((0, 4))

    def reset(
        self,
        world: ScenarioWorld,
        where: Bool[np.ndarray, " b"],
        mine: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Remembers whose the agents are."""
        self._mine = vehicles(world) if mine is None else mine
        self._areas = resized(self._areas, (len(world), 4))
        self._areas[where] = areas(world)[where]

    def control(self, world: ScenarioWorld) -> Control:
        """Straight on, for those whom the caller leaves alone."""
        episodes, rows = world.episodes, np.arange(len(world))
        driven = self._mine & episodes.valid[rows, world.now]
        leaving = driven & outside(episodes.states[rows, world.now], self._areas)
        nothing = idle(driven.shape)
        return Control(actions=nothing.actions, driven=driven & ~leaving, leaving=leaving)
