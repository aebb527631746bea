"""A planner: the ego neither accelerates nor steers."""

import numpy as np

from asp_env import Forecast, Plan, Scene
from asp_env.dynamics import rollout


class Coasting:
    """Keeps the ego at its speed and heading, whatever is forecast."""

    name = "sample-coasting"
    privileged = False
    uses_forecasts = False

    def plan(self, scene: Scene, forecast: Forecast) -> Plan:
        """Plans zero actions over the horizon of the forecast."""
        actions = np.zeros((len(scene.tick), forecast.states.shape[2], 2), dtype=np.float32)
        states = rollout(scene.states[:, 0, -1], actions, scene.sizes[:, 0, 0], scene.dt_s)
        return Plan(actions=actions, states=states)
