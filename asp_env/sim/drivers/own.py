"""Agents that the world itself drives."""

import numpy as np
from jaxtyping import Bool

from asp_env.errors import AspEnvError
from asp_env.sim.drivers.driver import Control, Plain, idle
from asp_env.sim.scenario_world import ScenarioWorld


class OwnDriver(Plain):
    """Everybody is left to a world whose vehicles drive themselves."""

    name = "own"

    def reset(
        self,
        world: ScenarioWorld,
        where: Bool[np.ndarray, " b"],
        mine: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Nothing to prepare.

        Raises:
            AspEnvError: the world has no drivers of its own.
        """
        del where, mine
        if world.traffic != self.name:
            raise AspEnvError(
                f"traffic {self.name}: vehicles of recordings do not drive themselves; use "
                f"{world.traffic}, idm or predictor:NAME"
            )

    def control(self, world: ScenarioWorld) -> Control:
        """Nobody is driven by anybody else."""
        return idle(world.episodes.ids.shape)
