"""The logged driver itself: what every planner is measured against."""

from typing import NoReturn

from asp_env.data.forecast import Forecast
from asp_env.data.scene import Scene
from asp_env.errors import AspEnvError


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
