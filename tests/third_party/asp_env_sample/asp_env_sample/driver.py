"""A driver: agents keep their speed and heading while their tracks last."""

from dataclasses import replace

import numpy as np

from asp_env.sim.traffic import BaseDriver, Control, controllable_agents
from asp_env.sim.traffic.log import LogActionsDriver
from asp_env.sim.world import World


class Cruising(BaseDriver):
    """Executes zero actions instead of the recorded ones."""

    name = "sample-cruising"

    def __init__(self) -> None:
        self._log = LogActionsDriver()

    def reset(
        self, world: World, reset_mask: np.ndarray, agent_mask: np.ndarray | None = None
    ) -> None:
        """Prepares for new episodes."""
        agents = controllable_agents(world) if agent_mask is None else agent_mask
        self._log.reset(world, reset_mask, agents)

    def control(self, world: World) -> Control:
        """Zero actions for the agents that are present."""
        control = self._log.control(world)
        return replace(control, actions=np.zeros_like(control.actions))
