"""The socket for planners."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from asp_env import registry
from asp_env.data.forecast import Forecast
from asp_env.data.scene import Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What the ego of each of B situations means to do over T ticks; the first action is done."""

    actions: Float[np.ndarray, "b t 2"]
    states: Float[np.ndarray, "b t 4"]


@runtime_checkable
class Planner(Protocol):
    """Decides for the egos (slot 0) of a scene."""

    name: str
    privileged: bool
    """Whether it follows the recorded future; tables name such a planner."""
    uses_forecasts: bool
    """Whether a predictor makes a difference to it."""

    def plan(self, scene: Scene, forecast: Forecast) -> Plan:
        """A plan for every situation; the forecast speaks of everybody else who is there now."""
        ...


def load_planner(name: str) -> Planner:
    """The planner registered under a name.

    Raises:
        AspEnvError: the name is unknown.
    """
    return registry.find("planners", name)()
