"""The most probable mode of another predictor alone, to show what its other modes are worth."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from asp_env.data.predictor import Forecast, load_predictor
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.errors import AspEnvError
from predictors.wrapping import Wrapping


@dataclass(frozen=True, slots=True, kw_only=True)
class MostProbable(Wrapping):
    """The most probable mode of another predictor's forecast, with a probability of 1.

    Of equally probable modes it is the first. All else is the other predictor's.
    """

    @property
    def name(self) -> str:
        """`most-probable:` and the name of the other predictor."""
        return f"most-probable:{self.inner.name}"

    @property
    def horizon(self) -> int:
        """Ticks that the other predictor forecasts."""
        return self.inner.horizon

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "MostProbable":
        """Loads the other predictor.

        Args:
            argument: NAME[:RUN], the other predictor.
            horizon: number of ticks to forecast.
            dt_s: seconds per tick.

        Raises:
            AspEnvError: The argument is empty, or the other predictor cannot be loaded.
        """
        if not argument:
            raise AspEnvError(
                "predictor most-probable: expected most-probable:NAME[:RUN] with the name of a "
                "predictor, such as most-probable:ffw-asp:pretrained"
            )
        return cls(inner=load_predictor(argument, horizon=horizon, dt_s=dt_s))

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets in one mode.

        Args:
            scene: the present scene.
            future: the recorded future of the targets, if privileged.

        Raises:
            AspEnvError: The other predictor refuses the scene.
        """
        forecast = self.inner.predict(scene, future)
        best = forecast.log_probs.argmax(axis=1)[:, None, None, None]
        return dataclasses.replace(
            forecast,
            states=np.take_along_axis(forecast.states, best, axis=1),
            actions=np.take_along_axis(forecast.actions, best, axis=1),
            log_probs=np.zeros((len(best), 1), dtype=np.float32),
        )
