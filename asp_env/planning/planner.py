"""The socket for planners.

MERGED: The logged driver itself: what every planner is measured against.
"""

from dataclasses import dataclass
from typing import NoReturn, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from asp_env import registry
from asp_env.data.predictor import Forecast
from asp_env.data.scene import Scene
from asp_env.errors import AspEnvError


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


class Expert:
    """Replays the logged ego, position by position; it plans nothing.

    Its score is the noise floor of data and metrics. Whoever runs planners looks at `privileged`
    and lets the world replay the ego, so that `plan` is never asked.
    """

    name = "expert"
    privileged = True
    uses_forecasts = False

    def plan(self, scene: Scene, forecast: Forecast) -> NoReturn:
        """Refuses: the log is not in the scene.

        Raises:
            AspEnvError: always.
        """
        del scene, forecast
        raise AspEnvError("the expert does not plan: let the world replay the ego")
