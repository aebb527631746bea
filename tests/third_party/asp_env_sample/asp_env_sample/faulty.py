"""A predictor with faults: its argument names the one that it has."""

import dataclasses
import time
from dataclasses import dataclass

import numpy as np

from asp_env import AspEnvError, Forecast, Scene
from asp_env.data import Future
from asp_env_sample.predictor import Standing

FAULTS = ("raises", "not-finite", "shapes", "ids", "slow")
SLOW_S = 2.0
"""Time that a forecast for one episode takes."""


@dataclass(frozen=True)
class Faulty(Standing):
    """Forecasts like `Standing`, with a fault at every tick."""

    name: str = "sample-faulty"
    fault: str = "raises"

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "Faulty":
        """Makes the predictor with a fault."""
        if argument not in FAULTS:
            raise AspEnvError(f"sample-faulty:{argument}: expected one of {', '.join(FAULTS)}")
        return cls(horizon, dt_s, fault=argument)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts every target of the scene, unless the fault prevents it."""
        if self.fault == "raises":
            raise RuntimeError("out of memory")
        forecast = super().predict(scene, future)
        if self.fault == "not-finite":
            return dataclasses.replace(forecast, states=forecast.states * np.nan)
        if self.fault == "shapes":
            return dataclasses.replace(forecast, states=forecast.states[:, :, :-1])
        if self.fault == "ids":
            return dataclasses.replace(forecast, ids=forecast.ids + 1)
        time.sleep(SLOW_S * len(scene.tick))
        return forecast
