"""A predictor: every agent stands still from now on."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from asp_env import AspEnvError, Forecast, Scene
from asp_env.data import Future, make_forecast


@dataclass(frozen=True)
class Standing:
    """Forecasts one mode, in which the target stays where it is."""

    horizon: int
    dt_s: float
    name: str = "sample-standing"
    privileged: bool = False
    history: int = 1
    trained_on: None = None
    metadata: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "Standing":
        """Makes the predictor, which takes no argument."""
        if argument:
            raise AspEnvError(f"sample-standing takes no argument, {argument!r} was given")
        return cls(horizon, dt_s)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts every target of the scene."""
        del future
        states = np.repeat(scene.target_states[:, None, None], self.horizon, axis=2)
        states[..., 3] = 0.0
        return make_forecast(
            scene,
            states=states,
            actions=None,
            log_probs=np.zeros(states.shape[:2]),
            valid=scene.predictable,
        )
