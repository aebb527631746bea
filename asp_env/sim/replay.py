"""Worlds that replay recordings: logged agents move as recorded, driven ones by the bicycle."""

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.dynamics import forward
from asp_env.sim.kernels import read_obeying, write_tick
from asp_env.sim.scenario_world import ScenarioWorld


class ReplayWorld(ScenarioWorld):
    """Whom nobody drives moves as recorded."""

    traffic = "log"

    def _move(
        self,
        rows: Int[np.ndarray, " r"],
        now: Int[np.ndarray, " r"],
        actions: Float[np.ndarray, "b a 2"],
        driven: Bool[np.ndarray, "r a"],
        obeys: Bool[np.ndarray, "r a"],
    ) -> None:
        moved = forward(*read_obeying(self.episodes, rows, now, actions, obeys), self.dt_s)
        write_tick(self.episodes, rows, now, driven, obeys, moved)
